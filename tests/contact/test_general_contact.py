"""All surfaces against each other by one declaration: as hand-declared pairs, stacks and corners of many bodies, their warnings.

Three tests to read first: ``test_as_declared_by_hand``, ``test_discs_in_motion`` and ``test_uniform_strain_in_a_grid``.
"""

from __future__ import annotations

from collections import Counter

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.scenes import scene as create_scene
from body_scenes import Bodies, Discs, ball, close, dimension, grid, oedometer, surface_of
from dolfinx import fem
from helpers import M, at, blocks, box, clamp, highest, linear, modulus, run, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.contact.friction.sliding import Sliding

COMM = MPI.COMM_WORLD


# -- as declared by hand -----------------------------------------------------------------------------------------------------

BLOCKS = [("quadrilateral", 4, 6), ("triangle", 4, 6), ("quadrilateral", 4, 4), ("tetrahedron", 2, 3), ("hexahedron", 2, 3)]


# with friction neither converges on quadratic tetrahedra
LIKE_BY_HAND = [
    (slow if degree == 2 else pytest.param)(*block, degree, mu)
    for block in BLOCKS
    for degree in (1, 2)
    for mu in (0.0, 0.3)
    if (block[0], degree, mu) != ("tetrahedron", 2, 0.3)
]


@pytest.mark.parametrize("cell,n_low,n_high,degree,mu", LIKE_BY_HAND)
def test_as_declared_by_hand(cell, n_low, n_high, degree, mu):
    """A block pushed down and sideways on a wider one: forces, states and displacements."""
    b = blocks(COMM, cell, n_low, n_high, overhang=0.25, degree=degree)
    g, found = b.gdim, []
    way = [0.02, *[0.0] * (g - 2), -0.05]
    for contact in (uem.GeneralContact(order=[b.high], friction=mu), uem.Contact(b.high, b.low, friction=mu)):
        u = fem.Function(b.V)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=way)]
        problem = uem.UnitedProblem(linear(u, modulus(b.scene, 1.0, 2.0)), u, bcs=bcs, contacts=[contact], rtol=1e-12)
        histories = [len(problem.solve()) for _ in range(2)]
        assert contact.n_active == sum(part.n_active for part in problem.contacts)
        found.append((u, contact, histories, problem.reaction(b.top)))
    (u, general, n, there), (v, declared, m, back) = found
    close(u, v)
    assert general.n_active == declared.n_active > 2 and n[1] == m[1] == 1
    assert np.abs(there - back).max() < 1e-12
    assert general.max_gap() <= 1e-12
    close(general.force, declared.force)
    # at the rim of what is declared by hand less of the surface belongs to a node than of the whole
    assert 0.0 < general.max_pressure() <= declared.max_pressure() * (1 + 1e-10)
    for about in (None, np.linspace(0.3, 0.6, g)):
        one, other = general.between("body 2", "body 1", about), declared.resultant(about=about)
        assert np.abs(one.force - other.force).max() < 1e-12 and np.abs(one.moment - other.moment).max() < 1e-12


@pytest.mark.parametrize("cell,n", [("quadrilateral", 8), ("triangle", 8), ("tetrahedron", 4), ("hexahedron", 4)])
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_a_small_block_on_a_large_one(cell, n, mu):
    """Equally fine, in either order of the input: no equation follows another, rows of P have one block and those of a facet's nodes,
    and forces and displacements are alike."""
    g, found = dimension(cell), []
    parts = [box(cell, [0.0] * g, [1.0] * (g - 1) + [0.5], [n] * (g - 1) + [n // 2])]
    parts.append(box(cell, [0.11, 0.09][: g - 1] + [0.5], [0.91, 0.89][: g - 1] + [1.0], [n] * (g - 1) + [n // 2]))
    on_facet = {"quadrilateral": 2, "triangle": 2, "tetrahedron": 3, "hexahedron": 4}[cell]
    for low in (0, 1):
        b = Bodies(cell, parts if low == 0 else parts[::-1])
        bottom, top = b.side(low, g - 1, 0.0), b.side(1 - low, g - 1, 1.0)
        bcs = [*clamp(b.V, bottom), *clamp(b.V, top, value=[0.005, *[0.0] * (g - 2), -0.03])]
        problem = b.problem([uem.GeneralContact(friction=mu)], bcs)
        problem.solve()
        r = problem.system.restriction()
        rows = r.rows()
        assert r.chain == 1 and r.rings is None and r.n_equations > n ** (g - 1)
        blocks_of_row = np.unique(rows.row, return_counts=True)[1]
        assert highest(COMM, blocks_of_row) <= on_facet + 1
        drawn, u = b.s.drawing, b.s.gather(b.u)
        found.append((u[np.lexsort(np.round(drawn, 9).T)], problem.reaction(top)))
    (u, force), (v, other) = found
    assert np.abs(u - v).max() < 1e-10 and np.abs(force - other).max() < 1e-10 * np.abs(force).max()


@pytest.mark.long
@pytest.mark.parametrize("rows,columns,end", [(2, 1, 0.12), slow(3, 2, 0.6)])
def test_discs_in_motion(rows, columns, end):
    """Every step, iteration and displacement is that of pairs declared by hand."""
    Discs(rows, columns).move_alike(end)


def test_lists_with_nothing_on_them_cost_nothing(monkeypatch):
    """Two discs and a floor meet each other one by one: of a node's three lists two stay empty, and ask friction once a step."""
    discs, placed = Discs(2, 1), Counter()
    problem = discs.problem(discs.contacts(True))
    place = Sliding.place
    monkeypatch.setattr(Sliding, "place", lambda self, *args: (placed.update([id(self)]), place(self, *args)))
    steps = sum(1 for _ in uem.time_steps(problem, 0.01, 0.12))
    first, *others = (pair for pair in problem.pairs if hasattr(pair.target, "neighbours"))
    assert [placed[id(pair.friction)] for pair in others] == [steps] * len(others)
    assert placed[id(first.friction)] >= 3 * steps


# -- closed forms ----------------------------------------------------------------------------------------------------------


GRIDS = [
    ("quadrilateral", (2, 2), (1, 2, 4, 2)), ("triangle", (2, 2), (2, 2)), ("quadrilateral", (3, 2), (2,)),
    ("hexahedron", (2, 1, 2), (1, 2, 2, 1)), ("tetrahedron", (1, 1, 2), (1, 2)), ("hexahedron", (2, 2, 2), (1,)),
    ("triangle", (1, 4), (2, 4)), ("quadrilateral", (1, 4), (4, 1, 2, 2)), ("hexahedron", (1, 1, 3), (2, 1)),
]  # fmt: skip


def pressures_by_axis(contact, g):
    """Pressures along each axis of nodes that touch along it, the sum over the bodies that a node touches so, and the axes (collective)."""
    reported = []
    for part in contact.parts:
        pair = part.pair
        on, pressures = pair.trial.active, part.pressures
        axis = np.abs(pair.kinematics.projection.normal[on]).argmax(axis=1)
        reported.append(np.column_stack([pair.config.to_global(pair.nodes[on]) * g + axis, pressures[on]]))
    reported = np.concatenate(COMM.allgather(np.concatenate(reported)))
    key, which = np.unique(reported[:, 0], return_inverse=True)
    return key % g, np.bincount(which, reported[:, 1])


@pytest.mark.parametrize("cell,counts,n", GRIDS, ids=str)
@pytest.mark.parametrize("shuffle", [None, 5])
def test_uniform_strain_in_a_grid(cell, counts, n, shuffle):
    """Blocks one on another and side by side, nested meshes: one strain in all of them, through sides, edges and points where they meet."""
    b, places = grid(cell, n, counts, shuffle=shuffle)
    strain = 0.01
    contact = uem.GeneralContact()
    problem = b.problem([contact], oedometer(b, places, counts, strain * counts[-1]), rtol=1e-12)
    run(problem)
    x, u = problem.config.X, problem.config.displacement
    exact = np.zeros_like(x)
    exact[:, -1] = -strain * x[:, -1]
    assert highest(COMM, np.abs(u - exact)) < 1e-12
    column = int(np.prod(counts[:-1]))
    if column == 1:
        # where four blocks meet, forces between these are not unique
        axis, pressures = pressures_by_axis(contact, b.g)
        assert np.abs(pressures / (strain * np.where(axis == b.g - 1, M, M * 0.3 / 0.7)) - 1.0).max() < 1e-9
    names = [f"body {k + 1}" for k in range(len(places))]
    if shuffle is None and column == 1:
        for low, high in zip(names, names[1:]):
            assert contact.between(high, low).force[-1] == pytest.approx(M * strain, rel=1e-10)
            assert contact.between(low, high).force[-1] == pytest.approx(-M * strain, rel=1e-10)
        assert [(t.first, t.second) for t in contact.touching()] == list(zip(names, names[1:]))
    if column > 1:
        total = sum(contact.between(name).force for name in names)
        assert np.abs(total).max() < 1e-13


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_a_block_in_a_corner_of_two_bodies(cell):
    """Pressed into the corner between a floor and a wall it hands each its own traction; nodes in the corner touch both."""
    g = dimension(cell)
    deep = [0.0] * (g - 2), [1.0] * (g - 2), [2] * (g - 2)
    floor = box(cell, [-1.5, *deep[0], -1.0], [1.5, *deep[1], 0.0], [6, *deep[2], 2])
    wall = box(cell, [-1.5, *deep[0], 0.0], [0.0, *deep[1], 1.5], [3, *deep[2], 3])
    block = box(cell, [0.0, *deep[0], 0.0], [1.0, *deep[1], 1.0], [4, *deep[2], 4])
    b = Bodies(cell, [floor, wall, block])
    bcs = [*clamp(b.V, b.side(0, g - 1, -1.0)), *clamp(b.V, b.side(1, 0, -1.5))]
    if g == 3:
        bcs += clamp(b.V, b.side(2, 1, 0.0), 1)
    px, pz = 0.003, 0.005
    b.push(b.side(2, 0, 1.0), [-px, *[0.0] * (g - 2), 0.0])
    b.push(b.side(2, g - 1, 1.0), [0.0, *[0.0] * (g - 2), -pz])
    bodies = {"floor": b.side(0, g - 1, -1.0), "wall": b.side(1, 0, -1.5), "block": b.side(2, 0, 1.0)}
    contact = uem.GeneralContact(order=[bodies["block"]], bodies=bodies, exclude=[(surface_of(b.s, 0), surface_of(b.s, 1))])
    problem = b.problem([contact], bcs)
    run(problem)
    assert [(t.first, t.second) for t in contact.touching()] == [("floor", "block"), ("wall", "block")]
    floor, wall = (contact.between("block", name).force for name in ("floor", "wall"))
    # contact normals turn with what they lie on, by as much as that strains
    assert floor[-1] + wall[-1] == pytest.approx(pz, rel=1e-9) and floor[0] + wall[0] == pytest.approx(px, rel=1e-9)
    assert floor[-1] == pytest.approx(pz, rel=0.02) and wall[0] == pytest.approx(px, rel=0.02)
    assert np.abs(contact.between("block").force - floor - wall).max() < 1e-15
    active = [part.pair.config.to_global(part.pair.nodes[part.pair.trial.active]) for part in problem.contacts]
    active = np.concatenate(COMM.allgather(np.concatenate(active)))
    assert contact.n_active == sum(t.n_active for t in contact.touching()) == len(active) >= len(np.unique(active))


def test_a_node_on_a_joint():
    """It lies on both blocks below, and is held once: a block that presses evenly stays flat, and no force is counted twice."""
    below = [box("quadrilateral", [x, -1.0], [x + 1.0, 0.0], [2, 2]) for x in (-1.0, 0.0)]
    b = Bodies("quadrilateral", [*below, box("quadrilateral", [-0.5, 0.0], [0.5, 1.0], [2, 4])], nu=0.0)
    top = b.side(2, 1, 1.0)
    bcs = [bc for k in (0, 1) for bc in clamp(b.V, b.side(k, 1, -1.0))]
    b.push(top, [0.0, -0.01])
    contact = uem.GeneralContact(exclude=[(surface_of(b.s, 0), surface_of(b.s, 1))])
    problem = b.problem([contact], [*bcs, *clamp(b.V, top, 0)])
    run(problem)
    left, right = contact.between("body 3", "body 1"), contact.between("body 3", "body 2")
    assert left.force[1] + right.force[1] == pytest.approx(0.01, rel=1e-10)
    assert contact.between("body 3").force[1] == pytest.approx(0.01, rel=1e-10)
    # the joint's node may be held by either, so that only both together are symmetric
    assert contact.between("body 3").moment == pytest.approx(0.0, abs=1e-5)
    u = problem.config.displacement[np.abs(problem.config.X[:, 1] - 1.0) < 1e-9, 1]
    assert highest(COMM, u) < 0


@pytest.mark.parametrize("mu", [0.0, 0.2])
def test_a_joint_with_a_step(mu):
    """A block on two others of which one is higher: corners and nodes that hold each other by rows which nearly say the same."""
    bodies = [box("triangle", [-1.01, -1.0], [-0.01, 0.0], [3, 3]), box("triangle", [0.0, -1.0], [1.0, 0.01], [2, 2])]
    b = Bodies("triangle", [*bodies, box("triangle", [-0.6, 0.02], [0.5, 0.8], [6, 4])])
    bcs = [*clamp(b.V, b.side(0, 1, -1.0)), *clamp(b.V, b.side(1, 1, -1.0)), *clamp(b.V, b.side(2, 1, 0.8), value=[0.03, -0.1])]
    contact = uem.GeneralContact(friction=mu)
    problem = b.problem([contact], bcs)
    run(problem, 2)
    left, right = contact.between("body 3", "body 1").force, contact.between("body 3", "body 2").force
    assert left[1] > 0 and right[1] > 0
    assert left + right == pytest.approx(-problem.reaction(b.side(2, 1, 0.8)), rel=1e-8)
    assert all(part.balance().force < 1e-13 for part in contact.parts)


# -- it does not matter how it is drawn --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "nodes_of", "tie_by", "coupling"),
    [
        ("tie", "upper", "node_to_surface", "node_to_surface"),
        ("tie", "lower", "mortar", "node_to_surface"),
        ("preload", "lower", "mortar", "node_to_surface"),
        ("tie", "upper", "mortar", "mortar"),
        ("preload", "lower", "node_to_surface", "mortar"),
    ],
)
def test_sections_that_are_tied(kind, nodes_of, tie_by, coupling):
    """Two loose plates on a base, tied or bolted over a section of their joint, whatever follows what; tied they are as one plate."""
    cell = "quadrilateral"
    base = box(cell, [-0.5, -1.0], [4.5, 0.0], [10, 1])
    plates = [box(cell, [0.0, 0.5 * k], [4.0, 0.5 * k + 0.5], [8, 1]) for k in (0, 1)]
    found = []
    for parts in (plates, [box(cell, [0.0, 0.0], [4.0, 1.0], [8, 2])]):
        s = create_scene(COMM, cell, [*parts, base])
        V = compat.function_space(s.mesh, 1, (2,))
        u, v, n = fem.Function(V, name="u"), ufl.TestFunction(V), len(parts)
        bottom = s.tag("bottom", n, at(1, -1.0))
        push = forms.surface_measure(s.mesh, s.tag("top", n - 1, at(1, 1.0)).entities)
        contacts = [general := uem.GeneralContact(friction=0.8, coupling=coupling)]
        if n == 2:
            section = [
                s.tag(f"section {k}", k, lambda x: (abs(x[:, 1] - 0.5) < 1e-9) & (abs(x[:, 0] - 2.0) < 0.6)) for k in (1, 0)
            ]
            section = section if nodes_of == "upper" else section[::-1]
            joint = uem.Contact(*section, tied=True, coupling=tie_by)
            if kind == "preload":
                joint = uem.Preload(*section, force=0.002, coupling=tie_by)
            contacts.append(joint)
        F = linear(u, 1.0) - (0.0005 * v[0] - 0.005 * v[1]) * push
        problem = uem.UnitedProblem(F, u, bcs=clamp(V, bottom), contacts=contacts, rtol=1e-11)
        run(problem)
        assert np.allclose(problem.reaction(bottom), (-0.002, 0.02), rtol=1e-9)
        top = np.isclose(s.drawing[:, 1], 1.0)
        found.append(s.gather(u)[top][np.argsort(s.drawing[top, 0])])
        if n == 2 and coupling == "node_to_surface":
            # nodes at the border of the section are tied, too
            own = [part.pair.trial.active[np.isin(part.pair.nodes, joint.nodes)].sum() for part in general.parts]
            assert COMM.allreduce(int(sum(own))) == 0
    if kind == "tie":
        assert np.abs(found[0] - found[1]).max() <= 1e-9 * np.abs(found[1]).max()


def heap(order=(0, 1, 2), *, turn=0.0, length=1.0, stress=1.0, mu=0.0, comm=COMM, **how):
    """Three discs of different facets pressed against each other, in any order: answers in the drawing's frame."""
    middles = np.array([[0.0, 0.0], [0.965, 0.0], [0.48, 0.86]])
    bodies = [ball("triangle", m, 0.5, n) for m, n in zip(middles, (3, 5, 8))]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    b = Bodies(
        "triangle", [bodies[k] for k in order], E=[stress * (1.0 + k) for k in order], comm=comm, law=st_venant,
        pose=lambda x: length * x @ R.T, **how,
    )  # fmt: skip
    names, parts, bcs = ("left", "right", "top"), {}, []
    for k, name in enumerate(names):
        parts[name] = surface_of(b.s, order.index(k))
        middle, way = length * R @ middles[k], length * R @ [0.03, -0.06] * (k == 2)
        core = fem.locate_dofs_geometrical(b.V, lambda x, m=middle: np.hypot(x[0] - m[0], x[1] - m[1]) < 0.2 * length)
        bcs.append(fem.dirichletbc(way, core, b.V))
    contact = uem.GeneralContact(bodies=parts, friction=mu)
    problem = b.problem([contact], bcs, rtol=1e-10)
    steps = run(problem, 2)
    drawn, u = b.s.drawing, b.s.gather(b.u) @ R / length
    sort = np.lexsort(np.round(drawn, 9).T)
    pairs = [("top", "left"), ("top", "right"), ("left", "right")]
    return {
        "X": drawn[sort], "u": u[sort], "iterations": [s.newton_iterations for s in steps],
        "touching": sorted((*sorted((t.first, t.second)), t.n_active) for t in contact.touching()),
        "forces": np.array([contact.between(*names).force @ R for names in pairs]) / (stress * length),
    }  # fmt: skip


def same(a, b, tol=1e-9):
    assert np.allclose(a["X"], b["X"], atol=1e-12) and a["touching"] == b["touching"]
    assert np.abs(a["u"] - b["u"]).max() < tol and np.abs(a["forces"] - b["forces"]).max() < tol


@pytest.fixture(scope="module", params=[0.0, 0.2], ids=["smooth", "rough"])
def reference(request):
    """The answer as it is drawn."""
    found = heap(mu=request.param)
    assert len(found["touching"]) == 3 and found["forces"][:2, 1].min() > 1e-3 and found["forces"][2, 0] < -1e-4
    return request.param, found


@pytest.mark.parametrize("order", [(2, 0, 1), (1, 2, 0), (2, 1, 0)])
def test_order_of_input(reference, order):
    """The finer body is the contactor, in both orders."""
    same(heap(order, mu=reference[0]), reference[1])


@pytest.mark.parametrize("turn", [0.4, np.pi / 2, -2.0])
def test_pose(reference, turn):
    same(heap(turn=turn, mu=reference[0]), reference[1])


@pytest.mark.parametrize("length,stress", [(1e-9, 2.1e11), (1e3, 1e-3)])
def test_units(reference, length, stress):
    scaled = heap(length=length, stress=stress, mu=reference[0])
    same(scaled, reference[1])
    assert scaled["iterations"] == reference[1]["iterations"]


@pytest.mark.parametrize("seed", [1, 2])
def test_numbering(reference, seed):
    same(heap(shuffle=seed, mu=reference[0]), reference[1])


def test_ranks(reference):
    """All ranks together find what each finds alone."""
    same(heap(comm=MPI.COMM_SELF, mu=reference[0]), reference[1])
