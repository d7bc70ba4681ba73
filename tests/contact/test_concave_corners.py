"""Bodies driven into concave corners of any opening: no contactor ends behind a flank, and flanks push and do not pull.

The test to read first is ``test_a_wedge_in_a_groove``; how deep contactors are follows from the boundary of the bodies alone
(``corner_scenes.depth``).
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from corner_scenes import InCorner, boundary, groove, notched, pit, upright
from dolfinx import fem
from helpers import at, box, clamp, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import MeshTarget

COMM = MPI.COMM_WORLD


def loaded(s: InCorner, steps: int = 1, deep: float = 1e-12) -> np.ndarray:
    """The force on the wedge at the end; in no step is it inside the groove, or the groove inside of it."""
    for step in uem.load_steps(s.problem, steps):
        assert step.cuts == 0
        assert s.inside() <= deep
    force = s.contact.resultant().force
    return -force if s.target_body == 1 else force


@pytest.mark.parametrize("angle", [20.0, 60.0, 80.0, 90.0, 92.0, 140.0, 179.0])
def test_a_wedge_in_a_groove(angle):
    """It comes down at a side of the bottom, or touches there and is pushed aside: the force is one that both flanks push with."""
    half = np.radians(angle / 2)
    aside = min(0.01, 0.005 * np.tan(half))
    for shift, push, steps in (((aside, 0.02), (0, -0.07), 1), ((-aside, 0.1), (0, -0.15), 3), ((0, 0), (0.03, -0.05), 1)):
        force = loaded(groove("triangle", angle, angle / 2, angle / 4, shift, push), steps)
        assert force[1] > 1e-3
        # the flanks give way by a few per cent
        assert abs(force[0]) * np.sin(half) <= force[1] * np.cos(half) + 0.1 * np.linalg.norm(force)
    # nodes of the groove are not inside the wedge either
    loaded(groove("triangle", angle, angle / 2, angle / 4, (aside, 0.02), (0.0, -0.07), swap=True))


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize("degree", [1, 2])
def test_a_wedge_of_other_cells_in_a_groove(cell, degree):
    """At degree 2 the boundary's straight pieces are a little off it."""
    for angle in (40.0, 90.0):
        s = groove(cell, angle, angle / 2, angle / 4, (0.01, 0.02), (0.0, -0.07), degree=degree)
        assert loaded(s, deep=1e-12 if degree == 1 else 1e-5)[1] > 1e-3


@pytest.mark.parametrize("angle", [40.0, 90.0])
def test_a_wedge_in_a_groove_with_averaged_normals(angle):
    """They lead over the bottom, and hold the tip there or on a flank."""
    s = groove("triangle", angle, angle / 2, angle / 4, (0.01, 0.02), (0.0, -0.07), normals="averaged")
    assert loaded(s)[1] > 1e-3


@pytest.mark.parametrize("lean", [10.0, 30.0, 70.0])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_block_driven_into_a_leaning_wall(lean, friction):
    """Along the floor, from nearby and from afar, under a wall that leans over it: its corner ends where they meet."""
    angle = 90 - lean
    for shift, push, steps in (((0.02, 0.0), (-0.05, -0.01), 1), ((0.3, 0.0), (-0.35, -0.01), 4)):
        s = groove("triangle", angle, 0.8 * angle, 0.0, shift, push, tilt=0.0, floor=True, friction=friction)
        force = loaded(s, steps)
        # the wall pushes it back
        assert force[0] > 1e-3
        pair = s.contact.pair
        assert COMM.allreduce(int(pair.trial.in_corner.sum())) == 1


@pytest.mark.parametrize("friction", [0.3, 0.7])
def test_a_wedge_that_friction_would_lock(friction):
    """In a groove narrower than the cones of its flanks a wedge is held against all that pushes it, and lets go of what pulls it out."""

    def path(factor: float) -> float:
        return 2.0 * factor if factor < 0.5 else 2.2 - 2.4 * factor

    s = groove("triangle", 20.0, 10.0, 5.0, (0.002, 0.02), (0.001, -0.07), friction=friction, path=path)
    forces = []
    for step in uem.load_steps(s.problem, 4):
        assert step.cuts == 0 and s.inside() <= 1e-12
        forces.append(s.contact.resultant().force)
    assert forces[1][1] > 1e-3 and np.abs(forces[-1]).max() == 0.0


@pytest.mark.parametrize("law", [uem.Tresca(3e-3), slow(uem.Coulomb(1.0, limit=3e-3))])
def test_work_of_a_limit_in_a_corner(law):
    """A law with a limit rubs in the corner, too: four steps have the work of sixteen, though two of them end in the corner."""
    works = []
    for steps in (4, 16):
        s = groove("triangle", 90.0, 45.0, 22.5, (0.01, 0.02), (0.0, -0.07), friction=law)
        loaded(s, steps)
        assert COMM.allreduce(int(s.contact.pair.trial.in_corner.sum())) == 1
        works.append(s.contact.dissipation)
    assert works[0] == pytest.approx(works[1], rel=0.1)


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("angle", [30.0, 90.0])
def test_a_keel_in_a_groove(cell, angle):
    """In space, pushed aside and along: bilinear facets are a little off the boundary's pieces."""
    s = groove(cell, angle, angle / 2, angle / 4, (0.01, 0.02, 0.01), (0.0, -0.07, 0.03), n=1)
    assert loaded(s, deep=1e-6)[1] > 1e-3


@pytest.mark.parametrize("stretch", [0.5, 1.0, 3.0])
def test_a_tip_in_a_pit_of_three_facets(stretch):
    """Shallower and deeper than a cube's corner."""
    for cell, shift, push in (
        ("hexahedron", (0.01, -0.02, 0.1), (0, 0.01, -0.15)),
        ("tetrahedron", (0, 0, 0), (0.03, 0.01, -0.05)),
    ):
        assert loaded(pit(cell, stretch, shift, push), deep=1e-6)[2] > 1e-3


@pytest.mark.parametrize(
    ("cell", "degree", "gap", "aslant"),
    [
        ("quadrilateral", 1, 0.0, False),
        ("quadrilateral", 2, 0.0, True),
        ("triangle", 2, 0.0, True),
        pytest.param("quadrilateral", 2, 0.01, True, marks=pytest.mark.slow),
    ],
)
def test_a_block_pressed_into_a_corner(cell, degree, gap, aslant):
    """By a tenth of its size in one step, between nodes of the corner: its own corner ends in the other's, without a cycle."""
    low = notched(cell, [-0.5] * 2, [1.5] * 2, [16] * 2, 2)
    s = scene(COMM, cell, [low, box(cell, [gap] * 2, [1 + gap] * 2, [5] * 2)])
    V = compat.function_space(s.mesh, degree, (2,))
    u = fem.Function(V)

    def flanks(x):
        return (np.abs(x - x.clip(0)) < 1e-9).all(axis=1) & (np.abs(x).min(axis=1) < 1e-9)

    corner = s.tag("corner", 0, flanks)
    contact = uem.Contact(s.tag("block", 1, lambda x: flanks(x - gap)), corner)
    bcs = [c for axis in (0, 1) for c in clamp(V, s.tag("outside", 0, at(axis, -0.5)))]
    top, side = (s.tag("far", 1, at(axis, 1 + gap)) for axis in (1, 0))
    if aslant:
        bcs += clamp(V, top, value=[-0.1, -0.1])
    else:
        bcs += [*clamp(V, top, 1, value=-0.1), *clamp(V, side, 0, value=-0.1)]
    F = uem.NeoHooke(1.0, 0.3, "plane_strain").residual(u, ufl.TestFunction(V)) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    (step,) = uem.load_steps(problem, 1)
    assert step.cuts == 0 and step.newton_iterations <= 15
    pair = contact.pair
    first = np.linalg.norm(pair.config.X[pair.nodes] - gap, axis=1) < 1e-9
    assert COMM.allreduce(int(first.sum())) == COMM.allreduce(int((first & pair.trial.in_corner).sum())) == 1


@pytest.mark.parametrize("stretch", [0.4, 1.0, 4.0])
def test_gaps_are_negative_inside_alone(stretch):
    """Around a cube with a notch that is pulled out of shape, which has convex, concave and mixed corners of three facets."""
    s = scene(COMM, "tetrahedron", [notched("tetrahedron", [-1.0] * 3, [1.0] * 3, [2] * 3, 3)], pose=upright(stretch))
    V = compat.function_space(s.mesh, 1, (3,))
    target = MeshTarget(TargetFacets(Configuration(fem.Function(V)), boundary(s, 0)))
    rng = np.random.default_rng(3)
    drawn = rng.uniform(-1.4, 1.4, (600, 3))
    near = np.round(drawn) + 0.3 * rng.uniform(-1, 1, drawn.shape)
    drawn = np.concatenate([drawn, near[np.abs(near).max(axis=1) < 1.4]])
    inside = (np.abs(drawn) < 1).all(axis=1) & ~(drawn > 0).all(axis=1)
    gap = target.project(upright(stretch)(drawn)).gap
    assert np.array_equal(gap < 0, inside)
