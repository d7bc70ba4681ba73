"""Nodes of a displacement and where they are, and what ranks tell each other about nodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints, sums_of_rows
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.parallel import Exchange


class Configuration:
    """Nodes of a vector Lagrange space and where they are now: ``x = X + u``.

    Raises:
        SpaceError: if ``u`` is not in a blocked Lagrange space of degree 1 or 2 with one component per coordinate.
    """

    def __init__(self, u: fem.Function):
        V = u.function_space
        self.u, self.V, self.mesh = u, V, V.mesh
        self.comm = V.mesh.comm
        self.gdim: int = V.mesh.geometry.dim
        self.tdim: int = V.mesh.topology.dim
        degree = compat.lagrange_degree(V)
        if self.tdim != self.gdim:
            raise SpaceError(
                f"a body of dimension {self.tdim} in {self.gdim}D space has no inside: use a mesh with gdim = {self.tdim}"
            )
        if V.dofmap.index_map_bs != self.gdim or degree is None:
            raise SpaceError(
                f"the displacement has {V.dofmap.index_map_bs} component(s) in {self.gdim}D: "
                f"use a vector Lagrange space of size {self.gdim}"
            )
        self.degree: int = degree
        if degree > 2:
            raise SpaceError(f"contact surfaces of degree {degree} are not supported: use degree 1 or 2")
        self.index_map = V.dofmap.index_map
        self.n_owned: int = self.index_map.size_local
        self.n_local: int = self.n_owned + self.index_map.num_ghosts
        # every rank takes a node's position from its owner, to the last bit
        X = fem.Function(V)
        X.x.array[:] = V.tabulate_dof_coordinates()[: self.n_local, : self.gdim].ravel()
        X.x.scatter_forward()
        self.X: Array = np.array(X.x.array.reshape(-1, self.gdim))

    @property
    def displacement(self) -> Array:
        """Displacement of the local nodes ``(n_local, gdim)``, ghosts included (a view)."""
        return self.u.x.array.reshape(-1, self.gdim)

    @property
    def x(self) -> Array:
        """Current positions of the local nodes ``(n_local, gdim)``, ghosts included."""
        return self.X + self.displacement

    @contextmanager
    def at(self, displacement: Array) -> Iterator[None]:
        """For a while, the nodes where another displacement takes them ``(n_local incl. ghosts,)``, which is flat."""
        u = self.u.x.array
        kept = np.array(u)
        u[:] = displacement
        try:
            yield
        finally:
            u[:] = kept

    def to_global(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Global block numbers of local nodes."""
        flat = np.ascontiguousarray(nodes, dtype=np.int32).ravel()
        return np.asarray(self.index_map.local_to_global(flat), dtype=np.int64).reshape(nodes.shape)

    @cached_property
    def _work(self) -> fem.Function:
        """Holds what is sent between owners and ghosts."""
        return fem.Function(self.V)

    def from_owners(self, nodes: npt.NDArray[np.integer], values: Array, wanted: npt.NDArray[np.integer]) -> Array:
        """Values that owners have at their ``nodes (n, k)``, at local nodes ``wanted (m, k)``, ghosts or not (collective)."""
        out = np.empty((len(wanted), values.shape[1]))
        sent = self._work.x.array.reshape(-1, self.gdim)
        for first in range(0, values.shape[1], self.gdim):
            part = values[:, first : first + self.gdim]
            sent[nodes, : part.shape[1]] = part
            self._work.x.scatter_forward()
            out[:, first : first + self.gdim] = sent[wanted, : part.shape[1]]
        return out

    def to_owners(self, nodes: npt.NDArray[np.integer], values: Array) -> Array:
        """Sums of values at local ``nodes (m,)``, ghosts or not, at every local node ``(n_local,)`` (collective)."""
        sent = self._work.x.array.reshape(-1, self.gdim)
        sent[:] = 0.0
        np.add.at(sent[:, 0], nodes, values)
        forms.sum_ghosts(self._work)
        return np.array(sent[:, 0])

    @cached_property
    def _first_nodes(self) -> Ints:
        """First global node of every rank, and one past the last."""
        return np.array([*self.comm.allgather(self.index_map.local_range[0]), self.index_map.size_global], dtype=np.int64)

    def owner_of(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Ranks that own global nodes."""
        return np.searchsorted(self._first_nodes, nodes, side="right") - 1

    def gather_owned(self, nodes: Ints) -> Ints:
        """Owned local nodes among the global ``nodes (m,)`` of all ranks, each once, sorted (collective)."""
        (owned,) = Exchange.to(self.comm, self.owner_of(nodes)).send(nodes)
        return np.unique(owned) - self._first_nodes[self.comm.rank]

    def ask_owners(self, nodes: Ints, values: Array) -> Array:
        """Values ``(n_owned, k)`` of the nodes' owners at global ``nodes (m,)``: ``(m, k)`` (collective)."""
        exchange = Exchange.to(self.comm, self.owner_of(nodes))
        (asked,) = exchange.send(nodes)
        out = np.empty((len(nodes), values.shape[1]))
        (out[exchange.rows],) = exchange.back(values[asked - self._first_nodes[self.comm.rank]])
        return out

    def add_at_owners(self, nodes: Ints, values: Array) -> Array:
        """Sums of values ``(m, k)`` at global ``nodes (m,)`` of all ranks, at their owners ``(n_owned, k)`` (collective)."""
        there, arrived = Exchange.to(self.comm, self.owner_of(nodes)).send(nodes, values)
        return sums_of_rows(there - self._first_nodes[self.comm.rank], arrived, self.n_owned)

    @cached_property
    def size(self) -> float:
        """Diagonal of the reference bounding box of the whole model, the length that tolerances scale with (first call: collective)."""
        bounds = np.concatenate([np.max(sign * self.X, axis=0, initial=-np.inf) for sign in (-1.0, 1.0)])
        self.comm.Allreduce(MPI.IN_PLACE, bounds, op=MPI.MAX)
        return float(np.linalg.norm(bounds[self.gdim :] + bounds[: self.gdim]))

    def describe(self, node: int) -> str:
        """Where a local node is, for error messages."""
        return "(" + ", ".join(f"{c:.6g}" for c in self.X[node]) + ")"
