"""Derivatives of rigid couplings by the reference positions of their nodes, and of equations that follow them.

Nodes of a rigid part are at ``x_i = x_p + R (X_i - p)``. With the change ``y_i = R X_i'`` of their positions relative to the part,

    rows of the coupling:   L (x' - y) = 0,    z' = Z (x' - y)_q    for the motion z of the part
    moment of forces f:     sum y_i x f_i (of small rotations, X_i' x f_i),    in addition to the stiffnesses of f and of springs times z'

where q are the components that the part keeps. Equations of contacts have the motions of the part in place of eliminated components,
so that what opens the rows of the coupling opens them, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.rigid_rows import RigidRows
from uem_dolfinx.conditions.rigid_set import moments, turned
from uem_dolfinx.conditions.user_rows import UserRows
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.gradients.shape_slopes import ShapeSlopes, of_equations, of_tie
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.rows import Rows


@dataclass(frozen=True)
class RigidSlopes:
    """Derivatives of the rows of couplings that move together, and of their forces, as ``ShapeSlopes``.

    Attributes:
        one: the rows.
        M: of each node, turns changes of reference positions with the part ``(n, gdim, gdim)``.
        arms: the same for the arms of forces, which small rotations do not turn.
        forces: of the bodies at the nodes, without forces of contacts ``(n, gdim)``.
        rows: derivatives by y, without the moments.
    """

    one: RigidRows
    M: Array
    arms: Array
    forces: Array
    rows: ShapeSlopes

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


def shape_slopes_of(problem: UnitedProblem, equations: Sequence[ContactRows]) -> list[tuple[slice, ShapeSlopes | RigidSlopes]]:
    """Of all ties, linear equations and couplings of a problem, each with its place among the equations of contacts and users (collective).

    Args:
        problem: in the state of the derivatives.
        equations: of each of its interfaces.
    """
    found, first = list[tuple[slice, ShapeSlopes | RigidSlopes]](), 0
    for pair, own in zip(problem.interfaces, equations):
        if pair.tie is not None and pair.tie.rows is not None and pair.trial.bond is not None:
            slopes = of_tie(pair.tie, pair.trial.bond)
            found.append((slice(first + len(own) - len(slopes.rows[0]), first + len(own)), slopes))
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
    """Equations in which motions of rigid parts have taken the place of eliminated components.

    Args:
        config: configuration of the displacement.
        rows: all equations, those of rigid couplings last.
    """

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
