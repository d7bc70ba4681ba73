"""Prediction of first contact, for bodies that follow their Dirichlet conditions rigidly, and of nodes that may be followed next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.pair.tables import slides
from uem_dolfinx.contact.seam import active_set
from uem_dolfinx.contact.seam.active_set import Violations
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import followed_nodes
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.rigid.rigid_motions import OPEN, RigidMotions

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver


def touch_ahead(
    bodies: Bodies,
    pairs: Sequence[Interface],
    rigid: RigidMotions | None,
    place: Callable[[], None],
    look_within: Callable[[float], object],
) -> None:
    """If there are no contact forces yet, activate the contactors that rigid motions move deepest into their targets (collective).

    This saves the solve that would find them; wrong ones are released before anything moves. With friction nothing is done, since a
    solve is needed for the slip directions.

    Args:
        bodies: held by their conditions.
        pairs: of all contacts.
        rigid: motions of the bodies; None without contacts.
        place: projects all contactors.
        look_within: searches contacts that may come near by motions of a given length; see ``FarApart``.
    """
    config, comm = bodies.config, bodies.comm
    known = reduced(comm, any(pair.friction is not None or pair.trial.lam.any() for pair in pairs), op=MPI.LOR)
    if known or rigid is None:
        return
    place()
    free, prescribed = bodies.free[: config.n_owned], bodies.prescribed[: config.n_owned]
    du = np.where(free, rigid.field(rigid.following(prescribed)), prescribed)
    way = float(reduced(comm, np.abs(du).max(initial=0.0), op=MPI.MAX))
    look_within(way)
    near = OPEN * way
    pairs = in_question(pairs)
    gaps = [pair.kinematics.gap_rows.gaps(du) for pair in pairs]
    violated = []
    for pair, gap in zip(pairs, gaps):
        none = np.zeros(len(pair.nodes))
        violated.append(pair.violated(gap, pair.traction._replace(lam=none), none, near, False, du))
    if reduced(comm, any(w.enter.any() for w in violated), op=MPI.LOR):
        for pair, first in zip(pairs, deepest_of(pairs, gaps, violated)):
            pair.exchange(first)


def deepest_of(pairs: Sequence[Interface], gaps: Sequence[Array], violated: Sequence[Violations]) -> list[Violations]:
    """Of contactors that would all be activated at once, only those deep enough for first contact, and all released ones (collective).

    Args:
        pairs: of all contacts.
        gaps: that decide on contact, of every pair ``(n,)``.
        violated: violating contactors of every pair; at least one is to be activated.
    """
    config = pairs[0].config
    g, entering = config.gdim, [w.enter for w in violated]
    points = np.concatenate([pair.points[enter] for pair, enter in zip(pairs, entering)])
    overlap = -np.concatenate([gap[enter] for gap, enter in zip(gaps, entering)])
    reach = np.array([*points.max(axis=0, initial=-np.inf), *(-points).max(axis=0, initial=-np.inf), overlap.max(initial=0.0)])
    config.comm.Allreduce(MPI.IN_PLACE, reach, op=MPI.MAX)
    span = float(np.linalg.norm(reach[:g] + reach[g : 2 * g])) / config.size
    depth = active_set.deep_enough(span, g) * float(reach[-1])
    return [w.on_first_touch(gap, depth) for w, gap in zip(violated, gaps)]


def nodes_next_to(config: Configuration, pairs: Sequence[Interface]) -> Callable[[Bools], Bools] | None:
    """Function from a mask of nodes to the mask of owned nodes of target facets at these nodes ``(n_owned,)``; None without sliding."""
    moving = [pair.target for pair in pairs if slides(pair) and pair.target.n_nodes and pair.tie is None]
    facets = list({id(target.dofs): target.dofs for target in moving}.values())
    every = np.arange(config.n_local)

    def next_to(nodes: Bools) -> Bools:
        on = config.from_owners(every[: config.n_owned], nodes[:, None].astype(float), every)[:, 0] > 0.0
        found = np.concatenate([dofs[on[dofs].any(axis=1)].ravel() for dofs in facets])
        return followed_nodes(config, found)[: config.n_owned]

    return next_to if facets else None


def way_ahead(bodies: Bodies, solver: UnitedSolver, pairs: Sequence[Interface], first: bool) -> Array | None:
    """Way of the owned nodes by which contactors may come together ``(n_owned, gdim)``; None to solve the present state alone.

    Problems with friction are solved on arrays from the beginning where a condensation is kept, in the present contact or with the velocity
    of the last step's end. So is the ``first`` one of a time step where other states would be factorised anew.
    """
    dynamics, way = bodies.dynamics, np.zeros((bodies.forces.size // bodies.config.gdim, bodies.config.gdim))
    ahead = first and dynamics is not None and not (solver.lasting or solver.iterative)
    if not (ahead or solver.slots.now is not None) or not any(pair.friction is not None for pair in pairs):
        return None
    return way if dynamics is None else way + dynamics.dt * dynamics.velocity.x.array[: way.size].reshape(way.shape)
