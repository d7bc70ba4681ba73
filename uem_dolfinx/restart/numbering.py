"""The input order of a mesh, in which checkpoints are written and read, since partitions differ between runs."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import AnyArray, Ints
from uem_dolfinx.errors import CheckpointError
from uem_dolfinx.files import as_bytes
from uem_dolfinx.parallel import Exchange, agree

#: Rows of a table that are hashed together; every rank holds whole chunks, so that the hash does not depend on the number of ranks.
#: [format; rows; -]
CHUNK = 1024
#: Length of a hash. [format; bytes; -]
DIGEST = 16


class Numbering:
    """Positions of this rank's rows in a table of all ranks, in the order of partition-independent keys (the constructor is collective).

    ``keys (n,)`` of this rank's rows are unique on all ranks and below ``bound``.

    Attributes:
        place: of each row in the table ``(n,)``.
        total: number of rows in the table.
        first: first row in this rank's part of the table.
        count: number of rows in it.

    Raises:
        CheckpointError: if two rows have the same key.
    """

    def __init__(self, comm: MPI.Comm, keys: Ints, bound: int):
        self.comm, size, rank = comm, comm.size, comm.rank
        meeting = Exchange.to(comm, keys * size // max(bound, 1))
        (met,) = meeting.send(keys)
        distinct, order = np.unique(met, return_inverse=True)
        unknown = "the mesh has no numbering of an input, like all meshes that are made from other meshes"
        twice = len(distinct) < len(order)
        agree(comm, CheckpointError(f"{unknown}: keep Functions on the mesh that was read") if twice else None)
        first = np.cumsum([0, *comm.allgather(len(distinct))])
        self.place: Ints = np.empty(len(keys), dtype=np.int64)
        (self.place[meeting.rows],) = meeting.back(first[rank] + order.ravel())
        self.total = int(first[-1])
        chunks = -(-self.total // CHUNK)
        bounds = np.minimum(CHUNK * (chunks * np.arange(size + 1) // size), self.total)
        self.first, self.count = int(bounds[rank]), int(bounds[rank + 1] - bounds[rank])
        holder = np.searchsorted(bounds, self.place, side="right") - 1
        self._exchange = Exchange.to(comm, holder)
        (self._received,) = self._exchange.send(self.place - bounds[holder])

    def to_table(self, rows: AnyArray) -> AnyArray:
        """This rank's part of the table ``(count, ...)`` from the rows ``(n, ...)`` of all ranks (collective)."""
        part = np.empty((self.count, *rows.shape[1:]), dtype=rows.dtype)
        (part[self._received],) = self._exchange.send(rows)
        return part

    def from_table(self, part: AnyArray) -> AnyArray:
        """This rank's rows ``(n, ...)`` from the parts ``(count, ...)`` of the table on all ranks (collective)."""
        rows = np.empty((len(self.place), *part.shape[1:]), dtype=part.dtype)
        (rows[self._exchange.rows],) = self._exchange.back(part[self._received])
        return rows


def n_cells(mesh: Any) -> int:
    """Number of cells over all ranks."""
    return int(mesh.topology.index_map(mesh.topology.dim).size_global)


def node_numbering(V: Any) -> Numbering:
    """Numbering of a space's owned nodes (blocks of d.o.f.), by their first cell in the input (collective).

    The order of a cell's vertices is the same in every partition, and so is the order of its nodes if edges and facets have at most one
    inner node each. Otherwise it depends on global numbers of vertices. So only Lagrange spaces of degree 1 or 2, discontinuous Lagrange
    and quadrature spaces are supported, with values of any shape; others raise a CheckpointError.
    """
    comm, index_map, cells = V.mesh.comm, V.dofmap.index_map, compat.cell_dofs(V)
    found, error = compat.element_family(V), None
    if found is None or (found[0] == "Lagrange" and found[1] > 2):
        error = CheckpointError(
            f"a checkpoint cannot hold a Function of {V.ufl_element()}: expected Lagrange of degree 1 or 2, discontinuous Lagrange "
            "or quadrature spaces; interpolate into one of them"
        )
    agree(comm, error)
    owned, k = index_map.size_local, V.dofmap.dof_layout.num_dofs
    keys = np.full(owned + index_map.num_ghosts, np.iinfo(np.int64).max)
    np.minimum.at(keys, cells, forms.original_cells(V.mesh)[:, None] * k + np.arange(cells.shape[1]))
    # the first cell may not exist on the rank that owns the node
    starts = np.array(comm.allgather(index_map.local_range[0]))
    ghosts = index_map.local_to_global(np.arange(owned, len(keys), dtype=np.int32)).astype(np.int64)
    owner = np.searchsorted(starts, ghosts, side="right") - 1
    nodes, key = Exchange.to(comm, owner).send(ghosts - starts[owner], keys[owned:])
    np.minimum.at(keys, nodes, key)
    return Numbering(comm, keys[:owned], k * n_cells(V.mesh))


def mesh_fingerprint(mesh: Any) -> str:
    """Hash of every cell's nodes in the input and of their coordinates to the last bit, the same in every partition (collective)."""
    n = mesh.topology.index_map(mesh.topology.dim).size_local
    nodes = compat.geometry_dofs(mesh)[:n]
    cells = Numbering(mesh.comm, forms.original_cells(mesh)[:n], n_cells(mesh))
    given = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    return fingerprint(mesh.comm, [hashes(cells.to_table(values[nodes])) for values in (given, mesh.geometry.x)])


def hashes(part: AnyArray) -> list[bytes]:
    """Hash of every chunk in this rank's part of a table."""
    chunks = range(0, len(part), CHUNK)
    return [blake2b(as_bytes(part[i : i + CHUNK]).data, digest_size=DIGEST).digest() for i in chunks]


def fingerprint(comm: MPI.Comm, tables: list[list[bytes]]) -> str:
    """One hash of several tables from the hashes of their chunks, the same for any number of ranks (collective)."""
    parts = comm.gather(tables) or []
    text = b"".join(h for table in zip(*parts) for rank in table for h in rank)
    return str(comm.bcast(blake2b(text, digest_size=DIGEST).hexdigest()))
