"""Scenes with friction: a block that is pressed onto another or onto a plane, then driven along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from evidence.scenes import Array, Blocks, at, blocks, clamp, linear, modulus

import uem_dolfinx as uem


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
        return tuple(self.problem.comm.allreduce(np.array([stick.sum(), pair.slipping.sum()])))


def driven(
    cell: str = "quadrilateral",
    mu: Any = 0.3,
    *,
    rigid: bool = False,
    law: Any = linear,
    E: float = 1.0,
    n: Any = (3, 4),
    comm: MPI.Comm = MPI.COMM_WORLD,
    target: Any = None,
    walls: bool = False,
    how: dict[str, Any] | None = None,
    options: dict[str, Any] | None = None,
    **scene: Any,
) -> Driven:
    """A block on another one that is wider, or on a plane; all of its top is driven. ``walls`` hold it in the second direction."""
    b = blocks(comm, cell, *n, overhang=0.5, **scene)
    g = b.gdim
    if target is None:
        target = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0]) if rigid else b.low
    contact = uem.Contact(b.high, target, friction=mu, **(how or {}))
    top = fem.Function(b.V)
    sides = [clamp(b.V, b.scene.tag("side", 1, at(1, end)), 1) for end in (0.0, 1.0) if walls]
    bcs = [
        *sum(sides, []),
        *clamp(b.V, b.bottom),
        fem.dirichletbc(top, fem.locate_dofs_topological(b.V, b.top.dim, b.top.entities)),
    ]
    problem = uem.UnitedProblem(law(b.u, modulus(b.scene, E, E)), b.u, bcs=bcs, contacts=[contact], **(options or {}))
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


def loose(cell: str = "quadrilateral", mu: Any = 0.3, *, rigid: bool = False, E: float = 50.0, **options: Any) -> Loose:
    """A block of unit volume on another one, or on a plane, that nothing but contact holds."""
    b = blocks(MPI.COMM_WORLD, cell, 3, 4, overhang=0.5)
    g = b.gdim
    target = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0]) if rigid else b.low
    contact = uem.Contact(b.high, target, friction=mu)
    force = fem.Constant(b.scene.mesh, np.zeros(g))
    F = linear(b.u, E) - modulus(b.scene, 0.0, 1.0) * ufl.inner(force, ufl.TestFunction(b.V)) * ufl.dx
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], **options)
    return Loose(problem, contact, force)


def history(scene: Driven, *places: tuple[float, ...]) -> Array:
    """Displacements after each place that the top is driven to, ``(n_places, n_nodes, gdim)`` in the drawing's order (collective)."""
    return np.array([(scene.to(*place), scene.blocks.scene.gather(scene.problem.u))[1] for place in places])
