"""Steps of one problem: conditions, loads, contacts and coefficients that change between them, and what that releases.

The test to read first is ``test_a_column_through_its_steps``.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_unit_square, locate_entities_boundary
from helpers import M, blocks, clamp, highest, linear, modulus, refused, slow
from restart_scenes import COMM, Killed, bits

import uem_dolfinx as uem
from uem_dolfinx import forms


class Column:
    """A block on a block between rollers, each of height 1: pressures and ways are those of one dimension."""

    def __init__(self, n=(1, 2), kind=uem.Contact, held=("bottom", "sides", "top"), equations=(), **how):
        self.b = b = blocks(COMM, "quadrilateral", *n)
        self.p, v = fem.Constant(b.scene.mesh, 0.0), ufl.TestFunction(b.V)
        F = linear(b.u, modulus(b.scene, 1.0, 1.0)) + self.p * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
        bottom, top, *sides = b.oedometer(0.02)
        self.bcs = {"bottom": [bottom], "top": [top], "sides": sides}
        self.joint = kind(b.high, b.low, name="joint", **how)
        self.problem = uem.UnitedProblem(F, b.u, bcs=self.held(*held), contacts=[self.joint], equations=equations, rtol=1e-12)

    def held(self, *names):
        return [bc for name in names for bc in self.bcs[name]]

    def steps(self):
        """Pressed by a way, then by a load; the contact goes and comes again under the way."""
        return [
            uem.Step("press", 2),
            uem.Step("load", 3, bcs=self.held("bottom", "sides"), loads={self.p: 0.03}),
            uem.Step(
                "part",
                4,
                bcs=self.held("bottom", "top", "sides"),
                loads={self.p: 0.0},
                contacts={self.joint: False},
                offset={self.joint: -0.02},
            ),
            uem.Step("meet", 2, contacts={self.joint: True}, offset={self.joint: 0.0}),
        ]

    def forces(self):
        """In the contact, and of the conditions at the bottom and at the top, upwards (collective)."""
        reactions = [self.problem.reaction(tag)[1] for tag in (self.b.bottom, self.b.top)]
        return np.array([self.joint.resultant().force[1], *reactions])

    def way(self):
        """Of the top (collective)."""
        there = self.b.scene.gather(self.b.u)[np.abs(self.b.scene.drawing[:, 1] - 1.0) < 1e-9, 1]
        assert np.ptp(there) <= 1e-14
        return there[0]


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_column_through_its_steps(coupling):
    """Every force is linear in the step's factor, from what was carried to what is to be."""
    column, pressed, times = Column(coupling=coupling), 0.5 * M * 0.02, []
    for step in uem.load_steps(column.problem, column.steps()):
        s, times = step.factor, [*times, step.time]
        contact, bottom, top, way = {
            "press": (pressed * s, pressed * s, -pressed * s, -0.02 * s),
            "load": (loaded := pressed + (0.03 - pressed) * s, loaded, 0.0, -loaded / (0.5 * M)),
            # of the contact's two forces one is the lower body's, the other the upper's, which the top holds as well
            "part": (0.0, 0.03 * (1 - s), None, -0.06 / M + (0.06 / M - 0.02) * s),
            # the overlap goes with the offset
            "meet": (pressed * s, pressed * s, -pressed * s, -0.02),
        }[step.step]
        found = column.forces()
        assert found[:2] == pytest.approx([contact, bottom], abs=1e-12) and column.way() == pytest.approx(way, abs=1e-12)
        assert top is None or found[2] == pytest.approx(top, abs=1e-12)
        assert column.joint.on is (step.step != "part")
    assert column.joint.initial_overlap == 0.0
    assert np.allclose(times, [0.5, 1, 4 / 3, 5 / 3, 2, 2.25, 2.5, 2.75, 3, 3.5, 4]) and step.cuts == 0
    assert column.problem.bodies.dead is None and column.problem.load is None
    assert column.problem.bodies.tangent.number == 1


def test_at_once():
    """Without a ramp the first load step has it all."""
    column = Column()
    press, load, *_ = column.steps()
    load = uem.Step("load", bcs=load.bcs, loads=load.loads, ramp=False, n=2)
    for step in uem.load_steps(column.problem, [press, load]):
        assert column.forces()[0] == pytest.approx(0.5 * M * 0.02 * step.factor if step.step == "press" else 0.03, abs=1e-12)


def test_a_step_that_is_left_continues_with_what_is_left():
    """Left at a third of the release, the next step releases the other two thirds."""
    column, pressed = Column(), 0.5 * M * 0.02
    press, *_ = column.steps()
    release = uem.Step("release", 3, bcs=column.held("bottom", "sides"))
    for step in uem.load_steps(column.problem, [press, release]):
        if step.step == "release":
            break
    assert column.forces()[0] == pytest.approx(pressed * 2 / 3, abs=1e-12)
    for step in uem.load_steps(column.problem, [uem.Step("on", 2)]):
        assert column.forces()[0] == pytest.approx(pressed * 2 / 3 * (1 - step.factor), abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("stops", [slow((3,)), (6, 2)], ids=str)
def test_interrupted_is_uninterrupted(stops, folder):
    """Left in the middle of a step, and continued by the same script: the same numbers, in serial bit by bit; results continue."""

    def run(name, stop=None):
        column, made = Column(friction=0.1), []
        checkpoint = Killed(folder / f"{name}.uem", every=1)
        checkpoint.begin(column.problem.state())
        steps = [*column.steps(), uem.Step("rough", 2, friction={column.joint: 0.3}, offset={column.joint: 0.01})]
        with uem.HistoryWriter(folder / f"{name}.csv", column.problem, resume=True) as history:
            for step in uem.load_steps(column.problem, steps, checkpoint=checkpoint):
                made.append((step.step, step.number, step.time, *column.forces()))
                history.write(step)
                if len(made) == stop:
                    break
        return column, made

    whole, wanted = run("whole")
    assert whole.joint.friction == 0.3 and whole.joint.offset == 0.01 and len(wanted) == 13
    assert wanted[-1][3] == pytest.approx(0.5 * M * 0.03, abs=1e-12)
    done = 0
    for stop in (*stops, None):
        last, made = run("parts", stop)
        for ours, theirs in zip(made, wanted[done:]):
            assert ours[:2] == theirs[:2] and np.allclose(ours[2:], theirs[2:], rtol=0, atol=1e-14)
        # a step that was left is not counted
        done += len(made) - (stop is not None)
    assert done == len(wanted)
    if COMM.size == 1:
        assert np.array_equal(bits(last.b.u.x.array), bits(whole.b.u.x.array))
        assert (folder / "parts.csv").read_bytes() == (folder / "whole.csv").read_bytes()
    again, made = run("parts")
    assert made == [] and again.joint.friction == 0.3 and np.allclose(again.forces(), whole.forces(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("stop", [6, slow(4), 8])
def test_a_list_that_is_left_is_left_again(stop, folder):
    """A script leaves a list by ``break`` amid a release, continues with another, and is run anew from a checkpoint of before or after."""

    def run(name, stop=None):
        column, made = Column(friction=0.1), []
        checkpoint = Killed(folder / name, every=1)
        for steps in (
            column.steps()[:3],
            [uem.Step("on", 2, offset={column.joint: -0.01}), uem.Step("rough", 2, friction={column.joint: 0.3})],
        ):
            for step in uem.load_steps(column.problem, steps, checkpoint=checkpoint):
                made.append((step.step, step.number, step.time, *column.forces()))
                if len(made) == stop:
                    return column, made
                if (step.step, step.number) == ("load", 2):
                    break
        return column, made

    whole, wanted = run("whole")
    # the contact is not switched off, as the step after the one that was left would do
    assert [one[0] for one in wanted] == ["press"] * 2 + ["load"] * 2 + ["on"] * 2 + ["rough"] * 2 and whole.joint.on
    run("parts", stop)
    last, made = run("parts")
    assert len(made) == len(wanted) - stop + 1 and last.joint.on and last.joint.friction == 0.3
    for ours, theirs in zip(made, wanted[stop - 1 :]):
        assert ours[:2] == theirs[:2] and np.allclose(ours[2:], theirs[2:], rtol=0, atol=1e-14)
    if COMM.size == 1:
        assert np.array_equal(bits(last.b.u.x.array), bits(whole.b.u.x.array))


def test_another_step_is_no_step_of_the_checkpoint(folder):
    column = Column()
    for step in uem.load_steps(column.problem, column.steps()[:2], checkpoint=uem.Checkpoint(folder / "run", every=1)):
        if step.step == "load" and step.number == 2:
            break
    del column
    other = Column()
    press, load, *_ = other.steps()
    steps = [press, uem.Step("pull", 3, bcs=load.bcs)]
    refused(
        uem.CheckpointError, "the step 'load', which is 'pull' now",
        lambda: list(uem.load_steps(other.problem, steps, checkpoint=uem.Checkpoint(folder / "run"))),
    )  # fmt: skip


def test_equations_go_on(folder):
    """Between steps, where what the top carries is released, a run that continues knows what an equation carries there."""

    def run(name, stop=None):
        squeezed, made = uem.Equation([((0.5, 1.0), (0.0, 1.0)), ((0.5, 0.5), (0.0, -1.0))], -0.004), []
        column = Column(equations=[squeezed])
        steps = [column.steps()[0], uem.Step("let go", 2, bcs=column.held("bottom", "sides"))]
        for step in uem.load_steps(column.problem, steps, checkpoint=Killed(folder / name, every=1)):
            made.append(column.forces())
            if step.time == stop:
                break
        return made

    whole, first, last = run("whole"), run("parts", 1.5), run("parts")
    assert np.allclose(first + last[1:], whole, rtol=0, atol=1e-14) and np.allclose(last[0], whole[2], rtol=0, atol=1e-14)
    assert whole[2][0] == pytest.approx(0.5 * whole[1][0], abs=1e-12) and abs(whole[1][0]) > 1e-3


def test_steps_that_fail_are_cut():
    """Within a step as without, from where the step began."""
    column, failed = Column(), []
    press, load, *_ = column.steps()
    attempt = column.problem.attempt

    def failing(**how):
        if column.problem.stage.step is load and not failed:
            failed.append(column.p.value.item())
            raise uem.ConvergenceError("no")
        return attempt(**how)

    column.problem.attempt = failing
    load = uem.Step("load", 2, bcs=load.bcs, loads=load.loads)
    made = [(s.step, s.factor, s.cuts) for s in uem.load_steps(column.problem, [press, load])]
    assert made == [("press", 0.5, 0), ("press", 1.0, 0), ("load", 0.25, 1), ("load", 0.5, 0), ("load", 1.0, 0)]
    assert failed == [0.015] and column.forces()[0] == pytest.approx(0.03, abs=1e-12)


def test_begun_once_with_friction_and_offset_on_their_way():
    """``begin`` is called once; a coefficient and an offset by place go from what they are to what they are to be."""
    column, begun = Column(friction=lambda x: 0.2 + 0.1 * x[0]), []
    steps = [
        uem.Step("press", begin=lambda: begun.append("press")),
        uem.Step(
            "rough", 2, friction={column.joint: 0.6}, offset={column.joint: lambda x: np.full(x.shape[1], 0.01)},
            begin=lambda: begun.append("rough"),
        ),
        uem.Step("smooth", 2, friction={column.joint: lambda x, s: 0.6 - 0.5 * s}),
    ]  # fmt: skip
    for step in uem.load_steps(column.problem, steps):
        x, s = column.b.scene.mesh.geometry.dim and column.problem.config.X[column.joint.nodes, 0], step.factor
        first = 0.2 + 0.1 * x
        mu = {"press": first, "rough": first + (0.6 - first) * s, "smooth": np.full(len(x), 0.6 - 0.5 * s)}[step.step]
        assert np.allclose(column.joint.friction_values(), mu, rtol=0, atol=1e-15)
        fitted = {"press": 0.0, "rough": 0.01 * s, "smooth": 0.01}[step.step]
        overlap = (0.02 if step.step != "press" else 0.02 * s) + fitted
        assert column.forces()[0] == pytest.approx(0.5 * M * overlap, abs=1e-12)
    assert begun == ["press", "rough"]
    assert np.allclose(column.joint.friction(np.zeros((3, 4))), 0.1) and callable(column.joint.offset)


def test_a_tie_that_lets_go():
    """What a tie carries in tension is released like the rest; it does not come again."""
    column = Column(tied=True)
    pull = uem.Step("pull", loads={column.p: -0.03}, bcs=column.held("bottom", "sides"))
    steps = [pull, uem.Step("let go", 2, bcs=column.held("bottom", "sides", "top"), contacts={column.joint: False})]
    for step in uem.load_steps(column.problem, steps):
        left = 1.0 if step.step == "pull" else 1.0 - step.factor
        assert column.forces()[1] == pytest.approx(-0.03 * left, abs=1e-12)
    assert column.joint.n_active == 0 and column.joint.resultant().force == pytest.approx(0.0)
    refused(
        uem.InputError, "tied='after'", lambda: uem.load_steps(column.problem, [uem.Step("tie", contacts={column.joint: True})])
    )


def test_a_bolt_is_tightened_locked_and_let_go():
    """The force is ramped, whatever else moves; locked, the section loses what the top's condition carried."""
    column = Column(kind=uem.Preload, force=0.0)
    tighten = uem.Step("tighten", 2, preload={column.joint: 0.03})
    let_go = uem.Step("let go", 2, preload={column.joint: None}, bcs=column.held("bottom", "sides"))
    for step in uem.load_steps(column.problem, [tighten, let_go]):
        wanted = 0.03 * (step.factor if step.step == "tighten" else 1.0 - step.factor)
        assert column.joint.carried == pytest.approx(wanted, abs=1e-12)
        assert column.joint.locked is (step.step == "let go")
    refused(
        uem.InputError, "preload 'joint' cannot be switched",
        lambda: uem.load_steps(column.problem, [uem.Step(contacts={column.joint: False})]),
    )  # fmt: skip


def test_what_steps_refuse():
    """Each on all ranks, before the first step is taken."""
    column, other = Column(), Column()
    step, steps = uem.Step, lambda *some: uem.load_steps(column.problem, list(some))
    for error, words, call in [
        (uem.InputTypeError, "n", lambda: step("a", "two")),
        (uem.InputTypeError, "Step('a'): contacts", lambda: step("a", contacts=[column.joint])),
        (uem.InputTypeError, "on or off", lambda: step("a", contacts={column.joint: "off"})),
        (uem.InputError, "0 or a positive", lambda: step("a", friction={column.joint: -0.1})),
        (uem.InputTypeError, "begin", lambda: step("a", begin=1)),
        (uem.InputTypeError, "steps[1]", lambda: steps(step("a"), 3)),
        (uem.InputError, "one Step at least", lambda: steps()),
        (uem.InputError, "step 2, 'b': contact 'joint' is not the problem's", lambda: steps(step(), step("b", offset={other.joint: 1}))),
        (uem.InputError, "made without friction", lambda: steps(step("a", friction={column.joint: 0.3}))),
        (uem.InputTypeError, "the law Coulomb", lambda: steps(step("a", friction={column.joint: uem.Tresca(0.3)}))),
        (uem.SpaceError, "bcs[0]", lambda: steps(step("a", bcs=other.held("top")))),
        (uem.InputError, "arc_length", lambda: uem.load_steps(column.problem, [step("a")], arc_length=True)),
    ]:  # fmt: skip
        refused(error, words, call)
    column.problem.load = lambda s: None
    refused(uem.InputError, "the problem has a load", lambda: steps(step("a")))
    held = Column(tied=True, coupling="mortar")
    loose = [uem.Step("a"), uem.Step("b", bcs=held.held("bottom", "top"))]
    refused(uem.InputError, "and a step changes its conditions", lambda: list(uem.load_steps(held.problem, loose)))


@pytest.mark.parametrize("coupling", [slow("node_to_surface"), "mortar"])
def test_a_driven_tool_is_let_go(coupling):
    """Contactors led along a guided block bear mu lam, each, both ways; let go, they bear together what is left of their lead: nothing."""
    column = Column((2, 4), friction=0.3, coupling=coupling)
    b, friction = column.b, column.joint.pair

    def lead(way):
        return [bc for tag in (b.high, b.top) for bc in clamp(b.V, tag, 0, value=way)]

    below = [*column.held("bottom", "top"), *column.bcs["sides"][::2]]
    steps = [
        uem.Step("press", bcs=[*below, *lead(0.0)]),
        uem.Step("forth", 2, bcs=[*below, *lead(0.02)]),
        uem.Step("back", 2, bcs=[*below, *lead(0.0)]),
        uem.Step("let go", 4, bcs=below),
    ]
    ways, led = {"forth": -1.0, "back": 1.0}, 0.0
    for step in uem.load_steps(column.problem, steps):
        pushed, trial = column.joint.resultant().force[0], friction.trial
        if step.step in ways:
            assert highest(COMM, np.abs(0.3 * trial.lam - np.linalg.norm(trial.friction.tau, axis=1))) <= 1e-12
            assert pushed * ways[step.step] > 0.0 and column.joint.dissipation > 0.0
            led = pushed
        elif step.step == "let go":
            assert pushed == pytest.approx(led * (1.0 - step.factor), abs=1e-10)


def test_released_without_contact():
    """A released side of a body without contact moves to its equilibrium in one iteration, with the matrix of the new conditions."""
    mesh = create_unit_square(COMM, 2, 2)
    V = uem.function_space(mesh, 1, (2,))
    u, v, p = fem.Function(V), ufl.TestFunction(V), fem.Constant(mesh, 0.0)
    F = uem.LinearElastic(2.0, 0.0, kind="plane_strain").residual(u, v) * ufl.dx
    sides = [locate_entities_boundary(mesh, 1, lambda x, at=at: np.isclose(x[1], at)) for at in (0.0, 1.0)]
    F += p * v[1] * forms.surface_measure(mesh, sides[1])
    bottom, top = (
        fem.dirichletbc(np.array([0.0, way]), fem.locate_dofs_topological(V, 1, side), V)
        for way, side in zip((0.0, -0.01), sides)
    )
    for pressure in (0.0, 0.01):
        u.x.array[:] = 0.0
        problem = uem.UnitedProblem(F, u, bcs=[bottom, top])
        for step in uem.load_steps(problem, [uem.Step("press"), uem.Step("let go", bcs=[bottom], loads={p: pressure})]):
            assert len(step.iterations) <= 2 and step.cuts == 0
        assert highest(COMM, -u.x.array.min()) == pytest.approx(pressure / 2.0, abs=1e-14)
        p.value = 0.0
