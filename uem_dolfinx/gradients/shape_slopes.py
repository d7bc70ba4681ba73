"""Derivatives of users' equations and of ties between nodes by the reference positions X of the nodes, at fixed present positions x.

A linear equation in the displacement ``x - X`` has ``g' = -c . X'``. A tied contactor follows the closest point of its reference position,
at the coordinates xi(X) and the height h(X):

    g_i = x_i - N_a(xi) x_a - h n(x),        g_i' = -t_f xi_f' - h' n,        t_f = sum_a dN_a/dxi_f x_a
    force on node a with multipliers lam:    -(dN_a xi') lam - h' (dn/dx_a)' lam
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.ties.preloaded import Preloaded
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.ties.tied_rows import Spacers, foot_below
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import gathered, reduced
from uem_dolfinx.solve.problem import UnitedProblem


@dataclass(frozen=True)
class ShapeSlopes:
    """Derivatives of some equations and of their forces by the positions of nodes.

    Attributes:
        config: configuration of the displacement.
        rows: global nodes ``(m, k)`` and vectors ``(m, k, gdim)`` for the gaps ``(m,)``.
        forces: global nodes ``(j, l)`` and blocks ``(j, l gdim, l gdim)`` for the residual, from columns to rows.
    """

    config: Configuration
    rows: tuple[Ints, Array]
    forces: tuple[Ints, Array]

    def along(self, X: Array) -> tuple[Array, Array]:
        """Changes of gaps ``(m,)`` and residual ``(n_owned, gdim)`` along ``X (n_owned, gdim)`` (collective)."""
        (nodes, vectors), (at, blocks), g = self.rows, self.forces, self.config.gdim
        there = self.config.ask_owners(nodes.ravel(), X).reshape(vectors.shape)
        moved = self.config.ask_owners(at.ravel(), X).reshape(len(at), at.shape[1] * g)
        pushed = np.einsum("jkl,jl->jk", blocks, moved).reshape(-1, g)
        return np.einsum("mkg,mkg->m", vectors, there), self.config.add_at_owners(at.ravel(), pushed)

    def back(self, by_gaps: Array, by_residual: Array) -> Array:
        """The transpose of ``along``: derivatives by the owned nodes ``(n_owned, gdim)`` (collective)."""
        (nodes, vectors), (at, blocks), g = self.rows, self.forces, self.config.gdim
        found = self.config.add_at_owners(nodes.ravel(), (by_gaps[:, None, None] * vectors).reshape(-1, g))
        work = self.config.ask_owners(at.ravel(), by_residual).reshape(len(at), at.shape[1] * g)
        back = np.einsum("jkl,jk->jl", blocks, work).reshape(-1, g)
        return np.asarray(found + self.config.add_at_owners(at.ravel(), back))


def of_equations(config: Configuration, eq: UnitingEquations) -> ShapeSlopes:
    """Of linear equations, whose coefficients are constant."""
    g = config.gdim
    widest = 1 + int(np.bincount(eq.row, minlength=1).max(initial=0))
    nodes = np.repeat(config.to_global(eq.node)[:, None], widest, axis=1)
    vectors = np.zeros((len(eq), widest, g))
    vectors[:, 0] = -eq.direction
    order = np.argsort(eq.row, kind="stable")
    row = eq.row[order]
    place = 1 + np.arange(len(row)) - np.searchsorted(row, row)
    nodes[row, place], vectors[row, place] = eq.followed[order], eq.coefficients[order]
    return ShapeSlopes(config, (nodes, vectors), (np.zeros((0, 1), np.int64), np.zeros((0, g, g))))


def of_tie(tie: Tie, bond: Array) -> ShapeSlopes:
    """Of a tie between nodes of straight facets, with its multipliers ``bond (n, gdim)`` (collective)."""
    config, target, g, i = tie.config, tie.target, tie.config.gdim, np.flatnonzero(tie.tied)
    assert isinstance(target, MeshTarget)
    own = tie.nodes[i]
    with config.at(config.values_of(config.functions() | {"displacement": tie.at})):
        X = config.x[own]
        p = target.project(config.x[tie.nodes])
        tab, height = foot_below(target, p.x[i], p.xi[i], X)
        below, drawn = p.nodes[i], p.x[i]
    s = Spacers(config.to_global(own)[:, None], np.ones((len(i), 1, g)), below, tab.dN, height, drawn)
    xi, up = _foot_slopes(s, tab.N)
    y = config.ask_owners(below.ravel(), config.x[: config.n_owned]).reshape(drawn.shape)
    length, n, across, slopes = s.turning(y)
    t = np.einsum("kaf,kag->kfg", tab.dN, y)
    # by contactor, component, and its own and the facet's nodes
    gaps = -np.einsum("kfc,kfj->kcj", t, xi) - np.einsum("kc,kj->kcj", n, up)
    k, width = len(i), 1 + below.shape[1]
    nodes = np.column_stack([config.to_global(own), below])
    lam = bond[i]
    blocks = np.zeros((k, width, g, width * g))
    blocks[:, 1:] = np.einsum("kaf,kfj,kg->kagj", tab.dN, xi, lam)
    leaning = np.einsum("kagh,kg->kah", across[:, None] @ slopes / length[:, None, None, None], lam)
    blocks[:, 1:] += np.einsum("kah,kj->kahj", leaning, up)
    rows = np.repeat(nodes, g, axis=0), gaps.reshape(k * g, width, g)
    if isinstance(tie, Preloaded):
        rows = tie.without_lead(*rows)
    return ShapeSlopes(config, rows, (nodes, blocks.reshape(k, width * g, width * g)))


def _foot_slopes(s: Spacers, N: Array) -> tuple[Array, Array]:
    """Derivatives of coordinates ``(k, fdim, (1 + nn) gdim)`` and heights ``(k, (1 + nn) gdim)`` of closest points on straight facets."""
    _, n, _, _ = s.turning(s.y)
    k, nn, fdim = s.dN.shape
    t = np.einsum("kaf,kag->kfg", s.dN, s.y)
    T = np.zeros((k, fdim, 1 + nn, n.shape[1]))
    T[:, :, 0] = t
    T[:, :, 1:] = np.einsum("k,kaf,kg->kfag", s.height, s.dN, n) - np.einsum("ka,kfg->kfag", N, t)
    m = np.einsum("kfg,keg->kfe", t, t)
    up = np.concatenate([n[:, None], -N[:, :, None] * n[:, None]], axis=1)
    # a rank without contactors has no width
    width = (1 + nn) * n.shape[1]
    return np.linalg.solve(m, T.reshape(k, fdim, width)), up.reshape(k, width)


def warn_of_edges(problem: UnitedProblem) -> None:
    """Warn of contactors on edges between facets, where derivatives by the shape are one-sided (collective)."""
    for contact, pair in zip(problem.contacts, problem.pairs):
        p, place = getattr(pair.kinematics, "projection", None), np.full(3, np.nan)
        on = np.zeros(len(pair.nodes), dtype=bool)
        target, free = pair.target, contact.coupling == "node_to_surface" and not contact.tied
        if free and isinstance(p, FacetProjection) and isinstance(target, MeshTarget):
            on = pair.trial.active & (target.shape.side_distances(p.xi) < ON_SIDE).any(axis=1)
            place[: problem.config.gdim] = problem.config.X[pair.nodes[on][0]] if on.any() else np.nan
        if count := reduced(problem.config.comm, int(on.sum())):
            places = gathered(problem.config.comm, place)[:, : problem.config.gdim]
            first = places[np.isfinite(places).all(axis=1)][0]
            logger.warning(
                "contact '%s': %d contactor(s), the first at (%s), lie on edges between facets of the target, whose normals change "
                "differently on either side: derivatives by the shape are one-sided", contact.name, count,
                ", ".join(f"{x:.6g}" for x in first),
            )  # fmt: skip
