"""Von Mises plasticity: kernels against slow references, closed forms of simple paths, balance of energy, limit loads.

Worth reading first: ``test_return_solves_the_equations_of_plasticity`` and ``test_limit_load_of_a_tube``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import Scene, at, box, clamp, highest, run, scene
from petsc4py import PETSc
from scipy.optimize import root

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.materials import von_mises as plasticity

KINDS = {3: "plane_stress", 4: "plane_strain", 6: "3d"}
E, NU, FY, H = 200.0, 0.3, 0.4, 15.0
MU = E / (2 * (1 + NU))
ONE = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


# -- kernels -----------------------------------------------------------------------------------------------------------


def kernel(k: int):
    """The return of vectors with k components, of strain and committed history."""
    law = plasticity.plane_stress_return if k == 3 else plasticity.radial_return
    elastic = (E, NU) if k == 3 else (MU,)

    def returned(strain, plastic_strain, peeq, hardening=H):
        n = len(strain)
        return law(strain, plastic_strain, peeq, *(np.full(n, x) for x in (*elastic, FY, hardening)))

    return returned


def states(k: int, n: int = 40):
    """Strains from elastic to 20 times the yield strain, and histories that plastic flow can leave behind."""
    rng = np.random.default_rng(k)
    plastic = 0.01 * rng.standard_normal((n, k))
    if k > 3:
        plastic[:, :3] -= plastic[:, :3].mean(axis=1, keepdims=True)
    strain = plastic + FY / E * rng.standard_normal((n, k)) * rng.choice([0.1, 1.0, 20.0], (n, 1))
    return strain, plastic, 0.02 * rng.random(n)


def slow_return(strain, plastic, peeq, hardening):
    """Stress, plastic strain and peeq of one point from the equations of plasticity in 3D, by a general root finder.

    Unknown are the stress over FY, the strain across the plane where there is one, and the increment of peeq over the yield strain.
    """
    k, unit = len(strain), FY / E
    inside = {3: [0, 1, 5], 4: [0, 1, 2, 5], 6: list(range(6))}[k]
    eps, before = np.zeros(6), np.zeros(6)
    eps[inside], before[inside] = strain, plastic
    if k == 3:
        before[2] = -before[0] - before[1]
    compliance = ((1 + NU) * np.eye(6) - NU * np.outer(ONE, ONE)) / E

    def mises(s):
        return np.sqrt(1.5) * np.linalg.norm(s - ONE * s[:3].mean())

    def state(x, flowing):
        s, across, dp = FY * x[:6], unit * x[6], unit * x[7] * flowing
        total = eps.copy()
        total[2] += across
        normal = 1.5 * (s - ONE * s[:3].mean()) / max(mises(s), 1e-300)
        return s, total, before + dp * normal, peeq + dp

    def equations(x, flowing):
        s, total, ep, p = state(x, flowing)
        hooke = (compliance @ s - total + ep) / unit
        plane = x[2] if k == 3 else x[6]
        surface = (mises(s) - FY - hardening * p) / FY if flowing else x[7]
        return [*hooke, plane, surface]

    guess = np.zeros(8)
    for flowing in (False, True):
        solution = root(equations, guess, args=(flowing,), method="hybr", options={"xtol": 1e-13})
        s, _, ep, p = state(solution.x, flowing)
        assert np.abs(equations(solution.x, flowing)).max() < 1e-9
        if mises(s) <= FY + hardening * p + 1e-9 * FY:
            break
        # start the flow from the elastic stress scaled back
        guess = solution.x.copy()
        guess[:6] *= (FY + hardening * p) / mises(s)
        guess[7] = 0.5 * (mises(s) / FY - 1)
    if k != 3:
        s = s - ONE * s[:3].mean()
    return s[inside], ep[inside], p


@pytest.mark.parametrize("hardening", [0.0, H])
@pytest.mark.parametrize("k", KINDS)
def test_return_solves_the_equations_of_plasticity(k, hardening):
    given = states(k)
    fast = kernel(k)(*given, hardening)
    slow = [slow_return(*point, hardening) for point in zip(*given)]
    plastic = fast.peeq > given[2]
    assert 5 < plastic.sum() < len(plastic) - 5
    for values, reference, scale in zip((fast.stress, fast.plastic_strain, fast.peeq), zip(*slow), (FY, FY / E, FY / E)):
        assert np.abs(values - np.array(reference)).max() < 1e-7 * scale


@pytest.mark.parametrize("hardening", [0.0, H])
@pytest.mark.parametrize("k", KINDS)
def test_tangent_is_derivative_of_the_stress(k, hardening):
    strain, *before = states(k)
    returned, h = kernel(k), 1e-6 * FY / E
    tangent = returned(strain, *before, hardening).tangent
    assert np.abs(tangent - tangent.transpose(0, 2, 1)).max() < 1e-14 * E
    for j in range(k):
        step = h * np.eye(k)[j]
        slope = (returned(strain + step, *before, hardening).stress - returned(strain - step, *before, hardening).stress) / (
            2 * h
        )
        assert np.abs(slope - tangent[:, :, j]).max() < 1e-6 * E
    # the plastic parts only soften
    elastic = returned(0 * strain, *(0 * x for x in before)).tangent
    assert np.linalg.eigvalsh(elastic - tangent).min() > -1e-12 * E
    assert np.linalg.eigvalsh(tangent).min() > -1e-12 * E


def test_plane_stress_return_converges_from_every_state():
    """The steps are bounded by far more than the worst of these states needs, whatever its scale and its path."""
    rng, n = np.random.default_rng(1), 20000
    scale, size = 10 ** rng.uniform(-3, 12, n), 10 ** rng.uniform(-6, 0, n)
    nu, hardening = rng.uniform(-0.9, 0.999, n), scale * rng.choice([0.0, 1e-3, 1.0, 10.0], n)
    strain = rng.standard_normal((n, 3)) * (size * 10 ** rng.uniform(0, 6, n))[:, None]
    strain[: n // 3] *= [1.0, 1.0, 0.0]
    strain[: n // 6, 1] = strain[: n // 6, 0]
    new = plasticity.plane_stress_return(strain, 0 * strain, np.zeros(n), scale, nu, scale * size, hardening)
    s = new.stress
    mises = np.sqrt(s[:, 0] ** 2 - s[:, 0] * s[:, 1] + s[:, 1] ** 2 + 1.5 * s[:, 2] ** 2)
    flows = new.peeq > 0
    assert flows.mean() > 0.9
    assert np.abs(mises / (scale * size + hardening * new.peeq) - 1)[flows].max() < 1e-10


def test_plane_strain_is_3d_held_across():
    """The plastic strain across the plane is part of the history, and the elastic one makes up for it."""
    strain, plastic, peeq = states(4)
    wide = [np.insert(x, [3, 3], 0.0, axis=1) for x in (strain, plastic)]
    plane, full = kernel(4)(strain, plastic, peeq), kernel(6)(*wide, peeq)
    for name in ("stress", "plastic_strain"):
        assert np.abs(np.insert(getattr(plane, name), [3, 3], 0.0, axis=1) - getattr(full, name)).max() < 1e-15
    assert np.abs(plane.plastic_strain[:, 2]).max() > FY / E
    assert np.abs(plane.plastic_strain[:, :3].sum(axis=1)).max() < 1e-15


# -- scenes ------------------------------------------------------------------------------------------------------------


def block(comm: MPI.Comm, cell: str, n: int = 2, degree: int = 1, **how: Any) -> tuple[Scene, fem.Function]:
    """Unit square or cube with a displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], **how)
    return s, fem.Function(compat.function_space(s.mesh, degree, (g,)), name="u")


def skewed(X: np.ndarray) -> np.ndarray:
    """A map that leaves no cell a parallelogram."""
    return X + 0.1 * np.sin(3 * X[:, ::-1] + X)


def deform(u: fem.Function, gradient: Any) -> None:
    """Homogeneous displacement."""
    g = u.function_space.mesh.geometry.dim
    u.x.array[:] = (u.function_space.tabulate_dof_coordinates()[:, :g] @ np.asarray(gradient).T).ravel()


def wiggle(u: fem.Function, size: float) -> None:
    """Smooth displacement that is not homogeneous."""
    g = u.function_space.mesh.geometry.dim
    X = u.function_space.tabulate_dof_coordinates()[:, :g]
    u.x.array[:] = size * np.stack([np.sin(2 * X[:, i] + i) * np.cos(X[:, (i + 1) % g]) for i in range(g)], axis=1).ravel()


def vector(form: ufl.Form, V: Any) -> np.ndarray:
    """Assembled owned entries."""
    b = compat.create_vector(V)
    forms.assemble_vector(b, compat.form(form))
    return np.array(b.array_r)


def matrix(form: ufl.Form) -> PETSc.Mat:
    """Assembled."""
    compiled = compat.form(form)
    A = forms.create_matrix(compiled)
    forms.assemble_matrix(A, compiled)
    return A


def spread(material: uem.VonMises, name: str) -> tuple[np.ndarray, float]:
    """Mean over this rank's points of a quadrature Function, and how far any point is from it."""
    f = getattr(material, name)
    values = material._points.read(f)
    mean = np.mean(f.function_space.mesh.comm.allgather(values.mean(axis=0)), axis=0)
    return mean, highest(material.comm, np.abs(values - mean))


def uniaxial(comm: MPI.Comm, cell: str, kind: str, strain: str) -> tuple[uem.UnitedProblem, uem.VonMises, fem.Constant]:
    """A bar on rollers whose end is drawn by ``stretch``; the load function sets it."""
    s, u = block(comm, cell)
    V, g = u.function_space, s.mesh.geometry.dim
    material = uem.VonMises(u, E, NU, FY, H, kind=kind, strain=strain)
    end = s.tag("end", 0, at(0, 1.0))
    pulled = fem.Constant(s.mesh, 0.0)
    bcs = [bc for c in range(g) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    dofs = fem.locate_dofs_topological(V.sub(0), g - 1, end.entities)
    bcs.append(fem.dirichletbc(pulled, dofs, V.sub(0)))
    F = material.residual(ufl.TestFunction(V))
    return uem.UnitedProblem(F, u, bcs=bcs, materials=[material], petsc_options_prefix="bar_", rtol=1e-11), material, pulled


def reaction(problem: uem.UnitedProblem) -> float:
    """Work of the internal forces on the present displacement."""
    problem.system.assemble_residual()
    r = problem.system.residual.array_r
    return problem.comm.allreduce(float(r @ problem.u.x.array[: len(r)]))


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strain", plasticity.STRAINS)
@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_stress"), ("triangle", "plane_stress"), ("hexahedron", "3d")])
def test_uniaxial_loading_unloading_and_reverse_flow(comm, cell, kind, strain):
    """Bilinear, unloading with Young's modulus, and isotropic hardening in the other direction; in E and S if strains are finite."""
    problem, material, pulled = uniaxial(comm, cell, kind, strain)
    yielded = FY / E
    stretches = [0.5 * yielded, 3 * yielded, 2 * yielded, 1.5 * yielded, 3 * yielded, 5 * yielded, 0.0, -4 * yielded]
    plastic, p = 0.0, 0.0
    for stretch in stretches:
        pulled.value = stretch
        problem.solve()
        e = stretch + (stretch**2 / 2 if strain == "green_lagrange" else 0.0)
        trial = E * (e - plastic)
        dp = max(0.0, (abs(trial) - FY - H * p) / (E + H))
        plastic, p = plastic + np.sign(trial) * dp, p + dp
        S = E * (e - plastic)
        mean, scatter = spread(material, "stress")
        assert scatter < 1e-9 * FY
        assert mean[0] == pytest.approx(S, abs=1e-8 * FY)
        assert np.abs(mean[1:]).max() < 1e-8 * FY
        assert spread(material, "peeq")[0] == pytest.approx([p], abs=1e-8 * yielded)
        if stretch:
            force = reaction(problem) / stretch
            assert force == pytest.approx(S * (1 + stretch if strain == "green_lagrange" else 1), abs=1e-7 * FY)
    assert p > 5 * yielded
    assert spread(material, "plastic_strain")[0][:2] == pytest.approx([plastic, -plastic / 2], abs=1e-8 * yielded)


def test_biaxial_and_shear_in_plane_stress(comm):
    """Equal tension in both directions flows at FY with twice the plastic strain in peeq, shear at FY / sqrt(3)."""
    _, u = block(comm, "quadrilateral")
    both = uem.VonMises(u, E, NU, FY, H, kind="plane_stress")
    for e in np.array([0.5, 2.0, 4.0, 3.8, 6.0]) * FY / E:
        deform(u, e * np.eye(2))
        both.update()
        both.commit()
    flow = (e - (1 - NU) * FY / E) / ((1 - NU) / E + 1 / (2 * H)) + FY
    assert spread(both, "stress")[0] == pytest.approx([flow, flow, 0.0], abs=1e-10 * FY)
    assert spread(both, "peeq")[0] == pytest.approx((flow - FY) / H, rel=1e-10)
    shear = uem.VonMises(u, E, NU, FY, H, kind="plane_stress")
    for gamma in np.array([0.5, 2.0, 4.0, 3.8, 6.0]) * FY / MU:
        deform(u, [[0.0, gamma], [0.0, 0.0]])
        shear.update()
        shear.commit()
    tau = FY / 3**0.5 + (gamma - FY / 3**0.5 / MU) / (1 / MU + 3 / H)
    assert spread(shear, "stress")[0] == pytest.approx([0.0, 0.0, 2**0.5 * tau], abs=1e-10 * FY)
    assert spread(shear, "plastic_strain")[0][2] == pytest.approx((gamma - tau / MU) / 2**0.5, rel=1e-10)


def test_plane_strain_tension_tends_to_its_limit(comm):
    """Perfectly plastic tension in plane strain ends at 2 / sqrt(3) FY, with half of that across."""
    s, u = block(comm, "quadrilateral")
    V = u.function_space
    material = uem.VonMises(u, E, NU, FY, kind="plane_strain")
    bcs = [bc for c in range(2) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    bcs += clamp(V, s.tag("end", 0, at(0, 1.0)), 0, value=40 * FY / E)
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, materials=[material], petsc_options_prefix="ps_"
    )
    run(problem, 40)
    limit = 2 / 3**0.5 * FY
    mean, scatter = spread(material, "stress")
    assert scatter < 1e-8 * FY
    assert mean == pytest.approx([limit, 0.0, limit / 2, 0.0], abs=1e-6 * FY)
    plastic = spread(material, "plastic_strain")[0]
    assert plastic[2] == pytest.approx((NU - 0.5) * limit / E, abs=1e-6 * FY / E)


# -- forms -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strain, law", [("small", uem.LinearElastic), ("green_lagrange", uem.StVenantKirchhoff)])
@pytest.mark.parametrize(
    "cell, degree, kind",
    [
        ("triangle", 1, "plane_strain"), ("triangle", 2, "plane_strain"), ("triangle", 2, "plane_stress"),
        ("quadrilateral", 1, "plane_stress"), ("quadrilateral", 2, "plane_strain"), ("quadrilateral", 1, "plane_strain"),
        ("tetrahedron", 1, "3d"), ("tetrahedron", 2, "3d"), ("hexahedron", 1, "3d"),
    ],
)  # fmt: skip
def test_without_yield_it_is_the_elastic_law(comm, cell, degree, kind, strain, law):
    """Forces, tangent and energy are those of the elastic law by the same quadrature, the pressure by its own."""
    s, u = block(comm, cell, degree=degree, pose=skewed)
    V = u.function_space
    wiggle(u, 0.05)
    material = uem.VonMises(u, E, NU, np.inf, kind=kind, strain=strain)
    elastic, v = law(E, NU, kind), ufl.TestFunction(V)
    material.update()
    tables = plasticity.SIMPLEX_DEGREES if cell in ("triangle", "tetrahedron") else plasticity.TENSOR_DEGREES
    dx, dx_pressure = (ufl.dx(domain=s.mesh, metadata={"quadrature_degree": d}) for d in tables[degree])
    # assembled one by one: a rule of one point does not go together with others, see QuadraturePoints
    parts = [elastic.energy(u) * dx]
    if kind != "plane_stress":
        pressed = E / (3 * (1 - 2 * NU)) / 2 * ufl.tr(elastic.strain(u)) ** 2
        parts += [-pressed * dx, pressed * dx_pressure]
    rounding = 1e-7 if tables[degree][1] == 0 else 1e-13
    wanted = sum(forms.assemble_scalar(compat.form(part), comm) for part in parts)
    assert material.energy() == pytest.approx(wanted, rel=10 * rounding)
    forces = sum(vector(ufl.derivative(part, u, v), V) for part in parts)
    scale = highest(comm, np.abs(forces))
    assert highest(comm, np.abs(vector(material.residual(v), V) - forces)) < rounding * scale
    du = ufl.TrialFunction(V)
    made = ufl.derivative(material.residual(v), u, du) + material.stiffness(du, v)
    K = matrix(made)
    scale = K.norm()
    for part in parts:
        K.axpy(-1.0, matrix(ufl.derivative(ufl.derivative(part, u, v), u, du)))
    assert K.norm() < rounding * scale


@pytest.mark.parametrize("strain", plasticity.STRAINS)
@pytest.mark.parametrize(
    "cell, degree, kind",
    [
        ("triangle", 2, "plane_stress"), ("quadrilateral", 1, "plane_stress"), ("quadrilateral", 1, "plane_strain"),
        ("quadrilateral", 2, "plane_strain"), ("tetrahedron", 2, "3d"), ("hexahedron", 1, "3d"),
    ],
)  # fmt: skip
def test_tangent_of_the_forms_by_differences(comm, cell, degree, kind, strain):
    """In a state of flow that follows a history; the tangent is symmetric."""
    _, u = block(comm, cell, degree=degree, pose=skewed)
    V = u.function_space
    material = uem.VonMises(u, E, NU, FY, H, kind=kind, strain=strain)
    wiggle(u, 0.02)
    material.update()
    material.commit()
    wiggle(u, 0.03)
    material.update()
    flowing = material._trial.peeq > material._points.read(material.peeq)[:, 0]
    assert comm.allreduce(int(flowing.sum())) > 0
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    K = matrix(ufl.derivative(material.residual(v), u, du) + material.stiffness(du, v))
    x, y = K.createVecRight(), K.createVecRight()
    X = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local, : len(u)]
    x.array[:], y.array[:] = np.cos(3 * X + 1).ravel(), np.sin(2 * X + 0.3 * X[:, ::-1]).ravel()
    assert y.dot(K * x) == pytest.approx(x.dot(K * y), rel=1e-11)
    direction, here, h = fem.Function(V), np.array(u.x.array), 1e-7
    direction.x.array[: len(x.array)] = x.array
    direction.x.scatter_forward()
    sides = []
    for sign in (1, -1):
        u.x.array[:] = here + sign * h * direction.x.array
        material.update()
        sides.append(vector(material.residual(v), V))
    slope, product = (sides[0] - sides[1]) / (2 * h), (K * x).array_r
    assert highest(comm, np.abs(slope - product)) < 2e-6 * highest(comm, np.abs(product))


# -- history -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_stress"), ("quadrilateral", "plane_strain")])
def test_iterates_count_as_neither_loading_nor_unloading(comm, cell, kind):
    _, u = block(comm, cell)
    direct, wandering = (uem.VonMises(u, E, NU, FY, H, kind=kind) for _ in range(2))
    for size in (0.01, 0.02, 0.015, 0.04):
        for iterate in (10 * size, -3 * size, 0.0):
            wiggle(u, iterate)
            wandering.update()
        wiggle(u, size)
        for material in (direct, wandering):
            material.update()
            material.commit()
    for name in ("stress", "plastic_strain", "peeq"):
        assert np.array_equal(getattr(direct, name).x.array, getattr(wandering, name).x.array)
    assert highest(comm, direct.peeq.x.array) > FY / E
    # on the yield surface a second look changes nothing: neither the stress nor, by flow, the history
    before = {name: np.array(f.x.array) for name, f in direct.history.items()}
    stress = np.array(direct.stress.x.array)
    direct.update()
    direct.commit()
    assert highest(comm, np.abs(direct.stress.x.array - stress)) < 1e-9 * FY
    for name, f in direct.history.items():
        assert np.array_equal(f.x.array, before[name])


def test_history_is_all_that_a_checkpoint_needs(comm):
    _, u = block(comm, "quadrilateral")
    law = partial(uem.VonMises, u, E, NU, FY, H, kind="plane_strain")
    first, second = law(), law()
    wiggle(u, 0.03)
    first.update()
    first.commit()
    for name, f in first.history.items():
        second.history[name].x.array[:] = f.x.array
    assert second.dissipation() == first.dissipation() > 0
    wiggle(u, 0.05)
    for material in (first, second):
        material.update()
        material.commit()
    assert np.array_equal(first.stress.x.array, second.stress.x.array)
    assert np.array_equal(first.peeq.x.array, second.peeq.x.array)


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_stress"), ("hexahedron", "3d")])
def test_work_is_stored_or_dissipated(comm, cell, kind):
    """Along a bilinear path whose bends are stations, the trapezoidal rule is exact."""
    problem, material, pulled = uniaxial(comm, cell, kind, "small")
    work, last = 0.0, (0.0, 0.0)
    for stretch in np.array([1.0, 2.0, 5.0, 4.0]) * FY / E:
        pulled.value = stretch
        problem.solve()
        force = reaction(problem) / stretch
        work += (force + last[1]) / 2 * (stretch - last[0])
        last = stretch, force
    assert material.dissipation() > 0.5 * work
    assert material.energy() + material.dissipation() == pytest.approx(work, rel=1e-9)


@pytest.mark.parametrize("cell, kind", [("triangle", "plane_stress"), ("hexahedron", "3d")])
def test_work_on_a_shear_path_is_stored_or_dissipated(comm, cell, kind):
    _, u = block(comm, cell)
    g, work, last = len(u), 0.0, (0.0, 0.0)
    material = uem.VonMises(u, E, NU, FY, H, kind=kind)
    for gamma in np.array([1 / 3**0.5, 2.0, 6.0]) * FY / MU:
        gradient = np.zeros((g, g))
        gradient[0, 1] = gamma
        deform(u, gradient)
        material.update()
        material.commit()
        tau = spread(material, "stress")[0][-1] / 2**0.5
        work += (tau + last[1]) / 2 * (gamma - last[0])
        last = gamma, tau
    assert material.energy() + material.dissipation() == pytest.approx(work, rel=1e-10)


# -- limit loads -------------------------------------------------------------------------------------------------------


def tube(comm: MPI.Comm, cell: str, n: int, degree: int) -> tuple[float, list[uem.LoadStep]]:
    """Inner pressure of a perfectly plastic tube in plane strain, wide open, over the exact limit load; b = 2 a."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3

    def bent(X):
        angle = np.pi / 2 * X[:, 1]
        return np.column_stack([(1 + X[:, 0]) * np.cos(angle), (1 + X[:, 0]) * np.sin(angle), X[:, 2:]])

    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0, 1.0, 0.25][:g], [n, 2 * n, 1][:g])], pose=bent)
    V = compat.function_space(s.mesh, degree, (g,))
    u, opened, opening = fem.Function(V), fem.Function(V), 0.01
    X = V.tabulate_dof_coordinates()[:, :2]
    opened.x.array.reshape(-1, g)[:, :2] = opening * X / np.linalg.norm(X, axis=1, keepdims=True)
    bcs = clamp(V, s.tag("x", 0, at(1, 0.0)), 1) + clamp(V, s.tag("y", 0, at(1, 1.0)), 0)
    for z in (0.0, 0.25) if g == 3 else ():
        bcs += clamp(V, s.tag("end", 0, at(2, z)), 2)
    bcs.append(fem.dirichletbc(opened, fem.locate_dofs_topological(V, g - 1, s.tag("inner", 0, at(0, 0.0)).entities)))
    material = uem.VonMises(u, 1000.0, NU, 1.0, kind="3d" if g == 3 else "plane_strain")
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, materials=[material], petsc_options_prefix="t_"
    )
    steps = run(problem, 8)
    pressure = reaction(problem) / (opening * np.pi / 2 * (0.25 if g == 3 else 1.0))
    return pressure / (2 / 3**0.5 * np.log(2)), steps


@pytest.mark.parametrize(
    "cell, n, degree, error",
    [
        ("quadrilateral", 4, 1, 0.0015), ("hexahedron", 4, 1, 0.0015), ("quadrilateral", 2, 2, 0.015),
        ("quadrilateral", 4, 2, 0.004), ("triangle", 4, 2, 0.004), ("tetrahedron", 2, 2, 0.012), ("hexahedron", 2, 2, 0.015),
    ],
)  # fmt: skip
def test_limit_load_of_a_tube(comm, cell, n, degree, error):
    """Cells that lock come out far above the limit; Newton's method is quadratic."""
    ratio, steps = tube(comm, cell, n, degree)
    assert abs(ratio - 1) < error
    assert max(step.newton_iterations for step in steps) <= 6


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_linear_simplices_lock_as_documented(comm, cell):
    assert tube(comm, cell, 4, 1)[0] > 1.1


@pytest.mark.parametrize(
    "cell, n, degree, error",
    [("quadrilateral", 8, 1, 0.056), ("quadrilateral", 4, 2, 0.042), ("triangle", 4, 2, 0.070), ("triangle", 8, 1, 0.24)],
)
def test_limit_load_of_a_punch(comm, cell, n, degree, error):
    """Errors against Prandtl's 2 + pi, that the docstring of ``VonMises`` tells."""
    s = scene(comm, cell, [box(cell, [0.0, -2.0], [4.0, 0.0], [4 * n, 2 * n])])
    V = compat.function_space(s.mesh, degree, (2,))
    u, punch = fem.Function(V), s.tag("punch", 0, lambda x: (np.abs(x[:, 1]) < 1e-9) & (x[:, 0] < 1 + 1e-9))
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, -2.0))), *clamp(V, punch, 0), *clamp(V, punch, 1, value=-0.06)]
    for x in (0.0, 4.0):
        bcs += clamp(V, s.tag("side", 0, at(0, x)), 0)
    material = uem.VonMises(u, 1000.0, NU, 1.0, kind="plane_strain")
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, materials=[material], petsc_options_prefix="p_"
    )
    run(problem, 10)
    assert reaction(problem) / 0.06 / ((2 + np.pi) / 3**0.5) - 1 == pytest.approx(error, rel=0.03)


# -- in a problem ------------------------------------------------------------------------------------------------------


def beams(comm: MPI.Comm) -> tuple[np.ndarray, list[float]]:
    """A finitely bent cantilever, plastic near its root and elastic elsewhere: displacement and what is measured."""
    s = scene(comm, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [4.0, 1.0], [16, 4])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    middle = s.mesh.geometry.x[compat.geometry_dofs(s.mesh)].mean(axis=1)
    root, rest = (np.flatnonzero(where).astype(np.int32) for where in (middle[:, 0] < 1, middle[:, 0] > 1))
    how = {"kind": "plane_stress", "strain": "green_lagrange"}
    material = uem.VonMises(u, E, NU, FY, H, cells=uem.Tag("root", 1, 2, s.mesh, root), **how)
    F = material.residual(v)
    F += uem.StVenantKirchhoff(E, NU, "plane_stress").residual(u, v) * forms.cell_measure(s.mesh, rest)
    bcs = clamp(V, s.tag("root", 0, at(0, 0.0))) + clamp(V, s.tag("tip", 0, at(0, 4.0)), 1, value=-0.4)
    problem = uem.UnitedProblem(F, u, bcs=bcs, materials=[material], petsc_options_prefix="b_")
    run(problem, 4)
    peeq = material.cell_averages()["peeq"]
    owned = peeq.x.array[: peeq.function_space.dofmap.index_map.size_local]
    figures = [material.energy(), material.dissipation(), reaction(problem), highest(comm, owned), comm.allreduce(owned.sum())]
    return s.gather(u), figures


def test_any_number_of_ranks_gives_the_same(comm):
    """Some ranks have no plastic cell."""
    u, figures = beams(comm)
    u_alone, figures_alone = beams(MPI.COMM_SELF)
    assert figures[1] > 0.1 * figures[2]
    assert figures == pytest.approx(figures_alone, rel=1e-7)
    assert np.abs(u - u_alone).max() < 1e-8


def test_contact_presses_a_column_into_flow(comm):
    """A rigid plane pushes with FY times the width of a perfectly plastic column, and no more."""
    s, u = block(comm, "quadrilateral")
    V = u.function_space
    material = uem.VonMises(u, E, NU, FY, kind="plane_stress")
    plane = uem.RigidPlane([0.0, 1.0], [0.0, -1.0])
    contact = uem.Contact(contactor=s.tag("top", 0, at(1, 1.0)), target=plane)
    bcs = clamp(V, s.tag("bottom", 0, at(1, 0.0)), 1) + clamp(V, s.tag("left", 0, at(0, 0.0)), 0)
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, contacts=[contact], materials=[material], petsc_options_prefix="c_",
        load=lambda factor: plane.move([0.0, -3 * FY / E * factor]),
    )  # fmt: skip
    forces = []
    for _ in uem.load_steps(problem, 6):
        forces.append(abs(contact.resultant().force[1]) / FY)
    assert forces == pytest.approx([0.5, 1.0, 1.0, 1.0, 1.0, 1.0], rel=1e-7)
    assert material.dissipation() == pytest.approx(2 * FY * FY / E, rel=1e-7)


def test_a_failed_step_leaves_the_committed_state(comm):
    problem, material, pulled = uniaxial(comm, "quadrilateral", "plane_stress", "small")
    pulled.value = 3 * FY / E
    problem.solve()
    stress, history = np.array(material.stress.x.array), {k: np.array(f.x.array) for k, f in material.history.items()}
    energy = material.energy()
    pulled.value = 9 * FY / E
    problem.max_iterations = 1
    with pytest.raises(uem.ConvergenceError):
        problem.solve()
    assert highest(comm, np.abs(material.stress.x.array - stress)) < 1e-9 * FY
    assert all(np.array_equal(f.x.array, history[k]) for k, f in material.history.items())
    assert material.energy() == pytest.approx(energy, rel=1e-9)


def test_cell_averages_are_tensors_of_the_cells(comm):
    """In the distorted cells of a homogeneous state all points agree; elsewhere there is nothing."""
    s, u = block(comm, "quadrilateral", 3)
    left = np.flatnonzero(s.mesh.geometry.x[compat.geometry_dofs(s.mesh)].mean(axis=1)[:, 0] < 0.5).astype(np.int32)
    for kind in ("plane_stress", "plane_strain"):
        material = uem.VonMises(u, E, NU, FY, H, kind=kind, cells=uem.Tag("left", 1, 2, s.mesh, left))
        deform(u, [[0.02, 0.01], [0.0, -0.01]])
        material.update()
        material.commit()
        fields = material.cell_averages()
        assert set(fields) == {"stress", "plastic_strain", "peeq", "von_mises"}
        cells = compat.cell_dofs(fields["peeq"].function_space)[:, 0]
        for name, f in fields.items():
            values = f.x.array.reshape(len(f.x.array) // (9 if "str" in name else 1), -1)
            assert highest(comm, np.abs(np.delete(values, cells[left], axis=0))) <= 0.0
            assert highest(comm, -np.abs(values[cells[left]]).max(axis=1)) < 0.0
        stress, plastic = (fields[name].x.array.reshape(-1, 3, 3)[cells[left]] for name in ("stress", "plastic_strain"))
        assert highest(comm, np.abs(stress - stress.transpose(0, 2, 1))) <= 0.0
        assert highest(comm, np.abs(np.trace(plastic, axis1=1, axis2=2))) < 1e-15
        assert (highest(comm, np.abs(stress[:, 2, 2])) > 0.1 * FY) == (kind == "plane_strain")
        flow = FY + H * fields["peeq"].x.array[cells[left]]
        assert highest(comm, np.abs(fields["von_mises"].x.array[cells[left]] - flow)) < 1e-12 * FY
        # the elastic strains of the output give its stresses
        gradient = np.array([[0.02, 0.005, 0.0], [0.005, -0.01, 0.0], [0.0, 0.0, 0.0]])
        elastic = ((1 + NU) * stress - NU * np.trace(stress, axis1=1, axis2=2)[:, None, None] * np.eye(3)) / E
        misfit = (elastic + plastic - gradient)[:, :2, :2] if kind == "plane_stress" else elastic + plastic - gradient
        assert highest(comm, np.abs(misfit)) < 1e-14


def test_parameters_differ_from_cell_to_cell(comm):
    s, u = block(comm, "quadrilateral")
    V = compat.dg0_space(s.mesh)
    fy = fem.Function(V)
    middle = s.mesh.geometry.x[compat.geometry_dofs(s.mesh)].mean(axis=1)[:, 0]
    fy.x.array[compat.cell_dofs(V)[:, 0]] = np.where(middle < 0.5, FY, 2 * FY)
    material = uem.VonMises(u, E, NU, fy, kind="plane_strain")
    deform(u, [[0.05, 0.0], [0.0, -0.05]])
    material.update()
    assert highest(comm, np.abs(material.cell_averages()["von_mises"].x.array - fy.x.array)) < 1e-12 * FY


# -- errors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given, says",
    [
        ({"kind": "plain_strain"}, "plane_strain"), ({"strain": "finite"}, "green_lagrange"), ({"kind": "3d"}, "2 components"),
        ({"E": 0.0}, "E = 0 in the cell"), ({"nu": 0.5}, "nu = 0.5"), ({"yield_stress": 0.0}, "yield_stress"),
        ({"yield_stress": np.nan}, "yield_stress = nan"), ({"hardening": -1.0}, "hardening = -1"), ({"quadrature_degree": 1}, "expected 2"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(comm, given, says):
    _, u = block(comm, "quadrilateral")
    with pytest.raises(ValueError, match=says):
        uem.VonMises(u, **{"E": E, "nu": NU, "yield_stress": FY, "kind": "plane_strain"} | given)


def test_bad_parameters_of_one_cell_are_told_by_all_ranks(comm):
    s, u = block(comm, "quadrilateral", 4)
    modulus = fem.Function(compat.dg0_space(s.mesh))
    modulus.x.array[:] = E
    if comm.rank == comm.size - 1:
        modulus.x.array[0] = -1.0
    with pytest.raises(ValueError, match=r"E = -1 in the cell at \(0\.\d+, 0\.\d+\)"):
        uem.VonMises(u, modulus, NU, FY, kind="plane_strain")
    with pytest.raises(uem.SpaceError, match="DG0"):
        uem.VonMises(u, fem.Function(compat.function_space(s.mesh, 1)), NU, FY, kind="plane_strain")


def test_bad_cells_are_refused(comm):
    s, u = block(comm, "quadrilateral")
    law = partial(uem.VonMises, u, E, NU, FY, kind="plane_stress")
    with pytest.raises(uem.TagError, match="expected cells"):
        law(cells=s.tag("left", 0, at(0, 0.0)))
    with pytest.raises(uem.TagError, match="no cells"):
        law(cells=uem.Tag("none", 1, 2, s.mesh, np.zeros(0, np.int32)))
    other, _ = block(comm, "quadrilateral")
    with pytest.raises(uem.SpaceError, match="another mesh"):
        law(cells=uem.Tag("other", 1, 2, other.mesh, np.arange(1, dtype=np.int32)))


def test_strain_that_is_not_finite_is_refused_by_all_ranks(comm):
    _, u = block(comm, "quadrilateral", 4)
    material = uem.VonMises(u, E, NU, FY, kind="plane_strain")
    before = np.array(material.stress.x.array)
    if comm.rank == comm.size - 1:
        u.x.array[0] = np.nan
    with pytest.raises(uem.NotFiniteError, match="cell at"):
        material.update()
    u.x.array[:] = 0.0
    deform(u, [[1e200, 0.0], [0.0, 0.0]])
    with pytest.raises(uem.NotFiniteError):
        material.update()
    assert np.array_equal(material.stress.x.array, before)
