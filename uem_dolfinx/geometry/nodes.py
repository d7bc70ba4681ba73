"""Nodes of a space: ownership, and communication of nodal values between ranks."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from hashlib import blake2b
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.arrays import AnyArray, Array, Bools, Ints, sums_of_rows
from uem_dolfinx.errors import InputError, MeshError
from uem_dolfinx.parallel import Exchange, agree, gathered, reduced


class Nodes:
    """Nodes of a Lagrange space with any number of components, and their reference positions (collective).

    Args:
        V: the space.

    Attributes:
        block: number of components of a node: 1 of a temperature, the dimension of a displacement.
        index_map: owned nodes and ghosts.
        n_owned: number of nodes that this rank owns.
        n_local: number of owned nodes and ghosts.
        first: global number of the first owned node.
        n_global: global numbers of all ranks' nodes are below it.
        X: reference positions of the local nodes ``(n_local, gdim)``, ghosts included.
        size: diagonal of the reference bounding box of the whole model, the length that tolerances scale with.
        places: digest of the positions of this rank's nodes of the mesh when these nodes were found.

    Raises:
        MeshError: if a node's position is not finite.
    """

    def __init__(self, V: Any):
        check_places(V.mesh)
        self.V, self.mesh, self.places = V, V.mesh, _digest_of_places(V.mesh)
        self.comm = V.mesh.comm
        self.gdim: int = V.mesh.geometry.dim
        self.block: int = V.dofmap.index_map_bs
        self.index_map = V.dofmap.index_map
        self.n_owned: int = self.index_map.size_local
        self.n_local: int = self.n_owned + self.index_map.num_ghosts
        # every rank takes a node's position from its owner, to the last bit
        every = np.arange(self.n_local)
        self.first, self.n_global = int(self.index_map.local_range[0]), int(self.index_map.size_global)
        self.X: Array = self.from_owners(every, V.tabulate_dof_coordinates()[: self.n_local, : self.gdim], every)
        bounds = np.concatenate([np.max(sign * self.X, axis=0, initial=-np.inf) for sign in (-1.0, 1.0)])
        self.comm.Allreduce(MPI.IN_PLACE, bounds, op=MPI.MAX)
        self.size = float(np.linalg.norm(bounds[self.gdim :] + bounds[: self.gdim]))

    def refuse_moved(self) -> None:
        """Refuse a mesh whose nodes have moved on this rank since, by an InputError (to be agreed on)."""
        if _digest_of_places(self.mesh) != self.places:
            raise InputError(
                "nodes have moved in the mesh since the problem was made, whose surfaces, gaps and equations are of their places then: "
                "expected the same mesh.geometry.x; move nodes first, and make a new problem for every mesh, with a new mass"
            )

    def modes(self, centred: bool = False) -> Array:
        """Constants of each component at owned nodes ``(n_owned, n_modes, block)``, ``centred`` ones of one size (collective)."""
        return np.broadcast_to(np.eye(self.block), (self.n_owned, self.block, self.block))

    def to_global(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Global block numbers of local nodes."""
        flat = np.ascontiguousarray(nodes, dtype=np.int32).ravel()
        return np.asarray(self.index_map.local_to_global(flat), dtype=np.int64).reshape(nodes.shape)

    @cached_property
    def like(self) -> PETSc.Vec:
        """Template for vectors, whose values do not count."""
        sizes = self.block * self.n_owned, self.block * self.n_global
        return forms.Vector().createMPI(sizes, bsize=self.block, comm=self.comm)

    def vector(self, values: npt.ArrayLike | None = None) -> PETSc.Vec:
        """A vector with these values at the owned components, or zeros."""
        v = self.like.duplicate()
        v.array[:] = 0.0 if values is None else np.asarray(values).reshape(-1)
        return v

    mixed = False  # whether there are unknowns in addition to nodal ones

    def create_matrix(self, a: Any) -> PETSc.Mat:
        """Matrix for a compiled bilinear form (collective)."""
        return forms.create_matrix(a)

    def complete(self, K: PETSc.Mat, free: Bools) -> None:
        """Set zero diagonal entries of K to its largest, but for ``free (n_owned, block)`` components (collective)."""
        diagonal = K.getDiagonal()
        largest = diagonal.norm(PETSc.NormType.INFINITY) or 1.0
        diagonal.array[~free.ravel() & (diagonal.array_r == 0.0)] = largest
        K.setDiagonal(diagonal)

    def multipliers(self, A: PETSc.Mat) -> int:
        """Number of unknowns with an expected negative eigenvalue (collective): zero for a displacement."""
        return 0

    def norms(self, v: PETSc.Vec) -> Any:
        """Norm of a vector; with other fields one norm per field, the displacement first ``(n_fields,)`` (collective)."""
        return v.norm()

    def work(self, q: PETSc.Vec, F: PETSc.Vec) -> float:
        """Work of forces in an increment, for the displacement only (collective)."""
        return float(q.dot(F))

    @cached_property
    def _work(self) -> fem.Function:
        """Buffer for values sent between owners and ghosts."""
        return fem.Function(self.V)

    def from_owners(self, nodes: npt.NDArray[np.integer], values: Array, wanted: npt.NDArray[np.integer]) -> Array:
        """Values that owners have at their ``nodes (n, k)``, at local nodes ``wanted (m, k)``, ghosts or not (collective)."""
        out = np.empty((len(wanted), values.shape[1]))
        sent = self._work.x.array.reshape(-1, self.block)
        for first in range(0, values.shape[1], self.block):
            part = values[:, first : first + self.block]
            sent[nodes, : part.shape[1]] = part
            self._work.x.scatter_forward()
            out[:, first : first + self.block] = sent[wanted, : part.shape[1]]
        return out

    def to_owners(self, nodes: npt.NDArray[np.integer], values: Array) -> Array:
        """Sums of values at local ``nodes (m,)``, ghosts or not, at every local node ``(n_local,)`` (collective)."""
        sent = self._work.x.array.reshape(-1, self.block)
        sent[:] = 0.0
        np.add.at(sent[:, 0], nodes, values)
        forms.sum_ghosts(self._work)
        return np.array(sent[:, 0])

    @cached_property
    def _first_nodes(self) -> Ints:
        """First global node of every rank, and one past the last."""
        return np.append(gathered(self.comm, self.first), self.n_global)

    def owner_of(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Ranks that own global nodes."""
        return np.searchsorted(self._first_nodes, nodes, side="right") - 1

    def first_of(self, ranks: Ints) -> Ints:
        """First global node of ranks ``(n,)``."""
        return np.asarray(self._first_nodes[ranks])

    def gather_owned(self, nodes: Ints) -> Ints:
        """Owned local nodes among the global ``nodes (m,)`` of all ranks, each once, sorted (collective)."""
        (owned,) = Exchange.to(self.comm, self.owner_of(nodes)).send(nodes)
        return np.unique(owned) - self.first

    def ask_owners(self, nodes: Ints, values: AnyArray) -> Any:
        """Values ``(n_owned, k)`` of the nodes' owners at global ``nodes (m,)``: ``(m, k)`` (collective)."""
        return Halo(self, nodes).take(lambda own: values[own])

    def send_to_owners(self, nodes: Ints, values: Array) -> tuple[Ints, Array]:
        """Values ``(m, k)`` at global ``nodes (m,)`` of all ranks, at their owners: owned nodes, repeated, and values (collective)."""
        there, arrived = Exchange.to(self.comm, self.owner_of(nodes)).send(nodes, values)
        return there - self.first, arrived

    def add_at_owners(self, nodes: Ints, values: Array) -> Array:
        """Sums of values ``(m, k)`` at global ``nodes (m,)`` of all ranks, at their owners ``(n_owned, k)`` (collective)."""
        return sums_of_rows(*self.send_to_owners(nodes, values), self.n_owned)

    def describe(self, node: int) -> str:
        """Position of a local node, for error messages."""
        return described(self.X[node])


def described(place: Array) -> str:
    """A position ``(gdim,)``, for error messages."""
    return "(" + ", ".join(f"{c:.6g}" for c in place) + ")"


def check_places(mesh: Any) -> None:
    """Refuse a mesh with nodes whose coordinates are not finite by a MeshError that names the first one (collective)."""
    x, number = mesh.geometry.x[:, : mesh.geometry.dim], np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    order, last = bad[np.argsort(number[bad])], np.iinfo(np.int64).max
    least, error = int(reduced(mesh.comm, int(number[order[0]]) if len(bad) else last, op=MPI.MIN)), None
    if len(bad) and number[order[0]] == least:
        error = MeshError(
            f"node {least} of the mesh's input, counted from 0, is at {described(x[order[0]])}: expected finite "
            "coordinates; correct the mesh, or the script that has moved its nodes"
        )
    agree(mesh.comm, error)


def _digest_of_places(mesh: Any) -> bytes:
    """Digest of the positions of this rank's nodes of a mesh."""
    return blake2b(np.ascontiguousarray(mesh.geometry.x).data).digest()


class Halo:
    """Communication with the owners of global ``nodes (m,)`` that this rank needs (collective)."""

    def __init__(self, space: Nodes, nodes: Ints):
        self._space, self._size = space, len(nodes)
        self._exchange = Exchange.to(space.comm, space.owner_of(nodes))
        (needed,) = self._exchange.send(nodes)
        self.needed: Ints = needed - space.first  # local numbers of the owned nodes that ranks need, with repetitions

    def take(self, values: Callable[[Ints], Array]) -> Array:
        """Values of the owners at the nodes ``(m, ...)``, from ``values`` at their local nodes ``(k,)``, rows of any shape (collective)."""
        (arrived,) = self._exchange.back(values(self.needed))
        out = np.empty((self._size, *arrived.shape[1:]), arrived.dtype)
        out[self._exchange.rows] = arrived
        return out

    def add(self, values: Array) -> Array:
        """Sums of ``values (m, k)`` of all ranks at their owners ``(n_owned, k)`` (collective)."""
        (arrived,) = self._exchange.send(values)
        return sums_of_rows(self.needed, arrived, self._space.n_owned)
