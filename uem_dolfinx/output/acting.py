"""Prescribed values, loads and springs at points of the undeformed bodies, for sketches."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.conditions.places import nodes_at
from uem_dolfinx.geometry.bodies import body_sums, find_bodies
from uem_dolfinx.output.drawings import EVEN
from uem_dolfinx.output.outside import Outside
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


@dataclass(frozen=True)
class Acting:
    """Prescribed values, loads or springs of one kind at points, on rank 0.

    Attributes:
        kind: ``"held"``, ``"prescribed"``, ``"value"`` of a scalar field, ``"load"``, ``"body load"``, ``"velocity"``, ``"spring"``,
            ``"equation"``, ``"turn"`` for a moment or a rotation, or ``"arm"``, from a node of a rigid part to its point.
        name: label in the legend.
        at: positions ``(n, gdim)``.
        vectors: 1 for held components, or displacements, forces or velocities ``(n, k)``.
        outward: outward unit normals there, zero off the surface ``(n, gdim)``.
    """

    kind: str
    name: str
    at: Array
    vectors: Array
    outward: Array


class Actions:
    """Collects present prescribed values, loads and springs.

    Args:
        problem: the problem.
        outside: surface of its bodies.

    Attributes:
        found: items collected so far, on rank 0.
    """

    def __init__(self, problem: UnitedProblem, outside: Outside):
        self.problem, self.config, self.comm, self._outside = problem, problem.config, problem.comm, outside
        self.gdim = problem.config.gdim
        self.found: list[Acting] = []

    def act(self, kind: str, name: str, at: Array, vectors: Array, outward: Array | None = None) -> None:
        """Collect an item at positions of this rank (collective)."""
        found = self._outside.gather(at, vectors, np.zeros_like(at) if outward is None else outward)
        if found is not None and len(found[0]):
            self.found.append(Acting(kind, name, *found))

    def conditions(self) -> Bools:
        """Collect Dirichlet conditions; returns the mask of surface facets that are held in all components ``(m,)`` (collective)."""
        found, largest = [], 0.0
        for bc in self.problem.bodies.bcs:
            mask, wanted = np.zeros((2, len(self.problem.u.x.array)))
            mask[compat.bc_dofs(bc)[0]] = 1.0
            compat.set_bc_values(wanted, [bc])
            self._other_fields(mask)
            masked, value = (self._outside.at_vertices(np.array(self.config.of(one))) for one in (mask, wanted))
            largest = max(largest, float(reduced(self.comm, np.abs(value).max(initial=0.0), op=MPI.MAX)))
            found.append((masked > 0.5, value))
        still: Bools = np.zeros((len(self._outside.X), self.config.block), dtype=bool)
        kept: list[tuple[Bools, Bools, Array]] = []
        for here, value in found:
            moves: Bools = reduced(self.comm, (np.abs(value) > EVEN * largest).any(axis=0), op=MPI.LOR)
            kept.append((here & ~moves, here & moves, value))
            still |= kept[-1][0]
        clamped: Bools = np.asarray(np.asarray(still.all(axis=1))[self._outside.faces].all(axis=1))
        if not self.config.moves:
            clamped[:] = False
        covered = self._outside.touched(clamped)
        for held, moved, value in kept:
            if not self.config.moves:
                self._note("value", "prescribed value", (held | moved), value)
                continue
            self._note("held", "held", held & ~covered[:, None], held.astype(float))
            self._note("prescribed", "prescribed displacement", moved, np.where(moved, value, 0.0))
        return clamped

    def _other_fields(self, mask: Array) -> None:
        """Collect prescribed values of other fields than the displacement, from a mask of the unknowns ``(n,)`` (collective)."""
        functions = self.config.functions()
        if len(functions) > 1:
            copies = {name: fem.Function(f.function_space) for name, f in functions.items()}
            self.config.fill(copies, mask)
            for name, field in copies.items():
                if name != self.config.name and field.ufl_shape == () and compat.lagrange_degree(field.function_space):
                    linear = fem.Function(compat.function_space(self.config.mesh, 1))
                    linear.interpolate(field)
                    linear.x.scatter_forward()
                    values = np.array(linear.x.array)[:, None]
                    self._note("value", f"prescribed value of {name.replace('_', ' ')}", values > 0.5, values)

    def _note(self, kind: str, name: str, where: Bools, vectors: Array) -> None:
        """Collect vectors at owned vertices on the surface, or inside if none is on the surface; ``where`` masks ``vectors``."""
        some = self._outside.owned & where.any(axis=1)
        outside = some & self._outside.normals.any(axis=1)
        if reduced(self.comm, int(outside.sum())):
            some = outside
        self.act(kind, name, self._outside.X[some], vectors[some], self._outside.normals[some])

    def points(self) -> None:
        """Collect forces and springs at points (collective)."""
        points = self.problem.bodies.tangent.points
        for one, nodes in points.parts if points is not None else ():
            (force, k), at = one.force_and_stiffness(self.gdim), self.config.X[nodes]
            kind, name, vector = ("load", "point load", force) if k is None else ("spring", "spring", np.diag(k))
            self.act(kind, name, at, np.broadcast_to(vector, at.shape))

    def bodies(self, loads: tuple[Array, Array]) -> None:
        """Collect loads on surfaces and body loads ``(n_owned, gdim)`` each, gravity and velocities of bodies (collective)."""
        config, dynamics, n = self.config, self.problem.dynamics, self.config.n_owned
        normals = fem.Function(compat.function_space(self.config.mesh, 1, (self.gdim,)))
        normals.x.array[:] = self._outside.normals.ravel()
        outward = fem.Function(config.V)
        outward.interpolate(normals)
        outward = outward.x.array.reshape(-1, self.gdim)[:n]
        size = np.linalg.norm(loads[0], axis=1)
        acts = size > EVEN * reduced(self.comm, size.max(initial=0.0), op=MPI.MAX)
        self.act("load", "load on a surface", config.X[:n][acts], loads[0][acts] / size[acts, None], outward[acts])
        label, count = find_bodies(config)
        label = label[:n]
        number = body_sums(self.comm, np.ones(n), label, count)[:, None]
        middle = body_sums(self.comm, config.X[:n], label, count) / number
        total = config.of_circles(body_sums(self.comm, loads[1], label, count))
        least = EVEN * body_sums(self.comm, np.abs(loads[1]).sum(axis=1), label, count)
        here = slice(None) if self.comm.rank == 0 else slice(0)
        acts = np.linalg.norm(total, axis=1) > least
        self.act("body load", "body force", middle[acts][here], total[acts][here])
        if dynamics is None:
            return
        if dynamics.gravity is not None and np.any(dynamics.gravity):
            self.act("body load", "gravity", middle[here], np.broadcast_to(dynamics.gravity, middle.shape)[here])
        velocity = dynamics.velocity.x.array.reshape(-1, self.gdim)[:n]
        fastest = reduced(self.comm, np.abs(velocity).max(initial=0.0), op=MPI.MAX)
        mean = body_sums(self.comm, velocity, label, count) / number
        off_mean = np.abs(velocity - mean[label]).max(axis=1) > EVEN * fastest
        varies = body_sums(self.comm, off_mean.astype(float), label, count) > 0
        moves = (np.abs(mean).max(axis=1) > EVEN * fastest) & ~varies
        self.act("velocity", "velocity", middle[moves][here], mean[moves][here])
        some = varies[label] & (outward != 0).any(axis=1)
        self.act("velocity", "velocity", config.X[:n][some], velocity[some])

    def couplings(self) -> None:
        """Collect rigid parts, with loads and prescribed motions of their points (collective)."""
        for one in self.problem.couplings:
            role = f"the part of the RigidCoupling of '{one.name}'"
            X, point = self.config.X[nodes_at(self.config, one.where, role)], one.point
            self.act("arm", f"{one.name}: {'shares loads' if one.distribute else 'rigid'}", X, point - X)
            here = point[None, :] if self.comm.rank == 0 else np.zeros((0, self.gdim))
            (force, moment), wanted, g = one.loads(), one.wanted(), self.gdim
            prescribed = dict(zip(one.prescribed, wanted))
            held = np.array([float(prescribed.get(c) == 0.0) for c in range(g)])
            moved = np.array([prescribed.get(c, 0.0) for c in range(g)])
            turn = np.array([prescribed.get(g + c, 0.0) for c in range(len(moment))])
            for kind, name, vector in (
                ("load", "force", force), ("turn", "moment", moment), ("held", "held", held),
                ("prescribed", "prescribed displacement", moved), ("turn", "prescribed rotation", turn),
            ):  # fmt: skip
                if vector.any():
                    self.act(kind, name, here, np.broadcast_to(vector, (len(here), len(vector))))
