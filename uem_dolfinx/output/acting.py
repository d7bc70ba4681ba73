"""The surface of the undeformed bodies, and prescribed values, loads and springs at its points, for sketches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.conditions.places import nodes_at
from uem_dolfinx.geometry.bodies import body_sums, find_bodies
from uem_dolfinx.geometry.rigid import RigidSurface
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.output.drawings import EVEN
from uem_dolfinx.output.frames import at_vertices, boundary_and_cells, vertex_positions
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.loading import rules_of, set_loads
from uem_dolfinx.solve.problem import UnitedProblem


def loads_of(problem: UnitedProblem, wanted: bool = True) -> tuple[Array, Array]:
    """Nodal forces ``(n_owned, gdim)`` of the residual's surface integrals on undeformed bodies, and of its other integrals (collective).

    Other integrals include stresses, which have no resultant on a body, so that sums over its nodes are resultants of volume loads. Zero
    unless ``wanted``.
    """
    config, F = problem.config, problem.bodies.F
    found = np.zeros((2, config.n_owned, config.gdim))
    if wanted:
        over = F.integrals_by_type("exterior_facet")
        with config.at(np.zeros_like(problem.u.x.array)):
            for k, part in enumerate((ufl.Form(over) if over else None, F)):
                if part is not None:
                    values = forms.assemble_array(problem.u.function_space, forms.form(part))
                    found[k] = -config.rows(values)[: config.n_owned]
        found[1] -= found[0]
    return found[0], found[1]


@contextmanager
def loaded(problem: UnitedProblem, at: float | None) -> Iterator[None]:
    """A block with loads, Dirichlet values and rigid surfaces set by ``load`` at a load factor or time (collective)."""
    if at is None:
        yield
        return
    F, load = problem.bodies.F, problem.load
    terms = [
        one
        for one in (*F.constants(), *F.coefficients())
        if one is not problem.u and isinstance(one, (fem.Constant, fem.Function))
    ]
    terms += load if isinstance(load, Mapping) else []
    terms += [rule.values for rule in rules_of(problem.bodies.bcs)]
    kept = [(forms.values_of(one), np.array(forms.values_of(one))) for one in terms]
    targets = [contact.target for contact in problem.contacts if isinstance(contact.target, RigidSurface)]
    motions = [target.motion for target in targets]
    now = problem.progress.factor if problem.dynamics is None else problem.dynamics.time
    try:
        _set_load(problem, at)
        yield
        _set_load(problem, now)
    finally:
        for values, before in kept:
            values[...] = before
        for target, motion in zip(targets, motions):
            target.motion = motion


def _set_load(problem: UnitedProblem, at: float) -> None:
    """Set a problem's ``load`` and its couplings at a load factor or time, but not its contacts (collective)."""
    set_loads(problem.comm, problem.load, at, problem.bodies.bcs)
    for one in problem.couplings:
        one.take_load(at)


class Outside:
    """Vertices and exterior facets (the constructor is collective).

    Attributes:
        X: positions of the d.o.f. of the mesh's P1 space ``(n_local, gdim)``.
        owned: mask of owned ones ``(n_local,)``.
        faces: d.o.f. around each owned exterior facet ``(m, k)``.
        cells: the cells behind them ``(m,)``.
        normals: outward unit normals at vertices, zero inside ``(n_local, gdim)``.
    """

    def __init__(self, problem: UnitedProblem):
        self.config, self.comm = problem.config, problem.comm
        self.mesh, self.gdim = problem.config.mesh, problem.config.gdim
        self.X = vertex_positions(problem, 0.0)
        self.owned: Bools = np.arange(len(self.X)) < compat.function_space(self.mesh, 1).dofmap.index_map.size_local
        self.faces, self.cells = boundary_and_cells(self.mesh)
        self.normals = self._outward()

    def gather(self, *arrays: Any) -> list[Any] | None:
        """Arrays of all ranks, one after the other, on rank 0 (collective)."""
        parts = self.comm.gather(arrays)
        return None if parts is None else [np.concatenate(column) for column in zip(*parts)]

    def facets(self, which: Any = slice(None), part: Part | None = None) -> tuple[Array, Array]:
        """Corners ``(m, k, gdim)`` and outward normals ``(m, gdim)`` of owned exterior facets, some or of a part (collective)."""
        faces, cells = (self.faces, self.cells) if part is None else boundary_and_cells(self.mesh, part)
        vectors = _area_vectors(self.X, faces[which], compat.cell_dofs(compat.function_space(self.mesh, 1))[cells[which]])
        return self.X[faces[which]], vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    def _outward(self) -> Array:
        """Outward unit normals at the vertices, zero inside ``(n_local, gdim)`` (collective)."""
        field = fem.Function(compat.function_space(self.mesh, 1, (self.gdim,)))
        n = field.x.array.reshape(-1, self.gdim)
        behind = compat.cell_dofs(compat.function_space(self.mesh, 1))[self.cells]
        vectors = _area_vectors(self.X, self.faces, behind)
        for k in range(self.faces.shape[1]):
            np.add.at(n, self.faces[:, k], vectors)
        forms.sum_ghosts(field)
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return np.divide(n, length, out=np.zeros_like(n), where=length > 0)

    def at_vertices(self, values: Array) -> Array:
        """Values at vertices ``(n_local of P1, k)``, from values at nodes ``(n_local, k)`` (collective)."""
        config, shape = self.config, (values.shape[1],) if values.shape[1] > 1 else ()
        field = fem.Function(compat.function_space(self.mesh, config.degree, shape))
        field.x.array[:] = values.ravel()
        return at_vertices(field).reshape(-1, values.shape[1])

    def touched(self, which: Bools) -> Bools:
        """Mask of vertices ``(n_local,)`` of owned facets in a mask, including facets of other ranks (collective)."""
        field = fem.Function(compat.function_space(self.mesh, 1))
        field.x.array[self.faces[which].ravel()] = 1.0
        forms.sum_ghosts(field)
        return np.asarray(field.x.array > 0)

    def body_of_cells(self) -> tuple[Ints, Ints]:
        """Body of each local cell, and the cell's number in the mesh's input ``(n_cells,)`` (collective)."""
        label, _ = find_bodies(self.config)
        first = compat.cell_dofs(self.config.V)[:, 0]
        return label[first], forms.original_cells(self.mesh)[: len(first)]


def _area_vectors(X: Array, faces: Ints, behind: Indices) -> Array:
    """Outward normals of facets, proportional to their areas ``(m, gdim)``; ``behind`` are vertices of the cells behind them."""
    corners = X[faces]
    a = corners[:, 1] - corners[:, 0]
    n = np.column_stack([a[:, 1], -a[:, 0]]) if X.shape[1] == 2 else np.cross(a, corners[:, 2] - corners[:, 0])
    inward = X[behind].mean(axis=1) - corners.mean(axis=1)
    return np.asarray(-np.sign(np.einsum("mg,mg->m", n, inward))[:, None] * n)


@dataclass(frozen=True)
class Acting:
    """Prescribed values, loads or springs of one kind at points, on rank 0."""

    #: ``"held"``, ``"prescribed"``, ``"value"`` of a scalar field, ``"load"``, ``"body load"``, ``"velocity"``, ``"spring"``,
    #: ``"equation"``, ``"turn"`` for a moment or a rotation, or ``"arm"``, from a node of a rigid part to its point.
    kind: str
    name: str  # label in the legend
    at: Array  # positions ``(n, gdim)``
    vectors: Array  # 1 for held components, or displacements, forces or velocities ``(n, k)``
    outward: Array  # outward unit normals there, zero off the surface ``(n, gdim)``


class Actions:
    """Collects present prescribed values, loads and springs, at the surface ``outside``."""

    def __init__(self, problem: UnitedProblem, outside: Outside):
        self.problem, self.config, self.comm, self._outside = problem, problem.config, problem.comm, outside
        self.gdim = problem.config.gdim
        self.found: list[Acting] = []  # items collected so far, on rank 0

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
                    values = at_vertices(field)[:, None]
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
