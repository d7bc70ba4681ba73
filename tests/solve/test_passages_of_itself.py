"""Steps that would lead parts of a body through other parts of it, and motions that only seem to: bodies that turn, bend, whip and roll.

Two tests to read first: ``test_a_needle_does_not_pass_a_plate`` and ``test_what_moves_with_a_body``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import Bodies, dimension, fork, without
from dolfinx import fem
from helpers import at, box, clamp, highest, linear, lowest, modulus, raised, run, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve import passages

COMM = MPI.COMM_WORLD
REFUSED = r"general contact: the contactor at \(.*\) passes through its own body within a step, .* inside, through \(.*\)"


class Needle:
    """A frame of three plates; from the upper one a needle points at the middle one, 0.3 away, and is led through it by its head.

    Args:
        cell: kind of cells.
        degree: of the displacement.
        apart: whether needle and plate are excluded from touching each other.
    """

    def __init__(self, cell, degree=1, apart=False):
        g = dimension(cell)
        whole = box(cell, [-0.2, 0.0, 0.0][:g], [1.2, 2.1, 0.2][:g], [14, 21, 2][:g])

        def hole(x):
            plates = (x[:, 1] < 0.1) | ((x[:, 1] > 1.0) & (x[:, 1] < 1.1)) | (x[:, 1] > 2.0)
            needle = (np.abs(x[:, 0] - 0.5) < 0.1) & (x[:, 1] > 1.4)
            return (x[:, 0] > 0.0) & (x[:, 0] < 1.0) & ~plates & ~needle

        s = scene(COMM, cell, [without(whole, hole)])
        V = compat.function_space(s.mesh, degree, (g,))
        u = fem.Function(V)
        head = s.tag("head", 0, lambda x: (x[:, 1] > 2.1 - 1e-9) & (np.abs(x[:, 0] - 0.5) < 0.1 + 1e-9))
        bcs = clamp(V, head, value=[0.0, -0.85, 0.0][:g])
        for x in (-0.2, 1.2):
            bcs += clamp(V, s.tag("side", 0, at(0, x)))
        needle = s.tag("needle", 0, lambda x: (x[:, 1] > 1.4 - 1e-9) & (x[:, 1] < 2.0 + 1e-9) & (np.abs(x[:, 0] - 0.5) < 0.2))
        plate = s.tag("plate", 0, lambda x: (x[:, 1] > 1.0 - 1e-9) & (x[:, 1] < 1.1 + 1e-9))
        self.contact = uem.GeneralContact(self_contact=True, exclude=[(needle, plate)] if apart else [])
        F = linear(u, modulus(s, 1.0))
        self.problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[self.contact], rtol=1e-10)

    def ends(self):
        """How low the tip's middle and the plate's upper side below it are."""
        config = self.problem.config
        X, x = (a[: config.n_owned] for a in (config.X, config.x))
        below = np.abs(X[:, 0] - 0.5) < 1e-9
        return [lowest(COMM, x[below & (np.abs(X[:, 1] - y) < 1e-9), 1]) for y in (1.4, 1.1)]


KINDS = [("quadrilateral", 1), slow("quadrilateral", 2), slow("triangle", 2)]


@pytest.mark.parametrize(("cell", "degree"), KINDS)
@pytest.mark.slow
def test_a_needle_does_not_pass_a_plate(cell, degree):
    """One solve would leave the plate unmoved above the tip: it is refused, with both places; steps that are cut push the plate down."""
    one = Needle(cell, degree)
    raised(uem.TunnellingError, REFUSED, one.problem.solve)
    assert highest(COMM, np.abs(one.problem.u.x.array)) == 0.0
    one = Needle(cell, degree)
    steps = run(one.problem)
    tip, plate = one.ends()
    assert len(steps) > 1 and one.contact.n_active > 0 and one.contact.max_gap() < 1e-12
    assert 0.5 < tip < 0.65 and plate < tip + 1e-9


@pytest.mark.slow
def test_a_needle_does_not_pass_a_plate_in_3d():
    """One solve ends in an error by name and leaves all as it was; in 3D the plate rolls off the tip before it is pushed as far."""
    one = Needle("hexahedron")
    with pytest.raises((uem.TunnellingError, uem.ConvergenceError)):
        one.problem.solve()
    assert highest(COMM, np.abs(one.problem.u.x.array)) == 0.0


def test_what_is_excluded_passes():
    """Parts that are excluded from touching each other pass: the plate stays where it is."""
    one = Needle("quadrilateral", apart=True)
    one.problem.solve()
    tip, plate = one.ends()
    assert tip < 0.6 and plate == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize("cell", ["quadrilateral", slow("triangle")])
def test_a_slot_closed_in_one_step(cell):
    """A load that presses the prongs of a fork flat together in one solve gives what four steps give."""
    g, found = dimension(cell), []
    for steps in (0, 4):
        s = scene(COMM, cell, [fork(cell)])
        V = compat.function_space(s.mesh, 1, (g,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F, push = linear(u, modulus(s, 1.0)), fem.Constant(s.mesh, 0.02)
        for side in (1, -1):
            F += side * push * v[1] * uem.ds(s.tag(f"outer{side}", 0, at(1, 0.45 * side)))
        contact = uem.GeneralContact(self_contact=True)
        bcs = clamp(V, s.tag("root", 0, at(0, -0.4)))
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load={push: 0.02} if steps else None, rtol=1e-10)
        run(problem, steps) if steps else problem.solve()
        assert contact.n_active > 15 and contact.max_gap() < 1e-12
        found.append(s.gather(u))
    assert np.abs(found[0] - found[1]).max() < 1e-6 * np.abs(found[1]).max()


# -- motions of a strip ------------------------------------------------------------------------------------------------------


LENGTH = 6.0


def along(angle, turn=0.0):
    """Maps a strip along x to a curve that has at every place the direction ``angle`` of a function, and turns the whole."""
    s = np.linspace(0.0, LENGTH, 4001)
    a = angle(s) + 0.0 * s
    t = np.column_stack([np.cos(a), np.sin(a)])
    curve = np.vstack([np.zeros(2), np.cumsum(0.5 * (t[1:] + t[:-1]) * np.diff(s)[:, None], axis=0)])

    def mapped(x):
        b, y = np.interp(x[:, 0], s, a), x.copy()
        y[:, 0] = np.interp(x[:, 0], s, curve[:, 0]) - np.sin(b) * x[:, 1]
        y[:, 1] = np.interp(x[:, 0], s, curve[:, 1]) + np.cos(b) * x[:, 1]
        y[:, :2] = y[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        return y

    return mapped


def arc(angle):
    return lambda s: angle / LENGTH * s


def wave(height, phase):
    return lambda s: height * np.sin(0.5 * np.pi * s + phase)


def hook(bent):
    """A strip that comes back above itself, whose last third bends by an angle."""
    return lambda s: np.interp(s, [2.5, 4.0], [0.0, np.pi]) + bent * np.clip(s - 4.0, 0.0, 1.0)


def spiral(turns):
    return lambda s: 2 * np.pi * turns * np.sqrt(s / LENGTH)


def move(cell, degree, before, after):
    """Move a strip, and look for passages: what is looked at."""
    g = dimension(cell)
    strip = box(cell, [0.0, -0.05, 0.0][:g], [LENGTH, 0.05, 0.3][:g], [48, 1, 2][:g])
    b = Bodies(cell, [strip.mapped(before)], degree)
    drawn = fem.Function(compat.function_space(b.s.mesh, 1, (g,)))
    drawn.x.array.reshape(-1, g)[:] = strip.x[b.s.numbering(drawn.function_space)]
    every = fem.Function(b.V)
    every.interpolate(drawn)
    problem = b.problem([uem.GeneralContact(self_contact=True)], [])
    config = problem.config
    config.displacement[:] = after(every.x.array.reshape(-1, g)) - config.X
    problem.system.place()
    passages.refuse_passages(config, problem.pairs, problem.committed, [None] * len(problem.pairs))
    return COMM.allreduce(len(problem.pairs[0].target.beside_themselves))


STRIPS = [("quadrilateral", 1), slow("triangle", 2), slow("hexahedron", 1), slow("tetrahedron", 1)]
LOOP, CIRCLE = arc(np.deg2rad(340)), arc(np.deg2rad(350))
KEPT = {
    "turned by 90": (along(LOOP), along(LOOP, 0.5 * np.pi)),
    "turned by 180": (along(LOOP), along(LOOP, np.pi)),
    "turned by 250": (along(LOOP), along(LOOP, 4.4)),
    "bent to a ring": (along(arc(0.0)), along(CIRCLE)),
    "straightened": (along(CIRCLE), along(arc(0.0))),
    "bent the other way": (along(arc(3.0)), along(arc(-3.0))),
    "wound up": (along(spiral(1.5)), along(spiral(1.8))),
    "unwound": (along(spiral(1.8)), along(spiral(1.4), 1.0)),
    "a wave that runs on": (along(wave(1.5, 0.0)), along(wave(1.5, 1.5))),
    "a wave that turns over": (along(wave(1.0, 0.0)), along(wave(1.0, np.pi))),
    "an end that lifts off": (along(hook(0.0)), along(hook(-1.3))),
    "that and turned": (along(hook(0.0)), along(hook(-1.3), 2.6)),
}


@pytest.mark.parametrize(("cell", "degree"), STRIPS)
def test_what_moves_with_a_body(cell, degree):
    """A strip, parts of which see each other, turns, bends, winds and whips by far more than its thickness in one step: nothing passes."""
    seen = [move(cell, degree, *KEPT[name]) for name in KEPT]
    assert min(seen) > 0


@pytest.mark.parametrize(("cell", "degree"), STRIPS)
@pytest.mark.parametrize("turn", [0.0, 1.5, 3.5])
def test_an_end_through_the_middle(cell, degree, turn):
    """The end of a strip that comes back above its middle goes through it in a step, whatever the whole strip does meanwhile."""
    raised(uem.TunnellingError, REFUSED, lambda: move(cell, degree, along(hook(0.0)), along(hook(1.3), turn)))


def test_nothing_near_is_not_looked_at(monkeypatch):
    """Where no body may touch itself, and where no part of one is near another, nothing is looked for, however far things move."""
    monkeypatch.setattr(passages, "carried_along", None)
    for itself in (False, True):
        b = Bodies("quadrilateral", [box("quadrilateral", [x, 0.0], [x + 1.0, 0.1], [10, 1]) for x in (0.0, 3.0)])
        ends = [bc for k, x in enumerate((0.0, 3.0)) for bc in clamp(b.V, b.side(k, 0, x))]
        stretched = [bc for k, x in enumerate((1.0, 4.0)) for bc in clamp(b.V, b.side(k, 0, x), value=[0.5, 0.0])]
        problem = b.problem([uem.GeneralContact(self_contact=itself)], ends + stretched)
        problem.solve()
        assert highest(COMM, problem.config.displacement) == 0.5
