"""Gradients of assemblies: controls by features, each product of second order by Taylor's test, or refused by name before any work.

The page on gradients has a table of the same rows and columns. Read first: ``FEATURES`` and ``REFUSED``.
"""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import along, move, wave
from helpers import blocks, refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def assembly(cell="triangle", sizes=(3, 4), feature=None, comm=COMM, top=True, bottom=True, gap=0.0, locked=False, **how):
    """A block on another, joined by a feature, loaded and moved at its top, and the values that its solution depends on."""
    # nodes are apart from sides of facets below, across which closest points have kinks
    shift = np.array([0.03, 0.07, 0.0]) if gap and cell == "tetrahedron" else 0.0
    b = blocks(comm, cell, *sizes, overhang=0.2, gap=gap, pose=lambda x: x + shift * (x[:, -1:] > 0.5 * gap))
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
AXIS = {"axis": (0.1, 1.0)}
LOADS = ("force of the coupling", "moment of the coupling")
MOTION = ("motion[0]", "motion[1]", "motion[2]")
#: Feature, its options, controls in addition to those of the bodies, and whether the top is moved by Dirichlet conditions.
FEATURES = {
    "tie": (tie, {}, (*ALL, "X")),
    "tie across a gap": (tie, {"gap": 0.05}, (*ALL, "X")),
    "tie of tetrahedra across a gap": (tie, {"gap": 0.05, "cell": "tetrahedron", "sizes": (2, 3)}, (*ALL, "X")),
    "tie by mortar": (tie, {"coupling": "mortar"}, ALL),
    "tie, friction beside it": (dragged, {}, ("E", "load", "field", "X", "friction", "place")),
    "preload": (preload, AXIS, (*ALL, "force", "X")),
    "preload by mortar": (preload, {"coupling": "mortar"}, (*ALL, "force")),
    "preload, locked": (preload, AXIS | {"locked": True}, (*ALL, "force")),
    "shortening": (shortening, AXIS, (*ALL, "shortening", "X")),
    "coupling": (coupling, {}, (*FREE, *LOADS, "X")),
    "coupling, mortar": (coupling, {"contact": {"tied": True, "coupling": "mortar"}}, (*FREE, *LOADS)),
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


@pytest.mark.parametrize("what", [what for what in FEATURES if what not in NEEDS_HISTORY])
def test_of_second_order(what):
    """All controls together."""
    assert order(*scene(what)) >= 1.95


@pytest.mark.parametrize("what", FEATURES)
def test_histories_of_second_order(what):
    """All controls together, and functionals of all steps, which show what values have reached in each."""
    assert order(*scene(what), 3, True) >= 1.95


@pytest.mark.slow
@pytest.mark.parametrize("what, name", EACH)
def test_each_of_second_order(what, name):
    """One control after the other."""
    s, _ = scene(what)
    assert order(s, (name,), 2 if what in NEEDS_HISTORY else 1, what in NEEDS_HISTORY) >= 1.95


#: What is exact in time, with its own control.
IN_TIME = {"tie": (), "preload": ("force",), "shortening": ("shortening",), "equation": ("b of the equation",)}
IN_TIME |= {"force and spring at nodes": ("force at a node",)}


@pytest.mark.parametrize("what", IN_TIME)
def test_in_time(what):
    """Each control against central differences of all steps; forces act on the first acceleration, too."""
    s, _ = scene(what)
    names = ("E", "load", *IN_TIME[what])
    s.solve(0.8, True, dynamics=True)
    controls = controls_of(s, names)
    found = s.history.gradient(s.J, list(controls.values()))
    for by, (name, control) in zip(found, controls.items()):
        change, values = change_of(s, name, control), []
        for h in (1e-4, -1e-4):
            before = s.numbers[name] if name in s.numbers else np.array(control.value)
            if name in s.numbers:
                s.numbers[name] = before + h * change
            else:
                control.value[...] = before + h * change
            s.solve(0.8, True, dynamics=True)
            values.append(uem.integrate(s.J))
            if name in s.numbers:
                s.numbers[name] = before
            else:
                control.value[...] = before
        assert float(np.sum(by * change)) == pytest.approx((values[0] - values[1]) / 2e-4, rel=1e-6)


def staged(second=None):
    """A bolt that is tightened by a Step, locked by the next, and loaded; with the values by which it is changed."""
    s = assembly(feature=preload, axis=(0.1, 1.0))
    s.load.value[:] = 0.0
    F = s.field * uem.NeoHooke(s.E, 0.3, kind="plane_strain").residual(s.u, ufl.TestFunction(s.b.V)) * ufl.dx
    F = F - ufl.inner(s.load, ufl.TestFunction(s.b.V)) * ufl.dx

    def solve(E=1.0, force=0.05, end=(0.03, 0.02)):
        s.E.value, s.numbers["force"], s.b.u.x.array[:], s.load.value[:] = E, force, 0.0, 0.0
        s.contact = preload(s, axis=(0.1, 1.0))["contacts"][0]
        problem = uem.UnitedProblem(F, s.u, bcs=s.bcs, contacts=[s.contact], rtol=1e-13)
        steps = [uem.Step(name="tighten"), uem.Step(name="pull", loads={s.load: end}, preload={s.contact: None}, n=2)]
        with uem.recording(problem) as s.history:
            total = sum(uem.integrate(s.J) for _ in uem.load_steps(problem, steps if second is None else second(s)))
        return total

    s.solve = solve
    return s


def test_steps():
    """Steps that tighten, lock and pull: of second order by modulus, force and the load at the end."""
    s = staged()
    s.solve()
    controls = [s.E, uem.ContactParameter(s.contact, "force"), s.load]
    by = s.history.gradient([s.J] * len(s.history), controls)
    slope = float(0.3 * by[0] + 0.02 * by[1] + by[2] @ [0.01, 0.02])
    assert len(s.history) == 3
    found = uem.taylor_test(lambda h: s.solve(1 + 0.3 * h, 0.05 + 0.02 * h, (0.03 + 0.01 * h, 0.02 + 0.02 * h)), slope, 0.02, 1)
    assert found >= 1.95
    others = staged(lambda s: [uem.Step(name="other", bcs=s.bcs)])
    refused(uem.InputError, "Steps with conditions", others.solve)


BOTH_WAYS = ("tie across a gap", "preload", "shortening", "coupling, spring", "coupling, led", "equation")


@pytest.mark.parametrize("what", BOTH_WAYS)
def test_forward_as_backward(what):
    """The adjoint's derivative is the one of the displacement, put into J."""
    s, names = scene(what)
    s.solve()
    controls = controls_of(s, names)
    pairs = [(control, change_of(s, name, control)) for name, control in controls.items()]
    du = uem.tangent(s.problem, pairs)
    explicit = ufl.derivative(s.J, s.u, du) + ufl.derivative(s.J, s.field, change_of(s, "field", s.field))
    by_E = ufl.diff(ufl.replace(s.E * s.u[0] * s.u[s.g - 1], {s.E: (E := ufl.variable(s.E))}), E) * float(change_of(s, "E", s.E))
    found = uem.integrate(explicit) + uem.integrate(ufl.algorithms.expand_derivatives(by_E * ufl.dx))
    if "X" in controls:
        found += uem.integrate(ufl.algorithms.expand_derivatives(ufl.derivative(s.J, s.X, change_of(s, "X", s.X))))
    by = along(uem.gradient(s.problem, s.J, list(controls.values())), [change for _, change in pairs])
    assert found == pytest.approx(by, rel=1e-10)


@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize("what", FEATURES)
def test_on_any_ranks(what):
    """The same derivatives along a change, on one rank and on all."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        s, names = scene(what, comm)
        s.solve(2, True)
        controls = controls_of(s, names)
        by = s.history.gradient([s.J] * len(s.history), list(controls.values()))
        found.append([along([b], [change_of(s, name, c)]) for b, (name, c) in zip(by, controls.items())])
    assert found[0] == pytest.approx(found[1], rel=1e-8)


def after(s, **how):
    return {"contacts": [uem.Contact(s.b.high, s.b.low, tied="after")]}


#: What is refused: feature, options, control, words of the refusal, and whether it is one of a history.
REFUSED = {
    "ties made later": (after, {}, "E", "tied between steps", True),
    "the shape, ties by mortar": (tie, {"coupling": "mortar"}, "X", "ties by mortar", False),
    "the shape, ties of hexahedra": (tie, {"cell": "hexahedron", "sizes": (2, 3)}, "X", "ties of hexahedra", False),
    "the shape, a section without axis": (preload, {}, "X", "expected an axis", False),
    "the shape, mean motions": (mean, {}, "X", "with a MeanMotion", False),
    "the shape, equations of rigid parts": (relation, {}, "X", "by the shape with couplings", False),
    "the offset of a tie": (tie, {}, "offset", "which is tied", False),
    "a locked preload without its history": (preload, AXIS | {"locked": True}, "E", "depends on earlier steps", False),
    "the shape, a locked preload": (preload, AXIS | {"locked": True}, "X", "an opening that changes with the shape", True),
    "a load distributed at large rotations": (coupling, {"distribute": True}, "E", "expected rotations='small'", False),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what, monkeypatch):
    """By name, and before anything is solved."""
    feature, how, name, words, recorded = REFUSED[what]
    s = assembly(feature=feature, top=feature not in (coupling, relation), **how)
    if feature is after:
        refused(uem.InputError, words, lambda: s.solve(1, True))
        return
    s.solve(1, recorded)
    control = uem.ContactParameter(s.problem.contacts[0], name) if name == "offset" else getattr(s, name)
    monkeypatch.setattr("uem_dolfinx.gradients.linearised.Linearised.__enter__", None)
    refused(
        uem.InputError,
        words,
        lambda: (s.history.gradient if recorded else lambda J, m: uem.gradient(s.problem, J, m))(s.J, control),
    )


#: What is refused before the first step of a history, by the derivatives that are announced.
ANNOUNCED = {
    "the shape, ties by mortar": (tie, {"coupling": "mortar"}, False, lambda s: {"controls": s.X}, "ties by mortar"),
    "the shape, equations of rigid parts": (relation, {}, False, lambda s: {"controls": [s.E, s.X]}, "with couplings"),
    "the shape in time": (tie, {}, True, lambda s: {"controls": [s.X]}, "no derivatives by it in time"),
    "the displacement": (tie, {}, False, lambda s: {"controls": [s.u]}, "which the problem solves for"),
    "a tangent in time": (tie, {}, True, lambda s: {"tangent": True}, "tangents of histories are of statics"),
}


@pytest.mark.parametrize("what", ANNOUNCED)
def test_refused_before_the_first_step(what):
    """Controls that are announced before the first step."""
    feature, how, dynamics, wanted, words = ANNOUNCED[what]
    s = assembly(feature=feature, top=feature is not relation, **how)
    refused(uem.InputError, words, lambda: s.solve(1, True, dynamics, **wanted(s)))
    assert s.problem.progress.steps == 0 and s.problem.history is None


def test_announced_and_taken():
    """Controls that have derivatives change nothing."""
    s = assembly(feature=tie)
    s.solve(2, True, controls=[s.E, s.X], tangent=True)
    assert len(s.history.gradient(s.J, [s.E, s.X])) == len(s.history.tangent([(s.E, 1.0)])) == 2


def test_pressures_of_ties():
    """Pressures next to a tie have derivatives, those of a tie itself have none."""
    s, _ = scene("tie")
    s.solve()
    J = s.problem.contacts[0].pressure * uem.ds(s.b.high) + s.u[0] * ufl.dx
    refused(uem.InputError, "pressure of", lambda: uem.gradient(s.problem, J, s.E))


def test_pressures_with_equations_and_couplings():
    """Of second order, with rows of users in addition to those of the contact."""
    for what, names in (("equation", ("E", "b of the equation")), ("coupling, led", ("E", *MOTION))):
        s, _ = scene(what)
        s.solve()
        controls = controls_of(s, names)

        def functional(h):
            for name, c in controls.items():
                c.value[...] = before[name] + h * change_of(s, name, c)
            s.solve()
            return uem.integrate(s.problem.contacts[0].pressure ** 2 * uem.ds(s.b.high))

        before = {name: np.array(c.value) for name, c in controls.items()}
        J = s.problem.contacts[0].pressure ** 2 * uem.ds(s.b.high)
        by = along(uem.gradient(s.problem, J, list(controls.values())), [change_of(s, n, c) for n, c in controls.items()])
        assert uem.taylor_test(functional, by, 0.02, 1) >= 1.95
