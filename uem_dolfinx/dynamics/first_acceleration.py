"""Initial acceleration of constrained bodies under forces."""

from __future__ import annotations

from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.errors import LinearSolveError
from uem_dolfinx.log import timed

#: Components with less mass than this part of the largest have no acceleration at the start.
#: [convention; diagonal of P'MP; test_thresholds_motion.py::test_components_without_mass]
MASSLESS = 1e-12
#: Relative tolerance of the residual of the first acceleration.
#: [bound; forces; -]
ACCELERATED = 1e-13


def united_accelerations(
    mass: PETSc.Mat, restriction: Restriction, forces: PETSc.Vec, added: PETSc.Mat | None = None
) -> PETSc.Vec:
    """``P a`` with ``P'MP a = P' forces``, zero in components without mass (collective).

    Args:
        mass: M, with the rows and columns of the constrained system.
        restriction: P.
        forces: on all unknowns.
        added: masses at points, in addition to M.

    Raises:
        LinearSolveError: if masses are negative.
    """
    M = mass.copy() if restriction.alone else mass.PtAP(restriction.P)
    if restriction.alone:
        restriction.cross_out(M)
    if added is not None:
        M.axpy(1.0, added.PtAP(restriction.P), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    rhs = restriction.transpose(forces)
    with timed("first acceleration"):
        q, reason = forms.solve_mass(M, rhs, MASSLESS, ACCELERATED)
    if reason < 0:
        raise LinearSolveError(f"the first acceleration was not found (KSP reason {reason}): check that no mass is negative")
    return restriction.expand(q)
