"""What solves the united system: when CG gives way, which modes multigrid is given, what is kept of earlier matrices."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from equation_scenes import triangles, united
from helpers import blocks

from uem_dolfinx import forms
from uem_dolfinx.algebra import options
from uem_dolfinx.algebra.blocks import is_symmetric
from uem_dolfinx.algebra.deflation import near_null_space
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import has_hypre, has_mumps
from uem_dolfinx.geometry.configuration import Configuration

ITERATIVE = {"ksp_type": "cg", "pc_type": "jacobi"}


def mass(config):
    u, v = ufl.TrialFunction(config.V), ufl.TestFunction(config.V)
    a = forms.form(ufl.inner(u, v) * ufl.dx)
    K = forms.create_matrix(a)
    forms.assemble_matrix(K, a)
    return K


@pytest.mark.skipif(not (has_hypre() and has_mumps()), reason="needs hypre and MUMPS")
@pytest.mark.parametrize("condition, symmetric, gives_way", [(10.0, True, False), (1e3, True, True), (10.0, False, True)])
def test_cg_gives_way(comm, condition, symmetric, gives_way, monkeypatch):
    """What takes CG long, here some 370 iterations for 40, or is not symmetric, is factorised until the next step begins."""
    monkeypatch.setattr(options, "HYPRE_FROM", {2: 0, 3: 0})
    # no multigrid would leave it so many
    monkeypatch.setattr(options, "multigrid_options", lambda amg: {"pc_type": "none"})
    config = Configuration(blocks(comm, "triangle", 16, 16, gap=0.5).u)
    solver, K, P = UnitedSolver(config, "gives_way_", None), mass(config), united(config, [])
    if symmetric:
        values = K.createVecLeft()
        values.array[:] = condition ** (np.arange(*values.owner_range) / values.size)
        K.zeroEntries()
        K.setDiagonal(values)
    else:
        stiffer = K.createVecLeft()
        stiffer.array[:] = 1.0 + np.arange(stiffer.local_size) % 3
        K.diagonalScale(stiffer, None)
    rhs = K.createVecLeft()
    rhs.array[:] = np.cos(np.arange(rhs.local_size))
    for _ in range(2):
        solver.begin_step()
        solver.set_operator(P, K, None)
        assert solver.iterative == symmetric
        dq, _ = solver.solve(rhs)
        assert solver.iterative != gives_way
        assert (K * dq - rhs).norm() <= 1e-9 * rhs.norm()


@pytest.mark.skipif(not has_mumps(), reason="needs MUMPS")
@pytest.mark.parametrize("scale, gives_way", [(1.0, False), (1e4, True)])
def test_gmres_gives_way(comm, scale, gives_way, monkeypatch):
    """In a large problem what GMRES does not solve in one cycle is factorised until the next step begins, and solved as accurately."""
    monkeypatch.setattr(options, "DIRECT_UP_TO", {2: 0, 3: 0})
    # no multigrid would leave it so many
    monkeypatch.setattr(options, "multigrid_options", lambda *amg: {"pc_type": "none"})
    config = Configuration(blocks(comm, "triangle", 16, 16, gap=0.5).u)
    solver, K, P = UnitedSolver(config, "gmres_gives_way_", None), mass(config), united(config, [])
    rows = K.createVecLeft()
    rows.array[:] = scale ** (np.arange(*rows.owner_range) / rows.size) * (1.0 + np.arange(rows.local_size) % 3)
    K.diagonalScale(rows, None)
    rhs = K.createVecLeft()
    rhs.array[:] = np.cos(np.arange(rhs.local_size))
    for _ in range(2):
        solver.begin_step()
        solver.set_operator(P, K, None)
        assert solver.iterative
        dq, iterations = solver.solve(rhs)
        assert solver.iterative != gives_way and iterations <= options.GMRES_RESTART + 1
        assert (K * dq - rhs).norm() <= 1e-9 * rhs.norm()


def test_gmres_in_place_of_cg_remembers(comm):
    """In place of CG that a user has chosen, too: one cycle solves what takes a third more iterations in cycles of 30."""
    config = Configuration(blocks(comm, "triangle", 16, 16, gap=0.5).u)
    taken = []
    for more in ({}, {"ksp_gmres_restart": 30}):
        solver = UnitedSolver(config, "gmres_remembers_", {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 5000} | more)
        K, P = mass(config), united(config, [])
        rows = K.createVecLeft()
        rows.array[:] = 5.0 ** (np.arange(*rows.owner_range) / rows.size) * (1.0 + np.arange(rows.local_size) % 3)
        K.diagonalScale(rows, None)
        rhs = K.createVecLeft()
        rhs.array[:] = np.cos(np.arange(rhs.local_size))
        solver.set_operator(P, K, None)
        dq, iterations = solver.solve(rhs)
        assert solver.ksp.getType() == "gmres" and (K * dq - rhs).norm() <= 1e-9 * rhs.norm()
        taken.append(iterations)
    assert taken[0] <= options.GMRES_RESTART < taken[1]


@pytest.mark.parametrize("part, symmetric", [(0.0, True), (3e-12, True), (3e-11, False)])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e12])
def test_what_counts_as_symmetric(comm, part, symmetric, scale):
    """One entry of a stiffness that differs from the one across, in any unit of force, and of each unknown."""
    V = blocks(comm, "triangle", 5, 5, gap=0.5).V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = forms.form((ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) + ufl.div(u) * ufl.div(v)) * ufl.dx)
    K = forms.create_matrix(a)
    forms.assemble_matrix(K, a)
    first, end = K.getOwnershipRange()
    if comm.rank == comm.size - 1:
        column = next(int(c) for c in K.getRow(first)[0] if first < c < end)
        across = np.sqrt(K.getValue(first, first) * K.getValue(column, column))
        K.setValue(first, column, K.getValue(first, column) + part * across)
    K.assemble()
    units = K.createVecLeft()
    units.array[:] = 10.0 ** (np.arange(units.local_size) % 7)
    K.diagonalScale(units, units)
    K.scale(scale)
    assert is_symmetric(K, Configuration(fem.Function(V))) == symmetric


def modes_of(config):
    return len(near_null_space(config, mass(config), united(config, [])).getVecs())


@pytest.mark.parametrize("bodies, modes", [(2, 6), (12, 3)])
def test_few_bodies_have_modes_of_their_own(bodies, modes):
    """Two bodies have three modes each, a dozen have them together."""
    assert modes_of(triangles(bodies)) == modes


@pytest.mark.parametrize("away, modes", [(2.2e5, 3), (2.2e6, 2)])
def test_modes_that_are_nearly_alike(away, modes):
    """Far from the origin a rotation about it is nearly a translation: the rest is as the body's radius 2/3 to its distance."""
    assert modes_of(triangles(1, away)) == modes


def test_places_of_earlier_products(comm):
    """A contactor that follows one node after the other: the places of two are kept, with a third only its own."""
    config = Configuration(blocks(comm, "triangle", 5, 5, gap=0.5).u)
    solver, K = UnitedSolver(config, "thresholds_", ITERATIVE), mass(config)
    x = np.concatenate(comm.allgather(config.X[: config.n_owned]))
    contactor, *followed = (
        int(np.abs(x - place).sum(axis=1).argmin()) for place in ((0.4, 0.9), (0.2, -0.2), (0.6, -0.2), (0.6, -0.8))
    )
    entries, handles = [], []
    for node in (*followed[:2], followed[0], followed[2]):
        solver.set_operator(united(config, [(contactor, [0.0, 1.0], node)]), K, None)
        entries.append(comm.allreduce(solver.A.getInfo()["nz_used"]) - comm.allreduce(K.getInfo()["nz_used"]))
        handles.append(solver.A.handle)
    own = entries[0]
    assert own > 0 and entries == [own, 2 * own, 2 * own, own]
    assert handles[1] == handles[2] != handles[3]


@pytest.mark.parametrize("requested, given", [(3e-10, True), (3e-11, False)])
def test_accuracy_of_an_iterative_solve(requested, given):
    """A Newton iteration gets the accuracy that it requires, unless it is near rounding."""
    config = triangles(1)
    solver, K = UnitedSolver(config, "thresholds_", ITERATIVE), mass(config)
    solver.set_operator(united(config, []), K, None)
    rhs = K.createVecLeft()
    rhs.set(1.0)
    solver.solve(rhs, accuracy=requested)
    rtol = solver.ksp.getTolerances()[0]
    assert rtol == requested if given else rtol > 1.5 * requested


def test_an_unsymmetric_solve_is_as_accurate_as_wanted(comm):
    """Of forces, whatever the preconditioner makes of them: here rows, and with them its own, differ by 1e4."""
    config = Configuration(blocks(comm, "triangle", 4, 4, gap=0.5).u)
    solver, K = UnitedSolver(config, "left_over_", ITERATIVE), mass(config)
    rows = K.createVecLeft()
    rows.array[:] = 1e-4 ** (np.arange(*rows.owner_range) / rows.size)
    K.diagonalScale(rows, None)
    solver.set_operator(united(config, []), K, None)
    rhs = K.createVecLeft()
    rhs.array[:] = np.cos(np.arange(*rhs.owner_range))
    dq, _ = solver.solve(rhs, accuracy=1e-6)
    assert solver.ksp.getType() == "gmres"
    assert (K * dq - rhs).norm() <= 1e-6 * rhs.norm()
