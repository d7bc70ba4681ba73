"""Cases of friction: stick, slip, and back again, for coefficients, stiffnesses and steps that are far apart.

A block lies on a wider base; its top is brought down and pushed to the side. What is checked are Coulomb's conditions at the
contactors, read from the residual of the bodies, and sums of forces with a closed form. The bodies are linear, and contact keeps the
normals of the drawing: forces are parted along its axes.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from dolfinx import fem

import uem_dolfinx as uem
from evidence import methods
from evidence.cases import BALANCE, COMM, FORCE, OVERLAP, Box, BoxScene, Case, NotApplicable, Trial, largest

H = 0.1


def rubbing(trial: Trial, mu: float, E: tuple[float, float] = (1.0, 1.0), width: float = 1.0) -> BoxScene:
    """Block of modulus ``E[1]`` on a base of ``E[0]`` that is held at its bottom."""
    if trial.column.method not in methods.RUB:
        raise NotApplicable("without friction here")
    n = round(0.6 / H)
    boxes = [
        Box((0.5 - width / 2, -0.4), (0.5 + width / 2, 0.0), (round(width / H), 4), E[0]),
        Box((0.2, 0.0), (0.8, 0.4), (n, 4), E[1]),
    ]
    scene = BoxScene(boxes)
    scene.hold(scene.side(0, 1, 0))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), friction=mu, sliding="fixed")
    return scene


def forces(scene: BoxScene) -> tuple[np.ndarray, np.ndarray]:
    """Normal and tangential contact forces of this rank's contactors ``(n,)``, from the residual (collective)."""
    r = scene.residual()[scene.nodes(scene.side(1, 1, 0))]
    return r[:, 1], r[:, 0]


def apart(scene: BoxScene) -> float:
    """Largest gap or overlap of contactors that press, each on the node of the base where it was drawn (collective)."""
    own, base = scene.nodes(scene.side(1, 1, 0)), scene.nodes(scene.side(0, 1, 1))
    X, u = scene.V.tabulate_dof_coordinates()[:, 0], scene.u.x.array.reshape(-1, 2)[:, 1]
    x, height = (np.concatenate(part) for part in zip(*COMM.allgather((X[base], u[base]))))
    gap = u[own] - height[np.abs(X[own, None] - x).argmin(axis=1)] if len(own) else np.zeros(0)
    p = forces(scene)[0]
    return largest(np.where(p > BALANCE * largest(p), gap, np.minimum(gap, 0.0)))


def check_coulomb(trial: Trial, scene: BoxScene, mu: float) -> tuple[float, float]:
    """Check pressure, cone, overlap and equilibrium; returns the sums of normal and of friction forces (collective)."""
    p, t = forces(scene)
    parts = (p.sum(), t.sum(), np.maximum(-p, 0.0).sum(), np.maximum(np.abs(t) - mu * np.maximum(p, 0.0), 0.0).sum())
    N, T, pulled, beyond = (COMM.allreduce(float(part)) for part in parts)
    trial.check("tension", pulled / N, BALANCE)
    trial.check("force beyond the cone", beyond / (min(mu, 1.0) * N), BALANCE)
    trial.check("overlap", apart(scene) / H, OVERLAP)
    below = scene.reaction(scene.side(0, 1, 0))
    trial.check("action - reaction", largest(below - [T, N]) / N, BALANCE)
    return N, T


def slipping(mu: float, E: tuple[float, float], steps: int, trial: Trial) -> None:
    """Pushed so far that all contactors slip: the sum of friction is mu times that of the normal forces."""
    scene = rubbing(trial, mu, E)
    soft = min(E)
    down = 0.01 * soft / E[1]
    scene.hold(scene.side(1, 1, 1), value=(8 * (mu + 0.1) * (0.01 + down), -(0.01 + down)))
    scene.solve(trial, H, steps)
    N, T = check_coulomb(trial, scene, mu)
    trial.check("friction over mu N", -T / (mu * N) - 1, FORCE)


def sticking(trial: Trial) -> None:
    """Two blocks of the same width that rough friction holds together, against one body of the same mesh."""
    scene = rubbing(trial, 10.0, width=0.6)
    whole = BoxScene([Box((0.2, -0.4), (0.8, 0.4), (round(0.6 / H), 8))])
    whole.hold(whole.side(0, 1, 0))
    push = (0.004, -0.01)
    for one, top in ((scene, scene.side(1, 1, 1)), (whole, whole.side(0, 1, 1))):
        one.hold(top, value=push)
    scene.solve(trial, H, 2)
    uem.UnitedProblem(whole.F, whole.u, bcs=whole.bcs, petsc_options_prefix="whole_").solve()
    N, T = check_coulomb(trial, scene, 10.0)
    exact = whole.reaction(whole.side(0, 1, 0))
    trial.check("force", max(abs(T / exact[0] - 1), abs(N / exact[1] - 1)), FORCE)


def to_and_fro(mu: float, trial: Trial) -> None:
    """Pressed, pushed until it slips, pushed back until it slips the other way, and once more: the same force each time."""
    scene = rubbing(trial, mu)
    place = fem.Constant(scene.mesh, np.zeros(2))
    scene.bcs.append(uem.dirichlet(scene.V, scene.side(1, 1, 1), value=place))
    way = 8 * (mu + 0.1) * 0.01

    def load(k: float) -> None:
        place.value[:] = np.interp(5 * k, range(6), [0.0, 0.0, way, -way, way, -way]), -0.01 * min(5 * k, 1.0)

    problem = trial.create(scene.F, scene.u, scene.moduli, H, bcs=scene.bcs, contacts=scene.contacts, load=load)
    for number, _ in enumerate(trial.load_steps(problem, 10), start=1):
        N, T = check_coulomb(trial, scene, mu)
        if number in (4, 6, 8, 10):
            trial.check("friction over mu N", (1 if number in (6, 10) else -1) * T / (mu * N) - 1, FORCE)


CASES = [
    *(
        Case(f"slip mu {mu:g}", "a block slips on all its contactors", partial(slipping, mu, (1.0, 1.0), 4))
        for mu in (1e-3, 0.3, 1.0)
    ),
    *(
        Case(
            f"slip E ratio {ratio:g}",
            "block over base, mu 0.3",
            partial(slipping, 0.3, (max(1.0, 1 / ratio), max(1.0, ratio)), 4),
        )
        for ratio in (1e-6, 1e-3, 1e3, 1e6)
    ),
    Case("slip in one step", "pressed and pushed past slip in a single step", partial(slipping, 0.3, (1.0, 1.0), 1)),
    Case("stick", "rough friction makes one body of two", sticking),
    Case("to and fro", "slip that turns four times", partial(to_and_fro, 0.3)),
]
