"""Wrong inputs that once ended in an error of Python's or of a library's: each is named."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import blocks, linear, raised
from ramp_scenes import COMM, five_steps, nothing

import uem_dolfinx as uem


def rough(friction):
    b = blocks(COMM, "triangle")
    contact = uem.Contact(b.high, b.low, friction=friction)
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact]).solve()


def closed(folder):
    problem, _ = five_steps(False, nothing)
    writer = uem.HistoryWriter(folder / "h.csv", problem)
    writer.close()
    writer.write(0.0)


CASES = {
    "general contact's force": (uem.SurfaceError, "belongs to no problem yet", lambda f: uem.GeneralContact().resultant()),
    "general contact's bodies": (uem.SurfaceError, "belongs to no problem yet", lambda f: uem.GeneralContact().touching()),
    "coupling's reaction": (
        uem.SpaceError, "is in no problem yet", lambda f: uem.RigidCoupling(np.array([0]), (0.5, 1.0)).reaction,
    ),
    "a law's class": (uem.InputTypeError, "make the law with its numbers", lambda f: rough(uem.Coulomb)),
    "words for friction": (uem.InputTypeError, "numbers", lambda f: rough(lambda x: ["a"] * x.shape[1])),
    "no functional": (uem.InputTypeError, "functional = None", lambda f: uem.taylor_test(None, 1.0)),
    "no halvings": (uem.InputError, "halvings = 0", lambda f: uem.taylor_test(lambda h: h * h, 0.0, halvings=0)),
    "half a halving": (uem.InputError, "halvings = 1.5", lambda f: uem.taylor_test(lambda h: h * h, 0.0, halvings=1.5)),
    "a closed table": (uem.InputError, "is closed", closed),
    "steps by number": (
        uem.InputTypeError, "steps = 3", lambda f: list(uem.animate(f / "x.gif", five_steps(False, nothing)[0], 3)),
    ),
    "no panels": (uem.InputError, "panels = 0", lambda f: uem.figure(f / "x.png", COMM, 0).__enter__()),
}  # fmt: skip


@pytest.mark.parametrize("what", CASES)
def test_named(what, folder):
    error, words, call = CASES[what]
    raised(error, words, lambda: call(folder))
