"""Conditions of decks: values at nodes that sets have in common, within a step and from step to step; elements, and what is said.

Read first: ``test_forces``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from deck_scenes import columns, deck, grid, node_sets, written
from helpers import refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, ALPHA = 1000.0, 1e-5
STEEL = f"*MATERIAL, NAME=STEEL\n*ELASTIC\n{E}, {{}}\n*EXPANSION\n{ALPHA}\n*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n"
HELD = "*BOUNDARY\nfoot 1, 3, 6\n101, 1, 2\n102, 2\n"
FLAT = "*BOUNDARY\nfoot 1, 2, 6\n101, 1\n"


def column(*steps, nu=0.3, kind="C3D8", cells=2, thickness="", held=HELD):
    """A column of height 2 with an area of 1, and steps of these conditions."""
    start = "*INITIAL CONDITIONS, TYPE=TEMPERATURE\nall, 20.\n"
    taken = "".join(f"*STEP\n*STATIC\n{step}*END STEP\n" for step in steps)
    return columns([(0.0, 2.0, cells)], kind) + STEEL.format(nu) + thickness + start + held + taken


def read(folder, text):
    """The deck of this text."""
    return uem.read_deck(written(folder, text), COMM)


def heights(folder, text, node=121):
    """Displacement of a node along the column at the end of each step, and the deck."""
    deck = read(folder, text)
    return [float(deck.displacement(node)[-1]) for _ in deck.run()], deck


HEAD, EACH = "head 1, 3, -25.\n", "121, 3, {0}\n122, 3, {0}\n123, 3, {0}\n124, 3, {0}\n"
FORCES = {
    "twice in a keyword": ([f"*CLOAD\n{HEAD}{HEAD}"], [200.0]),
    "in two keywords": ([f"*CLOAD\n{HEAD}*CLOAD\n" + EACH.format(-5.0)], [120.0]),
    "anew by nodes": ([f"*CLOAD\n{HEAD}", "*CLOAD\n" + EACH.format(-5.0)], [100.0, 20.0]),
    "new": ([f"*CLOAD\n{HEAD}", "*CLOAD, OP=NEW\n" + EACH.format(-5.0)], [100.0, 20.0]),
    "new twice": ([f"*CLOAD\n{HEAD}", f"*CLOAD, OP=NEW\n{HEAD}*CLOAD, OP=NEW\n" + EACH.format(-5.0)], [100.0, 120.0]),
    "none": ([f"*CLOAD\n{HEAD}", "*CLOAD, OP=NEW\n"], [100.0, 0.0]),
    "no rotations": ([f"*CLOAD\n{HEAD}head 1, 5, 1.\n"], [100.0]),
}


@pytest.mark.parametrize("case", FORCES)
def test_forces(folder, case):
    """Forces at a node add within a step, and replace those of steps before; the first OP=NEW of a step ends them."""
    steps, forces = FORCES[case]
    found, deck = heights(folder, column(*steps))
    assert found == pytest.approx([-2 * force / E for force in forces], rel=1e-9, abs=1e-15)
    assert deck.left_out == (["degree of freedom 5 of *CLOAD: the bodies have none such"] if case == "no rotations" else [])


TOP = "*SURFACE, NAME=top\n11, S2\n"
PRESSURES = {
    "twice": (["*DLOAD\n11, P2, 1.\n*DLOAD\n11, P2, 2.\n"], [3.0]),
    "on surfaces": (["*DSLOAD\nover 1, P, 1.\n*DLOAD\n11, P2, 2.\n"], [3.0]),
    "anew": (["*DSLOAD\nover 1, P, 1.\n", "*DLOAD\n11, P2, 5.\n"], [1.0, 5.0]),
    "new": (["*DLOAD\n11, P2, 1.\n", "*DLOAD, OP=NEW\n11, P2, 2.\n*DLOAD, OP=NEW\n11, P2, 2.\n"], [1.0, 4.0]),
}


@pytest.mark.parametrize("case", PRESSURES)
def test_pressures(folder, case):
    """The same of pressures on sides, of elements as of surfaces."""
    steps, pressures = PRESSURES[case]
    assert heights(folder, column(*steps))[0] == pytest.approx([-2 * p / E for p in pressures], rel=1e-9)


HOLD = "*BOUNDARY\nhead 1, 3, 3, {}\n"
HOLDS = {
    "anew by nodes": ([HOLD.format(-0.01), "*BOUNDARY\n" + EACH.format("3, -0.03")], [-0.01, -0.03]),
    "anew by a set": (["*BOUNDARY\n" + EACH.format("3, -0.03"), HOLD.format(-0.01)], [-0.03, -0.01]),
    "the last in a step": ([HOLD.format(-0.01) + HOLD.format(-0.02)], [-0.02]),
    "new": ([HOLD.format(-0.01), f"*CLOAD\n{HEAD}" + HELD.replace("RY", "RY, OP=NEW")], [-0.01, -0.2]),
    "by name": (["*BOUNDARY\nhead 1, XSYMM\nhead 1, 3, 3, -0.02\n"], [-0.02]),
    "new twice": (
        [HOLD.format(-0.01), HELD.replace("RY", "RY, OP=NEW") + HOLD.replace("RY", "RY, OP=NEW").format(0.02)],
        [-0.01, 0.02],
    ),
}


@pytest.mark.parametrize("case", HOLDS)
def test_prescribed_values(folder, case):
    """The last value of a node counts, whatever sets it is in; OP=NEW ends all values, those before the steps as well."""
    steps, found = HOLDS[case]
    assert heights(folder, column(*steps))[0] == pytest.approx(found, rel=1e-9)


def test_one_node_otherwise(folder):
    """A node of a held set that is led elsewhere: with nu = 0 a corner of the head, whose others stay."""
    deck = read(folder, column("*BOUNDARY\nhead 1, 3, 3, -0.01\n121, 3, 3, -0.03\n"))
    for _ in deck.run():
        pass
    assert [deck.displacement(node)[2] for node in (121, 122, 123, 124)] == pytest.approx([-0.03, -0.01, -0.01, -0.01])


def test_hexahedra_bend_as_in_calculix(folder):
    """C3D8 are integrated fully: displacements of CalculiX 2.20 for the same deck."""
    deck = read(folder, column("*CLOAD\nhead 1, 1, 1.\n"))
    for _ in deck.run():
        pass
    assert deck.displacement(123) == pytest.approx([0.1165477, -0.00996147, -0.0296958], rel=1e-5)


A = "*AMPLITUDE, NAME=a{}\n0., 0., 0.5, 1.,\n1., -0.5\n*AMPLITUDE, NAME=b\n0., 2., 4., 0.\n"
COURSES = {
    "its own time": ("", [f"*BOUNDARY, AMPLITUDE=A\n{EACH.format('3, -0.02')}", ""], lambda t: -0.02 * ramp(min(t, 2.0))),
    "all the time": (", TIME=TOTAL TIME", [HOLD.format(-0.02).replace("RY", "RY, AMPLITUDE=a"), ""], lambda t: -0.02 * ramp(t)),
    "forces, twice": ("", [f"*CLOAD, AMPLITUDE=a\n{HEAD}{HEAD}", ""], lambda t: -0.4 * ramp(min(t, 2.0))),
    "then a ramp": ("", [HOLD.format(-0.02).replace("RY", "RY, AMPLITUDE=a"), HOLD.format(-0.03)], lambda t: upto(t, -0.03)),
    "pressures, another one": (
        "",
        [f"*CLOAD, AMPLITUDE=a\n{HEAD}*DLOAD, AMPLITUDE=b\n11, P2, 50.\n", ""],
        lambda t: -0.2 * ramp(min(t, 2.0)) - 0.1 * np.interp(min(t, 2.0), [0, 4], [2, 0]),
    ),
}


def ramp(t):
    """The amplitude ``a`` of ``A``."""
    return float(np.interp(t, [0.0, 0.5, 1.0], [0.0, 1.0, -0.5]))


def upto(t, end):
    """The same in the first step, and from its end to another value in the second one."""
    return -0.02 * ramp(t) if t <= 2.0 else 0.01 + (t - 2.0) / 2.0 * (end - 0.01)


@pytest.mark.parametrize("case", COURSES)
def test_amplitudes(folder, case):
    """Values follow tables of times in their step, and stay as they are at its end, or of the time in all, in two steps of 2 s."""
    how, steps, expected = COURSES[case]
    text = column(*steps, thickness=A.format(how)).replace("*STATIC\n", "*STATIC\n0.25, 2.\n")
    found, deck = heights(folder, text)
    assert found == pytest.approx([expected(0.25 * (k + 1)) for k in range(16)], rel=1e-9, abs=1e-12)
    assert not deck.left_out


AXES = {
    "inclined forces": ("R\n0.6, 0., 0.8, 0., 1., 0.", "*CLOAD\nhead 1, 1, 5.\nhead 1, 2, 1.\n", (0.312076, 0.1015008, 0.1451126)),
    "inclined, held": ("R\n0.6, 0., 0.8, 0., 1., 0.", "*BOUNDARY\nhead 1, 1, 1, 0.01\n", (0.01242776, 0.0004986275, 0.003179179)),
    "round forces": ("C\n.5, .25, 0., .5, .25, 1.", "*CLOAD\nhead 1, 1, 5.\nhead 1, 2, 1.\n", (9.756245e-3, 3.746153e-2, 2.073253e-2)),
    "round, held": ("C\n.5, .25, 0., .5, .25, 1.", "*BOUNDARY\nhead 1, 1, 1, 0.01\nhead 1, 3, 3, 0.02\n", (-0.0151811, 8.001524e-3, 0.02)),
}  # fmt: skip


@pytest.mark.parametrize("case", AXES)
def test_local_directions(folder, case):
    """Forces and prescribed values in the directions of a *TRANSFORM: displacements of CalculiX 2.20 for the same deck."""
    axes, step, expected = AXES[case]
    deck = read(folder, column(step, thickness=f"*TRANSFORM, NSET=head 1, TYPE={axes}\n"))
    for _ in deck.run():
        pass
    assert deck.displacement(121) == pytest.approx(expected, rel=1e-6)
    assert not deck.left_out


def test_terms_of_equations_in_local_directions(folder):
    """Two corners of the head move alike along a local direction, which is the column's axis, and are pushed along it."""
    how = "*TRANSFORM, NSET=head 1, TYPE=R\n0., 0., 1., 1., 0., 0.\n*EQUATION\n2\n121, 1, 1., 122, 1, -1.\n"
    deck = read(folder, column("*CLOAD\n121, 1, -5.\n", thickness=how))
    for _ in deck.run():
        pass
    assert deck.displacement(121)[2] == pytest.approx(deck.displacement(122)[2], rel=1e-9)
    assert deck.displacement(121)[2] < 0.0


RIGID = "*NODE\n900, 0.5, 0.5, 3.\n901, 0., 0., 0.\n*RIGID BODY, NSET=head 1, REF NODE=900{}\n"
BODIES = {
    "pushed": (", ROT NODE=901", "*CLOAD\n900, 3, -100.\n", (0.0, 0.0, -0.2)),
    "pushed along a local axis": (
        ", ROT NODE=901\n*NSET, NSET=at\n900\n*TRANSFORM, NSET=at\n0., 0., 1., 1., 0., 0.", "*CLOAD\n900, 1, -100.\n", (0.0, 0.0, -0.2),
    ),
    "led": (", ROT NODE=901", "*BOUNDARY\n900, 3, 3, -0.02\n901, 1, 3\n", (0.0, 0.0, -0.02)),
    "turned": (", ROT NODE=901", "*BOUNDARY\n900, 1, 3\n901, 1, 1, 0.01\n901, 2, 3\n", (0.0, 0.01, -0.005)),
    "turned as in Abaqus": ("", "*BOUNDARY\n900, 1, 3\n900, 4, 4, 0.01\n900, 5, 6\n", (0.0, 0.01, -0.005)),
}  # fmt: skip


@pytest.mark.parametrize("case", BODIES)
def test_rigid_bodies(folder, case):
    """A rigid head, led or loaded at its reference nodes, halfway and at the end: the rigid motion of the corner at the origin."""
    how, step, expected = BODIES[case]
    text = column(step, nu=0.0, thickness=RIGID.format(how), held="*BOUNDARY\nfoot 1, 1, 3\n")
    deck = read(folder, text.replace("*STATIC\n", "*STATIC\n0.5, 1.\n"))
    for share, _ in zip((0.5, 1.0), deck.run()):
        assert deck.displacement(121) == pytest.approx(share * np.array(expected), rel=1e-9, abs=1e-12)
    assert not deck.left_out


@pytest.mark.parametrize(
    ("row", "said"),
    [("1, 1, 0.01", ("reference node 900", "global axis")), ("4, 4, 0.01", ("degree of freedom 4", "*TRANSFORM"))],
)
def test_rigid_bodies_in_local_directions(folder, row, said):
    """A reference node is not held in an inclined direction, nor are rotations of the node with a *TRANSFORM."""
    how = "\n*NSET, NSET=at\n900\n*TRANSFORM, NSET=at\n0.6, 0., 0.8, 0., 1., 0."
    text = column(f"*BOUNDARY\n900, {row}\n", thickness=RIGID.format(how), held="*BOUNDARY\nfoot 1, 1, 3\n")
    refused(uem.InputError, said, lambda: read(folder, text))


def test_thickness(folder):
    """Forces act on the thickness of plane bodies, pressures on an area; the deck says what contacts mean."""
    text = column("*CLOAD\nhead 1, 2, -5.\n", "*CLOAD, OP=NEW\n*DLOAD\n11, P3, 10.\n", kind="CPS4", thickness="0.1\n", held=FLAT)
    found, deck = heights(folder, text)
    assert found == pytest.approx([-2 * 100.0 / E, -2 * 10.0 / E], rel=1e-9)
    assert "thickness 0.1" in deck.left_out[0]
    other = "0.1\n*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n0.2\n"
    refused(uem.InputError, ("0.1 and 0.2",), lambda: read(folder, column("", kind="CPS4", thickness=other, held=FLAT)))


def test_temperatures(folder):
    """A hexahedron has the mean temperature of its vertices, and grows without stress; OP=NEW brings others back to the start."""
    steps = ["*TEMPERATURE\nall, 120.\n", "*TEMPERATURE, OP=NEW\nhead 1, 220.\n", "*TEMPERATURE\nhead 1, 420.\n"]
    deck = read(folder, column(*steps, cells=1))
    found = [deck.displacement(113) for _ in deck.run()]
    assert np.array(found) == pytest.approx(ALPHA * np.outer([100.0, 100.0, 200.0], [1.0, 1.0, 2.0]), rel=1e-9)


SPUN = "*DLOAD\nbody 1, CENTRIF, 2., 0.5, 0.25, 0., 0., 1., 3.\n"
MASSES = {
    "weight": ("*DLOAD\nbody 1, GRAV, 4., 0., 3., -8.\n", (-2.749631e-3, 7.902200e-2, 7.607675e-4), 1e-6),
    "about an axis": (SPUN, (7.985714e-4, -1.813036e-2, -4.897917e-3), 1e-6),
    # at the deformed positions; at those before 8.0e-4 along x
    "at large displacements": (SPUN, (1.007373e-3, -1.921679e-2, -5.214223e-3), 4e-3),
}


@pytest.mark.parametrize("case", MASSES)
def test_loads_on_masses(folder, case):
    """Gravity, and centrifugal forces about an inclined axis: displacements of CalculiX 2.20 for the same deck."""
    load, wanted, rel = MASSES[case]
    text = column(load).replace("*EXPANSION", "*DENSITY\n2.5\n*EXPANSION")
    deck = read(folder, text.replace("*STEP", "*STEP, NLGEOM") if "large" in case else text)
    list(deck.run())
    assert deck.displacement(121) == pytest.approx(wanted, rel=rel) and deck.left_out == []


def test_weights_of_steps(folder):
    """A column under its weight, ``rho g L^2 / 2 E`` at its head: of both elements, of the lower one, and ended by OP=NEW."""
    steps = [
        "*DLOAD\nbody 1, GRAV, 8., 0., 0., -1.\n",
        "*DLOAD, OP=NEW\n10, GRAV, 8., 0., 0., -1.\n",
        "*DLOAD, OP=NEW\n11, P2, 1.\n",
    ]
    found, deck = heights(folder, column(*steps, nu=0.0).replace("*EXPANSION", "*DENSITY\n2.5\n*EXPANSION"))
    assert found == pytest.approx([-2.5 * 8.0 * 2.0 / E, -2.5 * 8.0 * 0.5 / E, -2.0 / E], rel=1e-9) and deck.left_out == []
    refused(uem.InputError, ("'STEEL' has no *DENSITY", "mass of"), lambda: read(folder, column(steps[0])))
    refused(uem.InputError, ("*DLOAD", "expected a direction"), lambda: read(folder, column("*DLOAD\nbody 1, GRAV, 8.\n")))


def test_what_is_said(folder):
    """Options that are not taken, and elements that are integrated otherwise, are named."""
    step = "*BOUNDARY, LOAD CASE=2\nhead 1, 1, 1\n*CLOAD, USER\nhead 1, 3, -1.\n"
    spring = "*ELEMENT, TYPE=SPRINGA, ELSET=springs\n900, 101, 121\n*MATERIAL"
    text = column(step).replace("*STEP", "*STEP, PERTURBATION").replace("C3D8", "C3D8I")
    deck = read(folder, text.replace("*MATERIAL", spring))
    assert deck.left_out == [
        "PERTURBATION of *STEP", "LOAD CASE of *BOUNDARY", "USER of *CLOAD", "1 elements of type SPRINGA: they are no part of a body",
        "C3D8I: complete cells, integrated fully",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("*ELASTIC", "*ELASTIC, TYPE=ORTHO", ("TYPE=ORTHO", "ISO")),
        ("*BOUNDARY\nhead", "*BOUNDARY, AMPLITUDE=none\nhead", ("no amplitude 'NONE'",)),
        ("*BOUNDARY", "*AMPLITUDE, NAME=a, USER\n*BOUNDARY", ("by a function", "table")),
        ("*BOUNDARY", "*AMPLITUDE, NAME=a\n1., 0., 1., 1.\n*BOUNDARY", ("times that grow",)),
        ("*BOUNDARY", "*TRANSFORM, NSET=head 1\n1., 0., 0., 2., 0., 0.\n*BOUNDARY", ("no directions",)),
        ("*EXPANSION", "*EXPANSION, TYPE=ORTHO", ("TYPE=ORTHO", "ISO")),
        ("*BOUNDARY\nhead", "*BOUNDARY, FIXED\nhead", ("FIXED",)),
        ("head 1, 3", "head 1, 0", ("degree of freedom 0", "1 to 3")),
        ("11, P2", "11, P1", ("between two elements",)),
        ("head 1, 3", "empty, 3", ("'empty'", "no nodes")),
        ("MATERIAL=STEEL", "MATERIAL=IRON", ("'IRON'", "STEEL")),
        ("ELSET=body 1, MATERIAL", "ELSET=body 3, MATERIAL", ("'BODY 3'",)),
        ("*BOUNDARY", "*SOLID SECTION, ELSET=half, MATERIAL=STEEL\n*BOUNDARY", ("element 10", "two sections")),
        ("*BOUNDARY", "*EQUATION\n2\n121, 5, 1., 122, 5, -1.\n*BOUNDARY", ("'5'", "1 to 3")),
        ("ELSET=body 1, MATERIAL", "ELSET=half, MATERIAL", ("element 11", "*SOLID SECTION")),
    ],
)
def test_what_is_refused(folder, old, new, said):
    """What would be taken for something else."""
    text = column("*DLOAD\n11, P2, 1.\n*BOUNDARY\nhead 1, 3, 3\n").replace(
        "*MATERIAL", "*NSET, NSET=empty\n*ELSET, ELSET=half\n10\n*MATERIAL"
    )
    assert old in text
    refused(uem.InputError, said, lambda: read(folder, text.replace(old, new, 1)))


def test_adjusted_by_a_set(folder):
    """ADJUST with a set closes gaps as ADJUST with a length does, and says that it takes all contactors."""
    gap = 1e-3
    text = (
        columns([(0.0, 1.0, 1), (1.0 + gap, 2.0 + gap, 1)]) + STEEL.format(0.0) + "*SOLID SECTION, ELSET=body 2, MATERIAL=STEEL\n"
    )
    text += "*CONTACT PAIR, INTERACTION=I, ADJUST={}, TYPE=SURFACE TO SURFACE\nunder 2, over 1\n*SURFACE INTERACTION, NAME=I\n"
    text += "*BOUNDARY\nfoot 1, 1, 3\nfoot 2, 1, 2\nhead 2, 1, 2\n*STEP\n*STATIC\n*CLOAD\nhead 2, 3, -0.25\n*END STEP\n"
    for given in ("0.01", "foot 2"):
        found, deck = heights(folder, text.format(given), node=211)
        assert found == pytest.approx([-2.0 / E], rel=1e-9)
        assert deck.left_out == (
            ["ADJUST=foot 2 of *CONTACT PAIR: all contactors near the surface are adjusted"] if given[0] == "f" else []
        )


@pytest.mark.long
def test_direct_steps_of_heat(folder):
    """With DIRECT all steps of time have the given length."""
    heat = "*CONDUCTIVITY\n1.\n*SPECIFIC HEAT\n1.\n*DENSITY\n1.\n*SOLID"
    step = "*BOUNDARY\nhead 1, 1, 3\nfoot 1, 11, 11, 100.\n"
    for option in ("", ", DIRECT"):
        text = column(step).replace("*SOLID", heat).replace("*STATIC\n", f"*HEAT TRANSFER{option}\n0.05, 1.\n")
        deck = read(folder, text)
        taken = [float(deck._dt.value) for _ in deck.run()]
        assert sum(taken) == pytest.approx(1.0) and (len(set(np.round(taken, 9))) == 1) is bool(option)
        assert not option or len(taken) == 20


@pytest.mark.long
@pytest.mark.parametrize(("kind", "n"), [("quad", 3), ("hexahedron", 8)])
def test_forces_at_the_nodes_of_a_side(folder, kind, n):
    """The work of the stresses in a stretch is that of the n forces of the file, none at nodes that complete its cells."""
    x, name, cells = grid(kind, 2, 1)
    sets = node_sets({"foot": np.flatnonzero(x[:, -1] == 0.0), "head": np.flatnonzero(x[:, -1] == 1.0)})
    text = sets + STEEL.format(0.0).replace("body 1", name) + "*BOUNDARY\nfoot, 1, 3\n"
    read = uem.read_deck(
        deck(folder, "side.inp", x, {name: cells}, text + f"*STEP\n*STATIC\n*CLOAD\nhead, {x.shape[1]}, 0.5\n*END STEP\n"), COMM
    )
    list(read.run())
    assert uem.integrate(E * read.u[x.shape[1] - 1].dx(x.shape[1] - 1) * ufl.dx) == pytest.approx(0.5 * n, rel=1e-8)
