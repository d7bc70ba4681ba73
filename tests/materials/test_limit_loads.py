"""Limit loads of perfectly plastic bodies against the exact ones, and against the errors that ``VonMises`` documents.

The test to read first is ``test_limit_load_of_a_tube``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, clamp, highest, run, scene
from plastic_scenes import FY, NU, E, H, block, reaction, tube

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

# -- limit loads -------------------------------------------------------------------------------------------------------


def limit_load(comm: MPI.Comm, cell: str, n: int, degree: int) -> tuple[float, list[uem.LoadStep]]:
    """Inner pressure of a perfectly plastic tube in plane strain, wide open, over the exact limit load; b = 2 a."""
    pressure, steps = tube(comm, cell, n, degree, 0.01, uem.VonMises, 8)
    return pressure / (2 / 3**0.5 * np.log(2)), steps


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, n, degree, error",
    [
        ("quadrilateral", 4, 1, 0.0015), ("hexahedron", 4, 1, 0.0015), ("quadrilateral", 2, 2, 0.015),
        ("triangle", 4, 2, 0.004), ("tetrahedron", 2, 2, 0.012),
        *(pytest.param(*how, marks=pytest.mark.slow) for how in (("quadrilateral", 4, 2, 0.004), ("hexahedron", 2, 2, 0.015))),
    ],
)  # fmt: skip
def test_limit_load_of_a_tube(comm, cell, n, degree, error):
    """Cells that lock come out far above the limit; Newton's method is quadratic."""
    ratio, steps = limit_load(comm, cell, n, degree)
    assert abs(ratio - 1) < error
    assert max(step.newton_iterations for step in steps) <= 6


@pytest.mark.long
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_linear_simplices_lock_as_documented(comm, cell):
    assert limit_load(comm, cell, 4, 1)[0] > 1.1


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, n, degree, error",
    [("quadrilateral", 8, 1, 0.056), ("quadrilateral", 4, 2, 0.042), ("triangle", 4, 2, 0.070), ("triangle", 8, 1, 0.24)],
)
def test_limit_load_of_a_punch(comm, cell, n, degree, error):
    """Errors against Prandtl's 2 + pi, as in the docstring of ``VonMises``."""
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


@pytest.mark.long
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
