"""Linear equations between nodes of rigid parts alone.

Two tests to read first: ``test_levers_on_a_rope``, equilibrium in closed form at finite angles, and ``test_as_a_joint``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import linear, refused, slow, st_venant
from rigid_boxes import RigidBoxes, quadratic

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
CELLS = ["quadrilateral", slow("triangle"), slow("tetrahedron"), "hexahedron"]


class Row(RigidBoxes):
    """Rigid boxes, with the middles of their lower edges as points."""

    def __init__(self, cell="quadrilateral", n=2, comm=COMM):
        super().__init__(cell, n, comm)

    def equation(self, *terms, b=0.0):
        """``sum c . u(x)`` over pairs of x and y, and a component and a coefficient."""
        return uem.Equation([(self.at(*x), c * np.eye(self.g)[i]) for x, (i, c) in terms], b=b)

    def plane(self, i, x):
        """Equations by which body i moves in the plane, with its node at x and y = 0 at rest: a hinge."""
        rest = [self.equation(((x, 0.0), (k, 1.0))) for k in range(self.g)]
        other = 2.5 * i + (2.0 if x == 2.5 * i else 0.0)
        out = [self.equation(((other, 0.0), (2, 1.0))), self.equation(((x, 1.0), (2, 1.0)))] if self.g == 3 else []
        return rest + out

    def problem(self, couplings, equations, law=st_venant, **how):
        return uem.UnitedProblem(law(self.u, 1.0), self.u, couplings=couplings, equations=equations, rtol=1e-13, **how)


def turn(one):
    """Its angle in the plane."""
    return float(np.ravel(one.rotation)[-1])


@pytest.mark.parametrize("cell", CELLS)
def test_a_hinge_by_a_height(cell):
    """A bar on a hinge at its lower left node, whose lower right node is led to a height h: ``sin(phi) = h / 2``, in every step."""
    r = Row(cell, 1)
    bar = r.part(0)
    problem = r.problem([bar], [*r.plane(0, 0.0), r.equation(((2.0, 0.0), (1, 1.0)), b=1.6)])
    for step in uem.load_steps(problem, 4):
        assert np.sin(turn(bar)) == pytest.approx(0.8 * step.factor, abs=1e-12)
        assert bar.displacement[0] == pytest.approx(np.cos(turn(bar)) - 1.0, abs=1e-12)


@pytest.mark.parametrize("cell", CELLS)
def test_levers_on_a_rope(cell):
    """Two levers, of which one goes down as the other goes up: ``2 k phi = F L cos(phi)``, with quadratic convergence."""
    r = Row(cell)
    a, b = r.part(0), r.part(1, force=r.at(0.0, -1.0))
    # levers on torsional springs at their outer ends, which a rope over a pulley joins at their inner ends
    rope = r.equation(((2.0, 0.0), (1, 1.0)), ((2.5, 0.0), (1, 1.0)))
    axis = () if r.g == 2 else ((0.0, 0.0, 1.0),)
    hinges = [uem.Hinge(None, one, r.at(x), *axis, stiffness=0.8) for one, x in ((a, 0.0), (b, 4.5))]
    iterations = r.problem([a, b, *hinges], [rope]).solve()
    # body b goes down at its inner end, about its right end: its angle is positive; so is that of body a
    phi = turn(b)
    assert phi == pytest.approx(turn(a), rel=1e-11) and phi > 0.2
    assert 2.0 * 0.8 * phi == pytest.approx(1.0 * np.cos(phi), rel=1e-11)
    assert quadratic(iterations)
    # the rope carries half of the moment, as both springs are alike; each bearing carries its rope, and the load
    pull = 0.8 * phi / (2.0 * np.cos(phi))
    assert np.allclose(hinges[0].force, r.at(0.0, -pull), atol=1e-10)
    assert np.allclose(hinges[1].force, r.at(0.0, 1.0 - pull), atol=1e-10)


@pytest.mark.parametrize("large", [False, True])
def test_as_a_joint(large):
    """Equations at the points of a hinge are the hinge, between parts on springs: the same motions, and reactions of a led part."""
    found = []
    for joined in (True, False):
        r = Row()
        how = {"rotations": "large" if large else "small"}
        a, b = r.part(0, motion=(0.05, 0.02, 0.1), **how), r.part(1, force=(0.0, -0.9), **how)
        spring = uem.Spring(None, b, 2.0, points=((4.5, 2.0), (4.5, 1.0)))
        # points of both parts at the end of the first, as combinations of nodes of the second: u(2, 0) = 1.5 u(2.5, 0) - 0.5 u(3.5, 0)
        rows = [r.equation(((2.0, 0.0), (i, 1.0)), ((2.5, 0.0), (i, -1.5)), ((3.5, 0.0), (i, 0.5))) for i in range(2)]
        links = [uem.Ball(a, b, (2.0, 0.0))] if joined else []
        r.problem([a, b, spring, *links], [] if joined else rows).solve()
        found.append(np.concatenate([b.displacement, [b.rotation], *map(np.ravel, a.reaction)]))
    assert np.allclose(*found, rtol=1e-10, atol=1e-12)
    assert abs(found[0][2]) > 0.1


def test_a_family_of_equations():
    """A rigid part whose lower nodes stay level only moves along: of these equations, and of equal ones, one counts, however it lies."""
    r = Row(n=1)
    side = r.scene.tag("low", 0, lambda x: x[:, 1] == 0.0)
    bar = r.part(0, force=(0.2, 0.0), moment=0.3)
    level = uem.Equation([(side, (0, 1)), (r.at(0.0, 1.0), (0, -1))])
    springs = [uem.PointSpring(r.at(0.0), (1.0, 2.0))]
    r.problem([bar], [level, r.equation(((2.0, 0.0), (1, 1.0)), ((0.0, 0.0), (1, -1.0)))], points=springs).solve()
    assert np.allclose(bar.displacement, (0.2, 0.0), atol=1e-12) and bar.rotation == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("law", [linear, st_venant])
def test_values_follow_the_load(law):
    """Numbers are ramped from where the part is, functions are not; both again from the end of a first pass."""
    r = Row(n=1)
    bar = r.part(0)
    b = fem.Constant(r.scene.mesh, 0.0)
    along = r.equation(((2.0, 0.0), (0, 1.0)), b=b)
    up = [r.equation(((x, 0.0), (1, 1.0)), b=lambda s: 0.01 * s**2) for x in (0.0, 2.0)]
    problem = r.problem([bar], [along, *up], law=law)
    for start, end in ((0.0, 0.02), (0.02, 0.06)):
        b.value = end
        for step in uem.load_steps(problem, 2):
            assert bar.displacement[0] == pytest.approx(start + step.factor * (end - start), rel=1e-10)
            assert bar.displacement[1] == pytest.approx(0.01 * step.factor**2, rel=1e-10)


def test_a_linked_part_without_stress():
    """A box moves as a whole, and one that an equation of turns links to it stays at rest: rounding is no force at work."""
    r = Row()
    sides = [r.scene.tag(f"side {i}", i, lambda x, at=at: x[:, 0] == at) for i, at in enumerate((2.0, 2.5))]
    ends = [r.scene.tag(f"end {i}", i, lambda x, at=at: x[:, 0] == at) for i, at in enumerate((0.0, 4.5))]
    terms = ((2.0, 0.0), (0, 1.0)), ((2.0, 1.0), (0, -1.0)), ((2.5, 0.0), (0, -1.0)), ((2.5, 1.0), (0, 1.0))
    bcs = [uem.dirichlet(r.V, ends[0]), uem.dirichlet(r.V, ends[1], None, (0.0, -0.05))]
    a, b = (uem.RigidCoupling(side, r.at(2.25)) for side in sides)
    r.problem([a, b], [r.equation(*terms)], law=lambda u, E: linear(u, 1e3), bcs=bcs).solve()
    assert np.allclose(b.displacement, (0.0, -0.05), atol=1e-13) and np.abs(a.displacement).max() <= 1e-13


def test_conditions_are_replaced():
    """Equations of rigid parts are made anew with other conditions, and hold as before."""
    r = Row()
    a, b = r.part(0, force=(0.1, 0.0)), r.part(1)
    springs = [uem.PointSpring(r.at(x, y), (1.0, 1.0)) for x, y in ((0.0, 0.0), (2.0, 0.0), (2.5, 0.0), (4.5, 0.0))]
    end = r.scene.tag("end", 1, lambda x: x[:, 0] == 4.5)
    problem = r.problem([a, b], [r.equation(((2.0, 0.0), (0, 1.0)), ((2.5, 0.0), (0, -1.0)))], law=linear, points=springs)
    steps = [uem.Step(name="one"), uem.Step(name="two", bcs=[uem.dirichlet(r.V, end, 1, 0.01)]), uem.Step(name="three")]
    for _ in uem.load_steps(problem, steps):
        assert a.displacement[0] == pytest.approx(0.1 / 4.0, rel=1e-10)
        assert b.displacement[0] == pytest.approx(0.1 / 4.0, rel=1e-10)


@pytest.mark.parametrize("large", [False, True])
def test_what_is_refused(large):
    """Values that contradict each other, and equations with prescribed nodes alone together with those of rigid parts, are named."""
    law, r = st_venant if large else linear, Row(n=1)
    rows = [r.equation(((x, 0.0), (i, 1.0)), b=b) for x, i, b in ((0.0, 0, 0.0), (0.0, 1, 0.0), (2.0, 1, 0.1), (2.0, 1, 0.2))]
    refused(uem.ConflictError, ("equations[", "missed by"), r.problem([r.part(0)], rows, law=law).solve)
    r = Row()
    held = [uem.dirichlet(r.V, r.tags[1])]
    mixed = r.equation(((2.0, 0.0), (0, 1.0)), ((2.5, 0.0), (0, -1.0)))
    refused(uem.InputError, ("equations[0]", "prescribed"), lambda: r.problem([r.part(0)], [mixed], law=law, bcs=held))
    r = Row()
    parts = [r.part(0, rotations="small"), r.part(1, rotations="large")]
    refused(uem.InputError, ("equations[0]", "large and of small"), lambda: r.problem(parts, [mixed], law=law))


def test_two_springs_between_two_parts():
    """Several links may have the same ends: two springs in parallel carry a force together."""
    r = Row()
    a, b = r.part(0, motion=(0.0, 0.0, 0.0)), r.part(1, force=(0.3, 0.0))
    springs = [uem.Spring(a, b, k, points=((2.0, y), (2.5, y))) for k, y in ((1.0, -0.5), (1.0, 0.5))]
    guide = uem.Slider(a, b, (2.5, 0.0), (1.0, 0.0))
    r.problem([a, b, *springs, guide], []).solve()
    assert b.displacement[0] == pytest.approx(0.15, rel=1e-10)
    assert sum(one.force[0] for one in springs) == pytest.approx(-0.3, rel=1e-10)
