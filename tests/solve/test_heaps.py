"""Loose bodies that come to rest on each other."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from falling_scenes import Falling, arc
from helpers import box, lawful

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.solve.rigid import rigid_steps
from uem_dolfinx.solve.rigid.rigid_steps import least_motion

RADIUS, GAP, WEIGHT = 0.5, 0.05, 1e-4


def heap(cols, rows, n=4):
    """Discs of ``2 n`` cells across above a floor between two walls: bodies, problem, middles, width, contacts with the floor."""
    places = [
        (RADIUS + GAP + (c + 0.5 * (r % 2)) * (1 + GAP), RADIUS + GAP + 0.95 * r)
        for r in range(rows)
        for c in range(cols - r % 2)
    ]

    def disc(middle):
        def onto(x):
            y = np.column_stack([x[:, 0] * np.sqrt(1 - x[:, 1] ** 2 / 2), x[:, 1] * np.sqrt(1 - x[:, 0] ** 2 / 2)])
            return RADIUS * y + middle

        return box("quadrilateral", [-1.0, -1.0], [1.0, 1.0], [2 * n, 2 * n]).mapped(onto)

    f = Falling("quadrilateral", [disc(p) for p in places], "finite", E=(1.0,) * len(places), nu=0.3)
    f.weigh(*[WEIGHT] * len(places))
    rims = [f.s.tag(f"rim {k}", k, arc(p, RADIUS)) for k, p in enumerate(places)]
    width = cols * (1 + GAP) + GAP
    walls = (
        uem.RigidPlane([0.0, 0.0], [0.0, 1.0]),
        uem.RigidPlane([0.0, 0.0], [1.0, 0.0]),
        uem.RigidPlane([width, 0.0], [-1.0, 0.0]),
    )
    near = [(i, j) for i in range(len(places)) for j in range(i) if np.hypot(*np.subtract(places[i], places[j])) < 1.5]
    contacts = [uem.Contact(rims[i], rims[j]) for i, j in near] + [uem.Contact(rim, wall) for wall in walls for rim in rims]
    floor = contacts[len(near) : len(near) + len(rims)]
    return f, f.problem((), contacts), np.array(places), width, floor


@pytest.mark.parametrize("cols, rows, most", [(3, 3, 10), (4, 4, 20), pytest.param(7, 6, 30, marks=pytest.mark.slow)])
def test_heap_comes_to_rest_in_few_steps(monkeypatch, cols, rows, most):
    """Discs fall together: at most so many projections of each pair, one for each programme, until nothing rigid moves."""
    n = 4
    f, problem, places, width, _ = heap(cols, rows, n)
    counted, solved = [], []
    monkeypatch.setattr(rigid_steps, "least_motion", lambda *programme: solved.append(None) or least_motion(*programme))
    place = problem.system.place
    problem.system.floating.begin_step(lambda: counted.append(None) or place())
    assert len(counted) == len(solved) <= most
    # every disc has come down, and none is in another, but for a corner in the middle of a side that belongs to contactors:
    # three sags to first order
    x = f.s.drawing + f.moved()
    middles = np.array([x[f.bodies == k].mean(axis=0) for k in range(len(places))])
    assert (middles[:, 1] < places[:, 1] - 0.9 * GAP).all()
    sag = RADIUS * (1 - np.cos(0.5 * np.diff(np.arcsin(np.linspace(0.0, 1.0, n + 1) / np.sqrt(2))).max()))
    distance = np.linalg.norm(middles[:, None] - middles, axis=2) + 10 * np.eye(len(places))
    assert distance.min() > 2 * RADIUS - 3.1 * sag and x.min() > -1e-9 and x[:, 0].max() < width + 1e-9
    # each rests on two others, or on the floor or the walls
    bounds = np.column_stack([middles[:, 1], middles[:, 0], width - middles[:, 0]])
    assert ((distance < 2 * RADIUS + 1e-3).sum(axis=1) + (bounds < RADIUS + 1e-3).sum(axis=1) >= 2).all()


def test_heap_in_equilibrium():
    """Three discs, two below and one between them: the bodies give way from where the rigid ones rest, and the floor carries them all."""
    f, problem, places, _, floor = heap(2, 2)
    history = problem.solve()
    assert len(history) <= 6
    for contact in problem.contacts:
        lawful(contact)
    area = forms.assemble_scalar(forms.form(fem.Constant(f.s.mesh, 1.0) * ufl.dx), f.s.mesh.comm)
    assert sum(contact.resultant().force[1] for contact in floor) == pytest.approx(WEIGHT * area, rel=1e-8)
