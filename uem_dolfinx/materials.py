"""Elastic laws in UFL: stored energy, stress and internal virtual work, in 3D, plane strain and plane stress.

A convenience on the data's way, between mesh and forms: the united solver takes any UFL residual.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import ufl

if TYPE_CHECKING:
    from ufl.core.expr import Expr

KINDS = ("3d", "plane_strain", "plane_stress")


@dataclass(frozen=True)
class Elastic(ABC):
    """Common part of the laws.

    Attributes:
        E: Young's modulus, a force per area: a number, a Constant, a Function or any UFL expression.
        nu: Poisson's ratio, likewise.
        kind: ``"3d"``, ``"plane_strain"`` or ``"plane_stress"``.
    """

    E: Any
    nu: Any
    kind: str = "3d"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind = '{self.kind}': expected one of {', '.join(KINDS)}")

    @property
    def mu(self) -> Any:
        """Shear modulus."""
        return self.E / (2 * (1 + self.nu))

    @property
    def lam(self) -> Any:
        """Lame's first constant."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    @property
    def lam_in_plane(self) -> Any:
        """The same with the strain across a stress-free plane eliminated, where the law is linear in its strain."""
        return 2 * self.mu * self.lam / (self.lam + 2 * self.mu) if self.kind == "plane_stress" else self.lam

    def _check(self, u: Any) -> Any:
        """Identity of the displacement's dimension, which must fit the kind."""
        gdim = len(u)
        if (gdim == 3) != (self.kind == "3d"):
            raise ValueError(f"kind = '{self.kind}' does not fit a displacement with {gdim} components")
        return ufl.Identity(gdim)

    @abstractmethod
    def energy(self, u: Any) -> Expr:
        """Stored energy per reference volume."""

    @abstractmethod
    def first_piola(self, u: Any) -> Expr:
        """Stress that does work on ``grad(v)``."""

    def residual(self, u: Any, v: Any) -> Expr:
        """Internal virtual work per reference volume, to be integrated with ``dx``."""
        return ufl.inner(self.first_piola(u), ufl.grad(v))


@dataclass(frozen=True)
class LinearElastic(Elastic):
    """Hooke's law in small strains."""

    def strain(self, u: Any) -> Expr:
        """Symmetric gradient."""
        return ufl.sym(ufl.grad(u))

    def energy(self, u: Any) -> Expr:
        """``mu eps:eps + lambda/2 tr(eps)^2``."""
        eps = self.strain(u)
        return self.mu * ufl.inner(eps, eps) + self.lam_in_plane / 2 * ufl.tr(eps) ** 2

    def stress(self, u: Any) -> Expr:
        """Cauchy stress."""
        eps = self.strain(u)
        return 2 * self.mu * eps + self.lam_in_plane * ufl.tr(eps) * self._check(u)

    def first_piola(self, u: Any) -> Expr:
        """In small strains the Cauchy stress."""
        return self.stress(u)


@dataclass(frozen=True)
class StVenantKirchhoff(Elastic):
    """``S = 2 mu E + lambda tr(E) I`` with the Green-Lagrange strain E [UEM, 7.1]; for large rotations and moderate strains."""

    def strain(self, u: Any) -> Expr:
        """Green-Lagrange strain."""
        F = self._check(u) + ufl.grad(u)
        return (F.T * F - ufl.Identity(len(u))) / 2

    def energy(self, u: Any) -> Expr:
        """``mu E:E + lambda/2 tr(E)^2``; in plane stress E33 is eliminated by S33 = 0."""
        E = self.strain(u)
        return self.mu * ufl.inner(E, E) + self.lam_in_plane / 2 * ufl.tr(E) ** 2

    def stress(self, u: Any) -> Expr:
        """Second Piola-Kirchhoff stress."""
        E = self.strain(u)
        return 2 * self.mu * E + self.lam_in_plane * ufl.tr(E) * ufl.Identity(len(u))

    def first_piola(self, u: Any) -> Expr:
        """``F S``."""
        return (self._check(u) + ufl.grad(u)) * self.stress(u)


@dataclass(frozen=True)
class NeoHooke(Elastic):
    """Compressible neo-Hookean law ``W = mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)``; for large strains.

    In plane stress ``P33 = 0`` gives the stretch across the plane in closed form,
    ``l3^2 = (mu + lambda/2) / (mu + lambda/2 J2^2)`` with the in-plane determinant J2.
    """

    def _stretch_across(self, J2: Any) -> Any:
        """Square of the stretch across the plane."""
        if self.kind != "plane_stress":
            return 1.0
        return (self.mu + self.lam / 2) / (self.mu + self.lam / 2 * J2**2)

    def energy(self, u: Any) -> Expr:
        """Stored energy per reference volume."""
        F = self._check(u) + ufl.grad(u)
        J2 = ufl.det(F)
        l3 = self._stretch_across(J2)
        C33 = l3 if len(u) == 2 else 0.0
        JJ = J2**2 * l3
        return self.mu / 2 * (ufl.inner(F, F) + C33 - 3 - ufl.ln(JJ)) + self.lam / 4 * (JJ - 1 - ufl.ln(JJ))

    def stress(self, u: Any) -> Expr:
        """Second Piola-Kirchhoff stress ``mu (I - C^-1) + lambda/2 (J^2 - 1) C^-1``."""
        F = self._check(u) + ufl.grad(u)
        C = F.T * F
        JJ = ufl.det(C) * self._stretch_across(ufl.det(F))
        return self.mu * (ufl.Identity(len(u)) - ufl.inv(C)) + self.lam / 2 * (JJ - 1) * ufl.inv(C)

    def first_piola(self, u: Any) -> Expr:
        """``F S``."""
        return (self._check(u) + ufl.grad(u)) * self.stress(u)
