"""Heat through a general contact: as through contacts of pairs, once where nodes follow each other, and through rigid surfaces.

Read first: ``test_as_declared_by_hand``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from field_scenes import fields, strain, stress
from helpers import blocks, highest, refused, run, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
COLD, HOT, K, PRESS = 100.0, 300.0, 2.0, 0.01


class Bars:
    """Guided blocks of the same meshes, cold at the bottom and hot at the top, whose upper one is pressed down.

    Args:
        contacts: makes the contacts of the blocks.
        wall: whether a wall is in place of what presses and heats the top.
    """

    def __init__(self, contacts, cell="triangle", degree=1, *, wall=False, n=3):
        b = self.b = blocks(COMM, cell, n, n, degree=degree)
        f = fields(b, degree, degree)
        (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
        F = (ufl.inner(stress(u, 1e3, 0.3), strain(v)) + K * ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
        bcs = [*f.confined(), uem.dirichlet(f.other, b.bottom, value=COLD)]
        if not wall:
            bcs += [uem.dirichlet(f.space, b.top, b.gdim - 1, -PRESS), uem.dirichlet(f.other, b.top, value=HOT)]
        self.contacts = contacts(b)
        self.problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=self.contacts)
        run(self.problem)
        self.T = self.problem.config.functions()["field_1"]


H = {"constant": 5.0, "by pressure": lambda p, g: 0.5 * p, "united": np.inf}


@pytest.mark.parametrize("h", H)
@pytest.mark.parametrize(
    "cell,degree", [("triangle", 1), slow("quadrilateral", 1), ("triangle", 2), slow("tetrahedron", 1), slow("hexahedron", 1)]
)
def test_as_declared_by_hand(cell, degree, h):
    """All temperatures, and the heat that passes, are those of a contact of the two sides, up to the edges."""
    heat = uem.Conductance(H[h], field=1)
    one = Bars(lambda b: [uem.Contact(b.high, b.low, heat=heat)], cell, degree)
    other = Bars(lambda b: [uem.GeneralContact(heat=heat, order=[b.high])], cell, degree)
    # both scenes are the same mesh on the same ranks
    assert highest(COMM, np.abs(one.T.x.array - other.T.x.array)) < 1e-9 * HOT
    contact = other.contacts[0]
    assert contact.heat_balance() < 1e-13
    flux, found = one.contacts[0].heat_flux.x.array, contact.heat_flux.x.array
    leads = flux != 0
    assert highest(COMM, np.abs(found - flux)[leads]) < 1e-9 * highest(COMM, np.abs(flux))
    power = one.contacts[0].heat_power
    assert contact.heat_power("body 2", "body 1") == pytest.approx(power, rel=1e-8) and power > 0
    assert contact.heat_power("body 1") == pytest.approx(-power, rel=1e-8)


@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_through_a_rigid_surface(cell):
    """Two blocks pressed by a hot wall: four resistances in series; without a temperature nothing passes through the wall."""
    for temperature, wanted in ((HOT, (HOT - COLD) / (2 / K + 2 / 5.0)), (None, 0.0)):

        def contacts(b, temperature=temperature):
            g = b.gdim
            wall = uem.RigidPlane([0.0] * (g - 1) + [1.0 - PRESS], [0.0] * (g - 1) + [-1.0])
            heat = uem.Conductance(5.0, field=1, temperature=temperature)
            return [uem.GeneralContact(rigid=wall, heat=heat, max_penetration=0.1)]

        bars = Bars(contacts, cell, wall=True)
        for part in bars.contacts[0].parts:
            on = part.pair.trial.active & part.leads()
            size = np.abs(part.heat_flux.x.array[part.nodes[on]])
            assert highest(COMM, np.abs(size - wanted)) < 1e-9 * HOT


def test_by_mortar():
    """Each face of the upper block is a contact of its own; the flux is that of three resistances in series."""
    bars = Bars(lambda b: [uem.GeneralContact(heat=uem.Conductance(5.0, field=1), coupling="mortar", order=[b.high])])
    contact = bars.contacts[0]
    flux = contact.heat_flux.x.array[contact.active.x.array > 0]
    assert highest(COMM, np.abs(flux / ((HOT - COLD) / (2 / K + 1 / 5.0)) - 1.0)) < 1e-9
    assert contact.heat_balance() < 1e-13


def test_what_touches_nothing_is_not_searched(monkeypatch):
    """Of the lists of a general contact those with nothing on them look for nothing that is opposite."""
    from uem_dolfinx.contact.thermal import heat

    requested = []
    monkeypatch.setattr(heat, "sides_of", lambda pair, of=heat.sides_of: (requested.append(pair), of(pair))[1])
    bars = Bars(lambda b: [uem.GeneralContact(heat=uem.Conductance(5.0, field=1))])
    first, *others = bars.contacts[0].parts
    assert {id(pair) for pair in requested} == {id(first.pair)} and len(others) == 2


def test_what_is_refused():
    """Heat through gaps, which a general contact does not look at, and a temperature of no surface."""
    through = uem.Conductance(lambda p, g: 1.0 / (1.0 + g), field=1)
    refused(
        uem.InputError, ("h(0, g) is 0.99", "where surfaces touch"), lambda: Bars(lambda b: [uem.GeneralContact(heat=through)])
    )
    heat = uem.Conductance(1.0, field=1, temperature=3.0)
    refused(uem.InputError, "temperature is of rigid surfaces", lambda: uem.GeneralContact(heat=heat))
    refused(uem.InputTypeError, ("heat = 3", "Conductance"), lambda: uem.GeneralContact(heat=3.0))
