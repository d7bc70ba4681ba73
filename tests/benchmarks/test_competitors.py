"""The methods that the package is compared with: each converges to the united solution in the way its theory says.

Two tests to read first: ``test_penalty_converges_with_its_stiffness`` and ``test_saddle_point_is_indefinite``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks import methods
from dolfinx import fem
from helpers import at, blocks, box, clamp, gathered_matrix, highest, linear, modulus, refused, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
E = 10.0


def dented(x):
    """Bend the upper block's lower side, so that it touches in the middle first."""
    y = np.array(x)
    y[:, -1] += 0.08 * (x[:, :-1] - 0.5) ** 2 @ np.ones(x.shape[1] - 1) * (x[:, -1] > 0.0)
    return y


def pressed(method, parameter=None, *, cell="quadrilateral", degree=1, push=0.05, law=linear, lift=0.02, ratio=1.0, **options):
    """An arched block pressed onto a flat one, with another mesh: the problem, its contact, and the blocks."""
    b = blocks(COMM, cell, n_low=4, n_high=6, gap=lift, degree=degree, pose=dented, overhang=0.25)
    g = b.gdim
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, *range(g - 1)), *clamp(b.V, b.top, g - 1, value=-push)]
    contact = uem.Contact(
        b.high,
        b.low,
        normals=options.pop("normals", "averaged" if degree == 1 else "facet"),
        sliding=options.pop("sliding", "finite"),
        max_penetration=1.0,
    )
    problem = methods.create(
        method, law(b.u, modulus(b.scene, E, ratio * E)), b.u, parameter=parameter, bcs=bcs, contacts=[contact], **options
    )
    return problem, contact, b


def force(contact):
    """Normal resultant."""
    return contact.resultant().force[-1]


def overlap(contact):
    """Deepest node inside the target."""
    return highest(COMM, -contact.pair.kinematics.projection.gap)


@pytest.mark.parametrize("cell,degree", [("quadrilateral", 1), ("triangle", 2), ("hexahedron", 1), ("tetrahedron", 1)])
def test_multipliers_find_the_united_solution(cell, degree):
    """Elimination and multipliers solve the same equations."""
    states = []
    for method in ("united", "lagrange"):
        problem, contact, b = pressed(method, cell=cell, degree=degree, normals="facet")
        steps = run(problem)
        # ranks may part the two meshes differently
        x, u = problem.config.X, problem.config.displacement
        moments = [highest(COMM, u[:, i] * np.cos(k * x[:, 0])) for i in range(b.gdim) for k in range(4)]
        states.append((np.array(moments), force(contact), methods.counts(steps)[0]))
    (u, P, its), (v, Q, jts) = states
    assert np.abs(u - v).max() < 1e-9 and abs(P - Q) < 1e-8 * P and P > 0.01
    assert abs(its - jts) <= 1


@pytest.mark.parametrize(
    "method,cell",
    [
        ("penalty", "quadrilateral"),
        ("penalty_surface", "quadrilateral"),
        pytest.param("penalty", "hexahedron", marks=pytest.mark.slow),
    ],
)
def test_penalty_converges_with_its_stiffness(method, cell):
    """Overlap and error go like the inverse of the stiffness; node to surface ends at the united solution."""
    problem, contact, b = pressed("united", cell=cell)
    run(problem)
    # ranks may part the meshes differently
    u = b.scene.gather(b.u)
    found = []
    for stiffness in (1e4, 1e5, 1e6):
        other, touch, c = pressed(method, stiffness, cell=cell)
        history = run(other)[-1].iterations
        found.append((history[-1].gap, np.abs(c.scene.gather(c.u) - u).max(), force(touch)))
    overlaps, errors, forces = (np.array(f) for f in zip(*found))
    assert (overlaps > 0).all() and (overlaps[:-1] / overlaps[1:] > 5.0).all()
    if method == "penalty":
        assert np.allclose(overlaps[:-1] / overlaps[1:], 10.0, rtol=0.1)
        assert np.allclose(errors[:-1] / errors[1:], 10.0, rtol=0.15)
        assert abs(forces[-1] / force(contact) - 1) < 1e-3


def test_uzawa_reaches_the_united_solution():
    """Multiplier updates take the overlap away at a moderate stiffness."""
    problem, contact, _ = pressed("united")
    run(problem)
    other, touch, _ = pressed("augmented", 3000.0)
    run(other)
    assert overlap(touch) <= 1e-9 * other.config.size
    assert abs(force(touch) / force(contact) - 1) < 1e-6
    plain, _, _ = pressed("penalty", 3000.0)
    run(plain)
    assert overlap(touch) < 1e-3 * overlap(plain.contacts[0])


@pytest.mark.parametrize("cell", ["quadrilateral", "triangle"])
@pytest.mark.parametrize("stiffness", [1.0, 0.1, 10.0])
def test_the_proximal_point_method_reaches_the_united_solution(cell, stiffness):
    """From any first step of it; no surface enters the other, and its springs are stiffer than the bodies by its bound."""
    problem, contact, b = pressed("united", cell=cell, sliding="fixed")
    run(problem)
    other, touch, c = pressed("proximal", stiffness, cell=cell, sliding="fixed", scale=E * 6)
    steps = run(other)
    u, w = b.scene.gather(b.u), c.scene.gather(c.u)
    assert np.abs(u - w).max() < 1e-4 * np.abs(u).max()
    assert abs(force(touch) / force(contact) - 1) < 1e-3
    assert overlap(touch) < 1e-6 * other.config.size
    assert methods.counts(steps)[0] < 60


@pytest.mark.parametrize("method,parameter", [("penalty", 1e3), ("penalty_surface", 1e3), ("lagrange", None), ("augmented", 1e3)])
def test_finite_strain_in_steps(method, parameter):
    """All of them follow load steps with finite strain, in equilibrium with the supports."""
    problem, contact, b = pressed(
        method, parameter, law=st_venant, push=0.15, normals="facet" if method == "lagrange" else "averaged"
    )
    steps = run(problem, 3)
    assert all(step.cuts == 0 for step in steps) and methods.counts(steps)[0] < (100 if method == "augmented" else 40)
    reaction = problem.reaction(b.top)[-1]
    assert abs(reaction / force(contact) + 1) < 1e-6


def test_springs_know_no_equations_of_users():
    """Rigid couplings with masses at their points, and linear equations, are refused by name."""
    for coupled in (True, False):
        b = blocks(COMM, "quadrilateral", 2, 3)
        if coupled:
            more = {"couplings": [uem.RigidCoupling(b.top, (0.5, 1.0), mass=1.0)]}
        else:
            more = {"equations": [uem.Equation([((0.0, 1.0), (0.0, 1.0)), ((1.0, 1.0), (0.0, -1.0))])]}
        refused(
            uem.InputError,
            ("masses at their points", "elimination alone"),
            lambda b=b, more=more: methods.create(
                "penalty",
                linear(b.u, E),
                b.u,
                parameter=1e3,
                bcs=clamp(b.V, b.bottom),
                contacts=[uem.Contact(b.high, b.low)],
                **more,
            ),
        )


def test_saddle_point_is_indefinite():
    """Multipliers: one negative eigenvalue for each active contactor, and more unknowns; united: none, and fewer."""
    problem, contact, _ = pressed("lagrange", sliding="small")
    run(problem)
    united, touch, _ = pressed("united", sliding="small")
    run(united)
    assert contact.n_active == touch.n_active > 2
    saddle = np.linalg.eigvalsh(gathered_matrix(problem.system.saddle))
    assert (saddle < 0).sum() == contact.n_active
    assert (np.linalg.eigvalsh(gathered_matrix(united.system.solver.A)) > 0).all()


@pytest.mark.skipif(COMM.size > 1, reason="condition numbers are taken on one rank")
@pytest.mark.slow
def test_condition_number():
    """Against a dense computation; the penalty's grows with its stiffness, the united one has none."""
    united, _, _ = pressed("united", normals="facet")
    run(united)
    A = gathered_matrix(united.system.solver.A)
    A = A[np.ix_(*2 * [np.abs(A - np.diag(np.diag(A))).sum(axis=1) > 0])]
    assert methods.condition_number(united) == pytest.approx(np.linalg.cond(A), rel=1e-4)
    conditions = []
    for stiffness in (1e4, 1e6):
        problem, _, _ = pressed("penalty", stiffness)
        run(problem)
        conditions.append(methods.condition_number(problem))
    assert conditions[1] == pytest.approx(100 * conditions[0], rel=0.2) and conditions[0] > 5 * methods.condition_number(united)


@pytest.mark.skipif(COMM.size > 1 or not methods.available("barrier"), reason="ipctk, on one rank")
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_barrier_never_touches(cell):
    """Nothing overlaps; the error is proportional to dhat."""
    united, contact, _ = pressed("united", cell=cell)
    run(united)
    errors = []
    for dhat in (1e-3, 1e-4):
        problem, touch, b = pressed("barrier", dhat, cell=cell)
        run(problem)
        gap = touch.pair.kinematics.projection.gap
        assert gap.min() > 0 and gap.min() < dhat
        assert abs(problem.reaction(b.top)[-1] / force(touch) + 1) < 1e-4
        errors.append(abs(force(touch) / force(contact) - 1))
    assert errors[1] < 0.2 * errors[0] and errors[1] < 0.02


@pytest.mark.parametrize("method,parameter", [("penalty", 1e4), ("lagrange", None), ("augmented", 1e3), ("barrier", 1e-3)])
def test_rigid_target(method, parameter):
    """A block pressed onto a rigid plane: E times the strain, to the compliance of the method."""
    if method == "barrier" and (COMM.size > 1 or not methods.available(method)):
        pytest.skip("ipctk, on one rank")
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [4, 4])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    bcs = [*clamp(V, s.tag("side", 0, at(0, 0.0)), 0), *clamp(V, s.tag("top", 0, at(1, 1.0)), 1, value=-0.01)]
    floor = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    contact = uem.Contact(s.tag("low", 0, at(1, 0.0)), floor)
    problem = methods.create(method, linear(u, E, 0.0), u, parameter=parameter, bcs=bcs, contacts=[contact])
    run(problem)
    lost = {"penalty": 1e-5, "barrier": 1e-3}.get(method, 1e-8)
    assert force(contact) == pytest.approx(0.01 * E, rel=2 * lost / 0.01)


def test_names_and_parameters():
    """A method that is not there, or a parameter too many or too few, is reported."""
    b = blocks(COMM, "triangle")
    for method, parameter in (("glue", None), ("penalty", None), ("united", 1.0)):
        with pytest.raises(ValueError, match="expected one of|parameter"):
            methods.create(method, linear(b.u, E), b.u, parameter=parameter)
