"""Densities given by users, and the resulting masses of cells."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import MassError, SpaceError
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agree


def as_density(config: Configuration, rho: Any) -> Any:
    """The density as a UFL expression that forms can contain."""
    if isinstance(rho, (Real, ufl.constantvalue.ConstantValue)) and not given.truth(rho):
        # UFL drops terms with a literal zero
        return fem.Constant(config.mesh, float(rho))
    if not isinstance(rho, ufl.core.expr.Expr):
        raise MassError(f"the density {rho!r} is neither a number nor a Function nor a UFL expression: give one of them")
    if rho.ufl_shape != ():
        raise MassError(f"the density {rho} has shape {rho.ufl_shape}: give a scalar")
    if ufl.algorithms.extract_arguments(rho):
        raise MassError(f"the density {rho} contains a test or trial function: give a known field")
    if any(domain != config.mesh.ufl_domain() for domain in ufl.domain.extract_domains(rho)):
        raise SpaceError("the density is on another mesh than the displacement: make both on one mesh")
    return rho


def cell_masses(config: Configuration, density: Any) -> Array:
    """Masses of the owned cells ``(n_cells,)``; MassError if one is negative or not finite (collective)."""
    S = compat.function_space(config.mesh, ("DG", 0))
    n_cells = config.mesh.topology.index_map(config.tdim).size_local
    of_dofs = forms.assemble_array(S, forms.form(revolved(density * ufl.TestFunction(S) * ufl.dx)))
    masses = of_dofs[compat.cell_dofs(S)[:n_cells, 0]]
    wrong, error = np.flatnonzero(~((masses >= 0) & np.isfinite(masses))), None
    if len(wrong):
        where = ", ".join(f"{c:.6g}" for c in config.X[compat.cell_dofs(config.V)[wrong[0]]].mean(axis=0))
        error = MassError(f"the cell at ({where}) has the mass {masses[wrong[0]]:.6g}: give a finite density of at least 0")
    agree(config.comm, error)
    return masses
