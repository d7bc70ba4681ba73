"""Rigid motion of sets of nodes as constraint equations, linearised at the present placement of the sets.

A rigid motion z (translation and rotation) moves node i to ``u_i = u*_i + A_i z`` from the nearest rigid placement u*. The set keeps as
many components q as z has components that are not prescribed. With B the rows of A at q, and C the rows of the prescribed motion,

    z = (B; C)^-1 (q - u*_q; h - h*)

and every other component follows. q contains components with Dirichlet conditions first, then components far from each other.

Sets that joints connect have one vector z of the motions of all of them, and the equations of the joints are further rows of C. Rows that
depend on others, in closed chains of joints, are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx.algebra.equations import NEGLIGIBLE, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.independent_rows import Basis, chosen
from uem_dolfinx.conditions.joints import Link
from uem_dolfinx.conditions.linked import Linked
from uem_dolfinx.conditions.relations import Relation
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling, nearest_turn
from uem_dolfinx.conditions.rigid_set import Placement, RigidSets, moments, turned, velocities
from uem_dolfinx.conditions.united_rows import CONTRADICTING, is_ramped
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.rigid import Motion, rotation_matrix
from uem_dolfinx.parallel import agree, reduced

#: Components of a set are chosen anew when the least singular value of their rows falls below this part of its initial value.
#: [convention; least singular value of their rows; test_rigid_coupling.py::test_when_components_are_chosen_anew]
REDUCED = 0.5

#: Springs resist a motion with more than this part of what they resist most; the rest is rounding.
#: [bound; largest stiffness of springs; -]
SPRUNG = 1e-12


@dataclass(frozen=True)
class Aim:
    """What a linearisation aims at."""

    at: list[Placement]  # placement of each set
    C: Array  # rows of the prescribed motions and, after them, of equations between parts and of joints ``(k, n_z)``
    lacking: Array  # their residuals ``(k,)``
    part: Ints  # set of each prescribed component ``(n_prescribed,)``
    bends: Array  # second derivatives of the rows of equations and joints ``(k - n_prescribed, n_z, n_z)``


class RigidRows:
    """Constraint equations of one coupling, or of several with joints and springs between them (collective).

    Args:
        links: joints, springs and relations, all of whose ends are among the couplings.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        avoided: mask of owned nodes of contacts, which are preferably eliminated ``(n_owned,)``.
        loaded: Constants that the load sets.

    Attributes:
        equations: of this rank, one for each component of its nodes, with the gaps of the last call of ``at_present``; inactive for
            components in q and for prescribed components.
        jointed, springy, n_relations: whether rows of joints or relations, and springs, are among the links; number of relations.
    """

    def __init__(
        self,
        config: Configuration,
        couplings: Sequence[RigidCoupling],
        links: Sequence[Link | Relation],
        free: Bools,
        avoided: Bools,
        loaded: Sequence[fem.Constant],
    ):
        self._config, self.couplings, self.set = config, list(couplings), RigidSets([one.nodes for one in couplings])
        self._linked = Linked(couplings, links, self.set)
        self.jointed, self.springy, self.n_relations = bool(self._linked.joints), self._linked.springy, self._linked.n_relations
        own = self.set.nodes
        self._free_nodes, self._free, self._avoided = free, free[own], avoided[own]
        ramped = np.array([is_ramped(v, loaded) for one in couplings for v in one.prescribed.values()], dtype=bool)
        self._ramped, self._n_prescribed = np.append(ramped, self._linked.ramped), len(ramped)
        self._wanted = self.values()  # values of the present step; before the first one, equations hold parts where they are
        self._wanted[self._n_prescribed :] = self._linked.values_at(self.set.placements(config.displacement[: config.n_owned]))
        self._basis: Basis | None = None
        #: Displacement at the beginning of the ramp, its rigid motions, and the values of the rows of links.
        self._start: tuple[Array, list[Array], Array] | None = None
        #: Rotations there, for a run restarted from a checkpoint ``(n_turns,)``.
        self._began: list[Array | None] = [None] * len(couplings)
        self.at_present()

    def values(self) -> Array:
        """Present values of the prescribed components and, after them, of the rows of links ``(k,)`` (collective)."""
        return np.concatenate([*(one.wanted() for one in self.couplings), self._linked.values()])

    def begin_step(self, start: Array, fraction: float) -> None:
        """Begin a step at a fraction of a ramp that started at a displacement of the owned nodes ``(n_owned, gdim)`` (collective)."""
        wanted, own = self.values(), start[self.set.nodes]
        if self._start is None or reduced(self._config.comm, int(not np.array_equal(own, self._start[0]))):
            motions = [one.motion_of(start, known) for one, known in zip(self.couplings, self._began)]
            self._start = own.copy(), motions, self._linked.values_at(self.set.placements(start))
            self._began = [None] * len(self.couplings)
        _, motions, of_links = self._start
        began = np.concatenate([*(z[list(one.prescribed)] for one, z in zip(self.couplings, motions)), of_links])
        self._wanted = np.where(self._ramped, began + fraction * (wanted - began), wanted) if fraction < 1.0 else wanted
        self._basis = None
        self.at_present()

    @property
    def led(self) -> tuple[Any, ...]:
        """Prescribed values of the present step, and ``turns``."""
        return self._wanted, self.turns

    @led.setter
    def led(self, led: tuple[Any, ...]) -> None:
        self._wanted, self.turns = led

    @property
    def n_turns(self) -> int:
        """Number of items in ``turns``."""
        return len(self.couplings) + len(self._linked.joints)

    @property
    def turns(self) -> list[Any]:
        """Rotations with their number of full turns, now and at the beginning of the ramp, and of joints, for a checkpoint."""
        g, kept = self._config.gdim, []
        for i, one in enumerate(self.couplings):
            now = one.turns
            kept.append([now.tolist(), now.tolist() if self._start is None else self._start[1][i][g:].tolist()])
        return [*kept, *(one.known for one in self._linked.joints)]

    @turns.setter
    def turns(self, kept: list[Any]) -> None:
        for i, one in enumerate(self.couplings):
            one.turns, self._began[i] = (np.array(rotation) for rotation in kept[i])
        for joint, known in zip(self._linked.joints, kept[len(self.couplings) :]):
            joint.known = float(known)
        self._start = None

    def place(self) -> None:
        """Move the nodes to the nearest finite rigid placement in which joints are closed, except Dirichlet components (collective)."""
        s = self.set
        if not s.large:
            return
        u = self._config.displacement[: self._config.n_owned]
        places = s.placements(u)
        if self._linked.joints:
            aim, basis = self.aim(), self.basis
            held = np.logical_not(basis.halo.take(self._free_nodes.__getitem__)[np.arange(len(basis.node)), basis.component])
            firm = np.concatenate([aim.C[: len(aim.part)] * s.scale, self.rows_of(basis, places)[held]])
            first = self._n_prescribed
            places = self._linked.closed(places, self._wanted[first:], basis.kept[basis.kept >= first] - first, firm)
        change = s.displacement(places, s.X, s.part) - u[s.nodes]
        self._config.shift(s.nodes, np.where(self._free, change, 0.0))

    def end_step(self, forces: Array) -> None:
        """Store the number of turns and reactions, and refuse values that no rigid motion satisfies by a ConflictError (collective)."""
        config, s, eq, g = self._config, self.set, self.at_present(), self._config.gdim
        here, held = config.displacement[: config.n_owned], iter(self._wanted)
        for one in self.couplings:
            found = one.motion_of(here)
            for i, value in zip(one.prescribed, held):
                if i >= g and g == 2:
                    found[i] = value
            one.turns = found[g:]
        size = float(reduced(config.comm, np.abs(here).max(initial=0.0), op=MPI.MAX))
        misfit = np.where(~self._free & ~self._left, np.abs(eq.gap.reshape(-1, g)), 0.0)
        error = None
        if (misfit > CONTRADICTING * size).any():
            worst = int(np.argmax(misfit.max(axis=1)))
            name = self.couplings[s.part[worst]].name
            error = ConflictError(
                f"the RigidCoupling of '{name}' and a Dirichlet value at {config.describe(int(s.nodes[worst]))} "
                f"differ by {misfit.max():.4g}: no rigid motion has the prescribed values; give values that agree, or leave conditions out"
            )
        agree(config.comm, error)
        aim, first = self.aim(), self._n_prescribed
        z = 0.0 if s.large else np.concatenate([one.motion_of(at, here) for one, at in zip(s.each, aim.at)])
        # equations of links that were left out, since they depend on others
        off = (np.abs(aim.lacking - (aim.C * z).sum(axis=1)) / self._lengths(aim))[first:]
        self._linked.check(off, CONTRADICTING * max(size, self._config.size))
        self._read(forces)

    def _multipliers(self, forces: Array) -> Array:
        """Multipliers of the rows C ``(k,)``, from the forces of the equations ``(n_owned, gdim)`` (collective)."""
        s, basis, aim = self.set, self._basis, self._linearised
        assert basis is not None
        work = reduced(self._config.comm, np.einsum("ngz,ng->z", s.velocities(aim.at, s.X, s.part), forces[s.nodes]))
        found = np.zeros(len(aim.C))
        found[basis.kept] = (self._inverse.T @ work)[len(basis.node) :] / self._lengths(aim)[basis.kept]
        return found

    def _read(self, forces: Array) -> None:
        """Reactions of prescribed motions, and forces of joints (collective)."""
        first, aim, s, g = self._n_prescribed, self._linearised, self.set, self._config.gdim
        of_joints = self._multipliers(forces)[first:] if self._linked.joints else np.zeros(0)
        work = of_joints @ aim.C[first:]
        for i, one in enumerate(self.couplings):
            force, moment = np.split(work[s[i]], [g])
            one.read_reactions(forces, force, moment - moments(aim.at[i].arms(one.point[None])[0], force))
        self._linked.read(aim.at, of_joints)

    def aim(self) -> Aim:
        """Placements for linearisation, and the rows and residuals there (collective)."""
        s, g, wanted = self.set, self._config.gdim, iter(self._wanted)
        places = s.placements(self._config.displacement[: self._config.n_owned]) if s.large else [one.reference for one in s.each]
        rows, lacking, part = [np.zeros((0, len(s.scale)))], [np.zeros(0)], []
        for i, one in enumerate(self.couplings):
            held = list(one.prescribed)
            values = np.array([next(wanted) for _ in held])
            at = places[i]
            n_turns = 1 if g == 2 else 3
            turn = nearest_turn(at.turn, one.turns) if s.large else np.zeros(n_turns)
            known = [values[held.index(k)] for k in range(g, g + n_turns) if k in held]
            if s.large and len(known) == n_turns:
                # with a prescribed rotation the rows are exact
                turn = np.array(known)
                at = places[i] = Placement(Motion(at.motion.translation, rotation_matrix(turn), at.motion.about))
            C = np.zeros((g + n_turns, len(s.scale)))
            C[:g, s[i]] = velocities(at.arms(one.point[None]))[0]
            C[g:, s[i]][:, g:] = turn_rates(turn)
            rows.append(C[held])
            lacking.append(values - np.append(at.displacement(one.point[None])[0], turn)[held])
            part += [i] * len(held)
        more, value, bends = self._linked.rows(places)
        C, residual = np.concatenate([*rows, more]), np.concatenate([*lacking, self._wanted[self._n_prescribed :] - value])
        return Aim(places, C, residual, np.array(part, dtype=np.int64), bends)

    def _lengths(self, aim: Aim) -> Array:
        """Lengths of the scaled rows C ``(k,)``."""
        size = np.linalg.norm(aim.C * self.set.scale, axis=1)
        return np.where(size > 0.0, size, 1.0)

    def at_present(self) -> UnitingEquations:
        """The equations, linearised at the present displacement and with its gaps (collective)."""
        s, config, g, aim = self.set, self._config, self._config.gdim, self.aim()
        lengths = self._lengths(aim)[:, None]
        C, lacking = aim.C * s.scale / lengths, aim.lacking / lengths[:, 0]
        basis = self._basis_for(aim.at, C)
        k, m = len(basis.node), len(s.nodes)
        inverse = np.linalg.inv(np.concatenate([self.rows_of(basis, aim.at), C[basis.kept]]))
        u = config.displacement[: config.n_owned]
        off = (basis.halo.take(u.__getitem__) - s.displacement(aim.at, basis.X, basis.part))[np.arange(k), basis.component]
        V = s.velocities(aim.at, s.X, s.part)
        gap = u[s.nodes] - s.displacement(aim.at, s.X, s.part) - V @ (inverse @ np.append(off, lacking[basis.kept]))
        nodes, which = basis.nodes
        c = np.zeros((m, g, len(nodes), g))
        c[:, :, which, basis.component] = V @ inverse[:, :k]
        node, direction = np.repeat(s.nodes, g), np.tile(np.eye(g), (m, 1))
        row, followed, coefficients = np.repeat(np.arange(m * g), len(nodes)), np.tile(nodes, m * g), c.reshape(-1, g)
        if len(self.couplings) > 1:
            # without nodes that no joint connects
            linked = coefficients.any(axis=1)
            row, followed, coefficients = row[linked], followed[linked], coefficients[linked]
        self._inverse, self._linearised, active = inverse, aim, self.eliminated.ravel()
        self.equations = UnitingEquations(node, direction, gap.ravel(), active, row, followed, coefficients)
        return self.equations

    def opened(self, change: Array, share: float) -> Array:
        """As for ``UnitedRows``, with the values of all rows ``(k,)`` (collective)."""
        aim, basis, s = self._linearised, self.basis, self.set
        lacking = (np.where(self._ramped & (change != 0.0), share, 1.0) * change / self._lengths(aim))[basis.kept]
        return -(s.velocities(aim.at, s.X, s.part) @ (self._inverse[:, len(basis.node) :] @ lacking)).ravel()

    @property
    def eliminated(self) -> Bools:
        """Mask of the components that the equations eliminate ``(n, gdim)``."""
        return self._free & ~self._left

    def rewritten(self, equations: UnitingEquations) -> UnitingEquations:
        """Other equations with ``u_i = S_i q - gap_i`` in place of eliminated components of the set (collective)."""
        config, g, eq, basis, s = self._config, self._config.gdim, equations, self._basis, self.set
        assert basis is not None
        known = np.zeros((config.n_owned, 1 + 3 * g))
        known[s.nodes] = np.column_stack([1.0 + s.part, s.X, self.eliminated, self.equations.gap.reshape(-1, g)])
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
        across = s.velocities(self._linearised.at, X, there[mine, 0].astype(np.int64) - 1)
        V = np.einsum("kg,kgz->kz", taken, across) @ self._inverse[:, : len(which)]
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

        A rotation t changes the moment ``sum r_i x f_i`` by ``(sum r_i f_i' - r_i . f_i) t``, with arms r_i from the point at
        which loads and reactions act. Returns global nodes ``(1, n)`` and the block of their components ``(1, n gdim, n gdim)``,
        on one rank; None without stiffness.
        """
        s, config, g, aim = self.set, self._config, self._config.gdim, self._linearised
        if not s.large or self._basis is None or not len(self._basis.node):
            return None
        G, first = np.zeros((len(s.scale), len(s.scale))), self._n_prescribed
        found = self._multipliers(forces)[first:] if self._linked.joints else np.zeros(0)
        # forces on each body that act elsewhere than at its point
        elsewhere = found @ aim.C[first:]
        for i, one in enumerate(self.couplings):
            at, own, added = aim.at[i], s.each[i], one.added
            f = forces[own.nodes] + one.nodal_forces()
            if added is not None:
                f = f - added.nodal_forces(added.loads())
            lever = at.displacement(own.point[None])
            arms = own.X + config.displacement[own.nodes] - own.point - lever
            W = reduced(config.comm, arms.T @ f)
            if added is not None:
                W = W + added.arms(at).T @ added.loads()
            W = W + np.outer(at.arms(own.point[None])[0], elsewhere[s[i]][:g] + one.linked_load()[0])
            turns = slice(s[i].start + g, s[i].stop)
            G[turns, turns] = -np.trace(W) if g == 2 else W - np.trace(W) * np.eye(3)
        G -= np.einsum("k,kzy->zy", found, aim.bends)
        return self._at_basis(G + self._linked.stiffness(aim.at)[1])

    def stiffness(self) -> tuple[Ints, Array] | None:
        """Stiffness of springs, without the terms of rotating forces, in the format of ``curvature``; None without any."""
        if not self.springy or self._basis is None or not len(self._basis.node):
            return None
        return self._at_basis(self._linked.stiffness(self._linearised.at)[0])

    def sprung(self) -> UnitingEquations:
        """Equations of the motions that springs resist, each on one rank; only their coefficients count (collective)."""
        config, (basis, scale, g) = self._config, (self.basis, self.set.scale, self._config.gdim)
        value, vector = np.linalg.eigh(self._linked.stiffness(self._linearised.at)[0] * np.outer(scale, scale))
        here = len(basis.node) > 0 and config.owner_of(basis.node[:1])[0] == config.comm.rank
        rows = vector[:, value > SPRUNG * value[-1]].T @ self._inverse[:, : len(basis.node)] if here else np.zeros((0, 0))
        nodes, which = basis.nodes
        n, k = len(rows), len(nodes)
        c = np.zeros((n, k, g))
        if n:
            c[:, which, basis.component] = rows
        node = np.full(n, int(basis.node[0]) - config.first if n else 0, dtype=np.int32)
        return UnitingEquations(
            node,
            np.zeros((n, g)),
            np.zeros(n),
            np.ones(n, dtype=bool),
            np.repeat(np.arange(n), k),
            np.tile(nodes, n),
            c.reshape(-1, g),
        )

    def added_mass(self, factor: float | None = None) -> tuple[Ints, Array] | None:
        """The mass at the point times a factor, by default of the time step, in the format of ``curvature``; None without mass."""
        s, basis, some = self.set, self._basis, [one.added for one in self.couplings if one.added is not None]
        if not some or basis is None or not len(basis.node) or (factor is None and not some[0].factor):
            return None
        G = np.zeros((len(s.scale), len(s.scale)))
        for i, one in enumerate(self.couplings):
            if one.added is not None:
                G[s[i], s[i]] = (one.added.factor if factor is None else factor) * one.added.mass_of(self._linearised.at[i])
        return self._at_basis(G)

    @property
    def motions(self) -> Array:
        """Motions of the sets for unit components of the basis ``(n_z, k)``."""
        return (self._inverse * self.set.scale[:, None])[:, : len(self.basis.node)]

    def _at_basis(self, G: Array) -> tuple[Ints, Array]:
        """A matrix of motions ``(n_z, n_z)`` as global nodes ``(1, n)`` and block ``(1, n gdim, n gdim)`` of the basis, on one rank."""
        config, g, basis = self._config, self._config.gdim, self._basis
        assert basis is not None
        (nodes, which), T = basis.nodes, self.motions
        block = np.zeros((len(nodes), g, len(nodes), g))
        block[which[:, None], basis.component[:, None], which, basis.component] = T.T @ G @ T
        own = 1 if config.comm.rank == 0 else 0
        return np.tile(nodes, (own, 1)), np.tile(block.reshape(len(nodes) * g, -1), (own, 1, 1))

    def rows_of(self, basis: Basis, at: Sequence[Placement]) -> Array:
        """Rows B of the components q ``(k, n_z)``."""
        return self.set.velocities(at, basis.X, basis.part)[np.arange(len(basis.node)), basis.component]

    def _least(self, basis: Basis, at: Sequence[Placement], C: Array) -> float:
        """Smallest singular value of the rows B and C."""
        rows = np.concatenate([self.rows_of(basis, at), C[basis.kept]])
        return float(np.linalg.svd(rows, compute_uv=False)[-1])

    @property
    def basis(self) -> Basis:
        """The components q."""
        assert self._basis is not None
        return self._basis

    def _basis_for(self, at: Sequence[Placement], C: Array) -> Basis:
        """Components q that determine the motion together with C, unchanged as long as they are well conditioned (collective)."""
        if self._basis is not None and self._least(self._basis, at, C) < REDUCED * self._basis.least:
            self._basis = None
        if self._basis is None:
            found = chosen(self._config, self.set, [one.name for one in self.couplings], at, C, (self._free, self._avoided))
            self._basis = replace(found, least=self._least(found, at, C))
            at_nodes = self._config.to_global(self.set.nodes)[:, None, None] == self._basis.node
            #: Mask of the components q of this rank's nodes ``(n, gdim)``.
            self._left: Bools = (at_nodes & (np.arange(self._config.gdim)[:, None] == self._basis.component)).any(axis=2)
        return self._basis


def turn_rates(turn: Array) -> Array:
    """Rates of a rotation vector ``(n_turns,)`` for unit angular velocities ``(n_turns, n_turns)``."""
    angle = np.linalg.norm(turn)
    if len(turn) == 1 or angle == 0.0:
        return np.eye(len(turn))
    W = turned(turn / angle, np.eye(3)).T
    half = 0.5 * angle
    return np.asarray(np.eye(3) - half * W + (1.0 - half / np.tan(half)) * W @ W)
