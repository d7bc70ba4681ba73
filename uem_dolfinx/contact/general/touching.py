"""Results of general contact by pairs: which bodies touch, with which forces and moments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general.parts import BodiesContact
from uem_dolfinx.contact.results import Resultant, moments
from uem_dolfinx.geometry.skin import Skin


class Touch(NamedTuple):
    """Two bodies that touch, or a body and a rigid surface."""

    first: str  # name of the first body
    second: str  # name of the second body or rigid surface
    n_active: int  # number of active contactors
    force: Array  # on the first ``(gdim,)``


class Pair(NamedTuple):
    """Forces and heat between two bodies, or a body and a rigid surface."""

    touch: Touch  # names, number of contactors and force
    moment: Array  # moment on the first
    normal: float  # sum of the normal forces
    heat: float  # power from the first to the second in one field, without frictional heat


def sums_of_pairs(
    parts: Sequence[Contact], skin: Skin, names: Sequence[str], rigid: Sequence[str], centre: Array, field: int | None = None
) -> list[Pair]:
    """Sums over the contactors of each pair of bodies, sorted by their numbers in the mesh's input (collective).

    Args:
        parts: the parts of a general contact.
        skin: surfaces of the bodies.
        names: of the bodies ``(n_bodies,)``.
        rigid: names of the rigid surfaces, of every part.
        centre: point that moments are taken about ``(gdim,)``.
        field: field of the power; None for no power.
    """
    config, n = skin.config, skin.n_bodies + len(parts)
    g = config.gdim
    found: dict[tuple[int, int], Array] = {}
    for k, part in enumerate(parts):
        pair = part.pair
        # mortar rows also contain neighbouring contactors, active or not
        active = pair.trial.active
        heat = sum((one.power() for one in pair.heats if one.law.field == field), np.zeros(len(active)))
        i = np.flatnonzero(active | pair.trial.force.any(axis=1) | (heat != 0))
        across = pair.pressing()[0]
        second, x = np.full(len(i), skin.n_bodies + k), pair.points
        if isinstance(part, BodiesContact):
            second, x = part.opposite(skin)[i], part.acting_at()
        first, force = skin.body_of_node[pair.nodes[i]], config.of_circles(pair.trial.force[i])
        turning = moments(config.of_circles(x[i]) - centre, force)
        rows = np.column_stack([active[i], across[i], heat[i], force, turning])
        keys, inverse = np.unique(first * n + second, return_inverse=True)
        sums = np.zeros((len(keys), rows.shape[1]))
        np.add.at(sums, inverse.ravel(), rows)
        for key, row in (item for own in config.comm.allgather(list(zip(keys.tolist(), sums))) for item in own):
            a, b = divmod(key, n)
            # nodes of both bodies may be contactors
            a, b, sign = (a, b, 1.0) if a <= b else (b, a, -1.0)
            found[a, b] = found.get((a, b), 0.0) + row * np.where(np.arange(len(row)) < 2, 1.0, sign)
    called = [*names, *rigid]
    of = ((called[a], called[b], row) for (a, b), row in sorted(found.items()))
    return [Pair(Touch(a, b, int(row[0]), row[3 : 3 + g]), row[3 + g :], float(row[1]), float(row[2])) for a, b, row in of]


def _whole_name(one: Any, names: Sequence[str]) -> Any:
    """A name with the number of the rigid surface, if it is that of one surface alone and was given without."""
    found = [name for name in names if name.rpartition(" ")[0] == one]
    return found[0] if one not in names and len(found) == 1 else one


def between(
    pairs: Sequence[Pair], names: Sequence[str], first: str, second: str | None, nothing: Resultant
) -> tuple[Resultant, float]:
    """Force and moment on a body from another one, None for all others, and the power that flows there; InputError for other names."""
    first, second = (_whole_name(one, names) for one in (first, second))
    given.word("first", first, names)
    if second is not None:
        given.word("second", second, names)
    total, power = nothing, 0.0
    for (a, b, _, force), moment, normal, heat in pairs:
        if first in (a, b) and second in (None, b if first == a else a):
            sign = 1.0 if first == a else -1.0
            total = Resultant(total.force + sign * force, total.moment + sign * moment, total.normal + normal)
            power += sign * heat
    return total, power
