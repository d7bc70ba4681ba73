"""Cases of thin bodies that bend round rigid ones, and have to get on without a cut."""

from __future__ import annotations

from functools import partial

import numpy as np
import ufl

import uem_dolfinx as uem
from benchmarks.cases import COMM, FORCE, OVERLAP, Box, BoxScene, Case, Trial
from benchmarks.cases_laws import check_laws, overlap
from benchmarks.scenes import NU

#: Ends are clamped, and linear elements lock in bending: a membrane is shorter by an element at either end.
MEMBRANE = 3 * FORCE


def strip_under_ball(aspect: float, trial: Trial) -> None:
    """A strip, its ends held, is bent by a rigid ball; one of aspect 1000 pulls as a membrane does, whose force has a closed form."""
    R, d, t, n = 0.3, 0.1, 1.0 / aspect, 200
    scene = BoxScene([Box((-0.5, 0.0), (0.5, t), (n, 2))], law=uem.StVenantKirchhoff)
    for end in (0, 1):
        scene.hold(scene.side(0, 0, end))
    ball = uem.RigidSphere((0.0, t + R), R)
    scene.unite(scene.side(0, 1, 1), ball)
    problem = trial.create(
        scene.F, scene.u, scene.moduli, 1 / n, bcs=scene.bcs, contacts=scene.contacts, load=lambda f: ball.move((0.0, -d * f))
    )
    trial.check("cuts", sum(step.cuts for step in trial.load_steps(problem, 20)), 0.5)
    check_laws(trial, scene, 1 / n)
    if aspect < 1000:
        return
    # tangent from the end to the circle of the middle line
    r, reach = R + t / 2, np.array([0.5, R + t / 2 - d])
    far = np.linalg.norm(reach)
    angle = np.arcsin(r / far) - np.arctan2(reach[1], reach[0])
    stretch = 2 * (np.sqrt(far**2 - r**2) + r * angle)
    tension = t / (1 - NU**2) * stretch * (stretch**2 - 1) / 2
    force = sum(scene.reaction(scene.side(0, 0, end))[1] for end in (0, 1))
    trial.check("force", force / (2 * tension * np.sin(angle)) - 1, MEMBRANE)


def punch_and_die(plastic: bool, trial: Trial) -> None:
    """Half of a strip on a round die is bent by a round punch: nothing else holds it upright, so that both carry the same force."""
    t, r, n = 0.02, 0.1, 60
    scene = BoxScene([Box((0.0, 0.0), (0.6, t), (n, 2))], law=uem.StVenantKirchhoff)
    materials = []
    if plastic:
        materials = [uem.VonMises(scene.u, 1.0, NU, 0.01, hardening=0.01, kind="plane_strain", strain="green_lagrange")]
        scene.F = materials[0].residual(ufl.TestFunction(scene.V))
    scene.hold(scene.side(0, 0, 0), 0)
    punch, die = uem.RigidSphere((0.0, t + r), r), uem.RigidSphere((0.35, -r), r)
    above, below = scene.side(0, 1, 1), scene.side(0, 1, 0)
    scene.unite(above, punch)
    scene.unite(below, die)
    h = 0.6 / n
    problem = trial.create(
        scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts, materials=materials,
        load=lambda f: punch.move((0.0, -0.15 * f)),
    )  # fmt: skip
    trial.check("cuts", sum(step.cuts for step in trial.load_steps(problem, 40)), 0.5)
    r_all = scene.residual()[:, 1]
    pressed, held = (COMM.allreduce(float(r_all[scene.nodes(side)].sum())) for side in (above, below))
    trial.check("force of punch and die", pressed / held + 1, FORCE)
    trial.check("overlap", overlap(scene, h), OVERLAP)
    check_laws(trial, scene, h)


CASES = [
    *(
        Case(f"strip 1:{a:g} and ball", "bent by a rigid ball in 20 steps", partial(strip_under_ball, a), quick=a == 100)
        for a in (20, 100, 1000)
    ),
    *(
        Case(f"punch and die {words}", "a strip bent between them in 40 steps", partial(punch_and_die, plastic), quick=False)
        for words, plastic in (("elastic", False), ("plastic", True))
    ),
]
