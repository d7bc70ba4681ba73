"""Loads for sketches: at a load factor or time, and from the terms of a residual, by domain of integration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.geometry.rigid import RigidSurface
from uem_dolfinx.solve.loading import rules_of, set_loads
from uem_dolfinx.solve.problem import UnitedProblem


def loads_of(problem: UnitedProblem, wanted: bool = True) -> tuple[Array, Array]:
    """Nodal forces of the residual's surface integrals on undeformed bodies, and of all its other integrals (collective).

    The latter include stresses, which have no resultant on a body, so that sums over its nodes are resultants of volume loads.

    Args:
        problem: the problem.
        wanted: whether to compute them; otherwise zero.

    Returns:
        Forces at the owned nodes ``(n_owned, gdim)`` each.
    """
    config, F = problem.config, problem.bodies.F
    found = np.zeros((2, config.n_owned, config.gdim))
    if wanted:
        over = F.integrals_by_type("exterior_facet")
        with config.at(np.zeros_like(problem.u.x.array)):
            for k, part in enumerate((ufl.Form(over) if over else None, F)):
                if part is not None:
                    values = forms.assemble_array(problem.u.function_space, forms.form(part))
                    found[k] = -config.rows(values)[: config.n_owned]
        found[1] -= found[0]
    return found[0], found[1]


@contextmanager
def loaded(problem: UnitedProblem, at: float | None) -> Iterator[None]:
    """A block with loads, Dirichlet values and rigid surfaces set by ``load`` at a load factor or time (collective)."""
    if at is None:
        yield
        return
    F, load = problem.bodies.F, problem.load
    terms = [
        one
        for one in (*F.constants(), *F.coefficients())
        if one is not problem.u and isinstance(one, (fem.Constant, fem.Function))
    ]
    terms += load if isinstance(load, Mapping) else []
    terms += [rule.values for rule in rules_of(problem.bodies.bcs)]
    kept = [(forms.values_of(one), np.array(forms.values_of(one))) for one in terms]
    targets = [contact.target for contact in problem.contacts if isinstance(contact.target, RigidSurface)]
    motions = [target.motion for target in targets]
    now = problem.progress.factor if problem.dynamics is None else problem.dynamics.time
    try:
        _set_load(problem, at)
        yield
        _set_load(problem, now)
    finally:
        for values, before in kept:
            values[...] = before
        for target, motion in zip(targets, motions):
            target.motion = motion


def _set_load(problem: UnitedProblem, at: float) -> None:
    """Set a problem's ``load`` and its couplings at a load factor or time, but not its contacts (collective)."""
    set_loads(problem.comm, problem.load, at, problem.bodies.bcs)
    for one in problem.couplings:
        one.take_load(at)
