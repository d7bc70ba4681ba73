"""Elastic laws in UFL: stored energy, stress and internal virtual work, in 3D, plane strain, plane stress and axisymmetry.

A convenience: the united solver takes any UFL residual.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from ufl.constantvalue import Zero
from ufl.core.expr import Expr

from uem_dolfinx import compat, given
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.axisymmetry import displacement_gradient, is_axisymmetric
from uem_dolfinx.parallel import agree

Kind: TypeAlias = Literal["3d", "plane_strain", "plane_stress", "axisymmetric"]
KINDS: tuple[Kind, ...] = ("3d", "plane_strain", "plane_stress", "axisymmetric")
#: Poisson's ratios of bodies that resist every strain.
POISSON = given.between(-1.0, 0.5, "a body that hardly changes its volume has 0.4999, with residual_form")


@dataclass(frozen=True)
class Elastic(given.Copied, ABC):
    """Base of the elastic laws.

    Attributes:
        E: Young's modulus, a force per area: a number, a Constant, a Function or any UFL expression.
        nu: Poisson's ratio, of the same types.
        kind: ``"3d"``, ``"plane_strain"``, ``"plane_stress"``, or ``"axisymmetric"`` on a mesh declared axisymmetric: strains and
            stresses are then ``(3, 3)``, in the order r, z and circumferential.

    Raises:
        InputError, InputTypeError: for an unknown kind, E that is not positive and finite, or nu that is not between -1 and 1/2. Present
            values of Constants and Functions are checked, except Functions that are zero, which may be filled later.
    """

    E: Any
    nu: Any
    kind: Kind = "3d"

    def __post_init__(self) -> None:
        given.word("kind", self.kind, KINDS)
        check_parameter("E", self.E, given.POSITIVE)
        check_parameter("nu", self.nu, POISSON)

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
        """Lame's first constant, in plane stress with the out-of-plane strain eliminated, for laws that are linear in their strain."""
        return 2 * self.mu * self.lam / (self.lam + 2 * self.mu) if self.kind == "plane_stress" else self.lam

    def _check(self, u: Any) -> Any:
        """Identity of the strain's dimension; the displacement must fit the kind."""
        check_kind(self.kind, given.kind("u", u, isinstance(u, Expr) and len(u.ufl_shape) == 1, "a displacement, as a Function"))
        return ufl.Identity(3 if self.kind == "axisymmetric" else len(u))

    @abstractmethod
    def _energies(self, u: Any) -> tuple[Expr, Expr]:
        """Stored energy per reference volume in two parts: of mu, and of lambda, which resists changes of volume."""

    @abstractmethod
    def _stresses(self, u: Any) -> tuple[Expr, Expr]:
        """Stress in the same two parts."""

    def energy(self, u: Any) -> Expr:
        """Stored energy per reference volume."""
        return sum(self._energies(u))

    def stress(self, u: Any) -> Expr:
        """Cauchy stress in small strains, otherwise the second Piola-Kirchhoff stress S."""
        self._check(u)
        return sum(self._stresses(u))

    def first_piola(self, u: Any) -> Expr:
        """First Piola-Kirchhoff stress ``F S``, conjugate to ``grad(v)``."""
        return self._first_piola(u, self.stress(u))

    def _first_piola(self, u: Any, stress: Any) -> Expr:
        return (self._check(u) + displacement_gradient(u)) * stress

    def residual(self, u: Any, v: Any) -> Expr:
        """Internal virtual work per reference volume, to be integrated with ``dx``."""
        return ufl.inner(self.first_piola(u), displacement_gradient(v))

    def thermal_residual(self, u: Any, v: Any, strain: Any) -> Expr:
        """Virtual work per reference volume of the stress that a free strain, alpha times the heating, relieves: subtract it.

        ``law.residual(u, v) - law.thermal_residual(u, v, alpha * (T - T0))``: for small strains of heating, also with large rotations.
        """
        identity = self._check(u)
        modulus = 2 * self.mu + (2 * self.lam_in_plane if self.kind == "plane_stress" else 3 * self.lam)
        return ufl.inner(self._first_piola(u, modulus * strain * identity), displacement_gradient(v))

    def residual_form(self, u: fem.Function, v: Any, dx: ufl.Measure = ufl.dx) -> ufl.Form:
        """Internal virtual work of nearly incompressible bodies, without locking as nu approaches 1/2.

        The volumetric part is integrated with fewer points: one in quadrilaterals and hexahedra of degree 1 and simplices of degree 2,
        two in each direction in quadrilaterals and hexahedra of degree 2. This selective reduced integration is the mean dilatation
        method for quadrilaterals and small strains [Malkus and Hughes, Computer Methods in Applied Mechanics and Engineering 15 (1978)
        63-81].

        Args:
            u: displacement.
            v: test function of its space.
            dx: measure of the body's cells.

        Raises:
            InputError: for simplices of degree 1, which lock with one point, and axisymmetric cells of degree 1, which need more points.
        """
        shear, volume = (ufl.inner(self._first_piola(u, part), displacement_gradient(v)) for part in self._stresses(u))
        return self._integrated(shear, volume, u, dx)

    def energy_form(self, u: fem.Function, dx: ufl.Measure = ufl.dx) -> ufl.Form:
        """Stored energy, integrated as in ``residual_form``, whose form is its derivative."""
        self._check(u)
        return self._integrated(*self._energies(u), u, dx)

    def _integrated(self, shear: Expr, volume: Expr, u: fem.Function, dx: ufl.Measure) -> ufl.Form:
        """Integral of two parts of a stress or an energy; the second vanishes for nu = 0, and is then not integrated."""
        fewer = self._fewer_points(u, dx)
        return shear * dx if isinstance(volume, Zero) else shear * dx + volume * fewer

    def _fewer_points(self, u: fem.Function, dx: ufl.Measure) -> ufl.Measure:
        """Measure of the volumetric part; plane stress needs no reduced integration."""
        if self.kind == "plane_stress":
            return dx
        V = given.kind("u", u, isinstance(u, fem.Function), "the displacement, whose degree determines the points").function_space
        cell, degree = compat.cell_name(V.mesh), compat.lagrange_degree(V) or 0
        simplex = cell in ("triangle", "tetrahedron")
        if degree == 1 and (simplex or self.kind == "axisymmetric"):
            lock = "lock where the volume hardly changes, with one point as well"
            why = lock if simplex else "do not pass the patch test near the axis with one point"
            remedy = "degree 2" if self.kind == "axisymmetric" else "degree 2, or quadrilaterals or hexahedra"
            raise InputError(f"residual_form: cells of type {cell} and degree 1 {why}: take {remedy}")
        return dx(degree=1 if simplex else 2 * degree - 1)


@dataclass(frozen=True)
class LinearElastic(Elastic):
    """Hooke's law in small strains."""

    def strain(self, u: Any) -> Expr:
        """Symmetric gradient."""
        self._check(u)
        return ufl.sym(displacement_gradient(u))

    def _energies(self, u: Any) -> tuple[Expr, Expr]:
        """``mu eps:eps + lambda/2 tr(eps)^2``."""
        eps = self.strain(u)
        return self.mu * ufl.inner(eps, eps), self.lam_in_plane / 2 * ufl.tr(eps) ** 2

    def _stresses(self, u: Any) -> tuple[Expr, Expr]:
        """Cauchy stress."""
        eps = self.strain(u)
        return 2 * self.mu * eps, self.lam_in_plane * ufl.tr(eps) * self._check(u)

    def _first_piola(self, u: Any, stress: Any) -> Expr:
        """In small strains the Cauchy stress."""
        return stress


@dataclass(frozen=True)
class StVenantKirchhoff(Elastic):
    """``S = 2 mu E + lambda tr(E) I`` with the Green-Lagrange strain E [UEM, 7.1]; for large rotations and moderate strains."""

    def strain(self, u: Any) -> Expr:
        """Green-Lagrange strain."""
        self._check(u)
        return green_lagrange(u)

    def _energies(self, u: Any) -> tuple[Expr, Expr]:
        """``mu E:E + lambda/2 tr(E)^2``; in plane stress E33 is eliminated by S33 = 0."""
        E = self.strain(u)
        return self.mu * ufl.inner(E, E), self.lam_in_plane / 2 * ufl.tr(E) ** 2

    def _stresses(self, u: Any) -> tuple[Expr, Expr]:
        """Second Piola-Kirchhoff stress."""
        E = self.strain(u)
        return 2 * self.mu * E, self.lam_in_plane * ufl.tr(E) * self._check(u)


@dataclass(frozen=True)
class NeoHooke(Elastic):
    """Compressible neo-Hookean law ``W = mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)``; for large strains.

    In plane stress ``P33 = 0`` gives the stretch across the plane in closed form,
    ``l3^2 = (mu + lambda/2) / (mu + lambda/2 J2^2)`` with the in-plane determinant J2.
    """

    def _volume_change(self, u: Any) -> Any:
        """``J^2 - 1``, computed from the strain, so that small strains are not lost in rounding."""
        E = green_lagrange(u)
        second = (ufl.tr(E) ** 2 - ufl.inner(E, E)) / 2
        change = 2 * ufl.tr(E) + 4 * second + (8 * ufl.det(E) if E.ufl_shape == (3, 3) else 0)
        return self.mu * change / (self.mu + self.lam / 2 * (1 + change)) if self.kind == "plane_stress" else change

    def _energies(self, u: Any) -> tuple[Expr, Expr]:
        """``mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)``."""
        F = self._check(u) + displacement_gradient(u)
        JJ = 1 + self._volume_change(u)
        across = JJ / ufl.det(F) ** 2 if F.ufl_shape == (2, 2) else 0.0
        return self.mu / 2 * (ufl.inner(F, F) + across - 3 - ufl.ln(JJ)), self.lam / 4 * (JJ - 1 - ufl.ln(JJ))

    def _stresses(self, u: Any) -> tuple[Expr, Expr]:
        """Second Piola-Kirchhoff stress ``mu (I - C^-1) + lambda/2 (J^2 - 1) C^-1``."""
        E = green_lagrange(u)
        C_inverse = ufl.inv(ufl.Identity(E.ufl_shape[0]) + 2 * E)
        return 2 * self.mu * C_inverse * E, self.lam / 2 * self._volume_change(u) * C_inverse


def check_parameter(what: str, value: Any, within: given.Range) -> None:
    """Refuse a material parameter out of its range: a number, or present values of a Constant or Function (collective for Functions).

    Raises:
        InputTypeError, InputError: with its name and the first invalid value.
    """
    if isinstance(value, Expr):
        given.kind(what, value, value.ufl_shape == (), "a scalar expression", "take a component, or make a scalar Function")
    if isinstance(value, fem.Function):
        values, comm = value.x.array, value.function_space.mesh.comm
        bad = values[~within.holds(values)] if values.any() else values[:0]
        words = given.sentence(what, bad[0] if len(bad) else None, within.words, within.remedy)
        agree(comm, InputError(f"the Function {words}") if len(bad) else None)
    elif isinstance(value, fem.Constant):
        given.number(what, np.asarray(value.value)[()], within)
    elif not isinstance(value, Expr):
        given.number(what, value, within)


def green_lagrange(u: Any) -> Expr:
    """Green-Lagrange strain; ``F'F - I`` would lose strains below the rounding of 1."""
    G = displacement_gradient(u)
    return (G + G.T + G.T * G) / 2


def check_kind(kind: str, u: Any) -> None:
    """InputError for a kind that does not fit the displacement's number of components, or the axisymmetry of its mesh."""
    if (len(u) == 3) != (kind == "3d"):
        fitting = "'3d'" if len(u) == 3 else "'plane_strain', 'plane_stress' or 'axisymmetric'"
        raise InputError(f"kind = '{kind}' does not fit a displacement with {len(u)} components: expected {fitting}")
    if is_axisymmetric(u) != (kind == "axisymmetric"):
        state = "has not been declared" if kind == "axisymmetric" else "has been declared axisymmetric"
        remedy = "call uem.axisymmetric(mesh) first" if kind == "axisymmetric" else "take kind = 'axisymmetric'"
        raise InputError(f"kind = '{kind}' does not fit the displacement's mesh, which {state}: {remedy}")


def material_of(f: Any) -> Any:
    """The law with history that a Function belongs to, the weak reference if the law no longer exists, or None."""
    law = getattr(f, "material", None)
    return law if law is None else law() or law


class HistoryMaterial(Protocol):
    """Interface of the solver to a law whose stress depends on history, not only on the displacement, e.g. plasticity.

    Functions in its forms may refer to it weakly by an attribute ``material``, and the law to its displacement by ``u``. In a mixed
    space ``displacement`` is the number of the displacement's part; ``stiffness`` gets trial and test functions of the whole space.
    A law may find its tangent in a method ``differentiate()``, which is called before K is assembled, instead of in ``update``.
    """

    history: dict[str, Any]  # committed Functions that the stress depends on, by name

    def stiffness(self, du: Any, v: Any) -> ufl.Form:
        """Part of the tangent that is missing in the derivative of the residual form: the stress's change with the displacement."""

    def update(self) -> None:
        """Stresses at the present displacement, from the committed history."""

    def commit(self) -> None:
        """Make the trial history the committed one."""

    def energy(self) -> float:
        """Stored energy (collective)."""

    def dissipation(self) -> float:
        """Energy dissipated since the start (collective)."""


def differentiate(materials: Sequence[Any]) -> None:
    """Bring what ``stiffness`` of laws with history contains up to date with their last ``update``."""
    for material in materials:
        if hasattr(material, "differentiate"):
            material.differentiate()


def is_history_material(material: object) -> bool:
    """Whether an object is a law with history, with the interface of ``HistoryMaterial``."""
    return all(hasattr(material, name) for name in ("history", "stiffness", "update", "commit"))
