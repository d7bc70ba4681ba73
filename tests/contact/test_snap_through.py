"""Two cantilevers led past a limit point and off each other: reactions, a point as contactor, thin targets and what is behind them.

The figures of this scene are asserted by ``demos/snap_through.py``. Worth reading first: ``test_departure``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import MESHES, blocks, clamp, gathered_matrix, linear, run

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
CANTILEVERS = MESHES / "cantilevers.geo"


def cantilevers(w=-28.0, contactor="A", **how):
    """The scene of the demo; without ``contactor`` the beams do not see each other."""
    mesh, tags = uem.read_gmsh(CANTILEVERS, COMM, gdim=2)
    V = compat.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.StVenantKirchhoff(1000.0, 0.3, kind="plane_stress").residual(u, v) * ufl.dx(degree=2)
    bcs = [*clamp(V, tags["upper_held"]), *clamp(V, tags["lower_held"]), *clamp(V, tags["load"], 1, value=w)]
    contacts = [uem.Contact(tags[contactor], tags["lower_top"], **how)] if contactor else []
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, rtol=1e-11), tags


@pytest.mark.long
@pytest.mark.parametrize("steps", [28, pytest.param(45, marks=pytest.mark.slow)])
def test_departure(steps):
    """Wherever the stations are: in contact up to the end, then in one uncut step to the state that was never in contact."""
    problem, tags = cantilevers(thickness=4.0)
    (contact,) = problem.contacts
    for step in uem.load_steps(problem, steps):
        w = -28.0 * step.factor
        assert step.cuts == 0
        assert contact.n_active == (-26.456 < w < -1.057)
        lower, load = problem.reaction(tags["lower_held"]), problem.reaction(tags["load"])
        assert (np.abs(lower).max() > 1e-6 * np.abs(load).max()) == contact.n_active
    alone, own = cantilevers(contactor=None)
    run(alone, 28)
    assert max(COMM.allgather(np.abs(problem.u.x.array - alone.u.x.array).max(initial=0.0))) < 1e-8
    assert problem.reaction(tags["load"])[1] == pytest.approx(alone.reaction(own["load"])[1], rel=1e-9)


def test_reactions():
    """Supports and load hold each beam against the contact force; a component that is free has no reaction."""
    problem, tags = cantilevers(-13.5)
    (contact,) = problem.contacts
    for _ in uem.load_steps(problem, 9):
        force = contact.resultant().force
        load, upper, lower = (problem.reaction(tags[name]) for name in ("load", "upper_held", "lower_held"))
        assert load[0] == 0.0 and load[1] < 0.0
        assert np.abs(load + upper + force).max() < 1e-9 * np.abs(load).max()
        assert np.abs(lower - force).max() < 1e-9 * np.abs(load).max()


def test_reactions_beside_contact():
    """Contact forces on nodes that are held belong to the contact, not to the support."""
    b = blocks(COMM, "quadrilateral", 2, 4)
    # the held top of a lower block is the target
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.low), *clamp(b.V, b.top, 0), *clamp(b.V, b.top, 1, value=-0.1)]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
    run(problem)
    force = contact.resultant().force
    assert force[1] > 0.01
    assert np.abs(problem.reaction(b.top) + force).max() < 1e-9
    assert np.abs(problem.reaction(b.low) - force).max() < 1e-9
    assert np.abs(problem.reaction(b.bottom)).max() < 1e-12


@pytest.mark.long
def test_definite_past_the_limit_point():
    """The united tangent stays positive definite where the load is largest, and past it."""
    problem, tags = cantilevers(-14.0)
    loads = []
    for step in uem.load_steps(problem, 28):
        loads.append(problem.reaction(tags["load"])[1])
        if step.factor > 0.9:
            A = gathered_matrix(problem.system.solver.A)
            assert np.abs(A - A.T).max() < 1e-12 * np.abs(A).max()
            assert np.linalg.eigvalsh(A)[0] > 0.0
    assert loads[-1] > min(loads)


@pytest.mark.long
def test_point_as_contactor(tmp_path):
    """A point has a force but no pressure, and the picture shows its force."""
    problem, _ = cantilevers(-5.0)
    (contact,) = problem.contacts
    run(problem, 5)
    assert np.linalg.norm(contact.resultant().force) == pytest.approx(3.344452, rel=1e-6)
    assert contact.max_pressure() == 0.0 and not contact.pressures.any()
    balance = contact.balance()
    assert balance.force < 1e-12 and balance.moment < 1e-12
    uem.plot_scene(problem, tmp_path / "scene.png")


def test_only_facets_and_points():
    """A target is a surface; contactors are nodes of a surface or of points."""
    problem, tags = cantilevers()
    u = problem.u
    F = ufl.inner(u, ufl.TestFunction(u.function_space)) * ufl.dx
    for contactor, target, message in (
        ("lower_held", "A", "target 'A' has dimension 0: expected facets, dimension 1$"),
        ("upper", "lower_top", "contactor 'upper' has dimension 2: expected facets, dimension 1, or points, dimension 0$"),
    ):
        with pytest.raises(uem.TagError, match=message):
            uem.UnitedProblem(F, u, contacts=[uem.Contact(tags[contactor], tags[target])])


@pytest.mark.parametrize("thickness", [0.0, -1.0, float("nan")])
def test_thickness_is_positive(thickness):
    b = blocks(COMM, "triangle", 2, 2)
    with pytest.raises(ValueError, match="thickness"):
        uem.Contact(b.high, b.low, thickness=thickness)


def test_what_has_not_passed_the_end_is_in_the_body():
    """A first iterate that goes through a thin target is brought back, because it has come from the front."""
    forces = []
    for thickness in (None, 0.01):
        b = blocks(COMM, "quadrilateral", 2, 4, gap=0.1, overhang=0.5)
        contact = uem.Contact(b.high, b.low, thickness=thickness)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0), *clamp(b.V, b.top, 1, value=-0.3)]
        problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
        run(problem)
        forces.append(contact.resultant().force)
    assert forces[0][1] > 0.01
    assert np.abs(forces[1] - forces[0]).max() < 1e-12
