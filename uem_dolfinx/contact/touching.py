"""Results of general contact by pairs: which bodies touch, with which forces and moments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general_parts import BodiesContact
from uem_dolfinx.contact.results import moments
from uem_dolfinx.geometry.skin import Skin


class Touch(NamedTuple):
    """Two bodies that touch, or a body and a rigid surface.

    Attributes:
        first: name of the one.
        second: name of the other.
        n_active: number of contactors that touch.
        force: on the first ``(gdim,)``.
    """

    first: str
    second: str
    n_active: int
    force: Array


def forces_of_pairs(
    parts: Sequence[Contact], skin: Skin, names: Sequence[str], rigid: Sequence[str], centre: Array
) -> list[tuple[Touch, Array]]:
    """Bodies that touch, each with the moment on the first, sorted by their numbers in the mesh's input (collective).

    Args:
        parts: the contacts that a general contact consists of.
        skin: surfaces of the bodies.
        names: of the bodies ``(n_bodies,)``.
        rigid: names of the rigid surfaces, of every part.
        centre: point that moments are taken about ``(gdim,)``.
    """
    config, n = skin.config, skin.n_bodies + len(parts)
    g = config.gdim
    found: dict[tuple[int, int], Array] = {}
    for k, part in enumerate(parts):
        pair = part.pair
        # rows of mortar have the contactors around their own in them, active or not
        active = pair.trial.active
        i = np.flatnonzero(active | pair.trial.force.any(axis=1))
        second = np.full(len(i), skin.n_bodies + k)
        if isinstance(part, BodiesContact):
            second = part.opposite(skin)[i]
        first, force = skin.body_of_node[pair.nodes[i]], config.of_circles(pair.trial.force[i])
        rows = np.column_stack([active[i], force, moments(config.of_circles(pair.points[i]) - centre, force)])
        keys, inverse = np.unique(first * n + second, return_inverse=True)
        sums = np.zeros((len(keys), rows.shape[1]))
        np.add.at(sums, inverse.ravel(), rows)
        for key, row in (item for own in config.comm.allgather(list(zip(keys.tolist(), sums))) for item in own):
            a, b = divmod(key, n)
            # nodes of either of two bodies may follow the other
            a, b, sign = (a, b, 1.0) if a <= b else (b, a, -1.0)
            found[a, b] = found.get((a, b), 0.0) + row * np.where(np.arange(len(row)) == 0, 1.0, sign)
    called = [*names, *rigid]
    return [(Touch(called[a], called[b], int(row[0]), row[1 : 1 + g]), row[1 + g :]) for (a, b), row in sorted(found.items())]
