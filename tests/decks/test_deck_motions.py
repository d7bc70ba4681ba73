"""Decks with steps of time: free fall, motion that is damped, a wave in a column, and what is refused.

Read first: ``test_a_column_that_falls``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from deck_scenes import columns, written
from helpers import refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, RHO, G = 2.1e5, 7.8e-9, 9810.0
STEEL = f"*MATERIAL, NAME=STEEL\n*ELASTIC\n{E}, 0.0\n*DENSITY\n{RHO}\n"
SECTION = "*SOLID SECTION, ELSET=body 1, MATERIAL=STEEL\n"
FIRST = "*INITIAL CONDITIONS, TYPE=VELOCITY\nall, 3, 2.0\n"


def column(more="", material=STEEL):
    """Of height 1, in free space."""
    return columns([(0.0, 1.0, 2)]) + material + SECTION + more


def places(folder, text, node=121):
    """Displacements of a node along the column at the ends of all steps of time."""
    deck = uem.read_deck(written(folder, text), COMM)
    return np.array([(step.time, deck.displacement(node)[2]) for step in deck.run()]).T


def test_a_column_that_falls(folder):
    """Weight from the beginning, and a velocity: ``v t - g t^2 / 2``; the second step begins where the first ends."""
    fall = f"*DYNAMIC\n1e-3, 4e-3\n*DLOAD\nbody 1, GRAV, {G}, 0., 0., -1.\n"
    t, z = places(folder, column(FIRST + f"*STEP\n{fall}*END STEP\n*STEP\n{fall}*END STEP\n"))
    assert t == pytest.approx(np.arange(1, 9) * 1e-3)
    assert z == pytest.approx(2.0 * t - G * t**2 / 2, rel=1e-6)


def test_damping_by_the_mass(folder):
    """``v (1 - exp(-a t)) / a``, of second order in the step; an amplitude that is 0 adds nothing."""
    damped, a = STEEL + "*DAMPING, ALPHA=50.\n", 50.0
    none = "*CLOAD, AMPLITUDE=none\nhead 1, 3, 1.\n"
    start, off = "*AMPLITUDE, NAME=none\n0., 0., 1., 0.\n" + FIRST, []
    for dt in (4e-3, 2e-3):
        t, z = places(folder, column(start + f"*STEP\n*DYNAMIC, ALPHA=0.\n{dt}, 0.02\n{none}*END STEP\n", damped))
        off.append(abs(z[-1] - 2.0 * (1 - np.exp(-a * t[-1])) / a))
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("beta", [0.0, 1e-6])
def test_a_column_that_swings(folder, beta):
    """Of one cell, held at its foot and free along itself: the time step of one mass, with ``E A / L`` and a third of the mass."""
    held = "*BOUNDARY\nfoot 1, 1, 3\nhead 1, 1, 2\n"
    text = columns([(0.0, 1.0, 1)]) + STEEL + f"*DAMPING, BETA={beta}\n" + SECTION + held
    text += "*STEP\n*DYNAMIC\n1e-7, 2e-6\n*CLOAD\nhead 1, 3, 25.\n*END STEP\n"
    t, z = places(folder, text, 111)
    alpha, m, k, dt, u, v = -0.05, RHO / 3, E, 1e-7, 0.0, 0.0
    b, c, p, found = (1 - alpha) ** 2 / 4, 0.5 - alpha, 100.0, []
    a = p / m
    for _ in t:
        # all forces at a mean of both ends of the step
        u_past, v_past = u + dt * v + dt**2 * (0.5 - b) * a, v + dt * (1 - c) * a
        old = alpha * (k * u + beta * k * v)
        left = m + (1 + alpha) * (k * b * dt**2 + beta * k * c * dt)
        a = (p + old - (1 + alpha) * (k * u_past + beta * k * v_past)) / left
        u, v = u_past + b * dt**2 * a, v_past + c * dt * a
        found.append(u)
    assert z == pytest.approx(found, rel=1e-8)


def test_what_is_refused(folder):
    """Explicit steps, other steps among those of time, and bodies without mass."""

    def read(text):
        return lambda: uem.read_deck(written(folder, text), COMM)

    step, static = "*STEP\n*DYNAMIC\n1., 1.\n*END STEP\n", "*STEP\n*STATIC\n*END STEP\n"
    refused(uem.InputError, ("*DYNAMIC", "expected implicit"), read(column(step.replace("DYNAMIC", "DYNAMIC, EXPLICIT"))))
    refused(uem.InputError, "expected *DYNAMIC steps alone", read(column(static + step)))
    refused(uem.InputError, "and a motion needs the mass", read(column(step, STEEL.replace(f"*DENSITY\n{RHO}\n", ""))))
