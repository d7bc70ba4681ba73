"""Nodes given by tags or by coordinates, on any rank."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import surface_nodes
from uem_dolfinx.geometry.tags import as_tag, name_of
from uem_dolfinx.parallel import gathered, reduced

#: A node is at a position if it is nearer than this part of the distance of the second nearest node.
#: [convention; distance of the second node; test_places.py::test_how_near_a_node_must_be]
NEAR = 1e-3
#: Positions that differ by less are equal: nodes there cannot be distinguished. [bound; the model's size; -]
COINCIDENT = 1e-9


def is_point(where: Any) -> bool:
    """Whether a place is given by coordinates, not by a part of the mesh."""
    try:
        numbers = np.asarray(where, dtype=float)
    except (TypeError, ValueError):
        return False
    return numbers.ndim == 1 and not (isinstance(where, np.ndarray) and where.dtype.kind in "iu")


def nodes_at(config: Configuration, where: Any, role: str, dims: Sequence[int] | None = None) -> Indices:
    """Owned nodes of a part of the mesh, or the node at a point if this rank owns it ``(n,)`` (collective).

    Args:
        config: configuration of the displacement.
        where: a tag of any dimension, ``(meshtags, value)``, a list of these, or reference coordinates ``(gdim,)``.
        role: description of the place in messages.
        dims: dimensions that a tag may have; None for any.

    Raises:
        TagError: if the part is empty or invalid.
        InputError: if no node is at the point, with the nearest node.
    """
    if is_point(where):
        return _node_at(config, given.vector(role, where, config.gdim), role)
    tdim = config.tdim
    return surface_nodes(config, as_tag(where, config.mesh, dims or (tdim - 1, *range(tdim + 1)), role))


def described(where: Any) -> str:
    """A place in messages."""
    return given.shown(tuple(np.asarray(where, dtype=float).tolist())) if is_point(where) else f"'{name_of(where)}'"


def _node_at(config: Configuration, point: Array, role: str) -> Indices:
    distance = np.linalg.norm(config.X[: config.n_owned] - point, axis=1)
    # the two nearest nodes are among the two nearest of each rank
    nearest = np.argsort(distance, kind="stable")[:2]
    offers = np.full((2, 1 + config.gdim), np.inf)
    offers[: len(nearest)] = np.column_stack([distance[nearest], config.X[nearest]])
    every = gathered(config.comm, offers).reshape(-1, 1 + config.gdim)
    first, second = np.argsort(every[:, 0], kind="stable")[:2]
    if every[second, 0] <= COINCIDENT * config.size:
        raise InputError(
            f"{role} = {described(point)}: several nodes are there, of bodies that touch; give a tag of the point of one body"
        )
    if not every[first, 0] <= NEAR * every[second, 0]:
        place = ", ".join(f"{x:.6g}" for x in every[first, 1:])
        raise InputError(
            f"{role} = {described(point)}: no node is there, the nearest one is {every[first, 0]:.3g} away at ({place}): give the "
            "reference position of a node, or a tag of a point"
        )
    return nearest[:1].astype(np.int32) if first // 2 == config.comm.rank else np.zeros(0, dtype=np.int32)


def global_nodes(config: Configuration, nodes: Indices) -> Ints:
    """Global numbers of the owned nodes of all ranks, on every rank ``(n,)`` (collective)."""
    return np.concatenate(config.comm.allgather(config.to_global(nodes)))


def partners(config: Configuration, points: Array, nodes: Indices) -> tuple[Ints, Array, Array]:
    """The nearest of some nodes at each point (collective).

    The nodes' positions are gathered on all ranks, since they belong to a surface only.

    Args:
        config: configuration of the displacement.
        points: of this rank ``(n, gdim)``.
        nodes: owned nodes.

    Returns:
        Global numbers of the nearest nodes ``(n,)``, their distances, and the distances of the second nearest ones ``(n,)``.
    """
    from scipy.spatial import cKDTree

    numbers = global_nodes(config, nodes)
    places = np.concatenate(config.comm.allgather(config.X[nodes]))
    if not len(points):
        return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    distance, which = cKDTree(places).query(points, k=2)
    return numbers[which[:, 0]], distance[:, 0], distance[:, 1]


def middle_of(config: Configuration, nodes: Indices) -> Array:
    """Mean position of the owned nodes of all ranks ``(gdim,)`` (collective)."""
    sums = reduced(config.comm, np.append(config.X[nodes].sum(axis=0), float(len(nodes))), op=MPI.SUM)
    return np.asarray(sums[:-1] / sums[-1])
