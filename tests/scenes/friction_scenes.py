"""Scenes with friction: a block that is pressed onto another or onto a plane, then driven along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from benchmarks.scenes import Array, Body, at, box, clamp
from benchmarks.scenes import scene as create_scene
from block_scenes import Blocks, blocks, linear, modulus
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat


@dataclass
class Driven:
    """A block whose top is driven; ``to`` moves it there and finds the equilibrium."""

    blocks: Blocks
    problem: uem.UnitedProblem
    contact: uem.Contact
    top: fem.Function

    def to(self, *place: float) -> list[Any]:
        """Drive the top by so much from where it was drawn."""
        self.top.x.array[:] = np.tile(place, len(self.top.x.array) // len(place))
        return self.problem.solve()

    @property
    def states(self) -> tuple[int, int]:
        """Numbers of contactors that stick and that slip (collective)."""
        pair = self.contact.pair
        stick = pair.trial.active & pair.trial.friction.stick
        return tuple(self.problem.comm.allreduce(np.array([stick.sum(), pair.friction.slipping(pair.trial).sum()])))


def driven(
    cell: str = "quadrilateral",
    mu: Any = 0.3,
    *,
    rigid: bool = False,
    law: Any = linear,
    E: float | tuple[float, float] = 1.0,
    n: Any = (3, 4),
    comm: MPI.Comm = MPI.COMM_WORLD,
    target: Any = None,
    walls: bool = False,
    flat: bool = False,
    swap: bool = False,
    how: dict[str, Any] | None = None,
    options: dict[str, Any] | None = None,
    **scene: Any,
) -> Driven:
    """A block on another one that is wider, or on a plane; all of its top is driven.

    ``E`` is the modulus of both, or of the lower and the upper; ``walls`` hold it in the second direction, ``flat`` holds the surface of
    the other block, ``swap`` makes this the contactor.
    """
    b = blocks(comm, cell, *n, overhang=0.5, **scene)
    g = b.gdim
    if target is None:
        target = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0]) if rigid else b.low
    frictional = {} if mu is None else {"friction": mu}
    contact = uem.Contact(*((target, b.high) if swap else (b.high, target)), **frictional, **(how or {}))
    top = fem.Function(b.V)
    sides = [clamp(b.V, b.scene.tag("side", 1, at(1, end)), 1) for end in (0.0, 1.0) if walls]
    bcs = [
        *sum(sides, []),
        *clamp(b.V, b.low if flat else b.bottom),
        fem.dirichletbc(top, fem.locate_dofs_topological(b.V, b.top.dim, b.top.entities)),
    ]
    problem = uem.UnitedProblem(
        law(b.u, modulus(b.scene, *np.broadcast_to(E, 2))), b.u, bcs=bcs, contacts=[contact], **(options or {})
    )
    return Driven(b, problem, contact, top)


@dataclass
class Loose:
    """A block that friction alone holds; ``under`` puts it under a force and finds the equilibrium."""

    problem: uem.UnitedProblem
    contact: uem.Contact
    force: fem.Constant

    def under(self, *force: float) -> list[Any]:
        """Put the block under a force, which is spread over its volume."""
        self.force.value[:] = force
        return self.problem.solve()


def loose(
    cell: str = "quadrilateral",
    mu: Any = 0.3,
    *,
    rigid: bool = False,
    E: float = 50.0,
    n: Any = (3, 4),
    degree: int = 1,
    coupling: str = "node_to_surface",
    **options: Any,
) -> Loose:
    """A block of unit volume on another one, or on a plane, that nothing but contact holds."""
    b = blocks(MPI.COMM_WORLD, cell, *n, overhang=0.5, degree=degree)
    g = b.gdim
    target = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0]) if rigid else b.low
    contact = uem.Contact(b.high, target, friction=mu, coupling=coupling)
    force = fem.Constant(b.scene.mesh, np.zeros(g))
    F = linear(b.u, E) - modulus(b.scene, 0.0, 1.0) * ufl.inner(force, ufl.TestFunction(b.V)) * ufl.dx
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], **options)
    return Loose(problem, contact, force)


def history(scene: Driven, *places: tuple[float, ...]) -> Array:
    """Displacements after each place that the top is driven to, ``(n_places, n_nodes, gdim)`` in the drawing's order (collective)."""
    return np.array([(scene.to(*place), scene.blocks.scene.gather(scene.problem.u))[1] for place in places])


def fields(problem: uem.UnitedProblem, pair: Any) -> tuple[Array, Array, Array]:
    """Smooth displacement and way of all nodes, and numbers of the contactors, about which friction is differentiated."""
    x, g = problem.config.X, problem.config.gdim
    smooth = np.stack([0.05 * np.sin(2 * x[:, i] + i) * np.cos(x[:, (i + 1) % g]) for i in range(g)], axis=1)
    way = np.stack([np.cos(3 * x[:, i] + 2 * i) + 0.3 * x[:, (i + 1) % g] for i in range(g)], axis=1)
    return smooth, way, 0.3 + 0.2 * np.sin(5 * x[pair.nodes].sum(axis=1))


#: Radius of the cylinder's surface, and how far the bodies reach.
RADIUS, HALF_WIDTH = 8.0, 3.0


@dataclass
class Cylinder(Driven):
    """Two bodies with a mesh that is the finer the nearer to the middle of their contact."""

    n: int

    def facet(self, x: float) -> float:
        """Length of the facets at a distance from the middle."""
        return 2 * np.sqrt(HALF_WIDTH * max(x, HALF_WIDTH / self.n**2)) / self.n


def cylinder(
    mu: float, *, n: int, degree: int = 1, coupling: str = "node_to_surface", comm: MPI.Comm = MPI.COMM_WORLD
) -> Cylinder:
    """A body with a round lower surface on a flat one, of the same material; its top is driven."""

    def graded(body: Body) -> Body:
        return body.mapped(lambda x: HALF_WIDTH * np.sign(x) * x**2)

    def pose(x: Array) -> Array:
        y, high = x.copy(), np.arange(len(x)) >= len(lower.x)
        y[high, 1] += y[high, 0] ** 2 / (2 * RADIUS) * (1 - y[high, 1] / HALF_WIDTH)
        return y

    lower, upper = (graded(box("quadrilateral", [-1.0, y], [1.0, y + 1.0], [2 * n, n])) for y in (-1.0, 0.0))
    s = create_scene(comm, "quadrilateral", [lower, upper], pose=pose)
    V = compat.function_space(s.mesh, degree, (2,))
    bottom, low = s.tag("bottom", 0, at(1, -HALF_WIDTH)), s.tag("low", 0, at(1, 0.0))
    high, top = s.tag("high", 1, at(1, 0.0)), s.tag("top", 1, at(1, HALF_WIDTH))
    u, driver = fem.Function(V), fem.Function(V)
    contact = uem.Contact(high, low, friction=mu, coupling=coupling)
    bcs = [*clamp(V, bottom), fem.dirichletbc(driver, fem.locate_dofs_topological(V, 1, top.entities))]
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact])
    return Cylinder(Blocks(s, V, u, bottom, low, high, top, len(upper.x)), problem, contact, driver, n)


@dataclass
class Keel(Driven):
    """A wedge in a groove, or astride of a roof, whose flanks are at ``angles`` to the plane of symmetry."""

    angles: Array

    @property
    def normal_forces(self) -> Array:
        """Forces of the two flanks, each along its normal, that balance what does not act along the groove ``(2,)`` (collective)."""
        c, s = np.cos(self.angles), np.sin(self.angles)
        return np.linalg.solve([[c[0], -c[1]], [s[0], s[1]]], self.contact.resultant().force[1:])


def keel(
    angles: tuple[float, float],
    coupling: str,
    *,
    mu: float = 0.3,
    sharp: float = 1.0,
    roof: bool = False,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> Keel:
    """A wedge whose top is driven along a groove that does not give way; degrees, and by how much its flanks are steeper."""
    low = box("hexahedron", [0.0, -0.5, -1.0], [2.0, 0.5, 0.0], [5, 2, 1])
    high = box("hexahedron", [0.2, -0.4, 0.0], [1.2, 0.4, 1.0], [3, 2, 2])
    slopes = (-1.0 if roof else 1.0) / np.tan(np.radians(angles))

    def pose(x: Array) -> Array:
        y, above = x.copy(), np.arange(len(x)) >= len(low.x)
        rise = np.abs(x[:, 1]) * np.where(x[:, 1] < 0, *slopes)
        y[:, 2] += np.where(above, sharp * rise * (1 - x[:, 2]), rise * (1 + x[:, 2]))
        return y

    s = create_scene(comm, "hexahedron", [low, high], pose=pose)
    V = compat.function_space(s.mesh, 1, (3,))
    u, driver = fem.Function(V), fem.Function(V)
    bottom, surface = s.tag("bottom", 0, at(2, -1.0)), s.tag("groove", 0, at(2, 0.0))
    edge, top = s.tag("keel", 1, at(2, 0.0)), s.tag("top", 1, at(2, 1.0))
    contact = uem.Contact(edge, surface, friction=mu, coupling=coupling)
    bcs = [*clamp(V, bottom), *clamp(V, surface), fem.dirichletbc(driver, fem.locate_dofs_topological(V, 2, top.entities))]
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact])
    made = Blocks(s, V, u, bottom, surface, edge, top, len(high.x))
    return Keel(made, problem, contact, driver, np.radians(angles))


def on_plane(plane: Any, coupling: str, *, mu: float = 0.3, depth: float = 0.4, height: float = 0.4, law: Any = linear) -> Driven:
    """A block that stands at a distance from the origin on a rigid plane; its top is driven."""
    s = create_scene(MPI.COMM_WORLD, "hexahedron", [box("hexahedron", [0.8, -0.2, 0.0], [1.2, depth - 0.2, height], [3, 3, 3])])
    V = compat.function_space(s.mesh, 1, (3,))
    u, driver = fem.Function(V), fem.Function(V)
    low, top = s.tag("low", 0, at(2, 0.0)), s.tag("top", 0, at(2, height))
    contact = uem.Contact(low, plane, friction=mu, coupling=coupling)
    bcs = [fem.dirichletbc(driver, fem.locate_dofs_topological(V, 2, top.entities))]
    problem = uem.UnitedProblem(law(u, 1.0), u, bcs=bcs, contacts=[contact], rtol=1e-11)
    return Driven(Blocks(s, V, u, low, low, low, top, 64), problem, contact, driver)
