"""Derivatives of the return to the von Mises yield surface by its initial values, in reverse mode and in closed form.

The derivatives of a functional by strain, history and parameters follow from those by stress s, plastic strain and peeq after a return,
``(n, k)``, ``(n, k)`` and ``(n,)``. Yielding points are kept.

Derivatives of the return in logarithmic strain by its initial values, in reverse mode and in closed form.

With ``b = F (1 - 2 E_p) F^T``, its principal axes n_a and logarithmic strains t_a, the deviator d of these, and the flow dp,

    P = tau F^-T,    tau = sum_a a d_a n_a x n_a,                    a = 2 mu (1 - w),    w = 3 mu dp / q,    q = sqrt(6) mu |d|
    1 - 2 E_p' = F^-1 B F^-T,    B = sum_a exp(2 t_a - 2 w d_a) n_a x n_a,                q - 3 mu dp = yield stress at peeq + dp

Derivatives of tau and B by b are those of isotropic functions: divided differences apart from the diagonal. Yielding points are kept.

Derivatives of load steps of a law with history by the initial history and by the law's parameters, in both modes.

Derivatives by fields at quadrature points are densities: per volume of the point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.materials.back_stress import NO_VOLUME, Points, kinematic_return
from uem_dolfinx.materials.hardening import Linear, YieldCurve
from uem_dolfinx.materials.logarithmic import logarithm_slope, to_components, to_tensors
from uem_dolfinx.materials.quadrature_points import QuadraturePoints
from uem_dolfinx.materials.return_mapping import MODES, ON_SURFACE, plane_mises, plane_stress_return
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class ByReturn:
    """Derivatives by the initial values of a return, at n points.

    Attributes:
        strain, plastic_strain: ``(n, k)``, with the committed plastic strain.
        shear, area: by the logarithms of E / (1 + nu), and in plane stress of E / (1 - nu) ``(n,)``.
        yield_stress, hardening: ``(n,)``.
    """

    strain: Array
    plastic_strain: Array
    peeq: Array  # committed ``(n,)``
    shear: Array
    area: Array
    yield_stress: Array
    hardening: Array
    modulus: Array  # by the increase of the back stress per plastic strain ``(n,)``


def radial_back(
    strain: Array, plastic_strain: Array, peeq: Array, mu: Array, yield_stress: Array, hardening: Array, modulus: Array,
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Derivatives of ``radial_return``, whose arguments come first.

    With the trial deviator t, ``o = t - 2/3 K E_p``, ``q = |o| sqrt(3/2)``, ``N = o / q`` and ``dp = (q - flow) / (3 mu + H + K)`` a
    yielding point has

        s = t - 3 mu dp N,    E_p + 3/2 dp N,    peeq + dp
    """
    t = strain - plastic_strain
    t[:, :3] -= t[:, :3].mean(axis=1, keepdims=True)
    t *= 2 * mu[:, None]
    over = t - 2 / 3 * modulus[:, None] * plastic_strain
    q = np.sqrt(1.5) * np.linalg.norm(over, axis=1)
    flow = yield_stress + hardening * peeq
    i = np.flatnonzero(q > (1 + ON_SURFACE) * flow)
    by_over, of_dp = np.zeros_like(t), np.zeros_like(q)
    stiff, N = 3 * mu[i] + hardening[i] + modulus[i], over[i] / q[i, None]
    dp = (q[i] - flow[i]) / stiff
    by_flow = 1.5 * by_plastic_strain[i] - 3 * mu[i, None] * by_stress[i]
    along = (by_flow * N).sum(axis=1)
    of_dp[i] = along + by_peeq[i]
    turned = (dp / q[i])[:, None] * (by_flow - 1.5 * along[:, None] * N)
    by_over[i] = (1.5 * of_dp[i] / stiff)[:, None] * N + turned
    by_t = by_stress + by_over
    by_shear = (by_t * t).sum(axis=1)
    by_shear[i] -= 3 * mu[i] * dp * ((by_stress[i] * N).sum(axis=1) + of_dp[i] / stiff)
    by_t[:, :3] -= by_t[:, :3].mean(axis=1, keepdims=True)
    by_strain = 2 * mu[:, None] * by_t
    by_yield, by_hardening = np.zeros_like(q), np.zeros_like(q)
    by_yield[i] = -of_dp[i] / stiff
    by_hardening[i] = by_yield[i] * (peeq[i] + dp)
    by_modulus = -2 / 3 * (by_over * plastic_strain).sum(axis=1)
    by_modulus[i] += by_yield[i] * dp
    return ByReturn(
        by_strain, by_plastic_strain - by_strain - 2 / 3 * modulus[:, None] * by_over, by_peeq + hardening * by_yield, by_shear,
        0.0 * q, by_yield, by_hardening, by_modulus,
    )  # fmt: skip


def plane_stress_back(
    strain: Array, plastic_strain: Array, peeq: Array, E: Array, nu: Array, yield_stress: Array, hardening: Array, modulus: Array,
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Of ``plane_stress_return``, whose arguments come first, with its modes m, its unknown x and ``h(x) = 0`` differentiated."""
    shear, area = E / (1 + nu), E / (1 - nu)
    C, third = np.stack([area, shear, shear]), np.array([[3.0], [1.0], [1.0]])
    m, flowed = MODES @ (strain - plastic_strain).T * C, third * (MODES @ plastic_strain.T)
    flow, over = yield_stress + hardening * peeq, m - 2 / 3 * modulus * flowed
    i = np.flatnonzero(plane_mises(over[0] ** 2, over[1] ** 2 + over[2] ** 2) > (1 + ON_SURFACE) * flow)
    by_m, by_over = MODES @ by_stress.T, np.zeros_like(m)
    by_yield, by_hardening = np.zeros_like(E), np.zeros_like(E)
    b, H, r, k = shear[i], hardening[i], (area / shear)[i] / 3, (2 / 3 * modulus / shear)[i]
    after = plane_stress_return(strain, plastic_strain, peeq, E, nu, yield_stress, hardening, modulus)
    e = MODES @ by_plastic_strain[i].T
    # the differences from the back stress are on the yield surface
    q = flow[i] + H * (after.peeq[i] - peeq[i])
    x = 1.5 * b * (after.peeq[i] - peeq[i]) / q
    y, z = 1 / (1 + (r + k) * x), 1 / (1 + (1 + k) * x)
    shrunk, slope = np.stack([y, z, z]), 2 * H / (3 * b)
    t, moved = shrunk * over[:, i], (1 + k * x) * by_m[:, i]
    of_q = np.stack([0.5 * t[0], 1.5 * t[1], 1.5 * t[2]]) / q
    by_flow = (t / third * e).sum(axis=0) / b
    by_t = moved + x / b * e / third + by_peeq[i] * x / (1.5 * b) * of_q
    t_x = -np.stack([(r + k) * y, (1 + k) * z, (1 + k) * z]) * t
    along = (by_m[:, i] * t).sum(axis=0)
    by_x = k * along + by_flow + by_peeq[i] * q / (1.5 * b) + (by_t * t_x).sum(axis=0)
    h_x = slope - flow[i] / q**2 * (of_q * t_x).sum(axis=0)
    root = by_x / h_x
    by_t = by_t + root * flow[i] / q**2 * of_q
    by_over[:, i] = shrunk * by_t - by_m[:, i]
    by_m = by_m + by_over
    by_yield[i] = -root / q
    by_hardening[i] = by_yield[i] * peeq[i] - root * 2 * x / (3 * b)
    by_area, by_shear = by_m[0] * m[0], (by_m[1:] * m[1:]).sum(axis=0)
    of_ratio, of_k = -r * x * y * t[0] * by_t[0], x * (along - (by_t * shrunk * t).sum(axis=0))
    by_area[i] += of_ratio
    by_shear[i] += root * slope * x - x * by_flow - by_peeq[i] * x * q / (1.5 * b) - of_ratio - k * of_k
    by_modulus = -2 / 3 * (by_over * flowed).sum(axis=0)
    by_modulus[i] += 2 / 3 * of_k / b
    by_strain = (MODES.T @ (C * by_m)).T
    by_plastic_strain = by_plastic_strain - by_strain - (MODES.T @ (2 / 3 * modulus * third * by_over)).T
    return ByReturn(
        by_strain, by_plastic_strain, by_peeq + hardening * by_yield, by_shear, by_area, by_yield, by_hardening, by_modulus
    )


def logarithmic_back(
    gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, curve: YieldCurve, components: Sequence[Ints],
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Derivatives of ``logarithmic_return``, whose arguments come first, from those by its first Piola-Kirchhoff stress and history.

    ``strain`` of the result is by the components of the gradient, ``hardening`` by the slope of a linear curve.
    """
    size, n = plastic_strain.shape[1], len(mu)
    F, C = gradient + np.eye(3), np.eye(3) - 2 * to_tensors(plastic_strain)
    G = np.asarray(np.linalg.inv(F), dtype=np.float64)
    squares, axes = np.linalg.eigh(F @ C @ F.transpose(0, 2, 1))
    t = np.log(squares) / 2
    d = t - t.mean(axis=1, keepdims=True)
    q, dp, slope = np.sqrt(6.0) * mu * np.linalg.norm(d, axis=1), np.zeros(n), np.zeros(n)
    i = np.flatnonzero(q > (1 + ON_SURFACE) * curve.at(peeq, np.arange(n))[0])
    dp[i] = curve.increment(q[i], peeq[i], 3 * mu[i], i)
    slope[i] = curve.at(peeq[i] + dp[i], i)[1]
    yields = np.isin(np.arange(n), i)
    over = np.where(q > 0, q, 1.0)
    w = 3 * mu * dp / over
    a, kept = 2 * mu * (1 - w), np.exp(2 * t - 2 * w[:, None] * d)

    # by tau and B, in principal axes
    P = np.zeros((n, 3, 3))
    P[:, components[0], components[1]] = by_stress
    M = -to_tensors(by_plastic_strain) / 2
    by_tau, of_plastic = _in_axes(axes, P @ G), _in_axes(axes, G.transpose(0, 2, 1) @ M @ G)
    pushed, pulled = (np.einsum("naa->na", by) for by in (by_tau, of_plastic))

    # by the strains along the axes
    by_w = -2 * (kept * d * pulled).sum(axis=1) - 2 * mu * (d * pushed).sum(axis=1)
    by_mu = 2 * (1 - w) * (d * pushed).sum(axis=1) + 3 * dp / over * by_w
    of_dp = np.where(yields, 3 * mu / over * by_w + by_peeq, 0.0)
    root = of_dp / (3 * mu + slope)
    by_q = np.where(yields, root - w / over * by_w, 0.0)
    by_mu = by_mu - 3 * dp * root + q / mu * by_q
    by_d = a[:, None] * pushed - 2 * w[:, None] * kept * pulled + (6 * mu**2 * by_q / over)[:, None] * d
    by_t = by_d - by_d.mean(axis=1, keepdims=True) + 2 * kept * pulled

    # by b: divided differences of tau and B by the squares
    ratio = squares[:, :, None] / squares[:, None, :]
    divided = logarithm_slope(ratio - 1.0) / squares[:, None, :] / 2
    far = np.log(ratio)
    same = far == 0.0
    grown = np.where(same, (1 - w)[:, None, None], np.expm1((1 - w)[:, None, None] * far) / np.where(same, 1.0, np.expm1(far)))
    by_b = a[:, None, None] * divided * by_tau + (kept / squares)[:, None, :] * grown * of_plastic
    by_b[:, range(3), range(3)] = by_t / (2 * squares)
    by_b = axes @ by_b @ axes.transpose(0, 2, 1)

    # by F: through b, and through its inverse
    tau, B = ((axes * values[:, None, :]) @ axes.transpose(0, 2, 1) for values in (a[:, None] * d, kept))
    of_inverse = P.transpose(0, 2, 1) @ tau + 2 * M @ G @ B
    of_gradient = 2 * by_b @ F @ C - G.transpose(0, 2, 1) @ of_inverse @ G.transpose(0, 2, 1)
    of_metric = F.transpose(0, 2, 1) @ by_b @ F
    flow = np.where(yields, -root, 0.0)
    return ByReturn(
        of_gradient[:, components[0], components[1]], to_components(-2 * of_metric, size), by_peeq + slope * flow, by_mu * mu, 0.0 * mu,
        flow, flow * (peeq + dp), 0.0 * mu,
    )  # fmt: skip


def kinematic_back(
    gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, curve: YieldCurve, modulus: Array, components: Sequence[Ints],
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Derivatives of ``kinematic_return``, whose arguments come first, as of ``logarithmic_back``.

    At the minimum the slope g of the potential by further flow S vanishes, so that ``S' = -H^-1 dg`` with its second derivative H. The
    stress is elastic at the new plastic strain, ``E_p' = L S L^T``.
    """
    done = kinematic_return(gradient, plastic_strain, peeq, mu, curve, modulus, components)
    elastic = Linear(np.full(len(mu), np.inf), np.zeros(len(mu)))
    by = logarithmic_back(
        gradient, done.plastic_strain, done.peeq, mu, elastic, components, by_stress, by_plastic_strain, by_peeq
    )
    i, one = np.flatnonzero(done.peeq > peeq), np.eye(3)
    F, L = gradient[i] + one, np.asarray(np.linalg.cholesky(one - 2 * to_tensors(done.plastic_strain[i])), dtype=np.float64)
    points = Points(i, F.transpose(0, 2, 1) @ F, one - 2 * to_tensors(plastic_strain[i]), mu[i], modulus[i], peeq[i])
    step, D, root = points.step(L, curve), points.flowed(L), np.sqrt(2 / 3)
    (along, length), (stress, hardening) = step.flow, step.curve
    longer = root * by_peeq[i, None] * along
    load = to_components(L.transpose(0, 2, 1) @ to_tensors(by.plastic_strain[i]) @ L, 6) + longer
    z = -np.asarray(np.linalg.solve(step.hessian, (load @ NO_VOLUME)[:, :, None])[:, :, 0])
    of_stress = root * (z * along).sum(axis=1)
    # by the plastic strain of the step, and through it by the committed one
    across = z - (z * along).sum(axis=1)[:, None] * along
    by_flow = (root * stress / length)[:, None] * across + (root * hardening * of_stress)[:, None] * along + longer
    back = D.axes.transpose(0, 2, 1) @ np.linalg.inv(L)
    by_committed = D.divided * (D.axes.transpose(0, 2, 1) @ to_tensors(by_flow) @ D.axes)
    by_committed = -back.transpose(0, 2, 1) @ by_committed @ back
    found = {field.name: np.array(getattr(by, field.name)) for field in fields(by)}
    found["strain"][i] += np.einsum("ms,msc->mc", z, points.mixed(L, F, components))
    found["plastic_strain"][i] = to_components(by_committed, plastic_strain.shape[1])
    found["peeq"][i] += hardening * of_stress
    found["shear"][i] -= 2 * mu[i] * ((z @ NO_VOLUME) * step.elastic).sum(axis=1)
    found["yield_stress"][i] = of_stress
    found["hardening"][i] = of_stress * step.peeq
    found["modulus"][i] = 2 / 3 * ((z @ NO_VOLUME) * step.plastic).sum(axis=1)
    return ByReturn(**found)


def _in_axes(axes: Array, A: Array) -> Array:
    """The symmetric part of tensors in principal axes, ``(n, 3, 3)``."""
    return np.asarray(axes.transpose(0, 2, 1) @ (A + A.transpose(0, 2, 1)) @ axes / 2)


class PlasticSlopes:
    """Derivatives through the steps of one law, from the last to the first (the constructor is collective).

    Args:
        law: the law, with the initial values ``begins_with`` of its return and its parameters ``handed``.
        points: quadrature points of its stress.
        stress, bulk: Functions of its stress, and of its bulk modulus, in forms.
        along: returns the strain along a displacement, an expression with the components of the stress.
        back: derivatives of the return, see ``return_slopes``.
        a: adjoint displacement, a Function.
        test: test function of the displacement.

    Attributes:
        stress, bulk: as given.
    """

    def __init__(
        self, law: Any, points: QuadraturePoints, stress: fem.Function, bulk: fem.Function, along: Callable[[Any], Any],
        back: Callable[..., ByReturn], a: fem.Function, test: Any,
    ):  # fmt: skip
        self.stress, self.bulk, self._law, self._points, self._back = stress, bulk, law, points, back
        self._along_a = points.compile(along(a))
        size = stress.function_space.dofmap.index_map_bs
        self._pulled = points.create_function("pulled", size)
        self._V, self._load = a.function_space, forms.form(ufl.dot(self._pulled, along(test)) * points.dx)
        n = points.volumes.size
        self._by_stress = np.zeros((n, size))
        #: Derivatives by plastic strain and peeq at the end of the step, after ``pass_back`` at its beginning; forwards their changes.
        self._by_history: tuple[Array, ...] = tuple(np.zeros_like(values) for values in law.begins_with()[1:3])
        self._state: tuple[Any, ...] = ()

    def begin(self, by_stress: Array | None) -> None:
        """Begin a step, with the law set to its end.

        Args:
            by_stress: derivative of a functional by the owned values of ``stress``, or None.
        """
        self._state = self._law.begins_with()
        self._by_stress = np.zeros_like(self._by_stress)
        if by_stress is not None:
            values = self._points.create_function("by stress", self._by_stress.shape[1])
            values.x.array[: len(by_stress)] = by_stress
            self._by_stress = self._points.read(values) / self._points.volumes.reshape(-1, 1)

    def load(self) -> Array:
        """Derivative by the owned displacement at the step's end ``(n,)``, through stress and history there (collective)."""
        self._points.write(self._pulled, self._back(*self._state, self._by_stress, *self._by_history).strain)
        return forms.assemble_array(self._V, self._load)

    def pass_back(self) -> ByReturn:
        """Compute derivatives by the initial history of the step, with the adjoint displacement a; returns all (collective)."""
        stress = self._by_stress - self._points.evaluate(self._along_a)
        by = self._back(*self._state, stress, *self._by_history)
        self._by_history = by.plastic_strain, by.peeq
        return by

    def is_made_of(self, m: Any) -> bool:
        """Whether a control is a parameter of the law."""
        return any(m is value for value in self._law.handed.values())

    def by_parameter(self, m: fem.Constant | fem.Function, by: ByReturn, by_bulk: fem.Function) -> Array | fem.Function:
        """Derivative by a parameter, of its type (collective).

        Args:
            m: the parameter as passed to the law.
            by: as returned by ``pass_back``.
            by_bulk: derivative by the values of ``bulk``.
        """
        points, known = self._points, self._law.parameters
        volumes, of_cells, E, nu = self._points.volumes, np.zeros(len(points.cells)), known["E"], known["nu"]
        at_points = {
            "E": (by.shear + by.area) / E,
            "nu": by.area / (1 - nu) - by.shear / (1 + nu),
            "yield_stress": by.yield_stress,
            "hardening": by.hardening,
            "kinematic_hardening": by.modulus,
        }
        # of the bulk modulus, E / 3 / (1 - 2 nu)
        rates = {"E": 1 / E, "nu": 2 / (1 - 2 * nu)}
        at = compat.cell_dofs(by_bulk.function_space)[points.cells, 0]
        of_bulk = by_bulk.x.array[at] * self.bulk.x.array[at]
        for name, value in self._law.handed.items():
            if value is m:
                of_cells += (at_points[name].reshape(volumes.shape) * volumes).sum(axis=1)
                of_cells += of_bulk * (rates[name].reshape(volumes.shape)[:, 0] if name in rates else 0.0)
        if isinstance(m, fem.Constant):
            return np.asarray(reduced(points.mesh.comm, float(of_cells.sum())))
        found = fem.Function(m.function_space)
        found.x.array[compat.cell_dofs(m.function_space)[points.cells, 0]] = of_cells
        found.x.scatter_forward()
        return found


class PlasticChanges(PlasticSlopes):
    """Changes through the steps of one law along a direction, from the first to the last; arguments as of ``PlasticSlopes``.

    The derivatives of a return in reverse mode, for each of its results in turn, are the rows of its Jacobian.
    """

    def begin_along(self, direction: Sequence[tuple[Any, Any]]) -> tuple[Array, fem.Function]:
        """Begin a step, with the law set to its end, along changes of parameters as passed to the law (collective).

        Returns changes at the same displacement, of the residual by the stress ``(n,)``, and of ``bulk``.
        """
        self._state = self._law.begins_with()
        n, k = self._by_stress.shape
        m = k + sum(f.function_space.dofmap.index_map_bs for f in (self._law.plastic_strain, self._law.peeq))
        units = np.broadcast_to(np.eye(m)[:, None], (m, n, m))
        self._rows = [self._back(*self._state, *self._parted(unit)) for unit in units]
        changes, known = {name: np.zeros(n) for name in self._law.handed}, self._law.parameters
        for name, value in self._law.handed.items():
            for m, change in direction:
                if m is value:
                    changes[name] += self._at_points(m, change)
        E, nu = changes["E"] / known["E"], changes["nu"]
        # of the logarithms of E / (1 + nu), E / (1 - nu) and E / 3 / (1 - 2 nu)
        logs = E - nu / (1 + known["nu"]), E + nu / (1 - known["nu"]), E + 2 * nu / (1 - 2 * known["nu"])
        self._explicit = np.stack(
            [
                row.shear * logs[0] + row.area * logs[1] + row.yield_stress * changes["yield_stress"]
                + row.hardening * changes["hardening"] + row.modulus * changes["kinematic_hardening"]
                for row in self._rows
            ]
        )  # fmt: skip
        self._points.write(self._pulled, self._after(np.zeros((n, k)))[:, :k])
        bulk = fem.Function(self.bulk.function_space)
        at = compat.cell_dofs(bulk.function_space)[self._points.cells, 0]
        bulk.x.array[at] = self.bulk.x.array[at] * logs[2].reshape(self._points.volumes.shape)[:, 0]
        bulk.x.scatter_forward()
        return forms.assemble_array(self._V, self._load), bulk

    def end(self) -> None:
        """End the step, with a, the change of the displacement (collective)."""
        self._by_history = self._parted(self._after(self._points.evaluate(self._along_a)))[1:]

    def _parted(self, values: Array) -> tuple[Array, Array, Array]:
        """Values of stress, plastic strain and peeq side by side ``(n, m)``, in their shapes; layers are points of their own."""
        plastic, peeq = self._by_history
        k, j = self._by_stress.shape[1], self._law.peeq.function_space.dofmap.index_map_bs
        return values[:, :k], values[:, k:-j].reshape(plastic.shape), values[:, -j:].reshape(peeq.shape)

    def _after(self, strain: Array) -> Array:
        """Changes of stress, plastic strain and peeq after the return, with a change of the strain, side by side."""
        plastic, peeq = self._by_history
        n, j = len(strain), self._law.peeq.function_space.dofmap.index_map_bs
        parts = []
        for row in self._rows:
            of_layers = (row.plastic_strain * plastic).sum(axis=1) + row.peeq * peeq
            parts.append((row.strain * strain).sum(axis=1) + of_layers.reshape(n, j).sum(axis=1))
        return np.asarray((np.stack(parts) + self._explicit).T)

    def _at_points(self, m: Any, change: Any) -> Array:
        """Change of a parameter at the points ``(n,)``."""
        shape = self._points.volumes.shape
        if isinstance(m, fem.Constant):
            return np.full(shape[0] * shape[1], float(change))
        return np.repeat(change.x.array[compat.cell_dofs(change.function_space)[self._points.cells, 0]], shape[1])
