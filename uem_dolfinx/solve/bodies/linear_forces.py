"""Forces of bodies that are linear in the displacement, by a product with K instead of an assembly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import reduced

#: Forces of a translation are rounding below this part of the magnitudes in a row of K.
#: [derived; magnitudes in a row of K; test_linear_forces.py::test_what_resists_a_translation]
TRANSLATION_ROUNDING = 4.0 * np.finfo(float).eps


def explicit_forces(bodies: Any, form: Any, J: ufl.Form | None) -> Callable[[PETSc.Vec], None] | None:
    """How linear bodies write their residual F(u), ``form``, to a vector in explicit steps, without inertia in K; None for others."""
    dynamics = bodies.dynamics
    if not is_explicit(dynamics) or dynamics.damping is not None:
        return None
    return LinearForces(bodies, form).assemble if bodies.linear and bodies.tangent.points is None and J is None else None


class LinearForces:
    """``F(u) = K u + F(0)`` of bodies whose K is constant and has no inertia, as long as nothing but u changes in F, ``form``."""

    def __init__(self, bodies: Any, form: Any):
        self._bodies, self._form = bodies, form
        self._inputs = [one for one in forms.with_derivatives(bodies.F)[1] if one is not bodies.u]
        #: Values of Constants and Functions at the last call, and F(0) with them; None until it is needed.
        self._values: list[Array] | None = None
        self._at_zero: Array | None = None
        #: State of K's values, whether translations meet forces, these, and the number of nodes of each body.
        self._state, self._resists = -1, False
        self._resistance = self._sizes = np.zeros(0)

    def assemble(self, b: PETSc.Vec) -> None:
        """Write F(u) to the owned entries of ``b``; loads that have changed since the last call take an assembly (collective)."""
        bodies, (values, same) = self._bodies, forms.read_values(self._inputs, self._values)
        bodies.tangent.update()
        # a run that continues from a checkpoint begins with a product, like the step there of the uninterrupted one
        same |= self._values is None
        self._values = values if self._values is None else self._values
        if not reduced(bodies.comm, same, op=MPI.LAND) or bodies.tangent.completed:
            self._values, self._at_zero = values, None
            forms.assemble_vector(b, self._form)
            return
        u = bodies.u.x.array
        if self._at_zero is None:
            present = np.array(u)
            u[:] = 0.0
            forms.assemble_vector(b, self._form)
            u[:] = present
            self._at_zero = np.array(b.array_r)
        b.array[:] = self._at_zero + self._product()

    def _product(self) -> Array:
        """``K u (n,)``, without the rounding of each body's translation, which momentum would feel (collective)."""
        bodies, K = self._bodies, self._bodies.tangent.K
        config, state = bodies.config, K.stateGet()
        body, count = find_bodies(config)
        body, g = body[: config.n_owned], config.gdim
        if state != self._state:
            self._state, self._resistance = state, resistance_to_translation(K, config.unknowns)
            self._resists = bool(self._resistance.any())
            self._sizes = reduced(config.comm, np.bincount(body, minlength=count).astype(float))
        u = bodies.displacement()
        x = u.array.reshape(-1, g)
        sums = reduced(config.comm, np.column_stack([np.bincount(body, x[:, i], count) for i in range(g)]))
        mean = (sums / self._sizes[:, None])[body]
        u.array[:] -= mean.ravel()
        found = np.asarray(forms.product(K, u).array_r)
        return found + (self._resistance * mean.repeat(g, axis=0)).sum(axis=1) if self._resists else found


def resistance_to_translation(K: PETSc.Mat, space: Nodes) -> Array:
    """Forces of unit translations of all nodes ``(n, gdim)``, zero where they are rounding: only foundations resist (collective)."""
    starts, _, values = K.getValuesCSR()
    size = np.add.reduceat(np.abs(values), starts[:-1]) if len(values) else np.zeros(0)
    forces = np.zeros((len(size), space.block))
    for i in range(space.block):
        unit = space.vector(np.tile(np.arange(space.block) == i, space.n_owned).astype(float))
        forces[:, i] = forms.product(K, unit).array_r
    return np.where(np.abs(forces) > TRANSLATION_ROUNDING * size[:, None], forces, 0.0)
