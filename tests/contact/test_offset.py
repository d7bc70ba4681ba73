"""Offsets of gaps, and gaps that are adjusted: the same as meshes that were moved, closed forms, tangents, fits that come and go.

The test to read first: ``test_as_meshes_that_overlap`` (an offset is what moving a flat surface by it would be, to rounding).
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import (
    M,
    arch,
    at,
    blocks,
    box,
    clamp,
    gathered_vector,
    highest,
    linear,
    lowest,
    modulus,
    raised,
    run,
    scene,
    slow,
    st_venant,
    tangent_by_differences,
)  # fmt: skip

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
COUPLINGS = ("node_to_surface", "mortar")


def pressed(cell, n, degree, gap, *, material=st_venant, settlement=0.03, **how):
    """Two blocks between rollers, pressed onto each other: nodal displacements in the drawing's order, and the contact."""
    b = blocks(COMM, cell, *n, degree=degree, gap=gap)
    contact = uem.Contact(b.high, b.low, **how)
    problem = uem.UnitedProblem(material(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(settlement), contacts=[contact])
    run(problem)
    return np.concatenate(COMM.allgather(b.u.x.array[: b.gdim * problem.config.n_owned])), contact


FLAT = [("triangle", (2, 4), 1), ("quadrilateral", (2, 4), 2), ("tetrahedron", (1, 2), 1)]


@pytest.mark.parametrize(
    "cell,n,degree,sliding",
    [(*FLAT[0], "finite"), (*FLAT[0], "small"), (*FLAT[1], "fixed"), slow(*FLAT[1], "finite"), slow(*FLAT[2], "finite")],
)
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_as_meshes_that_overlap(cell, n, degree, coupling, sliding):
    """Blocks that overlap or are apart as drawn, and blocks that coincide and have an offset: the same displacements and pressures."""
    for gap in (-0.01, 0.01):
        moved, first = pressed(cell, n, degree, gap, coupling=coupling, sliding=sliding)
        offset = (lambda x, o=-gap: np.full(x.shape[1], o)) if gap > 0 else -gap
        kept, second = pressed(cell, n, degree, 0.0, coupling=coupling, sliding=sliding, offset=offset)
        assert np.abs(moved - kept).max() < 1e-12
        assert highest(COMM, np.abs(first.pressures - second.pressures)) < 1e-11
        assert highest(COMM, np.abs(first.gap.x.array - second.gap.x.array)) < 1e-12
        assert first.initial_overlap == pytest.approx(second.initial_overlap, abs=1e-12)


@pytest.mark.parametrize("coupling,degree", product(COUPLINGS, (1, 2)))
def test_a_fit_comes_and_goes(coupling, degree):
    """An interference by number makes the pressure of bodies in series, grows with the load factor, and taken back leaves nothing."""
    b = blocks(COMM, "triangle", 2, 4, degree=degree)
    contact = uem.Contact(b.high, b.low, coupling=coupling)

    def load(t):
        contact.offset = 0.02 * t

    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(0.0), contacts=[contact], load=load)
    for step in uem.load_steps(problem, 2):
        assert np.abs(contact.pressures - M * 0.02 * step.factor * 2 / 3).max(initial=0.0) < 1e-12
    problem.load = None
    assert contact.n_active == COMM.allreduce(len(contact.nodes))
    for offset in (0.0, -0.01):
        contact.offset = offset
        problem.solve()
        assert highest(COMM, np.abs(b.u.x.array)) < 1e-15 and highest(COMM, np.abs(contact.pressures)) < 1e-14
    assert contact.n_active == 0
    if degree == 1:
        assert highest(COMM, np.abs(contact.gap.x.array[contact.nodes] - 0.01)) < 1e-14


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_rigid_surfaces(coupling):
    """A plane that is taken to be thicker is a plane that stands higher."""
    found = []
    for height, offset in ((-0.98, 0.0), (-1.0, 0.02)):
        b = blocks(COMM, "quadrilateral", 2, 2)
        plane = uem.RigidPlane((0.0, height), (0.0, 1.0))
        contact = uem.Contact(b.bottom, plane, coupling=coupling, offset=offset, friction=0.3)
        held = [*clamp(b.V, b.low), *clamp(b.V, b.high)]
        problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=held, contacts=[contact])
        run(problem)
        found.append((np.array(b.u.x.array), contact.resultant().force))
    assert highest(COMM, np.abs(found[0][0] - found[1][0])) < 1e-13
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-10) and found[0][1][1] > 0.0


@pytest.mark.parametrize("cell,degree", [("triangle", 1), ("hexahedron", 1), ("triangle", 2)])
def test_tangent(cell, degree):
    """Curvature of nodes that are held at a height which varies, by differences; that of mortar is in ``test_mortar_tangent``."""
    b = blocks(COMM, cell, 2 if cell == "triangle" else 1, 3, degree=degree, pose=arch(0.3))
    contact = uem.Contact(b.high, b.low, offset=lambda x: 0.05 + 0.02 * x[0], max_penetration=1.0)
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    d, f, p = (gathered_vector(v) for v in tangent_by_differences(problem, contact))
    assert np.abs(d - f).max() < 1e-4 * np.abs(d - p).max()


def test_over_an_edge():
    """A node above the convex edge of a roof is held at its height from the edge, along the way from it."""
    roof = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [2, 1])
    s = scene(
        COMM, "quadrilateral", [roof, box("quadrilateral", [0.01, 0.105], [0.5, 1.0], [1, 1])],
        pose=lambda x: x - np.outer((x[:, 1] <= 0.0) * np.abs(x[:, 0]) * 0.3, [0.0, 1.0]),
    )  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("node", 1, at(1, 0.105)), s.tag("roof", 0, at(1, 0.0)), offset=0.1)
    top = s.tag("top", 1, at(1, 1.0))
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, -1.0))), *clamp(V, top, 0), *clamp(V, top, 1, value=-0.02)]
    uem.UnitedProblem(st_venant(u, modulus(s, 1.0, 1.0)), u, bcs=bcs, contacts=[contact]).solve()
    pair = contact.pair
    i = np.flatnonzero(pair.trial.active)
    away = pair.points[i] - pair.kinematics.projection.foot[i]
    assert contact.n_active == 1
    assert highest(COMM, np.abs(np.linalg.norm(away, axis=1) - 0.1)) < 1e-13
    assert contact.balance().moment < 1e-12


def test_in_a_concave_corner():
    """A tip that is pressed into a valley rests as far from both of its sides as the offset says."""
    bodies = [box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [2, 1]), box("quadrilateral", [-0.2, 0.1], [0.2, 0.5], [2, 1])]

    def pose(x):
        rise = np.where(x[:, 1] <= 0.0, 0.3 * (x[:, 1] + 1), np.where(x[:, 1] < 0.2, 0.9, 0.0))
        return x + np.outer(rise * np.abs(x[:, 0]), [0.0, 1.0])

    s = scene(COMM, "quadrilateral", bodies, pose=pose)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    low, top = s.tag("low", 0, at(1, 0.0)), s.tag("top", 1, at(1, 0.5))
    contact = uem.Contact(s.tag("high", 1, at(1, 0.1)), low, offset=0.01)
    bcs = [
        *clamp(V, s.tag("bottom", 0, at(1, -1.0))),
        *clamp(V, low),
        *clamp(V, top, 0, value=0.01),
        *clamp(V, top, 1, value=-0.12),
    ]
    problem = uem.UnitedProblem(st_venant(u, modulus(s, 1.0, 1.0)), u, bcs=bcs, contacts=[contact])
    run(problem, 4)
    pair = contact.pair
    assert contact.n_active == 1 and COMM.allreduce(int(pair.trial.in_corner.sum())) == 1
    tip = pair.points[pair.trial.active]
    assert highest(COMM, np.abs((tip[:, 1] - 0.3 * np.abs(tip[:, 0])) / np.hypot(1.0, 0.3) - 0.01)) < 1e-13
    assert highest(COMM, np.abs(tip[:, 0])) < 1e-13


@pytest.mark.parametrize("coupling,degree", product(COUPLINGS, (1, 2)))
@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_adjusted_gaps(coupling, degree, cell):
    """Blocks that are a little apart, or inside each other, and adjusted: as if they had been drawn upon each other."""
    n = (1, 2) if cell == "tetrahedron" else (2, 4)
    together, first = pressed(cell, n, degree, 0.0, coupling=coupling)
    for gap in (0.01, -0.01):
        adjusted, second = pressed(cell, n, degree, gap, coupling=coupling, adjust=0.02)
        assert np.abs(together - adjusted).max() < 1e-12
        assert second.adjusted == pytest.approx(0.01, rel=1e-10) and second.initial_overlap == 0.0
    assert first.adjusted == 0.0
    _, third = pressed(cell, n, degree, 0.01, coupling=coupling, adjust=0.005)
    assert third.adjusted == 0.0


def wave(x):
    """The upper block with a wave of 0.01 in its lower side; the rest is unchanged."""
    high = np.where(x[:, 1] > 0.005, np.clip(1.01 - x[:, 1], 0.0, 1.0), 0.0)
    return x + np.outer(0.01 * high * np.sin(2.0 * np.pi * x[:, 0]), [0.0, 1.0])


@pytest.mark.parametrize("pose, most", [(arch(0.1), 0.035), (wave, 0.02)])
@pytest.mark.parametrize("coupling,degree", product(COUPLINGS, (1, 2)))
def test_adjusted_waves(coupling, degree, pose, most):
    """Surfaces whose gaps vary are adjusted free of stress; all contactors touch, and pressing makes them push at once."""
    b = blocks(COMM, "triangle", 3, 4, gap=0.01, degree=degree, pose=pose)
    contact = uem.Contact(b.high, b.low, coupling=coupling, adjust=True)
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.0), contacts=[contact])
    problem.solve()
    assert highest(COMM, np.abs(b.u.x.array)) < 1e-14
    assert contact.n_active == COMM.allreduce(len(contact.nodes))
    assert contact.adjusted == pytest.approx(most, rel=0.1)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_tied_gaps_are_reported(coupling):
    b = blocks(COMM, "triangle", 2, 3, gap=0.03)
    tied = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=clamp(b.V, b.bottom), contacts=[tied])
    assert tied.adjusted == pytest.approx(0.03, rel=1e-10)
    near = uem.Contact(b.high, b.low, coupling=coupling, tied=True, adjust=0.02)
    raised(
        uem.SurfaceError, "near enough to the target to be tied",
        lambda: uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, contacts=[near]),
    )  # fmt: skip


def test_named_errors():
    b = blocks(COMM, "triangle", 2, 2)
    for how, words in (
        ({"offset": np.nan}, "offset = nan: expected a finite number"), ({"adjust": -1.0}, "adjust = -1.0: expected True, False or"),
        ({"offset": 0.1, "tied": True}, "keeps the gaps"),
    ):  # fmt: skip
        raised(uem.InputError, words, lambda how=how: uem.Contact(b.high, b.low, **how))
    raised(uem.InputTypeError, "offset = 'thick'", lambda: uem.Contact(b.high, b.low, offset="thick"))
    F = linear(b.u, modulus(b.scene, 1.0, 1.0))
    short = uem.Contact(b.high, b.low, offset=lambda x: np.zeros(3 * x.shape[1]))
    raised(uem.InputError, r"offset\(x\) has shape", lambda: uem.UnitedProblem(F, b.u, contacts=[short]))
    half = uem.Contact(b.high, b.low, friction=lambda x: np.where(x[0] < 0.5, -0.25, 0.25))
    raised(uem.InputError, r"friction\(x\) is -0.25 at \(0, [-.0-9e]+\)", lambda: uem.UnitedProblem(F, b.u, contacts=[half]))
    deep = uem.Contact(b.high, b.low, offset=0.5)
    raised(uem.PenetrationError, "starts 0.5 inside", lambda: uem.UnitedProblem(F, b.u, contacts=[deep]))
    contact = uem.Contact(b.high, b.low)
    uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])

    def set_it(value):
        contact.offset = value

    raised(uem.InputError, "offset = inf: expected a finite number", lambda: set_it(np.inf))
    assert contact.offset == 0.0 and lowest(COMM, contact.pair.kinematics.gap) > -1e-14
