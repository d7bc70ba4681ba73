"""Rigid contactors that are finer than a deformable target: a warning before the first step, and the advice that solves the scene.

The test to read first is ``test_a_fine_rigid_contactor_is_named``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import surface_of
from dolfinx import fem
from helpers import MESHES, at, box, clamp, highest, linear, run, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
WORDS = "the contactor is rigid and finer than its target"
ADVICE = "make the rigid surface the target"


def punch_on_block(
    cell, across, *, rigid_first=None, coupling="mortar", degree=1, rigid=True, held=False, half=0.4, turned=False
):
    """A punch with facets of a given part of the block's, on a block of one unit in height: pressed by 0.05, or held 0.03 lower.

    ``rigid_first=None`` is general contact; ``turned`` exchanges the bodies' places in the mesh.
    """
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    wide, fine = ([20] if g == 2 else [8, 8]), ([8] if g == 2 else [3, 3])
    low = box(cell, [-1.0] * (g - 1) + [0.0], [1.0] * g, [*wide, 4])
    high = box(cell, [-half] * (g - 1) + [1.0], [half] * (g - 1) + [1.5], [*(round(n / across) for n in fine), 2])
    s, block, head = scene(COMM, cell, [high, low] if turned else [low, high]), int(turned), int(not turned)
    u = fem.Function(compat.function_space(s.mesh, degree, (g,)))
    base, top, foot = (
        s.tag("base", block, at(g - 1, 0.0)),
        s.tag("top", block, at(g - 1, 1.0)),
        s.tag("foot", head, at(g - 1, 1.0)),
    )
    down, part = [0.0] * (g - 1), surface_of(s, head) if rigid else s.tag("lid", head, at(g - 1, 1.5))
    if held:
        punch, bcs = [], clamp(u.function_space, part, value=[*down, -0.03])
    else:
        punch, bcs = [uem.RigidCoupling(part, [*down, 1.5], force=[*down, -0.05])], []
    bcs += clamp(u.function_space, base)
    if rigid_first is None:
        contact = uem.GeneralContact(coupling=coupling, bodies={"block": base, "punch": foot})
    else:
        contact = uem.Contact(*((foot, top) if rigid_first else (top, foot)), coupling=coupling)
    return uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], couplings=punch), contact


def warned(caplog):
    """How often rank 0 was warned, on all ranks."""
    return COMM.bcast(sum(WORDS in r.getMessage() for r in caplog.records))


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("coupling", ["mortar", "node_to_surface"])
@pytest.mark.parametrize("cell", ["quadrilateral", "triangle", "hexahedron"])
@pytest.mark.parametrize("held", [False, True])
def test_a_fine_rigid_contactor_is_named(caplog, held, cell, coupling, degree):
    """Once, before any work; the same scene the other way round is silent and carries the force in a few iterations."""
    punch_on_block(cell, 0.5, rigid_first=True, coupling=coupling, degree=degree, held=held)
    assert warned(caplog) == 1
    problem, contact = punch_on_block(cell, 0.5, rigid_first=False, coupling=coupling, degree=degree, held=held)
    assert warned(caplog) == 1
    if cell == "quadrilateral":
        (step,) = run(problem)
        assert len(step.iterations) - 1 <= 6
        if not held:
            assert contact.resultant().force[1] == pytest.approx(-0.05, rel=1e-6)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("held", [False, True])
def test_in_general_contact_the_deformable_body_follows(caplog, held, coupling):
    """Whichever is finer and whichever comes first in the mesh; forces are those of the contact declared that way, but for corners."""
    problem, declared = punch_on_block("quadrilateral", 0.5, rigid_first=False, coupling=coupling, held=held)
    run(problem)
    want = declared.resultant().force[1]
    for turned in (False, True):
        problem, contact = punch_on_block("quadrilateral", 0.5, coupling=coupling, held=held, turned=turned)
        run(problem)
        force = contact.between("block", "punch").force
        assert np.linalg.norm(force - [0.0, want]) <= (3e-3 if held and coupling == "node_to_surface" else 1e-6) * abs(want)
    assert warned(caplog) == 0


def test_equal_facets(caplog):
    """Only shorter facets count, not equal ones nor longer ones; nor does a punch that deforms."""
    for across, half in ((1.0, 0.4), (1.0, 0.39992), (2.0, 0.4)):
        punch_on_block("quadrilateral", across, rigid_first=True, half=half)
    punch_on_block("quadrilateral", 0.5, rigid_first=True, rigid=False)
    punch_on_block("quadrilateral", 0.5, rigid_first=True, rigid=False, held=True)
    assert warned(caplog) == 0
    for number, (across, half) in enumerate(((1.0, 0.398), (0.8, 0.4)), 1):
        punch_on_block("quadrilateral", across, rigid_first=True, half=half)
        assert warned(caplog) == number


def test_held_ends_of_soft_rods(caplog):
    """In general contact, parts have the facets of some faces; held faces make no rigid body."""
    sizes = {"length": 24.0, "n_1": 6, "n_2": 6, "m": 2, "on_edge": 1, "angle": 0.5 * np.pi}
    mesh, tags = uem.read_gmsh(MESHES / "crossed_rods.geo", COMM, gdim=3, parameters=sizes)
    u = fem.Function(compat.function_space(mesh, 1, (3,)))
    bcs = [uem.dirichlet(u.function_space, tags[f"ends {k}"]) for k in (1, 2)]
    contact = uem.GeneralContact(coupling="mortar", bodies={f"rod {k}": tags[f"rod {k}"] for k in (1, 2)})
    uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact])
    assert warned(caplog) == 0


#: Equations that depend on others leave the gaps of their contactors to these.
NEARLY = pytest.mark.nearly_dependent


@pytest.mark.slow
@pytest.mark.parametrize(
    ("held", "coupling", "across", "half"),
    [
        pytest.param(held, coupling, across, half, marks=[NEARLY] if half == 0.4 else [])
        for held in (False, True) for coupling in ("node_to_surface", "mortar") for across in (0.5, 0.4) for half in (0.4, 0.37)
    ],
)  # fmt: skip
def test_none_pulls_or_the_error_says_what_helps(held, coupling, across, half):
    """Dependent equations leave forces open: a state has forces of one sign that balance, or an error advises to exchange the surfaces."""
    problem, contact = punch_on_block("quadrilateral", across, rigid_first=True, coupling=coupling, held=held, half=half)
    try:
        run(problem)
    except uem.ConvergenceError as error:
        assert ADVICE in str(error) and "finer facets" not in str(error)
        return
    (pair,) = problem.pairs
    least, most = -highest(COMM, -pair.committed.lam), highest(COMM, pair.committed.lam)
    assert least >= -1e-9 * most < 0.0
    if not held:
        assert contact.resultant().force[1] == pytest.approx(0.05, rel=1e-6)


@NEARLY
@pytest.mark.parametrize(
    ("n", "half", "coupling"),
    [(18, 0.4, "mortar"), *(slow(*one) for one in [
        (9, 0.4, "mortar"), (13, 0.4, "mortar"), (17, 0.43, "mortar"), (16, 0.4, "node_to_surface"), (18, 0.4, "node_to_surface"),
    ])],
)  # fmt: skip
def test_which_of_dependent_contactors_bear(n, half, coupling):
    """Of contactors that nearly depend on each other none is left inside the target, and the same ones are left out in all iterations."""
    problem, contact = punch_on_block("quadrilateral", 20 * half / n, rigid_first=True, half=half, coupling=coupling)
    (step,) = list(uem.load_steps(problem, 1))
    (pair,) = problem.pairs
    assert len(step.iterations) - 1 <= (4 if coupling == "mortar" else 30)
    assert -highest(COMM, -pair.kinematics.gap) >= -1e-11
    assert contact.resultant().force[1] == pytest.approx(0.05, rel=1e-9)


@NEARLY
@pytest.mark.parametrize("across", [0.5, 0.4, slow(8 / 11), slow(2 / 3), slow(4 / 7)])
def test_dependent_forces_push(across):
    """Edges of a finer rigid punch near nodes of the block: its contactors share forces that push, it sinks as with exchanged surfaces."""
    problem, contact = punch_on_block("quadrilateral", across, rigid_first=True)
    (step,) = list(uem.load_steps(problem, 1))
    (pair,) = problem.pairs
    assert len(step.iterations) - 1 <= 6
    assert -highest(COMM, -pair.committed.lam) >= -1e-9 * highest(COMM, pair.committed.lam) < 0.0
    assert contact.resultant().force[1] == pytest.approx(0.05, rel=1e-9)
    other, _ = punch_on_block("quadrilateral", across, rigid_first=False)
    run(other)
    way, wanted = (p.couplings[0].displacement[1] for p in (problem, other))
    assert way == pytest.approx(wanted, rel=0.01) and way < 0.0
