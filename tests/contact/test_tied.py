"""Tied contacts: patch tests, one piece made of two meshes, turns without stress, tension, tangents, conditions, chains.

The tests to read first: ``test_patch`` (any stress passes through any pair of meshes with mortar) and ``test_turned_without_stress``.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import (
    CELLS,
    NU,
    at,
    blocks,
    box,
    clamp,
    factors,
    gathered_vector,
    highest,
    linear,
    lowest,
    modulus,
    raised,
    run,
    scene,
    slow,
    st_venant,
)

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.solve.bodies.tangent import curvature_of

COMM = MPI.COMM_WORLD
COUPLINGS = ("node_to_surface", "mortar")


def field(V, A):
    """The linear displacement ``A x``."""
    f, g = fem.Function(V), V.mesh.geometry.dim
    f.interpolate(lambda x: A @ x[:g])
    return f


def stress_of(A, E=1.0):
    """Stress of a linear displacement."""
    g = len(A)
    eps = 0.5 * (A + A.T)
    return E / (1 + NU) * (eps + NU / (1 - 2 * NU) * np.trace(eps) * np.eye(g))


def patch(b, A, contact, material=linear):
    """A constant stress on all outer sides of two blocks, whose bottom and top are led by ``A x``."""
    g, v, n = b.gdim, ufl.TestFunction(b.V), ufl.FacetNormal(b.scene.mesh)
    exact = field(b.V, A)
    F = material(b.u, modulus(b.scene, 1.0, 1.0))
    push = ufl.dot(ufl.as_matrix(stress_of(A).tolist()), n)
    for c in range(g - 1):
        for end in (0.0, 1.0):
            for body in (0, 1):
                F -= ufl.dot(push, v) * forms.surface_measure(b.scene.mesh, b.scene.tag("side", body, at(c, end)).entities)
    ends = [fem.dirichletbc(exact, fem.locate_dofs_topological(b.V, g - 1, tag.entities)) for tag in (b.bottom, b.top)]
    return uem.UnitedProblem(F, b.u, bcs=ends, contacts=[contact]), exact


def strain(g):
    return 1e-3 * np.array([[1.0, 2.0, 3.0], [0.5, -1.0, 2.0], [1.0, -1.5, 2.0]])[:g, :g]


PATCHES = [("mortar", (2, 3)), ("mortar", (3, 2)), ("node_to_surface", (2, 4))]


@pytest.mark.parametrize(
    "cell,degree,coupling,n",
    [("triangle", k, *p) for k, p in product((1, 2), PATCHES)]
    + [(cell, 1, *PATCHES[0]) for cell in CELLS[1:]]
    + [slow(cell, k, *p) for cell, k, p in product(CELLS[1:], (1, 2), PATCHES) if (k, p) != (1, PATCHES[0])],
)
def test_patch(cell, degree, coupling, n):
    """Any constant stress, tension and shear, passes: displacement and traction to 1e-11; nodes where meshes are nested."""
    if cell == "hexahedron" and degree == 2:
        n = (1, 2)
    b = blocks(COMM, cell, *n, degree=degree)
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True, sliding="fixed")
    A = strain(b.gdim)
    problem, exact = patch(b, A, contact)
    problem.solve()
    size = highest(COMM, np.abs(exact.x.array))
    assert highest(COMM, np.abs(b.u.x.array - exact.x.array)) < 1e-11 * size
    normal = np.zeros(b.gdim)
    normal[-1] = 1.0
    traction = contact.traction.x.array.reshape(-1, b.gdim)[contact.nodes] + contact.pressures[:, None] * normal
    assert highest(COMM, np.abs(traction + stress_of(A)[-1])[contact.measured_areas() > 0]) < 1e-11
    assert contact.n_active == COMM.allreduce(len(contact.nodes))
    assert contact.balance().force < 1e-12 and contact.balance().moment < 1e-12


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("cell", ["triangle", slow("hexahedron")])
def test_one_piece_of_two(cell, coupling):
    """Matching meshes that are tied are one piece, at finite strain, bent and pulled."""
    b = blocks(COMM, cell, 2, 2)
    g = b.gdim
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    whole = scene(COMM, cell, [box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * g, [2] * (g - 1) + [4])])
    V = compat.function_space(whole.mesh, 1, (g,))
    found = []
    for u, s, bottom, top, contacts in (
        (b.u, b.scene, b.bottom, b.top, [contact]),
        (fem.Function(V), whole, whole.tag("bottom", 0, at(g - 1, -1.0)), whole.tag("top", 0, at(g - 1, 1.0)), []),
    ):
        E, v = [1.0] * (1 + len(contacts)), ufl.TestFunction(u.function_space)
        pull = ufl.as_vector([0.02] * (g - 1) + [0.05])
        F = st_venant(u, modulus(s, *E)) - ufl.dot(pull, v) * forms.surface_measure(s.mesh, top.entities)
        uem.UnitedProblem(F, u, bcs=clamp(u.function_space, bottom), contacts=contacts, rtol=1e-13).solve()
        rows = np.round(np.column_stack([s.drawing, s.gather(u)]), 14)
        found.append(rows[np.lexsort(rows[:, :g].T)])
    two = found[0][np.append(True, (np.diff(found[0][:, :g], axis=0) != 0).any(axis=1))]
    assert np.abs(two - found[1]).max() < 1e-11
    # tension is carried, in shear too
    assert lowest(COMM, contact.pressures) < 0.0
    assert contact.resultant().force == pytest.approx(-np.array([0.02] * (g - 1) + [0.05]), rel=1e-9)


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize(
    "cell,degree,gap",
    [
        ("triangle", 1, 0.0),
        slow("triangle", 2, 0.05),
        ("quadrilateral", 1, -0.03),
        ("tetrahedron", 1, 0.05),
        slow("hexahedron", 1, 0.05),
    ],
)
def test_turned_without_stress(cell, degree, coupling, gap):
    """A pair of any meshes that is turned by its lower body alone turns as one, whatever the gap between them."""
    b = blocks(COMM, cell, 2, 3, degree=degree, gap=gap)
    g, place = b.gdim, fem.Function(b.V)
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    held = fem.dirichletbc(place, fem.locate_dofs_topological(b.V, g - 1, b.bottom.entities))

    def load(t):
        R, angle = np.eye(g), 0.5 * np.pi * t
        R[np.ix_([0, g - 1], [0, g - 1])] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        place.interpolate(lambda x: (R - np.eye(g)) @ x[:g])

    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=[held], contacts=[contact], load=load)
    run(problem, 4)
    assert highest(COMM, np.abs(b.u.x.array - place.x.array)) < 1e-12
    assert highest(COMM, np.abs(contact.force.x.array)) < 1e-13


@pytest.mark.parametrize("cell,degree", [("triangle", 2), ("tetrahedron", 1), slow("hexahedron", 1)])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_tangent(cell, degree, coupling):
    """What the forces of a tie across a gap change by: the curvature is that of differences, and Newton's method is quadratic."""
    b = blocks(COMM, cell, 1, 2, degree=degree, gap=0.1)
    g = b.gdim
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    v = ufl.TestFunction(b.V)
    pull = fem.Constant(b.scene.mesh, np.array([0.03] * (g - 1) + [0.05]))
    F = st_venant(b.u, modulus(b.scene, 1.0, 2.0)) - ufl.dot(pull, v) * forms.surface_measure(b.scene.mesh, b.top.entities)
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-12)
    history = problem.solve()
    assert len(history) <= 8 and max(factors(history), default=0.0) < 100.0
    pair, config, X = contact.pair, problem.config, problem.config.X
    direction = np.stack([np.cos(3 * X[:, i] + 2 * i) + 0.3 * X[:, (i + 1) % g] for i in range(g)], axis=1)
    start = np.array(b.u.x.array)

    def forces(h):
        b.u.x.array[:] = start + h * direction.ravel()
        pair.project()
        nodes, f = pair.nodal_forces(pair.trial)
        return config.vector(config.add_at_owners(nodes, f))

    h = 1e-5
    slope = forces(-h) - forces(h)
    slope.scale(0.5 / h)
    forces(0.0)
    curvature = curvature_of([pair], config.vector(), False, False)
    found = curvature * config.vector(direction[: config.n_owned])
    assert np.abs(gathered_vector(slope - found)).max() < 1e-8 * np.abs(gathered_vector(slope)).max()
    assert contact.balance().force < 1e-12 and contact.balance().moment < 1e-12
    there, back = contact.resultant(), contact.resultant(on="target")
    assert np.abs(there.moment + back.moment).max() < 1e-12 * np.abs(there.moment).max()


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", slow("quadrilateral"), slow("hexahedron")])
@pytest.mark.parametrize("n", [(1, 1), (3, 2)])
def test_conditions_on_tied_nodes(cell, coupling, n):
    """Rollers that hold contactors and targets next to each other: tension passes without a part of it going into the rollers."""
    b = blocks(COMM, cell, *n)
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(-0.02), contacts=[contact])
    problem.solve()
    if coupling == "mortar" or n != (3, 2):
        assert np.abs(b.scene.gather(b.u)[:, -1] - 0.01 * (b.scene.drawing[:, -1] + 1)).max() < 1e-13
        stress = stress_of(np.diag([0.0] * (b.gdim - 1) + [0.01]))[-1, -1]
        assert highest(COMM, np.abs(contact.pressures + stress)) < 1e-12
    assert contact.balance().force < 1e-12


def test_contactors_that_are_led():
    """A contactor side that is wholly prescribed leads the target; what neither side can give is refused."""
    b = blocks(COMM, "quadrilateral", 3, 2)
    contact = uem.Contact(b.high, b.low, tied=True)
    lift = [*clamp(b.V, b.high, 1, value=0.01), *clamp(b.V, b.high, 0)]
    E = modulus(b.scene, 1.0, 1.0)
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=[*clamp(b.V, b.bottom), *lift], contacts=[contact])
    problem.solve()
    low = b.scene.gather(b.u)[np.abs(b.scene.drawing[:, 1]) < 1e-12]
    # three contactors hold as many of the target's four nodes, in the means of their feet
    assert contact.max_gap() < 1e-15 and np.abs(low[:, 1] - 0.01).max() < 5e-3
    stuck = [*clamp(b.V, b.low), *clamp(b.V, b.high, 1, value=0.01)]
    torn = uem.UnitedProblem(linear(b.u, E), b.u, bcs=stuck, contacts=[uem.Contact(b.high, b.low, tied=True)])
    raised(uem.ConflictError, "held 0.01 away from its tied position", torn.solve)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_chain(coupling):
    """Three blocks, each tied to the one below by another pair of meshes, and a target of one that is a contactor of the other."""
    cell = "triangle"
    parts = [box(cell, [0.0, float(k)], [1.0, k + 1.0], [n, 2]) for k, n in enumerate((4, 2, 2))]
    s = scene(COMM, cell, parts)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    first = uem.Contact(s.tag("low 1", 0, at(1, 1.0)), s.tag("high 1", 1, at(1, 1.0)), coupling=coupling, tied=True)
    second = uem.Contact(s.tag("low 2", 1, at(1, 2.0)), s.tag("high 2", 2, at(1, 2.0)), coupling=coupling, tied=True)
    rollers = [c for k in range(3) for c in clamp(V, s.tag("side", k, at(0, 0.0)), 0)]
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, 0.0)), 1), *clamp(V, s.tag("top", 2, at(1, 3.0)), 1, value=0.03), *rollers]
    uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0)), u, bcs=bcs, contacts=[first, second]).solve()
    assert np.abs(s.gather(u)[:, 1] - 0.01 * s.drawing[:, 1]).max() < 1e-13
    assert second.resultant().force[1] == pytest.approx(first.resultant().force[1], rel=1e-10)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_edge_of_two_ties(coupling):
    """A block on two others, whose meshes meet under it: nodes between are tied to both, and all is one piece."""
    cell = "quadrilateral"
    lower = [box(cell, [float(k), -1.0], [k + 1.0, 0.0], [2, 2]) for k in (0, 1)]
    s = scene(COMM, cell, [*lower, box(cell, [0.0, 0.0], [2.0, 1.0], [4, 2])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    high = s.tag("high", 2, at(1, 0.0))
    ties = [uem.Contact(high, s.tag(f"low {k}", k, at(1, 0.0)), coupling=coupling, tied=True) for k in (0, 1)]
    ties.append(uem.Contact(s.tag("right", 0, at(0, 1.0)), s.tag("left", 1, at(0, 1.0)), coupling=coupling, tied=True))
    A = strain(2)
    exact = field(V, A)
    ends = [s.tag("bottom", k, at(1, -1.0)) for k in (0, 1)] + [s.tag("top", 2, at(1, 1.0))]
    ends += [s.tag("side", k, at(0, x)) for k, x in ((0, 0.0), (1, 2.0), (2, 0.0), (2, 2.0))]
    bcs = [fem.dirichletbc(exact, fem.locate_dofs_topological(V, 1, tag.entities)) for tag in ends]
    uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0)), u, bcs=bcs, contacts=ties).solve()
    assert highest(COMM, np.abs(u.x.array - exact.x.array)) < 1e-14


def test_rigid_target():
    """Contactors that are tied to a rigid surface go where it goes, and turn with it without stress."""
    for coupling in COUPLINGS:
        b = blocks(COMM, "quadrilateral", 1, 3, gap=0.01)
        plane = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
        contact = uem.Contact(b.high, plane, coupling=coupling, tied=True)
        problem = uem.UnitedProblem(
            st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact],
            load=lambda t: plane.move((0.3 * t, 0.2 * t), 1.2 * t),
        )  # fmt: skip
        run(problem, 4)
        R = np.array([[np.cos(1.2), -np.sin(1.2)], [np.sin(1.2), np.cos(1.2)]])
        X = b.scene.drawing
        exact = np.where((np.arange(len(X)) >= len(X) - b.n_high_nodes)[:, None], X @ R.T + [0.3, 0.2] - X, 0.0)
        assert np.abs(b.scene.gather(b.u) - exact).max() < 1e-13
        assert contact.balance() is None and highest(COMM, np.abs(contact.force.x.array)) < 1e-13


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_any_units(scale):
    """Lengths and forces in other units take the same iterations and make the same picture."""
    found = []
    for size in (1.0, scale):
        b = blocks(COMM, "triangle", 2, 3, gap=0.02, pose=lambda x, k=size: k * x)
        contact = uem.Contact(b.high, b.low, coupling="mortar", tied=True)
        v, pull = ufl.TestFunction(b.V), fem.Constant(b.scene.mesh, np.array([0.03, 0.05]) * size**2)
        E = modulus(b.scene, size**2, 2.0 * size**2)
        F = st_venant(b.u, E) - ufl.dot(pull, v) * forms.surface_measure(b.scene.mesh, b.top.entities)
        history = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact]).solve()
        found.append((len(history), b.scene.gather(b.u) / size, contact.resultant().force / size**3))
    assert found[0][0] == found[1][0]
    assert np.abs(found[0][1] - found[1][1]).max() < 1e-10
    assert found[0][2] == pytest.approx(found[1][2], rel=1e-10)


def test_named_errors():
    b = blocks(COMM, "triangle", 2, 2, gap=0.8)
    for error, how, words in (
        (uem.InputError, {"tied": "later"}, "tied = 'later': expected"),
        (uem.InputTypeError, {"tied": 1}, "tied = 1: expected True or False"),
        (uem.InputError, {"tied": True, "friction": 0.3}, "never slips"),
        (uem.InputError, {"tied": True, "adjust": -1.0}, "adjust = -1.0: expected True, False or a positive"),
    ):
        raised(error, words, lambda how=how: uem.Contact(b.high, b.low, **how))
    F = linear(b.u, modulus(b.scene, 1.0, 1.0))
    for coupling in COUPLINGS:
        far = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
        raised(
            uem.SurfaceError, "near enough to the target to be tied", lambda far=far: uem.UnitedProblem(F, b.u, contacts=[far])
        )
    free = uem.Contact(b.high, b.low)
    raised(uem.InputError, "made with tied='after'", free.tie)
    apart = uem.Contact(b.high, b.low, tied="after")
    uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[apart])
    raised(uem.SurfaceError, "touches the target to be tied", apart.tie)
