"""Rigid motion of a set of nodes as constraint equations, linearised at the present placement of the set.

A rigid motion z (translation and rotation) moves node i to ``u_i = u*_i + A_i z`` from the nearest rigid placement u*. The set keeps as
many components q as z has components that are not prescribed. With B the rows of A at q, and C the rows of the prescribed motion,

    z = (B; C)^-1 (q - u*_q; h - h*)

and every other component follows. q contains components with Dirichlet conditions first, then components far from each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx.algebra.equations import NEGLIGIBLE, UnitingEquations
from uem_dolfinx.algebra.rings import DEPENDENT
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.places import COINCIDENT, NEAR
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling, nearest_turn
from uem_dolfinx.conditions.rigid_set import Placement, turned, velocities
from uem_dolfinx.conditions.united_rows import CONTRADICTING, is_ramped
from uem_dolfinx.errors import ConflictError, SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.rigid import Motion, rotation_matrix
from uem_dolfinx.parallel import agree, gathered, reduced

#: Components of a set are chosen anew when the least singular value of their rows falls below this part of its initial value.
#: [convention; least singular value of their rows; test_rigid_coupling.py::test_when_components_are_chosen_anew]
REDUCED = 0.5


@dataclass(frozen=True)
class Basis:
    """Components q that a set keeps, the same on all ranks.

    Attributes:
        node: global nodes ``(k,)``.
        component: of each ``(k,)``.
        X: positions of the nodes in the reference configuration ``(k, gdim)``.
        least: smallest singular value of their rows and the rows of the prescribed motion, when they were chosen.
        halo: fetches values from the owners.
    """

    node: Ints
    component: Ints
    X: Array
    least: float
    halo: Halo

    @cached_property
    def nodes(self) -> tuple[Ints, Ints]:
        """Distinct nodes, ascending, and the index of each component's node among them ``(k,)``."""
        nodes, which = np.unique(self.node, return_inverse=True)
        return nodes, which


class RigidRows:
    """Constraint equations of one coupling (collective).

    Args:
        config: configuration of the displacement.
        coupling: attached.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        avoided: mask of owned nodes of contacts, which are preferably eliminated ``(n_owned,)``.
        loaded: Constants that the load sets.

    Attributes:
        equations: of this rank, one for each component of its nodes, with the gaps of the last call of ``at_present``; inactive for
            components in q and for prescribed components.
    """

    def __init__(
        self, config: Configuration, coupling: RigidCoupling, free: Bools, avoided: Bools, loaded: Sequence[fem.Constant]
    ):
        self._config, self.coupling, self.set = config, coupling, coupling.nodes
        own = self.set.nodes
        #: Components with Dirichlet condition of all owned nodes ``(n_owned, gdim)``.
        self._held_nodes: Bools = ~free
        self._free, self._avoided = free[own], avoided[own]
        self._ramped = np.array([is_ramped(value, loaded) for value in coupling.prescribed.values()], dtype=bool)
        self._wanted = coupling.wanted()
        self._basis: Basis | None = None
        #: Displacement at the beginning of the ramp, and its rigid motion.
        self._start: tuple[Array, Array] | None = None
        #: Rotation there, for a run restarted from a checkpoint ``(n_turns,)``.
        self._began: Array | None = None
        self.at_present()

    # -- steps -------------------------------------------------------------------------------------------------------------

    def begin_step(self, start: Array, fraction: float) -> None:
        """Begin a step at a fraction of a ramp that started at a displacement of the owned nodes ``(n_owned, gdim)`` (collective)."""
        held, wanted = list(self.coupling.prescribed), self.coupling.wanted()
        own = start[self.set.nodes]
        if self._start is None or reduced(self._config.comm, int(not np.array_equal(own, self._start[0]))):
            # all steps of a ramp count rotations from its start
            self._start, self._began = (own.copy(), self.coupling.motion_of(start, self._began)), None
        began = self._start[1][held]
        self._wanted = np.where(self._ramped, began + fraction * (wanted - began), wanted) if fraction < 1.0 else wanted
        self._basis = None

    @property
    def turns(self) -> list[list[float]]:
        """Rotations with their number of full turns, now and at the beginning of the ramp, for a checkpoint."""
        now = self.coupling.turns
        return [now.tolist(), now.tolist() if self._start is None else self._start[1][self._config.gdim :].tolist()]

    @turns.setter
    def turns(self, kept: list[list[float]]) -> None:
        self.coupling.turns, self._began = (np.array(rotation) for rotation in kept)
        self._start = None

    def place(self) -> None:
        """Move the nodes to the nearest finite rigid placement, except components with Dirichlet conditions (collective)."""
        if not self.set.large:
            return
        u, nodes = self._config.displacement[: self._config.n_owned], self.set.nodes
        change = self.set.placement(u).displacement(self.set.X) - u[nodes]
        self._config.shift(nodes, np.where(self._free, change, 0.0))

    def end_step(self) -> None:
        """Store the number of turns, and refuse Dirichlet values that no rigid motion satisfies (collective).

        Raises:
            ConflictError: names the position.
        """
        config, eq = self._config, self.at_present()
        shift = config.gdim
        found = self.coupling.motion_of(config.displacement[: config.n_owned])
        for i, value in zip(self.coupling.prescribed, self._wanted):
            if i >= shift and shift == 2:
                found[i] = value
        self.coupling.turns = found[shift:]
        size = float(reduced(config.comm, np.abs(config.displacement[: config.n_owned]).max(initial=0.0), op=MPI.MAX))
        misfit = np.where(~self._free & ~self._left, np.abs(eq.gap.reshape(-1, shift)), 0.0)
        error = None
        if (misfit > CONTRADICTING * size).any():
            worst = int(np.argmax(misfit.max(axis=1)))
            error = ConflictError(
                f"the RigidCoupling of '{self.coupling.name}' and a Dirichlet value at {config.describe(int(self.set.nodes[worst]))} "
                f"differ by {misfit.max():.4g}: no rigid motion has the prescribed values; give values that agree, or leave conditions out"
            )
        agree(config.comm, error)

    # -- rows --------------------------------------------------------------------------------------------------------------

    def _aim(self) -> tuple[Placement, Array, Array]:
        """Placement for linearisation, rows C of the prescribed motion ``(k, n_z)``, and their residuals ``(k,)`` (collective)."""
        s, g, held = self.set, self._config.gdim, list(self.coupling.prescribed)
        n_turns = 1 if g == 2 else 3
        if not s.large:
            at, turn = s.reference, np.zeros(n_turns)
        else:
            at = s.placement(self._config.displacement[: self._config.n_owned])
            turn = nearest_turn(at.turn, self.coupling.turns)
            known = [self._wanted[held.index(i)] for i in range(g, g + n_turns) if i in held]
            if len(known) == n_turns:
                # with a prescribed rotation the rows are exact
                turn = np.array(known)
                at = Placement(Motion(at.motion.translation, rotation_matrix(turn), at.motion.about))
        C = np.zeros((g + n_turns, g + n_turns))
        C[:g] = velocities(at.arms(s.point[None]))[0]
        C[g:, g:] = turn_rates(turn)
        now = np.append(at.displacement(s.point[None])[0], turn)
        return at, C[held], self._wanted - now[held]

    def at_present(self) -> UnitingEquations:
        """The equations, linearised at the present displacement and with its gaps (collective)."""
        s, config, g = self.set, self._config, self._config.gdim
        at, C, lacking = self._aim()
        C = C * s.scale
        lengths = np.linalg.norm(C, axis=1)
        C, lacking = C / lengths[:, None], lacking / lengths
        basis = self._basis_for(at, C)
        k, m = len(basis.node), len(s.nodes)
        inverse = np.linalg.inv(np.concatenate([self._rows_of(basis, at), C]))
        u = config.displacement[: config.n_owned]
        off = (basis.halo.take(u.__getitem__) - at.displacement(basis.X))[np.arange(k), basis.component]
        V = velocities(at.arms(s.X)) * self.set.scale
        gap = u[s.nodes] - at.displacement(s.X) - V @ (inverse @ np.append(off, lacking))
        nodes, which = basis.nodes
        c = np.zeros((m, g, len(nodes), g))
        c[:, :, which, basis.component] = V @ inverse[:, :k]
        node, direction = np.repeat(s.nodes, g), np.tile(np.eye(g), (m, 1))
        row, followed = np.repeat(np.arange(m * g), len(nodes)), np.tile(nodes, m * g)
        self._inverse, self._at, active = inverse, at, self.eliminated.ravel()
        self.equations = UnitingEquations(node, direction, gap.ravel(), active, row, followed, c.reshape(-1, g))
        return self.equations

    @property
    def eliminated(self) -> Bools:
        """Mask of the components that the equations eliminate ``(n, gdim)``."""
        return self._free & ~self._left

    def rewritten(self, equations: UnitingEquations) -> UnitingEquations:
        """Other equations with ``u_i = S_i q - gap_i`` in place of eliminated components of the set (collective)."""
        config, g, eq, basis, s = self._config, self._config.gdim, equations, self._basis, self.set
        assert basis is not None
        known = np.zeros((config.n_owned, 1 + 3 * g))
        known[s.nodes] = np.column_stack([np.ones(len(s.nodes)), s.X, self.eliminated, self.equations.gap.reshape(-1, g)])
        # the terms of an equation, with its own node first
        m = len(eq)
        row = np.concatenate([np.arange(m), eq.row])
        node = np.concatenate([config.to_global(eq.node), eq.followed])
        terms = np.concatenate([-eq.direction, eq.coefficients])
        there = config.ask_owners(node, known)
        mine = there[:, 0] > 0
        X, gone, gap = there[mine, 1 : 1 + g], there[mine, 1 + g : 1 + 2 * g], there[mine, 1 + 2 * g :]
        rows, taken = row[mine], terms[mine] * gone
        terms[mine] -= taken
        nodes, which = basis.nodes
        V = np.einsum("kg,kgz->kz", taken, velocities(self._at.arms(X)) * self.set.scale) @ self._inverse[:, : len(which)]
        added = np.zeros((m, len(nodes), g))
        np.add.at(added.reshape(m, len(nodes) * g), (rows[:, None], which * g + basis.component), V)
        i, k = np.nonzero(np.abs(added).max(axis=2, initial=0.0) > NEGLIGIBLE)
        gaps, row = eq.gap + np.bincount(rows, (taken * gap).sum(axis=1), m), np.concatenate([eq.row, i])
        followed, kept = np.concatenate([eq.followed, nodes[k]]), np.concatenate([terms[m:], added[i, k]])
        return replace(eq, direction=-terms[:m], gap=gaps, row=row, followed=followed, coefficients=kept)

    def largest_gap_here(self) -> float:
        """Largest gap over the sum of the coefficients of its equation, a length, on this rank."""
        eq = self.equations
        size = 1.0 + np.bincount(eq.row, np.abs(eq.coefficients).sum(axis=1), len(eq))
        return float((np.abs(eq.gap) / size)[eq.active].max(initial=0.0))

    def curvature(self, forces: Array) -> tuple[Ints, Array] | None:
        """Geometric stiffness of the rotating rows, from the forces of the coupling ``(n_owned, gdim)`` (collective).

        A rotation t changes the moment ``sum r_i x f_i`` by ``(sum r_i f_i' - r_i . f_i) t``, with arms r_i from the point at which loads
        and reactions act.

        Returns:
            Global nodes ``(1, n)`` and the block of their components ``(1, n gdim, n gdim)``, on one rank; None without stiffness.
        """
        s, config, g, added = self.set, self._config, self._config.gdim, self.coupling.added
        if not s.large or self._basis is None or not len(self._basis.node):
            return None
        f = forces[s.nodes] + self.coupling.nodal_forces()
        if added is not None:
            f = f - added.nodal_forces(added.loads())
        arms = s.X + config.displacement[s.nodes] - s.point - self._at.displacement(s.point[None])
        W = reduced(config.comm, arms.T @ f)
        if added is not None:
            W = W + added.arms(self._at).T @ added.loads()
        G = np.zeros((len(self._inverse), len(self._inverse)))
        G[g:, g:] = -np.trace(W) if g == 2 else W - np.trace(W) * np.eye(3)
        return self._at_basis(G)

    def added_mass(self, factor: float | None = None) -> tuple[Ints, Array] | None:
        """The mass at the point times a factor, by default of the time step, in the format of ``curvature``; None without mass."""
        added, basis = self.coupling.added, self._basis
        if added is None or basis is None or not len(basis.node) or (factor is None and not added.factor):
            return None
        return self._at_basis((added.factor if factor is None else factor) * added.mass_of(self._at))

    def _at_basis(self, G: Array) -> tuple[Ints, Array]:
        """A matrix of motions ``(n_z, n_z)`` as global nodes ``(1, n)`` and block ``(1, n gdim, n gdim)`` of the basis, on one rank."""
        config, g, basis = self._config, self._config.gdim, self._basis
        assert basis is not None
        nodes, which = basis.nodes
        T = (self._inverse * self.set.scale[:, None])[:, : len(which)]
        block = np.zeros((len(nodes), g, len(nodes), g))
        block[which[:, None], basis.component[:, None], which, basis.component] = T.T @ G @ T
        own = 1 if config.comm.rank == 0 else 0
        return np.tile(nodes, (own, 1)), np.tile(block.reshape(len(nodes) * g, -1), (own, 1, 1))

    # -- motion in time ----------------------------------------------------------------------------------------------------

    def rates(self, times_mass: Callable[[Array], Array], v: Array, a: Array) -> tuple[Array, Array]:
        """Velocity and acceleration of the set as a rigid body, with the same momentum and rate of momentum (collective).

        Integrators act on each node: distances of nodes stay constant, but their rates do not vanish. The added mass gets its own rates.

        Args:
            times_mass: multiplies a field at the owned nodes by the mass ``(n_owned, gdim)`` (collective).
            v: velocity of the owned nodes ``(n_owned, gdim)``.
            a: acceleration of the owned nodes ``(n_owned, gdim)``.

        Returns:
            Velocity and acceleration of the set's nodes ``(n, gdim)``, unchanged if the set has no mass of its own.
        """
        s, config, g, added = self.set, self._config, self._config.gdim, self.coupling.added
        u, nodes, comm = config.displacement[: config.n_owned], s.nodes, self._config.comm
        at, C, _ = self._aim()
        arms, scale = at.arms(s.X), s.scale
        V, C = velocities(arms) * scale, C * scale
        everywhere = velocities(config.X[: config.n_owned] + u - s.middle - at.motion.translation) * scale
        W = np.stack([times_mass(field)[nodes] for field in np.moveaxis(everywhere, 2, 0)], axis=2)
        G, plain = (reduced(comm, np.einsum("ngz,ngy->zy", X, V)) for X in (W, V))
        massless = not np.trace(G) > 0.0
        if massless and added is None:
            return v[nodes], a[nodes]
        if added is not None:
            G = G + added.mass_of(at) * np.outer(scale, scale)
        # masses scaled to the order of 1, like the rows
        size = np.trace(G)
        G = G / size
        basis = self._basis_for(at, C)
        held = basis.halo.take(self._held_nodes.__getitem__)[np.arange(len(basis.node)), basis.component]
        rows = np.concatenate([C, self._rows_of(basis, at)[held]])

        def rigid(field: Array, of_point: Array) -> Array:
            """The motion ``(n_z,)`` with the momentum of fields ``(n_owned, gdim)`` and at the point, and its prescribed components."""
            momentum, sums = (reduced(comm, np.einsum("ngz,ng->z", X, field[nodes])) for X in (W, V))
            if added is not None:
                momentum = momentum + scale * np.einsum("n,ngz,ng->z", added.masses, added.motions(at), of_point)
            momentum = momentum / size
            if massless:
                # without mass of the nodes, the prescribed components follow from the added mass
                return scale * np.asarray(np.linalg.lstsq(G, momentum, rcond=None)[0], dtype=float)
            known = C @ np.linalg.solve(plain, sums)
            given = basis.halo.take(field.__getitem__)[np.arange(len(basis.node)), basis.component][held]
            k = len(rows)
            system = np.block([[G, rows.T], [rows, np.zeros((k, k))]])
            z: Array = np.asarray(np.linalg.lstsq(system, np.concatenate([momentum, known, given]), rcond=None)[0], dtype=float)
            return scale * z[: len(G)]

        none = np.zeros((0, g))
        z = rigid(v, none if added is None else added.velocity)
        turn = z[g:]
        bend, left = turned(turn, turned(turn, arms)), a.copy()
        left[nodes] -= bend
        if added is None:
            return velocities(arms) @ z, velocities(arms) @ rigid(left, none) + bend
        at_point = added.bend(at, turn)
        dz = rigid(left, added.acceleration - at_point)
        added.change_rates(added.motions(at) @ z, added.motions(at) @ dz + at_point)
        return (v[nodes], a[nodes]) if massless else (velocities(arms) @ z, velocities(arms) @ dz + bend)

    # -- components that the set keeps -------------------------------------------------------------------------------------

    def _rows_of(self, basis: Basis, at: Placement) -> Array:
        """Rows B of the components q ``(k, n_z)``."""
        return (velocities(at.arms(basis.X)) * self.set.scale)[np.arange(len(basis.node)), basis.component]

    def _least(self, basis: Basis, at: Placement, C: Array) -> float:
        """Smallest singular value of the rows B and C."""
        return float(np.linalg.svd(np.concatenate([self._rows_of(basis, at), C]), compute_uv=False)[-1])

    def _basis_for(self, at: Placement, C: Array) -> Basis:
        """Components q that determine the motion together with C, unchanged as long as they are well conditioned (collective)."""
        if self._basis is not None and self._least(self._basis, at, C) < REDUCED * self._basis.least:
            self._basis = None
        if self._basis is None:
            self._basis = self._choose(at, C)
            at_nodes = self._config.to_global(self.set.nodes)[:, None, None] == self._basis.node
            #: Mask of the components q of this rank's nodes ``(n, gdim)``.
            self._left: Bools = (at_nodes & (np.arange(self._config.gdim)[:, None] == self._basis.component)).any(axis=2)
        return self._basis

    def _choose(self, at: Placement, C: Array) -> Basis:
        """Components q that determine the motion together with C, each with the largest row orthogonal to the previous rows (collective).

        Raises:
            SurfaceError: if there are too few.
        """
        s, config, g = self.set, self._config, self._config.gdim
        across = velocities(at.arms(s.X)) * self.set.scale
        chosen: list[Array] = []
        for c in np.linalg.qr(C.T)[0].T:
            across = _without(across, c)
        places = np.round(s.X / (COINCIDENT * config.size))
        numbers = config.to_global(s.nodes)
        for allowed in (~self._free, self._free & ~self._avoided[:, None], self._free):
            while len(chosen) + len(C) < across.shape[2]:
                size = np.where(allowed, np.linalg.norm(across, axis=2), 0.0)
                largest = float(reduced(config.comm, size.max(initial=0.0), op=MPI.MAX))
                if largest <= DEPENDENT:
                    break
                # of equal candidates the first by position, on any number of ranks
                node, component = np.nonzero(size >= (1.0 - NEAR) * largest)
                order = np.lexsort([component, *places[node].T[::-1]])[:1]
                offer = np.full(2 * g + 2 + across.shape[2], np.inf)
                if len(order):
                    i, j = node[order[0]], component[order[0]]
                    offer = np.concatenate([places[i], [j, numbers[i]], s.X[i], across[i, j]])
                every = gathered(config.comm, offer)
                best = every[np.lexsort([*every[:, g::-1].T])[0]]
                chosen.append(best[: 2 * g + 2])
                across = _without(across, best[2 * g + 2 :])
        if len(chosen) + len(C) < across.shape[2]:
            raise SurfaceError(
                f"the RigidCoupling of '{self.coupling.name}': its nodes do not determine its motion, given the prescribed "
                "components; give it more nodes, or leave out components of its motion"
            )
        table = np.array(chosen).reshape(-1, 2 * g + 2)
        node, component = table[:, g + 1].astype(np.int64), table[:, g].astype(np.int64)
        basis = Basis(node, component, table[:, g + 2 :], 0.0, Halo(config, node))
        return replace(basis, least=self._least(basis, at, C))


def _without(rows: Array, row: Array) -> Array:
    """Rows ``(..., n)`` without their components along another row."""
    q = row / np.linalg.norm(row)
    return rows - (rows @ q)[..., None] * q


def turn_rates(turn: Array) -> Array:
    """Rates of a rotation vector ``(n_turns,)`` for unit angular velocities ``(n_turns, n_turns)``."""
    angle = np.linalg.norm(turn)
    if len(turn) == 1 or angle == 0.0:
        return np.eye(len(turn))
    W = turned(turn / angle, np.eye(3)).T
    half = 0.5 * angle
    return np.asarray(np.eye(3) - half * W + (1.0 - half / np.tan(half)) * W @ W)
