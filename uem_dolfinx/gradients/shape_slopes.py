"""Derivatives of users' equations and of ties between nodes by the reference positions X of the nodes, at fixed present positions x.

A linear equation in the displacement ``x - X`` has ``g' = -c . X'``. A tied contactor follows the closest point of its reference position,
at the coordinates xi(X) and the height h(X):

    g_i = x_i - N_a(xi) x_a - h n(x),        g_i' = -t_f xi_f' - h' n,        t_f = sum_a dN_a/dxi_f x_a
    force on node a with multipliers lam:    -(dN_a xi') lam - h' (dn/dx_a)' lam

Derivatives of rigid couplings by the reference positions of their nodes, and of equations that follow them.

Nodes of a rigid part are at ``x_i = x_p + R (X_i - p)``. With the change ``y_i = R X_i'`` of their positions relative to the part,

    rows of the coupling:   L (x' - y) = 0,    z' = Z (x' - y)_q    for the motion z of the part
    moment of forces f:     sum y_i x f_i (of small rotations, X_i' x f_i),    in addition to the stiffnesses of f and of springs times z'

where q are the components that the part keeps. Equations of contacts have the motions of the part in place of eliminated components,
so that what opens the rows of the coupling opens them, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.rigid_rows import RigidRows
from uem_dolfinx.conditions.rigid_set import moments, turned
from uem_dolfinx.conditions.user_rows import UserRows
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.contact.ties.preloaded import Preloaded
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.ties.tied_rows import Spacers, foot_below
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
from uem_dolfinx.gradients.tied_means import closest_slopes, of_means
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import gathered, reduced
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.rows import Rows


@dataclass(frozen=True)
class ShapeSlopes:
    """Derivatives of some equations and of their forces by the positions of nodes."""

    config: Configuration
    rows: tuple[Ints, Array]  # global nodes ``(m, k)`` and vectors ``(m, k, gdim)`` for the gaps ``(m,)``
    #: global nodes ``(j, l)`` and blocks ``(j, l gdim, l gdim)`` for the residual, from columns to rows.
    forces: tuple[Ints, Array]

    @property
    def n(self) -> int:
        """Number of the equations."""
        return len(self.rows[0])

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
    with config.at(config.values_at(tie.at)):
        X = config.x[own]
        p = target.project(config.x[tie.nodes])
        tab, height = foot_below(target, p.x[i], p.xi[i], X)
        below, drawn = p.nodes[i], p.x[i]
    s = Spacers(config.to_global(own)[:, None], np.ones((len(i), 1, g)), below, tab.dN, height, drawn)
    xi, up = closest_slopes(s, tab.N)
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


@dataclass(frozen=True)
class RigidSlopes:
    """Derivatives of the rows of couplings that move together, and of their forces, as ``ShapeSlopes``."""

    one: RigidRows  # the rows
    M: Array  # of each node, turns changes of reference positions with the part ``(n, gdim, gdim)``
    arms: Array  # the same for the arms of forces, which small rotations do not turn
    forces: Array  # of the bodies at the nodes, without forces of contacts ``(n, gdim)``
    rows: ShapeSlopes  # derivatives by y, without the moments

    def along(self, X: Array) -> tuple[Array, Array]:
        """As of ``ShapeSlopes`` (collective)."""
        s, config, y = self.one.set, self.rows.config, np.zeros_like(X)
        y[s.nodes] = np.einsum("ngh,nh->ng", self.M, X[s.nodes])
        gaps, pushed = self.rows.along(y)
        load, own = np.zeros(len(s.scale)), moments(np.einsum("ngh,nh->ng", self.arms, X[s.nodes]), self.forces)
        for i in range(len(s.each)):
            load[s[i]][config.gdim :] = own[s.part == i].sum(axis=0)
        load = reduced(config.comm, load)
        basis, here = self.one.basis, config.comm.rank == 0
        at = np.zeros((len(basis.node), config.gdim))
        at[np.arange(len(at)), basis.component] = load @ self.one.motions
        return gaps, pushed + config.add_at_owners(basis.node[: len(at) * here], at[: len(at) * here])

    def back(self, by_gaps: Array, by_residual: Array) -> Array:
        """As of ``ShapeSlopes`` (collective)."""
        s, config, basis = self.one.set, self.rows.config, self.one.basis
        found, by_arms = np.zeros_like(by_residual), np.zeros_like(self.forces)
        kept = config.ask_owners(basis.node, by_residual)[np.arange(len(basis.node)), basis.component]
        z = self.one.motions @ kept
        for i in range(len(s.each)):
            by_arms[s.part == i] = -turned(z[s[i]][config.gdim :], self.forces[s.part == i])
        by_y = self.rows.back(by_gaps, by_residual)[s.nodes]
        found[s.nodes] = np.einsum("ngh,ng->nh", self.M, by_y) + np.einsum("ngh,ng->nh", self.arms, by_arms)
        return found


def of_couplings(config: Configuration, users: UserRows) -> list[RigidSlopes]:
    """Of all rigid couplings, in the order of their rows (collective)."""
    found, g = [], config.gdim
    for one, forces in users.forces_of_each():
        rows = of_equations(config, one.equations)
        parts = [part for part in (one.curvature(forces), one.stiffness()) if part is not None]
        blocks = rows.forces
        if parts:
            blocks = np.concatenate([part[0] for part in parts]), -np.concatenate([part[1] for part in parts])
        M, own = np.zeros((len(one.set.nodes), g, g)), forces[one.set.nodes]
        for i, (at, coupling) in enumerate(zip(one.set.placements(config.displacement[: config.n_owned]), one.couplings)):
            M[one.set.part == i] = at.motion.Q if at.small is None else np.eye(g) + turned(at.small, np.eye(g)).T
            own[one.set.part == i] += coupling.nodal_forces()
        arms = M if one.set.large else np.broadcast_to(np.eye(g), M.shape)
        found.append(RigidSlopes(one, M, arms, own, ShapeSlopes(config, rows.rows, blocks)))
    return found


class Slopes(Protocol):
    """Derivatives of some equations and of their forces by the positions of nodes; members as of ``ShapeSlopes``."""

    def along(self, X: Array) -> tuple[Array, Array]:
        """See ``ShapeSlopes``."""

    def back(self, by_gaps: Array, by_residual: Array) -> Array:
        """See ``ShapeSlopes``."""


def shape_slopes_of(problem: UnitedProblem, equations: Sequence[ContactRows]) -> list[tuple[slice, Slopes]]:
    """Of all ties, linear equations and couplings, each with its place among the equations of contacts and users (collective)."""
    found, first = list[tuple[slice, Slopes]](), 0
    for pair, own in zip(problem.interfaces, equations):
        if pair.tie is not None and pair.tie.rows is not None and pair.trial.bond is not None:
            by_means = pair.tie.means is not None
            slopes = of_means(pair.tie, pair.trial.bond) if by_means else of_tie(pair.tie, pair.trial.bond)
            found.append((slice(first + len(own) - slopes.n, first + len(own)), slopes))
        first += len(own)
    if problem.linear is not None and problem.linear.linear is not None:
        linear = problem.linear.linear
        found.append((slice(first, first + len(linear.equations)), of_equations(problem.config, linear.equations)))
        first += len(linear.equations)
    if problem.linear is not None and problem.linear.each:
        for rigid in of_couplings(problem.config, problem.linear):
            n = len(rigid.one.equations)
            found.append((slice(first, first + n), rigid))
            first += n
    return found


class Followers:
    """Equations, those of couplings last, in which motions of rigid parts have taken the place of eliminated components."""

    def __init__(self, config: Configuration, rows: Rows):
        self._config, self._rigid = config, rows.rigid
        if self._rigid is not None:
            n = self._rigid.n_rows
            self._first = len(rows.whole) - n
            self._own = of_equations(config, rows.whole.rows.select(np.arange(len(rows.whole)) < self._first))

    def _parts(self) -> list[tuple[RigidRows, slice]]:
        assert self._rigid is not None
        ends: Ints = self._first + np.cumsum([0, *(len(one.equations) for one in self._rigid.each)])
        return [(one, slice(a, b)) for one, a, b in zip(self._rigid.each, ends, ends[1:])]

    def opened(self, gaps: Array) -> Array:
        """Changes of all gaps ``(m,)``, from those of the equations as contacts and users have them (collective)."""
        if self._rigid is None:
            return gaps
        there, g = np.zeros((self._config.n_owned, self._config.gdim)), self._config.gdim
        for one, which in self._parts():
            there[one.set.nodes] = np.where(one.eliminated, gaps[which].reshape(-1, g), 0.0)
        found = gaps.copy()
        found[: self._first] += self._own.along(there)[0]
        return found

    def back(self, by_gaps: Array) -> Array:
        """The transpose of ``opened`` (collective)."""
        if self._rigid is None:
            return by_gaps
        none = np.zeros((self._config.n_owned, self._config.gdim))
        there, found = self._own.back(by_gaps[: self._first], none), by_gaps.copy()
        for one, which in self._parts():
            found[which] += np.where(one.eliminated, there[one.set.nodes], 0.0).ravel()
        return found
