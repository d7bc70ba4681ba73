"""What is asked of MUMPS beside solving: whether it needs more room, and the sign of the determinant.

Figures are those of its users' guide: INFOG(1) is how a factorisation ended, ICNTL(14) the room it has beyond what the analysis foresees,
ICNTL(33) whether the determinant is told, RINFOG(12) its mantissa.
"""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

#: Types of PC that solve exactly.
FACTORISATIONS = ("cholesky", "lu")
#: MUMPS has at most so much room beyond what it foresees; a matrix that needs more is better not factorised.
#: [convention; per cent; test_mumps.py::test_room_has_an_end]
MOST_ROOM = 2000
#: Ends of a factorisation that lacked room: for integers, for entries, for messages that were sent and received.
SHORT_OF_ROOM = (-8, -9, -17, -20)
#: The option by which the determinant is told.
TELLS_SIGN = {"mat_mumps_icntl_33": 1}


def solves(pc: PETSc.PC) -> bool:
    """Whether it is MUMPS that a preconditioner factorises with."""
    return bool(pc.getType() in FACTORISATIONS and pc.getFactorSolverType() == "mumps")


def more_room(pc: PETSc.PC) -> dict[str, Any]:
    """PETSc's options by which a factorisation that lacked room gets twice as much; none if it did not, or has had enough.

    On several ranks MUMPS works in the order in which messages come: what it had foreseen does not always do, for the same matrix.
    """
    if not solves(pc):
        return {}
    factors = pc.getFactorMatrix()
    # what is foreseen is 100 per cent
    room = 2 * factors.getMumpsIcntl(14) + 100
    short = factors.getMumpsInfog(1) in SHORT_OF_ROOM and room <= MOST_ROOM
    return {"mat_mumps_icntl_14": room} if short else {}


def is_negative(pc: PETSc.PC) -> bool:
    """Whether the determinant of what was factorised with ``TELLS_SIGN`` is negative."""
    return bool(pc.getFactorMatrix().getMumpsRinfog(12) < 0.0)


def how_it_ended(pc: PETSc.PC) -> str:
    """What MUMPS says of a factorisation that failed, for a message; empty where it is not MUMPS, or where it did not fail."""
    ended = pc.getFactorMatrix().getMumpsInfog(1) if solves(pc) else 0
    return f" (MUMPS: INFOG(1) = {ended})" if ended < 0 else ""
