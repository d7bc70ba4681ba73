"""Gradients through the history of friction: against differences, on any ranks, and where they are refused.

Read first: ``test_of_second_order``, Taylor's test of steps in which some contactors stick and others slip.
"""

from __future__ import annotations

import re
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import DRAGGED, changed, control_of, dot, drag_anew, dragged
from helpers import blocks, clamp, linear, modulus, refused, run, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.mark.long
@pytest.mark.parametrize("cell, rigid, law, names, how", [DRAGGED[0], *(slow(*scene) for scene in DRAGGED[1:])])
def test_of_second_order(cell, rigid, law, names, how):
    """``J(h) - J(0) - h J'`` vanishes with h^2 over all steps, for every kind of control, where the same contactors stick and slip."""
    s = dragged(cell, rigid, law, **how)
    found, reported = s.solve(), {}
    assert any(0 < stick < active for active, stick in found.states)
    for name, by in zip(names, found.history.gradient(s.J, [control_of(s, found.contact, name) for name in names])):
        change = changed(s, name)
        slope = dot(by, change) if isinstance(by, fem.Function) else float(np.sum(by * change))

        def functional(h, name=name, change=change):
            again, J = drag_anew(s, name, change, h)
            assert again.states == found.states, f"{name} changes sticking contactors: take another scene"
            return J

        reported[name] = uem.taylor_test(functional, slope, 4e-4, 1)
    assert min(reported.values()) >= 1.95, reported


@pytest.mark.slow
def test_a_turned_sphere_is_the_same():
    """A ball turned about its centre in all steps takes its anchors along: nothing changes, in space neither, where slips turn."""
    s = dragged("hexahedron", "sphere", "linear")
    found = s.solve()
    by_turn, by_place = found.history.gradient(s.J, [uem.ContactParameter(found.contact, name) for name in ("turn", "place")])
    assert np.abs(by_turn).max() <= 1e-12 * np.abs(by_place).max()


def test_functionals_of_every_step():
    """A sum over steps has the sum of their gradients, the state is left as it is, and a step that is taken again takes its own place."""
    s = dragged("triangle", None, "linear")
    found = s.solve()
    history, u, n = found.history, np.array(s.u.x.array), len(found.history)
    first, last, both = (history.gradient(J, s.top)[0] for J in ([s.J, None], s.J, [s.J, s.J]))
    assert both == pytest.approx(first + last, rel=1e-10) and n == 2
    assert np.array_equal(u, s.u.x.array) and s.full.value == pytest.approx(s.values["full"])


def test_without_friction_it_is_the_gradient():
    """Steps without memory, and two ramps: the history's gradient is that of the last state, of Dirichlet values from both ramps."""
    b = blocks(COMM, "triangle", 2, 3)
    E, top = fem.Constant(b.scene.mesh, 1.0), fem.Constant(b.scene.mesh, np.array([0.0, -0.05]))
    bcs = [*clamp(b.V, b.bottom), fem.dirichletbc(top, fem.locate_dofs_topological(b.V, 1, b.top.entities), b.V)]
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)], rtol=1e-12)
    J = ufl.inner(b.u, b.u) * ufl.dx
    with uem.recording(problem) as history:
        run(problem, 2)
        top.value[1] = -0.06
        run(problem, 3)
        problem.solve()
    assert len(history) == 6
    for by, now in zip(history.gradient(J, [E, top]), uem.gradient(problem, J, [E, top])):
        assert by == pytest.approx(now, rel=1e-10)


def test_what_is_refused():
    """What began before it was recorded, what has other memories, and functionals that no step belongs to."""
    b = blocks(COMM, "triangle", 2, 2)
    F, options = linear(b.u, modulus(b.scene, 1.0, 1.0)), {"bcs": b.oedometer(0.01)}
    J = b.u[0] * ufl.dx

    def problem(**how):
        return uem.UnitedProblem(F, b.u, contacts=[uem.Contact(b.high, b.low, **{"friction": 0.3, **how})], **options)

    def record(of):
        with uem.recording(of) as history:
            return history

    refused(uem.InputTypeError, "problem = 3", lambda: record(3))
    for how, words in (
        ({"sliding": "small"}, "sliding='finite'"),
        ({"friction": uem.Tresca(1.0)}, "Coulomb's law"),
        ({"friction": uem.Coulomb(0.3, 1.0)}, "Coulomb's law, without limit"),
        ({"wear": 1e-3}, "no wear"),
        ({"offset": 1e-3}, "no offset with nodes"),
        ({"adjust": 1e-3, "coupling": "mortar"}, "no offset with nodes, and no adjust"),
        ({"normals": "averaged"}, "normals='facet'"),
    ):
        refused(uem.InputError, f"has derivatives for {words}", lambda how=how: record(problem(**how)))
    fit = problem(coupling="mortar", offset=1e-3)
    by_offset = {"controls": uem.ContactParameter(fit.contacts[0], "offset")}
    refused(uem.InputError, "with friction and coupling='mortar'", lambda: uem.recording(fit, **by_offset).__enter__())
    begun = problem()
    run(begun)
    refused(uem.InputError, "expected a problem that is recorded from its first step on", lambda: record(begun))
    refused(uem.InputError, "take the steps within uem.recording(problem)", lambda: uem.gradient(begun, J, []))
    new = problem()
    with uem.recording(new) as history:
        refused(uem.InputError, "has taken no step", lambda: history.gradient(J, []))
        refused(uem.InputError, "expected one history at a time", lambda: record(new))
        run(new)
    refused(uem.InputError, "J has 2 items: expected one for each of the 1 recorded steps", lambda: history.gradient([J, J], []))
    refused(uem.InputError, "J holds no functional", lambda: history.gradient([None], []))
    refused(uem.InputTypeError, "J[0] = 1.0", lambda: history.gradient([1.0], []))
    with uem.recording(problem()) as history:
        history.problem.contacts[0].friction = 0.0
        run(history.problem)
    mu = uem.ContactParameter(history.problem.contacts[0], "friction")
    refused(uem.InputError, "expected a positive coefficient everywhere", lambda: history.gradient(J, mu))
    led = fem.Constant(b.scene.mesh, 0.0)
    contact = uem.Contact(b.high, b.low)
    by_function = uem.UnitedProblem(
        F - led * ufl.TestFunction(b.V)[0] * ufl.dx, b.u, contacts=[contact], load={led: lambda f: 0.0}, **options
    )
    with uem.recording(by_function) as other:
        run(by_function)
    refused(uem.InputError, "controls[0] is set by a function of the load factor", lambda: other.gradient(J, led))
    with uem.recording(problem()) as history:
        run(history.problem)
    pressure = history.problem.contacts[0].pressure * ufl.ds
    refused(uem.InputError, "of forces take the residual", lambda: history.gradient(pressure, []))


@pytest.mark.slow
def test_page_of_optimisers():
    """SciPy's optimiser and PETSc's find the modulus and the load that a displacement was computed with."""
    page, known = (REPOSITORY / "demos" / "site" / "howto" / "optimise.md").read_text(encoding="utf-8"), {}
    exec(compile("".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL)), "optimise.md", "exec"), known)
    for name in ("by_scipy", "by_tao"):
        assert known[name] == pytest.approx([1.0, 0.05], rel=1e-3), name


def test_friction_that_is_a_function_of_place_has_no_gradient_by_the_shape():
    """The coefficient at a node changes with its place; other controls keep their gradients."""
    b = blocks(COMM, "triangle", 2, 2)
    E = fem.Constant(b.scene.mesh, 1.0)
    F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    contact = uem.Contact(b.high, b.low, friction=lambda x: 0.2 + 0.1 * x[0])
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.01), contacts=[contact])
    with uem.recording(problem) as history:
        run(problem)
    J = ufl.inner(b.u, b.u) * ufl.dx
    X = ufl.SpatialCoordinate(b.scene.mesh)
    refused(uem.InputError, "a function of place", lambda: history.gradient(J, X))
    assert np.isfinite(history.gradient(J, E)[0]).all()
