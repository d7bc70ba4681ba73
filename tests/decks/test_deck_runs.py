"""Decks of Abaqus and CalculiX from their files: stresses, heat, bolts, contacts and steps in closed form, and what is left out.

Read first: ``test_two_columns``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from deck_scenes import columns, deck, grid, node_sets, written
from dolfinx import fem
from helpers import refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, ALPHA = 2.1e5, 1.2e-5
SOLID = "".join(f"*SOLID SECTION, ELSET=body {k}, MATERIAL=steel\n" for k in (1, 2))
STEEL = f"*MATERIAL, NAME=STEEL\n*ELASTIC\n{E}, 0.0\n*EXPANSION\n{ALPHA}\n"
PAIR = "*CONTACT PAIR, INTERACTION=I, TYPE={}\nunder 2, over 1\n*SURFACE INTERACTION, NAME=I\n{}"
HELD = "foot 1, 1, 3\nfoot 2, 1, 2\nhead 2, 1, 2\nhead 1, 1, 2\n"
BOTH = HELD + "head 2, 3\n"


def two(how="SURFACE TO SURFACE", law="", gap=0.0, step="", material=STEEL, held=HELD, cells=2):
    """Two columns of height 1, the upper one with a gap, which it closes under a load."""
    text = columns([(0.0, 1.0, cells), (1.0 + gap, 2.0 + gap, cells)]) + material + SOLID + PAIR.format(how, law)
    return text + "*BOUNDARY\n" + (held) + step


def ran(folder, text, **how):
    """The deck after all of its steps."""
    deck = uem.read_deck(written(folder, text), COMM, **how)
    for _ in deck.run():
        pass
    return deck


@pytest.mark.long
@pytest.mark.parametrize("how", ["SURFACE TO SURFACE", "NODE TO SURFACE"])
@pytest.mark.parametrize("nlgeom", ["", ", NLGEOM"])
def test_two_columns(folder, how, nlgeom):
    """A pressure on the upper one shortens both by p h / E, exactly in small strains, and is the contact's force on an area of 1."""
    p = 100.0
    deck = ran(folder, two(how=how, step=f"*STEP{nlgeom}\n*STATIC\n0.5, 1.0\n*DLOAD\n21, P2, {p}\n*END STEP\n"))
    tolerance = 2e-3 if nlgeom else 1e-10
    assert deck.displacement(121) == pytest.approx([0.0, 0.0, -p / E], rel=tolerance)
    assert deck.displacement(224)[2] == pytest.approx(-2 * p / E, rel=tolerance)
    assert deck.contacts["under 2 on over 1"].resultant().force[2] == pytest.approx(p, rel=1e-8)
    assert deck.left_out == [] and deck.problem.progress.steps == 2


@pytest.mark.long
@pytest.mark.parametrize("law", ["LINEAR", "EXPONENTIAL", "TABULAR"])
def test_laws_of_pressure(folder, law):
    """By default contact is hard and says so; else the gap is that of the law."""
    p, k = 100.0, 1e6
    numbers = {"LINEAR": f"{k}, 1.\n", "EXPONENTIAL": "1e-3, 50.\n", "TABULAR": "0., 0.\n1000., 1e-3\n"}[law]
    closure = {"LINEAR": p / k, "EXPONENTIAL": np.log(p / 50.0) * 1e-3 / np.log(100.0), "TABULAR": p * 1e-6}[law]
    text = two(
        law=f"*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE={law}\n{numbers}", step=f"*STEP\n*STATIC\n*DLOAD\n21, P2, {p}\n*END STEP\n"
    )
    hard, soft = ran(folder, text), ran(folder, text, soft=True)
    assert hard.displacement(221)[2] == pytest.approx(-2 * p / E, rel=1e-8) and "contact is hard" in hard.left_out[0]
    assert soft.displacement(221)[2] == pytest.approx(-2 * p / E - closure, rel=1e-6) and soft.left_out == []


def test_steps_that_go_on(folder):
    """Forces of nodes in steps, a contact that is taken away and put back, loads that are new."""
    force = "*CLOAD\nhead 2, 3, -25.\n"
    alone = "".join(f"{node}, 3, -50.\n" for node in (221, 222, 223, 224))
    steps = f"*STEP\n*STATIC\n{force}*END STEP\n*STEP\n*STATIC\n*CLOAD, OP=NEW\n{alone}*END STEP\n"
    held = HELD
    deck = uem.read_deck(written(folder, two(step=steps, held=held)), COMM)
    found = []
    for _ in deck.run():
        found.append(deck.displacement(221)[2])
    assert found == pytest.approx([-2 * 100.0 / E, -2 * 200.0 / E], rel=1e-9)
    off = "*MODEL CHANGE, TYPE=CONTACT PAIR, REMOVE\nunder 2, over 1\n"
    hung = two(step=f"*STEP\n*STATIC\n{force}*END STEP\n*STEP\n*STATIC\n{off}*END STEP\n", held=held + "foot 2, 3\n")
    deck = ran(folder, hung)
    assert abs(deck.displacement(121)[2]) < 1e-12 and deck.displacement(221)[2] == pytest.approx(-100.0 / E, rel=1e-9)


SLIDES = [([0.2, 0.2, 0.1], 0.2, {3: 0.1}), ([0.0, 0.3, 0.3], 0.0, {2: 0.3}), ([0.4, 0.4, 0.0], 0.4, {3: 0.0})]


@pytest.mark.long
@pytest.mark.parametrize(("expected", "mu", "changes"), SLIDES)
@pytest.mark.parametrize("how", ["SURFACE TO SURFACE", "NODE TO SURFACE"])
@pytest.mark.parametrize("soft", [False, True])
def test_friction_that_steps_change(folder, expected, mu, changes, how, soft):
    """A column that is pressed and led to and fro pulls with the coefficient of its step, as friction2 of CalculiX does."""
    p, held = 100.0, "foot 1, 1, 3\nhead 1, 1, 3\nfoot 2, 2, 2\n"
    law = "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR\n1e7, 1.\n" + (f"*FRICTION\n{mu}, 80.\n" if mu else "")
    steps = f"*STEP\n*STATIC\n0.5, 1.\n*DLOAD\n21, P2, {p}\n*BOUNDARY\nhead 2, 1, 2\n*END STEP\n"
    for k, way in enumerate((0.1, -0.1, 0.1), 1):
        change = f"*CHANGE FRICTION, INTERACTION=I\n*FRICTION\n{changes[k]}, 80.\n" if k in changes else ""
        steps += f"*STEP\n*STATIC\n0.5, 1.\n{change}*BOUNDARY\nhead 2, 1, 1, {way}\n*END STEP\n"
    deck = uem.read_deck(written(folder, two(how=how, law=law, step=steps, held=held)), COMM, soft=soft)
    pulled = {step.step: deck.contacts["under 2 on over 1"].resultant().force for step in deck.run()}
    assert not any("FRICTION" in one for one in deck.left_out)
    assert [abs(pulled[f"step {k}"][0]) / p for k in (2, 3, 4)] == pytest.approx(expected, abs=1e-6)
    assert pulled["step 4"][2] == pytest.approx(p, rel=1e-6)


def test_hexahedra_on_tetrahedra(folder):
    """A cube of hexahedra tied onto one of tetrahedra that does not match: linear displacements are exact."""
    (x, name, cells), (other_x, other, other_cells) = grid("tetra", 1, 2), grid("hexahedron", 1, 3)
    points, nu, e = np.vstack([x, other_x + [0.0, 0.0, 1.0]]), 0.3, 0.005
    places = points.T
    first = np.arange(len(points)) < len(x)
    sets = {"low": first & (places[2] == 1.0), "high": ~first & (places[2] == 1.0), "bottom": places[2] == 0.0}
    sets |= {"top": places[2] == 2.0, "left": places[0] == 0.0, "front": places[1] == 0.0}
    text = node_sets({name: np.flatnonzero(own) for name, own in sets.items()}) + STEEL.replace(", 0.0", f", {nu}")
    text += (
        f"*SOLID SECTION, ELSET={name}, MATERIAL=STEEL\n*SOLID SECTION, ELSET={other}, MATERIAL=STEEL\n*TIE, NAME=T\nhigh, low\n"
    )
    text += f"*BOUNDARY\nbottom, 3\nleft, 1\nfront, 2\n*STEP\n*STATIC\n*BOUNDARY\ntop, 3, 3, {-2 * e}\n*END STEP\n"
    tied = uem.read_deck(deck(folder, "tied.inp", points, {name: cells, other: other_cells + len(x)}, text), COMM)
    list(tied.run())
    exact = fem.Function(tied.u.function_space)
    exact.interpolate(lambda x: np.stack([nu * e * x[0], nu * e * x[1], -e * x[2]]))
    assert np.abs(tied.u.x.array - exact.x.array).max(initial=0.0) <= 1e-12
    assert "hexahedron, tetra: divided into triangles or tetrahedra" in tied.left_out


@pytest.mark.parametrize("kind", ["C3D8", "CPE4", "CPS4", "CAX4"])
@pytest.mark.parametrize("nlgeom", ["", ", NLGEOM"])
def test_free_expansion(folder, kind, nlgeom):
    """A column that is heated grows by alpha times the heating, or by the stretch of that Green-Lagrange strain, without stress."""
    axial = 2 if kind == "C3D8" else 1
    across = (
        "foot 1, 2, 2\n"
        if kind == "CAX4"
        else "101, 1, 2\nfoot 1, 2, 2\n"
        if axial == 1
        else "101, 1, 3\n102, 2, 3\nfoot 1, 3, 3\n"
    )
    text = columns([(0.0, 1.0, 2)], kind) + STEEL.replace(", 0.0", ", 0.3") + "*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n"
    text += f"*INITIAL CONDITIONS, TYPE=TEMPERATURE\nall, 20.\n*BOUNDARY\n{across}"
    text += f"*STEP{nlgeom}\n*STATIC\n*TEMPERATURE\nall, 520.\n*END STEP\n"
    deck = ran(folder, text)
    strain = ALPHA * 500.0
    strain *= 1.3 if kind == "CPE4" else 1.0
    stretch = np.sqrt(1 + 2 * strain) - 1 if nlgeom else strain
    assert deck.displacement(121)[axial] == pytest.approx(stretch, rel=1e-8)
    if kind == "CAX4":
        assert deck.displacement(122)[0] == pytest.approx(2 * stretch, rel=1e-8)


@pytest.mark.parametrize(("load", "pulled"), [("*CLOAD\n999, 1, 50.\n", True), ("*BOUNDARY\n999, 1, 1, 1e-3\n", False)])
def test_a_section_of_a_bolt(folder, load, pulled):
    """A column in one piece, held at both ends and cut in its middle: force and shortening belong together by E A / L."""
    text = columns([(0.0, 1.0, 2)]) + STEEL + "*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n*SURFACE, NAME=middle\n10, S2\n"
    text += "*PRE-TENSION SECTION, SURFACE=middle, NODE=999\n0., 0., 1.\n*BOUNDARY\nfoot 1, 1, 3\nhead 1, 1, 3\n"
    deck = ran(folder, text + f"*STEP\n*STATIC\n{load}*END STEP\n")
    section = deck.sections["middle"]
    assert section.carried == pytest.approx(50.0 if pulled else E * 1e-3, rel=1e-8)
    assert section.opening == pytest.approx(-50.0 / E if pulled else -1e-3, rel=1e-8)
    assert section.locked is not pulled


HEAT = "*CONDUCTIVITY\n2.0\n*DENSITY\n1.0\n*SPECIFIC HEAT\n{}\n"
ENDS = "*BOUNDARY\nfoot 1, 11, 11, 100.\nhead 2, 11, 11, 300.\n*END STEP\n"


def test_heat_at_a_section_of_a_bolt(folder):
    """Temperatures of both sides of the cut do not meet, and the deck says so."""
    text = columns([(0.0, 1.0, 2)]) + STEEL + HEAT.format(1.0) + "*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n"
    text += "*SURFACE, NAME=middle\n10, S2\n*PRE-TENSION SECTION, SURFACE=middle, NODE=999\n0., 0., 1.\n"
    text += "*BOUNDARY\nfoot 1, 1, 3\nhead 1, 1, 3\n*STEP\n*COUPLED TEMPERATURE-DISPLACEMENT, STEADY STATE\n"
    deck = ran(folder, text + "*BOUNDARY\n999, 1, 1, 1e-3\n" + ENDS.replace("head 2", "head 1"))
    assert deck.temperature(111) == pytest.approx(100.0, rel=1e-8) or deck.temperature(111) == pytest.approx(300.0, rel=1e-8)
    assert deck.left_out == ["heat through the section 'middle': none passes its cut"]


KINDS = ["*HEAT TRANSFER, STEADY STATE\n", "*HEAT TRANSFER\n0.01, 50.\n", "*COUPLED TEMPERATURE-DISPLACEMENT\n0.01, 50.\n"]


@pytest.mark.parametrize("step", KINDS)
def test_heat_through_a_joint(folder, step):
    """Resistances in series, at once or after a long time; bodies that expand into each other press as stiffly as two springs."""
    text = two(law="*GAP CONDUCTANCE\n3.0\n", material=STEEL + HEAT.format(1.0), step=f"*STEP\n{step}{ENDS}", held=BOTH)
    deck = ran(folder, text)
    flux = 200.0 / (2 * 0.5 + 1 / 3.0)
    assert deck.temperature(121) == pytest.approx(100.0 + 0.5 * flux, rel=1e-6)
    assert deck.temperature(201) == pytest.approx(300.0 - 0.5 * flux, rel=1e-6)
    pressed = deck.contacts["under 2 on over 1"].resultant().force[2]
    mean = ALPHA * E * 0.5 * (100.0 + 0.25 * flux + 300.0 - 0.25 * flux)
    assert pressed == pytest.approx(mean if "COUPLED" in step else 0.0, rel=1e-6, abs=1e-9 * mean)


def test_gaps_that_conduct(folder):
    """Across a gap of less than a ten-thousandth of the model's size heat passes, across twice as much it does not."""
    for part, hot in ((0.5, True), (2.0, False)):
        gap = part * 1e-4 * np.sqrt(6.0)
        step = f"*STEP\n*HEAT TRANSFER, STEADY STATE\n{ENDS}"
        text = two(law="*GAP CONDUCTANCE\n3.0\n", gap=gap, material=STEEL + HEAT.format(1.0), step=step, held=BOTH)
        assert (ran(folder, text).temperature(121) > 101.0) is hot


@pytest.mark.long
def test_heat_in_steps_of_time(folder):
    """Steps grow by a half, to a tenth of the whole, and end with it."""
    text = two(material=STEEL + HEAT.format(1.0), step=f"*STEP\n*HEAT TRANSFER\n0.02, 1.0\n{ENDS}", held=BOTH)
    deck = uem.read_deck(written(folder, text), COMM)
    taken = []
    for _ in deck.run():
        taken.append(float(deck._dt.value))
    grown = [0.02 * 1.5**k for k in range(4)]
    assert taken[:4] == pytest.approx(grown) and max(taken) == pytest.approx(0.1) and sum(taken) == pytest.approx(1.0)
    assert len(taken) == 4 + int(np.ceil((1.0 - sum(grown)) / 0.1))
    exact = two(material=STEEL + HEAT.format(1.0), step=f"*STEP\n*HEAT TRANSFER\n0.1, 1.0000004\n{ENDS}", held=BOTH)
    assert len(list(uem.read_deck(written(folder, exact), COMM).run())) == 10


def test_what_is_left_out(folder, caplog):
    """Keywords without counterpart are named, in the log as well; requests of output are not among them."""
    step = "*STEP\n*STATIC\n*CLOAD, AMPLITUDE=a\nhead 2, 3, -1.\n"
    step += "*DLOAD\nbody 1, NEWTON\n*NODE PRINT, NSET=all\nU\n*END STEP\n"
    text = two(material=STEEL + "*PLASTIC\n300., 0.\n", step="*AMPLITUDE, NAME=a, SHIFTX=1.\n0., 0., 1., 1.\n" + step)
    deck = uem.read_deck(written(folder, text), COMM)
    assert [one.partition(":")[0] for one in deck.left_out] == ["*PLASTIC", "SHIFTX of *AMPLITUDE", "*DLOAD"]
    if COMM.rank == 0:
        assert "*PLASTIC" in caplog.text
    assert repr(deck) == "Deck(steps: static; contacts: under 2 on over 1; 3 keywords left out)"


def test_what_is_refused(folder):
    """Each with what is expected."""

    def read(text):
        return lambda: uem.read_deck(written(folder, text), COMM)

    static = "*STEP\n*STATIC\n*END STEP\n"
    refused(uem.InputError, "no step that can be taken", read(two()))
    refused(
        uem.InputError, ("*ELASTIC", "cannot read"), read(two(material="*MATERIAL, NAME=steel\n*ELASTIC\nsteel\n", step=static))
    )
    refused(uem.InputError, ("STEEL", "no *ELASTIC"), read(two(material="*MATERIAL, NAME=steel\n", step=static)))
    refused(uem.TagError, ("nothing", "no node or side"), read(two(held="nothing, 1, 3\n", step=static)))
    refused(uem.MissingFileError, "does not exist", lambda: uem.read_deck(folder / "none.inp", COMM))
    refused(uem.InputTypeError, "path = 3", lambda: uem.read_deck(3, COMM))
    law = "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=PERMANENT\n1., 1.\n"
    path = written(folder, two(law=law, step=static))
    refused(uem.InputError, ("PERMANENT", "LINEAR"), lambda: uem.read_deck(path, COMM, soft=True))
    change, rub = "*CHANGE FRICTION, INTERACTION={}\n", "*FRICTION\n0.1\n"
    refused(uem.InputError, ("FRICTION", "CHANGE FRICTION"), read(two(step=f"*STEP\n*STATIC\n{rub}*END STEP\n")))
    other = f"*STEP\n*STATIC\n{change.format('J')}{rub}*END STEP\n"
    refused(uem.InputError, ("no interaction 'J'", "one of I"), read(two(step=other)))
    deck = ran(folder, two(step="*STEP\n*STATIC\n*DLOAD\n21, P2, 1.\n*END STEP\n"))
    refused(uem.InputError, ("node = 7", "no body"), lambda: deck.displacement(7))
    refused(uem.InputError, "no unknown temperatures", lambda: deck.temperature(101))


def test_vibrations(folder):
    """Of a column of two cells along itself, in the closed form of linear cells with their consistent mass; none without *FREQUENCY."""
    pytest.importorskip("slepc4py")
    rho, h = 7.8e-9, 0.5
    text = (
        columns([(0.0, 1.0, 2)]) + STEEL + "*SOLID SECTION, ELSET=body 1, MATERIAL=steel\n*BOUNDARY\nfoot 1, 1, 3\nhead 1, 1, 2\n"
    )
    wanted, loaded = "*STEP\n*FREQUENCY\n14\n*END STEP\n", "*STEP\n*STATIC\n*CLOAD\nhead 1, 3, -25.\n*END STEP\n"
    deck = ran(
        folder,
        text.replace("*EXPANSION", f"*DENSITY\n{rho}\n*EXPANSION") + loaded + wanted.replace("*STEP", "*STEP, PERTURBATION"),
    )
    found, turn = deck.modes().frequencies, np.cos(np.array([1.0, 3.0]) * np.pi / 4)
    exact = np.sqrt(6 * E / (rho * h**2) * (1 - turn) / (2 + turn)) / (2 * np.pi)
    assert [np.abs(found / f - 1).min() for f in exact] == pytest.approx([0.0, 0.0], abs=1e-9) and deck.left_out == []
    refused(
        uem.InputError, "has no *DENSITY, and vibrations need the mass of all bodies", lambda: ran(folder, text + wanted).modes()
    )
    refused(uem.InputError, "the deck has no step *FREQUENCY", lambda: ran(folder, text + loaded).modes())
