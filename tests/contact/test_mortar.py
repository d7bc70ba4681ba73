"""Mortar: constant pressures through any pair of meshes, rows against slow quadrature, balances and derivatives.

The test to read first is ``test_patch_on_any_meshes``.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import surface_of
from dolfinx import fem
from helpers import (
    CELLS,
    M,
    at,
    box,
    clamp,
    complementary,
    factors,
    highest,
    linear,
    modulus,
    refused,
    run,
    scene,
    slow,
    st_venant,
)
from mortar_scenes import COMM, Blocks, disturbed

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

# -- the patch test ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("contactor", ["upper", "lower"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("cell", "n", "seed"), [
    ("triangle", (5, 3), None), ("triangle", (10, 7), 1), ("quadrilateral", (7, 10), None), ("quadrilateral", (5, 4), 2),
    ("tetrahedron", (2, 3), None), ("tetrahedron", (3, 2), 3), ("hexahedron", (3, 2), None), ("hexahedron", (2, 3), 4),
])  # fmt: skip
def test_patch_on_any_meshes(cell, n, seed, degree, contactor):
    """A constant pressure passes: stress, displacement, every pressure and both balances to rounding, in one solve."""
    p = 1e-3
    b = Blocks(cell, n, degree, contactor, seed=seed)
    steps = run(b.pressed(p))
    stress = fem.Function(compat.function_space(b.scene.mesh, ("DG", 0)))
    law = uem.LinearElastic(b.E, 0.3, kind="plane_strain" if b.g == 2 else "3d")
    forms.interpolation(stress, law.stress(b.u)[b.g - 1, b.g - 1])()
    assert highest(COMM, np.abs(stress.x.array / p + 1)) < 1e-11
    x = b.contact.pair.config.X
    lower = x[:, -1] < -1e-9
    exact = np.where(lower, -p / M * (x[:, -1] + 1), -p / M - p / (2 * M) * x[:, -1])
    inside = np.abs(x[:, -1]) > 1e-9
    assert highest(COMM, np.abs(b.u.x.array.reshape(-1, b.g)[:, -1] - exact)[inside]) < 1e-11 * p
    assert highest(COMM, np.abs(b.contact.pressures / p - 1)) < 1e-11
    assert b.contact.balance().force < 1e-14 and b.contact.balance().moment < 1e-14
    assert steps[0].newton_iterations <= 2


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_every_kind_of_sliding(cell, sliding):
    """Two steps, the second half of them with kept rows."""
    b = Blocks(cell, (3, 2), sliding=sliding)
    run(b.pressed(), 2)
    assert highest(COMM, np.abs(b.contact.pressures / 1e-3 - 1)) < 1e-11


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("contactor", ["upper", "lower"])
@pytest.mark.parametrize("width", [0.55, 0.61, 0.6 + 1e-9])
def test_partly_covered_facets(contactor, degree, width):
    """The upper block ends within a facet of the lower one: its own stress stays that of the load, whichever is the contactor."""
    p = 1e-3
    b = Blocks("quadrilateral", (5, 3), degree, contactor, narrow=width, E=(1e4, 1.0))
    run(b.pressed(p))
    assert b.contact.resultant().force[1] == pytest.approx((1 if contactor == "upper" else -1) * p * width, rel=1e-9)
    # the stiff floor stays even; rollers on its sides see no more than its small strain
    assert highest(COMM, np.abs(b.contact.pressures[b.contact.pair.trial.active] / p - 1)) < 0.01
    complementary(b.contact, 1e-12, 1e-12)


# -- rows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), [*product(CELLS, (1,)), ("triangle", 2), ("tetrahedron", 2)])
def test_forces_balance_across_open_gaps(cell, degree):
    """Whatever the multipliers, nodal forces have no resultant and no moment, wherever the bodies are."""
    b = Blocks(cell, (3, 2), degree, gap=0.03)
    problem = b.pressed()
    disturbed(b, 1, 0.01)
    problem.system.place()
    pair = b.contact.pair
    x = pair.config.X[pair.nodes]
    lam = 1e-3 * (2 + np.sin(11 * x[:, 0])) * pair.kinematics.rows.covered
    pair.trial = replace(pair.trial, lam=lam, active=lam > 0)
    balance = b.contact.balance()
    assert balance.force < 1e-14 and balance.moment < 1e-14
    complete = COMM.allreduce(float(np.abs(b.contact.force.x.array).max()), op=MPI.MAX)
    assert complete > 1e-5


# -- Newton, rigid targets, ends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("contactor", ["upper", "lower"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_newton_is_quadratic(cell, contactor):
    """Wavy surfaces, finite strain and far sliding in one step: the residual is squared by every iteration."""
    b = Blocks(cell, (5, 4), contactor=contactor, wave=0.03, gap=0.01)
    s, g = b.scene, b.g
    bcs = clamp(b.V, s.tag("bottom", 0, at(g - 1, -1.0)))
    bcs += clamp(b.V, b.top, value=[0.03, *[0.0] * (g - 2), -0.06])
    problem = uem.UnitedProblem(st_venant(b.u, b.E), b.u, bcs=bcs, contacts=[b.contact], rtol=1e-11)
    steps = run(problem)
    history = [i.residual for i in steps[-1].iterations]
    assert len(history) <= 9
    assert all(f < 1e3 for f in factors(steps[-1].iterations)) or history[-2] ** 2 < history[-1]
    complementary(b.contact, 1e-12, 1e-12)
    assert b.contact.balance().force < 1e-13 and b.contact.balance().moment < 1e-13


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_rigid_plane(cell, degree, sliding):
    """A constant pressure on a plane that moves, on any mesh and with any sliding."""
    g = 2 if cell == "triangle" else 3
    s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [3] * g)])
    V = compat.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)
    plane = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0])
    contact = uem.Contact(s.tag("base", 0, at(g - 1, 0.0)), plane, coupling="mortar", sliding=sliding)
    bcs = clamp(V, s.tag("top", 0, at(g - 1, 1.0)), g - 1)
    for c, end in product(range(g - 1), (0.0, 1.0)):
        bcs += clamp(V, s.tag("side", 0, at(c, end)), c)

    def push(factor):
        plane.move([0.0] * (g - 1) + [0.02 * factor])

    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], load=push)
    for step in uem.load_steps(problem, 2):
        assert highest(COMM, np.abs(contact.pressures / (0.02 * step.factor * M) - 1)) < 1e-10
    assert contact.resultant().force[-1] == pytest.approx(0.02 * M, rel=1e-10)
    assert contact.resultant(on="target").force[-1] == pytest.approx(-0.02 * M, rel=1e-10)


@pytest.mark.parametrize(("angle", "covers"), [(40.0, True), (43.0, False)])
def test_rigid_surfaces_cover_what_faces_them(angle, covers):
    """A plane covers facets that lean by less than 41 degrees; nodes of others have equations of their own."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    a = np.deg2rad(angle)
    plane = uem.RigidPlane((0.0, -0.8), (np.sin(a), np.cos(a)))
    contact = uem.Contact(s.tag("bottom", 0, at(1, 0.0)), plane, coupling="mortar", max_penetration=1.0)
    uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(u.function_space, s.tag("top", 0, at(1, 1.0))), contacts=[contact])
    contact.pair.project()
    assert (contact.pair.kinematics.rows.covered == covers).all()


def test_rigid_surfaces_go_on_covering():
    """A plane that turns away lets facets go at 46 degrees, and covers them again within 41; committed or not, as the state says."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    plane = uem.RigidPlane((0.0, -0.8), (0.0, 1.0))
    contact = uem.Contact(s.tag("bottom", 0, at(1, 0.0)), plane, coupling="mortar", max_penetration=3.0)
    uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(u.function_space, s.tag("top", 0, at(1, 1.0))), contacts=[contact])
    pair, begin = contact.pair, contact.pair.trial
    for degrees, covers in [(40, True), (43, True), (45, True), (46, False), (43, False), (40, True), (43, True)]:
        plane.move((0.0, 0.0), np.deg2rad(degrees))
        pair.project()
        pair.follow()
        assert (pair.kinematics.rows.covered == covers).all()
        pair.project()
        assert (pair.kinematics.rows.covered == covers).all()
    pair.trial = begin
    pair.project()
    assert not pair.kinematics.rows.covered.any()


def test_facets_go_on_facing_each_other_within_a_step():
    """One that turns away is covered until 78 degrees in the step in which it was covered before, and until 53 degrees in others."""
    s = scene(COMM, "quadrilateral", [
        box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [1, 1]), box("quadrilateral", [-3.0, -1.0], [3.0, 0.0], [1, 1])
    ])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("base", 0, at(1, 0.0)), s.tag("low", 1, at(1, 0.0)), coupling="mortar")
    uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(V, s.tag("bottom", 1, at(1, -1.0))), contacts=[contact])
    X = V.tabulate_dof_coordinates()[:, :2]
    upper = ((np.abs(X[:, 0] - 0.5) < 1.0) & (X[:, 1] > -0.5))[:, None]
    turns = [(50, False, True), (60, False, True), (77, False, True), (80, False, False), (77, False, True), (77, True, False)]
    for degrees, anew, covers in [*turns, (54, False, False), (52, False, True), (54, False, True)]:
        if anew:
            contact.pair.discretisation.begin_step()
        c, sn = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        u.x.array[:] = np.where(upper, X @ np.array([[c, sn], [-sn, c]]) - X, 0.0).ravel()[: len(u.x.array)]
        contact.pair.project()
        contact.pair.follow()
        assert (contact.pair.kinematics.rows.covered == covers).all()


def test_dual_functions_are_kept():
    """The end of a punch that moves over a facet: what it covers more than 5 % of has a dual function, and keeps it down to 1 %."""
    s = scene(COMM, "quadrilateral", [
        box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [1, 1]), box("quadrilateral", [-2.0, -1.0], [0.15, 0.0], [1, 1])
    ])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("base", 0, at(1, 0.0)), s.tag("punch", 1, at(1, 0.0)), coupling="mortar")
    uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(V, s.tag("top", 0, at(1, 1.0))), contacts=[contact])
    corner = np.linalg.norm(V.tabulate_dof_coordinates()[:, :2] - [0.15, 0.0], axis=1) < 1e-9
    for end, kept in [(0.15, False), (0.24, True), (0.22, True), (0.11, True), (0.09, False), (0.22, False), (0.23, True)]:
        # the share of the far node is the square of what is covered
        u.x.array.reshape(-1, 2)[corner, 0] = end - 0.15
        contact.pair.project()
        contact.pair.follow()
        duals = contact.pair.kinematics.rows.points.duals
        assert COMM.allreduce(int(duals.kept.sum())) == 1 + kept and COMM.allreduce(int(duals.own.sum())) == kept


@pytest.mark.slow
def test_off_the_end_and_back():
    """A block is drawn off the end of a slab and back again: it lets go without a cut, and takes hold again."""
    s = scene(COMM, "quadrilateral", [
        box("quadrilateral", [0.0, -0.5], [1.0, 0.0], [8, 3]), box("quadrilateral", [0.3, 0.0], [0.8, 0.4], [3, 2])
    ])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("base", 1, at(1, 0.0)), s.tag("slab", 0, at(1, 0.0)), coupling="mortar")
    place = fem.Constant(s.mesh, np.zeros(2))
    bcs = clamp(V, s.tag("ground", 0, at(1, -0.5)))
    bcs.append(uem.dirichlet(V, s.tag("top", 1, at(1, 0.4)), value=place))
    way = np.concatenate([[0.0, 0.0], np.linspace(0.0, 0.85, 17), np.linspace(0.85, 0.0, 17)])
    down = np.minimum(np.arange(36) / 2, 1.0) * 0.01

    def lead(factor):
        place.value[:] = [np.interp(35 * factor, range(36), way), -np.interp(35 * factor, range(36), down)]

    problem = uem.UnitedProblem(st_venant(u, 1.0), u, bcs=bcs, contacts=[contact], load=lead)
    forces, cuts = [], 0
    for step in uem.load_steps(problem, 35):
        forces.append(contact.resultant().force[1])
        cuts += step.cuts
    assert cuts == 0 and min(forces[16:19]) == 0.0
    assert forces[-1] == pytest.approx(forces[1], rel=1e-6) and forces[1] > 1e-3


def test_a_round_body_rests_on_a_flat_one():
    """Nothing holds a block with a round base along the floor: facets that lean do not drive it, and it rests where it is put down."""
    upper = box("quadrilateral", [0.2, 0.0], [0.8, 0.5], [8, 4])
    upper = replace(upper, x=upper.x + np.outer(0.3 * (upper.x[:, 0] - 0.5) ** 2, [0.0, 1.0]))
    lower = box("quadrilateral", [0.0, -0.5], [1.0, 0.0], [7, 3])
    drawn = scene(COMM, "quadrilateral", [lower, box("quadrilateral", [0.2, 0.0], [0.8, 0.5], [8, 4])])
    s = scene(COMM, "quadrilateral", [lower, upper])
    s.drawing = drawn.drawing
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    contact = uem.Contact(s.tag("base", 1, at(1, 0.0)), s.tag("floor", 0, at(1, 0.0)), coupling="mortar")
    bcs = clamp(V, s.tag("ground", 0, at(1, -0.5)))
    upon = modulus(s, 0.0, 1.0)
    problem = uem.UnitedProblem(linear(u, 1.0) + 1e-3 * upon * v[1] * ufl.dx, u, bcs=bcs, contacts=[contact])
    assert run(problem)[-1].newton_iterations <= 8
    assert contact.resultant().force == pytest.approx([0.0, 0.3e-3], abs=1e-10)


def test_parallel_facets():
    """Where all facets are parallel the rows are the derivatives, and the united system is symmetric."""
    for tilt, same in ((0.0, True), (3e-11, True), (3e-10, False)):
        b = Blocks("quadrilateral", (3, 2), comm=MPI.COMM_SELF)
        problem = b.pressed()
        b.u.x.array[1::2] += tilt * b.contact.pair.config.X[:, 0] * (b.contact.pair.config.X[:, 1] > -0.5 + 1e-6)
        high = np.isin(np.arange(len(b.u.x.array) // 2), b.contact.pair.nodes)
        b.u.x.array[1::2][high] += tilt * b.contact.pair.config.X[high, 0]
        problem.system.place()
        rows = b.contact.pair.kinematics.rows
        assert (rows.plain is rows.equations) == same


# -- ranks, and what is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_ranks_do_as_one(cell):
    """Histories, forces and displacements of a wavy contact are those of one rank."""

    def solve(comm):
        b = Blocks(cell, (4, 3), wave=0.02, gap=0.01, comm=comm)
        bcs = clamp(b.V, b.scene.tag("bottom", 0, at(b.g - 1, -1.0)))
        bcs += clamp(b.V, b.top, value=[0.01, *[0.0] * (b.g - 2), -0.04])
        problem = uem.UnitedProblem(st_venant(b.u, b.E), b.u, bcs=bcs, contacts=[b.contact])
        steps = run(problem, 2)
        path = [(i.active, i.exchanges) for step in steps for i in step.iterations]
        return path, b.contact.resultant().force, b.contact.max_pressure()

    mine, alone = solve(COMM), solve(MPI.COMM_SELF)
    assert mine[0] == alone[0]
    assert mine[1] == pytest.approx(alone[1], rel=1e-9, abs=1e-12) and mine[2] == pytest.approx(alone[2], rel=1e-9)


def test_what_does_not_go_with_mortar():
    b = Blocks("triangle", (2, 3))
    low, high = b.low, b.high
    for how, words in (({"normals": "averaged"}, "normals = 'averaged'"), ({"chords": True}, "chords = True")):
        refused(uem.InputError, [words, "mortar"], lambda how=how: uem.Contact(high, low, coupling="mortar", **how))
    refused(uem.InputError, ["coupling", "mortar"], lambda: uem.Contact(high, low, coupling="mortars"))
    both = [uem.Contact(high, low, coupling="mortar"), uem.Contact(low, high, coupling="mortar")]
    refused(
        uem.ConflictError, ["high on low", "one pass"],
        lambda: uem.UnitedProblem(linear(b.u, b.E), b.u, bcs=b.bcs, contacts=both),
    )  # fmt: skip


@pytest.mark.parametrize(
    "cell, degree", [("quadrilateral", 1), slow("hexahedron", 1), slow("tetrahedron", 1), slow("triangle", 2)]
)
def test_whole_surfaces_of_thin_bodies(cell, degree):
    """Of bodies as thin as half a facet is long, the far sides are not in each other: all of both press as the sides that face do.

    Facets that look away are part of the share of a node that is covered, which decides to whose dual functions those of hardly covered
    nodes are added: forces at the target's end differ by parts in 1e8.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    forces = []
    for whole in (True, False):
        low = box(cell, [-4.0, *[-2.0] * (g - 2), -1.0], [4.0, *[2.0] * (g - 2), 0.0], [4, *[2] * (g - 2), 1])
        high = box(cell, [-2.0, *[-4.0] * (g - 2), 0.0], [2.0, *[4.0] * (g - 2), 1.0], [2, *[4] * (g - 2), 1])
        s = scene(COMM, cell, [low, high])
        V = compat.function_space(s.mesh, degree, (g,))
        u = fem.Function(V)
        sides = [surface_of(s, k) if whole else s.tag(f"side {k}", k, at(g - 1, 0.0)) for k in (1, 0)]
        bcs = clamp(V, s.tag("base", 0, at(g - 1, -1.0))) + clamp(V, s.tag("lid", 1, at(g - 1, 1.0)), g - 1, value=-0.01)
        bcs += [bc for c in range(g - 1) for bc in clamp(V, s.tag("lid", 1, at(g - 1, 1.0)), c)]
        contact = uem.Contact(*sides, coupling="mortar")
        run(uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], rtol=1e-11))
        forces.append(contact.resultant().force)
    assert np.abs(forces[0] - forces[1]).max() < 1e-7 * forces[0][-1]
