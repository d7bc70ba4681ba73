"""Load steps that are interrupted and continued: scenes in each of which something else must be kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import Scene, at, blocks, box, clamp, linear, scene, st_venant
from restart_scenes import Killed, slider
from resting_scenes import Bar

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


@dataclass
class Ramps:
    """A scene, and the calls of ``load_steps`` that it takes: what is set before each, and its number of steps."""

    scene: Scene
    problem: uem.UnitedProblem
    calls: list[tuple[Callable[[], Any], int]] = field(default_factory=list)
    how: dict[str, Any] = field(default_factory=dict)

    def steps(self, checkpoint: uem.Checkpoint | None = None) -> Iterator[uem.LoadStep]:
        """All calls one after the other, as a script makes them."""
        for prepare, n in self.calls:
            prepare()
            yield from uem.load_steps(self.problem, n, checkpoint=checkpoint, **self.how)

    def run(self, folder: Path, *, every: int = 10**6, stop: int | None = None, cell: bool = False) -> list[uem.LoadStep]:
        """Step with the checkpoint ``run`` and results ``out`` in a folder, and leave after some steps; returns those made."""
        done, checkpoint = [], Killed(folder / "run", every=every)
        checkpoint.begin(self.problem.state())
        with uem.ResultsWriter(folder / "out", self.problem, fields={"u2": self.problem.u[1]}, resume=True) as writer:
            writer.write(0.0)
            for step in self.steps(checkpoint):
                done.append(step)
                writer.write(step)
                if len(done) == stop:
                    break
        return done


def nothing(at: float = 0.0) -> None:
    """Leave everything as it is."""


def sliding(comm: MPI.Comm) -> Ramps:
    """Dirichlet values set by a function of the factor, in two calls; contactors pass bends, steps are cut."""
    s, _, problem = slider(comm)
    led, way = problem.load, [0.0, 4.0]
    problem.load = lambda factor: led(way[0] + (way[1] - way[0]) * factor)
    problem.max_iterations = 5

    def on() -> None:
        way[:] = 4.0, 9.0

    return Ramps(s, problem, [(nothing, 2), (on, 3)])


def ramped(comm: MPI.Comm) -> Ramps:
    """Dirichlet values ramped from where the bodies are: pressed, and led back half of the way."""
    s, _, problem = slider(comm)
    led, problem.load = problem.load, None
    return Ramps(s, problem, [(lambda: led(2.0), 3), (lambda: led(1.0), 3)])


def plastic(comm: MPI.Comm) -> Ramps:
    """Bodies of layers that yield, with a modified Newton method that keeps its tangent."""
    b = blocks(comm, "quadrilateral", 2, 3)
    table = [(0.0, 0.0), (0.002, 0.5), (0.1, 1.0)]
    steel = uem.VonMises(b.u, E=100.0, nu=0.3, yield_stress=1.0, kinematic_hardening=table, kind="plane_strain")
    F = steel.residual(ufl.TestFunction(b.V))
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(
        F, b.u, bcs=b.oedometer(0.03), contacts=[contact], materials=[steel], newton="modified", rtol=1e-10, max_iterations=40
    )
    return Ramps(b.scene, problem, [(nothing, 5)])


def forming(comm: MPI.Comm) -> Ramps:
    """A soft body flattened by a rigid plane with friction."""
    b = blocks(comm, "quadrilateral", 2, 1, gap=1.0)
    metal, press = (
        uem.FinitePlasticity(b.u, 100.0, 0.3, [(0.0, 1.0), (0.1, 2.0)], 1.0, kinematic_hardening=3.0, kind="plane_strain"),
        uem.RigidPlane([0, 0], [0, -1.0]),
    )
    contact = uem.Contact(b.low, press, friction=0.1)
    bcs = [*clamp(b.V, b.bottom, 1), *clamp(b.V, b.scene.tag("side", 0, at(0, 0.0)), 0), *clamp(b.V, b.top), *clamp(b.V, b.high)]
    problem = uem.UnitedProblem(
        metal.residual(ufl.TestFunction(b.V)), b.u, bcs=bcs, contacts=[contact], materials=[metal], rtol=1e-10,
        load=lambda factor: press.move([0.0, -0.2 * factor]),
    )  # fmt: skip
    return Ramps(b.scene, problem, [(nothing, 5)])


def rolling(comm: MPI.Comm) -> Ramps:
    """A rigid disc that the load moves and turns, and a Constant would not do; solved by CG."""
    body = box("triangle", [-1.0, -1.0], [1.0, 0.0], [8, 4])
    s = scene(comm, "triangle", [body], shuffle=3)
    V = compat.function_space(s.mesh, 1, (2,))
    u, disc = fem.Function(V, name="u"), uem.RigidSphere([-0.3, 0.5], 0.5)
    contact = uem.Contact(s.tag("top", 0, at(1, 0.0)), disc)

    def load(factor: float) -> None:
        disc.move([0.4 * factor, -0.2 * np.sin(2.5 * factor)], 0.3 * factor)

    options = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-12}
    problem = uem.UnitedProblem(
        st_venant(u, 1.0), u, bcs=clamp(V, s.tag("base", 0, at(1, -1.0))), contacts=[contact], load=load, rtol=1e-10,
        petsc_options=options,
    )  # fmt: skip
    return Ramps(s, problem, [(nothing, 6)])


def loaded(comm: MPI.Comm) -> Ramps:
    """A pressure that grows with a Constant, while the support is led aside."""
    b = blocks(comm, "triangle", 2, 3)
    factor = fem.Constant(b.scene.mesh, 0.0)
    v = ufl.TestFunction(b.V)
    F = st_venant(b.u, 1.0) + 0.05 * factor * v[1] * ufl.dx
    bcs = [*clamp(b.V, b.scene.tag("bottom", 0, at(1, -1.0)), value=[0.02, 0.0])]
    bcs += clamp(b.V, b.scene.tag("top", 1, at(1, 1.0)), 0)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)], load=factor, rtol=1e-10)
    return Ramps(b.scene, problem, [(nothing, 5)])


def cracking(comm: MPI.Comm, *, cell: str = "quadrilateral", pull: float = 3.0, springs: float = 5.0, **how: Any) -> Ramps:
    """A bond that is pulled off from one end, and snaps back; springs then hold the upper body, at ``1.5 pull / springs`` where x = 0."""
    b = blocks(comm, cell, 2, 4)
    P, v, x = fem.Constant(b.scene.mesh, 0.0), ufl.TestFunction(b.V), ufl.SpatialCoordinate(b.scene.mesh)
    F = linear(b.u, 10.0) + (springs * ufl.inner(b.u, v) - P * (1.5 - x[0]) * v[1]) * uem.ds(b.top, b.scene.mesh)
    bond = uem.Contact(b.high, b.low, cohesion=uem.Cohesive(1.0, 0.05), sliding="small", **how)
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[bond], load={P: pull}, rtol=1e-10)
    return Ramps(b.scene, problem, [(nothing, 5)], {"arc_length": uem.Dissipation(0.01)})


RAMPS = {
    "sliding": sliding,
    "ramped": ramped,
    "plastic": plastic,
    "forming": forming,
    "rolling": rolling,
    "loaded": loaded,
    "cracking": cracking,
}


def five_steps(in_time: bool, load: Callable[[float], Any]) -> tuple[uem.UnitedProblem, Callable[[Any], Iterator[Any]]]:
    """A problem, and a function that begins its five steps with or without a checkpoint."""
    if in_time:
        problem = Bar((0.0, -3.0), load=load).problem
        return problem, lambda checkpoint: uem.time_steps(problem, 0.02, 0.1, checkpoint=checkpoint)
    b = blocks(COMM, "triangle")
    weight = fem.Constant(b.scene.mesh, 0.0)

    def pull(factor: float) -> None:
        weight.value = factor
        load(factor)

    F = linear(b.u, 1.0) + 0.1 * weight * ufl.TestFunction(b.V)[1] * ufl.dx
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)], load=pull)
    return problem, lambda checkpoint: uem.load_steps(problem, 5, checkpoint=checkpoint)
