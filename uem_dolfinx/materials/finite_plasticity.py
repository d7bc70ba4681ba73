"""Von Mises plasticity in finite strain: multiplicative split, logarithmic elastic strain, exponential return map."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.geometry.axisymmetry import displacement_gradient
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.log import timed
from uem_dolfinx.materials.hardening import Linear, Saturating, Voce, YieldCurve, is_table, read_table
from uem_dolfinx.materials.logarithmic import Flowed, logarithmic_return, to_components, to_tensors
from uem_dolfinx.materials.von_mises import VonMises

if TYPE_CHECKING:
    from uem_dolfinx.materials.return_slopes import ByReturn

#: Components of F that vary in each kind, by row and column.
VARYING = {
    "3d": np.divmod(np.arange(9), 3),
    "plane_strain": np.divmod(np.array([0, 1, 3, 4]), 3),
    "axisymmetric": np.divmod(np.array([0, 1, 3, 4, 8]), 3),
}


class FinitePlasticity(VonMises):
    """Von Mises elasto-plasticity at large strains and rotations, e.g. metal forming, with isotropic and kinematic hardening.

        F = F_e F_p,    tau = kappa ln(J) 1 + 2 mu dev(ln V_e),    q(tau) <= yield stress at peeq

    with the Kirchhoff stress ``tau``, ``J = det F`` and the elastic stretch ``V_e``. The flow is integrated by the exponential map,
    ``det F_p = 1`` to rounding, so that the radial return of small strains acts on the logarithmic strain. The law is hyperelastic in
    ``F_e`` and objective. For small strains it is equal to ``VonMises``, up to second order in the strain.

    With a number as ``kinematic_hardening`` the yield surface has its centre at a back stress, in the axes of F_p and V_e

        q(2 mu dev(ln U_e) - 2/3 kinematic_hardening ln V_p) <= yield stress at peeq

    with ``U_e^2 = F_e^T F_e`` and ``V_p^2 = F_p F_p^T``: Prager's rule, derived from an energy of ``V_p``. No plastic spin is
    assumed; the history variables are ``peeq`` and the plastic strain. In simple shear the back stress increases up to a shear of 3 and
    then decreases slowly, like the logarithm of the stretch, without oscillations. A table represents layers with the same F, as in
    ``VonMises``, and different plastic strains: tension follows the table over the logarithmic plastic strain exactly, and cycles
    follow Masing's rule.

    As in ``VonMises``, the volumetric part is integrated by a separate rule, so that the same cells do not lock, with one point in
    quadrilaterals and hexahedra of degree 1. In axisymmetry ``J`` is then the volume ratio of the ring of the cell. This part is an
    energy in ``J``, and the tangent is symmetric.

    Args:
        u: displacement, a Function of a vector Lagrange space; with ``displacement`` a Function of a mixed space, as in the problem.
        E: Young's modulus: a number or a DG0 Function, as the other parameters; read once.
        nu: Poisson's ratio.
        yield_stress: in uniaxial tension, force per present area times J; infinite where the body is elastic. Or a table: pairs
            (equivalent plastic strain, yield stress), with increasing strains from 0, and linear interpolation.
        hardening: increase of the yield stress per equivalent plastic strain, with a table beyond its last point; or ``Voce``.
        kinematic_hardening: increase of the back stress in uniaxial tension per plastic strain. Or a table: pairs (logarithmic plastic
            strain, back stress), as in ``VonMises``, without isotropic hardening.
        displacement: number of the displacement's part of the mixed space.
        kind: ``"3d"``, ``"plane_strain"``, or ``"axisymmetric"`` on a mesh declared axisymmetric.
        cells: cells of this material, a tag or as surfaces in ``Contact``; may be empty on some ranks. None is all cells.
        quadrature_degree: of the stress; None chooses by cell and degree. The degree of the pressure is not larger.

    Attributes:
        stress: Cauchy stress at quadrature points, from the last ``update``, with the components of ``Returned``.
        plastic_strain: committed ``(1 - C_p^-1) / 2`` there; ``cell_averages`` return ``ln(C_p) / 2``.
        peeq: committed equivalent plastic strain there; with a table both contain values of all layers, as in ``VonMises``.
        history: the committed Functions by name, the complete history.

    Raises:
        InputError, InputTypeError: for an unknown word, or a parameter out of its range.
        SpaceError, TagError: as ``VonMises``.
    """

    def __init__(
        self,
        u: fem.Function,
        E: Any,
        nu: Any,
        yield_stress: Any,
        hardening: Any = 0.0,
        *,
        kinematic_hardening: Any = 0.0,
        displacement: int | None = None,
        kind: Literal["3d", "plane_strain", "axisymmetric"] = "3d",
        cells: Part | None = None,
        quadrature_degree: int | None = None,
    ):
        given.word("kind", kind, tuple(VARYING))
        #: Outcome of the last update, and whether its tangent is known to the forms.
        self._trial: Flowed
        self._differentiated = False
        super().__init__(
            u, E, nu, yield_stress, hardening, kinematic_hardening=kinematic_hardening, displacement=displacement, kind=kind,
            cells=cells, quadrature_degree=quadrature_degree,
        )  # fmt: skip

    def _read_curve(self, yield_stress: Any, hardening: Any) -> YieldCurve:
        """Yield stress over peeq."""
        if is_table(yield_stress):
            return read_table(yield_stress, hardening)
        first = self._pointwise("yield_stress", yield_stress, given.POSITIVE_OR_INFINITE)
        if isinstance(hardening, Voce):
            return Saturating(first, hardening)
        return Linear(first, self._pointwise("hardening", hardening, given.NOT_NEGATIVE))

    def _create_functions(self) -> None:
        """Functions at the quadrature points, zero outside of this material's cells."""
        self._create_history()
        count = len(VARYING[self.kind][0])
        # Functions in the forms: the deviator's first Piola-Kirchhoff stress, and the upper triangle of its derivative by F
        self._piola = self._points.create_function("first_piola", count)
        self._upper = self._points.create_function("tangent", count * (count + 1) // 2)
        self._own(self.stress, self._piola, self._upper, *self.history.values())

    def _compile(self) -> None:
        """Compile the displacement's gradient at the stress points, and ln J at the pressure points."""
        self._strain = self._points.compile(self._components(self._moved))
        self._volume_change = self._pressure_points.compile(ufl.ln(self._volume_ratio()))

    def _gradient(self, w: Any) -> Expr:
        """Gradient of a displacement ``(3, 3)``."""
        G = displacement_gradient(w)
        return ufl.as_matrix([[G[0, 0], G[0, 1], 0], [G[1, 0], G[1, 1], 0], [0, 0, 0]]) if self.kind == "plane_strain" else G

    def _components(self, w: Any) -> Expr:
        """Varying components of a gradient."""
        G = self._gradient(w)
        return ufl.as_vector([G[i, j] for i, j in np.transpose(VARYING[self.kind]).tolist()])

    @property
    def _of_rings(self) -> bool:
        """Whether volume ratios are those of the rings of cells, evaluated at one point per cell."""
        return self.kind == "axisymmetric" and not self._pressure_points.degree

    def _volume_ratio(self) -> Expr:
        """J; for rings the present volume over the reference volume, exact if the cell is a parallelogram.

        A ring's volume is the integral of ``2 pi r`` over the cell's area. In a parallelogram ``r`` and the ratio of areas are linear in
        each coordinate. The mean of their product is its value at the centre plus the product of their slopes along the sides over 12.
        """
        F = ufl.Identity(3) + self._gradient(self._moved)
        if not self._of_rings:
            return ufl.det(F)
        r, area = ufl.SpatialCoordinate(self.mesh)[0], F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        return area * F[2, 2] + self._mean_of_slopes(area, r + self._moved[0]) / r

    def _volume_variation(self, v: Any) -> Expr:
        """Derivative of ``ln J`` along ``v``."""
        F, G = ufl.Identity(3) + self._gradient(self._moved), self._gradient(v)
        if not self._of_rings:
            return ufl.inner(ufl.inv(F).T, G)
        r, area = ufl.SpatialCoordinate(self.mesh)[0], F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        grown = F[1, 1] * G[0, 0] + F[0, 0] * G[1, 1] - F[1, 0] * G[0, 1] - F[0, 1] * G[1, 0]
        slopes = self._mean_of_slopes(grown, r + self._moved[0]) + self._mean_of_slopes(area, v[0])
        return (grown * F[2, 2] + area * G[2, 2] + slopes / r) / self._volume_ratio()

    def _mean_of_slopes(self, a: Expr, b: Expr) -> Expr:
        """Mean of a product over a parallelogram minus the product of the means."""
        A = ufl.Jacobian(self.mesh)
        return ufl.dot(ufl.dot(ufl.grad(a), A), ufl.dot(ufl.grad(b), A)) / 12

    def residual(self, v: Any) -> ufl.Form:
        """Internal virtual work of the material's cells; see ``VonMises.residual``."""
        v = self._part(v)
        pressed = self._kappa * ufl.ln(self._volume_ratio()) * self._volume_variation(v) * self._pressure_points.dx
        return ufl.dot(self._piola, self._components(v)) * self._points.dx + pressed

    def stiffness(self, du: Any, v: Any) -> ufl.Form:
        """The deviator's part of the tangent, as of the last ``differentiate``; see ``VonMises.stiffness``."""
        du, v = self._part(du), self._part(v)
        count = len(VARYING[self.kind][0])
        number = np.zeros((count, count), int)
        number[np.triu_indices(count)] = np.arange(self._upper.function_space.dofmap.index_map_bs)
        number = np.maximum(number, number.T)
        A = ufl.as_matrix([[self._upper[int(k)] for k in row] for row in number])
        return ufl.inner(ufl.dot(A, self._components(du)), self._components(v)) * self._points.dx

    def update(self) -> None:
        """Stress at the present displacement, from the committed history; NotFiniteError if it is not finite (collective)."""
        with timed("return mapping"):
            with np.errstate(over="ignore", invalid="ignore"):
                flowed = self._flowed()
                logarithm = self._volume_changes() @ self._spread.T
                stress = flowed.stress.copy()
                stress[:, :3] += (self._bulk[:, None] * logarithm).reshape(-1, 1)
                stress *= np.exp(-logarithm).reshape(-1, 1)
            self._refuse_infinite(stress)
            self._trial, self._differentiated, self._at = flowed, False, np.array(self.u.x.array)
            self._points.write(self._piola, flowed.first_piola)
            self._points.write(self.stress, stress)

    def _gradients(self) -> Array:
        """Gradients of the displacement at the points ``(n, 3, 3)``."""
        values, varying = self._points.evaluate(self._strain), VARYING[self.kind]
        gradient = np.zeros((len(values), 3, 3))
        gradient[:, varying[0], varying[1]] = values
        return gradient

    @property
    def _moves(self) -> bool:
        """Whether the yield surface moves, or there are derivatives by how it does."""
        return bool(self._modulus.any()) or isinstance(self.handed["kinematic_hardening"], fem.Constant | fem.Function)

    def begins_with(self) -> tuple[Any, ...]:
        """Initial values of the return at the present displacement: gradient, committed history and parameters, in its order."""
        begin, varying = (self._gradients(), *self._committed(), self._mu), VARYING[self.kind]
        if self._layers is not None:
            return *begin, varying
        return *begin, self._curve, *([self._modulus] if self._moves else []), varying

    @property
    def stress_in_forms(self) -> fem.Function:
        """The Function of the stress in ``residual``: the deviator's first Piola-Kirchhoff stress."""
        return self._piola

    def _slopes_of_return(self) -> tuple[Callable[[Any], Any], Callable[..., ByReturn]]:
        from uem_dolfinx.materials.return_slopes import kinematic_back, logarithmic_back

        back: Callable[..., ByReturn] = logarithmic_back
        if self._layers is not None:
            back = self._layers.logarithmic_back
        elif self._moves:
            back = kinematic_back
        return lambda w: self._components(self._part(w)), back

    def differentiate(self) -> None:
        """The tangent at the displacement of the last ``update``."""
        if self._differentiated:
            return
        with timed("return mapping"), np.errstate(over="ignore", invalid="ignore"):
            rows, columns = np.triu_indices(len(VARYING[self.kind][0]))
            self._points.write(self._upper, self._trial.tangent()[:, rows, columns])
            self._differentiated = True

    def _flowed(self) -> Flowed:
        if self._layers is not None:
            return self._layers.logarithmic_return(*self.begins_with())
        if not self._moves:
            return logarithmic_return(*self.begins_with())
        from uem_dolfinx.materials.back_stress import kinematic_return

        return kinematic_return(*self.begins_with())

    def _plastic_strains(self) -> Array:
        """Committed ``ln(C_p) / 2`` ``(n_points, size)``."""
        values, _ = self._committed()
        change, axes = np.linalg.eigh(to_tensors(values))
        strains = -np.log1p(-2 * change) / 2
        return self._mean(to_components((axes * strains[:, None, :]) @ axes.transpose(0, 2, 1), values.shape[1]))
