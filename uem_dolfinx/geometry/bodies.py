"""Bodies as the cells connect them, and their rigid motions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.geometry.nodes import Nodes, described
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


def rotations(sums: Array) -> Array:
    """Rotations that turn vectors a nearest to vectors b, from ``sums`` of ``b a'``, ``(k, g, g)``."""
    left, _, right = np.linalg.svd(sums)
    left[:, :, -1] *= np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)[:, None]
    return np.asarray(left @ right)


def middle(comm: MPI.Comm, places: Array) -> str:
    """Mean of the places ``(n, gdim)`` of all ranks, for error messages (collective)."""
    sums = reduced(comm, np.append(places.sum(axis=0), float(len(places))))
    return described(sums[:-1] / sums[-1])


_FOUND: WeakKeyDictionary[Nodes, tuple[Ints, int]] = WeakKeyDictionary()
#: Bodies of the cells of meshes, ghosts included, and their numbers: spaces on a mesh have the same bodies.
_OF_CELLS: WeakKeyDictionary[Any, tuple[Ints, int]] = WeakKeyDictionary()


def find_bodies(nodes: Nodes) -> tuple[Ints, int]:
    """Bodies as the cells connect them: the body of each local node ``(n_local,)`` and their number (collective; once for a mesh)."""
    if nodes not in _FOUND:
        cells = compat.cell_dofs(nodes.V)
        if nodes.mesh not in _OF_CELLS:
            body, count = _find_bodies(nodes, cells)
            _OF_CELLS[nodes.mesh] = body[cells[:, 0]], count
        of_cells, count = _OF_CELLS[nodes.mesh]
        body = np.zeros(nodes.n_local, np.int64)
        body[cells] = of_cells[:, None]
        _FOUND[nodes] = body, count
    return _FOUND[nodes]


def linked_bodies(nodes: Nodes, node: Indices, followed: Ints) -> tuple[Ints, int]:
    """As ``find_bodies``, with bodies as one between which there is a pair of an owned node and a global one ``(k,)`` (collective)."""
    body, count = find_bodies(nodes)
    there = nodes.ask_owners(followed, body[: nodes.n_owned, None].astype(float))[:, 0].astype(np.int64)
    pairs = np.unique(np.column_stack([body[node], there]), axis=0)
    n, group = _components(count, np.concatenate(nodes.comm.allgather(pairs)))
    return group[body], n


def _find_bodies(nodes: Nodes, cells: Indices) -> tuple[Ints, int]:
    label = fem.Function(nodes.V)
    view = label.x.array.reshape(-1, nodes.block)

    def shared(mine: Ints) -> Ints:
        """Numbers of the pieces of local nodes on the ranks of their owners."""
        view[:, 0] = mine
        label.x.scatter_forward()
        return np.column_stack([mine, view[:, 0].astype(np.int64)])

    return connected(nodes.comm, nodes.n_local, np.column_stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()]), shared)


def connected(comm: MPI.Comm, n: int, links: Ints, shared: Callable[[Ints], Ints]) -> tuple[Ints, int]:
    """What is connected over all ranks: the number of the component of each of n items of this rank ``(n,)``, and how many (collective).

    Every rank labels its own pieces; only the list of pieces that are connected across ranks is known to all.

    Args:
        comm: communicator.
        n: number of items of this rank.
        links: pairs of these ``(k, 2)``.
        shared: makes of the labels of this rank's items ``(n,)``, unlike those of other ranks, pairs of labels ``(l, 2)`` of items here
            and there that are connected; called on several ranks only (collective).
    """
    count, piece = _components(n, links)
    if comm.size == 1:
        return piece, count
    sizes = comm.allgather(count)
    mine = piece + sum(sizes[: comm.rank])
    count, whole = _components(sum(sizes), np.concatenate(comm.allgather(np.unique(shared(mine), axis=0))))
    return whole[mine], count


def _components(n: int, links: Ints) -> tuple[int, Ints]:
    """Number of components of a graph of n nodes with these ``links (k, 2)``, and that of each node ``(n,)``."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(links)), links.T), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    return int(count), label.astype(np.int64)


def bodies_in_order(nodes: Nodes) -> tuple[Ints, int]:
    """As ``find_bodies``, numbered in the order in which their cells come in the mesh's input (collective)."""
    body, count = find_bodies(nodes)
    n = nodes.mesh.topology.index_map(nodes.mesh.topology.dim).size_local
    of_cells, number = body[compat.cell_dofs(nodes.V)[:n, 0]], forms.original_cells(nodes.mesh)[:n]
    first = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first, of_cells[: len(number)], number)
    order = np.argsort(reduced(nodes.comm, first, op=MPI.MIN), kind="stable")
    return np.asarray(np.argsort(order)[body]), count


def body_sums(comm: MPI.Comm, values: Array, body: Ints, count: int) -> Array:
    """Sums of nodal values ``(n, ...)`` over the bodies ``(n,)`` of the nodes, over all ranks ``(count, ...)`` (collective)."""
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, body, values)
    return np.asarray(reduced(comm, out))


def carried_along(nodes: Nodes, body: Ints, count: int, before: Array, now: Array) -> Array:
    """Where nodes ``(n_local, gdim)`` would be had each body moved as one since ``before``, as far as it has, but rigidly (collective)."""
    own, g = slice(nodes.n_owned), before.shape[1]

    def means(values: Array) -> Array:
        sums = body_sums(nodes.comm, np.column_stack([values[own], np.ones(nodes.n_owned)]), body[own], count)
        return np.asarray(sums[:, :-1] / np.maximum(sums[:, -1:], 1.0))

    there, here = np.split(means(np.column_stack([before, now])), 2, axis=1)
    a, b = before - there[body], now - here[body]
    R = rotations(means((b[:, :, None] * a[:, None]).reshape(-1, g * g)).reshape(-1, g, g))
    return np.asarray(here[body] + np.einsum("nij,nj->ni", R[body], a))
