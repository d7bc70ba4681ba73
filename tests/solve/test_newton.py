"""The united Newton loop: its variants, its steps, what happens when one fails, and that its answer does not depend on them.

The test to read first is ``test_complementarity``.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import M, arch, at, blocks, clamp, complementary, linear, modulus, run, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.solve.rigid import rest

COMM = MPI.COMM_WORLD


def pressed(cell="triangle", height=0.3, d=0.2, law=st_venant, fine=2, overhang=0.5, **options):
    """A block pressed onto an arch."""
    how = {k: options.pop(k) for k in ("sliding", "normals") if k in options}
    b = blocks(COMM, cell, 3 * fine, 2 * fine, gap=0.1, overhang=overhang, pose=arch(height))
    contact = uem.Contact(b.high, b.low, max_penetration=0.2, **how)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (b.gdim - 1) + [-0.1 - d])]
    problem = uem.UnitedProblem(law(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], **options)
    return b, contact, problem


def test_linear_body_assembles_its_tangent_once():
    b, contact, problem = pressed(law=linear, sliding="fixed", consistent_tangent=False)
    steps = run(problem, 3)
    assert sum(step.newton_iterations for step in steps) >= 3
    assert problem.bodies.tangent.number == 1
    assert contact.n_active > 0


@pytest.mark.long
def test_solves_on_the_way_are_as_accurate_as_newton_needs():
    """Looser solves take less than nine tenths of the linear iterations of solves to 1e-8, and at most 15 % more Newton iterations."""

    def iterations(cell, law, fine, **accuracy):
        _, _, problem = pressed(cell, law=law, fine=fine, petsc_options={"ksp_type": "cg", "pc_type": "jacobi", **accuracy})
        steps = [i for step in uem.load_steps(problem, 3) for i in step.iterations]
        return sum(i.linear_iterations > 0 for i in steps), sum(i.linear_iterations for i in steps)

    scenes = [("triangle", st_venant, 4), ("quadrilateral", linear, 4), ("hexahedron", linear, 1)]
    loose, tight = (np.sum([iterations(*scene, **how) for scene in scenes], axis=0) for how in ({}, {"ksp_rtol": 1e-8}))
    assert loose[0] <= 1.15 * tight[0] and loose[1] <= 0.9 * tight[1]


@pytest.mark.parametrize("contact", [False, True])
@pytest.mark.parametrize("load", [3e-8, 1e-9, 1e-10])
def test_loads_that_rounding_of_the_deformation_gradient_hides(load, contact):
    """Where ``1 + grad(u)`` leaves the residual few digits, it has converged when it no longer falls."""
    b = blocks(COMM, "triangle", 6, 4, gap=0.5, overhang=0.5)
    F = st_venant(b.u, modulus(b.scene, 1.0, 2.0)) + load * ufl.TestFunction(b.V)[1] * ufl.dx
    contacts = [uem.Contact(b.high, b.low)] if contact else []
    history = uem.UnitedProblem(F, b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=contacts).solve()
    assert len(history) <= 5 and 1e-8 < history[-1].residual <= 1e-15 / load
    exact = blocks(COMM, "triangle", 6, 4, gap=0.5, overhang=0.5)
    F = linear(exact.u, modulus(exact.scene, 1.0, 2.0)) + load * ufl.TestFunction(exact.V)[1] * ufl.dx
    uem.UnitedProblem(F, exact.u, bcs=[*clamp(exact.V, exact.bottom), *clamp(exact.V, exact.top)]).solve()
    found, expected = b.scene.gather(b.u), exact.scene.gather(exact.u)
    assert np.abs(found - expected).max() <= 1e-15 / load * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_the_last_solve_is_as_accurate_as_convergence_asks(rtol):
    """A linear problem takes one solve, which leaves neither more than a twentieth of what converges nor less than a 250th."""
    left = []
    for n in (4, 5, 6, 7, 8, 9):
        b = blocks(COMM, "triangle", n, n, gap=0.5)
        F = linear(b.u, 1.0) + 0.01 * ufl.TestFunction(b.V)[0] * ufl.dx
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top)]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, petsc_options={"ksp_type": "cg", "pc_type": "jacobi"}, rtol=rtol)
        history = problem.solve()
        assert len(history) == 2
        left.append(history[-1].residual / rtol)
    assert 4e-3 < np.median(left) < 5e-2


def test_a_solve_that_another_follows_is_coarse():
    """At small strain the first solve of a nonlinear problem leaves its own accuracy, and no less."""
    left = []
    for n in (4, 5, 6, 7, 8, 9):
        b = blocks(COMM, "triangle", n, n, gap=0.5)
        F = st_venant(b.u, 1.0) + 1e-7 * ufl.TestFunction(b.V)[0] * ufl.dx
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top)]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, petsc_options={"ksp_type": "cg", "pc_type": "jacobi"}, rtol=1e-8)
        left.append(problem.solve()[1].residual)
    assert 5e-6 < np.median(left) < 5e-5


def test_modified_newton_gives_the_same_state():
    answers = {}
    for newton in ("full", "modified"):
        b, contact, problem = pressed(newton=newton, rtol=1e-10, max_iterations=200)
        steps = run(problem, 4)
        answers[newton] = (
            b.scene.gather(b.u),
            contact.n_active,
            problem.bodies.tangent.number,
            sum(s.newton_iterations for s in steps),
        )
    full, modified = answers["full"], answers["modified"]
    assert np.abs(full[0] - modified[0]).max() < 1e-7
    assert full[1] == modified[1]
    # fewer tangents than iterations, at the price of more iterations
    assert modified[2] < modified[3] and full[2] < modified[3]


def test_one_step_and_many_agree():
    """Frictionless hyperelastic contact does not remember its path."""
    answers = []
    for steps in (2, 7):
        b, contact, problem = pressed(rtol=1e-11)
        run(problem, steps)
        answers.append((b.scene.gather(b.u), contact.n_active))
    assert np.abs(answers[0][0] - answers[1][0]).max() < 1e-9
    assert answers[0][1] == answers[1][1]


@pytest.mark.parametrize("cell,normals", [*product(("triangle", "hexahedron"), ("facet", "averaged"))])
def test_complementarity(cell, normals):
    """On every converged state: no tension, no penetration, force only where the gap is closed; action = reaction."""
    b, contact, problem = pressed(cell, normals=normals, rtol=1e-10, fine=2 if cell == "triangle" else 1)
    size = problem.config.size
    for step in uem.load_steps(problem, 4):
        last = step.iterations[-1]
        assert last.residual <= 1e-10 or contact.n_active == 0
        assert last.gap <= 1e-13 * size and not last.changed and last.linear_iterations == 0
        complementary(contact, 1e-13 * size, 1e-12)
        if contact.n_active:
            assert contact.balance().force < 1e-12 and contact.balance().moment < 1e-12
    assert contact.n_active > 1


def test_release_when_pulled_apart():
    """Press, then lift: the forces vanish, and the lifted block is the undeformed one."""
    b = blocks(COMM, "triangle", 6, 4, gap=0.1, overhang=0.5, pose=arch(0.3))
    lift = fem.Function(b.V)
    dofs = fem.locate_dofs_topological(b.V, 1, b.top.entities)
    contact = uem.Contact(b.high, b.low)
    counts = []

    def load(factor):
        lift.x.array.reshape(-1, 2)[:, 1] = -0.3 * np.sin(np.pi * 1.25 * factor)

    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 2.0)),
        b.u,
        bcs=[*clamp(b.V, b.bottom), fem.dirichletbc(lift, dofs)],
        contacts=[contact],
        load=load,
        rtol=1e-10,
    )
    for _ in uem.load_steps(problem, 10):
        counts.append(contact.n_active)
        complementary(contact, 1e-13, 1e-12)
    assert max(counts) > 1 and counts[-1] == 0
    assert np.abs(contact.resultant().force).max() == 0.0 and contact.max_pressure() == 0.0
    u = b.scene.gather(b.u)
    upper = np.arange(len(u)) >= len(u) - b.n_high_nodes
    assert np.abs(u[upper] - [0.0, -0.3 * np.sin(1.25 * np.pi)]).max() < 1e-9
    assert np.abs(u[~upper]).max() < 1e-9


def test_big_step_is_cut():
    """A step that fails in the iterations it is given is halved, and increased again; the end is the same."""
    b, contact, problem = pressed(d=0.3, rtol=1e-10, max_iterations=4)
    steps = run(problem)
    assert sum(s.cuts for s in steps) > 0 and steps[-1].factor == 1.0
    assert [s.number for s in steps] == list(range(1, len(steps) + 1))
    assert (np.diff([s.factor for s in steps]) > 0).all()
    reference, other, patient = pressed(d=0.3, rtol=1e-10)
    run(patient, 8)
    assert np.abs(b.scene.gather(b.u) - reference.scene.gather(reference.u)).max() < 1e-8


def test_first_step_from_touching_is_cut(monkeypatch):
    """Bodies that touch at the start still touch when the first step has failed, here without a drag, and starts again."""
    monkeypatch.setattr(rest, "_may_rest", lambda problem: False)
    b = blocks(COMM, "triangle", 2, 4)
    load = fem.Constant(b.scene.mesh, PETSc.ScalarType(0.0))
    v = ufl.TestFunction(b.V)
    F = st_venant(b.u, modulus(b.scene, 1.0, 1.0)) + 0.1 * load * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    bcs = [*clamp(b.V, b.bottom, 1)]
    for end, body in product((0.0, 1.0), (0, 1)):
        bcs += clamp(b.V, b.scene.tag("side", body, at(0, end)), 0)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load=load, max_iterations=3, rtol=1e-10)
    steps = run(problem)
    assert sum(s.cuts for s in steps) > 0
    assert contact.resultant().force[1] == pytest.approx(0.1, rel=1e-8)


def test_loose_body_is_no_solution():
    """A body that nothing holds is reported, not flown away with."""
    b = blocks(COMM, "triangle", 2, 2, gap=0.5)
    load = fem.Constant(b.scene.mesh, PETSc.ScalarType(0.0))
    v = ufl.TestFunction(b.V)
    F = st_venant(b.u, modulus(b.scene, 1.0, 1.0)) - load * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    problem = uem.UnitedProblem(
        F, b.u, bcs=clamp(b.V, b.bottom), contacts=[uem.Contact(b.high, b.low)], load=load, max_iterations=5
    )
    with pytest.raises(uem.FloatingBodyError, match=r"moves along \(.*, 1\) under its loads"):
        run(problem)
    assert np.abs(b.scene.gather(b.u)).max() == 0.0


def test_line_search_shortens_a_step_and_ends_in_the_same_state():
    """A far step that full Newton steps cannot take is taken in shorter ones without a cut; the state is that of many small steps."""
    b, contact, problem = pressed(d=0.4, rtol=1e-9)
    steps = run(problem)
    assert min(i.step_length for s in steps for i in s.iterations) < 1.0 and [s.cuts for s in steps] == [0]
    complementary(contact, 1e-13, 1e-12)
    reference, _, patient = pressed(d=0.4, rtol=1e-9)
    run(patient, 10)
    assert np.abs(b.scene.gather(b.u) - reference.scene.gather(reference.u)).max() < 1e-6


def test_failure_restores_the_committed_state():
    """After a failed step everything is as before it, and the history has all iterations."""
    b, contact, problem = pressed(rtol=1e-10, load=None)
    steps = uem.load_steps(problem, 2)
    next(steps)
    before = b.u.x.array.copy(), contact.pair.trial, contact.resultant().force, contact.pressure.x.array.copy()
    problem.max_iterations = 1
    with pytest.raises(uem.ConvergenceError, match="in 1 iterations.*active contactors") as caught:
        problem.solve(fraction=1.0)
    assert len(caught.value.history) == 2
    assert caught.value.history[0].residual > 0 and caught.value.history[-1].active > 0
    assert np.array_equal(b.u.x.array, before[0])
    for field in ("active", "lam", "force"):
        assert np.array_equal(getattr(contact.pair.trial, field), getattr(before[1], field))
    assert np.array_equal(contact.resultant().force, before[2])
    assert np.array_equal(contact.pressure.x.array, before[3])
    # and the same problem continues
    problem.max_iterations = 50
    assert problem.solve()[-1].residual <= 1e-10


@pytest.mark.slow
def test_failure_after_all_cuts_keeps_the_last_step():
    """The load, too, is the one of the last converged state."""
    b = blocks(COMM, "triangle", 2, 4)
    load = fem.Constant(b.scene.mesh, PETSc.ScalarType(0.0))
    v = ufl.TestFunction(b.V)
    # St Venant-Kirchhoff in compression carries no more than 0.19 M: there is no equilibrium at the full load
    F = st_venant(b.u, modulus(b.scene, 1.0, 1.0)) + 0.5 * load * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    bcs = [*clamp(b.V, b.bottom, 1)]
    for end, body in product((0.0, 1.0), (0, 1)):
        bcs += clamp(b.V, b.scene.tag("side", body, at(0, end)), 0)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load=load, max_iterations=10)
    reached = 0.0
    with pytest.raises(uem.UEMError):
        for step in uem.load_steps(problem, 4):
            reached, u = step.factor, b.u.x.array.copy()
    # the largest force of s = M e (1 - e)(2 - e) / 2
    e = 1 - 1 / np.sqrt(3)
    limit = M * e * (1 - e) * (2 - e) / 2 / 0.5
    assert 0.95 * limit < reached < limit * (1 + 1e-9)
    assert float(load.value) == reached
    assert np.array_equal(b.u.x.array, u)
    assert contact.resultant().force[1] == pytest.approx(0.5 * reached, rel=1e-6)


def test_history_and_its_lines(capsys):
    """One line per iteration on request, on rank 0, with the figures of the history."""
    b, contact, problem = pressed(verbose=True)
    history = problem.solve()
    lines = [line for line in capsys.readouterr().out.splitlines() if "residual" in line]
    if COMM.rank == 0:
        assert len(lines) == len(history)
        assert all(f"{i.residual:.3e}" in line and f"active {i.active:5d}" in line for i, line in zip(history, lines))
    else:
        assert not lines
    assert history[-1].residual < 1e-8 and history[-1].active == contact.n_active
