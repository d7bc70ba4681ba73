"""Cohesion: tractions between points that faced each other at the start, by their opening, until they are separated.

The equivalent opening ``d = |w+|`` is the length of the opening without its compressive part, and B its share of shear. Up to the onset
the traction is ``K w+``, then it softens, ``(1 - D) K w+`` with a damage D that only grows:

    D(d, B) = 1 - t(d) / (K d),      t(d): softening of strength(B) and energy(B)

as in Turon, Camanho, Costa, Davila, Mechanics of Materials 38 (2006) 1072-1089. Derivatives of D are taken with a complex step, exact
to rounding. Unloading returns to the origin, or, plastic, with the stiffness K to a permanent opening.

Mixed modes of fracture: how much energy and strength a cohesive surface has between opening and shear.

The share B of the shear is 0 in pure opening, 1 in pure shear.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError


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


AT_LEAST_ONE = given.Range("a finite number of 1 or more", lambda x: 1 <= x < np.inf)


#: The strength that is left under plastic unloading is found by so many of Newton's steps, which converge monotonically.
#: [bound; iterations; -]
ITERATIONS = 30


class ExponentialSoftening:
    """``t = strength exp(-(w - w_0) / l)`` from the onset w_0 on, with ``l = energy / strength - w_0 / 2``.

    In plastic openings it is ``strength exp(-w_p strength / energy)``.
    """

    def softening(self, w: Any, strength: Any, energy: Any, stiffness: float) -> Any:
        """See ``Softening``."""
        onset = strength / stiffness
        return strength * np.exp(-(w - onset) / (energy / strength - 0.5 * onset))

    def left(self, trial: Any, strength: Any, energy: Any, stiffness: float, before: Any) -> Any:
        """See ``Softening``."""
        a, begin = stiffness * energy / strength, np.log(np.maximum(before.real, np.finfo(float).tiny))
        z = begin + 0.0 * trial
        for _ in range(ITERATIONS):
            e = strength * np.exp(z)
            z = z - (e - a * (z - begin) - trial) / (e - a)
        return np.exp(z)


class Bilinear:
    """``t = strength (w_f - w) / (w_f - w_0)`` from the onset w_0 to the largest opening ``w_f = 2 energy / strength``."""

    def softening(self, w: Any, strength: Any, energy: Any, stiffness: float) -> Any:
        """See ``Softening``."""
        last = 2.0 * energy / strength
        t = strength * (last - w) / (last - strength / stiffness)
        return np.where(w.real < last.real, t, 0.0)

    def left(self, trial: Any, strength: Any, energy: Any, stiffness: float, before: Any) -> Any:
        """See ``Softening``."""
        slope = 2.0 * stiffness * energy / strength
        q = (slope * before - trial) / (slope - strength)
        return np.where(q.real > 0.0, q, 0.0)


#: Stiffness before damage, without one given: so many times the least at which the law can soften, strength^2 / (2 energy).
#: [convention; the least stiffness; test_cohesive_laws.py::test_the_stiffness_before_damage]
STIFFER = 100.0
#: Length of a complex step, over the quantity: its square is below rounding. [format; the quantity; -]
COMPLEX_STEP = np.finfo(float).eps ** 2


class Softening(Protocol):
    """Softening beyond the onset; functions of complex arrays ``(n,)``, analytic between their kinks."""

    def softening(self, w: Any, strength: Any, energy: Any, stiffness: float) -> Any:
        """Equivalent tractions at equivalent openings beyond the onset ``(n,)``, so that a full separation takes ``energy``."""

    def left(self, trial: Any, strength: Any, energy: Any, stiffness: float, before: Any) -> Any:
        """Part of the strength that is left after a trial traction beyond it, with plastic unloading; ``before``: of the last step."""


class Response(NamedTuple):
    """Tractions on openings."""

    traction: Array  # that resists the opening, per area ``(n, gdim)``
    tangent: Array  # its derivative by the opening ``(n, gdim, gdim)``
    secant: Array  # stiffness without growth of the damage, positive ``(n, gdim, gdim)``
    damage: Array  # 0 to 1 ``(n,)``
    delayed: Array  # damage that acts, behind ``damage`` by the viscosity ``(n,)``
    permanent: Array  # plastic opening ``(n, gdim)``


SOFTENINGS: dict[str, type[Softening]] = {"bilinear": Bilinear, "exponential": ExponentialSoftening}


class Cohesive(given.Sealed):
    """Cohesion of two surfaces, with a strength and an energy per area of full separation.

        uem.Cohesive(strength=30e6, energy=260.0)
        uem.Cohesive(30e6, 260.0, shear_strength=60e6, shear_energy=1000.0, mixed=uem.BenzeggaghKenane(2.1))

    Args:
        strength: largest traction in opening, a force per area.
        energy: of a full separation in opening, the critical energy release rate, an energy per area.
        shear_strength: largest traction in shear; None is ``strength sqrt(shear_energy / energy)``, with which the share of shear of a
            cohesive zone is that of the crack [Turon et al., Engineering Fracture Mechanics 77 (2010) 2506-2520].
        shear_energy: of a full separation in shear; None is ``energy``.
        mixed: a law between the two, ``BenzeggaghKenane`` or ``Power``; None if both have the same values.
        law: ``"bilinear"`` or ``"exponential"`` softening.
        unloading: ``"origin"``, elastic with the damaged stiffness, or ``"plastic"``, with the initial stiffness to a permanent opening.
        stiffness: before damage, a traction over a length; None is 100 times the least, ``strength^2 / (2 energy)``.
        viscosity: time, in statics part of the load factor, by which damage is delayed; helps where equilibrium jumps.

    Raises:
        InputError, InputTypeError: for numbers out of their range, a stiffness below twice the least, two modes without ``mixed``, or
            a viscosity with plastic unloading.
    """

    bonds = True  #: Whether surfaces are bonded point to point.

    def __init__(
        self,
        strength: float,
        energy: float,
        *,
        shear_strength: float | None = None,
        shear_energy: float | None = None,
        mixed: MixedMode | None = None,
        law: str = "bilinear",
        unloading: str = "origin",
        stiffness: float | None = None,
        viscosity: float = 0.0,
    ):
        s, G = (given.number(name, v, given.POSITIVE) for name, v in (("strength", strength), ("energy", energy)))
        tough = G if shear_energy is None else given.number("shear_energy", shear_energy, given.POSITIVE)
        usual = s * float(np.sqrt(tough / G))
        hard = usual if shear_strength is None else given.number("shear_strength", shear_strength, given.POSITIVE)
        if mixed is None and (hard, tough) != (s, G):
            raise InputError("mixed = None with other values in shear: expected BenzeggaghKenane(eta) or Power(a)")
        if mixed is not None:
            given.kind("mixed", mixed, hasattr(mixed, "between"), "BenzeggaghKenane(eta) or Power(a)")
        self.strength, self.energy, self.shear_strength, self.shear_energy, self.mixed = s, G, hard, tough, mixed
        self.law, self.unloading = (
            given.word("law", law, tuple(SOFTENINGS)),
            given.word("unloading", unloading, ("origin", "plastic")),
        )
        least = max(s**2 / G, hard**2 / tough) / 2.0
        self.stiffness = STIFFER * least if stiffness is None else given.number("stiffness", stiffness, given.POSITIVE)
        self.viscosity = given.number("viscosity", viscosity, given.NOT_NEGATIVE)
        if self.stiffness <= 2.0 * least:
            raise InputError(
                f"stiffness = {self.stiffness:g} is too small: the surface cannot soften below strength^2 / energy, {2.0 * least:g}"
            )
        if viscosity and unloading == "plastic":
            raise InputError("viscosity does not go with unloading = 'plastic': leave one of them out")
        self._softening = SOFTENINGS[self.law]()

    def __repr__(self) -> str:
        """All of its numbers."""
        shear = "" if self.mixed is None else f", {self.shear_strength:g}, {self.shear_energy:g}, {self.mixed!r}"
        rest = f"{self.law}, {self.unloading}, stiffness={self.stiffness:g}, viscosity={self.viscosity:g}"
        return f"Cohesive({self.strength:g}, {self.energy:g}{shear}, {rest})"

    def _modes(self, share: Any) -> tuple[Any, Any]:
        """Strengths and energies at shares of shear ``(n,)``, which may be complex."""
        if self.mixed is None:
            return self.strength + 0.0 * share, self.energy + 0.0 * share
        squares = self.mixed.between(self.strength**2, self.shear_strength**2, share)
        return np.sqrt(squares), self.mixed.between(self.energy, self.shear_energy, share)

    def _damage(self, size: Any, share: Any) -> Any:
        """Damage at equivalent openings of a first loading ``(n,)``."""
        strength, energy = self._modes(share)
        t = self._softening.softening(size, strength, energy, self.stiffness)
        beyond = size.real > (strength / self.stiffness).real
        return np.where(beyond, 1.0 - t / (self.stiffness * np.where(beyond, size, 1.0)), 0.0)

    def respond(self, w: Array, normal: Array, kept: Response, passed: Array | float, growing: Bools | bool = False) -> Response:
        """Tractions on openings.

        Args:
            w: openings ``(n, gdim)``.
            normal: unit normals along which surfaces open ``(n, gdim)``.
            kept: of the last step.
            passed: time, or part of the load factor, since then, one or ``(n,)``.
            growing: whether the tangent is that of growing damage although it has not grown ``(n,)``; with unloading to the origin.
        """
        plastic = self.unloading == "plastic"
        e = w - kept.permanent if plastic else w
        across = np.einsum("ng,ng->n", e, normal)
        shut, K, eye = across < 0.0, self.stiffness, np.eye(w.shape[1])
        e = e - np.where(shut, across, 0.0)[:, None] * normal
        # derivative of e by w
        P = eye - np.where(shut, 1.0, 0.0)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        size = np.linalg.norm(e, axis=1)
        least = np.where(size > 0.0, size, 1.0)
        m, along = e / least[:, None], np.where(shut, 0.0, across)
        sideways = e - along[:, None] * normal
        share = np.clip(np.einsum("ng,ng->n", sideways, sideways) / least**2, 0.0, 1.0)
        of_share = 2.0 * (sideways - share[:, None] * e) / least[:, None] ** 2

        def slopes(f: Any) -> tuple[Array, Array]:
            """Value and gradient by w of a function of size and share."""
            h = COMPLEX_STEP
            by_size, by_share = f(size + 1j * h * least, share).imag / (h * least), f(size, share + 1j * h).imag / h
            return f(size, share).real, by_size[:, None] * m + by_share[:, None] * of_share

        if plastic:
            return self._yield(e, m, P, size, share, slopes, kept)
        damage, slope = slopes(self._damage)
        grows = (damage > kept.damage) | growing
        damage = np.maximum(damage, kept.damage)
        follows = passed / (passed + self.viscosity) if self.viscosity > 0.0 else 1.0
        delayed = (1.0 - follows) * kept.delayed + follows * damage
        left = K * (1.0 - delayed)
        rest = np.where(grows, follows * K, 0.0)[:, None, None] * w[:, :, None] * slope[:, None, :]
        # contact closes what is below zero; there the stiffness has no kink
        secant = left[:, None, None] * eye
        return Response(left[:, None] * w, secant - rest, secant, damage, delayed, kept.permanent)

    def _yield(self, e: Array, m: Array, P: Array, size: Array, share: Array, slopes: Any, kept: Response) -> Response:
        """Return to the strength that is left, with plastic unloading: for elastic openings e along unit vectors m."""
        K, before = self.stiffness, 1.0 - kept.damage

        def traction(d: Any, B: Any) -> Any:
            strength, energy = self._modes(B)
            q = self._softening.left(K * d, strength, energy, K, before)
            return np.where((K * d).real > (strength * before).real, strength * q, K * d)

        t, slope = slopes(traction)
        yields = t < K * size
        damage = np.where(yields, np.maximum(kept.damage, 1.0 - t / self._modes(share)[0]), kept.damage)
        elastic = np.where(size > 0.0, t / np.where(size > 0.0, size, 1.0), K)
        tangent = elastic[:, None, None] * (P - m[:, :, None] * m[:, None, :]) + m[:, :, None] * slope[:, None, :]
        permanent = kept.permanent + np.where(yields, size - t / K, 0.0)[:, None] * m
        tangent = np.where((size > 0.0)[:, None, None], tangent, K * P)
        return Response(t[:, None] * m, tangent, elastic[:, None, None] * P, damage, damage, permanent)
