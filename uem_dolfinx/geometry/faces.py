"""Smooth faces of the surfaces of many bodies, in classes such that faces at a sharp edge belong to different classes."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.bodies import connected
from uem_dolfinx.geometry.skin import Skin
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced


def facets_by_class(skin: Skin, classes: Ints, count: int, which: Bools) -> list[Tag]:
    """Surfaces of some of this rank's facets ``(m,)``, one for each nonempty class of ``classes (m,)`` (collective)."""
    some = reduced(skin.config.comm, np.bincount(classes[which], minlength=count)) > 0
    return [surface_of(skin, which & (classes == k)) for k in np.flatnonzero(some)]


def surface_of(skin: Skin, which: Bools) -> Tag:
    """Some of this rank's facets ``(m,)`` as a surface."""
    return replace(skin.tag, entities=np.sort(skin.entities[which]))


def classes_of_facets(skin: Skin) -> tuple[Ints, int]:
    """A class for each facet of this rank ``(m,)``, and the number of classes (collective).

    Facets at a smooth edge belong to one class, two faces at a sharp edge to different classes. Faces get, one by one in the order
    of facet keys, the first class that no neighbouring face has. Only the list of faces that meet at sharp edges is known to all
    ranks. A face that meets itself at a sharp edge belongs to a single class nevertheless.
    """
    face, count = _faces(skin)
    first = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first, face, skin.keys)
    first = reduced(skin.config.comm, first, op=MPI.MIN)
    facet, side = np.nonzero(skin.edges.sharp & (skin.edges.across >= 0))
    meeting = np.unique(np.column_stack([face[facet], skin.values_at(skin.edges.across[facet, side], face)]), axis=0)
    meeting = np.concatenate(skin.config.comm.allgather(meeting))
    beside: list[set[int]] = [set() for _ in range(count)]
    for a, b in meeting[meeting[:, 0] != meeting[:, 1]].tolist():
        beside[a].add(b)
    given = np.full(count, -1)
    for one in np.argsort(first).tolist():
        taken = {int(given[other]) for other in beside[one]}
        given[one] = next(k for k in range(count) if k not in taken)
    return given[face], int(given.max(initial=0)) + 1


def _faces(skin: Skin) -> tuple[Ints, int]:
    """The smooth face of each facet of this rank ``(m,)``, numbered equally on all ranks, and their number (collective)."""
    n, begin = len(skin.dofs), skin.first[skin.config.comm.rank]
    facet, side = np.nonzero(~skin.edges.sharp & (skin.edges.across >= 0))
    other = skin.edges.across[facet, side]
    here = (other >= begin) & (other < begin + n)

    def shared(mine: Ints) -> Ints:
        """Numbers of the pieces of neighbouring facets on their ranks."""
        return np.column_stack([mine[facet], skin.values_at(other, mine)])

    return connected(skin.config.comm, n, np.column_stack([facet[here], other[here] - begin]), shared)
