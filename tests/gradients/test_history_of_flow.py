"""Gradients through plastic flow: against differences and the closed form of a bar, on any ranks, and where they are refused.

Read first: ``test_a_bar_that_flows``, force over elongation of a bar that yields and is unloaded, in closed form.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, refused, run, scene, slow
from history_scenes import BACK_STRESSES, COMM, alone, bent, changes_of_flow, slope_alone, taylor

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.materials.back_stress import kinematic_return
from uem_dolfinx.materials.finite_plasticity import VARYING
from uem_dolfinx.materials.hardening import Linear, Saturating
from uem_dolfinx.materials.layers import BackTable, Layers
from uem_dolfinx.materials.logarithmic import logarithmic_return, to_components, to_tensors
from uem_dolfinx.materials.return_mapping import plane_stress_return, radial_return
from uem_dolfinx.materials.return_slopes import kinematic_back, logarithmic_back, plane_stress_back, radial_back

SCENES = [
    {"kind": "plane_stress"},
    slow({"friction": 0.2}),
    slow({"strain": "green_lagrange"}),
    slow({"cell": "hexahedron", "kind": "3d"}),
    slow({"law_of": uem.FinitePlasticity}),
    slow({"law_of": uem.FinitePlasticity, "cell": "hexahedron", "kind": "3d", "friction": 0.2}),
    slow({"kind": "plane_stress", "moves": 10.0}),
    slow({"moves": 10.0, "friction": 0.2}),
    slow({"moves": BACK_STRESSES}),
    slow({"moves": BACK_STRESSES, "kind": "plane_stress"}),
    slow({"law_of": uem.FinitePlasticity, "moves": 0.0}),
    slow({"law_of": uem.FinitePlasticity, "moves": 10.0, "cell": "hexahedron", "kind": "3d", "friction": 0.2}),
    slow({"law_of": uem.FinitePlasticity, "moves": BACK_STRESSES}),
]


def changes(s):
    """All controls of a scene, each with a change."""
    return [(control, control, change) for control, change in changes_of_flow(s)]


@pytest.mark.long
@pytest.mark.parametrize("how", SCENES)
def test_of_second_order(how):
    """``J(h) - J(0) - h J'`` vanishes with h^2 where the same points flow, and two ranks tell the same slope."""
    s = bent(**how)
    order, slope = taylor(s, changes(s), 1e-2)
    assert order >= 1.95, order
    if COMM.size > 1:
        one = bent(comm=alone(), **how)
        assert slope_alone(one, changes(one)) == pytest.approx(slope, rel=1e-10)


def bar():
    """A bar of height 1 in plane stress, free across, drawn to 2 % and back to 1.9 % in four steps, and the force in it."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    E, flow, strain = (fem.Constant(s.mesh, value) for value in (200.0, 0.4, 0.02))
    hardening = fem.Function(compat.function_space(s.mesh, ("DG", 0)))
    hardening.x.array[:] = 15.0
    law = uem.VonMises(u, E, 0.3, flow, hardening, kind="plane_stress")
    sides = [uem.dirichlet(V, s.tag(name, 0, at(i, 0.0)), i) for i, name in enumerate(("left", "bottom"))]
    top = s.tag("top", 0, at(1, 1.0))
    dofs = fem.locate_dofs_topological(V.sub(1), 1, top.entities)
    bcs = [*sides, fem.dirichletbc(strain, dofs, V.sub(1))]
    F, w = law.residual(v), fem.Function(V)
    compat.set_bc_values(w.x.array, [uem.dirichlet(V, top, 1, 1.0)])
    w.x.scatter_forward()
    return uem.UnitedProblem(F, u, bcs=bcs, materials=[law], rtol=1e-12), ufl.replace(F, {v: w}), (E, flow, hardening, strain)


def test_a_bar_that_flows():
    """The force ``E (Y + H e) / (E + H)``, less E times what it goes back by, and its derivatives by E, Y, H and e."""
    problem, force, controls = bar()
    E, Y, H, e, strain = 200.0, 0.4, 15.0, 0.02, controls[-1]
    with uem.recording(problem) as history:
        run(problem, 2)
        strain.value = 0.019
        run(problem, 2)
    assert uem.integrate(force) == pytest.approx(E * (Y + H * e) / (E + H) - E * 0.001, rel=1e-8)
    by_E, by_Y, by_H, _ = history.gradient([None, None, None, force], controls)
    assert float(by_E) == pytest.approx(H * (Y + H * e) / (E + H) ** 2 - 0.001, rel=1e-7)
    assert float(by_Y) == pytest.approx(E / (E + H), rel=1e-7)
    own = by_H.function_space.dofmap.index_map.size_local
    assert COMM.allreduce(by_H.x.array[:own].sum()) == pytest.approx(E * (E * e - Y) / (E + H) ** 2, rel=1e-7)
    (by_e,) = history.gradient([None, force, None, None], strain)
    assert float(by_e) == pytest.approx(E * H / (E + H), rel=1e-7)
    peeq = problem.materials[0].peeq
    refused(uem.InputError, "holds 'peeq', a field of a law with history", lambda: history.gradient(peeq * ufl.dx, strain))
    refused(uem.InputError, "is 'peeq', a field of a law with history", lambda: history.gradient(force, peeq))
    refused(
        uem.InputError,
        "the shape, by which",
        lambda: history.gradient(force, ufl.SpatialCoordinate(problem.u.function_space.mesh)),
    )


@pytest.mark.parametrize("k", [3, 4, 6])
def test_slopes_of_returns(k):
    """Of every return by strain, history and parameters, where points flow and where they do not, against central differences."""
    rng, n = np.random.default_rng(1), 40
    returned, back = (plane_stress_return, plane_stress_back) if k == 3 else (radial_return, radial_back)
    E, nu = 200.0 * (1.0 + rng.random(n)), np.full(n, 0.3)
    strain, plastic, deviatoric = rng.normal(size=(n, k)) * 2e-3, rng.normal(size=(n, k)) * 1e-3, rng.normal(size=(n, k)) * 1e-3
    if k > 3:
        plastic[:, :3] -= plastic[:, :3].mean(axis=1, keepdims=True)
        deviatoric[:, :3] -= deviatoric[:, :3].mean(axis=1, keepdims=True)
    begin = [strain, plastic, rng.random(n) * 0.01, E, nu, np.full(n, 0.8), 15.0 * rng.random(n), 9.0 * rng.random(n)]
    counts = rng.normal(size=(n, k)), rng.normal(size=(n, k)), rng.normal(size=n)

    def arguments(values):
        """Of a return."""
        *state, E, nu, flow, hardening, modulus = values
        return *state, *((E, nu) if k == 3 else (E / (2 * (1 + nu)),)), flow, hardening, modulus

    def counted(values):
        """What counts after a return."""
        found = returned(*arguments(values))
        return (found.stress * counts[0] + found.plastic_strain * counts[1]).sum(axis=1) + found.peeq * counts[2]

    flows = returned(*arguments(begin)).peeq > begin[2]
    assert 5 < flows.sum() < n - 5
    by = back(*arguments(begin), *counts)
    found = by.strain, by.plastic_strain, by.peeq, (by.shear + by.area) / E, by.area / (1 - nu) - by.shear / (1 + nu)
    found = *found, by.yield_stress, by.hardening, by.modulus
    sizes = rng.normal(size=(n, k)) * 1e-3, deviatoric, 0.01 * np.ones(n), 0.1 * E, 0.1 * nu, 0.1 * begin[5], begin[6], begin[7]
    for i, change in enumerate(sizes):
        ends = [counted([*begin[:i], begin[i] + h * change, *begin[i + 1 :]]) for h in (-1e-5, 1e-5)]
        slope = (found[i] * change).reshape(n, -1).sum(axis=1)
        assert (ends[1] - ends[0]) / 2e-5 == pytest.approx(slope, rel=1e-7, abs=1e-7 * np.abs(slope).max())


@pytest.mark.parametrize("kind", ["plane_strain", "axisymmetric", "3d"])
@pytest.mark.parametrize("curve", ["linear", "voce"])
@pytest.mark.parametrize("moves", [False, True])
def test_slopes_of_the_return_in_finite_strain(kind, curve, moves):
    """By gradient, history and parameters, at strains of a third, against central differences."""
    rng, n = np.random.default_rng(2), 40
    varying, k = VARYING[kind], 6 if kind == "3d" else 4
    c = len(varying[0])
    flow, slope = 0.8 + 0.1 * rng.random(n), 15.0 * rng.random(n)
    counts = rng.normal(size=(n, c)), rng.normal(size=(n, k)), rng.normal(size=n)
    parts = rng.normal(size=(2, n, k)) * np.where(np.arange(n) < n // 2, 5e-4, 0.05)[:, None]
    # flow keeps the volume, and so do the changes of what has flowed
    metric, grows = np.eye(3) - 2 * to_tensors(parts[0]), to_tensors(parts[1])
    metric /= np.linalg.det(metric)[:, None, None] ** (1 / 3)
    grows -= np.trace(np.linalg.solve(metric, grows), axis1=1, axis2=2)[:, None, None] / 3 * metric
    begin = [
        rng.normal(size=(n, c)) * 0.1,
        to_components((np.eye(3) - metric) / 2, k),
        rng.random(n) * 0.01,
        77.0 * (1.0 + rng.random(n)),
        flow,
        slope,
        20.0 * rng.random(n),
    ]
    returned, back = (kinematic_return, kinematic_back) if moves else (logarithmic_return, logarithmic_back)
    begin[0][: n // 2] *= 0.01

    def arguments(values):
        """Of the return."""
        moved, plastic, peeq, mu, flow, slope, modulus = values
        gradient = np.zeros((n, 3, 3))
        gradient[:, varying[0], varying[1]] = moved
        return (
            gradient,
            plastic,
            peeq,
            mu,
            Linear(flow, slope) if curve == "linear" else Saturating(flow, uem.Voce(0.5, 0.1, 2.0)),
            *([modulus] if moves else []),
            varying,
        )

    def counted(values):
        """What counts after a return."""
        found = returned(*arguments(values))
        return (
            (found.first_piola * counts[0]).sum(axis=1) + (found.plastic_strain * counts[1]).sum(axis=1) + found.peeq * counts[2]
        )

    flows = returned(*arguments(begin)).peeq > begin[2]
    assert flows.any() and not flows.all()
    by = back(*arguments(begin), *counts)
    found = [by.strain, by.plastic_strain, by.peeq, by.shear / begin[3], by.yield_stress]
    sizes = [rng.normal(size=(n, c)) * 0.1, to_components(grows, k), 0.1 * np.ones(n), 0.1 * begin[3], 0.1 * flow]
    found, sizes = [*found, by.hardening, by.modulus], [*sizes, slope, begin[6]]
    for i, change in enumerate(sizes):
        if i == 5 and curve == "voce":
            continue
        ends = [counted([*begin[:i], begin[i] + h * change, *begin[i + 1 :]]) for h in (-1e-5, 1e-5)]
        reported = (found[i] * change).reshape(n, -1).sum(axis=1)
        assert (ends[1] - ends[0]) / 2e-5 == pytest.approx(reported, rel=1e-6, abs=1e-6 * np.abs(reported).max()), i


@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_slopes_of_layers_in_plane_stress(nu):
    """By strain, history, E, nu and the yield stress, where some layers flow, against central differences."""
    rng, n, table = np.random.default_rng(3), 40, BackTable.read(BACK_STRESSES)
    j = len(table.strains)
    plastic, deviatoric = rng.normal(size=(2, n * j, 4)) * 5e-4
    for values in (plastic, deviatoric):
        values[:, :3] -= values[:, :3].mean(axis=1, keepdims=True)
    begin = [rng.normal(size=(n, 3)) * 4e-3, plastic, rng.random(n * j) * 0.01, 200.0 * (1.0 + rng.random(n)), np.full(n, nu)]
    begin.append(np.full(n, 0.4))
    counts = rng.normal(size=(n, 3)), rng.normal(size=(n * j, 4)), rng.normal(size=n * j)

    def layers(values):
        E, nu, flow = values[3:]
        return Layers.of(table, flow, E / (2 * (1 + nu)))

    def counted(values):
        found = layers(values).plane_stress_return(*values[:5])
        of_layers = (found.plastic_strain * counts[1]).sum(axis=1) + found.peeq * counts[2]
        return (found.stress * counts[0]).sum(axis=1) + of_layers.reshape(n, j).sum(axis=1)

    flows = layers(begin).plane_stress_return(*begin[:5]).peeq > begin[2]
    assert 0.1 < flows.mean() < 0.9
    by = layers(begin).plane_stress_back(*begin[:5], *counts)
    E = begin[3]
    found = (
        by.strain,
        by.plastic_strain,
        by.peeq,
        (by.shear + by.area) / E,
        by.area / (1 - nu) - by.shear / (1 + nu),
        by.yield_stress,
    )
    sizes = rng.normal(size=(n, 3)) * 1e-3, deviatoric, 0.01 * np.ones(n * j), 0.1 * E, 0.1 * begin[4], 0.1 * begin[5]
    for i, change in enumerate(sizes):
        ends = [counted([*begin[:i], begin[i] + h * change, *begin[i + 1 :]]) for h in (-1e-5, 1e-5)]
        slope = (found[i] * change).reshape(n, -1).sum(axis=1)
        assert (ends[1] - ends[0]) / 2e-5 == pytest.approx(slope, rel=1e-6, abs=1e-6 * np.abs(slope).max()), i


class OfUsers(uem.VonMises):
    """A law without derivatives through its history."""

    @property
    def slopes(self):
        raise AttributeError


def test_what_is_refused():
    """Laws whose memory has no derivatives, and single states of those that have."""
    s = bent()
    v = ufl.TestFunction(s.V)
    law = OfUsers(s.u, 200.0, 0.3, 0.4, kind="plane_stress")
    problem = uem.UnitedProblem(law.residual(v), s.u, materials=[law])
    refused(uem.InputError, "expected VonMises or FinitePlasticity", uem.recording(problem).__enter__)
    law = uem.VonMises(s.u, s.E, 0.3, 0.4, kind="plane_strain")
    problem = uem.UnitedProblem(law.residual(v), s.u, materials=[law])
    refused(uem.InputError, "take the steps within uem.recording(problem)", lambda: uem.gradient(problem, s.u[0] * ufl.dx, s.E))
