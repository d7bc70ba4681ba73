"""Functions of MUMPS in addition to solving: workspace, sign of the determinant, estimated cost, and Schur complements.

Parameters as in its users' guide: INFOG(1) is the status of a factorisation, ICNTL(14) the workspace beyond the estimate of the analysis,
INFOG(12) the number of negative pivots of a symmetric factorisation. ICNTL(7) and INFOG(7) are the requested and the used ordering.
ICNTL(33) enables the determinant, RINFOG(12) is its mantissa. RINFOG(1) and INFOG(20) are the estimated operations and entries, RINFOG(3)
and INFOG(29) the actual ones, entries in millions if negative. With a Schur complement all refer to the eliminated block, and with
ICNTL(26) = 0 so do solves. petsc4py has neither Schur complements nor separate analyses, so that PETSc's library is called directly.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.nodes import Nodes

#: Types of PC that are factorisations.
FACTORISATIONS = ("cholesky", "lu")
#: MUMPS has at most so much workspace beyond its estimate; a matrix that needs more is better not factorised.
#: [convention; per cent; test_mumps.py::test_workspace_has_an_end]
MOST_WORKSPACE = 2000
#: Status of factorisations that lacked workspace: for integers, for entries, for messages that were sent and received.
SHORT_OF_WORKSPACE = (-8, -9, -17, -20)
#: The option that enables the determinant.
TELLS_SIGN = {"mat_mumps_icntl_33": 1}
#: The option for ordering by approximate minimum fill.
MINIMUM_FILL = {"mat_mumps_icntl_7": 2}


def solves(pc: PETSc.PC) -> bool:
    """Whether a preconditioner is a factorisation by MUMPS."""
    return bool(pc.getType() in FACTORISATIONS and pc.getFactorSolverType() == "mumps")


def more_workspace(pc: PETSc.PC) -> dict[str, Any]:
    """PETSc's options that double the workspace of a failed factorisation; empty if it did not lack workspace, or at the limit.

    On several ranks the order of messages varies, so that MUMPS' estimate is not always sufficient, even for the same matrix.
    """
    if not solves(pc):
        return {}
    factors = pc.getFactorMatrix()
    # the estimate is 100 per cent
    workspace = 2 * factors.getMumpsIcntl(14) + 100
    short = factors.getMumpsInfog(1) in SHORT_OF_WORKSPACE and workspace <= MOST_WORKSPACE
    return {"mat_mumps_icntl_14": workspace} if short else {}


def is_negative(pc: PETSc.PC) -> bool:
    """Whether the determinant of a matrix factorised with ``TELLS_SIGN`` is negative."""
    return bool(pc.getFactorMatrix().getMumpsRinfog(12) < 0.0)


def is_indefinite(pc: PETSc.PC, space: Nodes | None = None) -> bool:
    """Whether a symmetric factorisation by MUMPS has negative pivots; otherwise False (collective in mixed problems).

    Multipliers in other fields of ``space``, such as pressures, are expected to have one negative pivot each.
    """
    if not (solves(pc) and pc.getType() == "cholesky"):
        return False
    return bool(pc.getFactorMatrix().getMumpsInfog(12) > (0 if space is None else space.multipliers(pc.getOperators()[0])))


@cache
def _petsc() -> Any:
    """PETSc's library if it has the functions for Schur complements and analyses, or None."""
    library = ctypes.CDLL(PETSc.__file__)
    arguments = {
        "MatFactorSetSchurIS": 2, "MatFactorCreateSchurComplement": 3, "MatDenseGetArrayRead": 2, "MatDestroy": 1,
        "MatFactorInfoInitialize": 1, "MatCholeskyFactorSymbolic": 4, "MatLUFactorSymbolic": 5,
    }  # fmt: skip
    if PETSc.ScalarType is not np.float64 or not all(hasattr(library, name) for name in arguments):
        return None
    for name, n in arguments.items():
        getattr(library, name).argtypes = [ctypes.c_void_p] * n
    return library


def has_schur_complements() -> bool:
    """Whether PETSc has MUMPS and its Schur complements."""
    return bool(PETSc.Sys.hasExternalPackage("mumps")) and _petsc() is not None


def condenses(pc: PETSc.PC) -> bool:
    """Whether a preconditioner is a factorisation by MUMPS that supports Schur complements."""
    return solves(pc) and _petsc() is not None


def solves_with_schur_complement(comm: MPI.Comm) -> bool:
    """Whether PETSc solves with a factorisation that has a Schur complement: after version 3.18 not on several ranks."""
    return comm.size == 1 or PETSc.Sys.getVersion() < (3, 19)


class Cost(NamedTuple):
    """Cost of a factorisation."""

    flops: float  # floating-point operations
    entries: float  # of the factors

    @classmethod
    def counted(cls, flops: float, entries: int) -> Cost:
        """From MUMPS' counts."""
        return cls(flops, float(entries if entries >= 0 else -1e6 * entries))


def made(pc: PETSc.PC) -> Cost | None:
    """Cost of a factorisation that has been made; None for other packages."""
    if not solves(pc):
        return None
    factors = pc.getFactorMatrix()
    return Cost.counted(factors.getMumpsRinfog(3), factors.getMumpsInfog(29))


def expected(pc: PETSc.PC, A: PETSc.Mat) -> Cost:
    """Estimated cost of factorising a matrix with the options of a PC, from the matrix's pattern (collective)."""
    library, alone = _petsc(), PETSc.PC().create(pc.comm)
    alone.setOptionsPrefix(pc.getOptionsPrefix())
    alone.setType(pc.getType())
    alone.setOperators(A)
    factors = _factors(alone)
    # MatFactorInfo has fewer numbers
    info = (ctypes.c_double * 32)()
    _check(library.MatFactorInfoInitialize(info))
    if pc.getType() == "cholesky":
        _check(library.MatCholeskyFactorSymbolic(factors.handle, A.handle, None, info))
    else:
        _check(library.MatLUFactorSymbolic(factors.handle, A.handle, None, None, info))
    found = Cost.counted(factors.getMumpsRinfog(1), factors.getMumpsInfog(20))
    alone.destroy()
    return found


def _factors(pc: PETSc.PC) -> PETSc.Mat:
    """The factor matrix of a PC, to be computed by MUMPS, with its options (collective)."""
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    factors = pc.getFactorMatrix()
    factors.setOptionsPrefix(pc.getOptionsPrefix())
    return factors


def schur_complement(pc: PETSc.PC, left: Ints) -> Array | None:
    """Factorise all unknowns except some, and compute the Schur complement of these (collective).

    If ``solves_with_schur_complement``, the PC then solves with the factorised block, and returns zero at the other unknowns.

    Args:
        pc: of a factorising type, with a matrix, not yet set up.
        left: global numbers of this rank's unknowns in the Schur complement.

    Returns:
        The Schur complement on rank 0, an empty array ``(0, 0)`` on other ranks; None if MUMPS fails.
    """
    library, comm = _petsc(), pc.comm.tompi4py()
    every = np.concatenate(comm.allgather(left)).astype(PETSc.IntType)
    numbers = PETSc.IS().createGeneral(every if comm.rank == 0 else every[:0], comm=comm)
    factors = _factors(pc)
    factors.setMumpsIcntl(33, 1)
    _check(library.MatFactorSetSchurIS(factors.handle, numbers.handle))
    pc.setUp()
    if factors.getMumpsInfog(1) < 0:
        return None
    factors.setMumpsIcntl(26, 0)
    complement, values = ctypes.c_void_p(), ctypes.c_void_p()
    _check(library.MatFactorCreateSchurComplement(factors.handle, ctypes.byref(complement), None))
    _check(library.MatDenseGetArrayRead(complement, ctypes.byref(values)))
    n = len(every) if comm.rank == 0 else 0
    # stored by columns
    S = np.ctypeslib.as_array(ctypes.cast(values, ctypes.POINTER(ctypes.c_double)), (n, n)).T.copy() if n else np.zeros((0, 0))
    _check(library.MatDestroy(ctypes.byref(complement)))
    return S


def _check(error: int) -> None:
    """Raise the error that a function of PETSc returned, if any."""
    if error:
        raise PETSc.Error(error)


def how_it_ended(pc: PETSc.PC) -> str:
    """Status of a failed factorisation by MUMPS, for a message; empty for other solvers, or without failure."""
    ended = pc.getFactorMatrix().getMumpsInfog(1) if solves(pc) else 0
    return f" (MUMPS: INFOG(1) = {ended})" if ended < 0 else ""
