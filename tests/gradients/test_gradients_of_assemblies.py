"""Gradients of assemblies: controls by features, each product of second order by Taylor's test.

The page on gradients has a table of the same rows and columns. Read first: ``FEATURES`` of ``assembly_scenes``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from assembly_scenes import EACH, FEATURES, MOTION, NEEDS_HISTORY, assembly, change_of, controls_of, order, preload, scene
from gradient_scenes import along, move, wave
from helpers import refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("what", [what for what in FEATURES if what not in NEEDS_HISTORY])
def test_of_second_order(what):
    """All controls together."""
    assert order(*scene(what)) >= 1.95


@pytest.mark.long
@pytest.mark.parametrize("what", FEATURES)
def test_histories_of_second_order(what):
    """All controls together, and functionals of all steps, which show what values have reached in each."""
    assert order(*scene(what), 3, True) >= 1.95


@pytest.mark.slow
@pytest.mark.parametrize("what, name", EACH)
def test_each_of_second_order(what, name):
    """One control after the other."""
    s, _ = scene(what)
    assert order(s, (name,), 2 if what in NEEDS_HISTORY else 1, what in NEEDS_HISTORY) >= 1.95


@pytest.mark.slow
@pytest.mark.parametrize("what, error", [("tie by mortar across a gap", 1e-8), ("shortening by mortar", 1e-8)])
def test_shape_of_means_by_differences(what, error):
    """By the shape, against central differences of fourth order."""
    s, _ = scene(what)
    s.solve()
    change, x, values = wave(s.b.V, 0.02), s.b.scene.mesh.geometry.x, []
    slope, places = along(uem.gradient(s.problem, s.J, [s.X]), [change]), np.array(x)
    for h in (0.05, -0.05, 0.1, -0.1):
        x[:] = places
        move(s, change, h)
        values.append(s.solve())
    assert slope == pytest.approx((8 * (values[0] - values[1]) - values[2] + values[3]) / 0.6, rel=error)


#: What is exact in time, with its own control.
IN_TIME = {"tie": (), "preload": ("force",), "shortening": ("shortening",), "equation": ("b of the equation",)}
IN_TIME |= {"force and spring at nodes": ("force at a node",)}


@pytest.mark.long
@pytest.mark.parametrize("what", IN_TIME)
def test_in_time(what):
    """Each control against central differences of all steps; forces act on the first acceleration, too."""
    s, _ = scene(what)
    names = ("E", "load", *IN_TIME[what])
    s.solve(0.8, True, dynamics=True)
    controls = controls_of(s, names)
    found = s.history.gradient(s.J, list(controls.values()))
    for by, (name, control) in zip(found, controls.items()):
        change, values = change_of(s, name, control), []
        for h in (1e-4, -1e-4):
            before = s.numbers[name] if name in s.numbers else np.array(control.value)
            if name in s.numbers:
                s.numbers[name] = before + h * change
            else:
                control.value[...] = before + h * change
            s.solve(0.8, True, dynamics=True)
            values.append(uem.integrate(s.J))
            if name in s.numbers:
                s.numbers[name] = before
            else:
                control.value[...] = before
        assert float(np.sum(by * change)) == pytest.approx((values[0] - values[1]) / 2e-4, rel=1e-6)


def staged(second=None):
    """A bolt that is tightened by a Step, locked by the next, and loaded; with the values by which it is changed."""
    s = assembly(feature=preload, axis=(0.1, 1.0))
    s.load.value[:] = 0.0
    F = s.field * uem.NeoHooke(s.E, 0.3, kind="plane_strain").residual(s.u, ufl.TestFunction(s.b.V)) * ufl.dx
    F = F - ufl.inner(s.load, ufl.TestFunction(s.b.V)) * ufl.dx

    def solve(E=1.0, force=0.05, end=(0.03, 0.02)):
        s.E.value, s.numbers["force"], s.b.u.x.array[:], s.load.value[:] = E, force, 0.0, 0.0
        s.contact = preload(s, axis=(0.1, 1.0))["contacts"][0]
        problem = uem.UnitedProblem(F, s.u, bcs=s.bcs, contacts=[s.contact], rtol=1e-13)
        steps = [uem.Step(name="tighten"), uem.Step(name="pull", loads={s.load: end}, preload={s.contact: None}, n=2)]
        with uem.recording(problem) as s.history:
            total = sum(uem.integrate(s.J) for _ in uem.load_steps(problem, steps if second is None else second(s)))
        return total

    s.solve = solve
    return s


def test_steps():
    """Steps that tighten, lock and pull: of second order by modulus, force and the load at the end."""
    s = staged()
    s.solve()
    controls = [s.E, uem.ContactParameter(s.contact, "force"), s.load]
    by = s.history.gradient([s.J] * len(s.history), controls)
    slope = float(0.3 * by[0] + 0.02 * by[1] + by[2] @ [0.01, 0.02])
    assert len(s.history) == 3
    found = uem.taylor_test(lambda h: s.solve(1 + 0.3 * h, 0.05 + 0.02 * h, (0.03 + 0.01 * h, 0.02 + 0.02 * h)), slope, 0.02, 1)
    assert found >= 1.95
    others = staged(lambda s: [uem.Step(name="other", bcs=s.bcs)])
    refused(uem.InputError, "Steps with conditions", others.solve)


BOTH_WAYS = ("tie across a gap", "preload", "shortening", "coupling, spring", "coupling, led", "equation")


@pytest.mark.long
@pytest.mark.parametrize("what", BOTH_WAYS)
def test_forward_as_backward(what):
    """The adjoint's derivative is the one of the displacement, put into J."""
    s, names = scene(what)
    s.solve()
    controls = controls_of(s, names)
    pairs = [(control, change_of(s, name, control)) for name, control in controls.items()]
    du = uem.tangent(s.problem, pairs)
    explicit = ufl.derivative(s.J, s.u, du) + ufl.derivative(s.J, s.field, change_of(s, "field", s.field))
    by_E = ufl.diff(ufl.replace(s.E * s.u[0] * s.u[s.g - 1], {s.E: (E := ufl.variable(s.E))}), E) * float(change_of(s, "E", s.E))
    found = uem.integrate(explicit) + uem.integrate(ufl.algorithms.expand_derivatives(by_E * ufl.dx))
    if "X" in controls:
        found += uem.integrate(ufl.algorithms.expand_derivatives(ufl.derivative(s.J, s.X, change_of(s, "X", s.X))))
    by = along(uem.gradient(s.problem, s.J, list(controls.values())), [change for _, change in pairs])
    assert found == pytest.approx(by, rel=1e-10)


@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize("what", FEATURES)
def test_on_any_ranks(what):
    """The same derivatives along a change, on one rank and on all."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        s, names = scene(what, comm)
        s.solve(2, True)
        controls = controls_of(s, names)
        by = s.history.gradient([s.J] * len(s.history), list(controls.values()))
        found.append([along([b], [change_of(s, name, c)]) for b, (name, c) in zip(by, controls.items())])
    assert found[0] == pytest.approx(found[1], rel=1e-8)


def test_pressures_of_ties():
    """Pressures next to a tie have derivatives, those of a tie itself have none."""
    s, _ = scene("tie")
    s.solve()
    J = s.problem.contacts[0].pressure * uem.ds(s.b.high) + s.u[0] * ufl.dx
    refused(uem.InputError, "pressure of", lambda: uem.gradient(s.problem, J, s.E))


def test_pressures_with_equations_and_couplings():
    """Of second order, with rows of users in addition to those of the contact."""
    for what, names in (("equation", ("E", "b of the equation")), ("coupling, led", ("E", *MOTION))):
        s, _ = scene(what)
        s.solve()
        controls = controls_of(s, names)

        def functional(h):
            for name, c in controls.items():
                c.value[...] = before[name] + h * change_of(s, name, c)
            s.solve()
            return uem.integrate(s.problem.contacts[0].pressure ** 2 * uem.ds(s.b.high))

        before = {name: np.array(c.value) for name, c in controls.items()}
        J = s.problem.contacts[0].pressure ** 2 * uem.ds(s.b.high)
        by = along(uem.gradient(s.problem, J, list(controls.values())), [change_of(s, n, c) for n, c in controls.items()])
        assert uem.taylor_test(functional, by, 0.02, 1) >= 1.95
