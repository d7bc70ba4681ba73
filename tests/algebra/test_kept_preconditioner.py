"""A preconditioner serves further matrices while they are nearly alike, and is made anew within a solve that takes too long."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from equation_scenes import united
from helpers import blocks

from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.ksp import KeptPreconditioner
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import multigrid_options
from uem_dolfinx.geometry.configuration import Configuration


@pytest.mark.parametrize(
    "changes, slower, kept", [(0, 1.0, True), (3, 1.0, True), (30, 1.0, False), (0, 2 / 3, True), (0, 6.0, False)]
)
def test_preconditioner_is_kept(changes, slower, kept):
    """While few of a hundred equations have changed and it takes not many more iterations than at first."""
    active = np.ones(100, bool)
    made, now = (
        UnitingEquations.along(
            np.arange(100, dtype=np.int32), np.ones((100, 2)), np.zeros((100, 0), np.int64), np.zeros((100, 0)), np.zeros(100), a
        )
        for a in (active, active & (np.arange(100) >= changes))
    )
    of = KeptPreconditioner()
    assert not of.serves(made, *of.changes(made))
    for digits in (1.0, slower):
        of.see(6, np.logspace(0, -6 / digits, 7))
    assert of.serves(now, *of.changes(now)) == kept
    # six digits, with as many iterations at first
    most = of.most(1e-6)
    assert 6 < most < 60 if kept else most is None


@pytest.mark.parametrize("method", ["cg", "gmres"])
@pytest.mark.parametrize("amg", ["gamg", "jacobi"])
@pytest.mark.parametrize("unlike", [1.0, 30.0])
def test_a_preconditioner_that_serves_badly_is_made_anew(comm, method, amg, unlike):
    """Every fifth node becomes 30^2 times as stiff: the solve takes no more than a new preconditioner's, after its share."""
    config = Configuration(blocks(comm, "triangle", 24, 24, gap=0.5).u)
    u, v = ufl.TrialFunction(config.V), ufl.TestFunction(config.V)
    a = forms.form((ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) + ufl.inner(u, v)) * ufl.dx)
    K = forms.create_matrix(a)
    forms.assemble_matrix(K, a)
    options = {"ksp_type": method, **(multigrid_options("gamg") if amg == "gamg" else {"pc_type": amg})}
    P, rhs = united(config, []), K.createVecLeft()
    rhs.array[:] = np.cos(np.arange(*rhs.owner_range))
    taken = {}
    for name in ("kept", "new"):
        solver = UnitedSolver(config, f"{name}_", options)
        if name == "kept":
            solver.set_operator(P, K, None)
            _, first = solver.solve(rhs, 1e-6)
            size = K.createVecLeft()
            size.array[:] = np.where(np.arange(*size.owner_range) % 10 < 2, unlike, 1.0)
            K.diagonalScale(size, size)
        solver.begin_step()
        solver.set_operator(P, K, None)
        dq, taken[name] = solver.solve(rhs, 1e-6)
        assert (K * dq - rhs).norm() <= 1e-3 * rhs.norm()
    # the old one may take twice as many as at first
    assert taken["kept"] <= taken["new"] + 2.0 * first + 2
