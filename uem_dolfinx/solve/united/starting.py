"""Where a motion begins: nodes without mass in equilibrium, and the first accelerations; also after supports have changed."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools
from uem_dolfinx.conditions.user_rows import rows_of_users
from uem_dolfinx.contact.switched import hold
from uem_dolfinx.dynamics.explicit.part_solver import SurfaceSolver
from uem_dolfinx.dynamics.massless import followed_by
from uem_dolfinx.errors import UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.united.rows import OverConstraints
from uem_dolfinx.solve.united.system import BodySystem


def hold_others(problem: Any, bcs: Sequence[Any]) -> None:
    """Replace the Dirichlet conditions of a problem in time, checked, between two steps (collective).

    The acceleration of what is released follows from the forces at this instant, as at the start.
    """
    bodies, dynamics, config, held = problem.bodies, problem.dynamics, problem.config, problem.bodies.held
    bodies.hold(bcs)
    changed = held != bodies.held
    if not reduced(problem.comm, bool(changed.any()), op=MPI.LOR):
        return
    free = bodies.free[: config.n_owned]
    dynamics.hold(~free)
    for pair in problem.interfaces:
        hold(pair, free, config.of(changed).any(axis=1))
    if problem.linear is not None:
        problem.unite(problem.load, dynamics.time)
        problem.system.take(problem.interfaces, problem.linear)
    problem.set_load(dynamics.time, known=True)
    dynamics.accelerated = False
    accelerate(problem)


def accelerate(problem: Any) -> None:
    """Find the first accelerations of a problem in time, with nodes without mass in equilibrium (collective).

    Bodies feel a load on such nodes by the strains of their cells. No time passes: nodes with mass, other fields and Dirichlet values stay.

    Recorded steps leave the equilibrium of these nodes to the first step, with a warning: histories have no derivatives through it.

    Raises:
        UEMError: as in ``attempt``, if the nodes have no equilibrium.
    """
    bodies, dynamics, config = problem.bodies, problem.dynamics, problem.config
    if dynamics.accelerated:
        return
    bare, couplings = _without_mass(problem)
    carries = _carries(problem, bare)
    if carries and problem.history is not None:
        logger.warning(
            "the problem is being recorded, and histories have no derivatives through the equilibrium of nodes without mass at the start: "
            "forces on such nodes act half a step late; let loads grow from 0"
        )
    elif carries:
        held = np.ones(len(bodies.held), dtype=bool)
        held[config.of(np.arange(len(held)))[: config.n_owned][bare]] = False
        with bodies.holding(bodies.of_owners(held)):
            system = _system(problem, bare, couplings)
            bodies.wanted[:] = problem.committed
            try:
                problem.converge(bodies, system, problem.committed, 0.0)
            except UEMError:
                problem.restore()
                raise
        problem.keep()
    (problem.impacts or problem.system).accelerate()


def _without_mass(problem: Any) -> tuple[Bools, list[Any]]:
    """Free components of owned nodes without inertia ``(n_owned, gdim)``, and the couplings of such nodes alone (collective)."""
    config, inert, free = problem.config, problem.dynamics.inert, problem.bodies.free[: problem.config.n_owned]
    moved, light = np.zeros(config.n_owned, dtype=bool), []
    for one in problem.couplings:
        one.mark(config, own := np.zeros(config.n_owned, dtype=bool))
        if reduced(problem.comm, bool(inert[own].any()), op=MPI.LOR):
            moved |= own
        else:
            light.append(one)
    return free & ~inert & ~moved[:, None], light


def _carries(problem: Any, bare: Bools) -> bool:
    """Whether forces of bodies or fluids act on components of owned nodes ``(n_owned, gdim)``, before contact (collective)."""
    system = problem.system
    if not isinstance(system, BodySystem) or not reduced(problem.comm, bool(bare.any()), op=MPI.LOR):
        return False
    system.place()
    problem.bodies.assemble()
    forces = system.residual().array_r[: bare.size].reshape(bare.shape)[bare]
    return bool(reduced(problem.comm, bool(forces.any()), op=MPI.LOR))


def _system(problem: Any, bare: Bools, couplings: Sequence[Any]) -> BodySystem:
    """United system of ``bare`` components ``(n_owned, gdim)``, while all others are held (collective)."""
    config, touched, given = problem.config, [], False
    n, some = config.n_owned, np.asarray(bare.any(axis=1))
    for pair in problem.interfaces:
        at = followed_by(config, pair.discretisation)[:n]
        at[pair.nodes] = True
        if reduced(problem.comm, bool(some[at].any()), op=MPI.LOR):
            touched.append(pair)
            given |= bool(reduced(problem.comm, bool((~some[pair.nodes]).any()), op=MPI.LOR))
    nodes, free = [pair.nodes for pair in problem.pairs], problem.bodies.free[:n]
    linear = rows_of_users(config, problem.equations, couplings, free, nodes, problem.load, problem.dynamics.time)
    if linear is not None:
        linear.begin_step(config.of(problem.committed)[:n], 0.0)
    system: BodySystem = copy(problem.system)
    system.solver = SurfaceSolver(config.unknowns, "uem_start_")
    system.take(touched, linear)
    system.over_constraints = OverConstraints(config, touched, linear, given)
    return system
