"""Wear of contactors in concave corners of the target: k times the force of each facet times the way along it.

Read first: ``test_strokes_over_an_elastic_floor``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from corner_scenes import notched
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
K, E, MU = 1e-3, 1.0, 0.2


class Guided:
    """A block under a dead load that is led to and fro over another body, and does not turn.

    Args:
        low: the body below.
        high: the block.
        touch: predicates of the surfaces of both.
        top: of the block.
        force: downwards, over that of a unit stress on a unit of the plane.
        unit: of length; the bodies are drawn in it.
    """

    def __init__(self, cell, low, high, touch, top, force, *, pose=None, unit=1.0, degree=1, friction=0.0, **how):
        self.unit, g = unit, low.x.shape[1]
        s = scene(COMM, cell, [low, high], pose=lambda x: unit * (x if pose is None else pose(x)))
        V = compat.function_space(s.mesh, degree, (g,))
        u, self.way, self.aside = fem.Function(V), fem.Constant(s.mesh, 0.0), fem.Constant(s.mesh, 0.0)
        floor, foot = (s.tag(name, b, touch[b]) for b, name in enumerate(("floor", "foot")))
        base = s.tag("base", 0, at(g - 1, low.x[:, -1].min()))
        self.contact = uem.Contact(foot, floor, wear=K, friction=friction, name="block", **how)
        motion = [self.way, None, 0.0] if g == 2 else [self.aside, self.way, None, 0.0, 0.0, 0.0]
        load = [*[0.0] * (g - 1), -force * unit ** (g - 1)]
        head = uem.RigidCoupling(s.tag("top", 1, top), unit * high.x.max(axis=0), force=load, motion=motion)
        F = linear(u, modulus(s, E, 5.0 * E), 0.3)
        self.problem = uem.UnitedProblem(F, u, bcs=clamp(V, base), contacts=[self.contact], couplings=[head], rtol=1e-11)
        self.problem.solve()

    @property
    def seen(self):
        """Forces of contactors along the normal, and how far they have slipped along the stroke ``(n,)`` each."""
        state, g = self.contact.pair.trial, self.contact.slip.function_space.mesh.geometry.dim
        return state.lam, state.friction.slipped[:, g - 2]

    def stroke(self, way, aside=0.0):
        """Go there.

        Returns:
            The worn volume over k, forces times slips, the same summed up over contactors, and how many of these a corner holds.
        """
        before, (lam, slipped), held = self.contact.worn_volume, self.seen, self.contact.pair.trial.in_corner
        self.way.value, self.aside.value = way * self.unit, aside * self.unit
        self.problem.solve()
        now, there = self.seen
        rubbed = COMM.allreduce(float(0.5 * (lam + now) @ np.abs(there - slipped)))
        return (
            (self.contact.worn_volume - before) / K,
            rubbed,
            COMM.allreduce(int((held | self.contact.pair.trial.in_corner).sum())),
        )


def over_floor(cell, n=1, **how):
    """A block on a floor of the same width aside; it begins in the middle."""
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    low = box(cell, [*[0.0] * (g - 2), 0.0, -0.6], [*[0.4] * (g - 2), 1.0, 0.0], [*[2] * (g - 2), 20 * n, 4])
    high = box(cell, [*[0.0] * (g - 2), 0.3, 0.0], [*[0.4] * (g - 2), 0.7, 0.4], [*[3] * (g - 2), 12 * n, 3])
    return Guided(cell, low, high, [at(g - 1, 0.0)] * 2, at(g - 1, 0.4), 2e-3 * 0.4 ** (g - 2), **how)


def at_wall(cell, gap, **how):
    """A block on the floor of a corner, before its wall."""
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    low = notched(cell, [-0.5] * 2 + [-0.25] * (g - 2), [1.5] * 2 + [1.25] * (g - 2), [8] * 2 + [4] * (g - 2), 2)
    if g == 3:
        low = low.mapped(lambda x: x[:, [2, 0, 1]])
    high = box(cell, [*[0.0] * (g - 2), gap, 0.0], [*[1.0] * (g - 2), 1.0 + gap, 1.0], [*[2] * (g - 2), 3, 3])

    def corner(before):
        def on(x):
            y = x[:, -2:] - [before, 0.0]
            return (np.abs(y) < 1e-9).any(axis=1) & (y > -1e-9).all(axis=1)

        return on

    return Guided(cell, low, high, [corner(0.0), corner(gap)], at(g - 1, 1.0), 1e-3, **how)


def in_trough(cell, slope, **how):
    """A block with a keel in a trough that leads along the second axis."""
    low = box(cell, [-1.0, -0.5, -1.0], [1.0, 1.5, 0.0], [4, 5, 2])
    high = box(cell, [-0.5, 0.0, 0.0], [0.5, 0.5, 0.5], [2, 2, 1])

    def pose(x):
        return x + np.outer(slope * np.abs(x[:, 0]), [0.0, 0.0, 1.0])

    return Guided(cell, low, high, [at(2, 0.0)] * 2, at(2, 0.5), 1e-3, pose=pose, **how)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "how", "corners"),
    [
        ("quadrilateral", {}, True), ("quadrilateral", {"unit": 1e-9}, True), ("quadrilateral", {"unit": 1e3}, True),
        ("triangle", {"degree": 2}, False), ("quadrilateral", {"coupling": "mortar"}, False),
        slow("hexahedron", {"unit": 1e-9}, True), slow("hexahedron", {"coupling": "mortar"}, False),
        slow("tetrahedron", {"unit": 1e3}, False),
    ],
)  # fmt: skip
def test_strokes_over_an_elastic_floor(cell, how, corners):
    """Every stroke wears k N s, also where contactors end it between two facets of the bent floor."""
    b, place, held = over_floor(cell, **how), 0.0, 0
    for target in (0.02, 0.0, 0.05, 0.01, 0.13):
        worn, _, count = b.stroke(target)
        # the floor stretches by the load
        assert worn / b.unit == pytest.approx(b.contact.resultant().force[-1] * abs(target - place), rel=5e-3)
        place, held = target, held + count
    assert (held > 0) == corners


@pytest.mark.long
@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_strokes_with_friction(cell):
    """The sum over contactors of k times force times slip, which is less than the way of the block."""
    b = over_floor(cell, friction=MU)
    for i, target in enumerate((0.02, 0.0, 0.05, 0.01)):
        worn, rubbed, _ = b.stroke(target)
        assert worn == pytest.approx(rubbed, rel=2e-2 if i == 0 else 1e-4)


@pytest.mark.parametrize(
    ("cell", "how"),
    [
        ("quadrilateral", {}), ("quadrilateral", {"friction": MU}), ("triangle", {"degree": 2}), ("quadrilateral", {"unit": 1e-9}),
        ("quadrilateral", {"unit": 1e3}), slow("hexahedron", {}), slow("tetrahedron", {"unit": 1e-9}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("steps", [1, 3])
def test_a_block_that_slides_against_a_wall(cell, how, steps):
    """Its foot wears by the way to the wall, whatever it is pressed against that with; its side does not slide, and wears nothing."""
    gap = 0.1
    b = at_wall(cell, gap, **how)
    strokes = [b.stroke(-gap * (i + 1) / steps - 1e-4 * (i + 1 == steps)) for i in range(steps)]
    force, worn = b.contact.resultant().force, sum(one for one, *_ in strokes)
    assert abs(force[-2]) > 0.05 * force[-1]
    # friction bends the block
    assert worn == pytest.approx(b.unit * gap * force[-1], rel=5e-3 if "friction" in how else 1e-3)
    assert strokes[-1][-1] > 0 or how.get("degree") == 2 or "friction" in how
    # pressed harder its foot stays where it is; drawn off it slides back
    for place, way, error in ((-gap - 2e-4, 0.0, 1e-4), (-gap + 0.05, 0.05, 0.015 * 0.05)):
        assert b.stroke(place)[0] / b.unit / force[-1] == pytest.approx(way, abs=error)


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "how"),
    [
        ("hexahedron", {}),
        ("hexahedron", {"friction": MU}),
        slow("tetrahedron", {"unit": 1e-9}),
        slow("hexahedron", {"unit": 1e3}),
    ],
)
@pytest.mark.parametrize("slope", [0.1, 0.7])
def test_a_keel_that_slides_along_a_trough(cell, how, slope):
    """It wears by the forces of both flanks: k N s over the cosine of their slope."""
    b = in_trough(cell, slope, **how)
    for place, target in ((0.0, 0.1), (0.1, 0.3)):
        taken = b.contact.dissipation
        worn, _, held = b.stroke(target)
        assert held == 3
        rubbed = b.unit * (target - place) * np.hypot(1, slope) * b.contact.resultant().force[-1]
        if "friction" in how:
            # in the first stroke friction grows from nothing
            rubbed = (b.contact.dissipation - taken) / MU if place else worn
        assert worn == pytest.approx(rubbed, rel=1e-3) and worn > 0
