"""Derivatives of ties by mortar by the reference positions X of the nodes, at fixed present positions x.

A point q of a contactor facet stays where it is on this facet. Its closest point has the coordinates xi(X), its height is h(X), and what
opens there is

    f = sum_j phi_j x_j - sum_a N_a(xi) x_a - h n(x),        R_i = sum_q w_q psi_i f

Weights grow with the area A of the facet, and a segment ends at a side s of a facet of the target, past which the contactor moves by b:

    R_i' = sum_q w_q psi_i (f' + f A'/A) - sum_s w_s psi_i f b'

Facets that are covered wholly keep their dual functions psi. The divisors of equations change multipliers only.

A preloaded section with the axis a opens by d and has the force F, where A_i = int psi_i changes with the areas:

    R_i = A_i a d,    F = -sum_i A_i a . lam_i:    a change ``sum_i A_i' a . lam_i`` is one of the force
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.preloaded import Preloaded
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.ties.tied_rows import Spacers, TiedRows, below, foot_below
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.gradients.assemblies import by_section
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class TiedMeans:
    """Derivatives of the equations of a tie by mortar, and of their forces; members as of ``ShapeSlopes``."""

    made: TiedRows  # the equations
    nodes: Ints  # global nodes of pairs of facets ``(k, nn)``, the ``nc`` of the contactor first
    gaps: Array  # derivatives of weighted openings of the contactor's nodes ``(k, nc gdim, nn gdim)``
    forces: Array  # of the residual ``(k, nn gdim, nn gdim)``
    section: Preloaded | None  # the tie, if it is a preloaded section
    pull: Array  # derivatives of its force at fixed multipliers, with the opposite sign ``(k, nn gdim)``

    @property
    def n(self) -> int:
        """Number of the equations."""
        return int(self.made.has.sum()) if self.section is None else self.section.rows_in_use

    @property
    def _contactors(self) -> Ints:
        return self.nodes[:, : self.gaps.shape[1] // self.made.has.shape[1]].ravel()

    def along(self, X: Array) -> tuple[Array, Array]:
        """Changes of gaps ``(m,)`` and residual ``(n_owned, gdim)`` along ``X (n_owned, gdim)`` (collective)."""
        made, config, g = self.made, self.made.config, X.shape[1]
        moved = config.ask_owners(self.nodes.ravel(), X).reshape(len(self.nodes), -1)
        opened, pushed = (np.einsum("kab,kb->ka", part, moved).reshape(-1, g) for part in (self.gaps, self.forces))
        opened = made.elimination.total(self._contactors, opened) / made.own
        gaps, pushed = opened[made.has], config.add_at_owners(self.nodes.ravel(), pushed)
        if self.section is None:
            return gaps, pushed
        return self.section.along_rows(gaps), pushed + reduced(config.comm, float((self.pull * moved).sum())) * self._by_force()

    def back(self, by_gaps: Array, by_residual: Array) -> Array:
        """The transpose of ``along``: derivatives by the owned nodes ``(n_owned, gdim)`` (collective)."""
        config, g, values = self.made.config, by_residual.shape[1], np.zeros(self.made.has.shape)
        values[self.made.has] = by_gaps if self.section is None else self.section.back_to_rows(by_gaps)
        openings = _at_facets(self.made, values, self._contactors).reshape(len(self.nodes), -1)
        work = config.ask_owners(self.nodes.ravel(), by_residual).reshape(len(self.nodes), -1)
        found = np.einsum("kab,ka->kb", self.gaps, openings) + np.einsum("kab,ka->kb", self.forces, work)
        if self.section is not None:
            found += reduced(config.comm, float((self._by_force() * by_residual).sum())) * self.pull
        return np.asarray(config.add_at_owners(self.nodes.ravel(), found.reshape(-1, g)))

    def _by_force(self) -> Array:
        """Derivative of the residual by the force of the section ``(n_owned, gdim)`` (collective)."""
        assert self.section is not None
        return by_section(self.section, "force", 0)[1]


def _at_facets(made: TiedRows, multipliers: Array, nodes: Ints) -> Array:
    """Multipliers ``(n, gdim)`` over the divisors of their equations, at global nodes ``(k,)`` of facets (collective)."""
    own = np.zeros((made.config.n_owned, multipliers.shape[1]))
    own[made.nodes] = multipliers / made.own
    return made.config.ask_owners(nodes, made.elimination.seam.sums(own))


class _Openings(NamedTuple):
    """What opens at points of pairs of facets."""

    f: Array  # the openings ``(q, gdim)``
    by_X: Array  # derivatives by reference positions ``(q, gdim, nn, gdim)``
    loads: Array  # forces on the nodes of a multiplier there ``(q, nn, gdim)``
    turned: Array  # their derivatives by reference positions ``(q, nn, gdim, nn, gdim)``


def closest_slopes(s: Spacers, N: Array) -> tuple[Array, Array]:
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


def of_means(tie: Tie, bond: Array) -> TiedMeans:
    """Of a tie by mortar of straight facets that the target covers, with its multipliers ``bond (n, gdim)`` (collective)."""
    config, d, g, made = tie.config, tie.means, tie.config.gdim, tie.made
    assert d is not None and isinstance(d.target, MeshTarget)
    with config.at(config.values_at(tie.at)):
        d.let_go()
        rows = d.place(config.here(tie.nodes), PairState.initial(len(tie.nodes), g)).rows
        at, target = rows.points, d.target
        every = np.flatnonzero(np.bincount(at.segments.pair, minlength=len(at.facet)) > 0)
        sides = at.sides(target.shape, every)
        duals = below(d, rows)[-1]
        d.let_go()
    if reduced(config.comm, int((at.partly & (at.covered.D.sum(axis=1) > 0.0)).sum())):
        raise InputError(
            f"{tie.name}: the target covers facets of the contactor in part, whose means have no derivatives by the shape: make the "
            "contactor the smaller surface, or take coupling='node_to_surface'"
        )
    (k, nt), nc, s = at.opposite.shape, at.nodes.shape[1], at.segments
    nodes = np.concatenate([at.nodes[at.facet], at.opposite], axis=1)
    present = config.ask_owners(nodes.ravel(), config.x[: config.n_owned]).reshape(k, nc + nt, g)
    multipliers = _at_facets(made, bond, at.nodes.ravel()).reshape(len(at.nodes), nc, g)

    def openings(pair: Ints, phi: Array, force: Array) -> _Openings:
        y, x = at.y[pair], present[pair]
        middle = np.tile(target.shape.middle, (len(pair), 1))
        tab, height = foot_below(target, y, middle, np.einsum("qa,qag->qg", phi, at.x[at.facet[pair]]))
        spacers = Spacers(nodes[pair, :1], np.ones((len(pair), 1, g)), at.opposite[pair], tab.dN, height, y)
        xi, up = closest_slopes(spacers, tab.N)
        feet = np.concatenate([xi, up[:, None]], axis=1).reshape(len(pair), -1, 1 + nt, g)
        feet = np.concatenate([phi[:, None, :, None] * feet[:, :, :1], feet[:, :, 1:]], axis=2)
        xi, up = feet[:, :-1], feet[:, -1]
        length, n, across, slopes = spacers.turning(x[:, nc:])
        leaning = across[:, None] @ slopes / length[:, None, None, None]
        t = np.einsum("qaf,qag->qfg", tab.dN, x[:, nc:])
        f = np.einsum("qa,qag->qg", np.concatenate([phi, -tab.N], axis=1), x) - height[:, None] * n
        by_X = -np.einsum("qfc,qfah->qcah", t, xi) - np.einsum("qc,qah->qcah", n, up)
        lean = np.einsum("qagh,qg->qah", leaning, force)
        loads = np.concatenate([phi, -tab.N], axis=1)[..., None] * force[:, None]
        loads[:, nc:] -= height[:, None, None] * lean
        turned = np.zeros((len(pair), nc + nt, g, nc + nt, g))
        turned[:, nc:] = -np.einsum("qaf,qfbh,qg->qagbh", tab.dN, xi, force) - np.einsum("qag,qbh->qagbh", lean, up)
        return _Openings(f, by_X, loads, turned)

    def dual(pair: Ints, b: Array) -> Array:
        return np.stack([np.einsum("qib,qb->qi", one.A[at.facet[pair]], b) for one in duals], axis=2)

    grown = np.zeros((k, nc + nt, g))
    grown[:, :nc] = (np.einsum("mg,magh->mah", at.planes.normal, at.turning) / at.planes.size[:, None, None])[at.facet]
    size, width = nc * g, (nc + nt) * g
    gaps, forces = np.zeros((k, size, width)), np.zeros((k, width, width))
    side = every[sides.pair]
    for pair, phi, b, weight, way in (
        (s.pair, at.phi, at.b, s.weight, grown[s.pair]),
        (side, sides.phi, sides.b, -sides.weight, sides.way),
    ):
        psi = dual(pair, b)
        here = openings(pair, phi, np.einsum("qig,qig->qg", psi, multipliers[at.facet[pair]]))
        inner = pair is s.pair
        opened = (psi * here.f[:, None]).reshape(len(pair), size, 1) * way.reshape(len(pair), 1, width)
        pushed = here.loads.reshape(len(pair), width, 1) * way.reshape(len(pair), 1, width)
        if inner:
            opened += (psi[..., None, None] * here.by_X[:, None]).reshape(len(pair), size, width)
            pushed += here.turned.reshape(len(pair), width, width)
        np.add.at(gaps, pair, weight[:, None, None] * opened)
        np.add.at(forces, pair, -weight[:, None, None] * pushed)
    section, pull = tie if isinstance(tie, Preloaded) else None, np.zeros((k, width))
    if section is not None:
        facet, pair = np.unique(at.facet, return_index=True)
        area = at.duals.C.sum(axis=2)[facet, :, None] * section.axis
        by_areas = grown[pair].reshape(len(pair), 1, width)
        gaps[pair] -= section.opening * area.reshape(len(pair), size, 1) * by_areas
        pull[pair] = (area * multipliers[facet]).sum(axis=(1, 2))[:, None] * by_areas[:, 0]
    return TiedMeans(made, nodes, gaps, forces, section, pull)
