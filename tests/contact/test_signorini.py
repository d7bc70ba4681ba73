"""Contact with rigid surfaces: Signorini's problem against quadratic programming, Hertz, and its rate of convergence.

Two tests to read first: ``test_against_quadratic_programming`` (the exact discrete solution, found without any contact algorithm) and
``test_energy_rate``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, clamp, complementary, gathered_matrix, highest, linear, run, scene
from petsc4py import PETSc
from scipy.optimize import lsq_linear

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD


def graded(x, power=2):
    """Concentrate nodes at the origin, where a body [0, 1]^(g-1) x [-1, 0] is touched."""
    return np.sign(x) * np.abs(x) ** power


def quarter(cell, n, target, *, comm=COMM, power=2, sliding="finite", **options):
    """Quarter (half) of a block under a rigid surface, with symmetry planes and a fixed base."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], n)], pose=lambda x: graded(x, power))
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    bcs = clamp(V, s.tag("base", 0, at(g - 1, -1.0)))
    for c in range(g - 1):
        bcs += clamp(V, s.tag("symmetry", 0, at(c, 0.0)), c)
    contact = uem.Contact(s.tag("top", 0, at(g - 1, 0.0)), target, sliding=sliding, max_penetration=1.0)
    problem = uem.UnitedProblem(
        linear(u, fem.Constant(s.mesh, PETSc.ScalarType(10.0))), u, bcs=bcs, contacts=[contact], **options
    )
    return s, contact, problem


def vertical_gap(g, d, R):
    """Rigid paraboloid pressed in by d, its gap measured along the vertical: the linear Signorini problem."""
    e = np.eye(g)[-1]
    return uem.RigidSurface(
        lambda x: -(x[:, -1] + d - (x[:, :-1] ** 2).sum(axis=1) / (2 * R)),
        lambda x: np.tile(-e, (len(x), 1)),
        lambda x: np.zeros((len(x), g, g)),
        name="paraboloid",
    )


@pytest.mark.parametrize(
    "cell,n", [("triangle", (8, 6)), ("quadrilateral", (10, 6)), ("tetrahedron", (4, 4, 3)), ("hexahedron", (4, 4, 3))]
)
def test_against_quadratic_programming(cell, n):
    """min u'Ku/2 with g >= 0 by SciPy's bounded least squares: the same active set, forces and displacements."""
    g, d, R = len(n), 0.02, 0.5
    # fixed horizontal positions, as in the linear problem: projected once for all
    _, contact, problem = quarter(cell, n, vertical_gap(g, d, R), sliding="fixed")
    run(problem)
    config = problem.config
    K = gathered_matrix(problem.bodies.update_tangent())
    free = np.concatenate(COMM.allgather(problem.bodies.free[: config.n_owned].ravel()))
    first = config.index_map.local_range[0]
    own = (first + contact.pair.nodes) * g + g - 1
    normal = np.concatenate(COMM.allgather(own))
    X = np.concatenate(COMM.allgather(config.X[contact.pair.nodes]))
    bound = -(d - (X[:, :-1] ** 2).sum(axis=1) / (2 * R))
    u = np.concatenate(COMM.allgather(config.displacement[: config.n_owned].ravel()))

    # condense onto the contactors, then solve the small bounded problem
    rest = np.setdiff1d(np.flatnonzero(free), normal)
    movable = normal[free[normal]]
    high = bound[free[normal]]
    S = K[np.ix_(movable, movable)] - K[np.ix_(movable, rest)] @ np.linalg.solve(K[np.ix_(rest, rest)], K[np.ix_(rest, movable)])
    L = np.linalg.cholesky(S).T
    qp = lsq_linear(L, np.zeros(len(movable)), bounds=(-np.inf, high), method="bvls", tol=1e-15, max_iter=500)
    assert np.abs(u[movable] - qp.x).max() < 1e-10 * d
    forces = -(S @ qp.x)
    assert contact.resultant().force[-1] == pytest.approx(-forces.sum(), rel=1e-9)
    assert contact.n_active == (qp.active_mask == 1).sum()
    complementary(contact, 1e-15, 1e-14)


@pytest.mark.parametrize("cell,n", [("quadrilateral", (40, 20)), ("triangle", (40, 20))])
def test_line_contact_of_hertz(cell, n):
    """A rigid cylinder on a graded block: peak pressure, half width and pressure profile at the computed force."""
    R, d, E, nu = 0.5, 0.004, 10.0, 0.3
    _, contact, problem = quarter(cell, n, uem.RigidSphere((0.0, R - d), R), power=3)
    run(problem)
    P = -2 * contact.resultant().force[1]
    Es = E / (1 - nu**2)
    a, p0 = np.sqrt(4 * P * R / (np.pi * Es)), np.sqrt(P * Es / (np.pi * R))
    assert contact.max_pressure() == pytest.approx(p0, rel=0.03)
    x = contact.pair.points[:, 0]
    profile = p0 * np.sqrt(np.maximum(0.0, 1 - (x / a) ** 2))
    assert highest(COMM, np.abs(contact.pressures - profile)[x < 0.8 * a]) < 0.04 * p0
    edge = highest(COMM, x[contact.pair.trial.active])
    beyond = -highest(COMM, -x[~contact.pair.trial.active])
    assert edge < 1.1 * a and beyond > 0.9 * a
    complementary(contact, 1e-15, 1e-12)


@pytest.mark.slow
def test_point_contact_of_the_penalty_demo():
    """The quarter block under a rigid paraboloid at half the demo's resolution: force and peak pressure near the discrete reference."""
    _, contact, problem = quarter("hexahedron", (15, 15, 8), vertical_gap(3, 0.02, 0.5))
    steps = run(problem)
    assert -4 * contact.resultant().force[2] == pytest.approx(0.032099, rel=0.03)
    assert contact.max_pressure() == pytest.approx(1.453, rel=0.05)
    assert steps[0].newton_iterations <= 6
    complementary(contact, 1e-15, 1e-12)


@pytest.mark.parametrize("target", ["plane", "sphere", "paraboloid", "own"])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_complementarity_on_rigid_surfaces(target, cell):
    g, d = (2, 0.03) if cell == "triangle" else (3, 0.03)
    apex, up = [0.0] * (g - 1) + [-d], [0.0] * (g - 1)
    surfaces = {
        "plane": uem.RigidPlane(apex, [*up[:-1], 0.2, -1.0]),
        "sphere": uem.RigidSphere([*up, 0.5 - d], 0.5),
        "paraboloid": uem.RigidParaboloid(apex, [*up, 1.0], 0.5),
        "own": vertical_gap(g, d, 0.5),
    }
    _, contact, problem = quarter(cell, (8, 5) if g == 2 else (5, 5, 4), surfaces[target], rtol=1e-10)
    for _ in uem.load_steps(problem, 1):
        complementary(contact, 1e-14, 1e-13)
    assert contact.n_active > 1
    # equilibrium: the contact balances what base and symmetry planes hold, where a contactor may lie in a symmetry plane, too
    problem.bodies.assemble()
    n = problem.config.n_owned
    held = problem.bodies.residual.array_r.reshape(-1, g) - contact.force.x.array.reshape(-1, g)[:n]
    fixed = ~problem.bodies.free[:n]
    assert highest(COMM, np.abs(held[~fixed])) < 1e-10 * np.abs(contact.resultant().force).max()
    reaction = np.array(COMM.allreduce((held * fixed).sum(axis=0)))
    assert np.abs(reaction + contact.resultant().force).max() < 1e-10 * np.abs(reaction).max()


@pytest.mark.slow
def test_energy_rate():
    """The error in energy norm falls like h, measured against a fine mesh."""
    energies = []
    sizes = (8, 16, 32, 64, 256)
    for n in sizes:
        _, contact, problem = quarter("triangle", (n, n), vertical_gap(2, 0.05, 0.5), sliding="fixed")
        run(problem)
        u = problem.u
        eps = ufl.sym(ufl.grad(u))
        E, nu = 10.0, 0.3
        density = E / (1 + nu) / 2 * (ufl.inner(eps, eps) + nu / (1 - 2 * nu) * ufl.tr(eps) ** 2)
        energies.append(forms.assemble_scalar(forms.form(density * ufl.dx), COMM))
    # in Signorini's problem the energy differs from its limit by at least the square of the error in energy norm
    errors = np.sqrt(np.abs(np.array(energies[:-1]) - energies[-1]))
    rates = np.log2(errors[:-1] / errors[1:])
    assert (np.diff(energies) < 0).all() or (np.diff(energies) > 0).all()
    assert rates[1:].mean() > 0.9 and rates.min() > 0.75
