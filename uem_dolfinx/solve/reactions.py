"""Reaction forces of Dirichlet conditions."""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array


def reactions(problem: Any) -> Array:
    """Reactions of Dirichlet conditions in the present state, without contacts and equations, at all unknowns ``(n,)`` (collective).

    Rounding at unknowns without condition, zero at ghosts; for other fields the flow into the body.
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
    """Unknowns of the components of the owned nodes ``(n_owned, gdim)``."""
    return problem.config.of(np.arange(len(problem.bodies.held)))[: problem.config.n_owned]
