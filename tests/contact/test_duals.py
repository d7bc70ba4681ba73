"""Dual functions of facets that are covered in part: biorthogonal, adding up to one, and how their integrals grow with what is covered."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, run, scene
from mortar_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.mortar.duals import Covered, basis_of, dual_functions
from uem_dolfinx.geometry.shapes import facet_shape

KINDS = [("interval", 1), ("interval", 2), ("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("quadrilateral", 2)]


def covered(cell, degree, part, gap=np.ones_like):
    """One facet of which the corner at its first vertex is covered, up to this part of its sides; its basis, and the dual functions."""
    basis, dim = basis_of(facet_shape(cell, degree)), 1 if cell == "interval" else 2
    x, w = np.polynomial.legendre.leggauss(8)
    xi = np.stack(np.meshgrid(*[0.5 + 0.5 * x] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    w = np.prod(np.stack(np.meshgrid(*[0.5 * w] * dim, indexing="ij"), axis=-1).reshape(-1, dim), axis=1)
    if cell == "triangle":
        w, xi = w * (1 - xi[:, 0]), np.column_stack([xi[:, 0], xi[:, 1] * (1 - xi[:, 0])])
    whole, b, w = w.sum(), basis.at(part * xi), w * part**dim
    D, M, G = w @ b, b.T @ (w[:, None] * b), (w * gap(part * xi[:, 0])) @ b
    nothing = np.zeros((0, len(D), len(D) + 1))
    integrals = Covered(np.zeros(0, int), D[None], M[None], G[None], nothing, nothing, whole * basis.mean[None])
    return basis, integrals, dual_functions(integrals, np.arange(len(D))[None], np.zeros((1, len(D)), bool))


@pytest.mark.parametrize("part", [1.0, 0.6, 0.2])
@pytest.mark.parametrize(("cell", "degree"), KINDS)
def test_biorthogonal_and_adding_up_to_one(cell, degree, part):
    """Each is orthogonal to the functions of all other nodes; those that are hardly covered have none, and the foremost takes the rest."""
    _, of, duals = covered(cell, degree, part)
    integrals, last = duals.A[0] @ of.M[0], len(of.D[0]) - 1
    assert duals.A[0].sum(axis=0) == pytest.approx(1.0, abs=1e-11)
    assert integrals == pytest.approx(duals.C[0], abs=1e-11 * of.D.sum()) and duals.foremost[0] == last
    own = np.append(of.D[0] >= 0.05 * of.full[0], False)[: last + 1] & (np.arange(last + 1) < last)
    assert np.array_equal(duals.own[0], own) and not duals.A[0][:last][~own[:last]].any()
    assert np.diag(integrals)[own] == pytest.approx(of.D[0][own])
    assert own.sum() == last or part < 1


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("part", [0.3, 0.7])
def test_weighted_gaps_grow_with_what_is_covered(degree, part):
    """Against differences: the dual functions change with the end of the target as well."""

    def gap(x):
        return 0.3 + np.sin(2 * x)

    def weighted(part):
        _, of, duals = covered("interval", degree, part, gap)
        return duals.A[0] @ of.G[0]

    basis, _, duals = covered("interval", degree, part, gap)
    grown = duals.at_end(np.zeros(1, int), basis.at(np.array([[part]])), gap(np.array([part])))[0]
    assert grown == pytest.approx((weighted(part + 1e-5) - weighted(part - 1e-5)) / 2e-5, abs=1e-8)
    assert grown.sum() == pytest.approx(gap(part))


@pytest.mark.parametrize("punch", [0.03, 0.1])
def test_what_is_hardly_covered(punch):
    """A punch on 3 % of a facet far from its nodes is carried by one row of all of them; on 10 % by a row for each."""
    s = scene(COMM, "quadrilateral", [
        box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [1, 1]), box("quadrilateral", [0.5, -1.0], [0.5 + punch, 0.0], [1, 4])
    ])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("base", 0, at(1, 0.0)), s.tag("punch", 1, at(1, 0.0)), coupling="mortar")
    bcs = clamp(V, s.tag("ground", 1, at(1, -1.0))) + clamp(V, s.tag("top", 0, at(1, 1.0)), value=[0.0, -1e-3])
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 100.0)), u, bcs=bcs, contacts=[contact])
    run(problem)
    assert contact.n_active == (1 if punch < 0.05 else 2)
    assert contact.balance().moment < 1e-13
    # the block's base between its corners, against the punch's: the weighted gap is closed
    assert contact.max_gap() < 1e-13 and contact.resultant().force[1] > 1e-6
