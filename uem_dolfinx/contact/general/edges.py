"""Edges of a general contact: which edges of which bodies may meet, and the contacts at their crossings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.contact.further.part import LISTS, OfCrossings
from uem_dolfinx.contact.general.parts import BodiesContact
from uem_dolfinx.geometry.edge_crossings import Crossings, SharpLines
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.geometry.neighbours import Neighbours


class EdgeContact(OfCrossings, BodiesContact):
    """Part of a general contact: nodes on sharp edges, each with one crossing of its edge with another edge."""

    def __init__(self, neighbours: Neighbours, crossings: Crossings, number: int, **options: Any):
        super().__init__(neighbours.skin.tag, neighbours.skin.tag, coupling=OfCrossings.kind, **options)
        self._crossings, self._number, self._order = crossings, number, neighbours.number


def crossings_of(neighbours: Neighbours, overlap: float, ridges: bool = False) -> Crossings | None:
    """Crossings of edges; None unless two bodies, or one that may touch itself, have any in 3D (collective).

    Nodes follow the bodies later in the order, and in one body the edges with larger keys; ``ridges`` as for ``Crossings``.
    """
    skin, place, itself = neighbours.skin, neighbours.place, neighbours.itself
    if skin.config.gdim < 3:
        return None
    lines = SharpLines(skin)
    body = skin.body[lines.facet]
    with_edges = reduced(skin.config.comm, np.bincount(body, minlength=skin.n_bodies) > 0, op=MPI.LOR)
    if with_edges.sum() < 2 and not (with_edges & itself).any():
        return None
    sets = [facets[lines.facet] for _, a, _, b in neighbours.apart for facets in (a, b)]
    keys = np.column_stack([*sets, lines.keys, place[body], body]).astype(np.int64)

    def meet(one: Ints, other: Ints) -> Bools:
        own: Bools = (one[:, -1] == other[:, -1]) & itself[one[:, -1]] & (one[:, -3] < other[:, -3])
        may: Bools = (one[:, -2] < other[:, -2]) | own
        for k in range(0, one.shape[1] - 3, 2):
            a, b = (part[:, k : k + 2] > 0 for part in (one, other))
            may &= ~((a[:, 0] & b[:, 1]) | (a[:, 1] & b[:, 0]))
        return may

    return Crossings(lines, lines, (keys, keys), meet, overlap, LISTS, ridges)


def edge_contacts(neighbours: Neighbours, crossings: Crossings, name: str, options: dict[str, Any]) -> Sequence[EdgeContact]:
    """Contacts at crossings of edges, one for each crossing that a node may have (collective)."""
    return [
        EdgeContact(neighbours, crossings, k, name=f"{name} at edges" + f" {k + 1}" * (k > 0), **options) for k in range(LISTS)
    ]
