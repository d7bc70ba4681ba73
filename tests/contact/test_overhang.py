"""Contactors a little past an end of the target, whose own facets lie over it: they are in contact, or a warning says why not.

The test to read first is ``test_a_block_wider_than_its_support``: each body has one cell across, so that no contactor is over the target.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, clamp, highest, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.seam import ends

COMM = MPI.COMM_WORLD
PUSH = 0.02


def on_support(
    cell="quadrilateral", past=1e-3, *, degree=1, cells=1, gap=0.0, aside=0.0, number=1, turn=0.0, swap=False, push=PUSH, **how
):
    """Blocks of one unit without lateral contraction, each wider by ``past`` at all sides than its support.

    They come from ``gap`` above and ``aside`` and are pushed down by ``push``, in ``number`` scenes of one problem, which is turned.
    """
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    c, s_ = np.cos(turn), np.sin(turn)
    R = np.eye(g)
    R[:2, :2] = [[c, -s_], [s_, c]]
    bodies, across = [], g - 1
    for k in range(number):
        low, wide = np.zeros(g), np.ones(g)
        low[0], wide[0], wide[-1] = 4.0 * k, 4.0 * k + 1.0, 0.0
        bodies.append(box(cell, [*low[:-1], -1.0], wide, [1] * across + [2]))
        low[:across] -= past
        wide[:across] += past
        low[0], wide[0] = low[0] + aside, wide[0] + aside
        bodies.append(box(cell, [*low[:-1], gap], [*wide[:-1], gap + 1.0], [cells] * across + [2]))
    s = scene(COMM, cell, bodies, pose=lambda x: x @ R.T)
    V = compat.function_space(s.mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    bcs, contacts = [], []
    for k in range(number):
        foot, top = s.tag(f"foot {k}", 2 * k + 1, at(g - 1, gap)), s.tag(f"top {k}", 2 * k, at(g - 1, 0.0))
        led = R @ [-aside, *[0.0] * (g - 2), -gap - push]
        bcs += clamp(V, s.tag("base", 2 * k, at(g - 1, -1.0)))
        bcs += clamp(V, s.tag("lid", 2 * k + 1, at(g - 1, gap + 1.0)), value=led.tolist())
        contacts.append(uem.Contact(*((top, foot) if swap else (foot, top)), name=f"block {k}", max_penetration=0.5, **how))
    F = uem.LinearElastic(1.0, 0.0, **({"kind": "plane_strain"} if g == 2 else {})).residual(u, v) * ufl.dx
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts), contacts


def warned(caplog):
    """How often rank 0 was warned of corners of the target, on all ranks."""
    return COMM.bcast(sum("a convex corner of the target" in r.getMessage() for r in caplog.records))


@pytest.mark.parametrize(
    ("cell", "past", "how"),
    [
        ("quadrilateral", 1e-3, {}),
        slow("quadrilateral", 0.05, {}),
        slow("quadrilateral", 1e-3, {"number": 2, "turn": 0.5}),
        slow("quadrilateral", 1e-3, {"normals": "averaged"}),
        *(slow("quadrilateral", 1e-3, {"sliding": sliding}) for sliding in ("small", "fixed")),
        *(slow(cell, 1e-3, {"degree": d}) for cell in ("quadrilateral", "triangle", "hexahedron", "tetrahedron") for d in (1, 2)),
        *(slow(cell, 1e-3, more) for cell in ("quadrilateral", "hexahedron") for more in ({"friction": 0.3}, {"corners": True})),
        slow("quadrilateral", 1e-3, {"gap": 0.3, "aside": 0.7}),
        *(slow(cell, 1e-3, {"gap": gap}) for cell in ("quadrilateral", "hexahedron") for gap in (0.3, 3.0)),
        *(slow(cell, 1e-3, {"coupling": "mortar"}) for cell in ("quadrilateral", "hexahedron")),
        *(slow(cell, past, {"cells": 3}) for cell in ("quadrilateral", "hexahedron") for past in (-1e-3, 1e-3, 1.001)),
    ],
)  # fmt: skip
def test_a_block_wider_than_its_support(cell, past, how, caplog):
    """Two bars in series, ``F = push E A / (2 h)``: the overhang has an effect of its own size; nothing is warned of."""
    problem, contacts = on_support(cell, past, **how)
    steps = list(uem.load_steps(problem, 8 if "gap" in how else 1))
    assert not any(step.cuts for step in steps) and not warned(caplog)
    for contact in contacts:
        force = contact.resultant().force
        wide = how.get("cells", 1) > 1 and past > 1
        # a block of three cells, of which that in the middle covers the support, is stiffer
        assert (
            0.99 < np.linalg.norm(force) / (0.5 * PUSH) < 1.6
            if wide
            else np.linalg.norm(force) == pytest.approx(0.5 * PUSH, rel=4 * abs(past))
        )
        turned = np.array([-np.sin(how.get("turn", 0.0)), np.cos(how.get("turn", 0.0))])
        if len(force) == 2:
            assert abs(force @ turned) == pytest.approx(np.linalg.norm(force), rel=1e-3)


@pytest.mark.parametrize(
    ("past", "factor", "held"), [(0.09, 1, True), (0.11, 1, False), (0.09, 0.1, False), (0.11, 10, True), (1e-3, 1, True)]
)
def test_how_far_facets_reach(past, factor, held, monkeypatch, caplog):
    """An end holds a contactor past it by a tenth of the facet; farther ones have no contact, with a warning at the smallest push."""
    monkeypatch.setattr(ends, "END_HOLDS", factor * ends.END_HOLDS)
    monkeypatch.setattr("uem_dolfinx.contact.nodes.node_to_surface.END_HOLDS", ends.END_HOLDS)
    problem, (contact,) = on_support(past=past, push=1e-6)
    list(uem.load_steps(problem, 1))
    assert contact.n_active == (2 if held else 0) and warned(caplog) == (not held)


@pytest.mark.parametrize("push", [1e-6, slow(0.7)])
def test_corners_far_inside_are_named(push, caplog):
    """Corners of the support that no contactor sees, at any depth, also below the first cells of the block."""
    problem, (contact,) = on_support(past=0.2, push=push)
    list(uem.load_steps(problem, 1))
    assert not contact.n_active and warned(caplog) == 1


def test_bodies_side_by_side():
    """Nodes of a block's side a little past the end of its neighbour's top, and below it, are not over it: no force holds them."""
    s = scene(
        COMM,
        "quadrilateral",
        [box("quadrilateral", [0, -1], [1, 0], [1, 2]), box("quadrilateral", [1.001, -0.6], [2, 0.4], [1, 4])],
    )
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    bcs = [*clamp(V, s.tag("base", 0, at(1, -1.0))), *clamp(V, s.tag("lid", 1, at(1, 0.4)), value=[0.0, -0.1])]
    contact = uem.Contact(s.tag("side", 1, at(0, 1.001)), s.tag("top", 0, at(1, 0.0)), max_penetration=1.0)
    problem = uem.UnitedProblem(
        uem.LinearElastic(1.0, 0.0, kind="plane_strain").residual(u, v) * ufl.dx, u, bcs=bcs, contacts=[contact]
    )
    list(uem.load_steps(problem, 2))
    assert contact.n_active == 0 and highest(COMM, np.abs(contact.pair.trial.lam)) == 0.0
