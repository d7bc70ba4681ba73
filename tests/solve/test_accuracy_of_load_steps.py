"""Load steps whose length follows their error.

Read first: ``test_a_forming``.
"""

from __future__ import annotations

import functools

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, linear, refused, scene, slow
from ramp_scenes import COMM, forming, ramped

import uem_dolfinx as uem


def formed(n, tolerance=None, path=lambda f: f, problem=None, **how):
    """A soft body, flattened with friction along a path that is slow and fast: its problem and its steps."""
    problem = forming(COMM).problem if problem is None else problem
    press = problem.load
    problem.load = lambda f: press(path(f))
    return problem, list(uem.load_steps(problem, n, tolerance=tolerance, **how))


@functools.cache
def fine():
    """The same in many steps."""
    return end(formed(64)[0])


def end(problem):
    """Displacements and forces of the tool."""
    u, force = problem.u.x.array, problem.contacts[0].resultant().force
    return np.array([*u, *(np.abs(u).max() / np.abs(force).max() * force)])


def error(problem):
    """Relative to what many steps give."""
    sums = COMM.allreduce(np.array([((end(problem) - fine()) ** 2).sum(), (fine() ** 2).sum()]))
    return np.sqrt(sums[0] / sums[1])


def lengths(steps):
    return np.diff([0.0, *(step.factor for step in steps)])


@pytest.mark.slow
def test_a_forming():
    """Friction and plasticity: errors add up to some times the tolerance, with as few steps as this takes."""
    counts = []
    for tolerance in (3e-3, 1e-3):
        problem, steps = formed(1, tolerance)
        assert tolerance < error(problem) < 4 * tolerance
        counts.append(len(steps))
    assert 3 <= counts[0] < counts[1] <= 8


@pytest.mark.slow
@pytest.mark.parametrize("path", [lambda f: 1 - (1 - f) ** 4, lambda f: f**4], ids=["early", "late"])
def test_steps_are_doubled_in_load(path):
    """Steps are short where much happens, and few are refused: fewer of them than equal ones of the same error."""
    problem, steps = formed(4, 3e-4, path)
    size, equal = lengths(steps), formed(len(steps) * 2, path=path)[0]
    assert size.max() >= 4 * size.min() and abs(sum(size) - 1) < 1e-12
    assert (np.argmin(size) > len(size) / 2) == (path(0.5) < 0.5)
    if path(0.5) > 0.5:
        assert sum(step.cuts for step in steps[2:]) == 0 and len(steps) < 12
    assert error(problem) < error(equal)


def turning(tolerance, path, by="values", comm=COMM):
    """A block that yields, pressed by ``path`` times a part of its height at its top or between both: largest plastic strain, and steps."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), comm, gdim=2, parameters={"n_lower": 2, "n_upper": 3})
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    flows, depth = uem.VonMises(u, 100.0, 0.3, 1.0, 10.0, kind="plane_strain"), fem.Constant(mesh, np.zeros(2))
    bcs = [uem.dirichlet(V, tags["lower_bottom"])]
    contact = uem.Contact(tags["upper_bottom"], tags["lower_top"])
    how = {"bcs": bcs, "contacts": [contact], "materials": [flows]}

    def load(f):
        if by == "offset":
            contact.offset = 0.04 * path(f)
        else:
            depth.value[1] = -0.04 * path(f)

    if by == "coupling":
        motion = (0.0, lambda f: -0.04 * path(f), 0.0)
        how["couplings"] = [uem.RigidCoupling(tags["upper_top"], point=(0.5, 2.0), motion=motion)]
    else:
        bcs.append(uem.dirichlet(V, tags["upper_top"], value=depth))
        how["load"] = load
    problem = uem.UnitedProblem(flows.residual(v), u, **how)
    steps = list(uem.load_steps(problem, 1, tolerance=tolerance))
    return comm.allreduce(flows.peeq.x.array.max(initial=0.0), op=MPI.MAX), steps


@pytest.mark.long
@pytest.mark.parametrize("by", ["values", slow("coupling"), slow("offset")])
def test_a_load_that_turns(by):
    """To and fro within a part of a step, with zeros at its ends and middle: the halves alone would not see it."""
    exact, _ = turning(None, lambda f: f, by)
    found, steps = turning(3e-3, lambda f: np.interp(f, [0.0, 0.13, 0.26, 1.0], [0.0, 1.0, 0.0, 0.0]), by)
    assert abs(found / exact - 1) < 0.1 and sum(step.cuts for step in steps) > 0
    straight, steps = turning(3e-3, lambda f: f, by)
    assert abs(straight / exact - 1) < 3e-3 and len(steps) == 1


def test_a_rigid_floor_that_turns():
    """A block on a floor that goes to and fro twice, with zeros at ends and middle of the step, slips: friction is at its limit."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    V, floor, way = uem.function_space(s.mesh, 1, (2,)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]), 0.05
    u, top = fem.Function(V), s.tag("top", 0, at(1, 1.0))
    contact = uem.Contact(s.tag("low", 0, at(1, 0.0)), floor, friction=0.01)
    bcs = [uem.dirichlet(V, top, 0), uem.dirichlet(V, top, 1, value=-0.02)]

    def load(t):
        floor.move([way * np.sin(2.0 * np.pi * t) ** 2, 0.0])

    problem = uem.UnitedProblem(linear(u, 1.0, 0.3), u, bcs=bcs, contacts=[contact], load=load)
    problem.set_load(0.0)
    problem.solve()
    list(uem.load_steps(problem, 1, tolerance=3e-3))
    friction, force = contact.resultant().force
    assert force > 0.0 and friction == pytest.approx(-0.01 * force, rel=1e-6)


def test_without_history():
    """Elastic bodies without friction are where they are whatever the steps: none is cut, and the state is the same."""
    found = []
    for tolerance in (None, 1e-6):
        scene = ramped(COMM)
        contact = scene.problem.contacts[0]
        assert contact.pair.friction is None
        scene.calls[0][0]()
        steps = list(uem.load_steps(scene.problem, 2, tolerance=tolerance))
        assert [step.factor for step in steps] == [0.5, 1.0]
        found.append(np.array(scene.problem.u.x.array))
    assert np.abs(found[0] - found[1]).max(initial=0.0) <= 1e-8 * COMM.allreduce(np.abs(found[0]).max(initial=0.0))


@pytest.mark.slow
def test_a_refused_step_leaves_nothing():
    """After a tolerance that no step reaches the body continues as another that has not tried."""
    problem, new = forming(COMM).problem, forming(COMM).problem
    refused(uem.StepAccuracyError, ["tolerance", "no better"], lambda: list(uem.load_steps(problem, 1, tolerance=1e-13)))
    elastic = problem.progress.factor
    assert 0 < elastic < 0.1 and problem.progress.steps == 1
    for factor in (elastic / 2, elastic):
        new.set_load(factor)
        new.solve()
    for one in (problem, new):
        assert [step.cuts for step in uem.load_steps(one, 4)] == [0] * 4
    assert np.array_equal(problem.u.x.array, new.u.x.array)
    assert np.array_equal(problem.contacts[0].force.x.array, new.contacts[0].force.x.array)


def test_what_is_refused():
    problem = forming(COMM).problem
    refused(uem.InputError, "between 0 and 1", lambda: uem.load_steps(problem, 1, tolerance=2.0))
    refused(uem.InputError, "arc_length", lambda: uem.load_steps(problem, 1, tolerance=0.1, arc_length=True))


@pytest.mark.slow
def test_gone_on_with(folder):
    """A run that is left and continued takes the same steps to the same end."""
    whole, steps = formed(1, 1e-3)
    for stop in (3, 99):
        problem = forming(COMM).problem
        made = []
        for step in uem.load_steps(problem, 1, tolerance=1e-3, checkpoint=uem.Checkpoint(folder / "run", every=1)):
            made.append(step.factor)
            if len(made) == stop:
                break
    assert made == [step.factor for step in steps][-len(made) :] and len(made) < len(steps)
    assert np.abs(problem.u.x.array - whole.u.x.array).max(initial=0.0) <= 1e-12
