"""Bodies that touch themselves: nothing is found on bodies at rest; prongs of a fork that close, in any pose, on any ranks, in 2D and 3D.

Read first: ``test_prongs_in_any_pose``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import fork, skin_of
from dolfinx import fem
from helpers import at, box, highest, refused, run, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.neighbours import Neighbour, Neighbours

COMM = MPI.COMM_WORLD


def closed(cell, angle=0.0, load=4e-3, steps=4, degree=1, more=0.0, normals="facet", length=1.0, stress=1.0, **how):
    """A fork turned by an angle whose prongs are pressed together: its contact, displacements in its own axes, and iterations.

    ``length`` and ``stress`` are the units.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    R = np.eye(g)
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    s = scene(COMM, cell, [fork(cell, more=more)], pose=lambda x: length * (x @ R.T), **how)
    V = compat.function_space(s.mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    push = fem.Constant(s.mesh, 0.0)
    across = ufl.as_vector([float(c) for c in R[:, 1]])
    law = uem.NeoHooke(stress, 0.3, kind="plane_strain" if g == 2 else "3d")
    F = law.residual(u, v) * ufl.dx
    for side in (1, -1):
        F += side * push * ufl.inner(across, v) * uem.ds(s.tag(f"outer{side}", 0, at(1, 0.45 * side)))
    contact = uem.GeneralContact(self_contact=True, normals=normals)
    bcs = [uem.dirichlet(V, s.tag("root", 0, at(0, -0.4)))]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load={push: load * stress}, rtol=1e-10)
    history = run(problem, steps)
    X, U = (a @ R for a in (problem.config.X, problem.config.displacement))
    own = slice(problem.config.n_owned)
    return contact, X[own], U[own], [step.newton_iterations for step in history]


def farthest(U):
    """The longest displacement."""
    return COMM.allreduce(float(np.linalg.norm(U, axis=1).max(initial=0.0)), op=MPI.MAX)


def resting(cell, bodies, reach=10.0):
    """Number of nodes of bodies at rest that facets of their own body may hold, which are looked for all over.

    Those that have their foot past the last facet listed are held by none.
    """
    _, skin = skin_of(cell, bodies)
    nodes = np.unique(skin.dofs[skin.dofs < skin.config.n_owned]).astype(np.int32)
    lists = Neighbours(skin, nodes, np.arange(skin.n_bodies), [], 0.0, 1, np.ones(skin.n_bodies, bool))
    lists._farther = reach
    found = Neighbour(lists, 0).project(skin.config.X[nodes])
    return COMM.allreduce(int(((found.facet >= 0) & (found.beyond == 0.0).all(axis=1)).sum()))


def bent(body, start, end):
    """A bar along x, ``(0, 1)``, bent to a ring of radius 1 from one angle to another."""

    def ring(x):
        a, r = start + (end - start) * x[:, 0], 1.0 + x[:, 1]
        return np.column_stack([r * np.cos(a), r * np.sin(a), x[:, 2:]])

    return body.mapped(ring)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", slow("hexahedron")])
def test_nothing_on_bodies_at_rest(cell):
    """Thin plates of one cell, blocks and arcs that see no part of themselves have nothing to touch, however far one looks."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    plate = box(cell, [0.0] * g, [1.0, 0.02, 1.0][:g], [8, 1, 4][:g])
    block = box(cell, [0.0] * g, [1.0] * g, [3] * g)
    assert resting(cell, [plate]) == resting(cell, [block]) == 0
    bar = box(cell, [0.0, 0.0, 0.0][:g], [1.0, 0.1, 0.3][:g], [12, 1, 2][:g])
    assert resting(cell, [bent(bar, 0.0, 0.6)]) == 0
    # of a fork the prongs see each other alone
    assert resting(cell, [fork(cell)]) > 0


@pytest.mark.parametrize(
    ("cell", "more"), [("quadrilateral", 0.0), slow("triangle", 0.2), slow("quadrilateral", 0.2), slow("triangle", 0.0)]
)
@pytest.mark.slow
def test_prongs_in_any_pose(cell, more):
    """In any pose, which decides which prong follows, the prongs close alike; none passes into the other."""
    found = []
    for angle in 2 * np.pi * np.array([0.0, 0.2, 0.52, 0.75]):
        contact, X, U, iterations = closed(cell, angle, more=more)
        assert contact.n_active > 5 and contact.max_gap() < 1e-12 and max(iterations) <= 10
        assert contact.parts[0].balance().force < 1e-12
        found.append(farthest(U))
        upper = (X[:, 0] > 0.05) & (np.abs(X[:, 1] - 0.05) < 1e-9)
        assert COMM.allreduce(float((X + U)[upper, 1].min(initial=1.0)), op=MPI.MIN) > -0.06
    assert np.ptp(found) < 0.01 * found[0]


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "angle"), [("quadrilateral", 0.0), ("triangle", 0.2)])
def test_units(cell, angle):
    """In nanometres and kilometres, soft and stiff, prongs close by the same displacements in the same iterations."""
    _, _, U, iterations = closed(cell, angle)
    for length, stress in ((1e3, 1.0), (1e3, 2.1e11), (1e-9, 2.1e11)):
        _, _, W, scaled = closed(cell, angle, length=length, stress=stress)
        assert scaled == iterations
        assert farthest(W / length - U) < 1e-12


@pytest.mark.parametrize(
    ("cell", "degree", "normals"),
    [slow("quadrilateral", 2, "facet"), slow("triangle", 1, "averaged"), slow("hexahedron", 1, "facet")],
)
def test_prongs_of_other_kinds(cell, degree, normals):
    """Degree 2, averaged normals and 3D close as far as linear quadrilaterals do, but for what these err."""
    contact, _, U, _ = closed(cell, degree=degree, normals=normals, more=0.2)
    _, _, W, _ = closed("quadrilateral", more=0.2)
    assert contact.n_active > 3 and contact.max_gap() < 1e-12
    assert farthest(U) == pytest.approx(farthest(W), rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [
        {},
        *map(
            slow,
            [{"explicit": True}, {"cell": "hexahedron", "explicit": True}, {"soft": True}, {"explicit": True, "friction": 0.3}],
        ),
    ],
    ids=str,
)
def test_prongs_in_flight(how):
    """Prongs that are thrown at each other meet and do not pass; momentum stays to rounding, and nothing gives energy."""
    cell = how.get("cell", "quadrilateral")
    g = 2 if cell == "quadrilateral" else 3
    s = scene(COMM, cell, [fork(cell)])
    V = compat.function_space(s.mesh, 1, (g,))
    u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    X = V.tabulate_dof_coordinates()
    velocity.x.array.reshape(-1, g)[:, 0] = 0.03
    velocity.x.array.reshape(-1, g)[:, 1] = -0.075 * np.sign(X[:, 1]) * np.maximum(X[:, 0], 0.0)
    law = uem.NeoHooke(1.0, 0.3, kind="plane_strain" if g == 2 else "3d")
    normal = uem.SoftContact(50.0) if how.get("soft") else None
    contact = uem.GeneralContact(self_contact=True, normal=normal, friction=how.get("friction", 0.0))
    scheme = {"scheme": uem.CentralDifferences(), "contactors": "massy"} if how.get("explicit") else {}
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, **scheme)
    problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=[contact], rtol=1e-10, dynamics=dynamics)
    book, config, closed = uem.EnergyBook(problem, law.energy(u) * ufl.dx), problem.config, 0
    sides = [
        np.flatnonzero((np.abs(config.X[: config.n_owned, 1] - y) < 1e-9) & (X[: config.n_owned, 0] > -1e-9))
        for y in (-0.05, 0.05)
    ]
    for step in uem.time_steps(problem, None if scheme else 0.1, 1.3):
        row = book.write(step)
        low, high = ((config.X + config.displacement)[side, 1] for side in sides)
        slit = -COMM.allreduce(-high.min(initial=np.inf), op=MPI.MAX) - COMM.allreduce(low.max(initial=-np.inf), op=MPI.MAX)
        assert slit > -0.01
        assert row.kinetic + row.stored <= (1.0 + 1e-3) * book.rows[0].kinetic
        closed += COMM.allreduce(any(pair.united.any() for pair in problem.pairs), op=MPI.LOR)
    momenta = np.array(book.momenta)
    # rounding is that of the masses' own momenta, whose sizes add up to this at most [Cauchy and Schwarz]
    size = np.sqrt(2.0 * book.rows[0].kinetic * momenta[0, 0] / 0.03)
    assert closed >= 3 and np.abs(momenta - momenta[0]).max() < 1e-12 * size


@pytest.mark.long
def test_order_of_the_input():
    """Any order of nodes and cells gives the same displacements, to rounding."""
    ends = [farthest(closed("triangle", shuffle=seed)[2]) for seed in (None, 1)]
    assert ends[1] == pytest.approx(ends[0], rel=1e-9)


def test_not_declared():
    """Without self contact one body alone has nothing to touch; a part that may names the body."""
    s = scene(COMM, "triangle", [fork("triangle")])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    root = s.tag("root", 0, at(0, -0.4))
    bcs = [uem.dirichlet(V, root)]
    refused(
        uem.SurfaceError, ("one body", "self_contact"), lambda: uem.UnitedProblem(F, u, bcs=bcs, contacts=[uem.GeneralContact()])
    )
    contact = uem.GeneralContact(self_contact=[root])
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    problem.solve()
    assert contact.n_active == 0 and contact.touching() == []


@pytest.mark.long
def test_prongs_of_soft_contact():
    """A fork that is pressed together touches itself by a pressure, which tends to hard contact, and forces balance."""

    def closed(normal):
        s = scene(COMM, "quadrilateral", [fork("quadrilateral")])
        V = compat.function_space(s.mesh, 1, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        push = fem.Constant(s.mesh, 0.0)
        F = uem.NeoHooke(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
        for side in (1, -1):
            F += side * push * v[1] * uem.ds(s.tag(f"outer{side}", 0, at(1, 0.45 * side)))
        contact = uem.GeneralContact(self_contact=True, normal=normal)
        bcs = [uem.dirichlet(V, s.tag("root", 0, at(0, -0.4)))]
        run(uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load={push: 4e-3}, petsc_options_prefix="soft_"), 4)
        force = contact.force.x.array.reshape(-1, 2)[: contact._config.n_owned]
        return COMM.allreduce(force.sum(axis=0)), COMM.allreduce(np.abs(force).sum()), highest(COMM, np.abs(u.x.array))

    _, hard, far = closed(None)
    errors = []
    for k in (1.0, 10.0):
        left, size, way = closed(uem.SoftContact(k))
        assert np.abs(left).max() < 1e-13 * size
        errors.append(abs(size / hard - 1) + abs(way / far - 1))
    assert size > 0.005 and errors[1] < 0.25 * errors[0] < 0.25
