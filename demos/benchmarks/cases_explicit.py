"""Cases of explicit impact: stiffnesses and masses six orders apart, layers of a thousandth of a cell, speeds near those of waves.

Steps are as long as the bodies allow: contact has no stiffness that would shorten them. Known are momentum, energy and which side
the bodies are on.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks.cases import COMM, FORCE, OVERLAP, Box, BoxScene, Case, NotApplicable, Trial
from benchmarks.cases_laws import overlap
from benchmarks.cases_motion import LOOK, RHO, V0, WAVES, Motion
from uem_dolfinx import forms

N, C = 16, 10.0
H = 1 / N


def explicit(scene: BoxScene, velocity: object, contactors: str, density: object = RHO, safety: float = 0.9) -> uem.Dynamics:
    """Central differences with lumped masses."""
    mass = uem.lumped_mass(scene.V, density)
    return uem.Dynamics(mass, velocity=velocity, scheme=uem.CentralDifferences(safety=safety), contactors=contactors)


def gained(motion: Motion, dynamics: uem.Dynamics, dt: float) -> float:
    """Energy won since the start over that at the start, of the energy that central differences conserve: ``- dt^2 / 8 a'M a``."""
    own = slice(dynamics.mass.of_nodes.size)
    a = dynamics.acceleration.x.array[own].reshape(dynamics.mass.of_nodes.shape)
    within = COMM.allreduce(float((dynamics.mass.of_nodes * a**2).sum()))
    return motion.gained() - dt**2 / 8 * within / motion.start_energy


def only_exact(trial: Trial) -> None:
    """Explicit steps are for contact without a penalty."""
    if trial.column.method not in ("united", "mortar"):
        raise NotApplicable("explicit steps are for exact contact")


def bar(layer: float, speed: float, size: float, contactors: str, trial: Trial, cell: str = "quadrilateral") -> None:
    """A bar hits a rigid wall: no energy gained, and an impulse that is right.

    Args:
        layer: thickness of the cells at the wall over that of the others.
        speed: over that of the wave.
        size: length of the bar.
        contactors: with their mass, or without.
        trial: the method.
        cell: kind of the cells, in 2D or 3D.
    """
    only_exact(trial)
    small, v, h = speed < 0.1, speed * C, size * H
    gap, g = 0.3 * v * h / C, 2 if cell == "quadrilateral" else 3
    up, across = np.eye(g)[-1], np.ones(g - 1)

    def squeezed(x: np.ndarray, k: int) -> np.ndarray:
        """The lowest row of cells as a layer, the others as they are."""
        y = x[:, -1] - gap
        return np.column_stack([x[:, :-1], gap + np.where(y < 0.5 * h, y, np.where(y < 1.5 * h, h * layer + (y - h), y))])

    scene = BoxScene(
        [Box((*across * 0.0, gap), (*across * h, gap + size), (*across.astype(int), N), RHO * C**2)],
        cell,
        pose=squeezed,
        nu=0.0,
        law=uem.LinearElastic if small else uem.NeoHooke,
    )
    scene.unite(scene.side(0, g - 1, 0), uem.RigidPlane(0.0 * up, up))
    # a shock leaves vibrations that the longest steps do not resolve
    dynamics = explicit(scene, -v * up, contactors, safety=0.9 if small else 0.3)
    problem = trial.create(scene.F, scene.u, scene.moduli, h, contacts=scene.contacts, dynamics=dynamics)
    motion, momentum = Motion(problem, scene), -float(dynamics.momentum()[-1])
    for step in uem.time_steps(problem, end=gap / v + 2.2 * size / C):
        trial.iterations += step.newton_iterations
        if step.number % LOOK == 0:
            trial.check("overlap", overlap(scene, layer * h), OVERLAP)
            trial.check("energy gained", max(0.0, gained(motion, dynamics, step.dt)), FORCE)
    # as fast as it came; at large strains waves have other speeds, and part of the energy stays in vibrations
    impulse = motion.impulse() / momentum
    trial.check("impulse", impulse / 2 - 1 if small else impulse / np.clip(impulse, 1.0, 2.0) - 1, WAVES)
    if contactors == "massless" and small:
        trial.check("energy lost", min(0.0, gained(motion, dynamics, step.dt)), WAVES)


def two_bars(stiffer: float, heavier: float, contactors: str, trial: Trial) -> None:
    """A bar hits another at rest, whose modulus and density are larger: the force by the impedances, no energy gained.

    Args:
        stiffer: modulus of the bar at rest over that of the bar that flies.
        heavier: density, likewise.
        contactors: with their mass, or without.
        trial: the method.
    """
    only_exact(trial)
    gap = 0.3 * V0 * H / C
    E = RHO * C**2
    # whose waves do not come back before those of the bar that flies
    long = max(1.0, np.sqrt(stiffer / heavier))
    boxes = [Box((0.0, gap), (H, gap + 1.0), (1, N), E), Box((0.0, -long), (H, 0.0), (1, N), stiffer * E)]
    scene = BoxScene(boxes, nu=0.0)
    scene.unite(scene.side(0, 1, 0), scene.side(1, 1, 1))
    velocity, density = fem.Function(scene.V), fem.Function(scene.E.function_space)
    velocity.x.array.reshape(-1, 2)[scene.nodes_of(0), 1] = -V0
    density.x.array[:] = RHO * np.where(scene.E.x.array > E, heavier, 1.0) if stiffer > 1 else RHO
    dynamics = explicit(scene, velocity, contactors, density)
    problem = trial.create(scene.F, scene.u, scene.moduli, H, contacts=scene.contacts, dynamics=dynamics)
    motion = Motion(problem, scene)
    upper = forms.form(RHO * dynamics.mean_velocity[1] * scene.part(0))
    start = forms.assemble_scalar(forms.form(RHO * dynamics.velocity[1] * scene.part(0)), COMM)
    impedance = np.sqrt(stiffer * heavier)
    force, impulses = RHO * C * V0 * impedance / (1 + impedance) * H, []
    for since in pressed(problem, trial, scene, motion, gap):
        impulses.append((forms.assemble_scalar(upper, COMM) - start) / (force * since))
    trial.check("impulse", np.mean(impulses) - 1, WAVES)


def pressed(problem: Any, trial: Trial, scene: BoxScene, motion: Motion, gap: float) -> Iterator[float]:
    """Times since bars met across a gap, after the wave has passed one; overlap and energy are checked every few steps."""
    for step in uem.time_steps(problem, end=gap / V0 + 1.8 / C):
        trial.iterations += step.newton_iterations
        since = step.time - gap / V0
        if step.number % LOOK == 0:
            trial.check("overlap", overlap(scene, H), OVERLAP)
            trial.check("energy gained", max(0.0, gained(motion, problem.dynamics, step.dt)), FORCE)
            if since > 1.0 / C:
                yield since


def onto_block(stiffer: float, cell: str, wide: float, contactors: str, trial: Trial) -> None:
    """A bar hits a block of one stiff cell, which it sets in motion like a rigid body: impulse in closed form, no energy gained.

    Args:
        stiffer: modulus of the block over that of the bar.
        cell: kind of the cells, in 2D or 3D.
        wide: side of the block, along all axes.
        contactors: with their mass, or without.
        trial: the method.
    """
    only_exact(trial)
    g, gap, E = 2 if cell == "quadrilateral" else 3, 0.3 * V0 * H / C, RHO * C**2
    one, side = np.ones(g - 1), 0.5 * (wide - H)
    boxes = [
        Box((*0.0 * one, gap), (*H * one, gap + 1.0), (*one.astype(int), N), E),
        Box((*-side * one, -wide), (*(H + side) * one, 0.0), np.ones(g, int), stiffer * E),
    ]
    scene = BoxScene(boxes, cell, nu=0.0)
    scene.unite(scene.side(0, g - 1, 0), scene.side(1, g - 1, 1))
    velocity = fem.Function(scene.V)
    velocity.x.array.reshape(-1, g)[scene.nodes_of(0), -1] = -V0
    dynamics = explicit(scene, velocity, contactors)
    problem = trial.create(scene.F, scene.u, scene.moduli, H, contacts=scene.contacts, dynamics=dynamics)
    motion = Motion(problem, scene)
    block = forms.form(RHO * dynamics.mean_velocity[g - 1] * scene.part(1))
    # the force falls with the speed of the bar relative to the block
    mass, rate, impulses = RHO * wide**g, C * H ** (g - 1) / wide**g, []
    for since in pressed(problem, trial, scene, motion, gap):
        expected = -mass * V0 * (1.0 - np.exp(-rate * since))
        impulses.append(forms.assemble_scalar(block, COMM) / expected)
    trial.check("impulse", np.mean(impulses) - 1, WAVES)


def case(name: str, what: str, run: object, quick: bool = True) -> list[Case]:
    """The case for contactors without mass, and with it."""
    return [
        Case(f"{more}explicit {name}", what, partial(run, contactors), quick=quick, moving=True)  # type: ignore[arg-type]
        for contactors, more in (("massless", ""), ("massy", "massy "))
    ]


CASES = [
    *case("bar", "a bar hits a rigid wall", partial(bar, 1.0, 0.1 * V0 / C, 1.0)),
    *case("bar of 1 nm", "a bar of a nanometre", partial(bar, 1.0, 0.1 * V0 / C, 1e-9), quick=False),
    *case("bar of 1 km", "a bar of a kilometre", partial(bar, 1.0, 0.1 * V0 / C, 1e3), quick=False),
    *case("layer 0.01", "cells at the wall are a hundredth of the others", partial(bar, 0.01, 0.1 * V0 / C, 1.0), quick=False),
    *case("layer 0.001", "cells at the wall are a thousandth of the others", partial(bar, 0.001, 0.1 * V0 / C, 1.0), quick=False),
    *case("half the wave speed", "a bar of rubber hits a wall at half the speed of its waves", partial(bar, 1.0, 0.5, 1.0)),
    *case("the wave speed", "the same at the speed of its waves", partial(bar, 1.0, 1.0, 1.0), quick=False),
    *case("twice the wave speed", "the same at twice the speed of its waves", partial(bar, 1.0, 2.0, 1.0), quick=False),
    *case("E 1 : 1e4", "a bar hits a stiffer one", partial(two_bars, 1e4, 1.0), quick=False),
    *case(
        "E 1 : 1e6", "a bar hits a block a million times as stiff", partial(onto_block, 1e6, "quadrilateral", 1.0), quick=False
    ),
    *case("E and mass 1 : 1e6", "a bar hits a stiffer, heavier one", partial(two_bars, 1e6, 1e6)),
    *case("3D layer 0.01", "the same in 3D", partial(bar, 0.01, 0.1 * V0 / C, 1.0, cell="hexahedron"), quick=False),
    *case("3D layer 0.001", "a thousandth", partial(bar, 0.001, 0.1 * V0 / C, 1.0, cell="hexahedron"), quick=False),
    *case("3D layer 0.01 tetrahedra", "of tetrahedra", partial(bar, 0.01, 0.1 * V0 / C, 1.0, cell="tetrahedron"), quick=False),
]
