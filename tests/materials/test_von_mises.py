"""Von Mises plasticity in bodies: closed forms of simple paths, balance of energy, what a problem keeps of it, and what is refused.

The test to read first is ``test_uniaxial_loading_unloading_and_reverse_flow``.
"""

from __future__ import annotations

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, clamp, highest, run
from plastic_scenes import FY, MU, NU, E, H, block, deform, matrix, reaction, skewed, spread, tangent_in_flow, vector, wiggle

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.materials import von_mises as plasticity


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


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strain", plasticity.STRAINS)
@pytest.mark.parametrize(
    "cell, kind",
    [("quadrilateral", "plane_stress"), pytest.param("triangle", "plane_stress", marks=pytest.mark.slow), ("hexahedron", "3d")],
)
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


@pytest.mark.long
@pytest.mark.parametrize("strain, law", [("small", uem.LinearElastic), ("green_lagrange", uem.StVenantKirchhoff)])
@pytest.mark.parametrize(
    "cell, degree, kind",
    [
        ("triangle", 2, "plane_stress"), ("tetrahedron", 1, "3d"),
        *(
            pytest.param(*how, marks=pytest.mark.slow)
            for how in (
                ("triangle", 1, "plane_strain"), ("triangle", 2, "plane_strain"), ("quadrilateral", 1, "plane_stress"),
                ("quadrilateral", 1, "plane_strain"), ("quadrilateral", 2, "plane_strain"), ("tetrahedron", 2, "3d"),
                ("hexahedron", 1, "3d"),
            )
        ),
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
    wanted = sum(forms.assemble_scalar(forms.form(part), comm) for part in parts)
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


@pytest.mark.long
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
    material = uem.VonMises(u, E, NU, FY, H, kind=kind, strain=strain)
    wiggle(u, 0.02)
    material.update()
    material.commit()
    wiggle(u, 0.03)
    material.update()
    tangent_in_flow(material, u)


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
    V = compat.function_space(s.mesh, ("DG", 0))
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
        ({"E": 0.0}, "E = 0.0: expected a positive number"), ({"nu": 0.5}, "nu = 0.5"), ({"yield_stress": 0.0}, "yield_stress"),
        ({"yield_stress": np.nan}, "yield_stress = nan"), ({"hardening": -1.0}, "hardening = -1"), ({"quadrature_degree": 1}, "expected 2"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(comm, given, says):
    _, u = block(comm, "quadrilateral")
    with pytest.raises(ValueError, match=says):
        uem.VonMises(u, **{"E": E, "nu": NU, "yield_stress": FY, "kind": "plane_strain"} | given)


def test_bad_parameters_of_one_cell_are_an_error_on_all_ranks(comm):
    s, u = block(comm, "quadrilateral", 4)
    modulus = fem.Function(compat.function_space(s.mesh, ("DG", 0)))
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
