"""Tangents of histories: the derivative of all displacements, put into functionals, is the adjoint's, over friction, plasticity,
preloads, and motions.

The adjoint's derivatives are of second order in tests of their own. Read first: ``test_forward_as_backward``.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import DRAGGED, along, changed, control_of, dragged, wave
from helpers import blocks, refused, slow
from history_scenes import BACK_STRESSES, COMM, alone, bent, changes_of_flow, thrown

import uem_dolfinx as uem


def both(u, J, history, pairs):
    """The derivative of the sum of J over all steps along a direction, forwards and backwards."""
    by = history.gradient([J] * len(history), [control for control, _ in pairs])
    back, onward = along(by, [change for _, change in pairs]), 0.0
    tangents, now = history.tangent(pairs), np.array(u.x.array)
    for k, du in enumerate(tangents):
        u.x.array[:] = history._records[k].displacement
        form = ufl.derivative(J, u, du)
        for control, change in pairs:
            if isinstance(control, ufl.SpatialCoordinate):
                form += ufl.derivative(J, control, change)
        onward += uem.integrate(ufl.algorithms.expand_derivatives(form))
    u.x.array[:] = now
    return onward, back


def pairs_of(s, contact, names):
    """Controls of a dragged scene, and changes."""
    return [(control_of(s, contact, name), changed(s, name)) for name in names]


@pytest.mark.long
@pytest.mark.parametrize("cell, rigid, law, names, how", [DRAGGED[0], *(slow(*scene) for scene in DRAGGED[1:])])
def test_forward_as_backward(cell, rigid, law, names, how):
    """Over steps in which some contactors stick and others slip, along all controls at once, on any ranks."""
    found = []
    for comm in (COMM, alone()) if COMM.size > 1 else (COMM,):
        s = dragged(cell, rigid, law, steps=2 if how else 3, comm=comm, **how)
        steps = s.solve()
        assert any(0 < stick < active for active, stick in steps.states)
        J = ufl.inner(s.u, s.u) * ufl.dx
        onward, back = both(s.u, J, steps.history, pairs_of(s, steps.contact, (*names, "top", "full")))
        assert onward == pytest.approx(back, rel=1e-9)
        found.append(onward)
    assert found[0] == pytest.approx(found[-1], rel=1e-9)


def test_a_function_as_friction():
    """Each contactor with its own coefficient."""
    s = dragged("triangle", mu=lambda V: wave(V, 0.05))
    mu = s.values["friction"]
    mu.x.array[:] += 0.3
    steps = s.solve()
    J = ufl.inner(s.u, s.u) * ufl.dx
    onward, back = both(s.u, J, steps.history, [(mu, wave(mu.function_space))])
    assert onward == pytest.approx(back, rel=1e-9) and abs(back) > 1e-6


FLOWS = [
    {"kind": "plane_stress"},
    {"friction": 0.2},
    slow({"cell": "hexahedron", "kind": "3d"}),
    slow({"kind": "plane_stress", "moves": 10.0}),
    slow({"law_of": uem.FinitePlasticity, "moves": 10.0, "friction": 0.2}),
    slow({"law_of": uem.FinitePlasticity, "moves": BACK_STRESSES}),
]


@pytest.mark.slow
@pytest.mark.parametrize("how", FLOWS)
def test_through_plastic_flow(how):
    """By all parameters of the law, and what leads the block."""
    s = bent(**how)
    found = s.solve()
    J, pairs = ufl.inner(s.u, s.u) * ufl.dx, changes_of_flow(s)
    for some in ([pair] for pair in pairs) if COMM.size == 1 else ():
        onward, back = both(s.u, J, found.history, some)
        assert onward == pytest.approx(back, rel=1e-9)
    onward, back = both(s.u, J, found.history, pairs)
    assert onward == pytest.approx(back, rel=1e-9)


def test_of_locked_sections():
    """A bolt keeps the opening that its force has given it; without friction the step before the last determines its derivative."""
    b = blocks(COMM, "triangle", 3, 4, overhang=0.2)
    E, load = fem.Constant(b.scene.mesh, 1.0), fem.Constant(b.scene.mesh, np.zeros(2))
    v = ufl.TestFunction(b.V)
    F = uem.NeoHooke(E, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx - ufl.inner(load, v) * ufl.dx
    bolt = uem.Preload(b.high, b.low, (0.1, 1.0), force=0.05)
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[bolt], rtol=1e-13)
    with uem.recording(problem) as history:
        problem.solve()
        pairs = [(E, 0.3), (uem.ContactParameter(bolt, "force"), 0.02), (load, np.array([0.01, 0.02]))]
        first = uem.tangent(problem, pairs).x.array
        assert history.tangent(pairs)[0].x.array == pytest.approx(first, rel=1e-9, abs=1e-10 * np.abs(first).max())
        bolt.lock()
        load.value[:] = 0.03, 0.02
        problem.solve()
    onward, back = both(b.u, ufl.inner(b.u, b.u) * ufl.dx, history, pairs)
    assert onward == pytest.approx(back, rel=1e-9)


def test_the_place_of_one_of_two_planes():
    """A plane takes the anchors of its own contactors along, not those on another plane: as by differences of all steps."""
    b = blocks(COMM, "triangle", 3, 4, gap=0.5)
    mesh, v, J = b.scene.mesh, ufl.TestFunction(b.V), ufl.inner(b.u, b.u) * ufl.dx
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx
    ways = ((b.low, [0.05, -0.05]), (b.top, [0.06, -0.05]))
    bcs = [uem.dirichlet(b.V, tag, None, fem.Constant(mesh, np.array(way))) for tag, way in ways]

    def solve(h):
        b.u.x.array[:] = 0.0
        planes = uem.RigidPlane([0.5, -1.0], [0.02, 1.0]), uem.RigidPlane([0.5, 0.5], [-0.03, 1.0])
        planes[0].move(np.array([0.5 * h, h]))
        contacts = [uem.Contact(tag, plane, friction=0.3) for tag, plane in zip((b.bottom, b.high), planes)]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=contacts, rtol=1e-13)
        with uem.recording(problem) as history:
            return sum(uem.integrate(J) for _ in uem.load_steps(problem, 3)), history

    h = 1e-5
    _, history = solve(0.0)
    onward, back = both(b.u, J, history, [(uem.ContactParameter(history.problem.contacts[0], "place"), np.array([0.5, 1.0]))])
    assert onward == pytest.approx(back, rel=1e-9)
    assert back == pytest.approx((solve(h)[0] - solve(-h)[0]) / (2 * h), rel=1e-6)


MOTIONS = [
    {"scheme": uem.generalised_alpha(0.7)},
    slow({"law": uem.NeoHooke, "friction": 0.2, "damped": False}),
    slow({"law": uem.NeoHooke, "scheme": uem.generalised_alpha(0.7), "shaken": True, "end": 0.3}),
    slow({"friction": 0.2, "shaken": True}),
]


@pytest.mark.slow
@pytest.mark.parametrize("how", MOTIONS)
def test_through_motions(how):
    """By what a motion with impact depends on, each alone and all at once: over initial state, damping, density and what shakes the top."""
    s = thrown(**how)
    found, two = s.solve(), np.ones(2)
    assert any(active for _, active in found.states)
    pairs = [(s.E, 90.0), (s.rho, 0.1), (s.force, two), (s.push, two), (s.velocity, wave(s.V, 0.2))]
    pairs += [(s.viscosity, 1e-3)] if how.get("damped", True) else []
    pairs += [(s.hand, wave(s.V, 0.1))] if how.get("shaken") else []
    J = ufl.inner(s.u, s.u) * ufl.dx
    for some in [*([pair] for pair in pairs if COMM.size == 1), pairs]:
        onward, back = both(s.u, J, found.history, some)
        assert onward == pytest.approx(back, rel=1e-9)


def test_what_is_refused():
    """What is no direction, and the displacement."""
    s = dragged("triangle")
    steps = s.solve()
    refused(uem.InputTypeError, "direction = a Constant", lambda: steps.history.tangent(s.E))
    refused(uem.InputError, "direction[0] holds the displacement", lambda: steps.history.tangent([(s.u, s.u)]))
