"""Attributes of public objects that are set late or misspelt: they count, or are refused by name.

The test to read first is ``test_misspelt``.
"""

from __future__ import annotations

import copy
import inspect
import pickle

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import blocks, linear, refused

import uem_dolfinx as uem
from uem_dolfinx import given

COMM = MPI.COMM_WORLD


def made(folder):
    """One of every public class that keeps a state, and of those that are handed to problems (collective)."""
    b = blocks(COMM, "triangle")
    contact, law = uem.Contact(b.high, b.low), uem.VonMises(b.u, 1.0, 0.3, 1.0, kind="plane_strain")
    general, coupling = uem.GeneralContact(), uem.RigidCoupling(b.high, (0.5, 1.0), motion=(0.0, -0.01, 0.0))
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact])
    return {
        "problem": problem, "contact": contact, "general": general, "coupling": coupling, "law": law,
        "point": uem.PointLoad((0.5, 1.0), (0.0, 1.0)), "spring": uem.PointSpring((0.5, 1.0), 1.0),
        "equation": uem.Equation([((0.5, 1.0), (0.0, 1.0))]), "seam": uem.periodic(b.high, b.low), "plane": uem.RigidPlane((0, 0), (0, 1)),
        "sphere": uem.RigidSphere((0, 0), 1.0), "heat": uem.Conductance(1.0, field=1),
        "warm": uem.OfTemperature(lambda x, t, T: T, field=1),
        "dynamics": uem.Dynamics(uem.lumped_mass(b.V, 1.0)), "checkpoint": uem.Checkpoint(folder / "run"), "state": problem.state(),
        "history": uem.HistoryWriter(folder / "h.csv", problem), "results": uem.ResultsWriter(folder / "r", problem),
        "elastic": uem.LinearElastic(1.0, 0.3), "slide": uem.Coulomb(0.3),
        "step": uem.Step("a"), "bar": Bar(4).problem, "book": uem.EnergyBook(Bar(4).problem),
    }  # fmt: skip


def test_misspelt(folder):
    """Nothing takes an attribute that it has not, whichever class it is of; private ones are the package's business."""
    for name, one in made(folder).items():
        with pytest.raises((uem.InputError, AttributeError)) as reported:
            one.misspelt = 1
        assert "misspelt" in str(reported.value), name


def test_a_note():
    """A name of one letter is the script's own, unless it is an argument."""
    b = blocks(COMM, "triangle")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05))
    problem.b = b
    assert problem.b is b
    refused(uem.InputError, "make a new UnitedProblem", lambda: setattr(problem, "u", fem.Function(b.V)))


LATE = [
    ("problem", "bcs", []), ("problem", "points", []), ("problem", "contacts", []), ("problem", "materials", []), ("problem", "F", None),
    ("problem", "dynamics", None), ("general", "friction", 0.2), ("coupling", "motion", (0, 0, 0)), ("coupling", "force", (0.0, 1.0)),
    ("coupling", "point", (0.0, 0.0)), ("point", "at", (0.0, 0.0)), ("spring", "stiffness", 2.0), ("equation", "b", 2.0),
    ("sphere", "radius", 2.0), ("heat", "h", 2.0), ("dynamics", "gravity", (0.0, -1.0)), ("checkpoint", "every", 3), ("law", "E", 2.0),
    ("state", "mesh", None), ("history", "columns", {}), ("results", "fields", {}), ("contact", "sliding", "small"),
]  # fmt: skip


def test_late(folder):
    """What counts only when an object is made is refused with what to do, and stays what it was."""
    objects = made(folder)
    for name, what, value in LATE:
        one = objects[name]
        before = one.__dict__.get(what)
        refused(uem.InputError, ("make a new", what), lambda one=one, what=what, value=value: setattr(one, what, value))
        assert one.__dict__.get(what) is before, (name, what)


def test_copies(folder):
    """What has numbers alone is copied and pickled; what a mesh or a file belongs to names itself, and says what to do."""
    b, objects = blocks(COMM, "triangle"), made(folder)
    objects |= {"mass": uem.lumped_mass(b.V, 1.0), "tag": b.high, "soft": uem.NeoHooke(fem.Constant(b.scene.mesh, 1.0), 0.3)}
    for name in ("point", "spring", "equation", "general", "elastic", "slide"):
        for other in (copy.deepcopy(objects[name]), pickle.loads(pickle.dumps(objects[name])), copy.copy(objects[name])):
            assert type(other) is type(objects[name]) and repr(other) == repr(objects.get(name))
        objects.pop(name)
    moved = copy.deepcopy(plane := objects["plane"])
    moved.move((0.0, 0.1))
    assert moved.motion is not None and plane.motion is None
    for name in ("heat", "step", "checkpoint", "plane", "sphere", "warm"):
        objects.pop(name)
    for one in objects.values():
        for how in (copy.deepcopy, pickle.dumps):
            refused(uem.InputTypeError, (type(one).__name__, "cannot be", "make another"), lambda one=one, how=how: how(one))
    refused(uem.InputTypeError, "a RigidPlane cannot be pickled", lambda: pickle.dumps(plane))


def test_a_word_that_is_near():
    b = blocks(COMM, "triangle")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05))
    refused(uem.InputError, ("has no 'loads' to be set", "did you mean 'load'"), lambda: setattr(problem, "loads", None))
    refused(uem.InputTypeError, ("load = 3", "a scalar Constant"), lambda: setattr(problem, "load", 3))
    refused(uem.InputError, "has no 'pairs' to be set", lambda: setattr(problem, "pairs", []))


def test_what_counts_later():
    """The load of a problem, here a bare Constant, takes effect in the next steps."""
    b = blocks(COMM, "triangle")
    pull = fem.Constant(b.scene.mesh, 0.0)
    F = linear(b.u, 1.0) - pull * ufl.TestFunction(b.V)[1] * ufl.ds
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.05))
    list(uem.load_steps(problem, 1))
    before = np.abs(b.u.x.array).max()
    problem.load = pull
    list(uem.load_steps(problem, 1))
    assert pull.value == 1.0 and COMM.allreduce(np.abs(b.u.x.array).max() > before, MPI.LOR)


def test_classes_that_scripts_derive():
    """They have attributes of their own, set whenever they like, and arguments that count no more are still refused."""

    class Floor(uem.RigidPlane):
        def __init__(self, height):
            super().__init__((0.0, height), (0.0, 1.0))
            self.height = height

        def rise(self):
            self.risen = True
            self.move((0.0, 0.1))

    floor = Floor(1.0)
    floor.rise()
    assert floor.risen and floor.height == 1.0
    refused(uem.InputError, "make a new Floor", lambda: setattr(floor, "normal", (1.0, 0.0)))


def test_signatures_are_seen():
    """Help and completion show the arguments, not those of what seals."""
    assert list(inspect.signature(uem.PointLoad).parameters) == ["at", "force"]
    assert "contacts" in inspect.signature(uem.UnitedProblem).parameters
    assert given.arguments_of(uem.RigidSphere)[:2] == ("center", "radius")
