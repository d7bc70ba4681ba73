"""The tangent K of the bodies: the residual's derivative, the stiffness of materials with history, and the mass's part of it.

Seventh step on the data's way; it is assembled only when something it depends on has changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.log import timed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uem_dolfinx.inertia import Dynamics
    from uem_dolfinx.materials import HistoryMaterial

Array = npt.NDArray[np.float64]


class Tangent:
    """K = dF/du, with the mass's part of it in dynamics, assembled when it has changed.

    Args:
        F: UFL residual.
        u: displacement.
        materials: whose stresses in F are no expressions of u; they add their stiffness.
        dynamics: whose inertia forces depend on u, or None.

    Raises:
        SpaceError: if F does not depend on u.
    """

    def __init__(self, F: ufl.Form, u: fem.Function, materials: Sequence[HistoryMaterial] = (), dynamics: Dynamics | None = None):
        J = ufl.derivative(F, u)
        for material in materials:
            J += material.stiffness(ufl.TrialFunction(u.function_space), F.arguments()[0])
        J = ufl.algorithms.expand_derivatives(J)
        if J.empty():
            raise SpaceError("the residual F does not depend on u: build it from the same Function that the problem gets")
        #: Whether K is the same for every u.
        self.linear: bool = u not in J.coefficients()
        self._dynamics, self._factor = dynamics, 0.0
        self._inputs = [*J.coefficients(), *J.constants()]
        self._values: list[Array] | None = None
        with timed("compile forms"):
            self._form = compat.form(J)
        self.K: PETSc.Mat = compat.create_matrix(self._form)
        #: Grows with every assembly.
        self.number = 0

    def update(self) -> None:
        """Assemble K unless nothing it depends on has changed (collective)."""
        values = [np.array(c.x.array if isinstance(c, fem.Function) else c.value) for c in self._inputs]
        factor = self._dynamics.factor if self._dynamics is not None else 0.0
        same = self._values is not None and all(np.array_equal(a, b) for a, b in zip(values, self._values))
        same &= factor == self._factor
        comm = self.K.comm.tompi4py()
        if comm.allreduce(int(same)) == comm.size:
            return
        with timed("assemble tangent"):
            compat.assemble_matrix(self.K, self._form)
            if self._dynamics is not None and factor:
                self.K.axpy(factor, self._dynamics.mass.M, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        self._values, self._factor = values, factor
        self.number += 1
