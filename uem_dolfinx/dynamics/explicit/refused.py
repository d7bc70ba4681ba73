"""What does not go with explicit steps, refused by name before any work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.contact.laws.stribeck import ViscousFriction
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.errors import InputError


def refuse_unsupported(dynamics: Any, contacts: Any, others: Mapping[str, Any]) -> None:
    """Refuse arguments of a problem whose dynamics are explicit and do not go with them (its caller makes the ranks agree).

    Args:
        dynamics: of the problem, or None.
        contacts: as declared.
        others: further arguments of the problem by name, refused unless empty or False.

    Raises:
        InputError: with the argument, the reason and a remedy.
    """
    if not is_explicit(dynamics):
        return
    remedy = "leave it out, or take an implicit scheme, as uem.newmark()"
    massy = dynamics.contactors == "massy"
    for name, value in others.items():
        if value and name in ("equations", "couplings") and not massy:
            raise InputError(f"{name} need nodes with mass to go with CentralDifferences: take Dynamics(..., contactors='massy')")
        if value and name not in ("equations", "couplings"):
            raise InputError(f"{name} does not go with CentralDifferences: {remedy}")
    for one in others.get("couplings", ()):
        if getattr(one, "mass", 0.0) or np.any(getattr(one, "inertia", 0.0)):
            raise InputError(
                f"the mass of the RigidCoupling of '{one.name}' does not go with CentralDifferences, which lump masses at nodes: give its "
                "part more density, or take an implicit scheme, as uem.newmark()"
            )
        if getattr(one, "stiffness", 0.0):
            raise InputError(
                f"the stiffness of a {one.name} does not go with CentralDifferences, whose critical step does not count it: {remedy}"
            )
    if not dynamics.mass.diagonal:
        raise InputError(
            "CentralDifferences divide forces by masses: expected a lumped mass; make it by uem.lumped_mass(V, density)"
        )
    for contact in contacts:
        name = f"contact '{contact.name}'"
        if isinstance(contact, GeneralContact) and not massy:
            raise InputError(
                f"{name}: GeneralContact, whose surfaces may keep mass, does not go with CentralDifferences and massless contactors: "
                "take Dynamics(..., contactors='massy'), or name each contact"
            )
        if getattr(contact, "tied", False) and not massy:
            raise InputError(
                f"{name} is tied, and needs nodes with mass to go with CentralDifferences: take Dynamics(..., contactors='massy')"
            )
        if getattr(contact, "heats", ()):
            raise InputError(f"{name} conducts heat, which does not go with CentralDifferences: {remedy}")
        friction = getattr(contact, "friction", None)
        for law in friction.values() if isinstance(friction, Mapping) else (friction,):
            if isinstance(law, ViscousFriction):
                raise InputError(f"{name} has friction = {law!r}, which does not go with CentralDifferences: {remedy}")
        for what in ("corners", "normal", "cohesion", "leak", *(() if isinstance(contact, GeneralContact) else ("edges",))):
            if law := getattr(contact, what, None):
                raise InputError(f"{name} has {what} = {law!r}, which does not go with CentralDifferences: {remedy}")
