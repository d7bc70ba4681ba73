"""Derivatives of a step with friction by its initial anchors, and of anchors by earlier positions of contactors, in both modes.

A sticking contactor coincides with its anchor A, a point of the target, in all components,

    x_i = A(xi) = sum_a N_a(xi) x_a,        A' = t xi',        t = sum_a dN_a x_a

so that the gaps of its equations change by ``-d . A'`` for a direction d, and its force f acts on the target's nodes with
``N_a + dN_a xi'``. In 3D the slip direction changes with the offset w from A by a stiffness S, ``tau' = -S w'``. The anchor of a contactor
that does not stick is its closest point, with the derivatives of the projection.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import name_at
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.projection import FacetProjection, foot_slopes
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
from uem_dolfinx.parallel import reduced

#: What has no derivative in 3D, in messages.
BEYOND = "edge of the target is nearest to"


def refuse_some(pair: Interface, which: Bools, words: str) -> None:
    """InputError, which says what holds them, for contactors ``which (n,)`` through which there are no derivatives (collective)."""
    count = int(reduced(pair.config.comm, int(which.sum())))
    if count:
        names = pair.config.comm.allgather([name_at(pair, i) for i in np.flatnonzero(which)[:1]])
        name = next(filter(None, names))[0]
        raise InputError(
            f"contact '{name}': a {words} {count} contactor(s), through which histories have no derivatives; take another mesh, other "
            "steps, or differences of two solutions"
        )


def turn_by_slip(pair: Interface) -> None:
    """Set directions that depend on slip and force in equal parts, which does not affect the stiffness S in equilibrium (collective)."""
    sliding, state = pair.friction, pair.trial
    assert sliding is not None and state.friction is not None
    w, bound, slips = sliding.frame.slip, sliding.bound(state), sliding.slipping(state)
    way = np.linalg.norm(w, axis=1)
    refuse_some(pair, slips & ((way == 0.0) | (bound == 0.0)), "slip without way or without force turns")
    c = np.where(slips, bound / np.where(way > 0.0, way, 1.0), 0.0)
    q = c[:, None] * w - sliding.frame.tangential(state.friction.tau)
    pair.take(state, replace(sliding.pivot, stiffness=c, q=q))


class AnchorSlopes:
    """Derivatives of one converged step of a contact with friction of nodes, by its anchors (collective).

    Args:
        pair: the interface, in the trial state of the step.

    Raises:
        InputError: for contactors held by corners or edges of the target, or with zero slip, whose direction is undefined.
    """

    def __init__(self, pair: Interface):
        assert pair.friction is not None
        self._pair, self._sliding = pair, pair.friction
        self._config, state = pair.config, pair.trial
        active = self._sliding.active(state)
        assert state.friction is not None
        held = self._sliding.frame.free_tangents.any(axis=(1, 2))
        #: mask of contactors at their anchors ``(n,)``.
        self.stuck: Bools = active & state.friction.stick & ~state.redundant & held
        self._slips = self._sliding.slipping(state)
        self._anchor, friction = self._tangents_at_anchors(), self._sliding
        at_edges = self._slips & (pair.kinematics.pressure_map(False).force != pair.kinematics.ties.share)
        refuse_some(self._pair, active & (state.in_corner | friction.frame.cornered | at_edges), "corner of the target holds")
        refuse_some(self._pair, self.stuck & friction.left_out.any(axis=1), "dependent equation along the target holds")
        if self._config.gdim == 3:
            turn_by_slip(pair)

    def turned(self, state: PairState) -> list[tuple[Ints, Array]]:
        """Terms of slip with the forces of a state, lists of global nodes and blocks as in ``Interface.curvature`` (collective).

        In 3D, directions turn. On a curved surface an offset w is inclined to the tangent plane, so that its part in that plane changes
        by ``- (n . w) n'``, which Newton's tangent neglects.
        """
        if self._config.gdim == 2:
            return []
        kinematics = self._pair.kinematics
        i, p = np.flatnonzero(self._sliding.slipping(state)), kinematics.projection
        _, _, stiffness = self._sliding.turning(state, kinematics)
        lean = np.einsum("ng,ng->n", kinematics.normal, self._sliding.frame.away)[i]
        turned = -lean[:, None, None] * np.einsum("kgh,khi->kgi", stiffness, p.normal_slopes(i))
        share = np.column_stack([np.ones(len(i)), -p.weights[i]])
        blocks = np.einsum("ka,kgi->kagi", share, turned).reshape(len(i), turned.shape[2], turned.shape[2])
        leaning = np.column_stack([self._config.to_global(self._pair.nodes[i]), p.nodes[i]]), blocks
        return [leaning, *(terms[:2] for terms in [self._sliding.slip_terms(state, kinematics)] if terms is not None)]

    def leaning(self, equations: ContactRows) -> None:
        """None: contactors that stick are at their anchors."""

    def of_contact(self, by_anchors: Array, rows: slice) -> Array:
        """The derivatives by the anchors of some contactors."""
        found = np.zeros_like(by_anchors)
        found[rows] = by_anchors[rows]
        return found

    def without_stuck(self, state: PairState) -> PairState:
        """The state with zero forces of contactors at their anchors, since their equations do not rotate."""
        return replace(state, nodal=np.where(self.stuck, 0.0, state.nodal))

    def _tangents_at_anchors(self) -> Array:
        """Derivatives of the anchors ``(n, k, gdim)`` by their coordinates (collective)."""
        target, f = self._pair.target, self._pair.trial.friction
        assert f is not None
        if isinstance(target, MeshTarget):
            own = target.facets.current()
            return np.einsum("naf,nag->nfg", target.shape.tabulate(f.xi).dN, target.of_facets(f.facet, own.x))
        along = np.broadcast_to(np.eye(self._config.gdim)[:, None], (self._config.gdim, *f.anchor.shape))
        return np.stack([e if target.motion is None else target.motion.turn(e) for e in along], axis=1)

    @property
    def none(self) -> Array:
        """No changes of the anchors."""
        return np.zeros((len(self._pair.nodes), self.size))

    @property
    def size(self) -> int:
        """Number of coordinates of an anchor."""
        return self._anchor.shape[1]

    def by_anchors(self, by_gaps: Array, equations: ContactRows, a: Array) -> Array:
        """Derivative by the anchors ``(n, k)`` from that by the gaps of the equations, and the adjoint displacement (collective)."""
        pair, kinematics, n = self._pair, self._pair.kinematics, len(self._pair.nodes)
        pulled = np.zeros((n, self._config.gdim))
        np.add.at(pulled, equations.contactor, -by_gaps[:, None] * equations.P.direction)
        found = np.where(self.stuck[:, None], np.einsum("nkg,ng->nk", self._anchor, pulled), 0.0)
        p = kinematics.projection
        if isinstance(p, FacetProjection):
            there = self._config.ask_owners(np.maximum(p.nodes, 0).ravel(), a).reshape(*p.nodes.shape, self._config.gdim)
            work = np.einsum("nag,ng,naf->nf", there, pair.trial.force, np.where(p.nodes[..., None] >= 0, p.dN, 0.0))
            found -= np.where(self.stuck[:, None], work, 0.0)
        if self._config.gdim == 3:
            i, (_, _, stiffness) = np.flatnonzero(self._slips), self._sliding.turning(pair.trial, kinematics)
            handed = np.einsum("kgh,kg->kh", stiffness, self._sliding.frame.ties.relative(a)[i])
            found[i] += np.einsum("nkg,ng->nk", self._anchor[i], handed)
        return found

    def back(self, by_anchors: Array, first: bool) -> tuple[Array, Array]:
        """Derivatives by positions and by initial anchors, from derivatives by final anchors of the step ``(n, k)`` (collective).

        ``by_anchors`` is empty if there are none yet. ``first``: for the state before the first step, in which all anchors are closest
        points.

        Returns:
            By the positions of the owned nodes ``(n_owned, gdim)``, and by the unchanged anchors ``(n, k)``.
        """
        pair, loose = self._pair, self._loose(first)
        by_anchors = by_anchors if by_anchors.size else np.zeros((len(pair.nodes), self.size))
        i = np.flatnonzero(loose & by_anchors.any(axis=1))
        p, own = pair.kinematics.nearest, np.zeros((self._config.n_owned, self._config.gdim))
        if isinstance(p, FacetProjection):
            free, D = self._feet(p, i)
            if self._config.gdim == 3:
                beyond = np.zeros(len(loose), dtype=bool)
                beyond[i] = ~free.all(axis=1)
                refuse_some(self._pair, beyond, BEYOND)
            forces = np.einsum("kf,kfi->ki", np.where(free, by_anchors[i], 0.0), D).reshape(-1, self._config.gdim)
            nodes = np.column_stack([self._config.to_global(pair.nodes[i]), p.nodes[i]])
            own = self._config.add_at_owners(nodes.ravel(), forces)
        else:
            own[pair.nodes[i]] = self._below(p, i, np.einsum("nkg,nk->ng", self._anchor[i], by_anchors[i]), True)
        return own, np.where(loose[:, None], 0.0, by_anchors)

    def _loose(self, first: bool) -> Bools:
        """Contactors whose anchors are closest points at the end of the step ``(n,)``."""
        f = self._pair.trial.friction
        assert f is not None
        return np.asarray(~f.stick | ~self._sliding.active(self._pair.trial) | first)

    def _feet(self, p: FacetProjection, i: Ints) -> tuple[Bools, Array]:
        """Coordinates of closest points that move freely ``(k, f)``, and derivatives of all ``(k, f, (1 + nn) gdim)``.

        Past an end or over a convex edge, the closest point is fixed or moves along the edge.
        """
        t, D = foot_slopes(p, i)
        off = np.einsum("kfg,kg->kf", t, self._pair.points[i] - p.foot[i])
        return np.abs(off) <= ON_SIDE * np.einsum("kfg,kfg->kf", t, t), D

    def _below(self, p: Any, i: Ints, v: Array, back: bool) -> Array:
        """Changes of closest points on a rigid surface by those of contactors ``v (k, gdim)``, or ``back`` (collective)."""

        def across(v: Array) -> Array:
            return v - np.einsum("kg,kg->k", p.normal[i], v)[:, None] * p.normal[i]

        v = across(v) if back else v
        v = v - p.height[i, None] * np.einsum("kgh,kg->kh", p.hessians(i), v)
        return v if back else across(v)

    def pushed(self, moved: Array, equations: ContactRows) -> tuple[Array, Array]:
        """Changes of gaps ``(m,)`` and residual ``(n_owned, gdim)`` with the anchors ``(n, k)``, or NaN: transpose of ``by_anchors``."""
        pair, kinematics, config = self._pair, self._pair.kinematics, self._config
        needed = self.stuck | (self._slips & (config.gdim == 3))
        refuse_some(self._pair, needed & np.isnan(moved).any(axis=1), BEYOND)
        moved = np.where(needed[:, None], moved, 0.0)
        there, own = np.einsum("nkg,nk->ng", self._anchor, moved), np.zeros((config.n_owned, config.gdim))
        stuck = np.where(self.stuck[:, None], there, 0.0)
        gaps = -np.einsum("mg,mg->m", equations.P.direction, stuck[equations.contactor])
        p = kinematics.projection
        if isinstance(p, FacetProjection):
            share = np.einsum(
                "naf,nf->na", np.where(p.nodes[..., None] >= 0, p.dN, 0.0), np.where(self.stuck[:, None], moved, 0.0)
            )
            own = config.add_at_owners(
                np.maximum(p.nodes, 0).ravel(), (share[..., None] * pair.trial.force[:, None]).reshape(-1, config.gdim)
            )
        if config.gdim == 3:
            i, (_, _, stiffness) = np.flatnonzero(self._slips), self._sliding.turning(pair.trial, kinematics)
            turned = np.zeros_like(there)
            turned[i] = np.einsum("kgh,kh->kg", stiffness, there[i])
            own = own - config.add_at_owners(*self._sliding.frame.ties.handed_on(turned))
        return gaps, own

    def follow(self, moved: Array, way: Array, led: Array, first: bool) -> Array:
        """Changes of the anchors ``(n, k)`` at the end of the step, NaN where they have no derivative: the transpose of ``back``.

        Args:
            moved: changes of the initial anchors ``(n, k)``.
            way: changes of the positions of the owned nodes ``(n_owned, gdim)``.
            led: changes of the positions of rigid targets below contactors ``(n, gdim)``.
            first: see ``back``.
        """
        pair, loose = self._pair, self._loose(first)
        p, i, found = pair.kinematics.nearest, np.flatnonzero(loose), np.array(moved)
        if isinstance(p, FacetProjection):
            # none is nearest to contactors that are far away
            found[loose], i = np.nan, np.flatnonzero(loose & (p.nodes >= 0).all(axis=1))
            free, D = self._feet(p, i)
            nodes = np.column_stack([self._config.to_global(pair.nodes[i]), p.nodes[i]])
            there = self._config.ask_owners(nodes.ravel(), way).reshape(len(i), nodes.shape[1] * self._config.gdim)
            found[i] = np.where(free, np.einsum("kfi,ki->kf", D, there), 0.0)
            if self._config.gdim == 3:
                found[i[~free.all(axis=1)]] = np.nan
        else:
            found[i] = np.einsum("nkg,ng->nk", self._anchor[i], self._below(p, i, way[pair.nodes[i]] - led[i], False))
        return found
