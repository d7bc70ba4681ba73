"""Coulomb friction by elimination; every converged state is checked for its law by the fixture in conftest.

The tests to read first are ``test_a_block_slides_at_mu_times_its_load`` and ``test_friction_holds_a_block``.
"""

import numpy as np
import pytest
from friction_scenes import driven, loose
from helpers import CELLS, highest, refused

import uem_dolfinx as uem


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.9])
@pytest.mark.parametrize("rigid", [True, False])
def test_a_block_slides_at_mu_times_its_load(mu, rigid):
    """Driven far enough the whole surface slips, and the force along the base is mu times the force on it."""
    scene = driven("quadrilateral", mu, rigid=rigid, how={"sliding": "finite" if rigid else "fixed"})
    assert scene.to(0.0, -0.01)
    assert scene.states[0] > 0
    for x in np.linspace(0.0, 0.1 if mu > 0.5 else 0.06, 7)[1:]:
        scene.to(x, -0.01)
    sticking, slipping = scene.states
    # at a high coefficient the rear lifts off
    assert sticking == 0 and slipping >= (5 if mu < 0.5 else 3)
    f = scene.contact.resultant().force
    assert abs(-f[0] / (mu * f[1]) - 1) <= 1e-10
    if not rigid:
        assert scene.contact.balance().force <= 1e-12


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("rigid", [True, False])
def test_friction_holds_a_block(cell, rigid):
    """Pushed with less than mu times its weight, it stays: weight, push and friction balance. It is pushed back as well."""
    scene = loose(cell, 0.3, rigid=rigid, rtol=1e-12)
    g = scene.problem.config.gdim
    for push in (0.0, 0.15, 0.27, -0.2):
        load = np.zeros(g)
        load[0], load[-1] = push, -1.0
        scene.under(*load)
        assert np.abs(scene.contact.resultant().force + load).max() <= 1e-12
        if not rigid:
            balance = scene.contact.balance()
            assert balance.force <= 1e-12 and balance.moment <= 1e-11


def test_no_friction_is_the_contact_without():
    """A coefficient of zero, or one that is zero everywhere, leaves every bit as it is without friction."""
    found = []
    for how in ({}, {"friction": 0.0}, {"friction": lambda x: 0.0 * x[0]}):
        scene = driven("quadrilateral", 0.0, how={})
        scene = driven("quadrilateral", how.get("friction", 0.0))
        scene.to(0.01, -0.02)
        found.append(scene.problem.u.x.array.tobytes())
        assert type(scene.contact.pair) is uem.contact.pair.ContactPair
    assert len(set(found)) == 1


def test_what_sticks_does_not_move():
    """All of it sticks at a high coefficient: then it is one body with its base, to rounding, on the way forth and back."""
    scene = driven("quadrilateral", 50.0)
    scene.to(0.0, -0.01)
    for x in (0.001, 0.004, -0.003):
        scene.to(x, -0.01)
        assert scene.states == (5, 0)
        assert highest(scene.problem.comm, np.abs(scene.contact.pair.slip)) <= 1e-15


def test_fields_of_results():
    """Status, traction, slip and pressures agree with the forces."""
    scene = driven("quadrilateral", 0.3, rigid=True)
    scene.to(0.0, -0.01)
    scene.to(0.05, -0.01)
    contact, pair = scene.contact, scene.contact.pair
    assert set(contact.status.x.array[pair.nodes]) <= {2.0}
    traction = contact.traction.x.array.reshape(-1, 2)[pair.nodes]
    assert np.abs(traction + 0.3 * contact.pressures[:, None] * [1.0, 0.0]).max(initial=0.0) <= 1e-15
    slipped = contact.slip.x.array.reshape(-1, 2)[pair.nodes]
    assert (slipped[:, 0] > 0.03).all() and not slipped[:, 1].any()
    assert contact.dissipation > 0


def test_the_coefficient_may_be_a_function_of_place():
    """Where there is no friction everything slips, at no force."""
    scene = driven("quadrilateral", lambda x: np.where(x[0] > 0.6, 0.4, 0.0), rigid=True)
    scene.to(0.0, -0.01)
    scene.to(0.002, -0.01)
    pair = scene.contact.pair
    smooth = pair.points[:, 0] < 0.6
    assert not pair.trial.friction.stick[smooth].any()
    assert np.abs(pair.trial.force[smooth, 0]).max(initial=0.0) <= 1e-12
    force = scene.contact.resultant().force
    assert force[0] < -1e-4


@pytest.mark.parametrize(
    "mu, words",
    [(-0.1, "friction"), (np.nan, "friction"), ("much", "friction"), (lambda x: -x[0] - 1, "friction"), (lambda x: 1.0, "shape")],
)
def test_coefficients_that_are_none(mu, words):
    error = uem.InputTypeError if isinstance(mu, str) else uem.InputError
    refused(error, words, lambda: driven("quadrilateral", mu))
