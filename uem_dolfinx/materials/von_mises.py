"""Von Mises plasticity: return mapping at quadrature points, consistent tangent, trial and committed history.

Stress and tangent enter forms as Functions known at quadrature points.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError, NotFiniteError, SpaceError
from uem_dolfinx.geometry.axisymmetry import centre_of_mass, displacement_gradient
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.log import timed, timed_as
from uem_dolfinx.materials.elastic import KINDS, POISSON, Kind, check_kind, green_lagrange
from uem_dolfinx.materials.quadrature_points import QuadraturePoints, owned_cells
from uem_dolfinx.materials.return_mapping import Returned, plane_stress_return, radial_return
from uem_dolfinx.parallel import agree, reduced

if TYPE_CHECKING:
    from uem_dolfinx.materials.hardening import YieldCurve
    from uem_dolfinx.materials.layers import Layers
    from uem_dolfinx.materials.logarithmic import Flowed
    from uem_dolfinx.materials.return_slopes import ByReturn, PlasticSlopes

STRAINS = ("small", "green_lagrange")
#: Expected values of kinematic hardening.
SLOPE_OR_TABLE = given.Range("0 or a positive number, or a table", given.NOT_NEGATIVE.holds)
#: Degrees of the quadrature of stress and of pressure, by the displacement's degree, on simplices and on tensor-product cells;
#: 0 is the cell's centre.
SIMPLEX_DEGREES = {1: (1, 1), 2: (2, 2)}
TENSOR_DEGREES = {1: (2, 0), 2: (4, 2)}


class VonMises(given.Sealed):
    """Elasto-plasticity with the yield surface of von Mises, associated flow, isotropic and kinematic hardening.

        S = C : (E - E_p),    q(S - 2/3 kinematic_hardening E_p) <= yield_stress + hardening * peeq

    ``update`` computes the stresses at the present displacement from the *committed* history, ``commit`` stores the new history, so
    that Newton iterates count as neither loading nor unloading [UEM, 3]. The form is ``residual(v)``; its tangent is
    ``ufl.derivative(residual(v), u) + stiffness(du, v)``.

    A number as ``kinematic_hardening`` is Prager's rule. A table represents parallel, perfectly plastic layers with the same strain and
    different weights and yield stresses [Besseling, Journal of Applied Mechanics 25 (1958) 529-536; Owen, Prakash and Zienkiewicz,
    Computers and Structures 4 (1974) 1251-1267], also known as multilinear kinematic hardening, sublayer or overlay model. In uniaxial
    tension the stress follows the table exactly, and in cycles Masing's rule: after a reversal the curve of first loading scaled by two,
    until a loop closes and the previous curve continues. A table of one straight line is Prager's rule. Each bend of the table is a
    layer with its own history.

    Plastic flow is isochoric, so that some cells lock. Except in plane stress, the pressure, which is elastic in this law, is therefore
    integrated by a separate rule. These are errors of the limit load of Prandtl's punch in plane strain, perfectly plastic
    with a yield strain of 0.001. The indentation is 0.03 of the width, with 8 linear or 4 quadratic cells beneath half of it:

    - degree 1 on quadrilaterals and hexahedra, 5.6 %: stress at 2 points per direction, pressure at the cell's centre, which is the
      B-bar method (Hughes, Int. J. Numer. Meth. Engng 15 (1980) 1413-1418); with the pressure at the stress's points it would be
      35 % and increase with the load. Hexahedra that are no parallelepipeds then pass the patch test approximately. With nodes
      moved by 10 % of a cell's size the error of stresses is 0.08 %, by 25 % 0.6 %. For axisymmetric quadrilaterals that are no
      parallelograms it is 0.3 % and 0.9 % next to the axis, where pressures are taken at the mean position of the cell's circles;
    - degree 2 on quadrilaterals and hexahedra, 4.2 %: stress at 3 points per direction, pressure at 2; with both at 3 it
      would be 12 %;
    - degree 2 on triangles and tetrahedra, 7.0 %: both by the rule of degree 2, as a single point for the pressure leaves the
      tangent singular;
    - degree 1 on triangles and tetrahedra, 24 % and increasing: one point. These cells **lock**; use other cells.

    Plane stress does not lock with any cell.

    Args:
        u: displacement, a Function of a vector Lagrange space; with ``displacement`` a Function of a mixed space, as in the problem.
        E: Young's modulus: a number or a DG0 Function, as the other parameters; read once.
        nu: Poisson's ratio.
        yield_stress: in uniaxial tension; infinite where the body is elastic.
        hardening: increase of the yield stress per equivalent plastic strain.
        kinematic_hardening: increase of the back stress in uniaxial tension per plastic strain. Or a table: pairs (plastic strain, back
            stress in uniaxial tension) from (0, 0), with linear interpolation, slopes that do not increase, and a constant beyond the
            last pair. Then ``hardening`` must be 0, and in plane stress ``nu`` below 1/2.
        displacement: number of the displacement's part of the mixed space.
        kind: ``"3d"``, ``"plane_strain"``, ``"plane_stress"``, or ``"axisymmetric"`` on a mesh declared axisymmetric.
        strain: ``"small"``: symmetric gradient and Cauchy stress, or ``"green_lagrange"``: additive split of the Green-Lagrange
            strain, with the second Piola-Kirchhoff stress in the yield surface; for large rotations and moderate strains.
        cells: cells of this material, a tag or as surfaces in ``Contact``; may be empty on some ranks. None is all cells.
        quadrature_degree: of the stress; None chooses by cell and degree. The degree of the pressure is not larger.

    Attributes:
        stress, plastic_strain, peeq: at quadrature points, with the components of ``Returned``; ``stress`` from the last ``update``,
            the others committed; zero outside of ``cells``. With a table values of all layers, one after another (in plane stress
            with the components of plane strain); ``cell_averages`` are weighted means over the layers.
        history: the committed Functions by name, the complete history.
        handed: parameters as passed, by name.

    Raises:
        InputError, InputTypeError: for an unknown word, a parameter out of its range, or isotropic hardening together with a table.
        SpaceError: if ``u`` is no displacement in a Lagrange space of degree 1 or 2, or if ``cells`` are of another mesh.
        TagError: if ``cells`` are not cells, or empty on all ranks.
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
        kind: Kind = "3d",
        strain: Literal["small", "green_lagrange"] = "small",
        cells: Part | None = None,
        quadrature_degree: int | None = None,
    ):
        given.kind("u", u, isinstance(u, fem.Function), "a Function of a vector Lagrange space")
        given.word("kind", kind, KINDS)
        given.word("strain", strain, STRAINS)
        self.u, self.displacement, self.kind, self.strain = u, displacement, kind, strain
        self.mesh, self.comm = u.function_space.mesh, u.function_space.mesh.comm
        degree = self._degree_of(u)
        self._moved = u if displacement is None else ufl.split(u)[displacement]  # the displacement in UFL
        self.cells = owned_cells(self.mesh, cells)
        degrees = self._degrees(degree, quadrature_degree)
        self._points, self._pressure_points = (QuadraturePoints(self.mesh, self.cells, one) for one in degrees)
        self.handed = {"E": E, "nu": nu, "yield_stress": yield_stress, "hardening": hardening}
        self.handed["kinematic_hardening"] = kinematic_hardening
        self._shown = self.handed | {"cells": cells}
        self._curve: YieldCurve  # yield stress over peeq; with a table, the yield curve of the layers
        self._layers: Layers | None = None
        self._read_parameters(E, nu, yield_stress, hardening, kinematic_hardening)
        self._create_functions()
        self._compile()
        self._spread = self._points.spread_from(self._pressure_points)
        self._trial: Returned | Flowed  # outcome of the last update, which was at a displacement ``_at``
        self.update()

    def _compile(self) -> None:
        """Compile the strain at the stress points, and its trace at the pressure points."""
        self._strain = self._points.compile(self._vector(self._lagrangian(self._moved)))
        self._volume_change = self._pressure_points.compile(self._dilatation(self._lagrangian(self._moved)))

    def _degree_of(self, u: fem.Function) -> int:
        """Degree of the displacement."""
        V, gdim, size = u.function_space, self.mesh.geometry.dim, u.function_space.dofmap.index_map_bs
        degree = compat.lagrange_degree(V)
        if self.displacement is not None:
            from uem_dolfinx.geometry.fields import degree_of_displacement

            degree, size = degree_of_displacement(V, self.displacement), gdim
        if size != gdim or self.mesh.topology.dim != gdim or degree not in (1, 2):
            raise SpaceError(
                f"plasticity needs a displacement in a vector Lagrange space of size {gdim} and degree 1 or 2 on a mesh of "
                f"dimension {gdim}: got size {size}, degree {degree}, dimension {self.mesh.topology.dim}"
                + ("; name its part of the mixed space, as displacement=0" if compat.is_mixed(V) else "")
            )
        return degree

    def _degrees(self, degree: int, quadrature_degree: int | None) -> tuple[int, int]:
        """Degrees of the quadrature of stress and of pressure."""
        gdim = self.mesh.geometry.dim
        check_kind(self.kind, self._moved)
        cell = compat.cell_name(self.mesh)
        simplex = cell in ("triangle", "tetrahedron")
        affine = simplex and compat.geometry_dofs(self.mesh).shape[1] == gdim + 1
        # one point is sufficient for constant strains only
        lowest = 1 if affine and degree == 1 else 2
        if quadrature_degree is not None and given.count("quadrature_degree", quadrature_degree) < lowest:
            expected = f"expected {lowest} or more for degree {degree} on {cell} cells"
            raise InputError(f"quadrature_degree = {quadrature_degree}: {expected}")
        stress, pressure = (SIMPLEX_DEGREES if simplex else TENSOR_DEGREES)[degree]
        stress = max(stress, lowest) if quadrature_degree is None else quadrature_degree
        return stress, min(stress, max(pressure, lowest) if simplex else pressure)

    def _read_parameters(self, E: Any, nu: Any, yield_stress: Any, hardening: Any, kinematic_hardening: Any) -> None:
        """Read the parameters of every cell, and repeat them for its points."""
        from uem_dolfinx.materials.hardening import is_table

        layered, count = is_table(kinematic_hardening), len(self._points.points)
        E = self._points.of_cells("E", E, given.POSITIVE)
        nu = self._points.of_cells("nu", nu, given.between(-1.0, 1.0) if self.kind == "plane_stress" and not layered else POISSON)
        self._E, self._nu = np.repeat(E, count), np.repeat(nu, count)
        self._mu = self._E / (2 * (1 + self._nu))
        self._bulk = np.zeros_like(E) if self.kind == "plane_stress" else E / (3 * (1 - 2 * nu))
        self._curve = self._read_curve(yield_stress, hardening)
        #: Parameters at this rank's points, by name, each ``(n_points,)``; for tables their columns.
        self.parameters = {"E": self._E, "nu": self._nu, **self._curve.parameters}
        if layered:
            self._read_layers(kinematic_hardening)
            return
        #: Increase of the back stress in uniaxial tension per plastic strain.
        self._modulus = self._pointwise("kinematic_hardening", kinematic_hardening, SLOPE_OR_TABLE)
        self.parameters["kinematic_hardening"] = self._modulus

    def _read_curve(self, yield_stress: Any, hardening: Any) -> YieldCurve:
        """Yield stress over peeq."""
        from uem_dolfinx.materials.hardening import Linear

        first = self._pointwise("yield_stress", yield_stress, given.POSITIVE_OR_INFINITE)
        return Linear(first, self._pointwise("hardening", hardening, given.NOT_NEGATIVE))

    def _read_layers(self, points: Any) -> None:
        """Make the layers of a table of back stresses, without isotropic hardening (collective)."""
        from uem_dolfinx.materials.hardening import Linear
        from uem_dolfinx.materials.layers import BackTable, Layers

        table, curve, error = BackTable.read(points), self._curve, None
        if not isinstance(curve, Linear) or curve.slope.any():
            error = InputError(
                "isotropic hardening together with a table of back stresses: expected hardening = 0 and yield_stress as a number or a DG0 "
                "Function; or give kinematic_hardening as a number, which any isotropic hardening can be combined with"
            )
        agree(self.comm, error)
        self._layers = Layers.of(table, curve.at(np.zeros_like(self._mu), np.arange(len(self._mu)))[0], self._mu)
        self._curve = self._layers.curve
        self.parameters |= {"kinematic_hardening": table.stresses, "plastic strains of kinematic_hardening": table.strains}

    def _pointwise(self, name: str, value: Any, within: given.Range) -> Array:
        """Values of a parameter at this rank's points; see ``of_cells`` (collective)."""
        return np.repeat(self._points.of_cells(name, value, within), len(self._points.points))

    def _create_history(self) -> int:
        """Make stress and history at the quadrature points, zero outside of the cells; returns the number of stress components."""
        size, at = {"3d": 6, "plane_strain": 4, "plane_stress": 3, "axisymmetric": 4}[self.kind], self._points
        # in plane stress single layers have out-of-plane stresses
        layers, of_each = (1, size) if self._layers is None else (self._layers.count, max(size, 4))
        self.stress = at.create_function("stress", size)
        self.plastic_strain = at.create_function("plastic_strain", layers * of_each)
        self.peeq = at.create_function("peeq", layers)
        self.history: dict[str, fem.Function] = {f.name: f for f in (self.plastic_strain, self.peeq)}
        self._kappa = fem.Function(compat.function_space(self.mesh, ("DG", 0)), name="bulk_modulus")
        self._kappa.x.array[compat.cell_dofs(self._kappa.function_space)[self.cells, 0]] = self._bulk
        return size

    def _create_functions(self) -> None:
        """Functions at the quadrature points, zero outside of this material's cells."""
        size, at = self._create_history(), self._points
        # Functions in the forms: the deviator, if the pressure is integrated separately, and the tangent
        self._s = self.stress if self.kind == "plane_stress" else at.create_function("deviator", size)
        self._a, self._c = at.create_function("a"), at.create_function("c")
        vectors = 1 if self._layers is None else self._layers.count + (self.kind == "plane_stress")
        self._m = at.create_function("m", vectors * size)
        self._own(self.stress, self._s, self._a, self._c, self._m, *self.history.values())

    def _own(self, *functions: fem.Function) -> None:
        """Mark Functions as fields of this law, so that a problem can check that the laws of all fields in F are given."""
        for f in functions:
            f.material = weakref.ref(self)

    def _part(self, v: Any) -> Any:
        """The displacement's part of a trial or test function of the space of ``u``; other arguments are returned unchanged."""
        return ufl.split(v)[self.displacement] if self.displacement is not None and isinstance(v, ufl.Argument) else v

    def _lagrangian(self, u: Any) -> Expr:
        return ufl.sym(displacement_gradient(u)) if self.strain == "small" else green_lagrange(u)

    def _variation(self, v: Any) -> Expr:
        """Derivative of the strain along ``v``."""
        G = displacement_gradient(self._part(v))
        return ufl.sym(G if self.strain == "small" else G + displacement_gradient(self._moved).T * G)

    def _vector(self, A: Any) -> Expr:
        """Components of a symmetric tensor in the order of ``Returned``."""
        root = 2**0.5
        if self.kind == "3d":
            return ufl.as_vector([A[0, 0], A[1, 1], A[2, 2], root * A[1, 2], root * A[0, 2], root * A[0, 1]])
        across = [A[2, 2]] if self.kind == "axisymmetric" else [] if self.kind == "plane_stress" else [0]
        return ufl.as_vector([A[0, 0], A[1, 1], *across, root * A[0, 1]])

    def _dilatation(self, A: Any) -> Expr:
        """Trace of a strain; for one point per axisymmetric cell, the trace at the cell's centre of mass, for the mean over circles."""
        if self.kind != "axisymmetric" or self._pressure_points.degree:
            return ufl.tr(A)
        return ufl.tr(A) + ufl.dot(ufl.grad(A[0, 0] + A[1, 1]), centre_of_mass(self.mesh))

    def residual(self, v: Any) -> ufl.Form:
        """Internal virtual work of the material's cells.

        Args:
            v: test function; in a mixed space its displacement part or the whole.

        Returns:
            The form, integrated over all cells, with zeros in cells of other materials, so that it may be added to integrals over any
            tagged cells.
        """
        variation = self._variation(v)
        work = ufl.dot(self._s, self._vector(variation)) * self._points.dx
        if self.kind == "plane_stress":
            return work
        pressed = self._kappa * self._dilatation(self._lagrangian(self._moved)) * self._dilatation(variation)
        return work + pressed * self._pressure_points.dx

    def stiffness(self, du: Any, v: Any) -> ufl.Form:
        """The part ``C : dE(u; du) : dE(u; v)`` of the tangent that is missing in ``ufl.derivative(residual(v), u)``.

        C is the symmetric consistent tangent of the last ``update``; except in plane stress only its deviatoric part, since the
        derivative includes the pressure.

        Args:
            du: trial function.
            v: test function.
        """
        A, B = self._variation(du), self._variation(v)
        tangent = self._a * ufl.inner(A, B) + self._c * ufl.tr(A) * ufl.tr(B)
        size = self.stress.function_space.dofmap.index_map_bs
        for first in range(0, self._m.function_space.dofmap.index_map_bs, size):
            m = ufl.as_vector([self._m[first + i] for i in range(size)])
            tangent -= ufl.dot(m, self._vector(A)) * ufl.dot(m, self._vector(B))
        return tangent * self._points.dx

    def update(self) -> None:
        """Stress and tangent at the present displacement, from the committed history; NotFiniteError if they are not (collective)."""
        with timed("return mapping"):
            with np.errstate(over="ignore", invalid="ignore"):
                trial = self._returned()
                stress = trial.stress.copy()
                if self.kind != "plane_stress":
                    stress[:, :3] += (self._bulk[:, None] * (self._volume_changes() @ self._spread.T)).reshape(-1, 1)
            self._refuse_infinite(stress)
            self._trial, self._at = trial, np.array(self.u.x.array)
            values = trial.stress, trial.a, trial.c, trial.m, stress
            for f, own in zip((self._s, self._a, self._c, self._m, self.stress), values):
                self._points.write(f, own)

    def _returned(self) -> Returned:
        """Stress, history and tangent at the present displacement, from the committed history."""
        plane, of = self.kind == "plane_stress", self._layers
        radial: Callable[..., Returned] = radial_return if of is None else of.radial_return
        flat: Callable[..., Returned] = plane_stress_return if of is None else of.plane_stress_return
        return (flat if plane else radial)(*self.begins_with())

    def _committed(self) -> tuple[Array, Array]:
        """Plastic strain ``(n, k)`` and peeq ``(n,)`` of all points, with layers one after another."""
        strains, peeq = map(self._points.read, self.history.values())
        return strains.reshape(peeq.size, strains.shape[1] // peeq.shape[1]), peeq.ravel()

    def _mean(self, values: Array) -> Array:
        """Weighted mean over the layers of each point; values ``(n, ...)`` are unchanged without layers."""
        return values if self._layers is None else self._layers.mean(values)

    def begins_with(self) -> tuple[Any, ...]:
        """Initial values of the return at the present displacement: strain, committed history and parameters, in its order."""
        elastic = [self._E, self._nu] if self.kind == "plane_stress" else [self._mu]
        begin = self._points.evaluate(self._strain), *self._committed(), *elastic
        return begin if self._layers is not None else (*begin, *self._curve.parameters.values(), self._modulus)

    @property
    def stress_in_forms(self) -> fem.Function:
        """The Function of the stress in ``residual``: its deviator, or in plane stress the whole stress."""
        return self._s

    def slopes(self, a: fem.Function, test: Any, onward: bool = False) -> PlasticSlopes:
        """Derivatives through load steps, backwards or ``onward``; arguments as in ``PlasticSlopes`` (collective)."""
        from uem_dolfinx.materials.return_slopes import PlasticChanges, PlasticSlopes

        kind = PlasticChanges if onward else PlasticSlopes
        return kind(self, self._points, self.stress_in_forms, self._kappa, *self._slopes_of_return(), a, test)

    def _slopes_of_return(self) -> tuple[Callable[[Any], Any], Callable[..., ByReturn]]:
        """Strain along a displacement, and derivatives of the return."""
        from uem_dolfinx.materials.return_slopes import plane_stress_back, radial_back

        plane, of = self.kind == "plane_stress", self._layers
        radial: Callable[..., ByReturn] = radial_back if of is None else of.radial_back
        flat: Callable[..., ByReturn] = plane_stress_back if of is None else of.plane_stress_back
        return lambda w: self._vector(self._variation(w)), flat if plane else radial

    def _refuse_infinite(self, stress: Array) -> None:
        """NotFiniteError on all ranks if a stress at this rank's points ``(n_points, size)`` is not finite (collective)."""
        bad, error = np.flatnonzero(~np.isfinite(stress).all(axis=1)), None
        if len(bad):
            error = NotFiniteError(
                f"strain or stress of the cell at {self._points.where(bad[0])} is NaN or infinite: "
                "check the displacement's initial values, the loads and the Dirichlet conditions, or take smaller load steps"
            )
        agree(self.comm, error)

    def _volume_changes(self) -> Array:
        """Trace of the strain at the pressure points ``(n_cells, n_pressure_points)``."""
        return self._pressure_points.evaluate(self._volume_change).reshape(self._pressure_points.volumes.shape)

    @timed_as("commit history")
    def commit(self) -> None:
        """Make the state of the last ``update`` the history (collective)."""
        for f, values in zip(self.history.values(), (self._trial.plastic_strain, self._trial.peeq)):
            self._points.write(f, values)
            f.x.scatter_forward()

    def energy(self) -> float:
        """Elastic energy at the present displacement, plus the energy of the back stress (collective)."""
        # a committed update at this displacement is not repeated
        known = self._at, self._trial.plastic_strain, self._trial.peeq
        if reduced(self.comm, not all(map(np.array_equal, known, (self.u.x.array, *self._committed())))):
            self.update()
        pressed = (self._bulk[:, None] * self._volume_changes() ** 2).ravel()
        return self._points.integrate(self._trial.energy) + self._pressure_points.integrate(pressed) / 2

    def dissipation(self) -> float:
        """Committed plastic work since the start, minus the work against the back stress (collective).

        It includes the energy stored by isotropic hardening. The work against the back stress is recoverable and part of ``energy``.
        The result depends on ``peeq`` only.
        """
        return self._points.integrate(self._mean(self._curve.work(self._committed()[1])))

    def cell_averages(self) -> dict[str, fem.Function]:
        """Means over the cells for output: ``stress`` and ``plastic_strain (3, 3)``, ``peeq`` and ``von_mises``, zero elsewhere.

        Returns:
            DG0 Functions by name, overwritten by every call (collective).
        """
        root = np.sqrt(0.5)
        full = {"stress": self._points.read(self.stress), "plastic_strain": self._plastic_strains()}
        for name, values in full.items():
            if values.shape[1] == 3:
                across = 0 * values[:, 0] if name == "stress" else -values[:, 0] - values[:, 1]
                values = np.insert(values, 2, across, axis=1)
            if values.shape[1] == 4:
                values = np.insert(values, [3, 3], 0.0, axis=1)
            full[name] = values * [1, 1, 1, root, root, root]
        deviator = full["stress"] - np.array([1, 1, 1, 0, 0, 0]) * full["stress"][:, :3].mean(axis=1, keepdims=True)
        fields = {name: values[:, [0, 5, 4, 5, 1, 3, 4, 3, 2]] for name, values in full.items()}
        fields["peeq"] = self._mean(self._committed()[1])[:, None]
        fields["von_mises"] = np.sqrt(1.5 * (deviator**2) @ [1, 1, 1, 2, 2, 2])[:, None]
        for name, values in fields.items():
            self._points.average(values, self._averages[name])
        return dict(self._averages)

    def _plastic_strains(self) -> Array:
        """Committed plastic strains for output ``(n_points, k)``."""
        return self._mean(self._committed()[0])

    @cached_property
    def _averages(self) -> dict[str, fem.Function]:
        scalars, tensors = compat.function_space(self.mesh, ("DG", 0)), compat.function_space(self.mesh, ("DG", 0), (3, 3))
        spaces = {"stress": tensors, "plastic_strain": tensors, "peeq": scalars, "von_mises": scalars}
        return {name: fem.Function(space, name=name) for name, space in spaces.items()}
