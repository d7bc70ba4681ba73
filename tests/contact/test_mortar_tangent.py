"""Derivatives of mortar's weighted gaps: rows and curvature against differences."""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from helpers import CELLS, arch, clamp, run, slow, st_venant
from helpers import blocks as two_blocks
from mortar_scenes import Blocks, disturbed

import uem_dolfinx as uem
from uem_dolfinx.contact.mortar.ends import curvature, own_curvature
from uem_dolfinx.contact.mortar.tangent import gap_derivatives


class WeightedGap:
    """Sum of weighted gaps times multipliers as a function of the displacement, from the points of the segments.

    Args:
        b: blocks, of a problem already.
        system: of it.
    """

    def __init__(self, b, system):
        self.b, self.system, self.pair, self.g = b, system, b.contact.pair, b.g
        self.start = b.u.x.array.copy()
        X, surface = self.pair.config.X, self.pair.discretisation.surface
        self.X, self.dofs = X, surface.dofs[self.points(self.start).facets]
        self.pressure = (1.0 + 0.5 * np.sin(5 * X[:, 0]))[self.dofs]

    def points(self, displacement):
        self.b.u.x.array[:] = displacement
        self.system.place()
        return self.pair.kinematics.rows

    def leave_out(self, target):
        """No multipliers where little is covered, or where sides all but coincide in 3D, as differences are poor there; the rows."""
        rows = self.points(self.start)
        inner = rows.ratio > (1 - 1e-9 if self.g == 3 and target == "mesh" else 0.5)
        self.pressure[np.isin(self.dofs, self.pair.nodes[~inner]).any(axis=1)] = 0.0
        assert (self.pressure != 0).any()
        return rows

    def value(self, displacement):
        points = self.points(displacement).points
        return np.einsum("mj,mji,mi->", self.pressure, points.duals.A, points.covered.G)

    def forces(self, displacement):
        points, g = self.points(displacement).points, self.g
        s, e, out = points.segments, points.facet, np.zeros((self.pair.config.n_local, g))
        amount = np.einsum("qb,qb->q", points.b, np.einsum("mj,mjb->mb", self.pressure, points.duals.A)[e[s.pair]]) * s.weight
        push = -amount[:, None] * points.planes.normal[e[s.pair]]
        on_facet, on_target = gap_derivatives(points)
        np.add.at(out, points.nodes[e[s.pair]], points.phi[..., None] * push[:, None])
        np.add.at(out, points.nodes, np.einsum("mj,mjag->mag", self.pressure, on_facet))
        if points.opposite.shape[1]:
            np.add.at(out, points.opposite[s.pair], -points.N[..., None] * push[:, None])
            np.add.at(out, points.opposite, np.einsum("kj,kjag->kag", self.pressure[e], on_target))
        return out.ravel()

    def ways(self, cell, h=1e-6):
        """Displacements at random; facets of hexahedra stay flat, since quadrature of warped ones has further terms."""
        rng, low = np.random.default_rng(3), self.X[:, -1:] < 1e-9
        for _ in range(3):
            way = rng.standard_normal(self.start.shape)
            if cell == "hexahedron":
                way = np.where(low, self.X @ rng.standard_normal((3, 3)), self.X @ rng.standard_normal((3, 3))).ravel()
            yield way, [self.start + side * h * way for side in (1, -1)], 2 * h


def leaning(b, cell):
    """Displace both blocks, so that facets are no longer parallel."""
    if cell == "hexahedron":
        X, A = b.contact.pair.config.X, np.random.default_rng(2).uniform(-0.05, 0.05, (2, 3, 3))
        b.u.x.array[:] = np.where(X[:, 2:] < 1e-9, X @ A[0], X @ A[1]).ravel()
    else:
        disturbed(b, 2, 0.01)


def weighted_gap(cell, target, offset=0.0, hollow=None, degree=1):
    """Of leaning blocks above a mesh, one that ends over a facet, or a rigid ball; of rings with a radius ``hollow``; with an offset."""
    how = {"narrow": 0.55 if target == "end" else 1.0, "contactor": "lower" if target == "end" else "upper"}
    b = Blocks(cell, (3, 5), degree=degree, gap=0.02, comm=MPI.COMM_SELF, hollow=hollow, **how)
    if target == "ball":
        b.contact = uem.Contact(b.high, uem.RigidSphere([0.4 + (hollow or 0.0)] * (b.g - 1) + [-2.0], 2.0), coupling="mortar")
    b.contact.offset = offset
    problem = b.pressed()
    leaning(b, cell if degree == 1 else "hexahedron")
    return WeightedGap(b, problem.system)


def varying(x):
    """An offset that varies from place to place."""
    return 0.03 + 0.02 * x[0]


SCENES = [
    *product(CELLS, ("mesh", "ball", "end"), (0.0,)),
    *product(("triangle", "tetrahedron"), ("mesh", "ball", "end"), (varying,)),
]


@pytest.mark.parametrize("cell,target,offset", SCENES)
def test_rows_are_derivatives_of_the_gaps(cell, target, offset):
    """What rows are made of against central differences of the weighted gaps, also where the target ends over a facet."""
    phi = weighted_gap(cell, target, offset)
    phi.leave_out(target)
    first = phi.forces(phi.start)
    for way, (ahead, behind), h in phi.ways(cell):
        slope = (phi.value(ahead) - phi.value(behind)) / h
        assert slope == pytest.approx(first @ way, rel=1e-6, abs=1e-8 * np.abs(first).sum())


@pytest.mark.parametrize("cell,target,offset", SCENES)
def test_curvature_against_differences(cell, target, offset):
    """Blocks of the curvature against central differences of the nodal forces at constant multipliers."""
    phi = weighted_gap(cell, target, offset)
    rows = phi.leave_out(target)
    parts = curvature(rows.points, phi.pressure)
    assert all(np.abs(blocks - blocks.transpose(0, 2, 1)).max() == 0.0 for _, blocks in parts)
    for way, (ahead, behind), h in phi.ways(cell):
        measured = -(phi.forces(ahead) - phi.forces(behind)) / h
        reported = np.zeros(len(phi.start))
        for nodes, blocks in parts:
            index = (nodes[:, :, None] * phi.g + np.arange(phi.g)).reshape(len(nodes), -1)
            np.add.at(reported, index, np.einsum("kij,kj->ki", blocks, way[index]))
        assert np.abs(measured - reported).max() < 1e-5 * np.abs(measured).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell,target", [("hexahedron", "end"), *map(slow, ["tetrahedron"] * 2 + ["hexahedron"], ["mesh", "end", "mesh"])]
)
def test_sides_of_quadratic_facets(cell, target, monkeypatch):
    """Rows and curvature where nodes in the middles of sides of both surfaces move, on tetrahedra with the corners, past their chords."""
    # all that facets do that are no longer affine is integrated
    monkeypatch.setattr("uem_dolfinx.geometry.overlaps.STRAIGHT", 0.0)
    phi = weighted_gap(cell, target, degree=2)
    rows, rng = phi.leave_out(target), np.random.default_rng(3)
    first, parts = phi.forces(phi.start), curvature(rows.points, phi.pressure)
    corner = (np.abs(phi.X[:, None] - phi.b.scene.mesh.geometry.x).max(axis=2) < 1e-9).any(axis=1)
    moved = ~corner if cell == "hexahedron" else np.ones(len(corner), dtype=bool)
    way, h = (rng.standard_normal(phi.X.shape) * moved[:, None]).ravel(), 1e-6
    ahead, behind = phi.start + h * way, phi.start - h * way
    slope = (phi.value(ahead) - phi.value(behind)) / (2 * h)
    assert slope == pytest.approx(first @ way, rel=1e-6, abs=1e-8 * np.abs(first).sum())
    measured, reported = -(phi.forces(ahead) - phi.forces(behind)) / (2 * h), np.zeros(len(way))
    for nodes, blocks in parts:
        index = (nodes[:, :, None] * 3 + np.arange(3)).reshape(len(nodes), -1)
        np.add.at(reported, index, np.einsum("kij,kj->ki", blocks, way[index]))
    assert np.abs(measured - reported).max() < 1e-5 * np.abs(measured).max()


@pytest.mark.parametrize("cell,target,offset", SCENES)
def test_own_rows(cell, target, offset):
    """All nodes' own rows at once are rows of the curvature by one multiplier after the other."""
    phi = weighted_gap(cell, target, offset)
    points, g = phi.leave_out(target).points, phi.g
    way = np.random.default_rng(4).standard_normal(phi.start.reshape(-1, g).shape)
    together, apart = np.zeros((2, *way.shape))
    for some, nodes, rows in own_curvature(points, phi.pressure):
        own = nodes[:, : points.nodes.shape[1]][:, some]
        np.add.at(together, own, np.einsum("pjgch,pch->pjg", rows, way[nodes]))
    for j, one in enumerate(np.eye(points.nodes.shape[1])):
        for nodes, blocks in curvature(points, phi.pressure * one):
            moved = np.einsum("pik,pk->pi", blocks, way[nodes].reshape(len(nodes), -1))
            np.add.at(apart, nodes[:, j], moved.reshape(*nodes.shape, g)[:, j])
    assert np.abs(together - apart).max() < 1e-12 * np.abs(apart).max()


@pytest.mark.parametrize("target,offset", product(("mesh", "ball", "end"), (0.0, varying)))
def test_circles(target, offset):
    """Both of rings, whose parts grow with their radii; of second derivatives all but how dual functions change to second order."""
    phi = weighted_gap("triangle", target, offset, hollow=0.5)
    rows = phi.leave_out(target)
    first, parts = phi.forces(phi.start), curvature(rows.points, phi.pressure)
    for way, (ahead, behind), h in phi.ways("triangle"):
        slope = (phi.value(ahead) - phi.value(behind)) / h
        assert slope == pytest.approx(first @ way, rel=1e-6, abs=1e-8 * np.abs(first).sum())
        measured, reported = -(phi.forces(ahead) - phi.forces(behind)) / h, np.zeros(len(phi.start))
        for nodes, blocks in parts:
            index = (nodes[:, :, None] * 2 + np.arange(2)).reshape(len(nodes), -1)
            np.add.at(reported, index, np.einsum("kij,kj->ki", blocks, way[index]))
        assert np.abs(measured - reported).max() < 1e-4 * np.abs(measured).max()


@pytest.mark.parametrize("hollow", [None, 0.5])
def test_shares_grow(hollow):
    """Derivatives of the integrals of the basis over facets by their nodes, against differences."""
    of = weighted_gap("triangle", "mesh", hollow=hollow).pair.discretisation
    facets, x, h = np.arange(len(of.surface.dofs)), of.surface.x, 1e-6
    _, slopes = of.share_slopes(facets, x)
    for a, k in np.ndindex(x.shape[1:]):
        step = h * (np.arange(x.shape[1]) == a)[:, None] * np.eye(2)[k]
        ahead, behind = (of.shares(of.sizes(x + side * step), x + side * step) for side in (1, -1))
        assert np.abs(slopes[:, :, a, k] - (ahead - behind) / (2 * h)).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_newton_on_quadratic_facets_past_the_end(cell):
    """Where curved facets of degree 2 are covered in part, residuals fall quadratically; it took 20 iterations at a constant rate."""
    b = two_blocks(MPI.COMM_WORLD, cell, 2, 2, pose=arch(0.1), degree=2, overhang=-0.1)
    contact = uem.Contact(b.high, b.low, coupling="mortar", max_penetration=1.0)
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=(0.02, 0.01, -0.05))]
    (step,) = run(uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], rtol=1e-11))
    residuals = [iteration.residual for iteration in step.iterations]
    assert step.newton_iterations <= 6 and residuals[-1] < 1e-11
    assert all(after < 10.0 * before**1.5 for before, after in zip(residuals[2:-1], residuals[3:-1]))
