"""Kinds of interfaces, ties, heat flows and wear for the laws of a contact; they are imported where they are used."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import proxy

from uem_dolfinx.arrays import Indices
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.placement import Discretisation
from uem_dolfinx.errors import InputError

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.friction.wear import Wear
    from uem_dolfinx.contact.thermal.heat import Heat
    from uem_dolfinx.contact.ties.tie import Tie


class PartsOfPair(NamedTuple):
    """What the interface of a contact is made of, ``alone`` or with those of others; other attributes are its arguments."""

    alone: Callable[[], Interface]
    discretisation: Any
    friction: Sliding | None
    name: str
    max_penetration: float


def kind_of_interface(contact: Any, duration: Callable[[], float] | None) -> Callable[..., Interface]:
    """Class of a contact's interface: hard, soft, with cohesion, or with a fluid.

    Args:
        contact: as declared.
        duration: length of the present step, a time; None in statics.

    Raises:
        InputError: for a law of points, which have no areas, and for damping in statics.
    """
    law = contact.normal or contact.cohesion or contact.leak
    if law is None:
        return Interface
    if contact.contactor.dim == 0:
        raise InputError(f"contact '{contact.name}': {law!r} needs areas, and points have none: give facets")
    kind: Any
    if contact.normal is not None:
        from uem_dolfinx.contact.pair import soft

        if law.damping and duration is None:
            raise InputError(
                f"contact '{contact.name}': damping of {law!r} needs the speed of approach, and statics has none: give the problem "
                "dynamics and take time steps, or leave damping out"
            )
        kind = partial(soft.SoftInterface, duration=duration)
    elif contact.leak is not None:
        from uem_dolfinx.contact.pair import leaking

        kind = leaking.LeakingInterface
    else:
        from uem_dolfinx.contact.pair import adhesive, cohesive

        kind = cohesive.CohesiveInterface if contact.cohesion.bonds else adhesive.AdhesiveInterface
    # the contact has the pair
    return partial(kind, law=law, contact=proxy(contact))


def heats_of_kind(contact: Any, pair: Interface) -> list[Heat]:
    """Heat flows of a contact's interface, hard or soft; see ``thermal.heat.heats_of`` (collective)."""
    from uem_dolfinx.contact.thermal import heat, soft_heat

    kind = heat.Heat if contact.normal is None else soft_heat.SoftHeat
    return heat.heats_of(pair, contact.heats, contact, kind)


def wear_of(contact: Any, nodes: Indices) -> Wear:
    """Wear of a contact's contactors (collective)."""
    from uem_dolfinx.contact.friction import wear

    how: dict[str, Any] = {"tag": contact.contactor, "areas": contact.surface, "name": contact.name}
    return wear.Wear(contact.config, nodes, contact._wear, lower=lambda worn: contact._offsets_of_pair().wear(worn), **how)


def tie_of(contact: Any, nodes: Indices, discretisation: Discretisation, means: Any, **of: Any) -> Tie | None:
    """Permanent tie, or bonds, of a contact; ``means`` as in ``Tie``. None without."""
    reach = None if isinstance(contact.adjust, bool) else contact.adjust
    how: dict[str, Any] = {"means": means, "reach": reach, **of}
    if contact.cohesion is not None and contact.cohesion.bonds:
        from uem_dolfinx.contact.ties import bonds

        return bonds.Bonds(contact.config, nodes, discretisation, **how)
    if contact.tied:
        from uem_dolfinx.contact.ties import tie

        return tie.Tie(contact.config, nodes, discretisation, **how)
    return None
