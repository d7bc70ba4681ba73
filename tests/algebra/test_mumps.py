"""Workspace that MUMPS had not estimated to need: it gets more, to an end, and nobody sees more of it than the answer."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from helpers import blocks, clamp, linear, raised

import uem_dolfinx as uem
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import has_mumps

pytestmark = pytest.mark.skipif(not has_mumps(), reason="this PETSc has no MUMPS")

DIRECT = {"ksp_type": "preonly", "pc_factor_mat_solver_type": "mumps"}
#: Per cent of what MUMPS estimates: less than it needs.
TOO_LITTLE = {"mat_mumps_icntl_14": -60}


@pytest.fixture(autouse=True)
def whole(monkeypatch):
    """The united matrix is factorised whole: what a condensed problem needs, on several ranks in the order of messages, varies more."""
    monkeypatch.setattr(mumps, "condenses", lambda pc: False)


def pressed(comm, options, friction=0.0):
    """A block that is pressed on another one and pulled aside."""
    b = blocks(comm, "hexahedron", 8, 9, overhang=0.25)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[1e-3, 0.0, -1e-2])]
    contact = uem.Contact(b.high, b.low, friction=friction)
    return b, uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], petsc_options=DIRECT | options)


@pytest.mark.parametrize("kind, friction", [("cholesky", 0.0), ("lu", 0.0), ("lu", 0.02)])
@pytest.mark.slow
def test_mumps_gets_the_workspace_it_asks_for(comm, kind, friction, caplog):
    """With too little workspace at first the state is that of a run with enough; with friction the sign of the determinant is reported."""
    states = []
    for workspace in ({}, TOO_LITTLE):
        caplog.clear()
        b, problem = pressed(comm, {"pc_type": kind} | workspace, friction)
        with caplog.at_level(logging.DEBUG, logger="uem_dolfinx"):
            problem.solve()
        lacked = comm.bcast("MUMPS lacked workspace" in caplog.text)
        # on several ranks the estimate does not always do
        assert lacked == bool(workspace) or (lacked and comm.size > 1)
        states.append(b.scene.gather(b.u))
    assert np.abs(states[1] - states[0]).max() <= 1e-12 * np.abs(states[0]).max()


@pytest.mark.long
@pytest.mark.parametrize("workspace, gets", [(900, {"mat_mumps_icntl_14": 1900}), (1000, {})])
def test_workspace_has_an_end(comm, workspace, gets, monkeypatch):
    """A factorisation that lacked workspace gets twice as much as it had, up to the most; then the error contains the message of MUMPS."""
    _, problem = pressed(comm, {"pc_type": "cholesky"} | TOO_LITTLE)
    with monkeypatch.context() as m:
        m.setattr(mumps, "MOST_WORKSPACE", -100)
        # the failed factorisation stays
        m.setattr(UnitedSolver, "restore", lambda self: None)
        raised(uem.LinearSolveError, r"MUMPS: INFOG\(1\) = -\d", problem.solve)
    pc = problem.system.solver.pc
    pc.getFactorMatrix().setMumpsIcntl(14, workspace)
    assert mumps.more_workspace(pc) == gets


def test_ordering_in_the_plane(comm):
    """Unknowns are ordered by minimum fill, where MUMPS by itself would take nested dissection: so many unknowns."""
    b = blocks(comm, "triangle", 72, 72)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -1e-3])]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs)
    problem.solve()
    assert problem.config.n_global * 2 > 10_000 and problem.system.solver.pc.getFactorMatrix().getMumpsInfog(7) == 2
