"""What is asked of MUMPS beside solving: whether it needs more workspace, the sign of the determinant, and what a factorisation takes.

Figures are those of its users' guide: INFOG(1) is how a factorisation ended, ICNTL(14) the workspace beyond what the analysis estimates,
INFOG(12) the number of negative pivots of a symmetric one, ICNTL(7) and INFOG(7) how unknowns are and were ordered, ICNTL(33) whether the
determinant is told, RINFOG(12) its mantissa; RINFOG(1) and INFOG(20) the operations and entries that the analysis expects of it, the
latter in millions where it is negative. With a Schur complement all are of what it is the complement of, and with ICNTL(26) = 0 so are
solves. petsc4py has neither Schur complements nor analyses alone: PETSc's own library is called.
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

#: Types of PC that solve exactly.
FACTORISATIONS = ("cholesky", "lu")
#: MUMPS has at most so much workspace beyond its estimate; a matrix that needs more is better not factorised.
#: [convention; per cent; test_mumps.py::test_workspace_has_an_end]
MOST_WORKSPACE = 2000
#: Ends of a factorisation that lacked workspace: for integers, for entries, for messages that were sent and received.
SHORT_OF_WORKSPACE = (-8, -9, -17, -20)
#: The option by which the determinant is told.
TELLS_SIGN = {"mat_mumps_icntl_33": 1}
#: The option by which unknowns are ordered by approximate minimum fill.
MINIMUM_FILL = {"mat_mumps_icntl_7": 2}


def solves(pc: PETSc.PC) -> bool:
    """Whether it is MUMPS that a preconditioner factorises with."""
    return bool(pc.getType() in FACTORISATIONS and pc.getFactorSolverType() == "mumps")


def more_workspace(pc: PETSc.PC) -> dict[str, Any]:
    """PETSc's options by which a factorisation that lacked workspace gets twice as much; none if it did not, or has had enough.

    On several ranks MUMPS works in the order in which messages come: its estimate does not always do, for the same matrix.
    """
    if not solves(pc):
        return {}
    factors = pc.getFactorMatrix()
    # the estimate is 100 per cent
    workspace = 2 * factors.getMumpsIcntl(14) + 100
    short = factors.getMumpsInfog(1) in SHORT_OF_WORKSPACE and workspace <= MOST_WORKSPACE
    return {"mat_mumps_icntl_14": workspace} if short else {}


def is_negative(pc: PETSc.PC) -> bool:
    """Whether the determinant of what was factorised with ``TELLS_SIGN`` is negative."""
    return bool(pc.getFactorMatrix().getMumpsRinfog(12) < 0.0)


def is_indefinite(pc: PETSc.PC, space: Nodes | None = None) -> bool:
    """Whether a symmetric factorisation has negative pivots; not told if it is not MUMPS that made it (collective among other fields).

    Multipliers of other fields of ``space``, such as pressures, are expected to make one each.
    """
    if not (solves(pc) and pc.getType() == "cholesky"):
        return False
    return bool(pc.getFactorMatrix().getMumpsInfog(12) > (0 if space is None else space.multipliers(pc.getOperators()[0])))


@cache
def _petsc() -> Any:
    """PETSc's library if it has what Schur complements and analyses take, or None."""
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


def condenses(pc: PETSc.PC) -> bool:
    """Whether a preconditioner factorises with MUMPS, which can leave some unknowns then and make their Schur complement."""
    return solves(pc) and _petsc() is not None


def solves_with_schur_complement(comm: MPI.Comm) -> bool:
    """Whether PETSc solves with a factorisation that has a Schur complement: on several ranks those after 3.18 do not."""
    return comm.size == 1 or PETSc.Sys.getVersion() < (3, 19)


class Expected(NamedTuple):
    """What a factorisation is expected to take.

    Attributes:
        flops: floating-point operations.
        entries: of the factors.
    """

    flops: float
    entries: float


def expected(pc: PETSc.PC, A: PETSc.Mat) -> Expected:
    """What factorising a matrix as a PC is made to is expected to take, by the matrix's pattern (collective)."""
    library, alone = _petsc(), PETSc.PC().create(pc.comm)
    alone.setOptionsPrefix(pc.getOptionsPrefix())
    alone.setType(pc.getType())
    alone.setOperators(A)
    factors = _factors(alone)
    # MatFactorInfo is less than this many numbers
    info = (ctypes.c_double * 32)()
    _check(library.MatFactorInfoInitialize(info))
    if pc.getType() == "cholesky":
        _check(library.MatCholeskyFactorSymbolic(factors.handle, A.handle, None, info))
    else:
        _check(library.MatLUFactorSymbolic(factors.handle, A.handle, None, None, info))
    flops, entries = factors.getMumpsRinfog(1), factors.getMumpsInfog(20)
    alone.destroy()
    return Expected(flops, float(entries if entries >= 0 else -1e6 * entries))


def _factors(pc: PETSc.PC) -> PETSc.Mat:
    """The factors that a PC is going to make by MUMPS, with its options (collective)."""
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    factors = pc.getFactorMatrix()
    factors.setOptionsPrefix(pc.getOptionsPrefix())
    return factors


def schur_complement(pc: PETSc.PC, left: Ints) -> Array | None:
    """Factorise all unknowns but some (collective).

    The PC then solves with them, and gives zero at those left, where ``solves_with_schur_complement``.

    Args:
        pc: of a type that factorises, with a matrix, not yet set up.
        left: global numbers of those to be left, rank by rank.

    Returns:
        On rank 0 the Schur complement of all that were left, and nothing ``(0, 0)`` on others; None if MUMPS fails.
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
    """Raise what a function of PETSc returned."""
    if error:
        raise PETSc.Error(error)


def how_it_ended(pc: PETSc.PC) -> str:
    """What MUMPS says of a factorisation that failed, for a message; empty where it is not MUMPS, or where it did not fail."""
    ended = pc.getFactorMatrix().getMumpsInfog(1) if solves(pc) else 0
    return f" (MUMPS: INFOG(1) = {ended})" if ended < 0 else ""
