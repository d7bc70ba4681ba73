"""Cases of scales: stiffnesses, sizes of elements, Poisson's ratios, units and overlaps that are far apart.

All but one are two blocks between rollers, whose springs in series have a closed form.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import uem_dolfinx as uem
from benchmarks.cases import FORCE, OVERLAP, Box, BoxScene, Case, Trial
from benchmarks.cases_laws import check_laws, overlap
from benchmarks.scenes import NU, oedometric


def springs(n: tuple[list[int], list[int]], E: tuple[float, float] = (1.0, 1.0), d: float = 0.01, gap: float = 0.0) -> BoxScene:
    """Unit block on unit block between rollers, the top pushed down by d; ``n`` and E of the lower and the upper one."""
    scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), n[0], E[0]), Box((0.0, gap), (1.0, 1.0 + gap), n[1], E[1])])
    scene.rollers()
    scene.hold(scene.side(0, 1, 0), 1)
    scene.hold(scene.side(1, 1, 1), 1, value=-d)
    return scene


def settled(trial: Trial, scene: BoxScene, force: float, h: float) -> None:
    """Check the reaction of the ground against the force of the springs, and the overlap (collective)."""
    trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / force - 1, FORCE)
    trial.check("overlap", overlap(scene, h), OVERLAP)


def stiffness_ratio(ratio: float, trial: Trial) -> None:
    """The upper block ``ratio`` times as stiff as the lower one, either side as contactor; the softer one has E = 1."""
    E = (max(1.0, 1 / ratio), max(1.0, ratio))
    for contactor in (0, 1):
        scene = springs(([4 * (2 - contactor)] * 2, [4 * (1 + contactor)] * 2), E)
        scene.unite(scene.side(contactor, 1, 1 - contactor), scene.side(1 - contactor, 1, contactor))
        scene.solve(trial, 1 / 8)
        settled(trial, scene, 0.01 * oedometric() / (1 / E[0] + 1 / E[1]), 1 / 8)


def stiffness_ratio_curved(ratio: float, trial: Trial) -> None:
    """A round block on a flat one, in finite strain: equilibrium and the conditions of contact."""
    E = (max(1.0, 1 / ratio), max(1.0, ratio))

    def round_below(x: np.ndarray, body: int) -> np.ndarray:
        lift = np.where(body == 1, 0.3 * x[:, 0] ** 2 * (1 - x[:, 1]), 0.0)
        return np.column_stack([x[:, 0], x[:, 1] + lift])

    boxes = [Box((-1.0, -1.0), (1.0, 0.0), (15, 8), E[0]), Box((-0.6, 0.0), (0.6, 1.0), (12, 8), E[1])]
    scene = BoxScene(boxes, "triangle", round_below, law=uem.StVenantKirchhoff)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.0, -0.04))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 0.1, 2)
    check_laws(trial, scene, 0.1)


def mesh_ratio(n: tuple[int, int], two_pass: bool, trial: Trial) -> None:
    """Facets of very different sizes, the upper side as contactor, or both sides."""
    scene = springs(([n[0], 4], [n[1], 4]))
    low, high = scene.side(0, 1, 1), scene.side(1, 1, 0)
    if two_pass:
        scene.unite_both(trial, high, low)
    else:
        scene.unite(high, low)
    scene.solve(trial, 1 / max(n))
    if n[1] >= n[0] or two_pass:
        settled(trial, scene, 0.01 * oedometric() / 2, 1 / max(n))
    check_laws(trial, scene, 1 / max(n))


def locking(trial: Trial) -> None:
    """Two equal clamped blocks that bulge, against the same mesh in one piece: no shear where they meet, so the same force."""
    for nu in (0.3, 0.49, 0.4999):
        whole = BoxScene([Box((0.0, -1.0), (1.0, 1.0), (6, 12))], nu=nu)
        whole.hold(whole.side(0, 1, 0))
        whole.hold(whole.side(0, 1, 1), value=(0.0, -0.02))
        uem.UnitedProblem(whole.F, whole.u, bcs=whole.bcs, petsc_options_prefix="whole_").solve()
        scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), (6, 6)), Box((0.0, 0.0), (1.0, 1.0), (6, 6))], nu=nu)
        scene.hold(scene.side(0, 1, 0))
        scene.hold(scene.side(1, 1, 1), value=(0.0, -0.02))
        scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
        scene.solve(trial, 1 / 6)
        start = len(trial.checks)
        force = whole.reaction(whole.side(0, 1, 0))[1]
        trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / force - 1, FORCE)
        check_laws(trial, scene, 1 / 6)
        trial.about(f"nu = {nu}", start)


def _one_unit(trial: Trial, length: float, E: float) -> tuple[np.ndarray, int]:
    """An oblique approach over a bent target in other units: force over E length, and Newton iterations."""

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        bent = np.column_stack([x[:, 0], x[:, 1] - (0.2 * (x[:, 1] + 1) * (x[:, 0] - 0.45) ** 2 if body == 0 else 0.0)])
        return length * bent

    boxes = [Box((-0.5, -1.0), (1.5, 0.0), (8, 4), E), Box((0.0, 0.05), (1.0, 1.05), (6, 6), 2 * E)]
    scene = BoxScene(boxes, "triangle", pose, law=uem.StVenantKirchhoff)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.03 * length, -0.12 * length))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    before = trial.iterations
    scene.solve(trial, length / 6, 2)
    check_laws(trial, scene, length / 6)
    return scene.reaction(scene.side(0, 1, 0)) / (E * length), trial.iterations - before


def units(trial: Trial) -> None:
    """From nanometres and kPa to kilometres and TPa: the same forces to 1e-6 in the same iterations."""
    force, iterations = _one_unit(trial, 1.0, 1.0)
    for length, E in ((1e-9, 1e3), (1e-9, 1e12), (1e-3, 2e11), (1e3, 1e3), (1e3, 1e12)):
        start = len(trial.checks)
        there, count = _one_unit(trial, length, E)
        trial.check("force", float(np.abs(there - force).max() / np.linalg.norm(force)), 1e-6)
        trial.check("iterations", abs(count - iterations), 0.5)
        trial.about(f"length {length:g} m, E {E:g} Pa", start)


def penetration(depth: float, trial: Trial) -> None:
    """Unit blocks drawn into each other by a length press each other apart: an interference of known force."""
    h = 1 / 8
    scene = springs(([4, 4], [8, 8]), d=0.0, gap=-depth)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), max_penetration=2 * h)
    scene.solve(trial, h)
    trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / (depth * oedometric() / 2) - 1, FORCE)
    trial.check("overlap", overlap(scene, h), OVERLAP)


def compression(kept: float, held: bool, trial: Trial) -> None:
    """Two neo-Hookean blocks pressed to a part of their height, between rollers or free to spread; both stay bricks."""
    scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), (4, 4)), Box((0.0, 0.0), (1.0, 1.0), (4, 4))], law=uem.NeoHooke)
    if held:
        scene.rollers()
    else:
        for body in (0, 1):
            scene.hold(scene.side(body, 0, 0), 0)
    scene.hold(scene.side(0, 1, 0), 1)
    scene.hold(scene.side(1, 1, 1), 1, value=-2 * (1 - kept))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 4, 10)
    mu, lam = 1 / (2 * (1 + NU)), NU / ((1 + NU) * (1 - 2 * NU))

    def along(a: float, b: float) -> float:
        """Nominal stress along the stretch a with the stretch b across."""
        return mu * (a - 1 / a) + lam / 2 * ((a * b) ** 2 - 1) / a

    low, high = 1.0, 3.0
    while not held and low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if along(middle, kept) < 0 else (low, middle)
    settled(trial, scene, -along(kept, low), 1 / 4)
    check_laws(trial, scene, 1 / 4)


CASES = [
    *(
        Case(
            f"E ratio {r:g}",
            "two blocks, one stiffer, either side as contactor",
            partial(stiffness_ratio, r),
            r in (1e-9, 1e9, 1e12),
        )
        for r in (1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e12, 1e13)
    ),
    *(
        Case(
            f"E ratio {r} round",
            "round block on a flat one, finite strain",
            partial(stiffness_ratio_curved, float(r)),
            "12" not in r,
        )
        for r in ("1e-12", "1e-6", "1e6", "1e12")
    ),
    Case("mesh 50:1", "50 contactors on a facet of the target", partial(mesh_ratio, (2, 100), False)),
    Case("mesh 1:50", "a contactor on every 50th facet of the target", partial(mesh_ratio, (100, 2), False)),
    Case("mesh 1:50 two-pass", "the same, each side contactor and target", partial(mesh_ratio, (100, 2), True)),
    Case("1000 per facet", "1000 contactors on one facet of the target", partial(mesh_ratio, (1, 1000), False)),
    Case("1 per facet", "one contactor on every facet of the target, node on node", partial(mesh_ratio, (20, 20), False)),
    Case("locking", "nu = 0.3 to 0.4999 against the same mesh in one piece", locking),
    Case("units", "nm to km, kPa to TPa", units, quick=False),
    *(
        Case(f"overlap {p:g}", f"unit blocks drawn {words} into each other", partial(penetration, p))
        for p, words in ((1e-12, "1e-12"), (1e-6, "1e-6"), (1e-3, "1e-3"), (0.125, "by one element"))
    ),
    Case("60 % height held", "neo-Hookean blocks between rollers", partial(compression, 0.6, True)),
    Case("60 % height free", "neo-Hookean blocks that spread together", partial(compression, 0.6, False)),
]
