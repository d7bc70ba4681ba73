"""Assemblies with ties, preloads, couplings and equations, whose state depends on everything that there are derivatives by."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from gradient_scenes import along, move, wave
from helpers import blocks

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def assembly(
    cell="triangle", sizes=(3, 4), feature=None, comm=COMM, top=True, bottom=True, gap=0.0, locked=False, wavy=0.0, overhang=0.2, **how
):  # fmt: skip
    """A block on another, joined by a feature, loaded and moved at its top, and the values that its solution depends on."""
    # nodes are apart from sides of facets below, across which closest points have kinks
    shift = np.array([0.03, 0.07, 0.0]) if gap and cell == "tetrahedron" else 0.0
    b = blocks(comm, cell, *sizes, overhang=overhang, gap=gap, pose=lambda x: x + shift * (x[:, -1:] > 0.5 * gap))
    X = b.scene.mesh.geometry.x
    X[:, b.gdim - 1] += wavy * np.sin(4 * X[:, 0] + X[:, 1] * (b.gdim == 3))
    mesh, g, v = b.scene.mesh, b.gdim, ufl.TestFunction(b.V)
    E, load = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.array([0.01, *[0.0] * (g - 2), -0.01]))
    push = fem.Constant(mesh, np.array([0.02, *[0.0] * (g - 2), -0.05]))
    field = fem.Function(uem.function_space(mesh, ("DG", 0)))
    field.interpolate(lambda x: 1.0 + 0.2 * np.sin(5 * x[0] + x[1]))
    F = field * uem.NeoHooke(E, 0.3, kind="plane_strain" if g == 2 else "3d").residual(b.u, v) * ufl.dx
    later = fem.Constant(mesh, np.zeros(g))
    F = F - ufl.inner(load + later, v) * ufl.dx
    s = SimpleNamespace(
        b=b, u=b.u, E=E, load=load, top=push, field=field, X=ufl.SpatialCoordinate(mesh), g=g, numbers={}, constants={}, h=0.0
    )
    s.J = (ufl.inner(b.u, b.u) + E * b.u[0] * b.u[g - 1] + 0.1 * field * b.u[0]) * ufl.dx
    held = [fem.dirichletbc(push, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)] if top else []
    s.bcs = [*([uem.dirichlet(b.V, b.bottom)] if bottom else [uem.dirichlet(b.V, b.top, 0, 0.02)]), *held]

    def steps_of(problem, steps):
        """The load steps, after which preloads are locked, and another load acts."""
        yield from uem.load_steps(problem, steps)
        for contact in problem.contacts if locked else ():
            contact.lock()
            later.value[0], later.value[-1] = 0.03, 0.02
            problem.solve()
            yield

    def solve(steps=1, recorded=False, dynamics=False, **wanted):
        """The sum of J over all steps, or time steps up to a time, after which the problem and its history are at hand."""
        b.u.x.array[:], later.value[:], total = 0.0, 0.0, 0.0
        made = feature(s, **how)
        bcs = s.bcs[:1] if dynamics else s.bcs
        made |= {"dynamics": uem.Dynamics(uem.lumped_mass(b.V, 1.0))} if dynamics else {}
        s.problem = uem.UnitedProblem(F, b.u, bcs=bcs, rtol=1e-13, **made)
        with uem.recording(s.problem, **wanted) if recorded else nullcontext() as s.history:
            for _ in uem.time_steps(s.problem, 0.2, steps) if dynamics else steps_of(s.problem, steps):
                total += uem.integrate(s.J)
        return total

    s.solve = solve
    return s


def constant(s, name, value):
    """A Constant of a feature, made once."""
    if name not in s.constants:
        s.constants[name] = fem.Constant(s.b.scene.mesh, np.array(value, dtype=float) if np.ndim(value) else float(value))
    return s.constants[name]


def pressing(s, **how):
    """Contact of both blocks."""
    return uem.Contact(s.b.high, s.b.low, offset=float(s.numbers.setdefault("offset", 0.0)), **how)


def tie(s, **how):
    return {"contacts": [uem.Contact(s.b.high, s.b.low, tied=True, **how)]}


def preload(s, **how):
    force = s.numbers.setdefault("force", 0.05)
    return {"contacts": [uem.Preload(s.b.high, s.b.low, force=float(force), **how)]}


def shortening(s, **how):
    length = s.numbers.setdefault("shortening", 0.03)
    return {"contacts": [uem.Preload(s.b.high, s.b.low, shortening=float(length), **how)]}


def coupling(s, distribute=False, joints=None, contact=None, larger=1, rotations="large", **how):
    """The top as a rigid part, loaded at a point."""
    force, moment = constant(s, "force of the coupling", [0.01, *[0.0] * (s.g - 2), -0.03]), None
    moment = constant(s, "moment of the coupling", 0.004 if s.g == 2 else larger * np.array([0.001, 0.002, 0.0]))
    loads = {"force": force, "moment": moment, "rotations": rotations}
    one = uem.RigidCoupling(s.b.top, (*[0.5] * (s.g - 1), 1.2), distribute=distribute, **loads)
    contacts = tie(s)["contacts"] if contact is None else [uem.Contact(s.b.high, s.b.low, **contact)]
    return {"contacts": contacts, "couplings": [one, *([] if joints is None else joints(one))], **how}


def led(s, target=False, **how):
    """The top, or the surface of the lower block, as a rigid part whose motion is given."""
    motion = [constant(s, f"motion[{i}]", x) for i, x in enumerate((0.02, 0.05 if target else -0.05, 0.03))]
    one = uem.RigidCoupling(s.b.low if target else s.b.top, (0.5, 1.2), motion=motion)
    return {"contacts": [pressing(s, **how)], "couplings": [one]}


def dragged(s, **how):
    """Blocks that are tied, on a rigid plane with friction; the top is held."""
    friction = s.numbers.setdefault("friction", 0.3)
    plane = uem.RigidPlane((0.5, -1.0), (0.02, 1.0))
    plane.move(s.numbers.setdefault("place", np.zeros(2)))
    return {"contacts": [*tie(s)["contacts"], uem.Contact(s.b.bottom, plane, friction=float(friction))]}


def equation(s, **how):
    """Both sides of the upper block move alike, up to a given difference."""
    jump = constant(s, "b of the equation", 0.02)
    one = uem.Equation([(place(s, 0.0, 0.5), (1, 0.5)), (place(s, 1.0, 0.5), (-1, 0))], b=jump)
    return {"contacts": [pressing(s)], "equations": [one]}


def relation(s, **how):
    """Both corners of the rigid top move alike across, up to a given difference: it turns."""
    jump = constant(s, "b of the equation", 0.02)
    one = uem.Equation([(place(s, 0.0, 1.0), (0, 1.0)), (place(s, 1.0, 1.0), (0, -1))], b=jump)
    return coupling(s, equations=[one])


def mean(s, **how):
    """The lower side of the upper block has a given mean motion along the contact."""
    return {"contacts": [pressing(s)], "equations": [uem.MeanMotion(s.b.high, (1, 0), b=constant(s, "mean motion", 0.03))]}


def points(s, **how):
    """A force and a spring at nodes."""
    force = constant(s, "force at a node", [0.01, -0.005])
    loaded = [uem.PointLoad(place(s, 1.0, 0.5), force), uem.PointSpring(place(s, 0.0, 0.5), 0.3)]
    return {"contacts": [pressing(s)], "points": loaded}


def place(s, *x):
    """Where a node of the drawing is, once all nodes have moved by a share of the change of the shape."""
    return [a + s.h * 0.02 * np.sin(3 * x[0] + 2 * x[1] + i) for i, a in enumerate(x)]


def sprung(one):
    return [uem.Spring(None, one, 0.4, points=((0.5, 1.6), (0.5, 1.2)))]


def sliding(one):
    return [uem.Slider(None, one, (0.5, 1.2), (0.2, 1.0))]


def hinged(one):
    return [uem.Hinge(None, one, (0.5, 1.2))]


def controls_of(s, names):
    """Controls with the values that a run is made with, by name: the control, and a setter of its value plus h times its change."""
    found = {}
    for name in names:
        if name in s.numbers:
            found[name] = uem.ContactParameter(s.problem.contacts[-1], name)
        else:
            found[name] = s.constants[name] if name in s.constants else getattr(s, name)
    return found


def change_of(s, name, control):
    if name == "X":
        return wave(s.b.V, 0.02)
    if isinstance(control, fem.Function):
        return wave(control.function_space, 0.2)
    size = {"force": 0.02, "E": 0.3, "friction": 0.01, "shortening": 0.02, "mean motion": 0.03}.get(name, 0.01)
    shape = np.shape(control.value) if isinstance(control, fem.Constant) else control.shape(s.g)
    return size * np.linspace(1.0, 0.6, int(np.prod(shape))).reshape(shape)


def order(s, names, steps=1, recorded=False, size=0.02, halvings=1):
    """Taylor's test along a change of some controls together."""
    s.solve(steps, recorded)
    controls = controls_of(s, names)
    changes = {name: change_of(s, name, control) for name, control in controls.items()}
    every = list(controls.values())
    by = s.history.gradient([s.J] * len(s.history), every) if recorded else uem.gradient(s.problem, s.J, every)
    slope = along(by, changes.values())
    x = s.b.scene.mesh.geometry.x
    before = {
        n: np.array(c.x.array if isinstance(c, fem.Function) else c.value)
        for n, c in controls.items()
        if isinstance(c, (fem.Function, fem.Constant))
    }
    places, numbers = np.array(x), dict(s.numbers)

    def put(h):
        x[:], s.h = places, h if "X" in names else 0.0
        for name, control in controls.items():
            if name == "X":
                if h:
                    move(s, changes[name], h)
            elif isinstance(control, fem.Function):
                control.x.array[:] = before[name] + h * changes[name].x.array
            elif isinstance(control, fem.Constant):
                control.value[...] = before[name] + h * changes[name]
            else:
                s.numbers[name] = numbers[name] + h * changes[name]

    def functional(h):
        put(h)
        return s.solve(steps, recorded)

    try:
        return uem.taylor_test(functional, slope, size, halvings)
    finally:
        put(0.0)


ALL, FREE = ("E", "load", "top", "field"), ("E", "load", "field")
AXIS, TETRAHEDRA = {"axis": (0.1, 1.0)}, {"gap": 0.05, "cell": "tetrahedron", "sizes": (2, 3)}
LOADS = ("force of the coupling", "moment of the coupling")
MOTION = ("motion[0]", "motion[1]", "motion[2]")
#: Feature, its options, controls in addition to those of the bodies, and whether the top is moved by Dirichlet conditions.
FEATURES = {
    "tie": (tie, {}, (*ALL, "X")),
    "tie across a gap": (tie, {"gap": 0.05}, (*ALL, "X")),
    "tie of tetrahedra across a gap": (tie, TETRAHEDRA, (*ALL, "X")),
    "tie by mortar": (tie, {"coupling": "mortar"}, (*ALL, "X")),
    "tie by mortar across a gap": (tie, {"coupling": "mortar", "gap": 0.05, "wavy": 0.1}, (*ALL, "X")),
    "tie by mortar of tetrahedra": (tie, {"coupling": "mortar", "wavy": 0.12} | TETRAHEDRA, (*ALL, "X")),
    "tie, friction beside it": (dragged, {}, ("E", "load", "field", "X", "friction", "place")),
    "preload": (preload, AXIS, (*ALL, "force", "X")),
    "preload by mortar": (preload, AXIS | {"coupling": "mortar"}, (*ALL, "force", "X")),
    "shortening by mortar": (shortening, AXIS | {"coupling": "mortar", "wavy": 0.1}, (*ALL, "shortening", "X")),
    "preload, locked": (preload, AXIS | {"locked": True}, (*ALL, "force")),
    "shortening": (shortening, AXIS, (*ALL, "shortening", "X")),
    "coupling": (coupling, {}, (*FREE, *LOADS, "X")),
    "coupling, mortar": (coupling, {"contact": {"tied": True, "coupling": "mortar"}}, (*FREE, *LOADS, "X")),
    "coupling in space": (coupling, {"cell": "tetrahedron", "sizes": (2, 2), "gap": 0.05, "larger": 20}, (*FREE, *LOADS, "X")),
    "coupling, spring": (coupling, {"joints": sprung}, (*FREE, *LOADS, "X")),
    "coupling, spring, small rotations": (coupling, {"joints": sprung, "rotations": "small"}, (*FREE, *LOADS, "X")),
    "coupling, hinge": (coupling, {"joints": hinged}, (*FREE, LOADS[1], "X")),
    "coupling, led": (led, {}, (*FREE, *MOTION, "offset", "X")),
    "coupling, led, friction": (led, {"friction": 0.3}, (*FREE, *MOTION, "X")),
    "coupling of the target, led": (led, {"target": True}, (*ALL, *MOTION, "offset", "X")),
    "coupling, equation": (relation, {}, (*FREE, LOADS[0], "b of the equation")),
    "equation": (equation, {}, (*ALL, "b of the equation", "offset", "X")),
    "mean motion": (mean, {}, (*ALL, "mean motion", "offset")),
    # a slider takes all of a moment
    "coupling, slider": (coupling, {"joints": sliding}, (*FREE, LOADS[0], "X")),
    "force and spring at nodes": (points, {}, (*ALL, "force at a node", "offset", "X")),
}  # fmt: skip
NEEDS_HISTORY = ("tie, friction beside it", "preload, locked", "coupling, led, friction")
EACH = [(what, name) for what, (_, _, names) in FEATURES.items() for name in names]


def scene(what, comm=COMM):
    feature, how, names = FEATURES[what]
    return assembly(
        feature=feature, comm=comm, top="top" in names or feature is dragged, bottom=feature is not dragged, **how
    ), names
