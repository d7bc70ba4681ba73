"""Bodies as the cells connect them, and their rigid motions."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import reduced


def rigid_velocities(arm: Array) -> Array:
    """Velocities of points at ``arm (n, gdim)`` from a pole in the modes of a rigid body ``(n, n_modes, gdim)``.

    Translations first, then the linearised rotations in the planes xy, xz and yz.
    """
    n, g = arm.shape
    shifts = np.broadcast_to(np.eye(g), (n, g, g))
    turns = []
    for i in range(g):
        for j in range(i + 1, g):
            v = np.zeros_like(arm)
            v[:, i], v[:, j] = -arm[:, j], arm[:, i]
            turns.append(v)
    return np.concatenate([shifts, np.stack(turns, axis=1)], axis=1)


_FOUND: WeakKeyDictionary[Nodes, tuple[Ints, int]] = WeakKeyDictionary()


def find_bodies(nodes: Nodes) -> tuple[Ints, int]:
    """Bodies as the cells connect them: the body of each local node ``(n_local,)`` and their number (collective; found once).

    Every rank labels its own pieces; only the list of pieces that share nodes across ranks is known to all.
    """
    if nodes not in _FOUND:
        _FOUND[nodes] = _find_bodies(nodes)
    return _FOUND[nodes]


def _find_bodies(nodes: Nodes) -> tuple[Ints, int]:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    comm, cells = nodes.comm, compat.cell_dofs(nodes.V)
    pairs = np.column_stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(nodes.n_local,) * 2)
    n_pieces, piece = connected_components(graph, directed=False)
    if comm.size == 1:
        return piece.astype(np.int64), int(n_pieces)
    sizes = comm.allgather(n_pieces)
    mine = piece + sum(sizes[: comm.rank])
    label = fem.Function(nodes.V)
    view = label.x.array.reshape(-1, nodes.block)
    view[:, 0] = mine
    label.x.scatter_forward()
    links = np.unique(np.column_stack([mine, view[:, 0].astype(np.int64)]), axis=0)
    links = np.concatenate(comm.allgather(links))
    total = sum(sizes)
    count, body = connected_components(coo_matrix((np.ones(len(links)), links.T), shape=(total, total)), directed=False)
    return body[mine].astype(np.int64), int(count)


def body_sums(comm: MPI.Comm, values: Array, body: Ints, count: int) -> Array:
    """Sums of nodal values ``(n, ...)`` over the bodies ``(n,)`` of the nodes, over all ranks ``(count, ...)`` (collective)."""
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, body, values)
    return np.asarray(reduced(comm, out))
