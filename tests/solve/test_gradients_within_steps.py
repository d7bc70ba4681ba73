"""Gradients of states within load steps: of what steps lead to its value they have the share that the state has of it.

Read first: ``test_shares``, Taylor's test over what is led, and how.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import dot, wave
from helpers import blocks, refused, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
#: Values that are led, in lengths of the scene and moduli.
FULL = {"pull": 0.02, "shear": 0.03, "offset": 0.01, "top": -0.06, "E": 1.0, "by_function": 0.01}


class Led:
    """A block pressed onto another: ``values`` are led there in some way, ``controls`` what there are derivatives by, all by name."""

    def __init__(self, size=1.0, comm=COMM):
        b = blocks(comm, "triangle", 2, 3, overhang=0.25)
        b.scene.mesh.geometry.x[:] *= size
        mesh, v = b.scene.mesh, ufl.TestFunction(b.V)
        constants = {name: fem.Constant(mesh, 0.0) for name in ("pull", "shear", "by_function")}
        constants |= {"E": fem.Constant(mesh, 1.0), "top": fem.Constant(mesh, 0.0)}
        self.sides = wave(b.V, 2e-3 * size)
        law = uem.NeoHooke(constants["E"], 0.3, kind="plane_strain")
        self.F = law.residual(b.u, v) * ufl.dx - (constants["pull"] + constants["by_function"]) / size * v[0] * ufl.dx
        ends = (
            fem.locate_dofs_topological(b.V.sub(0), 1, b.top.entities),
            fem.locate_dofs_topological(b.V.sub(1), 1, b.top.entities),
        )
        self.bcs = [uem.dirichlet(b.V, b.bottom, value=self.sides)]
        self.bcs += [
            fem.dirichletbc(constants[name], dofs, b.V.sub(i)) for i, (name, dofs) in enumerate(zip(("shear", "top"), ends))
        ]
        self.b, self.size, self.constants = b, size, constants
        self.values = {name: full * (size if name in ("shear", "offset", "top") else 1.0) for name, full in FULL.items()}
        self.J = (b.u[0] ** 2 + b.u[0] * b.u[1]) * ufl.dx

    def problem(self, load=None):
        """A new one at rest, its contact without offset."""
        self.b.u.x.array[:] = 0.0
        for name, constant in self.constants.items():
            constant.value = self.values[name] if name in ("E", "top") else 0.0
        self.contact = uem.Contact(self.b.high, self.b.low)
        return uem.UnitedProblem(self.F, self.b.u, bcs=self.bcs, contacts=[self.contact], load=load, rtol=1e-13)

    def load(self):
        """Constants in a form and in a condition, and one that a function sets."""
        c, v = self.constants, self.values
        return {
            c["pull"]: v["pull"],
            c["shear"]: v["shear"],
            c["by_function"]: lambda s: FULL["by_function"] * s**2 + v["by_function"] - FULL["by_function"],
        }

    def control(self, name):
        return (
            self.sides
            if name == "sides"
            else uem.ContactParameter(self.contact, "offset")
            if name == "offset"
            else self.constants[name]
        )


def until(steps, factor):
    """The step at which a load factor is reached, the steps left there."""
    return next(step for step in steps if abs(step.factor - factor) < 1e-9)


def in_one_call(s, path):
    problem = s.problem(s.load())
    until(uem.load_steps(problem, 4), 0.5)
    return problem


def in_the_body(s, path):
    """Asked while the step is handed out, and taken again."""
    problem = s.problem(s.load())
    for step in uem.load_steps(problem, 4):
        if step.factor == 0.75:
            problem.solve()
            s.requested = uem.gradient(problem, s.J, [s.control(name) for name in s.names])
            break
    return problem


def in_the_second_call(s, path):
    """To half of the values first, then on: a change is the same in both calls."""
    problem, change = s.problem(s.load()), s.values["top"] - FULL["top"] * s.size
    s.constants["top"].value = 0.5 * FULL["top"] * s.size + change
    until(uem.load_steps(problem, 1), 1.0)
    s.constants["top"].value = s.values["top"]
    until(uem.load_steps(problem, 4), 0.25)
    return problem


def recorded(s, path):
    """Two calls, of which a history has the derivative at the end of the last step, too."""
    problem = s.problem({c: v for c, v in s.load().items() if not callable(v)})
    with uem.recording(problem) as s.history:
        until(uem.load_steps(problem, 2), 0.5)
        until(uem.load_steps(problem, 4), 0.5)
    return problem


def in_steps(s, path):
    """The second of two Steps, with an offset; a Constant continues from its value in the first, another from nothing."""
    problem, c, v = s.problem(), s.constants, s.values
    first = uem.Step("first", 1, loads={c["pull"]: v["pull"] - 0.5 * FULL["pull"]})
    second = uem.Step("second", 4, loads={c["pull"]: v["pull"], c["shear"]: v["shear"]}, offset={s.contact: v["offset"]})
    until((step for step in uem.load_steps(problem, [first, second]) if step.step == "second"), 0.5)
    return problem


def at_once(s, path):
    problem, c, v = s.problem(), s.constants, s.values
    until(
        uem.load_steps(problem, [uem.Step(n=2, loads={c["pull"]: v["pull"]}, offset={s.contact: v["offset"]}, ramp=False)]), 0.5
    )
    return problem


def resumed(s, path):
    """Steps continued from a checkpoint in the second of two calls."""
    for until_now in (0.5, 0.75):
        problem = s.problem(s.load())
        for calls, factor in ((1, 1.0), (4, until_now)):
            for step in uem.load_steps(problem, calls, checkpoint=uem.Checkpoint(path, every=1)):
                if step.factor >= factor:
                    break
    path.unlink()
    return problem


def along_an_arc(s, path):
    """A state that an arc has found, at the load factor that it has found; other values are those of this factor."""
    problem = s.problem({c: v for c, v in s.load().items() if c is s.constants["pull"]})
    problem.set_load(0.0)
    problem.solve()
    if s.factor is None:
        steps = uem.load_steps(problem, 4, arc_length=True)
        s.factor = [next(steps).factor for _ in range(3)][-1]
        steps.close()
    else:
        problem.set_load(s.factor)
        problem.solve()
    return problem


WAYS = {
    in_one_call: ("top", "sides", "pull", "shear", "by_function", "E"),
    in_the_body: ("top", "pull", "shear"),
    in_the_second_call: ("top", "sides", "pull", "shear"),
    recorded: ("top", "sides", "pull", "shear", "E"),
    in_steps: ("top", "sides", "pull", "shear", "offset"),
    at_once: ("top", "pull", "offset"),
    resumed: ("top", "sides", "pull"),
    along_an_arc: ("top", "pull", "E"),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", [pytest.param(way, id=way.__name__) for way in WAYS])
@pytest.mark.parametrize("size", [1.0, slow(1e-9), slow(1e3)])
def test_shares(way, size, tmp_path):
    """``J(h) - J(0) - h J'`` vanishes with h^2, J computed anew by all steps, for all that is led, and for what is not."""
    s, names = Led(size), WAYS[way]
    s.names, s.factor, s.requested, s.history = names, None, None, None
    path = COMM.bcast(tmp_path) / "run"
    problem, scale = way(s, path), size**4
    controls = [s.control(name) for name in names]
    found, reported = s.requested or uem.gradient(problem, s.J, controls), {}
    if s.history is not None:
        for now, before in zip(found, s.history.gradient(s.J, controls)):
            values = [np.asarray(one.x.array if isinstance(one, fem.Function) else one) for one in (now, before)]
            assert values[0] == pytest.approx(values[1], rel=1e-9, abs=1e-9 * np.abs(values[1]).max())
    for name, by in zip(names, found):
        change, before = wave(s.b.V, 0.02 * size), np.array(s.sides.x.array)
        size_of = size if name in ("top", "shear", "offset") else 1.0
        slope = dot(by, change) if name == "sides" else float(by) * size_of
        # forwards as backwards
        pair = (controls[names.index(name)], change if name == "sides" else size_of)
        if s.requested is None and name != "by_function":
            problem = way(s, path)
            pair = (s.control(name), pair[1])
            du = uem.tangent(problem, [pair])
            assert uem.integrate(ufl.derivative(s.J, s.b.u, du)) == pytest.approx(slope, rel=1e-8)

        def functional(h, name=name, change=change, before=before, size_of=size_of):
            kept = s.values.get(name)
            if name == "sides":
                s.sides.x.array[:] = before + h * change.x.array
            else:
                s.values[name] = kept + h * size_of
            way(s, path)
            s.sides.x.array[:], s.values[name] = before, kept
            return uem.integrate(s.J) / scale

        reported[name] = uem.taylor_test(functional, slope / scale, 2e-3, 1)
    assert min(reported.values()) >= 1.9, reported


def test_from_where_nodes_were_free():
    """A condition that a Step begins leads nodes on from where everything has left them: refused on the way, not at its end."""
    s = Led()
    problem = s.problem()
    more = [*s.bcs, uem.dirichlet(s.b.V, s.b.high, 0, 0.01)]
    for step in uem.load_steps(problem, [uem.Step(n=1), uem.Step("hold", 2, bcs=more)]):
        if step.step == "hold" and step.factor < 1.0:
            refused(
                uem.InputError,
                ("the Dirichlet value of x at", "is being ramped"),
                lambda: uem.gradient(problem, s.J, s.constants["E"]),
            )
    assert np.isfinite(uem.gradient(problem, s.J, s.constants["E"])[0])


def test_values_that_have_changed_within_steps():
    """A value on its way that has changed since the step is reported, too, and a Constant that was set by hand is what it is."""
    s = Led()
    problem = s.problem(s.load())
    until(uem.load_steps(problem, 4), 0.5)
    first = float(uem.gradient(problem, s.J, s.constants["pull"])[0])
    s.constants["top"].value *= 1.01
    refused(
        uem.InputError, "other values than Dirichlet conditions prescribe", lambda: uem.gradient(problem, s.J, s.constants["E"])
    )
    s.constants["top"].value = s.values["top"]
    problem.load = {c: v for c, v in s.load().items() if c is not s.constants["pull"]}
    s.constants["pull"].value *= 1.0 + 1e-9
    problem.solve(start=problem.progress.start, fraction=0.5)
    assert float(uem.gradient(problem, s.J, s.constants["pull"])[0]) == pytest.approx(2.0 * first, rel=1e-6)
