"""A displacement that is one part of a mixed space: numbering of its nodes, and of the unknowns of all other fields.

Vectors and matrices of the constrained system have rows of gdim components. On every rank the displacement's nodes come first, then
the unknowns of all other fields, gdim per row; the last row is padded with fixed components.

A scalar field may also be the only unknown, or be read at the nodes of the displacement.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import AnyArray, Array, Bools, Ints, is_whole
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.axisymmetry import taken_as_axisymmetric
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import Exchange, agreed, gathered, reduced


class ConfigurationAmongFields(Configuration):
    """Nodes of a displacement that is one part of a mixed space, and their current positions (collective).

    Args:
        w: Function of the mixed space.
        displacement: number of the part, of vector Lagrange elements of degree 1 or 2.

    Raises:
        InputTypeError, InputError, SpaceError: if w has no mixed space or no such part, or if the part is not a displacement.
    """

    def __init__(self, w: fem.Function, displacement: int):
        W = w.function_space
        with agreed(W.mesh.comm):
            degree = degree_of_displacement(W, displacement)
        given.alike(W.mesh.comm, "UnitedProblem", displacement=displacement)
        self.whole, self.part, self.u = w, int(displacement), ufl.split(w)[displacement]
        # numbered as a separate space, for surfaces and results
        V = compat.function_space(W.mesh, degree, (W.mesh.geometry.dim,))
        self._take(V)
        nodes, own = compat.cell_dofs(V), compat.part_dofs(W, self.part)
        #: local unknowns of w for the components of the local nodes ``(n_local, gdim)``.
        self.dofs: Ints = np.zeros((self.n_local, self.gdim), dtype=np.int64)
        if len(nodes):
            self.dofs[nodes.ravel()] = own.reshape(-1, self.gdim)
        self.nodal_fields: dict[int, Any] = {}  # ``NodalField`` of other parts by their number, made when needed
        self._unknowns = Unknowns(self)
        first = np.append(self._first_nodes[:-1], np.iinfo(np.int64).max)
        numbers = super().to_global(np.arange(self.n_local))
        rank = np.searchsorted(first, numbers, side="right") - 1
        #: Rows of the local nodes, over all ranks.
        self._rows: Ints = numbers - first[rank] + self._unknowns._first_nodes[rank]
        self.first, self.n_global = self._unknowns.first, self._unknowns.n_global
        self._first_nodes = self._unknowns._first_nodes

    @property
    def unknowns(self) -> Unknowns:
        """Rows of vectors and matrices."""
        return self._unknowns

    def to_global(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Rows of local nodes, over all ranks."""
        return self._rows[nodes]

    def of(self, values: AnyArray) -> Any:
        """Values of the displacement ``(n_local, gdim)`` from values of all unknowns including ghosts ``(n,)``."""
        return values[self.dofs]

    def rows(self, values: AnyArray) -> Any:
        """Owned values of all unknowns ``(n,)`` in the rows of vectors ``(n_rows, gdim)``, padded with zeros."""
        out = np.zeros(self.gdim * self._unknowns.n_owned, values.dtype)
        out[self._unknowns.place] = values
        return out.reshape(-1, self.gdim)

    def from_rows(self, rows: Array) -> Array:
        """Owned values of all unknowns ``(n,)`` from a vector's ``rows (n_rows * gdim,)``."""
        return rows[self._unknowns.place]

    def add_to(self, values: AnyArray, of_nodes: Array) -> None:
        """Add values at the owned nodes of the displacement ``(n_owned * gdim,)`` to owned values of all unknowns ``(n,)``."""
        values[self.dofs[: self.n_owned].ravel()] += of_nodes

    def in_rows(self, matrix: PETSc.Mat) -> PETSc.Mat:
        """A matrix of the displacement extended to all rows and columns, with zeros for other fields (collective)."""
        (start, columns, values), g, rows = matrix.getValuesCSR(), self.gdim, self._unknowns
        ends = np.asarray(matrix.getOwnershipRanges(), dtype=np.int64)
        rank = np.searchsorted(ends, columns, side="right") - 1
        columns = columns - ends[rank] + g * rows._first_nodes[rank]
        # with all diagonal entries, which solvers need
        more = np.arange(g * self.n_owned, g * rows.n_owned)
        start = np.append(start, start[-1] + 1 + np.arange(len(more)))
        columns, values = np.append(columns, g * rows.first + more), np.append(values, np.zeros(len(more)))
        size = (g * rows.n_owned, g * rows.n_global)
        csr = start.astype(PETSc.IntType), columns.astype(PETSc.IntType), values
        return PETSc.Mat().createAIJ((size, size), bsize=g, csr=csr, comm=self.comm)

    def place_of(self, unknown: int) -> str:
        """Component and node of a local unknown, or its other part of the space, for error messages."""
        node, component = np.nonzero(self.dofs == unknown)
        if len(node):
            return f"{'xyz'[component[0]]} at {self.describe(node[0])}"
        W = self.whole.function_space
        parts = [i for i in range(W.num_sub_spaces) if (compat.part_dofs(W, i) == unknown).any()]
        return f"part {parts[0]} of the mixed space"

    @cached_property
    def _parts(self) -> dict[str, tuple[fem.Function, Ints]]:
        """Functions of the parts by name, with their unknowns of w (first time: collective)."""
        W, found = self.whole.function_space, {"displacement": (fem.Function(self.V, name="displacement"), self.dofs.ravel())}
        for i in range(W.num_sub_spaces):
            if i != self.part:
                V, dofs = self._space_of_part(i)
                found[f"field_{i}"] = fem.Function(V, name=f"field_{i}"), dofs
        return found

    def _space_of_part(self, i: int) -> tuple[Any, Ints]:
        """A space for part i alone, and the local unknowns of w for its own ``(n,)`` (collective).

        DOLFINx 0.5's ``collapse`` would end the process on a rank without cells.
        """
        W = self.whole.function_space
        V = compat.space_of(W.mesh, W.sub(i).ufl_element())
        block, numbers = V.dofmap.bs, V.dofmap.index_map
        dofs = np.zeros(block * (numbers.size_local + numbers.num_ghosts), dtype=np.int64)
        if len(nodes := compat.cell_dofs(V)):
            dofs[(block * nodes[:, :, None] + np.arange(block)).ravel()] = compat.part_dofs(W, i).ravel()
        return V, dofs

    def functions(self) -> dict[str, fem.Function]:
        """The displacement and all other fields (part 1 is ``field_1``) as separate, current Functions (first call: collective)."""
        found = {name: f for name, (f, _) in self._parts.items()}
        self.fill(found, self.whole.x.array)
        return found

    def fill(self, functions: Mapping[str, fem.Function], values: Array) -> None:
        """Write values of all unknowns including ghosts ``(n,)`` to Functions as in ``functions``."""
        for name, (_, dofs) in self._parts.items():
            functions[name].x.array[:] = values[dofs]

    def values_of(self, functions: Mapping[str, fem.Function]) -> Array:
        """Values of all unknowns including ghosts ``(n,)`` from Functions as in ``functions``."""
        values = np.zeros(len(self.whole.x.array))
        for name, (_, dofs) in self._parts.items():
            values[dofs] = functions[name].x.array
        return values

    def values_at(self, displacement: fem.Function) -> Array:
        """Values of all unknowns including ghosts ``(n,)``, with another displacement."""
        values = np.array(self.whole.x.array)
        values[self.dofs.ravel()] = displacement.x.array
        return values

    def shift(self, nodes: Any, way: Array) -> None:
        """Move distinct local nodes ``(n,)``, or a slice, by ``way (n, gdim)``; ghosts are not updated."""
        self.whole.x.array[self.dofs[nodes]] += way


class Unknowns(Nodes):
    """Rows of the constrained system of a mixed space: nodes of the displacement, then the unknowns of all other fields (collective).

    Args:
        config: nodes of the displacement, in their own numbering.

    Attributes:
        place: vector component of each owned unknown of the mixed space ``(n,)``.
        numbers: vector component over all ranks of each local unknown, including ghosts.
        n_fields: number of parts of the mixed space.
        field: field of each component, 0 for the displacement, others in their order ``(n_owned * block,)``; -1 for padding.
        kind: number of the part's component, equal for components that can be averaged ``(n_owned * block,)``.
    """

    mixed = True

    def __init__(self, config: ConfigurationAmongFields):
        W = config.whole.function_space
        self.config, self.comm, self.mesh, self.V = config, config.comm, config.mesh, W
        self.gdim = self.block = g = config.gdim
        self._map, n = W.dofmap.index_map, W.dofmap.index_map.size_local
        own = config.dofs[: config.n_owned].ravel()
        others = np.setdiff1d(np.arange(n), own)
        self.n_owned = self.n_local = config.n_owned + -(-len(others) // g)
        counts = gathered(self.comm, self.n_owned)
        self.first, self.n_global = int(counts[: self.comm.rank].sum()), int(counts.sum())
        self.place: Ints = np.empty(n, dtype=np.int64)
        self.place[own], self.place[others] = np.arange(len(own)), g * config.n_owned + np.arange(len(others))
        sent = fem.Function(W)
        sent.x.array[:n] = g * self.first + self.place
        sent.x.scatter_forward()
        self.numbers: Ints = np.rint(sent.x.array).astype(np.int64)
        self._label(W, n)

    def _label(self, W: Any, n: int) -> None:
        """Set ``field`` and ``kind`` of all components."""
        self.n_fields = W.num_sub_spaces
        field, kind = np.full((2, len(self.numbers)), -1)
        order = [self.config.part, *(i for i in range(self.n_fields) if i != self.config.part)]
        #: Names of the parts in solver options, the displacement first.
        self.names = ["u", *map(str, order[1:])]
        count = 0
        for number, i in enumerate(order):
            dofs = compat.part_dofs(W, i)
            width = max(W.sub(i).num_sub_spaces, 1)
            field[dofs] = number
            kind[dofs] = count + np.arange(dofs.shape[1]) % width
            count += width
        self.field, self.kind = np.full((2, self.block * self.n_owned), -1)
        self.field[self.place], self.kind[self.place] = field[:n], kind[:n]
        self.field_of: Ints = field  # field of every local unknown of the mixed space, including ghosts

    def norms(self, v: PETSc.Vec) -> Array:
        """Norm of each field's part of a vector, the displacement first ``(n_fields,)`` (collective)."""
        return self.norms_of(v.array_r)

    def norms_of(self, values: Array) -> Array:
        """Norm of each field's part from owned components ``(n_owned * block,)`` (collective)."""
        # for empty arrays the result would have integer type
        squares = np.bincount(self.field + 1, values**2, self.n_fields + 1)[1:].astype(float)
        return np.sqrt(np.asarray(reduced(self.comm, squares)))

    def work(self, q: PETSc.Vec, F: PETSc.Vec) -> float:
        """Work of forces in an increment, for the displacement only (collective)."""
        n = self.block * self.config.n_owned
        return float(reduced(self.comm, float(q.array_r[:n] @ F.array_r[:n])))

    def to_global(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Numbers of owned rows over all ranks."""
        return np.asarray(nodes, dtype=np.int64) + self.first

    def describe(self, node: int) -> str:
        """Position of an owned row's node, for error messages."""
        return self.config.describe(node) if node < self.config.n_owned else "an unknown of another field"

    def create_matrix(self, a: Any) -> PETSc.Mat:
        """Matrix for a compiled bilinear form of the mixed space, with a map from DOLFINx's numbering (collective).

        All components of a row have the same block columns, as for nodes.
        """
        there = forms.create_matrix(a)
        forms.assemble_matrix(there, a)
        indptr, columns, _ = there.getValuesCSR()
        there.destroy()
        g, (distinct, at) = self.block, np.unique(columns, return_inverse=True)
        column = self._numbers_of(distinct)[at] // g
        row = np.repeat(self.place // g, np.diff(indptr))
        every = np.arange(self.n_owned)
        keys = np.unique(np.append(row * self.n_global + column, every * self.n_global + every + self.first))
        row, column = np.divmod(keys, self.n_global)
        width = g * np.bincount(row, minlength=self.n_owned)
        of_row, wide = np.cumsum(width) - width, np.repeat(width, g)
        starts = np.append(0, np.cumsum(wide))
        places = np.arange(starts[-1]) + np.repeat(np.repeat(of_row, g) - starts[:-1], wide)
        all_columns = (g * column[:, None] + np.arange(g)).ravel()[places]
        sizes = ((g * self.n_owned, g * self.n_global),) * 2
        csr = starts.astype(PETSc.IntType), all_columns.astype(PETSc.IntType), np.zeros(len(all_columns))
        K = PETSc.Mat().createAIJ(sizes, csr=csr, comm=self.comm)
        numbers = PETSc.LGMap().create(self.numbers.astype(PETSc.IntType), comm=self.comm)
        K.setLGMap(numbers, numbers)
        return K

    def _numbers_of(self, unknowns: Ints) -> Ints:
        """Vector components, over all ranks, of DOLFINx's global ``unknowns (k,)`` of any rank (collective)."""
        first = gathered(self.comm, int(self._map.local_range[0]))
        asking = Exchange.to(self.comm, np.searchsorted(first, unknowns, side="right") - 1)
        (received,) = asking.send(unknowns)
        found = np.empty(len(unknowns), dtype=np.int64)
        (found[asking.rows],) = asking.back(self.numbers[received - first[self.comm.rank]])
        return found

    def multipliers(self, A: PETSc.Mat) -> int:
        """Number of unknowns of other fields with zero or negative diagonal (collective)."""
        return int(reduced(self.comm, int(((A.getDiagonal().array_r <= 0.0) & (self.field > 0)).sum())))

    def complete(self, K: PETSc.Mat, free: Bools) -> None:
        """Set zero diagonal entries of K to 1 for fixed components, which P eliminates ``(n_owned, block)`` (collective)."""
        diagonal = K.getDiagonal()
        idle = ~free.ravel() & (diagonal.array_r == 0.0)
        diagonal.array[idle] = 1.0
        K.setDiagonal(diagonal)


def degree_of_displacement(W: Any, i: Any) -> int:
    """Degree of a mixed space's part i, a vector Lagrange space."""
    if not compat.is_mixed(W):
        raise SpaceError("displacement names a part of a mixed space, and the space of u is none: leave displacement out")
    size = W.num_sub_spaces
    given.kind("displacement", i, is_whole(i), f"the number of a part of the mixed space, one of 0 to {size - 1}")
    if not 0 <= i < size:
        raise InputError(given.sentence("displacement", i, f"the number of a part of the mixed space, one of 0 to {size - 1}"))
    part, g = W.sub(int(i)), W.mesh.geometry.dim
    degree, components = compat.lagrange_degree(part), part.num_sub_spaces
    if degree is None or components != g:
        fit = [k for k in range(size) if W.sub(k).num_sub_spaces == g and compat.lagrange_degree(W.sub(k)) is not None]
        remedy = f"; take displacement={fit[0]}" if fit else "; make the displacement a part of its own"
        raise SpaceError(
            f"displacement = {i}: that part of the mixed space has {max(components, 1)} component(s)"
            f"{'' if degree else ' and is no Lagrange space'}, expected a vector Lagrange space of size {g}{remedy}"
        )
    return degree


class ScalarConfiguration(Configuration):
    """Nodes of a scalar Lagrange space of degree 1 or 2, in no surface, else a SpaceError; arrays are ``(n, 1)``, not ``(n, gdim)``."""

    moves, name = False, "field"

    def _take(self, V: Any) -> None:
        degree, self.tdim = compat.lagrange_degree(V), V.mesh.topology.dim
        if degree not in (1, 2) or self.tdim != V.mesh.geometry.dim:
            raise SpaceError(
                f"u is a scalar field of a space {V.ufl_element()} on cells of dimension {self.tdim} in {V.mesh.geometry.dim}D: expected "
                "a Lagrange space of degree 1 or 2 on cells of the dimension of their space"
            )
        self.degree: int = degree
        Nodes.__init__(self, V)
        self.axisymmetric = taken_as_axisymmetric(V.mesh)

    def place_of(self, unknown: int) -> str:
        """Position of the node of a local unknown, for error messages."""
        return f"the value at {self.describe(unknown)}"

    @property
    def x(self) -> Array:
        """Positions of the local nodes ``(n_local, gdim)``: the reference positions."""
        return self.X

    def modes(self, centred: bool = False) -> Array:
        """The constant field, which conduction does not resist ``(n_owned, 1, 1)``."""
        return Nodes.modes(self, centred)

    def of_circles(self, vectors: Array) -> Array:
        """The unchanged vectors: sums of scalars around an axis do not cancel."""
        return vectors


class NodalField:
    """Values of a field at nodes, interpolated from the unknowns of one cell with its shape functions.

    Args:
        config: displacement among other fields.
        part: number of the field in the mixed space.
        what: user of the field, for messages.

    Raises:
        InputError, SpaceError: if the space has no such part, or if it is not a scalar Lagrange field of at most the displacement's
            degree.
    """

    def __init__(self, config: ConfigurationAmongFields, part: int, what: str):
        self.config, self.part = config, part
        W = config.whole.function_space
        degree = _degree(config, part, what)
        cell = compat.cell_name(config.mesh)
        points = forms.create_lagrange_element(cell, config.degree).points
        # values are multiples of 1/8, for degree 1 at nodes of degree 2, or 1
        shape = np.rint(8.0 * forms.create_lagrange_element(cell, degree).tabulate(0, points)[0, :, :, 0]) / 8.0
        nodes, own = compat.cell_dofs(config.V), compat.part_dofs(W, part)
        # unknowns of the cell by their weight at each node, the largest first
        k = int((shape != 0).sum(axis=1).max())
        order = np.argsort(-np.abs(shape), axis=1, kind="stable")[:, :k]
        #: local unknowns of the mixed space for the value at each local node ``(n_local, k)``.
        self.unknowns: Ints = np.zeros((config.n_local, k), dtype=np.int64)
        self.weights: Array = np.zeros((config.n_local, k))  # weights of these unknowns ``(n_local, k)``
        if len(nodes):
            self.unknowns[nodes] = own[:, order]
            self.weights[nodes] = np.take_along_axis(shape, order, axis=1)

    @property
    def values(self) -> Array:
        """Values at the owned nodes ``(n_owned,)``."""
        n = self.config.n_owned
        return np.asarray((self.weights[:n] * self.config.whole.x.array[self.unknowns[:n]]).sum(axis=1))

    def terms(self, nodes: Ints) -> Array:
        """Global vector components for the values at owned ``nodes (m,)``, followed by their weights ``(m, 2 k)``."""
        return np.column_stack([self.config.unknowns.numbers[self.unknowns[nodes]], self.weights[nodes]])

    def rows(self, nodal: Array) -> Array:
        """Nodal amounts ``nodal (n_owned,)`` as terms of the field's equations, in rows of vectors ``(n_rows * gdim,)`` (collective)."""
        from dolfinx import fem

        n, sent = self.config.n_owned, fem.Function(self.config.whole.function_space)
        np.add.at(sent.x.array, self.unknowns[:n].ravel(), (self.weights[:n] * nodal[:, None]).ravel())
        forms.sum_ghosts(sent)
        return np.asarray(self.config.rows(sent.x.array[: len(self.config.unknowns.place)]).ravel())


def nodal_field(config: ConfigurationAmongFields, part: int, what: str) -> NodalField:
    """The field of a part at nodes, made once; arguments and errors as for ``NodalField``."""
    if part not in config.nodal_fields:
        config.nodal_fields[part] = NodalField(config, part, what)
    found: NodalField = config.nodal_fields[part]
    return found


def _degree(config: Any, part: int, what: str) -> int:
    """Degree of the field, which must not exceed the displacement's degree."""
    W = config.whole.function_space
    others = [i for i in range(W.num_sub_spaces) if i != config.part]
    if part not in others:
        raise InputError(f"{what}: field = {part}: expected the number of a part other than the displacement, one of {others}")
    V = W.sub(part)
    degree = compat.lagrange_degree(V)
    if V.num_sub_spaces or degree is None or degree > config.degree:
        raise SpaceError(
            f"{what}: part {part} of the mixed space is no scalar Lagrange field of degree {config.degree} or less, whose "
            "values the contactors' nodes determine: give the field such an element, or the displacement a higher degree"
        )
    return degree
