"""Contacts that are alike are treated as one, and nothing but the time it takes depends on that.

Two tests to read first: ``test_blocks_in_a_grid`` and ``test_exchanges_of_many_are_those_of_one``.
"""

from __future__ import annotations

import gc
import sys
import weakref
from collections import Counter

import numpy as np
import pytest
import ufl
from body_scenes import COMM, Bodies, Discs, close, grid, oedometer, surface_of
from dolfinx import fem
from helpers import box, clamp, highest, linear, modulus

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact import joining
from uem_dolfinx.contact.laws.law import as_law
from uem_dolfinx.contact.pair.joined_nodes import Member

CALLS = ("Allreduce", "allreduce", "Allgather", "allgather", "Alltoall", "Alltoallv", "bcast")


def one_by_one(monkeypatch):
    """Let each contact be treated alone."""
    monkeypatch.setattr(joining, "_kind", lambda *of: None)


def reported(contact):
    """Results of a contact, by nodes, and in sums over all ranks."""
    fields = [getattr(contact, name) for name in ("pressure", "gap", "active", "status", "traction", "slip", "force")]
    on = [contact.resultant(on=side) for side in ("contactor", "target")]
    sums = [contact.n_active, contact.max_gap(), contact.max_pressure(), contact.initial_overlap, contact.dissipation]
    return [np.array(f.x.array) for f in fields], np.concatenate([*sums_of(on), sums])


def sums_of(resultants):
    return [np.concatenate([r.force, r.moment]) for r in resultants]


def alike(one, other, rounding=1e-10):
    """Two contacts tell the same."""
    for a, b in zip(one[0], other[0]):
        assert highest(COMM, np.abs(a - b)) <= rounding * (1.0 + highest(COMM, np.abs(b)))
    assert np.abs(one[1] - other[1]).max() <= rounding * (1.0 + np.abs(other[1]).max())


def blocks_in_a_grid(cell, counts, mu, settlement, normals="facet"):
    """Blocks side by side and one above the other, pushed down; each touches its neighbours by a contact of its own."""
    b, places = grid(cell, (1, 2), counts)
    sides = [surface_of(b.s, k) for k in range(len(places))]
    contacts = []
    for i, p in enumerate(places):
        for j, q in enumerate(places):
            if sum(abs(x - y) for x, y in zip(p, q)) == 1 and (sum(p) % 2, i) > (sum(q) % 2, j):
                how = {"friction": mu * (1 + i), "normals": normals}
                contacts.append(uem.Contact(sides[i], sides[j], name=f"{i} on {j}", **how))
    u = fem.Function(b.V)
    F = linear(u, modulus(b.s, *[1.0 + k for k in range(len(places))]))
    bcs = oedometer(b, places, counts, settlement)
    return contacts, uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, rtol=1e-12)


@pytest.mark.parametrize(
    "cell,counts,mu,normals",
    [
        ("quadrilateral", (2, 2), 0.0, "facet"), ("triangle", (2, 2), 0.1, "facet"), ("quadrilateral", (1, 3), 0.1, "averaged"),
        pytest.param("tetrahedron", (1, 1, 3), 0.2, "facet", marks=pytest.mark.slow), ("hexahedron", (1, 1, 3), 0.0, "facet"),
        pytest.param("hexahedron", (1, 1, 3), 0.1, "averaged", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_blocks_in_a_grid(cell, counts, mu, normals, monkeypatch):
    """All iterations but for rounding, displacements, and results of each contact are as if it were treated alone; nodes are of several."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = blocks_in_a_grid(cell, counts, mu, 0.02, normals)
        assert all(isinstance(contact.pair, Member) is together for contact in contacts) and len(contacts) > 1
        steps = [len(problem.solve()) for _ in range(2)]
        found.append((problem.u, steps, [reported(contact) for contact in contacts]))
    (u, n, here), (v, m, there) = found
    assert all(abs(a - b) <= 1 for a, b in zip(n, m))
    close(u, v)
    for one, other in zip(here, there):
        alike(one, other)


@pytest.mark.long
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_discs_in_motion(mu, monkeypatch):
    """Discs that fall and collide: steps, iterations, active contactors and displacements; most contacts are far apart."""
    found, d = [], Discs(2, 2, mu=mu)
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts = d.contacts(False)
        problem = d.problem(contacts)
        steps = [(s.newton_iterations, [c.n_active for c in contacts]) for s in uem.time_steps(problem, 0.02, 0.14)]
        found.append((problem.u, steps, [reported(contact) for contact in contacts], [contact.pair.far for contact in contacts]))
    (u, one, here, far), (v, other, there, apart) = found
    assert [active for _, active in one] == [active for _, active in other] and far == apart
    assert all(abs(a - b) <= 1 for (a, _), (b, _) in zip(one, other)) and max(sum(active) for _, active in one) >= 1
    close(u, v)
    for a, b in zip(here, there):
        alike(a, b, 1e-8)


def stacks(n, gap=0.0, mu=0.0, **how):
    """Blocks next to each other, each on a wider one of its own, with a contact each that is named by its number."""
    every = [
        box("quadrilateral", [2.0 * k + left, low], [2.0 * k + right, high], [2, 2])
        for k in range(n)
        for left, right, low, high in ((0.0, 1.0, 0.0, 1.0), (0.1, 0.7, 1.0 + gap, 2.0 + gap))
    ]
    b = Bodies("quadrilateral", every)
    u = fem.Function(b.V)
    bcs = []
    for k in range(n):
        bcs += clamp(b.V, b.side(2 * k, 1, 0.0)) + clamp(b.V, b.side(2 * k + 1, 1, 2.0 + gap), value=(0.01, -0.02 - gap))
    pairs = [(b.side(2 * k + 1, 1, 1.0 + gap), b.side(2 * k, 1, 1.0)) for k in range(n)]
    contacts = [uem.Contact(high, low, name=f"stack {k}", friction=mu, **how) for k, (high, low) in enumerate(pairs)]
    F = linear(u, modulus(b.s, *[1.0] * (2 * n)))
    return contacts, uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, rtol=1e-11)


def calls_of_a_step(n, monkeypatch):
    # which calls every contact
    monkeypatch.setattr("conftest.check_state", lambda *a: None)
    contacts, problem = stacks(n, mu=0.2)
    problem.solve()
    calls = Counter()
    sys.setprofile(lambda frame, event, what: calls.update([what.__name__]) if event == "c_call" else None)
    try:
        problem.solve()
    finally:
        sys.setprofile(None)
    assert all(contact.n_active > 0 for contact in contacts)
    return {name: calls[name] for name in CALLS}


def test_exchanges_of_many_are_those_of_one(monkeypatch):
    """A step with six contacts in touch makes as many calls to other ranks as one with two, or with one contact alone."""
    one, two, six = (calls_of_a_step(n, monkeypatch) for n in (1, 2, 6))
    assert one == two == six


def test_what_is_not_alike_is_treated_alone():
    """Contacts are alike where couplings, sliding, normals and kinds of friction are; one alone, and others, stay as they are."""
    contacts, problem = stacks(2)
    assert len(problem.interfaces) == 1 and problem.pairs == [contact.pair for contact in contacts]
    for how in ({"coupling": "mortar"}, {"sliding": "small"}, {"tied": "after"}, {"wear": 1e-3}):
        contacts, problem = stacks(2, **how)
        assert problem.interfaces == problem.pairs and len(problem.pairs) == 2
    contacts, problem = stacks(1)
    assert problem.interfaces == problem.pairs and not isinstance(contacts[0].pair, Member)


@pytest.mark.parametrize("limit", [None, 1e-3])
def test_friction_and_offsets_of_one(limit, monkeypatch):
    """Friction and an offset that are set between steps are those of their contact alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = stacks(3, mu=0.3)
        problem.solve()
        contacts[1].friction = uem.Coulomb(0.1, limit=limit)
        contacts[2].offset = 1e-3
        contacts[0].friction = 0.05
        steps = len(problem.solve())
        found.append((problem.u, steps, [reported(contact) for contact in contacts]))
        forces = [contact.resultant().force for contact in contacts]
        # slopes of 0.05 and 0.1, and more pressure by the offset
        slopes = [abs(f[0] / f[1]) for f in forces]
        assert (
            abs(slopes[0] - 0.05) < 0.01 and slopes[1] < (0.12 if limit is None else 0.09) and forces[2][1] > 1.02 * forces[1][1]
        )
    (u, n, here), (v, m, there) = found
    assert abs(n - m) <= 1
    close(u, v)
    for one, other in zip(here, there):
        alike(one, other)


def test_a_message_names_the_contact(caplog):
    """An overlap at the start that is refused, and one that is reported, is that of one contact."""
    with pytest.raises(uem.PenetrationError, match="stack 1"):
        contacts, problem = stacks(2, gap=-0.05, max_penetration=0.06)
        contacts, problem = stacks(2, gap=-0.05, max_penetration=0.06)
        refused = [uem.Contact(c.contactor, c.target, name=c.name, max_penetration=m) for c, m in zip(contacts, (0.06, 0.01))]
        uem.UnitedProblem(problem.bodies.F, problem.u, bcs=problem.bodies.bcs, contacts=refused)
    if COMM.rank == 0:
        assert "stack 0: 3 contactors start up to 0.05 inside" in caplog.text
    assert [contact.initial_overlap for contact in contacts] == pytest.approx([0.05, 0.05])


def test_derivatives_are_of_each(monkeypatch):
    """Derivatives through steps by the coefficient of one, and along its change, are those of contacts that are treated alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = stacks(2, mu=0.05)
        with uem.recording(problem) as history:
            for _ in uem.load_steps(problem, 2):
                pass
        J, by_mu = problem.u[0] ** 2 * ufl.dx, uem.ContactParameter(contacts[1], "friction")
        along = history.tangent([(by_mu, 1.0)])[-1]
        other = uem.forms.assemble_scalar(fem.form(2.0 * problem.u[0] * along[0] * ufl.dx), COMM)
        found.append([history.gradient(J, [by_mu])[0], other])
        assert len(problem.interfaces) == (1 if together else 2)
    assert np.abs(np.subtract(*found)).max() <= 1e-9 * np.abs(found[1]).max() and found[0][0] == pytest.approx(
        found[0][1], rel=1e-9
    )


def parameters_of(contacts):
    return [uem.ContactParameter(contact, name) for contact in contacts for name in ("place", "turn", "offset")]


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_derivatives_by_walls(mu, monkeypatch):
    """Derivatives by places, turns and offsets of several surfaces are those of contacts alone; with friction through all steps."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = between_walls(mu)
        J = (problem.u[0] ** 2 + problem.u[1]) * ufl.dx
        if mu:
            with uem.recording(problem) as history:
                for _ in uem.load_steps(problem, 2):
                    pass
            controls = [m for m in parameters_of(contacts) if m.parameter != "offset"]
            slopes = history.gradient(J, controls)
            along = history.tangent([(controls[0], np.array([0.3, 0.7]))])[-1]
            work = uem.forms.assemble_scalar(fem.form(ufl.derivative(J, problem.u, along)), COMM)
            assert work == pytest.approx(slopes[0] @ [0.3, 0.7], rel=1e-8)
        else:
            problem.solve()
            slopes = uem.gradient(problem, J, parameters_of(contacts))
        found.append(np.concatenate([np.ravel(one) for one in slopes]))
    assert np.abs(found[0] - found[1]).max() <= 1e-9 * np.abs(found[1]).max() and np.abs(found[1]).max() > 1e-6


def test_derivatives_of_a_pressure(monkeypatch):
    """The pressure of one contact, by the offsets of two, backwards and forwards: as of contacts that are treated alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = stacks(3)
        contacts[2].offset = thicker = fem.Function(compat.function_space(problem.config.mesh, 1))
        problem.solve()
        p, offsets = contacts[1].pressure, [uem.ContactParameter(contact, "offset") for contact in contacts[:2]]
        along = uem.tangent(problem, [(offsets[1], 1.0)], of=p)
        slopes = uem.gradient(problem, p**2 * uem.ds(contacts[1].contactor), offsets)
        work = uem.forms.assemble_scalar(fem.form(2.0 * p * along * uem.ds(contacts[1].contactor)), COMM)
        assert work == pytest.approx(float(slopes[1]), rel=1e-9) and abs(slopes[0]) <= 1e-9 * abs(work)
        by_field = uem.gradient(problem, problem.u[0] * ufl.dx, thicker)[0]
        by_number = uem.gradient(problem, problem.u[0] * ufl.dx, uem.ContactParameter(contacts[2], "offset"))[0]
        n = by_field.function_space.dofmap.index_map.size_local
        assert COMM.allreduce(by_field.x.array[:n].sum()) == pytest.approx(float(by_number), rel=1e-9)
        found.append([work, float(by_number)])
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_a_run_continues(mu, folder, monkeypatch):
    """A run that continues from the checkpoint of contacts that were treated alone is that of one in one go."""
    with monkeypatch.context() as change:
        one_by_one(change)
        _, problem = stacks(3, mu=mu)
        problem.solve()
        uem.write_checkpoint(folder / "alone", problem.state())
    _, again = stacks(3, mu=mu)
    uem.read_checkpoint(folder / "alone", again.state())
    contacts, problem = stacks(3, mu=mu)
    problem.solve()
    for one in (problem, again):
        for contact in one.contacts:
            contact.offset = 1e-3
        assert len(one.interfaces) == 1
    assert len(again.solve()) == len(problem.solve())
    close(again.u, problem.u)
    for contact, other in zip(again.contacts, contacts):
        alike(reported(contact), reported(other))


def test_steps_that_switch_one(monkeypatch):
    """A step that switches one of the contacts off, and one that switches it on, are those of contacts that are treated alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = stacks(3, mu=0.1)
        forces = []
        for step in uem.load_steps(
            problem, [uem.Step(n=2), uem.Step(contacts={contacts[1]: False}), uem.Step(contacts={contacts[1]: True})]
        ):
            forces.append([contact.resultant().force for contact in contacts])
        assert len(problem.interfaces) == (1 if together else 3) and len(forces) >= 4
        found.append((problem.u, np.array(forces)))
    (u, one), (v, other) = found
    close(u, v)
    assert np.abs(one - other).max() <= 1e-10 * np.abs(other).max() and (one[:, 1] == 0.0).all(axis=1).any()


@pytest.mark.long
def test_a_goal_of_several(monkeypatch):
    """The error of a functional, with contactors that stick and slip, is that of contacts that are treated alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        _, problem = stacks(2, mu=0.2)
        problem.solve()
        error = uem.goal_error(problem, problem.u[0] * ufl.dx)
        found.append([error.value, error.error, error.parts])
    assert found[0] == pytest.approx(found[1], rel=1e-9) and abs(found[0][1]) > 1e-9


def test_facets_keep_their_numbers():
    """A contact's facets are numbered as by its target alone, in states and projections."""
    contacts, problem = stacks(3)
    problem.solve()
    for contact in contacts:
        pair = contact.pair
        p = pair.kinematics.projection
        assert np.array_equal(pair.committed.facet, p.facet) and (p.facet >= 0).all()
        own = pair.target.project(pair.points)
        assert np.array_equal(own.facet, p.facet) and np.array_equal(own.nodes, p.nodes)
        kept = pair.to_checkpoint()
        pair.from_checkpoint(kept)
        pair.project()
        again = pair.to_checkpoint()
        assert all(np.array_equal(kept[name], again[name]) for name in kept)


def test_no_references_in_circles():
    """Contacts that are treated as one, and their problem, are gone at once when they are let go of."""
    contacts, problem = stacks(3)
    problem.solve()
    of = problem.system, problem.bodies, problem.config, contacts[0].pair, contacts[0].pair.whole
    known = [weakref.ref(one) for one in of]
    gc.disable()
    try:
        problem.__dict__.clear()
        del problem, contacts, of
        assert [one() for one in known] == [None] * len(known)
    finally:
        gc.enable()


def test_friction_that_follows_a_temperature_is_not_joined():
    """Its values are evaluated at each placement, by each contact; Coulomb's that only differ in values are joined."""

    def joins(friction):
        return joining._joins(as_law(friction))

    assert joins(0.3) and joins(lambda x, t: t * x[0]) and joins(uem.Coulomb(0.2, limit=3.0))
    assert not joins(uem.OfTemperature(lambda x, t, T: 0.1 * T, field=1)) and not joins(uem.Tresca(1.0))


def between_walls(mu, moves=True):
    """A block that is pressed into a corner of two rigid walls, which turn and move, and that a ball reaches in the second half."""
    b = Bodies("quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [3, 3])])
    walls = [uem.RigidPlane((0, 0), (0, 1)), uem.RigidPlane((0, 0), (1, 0)), uem.RigidSphere((1.6, 0.5), 0.55)]

    def load(factor):
        walls[0].move((0.0, 0.02 * factor), 0.02 * factor)
        walls[1].move((0.01 * factor, -0.02 * factor))
        walls[2].move((-0.1 * factor, 0.0))

    every = surface_of(b.s, 0)
    contacts = [uem.Contact(every, wall, friction=mu, name=f"wall {k}") for k, wall in enumerate(walls)]
    bcs = clamp(b.V, b.side(0, 1, 1.0), 1, value=-0.03)
    if not moves:
        return contacts, b.problem(contacts, bcs + clamp(b.V, b.side(0, 0, 1.0), 0, value=-0.01))
    return contacts, b.problem(contacts, bcs, load=load)


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_rigid_surfaces_that_move(mu, folder, monkeypatch):
    """A corner of two walls and a ball, each of which moves: steps, and a run that continues."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = between_walls(mu)
        assert len(problem.interfaces) == (1 if together else 3)
        steps = [s.newton_iterations for s in uem.load_steps(problem, 2)]
        uem.write_checkpoint(folder / f"walls {together}", problem.state())
        here = [reported(contact) for contact in contacts]
        assert all(contact.n_active > 0 for contact in contacts)
        found.append((problem.u, steps, here))
    (u, n, here), (v, m, there) = found
    assert n == m
    close(u, v)
    for one, other in zip(here, there):
        alike(one, other)
    monkeypatch.undo()
    contacts, problem = between_walls(mu)
    uem.read_checkpoint(folder / "walls False", problem.state())
    for contact, other in zip(contacts, there):
        alike(reported(contact), other)


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_walls_that_are_switched(mu, monkeypatch):
    """A wall that is taken away under load, and put back: forces are those of contacts that are treated alone."""
    found = []
    for together in (True, False):
        if not together:
            one_by_one(monkeypatch)
        contacts, problem = between_walls(mu, moves=False)
        steps = [
            uem.Step("press", 2),
            uem.Step("away", 2, contacts={contacts[1]: False}),
            uem.Step("back", contacts={contacts[1]: True}),
        ]
        forces = []
        for step in uem.load_steps(problem, steps):
            forces.append([contact.resultant().force for contact in contacts])
        found.append((problem.u, np.array(forces), reported(contacts[0])))
        assert (
            contacts[1].n_active and (np.array(forces)[3, 1] == 0.0).all() and len(problem.interfaces) == (1 if together else 3)
        )
    (u, one, here), (v, other, there) = found
    close(u, v)
    alike(here, there)
    assert np.abs(one - other).max() <= 1e-10 * np.abs(other).max() and np.abs(one[0, 1]).max() > 1e-3


def test_no_passage_through_one_of_several_surfaces():
    """A block that is led through a ball within a step is refused by the name of this contact among others."""
    b = Bodies("quadrilateral", [box("quadrilateral", [-1.9, 0.1], [-1.8, 0.2], [1, 1])])
    walls = [uem.RigidPlane((0, -9), (0, 1)), uem.RigidSphere((0, 0), 1.0), uem.RigidPlane((9, 0), (-1, 0))]
    contacts = [uem.Contact(surface_of(b.s, 0), wall, name=f"wall {k}") for k, wall in enumerate(walls)]
    bcs = clamp(b.V, b.s.tag("whole", 0, lambda x: np.full(len(x), True)), value=(3.8, 0.0))
    problem = b.problem(contacts, bcs, line_search=False)
    assert len(problem.interfaces) == 1
    with pytest.raises(uem.TunnellingError, match="wall 1"):
        problem.solve()
