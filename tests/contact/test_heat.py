"""Heat through a contact: jumps and fluxes of bars in series, the same on both sides to rounding, and what is refused.

Read first: ``test_bars_in_series``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields, strain, stress
from heat_scenes import COLD, HOT, Bars, K
from helpers import blocks, factors, highest, linear, modulus, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx.solve.bodies.tangent import slip_terms

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(
    ("cell", "coupling", "degree", "of_heat", "h", "how"),
    [
        ("triangle", "node_to_surface", 1, 1, 5.0, {}), ("triangle", "mortar", 1, 1, np.inf, {"sliding": "small"}),
        ("triangle", "node_to_surface", 2, 1, 5.0, {"measure": "current"}), ("triangle", "mortar", 2, 2, np.inf, {}),
        ("triangle", "mortar", 2, 1, 5.0, {"tied": True}), ("tetrahedron", "node_to_surface", 1, 1, np.inf, {}),
        slow("triangle", "mortar", 2, 2, 5.0, {"friction": 0.3}), slow("triangle", "node_to_surface", 2, 2, np.inf, {"tied": True}),
        slow("quadrilateral", "mortar", 2, 1, 5.0, {}), slow("tetrahedron", "node_to_surface", 1, 1, 5.0, {"friction": 0.3}),
        slow("tetrahedron", "node_to_surface", 2, 2, np.inf, {}), slow("tetrahedron", "mortar", 1, 1, np.inf, {}),
        slow("hexahedron", "mortar", 1, 1, 5.0, {"sliding": "fixed"}),
    ],
)  # fmt: skip
def test_bars_in_series(cell, coupling, degree, of_heat, h, how):
    """The jump is q/h, the flux that of three resistances in series, in one linear solve; what leaves one body enters the other."""
    n = 3 if coupling == "node_to_surface" else 4
    bars = Bars(h, cell=cell, degree=degree, of_heat=of_heat, n=n, coupling=coupling, **how)
    (step,) = run(bars.problem)
    flux = (HOT - COLD) / (2 / K + 1 / h)
    assert step.newton_iterations == 1
    assert highest(COMM, np.abs(bars.flux / flux - 1.0)) < 1e-12
    own, c = bars.temperature, bars.contact
    theirs = c.opposite(own).x.array[c.nodes]
    assert highest(COMM, np.abs(theirs - (COLD + flux / K))) < 1e-12 * HOT
    here = fem.Function(c.heat_flux.function_space)
    here.interpolate(own)
    assert highest(COMM, np.abs(here.x.array[c.nodes] - theirs - flux / h)) < 1e-12 * HOT
    assert c.heat_balance() < 1e-15
    # heat that enters at one end leaves at the other, to the rounding of the solve: 1.5e-13 at degree 2 on Debian 13
    cold, hot = bars.ends()
    assert abs(hot / flux - 1.0) < 1e-12 and abs(hot + cold) < 1e-12 * hot


def test_an_open_gap_lets_nothing_through():
    """Both bodies have the temperature of their ends, with a number and with perfect conductance; a function sees the gap."""
    for h in (5.0, np.inf):
        bars = Bars(h, gap=0.1)
        run(bars.problem)
        T, c = bars.temperature.x.array, bars.contact
        assert highest(COMM, np.minimum(np.abs(T - HOT), np.abs(T - COLD))) < 1e-9
        assert highest(COMM, np.abs(bars.flux)) == 0.0 == c.heat_balance()
    bars = Bars(lambda p, g: 0.05 / (0.01 + g), gap=0.1, press=0.05)
    run(bars.problem)
    flux = (HOT - COLD) / (2 / K + 0.06 / 0.05)
    assert highest(COMM, np.abs(bars.flux / flux - 1.0)) < 1e-9


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_surfaces_that_do_not_match(coupling):
    """Bodies that lie askew and bent: what leaves one enters the other to rounding, whatever the meshes."""
    for h in (5.0, np.inf):
        bars = Bars(h, n=4, coupling=coupling, pose=lambda x: x + 0.1 * np.sin(2.0 * x[:, ::-1]))
        run(bars.problem)
        cold, hot = bars.ends()
        assert hot > 0.0 and abs(cold + hot) < 1e-12 * hot
        assert bars.contact.heat_balance() < 1e-13


def test_a_rigid_surface_has_a_temperature_that_is_given():
    """A block on it, hot at the top: the resistances of block and contact in series."""
    b = blocks(COMM, "triangle", 2, 3, gap=0.5)
    f = fields(b, 1, 1)
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    F = ufl.inner(stress(u, 1.0), strain(v)) * ufl.dx + K * ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx
    rest = [uem.dirichlet(f.space, tag, 1) for tag in (b.low, b.top)]
    bcs = [*f.confined(), *rest, uem.dirichlet(f.other, b.bottom), uem.dirichlet(f.other, b.top, value=HOT)]
    floor, cold = uem.RigidPlane((0.0, 0.5), (0.0, 1.0)), fem.Constant(b.scene.mesh, COLD)
    for h in (5.0, np.inf):
        c = uem.Contact(b.high, floor, offset=1e-3, heat=uem.Conductance(h, field=1, temperature=cold))
        run(uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[c]))
        flux = (HOT - COLD) / (1 / K + 1 / h)
        assert highest(COMM, np.abs(c.heat_flux.x.array[c.nodes] / flux - 1.0)) < 1e-12


def test_conductance_that_grows_with_the_pressure():
    """Pressures come from the iteration before: flux and pressure agree at the end, after a few more iterations."""
    bars = Bars(lambda p, g: 0.3 * p, alpha=1e-4, press=0.02, degree=2, above=4.0)
    (step,) = run(bars.problem)
    p = bars.contact.pressures
    flux = (HOT - COLD) / (1.25 / K + 1 / (0.3 * p))
    assert highest(COMM, np.abs(bars.flux / flux - 1.0)) < 1e-7
    assert 2 < step.newton_iterations < 9


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_conductances_are_functions_of_no_negative_pressure(coupling):
    """Contactors pull before their release, and the law gets no negative pressure; the heat that enters a body passes the contact."""
    least = []

    def h(p, g):
        least.append(p.min(initial=0.0))
        return 0.3 * p

    bars = Bars(h, alpha=1e-4, press=0.02, coupling=coupling)
    run(bars.problem)
    pair = bars.contact.pair
    assert min(least) >= 0.0
    assert bars.contact.heat_power == pytest.approx(bars.ends()[1], rel=1e-7)
    state = pair.trial
    pair.trial = replace(state, lam=-state.lam)
    assert highest(COMM, pair.heats[0].conductances()) == 0.0 == min(least)
    pair.trial = state


@pytest.mark.parametrize(
    ("coupling", "degree", "of_heat"), [slow("node_to_surface", 2, 1), ("mortar", 2, 2), slow("mortar", 1, 1)]
)
def test_the_tangent_is_the_residuals_derivative(coupling, degree, of_heat):
    """By temperatures, in which heat is linear: differences are exact. It is symmetric, and a constant makes no heat."""
    bars = Bars(5.0, n=4, coupling=coupling, degree=degree, of_heat=of_heat, pose=lambda x: x + 0.1 * np.sin(2.0 * x[:, ::-1]))
    run(bars.problem)
    heat, unknowns, w = bars.contact.pair.heats[0], bars.problem.config.unknowns, bars.f.w
    H, held = slip_terms(bars.problem.pairs, unknowns.vector())
    assert held is None and H.isSymmetric(1e-12 * H.norm())
    before, start = np.array(w.x.array), heat.residual()
    change = fem.Function(w.function_space)
    change.sub(1).interpolate(lambda x: np.sin(5.0 * x[0]) + x[1] ** 2)
    w.x.array[:] += change.x.array
    by = H * unknowns.vector(bars.problem.config.rows(change.x.array[: len(unknowns.place)]))
    assert highest(COMM, np.abs(heat.residual() - start - by.array_r)) < 1e-12 * by.norm()
    w.x.array[:] = before
    w.sub(1).interpolate(lambda x: 7.0 + 0.0 * x[0])
    w.x.scatter_forward()
    assert highest(COMM, np.abs(heat.residual())) < 1e-12 * np.abs(by.norm())


def test_the_tangent_by_gaps_and_pressures():
    """A function h is differentiated at every contactor: across an open gap to rounding, exactly by pressures where these are linear."""
    for h, gap, wanted in (
        (lambda p, g: 3.0 * g**2, 0.1, lambda p, g: 6.0 * g),
        (lambda p, g: 3e-4 * p**2, 0.0, lambda p, g: 6e-4 * p),
    ):
        bars = Bars(h, gap=gap, coupling="mortar", n=4)
        run(bars.problem)
        heat, c = bars.contact.pair.heats[0], bars.contact
        g, p = c.pair.kinematics.projection.gap, c.pressures
        slopes = wanted(p, np.where(c.pair.united, 0.0, g)) * heat.jump() * heat.passage.areas
        assert highest(COMM, np.abs(heat._slopes(0 if gap == 0.0 else 1)[0] / slopes - 1.0)) < 2.5e-8
    bars = Bars(lambda p, g: 0.05 / (0.01 + g), gap=0.1, n=4, coupling="mortar")
    run(bars.problem)
    heat, unknowns, w = bars.contact.pair.heats[0], bars.problem.config.unknowns, bars.f.w
    assert bars.contact.n_active == 0
    H, _ = slip_terms(bars.problem.pairs, unknowns.vector())
    # across the gap: weights do not change
    n, high = bars.problem.config.n_owned, (bars.problem.config.X[:, 1] > 0.05)[:, None]
    way = fem.Function(w.function_space)
    way.x.array[bars.problem.config.dofs] = high * np.array([0.0, 1e-6])
    by = H * unknowns.vector(bars.problem.config.rows(way.x.array[: len(unknowns.place)]))
    found = []
    for sign in (1.0, -1.0):
        w.x.array[:] += sign * way.x.array
        bars.problem.system.place()
        found.append(heat.residual())
        w.x.array[:] -= sign * way.x.array
    assert highest(COMM, np.abs(0.5 * (found[0] - found[1]) - by.array_r)) < 1e-6 * by.norm()
    assert by.norm() > 0.0 and (by.array_r[: 2 * n] == 0.0).all()


@pytest.mark.parametrize("coupling", ["mortar", slow("node_to_surface")])
def test_newtons_method_is_quadratic(coupling):
    """Where feet stay: heat that a growing pressure lets through, and heat through a gap that it closes."""
    bars = Bars(lambda p, g: 0.1 * p, coupling=coupling, n=4, press=0.02, alpha=1e-4, above=4.0, sliding="fixed")
    run(bars.problem)
    bars.hot.value = 400.0
    history = bars.problem.solve()
    assert len(history) <= 4 and max(factors(history)) < 1.0
    bars = Bars(lambda p, g: 0.05 / (0.01 + g), coupling=coupling, n=4, gap=0.1, press=0.0, alpha=7e-5, above=6.0)
    history = bars.problem.solve()
    assert len(history) <= 5 and bars.contact.n_active == 0 and max(factors(history)) < 1.0


class Rubbing:
    """A block held at its top on one that is drawn under it, insulated, in steps of time; other arguments as of ``Conductance``."""

    def __init__(self, h=0.0, *, coupling="mortar", share=0.25, n=3, **how):
        b = self.b = blocks(COMM, "triangle", 3, n, overhang=0.5)
        f = self.f = fields(b, 1, 1)
        self.old, self.dt, self.way = (
            fem.Function(f.w.function_space),
            fem.Constant(b.scene.mesh, 0.2),
            fem.Constant(b.scene.mesh, 0.0),
        )
        (u, self.T), (v, q), T_old = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space)), f.split(self.old)[1]
        F = ufl.inner(stress(u, 10.0), strain(v)) * ufl.dx
        F += ((self.T - T_old) / self.dt * q + K * ufl.inner(ufl.grad(self.T), ufl.grad(q))) * ufl.dx
        bcs = [uem.dirichlet(f.space, b.bottom, 0, self.way), uem.dirichlet(f.space, b.bottom, 1)]
        bcs += [uem.dirichlet(f.space, b.top, 0), uem.dirichlet(f.space, b.top, 1, -0.02)]
        heat = uem.Conductance(h, field=1, friction_share=share, dt=self.dt)
        self.contact = uem.Contact(b.high, b.low, friction=0.3, coupling=coupling, heat=heat, **how)
        self.problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[self.contact], rtol=1e-10)

    def slide(self, first=0, last=3):
        for i in range(first, last):
            self.way.value = 0.05 * i
            self.problem.solve()
            self.old.x.array[:] = self.f.w.x.array
        return self

    def heat(self, body):
        """What a body has in it."""
        mark = modulus(self.b.scene, *(float(body == i) for i in range(2)))
        return uem.integrate(mark * self.T * ufl.dx)


@pytest.mark.parametrize(
    ("coupling", "h"),
    [
        ("mortar", 0.0), ("node_to_surface", 3.0), slow("mortar", np.inf), slow("node_to_surface", 0.0), slow("mortar", 3.0),
        slow("node_to_surface", np.inf),
    ],
)  # fmt: skip
def test_heat_of_friction(coupling, h):
    """Bodies that conduct nothing to each other have their shares of the work in them; whatever they conduct, they have all of it."""
    rubbing = Rubbing(h, coupling=coupling).slide()
    work, own, theirs = rubbing.contact.dissipation, rubbing.heat(1), rubbing.heat(0)
    assert work > 1e-4
    assert abs((own + theirs) / work - 1.0) < 1e-9
    if h == 0.0:
        assert abs(own / (0.25 * work) - 1.0) < 1e-9
    assert rubbing.contact.heat_balance() < 1e-13


@pytest.mark.long
@pytest.mark.parametrize("h", [slow(lambda p, g: 2.0 * p + 0.1 / (1.0 + g)), np.inf])
def test_going_on_from_a_checkpoint(folder, h):
    """The rest is what it would have been, flux and all, which is among the results; a run with another share is refused."""
    whole = Rubbing(h).slide(0, 2)
    uem.write_checkpoint(folder / "run.uem", whole.problem.state())
    flux = whole.contact.heat_flux.x.array.copy()
    with uem.ResultsWriter(folder / "run", whole.problem) as writer:
        writer.write(1.0)
    assert 'Name="heat_flux"' in (folder / "run.xdmf").read_text()
    whole.slide(2, 3)
    rest = Rubbing(h)
    uem.read_checkpoint(folder / "run.uem", rest.problem.state())
    assert highest(COMM, np.abs(rest.contact.heat_flux.x.array - flux)) <= 1e-15 * highest(COMM, np.abs(flux))
    rest.old.x.array[:] = rest.f.w.x.array
    rest.slide(2, 3)
    assert highest(COMM, np.abs(rest.f.w.x.array - whole.f.w.x.array)) <= (0.0 if COMM.size == 1 else 1e-12)
    other = Rubbing(h, share=0.5)
    refused(uem.CheckpointError, "friction_share of heat", lambda: uem.read_checkpoint(folder / "run.uem", other.problem.state()))


@pytest.mark.long
def test_what_is_refused():
    """Each with what to do instead."""
    b = blocks(COMM, "triangle", 2, 2)
    f, floor = fields(b, 1, 1), uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    F = (ufl.inner(stress(u, 1.0), strain(v)) + ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx

    def made(h=1.0, target=b.low, field=1, **how):
        c = uem.Contact(b.high, target, heat=uem.Conductance(h, field=field, **how), name="c")
        return uem.UnitedProblem(F, f.w, displacement=0, contacts=[c])

    refused(uem.InputError, ("h = -1", "infinity"), lambda: uem.Conductance(-1.0, field=1))
    refused(uem.InputTypeError, "field = 'T'", lambda: uem.Conductance(1.0, field="T"))
    refused(uem.InputError, ("friction_share = 2", "from 0 to 1"), lambda: uem.Conductance(1.0, field=1, friction_share=2.0))
    refused(uem.InputTypeError, ("heat = 3", "Conductance"), lambda: uem.Contact(b.high, b.low, heat=3.0))
    refused(uem.InputError, ("contact 'c'", "field = 0", "[1]"), lambda: made(field=0))
    refused(uem.InputError, ("contact 'c'", "temperature", "leave it out"), lambda: made(temperature=1.0))
    refused(uem.InputError, ("contact 'c'", "rigid target", "give temperature"), lambda: made(target=floor))
    refused(uem.InputError, ("contact 'c'", "no friction"), lambda: made(friction_share=0.5))
    other = uem.Contact(b.high, b.low, heat=uem.Conductance(1.0, field=1))
    method = lambda *of, **how: None  # noqa: E731
    refused(
        uem.InputError, "leave method out", lambda: uem.UnitedProblem(F, f.w, displacement=0, contacts=[other], method=method)
    )
    plain = uem.Contact(b.high, b.low, heat=uem.Conductance(1.0, field=1), name="c")
    F_u = ufl.inner(strain(b.u), strain(ufl.TestFunction(b.V))) * ufl.dx
    refused(uem.InputError, ("contact 'c'", "displacement="), lambda: uem.UnitedProblem(F_u, b.u, contacts=[plain]))
    quadratic = fields(b, 1, 2)
    (u, T), (v, q) = quadratic.split(quadratic.w), quadratic.split(ufl.TestFunction(quadratic.w.function_space))
    F_2 = (ufl.inner(stress(u, 1.0), strain(v)) + ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
    high = uem.Contact(b.high, b.low, heat=uem.Conductance(1.0, field=1))
    refused(uem.SpaceError, "degree 1 or less", lambda: uem.UnitedProblem(F_2, quadratic.w, displacement=0, contacts=[high]))
    for h, error, words in (
        (lambda p, g: p - 1.0, uem.InputError, "heat, h(p, g)"),
        (lambda p: p, uem.UserFunctionError, "heat, h"),
    ):
        refused(error, words, lambda h=h: run(made(h)))


@pytest.mark.long
def test_page_on_heat():
    """Its example has the heat that friction makes in its bodies."""
    page = (Path(__file__).parents[2] / "demos" / "site" / "howto" / "heat.md").read_text(encoding="utf-8")
    known: dict[str, Any] = {}
    exec(compile(re.findall(r"```python\n(from .*?)```", page, re.DOTALL)[0], "heat.md", "exec"), known)
    assert known["inside"] == pytest.approx(known["contact"].dissipation, rel=1e-9) and known["inside"] > 0.0


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_what_contactors_face_without_heat(coupling):
    """A field that is linear along the surface is opposite as it is at the contactors, for a displacement alone, too."""
    b = blocks(COMM, "triangle", 3, 4, overhang=0.5)
    T, c = fem.Function(uem.function_space(b.scene.mesh, 1)), uem.Contact(b.high, b.low, coupling=coupling, name="c")
    refused(uem.SurfaceError, "belongs to no problem", lambda: c.opposite(T))
    run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.0), contacts=[c]))
    T.interpolate(lambda x: 2.0 + 3.0 * x[0])
    assert highest(COMM, np.abs(c.opposite(T).x.array[c.nodes] - 2.0 - 3.0 * c.points[:, 0])) < 1e-12
    assert highest(COMM, np.abs(c.heat_flux.x.array)) == 0.0 == c.heat_balance()
    refused(uem.InputTypeError, "scalar Function", lambda: c.opposite(3.0))
    refused(uem.InputError, ("contact 'c'", "scalar Function"), lambda: c.opposite(b.u))
