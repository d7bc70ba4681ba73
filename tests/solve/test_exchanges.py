"""Contactors that change sides: states that come again are noticed at once, another rule ends the circle, or an error names them.

Read first: ``test_scenes_that_went_in_circles``.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from friction_scenes import driven
from helpers import Body, at, blocks, box, clamp, linear, modulus, raised, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.nodes.concave_edges import HOLD_AFTER
from uem_dolfinx.contact.seam.active_set import Pivoting, Rule, Violations
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.solve.united import exchanges as exchanges_of_a_step
from uem_dolfinx.solve.united.exchanges import ALONG, Exchanges

COMM = MPI.COMM_WORLD


class Nodes:
    """A pair of which one knows the places of its contactors in the drawing and whether they are active; each rank has its own part."""

    def __init__(self, X, name="upper on lower", frictional=False):
        X = np.asarray(X, dtype=float)[COMM.rank :: COMM.size]
        config = SimpleNamespace(
            comm=COMM, X=X, gdim=X.shape[1], size=1.0, describe=lambda i: "(" + ", ".join(f"{c:.6g}" for c in X[i]) + ")"
        )
        self.config, self.nodes, self.name, self.members = config, np.arange(len(X)), name, [self]
        self.friction = SimpleNamespace() if frictional else None
        self.discretisation = SimpleNamespace(setting=SimpleNamespace(label=np.zeros(len(X), int)))
        here = PairState.initial(len(X), config.gdim)
        self.trial = replace(here, active=np.ones(len(X), bool), changes=np.full(len(X), HOLD_AFTER))

    def be_active(self, which):
        """Let these of all contactors be active."""
        self.trial = replace(self.trial, active=self.of_all(which))

    def take(self, state):
        """Have another trial state."""
        self.trial = state

    def project(self):
        """They stay where they are."""

    def of_all(self, values):
        """This rank's part of what all contactors have."""
        return np.asarray(values)[COMM.rank :: COMM.size]


def wrong(pair, which):
    """Contactors that would be released."""
    here = pair.of_all(which)
    return Violations(np.zeros(len(here), bool), here)


def all_released(pair, chosen):
    """Which of all ranks' contactors are to be exchanged."""
    out = np.zeros(COMM.allreduce(len(pair.nodes)), bool)
    for rank, part in enumerate(COMM.allgather(chosen.release)):
        out[rank :: COMM.size] = part
    return out.tolist()


def test_the_order_does_not_depend_on_ranks():
    """All of them, and at last the first along a direction of the drawing, of the first pair that has any."""
    X = [(0.0, 0.0), (1.0, 0.0), (0.0, 0.5), (0.5, 0.5)]
    pairs = [Nodes(X), Nodes(X)]
    none, some = np.array([False] * 4), np.array([False, True, True, True])
    for first, last in ((none, [2]), (some, [2])):
        exchanges, went = Exchanges(pairs), []
        for _ in range(2):
            chosen = exchanges.choose([wrong(pairs[0], first), wrong(pairs[1], some)], (), False)
            went.append([all_released(pair, c) for pair, c in zip(pairs, chosen)])
        at_work = 0 if first.any() else 1
        every = [first.tolist(), some.tolist()]
        assert went[0] == every
        assert np.flatnonzero(went[1][at_work]).tolist() == last
        assert not any(went[1][1 - at_work])
        along = np.array(X) @ ALONG[:2]
        assert last == [int(np.flatnonzero(some)[along[some].argmin()])]


def test_contactors_in_a_cycle_are_named():
    """Contacts and places of the contactors that the last rule has exchanged, three at most and how many more, in one order."""
    X = [(float(i), 0.5) for i in range(6)]
    for frictional, error in ((False, uem.ConvergenceError), (True, uem.FrictionError)):
        pair = Nodes(X, frictional=frictional)
        exchanges = Exchanges([pair])

        def exchange_for_ever(exchanges=exchanges, pair=pair):
            for k in range(100):
                which = np.zeros(6, bool)
                which[[1, 2, 4, 5][k % 4]] = True
                pair.be_active(which)
                exchanges.choose([wrong(pair, which)], (), False)

        found = raised(error, "the active set cycles", exchange_for_ever)
        assert "upper on lower at (1, 0.5), upper on lower at (2, 0.5), upper on lower at (4, 0.5), and 1 more" in str(found)


@pytest.mark.slow
@pytest.mark.parametrize("most", [0, exchanges_of_a_step.MOST_OF_EACH])
def test_the_first_alone_finds_any_active_set(most, monkeypatch):
    """Exchanged one by one in their order, however many these are, contactors end where all at once do; reaching a bound is an error."""
    ends = []
    for rule in (None, Rule.FIRST):
        if rule is not None:
            monkeypatch.setattr(Pivoting, "choose", lambda self, count, state: Rule.FIRST)
            monkeypatch.setattr(exchanges_of_a_step, "MOST_EXCHANGES", 1)
            monkeypatch.setattr(exchanges_of_a_step, "MOST_OF_EACH", most)
        b = blocks(
            COMM, "triangle", 30, 150, gap=0.02, pose=lambda x: x + np.array([0.0, 0.02]) * np.cos(40 * x[:, :1]) * (x[:, 1:] > 0)
        )
        contact = uem.Contact(b.high, b.low, sliding="fixed")
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.08])]
        problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], max_iterations=50)
        if most == 0 and rule is not None:
            raised(uem.ConvergenceError, "the active set cycles", problem.solve)
            return
        history = problem.solve()
        ends.append((contact.n_active, contact.resultant().force[1], sum(i.exchanges for i in history)))
    assert ends[0][0] == ends[1][0] and ends[1][1] == pytest.approx(ends[0][1], rel=1e-10)
    assert ends[1][2] > exchanges_of_a_step.MOST_EXCHANGES


def test_without_curvature_first():
    """Before the first contactor goes alone the curvature of the contact is left out."""
    pair = Nodes([(0.0, 0.0), (1.0, 0.0)])
    exchanges, which, straight = Exchanges([pair]), np.array([True, True]), []
    for _ in range(3):
        exchanges.choose([wrong(pair, which)], (), True)
        straight.append(exchanges.straight)
    assert straight == [False, True, True]
    assert exchanges._pivoting._rule < Rule.FIRST


def test_convex_until_it_gets_better():
    """A state that comes again and again although no contactor changes gets a convex tangent, until a tenth of the residual is left."""
    pair = Nodes([(0.0, 0.0), (1.0, 0.0)])
    exchanges = Exchanges([pair])
    pair.be_active([True, False])
    convex = []
    for norm in (1.0, 0.5, 0.6, 0.6, 0.6, 0.9, 0.091, 0.05, 0.04, 0.07):
        exchanges.visit(norm)
        convex.append(exchanges.convex)
    assert convex == [False] * 5 + [True, True] + [False] * 3
    exchanges.begin_step()
    assert not exchanges.convex


def test_states_that_come_again():
    """A state with no less than 0.9 of its residual has led nowhere; bends are left out then, and the sixth time is an error."""
    pair = Nodes([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)])
    exchanges = Exchanges([pair])

    def visit(first, norm):
        pair.be_active([first, True, False])
        return exchanges.visit(norm)

    # it gets better, then nothing changes, then it the active set cycles
    assert not any(visit(k % 2 == 0, 0.85**k) for k in range(10))
    exchanges.begin_step()
    assert not any(visit(True, 1.0) for _ in range(4))
    exchanges.begin_step()
    assert [visit(*v) for v in ((True, 1.0), (False, 1.0), (True, 0.95), (False, 1.0), (True, 1.0))] == [
        False,
        False,
        True,
        False,
        False,
    ]
    assert not visit(False, 1.0)
    visit(True, 1.0)
    # two rounds so far, each of three visits
    for k in range(3 * 3):
        visit(k % 2 == 1, 1.0)
    error = raised(uem.ConvergenceError, "the active set cycles", lambda: [visit(k % 2 == 1, 1.0) for k in range(9, 14)])
    assert str(error).count("upper on lower") == 1 and "(0, 0)" in str(error)


def belt(mu, n):
    """A block on a plane that moves on under it."""
    s = scene(COMM, "hexahedron", [box("hexahedron", [0.0] * 3, [1.0] * 3, [n] * 3)])
    V = compat.function_space(s.mesh, 1, (3,))
    u, top, plane = fem.Function(V), fem.Function(V), uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    contact = uem.Contact(s.tag("low", 0, at(2, 0.0)), plane, friction=mu)
    bcs = [fem.dirichletbc(top, fem.locate_dofs_topological(V, 2, s.tag("top", 0, at(2, 1.0)).entities))]

    def load(part):
        top.x.array[2::3] = -0.01
        plane.move([0.2 * part, 0.06 * part, 0.0])

    return uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], load=load), 10


def pressed(n_low, n_high):
    """A block of degree 2 pressed straight onto another, whose nodes its corners stand on."""
    b = blocks(COMM, "quadrilateral", n_low, n_high, overhang=0.5, degree=2)
    contact = uem.Contact(b.high, b.low, friction=0.3)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.02])]
    return uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=bcs, contacts=[contact]), 1


def leaves(mu):
    """A spring of five leaves that are clamped at one end, the longest bent by its tip."""
    t, n = 0.02, 5
    s = scene(
        COMM,
        "quadrilateral",
        [box("quadrilateral", [0, -t * (k + 1)], [1 - k / 8, -t * k], [16 - 2 * k + k % 2, 1]) for k in range(n)],
    )
    V = compat.function_space(s.mesh, 1, (2,))
    u, bcs, contacts = fem.Function(V), clamp(V, s.tag("tip", 0, at(0, 1.0)), 1, value=-0.1), []
    for k in range(n):
        bcs += clamp(V, s.tag(f"root {k}", k, at(0, 0.0)))
    for k in range(1, n):
        upper, lower = s.tag(f"{k}", k, at(1, -t * k)), s.tag(f"above {k}", k - 1, at(1, -t * k))
        contacts.append(uem.Contact(upper, lower, friction=mu))
    return uem.UnitedProblem(st_venant(u, 1.0), u, bcs=bcs, contacts=contacts), 1


def bolt(mu, coupling):
    """Two plates that a bolt draws together, which friction alone holds."""

    def grid(x, y, z, inside):
        body = box("hexahedron", [0.0] * 3, [len(x) - 1.0, len(y) - 1.0, len(z) - 1.0], [len(x) - 1, len(y) - 1, len(z) - 1])
        places = np.stack([np.interp(body.x[:, i], np.arange(len(a)), a) for i, a in enumerate((x, y, z))], axis=1)
        used, cells = np.unique(body.cells[inside(np.abs(places[body.cells].mean(axis=1)))], return_inverse=True)
        return Body(places[used], cells.reshape(-1, 8))

    plate = np.array([-2.0, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0])
    low, high = (
        grid(plate, plate, z, lambda m: m[:, :2].max(axis=1) > 0.6) for z in (np.array([-1.0, 0.0]), np.array([0.0, 1.0]))
    )
    across, along = np.array([-1.0, -0.4, 0.0, 0.4, 1.0]), np.array([-1.5, -1.0, 0.0, 1.0, 1.5])
    shank = grid(across, across, along, lambda m: (m[:, 2] > 1.0) | (m[:, :2].max(axis=1) < 0.4))
    s = scene(COMM, "hexahedron", [low, high, shank])
    V = compat.function_space(s.mesh, 1, (3,))
    u, strain = fem.Function(V), fem.Constant(s.mesh, 0.0)

    def ring(z):
        return lambda x: at(2, z)(x) & (np.abs(x[:, :2]).max(axis=1) > 0.3)

    how = {"friction": mu, "coupling": coupling}
    contacts = [uem.Contact(s.tag("over", 1, at(2, 0.0)), s.tag("under", 0, at(2, 0.0)), **how)]
    contacts += [
        uem.Contact(s.tag(f"ring {b}", 2, ring(z)), s.tag(f"face {b}", b, at(2, z)), **how) for b, z in ((0, -1.0), (1, 1.0))
    ]
    F = linear(u, 100.0) + 100.0 * modulus(s, 0.0, 0.0, 1.0) * strain * ufl.TestFunction(u.function_space)[2].dx(2) * ufl.dx
    load = {strain: 0.01}
    return uem.UnitedProblem(F, u, bcs=clamp(V, s.tag("left", 0, at(0, -2.0))), contacts=contacts, load=load), 1


@pytest.mark.parametrize(
    ("make", "how", "most"),
    [
        (belt, (1.0, 3), 150),
        (belt, (1.0, 5), 100),
        (pressed, (4, 5), 60),
        (leaves, (0.2,), 120),
        (bolt, (0.2, "node_to_surface"), 60),
        (bolt, (0.2, "mortar"), 60),
        (bolt, (0.5, "mortar"), 30),
    ],
)
def test_scenes_that_went_in_circles(make, how, most):
    """At the end of the load without a cut, after so many linear solves at most; the states are checked by ``conftest``."""
    problem, number = make(*how)
    steps = run(problem, number)
    assert len(steps) == number and not any(step.cuts for step in steps)
    assert sum(step.newton_iterations + step.exchanges for step in steps) <= most


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize(
    ("cell", "n", "ratio", "mu"),
    [
        ("quadrilateral", (5, 7), 1e4, 0.5),
        ("hexahedron", (3, 4), 1e4, 0.3),
        ("hexahedron", (3, 4), 1e2, 1.0),
        ("tetrahedron", (2, 3), 1e4, 0.5),
    ],
)
def test_a_stiff_block_is_dragged_over_a_soft_one_and_back(cell, n, ratio, mu, coupling):
    """The contactor is the stiffer by so much: no more than eight iterations and 100 exchanges a step, and Coulomb's law at the end."""
    d = driven(cell, mu, law=st_venant, E=(1.0, ratio), n=n, how={"coupling": coupling})
    sideways = [0.0] * (d.blocks.gdim - 2)
    ways = [(0.03 * k, -0.02) for k in range(5)] + [(0.12 - 0.03 * k, -0.03) for k in range(1, 5)]
    for way, depth in ways:
        history = d.to(way, *sideways, depth)
        assert len(history) - 1 <= 8 and sum(i.exchanges for i in history) <= 100
    force = d.contact.resultant().force
    assert abs(force[0]) <= mu * abs(force[-1]) * (1 + 1e-6)
    assert sum(d.states) > 0 and force[0] * force[-1] != 0


@pytest.mark.long
def test_a_body_that_friction_does_not_hold_is_refused_soon():
    """Pushed a little harder than friction bears, a block leads to the same states again: the error takes 200 linear solves at most."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [2.0, 0.5], [8, 2])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, force = fem.Function(V), fem.Constant(s.mesh, np.zeros(2))
    contact = uem.Contact(s.tag("low", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), friction=0.3)
    problem = uem.UnitedProblem(
        linear(u, 200.0) - ufl.dot(force, ufl.TestFunction(V)) * ufl.dx, u, contacts=[contact], rtol=1e-12
    )
    for part in (0.0, 0.5, 0.9, 1 - 1e-6, 1e-6 - 1):
        force.value[:] = 0.3 * part, -1.0
        problem.solve()
    force.value[0] = 0.3 * (1 + 1e-6)
    error = raised(uem.FrictionError, "", problem.solve)
    assert len(error.history) + sum(i.exchanges for i in error.history) <= 200


def test_signals_are_heeded_between_exchanges(monkeypatch):
    """After every linear solve, not only when the bodies have moved."""
    monkeypatch.setattr(Exchanges, "take_long", lambda *_: False)
    d = driven(mu=0.3)
    d.to(0.0, -0.01)
    heeded = []
    d.problem.progress.check_signals = lambda comm: heeded.append(comm)
    history = d.to(0.05, -0.01)
    solves = sum(i.exchanges + 1 for i in history[:-1])
    assert solves > len(history) - 1
    # and once more when all is done
    assert len(heeded) == solves + 1
