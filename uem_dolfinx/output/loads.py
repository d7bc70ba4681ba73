"""Loads for sketches: those that a load factor or time makes, and those that are terms of a residual, by what they are integrated over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.geometry.rigid import RigidSurface
from uem_dolfinx.solve.loading import set_loads
from uem_dolfinx.solve.problem import UnitedProblem


def loads_of(problem: UnitedProblem, wanted: bool = True) -> tuple[Array, Array]:
    """Nodal forces of what the residual integrates over surfaces of the undeformed bodies, and of all else in it (collective).

    Stresses are among the latter. On a body they have no resultant, so that sums over its nodes are what loads in its volume amount to.

    Args:
        problem: the scene.
        wanted: whether they are wanted; if not, they are zero.

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
    """For a while, loads, Dirichlet values and rigid surfaces as ``load`` makes them at a load factor or time (collective)."""
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
    """What a problem's ``load`` and its couplings set at a load factor or time; nothing of contacts (collective)."""
    set_loads(problem.comm, problem.load, at)
    for one in problem.couplings:
        one.take_load(at)
