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
from uem_dolfinx.dynamics.explicit.central_differences import CentralDifferences
from uem_dolfinx.parallel import reduced


def explicit_forces(bodies: Any, J: ufl.Form | None) -> Callable[[PETSc.Vec], None] | None:
    """How linear bodies write their residual F(u) to a vector in explicit steps, where K has no inertia; None for others.

    Args:
        bodies: with F, tangent, materials, points and dynamics.
        J: tangent of users, or None.
    """
    dynamics = bodies.dynamics
    if dynamics is None or not isinstance(dynamics.scheme, CentralDifferences) or dynamics.damping is not None:
        return None
    return LinearForces(bodies).assemble if bodies.linear and bodies.points is None and J is None else None


class LinearForces:
    """``F(u) = K u + F(0)`` of bodies, as long as nothing but u changes in F.

    Args:
        bodies: whose K is constant, and has no inertia.
    """

    def __init__(self, bodies: Any):
        self._bodies, self._inputs = bodies, [one for one in forms.with_derivatives(bodies.F)[1] if one is not bodies.u]
        self._form = forms.form(bodies.F)
        #: Values of Constants and Functions at the last call, and F(0) with them; None until it is needed.
        self._values: list[Array] | None = None
        self._at_zero: Array | None = None

    def assemble(self, b: PETSc.Vec) -> None:
        """Write F(u) to the owned entries of ``b``; loads that have changed since the last call take an assembly (collective)."""
        bodies, values = self._bodies, [np.array(forms.values_of(one)) for one in self._inputs]
        same = self._values is not None and all(np.array_equal(*pair) for pair in zip(values, self._values))
        bodies.tangent.update()
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
        b.array[:] = self._at_zero + forms.product(bodies.tangent.K, bodies.displacement()).array_r
