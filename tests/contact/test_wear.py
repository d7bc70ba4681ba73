"""Wear by Archard's law: depths and volumes of flat pins in closed form, conservation of volume, and what a run continues from.

Read first: ``test_a_flat_pin_wears_evenly``.
"""

from __future__ import annotations

import logging

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, linear, modulus, raised, run, scene, slow
from restart_scenes import bits

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.friction.wear import worn_volume

COMM = MPI.COMM_WORLD
K, P, WAY = 1e-2, 0.02, 0.5


class Pin:
    """A block whose guided top is pressed down by a pressure, or by a settlement, onto a rigid floor that is drawn under it.

    Args:
        press: on the top; None holds it at the settlement ``P / E``.
        unit: of length; that of force is its square.
    """

    def __init__(self, *, cell="quadrilateral", degree=1, wear=K, press=P, unit=1.0, n=2, **options):
        g = self.g = 3 if cell in ("hexahedron", "tetrahedron") else 2
        self.unit = unit
        s = scene(COMM, cell, [box(cell, [0.0] * g, [unit] * g, [n] * g)])
        V = compat.function_space(s.mesh, degree, (g,))
        self.u, v, load, place = fem.Function(V), ufl.TestFunction(V), fem.Constant(s.mesh, 0.0), fem.Constant(s.mesh, 0.0)
        low, top = s.tag("low", 0, at(g - 1, 0.0, 1e-9 * unit)), s.tag("top", 0, at(g - 1, unit, 1e-9 * unit))
        self.floor = uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0])
        self.contact = uem.Contact(low, self.floor, wear=wear, name="pin", **options)
        bcs = [uem.dirichlet(V, top, c) for c in range(g - 1)]
        if press is None:
            bcs += [fem.dirichletbc(place, fem.locate_dofs_topological(V.sub(g - 1), g - 1, top.entities), V.sub(g - 1))]

        def drive(t):
            load.value, place.value = press or 0.0, -P * unit
            self.floor.move([-WAY * unit * t, *[0.0] * (g - 1)])

        self.drive = drive
        F = linear(self.u, 1.0, 0.0) + load * v[g - 1] * uem.ds(top)
        self.problem = uem.UnitedProblem(F, self.u, bcs=bcs, contacts=[self.contact])

    def slide(self, steps=4, begin=0):
        """Press, and draw the floor by ``WAY`` in equal steps."""
        for i in range(begin, steps + 1):
            self.drive(i / steps)
            self.problem.solve()
        return self

    @property
    def depths(self):
        """Depths of this rank's contactors ``(n,)``."""
        return self.contact.wear.x.array[self.contact.nodes]


@pytest.mark.parametrize(
    ("cell", "degree", "coupling"),
    [
        ("quadrilateral", 1, "node_to_surface"), ("quadrilateral", 1, "mortar"), ("triangle", 2, "node_to_surface"),
        slow("triangle", 2, "mortar"), slow("hexahedron", 1, "node_to_surface"), slow("hexahedron", 2, "mortar"),
        slow("tetrahedron", 2, "node_to_surface"),
    ],
)  # fmt: skip
def test_a_flat_pin_wears_evenly(cell, degree, coupling):
    """Depth k p s at every node and volume k N s, to rounding, in however many steps; the pin follows its wear down."""
    pin = Pin(cell=cell, degree=degree, coupling=coupling).slide(3)
    np.testing.assert_allclose(pin.depths, K * P * WAY, rtol=1e-11)
    assert pin.contact.worn_volume == pytest.approx(K * P * WAY, rel=1e-12)
    pin.problem.solve()
    assert pin.contact.worn_volume == pytest.approx(K * P * WAY, rel=1e-12)
    np.testing.assert_allclose(pin.contact.points[:, -1], -K * P * WAY, rtol=1e-9)
    assert pin.contact.max_gap() <= 1e-14


def test_units_do_not_matter():
    """Nanometres and kilometres wear as metres do."""
    found = [Pin(unit=unit, coupling="mortar").slide(2) for unit in (1e-9, 1e3)]
    for pin in found:
        np.testing.assert_allclose(pin.depths / pin.unit, K * P * WAY, rtol=1e-9)
        assert pin.contact.worn_volume / pin.unit**2 == pytest.approx(K * P * WAY, rel=1e-9)


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_a_pin_that_is_held_loses_its_pressure(coupling):
    """Held at its top it wears until it no longer presses, ``p = p0 exp(-k E s / H)``, with an error of the second order in the step."""
    k, p, errors = 1.0, P * np.exp(-WAY), []
    for steps in (5, 10):
        pin = Pin(wear=k, press=None, coupling=coupling).slide(steps)
        pressure, depth = (COMM.allreduce(values.max(initial=0.0), op=MPI.MAX) for values in (pin.contact.pressures, pin.depths))
        errors.append((abs(float(pressure) / p - 1), abs(float(depth) / (P - p) - 1)))
    assert max(errors[0]) <= 0.004
    assert (np.array(errors[1]) <= 0.3 * np.array(errors[0])).all()


@pytest.mark.parametrize(
    ("cell", "degree", "coupling"),
    [("quadrilateral", 1, "node_to_surface"), slow("quadrilateral", 1, "mortar"), slow("triangle", 2, "mortar")],
)
def test_volume_is_that_of_the_dissipation(cell, degree, coupling):
    """Where all slips on, unevenly, the volume is k over mu times what Coulomb's friction takes: both are of forces and slips."""
    b = blocks(COMM, cell, 3, 4, degree=degree, overhang=0.5)
    g, mu = b.gdim, 0.2
    contact = uem.Contact(b.high, b.low, coupling=coupling, friction=mu, wear=K)
    place = fem.Constant(b.scene.mesh, np.zeros(g))
    top = fem.dirichletbc(place, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 3.0, 1.0)), b.u, bcs=[*clamp(b.V, b.bottom), top], contacts=[contact]
    )
    place.value[:] = [*[0.0] * (g - 1), -0.01]
    run(problem)
    place.value[:] = [0.1, *[0.02] * (g - 2), -0.01]
    run(problem, 3)
    before = np.array([contact.worn_volume, K / mu * contact.dissipation])
    place.value[:] = [0.15, *[0.03] * (g - 2), -0.01]
    run(problem)
    worn, taken = np.array([contact.worn_volume, K / mu * contact.dissipation]) - before
    assert worn == pytest.approx(taken, rel=1e-6) and worn > 0
    balance = contact.balance()
    assert balance is not None and balance.force <= 1e-12


def test_coefficients_of_place_and_worn_shapes():
    """A pin that wears on its right half alone is borne by its left one in the end."""
    pin = Pin(wear=lambda x: 0.5 * (x[0] > 0.5), press=None).slide(8)
    right = pin.contact.points[:, 0] > 0.5
    assert (pin.depths[~right] == 0.0).all() and (pin.depths[right] > 0.0).all()
    lam = pin.contact.pair.trial.lam
    assert COMM.allreduce(lam[~right].sum()) > 1.1 * COMM.allreduce(lam[right].sum())


def test_a_step_taken_again_wears_once():
    """Depths of a step that is taken again are those of one step."""
    once, twice = Pin(friction=0.1, press=None).slide(3), Pin(friction=0.1, press=None)
    for i in range(4):
        twice.drive(i / 3)
        twice.problem.solve()
        with twice.problem.progress.checking_signals(COMM):
            twice.problem.progress.inside = True
            twice.problem.solve()
            twice.problem.progress.inside = False
    np.testing.assert_allclose(twice.depths, once.depths, rtol=1e-9)


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_wear_continues_from_a_checkpoint(coupling, folder):
    """A run that continues from a file ends as the one that was left alone, to the last bit in serial."""
    whole, first, last = (Pin(friction=0.1, press=None, coupling=coupling) for _ in range(3))
    whole.slide(4)
    for i in range(3):
        first.drive(i / 4)
        first.problem.solve()
    uem.write_checkpoint(folder / "run", first.problem.state())
    uem.read_checkpoint(folder / "run", last.problem.state())
    np.testing.assert_array_equal(last.depths, first.depths)
    last.slide(4, begin=3)
    np.testing.assert_allclose(last.depths, whole.depths, rtol=1e-12)
    if COMM.size == 1:
        assert np.array_equal(bits(whole.u.x.array), bits(last.u.x.array))
        assert np.array_equal(bits(whole.depths), bits(last.depths))


def test_steps_that_wear_too_much(caplog):
    """Beyond explicit Euler's bound of the surface a warning names it; below there is none."""
    for k, warned in ((2.0, False), (8.0, True)):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            Pin(wear=k).slide(2)
        reported = COMM.bcast(any("take turns in bearing" in record.message for record in caplog.records))
        assert reported == warned


def test_the_law():
    """The mean of force times way at both ends; tension wears nothing."""
    found = worn_volume(2.0 * np.ones(3), np.array([0.5, -0.5, 0.0]), np.array([1.5, 0.5, 0.5]))
    np.testing.assert_allclose(found, [2.0, 0.5, 0.5], rtol=1e-15)


def test_what_is_refused():
    """Negative coefficients, points, and what never slips."""
    raised(uem.InputError, "wear = -1", lambda: Pin(wear=-1.0))
    raised(uem.InputError, "contact 'pin': wear", lambda: Pin(wear=lambda x: -1.0 + 0 * x[0]))
    raised(uem.InputError, "wear does not go with tied = True", lambda: Pin(tied=True))
    assert Pin(wear=0.0).contact.worn_volume == 0.0
