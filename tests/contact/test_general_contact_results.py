"""General contact: pairs that may touch, results of bodies that touch, runs in steps, and what is refused.

Two tests to read first: ``test_forces_and_moments_balance`` and ``test_going_on_from_a_checkpoint``.
"""

from __future__ import annotations

import csv

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import Bodies, Discs, all_facets, ball, bodies_of, close, dimension, surface_of
from dolfinx import fem
from helpers import blocks, box, clamp, highest, linear, modulus, raised, refused, run, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import forms

COMM = MPI.COMM_WORLD


# -- pairs that may touch --------------------------------------------------------------------------------------------------


def pressed(contacts, cell="quadrilateral", steps=1, n=(2, 4), **how):
    """A block pressed by a tenth onto another one: the scene and the problem; contacts are made of the scene."""
    b = blocks(COMM, cell, *n, overhang=0.25, **how)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (b.gdim - 1) + [-0.1])]
    made = contacts(b)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=bcs, contacts=made, rtol=1e-11)
    run(problem, steps)
    return b, made, problem


def cells_of(b, body):
    """The cells of a body, as a tag."""
    cells = np.flatnonzero(b.scene.body == body).astype(np.int32)
    return uem.Tag("cells", 7, b.gdim, b.scene.mesh, cells)


EXCLUDED = {
    "pair of sides": lambda b: [(b.high, b.low)],
    "pair the other way": lambda b: [(b.low, b.high)],
    "pair of cells": lambda b: [(cells_of(b, 0), cells_of(b, 1))],
    "pair of indices": lambda b: [(b.high.entities, b.low.entities)],
    "pair of lists": lambda b: [([b.high, b.top], [b.low])],
}


@pytest.mark.parametrize("exclude", EXCLUDED.values(), ids=EXCLUDED)
def test_excluded_pairs(exclude):
    """What is left out does not touch: a block is moved into the other one without any force."""
    _, (contact,), problem = pressed(lambda b: [uem.GeneralContact(exclude=exclude(b))])
    assert contact.touching() == [] and contact.n_active == 0
    assert np.abs(problem.reaction(problem_bottom(problem))).max() < 1e-14


def problem_bottom(problem):
    """Facets of the lowest side of a problem's mesh."""
    X = problem.config.X
    low = -COMM.allreduce(float((-X[:, -1]).max(initial=-np.inf)), op=MPI.MAX)
    tdim = problem.config.tdim
    from dolfinx.mesh import locate_entities_boundary

    return locate_entities_boundary(problem.config.mesh, tdim - 1, lambda x: np.abs(x[tdim - 1] - low) < 1e-9)


@pytest.mark.parametrize("part", ["cells", "sides"])
def test_excluded_parts(part):
    """A part that touches nothing: of two rigid planes and another block, none holds it."""

    def contacts(b):
        alone = cells_of(b, 1) if part == "cells" else [b.high, b.top]
        return [uem.GeneralContact(rigid=uem.RigidPlane((0.0, -1.0), (0.0, 1.0)), exclude=[alone])]

    _, (contact,), problem = pressed(contacts)
    assert all(t.first == "body 1" and t.second != "body 2" for t in contact.touching())
    assert contact.between("body 2").force == pytest.approx([0.0, 0.0], abs=1e-15)


def test_beside_another_contact():
    """What a ``Contact`` of the same problem names against each other is left to it; the rest is general contact's."""
    u = []
    for alone in (True, False):
        b, made, _ = pressed(lambda b: [uem.Contact(b.high, b.low)] + ([] if alone else [uem.GeneralContact()]))
        u.append(b.scene.gather(b.u))
        assert made[0].n_active > 0 and (alone or made[1].n_active == 0)
    assert np.abs(u[0] - u[1]).max() < 1e-12


def test_order_of_bodies():
    """Contactors are nodes of the finer body, or of that which is named first; corners are on both."""
    for named in (False, True):
        b, (contact,), problem = pressed(lambda b: [uem.GeneralContact(order=[b.bottom] if named else [])], n=(6, 8))
        assert [(t.first, t.second) for t in contact.touching()] == [("body 1", "body 2")]
        body = bodies_of(problem, b.scene)
        found = [body[part.pair.nodes[part.pair.trial.active]] for part in problem.contacts]
        lower, upper = COMM.allreduce(np.bincount(np.concatenate(found), minlength=2))
        assert (lower, upper) == ((5, 0) if named else (0, 9))


def test_only_some_surfaces():
    """Given surfaces alone may touch; facets by name, by index or in lists."""
    for surfaces, touches in ((lambda b: [b.high, b.low], True), (lambda b: [b.top, b.low], False)):
        _, (contact,), _ = pressed(lambda b: [uem.GeneralContact(surfaces(b))])
        assert (contact.n_active > 0) == touches


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_rigid_surfaces(cell, mu):
    """As contacts of all surfaces with each; by their names, numbered if there are several."""
    g, found = dimension(cell), []
    b = Bodies(cell, [box(cell, [0.0] * g, [1.0] * g, [3] * g)])
    normals = [np.eye(g)[-1], np.eye(g)[0]]

    def planes():
        return [uem.RigidPlane([0.0] * g, normal) for normal in normals]

    every, E = all_facets(b.s.mesh), modulus(b.s, 1.0)
    across = [clamp(b.V, b.side(0, 1, 0.0), 1)] if g == 3 else []
    for contacts in (
        [uem.GeneralContact(rigid=planes(), friction=mu)],
        [uem.Contact(every, plane, friction=mu, name=f"c{k}") for k, plane in enumerate(planes())],
    ):
        u, v = fem.Function(b.V), ufl.TestFunction(b.V)
        F = linear(u, E)
        for axis, pressure in ((0, 0.003), (g - 1, 0.01)):
            F += pressure * v[axis] * forms.surface_measure(b.s.mesh, b.side(0, axis, 1.0).entities)
        problem = uem.UnitedProblem(F, u, bcs=sum(across, []), contacts=contacts, rtol=1e-11)
        run(problem, 2)
        found.append((u, contacts))
    (u, (general,)), (v, declared) = found
    close(u, v)
    touching = general.touching()
    assert [(t.first, t.second) for t in touching] == [("body 1", "rigid plane 1"), ("body 1", "rigid plane 2")]
    for touch, contact in zip(touching, declared):
        assert touch.n_active == contact.n_active > 0
        assert np.abs(touch.force - contact.resultant().force).max() < 1e-13 and touch.force.max() > 0.002
        on = general.between(touch.second, "body 1")
        assert np.abs(on.force + touch.force).max() < 1e-15 and on.normal == pytest.approx(contact.resultant().normal, rel=1e-10)
    assert general.resultant().normal == pytest.approx(sum(c.resultant().normal for c in declared), rel=1e-10)
    assert general.dissipation == pytest.approx(sum(c.dissipation for c in declared), rel=1e-8) and (
        general.dissipation > 0.0
    ) == (mu > 0.0)


# -- results -----------------------------------------------------------------------------------------------------------------


#: Of three discs of 12 sides and the radius 0.5, a little inside each other.
MIDDLES = [[0.0, 0.0], [0.95, 0.0], [0.475, 0.95 * np.sqrt(0.75)]]


@pytest.mark.parametrize("mu", [0.0, 0.2])
def test_forces_and_moments_balance(mu):
    """Over all bodies they sum to none, about any point; forces of pairs add up to what holds each body."""
    b = Bodies("quadrilateral", [ball("quadrilateral", m, 0.5, 3) for m in MIDDLES], law=st_venant)
    cores = [fem.locate_dofs_geometrical(b.V, lambda x, m=m: np.hypot(x[0] - m[0], x[1] - m[1]) < 0.2) for m in MIDDLES[:2]]
    push = fem.locate_dofs_geometrical(b.V, lambda x: np.hypot(x[0] - MIDDLES[2][0], x[1] - MIDDLES[2][1]) < 0.2)
    bcs = [fem.dirichletbc(np.zeros(2), dofs, b.V) for dofs in cores] + [fem.dirichletbc(np.array([0.02, -0.03]), push, b.V)]
    contact = uem.GeneralContact(friction=mu)
    problem = b.problem([contact], bcs)
    run(problem, 2)
    config, field = problem.config, contact.force
    force = field.x.array.reshape(-1, 2)
    own, x = slice(config.n_owned), config.x
    total = COMM.allreduce(np.append(force[own].sum(axis=0), (x[own, 0] * force[own, 1] - x[own, 1] * force[own, 0]).sum()))
    assert np.abs(total).max() < 1e-15 and contact.max_pressure() > 1e-4
    names = ["body 1", "body 2", "body 3"]
    pairs = contact.touching()
    assert {frozenset((t.first, t.second)) for t in pairs} == {frozenset(p) for p in (names[:2], names[1:], names[::2])}
    body = bodies_of(problem, b.s)
    for about in (None, (0.3, -0.2)):
        for k, name in enumerate(names):
            every = contact.between(name, about=about)
            parts = [contact.between(name, other, about) for other in names if other != name]
            mine = np.flatnonzero(body[own] == k)
            arm = x[mine] - (about or (0.0, 0.0))
            nodal = COMM.allreduce(
                np.append(force[mine].sum(axis=0), (arm[:, 0] * force[mine, 1] - arm[:, 1] * force[mine, 0]).sum())
            )
            reported = np.append(every.force, every.moment)
            assert np.abs(reported - sum(np.append(p.force, p.moment) for p in parts)).max() < 1e-15
            assert np.abs(reported - nodal).max() < 1e-14


def test_written_as_one(folder):
    """Files have one set of fields and columns for all that it consists of; the resultant is that of the rigid surfaces."""
    plane = uem.RigidPlane((0.0, -1.0), (0.0, 1.0))
    _, (contact,), problem = pressed(lambda b: [uem.GeneralContact(rigid=plane)])
    assert len(problem.contacts) > 2 and problem.declared == [contact]
    with uem.ResultsWriter(folder / "run", problem) as writer:
        writer.write(1.0)
    columns = (folder / "run.csv").read_text().splitlines()[0].split(",")
    assert columns[3:] == ["active", "max_gap", "force_x", "force_y", "moment_z"]
    assert contact.resultant().force == pytest.approx(problem.contacts[-1].resultant().force, abs=1e-15)
    own = slice(problem.config.n_owned)
    most = COMM.allreduce(float(contact.active.x.array[own].max(initial=0.0)), op=MPI.MAX)
    assert most >= 1 and COMM.allreduce(float(contact.gap.x.array[own].min(initial=0.0)), op=MPI.MIN) > -1e-12


def test_pairs_in_a_table(folder):
    """Every step has a row for each pair that touches then, whose moment is about the origin; a run that continues keeps those before."""
    _, (contact,), problem = pressed(lambda b: [uem.GeneralContact(bodies={"base, below": cells_of(b, 0)})])
    pairs = contact.forces_of_pairs()
    assert [(t.first, t.second) for t, _ in pairs] == [("base, below", "body 2")]
    for (first, second, _, force), moment in pairs:
        reported = contact.between(first, second)
        assert np.array_equal(reported.force, force) and np.array_equal(reported.moment, moment) and np.abs(moment).max() > 0
    for resume in (False, True, False):
        with uem.HistoryWriter(folder / "run.csv", problem, resume=resume) as writer:
            writer.write(1.0)
    if COMM.rank == 0:
        with open(folder / "run_pairs.csv", newline="") as file:
            columns, *rows = csv.reader(file)
        assert columns == ["factor", "step", "first", "second", "active", "force_x", "force_y", "moment_z"]
        step = str(problem.progress.steps)
        wanted = [["1.0", step, t.first, t.second, f"{t.n_active}", *(repr(float(f)) for f in (*t.force, *m))] for t, m in pairs]
        assert rows == wanted
        assert (folder / "run_pairs.1" / "run_pairs.csv").read_text() == (folder / "run_pairs.csv").read_text()


def test_names():
    """Bodies by parts of cells or facets; others by their numbers; what is unknown is refused with what there is."""
    _, (contact,), _ = pressed(lambda b: [uem.GeneralContact(bodies={"punch": b.top, "base": cells_of(b, 0)}, name="all")])
    assert [(t.first, t.second) for t in contact.touching()] == [("base", "punch")]
    assert repr(contact) == "GeneralContact('all', rigid surfaces: 0)"
    refused(uem.InputError, ("first = 'body 1'", "'base'", "'punch'"), lambda: contact.between("body 1"))
    refused(uem.InputError, ("second = 'floor'", "'base'"), lambda: contact.between("punch", "floor"))
    _, (contact,), _ = pressed(lambda b: [uem.GeneralContact(bodies={"punch": b.top})])
    assert [(t.first, t.second) for t in contact.touching()] == [("body 1", "punch")]


def test_before_a_problem():
    """There are no results yet."""
    for ask in (lambda c: c.n_active, lambda c: c.max_gap(), lambda c: c.pressure, lambda c: c.parts):
        refused(uem.SurfaceError, ("'one' belongs to no problem yet",), lambda: ask(uem.GeneralContact(name="one")))


# -- steps -------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("degree", [1, slow(2)])
def test_going_on_from_a_checkpoint(degree, folder):
    """A run that is left while discs touch, and continued, is the run that was not left."""
    discs, found = Discs(2, 1, degree=degree), []
    end = 0.16
    for name, stops in (("whole", [end]), ("parts", [0.14, end])):
        counts = []
        for stop in stops:
            problem = discs.problem(discs.contacts(True))
            for step in uem.time_steps(problem, 0.02, stop, checkpoint=uem.Checkpoint(folder / name)):
                counts.append((step.number, step.newton_iterations, sum(c.n_active for c in problem.contacts)))
        found.append((problem.u, problem.dynamics.velocity, counts))
    (u, v, whole), (w, z, parts) = found
    assert whole == parts and whole[6][2] > 0
    close(u, w)
    close(v, z)


@pytest.mark.long
def test_a_plate_is_not_passed():
    """A step that leads a disc through a thin plate is refused as that of hand-declared surfaces; one step ends where many do."""
    forces = []
    for push, steps, general in (
        (p, n, g) for p, n in (((0.45, -0.45), 0), ((0.0, -0.45), 1), ((0.0, -0.45), 9)) for g in (True, False)
    ):
        plate, disc = box("quadrilateral", [-1.0, -0.1], [1.0, 0.0], [20, 1]), ball("quadrilateral", [0.0, 0.25], 0.2, 4)
        b = Bodies("quadrilateral", [plate, disc], E=[1.0, 10.0])
        core = fem.locate_dofs_geometrical(b.V, lambda x: np.hypot(x[0], x[1] - 0.25) < 0.11)
        bcs = [fem.dirichletbc(np.array(push), core, b.V)]
        bcs += [bc for end in (-1.0, 1.0) for bc in clamp(b.V, b.side(0, 0, end))]
        high, low = surface_of(b.s, 1), surface_of(b.s, 0)
        contact = uem.GeneralContact(order=[high]) if general else uem.Contact(high, low)
        problem = b.problem([contact], bcs)
        if steps:
            run(problem, steps)
            forces.append(contact.between("body 2").force if general else contact.resultant().force)
        else:
            raised(uem.TunnellingError, "passes through the target within a step", problem.solve)
            assert highest(COMM, np.abs(problem.u.x.array)) == 0.0
    for force in forces[1:]:
        assert forces[0] == pytest.approx(force, rel=1e-6, abs=1e-7 * forces[0][1])
    assert forces[0][1] > 1e-5


def test_overlaps_at_the_start():
    """Up to the bound they are taken out; beyond it they are refused with the place and the depth."""
    for depth, bound, refusal in ((0.02, None, False), (0.2, None, True), (0.2, 0.3, False)):
        b = blocks(COMM, "quadrilateral", 2, 4, gap=-depth, overhang=0.25)
        contact = uem.GeneralContact(max_penetration=bound)

        def make(contact=contact, b=b):
            F = linear(b.u, modulus(b.scene, 1.0, 1.0))
            return uem.UnitedProblem(F, b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=[contact])

        if refusal:
            raised(uem.PenetrationError, "", lambda: run(make()))
        else:
            run(make())
            assert contact.n_active == 5 and contact.max_gap() < 1e-12


# -- what is refused ---------------------------------------------------------------------------------------------------------


def one_block(contact, comm=COMM):
    b = Bodies("triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])], comm=comm)
    return b.problem([contact(b)], clamp(b.V, b.side(0, 1, 1.0)))


OPTIONS = [
    ({"normals": "smooth"}, uem.InputError, ("normals = 'smooth'", "'facet' or 'averaged'")),
    ({"measure": "actual"}, uem.InputError, ("measure = 'actual'", "'reference' or 'current'")),
    ({"friction": -0.1}, uem.InputError, ("friction = -0.1",)),
    ({"friction": "rough"}, uem.InputTypeError, ("friction = 'rough'",)),
    ({"max_penetration": -1.0}, uem.InputError, ("max_penetration = -1.0",)),
    ({"max_penetration": "small"}, uem.InputTypeError, ("max_penetration = 'small'",)),
    ({"name": ""}, uem.InputTypeError, ("name = ''",)),
    ({"rigid": [None]}, uem.InputTypeError, ("rigid[0] = None", "a rigid surface")),
    ({"rigid": "floor"}, uem.InputTypeError, ("rigid = 'floor'",)),
    ({"exclude": [None]}, uem.InputTypeError, ("exclude[0] = None", "a part")),
    ({"order": [None]}, uem.InputTypeError, ("order[0] = None", "a part")),
    ({"bodies": ["a"]}, uem.InputTypeError, ("bodies = ['a']", "{name: part}")),
    ({"self_contact": "yes"}, uem.InputTypeError, ("self_contact = 'yes'",)),
]


@pytest.mark.parametrize("options,error,words", OPTIONS, ids=[next(iter(o)) for o, _, _ in OPTIONS])
def test_what_it_refuses(options, error, words):
    refused(error, words, lambda: uem.GeneralContact(**options))


PROBLEMS = {
    "one body": (lambda b: uem.GeneralContact(), uem.SurfaceError, ("there is one body and no rigid surface", "rigid=")),
    "nothing left": (lambda b: uem.GeneralContact(exclude=[all_facets(b.s.mesh)]), uem.SurfaceError, ("no facet that may touch",)),
    "another mesh": (
        lambda b: uem.GeneralContact(blocks(COMM, "triangle").low),
        uem.SpaceError,
        ("surfaces 'low' belongs to another mesh",),
    ),
    "cells": (lambda b: uem.GeneralContact(cells(b)), uem.TagError, ("surfaces 'cells' has dimension 2", "facets")),
    "a name": (lambda b: uem.GeneralContact("rims"), uem.TagError, ("surfaces = 'rims'", "tags['rims']")),
    "two names": (
        lambda b: uem.GeneralContact(bodies={"a": b.side(0, 1, 1.0), "b": cells(b)}, rigid=uem.RigidPlane((0, 0), (0, 1))),
        uem.SurfaceError,
        ("'b' and 'a' are one body", "one name"),
    ),
    "within a body": (
        lambda b: uem.GeneralContact(inner(b), rigid=uem.RigidPlane((0, 0), (0, 1))),
        uem.OrientationError,
        ("between two cells",),
    ),
}  # fmt: skip


def cells(b):
    return uem.Tag("cells", 7, 2, b.s.mesh, np.arange(len(b.s.body), dtype=np.int32))


def inner(b):
    """All facets of the mesh, on the outside and within."""
    b.s.mesh.topology.create_entities(1)
    index = b.s.mesh.topology.index_map(1)
    return uem.Tag("every", 8, 1, b.s.mesh, np.arange(index.size_local + index.num_ghosts, dtype=np.int32))


@pytest.mark.parametrize("contact,error,words", PROBLEMS.values(), ids=PROBLEMS)
def test_what_a_problem_refuses(contact, error, words):
    refused(error, words, lambda: one_block(contact))


def test_one_problem_each():
    """A general contact keeps the state of one problem."""
    contact = uem.GeneralContact(rigid=uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    one_block(lambda b: contact)
    refused(uem.SpaceError, ("new",), lambda: one_block(lambda b: contact))
