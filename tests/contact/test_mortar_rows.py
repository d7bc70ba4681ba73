"""Rows of mortar against slow quadrature."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from mortar_scenes import Blocks, disturbed

from uem_dolfinx.contact.mortar.duals import basis_of
from uem_dolfinx.geometry.shapes import facet_shape


@pytest.mark.parametrize("degree", [1, 2])
def test_rows_against_slow_quadrature(degree):
    """Rows of 2D facets on a wavy target, from 20,000 points a facet that look for what is opposite one by one."""
    b = Blocks("triangle", (5, 3), degree, wave=0.02, gap=0.01, comm=MPI.COMM_SELF)
    b.pressed()
    pair = b.contact.pair
    rows, config, surface = pair.kinematics.rows.plain, pair.config, pair.discretisation.surface
    target = pair.target.facets
    shape, basis = facet_shape("interval", degree), basis_of(facet_shape("interval", degree))
    total, follows = np.zeros((config.n_local, 2)), np.zeros((config.n_local, config.n_local, 2))
    s = (np.arange(20000) + 0.5) / 20000
    for x, dofs, sign in zip(surface.x, surface.dofs, surface.sign):
        t = x[1] - x[0]
        length = np.linalg.norm(t)
        n = np.array([t[1], -t[0]]) / length * sign
        xi = s[:, None]
        where = np.einsum("qa,ag->qg", shape.tabulate(xi).N, x)
        along = (where - x[0]) @ t / length
        w = np.gradient(along)
        seen, N = np.zeros(len(s), bool), np.zeros((len(s), config.n_local))
        for y, its in zip(target.x, target.dofs):
            z = (y - x[0]) @ t / length
            grid = np.linspace(0, 1, 2001)
            there = shape.tabulate(grid[:, None]).N @ z
            order = np.argsort(there)
            eta = np.interp(along, there[order], grid[order], left=np.nan, right=np.nan)
            here = ~np.isnan(eta) & ~seen
            N[np.ix_(here, its)] = shape.tabulate(eta[here, None]).N
            seen |= here
        values = basis.at(xi) * (w * seen)[:, None]
        D, Me = values.sum(axis=0), values.T @ basis.at(xi)
        A = np.diag(D) @ np.linalg.inv(Me)
        for j, row in enumerate(D[:, None] * basis.T):
            for k in range(len(dofs)):
                if k == j:
                    total[dofs[j]] -= row[k] * n
                else:
                    follows[dofs[j], dofs[k]] += row[k] * n
            follows[dofs[j]] -= (A @ values.T @ N)[j][:, None] * n
    for k, node in enumerate(pair.nodes):
        scale = np.linalg.norm(total[node])
        assert rows.direction[k] == pytest.approx(total[node] / scale, abs=1e-6)
        terms = rows.row == k
        found = np.zeros((config.n_local, 2))
        np.add.at(found, rows.followed[terms], rows.coefficients[terms])
        assert np.abs(found - follows[node] / scale).max() < 2e-4


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_rows_do_not_depend_on_the_active_set(cell):
    """Gaps and multipliers of a linearised problem are conjugate: any active set finds the same equations across the target."""
    b = Blocks(
        cell, (3, 4), degree=2 if cell == "quadrilateral" else 1, gap=-0.01, narrow=0.55, contactor="lower", max_penetration=1.0
    )
    problem = b.pressed()
    disturbed(b, 2, 0.01)
    problem.system.place()
    pair, rng = b.contact.pair, np.random.default_rng(5)
    every = np.arange(len(pair.nodes))
    first = pair.kinematics.gap_rows.select(every, np.ones(len(every), bool)).P
    for _ in range(3):
        pair.trial = replace(pair.trial, active=rng.random(len(every)) < 0.5)
        made = pair.kinematics.gap_rows.select(every, pair.trial.active).P
        assert (made.active == pair.trial.active).all()
        for name in ("node", "direction", "gap", "row", "followed", "coefficients"):
            assert np.array_equal(getattr(made, name), getattr(first, name))
