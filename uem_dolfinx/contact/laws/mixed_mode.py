"""Mixed modes of fracture: how much energy and strength a cohesive surface has between opening and shear.

The share B of the shear is 0 in pure opening, 1 in pure shear.
"""

from __future__ import annotations

from typing import Any, Protocol

from uem_dolfinx import given


class MixedMode(Protocol):
    """A value between that of pure opening and that of pure shear."""

    def between(self, opening: float, shear: float, share: Any) -> Any:
        """The energy per area, or half the square of the strength over the stiffness, at shares of shear ``(n,)``, which may be complex.

        Args:
            opening: value in pure opening.
            shear: value in pure shear.
            share: part of the shear in the square of the opening ``(n,)``.
        """


class BenzeggaghKenane(given.Sealed):
    """``G = G_1 + (G_2 - G_1) B^eta`` [Benzeggagh, Kenane, Composites Science and Technology 56 (1996) 439-449].

    Args:
        eta: exponent, 1 or more; 1.5 to 3 for layered composites.

    Raises:
        InputError, InputTypeError: for an exponent below 1.
    """

    def __init__(self, eta: float):
        self.eta = given.number("eta", eta, AT_LEAST_ONE)

    def __repr__(self) -> str:
        """With its exponent."""
        return f"BenzeggaghKenane({self.eta:g})"

    def between(self, opening: float, shear: float, share: Any) -> Any:
        """See ``MixedMode``."""
        return opening + (shear - opening) * share**self.eta


class Power(given.Sealed):
    """``(G_I / G_1)^a + (G_II / G_2)^a = 1`` for the parts G_I = (1 - B) G and G_II = B G.

    Args:
        a: exponent, 1 or more.

    Raises:
        InputError, InputTypeError: for an exponent below 1.
    """

    def __init__(self, a: float):
        self.a = given.number("a", a, AT_LEAST_ONE)

    def __repr__(self) -> str:
        """With its exponent."""
        return f"Power({self.a:g})"

    def between(self, opening: float, shear: float, share: Any) -> Any:
        """See ``MixedMode``."""
        return (((1.0 - share) / opening) ** self.a + (share / shear) ** self.a) ** (-1.0 / self.a)


AT_LEAST_ONE = given.Range("a number of 1 or more", lambda x: x >= 1)
