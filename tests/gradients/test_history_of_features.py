"""Histories over features of contacts and of problems: derivatives as by differences of all steps, or refused by name.

The page on gradients has a table of the same rows. Read first: ``EXACT`` and ``REFUSED``.
"""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import control_of, dot, drag_anew, wave
from helpers import blocks, highest, refused

import uem_dolfinx as uem

pytestmark = pytest.mark.every_case

COMM = MPI.COMM_WORLD
STEPS = 3


def plane():
    return uem.RigidPlane([0.4, 0.0], [0.02, 1.0])


def ball():
    return uem.RigidSphere([0.4, -3.0], 3.0)


def dragged(target=None, moves=False, general=False, equation=False, **how):
    """A block pressed onto another or onto a rigid surface and dragged, on 3 steps; see ``gradient_scenes.dragged``."""
    b = blocks(COMM, "triangle", 3, 4, overhang=0.25)
    mesh, v = b.scene.mesh, ufl.TestFunction(b.V)
    E, top = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.array([0.05, -0.05]))
    F = uem.NeoHooke(E, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx
    push = fem.dirichletbc(top, fem.locate_dofs_topological(b.V, 1, b.top.entities), b.V)
    # more is added to a friction that is a function of place
    values = {"offset": np.array(0.0), "place": np.zeros(2), "turn": np.array(0.0), "more": np.array(0.0)}
    if isinstance(how.get("friction"), float):
        values["friction"] = np.array(how.pop("friction"))
    s = SimpleNamespace(
        b=b, E=E, top=top, X=ufl.SpatialCoordinate(mesh), values=values, J=(ufl.inner(b.u, b.u) + E * b.u[0] * b.u[1]) * ufl.dx
    )

    def solve():
        b.u.x.array[:] = 0.0
        surface, load = b.low if target is None else target(), None
        if target is not None:
            # the place where it starts is changed with all others
            surface.move(values["place"], float(values["turn"]))
        if moves:

            def load(f):
                surface.move(values["place"] + f * np.array([0.05, 0.01]), float(values["turn"]) + 0.02 * f)

        laws = dict(how)
        if "friction" in values:
            laws["friction"] = float(values["friction"])
        elif callable(how.get("friction")):
            laws["friction"] = lambda x: how["friction"](x) + float(values["more"])
        offset = {} if general or not values["offset"] else {"offset": float(values["offset"])}
        s.contact = uem.GeneralContact(**laws) if general else uem.Contact(b.high, surface, **offset, **laws)
        more = {"equations": [uem.Equation([((0.0, 0.5), (1, 0)), ((1.0, 0.5), (-1, 0))])]} if equation else {}
        bcs = [uem.dirichlet(b.V, b.bottom), push]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[s.contact], rtol=1e-13, **({"load": load} if load else {}), **more)
        with uem.recording(problem) as history:
            for _ in uem.load_steps(problem, STEPS):
                pass
        s.fields = [part.status for part in (s.contact.parts if general else [s.contact])]
        return history

    s.solve = solve
    return s


def deviation(s, name):
    """Derivative along a change of one control, over all steps, over central differences of the runs, less 1."""
    found = s.solve()
    (by,) = found.gradient(s.J, [control_of(s, s.contact, "friction" if name == "more" else name)])
    status = [np.array(f.x.array) for f in s.fields]
    change = wave(s.b.V) if name == "X" else np.linspace(1.0, 0.6, np.size(by)).reshape(np.shape(by))
    slope = dot(by, change) if name == "X" else float(np.sum(by * change))

    def functional(h):
        _, J = drag_anew(s, name, change, h)
        assert all(np.array_equal(f.x.array, then) for f, then in zip(s.fields, status)), f"{name} changes the active set"
        return J

    h = 1e-5
    by_differences = (functional(h) - functional(-h)) / (2 * h)
    # of a ball's turn both are zero
    return abs(slope - by_differences) / max(abs(by_differences), 1e-6)


#: What is exact, by what it is: options and controls.
EXACT = {
    "without friction": ({}, "E top X offset"),
    "without friction, mortar": ({"coupling": "mortar"}, "E top X offset"),
    "sliding='fixed'": ({"sliding": "fixed"}, "E top offset"),
    "a plane that moves": ({"target": plane, "moves": True}, "E top X place turn"),
    "a plane that moves, mortar": ({"target": plane, "moves": True, "coupling": "mortar"}, "E top X place turn"),
    "a ball that moves": ({"target": ball, "moves": True}, "E top X place turn"),
    "all surfaces": ({"general": True}, "E top X"),
    "all surfaces, mortar": ({"general": True, "coupling": "mortar"}, "E top X"),
    "ties": ({"tied": True}, "E top X"),
    "equations": ({"equation": True}, "E top"),
    "friction": ({"friction": 0.3}, "E top X friction"),
    "friction, all surfaces": ({"friction": 0.3, "general": True}, "E top X"),
    "friction, equations": ({"friction": 0.3, "equation": True}, "E top"),
    "friction, a function of place": ({"friction": lambda x: 0.15 + 0.1 * x[0]}, "E top more"),
    "friction, a function of place, a plane": ({"friction": lambda x: 0.3 + 0.1 * x[0], "target": plane}, "place more"),
    "friction, a plane that moves": ({"friction": 0.3, "target": plane, "moves": True}, "E top X friction place turn"),
    "friction, a ball": ({"friction": 0.3, "target": ball}, "E X place turn"),
    "friction, a ball that moves": ({"friction": 0.3, "target": ball, "moves": True}, "E place turn"),
}  # fmt: skip
CASES = [(what, name) for what, (_, names) in EXACT.items() for name in names.split()]


@pytest.mark.parametrize("what, name", CASES)
def test_exact(what, name):
    assert deviation(dragged(**EXACT[what][0]), name) <= 1e-6


#: What is refused, by what it is: options, control, words of the refusal.
REFUSED = {
    "sliding='small'": ({"sliding": "small"}, "E", "projected where an earlier step ended"),
    "the shape, sliding='fixed'": ({"sliding": "fixed"}, "X", "needs contacts of sliding='finite'"),
    "friction, the shape and a function of place": ({"friction": lambda x: 0.3 + 0.1 * x[0]}, "X", "a function of place"),
    "friction, sliding='small'": ({"friction": 0.3, "sliding": "small"}, "E", "sliding='finite'"),
    "friction, averaged normals": ({"friction": 0.3, "normals": "averaged"}, "E", "normals='facet'"),
    "Tresca": ({"friction": uem.Tresca(0.01)}, "E", "Coulomb's law"),
    "Stribeck": ({"friction": uem.Stribeck(0.3, 0.2)}, "E", "Coulomb's law"),
    "wear": ({"friction": 0.3, "wear": 1e-2}, "E", "no wear"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what):
    how, name, words = REFUSED[what]
    s = dragged(**how)
    refused(uem.InputError, words, lambda: s.solve().gradient(s.J, getattr(s, name)))


def test_a_ball_turns_about_its_centre():
    """A turn of a ball about its centre does nothing where no friction takes it along."""
    s = dragged(target=ball, moves=True)
    found = s.solve()
    by_turn, by_place = found.gradient(s.J, [uem.ContactParameter(s.contact, name) for name in ("turn", "place")])
    assert highest(COMM, np.abs(by_turn)) <= 1e-10 * highest(COMM, np.abs(by_place))
