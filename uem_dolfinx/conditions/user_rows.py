"""All equations of users: linear equations and, after them, rigid couplings, whose rows depend on the displacement."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.conditions.equation import GivenRows, rows_of
from uem_dolfinx.conditions.joints import Link
from uem_dolfinx.conditions.relations import Relation, relations_of
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_rows import RigidRows
from uem_dolfinx.conditions.rigid_set import turned, velocities
from uem_dolfinx.conditions.united_rows import RightSides, UnitedRows, forces_of
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agree, reduced


def rates(
    rows: RigidRows, config: Configuration, times_mass: Callable[[Array], Array], v: Array, a: Array, free: Bools
) -> tuple[Array, Array]:
    """Velocity and acceleration of sets as rigid bodies, with the same momentum and rate of momentum (collective).

    Integrators act on each node: distances of nodes stay constant, but their rates do not vanish. Rates of joints vanish, too: with the
    gradient J and second derivatives H of their equations, ``J z = 0`` and ``J z' = -z' H z``. Added masses get their own rates.

    Args:
        rows: of the sets.
        config: configuration of the displacement.
        times_mass: multiplies a field at the owned nodes by the mass ``(n_owned, gdim)`` (collective).
        v: velocity of the owned nodes ``(n_owned, gdim)``.
        a: acceleration of the owned nodes ``(n_owned, gdim)``.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.

    Returns:
        Velocity and acceleration of the nodes ``(n, gdim)``, unchanged for sets without mass of their own.
    """
    s, g, comm, aim, basis = rows.set, config.gdim, config.comm, rows.aim(), rows.basis
    u, scale, added = config.displacement[: config.n_owned], s.scale, [one.added for one in rows.couplings]
    V, n_held = s.velocities(aim.at, s.X, s.part), len(aim.part) + rows.n_relations
    W = np.zeros_like(V)
    for i, own in enumerate(s.each):
        everywhere = velocities(config.X[: config.n_owned] + u - own.middle - aim.at[i].motion.translation) * own.scale
        of_own = np.stack([times_mass(field)[own.nodes] for field in np.moveaxis(everywhere, 2, 0)], axis=2)
        W[s.part == i, :, s[i]] = of_own
    G, plain = (reduced(comm, np.einsum("ngz,ngy->zy", X, V)) for X in (W, V))
    massless = np.array([not np.trace(G[s[i], s[i]]) > 0.0 for i in range(len(s.each))])
    if massless.all() and all(one is None for one in added):
        return v[s.nodes], a[s.nodes]
    for i, mass in enumerate(added):
        if mass is not None:
            G[s[i], s[i]] += mass.mass_of(aim.at[i]) * np.outer(scale[s[i]], scale[s[i]])
    # masses scaled to the order of 1, like the rows
    size = np.trace(G)
    G = G / size
    which = np.arange(len(basis.node)), basis.component
    held = np.logical_not(basis.halo.take(free.__getitem__)[which]) & ~massless[basis.part]
    # without mass of the nodes, what is prescribed follows from the added mass
    C = aim.C * scale
    led = ~C[:n_held, np.repeat(massless, len(scale) // len(massless))].any(axis=1)
    of_joints = C[n_held:]
    rows_of = np.concatenate([C[:n_held][led], rows.rows_of(basis, aim.at)[held], of_joints])
    k = len(rows_of)
    system = np.block([[G, rows_of.T], [rows_of, np.zeros((k, k))]])

    def rigid(field: Array, of_points: Sequence[Any], ends: Array) -> Array:
        """The motion ``(n_z,)`` with the momentum of fields ``(n_owned, gdim)`` and at the points, and its prescribed components."""
        momentum, sums = (reduced(comm, np.einsum("ngz,ng->z", X, field[s.nodes])) for X in (W, V))
        for i, (mass, own) in enumerate(zip(added, of_points)):
            if mass is not None:
                momentum[s[i]] += scale[s[i]] * np.einsum("n,ngz,ng->z", mass.masses, mass.motions(aim.at[i]), own)
        known = (C[:n_held] @ np.linalg.solve(plain, sums))[led]
        given = basis.halo.take(field.__getitem__)[which][held]
        right = np.concatenate([momentum / size, known, given, ends])
        z: Array = np.asarray(np.linalg.lstsq(system, right, rcond=None)[0], dtype=float)
        return scale * z[: len(G)]

    z = rigid(v, [None if one is None else one.velocity for one in added], np.zeros(len(of_joints)))
    bend, arms = np.empty_like(s.X), [at.arms(own.X) for at, own in zip(aim.at, s.each)]
    for i, arm in enumerate(arms):
        turn = z[s[i]][g:]
        bend[s.part == i] = turned(turn, turned(turn, arm))
    left = a.copy()
    left[s.nodes] -= bend
    at_points = [None if one is None else one.bend(aim.at[i], z[s[i]][g:]) for i, one in enumerate(added)]
    ends = -np.einsum("kzy,z,y->k", aim.bends[rows.n_relations :], z, z)
    dz = rigid(left, [None if p is None else one.acceleration - p for one, p in zip(added, at_points)], ends)
    for i, (mass, p) in enumerate(zip(added, at_points)):
        if mass is not None:
            motions = mass.motions(aim.at[i])
            mass.change_rates(motions @ z[s[i]], motions @ dz[s[i]] + p)
    moves = ~massless[s.part][:, None]
    return np.where(moves, V @ (z / scale), v[s.nodes]), np.where(moves, V @ (dz / scale) + bend, a[s.nodes])


class UserRows:
    """Linear equations and rigid couplings of a problem.

    Other equations must not contain components that rigid couplings eliminate: an equation at such a node would have to eliminate
    another component of the whole rigid body.

    Args:
        linear: linear equations, or None.
        rigid: rows of couplings that make nodes rigid, together where joints or springs connect them.
        couplings: all couplings.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
    """

    def __init__(
        self,
        config: Configuration,
        linear: UnitedRows | None,
        rigid: Sequence[RigidRows],
        couplings: Sequence[RigidCoupling],
        free: Bools,
    ):
        self._free = free
        self._config, self.linear, self.each, self._couplings = config, linear, list(rigid), list(couplings)
        #: linear equations, and the rows of couplings.
        self.parts: list[UnitedRows | RigidRows] = [one for one in (linear, *rigid) if one is not None]
        self.turning: bool = any(one.set.large for one in self.each)  # whether rows depend on the displacement
        self.equations = self._joined()  # of this rank, as last computed
        self.multipliers: Array = np.zeros(len(self.equations))  # forces along their eliminated components ``(m,)``, as last set
        self._committed: tuple[Array, list[Any]] = self.multipliers, self.turns

    def _joined(self) -> UnitingEquations:
        return UnitingEquations.join([one.equations for one in self.parts], self._config.gdim)

    @property
    def turns(self) -> list[Any]:
        """Data of the couplings in a checkpoint."""
        return [kept for one in self.each for kept in one.turns]

    @turns.setter
    def turns(self, kept: list[Any]) -> None:
        for one in self.each:
            one.turns, kept = kept[: one.n_turns], kept[one.n_turns :]

    def commit(self, dynamics: Any = None) -> None:
        """Make the present multipliers and rotations, with rates of the dynamics, those of the committed state (collective)."""
        if dynamics is not None:
            self.settle(dynamics)
        self._committed = self.multipliers, self.turns

    def restore(self) -> None:
        """Go back to the committed multipliers and rotations: the next tangent and full turns begin with them."""
        self.multipliers, self.turns = self._committed

    def memory(self) -> tuple[Array, list[Any]]:
        """Multipliers and rotations of the committed state."""
        return self._committed

    def remember(self, memory: tuple[Array, list[Any]]) -> None:
        """Restore them from ``memory``."""
        self._committed = memory
        self.restore()

    @property
    def rigid(self) -> UserRows | None:
        """These equations if they contain rigid couplings, or None."""
        return self if self.each else None

    @property
    def n_rows(self) -> int:
        """Number of rows of rigid couplings on this rank."""
        return sum(len(one.equations) for one in self.each)

    def left(self, free: Bools) -> Bools:
        """Free components ``(n_owned, gdim)`` without those that the couplings eliminate."""
        left = free.copy()
        for one in self.each:
            left[one.set.nodes] &= ~one.eliminated
        return left

    def rewritten(self, equations: UnitingEquations) -> UnitingEquations:
        """Equations with eliminated components replaced by the components that these follow (collective)."""
        for one in self.each:
            equations = one.rewritten(equations)
        return equations

    def with_rewritten(self, multipliers: Array, equations: UnitingEquations, lam: Array) -> Array:
        """Multipliers of couplings ``(k,)`` from those with rewritten equations, whose original ones have ``lam (m,)`` (collective)."""
        # original equations act on the eliminated components directly
        forces = forces_of(self._config, equations, np.where(equations.active, lam, 0.0))
        parts = [np.where(one.eliminated, forces[one.set.nodes], 0.0).ravel() for one in self.each]
        return np.asarray(multipliers - np.concatenate(parts))

    def take_load(self, at: float) -> None:
        """Evaluate functions at a load factor or time (collective)."""
        if self.linear is not None:
            self.linear.sides.take_load(at)
        for one in self._couplings:
            one.take_load(at)

    def given_values(self) -> dict[str, Any]:
        """Present right-hand sides of linear equations, by name."""
        return {} if self.linear is None else self.linear.sides.by_name()

    def begin_step(self, start: Array, fraction: float) -> None:
        """Begin a step at a fraction of a ramp that started at a displacement ``(n_owned, gdim)`` (collective)."""
        for one in self.parts:
            one.begin_step(start, fraction)

    def place(self) -> None:
        """Move nodes to positions that satisfy nonlinear equations (collective)."""
        if self.turning:
            for one in self.each:
                one.place()
            self._config.whole.x.scatter_forward()

    def at_present(self) -> UnitingEquations:
        """The equations at the present displacement, with its gaps (collective)."""
        for one in self.parts:
            one.at_present()
        self.equations = self._joined()
        return self.equations

    def largest_gap_here(self) -> float:
        """Largest gap, a length, on this rank."""
        return max((one.largest_gap_here() for one in self.parts), default=0.0)

    def joints_led(self, bound: float) -> bool:
        """Whether prescribed motions have yet to lead jointed parts by more than ``bound``, a length (collective).

        Such a step is taken whole: forces of a mechanism at rest, which vanish, are no measure of part of it.
        """
        linked = [one for one in self.each if one.jointed]
        gap = max((one.largest_gap_here() for one in linked), default=0.0)
        return bool(linked) and float(reduced(self._config.comm, gap, op=MPI.MAX)) > bound

    def curvature(self) -> list[tuple[Ints, Array]]:
        """Geometric stiffness in the tangent: global nodes ``(k, n)`` and blocks ``(k, n gdim, n gdim)`` (collective)."""
        parts = [one.curvature(forces) for one, forces in self.forces_of_each()] if self.turning else []
        return [part for part in parts if part is not None]

    def added_mass(self, factor: float | None = None) -> list[tuple[Ints, Array]]:
        """Masses at points times a factor, by default of the time step, in the format of ``curvature`` (collective)."""
        return [part for part in (one.added_mass(factor) for one in self.each) if part is not None]

    def stiffness(self) -> list[tuple[Ints, Array]]:
        """Stiffness of springs between the couplings, without its part in ``curvature``, in the same format (collective)."""
        return [part for part in (one.stiffness() for one in self.each) if part is not None]

    def sprung(self) -> list[UnitingEquations]:
        """Equations of the motions that springs between couplings resist (collective)."""
        return [one.sprung() for one in self.each if one.springy]

    def forces_of_each(self) -> Iterator[tuple[RigidRows, Array]]:
        """The couplings' forces at the owned nodes ``(n_owned, gdim)`` (collective)."""
        start = 0 if self.linear is None else len(self.linear.equations)
        for one in self.each:
            end = start + len(one.equations)
            yield one, forces_of(self._config, one.equations, self.multipliers[start:end])
            start = end

    def settle(self, dynamics: Any) -> None:
        """Set velocities and accelerations of nodes that are consistent with nonlinear equations (collective)."""
        n, g = self._config.n_owned, self._config.gdim
        for one in (one for one in self.each if one.set.large):
            v, a = (f.x.array[: n * g].reshape(n, g).copy() for f in (dynamics.velocity, dynamics.acceleration))
            v[one.set.nodes], a[one.set.nodes] = rates(one, self._config, dynamics.mass.times, v, a, self._free)
            dynamics.change_rates(v.ravel(), a.ravel())

    def check(self) -> None:
        """End a step: refuse values that contradict each other, or Dirichlet values (collective)."""
        if self.linear is not None:
            self.linear.check()
        for one, forces in self.forces_of_each():
            one.end_step(forces)

    def forces(self, multipliers: Array) -> Array:
        """Forces of the equations on the bodies, at the owned nodes ``(n_owned, gdim)`` (collective)."""
        return forces_of(self._config, self.equations, multipliers)


def _refuse_shared(coupling: RigidCoupling, taken: Bools) -> None:
    """Mark a coupling's nodes as taken ``(n_owned,)``; ConflictError if another coupling has one of them (collective)."""
    nodes, config = coupling.nodes.nodes, coupling.nodes.config
    twice, error = nodes[taken[nodes]], None
    if len(twice):
        error = ConflictError(
            f"the node at {config.describe(int(twice[0]))} is in the RigidCoupling of '{coupling.name}' and in another one: make it one "
            "coupling of both parts, or give each its own nodes"
        )
    agree(config.comm, error)
    taken[nodes] = True


def rows_of_users(
    config: Configuration,
    equations: Sequence[Any],
    couplings: Sequence[RigidCoupling],
    free: Bools,
    contactors: Sequence[Indices],
    load: Any,
    at: float,
) -> UserRows | None:
    """Equations of users in a problem with contactors ``(n,)`` of several contacts, or None (collective).

    Args:
        config: configuration of the displacement.
        equations: linear equations.
        couplings: attached.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        contactors: owned nodes of each contact.
        load: of the problem.
        at: load factor or time of the first evaluation of functions.
    """
    if not (couplings or equations):
        return None
    avoided = np.zeros(config.n_owned, dtype=bool)
    avoided[np.concatenate([np.zeros(0, np.int32), *contactors])] = True
    loaded, rigid = list(load) if isinstance(load, Mapping) else [], []
    taken = np.zeros(config.n_owned, dtype=bool)
    for one in couplings:
        one.take_load(at)
        if not one.distribute:
            _refuse_shared(one, taken)
    # linear equations do not eliminate components of couplings
    linear, relations, left = None, list[Relation](), free & ~taken[:, None]
    if equations:
        sides = RightSides(config, equations, loaded, at)
        parts = config.seams.given if config.seams else rows_of(config, equations)
        item = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        rows = GivenRows.join([replace(p, value=p.value + f) for p, f in zip(parts, sides.first)])
        if stiff := [one for one in couplings if not one.distribute]:
            among, relations = relations_of(config, rows, item, sides, stiff, left)
            rows, item = rows.select(~among), item[~among]
        linear = UnitedRows(config, sides, rows, item, left, avoided)
    for some, links in connected(couplings, relations):
        rigid.append(RigidRows(config, some, links, free, avoided, loaded))
    return UserRows(config, linear, rigid, couplings, free)


def connected(
    couplings: Sequence[RigidCoupling], relations: Sequence[Relation] = ()
) -> list[tuple[list[RigidCoupling], list[Link | Relation]]]:
    """Groups of couplings that joints, springs or relations connect, with these; couplings without are groups of one."""
    left, groups = [one for one in couplings if not one.distribute], []
    while left:
        group, links = [left.pop(0)], dict[int, Link | Relation]()
        for one in group:
            own = [*one.links, *(link for link in relations if any(end is one for end in link.ends))]
            links |= {id(link): link for link in own}
            # several links may have the same ends
            ends = {id(end): end for link in own for end in link.ends}
            group += [end for end in ends.values() if not any(end is other for other in group)]
        left = [one for one in left if not any(one is other for other in group)]
        groups.append((group, list(links.values())))
    return groups
