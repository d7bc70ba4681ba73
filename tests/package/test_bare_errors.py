"""Wrong inputs that once ended in an error of Python's or of a library's: each is named."""

from __future__ import annotations

import os

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, clamp, linear, raised
from ramp_scenes import COMM, five_steps, nothing

import uem_dolfinx as uem

pytestmark = pytest.mark.every_case


def rough(friction):
    b = blocks(COMM, "triangle")
    contact = uem.Contact(b.high, b.low, friction=friction)
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact]).solve()


def closed(folder):
    problem, _ = five_steps(False, nothing)
    writer = uem.HistoryWriter(folder / "h.csv", problem)
    writer.close()
    writer.write(0.0)


def fails_on_the_last_rank(h):
    if COMM.rank == COMM.size - 1:
        raise ValueError("on this rank alone")
    return h * h


def fails_for(problem):
    fails_on_the_last_rank(0.0)


def one_step():
    problem, begin = five_steps(False, nothing)
    next(iter(begin(None)))
    return problem


def elsewhere():
    """A scene on another mesh."""
    return blocks(COMM, "triangle")


def write(folder, field):
    problem, _ = five_steps(False, nothing)
    b = field(problem)
    uem.ResultsWriter(folder / "r", problem, fields={"a": b})


def over_other_mesh(control):
    problem = one_step()
    b = elsewhere()
    own = fem.Constant(problem.u.function_space.mesh, 1.0)
    uem.gradient(problem, own * problem.u[0] * ufl.dx, [control(b)])


def functional_of_other_mesh():
    problem = one_step()
    uem.gradient(problem, elsewhere().u[0] * ufl.dx, [fem.Constant(problem.u.function_space.mesh, 1.0)])


def history_of_other_mesh():
    problem, begin = five_steps(False, nothing)
    with uem.recording(problem) as history:
        next(iter(begin(None)))
    history.gradient(elsewhere().u[0] * ufl.dx, [fem.Constant(problem.u.function_space.mesh, 1.0)])


def of_law(v):
    b = elsewhere()
    uem.VonMises(b.u, 1.0, 0.3, 1.0, kind="plane_strain").residual(v(b))


def drawn(folder, name="x.png", **how):
    pytest.importorskip("matplotlib")
    uem.plot_scene(five_steps(False, nothing)[0], folder / name, **how)


def profile(folder, contacts=None, **how):
    pytest.importorskip("matplotlib")
    uem.plot_pressure(five_steps(False, nothing)[0].contacts if contacts is None else contacts, folder / "x.png", **how)


def film(folder, **how):
    pytest.importorskip("matplotlib")
    problem, begin = five_steps(False, nothing)
    list(uem.animate(folder / "x.gif", problem, begin(None), **how))


def wrong(x):
    raise KeyError("the user's fault")


def moved_back(motions):
    five_steps(False, nothing)[0].state().move(motions)


def estimated(estimate):
    list(uem.load_steps(five_steps(False, nothing)[0], 1, estimate=estimate))


def along(arc_length):
    list(uem.load_steps(five_steps(False, nothing)[0], 1, arc_length=arc_length))


def touching(**how):
    b = blocks(COMM, "triangle")
    uem.Contact(b.high, how.pop("target", b.low), **how)


def assembled(**how):
    b = blocks(COMM, "triangle")
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), **how)


CLASSES = [
    *(
        (what, kind, lambda f, what=what, kind=kind: touching(**{what: kind}))
        for what, kind in (
            ("normal", uem.SoftContact), ("cohesion", uem.Cohesive), ("cohesion", uem.Adhesion), ("heat", uem.Conductance),
            ("leak", uem.Leak), ("target", uem.RigidPlane),
        )
    ),
    *(
        (what, kind, lambda f, what=what, kind=kind: assembled(**{what: [kind]}))
        for what, kind in (("points", uem.PointLoad), ("equations", uem.Equation), ("couplings", uem.RigidCoupling))
    ),
    ("arc_length", uem.Dissipation, lambda f: along(uem.Dissipation)),
    ("estimate", uem.ErrorLimit, lambda f: estimated(uem.ErrorLimit)),
]  # fmt: skip


def lone(result):
    b = blocks(COMM, "triangle")
    return result(uem.Contact(b.high, b.low))


def pushed(value):
    b = blocks(COMM, "triangle")
    return uem.dirichlet(b.V, b.top, 1, value)


def into(folder, name):
    """A checkpoint in a pipe or a path that is none."""
    if COMM.rank == 0 and not (folder / "pipe").exists():
        os.mkfifo(folder / "pipe")
    COMM.barrier()
    uem.write_checkpoint(f"{folder}/{name}", one_step().state())


CASES = {
    "active contactors of no problem": (uem.SurfaceError, "belongs to no problem yet", lambda f: lone(lambda c: c.n_active)),
    "gaps of no problem": (uem.SurfaceError, "belongs to no problem yet", lambda f: lone(lambda c: c.max_gap())),
    "pressures of no problem": (uem.SurfaceError, "belongs to no problem yet", lambda f: lone(lambda c: c.max_pressure())),
    "a Dirichlet value in words": (uem.InputTypeError, "= '-0.01': expected a number", lambda f: pushed("-0.01")),
    "complex Dirichlet values": (uem.InputError, "has complex numbers of the shape", lambda f: pushed(lambda x: 1j * x[0])),
    "no Dirichlet values": (uem.InputError, r"has the shape \(\)", lambda f: pushed(lambda x: None)),
    "complex friction": (uem.InputTypeError, "numbers", lambda f: rough(lambda x: 0.3 + 0j * x[0])),
    "a path with a null": (uem.InputError, "the path of a file", lambda f: into(f, "a\0b")),
    "a path that is a pipe": (uem.InputError, "a device or a pipe would be replaced", lambda f: into(f, "pipe")),
    **{
        f"{what} = {value!r} between steps": (error, what, lambda f, what=what, value=value: setattr(one_step(), what, value))
        for what, value, error in (
            ("rtol", "1e-8", uem.InputTypeError), ("rtol", np.nan, uem.InputError), ("max_iterations", 0, uem.InputError),
            ("line_search", "no", uem.InputTypeError), ("verbose", "yes", uem.InputTypeError),
        )
    },
    "general contact's force": (uem.SurfaceError, "belongs to no problem yet", lambda f: uem.GeneralContact().resultant()),
    "general contact's bodies": (uem.SurfaceError, "belongs to no problem yet", lambda f: uem.GeneralContact().touching()),
    "coupling's reaction": (
        uem.SpaceError, "is in no problem yet", lambda f: uem.RigidCoupling(np.array([0]), (0.5, 1.0)).reaction,
    ),
    "a law's class": (uem.InputTypeError, "as Coulomb(...)", lambda f: rough(uem.Coulomb)),
    **{
        f"the class {kind.__name__} as {what}": (uem.InputTypeError, rf"make an object of it, as {kind.__name__}", makes)
        for what, kind, makes in CLASSES
    },
    "an estimate that fails on one rank": (uem.UserFunctionError, "estimate raised ValueError", lambda f: estimated(fails_for)),
    "an arc length by number": (uem.InputTypeError, "arc_length = 0.1: expected True, False or a Dissipation", lambda f: along(0.1)),
    "words for friction": (uem.InputTypeError, "numbers", lambda f: rough(lambda x: ["a"] * x.shape[1])),
    "no functional": (uem.InputTypeError, "functional = None", lambda f: uem.taylor_test(None, 1.0)),
    "no halvings": (uem.InputError, "halvings = 0", lambda f: uem.taylor_test(lambda h: h * h, 0.0, halvings=0)),
    "half a halving": (uem.InputError, "halvings = 1.5", lambda f: uem.taylor_test(lambda h: h * h, 0.0, halvings=1.5)),
    "a closed table": (uem.InputError, "is closed", closed),
    "steps by number": (
        uem.InputTypeError, "steps = 3", lambda f: list(uem.animate(f / "x.gif", five_steps(False, nothing)[0], 3)),
    ),
    "no panels": (uem.InputError, "panels = 0", lambda f: uem.figure(f / "x.png", COMM, 0).__enter__()),
    "a functional of words": (uem.InputTypeError, "functional.0. = 'x'", lambda f: uem.taylor_test(lambda h: "x", 1.0)),
    "a functional that fails on one rank": (
        uem.UserFunctionError, "functional.0. raised ValueError", lambda f: uem.taylor_test(fails_on_the_last_rank, 0.0),
    ),
    "places of another mesh": (
        uem.SpaceError, r"controls.0. holds .* another mesh", lambda f: over_other_mesh(lambda b: ufl.SpatialCoordinate(b.V.mesh)),
    ),
    "a field of another mesh": (uem.SpaceError, r"controls.0. holds .* another mesh", lambda f: over_other_mesh(lambda b: b.u)),
    "a functional of another mesh": (uem.SpaceError, "J is integrated over another mesh", lambda f: functional_of_other_mesh()),
    "a history's functional of another mesh": (
        uem.SpaceError, "J is integrated over another mesh", lambda f: history_of_other_mesh(),
    ),
    "gradient of a number": (uem.InputTypeError, "u = 3", lambda f: uem.displacement_gradient(3)),
    "gradient without a mesh": (uem.InputTypeError, "u = ", lambda f: uem.displacement_gradient(ufl.as_vector([1.0, 2.0]))),
    "gradient of a scalar": (uem.InputError, r"u has the shape \(\)", lambda f: uem.displacement_gradient(elsewhere().u[0])),
    "variation of a number": (uem.InputTypeError, "u = 3", lambda f: of_law(lambda b: 3)),
    "variation of a scalar": (uem.InputError, r"u has the shape \(\)", lambda f: of_law(lambda b: ufl.TestFunction(b.V)[0])),
    "elastic variation of a number": (
        uem.InputTypeError, "u = 3", lambda f: uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(elsewhere().u, 3),
    ),
    "a field of five components": (
        uem.InputError, r"has the shape \(5,\)", lambda f: write(f, lambda p: ufl.as_vector([p.u[0]] * 5)),
    ),
    "a field of three indices": (
        uem.InputError, r"has the shape \(2, 2, 2\)", lambda f: write(f, lambda p: ufl.grad(ufl.grad(p.u))),
    ),
    "a test function as field": (
        uem.InputError, "holds a test or trial function", lambda f: write(f, lambda p: ufl.TestFunction(p.u.function_space)),
    ),
    "motions by number": (uem.InputTypeError, "motions = 3", lambda f: moved_back(3)),
    "motions of words": (uem.InputTypeError, "motions.0. = 'up'", lambda f: moved_back(["up"])),
    "motions of other contacts": (uem.InputError, "motions has 7 items", lambda f: moved_back([None] * 7)),
    "an unknown ending": (uem.InputError, "a name that ends in", lambda f: drawn(f, "x.foo")),
    "an unknown colour map": (uem.InputError, "did you mean 'rainbow'", lambda f: drawn(f, cmap="rainbow9")),
    "a colour map by number": (uem.InputTypeError, "cmap = 3", lambda f: drawn(f, cmap=3)),
    "a test function drawn": (
        uem.InputError, "field holds a test or trial", lambda f: drawn(f, field=ufl.TestFunction(elsewhere().V)[0]),
    ),
    "a drawn field of another mesh": (uem.SpaceError, "of another mesh", lambda f: drawn(f, field=elsewhere().u[0])),
    "a picture of negative width": (uem.InputError, r"size = \(-1, 2\)", lambda f: drawn(f, size=(-1, 2))),
    "a film of no height": (uem.InputError, r"size = \(1, 0\)", lambda f: film(f, size=(1, 0))),
    "a coordinate that raises": (uem.UserFunctionError, "along raised KeyError", lambda f: profile(f, along=wrong)),
    "a coordinate of more numbers": (uem.InputError, r"along\(x\) has shape", lambda f: profile(f, along=lambda x: x)),
    "a coordinate of words": (uem.InputTypeError, r"along\(x\) = ", lambda f: profile(f, along=lambda x: ["a"] * len(x))),
    "a reference of one number": (uem.InputError, r"reference\(x\) has shape", lambda f: profile(f, reference=lambda s: 1.0)),
    "a window the wrong way round": (uem.InputError, "a lower bound and a larger", lambda f: profile(f, window=(1.0, 0.0))),
    "pressure of no contact": (uem.InputError, r"contacts = \[\]", lambda f: profile(f, [])),
    "pressure of a number": (uem.InputTypeError, r"contacts\[0\] = 3", lambda f: profile(f, [3])),
    "outline of nothing": (uem.InputTypeError, "problem = None", lambda f: uem.outline(None)),
    "outline of no size": (uem.InputError, "scale = nan", lambda f: uem.outline(five_steps(False, nothing)[0], np.nan)),
}  # fmt: skip


@pytest.mark.parametrize("what", CASES)
def test_named(what, folder):
    error, words, call = CASES[what]
    raised(error, words, lambda: call(folder))
