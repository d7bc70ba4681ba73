"""Kinds of interfaces, of ties and of heat flows that a contact's laws ask for; they are imported where they are used."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from uem_dolfinx.arrays import Indices
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.placement import Discretisation
from uem_dolfinx.errors import InputError

if TYPE_CHECKING:
    from uem_dolfinx.contact.thermal.heat import Heat
    from uem_dolfinx.contact.ties.tie import Tie


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
    return partial(kind, law=law, contact=contact)


def heats_of_kind(contact: Any) -> list[Heat]:
    """Heat flows of a contact, hard or soft; see ``thermal.heat.heats_of`` (collective)."""
    from uem_dolfinx.contact.thermal import heat, soft_heat

    kind = heat.Heat if contact.normal is None else soft_heat.SoftHeat
    return heat.heats_of(contact.pair, contact.heats, contact, kind)


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
