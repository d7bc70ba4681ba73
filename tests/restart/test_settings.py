"""Runs that continue with something else than they began with name it; so are what differs between ranks, and lost times.

Read ``test_other_settings_are_named`` first.
"""

from __future__ import annotations

import json
import logging

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, raised
from resting_scenes import Bar as Resting

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.restart import checkpoint

COMM = MPI.COMM_WORLD


def made(E=100.0, rho=1.0, friction=0.1, scheme=None, coupling="node_to_surface", as_what="number", **how):
    """Two blocks that are let fall onto each other."""
    b = blocks(COMM, "quadrilateral", 2, 3, gap=0.05)
    if as_what == "constant":
        E = fem.Constant(b.scene.mesh, E)
    elif as_what == "function":
        given, E = E, fem.Function(compat.function_space(b.scene.mesh, ("DG", 0)))
        E.x.array[:] = given
    v = ufl.TestFunction(b.V)
    contact = uem.Contact(b.high, b.low, name="pair", friction=friction, coupling=coupling, sliding=how.pop("sliding", "finite"))
    materials = []
    if as_what == "plastic":
        materials = [uem.VonMises(b.u, 100.0, 0.3, E, kind="plane_strain")]
        F = materials[0].residual(v)
    elif as_what == "back stress":
        materials = [uem.FinitePlasticity(b.u, 100.0, 0.3, 1.0, kinematic_hardening=E, kind="plane_strain")]
        F = materials[0].residual(v)
    else:
        F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx
    dynamics = uem.Dynamics(
        uem.lumped_mass(b.V, rho), scheme=scheme, gravity=how.pop("gravity", (0.0, -1.0)), contactors="massy", **how
    )
    return uem.UnitedProblem(F, b.u, contacts=[contact], materials=materials, bcs=b.oedometer(0.0)[:1], dynamics=dynamics)


OTHERS = {
    "number": ({}, {"E": 200.0}, r"F, its expressions and numbers \(now .*; continue with those"),
    "constant": ({"as_what": "constant"}, {"E": 200.0}, r"F, Constant 1 \(now 200, then 100\)"),
    "function": ({"as_what": "function"}, {"E": 200.0}, r"F, Function \d \(now 200, then 100\)"),
    "yield stress": ({"as_what": "plastic"}, {"E": 3.0}, r"material 1, yield_stress \(now 3, then 100\)"),
    "back stress": ({"as_what": "back stress"}, {"E": 3.0}, r"material 1, kinematic_hardening \(now 3, then 100\)"),
    "density": ({}, {"rho": 2.0}, r"mass \(now 4 4, .*, then 2 2, "),
    "friction": ({}, {"friction": 0.2}, r"contact 1 'pair', friction \(now 0.2, then 0.1\)"),
    "scheme": ({}, {"scheme": uem.generalised_alpha(0.5)}, r"scheme \(now Scheme\(beta=0.44.*, then Scheme\(beta=0.25"),
    "sliding": ({}, {"sliding": "small"}, r"contact 1 'pair', sliding \(now small, then finite\)"),
    "coupling": ({}, {"coupling": "mortar"}, r"contact 1 'pair', coupling \(now mortar, then node_to_surface\)"),
    "gravity": ({}, {"gravity": (0.0, -2.0), "rho": 3.0}, r"gravity \(now 0 -2, then 0 -1\); mass \(now 6 6"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_other_settings_are_named(what, folder):
    """All that differs, now and then; the same run continues, and one that is to continue with something else can."""
    same, other, words = OTHERS[what]
    problem = made(**same)
    uem.write_checkpoint(folder / "run", problem.state())
    uem.read_checkpoint(folder / "run", made(**same).state())
    other = made(**same | other)
    raised(
        uem.CheckpointError,
        f"run belongs to a run with other settings: {words}",
        lambda: uem.Checkpoint(folder / "run").begin(other.state()),
    )
    state = other.state()
    state.settings.clear()
    uem.read_checkpoint(folder / "run", state)


#: Settings with the words of a run that names none of them, and another run.
BY_DEFAULT = {
    "material 1, kinematic_hardening": ({"as_what": "back stress", "E": 0.0}, {"E": 3.0}),
    "contact 1 'pair', sliding": ({}, {"sliding": "small"}),
    "scheme": ({}, {"scheme": uem.generalised_alpha(0.5)}),
    "gravity": ({"gravity": None}, {"gravity": (0.0, -2.0)}),
}


def without(path, name):
    """Rewrite a checkpoint as a version that did not know of a setting would have written it (collective)."""
    if COMM.rank == 0:
        whole = path.read_bytes()
        end = int(whole[: checkpoint.HEAD].split()[5])
        content = json.loads(whole[end:])
        del content["settings"][name]
        text = checkpoint._text(content)
        path.write_bytes(checkpoint._head(end, text) + whole[checkpoint.HEAD : end] + text)
    COMM.barrier()


@pytest.mark.parametrize("name", BY_DEFAULT)
def test_settings_that_came_later(name, folder):
    """A file that does not know of a setting is of a run that had it by default: that continues, one with another value is refused."""
    same, other = BY_DEFAULT[name]
    uem.write_checkpoint(folder / "run", made(**same).state())
    without(folder / "run", name)
    uem.read_checkpoint(folder / "run", made(**same).state())
    raised(
        uem.CheckpointError,
        rf"other settings: {name} \(now [^;]*, then nothing\); continue with those",
        lambda: uem.read_checkpoint(folder / "run", made(**same | other).state()),
    )


def test_settings_without_a_default(folder):
    """What has to be named was named then, too."""
    uem.write_checkpoint(folder / "run", made().state())
    without(folder / "run", "mass")
    raised(
        uem.CheckpointError, r"mass \(now 2 2, .*, then nothing\)", lambda: uem.read_checkpoint(folder / "run", made().state())
    )


def test_other_steps_are_reported(folder, caplog):
    """Steps of another length are no other run: a warning says it, once."""
    for end, dt, reported in ((0.02, 0.01, 0), (0.04, 0.01, 0), (0.08, 0.02, 1), (0.1, 0.02, 0)):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            for _ in uem.time_steps(made(friction=0.0), dt, end, checkpoint=uem.Checkpoint(folder / "run")):
                pass
        messages = [r.getMessage() for r in caplog.records if "continuing with steps" in r.getMessage()]
        assert len(messages) == (reported if COMM.rank == 0 else 0), (dt, messages)
        assert not messages or messages[0] == "continuing with steps of 0.02; the steps before the checkpoint were 0.01"


def test_one_checkpoint_for_two_problems(folder):
    """The second would be written over the first's, or be continued from it."""
    first, second, checkpoint = made(friction=0.0), made(friction=0.0), uem.Checkpoint(folder / "run")
    for _ in uem.time_steps(first, 0.01, 0.01, checkpoint=checkpoint):
        pass
    for again in (lambda: uem.time_steps(second, 0.01, 0.01, checkpoint=checkpoint), lambda: checkpoint.begin(second.state())):
        raised(uem.CheckpointError, "run keeps the state of another problem: make one Checkpoint", again)
    for _ in uem.time_steps(first, 0.01, 0.02, checkpoint=checkpoint):
        pass
    assert checkpoint.begin(first.state()) and first.dynamics.time == 0.02


def test_damping_without_return():
    def forgotten(v):
        """Returns nothing."""

    words = r"damping\(v\) = None: expected a UFL form, linear in the test function; return it"
    raised(uem.InputTypeError, words, lambda: made(damping=forgotten))


@pytest.mark.skipif(COMM.size == 1, reason="is about several ranks")
def test_rigid_surface_moved_on_one_rank():
    b = blocks(COMM, "quadrilateral", 2, 3)
    plane = uem.RigidPlane([0.0, 1.2], [0.0, -1.0])
    contact = uem.Contact(b.top, plane, name="press")
    v = ufl.TestFunction(b.V)
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx
    problem = uem.UnitedProblem(F, b.u, contacts=[contact, uem.Contact(b.high, b.low)], bcs=b.oedometer(0.0))
    if COMM.rank == 0:
        plane.move([0.0, -0.01])
    words = r"contact 'press', move\(\) of its rigid target: .* = '0 -0.01 .*' on rank 0, but 'not moved' on rank 1"
    raised(uem.InputError, words, problem.solve)


@pytest.mark.parametrize("writer", [uem.HistoryWriter, uem.ResultsWriter])
def test_times_that_are_none(writer, folder, caplog):
    """Not finite, different on ranks, or falling; what is written before and after stays whole."""
    bar = Resting((0.0, -1.0))
    kept = writer(folder / ("run.csv" if writer is uem.HistoryWriter else "run"), bar.problem)
    kept.write(0.5)
    for wrong, words in (
        (np.nan, "time = nan: expected a finite number"),
        (np.inf, "time = inf"),
        (0.25, "time = 0.25 is written after 0.5"),
    ):
        raised(uem.InputError, words, lambda: kept.write(wrong))
    if COMM.size > 1:
        raised(uem.InputError, "write: time = 1.0 on rank 0, but 2.0 on rank 1", lambda: kept.write(1.0 + COMM.rank))
    kept.write(0.5)
    kept.write(0.75)
    kept.close()
    COMM.barrier()
    assert (folder / "run.csv").read_text().count("\n") == 4
