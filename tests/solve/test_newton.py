"""The united Newton loop against closed forms, and the laws that every converged state obeys.

Two tests to read first: ``test_patch`` (a constant stress passes a nested interface to rounding, whatever the stiffnesses) and
``test_sliding_along_a_polygon`` (contactors cross facets and vertices, and every state is complementary).
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, blocks, box, clamp, complementary, highest, linear, lowest, modulus, run, scene, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD
NU = 0.3
#: Oedometric modulus over Young's modulus.
M = (1 - NU) / ((1 + NU) * (1 - 2 * NU))


def vertical(b, settlement_low, settlement_high, gap=0.0):
    """Exact nodal displacement of two homogeneously compressed blocks, in the drawing's order."""
    z = b.scene.drawing[:, -1]
    lower = np.arange(len(z)) < len(z) - b.n_high_nodes
    exact = np.zeros((len(z), b.gdim))
    exact[lower, -1] = -settlement_low * (z[lower] + 1)
    exact[~lower, -1] = -settlement_low - gap - settlement_high * (z[~lower] - gap)
    return exact


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell,finer,ratio", product(CELLS, ("upper", "lower"), (1e-3, 1.0, 1e6)))
def test_patch(cell, finer, ratio):
    """Nested meshes, the finer side the contactor: force, pressure and every nodal displacement are the closed form's."""
    d = 0.01
    n_low, n_high = (2, 4) if finer == "upper" else (4, 2)
    b = blocks(COMM, cell, n_low, n_high)
    pair = (b.high, b.low) if finer == "upper" else (b.low, b.high)
    contact = uem.Contact(*pair)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=b.oedometer(d), contacts=[contact])
    run(problem)
    low, high = d * ratio / (1 + ratio), d / (1 + ratio)
    force = M * low
    side = 1.0 if finer == "upper" else -1.0
    assert contact.resultant().force[-1] == pytest.approx(side * force, rel=1e-9)
    assert np.abs(contact.resultant().force[:-1]).max() < 1e-11 * force
    pressures = contact.pressures
    # read from the contactor's own residual, whose rounding grows with its stiffness
    assert highest(COMM, np.abs(pressures / force - 1)) < (1e-9 if ratio <= 1 else 1e-6)
    assert contact.n_active == (max(n_low, n_high) + 1) ** (b.gdim - 1)
    exact = vertical(b, low, high)
    assert np.abs(b.scene.gather(b.u) - exact).max() < 1e-11 * d
    complementary(contact, 1e-13, 1e-14 * force)
    assert contact.balance().force < 1e-12 and contact.balance().moment < 1e-12


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_finite_strain_closed_form(cell):
    """Two St Venant-Kirchhoff blocks in series, a quarter of the height of one: M e (1 - e)(2 - e) / 2 on both sides."""
    d, ratio = 0.25, 3.0
    b = blocks(COMM, cell, 1, 2)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=b.oedometer(d), contacts=[contact])
    run(problem)

    def law(e):
        return M * e * (1 - e) * (2 - e) / 2

    low, high = 0.0, d
    for _ in range(100):
        e = (low + high) / 2
        low, high = (e, high) if law(e) < ratio * law(d - e) else (low, e)
    assert contact.resultant().force[-1] == pytest.approx(law(e), rel=1e-9)
    assert np.abs(b.scene.gather(b.u) - vertical(b, e, d - e)).max() < 1e-9


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_closing_a_gap(cell):
    """No force before the gap is closed, the series stiffness after."""
    gap = 0.025
    b = blocks(COMM, cell, 2, 4, gap=gap)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(0.05), contacts=[contact])
    for step in uem.load_steps(problem, 5):
        closed = max(0.0, 0.05 * step.factor - gap)
        assert contact.resultant().force[-1] == pytest.approx(M * closed * 2 / 3, abs=1e-12)
        assert (contact.n_active > 0) == (closed > 0)
        complementary(contact, 1e-13, 1e-15)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_body_held_by_contact_alone(cell):
    """A block that only the contact holds up carries exactly its load."""
    b = blocks(COMM, cell, 2, 4)
    g = b.gdim
    load = fem.Constant(b.scene.mesh, PETSc.ScalarType(0.0))
    v = ufl.TestFunction(b.V)
    F = linear(b.u, modulus(b.scene, 1.0, 2.0)) + 0.01 * load * v[g - 1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    bcs = [*clamp(b.V, b.bottom, g - 1)]
    for c, end, body in product(range(g - 1), (0.0, 1.0), (0, 1)):
        bcs += clamp(b.V, b.scene.tag("side", body, at(c, end)), c)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load=load)
    for step in uem.load_steps(problem, 2):
        assert contact.resultant().force[-1] == pytest.approx(0.01 * step.factor, rel=1e-10)
        assert np.abs(b.scene.gather(b.u) - vertical(b, 0.01 * step.factor / M, 0.005 * step.factor / M)).max() < 1e-12


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("normals", ["facet", "averaged"])
def test_every_kind_of_sliding_passes_the_patch(sliding, normals):
    b = blocks(COMM, "quadrilateral", 2, 4)
    contact = uem.Contact(b.high, b.low, sliding=sliding, normals=normals)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    run(problem, 2)
    assert np.abs(b.scene.gather(b.u) - vertical(b, 0.005, 0.005)).max() < 1e-14


@pytest.mark.parametrize("degree", [2])
def test_patch_of_degree_two(degree):
    b = blocks(COMM, "triangle", 2, 2, degree=degree)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    run(problem)
    x, u = problem.config.X, problem.config.displacement
    # upper and lower sides of the interface both move by half
    assert highest(COMM, np.abs(u[np.abs(x[:, 1]) < 1e-9, 1] + 0.005)) < 1e-13
    assert contact.resultant().force[-1] == pytest.approx(0.005 * M, rel=1e-10)


# -- the loop ----------------------------------------------------------------------------------------------------------


def arch(height):
    """Bend the lower block's top: an arch for a positive height, a bowl for a negative one."""

    def pose(x):
        y = x.copy()
        y[:, -1] -= height * np.where(x[:, -1] <= 1e-12, x[:, -1] + 1, 0.0) * (x[:, 0] - 0.5) ** 2
        return y

    return pose


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
    assert problem.system.tangent.number == 1
    assert contact.n_active > 0


def test_modified_newton_gives_the_same_state():
    answers = {}
    for newton in ("full", "modified"):
        b, contact, problem = pressed(newton=newton, rtol=1e-10, max_iterations=200)
        steps = run(problem, 4)
        answers[newton] = (
            b.scene.gather(b.u),
            contact.n_active,
            problem.system.tangent.number,
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


@pytest.mark.parametrize("cell,normals", product(("triangle", "hexahedron"), ("facet", "averaged")))
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
    """A step that fails in the iterations it is given is halved, and grown again; the end is the same."""
    b, contact, problem = pressed(d=0.3, rtol=1e-10, max_iterations=4)
    steps = run(problem)
    assert sum(s.cuts for s in steps) > 0 and steps[-1].factor == 1.0
    assert [s.number for s in steps] == list(range(1, len(steps) + 1))
    assert (np.diff([s.factor for s in steps]) > 0).all()
    reference, other, patient = pressed(d=0.3, rtol=1e-10)
    run(patient, 8)
    assert np.abs(b.scene.gather(b.u) - reference.scene.gather(reference.u)).max() < 1e-8


def test_first_step_from_touching_is_cut():
    """Bodies that touch at the start still touch when the first step has failed and starts again."""
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
    """A far step that full Newton steps cannot take is taken in shorter ones, or cut; the state is that of many small steps."""
    b, contact, problem = pressed(d=0.4, rtol=1e-9)
    steps = run(problem)
    assert min(i.step_length for s in steps for i in s.iterations) < 1.0 or sum(s.cuts for s in steps) > 0
    complementary(contact, 1e-13, 1e-12)
    reference, _, patient = pressed(d=0.4, rtol=1e-9)
    run(patient, 10)
    assert np.abs(b.scene.gather(b.u) - reference.scene.gather(reference.u)).max() < 1e-6


def test_failure_restores_the_committed_state():
    """After a failed step everything is as before it, and the history tells what happened."""
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
    # and the same problem goes on
    problem.max_iterations = 50
    assert problem.solve()[-1].residual <= 1e-10


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


# -- sliding -----------------------------------------------------------------------------------------------------------


def sliding_block(cell, height, normals, start=0.0, n_low=8, length=2.0, offset=0.0):
    """A block, narrower than the polygon below it, on its way from left to right."""
    g = 2 if cell == "triangle" else 3
    low = box(cell, [-0.5, *[-0.25] * (g - 2), -1.0], [length - 0.5, *[1.25] * (g - 2), 0.0], [n_low, *[2] * (g - 2), 2])
    high = box(cell, [start, *[0.0] * (g - 2), offset], [start + 0.5, *[1.0] * (g - 2), offset + 0.5], [2, *[2] * (g - 2), 2])
    s = scene(COMM, cell, [low, high], pose=arch(height))
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    tags = [s.tag("bottom", 0, at(g - 1, -1.0)), s.tag("low", 0, at(g - 1, 0.0))]
    tags += [s.tag("high", 1, at(g - 1, offset)), s.tag("top", 1, at(g - 1, offset + 0.5))]
    return s, V, u, tags


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("cell,height", [("triangle", 0.15), ("triangle", -0.15), ("hexahedron", 0.15), ("hexahedron", -0.15)])
def test_sliding_along_a_polygon(cell, height, normals):
    """Over several facets and vertices of an arch or a bowl, starting exactly on a vertex; no step is cut, none cycles."""
    # the block's corners start above nodes of the polygon
    offset = 0.0 if height > 0 else -height / 4
    s, V, u, (bottom, low, high, top) = sliding_block(cell, height, normals, offset=offset)
    g = V.mesh.geometry.dim
    path = fem.Function(V)
    dofs = fem.locate_dofs_topological(V, g - 1, top.entities)
    contact = uem.Contact(high, low, normals=normals, max_penetration=0.2)

    def load(factor):
        p = path.x.array.reshape(-1, g)
        middle = 0.25 + factor
        p[:, 0] = factor
        # follow the polygon's parabola, pressed in a little
        p[:, -1] = -height * (middle - 0.5) ** 2 - 0.02 - offset / 2

    problem = uem.UnitedProblem(
        st_venant(u, modulus(s, 1.0, 2.0)), u, bcs=[*clamp(V, bottom), fem.dirichletbc(path, dofs)], contacts=[contact], load=load
    )
    touched, facets = [], set()
    for step in uem.load_steps(problem, 16):
        # averaged normals are no gradient of the gap, so that Newton is linear with them
        assert step.cuts == 0 and step.newton_iterations <= (25 if normals == "facet" else 30)
        complementary(contact, 1e-12, 1e-10)
        touched.append(contact.n_active)
        facets |= {int(f) for part in COMM.allgather(contact.pair.projection.facet[contact.pair.trial.active]) for f in part}
    assert min(touched[1:]) > 0
    assert len(facets) > 3


@pytest.mark.parametrize("normals", ["facet", "averaged"])
def test_sliding_off_the_end(normals):
    """Past the end of the target a contactor is let go, one after the other, and the last force is gone with the last of them."""
    s, V, u, (bottom, low, high, top) = sliding_block("triangle", 0.0, normals, start=0.9, offset=0.0)
    path = fem.Function(V)
    dofs = fem.locate_dofs_topological(V, 1, top.entities)
    contact = uem.Contact(high, low, normals=normals)

    def load(factor):
        path.x.array.reshape(-1, 2)[:] = [0.8 * factor, -0.01]

    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 1.0)), u, bcs=[*clamp(V, bottom), fem.dirichletbc(path, dofs)], contacts=[contact], load=load
    )
    counts = []
    for step in uem.load_steps(problem, 16):
        counts.append(contact.n_active)
        complementary(contact, 1e-13, 1e-12)
        # the end of the flat target has moved by a few per cent at most
        assert highest(COMM, contact.pair.points[contact.pair.trial.active, 0]) < 1.55
    assert counts[0] == 3 and counts[-1] == 0 and (np.diff(counts) <= 0).all()
    assert np.abs(contact.resultant().force).max() == 0.0


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_contactor_exactly_on_a_vertex(cell, normals):
    """Matching meshes over a roof: every contactor starts on a vertex, the middle ones on a ridge.

    On a ridge the facets' normals have no balance but on one of its slopes; averaged normals keep the symmetry of the scene.
    """

    def roof(x):
        y = x.copy()
        y[:, -1] -= 0.3 * np.abs(x[:, 0] - 0.5) * np.where(x[:, -1] <= 0.5, 1.0, 2 * (1 - x[:, -1]) if x.shape[1] else 0.0)
        return y

    b = blocks(COMM, cell, 2, 2, pose=roof)
    contact = uem.Contact(b.high, b.low, normals=normals, max_penetration=0.1)
    slide = [0.0] * (b.gdim - 1) + [-0.02]
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 1.0)),
        b.u,
        bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=slide)],
        contacts=[contact],
    )
    steps = run(problem, 2)
    assert max(s.newton_iterations for s in steps) <= 12 and not any(s.cuts for s in steps)
    complementary(contact, 1e-13, 1e-12)
    u, x = b.scene.gather(b.u), b.scene.drawing
    ridge = (np.abs(x[:, 0] - 0.5) < 1e-9) & (np.abs(x[:, -1]) < 1e-9)
    if cell == "hexahedron" and normals == "averaged":
        assert np.abs(u[ridge, 0]).max() < 1e-9
    assert u[ridge, -1].max() < -0.005
    assert contact.resultant().force[-1] > 0


@pytest.mark.parametrize("cell,ratio", product(("quadrilateral", "tetrahedron", "hexahedron"), (0.2, 5.0)))
def test_contactors_on_the_rim_of_the_target(cell, ratio):
    """Equal blocks with free sides: the softer bulges past the stiffer one's rim, where contactors sit from the start."""
    b = blocks(COMM, cell, 2, 4 if b_is_flat(cell) else 3)
    g = b.gdim
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (g - 1) + [-0.1])]
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=bcs, contacts=[contact])
    for step in uem.load_steps(problem, 2):
        assert step.cuts == 0 and step.newton_iterations <= 20
        complementary(contact, 1e-12, 1e-10)
    assert contact.n_active > 1


def b_is_flat(cell):
    """Whether cells are two-dimensional."""
    return cell in ("triangle", "quadrilateral")


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("off_centre", [0.0, 0.02, -0.03])
def test_tip_in_a_groove(normals, off_centre):
    """A wedge's tip falls into a V-shaped groove and is held by both of its faces, wherever it came down."""
    low = box("triangle", [0.0, -1.0], [1.0, 0.0], [2, 2]).mapped(
        lambda x: x + np.outer((x[:, 1] + 1) * np.abs(x[:, 0] - 0.5), [0, 0.8])
    )
    high = box("triangle", [0.3 + off_centre, 0.05], [0.7 + off_centre, 0.9], [2, 2])
    # steeper than the groove, so that nothing but the tip touches
    high = high.mapped(lambda x: x + np.outer((0.9 - x[:, 1]) * np.abs(x[:, 0] - 0.5 - off_centre), [0, 1.5]))
    s = scene(COMM, "triangle", [low, high])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    bottom = s.tag("bottom", 0, at(1, -1.0))
    groove = s.tag("groove", 0, lambda x: np.abs(x[:, 1] - 0.8 * np.abs(x[:, 0] - 0.5)) < 1e-9)
    tip = s.tag("tip", 1, lambda x: np.abs(x[:, 1] - 0.05 - 0.85 * 1.5 * np.abs(x[:, 0] - 0.5 - off_centre)) < 1e-9)
    top = s.tag("top", 1, at(1, 0.9))
    contact = uem.Contact(tip, groove, normals=normals)
    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 1.0)), u, bcs=[*clamp(V, bottom), *clamp(V, top, value=[0.0, -0.1])], contacts=[contact]
    )
    for step in uem.load_steps(problem, 4):
        assert step.newton_iterations <= (12 if normals == "facet" else 30)
        complementary(contact, 1e-13, 1e-12)
    assert contact.n_active == 1
    force = contact.resultant().force
    assert force[1] > 1e-3
    if normals == "facet":
        # the tip rests in the corner: it and the corner are one point, and neither face pulls
        x = problem.config.X + problem.config.displacement
        place = s.gather(u) + s.drawing
        corner = place[np.linalg.norm(s.drawing - [0.5, 0.0], axis=1).argmin()]
        apex = place[np.linalg.norm(s.drawing - [0.5 + off_centre, 0.05], axis=1).argmin()]
        assert np.abs(corner - apex).max() < 1e-12
        assert abs(force[0]) <= 0.8 * force[1] * (1 + 1e-9)
        assert lowest(COMM, x) > -2


def test_two_pairs_and_a_rigid_floor():
    """Stacked bodies on a rigid plane: three contacts in series carry one force."""
    g = 2
    bodies = [box("quadrilateral", [0.0, k], [1.0, k + 1.0], [n, 2]) for k, n in ((0.0, 1), (1.0, 2), (2.0, 4))]
    s = scene(COMM, "quadrilateral", bodies)
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    sides = [bc for body in range(3) for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", body, at(0, end)), 0)]
    top = s.tag("top", 2, at(1, 3.0))
    contacts = [
        uem.Contact(s.tag("floor", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0))),
        uem.Contact(s.tag("second", 1, at(1, 1.0)), s.tag("first", 0, at(1, 1.0))),
        uem.Contact(s.tag("third", 2, at(1, 2.0)), s.tag("second top", 1, at(1, 2.0))),
    ]
    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 2.0, 4.0)), u, bcs=[*sides, *clamp(V, top, 1, value=-0.07)], contacts=contacts
    )
    run(problem)
    force = M * 0.07 / (1 + 1 / 2 + 1 / 4)
    for contact in contacts:
        assert contact.resultant().force[1] == pytest.approx(force, rel=1e-10)
        complementary(contact, 1e-13, 1e-14)
    assert contacts[0].balance() is None
