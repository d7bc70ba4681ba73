"""Derivatives of a step with mortar and friction by the positions of all nodes at its beginning, in the place of anchors.

A contactor follows other nodes in a mean, with the weights that these have at the beginning of the step, x~. Its relative motion is

    w_i = sum_a W_ia(x~) (x_a - x~_a),        d w_i/dx~ = -W_i + (dW_i/dx~) (x - x~)

If it sticks, the motion vanishes along the tangents t of the end of the step, which turn with the contactor's row by ``- n (t . n')``. The
tangent of Newton's method leaves this term ``- (n . w) t . n'`` out. In 3D the direction of slip changes with w by a stiffness S,
``tau' = -S w'``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.friction.stick_slip import LastStep
from uem_dolfinx.contact.mortar.placement import MortarKinematics
from uem_dolfinx.contact.mortar.turning import Frictional, RowSlopes, at_facets, handing_on, row_slopes, turning
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.gradients.anchor_slopes import refuse_some, turn_by_slip


class MeanSlopes:
    """Derivatives of one converged step of a contact with mortar and friction (collective); members as of ``AnchorSlopes``.

    Args:
        pair: the interface, in the trial state of the step.

    Raises:
        InputError: for contactors that the target does not cover, or with zero slip in 3D, whose direction is undefined.
    """

    def __init__(self, pair: Interface):
        assert pair.friction is not None and isinstance(pair.kinematics, MortarKinematics)
        self._pair, self._sliding, self._kinematics = pair, pair.friction, pair.kinematics
        self._config, state = pair.config, pair.trial
        assert state.friction is not None
        active, frame = self._sliding.active(state), self._sliding.frame
        self.stuck: Bools = active & state.friction.stick & ~state.redundant & frame.free_tangents.any(axis=(1, 2))
        self._slips = self._sliding.slipping(state)
        refuse_some(pair, active & ~self._kinematics.rows.covered, "facet that the target does not cover holds")
        refuse_some(pair, self.stuck & self._sliding.left_out.any(axis=1), "dependent equation along the target holds")
        if self._config.gdim == 3:
            turn_by_slip(pair)

    def turned(self, state: PairState) -> list[tuple[Ints, Array]]:
        """See ``AnchorSlopes`` (collective)."""
        if self._config.gdim == 2:
            return []
        terms, i = self._sliding.slip_terms(state, self._kinematics), np.flatnonzero(self._sliding.slipping(state))
        made, (_, _, stiffness) = self._slopes(i), self._sliding.turning(state, self._kinematics)
        (k, c), g = made.nodes.shape, self._config.gdim
        blocks = -np.einsum("k,ka,kgh,kchi->kagci", self._lean[i], made.weight, stiffness, made.normal)
        return [(made.nodes, blocks.reshape(k, c * g, c * g)), *(part[:2] for part in [terms] if part is not None)]

    def without_stuck(self, state: PairState) -> PairState:
        """The state itself: equations of contactors that follow means turn."""
        return state

    @property
    def _lean(self) -> Array:
        """Relative motions along the normals ``(n,)``."""
        return np.einsum("ng,ng->n", self._kinematics.normal, self._sliding.frame.away)

    def _slopes(self, which: Ints) -> RowSlopes:
        """How the rows of contactors ``which (k,)`` change (collective)."""
        of, rows = self._kinematics.of, self._kinematics.rows
        assert rows.weights is not None
        none = np.zeros((len(which), self._config.gdim))
        there, _ = at_facets(of.elimination, rows, of.surface.dofs[rows.facets], which, none)
        return row_slopes(of.elimination, rows, which, there[:, :, 0], rows.weights)

    def leaning(self, equations: ContactRows) -> tuple[Ints, Ints, Array] | None:
        """What Newton's tangent leaves out of equations along the target (collective).

        Returns equations ``(k,)``, nodes that they depend on, -1 for none ``(k, c)``, and coefficients of these ``(k, c, gdim)``.
        """
        i = np.flatnonzero(self.stuck)
        made, place = self._slopes(i), np.full(len(self.stuck), -1, dtype=np.int64)
        place[i] = np.arange(len(i))
        row = np.flatnonzero((equations.tangent >= 0) & (place[equations.contactor] >= 0))
        of, t = place[equations.contactor[row]], equations.rows.direction[row]
        lean = self._lean[equations.contactor[row]]
        coefficients = -np.einsum("k,kg,kcgh->kch", lean, t, made.normal[of])
        return row, made.nodes[of], np.where(made.nodes[of][..., None] >= 0, coefficients, 0.0)

    def by_anchors(self, by_gaps: Array, equations: ContactRows, a: Array) -> Array:
        """Derivative by the positions of the owned nodes at the beginning of the step ``(n_owned, gdim)`` (collective)."""
        pair, config, sliding = self._pair, self._config, self._sliding
        i, pulled = np.flatnonzero(equations.tangent >= 0), np.zeros(pair.points.shape)
        np.add.at(pulled, equations.contactor[i], by_gaps[i, None] * equations.rows.direction[i])
        pulled[~self.stuck] = 0.0
        if config.gdim == 3:
            i, (_, _, stiffness) = np.flatnonzero(self._slips), sliding.turning(pair.trial, self._kinematics)
            pulled[i] -= np.einsum("kgh,kg->kh", stiffness, sliding.frame.ties.relative(a)[i])
        then, which = self._then(np.asarray(pulled.any(axis=1)))
        found = -config.add_at_owners(*then.ties.handed_on(pulled))
        found[pair.nodes] = found[pair.nodes] @ self._turn
        assert then.rows.weights is not None
        kept = Frictional(which, 0.0 * pulled[which], -pulled[which], np.zeros(len(which), dtype=bool))
        dofs = then.of.surface.dofs[then.rows.facets]
        parts = turning(then.of.elimination, then.rows, dofs, kept, then.rows.weights)
        nodes = np.concatenate([some.ravel() for some, _ in parts])
        (way,) = self._at(parts, self._way)
        by = np.concatenate([np.einsum("ka,kab->kb", own, blocks).ravel() for own, (_, blocks) in zip(way, parts)])
        there = nodes >= 0
        return found + config.add_at_owners(nodes[there], by.reshape(-1, config.gdim)[there])

    @property
    def _last(self) -> LastStep:
        assert self._sliding.last is not None
        return self._sliding.last

    @property
    def _way(self) -> Array:
        """Displacements in the step, of contactors relative to a rigid target ``(n_owned, gdim)``."""
        return self._sliding.since(self._last)

    @property
    def _turn(self) -> Array:
        """Rotation of a rigid target in the step ``(gdim, gdim)``."""
        still = Motion.none(self._config.gdim)
        return (self._pair.target.motion or still).Q @ (self._last.motion or still).Q.T

    def _then(self, needed: Bools) -> tuple[MortarKinematics, Ints]:
        """The kinematics at the beginning of the step, and contactors whose weights are needed (collective)."""
        then = self._last.kinematics
        assert isinstance(then, MortarKinematics)
        refuse_some(self._pair, needed & ~then.rows.covered, "facet that the target did not cover before a step leads")
        return then, np.flatnonzero(needed)

    def _at(self, parts: Sequence[tuple[Ints, Array]], *values: Array) -> list[list[Array]]:
        """Each of some values of the owned nodes at the nodes ``(k, c)`` of parts, zero at -1: ``(k, c gdim)`` (collective)."""
        nodes = np.concatenate([some.ravel() for some, _ in parts])
        there = np.where(nodes[:, None] >= 0, self._config.ask_owners(np.maximum(nodes, 0), np.column_stack(values)), 0.0)
        ends = np.cumsum([some.size for some, _ in parts])[:-1]
        return [
            [own.reshape(*blocks.shape[:2]) for own, (_, blocks) in zip(np.split(column, ends), parts)]
            for column in np.split(there, len(values), axis=1)
        ]

    @property
    def none(self) -> Array:
        """No changes of the positions."""
        return np.zeros((self._config.n_owned, self._config.gdim))

    def pushed(self, moved: Array, equations: ContactRows) -> tuple[Array, Array]:
        """Changes of the gaps of the pair's ``equations (m,)`` and of the residual with positions at the step's beginning (collective).

        The transpose of ``by_anchors``.
        """
        pair, config, sliding = self._pair, self._config, self._sliding
        way = self._along(moved, np.asarray(self.stuck | (self._slips & (config.gdim == 3))))
        rows = (equations.tangent >= 0) & self.stuck[equations.contactor]
        gaps = np.where(rows, np.einsum("mg,mg->m", equations.rows.direction, way[equations.contactor]), 0.0)
        own = self.none
        if config.gdim == 3:
            i, (_, _, stiffness) = np.flatnonzero(self._slips), sliding.turning(pair.trial, self._kinematics)
            turned = np.zeros_like(way)
            turned[i] = np.einsum("kgh,kh->kg", stiffness, way[i])
            own = config.add_at_owners(*sliding.frame.ties.handed_on(turned))
        return gaps, own

    def _along(self, moved: Array, needed: Bools) -> Array:
        """Changes of the relative motions of contactors with positions at the beginning of the step ``(n, gdim)`` (collective)."""
        (then, which), pair, g = self._then(needed), self._pair, self._config.gdim
        of, rows, carried = then.of, then.rows, moved.copy()
        carried[pair.nodes] = moved[pair.nodes] @ self._turn.T
        found, dofs, way = -then.ties.relative(carried), of.surface.dofs[rows.facets], self._way
        for h, unit in enumerate(np.eye(g)):
            there, whole = at_facets(of.elimination, rows, dofs, which, np.tile(unit, (len(which), 1)))
            for j in range(dofs.shape[1]):
                alone = np.zeros_like(there[:, :, 1:])
                alone[:, j] = there[:, j, 1:]
                # of the contactor at this node of each facet
                parts = handing_on(rows.points, alone)
                work = [np.einsum("ka,kab,kb->k", a, part[1], b) for a, b, part in zip(*self._at(parts, way, moved), parts)]
                nodes = np.concatenate([some[:, j] for some, _ in parts])
                found[:, h] += self._config.add_at_owners(nodes, np.concatenate(work)[:, None])[pair.nodes, 0]
        assert rows.weights is not None
        made = row_slopes(of.elimination, rows, which, there[:, :, 0], rows.weights)
        k, c = made.nodes.shape
        ((change,),) = self._at([(made.nodes, made.whole.reshape(k, c * g))], moved)
        grown = np.einsum("ka,ka->k", made.whole.reshape(k, c * g), change)
        found[which] -= self._sliding.frame.away[which] * grown[:, None] / whole
        return found

    def follow(self, moved: Array, way: Array, led: Array, first: bool) -> Array:
        """Changes of the positions of the owned nodes, of contactors relative to a rigid target ``(n_owned, gdim)``."""
        found = np.array(way)
        found[self._pair.nodes] -= led
        return found

    def back(self, by_anchors: Array, first: bool) -> tuple[Array, Array]:
        """Derivatives by positions, which are those at the beginning of the next step, and none by unchanged ones."""
        return by_anchors if by_anchors.size else self.none, self.none

    def of_contact(self, by_anchors: Array, rows: slice) -> Array:
        """The derivatives by positions of some contactors."""
        found, nodes = self.none, self._pair.nodes[rows]
        found[nodes] = by_anchors[nodes] if by_anchors.size else 0.0
        return found
