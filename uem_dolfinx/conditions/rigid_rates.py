"""Velocities and accelerations of rigid sets that satisfy the equations of their motions and keep momenta."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.conditions.rigid_rows import RigidRows
from uem_dolfinx.conditions.rigid_set import turned, velocities
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import reduced


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
