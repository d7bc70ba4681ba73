"""Adhesion: an attraction by the gap in addition to hard contact.

The test to read first is ``test_pull_off_of_a_sphere``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import arch, blocks, clamp, highest, linear, refused, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.bodies.tangent import contact_curvature, curvature_of

COMM = MPI.COMM_WORLD


def test_the_law():
    """The area below the attraction is the energy; the slope is its derivative."""
    law = uem.Adhesion(0.01, 2.0)
    g = np.linspace(0.0, 0.02, 2001)
    t, slope = law.attraction(g)
    assert t[0] == 2.0 and 1e-5 * (t.sum() - 0.5 * (t[0] + t[-1])) == pytest.approx(0.01, rel=1e-9)
    assert np.allclose(np.diff(t[1:900]) / 1e-5, slope[1:899]) and law.attraction(np.array([-1e-3]))[0] == [2.0]


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["mortar", slow("node_to_surface")])
def test_pull_off_of_a_sphere(coupling):
    """A rigid paraboloid pressed into an elastic half-space is pulled off by 1.5 pi w R (JKR), within 4 % on this mesh."""
    E, nu, R, a = 1.0, 0.3, 1.0, 0.1
    stiff = E / (1 - nu**2)
    w = 2 * stiff * a**3 / (9 * np.pi * R)
    law = uem.Adhesion(w, 1.0 * (np.pi * w * (4 * stiff / 3) ** 2 / R) ** (1 / 3))
    mesh, tags = uem.read_gmsh(uem.example_mesh("sticky_sphere"), COMM, gdim=2, parameters={"h": 3e-3})
    uem.axisymmetric(mesh)
    V = compat.function_space(mesh, 1, (2,))
    u, v, base = fem.Function(V), ufl.TestFunction(V), fem.Function(V)

    def move(s):
        base.x.array[1::2] = -0.0086 * max(s - 0.1, 0.0) / 0.9

    contact = uem.Contact(
        tags["top"], uem.RigidParaboloid((0, -0.007), (0, 1), R), cohesion=law, coupling=coupling, sliding="small"
    )
    bcs = [uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["bottom"], value=base)]
    F = uem.LinearElastic(E, nu, kind="axisymmetric").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load=move, petsc_options_prefix="adhesion_")
    pulls = []
    for step in uem.load_steps(problem, 10):
        pulls.append(float(problem.reaction(tags["bottom"])[1]))
        assert contact.resultant().force[1] == pytest.approx(-pulls[-1], rel=1e-6)
        # contactors at the edge of the contact that are not yet to be released stay
        assert step.newton_iterations <= 6
    assert pulls[0] > 0 and min(pulls) == pytest.approx(-1.5 * np.pi * w * R, rel=0.04)


@pytest.mark.parametrize(
    "cell,degree", [("triangle", 1), ("quadrilateral", 2), slow("tetrahedron", 1), slow("tetrahedron", 2), slow("hexahedron", 2)]
)
def test_the_tangent_is_the_derivative(cell, degree):
    """On arched surfaces with open gaps, stiffness and curvature of the attraction are the derivative of the residual."""
    b = blocks(COMM, cell, 3, 4, pose=arch(0.2), gap=0.02, degree=degree)
    contact = uem.Contact(b.high, b.low, cohesion=uem.Adhesion(0.02, 0.2))
    problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    system, pair, config = problem.system, contact.pair, problem.config
    x = config.X
    smooth = 0.003 * np.stack([np.sin(2 * x[:, i] + i) for i in range(b.gdim)], axis=1)
    direction = np.stack([np.cos(3 * x[:, i] + 2 * i) for i in range(b.gdim)], axis=1)

    def forces(u):
        problem.u.x.array[:] = u.ravel()
        system.place()
        return -config.add_at_owners(*pair.applied_forces()).ravel()

    forces(smooth)
    facets, du, h = pair.kinematics.projection.facet.copy(), config.vector(), 1e-6
    nodes, K, _ = pair.slip_terms()
    of_gaps, bends = contact_curvature([(nodes, K)], config.vector()), curvature_of([pair], config.vector(), True, False)
    du.array[:] = direction[: config.n_owned].ravel()
    wanted, found = of_gaps * du + bends * du, config.vector()
    found.array[:] = (forces(smooth + h * direction) - forces(smooth - h * direction)) / (2 * h)
    assert highest(COMM, np.abs(pair.kinematics.projection.facet - facets)) == 0
    assert wanted.norm() > 0 and (found - wanted).norm() < 1e-5 * wanted.norm()


@pytest.mark.parametrize("coupling", ["mortar", "node_to_surface"])
def test_blocks_adhere_again(coupling):
    """Pulled by less than the strength blocks hold, and balance; the pressure is tensile."""
    b = blocks(COMM, "quadrilateral", 2, 3 if coupling == "mortar" else 4)
    contact = uem.Contact(b.high, b.low, cohesion=uem.Adhesion(0.01, 1.0), coupling=coupling)
    up = fem.Function(b.V)

    def move(s):
        up.x.array[1::2] = 1e-3 * np.interp(3 * s, range(4), [0.0, 1.0, -1.0, 1.0])

    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=up)]
    problem = uem.UnitedProblem(
        linear(b.u, 1e3, 0.0), b.u, bcs=bcs, contacts=[contact], load=move, petsc_options_prefix="adhesion_"
    )
    for _, way in zip(uem.load_steps(problem, 3), (1.0, -1.0, 1.0), strict=True):
        assert contact.resultant().force[1] == pytest.approx(-0.5 * way, rel=1e-6)
        assert highest(COMM, np.abs(contact.pressures + 0.5 * way)) < 1e-6 and contact.balance().force < 1e-12


@pytest.mark.parametrize("coupling", ["mortar", slow("node_to_surface")])
def test_snapping_in(coupling):
    """Blocks that come nearer than the range snap together, and stretch by what is left of the gap: the same iterations in all units."""
    gap, near, L_of = 0.03, 0.019, (1.0, 1e-9, 1e3)
    taken = []
    for L in L_of:
        b = blocks(COMM, "quadrilateral", 2, 3 if coupling == "mortar" else 4, gap=gap, pose=lambda x, L=L: L * x)
        # the range is 0.02; attraction falls off with the gap faster than both blocks pull back
        contact = uem.Contact(b.high, b.low, cohesion=uem.Adhesion(0.001 * L, 0.1), coupling=coupling)
        down = fem.Function(b.V)

        def move(s, down=down, L=L):
            down.x.array[1::2] = -(gap - near) * L * s

        bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=down)]
        problem = uem.UnitedProblem(
            linear(b.u, 1.0, 0.0), b.u, bcs=bcs, contacts=[contact], load=move, petsc_options_prefix="adhesion_"
        )
        steps = list(uem.load_steps(problem, 1))
        taken.append([(step.newton_iterations, [i.exchanges for i in step.iterations]) for step in steps])
        # two blocks in series: strain near / 2, of the modulus 1
        assert contact.resultant().force[1] == pytest.approx(-0.5 * near * L, rel=1e-6)
        assert contact.n_active > 0
    assert taken[0] == taken[1] == taken[2] and taken[0][0][0] <= 4


def test_switched_off_and_on():
    """A contact that was switched off attracts again as soon as it is switched on."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    contact = uem.Contact(b.high, b.low, cohesion=uem.Adhesion(0.01, 1.0), coupling="mortar")
    up = fem.Function(b.V)

    def pull(s):
        up.x.array[1::2] = 1e-3

    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=up)]
    problem = uem.UnitedProblem(linear(b.u, 1e3, 0.0), b.u, bcs=bcs, contacts=[contact], petsc_options_prefix="adhesion_")
    turns = [("a", True, 0.5), ("off", False, 0.0), ("on", True, 0.5)]
    steps = [uem.Step(name, 1, loads=pull, contacts={contact: is_on}) for name, is_on, _ in turns]
    for _, (_, is_on, wanted) in zip(uem.load_steps(problem, steps), turns, strict=True):
        force = contact.resultant().force[1]
        assert is_on == (force != 0.0) and abs(force) == pytest.approx(wanted, rel=0.1)


def test_what_is_refused():
    """Friction does not go with adhesion; numbers must be positive."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    refused(uem.InputError, "friction", lambda: uem.Contact(b.high, b.low, cohesion=uem.Adhesion(1.0, 1.0), friction=0.3))
    refused(uem.InputError, "strength", lambda: uem.Adhesion(1.0, 0.0))


@pytest.mark.parametrize("coupling", ["mortar", "node_to_surface"])
@pytest.mark.parametrize("L", [1.0, 1e-6])
def test_ranges_within_which_surfaces_touch(coupling, L):
    """Refused if below 1e-9 of the model's size: attraction would never act."""
    b = blocks(COMM, "quadrilateral", 2, 3, pose=lambda x: L * x)

    def problem(part):
        law = uem.Adhesion(0.5 * part * L * np.sqrt(5.0), 1.0)
        return uem.UnitedProblem(
            linear(b.u, 1e3, 0.0),
            b.u,
            bcs=clamp(b.V, b.bottom),
            contacts=[uem.Contact(b.high, b.low, cohesion=law, coupling=coupling)],
        )

    refused(uem.InputError, ("high on low", "count as touching", "smaller strength"), lambda: problem(0.5e-9))
    assert problem(2e-9).contacts[0].cohesion.range == pytest.approx(2e-9 * L * np.sqrt(5.0))


@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_the_tangent_by_mortar(cell):
    """Across open gaps of arched surfaces that slide, stiffness and curvature are the derivative of the attraction."""
    b = blocks(COMM, cell, 3, 4, pose=arch(0.2), gap=2e-3, overhang=0.25)
    contact = uem.Contact(b.high, b.low, cohesion=uem.Adhesion(0.01, 1.0), coupling="mortar")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    pair, config = contact.pair, problem.config
    smooth, way = (size * np.sin(2.0 * config.X + np.arange(b.gdim)) for size in (1e-4, 1.0))

    def forces(u):
        problem.u.x.array[:] = u.ravel()
        problem.system.place()
        return config.add_at_owners(*pair.applied_forces())

    forces(smooth)
    nodes, stiffness, _ = pair.slip_terms()
    parts = [(nodes, stiffness), *pair.curvature()]
    K = contact_curvature(parts, config.vector())
    du = K.createVecRight()
    du.array[:] = way[: config.n_owned].ravel()
    wanted, h = (K * du).array_r.reshape(-1, b.gdim), 1e-7
    found = -(forces(smooth + h * way) - forces(smooth - h * way)) / (2 * h)
    assert highest(COMM, np.abs(wanted)) > 0.0
    assert highest(COMM, np.abs(found - wanted)) < 1e-5 * highest(COMM, np.abs(wanted))
