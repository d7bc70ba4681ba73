"""Laws of pressure by gap, as numbers: slopes, tables, functions of users, and what is no law."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from helpers import M, blocks, highest, linear, lowest, refused, run

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
TABLE = [(-3e-6, 4e6), (-1e-6, 1e6), (0.0, 0.0)]
LAWS = [1e12, uem.Exponential(1e6, 2e-6), uem.PowerLaw(1e6, 1e-6, 2.0), uem.PowerLaw(1e6, 1e-6, 1.0), TABLE]


def pressures(p, gap, slope=None):
    """Pressures and slopes of a soft contact."""
    return uem.SoftContact(p, slope).pressures(COMM, "joint", np.atleast_1d(np.array(gap, dtype=float)), 1e-15)


@pytest.mark.parametrize("law", LAWS, ids=type)
def test_slopes(law):
    """They are the derivatives, 0 or negative; pressures are 0 or positive, and continue beyond the data."""
    gap = np.array([-7e-6, -2.2e-6, -0.4e-6, 0.3e-6, 5e-6])
    p, slope = pressures(law, gap)
    h = 1e-10
    assert slope == pytest.approx((pressures(law, gap + h)[0] - pressures(law, gap - h)[0]) / (2 * h), rel=1e-6, abs=1e-6)
    assert (p >= 0).all() and (slope <= 0).all() and (np.diff(p) <= 0).all()
    rest = uem.SoftContact(law).law.rest
    assert pressures(law, rest)[1][0] < 0


def test_a_table():
    """Linear between its points, its first slope below them, nothing above."""
    assert pressures(TABLE, [-5e-6, -3e-6, -2e-6, -0.5e-6, 0.0, 1e-6])[0] == pytest.approx([7e6, 4e6, 2.5e6, 5e5, 0.0, 0.0])


def test_an_exponential_law_far_out():
    """No overflow deep inside, where it continues linearly; rounding of p0 is nothing far outside."""
    law, h = uem.Exponential(1e6, 2e-6), 2e-6
    p, slope = pressures(law, np.array([-1e3, -35.0, 35.0, 37.0]) * h)
    assert (
        np.isfinite(p).all()
        and p[1] == pytest.approx(1e6 * np.exp(35.0))
        and slope[0] == pytest.approx(-1e6 / h / np.finfo(float).eps)
    )
    assert p[2] > 0.0 and p[3] == 0.0 and slope[3] == 0.0


def test_slopes_by_differences():
    """Of a function, to a few parts in 10^8 at gaps of any size; a slope that is given is taken."""
    p0, h = 3e5, 1e-6
    gap = np.array([-2e-5, *np.linspace(-1.5e-9, -1e-9, 50), 1e-7, 5e-6])
    _, slope = pressures(lambda g: p0 * np.exp(-g / h), gap)
    assert slope == pytest.approx(-p0 / h * np.exp(-gap / h), rel=1e-7)
    assert pressures(lambda g: p0 * np.exp(-g / h), gap, slope=lambda g: -5.0 + 0 * g)[1] == pytest.approx(-5.0)


@pytest.mark.parametrize(
    ("p", "error", "words"),
    [
        (0.0, uem.InputError, "a positive number"),
        ("stiff", uem.InputTypeError, "a positive number"),
        (None, uem.InputTypeError, "a positive number"),
        ([(0.0, 1.0)], uem.InputError, "two or more pairs"),
        ([(-1.0, 1.0), (0.0, 0.5)], uem.InputError, "end with 0"),
        ([(-1.0, 1.0), (-0.5, 2.0), (0.0, 0.0)], uem.InputError, "do not increase"),
        ([(0.0, 1.0), (-1.0, 0.0)], uem.InputError, "ascending"),
        ([("a", 1.0), (0.0, 0.0)], uem.InputTypeError, "two or more pairs"),
    ],
)
def test_what_is_no_law(p, error, words):
    refused(error, words, lambda: uem.SoftContact(p))


def test_functions_that_are_no_law():
    """Pressures that pull, that grow with the gap, or too few of them are named."""
    for p in (lambda g: -1.0 + 0 * g, lambda g: g**2, lambda g: np.zeros(2), lambda g: g + np.nan):
        refused(
            uem.InputError, ("contact 'joint': normal", "do not increase with the gap"), lambda p=p: pressures(p, [0.5, 1.0, 2.0])
        )
    refused(uem.UserFunctionError, "no pressure today", lambda: pressures(_raising, [0.5]))
    refused(uem.InputTypeError, "slope", lambda: uem.SoftContact(1.0, slope=lambda g: g))
    refused(uem.InputError, "p0", lambda: uem.Exponential(-1.0, 1.0))
    refused(uem.InputError, "at least 1", lambda: uem.PowerLaw(1.0, 1.0, 0.5))


def _raising(gap):
    raise ValueError("no pressure today")


FLAT = {
    "a kink": (lambda g: 20.0 * np.maximum(-g, 0.0), lambda g: np.where(g < 0.0, -20.0, 0.0)),
    "a parabola": (lambda g: 2e4 * np.maximum(-g, 0.0) ** 2, lambda g: -4e4 * np.maximum(-g, 0.0)),
    "later": (lambda g: 20.0 * np.maximum(-g - 1e-3, 0.0), None),
    "later, by its slope": (lambda g: 20.0 * np.maximum(-g - 1e-3, 0.0), lambda g: np.where(g < -1e-3, -20.0, 0.0)),
}


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("name", FLAT)
@pytest.mark.every_case
def test_a_law_without_a_slope_at_rest(name, coupling):
    """In the first step, too, pressures are those of the gaps; it once ended with overlapping bodies and without a force."""
    b = blocks(COMM, "quadrilateral", 2, 2)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(*FLAT[name]), coupling=coupling)
    run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.01), contacts=[contact]))
    gap = contact.pair.gaps()
    for p in (FLAT[name][0](gap), 0.5 * M * (0.01 + gap)):
        assert highest(COMM, np.abs(contact.pressures - p)) <= 1e-9 * M
    assert lowest(COMM, contact.pressures) >= 0.2 * 0.01 * M
