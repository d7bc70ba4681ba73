"""Which contactors touch first: told by how bodies would move if they followed their Dirichlet conditions rigidly."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import numpy as np

from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.solve.body_forces import BodyForces
from uem_dolfinx.solve.rigid_motions import OPEN, RigidMotions


def touch_ahead(forces: BodyForces, pairs: Sequence[ContactPair], place: Callable[[], None]) -> None:
    """Where no contactor is pushed yet, activate those that rigid bodies would take deepest into their targets (collective).

    It saves the solve that would find them; who is wrong among them is released before anything moves. Contactors with friction are left
    to that solve, which tells the way that they slip.

    Args:
        forces: of bodies that their conditions hold.
        pairs: of all contacts.
        place: projects all contactors.
    """
    config, comm = forces.config, forces.comm
    known = comm.allreduce(any(pair.rough or pair.trial.lam.any() for pair in pairs), op=MPI.LOR)
    if known or not pairs:
        return
    place()
    free, prescribed = forces.free[: config.n_owned], forces.prescribed
    rigid = RigidMotions(config, free, not forces.tangent.linear)
    du = np.where(free, rigid.field(rigid.following(prescribed)), prescribed)
    near = OPEN * float(comm.allreduce(np.abs(du).max(initial=0.0), op=MPI.MAX))
    entering, deepest = [], 0.0
    for pair in pairs:
        gap, none = pair.foreseen(du), np.zeros(len(pair.nodes))
        wrong = pair.wrong(gap, none, none, none, near, False, du)
        entering.append((pair, gap, wrong))
        deepest = max(deepest, -float(gap[wrong.enter].min(initial=0.0)))
    deepest = comm.allreduce(deepest, op=MPI.MAX)
    if deepest > 0.0:
        for pair, gap, wrong in entering:
            pair.exchange(wrong.on_first_touch(gap, deepest), False)
