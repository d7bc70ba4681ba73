"""``problem.solve()`` in the body of a loop over steps: equilibrium again at the step's load or time, in the step's place.

The test to read first is ``test_a_field_that_changes_within_the_step``.
"""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, clamp, highest, modulus, raised, st_venant
from restart_scenes import COMM, Impact

import uem_dolfinx as uem

FAMILY = {
    "nodes": {},
    "3d": {"cell": "hexahedron"},
    "mortar": {"coupling": "mortar"},
    "small": {"sliding": "small"},
    "friction": {"friction": 0.2},
    "friction, mortar": {"friction": 0.2, "coupling": "mortar"},
    "friction, rigid": {"friction": 0.2, "rigid": True},
    "friction, 3d": {"friction": 0.2, "cell": "hexahedron"},
    "plastic": {"plastic": True},
    "plastic, friction": {"plastic": True, "friction": 0.2},
    "finite plasticity": {"plastic": uem.FinitePlasticity},
}


def heat(factor):
    """Swelling of the upper block at a load factor."""
    return 0.02 * factor**2


class Warm:
    """A block that swells, pressed onto another one, or a plane that moves, and driven along it."""

    def __init__(self, cell="quadrilateral", plastic=False, rigid=False, in_load=False, **contact):
        self.b = b = blocks(COMM, cell, 2, 3, overhang=0.25)
        g, self.swelling = b.gdim, fem.Constant(b.scene.mesh, 0.0)
        self.value = fem.Constant(b.scene.mesh, np.array([0.06, *[0.0] * (g - 2), -0.04]))
        kind, v = ("3d" if g == 3 else "plane_strain"), ufl.TestFunction(b.V)
        law = uem.VonMises if plastic is True else plastic
        self.laws = [law(b.u, 1.0, 0.3, 0.02, 0.1, kind=kind)] if plastic else []
        F = self.laws[0].residual(v) if plastic else st_venant(b.u, modulus(b.scene, 1.0, 2.0))
        up = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(b.scene.mesh)[g - 1], 0.0), 1.0, 0.0)
        F -= self.swelling * up * ufl.div(v) * ufl.dx
        ground = uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0])
        self.contact = uem.Contact(b.high, ground if rigid else b.low, **contact)
        top = fem.dirichletbc(self.value, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)

        def load(factor):
            self.value.value[:] = np.array([0.06, *[0.0] * (g - 2), -0.04]) * factor
            ground.move([-0.02 * factor, *[0.0] * (g - 1)])
            if in_load:
                self.swelling.value = heat(factor)

        led = load if rigid else {self.swelling: heat} if in_load else None
        self.problem = uem.UnitedProblem(
            F, b.u, bcs=[*clamp(b.V, b.bottom), top], contacts=[self.contact], materials=self.laws, load=led, rtol=1e-12
        )

    def state(self):
        """All that the next step begins with, and the results of the last."""
        pair, history = self.contact.pair, [f for law in self.laws for f in law.history.values()]
        arrays = [self.b.u.x.array, pair.committed.lam, pair.committed.force, *(f.x.array for f in history)]
        f = pair.committed.friction
        arrays += [] if f is None else [f.slipped, f.tau, f.work]
        return [np.array(a) for a in arrays], self.contact.dissipation


def same(ours, theirs, part=1e-9):
    """The same numbers to a part of the largest (collective)."""
    for a, b in zip(ours, theirs):
        assert highest(COMM, np.abs(a - b)) <= part * max(highest(COMM, np.abs(b)), 1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", FAMILY)
def test_a_field_that_changes_within_the_step(name):
    """Solved again with the right field, a step is the one that would have been made with it, histories among it."""
    whole, staggered = Warm(in_load=True, **FAMILY[name]), Warm(**FAMILY[name])
    states = []
    for _ in uem.load_steps(whole.problem, 2):
        states.append(whole.state())
    for step in uem.load_steps(staggered.problem, 2):
        for part in (0.3, 1.0):
            staggered.swelling.value = part * heat(step.factor)
            assert staggered.problem.solve()[-1].residual <= 1e-12
        (arrays, work), (wanted, total) = staggered.state(), states[step.number - 1]
        same(arrays, wanted, 1e-8)
        assert work == pytest.approx(total, rel=1e-7, abs=1e-14)
    assert staggered.problem.progress.steps == len(states) == 2
    if whole.contact.pair.friction is not None:
        assert whole.contact.dissipation > 0


@pytest.mark.parametrize("steps", [1, 4])
def test_dirichlet_values_stay_those_of_the_step(steps):
    scene = Warm()
    for step in uem.load_steps(scene.problem, steps):
        for _ in range(2):
            scene.problem.solve()
            top = scene.b.scene.gather(scene.b.u)[np.abs(scene.b.scene.drawing[:, 1] - 1.0) < 1e-9]
            assert np.allclose(top, step.factor * np.array([0.06, -0.04]), atol=1e-15)
    # after the loop it is a step of its own, as ever
    scene.value.value[:] = 0.06, -0.05
    scene.problem.solve()
    assert scene.problem.progress.steps == steps + 1
    assert scene.b.u.x.array.min(initial=0.0) >= -0.05 - 1e-15


class Late(Impact):
    """An impact whose load is wrong until the caller mends it."""

    def load(self, t):
        super().load(t)
        self.push.value *= 0.0


@pytest.mark.parametrize("scheme", [uem.newmark(), uem.generalised_alpha(0.7)], ids=["newmark", "alpha"])
def test_time_steps_taken_again(scheme):
    """Displacements, velocities, accelerations, plastic strains and the time are those of one step."""
    whole, late = (kind(scheme=scheme, max_iterations=40) for kind in (Impact, Late))
    times = []
    for step in uem.time_steps(whole.problem, 0.02, 0.1):
        d = whole.problem.dynamics
        fields = whole.u, d.velocity, d.acceleration, d.forces, whole.law.peeq
        times.append((d.time, [np.array(f.x.array) for f in fields]))
    assert whole.contact.n_active > 0
    # the first acceleration belongs to the load
    late.push.value = 0.2
    wrong, late.load = late.problem.load, lambda t: Impact.load(late, t)
    late.problem.load = late.load
    for step in uem.time_steps(late.problem, 0.02, 0.1):
        late.problem.load = wrong
        for part in (0.5, 1.0):
            late.push.value = part * (0.2 + step.time)
            late.problem.solve()
        d = late.problem.dynamics
        time, wanted = times[step.number - 1]
        assert d.time == time == step.time
        same([f.x.array for f in (late.u, d.velocity, d.acceleration, d.forces, late.law.peeq)], wanted, 1e-7)
    assert step.number == len(times)


@pytest.mark.parametrize("plastic", [False, True])
def test_a_step_that_fails_when_taken_again_stays(plastic):
    scene = Warm(plastic=plastic, friction=0.2)
    for step in uem.load_steps(scene.problem, 2):
        before = scene.state()
        scene.swelling.value = np.nan
        raised(uem.NotFiniteError, "not finite", scene.problem.solve)
        scene.swelling.value = 0.0
        same(scene.state()[0], before[0], 0.0)
    assert step.factor == 1.0
    same([scene.state()[1]], [work_of(plastic)], 1e-9)


def work_of(plastic):
    """Work of friction without failures."""
    scene = Warm(plastic=plastic, friction=0.2)
    list(uem.load_steps(scene.problem, 2))
    return scene.contact.dissipation


def test_page_on_staggered_problems():
    """Its script runs as it stands there, to the root of the equation in it."""
    page = (Path(__file__).parents[2] / "demos" / "site" / "howto" / "staggered.md").read_text(encoding="utf-8")
    known = {}
    exec(compile(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[1], "staggered.md", "exec"), known)
    E, alpha, q, h, d = (known[name] for name in ("E", "alpha", "q", "h", "d"))
    assert len(known["forces"]) == 4
    for factor, force in known["forces"]:
        half = E * d * factor / 2
        assert force == pytest.approx(half + np.sqrt(half**2 + E * alpha * q / h), rel=1e-9)


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_while_a_step_is_taken_again(number, kept, folder):
    """Whichever rank gets one, all end, with the step as it was."""
    scene, ends = Warm(), {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: SystemExit}
    checkpoint = uem.Checkpoint(folder / "run") if kept else None

    def loop():
        for _ in uem.load_steps(scene.problem, 3, checkpoint=checkpoint):
            found.append(np.array(scene.b.u.x.array))
            if COMM.rank == COMM.size - 1:
                os.kill(os.getpid(), number)
            scene.swelling.value = 0.01
            scene.problem.solve()

    found = []
    # a shell that runs tests in the background has Ctrl-C ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(ends[number]):
            loop()
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(found) == 1 and np.array_equal(found[0], scene.b.u.x.array)
    assert (folder / "run").exists() == kept
    assert scene.problem.progress.interruption is None and not scene.problem.progress.inside


@pytest.mark.parametrize("in_stages", [False, True])
def test_a_loop_within_a_loop(in_stages):
    """The outer one has no steps left once the inner one is at the full load: it says so, where it once ended without a word."""
    w, taken = Warm(), []

    def nested():
        for step in uem.load_steps(w.problem, [uem.Step("a", 2)] if in_stages else 2):
            taken.append(step.factor)
            list(uem.load_steps(w.problem, 1))

    raised(uem.InputError, "another loop over load_steps.* at its load factor 0.5: expected one loop after the other", nested)
    assert taken == [0.5]
    # a loop that is left, and another one in the body of the last step, are none of these
    for step in uem.load_steps(w.problem, 4):
        break
    for step in uem.load_steps(w.problem, 2):
        if step.factor == 1.0:
            list(uem.load_steps(w.problem, 1))
