"""Elastic laws: closed forms of uniaxial states, stress as derivative of the energy, indifference to rotation.

Worth reading first: ``test_stress_is_derivative_of_energy`` and ``test_uniaxial_stress``.
"""

from __future__ import annotations

import re

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from helpers import blocks

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

LAWS = [uem.LinearElastic, uem.StVenantKirchhoff, uem.NeoHooke]
FINITE = LAWS[1:]
E, NU = 7.0, 0.3


def displacement(gradient: np.ndarray) -> fem.Function:
    """Homogeneous displacement on a unit square or cube."""
    gdim = len(gradient)
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1) if gdim == 2 else mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
    u = fem.Function(compat.function_space(domain, 1, (gdim,)))
    X = u.function_space.tabulate_dof_coordinates()[:, :gdim]
    u.x.array[:] = (X @ gradient.T).ravel()
    return u


def value(expression, u: fem.Function) -> float:
    return forms.assemble_scalar(forms.form(expression * ufl.dx(domain=u.function_space.mesh)), MPI.COMM_SELF)


def matrix(expression, u: fem.Function) -> np.ndarray:
    n = len(u)
    return np.array([[value(expression[i, j], u) for j in range(n)] for i in range(n)])


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("kind", ["3d", "plane_strain", "plane_stress"])
def test_stress_is_derivative_of_energy(law, kind):
    gdim = 3 if kind == "3d" else 2
    G = 0.2 * np.random.default_rng(1).standard_normal((gdim, gdim))
    material, h = law(E, NU, kind), 1e-5
    P = matrix(material.first_piola(u := displacement(G)), u)
    for i in range(gdim):
        for j in range(gdim):
            D = np.zeros_like(G)
            D[i, j] = h
            plus, minus = displacement(G + D), displacement(G - D)
            slope = (value(material.energy(plus), plus) - value(material.energy(minus), minus)) / (2 * h)
            assert slope == pytest.approx(P[i, j], abs=1e-7 * E)


@pytest.mark.parametrize("law", FINITE)
@pytest.mark.parametrize("kind", ["3d", "plane_strain", "plane_stress"])
def test_rigid_rotation_is_free_of_stress(law, kind):
    a = 0.7
    R = np.eye(3 if kind == "3d" else 2)
    R[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    u = displacement(R - np.eye(len(R)))
    assert np.abs(matrix(law(E, NU, kind).first_piola(u), u)).max() < 1e-13 * E


@pytest.mark.parametrize("kind, modulus", [("plane_stress", E), ("plane_strain", E / (1 - NU**2)), ("3d", E)])
@pytest.mark.parametrize("law", LAWS)
def test_uniaxial_stress(law, kind, modulus):
    """Every law begins with Young's modulus of its kind."""
    e = 1e-6
    across = -NU / (1 - NU) if kind == "plane_strain" else -NU
    u = displacement(np.diag([e] + [across * e] * (2 if kind == "3d" else 1)))
    S = matrix(law(E, NU, kind).stress(u), u)
    assert S[0, 0] == pytest.approx(modulus * e, rel=1e-5)
    assert abs(S[1, 1]) < 1e-5 * modulus * e


def test_plane_stress_is_3d_free_of_stress_across():
    """The stretch across the plane that makes P33 vanish in 3D gives the in-plane stresses of plane stress."""
    G = np.array([[0.2, 0.1], [-0.05, -0.1]])
    material = uem.NeoHooke(E, NU, "3d")
    J2 = np.linalg.det(np.eye(2) + G)
    l3 = np.sqrt((material.mu + material.lam / 2) / (material.mu + material.lam / 2 * J2**2))
    G3 = np.zeros((3, 3))
    G3[:2, :2], G3[2, 2] = G, l3 - 1
    full = matrix(material.first_piola(u := displacement(G3)), u)
    plane = matrix(uem.NeoHooke(E, NU, "plane_stress").first_piola(u := displacement(G)), u)
    assert abs(full[2, 2]) < 1e-13 * E
    assert np.abs(full[:2, :2] - plane).max() < 1e-13 * E


def test_wrong_kind_is_refused():
    with pytest.raises(ValueError, match="plane_strain"):
        uem.LinearElastic(E, NU, "plain_strain")
    with pytest.raises(ValueError, match="components"):
        uem.LinearElastic(E, NU, "3d").stress(displacement(np.zeros((2, 2))))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "E, nu, words",
    [
        *((E, 0.3, f"E = {E!r}: expected a positive number") for E in (0, -1.0, np.inf, np.nan, "steel", None, (1.0, 2.0))),
        *((1.0, nu, f"nu = {nu!r}: expected a number between -1 and 0.5") for nu in (0.5, 0.7, -1, np.nan, "a", None)),
    ],
)
@pytest.mark.parametrize("kind", ["3d", "plane_strain", "plane_stress"])
def test_parameters_out_of_range(law, E, nu, words, kind):
    bad = E if words.startswith("E") else nu
    with pytest.raises(uem.InputError if isinstance(bad, (int, float)) else uem.InputTypeError, match=re.escape(words)):
        law(E, nu, kind)


@pytest.mark.parametrize("law", LAWS)
def test_parameters_out_of_range_in_constants_and_functions(comm, law):
    """Alike on all ranks, also where one cell of one rank is wrong; what is yet to be filled is left alone."""
    square = mesh.create_unit_square(comm, 4, 4)
    with pytest.raises(uem.InputError, match="nu = 0.5: expected a number between -1 and 0.5; a body that hardly changes"):
        law(1.0, fem.Constant(square, 0.5), "plane_strain")
    E = fem.Function(compat.function_space(square, ("DG", 0)))
    law(E, fem.Constant(square, 0.3), "plane_strain")
    E.x.array[:] = 1.0
    law(E, E - 0.7, "plane_strain")
    E.x.array[:1] = -2.0 if comm.rank == comm.size - 1 else 1.0
    with pytest.raises(uem.InputError, match="the Function E = -2.0: expected a positive number"):
        law(E, 0.3, "plane_strain")
    with pytest.raises(uem.InputTypeError, match="E = .*expected a scalar expression"):
        law(ufl.SpatialCoordinate(square), 0.3, "plane_strain")


@pytest.mark.parametrize("cell,degree", [("quadrilateral", 1), ("quadrilateral", 2), ("hexahedron", 1)])
def test_quadrature_of_what_is_no_polynomial(cell, degree, monkeypatch):
    """Forces of a block, compressed by 30 % and sheared, are those of a fine rule; with a tenth of the points they are not."""

    def force(rule):
        b = blocks(MPI.COMM_WORLD, cell, 1, 2, degree=degree)
        g, law = b.gdim, uem.NeoHooke(1.0, 0.4, "3d" if b.gdim == 3 else "plane_strain")
        b.u.interpolate(
            lambda x: np.stack([0.2 * x[0] * x[g - 1], *([0.1 * x[1]] * (g - 2)), -0.3 * x[g - 1] * (1 + 0.2 * x[0])])
        )
        F = law.residual(b.u, ufl.TestFunction(b.V)) * (ufl.dx if rule is None else ufl.dx(metadata={"quadrature_degree": rule}))
        parts = MPI.COMM_WORLD.allgather(np.linalg.norm(forms.assemble_array(b.V, forms.form(F))) ** 2)
        return np.sqrt(sum(parts))

    fine = force(12)
    assert force(None) == pytest.approx(fine, rel=1e-6)
    monkeypatch.setattr(forms, "DEGREES_ENOUGH", 0.4)
    assert force(None) != pytest.approx(fine, rel=1e-4)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("degree", [1, 2])
def test_degrees_that_are_asked_for(law, degree):
    """A rational law gets a sensible rule, also in its tangent; a polynomial one, and a rule that is named, stay as they are."""
    b = blocks(MPI.COMM_WORLD, "quadrilateral", 1, 1, degree=degree)
    v = ufl.TestFunction(b.V)

    def degrees(F):
        return [i.metadata().get("quadrature_degree") for i in forms._of_sensible_degree(F).integrals()]

    residual = law(1.0, 0.3, "plane_strain").residual(b.u, v)
    energy = law(1.0, 0.3, "plane_strain").energy(b.u) * ufl.dx
    wanted = [4 * degree] if law is uem.NeoHooke else [None]
    assert degrees(residual * ufl.dx) == degrees(ufl.derivative(residual * ufl.dx, b.u)) == wanted
    assert degrees(ufl.derivative(energy, b.u, v)) == wanted
    assert degrees(residual * ufl.dx(metadata={"quadrature_degree": 6})) == [6]
