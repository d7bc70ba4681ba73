"""The map between multipliers, forces and pressures, of every discretisation: against the forces, linear parts against transposes."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from gauss_points import GaussPoints
from helpers import arch, blocks, clamp, highest, modulus, run, st_venant

import uem_dolfinx as uem
from uem_dolfinx.contact.nodes.concave_edges import MOST_CHANGES

COMM = MPI.COMM_WORLD
CASES = [
    ("triangle", 1, "node_to_surface", 0.0),
    ("triangle", 1, "node_to_surface", 0.3),
    ("hexahedron", 1, "node_to_surface", 0.3),
    ("triangle", 2, "node_to_surface", 0.3),
    ("hexahedron", 2, "node_to_surface", 0.0),
    ("quadrilateral", 1, "mortar", 0.3),
    ("tetrahedron", 1, "mortar", 0.0),
    ("triangle", 2, "mortar", 0.3),
    ("tetrahedron", 1, GaussPoints, 0.0),
]


def over_an_arch(cell, degree, coupling, friction, height=0.3):
    """A block over an arch, in part beyond its end, all contactors active, with a wavy displacement."""
    n = (5, 4) if cell in ("triangle", "quadrilateral") else (3, 2)
    b = blocks(COMM, cell, *n, gap=0.1, overhang=-0.15, degree=degree, pose=arch(height, 0.45))
    contact = uem.Contact(b.high, b.low, max_penetration=0.5, friction=friction, coupling=coupling)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top)]
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])
    problem.config.displacement[:] = 0.01 * np.sin(3 * problem.config.X[:, ::-1])
    pair = contact.pair
    pair.trial = replace(pair.trial, active=np.ones(len(pair.nodes), bool))
    pair.project()
    return problem.config, pair, contact


def total(*products):
    """Sums over all ranks of products of arrays."""
    return COMM.allreduce(float(sum((a * b).sum() for a, b in products)))


@pytest.mark.parametrize(("cell", "degree", "coupling", "friction"), CASES)
def test_forces_of_multipliers(cell, degree, coupling, friction):
    """``lam = F mu``, with friction also on edges, where facets push with more than the force along the mean normal."""
    config, pair, _ = over_an_arch(cell, degree, coupling, friction)
    if friction and coupling == "node_to_surface":
        # on edges that they have crossed too often contactors have the mean normal
        pair.trial = replace(pair.trial, changes=np.full(len(pair.nodes), MOST_CHANGES))
        pair.project()
    k, every = pair.kinematics, np.ones(len(pair.nodes), bool)
    mu = 1.0 + np.sin(7 * config.X[pair.nodes].sum(axis=1))
    lam = k.forces(pair.trial, k.gap_rows.select(np.flatnonzero(every), every), mu).lam
    for current in (False, True):
        assert highest(COMM, np.abs(k.pressure_map(current).force * mu - lam)) <= 1e-14 * highest(COMM, np.abs(lam))
    if friction and coupling == "node_to_surface" and degree == 1:
        assert highest(COMM, k.cone) > 1.0 + 1e-4


@pytest.mark.parametrize("current", [False, True])
@pytest.mark.parametrize(("cell", "degree", "coupling", "friction"), CASES)
def test_areas_are_affine(cell, degree, coupling, friction, current):
    """Areas change with integrals of shape functions by ``along``, whose transpose is ``back``, and so do stretches."""
    config, pair, contact = over_an_arch(cell, degree, coupling, friction)
    found, X = pair.kinematics.pressure_map(current), config.X[pair.nodes]
    a = contact.areas_facing(pair.nodes, pair.kinematics.projection.normal, current)
    d, w = np.cos(4 * X.sum(axis=1)), np.sin(3 * X.sum(axis=1) + 1)
    assert highest(COMM, np.abs(found.areas(a + d) - found.areas(a) - found.along(d))) < 1e-13
    assert total((w, found.along(d))) == pytest.approx(total((found.back(w), d)), rel=1e-11, abs=1e-13)
    assert (found.stretch is not None) == (coupling == "mortar" and not current)
    if found.stretch is not None:
        now, drawn = np.cos(5 * config.X + 1), np.sin(2 * config.X)
        back, n = found.stretch.back(w), config.n_owned
        along = total((w, found.stretch.along(now, drawn)))
        assert along == pytest.approx(total((back[0], now[:n]), (back[1], drawn[:n])), rel=1e-11) and abs(along) > 1e-3


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree", [1, 2])
def test_any_unit(coupling, degree):
    """Pressures of the same scene in nanometres and in kilometres."""
    found = []
    for size in (1e-9, 1.0, 1e3):
        b = blocks(COMM, "quadrilateral", 3, 4, degree=degree, pose=lambda x, size=size: size * x)
        contact = uem.Contact(b.high, b.low, coupling=coupling)
        F = st_venant(b.u, modulus(b.scene, 1.0, 2.0))
        run(uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.02 * size), contacts=[contact]))
        p = contact.pressures
        found.append([highest(COMM, p), COMM.allreduce(float(p.sum())), COMM.allreduce(float(p @ p))])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-9)
