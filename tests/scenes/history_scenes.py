"""Motions and flows whose end depends on all that there are derivatives by."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from gradient_scenes import dot, wave
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def thrown(comm=COMM, law=uem.LinearElastic, scheme=None, damped=True, friction=0.0, shaken=False, wall=True, end=0.16):
    """A block that is thrown at a leaning rigid plane, comes off again, and may be held at its top by what shakes it.

    ``solve()`` takes all steps anew with the present values of all that the motion depends on.
    """
    gap = 0.02
    s = scene(comm, "quadrilateral", [box("quadrilateral", [0.0, gap], [1.0, 1.0 + gap], [2, 6])])
    mesh, V = s.mesh, compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    tip, top = s.tag("tip", 0, at(1, gap)), s.tag("top", 0, at(1, 1.0 + gap))
    E, rho, viscosity = (fem.Constant(mesh, value) for value in (900.0, 1.0, 0.002))
    force, push, grows = (fem.Constant(mesh, np.array(value)) for value in ((0.3, -5.0), (0.0, 0.0), (1.0, 0.5)))
    thrown_by, hand = fem.Function(V), fem.Function(V)
    thrown_by.x.array.reshape(-1, 2)[:] = [0.1, -1.0]
    spin = wave(V, 0.1)
    thrown_by.x.array[:] += spin.x.array
    F = law(E, 0.3, kind="plane_strain").residual(u, v) * ufl.dx - ufl.inner(force + push, v) * ufl.dx
    way = fem.Function(V)

    def lead(time):
        """Put the hand where it is at a time."""
        hand.x.array.reshape(-1, 2)[:] = np.array([0.3, -0.5]) * np.sin(9 * time)
        hand.x.array[:] += way.x.array

    def solve(**how):
        u.x.array[:] = 0.0
        push.value[:] = 0.0
        viscous = viscosity * E
        damping = (lambda w: viscous * ufl.inner(ufl.sym(ufl.grad(w)), ufl.sym(ufl.grad(v))) * ufl.dx) if damped else None
        contact = uem.Contact(tip, uem.RigidPlane([0.0, 0.0], [0.1, 1.0]), friction=friction)
        dynamics = uem.Dynamics(
            uem.consistent_mass(V, rho), velocity=thrown_by, scheme=scheme, damping=damping, gravity=[0.0, -1.0]
        )
        bcs = [uem.dirichlet(V, top, value=hand)] if shaken else []
        problem, states = (
            uem.UnitedProblem(
                F, u, bcs=bcs, contacts=[contact] if wall else [], dynamics=dynamics, load={push: grows.value}, rtol=1e-13
            ),
            [],
        )
        lead(0.02)
        with uem.recording(problem, **how) as history:
            for step in uem.time_steps(problem, 0.02, end):
                states.append((round(step.dt, 9), contact.n_active if wall else 0))
                lead(step.time + 0.02)
        w = dynamics.velocity
        J = ufl.inner(u, u) * ufl.dx + 0.05 * rho * ufl.inner(w, w) * ufl.dx
        return SimpleNamespace(problem=problem, history=history, contact=contact, states=states, J=J)

    return SimpleNamespace(
        V=V, u=u, F=F, E=E, rho=rho, viscosity=viscosity, force=force, push=push, grows=grows, velocity=thrown_by, hand=hand, way=way,
        solve=solve,
    )  # fmt: skip


def slope_of(by, changes):
    """Derivative along all changes together, of what ``changes`` of controls tell (collective)."""
    parts = zip(by, (change for _, _, change in changes))
    return sum(dot(b, c) if isinstance(b, fem.Function) else float(np.sum(b * c)) for b, c in parts)


def slope_alone(s, changes):
    """That of a scene on one rank alone."""
    found = s.solve()
    return slope_of(found.history.gradient(found.J, [control for control, _, _ in changes]), changes)


def alone():
    """A communicator of this rank."""
    return COMM.Create_group(COMM.group.Incl([COMM.rank]))


def taylor(s, changes, size=1e-3):
    """Order of Taylor's test of a scene with all controls changed together, and the slope.

    Args:
        s: with ``solve()``, which returns the history, the functional, and the states that are to stay.
        changes: of each control the values that tell it and the change of these.
    """
    found = s.solve()
    slope = slope_of(found.history.gradient(found.J, [control for control, _, _ in changes]), changes)
    values = [reported.x.array if isinstance(reported, fem.Function) else reported.value for _, reported, _ in changes]
    before = [np.array(reported) for reported in values]

    def functional(h):
        for reported, old, (_, _, change) in zip(values, before, changes):
            reported[...] = old + h * (change.x.array if isinstance(change, fem.Function) else change)
        again = s.solve()
        assert again.states == found.states, f"other steps or contactors at {h}: take another scene"
        return uem.integrate(again.J)

    order = uem.taylor_test(functional, slope, size, 1)
    for reported, old in zip(values, before):
        reported[...] = old
    return order, slope


BACK_STRESSES = [(0.0, 0.0), (0.005, 0.15), (0.02, 0.3)]


def bent(
    cell="quadrilateral", kind="plane_strain", strain="small", comm=COMM, steps=2, friction=0.0, law_of=uem.VonMises, moves=None
):
    """A plastic block that is pressed against a rigid plane by its bottom, and goes back a little, in some steps each way.

    ``moves`` is its kinematic hardening, or a table of back stresses, then without isotropic hardening.
    ``solve()`` makes the law anew with the present values of its parameters, and takes all steps.
    """
    g = 3 if cell == "hexahedron" else 2
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)])
    mesh, V = s.mesh, compat.function_space(s.mesh, 1, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    bottom, top = s.tag("bottom", 0, at(g - 1, 0.0)), s.tag("top", 0, at(g - 1, 1.0))
    E, nu, flow = (fem.Constant(mesh, value) for value in (200.0, 0.3, 0.4))
    hardening = fem.Function(compat.function_space(mesh, ("DG", 0)))
    hardening.interpolate(lambda x: 15.0 + 5.0 * x[0])
    kinematic = fem.Constant(mesh, moves) if isinstance(moves, float) else moves or 0.0
    load, led = fem.Constant(mesh, np.full(g, 0.02)), fem.Constant(mesh, np.zeros(g))
    led.value[0], led.value[-1] = 0.004, 0.012
    w = fem.Function(V)
    compat.set_bc_values(w.x.array, [uem.dirichlet(V, bottom, g - 1, 1.0)])
    w.x.scatter_forward()

    def solve():
        u.x.array[:] = 0.0
        way = np.array(led.value)
        how = {} if law_of is uem.FinitePlasticity else {"strain": strain}
        isotropic = 0.0 if kinematic is BACK_STRESSES else hardening
        law = law_of(u, E, nu, flow, isotropic, kinematic_hardening=kinematic, kind=kind, **how)
        F = law.residual(v) - ufl.inner(load, v) * ufl.dx
        contact = uem.Contact(top, uem.RigidPlane([0.0] * (g - 1) + [1.0], [0.0] * (g - 1) + [-1.0]), friction=friction)
        bcs = [fem.dirichletbc(led, fem.locate_dofs_topological(V, g - 1, bottom.entities), V)]
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], materials=[law], rtol=1e-13)
        states = []
        with uem.recording(problem) as history:
            for back in (0.0, 0.0006):
                led.value[:] = way
                led.value[-1] -= back
                for step in uem.load_steps(problem, steps):
                    states.append((step.factor, contact.n_active, int((law.peeq.x.array > 0).sum())))
        led.value[:] = way
        J = ufl.inner(u, u) * ufl.dx + ufl.replace(F, {v: w})
        return SimpleNamespace(problem=problem, history=history, contact=contact, states=states, J=J, law=law)

    return SimpleNamespace(
        V=V, u=u, E=E, nu=nu, flow=flow, hardening=hardening, kinematic=kinematic, load=load, led=led, solve=solve
    )


def changes_of_flow(s):
    """Changes of all controls of ``bent``."""
    g = len(s.led.value)
    some = [(s.E, 20.0), (s.nu, 0.02), (s.flow, 0.04), (s.load, np.full(g, 0.02)), (s.led, np.full(g, 1e-3))]
    if s.kinematic is not BACK_STRESSES:
        some.append((s.hardening, wave(s.hardening.function_space, 2.0)))
    return [*some, (s.kinematic, 2.0)] if isinstance(s.kinematic, fem.Constant) else some
