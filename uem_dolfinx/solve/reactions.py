"""Forces with which Dirichlet conditions act."""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array


def reactions(problem: Any) -> Array:
    """What holds a problem's bodies in its present state beside contacts and equations, at all unknowns ``(n,)`` (collective).

    Rounding where there is no condition, zero at ghosts; of other fields what flows in there.
    """
    bodies, config = problem.bodies, problem.config
    bodies.assemble()
    own = bodies.residual_of_all
    forces: Array = np.zeros(len(bodies.held))
    forces[: len(own)] = own
    at = owned_displacement(problem)
    for contact in problem.contacts:
        forces[at] -= contact.force.x.array.reshape(-1, config.gdim)[: config.n_owned]
        for heat in contact.pair.heats if contact.on else ():
            forces[: len(own)] += config.from_rows(heat.residual())
    if problem.linear is not None:
        forces[at] -= problem.linear.forces(problem.linear.multipliers)
    return forces


def owned_displacement(problem: Any) -> Any:
    """Unknowns that the components of the owned nodes are ``(n_owned, gdim)``."""
    return problem.config.of(np.arange(len(problem.bodies.held)))[: problem.config.n_owned]
