"""Nodes of a displacement and their current positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import AnyArray, Array, Indices
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.geometry.axisymmetry import taken_as_axisymmetric
from uem_dolfinx.geometry.bodies import rigid_velocities
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import reduced


class Configuration(Nodes):
    """Nodes of a vector Lagrange space of degree 1 or 2 and their positions ``x = X + u``; SpaceError for any other ``u``."""

    moves = True  # whether the unknowns move the nodes; a scalar field does not
    name = "displacement"  # name of the solution in results and checkpoints
    #: Equations of users, and those that give nodes one displacement, see ``conditions.seams.seams_of``.
    equations: Sequence[Any] = ()
    seams: Any = None

    def __init__(self, u: fem.Function):
        #: The Function with all unknowns, and the displacement in UFL; identical without other fields.
        self.whole: fem.Function = u
        self.u: Any = u
        self._take(u.function_space)

    def _take(self, V: Any) -> None:
        """Set the nodes of the displacement's space (collective)."""
        gdim = V.mesh.geometry.dim
        self.tdim: int = V.mesh.topology.dim
        degree = compat.lagrange_degree(V)
        if self.tdim != gdim:
            raise SpaceError(
                f"a body of dimension {self.tdim} in {gdim}D space has no inside: use a mesh with gdim = {self.tdim}"
            )
        if V.dofmap.index_map_bs != gdim or degree is None:
            raise SpaceError(
                f"the displacement has {V.dofmap.index_map_bs} component(s) in {gdim}D: use a vector Lagrange space of size {gdim}"
                + ("; of a mixed space name the part that it is, as displacement=0" if compat.is_mixed(V) else "")
            )
        self.degree: int = degree
        if degree > 2:
            raise SpaceError(f"contact surfaces of degree {degree} are not supported: use degree 1 or 2")
        super().__init__(V)
        #: Shared facets of surfaces while they are in use, by ``id`` of their tags; see ``facets.facets_of``.
        self.surfaces: WeakValueDictionary[int, Any] = WeakValueDictionary()
        #: Whether the coordinates are radius and height, and nodes represent circles.
        self.axisymmetric: bool = taken_as_axisymmetric(V.mesh)

    @property
    def unknowns(self) -> Any:
        """The nodes with rows in vectors and matrices: all of these."""
        return self

    def of(self, values: AnyArray) -> Any:
        """Values of the displacement ``(n_local, gdim)`` from values of all unknowns including ghosts ``(n,)`` (a view)."""
        return values.reshape(-1, self.block)

    def numbers_as(self, V: Any) -> bool:
        """Whether another space has the same mesh and numbering as the displacement's, on this rank."""
        return compat.is_on(V, self.mesh) and np.array_equal(compat.cell_dofs(V), compat.cell_dofs(self.V))

    def entries_in(self, W: Any) -> Indices | None:
        """Local degrees of freedom of a scalar space at the nodes ``(n_local,)``; None if its nodes are not those of the displacement."""
        own, theirs = compat.cell_dofs(self.V), compat.cell_dofs(W)
        if not compat.is_on(W, self.mesh) or W.dofmap.index_map_bs != 1 or own.shape != theirs.shape:
            return None
        found = np.zeros(self.n_local, dtype=np.int32)
        found[own] = theirs
        return found if np.array_equal(found[own], theirs) else None

    def rows(self, values: AnyArray) -> Any:
        """Owned values of all unknowns ``(n,)`` in the rows of vectors ``(n_rows, gdim)`` (a view)."""
        return values.reshape(-1, self.block)

    def from_rows(self, rows: Array) -> Array:
        """Owned values of all unknowns ``(n,)`` from a vector's ``rows (n_rows * gdim,)``."""
        return rows

    def add_to(self, values: AnyArray, of_nodes: Array) -> None:
        """Add values at the owned nodes of the displacement ``(n_owned * gdim,)`` to owned values of all unknowns ``(n,)``."""
        values += of_nodes

    def in_rows(self, matrix: PETSc.Mat) -> PETSc.Mat:
        """A matrix of the displacement extended to all rows and columns, with zeros for other fields (collective)."""
        return matrix

    def place_of(self, unknown: int) -> str:
        """Component and node of a local unknown, for error messages."""
        node, component = divmod(unknown, self.gdim)
        return f"{'xyz'[component]} at {self.describe(node)}"

    def functions(self) -> dict[str, fem.Function]:
        """The displacement and other fields as separate, current Functions by name (first call: collective)."""
        return {self.name: self.whole}

    def fill(self, functions: Mapping[str, fem.Function], values: Array) -> None:
        """Write values of all unknowns including ghosts ``(n,)`` to Functions as in ``functions``."""
        functions[self.name].x.array[:] = values

    def values_of(self, functions: Mapping[str, fem.Function]) -> Array:
        """Values of all unknowns including ghosts ``(n,)`` from Functions as in ``functions``."""
        return np.array(functions[self.name].x.array)

    def values_at(self, displacement: fem.Function) -> Array:
        """Values of all unknowns including ghosts ``(n,)``, with another displacement."""
        return np.array(displacement.x.array)

    @property
    def displacement(self) -> Array:
        """Displacement of the local nodes ``(n_local, gdim)``, ghosts included (to be read)."""
        return np.asarray(self.of(self.whole.x.array))

    def shift(self, nodes: Any, way: Array) -> None:
        """Move distinct local nodes ``(n,)``, or a slice, by ``way (n, gdim)``; ghosts are not updated."""
        self.of(self.whole.x.array)[nodes] += way

    @property
    def x(self) -> Array:
        """Current positions of the local nodes ``(n_local, gdim)``, ghosts included."""
        return self.X + self.displacement

    def here(self, nodes: Any) -> Array:
        """Current positions of local nodes, of an array of any shape ``(...)``: ``(..., gdim)``."""
        return np.asarray(self.X[nodes] + self.displacement[nodes])

    @contextmanager
    def at(self, displacement: Array) -> Iterator[None]:
        """Context with other values of all unknowns including ghosts ``(n,)``."""
        u = self.whole.x.array
        kept = np.array(u)
        u[:] = displacement
        try:
            yield
        finally:
            u[:] = kept

    def modes(self, centred: bool = False) -> Array:
        """Translations and linearised rotations ``(n_owned, n_modes, gdim)``; ``centred`` about the middle of all nodes and scaled."""
        x = self.x[: self.n_owned]
        if centred:
            x = (x - reduced(self.comm, x.sum(axis=0)) / self.index_map.size_global) / self.size
        return rigid_velocities(x)

    def of_circles(self, vectors: Array) -> Array:
        """Forces, momenta or positions of nodes ``(..., gdim)``, integrated over circles in axisymmetry: radial parts cancel."""
        return vectors * np.array([0.0, 1.0]) if self.axisymmetric else vectors


def configuration_of(V: Any) -> Configuration:
    """Nodes of a displacement space (collective); InputTypeError or SpaceError for other spaces."""
    given.kind("V", V, isinstance(V, fem.FunctionSpace), "a function space", "as u.function_space")
    if len(V.component()):
        raise SpaceError("V is a part of another space: expected a whole one; collapse it, or make it by uem.function_space")
    return Configuration(fem.Function(V))
