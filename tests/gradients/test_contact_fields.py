"""Functions as friction and offset of contacts: values at contactors, and derivatives by them.

Read first: ``test_by_friction``, Taylor's test of steps in which some contactors stick and others slip.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import changed, control_of, dot, drag_anew, dragged, move, pressed, wave
from helpers import blocks, linear, modulus, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def rough(W):
    """A coefficient of friction that differs from node to node, on a space."""
    f = wave(W, 0.1)
    f.x.array[:] += 0.3
    return f


@pytest.mark.long
@pytest.mark.parametrize("cell, law", [("triangle", "neo"), slow("tetrahedron", "linear"), slow("hexahedron", "linear")])
def test_by_friction(cell, law):
    """``J(h) - J(0) - h J'`` vanishes with h^2 for changes of the coefficient from node to node, and of the shape that takes it along."""
    s = dragged(cell, None, law, mu=rough)
    f, found = s.values["friction"], s.solve()
    assert any(0 < stick < active for active, stick in found.states)
    by, by_shape = found.history.gradient(s.J, [f, control_of(s, found.contact, "X")])
    before, change = np.array(f.x.array), wave(f.function_space, 1.0)

    def at(h):
        f.x.array[:] = before + h * change.x.array
        again = s.solve()
        assert again.states == found.states
        f.x.array[:] = before
        return uem.integrate(s.J)

    assert uem.taylor_test(at, dot(by, change), 1e-3, 1) >= 1.95
    if cell == "tetrahedron":
        # feet on edges of the flat target, which other places turn over either of two facets: one-sided derivatives
        return
    shift = changed(s, "X")
    assert uem.taylor_test(lambda h: drag_anew(s, "X", shift, h)[1], dot(by_shape, shift), 4e-4, 1) >= 1.95


@pytest.mark.long
@pytest.mark.parametrize("rigid", [None, slow("plane"), slow(True)])
@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron"), slow("hexahedron")])
def test_by_offset(cell, rigid):
    """Changes of an offset from node to node, backwards and forwards, of displacements and pressures; the shape takes it along."""
    s = pressed(cell, rigid=rigid)
    s.values["offset"] = f = wave(compat.function_space(s.b.scene.mesh, ("Lagrange", 1)), 2e-3)
    problem, before, change = s.solve(), np.array(f.x.array), wave(f.function_space, 0.1)
    J = s.J + s.of_pressures(problem)
    by, by_shape = uem.gradient(problem, J, [f, s.X])
    du = uem.tangent(problem, [(f, change)])
    slope = dot(by, change)
    assert uem.integrate(ufl.derivative(s.J, s.u, du)) == pytest.approx(dot(uem.gradient(problem, s.J, f)[0], change), rel=1e-8)

    def at(h):
        f.x.array[:] = before + h * change.x.array
        return uem.integrate(s.J + s.of_pressures(s.solve()))

    assert uem.taylor_test(at, slope, 1e-3, 2) >= 1.95
    f.x.array[:] = before
    x, shift = np.array(s.b.scene.mesh.geometry.x), wave(s.b.V, 0.05)

    def moved(h):
        s.b.scene.mesh.geometry.x[:] = x
        move(s, shift, h)
        return uem.integrate(s.J + s.of_pressures(s.solve()))

    assert uem.taylor_test(moved, dot(by_shape, shift), 1e-3, 2) >= 1.95


@pytest.mark.long
def test_sums_are_the_derivatives_by_a_uniform_change():
    """All entries together make the derivative by a uniform increment, of the friction in a history and of the offset in a state."""
    s = dragged("triangle", mu=rough)
    found = s.solve()
    one = uem.ContactParameter(found.contact, "friction")
    by, whole = found.history.gradient(s.J, [s.values["friction"], one])
    every = fem.Function(by.function_space)
    every.x.array[:] = 1.0
    assert dot(by, every) == pytest.approx(float(whole), rel=1e-10)
    s = pressed("triangle")
    s.values["offset"] = f = wave(compat.function_space(s.b.scene.mesh, ("Lagrange", 1)), 2e-3)
    problem = s.solve()
    by, whole = uem.gradient(problem, s.J, [f, uem.ContactParameter(problem.contacts[0], "offset")])
    every = fem.Function(by.function_space)
    every.x.array[:] = 1.0
    assert dot(by, every) == pytest.approx(float(whole), rel=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("cell, degree, coupling", [("triangle", 1, "mortar"), slow("quadrilateral", 2, "node_to_surface")])
def test_the_same_as_functions_of_position(cell, degree, coupling):
    """A Function and the function of position that it interpolates give the same state, with both couplings; new values are read."""
    b = blocks(COMM, cell, 3, 4, degree=degree)
    W = compat.function_space(b.scene.mesh, ("Lagrange", degree))
    states = []
    for size in (1.0, 2.0):

        def mu(x, size=size):
            return size * (0.1 + 0.1 * x[0])

        def off(x, size=size):
            return size * 0.002 * (1.0 + x[0])

        for kind in ("functions", "Functions"):
            f, g = fem.Function(W), fem.Function(W)
            b.u.x.array[:] = 0.0
            how = {"friction": mu, "offset": off} if kind == "functions" else {"friction": f, "offset": g}
            contact = uem.Contact(b.high, b.low, coupling=coupling, **how)
            problem = uem.UnitedProblem(
                linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=[contact], rtol=1e-12
            )
            # the values that a step reads are those at its beginning, not those of the making
            f.interpolate(mu)
            g.interpolate(off)
            run(problem, 2)
            states.append(np.array(b.u.x.array))
    assert COMM.allreduce(np.abs(states[0] - states[1]).max(), op=MPI.MAX) <= 1e-11
    assert COMM.allreduce(np.abs(states[2] - states[3]).max(), op=MPI.MAX) <= 1e-11
    assert COMM.allreduce(np.abs(states[0] - states[2]).max(), op=MPI.MAX) >= 1e-4


def test_what_is_refused():
    """Functions of other nodes or values, in a ramp and among pairs, and offsets whose gaps are of several nodes."""
    b = blocks(COMM, "triangle", 2, 2)
    F, bcs = linear(b.u, modulus(b.scene, 1.0, 1.0)), b.oedometer(0.01)

    def problem(**how):
        return uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low, **how)])

    W = compat.function_space(b.scene.mesh, ("Lagrange", 1))
    for space in (("DG", 0), ("DG", 1), ("Lagrange", 2)):
        f = fem.Function(compat.function_space(b.scene.mesh, space))
        for what in ("friction", "offset"):
            refused(
                uem.InputTypeError, f"{what} = a Function: expected a scalar Function with", lambda w=what, f=f: problem(**{w: f})
            )
    refused(uem.InputTypeError, "expected a scalar Function with", lambda: problem(friction=b.u))
    f = fem.Function(W, name="mu")
    f.x.array[:] = -1.0
    refused(uem.InputError, "friction, the Function 'mu', has values that are not", lambda: problem(friction=f))
    f.x.array[:] = 0.2
    rubbing = problem(friction=f)
    contact = rubbing.contacts[0]
    step = uem.Step(friction={contact: 0.1})
    refused(uem.InputError, "is a Function, which a Step does not ramp", lambda: next(iter(uem.load_steps(rubbing, [step]))))
    refused(uem.InputTypeError, "wear = a Function: expected a number or a function of position", lambda: problem(wear=f))
    f.x.array[:] = 1e-3
    thick = problem(offset=f)
    step = uem.Step(offset={thick.contacts[0]: 0.1})
    refused(uem.InputError, "is a Function, which a Step does not ramp", lambda: next(iter(uem.load_steps(thick, [step]))))
    by_mortar = problem(offset=f, coupling="mortar")
    by_mortar.solve()
    J = ufl.inner(b.u, b.u) * ufl.dx
    refused(uem.InputError, "there is no derivative by its values with mortar", lambda: uem.gradient(by_mortar, J, f))
