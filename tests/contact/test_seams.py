"""Contact across the seam of a periodic body, against the same scene with the seam elsewhere.

Read first: ``test_where_the_seam_is``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields
from helpers import at, blocks, box, clamp, linear, run, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.conditions.equation import GivenRows
from uem_dolfinx.conditions.seams import Seams
from uem_dolfinx.geometry.configuration import configuration_of

COMM = MPI.COMM_WORLD
PERIOD, HEIGHT, DEPTH, CREST = 2.0, 1.0, 0.012, 0.3


def wave(x):
    """Height of a wave, periodic in all horizontal directions x ``(k, n)``."""
    return sum(0.02 * (1 - np.cos(np.pi * (y - CREST))) + 0.004 * np.sin(2 * np.pi * (y - CREST)) for y in x)


def rigid_wave(g, along):
    """The wave along some directions as a rigid surface."""

    def slopes(x):
        out = np.zeros((g, x.shape[1]))
        for i in along:
            y = np.pi * (x[i] - CREST)
            out[i] = 0.02 * np.pi * np.sin(y) + 0.008 * np.pi * np.cos(2 * y)
        out[g - 1] = -1.0
        return out

    return uem.RigidSurface(lambda x: HEIGHT + wave([x[i] for i in along]) - x[g - 1], slopes)


def pulled(x):
    """A periodic displacement along the first direction, none at multiples of a half, next to which facets get other sizes."""
    return np.eye(x.shape[1])[0] * np.sin(2 * np.pi * x[:, :1]) ** 2


def everywhere(values):
    return np.concatenate(COMM.allgather(values))


def slab(start, n, coupling="mortar", target="rigid", degree=1, cell="quadrilateral", steps=2, drag=0.0, graded=0.0, **how):
    """A periodic slab between ``start`` and a period further, under a wave that moves down and by ``drag`` sideways.

    The wave is a rigid surface, or a mesh that moves as prescribed and overhangs the slab at all sides.

    Returns:
        Places of contactors within one period, and there pressures, friction, slip and status; then sums; then iterations.
    """
    g, start = len(start) + 1, np.array(start)
    bodies = [box(cell, [*start, 0.0], [*(start + PERIOD), HEIGHT], n).mapped(lambda x: x + graded * pulled(x))]
    if target == "mesh":
        bodies.append(box(cell, [*(start - 0.5), HEIGHT], [*(start + PERIOD + 0.5), 1.2 * HEIGHT], [18] * (g - 1) + [1]))
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)
    sides = [[s.tag(f"{i}{k}", 0, at(i, start[i] + k * PERIOD)) for k in (1, 0)] for i in range(g - 1)]
    top, bcs = s.tag("top", 0, at(g - 1, HEIGHT)), clamp(V, s.tag("bottom", 0, at(g - 1, 0.0)))
    if target == "mesh":
        goes = fem.Function(V)
        goes.interpolate(lambda x: np.stack([drag + 0 * x[0], *(0 * x[1 : g - 1]), wave(x[: g - 1]) - DEPTH]))
        every = s.mesh.topology.index_map(g)
        cells = np.flatnonzero(s.body[: every.size_local + every.num_ghosts] == 1).astype(np.int32)
        bcs.append(fem.dirichletbc(goes, fem.locate_dofs_topological(V, g, cells)))
        surface, load = s.tag("wave", 1, at(g - 1, HEIGHT)), None
    else:
        surface = rigid_wave(g, range(g - 1))

        def load(f):
            surface.move((drag * f, *[0.0] * (g - 2), -DEPTH * f))

    contact = uem.Contact(top, surface, coupling=coupling, **how)
    problem = uem.UnitedProblem(
        linear(u, 1000.0), u, bcs=bcs, contacts=[contact], equations=[uem.periodic(*pair) for pair in sides], rtol=1e-11,
        **({} if load is None else {"load": load}),
    )  # fmt: skip
    iterations = [len(step.iterations) for step in run(problem, steps)]
    nodes = contact.nodes

    def nodal(f):
        return np.linalg.norm(f.x.array.reshape(-1, g)[nodes], axis=1)

    X = np.round(np.mod(V.tabulate_dof_coordinates()[nodes, : g - 1], PERIOD), 6) % PERIOD
    density = contact.pressure_to_integrate()
    here = [
        X,
        contact.pressures,
        density.x.array[nodes],
        nodal(contact.traction),
        nodal(contact.slip),
        contact.status.x.array[nodes],
    ]
    table = everywhere(np.column_stack(here))
    table = table[np.lexsort(table.T[: g - 1])]
    twice = np.flatnonzero((np.diff(table[:, : g - 1], axis=0) == 0).all(axis=1))
    assert len(twice)
    if coupling == "mortar":
        assert table[twice, g - 1 :] == pytest.approx(table[twice + 1, g - 1 :], abs=1e-11)
    whole = contact.resultant()
    integral = uem.integrate(density * uem.ds(top))
    assert integral == pytest.approx(whole.normal, rel=1e-12)
    sums = [*whole.force, whole.normal, contact.max_pressure(), contact.dissipation]
    return np.delete(table, twice, axis=0), sums, iterations


def alike(found, other, tolerance=1e-9):
    """Whether two slabs have the same contact."""
    (table, sums, iterations), (more, others, again) = found, other
    # the last residual is near the tolerance in some
    assert iterations == pytest.approx(again, abs=1)
    assert np.array_equal(table[:, -1], more[:, -1])
    scale = np.abs(table).max(axis=0)
    assert table / np.where(scale > 0, scale, 1.0) == pytest.approx(more / np.where(scale > 0, scale, 1.0), abs=tolerance)
    assert sums == pytest.approx(others, abs=tolerance * max(map(abs, sums)))


FLAT = [16, 5]


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"degree": 2},
        {"friction": 0.3, "drag": 0.004},
        slow({"friction": 0.3, "drag": 0.004, "degree": 2, "cell": "triangle", "measure": "current"}),
        {"friction": 0.3, "drag": 0.004, "sliding": "small"},
        {"sliding": "fixed", "degree": 2, "offset": 0.003},
        {"target": "mesh"},
        {"target": "mesh", "degree": 2, "friction": 0.3, "drag": 0.02},
        slow({"target": "mesh", "friction": 0.3, "drag": 0.02, "cell": "triangle", "offset": 0.003}),
        {"target": "mesh", "sliding": "small", "friction": 0.3, "drag": 0.004},
        {"target": "mesh", "sliding": "fixed", "degree": 2},
        {"target": "mesh", "tied": True, "degree": 2},
        {"target": "mesh", "tied": True, "drag": 0.02, "sliding": "small"},
        {"coupling": "node_to_surface", "friction": 0.3, "drag": 0.004},
        {"coupling": "node_to_surface", "degree": 2},
        {"graded": 0.05, "friction": 0.3, "drag": 0.004},
        {"graded": 0.05, "degree": 2, "target": "mesh"},
        {"graded": 0.05, "tied": True, "target": "mesh"},
        {"graded": 0.05, "coupling": "node_to_surface", "measure": "current"},
        {"graded": 0.05, "coupling": "node_to_surface", "degree": 2},
    ],
    ids=str,
)
def test_where_the_seam_is(how):
    """Pressures, friction, slip, status, force and iterations do not depend on where a body is cut."""
    first = slab([0.0], FLAT, **how)
    assert np.count_nonzero(first[0][:, 1]) > 3
    for start in (-0.5, 1.0):
        alike(first, slab([start], FLAT, **how))


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [
        slow({"cell": "hexahedron", "friction": 0.3, "drag": 0.004}),
        {"cell": "tetrahedron"},
        slow({"cell": "hexahedron", "degree": 2}),
        slow({"cell": "tetrahedron", "degree": 2, "friction": 0.3, "drag": 0.004}),
        slow({"cell": "hexahedron", "target": "mesh", "friction": 0.3, "drag": 0.004}),
    ],
    ids=str,
)
def test_two_seams(how):
    """A slab that is periodic in two directions: at its corner four contactors have one displacement."""
    n = [8, 8, 2]
    first = slab([0.0, 0.0], n, steps=1, **how)
    for start in ([-0.5, 0.0], [0.5, 1.0]):
        alike(first, slab(start, n, steps=1, **how), 1e-8)


@pytest.mark.parametrize("degree, friction", [(1, 0.0), (2, 0.0), (1, 0.3)])
def test_one_facet_across(degree, friction):
    """A slice with one facet from seam to seam, all of whose contactors have another, has the contact of a plane body."""
    how = {"degree": degree, "friction": friction, "drag": 0.004 if friction else 0.0, "steps": 1}
    s = scene(COMM, "hexahedron", [box("hexahedron", [0.0, 0.0, 0.0], [PERIOD, 0.25, HEIGHT], [16, 1, 5])])
    V = compat.function_space(s.mesh, degree, (3,))
    u = fem.Function(V)
    surface = rigid_wave(3, [0])
    contact = uem.Contact(s.tag("top", 0, at(2, HEIGHT)), surface, coupling="mortar", friction=friction)
    tags = [(s.tag(f"{i}1", 0, at(i, end)), s.tag(f"{i}0", 0, at(i, 0.0))) for i, end in ((0, PERIOD), (1, 0.25))]
    problem = uem.UnitedProblem(
        linear(u, 1000.0), u, bcs=clamp(V, s.tag("bottom", 0, at(2, 0.0))), contacts=[contact], rtol=1e-11,
        equations=[uem.periodic(*pair) for pair in tags],
        load=lambda f: surface.move((how["drag"] * f, 0.0, -DEPTH * f)),
    )  # fmt: skip
    run(problem)
    plane = slab([0.0], FLAT, **how)
    force = contact.resultant().force
    # quadratic quadrilaterals have the middle nodes of the plane's facets and their neighbours
    assert force == pytest.approx(0.25 * np.array([plane[1][0], 0.0, plane[1][1]]), abs=1e-9)
    assert contact.max_pressure() == pytest.approx(plane[1][3], rel=1e-9)


@pytest.mark.parametrize("degree, sliding", [(1, "finite"), (2, "finite"), (1, "small")])
def test_jumps(degree, sliding):
    """A slab under a plane, stretched by a jump that follows the load, has Hooke's pressure and no error at its seam."""
    E, nu, stretch, crushed = 1000.0, 0.3, 0.004, 0.002
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [PERIOD, HEIGHT], FLAT)])
    V = compat.function_space(s.mesh, degree, (2,))
    u, W = fem.Function(V), V.sub(0).collapse()[0]
    plane = uem.RigidSurface(lambda x: HEIGHT - x[1], lambda x: np.stack([0 * x[0], 0 * x[0] - 1.0]))
    contact = uem.Contact(s.tag("top", 0, at(1, HEIGHT)), plane, coupling="mortar", sliding=sliding)
    right, left = (s.tag(name, 0, at(0, x)) for name, x in (("right", PERIOD), ("left", 0.0)))
    corner = fem.locate_dofs_geometrical((V.sub(0), W), lambda x: np.isclose(x[0], 1.5) & np.isclose(x[1], 0.0))
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, 0.0)), 1), fem.dirichletbc(fem.Function(W), corner, V.sub(0))]
    problem = uem.UnitedProblem(
        linear(u, E, nu), u, bcs=bcs, contacts=[contact], rtol=1e-11, load=lambda f: plane.move((0.0, -crushed * HEIGHT * f)),
        equations=[uem.periodic(right, left, jump=lambda f: (stretch * PERIOD * f, 0.0))],
    )  # fmt: skip
    run(problem, 2)
    lam, mu = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu)
    pressure = (lam + 2 * mu) * crushed - lam * stretch
    assert contact.pressures == pytest.approx(np.full(len(contact.nodes), pressure), rel=1e-9)
    assert contact.resultant().force == pytest.approx([0.0, -pressure * PERIOD], abs=1e-9 * pressure)


@pytest.mark.parametrize("degree, friction", [(1, 0.0), (2, 0.3)])
@pytest.mark.parametrize("coupling", ["mortar", "general"])
def test_seams_of_both_bodies(coupling, degree, friction):
    """Two periodic bodies with non-matching meshes, pressed together most at their seams, or midway."""
    found = []
    for start in (CREST, CREST - 0.5 * PERIOD):
        end = start + PERIOD
        bodies = [box("quadrilateral", [start, k * HEIGHT], [end, (k + 1) * HEIGHT], [n, 4]) for k, n in enumerate((16, 12))]
        s = scene(COMM, "quadrilateral", bodies)
        V = compat.function_space(s.mesh, degree, (2,))
        u, goes = fem.Function(V), fem.Function(V)
        goes.interpolate(lambda x: np.stack([0 * x[0], -0.006 - 0.005 * np.cos(np.pi * (x[0] - CREST))]))
        top, upper, lower = s.tag("top", 1, at(1, 2 * HEIGHT)), s.tag("upper", 1, at(1, HEIGHT)), s.tag("lower", 0, at(1, HEIGHT))
        bcs = [*clamp(V, s.tag("bottom", 0, at(1, 0.0))), fem.dirichletbc(goes, fem.locate_dofs_topological(V, 1, top.entities))]
        if coupling == "general":
            contact = uem.GeneralContact(np.sort(np.append(upper.entities, lower.entities)), coupling="mortar", friction=friction)
        else:
            contact = uem.Contact(lower, upper, coupling="mortar", friction=friction)
        sides = [[s.tag(f"{k}{x}", k, at(0, x)) for x in (end, start)] for k in (0, 1)]
        problem = uem.UnitedProblem(
            linear(u, 1000.0), u, bcs=bcs, contacts=[contact], equations=[uem.periodic(*pair) for pair in sides], rtol=1e-11
        )
        run(problem)
        parts = problem.contacts
        nodes = np.concatenate([one.nodes for one in parts])
        X = np.round(np.mod(V.tabulate_dof_coordinates()[nodes, 0], PERIOD), 6) % PERIOD
        table = everywhere(np.column_stack([X, np.concatenate([one.pressures for one in parts])]))
        table = table[np.lexsort(table.T[::-1])]
        twice = np.flatnonzero(np.diff(table[:, 0]) == 0)
        assert table[twice] == pytest.approx(table[twice + 1], abs=1e-10)
        found.append((np.delete(table, twice, axis=0), sum(one.resultant().force for one in parts)))
    (table, force), (more, other) = found
    assert table == pytest.approx(more, abs=1e-8 * table.max())
    assert force == pytest.approx(other, abs=1e-9 * np.abs(force).max())


def pressed_layers(n, degree, push, coupling, shift=0.0):
    """Two layers with a seam, the upper one's at ``shift``, pressed together by ``push``: problem, contact, and its top."""
    at_ends = [(0.0, PERIOD), (shift, PERIOD + shift)]
    bodies = [box("quadrilateral", [at_ends[k][0], k - 1.0], [at_ends[k][1], k], [n[k], 2]) for k in (0, 1)]
    s = scene(COMM, "quadrilateral", bodies)
    V = compat.function_space(s.mesh, degree, (2,))
    u, top = fem.Function(V), s.tag("top", 1, at(1, 1.0))
    bcs = clamp(V, s.tag("bottom", 0, at(1, -1.0))) + clamp(V, top, value=[0.0, -push])
    contact = uem.Contact(s.tag("upper", 1, at(1, 0.0)), s.tag("lower", 0, at(1, 0.0)), coupling=coupling)
    seams = [uem.periodic(*(s.tag(f"{k}{x}", k, at(0, x)) for x in at_ends[k][::-1])) for k in (0, 1)]
    return uem.UnitedProblem(linear(u, 10.0), u, bcs=bcs, contacts=[contact], equations=seams, rtol=1e-11), contact, top


@pytest.mark.parametrize("coupling", ["mortar", slow("node_to_surface")])
@pytest.mark.parametrize("shift, warnings", [(0.37, 1), (-0.37, 1), (0.01, 0), (0.0, 0)])
def test_contactors_past_the_seam_of_their_target(shift, warnings, coupling, caplog):
    """Where contactors start past the end that a periodic target has at its seam, a warning says that contact is missing."""
    pressed_layers((6, 5), 1, 0.005, coupling, shift)
    assert COMM.bcast(sum("the seam of a periodic body" in r.getMessage() for r in caplog.records)) == warnings


@pytest.mark.parametrize(
    "n, degree, push",
    [((6, 5), 1, 0.05), ((6, 5), 1, 0.005), *(slow((6, 5), 1, push) for push in (0.02, 1e-3, 1e-4)), slow((4, 9), 1, 0.05)]
    + [slow((5, 6), 1, 0.05), slow((6, 5), 2, 0.05), slow((5, 6), 2, 0.05)],
)
def test_nodes_of_both_bodies(n, degree, push):
    """Where both bodies have a seam, and meshes do not match, equations of nodes depend on each other but for the strain."""
    found = []
    for coupling in ("node_to_surface", "mortar"):
        problem, contact, top = pressed_layers(n, degree, push, coupling)
        (step,) = run(problem)
        assert len(step.iterations) - 1 <= 4
        found.append(contact.resultant().force)
        assert found[-1] == pytest.approx(-problem.reaction(top), abs=1e-8)
    assert found[0] == pytest.approx(found[1], abs=0.01 * found[1][1])


@pytest.mark.parametrize("degree, h", [(1, 5.0), (2, 5.0), (1, lambda p, g: 0.01 * p), (1, np.inf)])
def test_heat_across_a_seam(degree, h):
    """Blocks that are periodic and insulated at their sides conduct and press as in one dimension, on both sides of the seam."""
    b = blocks(COMM, "triangle", 3, 4, degree=degree)
    f = fields(b, degree, degree)
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    E, nu = 1e3, 0.3
    strain = ufl.sym(ufl.grad(u))
    stress = E / (1 + nu) * (strain + nu / (1 - 2 * nu) * ufl.tr(strain) * ufl.Identity(2))
    F = ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx + ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx
    ends = [uem.dirichlet(f.other, b.bottom, value=0.0), uem.dirichlet(f.other, b.top, value=10.0)]
    moves = [(b.bottom, 0, 0.0), (b.bottom, 1, 0.0), (b.top, 0, 0.0), (b.top, 1, -0.02)]
    bcs = [*(uem.dirichlet(f.space, *one) for one in moves), *ends]
    sides = [[b.scene.tag(f"{body}{x}", body, at(0, x)) for x in (1.0, 0.0)] for body in (0, 1)]
    contact = uem.Contact(b.high, b.low, coupling="mortar", heat=uem.Conductance(h, field=1))
    problem = uem.UnitedProblem(
        F, f.w, displacement=0, bcs=bcs, contacts=[contact], equations=[uem.periodic(*pair) for pair in sides], rtol=1e-11
    )
    run(problem)
    pressure = E * (1 - nu) / (1 + nu) / (1 - 2 * nu) * 0.01
    assert contact.pressures == pytest.approx(np.full(len(contact.nodes), pressure), rel=1e-9)
    across = 0.01 * pressure if callable(h) else h
    flux = 10.0 / (2.0 + 1.0 / across)
    assert contact.heat_flux.x.array[contact.nodes] == pytest.approx(np.full(len(contact.nodes), flux), rel=1e-9)
    assert contact.heat_power == pytest.approx(flux, rel=1e-9)


# -- which nodes are one --------------------------------------------------------------------------------------------------

X, Y = (1.0, 0.0), (0.0, 1.0)


def tie(a, b, c):
    """The equation ``c . (u_a - u_b) = 0``."""
    return [(a, np.array(c)), (b, -np.array(c))]


def united(rows):
    """Groups of nodes 2, 5 and 7 that equations, each a list of a node and its coefficients, give one displacement."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [3, 3])])
    config = configuration_of(compat.function_space(s.mesh, 1, (2,)))
    # each rank has some
    mine = rows[COMM.rank :: COMM.size]
    row, value = np.repeat(np.arange(len(mine)), [len(one) for one in mine]).astype(np.int64), np.zeros(len(mine), np.int64)
    node = np.array([node for one in mine for node, _ in one], dtype=np.int64)
    c = np.array([c for one in mine for _, c in one], dtype=float).reshape(-1, 2)
    seams = Seams([GivenRows(value, row, node, c)])
    nodes = np.array([2, 5, 7]) - config.first
    known, group = seams.groups(config, nodes[(nodes >= 0) & (nodes < config.n_owned)])
    others = COMM.allreduce(sum(len(np.unique(row)) for row, _ in seams.others(known, group)))
    return {frozenset(known[group == k].tolist()) for k in np.unique(group)}, others


@pytest.mark.parametrize(
    "rows, groups, others",
    [
        ([], [], 0),
        ([tie(3, 7, X), tie(7, 3, Y)], [{3, 7}], 0),
        ([tie(3, 7, X), tie(3, 7, Y), tie(7, 2, X), tie(7, 2, Y), tie(0, 1, X), tie(0, 1, Y)], [{2, 3, 7}], 2),
        # a group that continues in other nodes
        (sum(([tie(a, b, X), tie(a, b, Y)] for a, b in ((2, 0), (3, 1), (1, 4), (4, 7), (0, 3))), []), [{0, 1, 2, 3, 4, 7}], 0),
        # a component alone, a rotation, the opposite, a multiple, a mean
        ([tie(3, 7, X)], [], 1),
        ([[(3, X), (7, Y)], [(3, Y), (7, (-1.0, 0.0))]], [], 2),
        ([[(3, X), (7, X)], [(3, Y), (7, Y)]], [], 2),
        ([[(3, (2.0, 0.0)), (7, (-1.0, 0.0))], tie(3, 7, Y)], [], 2),
        ([[(3, X), (7, (-0.5, 0.0)), (2, (-0.5, 0.0))], tie(3, 7, Y), tie(5, 6, X), tie(5, 6, Y)], [{5, 6}], 2),
        ([[(3, (5.0, 0.0)), (7, (-5.0, 0.0)), (2, (0.0, 0.0))], tie(3, 7, Y)], [{3, 7}], 0),
    ],
)
def test_what_equations_unite(rows, groups, others):
    """Nodes are one if equations make all of their components equal, up to a jump."""
    assert united(rows) == ({frozenset(one) for one in groups}, others)


# -- warnings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "coupling, turn, warns", [("mortar", False, False), ("mortar", True, True), ("node_to_surface", True, False)]
)
def test_what_is_warned_of(coupling, turn, warns, caplog):
    """Equations between contactors of a mortar contact that do not give them one displacement, as antiperiodic ones."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [PERIOD, HEIGHT], FLAT)])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    right, left = (s.tag(name, 0, at(0, x)) for name, x in (("right", PERIOD), ("left", 0.0)))
    how = {"turn": -np.eye(2), "map": lambda x: x - np.array([PERIOD, 0.0])} if turn else {}
    contact = uem.Contact(s.tag("top", 0, at(1, HEIGHT)), rigid_wave(2, [0]), coupling=coupling)
    uem.UnitedProblem(
        linear(u, 1000.0), u, bcs=clamp(V, s.tag("bottom", 0, at(1, 0.0))), contacts=[contact],
        equations=[uem.periodic(right, left, **how)],
    )  # fmt: skip
    words = "equations tie contactors between (0, 1) and (2, 1) to each other"
    assert COMM.bcast(any(words in r.getMessage() for r in caplog.records)) == warns
