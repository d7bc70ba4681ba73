"""Contactors with friction whose motion along the target is prescribed: driven, between guides, or on a plane of symmetry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import Array, Blocks, at, blocks, box, clamp, linear, modulus, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.geometry.configuration import Configuration

MU = 0.3


@dataclass
class Pushed:
    """A block, pressed down by its top onto a wider one or onto a plane, and what is measured."""

    blocks: Blocks
    problem: uem.UnitedProblem
    contact: uem.Contact
    held: uem.Tag
    to: Callable[..., list[Any]]

    def friction(self) -> tuple[Array, float]:
        """Reaction of what is held along the target, and normal force (collective)."""
        return self.problem.reaction(self.held)[:-1], float(self.contact.resultant().force[-1])

    def drives(self, *direction: float, within: float = 1e-9) -> None:
        """Assert that the reaction is mu N in this direction, in equilibrium with the target (collective)."""
        along, N = self.friction()
        np.testing.assert_allclose(along, MU * N * np.array(direction), atol=within * N)
        np.testing.assert_allclose(along, -self.contact.resultant().force[:-1], atol=1e-9 * N)


def pushed(
    cell: str = "quadrilateral",
    *,
    side: bool = True,
    guides: bool = False,
    surface: bool = False,
    rigid: bool = True,
    target: Any = None,
    degree: int = 1,
    n: Any = (3, 4),
    E: float = 1.0,
    **how: Any,
) -> Pushed:
    """A block without lateral strain; all contactors press, as the normals of the drawing are kept.

    ``side`` drives the face at x = 0, ``guides`` those at both ends of y, ``surface`` all components of the contactors; ``to`` drives
    them to a place and the top down.
    """
    b = blocks(MPI.COMM_WORLD, cell, *n, overhang=0.5, degree=degree)
    g = b.gdim
    place = [fem.Constant(b.scene.mesh, 0.0) for _ in range(g)]
    bcs, held = [*clamp(b.V, b.bottom)], []
    if side:
        held.append(b.scene.tag("side", 1, at(0, 0.0)))
        bcs.append(uem.dirichlet(b.V, held[-1], 0, place[0]))
    for end in (0.0, 1.0) if guides else ():
        held.append(b.scene.tag(f"guide {end:g}", 1, at(1, end)))
        bcs.append(uem.dirichlet(b.V, held[-1], 1, place[1]))
    if surface:
        held.append(b.high)
        bcs += [uem.dirichlet(b.V, b.high, c, place[c]) for c in range(g)]
    else:
        bcs.append(uem.dirichlet(b.V, b.top, g - 1, place[-1]))
    if target is None:
        target = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0]) if rigid else b.low
    contact = uem.Contact(b.high, target, friction=MU, **{"sliding": "fixed", **how})
    F = linear(b.u, modulus(b.scene, E, 1.0), nu=0.0)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], rtol=1e-11)

    def to(*where: float) -> list[Any]:
        for constant, value in zip(place, where):
            constant.value = value
        return problem.solve()

    # nodes on two faces count once
    facets = np.unique(np.concatenate([tag.entities for tag in held]))
    return Pushed(b, problem, contact, replace(held[0], entities=facets), to)


@pytest.mark.parametrize(
    "cell, degree, coupling, rigid, sliding",
    [
        ("quadrilateral", 1, "node_to_surface", True, "finite"),
        ("triangle", 1, "node_to_surface", False, "fixed"),
        ("quadrilateral", 2, "mortar", False, "small"),
        ("triangle", 2, "node_to_surface", True, "fixed"),
        ("hexahedron", 1, "mortar", True, "finite"),
        ("hexahedron", 1, "node_to_surface", False, "fixed"),
    ],
)
def test_driven_by_its_side(cell, degree, coupling, rigid, sliding):
    """Driven to and fro by a face whose lowest nodes are contactors: its reaction is mu N either way, friction takes the work."""
    scene = pushed(
        cell, degree=degree, coupling=coupling, rigid=rigid, sliding=sliding, E=4.0, n=(3, 3) if cell != "hexahedron" else (2, 2)
    )
    rest = [0.0] * (scene.blocks.gdim - 2)
    # in space directions settle, and with small sliding the base's surface turns a little
    exact = {"small": 1e-2}.get(sliding, 1e-9 if cell != "hexahedron" else 1e-5)
    for place, before in ((0.0, 0.0), (0.3, 0.0), (0.4, 0.3), (0.2, 0.4), (0.1, 0.2), (0.15, 0.1)):
        taken = scene.contact.dissipation
        scene.to(place, *rest, -0.01)
        along, N = scene.friction()
        way = place - before
        if not way:
            # Poisson's ratio is zero: over a plane nothing moves
            assert abs(along[0]) < 1e-9 * N or not rigid
            continue
        assert along[0] == pytest.approx(np.sign(way) * MU * N, rel=exact)
        if sliding != "small":
            np.testing.assert_allclose(along, -scene.contact.resultant().force[:-1], atol=1e-9 * N)
        if place in (0.4, 0.1):
            # it has slipped all the way
            assert scene.contact.dissipation - taken == pytest.approx(abs(along[0] * way), rel=10 * exact)


@pytest.mark.parametrize(
    "cell, coupling", [("quadrilateral", "node_to_surface"), ("quadrilateral", "mortar"), ("hexahedron", "mortar")]
)
def test_surface_that_is_prescribed(cell, coupling):
    """A punch all of whose contactors are prescribed: the target sticks to it until it cannot, then mu N drags it either way."""
    scene = pushed(cell, side=False, surface=True, rigid=False, coupling=coupling, n=(6, 3) if cell != "hexahedron" else (4, 2))
    rest = [0.0] * (scene.blocks.gdim - 2)
    scene.to(0.0, *rest, -0.02)
    scene.drives(0.0, *rest)
    scene.to(1e-4, *rest, -0.02)
    along, N = scene.friction()
    assert 0 < along[0] < 0.5 * MU * N
    for way in (0.1, 0.2, -0.1):
        scene.to(way, *rest, -0.02)
        scene.drives(np.sign(way), *rest, within=1e-9 if not rest else 1e-3)
        below = scene.problem.reaction(scene.blocks.bottom)
        np.testing.assert_allclose(below[0], -scene.friction()[0][0], rtol=1e-8)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_guides_that_move(coupling):
    """Between lateral guides that move as well: friction is against the whole motion, on guides, at the side and in between."""
    scene = pushed("hexahedron", guides=True, coupling=coupling, n=(1, 2))
    here = np.zeros(2)
    scene.to(*here, -1e-5)
    scene.drives(0.0, 0.0)
    for place in ((0.3, 0.0), (0.3, 0.4), (0.0, 0.0), (-0.12, 0.05)):
        scene.to(*place, -1e-5)
        # the block is all but rigid
        scene.drives(*(place - here) / np.linalg.norm(place - here), within=1e-4)
        here = np.array(place)


@pytest.mark.parametrize("held", ["side", "surface"])
def test_target_that_moves(held):
    """What is held is dragged along by a rigid plane that moves beneath it, and friction stays when the plane stops."""
    plane = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
    scene = pushed(target=plane.move([0.0, 0.0]), side=True, sliding="finite")
    scene.to(0.0, -0.01)
    scene.drives(0.0)
    for x, direction in ((0.2, -1.0), (0.2, -1.0), (0.1, 1.0)):
        plane.move([x, 0.0])
        scene.to(0.0, -0.01)
        scene.drives(direction)


def test_what_is_held_tells():
    """Components of the relative motion that are prescribed: at feet where all is, in a mean where most of it is."""
    b = blocks(MPI.COMM_SELF, "quadrilateral", 2, 2)
    config, node = Configuration(b.u), np.array([0])
    free = np.ones((config.n_owned, 2), dtype=bool)
    free[[0, 1], 0] = False
    du = np.zeros((config.n_owned, 2))
    du[:3, 0] = 1.0, 0.2, 0.7
    for share, moves, means in ((0.4, True, True), (0.5, True, True), (0.6, True, False), (1.0, False, False)):
        terms = np.zeros(2, np.int64), np.array([1, 2]), np.array([share, 1.0 - share])
        for at_feet, expected in ((True, moves), (False, means)):
            ties = Ties.of(config, node, terms, free, at_feet)
            np.testing.assert_array_equal(ties.moves, [[expected, True]])
            far = 1.0 - 0.2 * share - 0.7 * (1.0 - share) if expected else 0.8
            np.testing.assert_allclose(ties.relative(du), [[far, 0.0]], atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_half_model(coupling):
    """With half the force of the whole one; mortar's relative motions, means over facets, have parts across the plane of symmetry."""

    def pushed(half):
        y, n = (0.0, 1) if half else (-1.0, 2)
        lower = box("hexahedron", [-0.4, 1.4 * y, -1.0], [1.4, 1.4, 0.0], [4, 3 * n, 2])
        upper = box("hexahedron", [0.0, y, 0.0], [1.0, 1.0, 1.0], [3, 4 * n, 3])
        s = scene(MPI.COMM_WORLD, "hexahedron", [lower, upper])
        V = compat.function_space(s.mesh, 1, (3,))
        u, low, high, top = (
            fem.Function(V),
            s.tag("low", 0, at(2, 0.0)),
            s.tag("high", 1, at(2, 0.0)),
            s.tag("top", 1, at(2, 1.0)),
        )
        bcs = [
            *clamp(V, s.tag("bottom", 0, at(2, -1.0))),
            *clamp(V, top, 0, value=0.05),
            *clamp(V, top, 1),
            *clamp(V, top, 2, value=-0.02),
        ]
        for body in (0, 1) if half else ():
            bcs += clamp(V, s.tag(f"middle {body}", body, at(1, 0.0)), 1)
        contact = uem.Contact(high, low, coupling=coupling, friction=0.3)
        problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact])
        for _ in uem.load_steps(problem, 2):
            pass
        assert MPI.COMM_WORLD.allreduce(int(contact.pair.friction.slipping(contact.pair.trial).sum())) > 0
        return np.asarray(contact.resultant().force)

    whole, half = pushed(False), pushed(True)
    np.testing.assert_allclose(2 * half[[0, 2]], whole[[0, 2]], rtol=1e-6)


@pytest.mark.parametrize(
    "cell, coupling", [("quadrilateral", "node_to_surface"), ("triangle", "mortar"), ("hexahedron", "node_to_surface")]
)
def test_between_floor_and_wall(cell, coupling):
    """A slider whose edge lies on two rigid planes, pushed along them, away and back: every contactor rubs by each plane's own law."""
    b = blocks(MPI.COMM_WORLD, cell, 1, 2, overhang=0.5)
    g, zero = b.gdim, [0.0] * (b.gdim - 1)
    floor, wall = uem.RigidPlane([0.0] * g, [*zero, 1.0]), uem.RigidPlane([1.0, *zero], [-1.0, *zero])
    right, left = b.scene.tag("right", 1, at(0, 1.0)), b.scene.tag("left", 1, at(0, 0.0))
    contacts = [uem.Contact(own, plane, friction=MU, coupling=coupling) for own, plane in ((b.high, floor), (right, wall))]
    place = [fem.Constant(b.scene.mesh, 0.0) for _ in range(g)]
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, g - 1, place[-1])]
    bcs += [uem.dirichlet(b.V, left, c, place[c]) for c in range(g - 1)]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=contacts)
    for path in ((0.01, 0.0, -0.02), (0.02, 0.0, -0.05), (0.02, 0.1, -0.05), (-0.02, 0.2, -0.05)):
        for constant, value in zip(place, path if g == 3 else path[::2]):
            constant.value = value
        problem.solve()
        (x, *_, N), (H, *_, y) = (contact.resultant().force for contact in contacts)
        assert 0 < np.hypot(x, 0.0) <= MU * N * (1 + 1e-9) and 0 <= y <= -MU * H * (1 + 1e-9)
