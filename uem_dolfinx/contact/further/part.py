"""Further parts of a contact, with contactors and equations of their own: corners of its target, and edges that cross."""

from __future__ import annotations

from typing import Any
from weakref import ref

from uem_dolfinx.contact.contact import Contact


def _of_contact(name: str) -> property:
    """An attribute that is always that of the contact; values set on its part have no effect."""
    return property(lambda part: getattr(part._contact, name), lambda part, value: None)


class FurtherPart(Contact):
    """Part of a contact; the contact tells its results.

    Args:
        of: the contact, attached to a problem.
        what: for its name.
        order: see ``Traits``, of all parts of the contact.
        how: arguments of ``Contact`` in place of those of the contact.
    """

    is_further_part = True
    #: Corners are contactors themselves, and contactors pass ends regularly.
    sees_corners = watches_ends = False

    def __init__(self, of: Contact, what: str, order: int, **how: Any):
        same = {name: getattr(of, name) for name in ("sliding", "normals", "max_penetration", "friction", "offset", "measure")}
        # the contact refers to its part
        self._of, self._order = ref(of), order
        sides = {"contactor": of.contactor, "target": of.target}
        super().__init__(**(sides | same | how), name=f"{of.name}, {what}", corners=False, edges=False)

    @property
    def _contact(self) -> Contact:
        of = self._of()
        assert of is not None
        return of

    _friction: Any = _of_contact("_friction")
    _offset: Any = _of_contact("_offset")

    def edges_that_meet(self) -> None:
        """None, since the contact itself looks at them."""

    def share(self) -> None:
        """Decide which nodes of the other parts are left to this one (collective)."""
        raise NotImplementedError
