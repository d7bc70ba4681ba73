"""Errors for unrestrained fields, unknowns without stiffness, and equilibria hidden by rounding.

Rigid motions of bodies are checked before they move, by ``floating``; other fields after they have diverged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import FloatingBodyError, InputError, PrecisionError, UEMError
from uem_dolfinx.geometry.bodies import find_bodies, middle
from uem_dolfinx.geometry.nodes import described
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.bodies import FORCE_ROUNDING, Bodies
from uem_dolfinx.solve.bodies.field_scales import ratio
from uem_dolfinx.solve.bodies.tangent import driven_on


def unheld(bodies: Bodies, field: int, residual: float) -> FloatingBodyError:
    """The error for a field that diverges, with the body on which it is largest (collective).

    Args:
        bodies: with the diverged field.
        field: number of the field in a mixed problem, 0 for the displacement; otherwise 0.
        residual: relative residual of its equations.
    """
    config, comm, values = bodies.config, bodies.comm, np.abs(bodies.u.x.array)
    if config.unknowns.mixed:
        values = np.where(config.unknowns.field_of == field, values, 0.0)
    most = values.max(initial=0.0)
    largest, rank = max((value, -r) for r, value in enumerate(comm.allgather(most)))
    body, _ = find_bodies(config)
    where = -1
    if comm.rank == -rank:
        unknown = int(values.argmax())
        node = unknown if config.unknowns.mixed else unknown // config.block
        cells, _ = np.nonzero(compat.cell_dofs(bodies.u.function_space) == node)
        where = int(body[compat.cell_dofs(config.V)[cells[0], 0]])
    where = comm.bcast(where, root=-rank)
    here = middle(comm, config.X[: config.n_owned][body[: config.n_owned] == where])
    name = config.unknowns.names[field] if config.unknowns.mixed else bodies.u.name
    what = f"part {name} of the mixed space" if name.isdigit() else f"the {config.name} '{name}'"
    return FloatingBodyError(
        f"nothing holds {what} on the body with its middle at {here}: it becomes {largest:.3g} there, and "
        f"{residual:.3g} of its source is not in equilibrium; give it a Dirichlet condition, or a term that depends on its value"
    )


def explain(problem: Any, error: UEMError, stiffness: Array | None, mendable: bool) -> None:
    """Add to the error of a failed step what may have caused it: an indefinite tangent, or a corner; the state is restored (collective).

    ``stiffness``: see ``Watch.name_corner``. ``mendable``: whether a shorter step may avoid the error.
    """
    bodies, config = problem.bodies, problem.config
    if not (mendable or isinstance(error, FloatingBodyError)) or not config.moves:
        return
    start = bodies.stiffness_at_start
    try:
        diagonal = (bodies.initial_stiffness() if start is None else start) * bodies.free[: config.n_owned]
    except UEMError:
        diagonal = np.zeros((config.n_owned, config.gdim))
    if words := driven_on(config, diagonal, FORCE_ROUNDING):
        error.amend(words, instead=True)
    elif mendable:
        problem.watch.name_corner(stiffness, error)


def refuse_bare(bodies: Bodies, P: Restriction, Q: Restriction, more: PETSc.Mat | None) -> None:
    """Refuse a constrained system with unknowns without stiffness (collective).

    Args:
        bodies: with the tangent K.
        P: trial restriction.
        Q: test restriction.
        more: terms of contacts and couplings in addition to K, or None.

    Raises:
        InputError: names the first body and node.
    """
    if bodies.tangent.bare is None:
        return
    config, comm, n = bodies.config, bodies.comm, bodies.config.n_owned
    # random unknowns: rows with any entry give non-zero forces
    du = P.expand(config.vector(np.random.default_rng(comm.rank).uniform(1.0, 2.0, P.used.shape) * P.used))
    y = forms.product(bodies.tangent.K, du)
    if more is not None:
        y.axpy(1.0, forms.product(more, du))
    left = Q.transpose(y).array_r == 0.0
    nodes = np.flatnonzero((left & bodies.tangent.bare & P.used.ravel()).reshape(P.used.shape).any(axis=1))
    body, count = find_bodies(config)
    own = body[:n]
    number = reduced(comm, np.bincount(own[nodes], minlength=count))
    if not number.any():
        return
    where = int(number.argmax())
    offers = comm.allgather([described(config.X[i]) for i in nodes[own[nodes] == where][:1]])
    place = next(offer[0] for offer in offers if offer)
    here = middle(comm, config.X[:n][own == where])
    remedy = ", or make it rigid by a RigidCoupling of its cells" if config.moves else ""
    raise InputError(
        f"nothing resists {number[where]} nodes of the body with its middle at {here}, as that at {place}: "
        f"expected terms in F that do; integrate F over its cells, too, with a stiffness, hold these nodes by Dirichlet conditions{remedy}"
    )


def no_precision(norm: float, rounding: float, real: float) -> PrecisionError:
    """The error for a residual of this norm with this rounding, relative to forces of the norm ``real``."""
    return PrecisionError(
        f"rounding hides the equilibrium: the residual stays at {norm:.3g}, which is {ratio(norm, real):.1g} of the forces at work, "
        f"while rounding of the stiffest parts alone makes {rounding:.3g}: their stiffness times displacement is too large for the "
        "forces; model them as rigid, give them less stiffness or less far to go, or raise rtol if that is accurate enough; bodies that "
        "lie loose, with nothing to press them together yet, need a weight or a load"
    )
