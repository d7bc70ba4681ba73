"""Sharp edges that cross between their nodes: a warning after every step, with the place; two roofs on each other, ridge over ridge.

Read first: ``test_ridge_over_ridge``.
"""

from __future__ import annotations

import logging

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks.scenes import Body, at, box, clamp, scene
from dolfinx import fem
from helpers import linear, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
N = 4


def roof(cell, upside_down, along, shift, slope):
    """A block ``[-1, 1]^2`` with a ridge along one coordinate at z = 0 below it, or above it ``upside_down``."""
    b = box(cell, (-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), (N, N, 1))
    x, y, t = b.x.T
    # heights from the base, which is 1.5 away from the ridge
    z = -1.5 + t * (1.5 - slope * np.abs(y if along == 0 else x))
    return Body(np.column_stack([x + shift, y + shift, -z if upside_down else z]), b.cells)


def warned(caplog, depth=0.05, *, cell="hexahedron", degree=1, shift=1.0 / N, slope=0.5, unit=1.0, contact=None, steps=1):
    """Warnings of edges that cross, of a roof that is moved down onto another one by ``depth`` in units of a length (collective)."""
    s = scene(COMM, cell, [roof(cell, False, 0, 0.0, slope), roof(cell, True, 1, shift, slope)], pose=lambda x: x * unit)
    V = uem.function_space(s.mesh, degree, (3,))
    u = fem.Function(V)
    sides = [s.tag(f"base {k}", k, at(2, z)) for k, z in ((0, -1.5), (1, 1.5))]
    bcs = [*clamp(V, sides[0], 0, 1, 2), *clamp(V, sides[1], 0, 1, 2, value=[0.0, 0.0, -depth * unit])]
    slopes = [s.tag(f"slopes {k}", k, lambda x, k=k: (1 - 2 * k) * x[:, 2] > -slope - 1e-9) for k in (0, 1)]
    contact = uem.GeneralContact(max_penetration=unit, edges=False) if contact is None else contact(*slopes)
    problem = uem.UnitedProblem(linear(u, 1e3), u, bcs=bcs, contacts=[contact])
    with caplog.at_level(logging.WARNING):
        for _ in uem.load_steps(problem, steps):
            pass
    # rank 0 speaks for all
    reported = [r.getMessage() for r in caplog.records if "sharp edges" in r.getMessage()]
    return COMM.bcast(reported)


@pytest.mark.parametrize("unit", [1.0, slow(1e-9), slow(1e3)])
@pytest.mark.parametrize("cell,degree", [("hexahedron", 1), slow("tetrahedron", 1), slow("hexahedron", 2)])
def test_ridge_over_ridge(caplog, cell, degree, unit):
    """In every step, with the depth and the middle of both ridges, at whatever unit of length."""
    # between nodes of elements of degree 2, too
    shift = 1.0 / N if degree == 1 else 0.5 / N
    reported = warned(caplog, cell=cell, degree=degree, shift=shift, unit=unit, steps=2)
    assert len(reported) == 2 and all(text.startswith("general contact: sharp edges") for text in reported)
    for text, depth in zip(reported, (0.025, 0.05)):
        found, place = text.partition(" deep")[0].split()[-1], text.partition(" at (")[2].partition(")")[0]
        assert float(found) == pytest.approx(depth * unit, rel=1e-3)
        assert np.array(list(map(float, place.split(",")))) == pytest.approx(
            np.array([shift, 0.0, -0.5 * depth]) * unit, abs=1e-4 * unit
        )


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_declared_contacts(caplog, coupling):
    """Of a contact between two surfaces within which the edges lie, and of general contact by mortar."""
    name = {"coupling": coupling, "name": "roofs"}
    for contact in (
        lambda low, high: uem.Contact(high, low, max_penetration=1.0, **name),
        lambda low, high: uem.GeneralContact(max_penetration=1.0, edges=False, **name),
    ):
        caplog.clear()
        reported = warned(caplog, contact=contact)
        assert len(reported) == 1 and reported[0].startswith("roofs: sharp edges")
        assert "edges = True, with hard contact and sliding = 'finite'; else" in reported[0]


@pytest.mark.slow
def test_crossings_without_a_warning(caplog):
    """Edges that are held apart, by equations of their own or at their nodes; parts that never touch; edges that are not sharp; ties."""
    assert warned(caplog, contact=lambda low, high: uem.GeneralContact(max_penetration=1.0)) == []
    assert warned(caplog, shift=0.0) == []
    assert warned(caplog, contact=lambda low, high: uem.GeneralContact(exclude=[(low, high)])) == []
    assert warned(caplog, slope=0.15) == []
    assert warned(caplog, contact=lambda low, high: uem.Contact(high, low, tied=True, adjust=1.0)) == []


def test_how_deep_edges_cross(caplog):
    """From a fiftieth of an edge between two nodes on."""
    edge = 2.0 / N
    assert warned(caplog, 0.01 * edge) == [] and len(warned(caplog, 0.03 * edge)) == 1
