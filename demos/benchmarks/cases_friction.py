"""Cases of friction: stick, slip, and back again, for coefficients, stiffnesses and steps that are far apart.

In most a block lies on a wider base; its top is brought down and pushed to the side. What is checked are Coulomb's conditions at the
contactors, read from the residual of the bodies, and sums of forces with a closed form. The bodies are linear, and contact keeps the
normals of the drawing: forces are parted along its axes.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks import methods
from benchmarks.cases import BALANCE, COMM, FORCE, OVERLAP, Box, BoxScene, Case, NotApplicable, Trial, largest

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


def in_a_groove(trial: Trial) -> None:
    """A keel whose edge, or whose flanks, slide along a groove that stands still: mu times the forces of both flanks together."""
    mu = 0.3
    if trial.column.method not in methods.OWN:
        raise NotApplicable("springs have no facets that share a node")
    # gaps of mortar vanish in the mean of both flanks, which slide against each other where they differ
    other = (30.0, 30.0) if trial.column.method == "mortar" else (60.0, 80.0)
    for angles, sharp in (((50.0, 50.0), 1.3), ((70.0, 70.0), 1.0), (other, 1.3)):
        slopes = 1 / np.tan(np.radians(angles))

        def pose(x: np.ndarray, body: int, sharp: float = sharp, slopes: np.ndarray = slopes) -> np.ndarray:
            rise = np.abs(x[:, 1]) * np.where(x[:, 1] < 0, *slopes) * (sharp * (1 - x[:, 2]) if body else 1 + x[:, 2])
            return np.column_stack([x[:, :2], x[:, 2] + rise])

        boxes = [Box((0, -0.5, -1), (2, 0.5, 0), (5, 2, 1)), Box((0.2, -0.4, 0), (1.2, 0.4, 1), (3, 2, 2))]
        scene, start = BoxScene(boxes, "hexahedron", pose), len(trial.checks)
        groove, lid = scene.side(0, 2, 1), scene.side(1, 2, 1)
        place = fem.Constant(scene.mesh, np.zeros(3))
        scene.hold(scene.side(0, 2, 0))
        scene.hold(groove)
        scene.bcs.append(uem.dirichlet(scene.V, lid, value=place))
        scene.unite(scene.side(1, 2, 0), groove, friction=mu)

        def load(k: float, place: fem.Constant = place) -> None:
            place.value[:] = 0.5 * max(k - 0.2, 0.0), 0.0, -0.02 * min(5 * k, 1.0)

        problem = trial.create(scene.F, scene.u, scene.moduli, 0.4, bcs=scene.bcs, contacts=scene.contacts, load=load)
        trial.load(problem, 5)
        f = -scene.reaction(lid)
        flanks = np.transpose([(np.cos(a), np.sin(a)) for a in np.radians(angles)]) * [[1.0, -1.0], [1.0, 1.0]]
        trial.check("friction over mu (N1 + N2)", f[0] / (mu * np.linalg.solve(flanks, -f[1:]).sum()) - 1, FORCE)
        trial.about(f"{angles[0]:g} and {angles[1]:g} degrees", start)


def on_a_turntable(trial: Trial) -> None:
    """A block is held above a plane that turns about a far axis: slip spreads, then all of it is dragged with mu N."""
    mu = 0.3
    if trial.column.method not in methods.OWN:
        raise NotApplicable("springs on rigid surfaces that move have no friction here")
    table = uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    scene = BoxScene([Box((9.8, -0.2, 0.0), (10.2, 0.2, 0.4), (3, 3, 3))], "hexahedron")
    lid = scene.side(0, 2, 1)
    place = fem.Constant(scene.mesh, np.zeros(3))
    scene.bcs.append(uem.dirichlet(scene.V, lid, value=place))
    scene.unite(scene.side(0, 2, 0), table, friction=mu)

    def load(k: float) -> None:
        place.value[:] = 0.0, 0.0, -0.01 * min(10 * k, 1.0)
        table.move([0.0] * 3, [0.0, 0.0, 0.002 * max(k - 0.1, 0.0) / 0.9])

    problem = trial.create(scene.F, scene.u, scene.moduli, 0.4 / 3, bcs=scene.bcs, contacts=scene.contacts, load=load)
    trial.load(problem, 10)
    f = scene.reaction(lid)
    trial.check("friction over mu N", -f[1] / (mu * -f[2]) - 1, FORCE)
    trial.check("force across the way", f[0] / f[2], FORCE)


def belt_under_block(trial: Trial) -> None:
    """A block on a rigid belt that starts to move, with friction so rough that half of its contactors lift off before it slips."""
    if trial.column.method not in ("united", "mortar"):
        raise NotApplicable("rigid surfaces that move")
    mu, n, way = 1.0, 4, np.array([0.2, 0.06, 0.0])
    scene = BoxScene([Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (n, n, n))], cell="hexahedron")
    belt = uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    low = scene.side(0, 2, 0)
    scene.hold(scene.side(0, 2, 1), value=(0.0, 0.0, -0.01))
    scene.unite(low, belt, friction=mu)
    options = {"bcs": scene.bcs, "contacts": scene.contacts, "load": lambda k: belt.move(k * way)}
    trial.load(trial.create(scene.F, scene.u, scene.moduli, 1.0 / n, **options), 10)
    r = scene.residual()[scene.nodes(low)]
    p, t = r[:, 2], r[:, :2]
    parts = (p.sum(), np.maximum(-p, 0.0).sum(), np.maximum(np.linalg.norm(t, axis=1) - mu * np.maximum(p, 0.0), 0.0).sum())
    N, pulled, beyond = (COMM.allreduce(float(part)) for part in parts)
    trial.check("tension", pulled / N, BALANCE)
    trial.check("force beyond the cone", beyond / (mu * N), BALANCE)
    T = scene.reaction(low)[:2] @ way[:2] / np.linalg.norm(way)
    trial.check("friction over mu N", T / (mu * N) - 1, FORCE)


def by_its_side(trial: Trial) -> None:
    """Pressed at its top, pushed by a side whose lowest node is a contactor, then back: friction is mu N there as anywhere."""
    scene, mu = rubbing(trial, 0.3), 0.3
    push = fem.Constant(scene.mesh, 0.0)
    top, side = scene.side(1, 1, 1), scene.side(1, 0, 0)
    scene.bcs += [uem.dirichlet(scene.V, top, 1, -0.01), uem.dirichlet(scene.V, side, 0, push)]

    def load(k: float) -> None:
        push.value = float(np.interp(2 * k, range(3), [0.0, 0.1, -0.1]))

    problem = trial.create(scene.F, scene.u, scene.moduli, H, bcs=scene.bcs, contacts=scene.contacts, load=load)
    for number, _ in enumerate(trial.load_steps(problem, 4), start=1):
        below = scene.reaction(scene.side(0, 1, 0))
        if number in (2, 4):
            trial.check("friction over mu N", (-1 if number == 2 else 1) * below[0] / (mu * below[1]) - 1, FORCE)


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
    Case("groove", "a keel slides along a groove that two flanks hold it in", in_a_groove),
    Case("turntable", "slip begins on a surface that has moved", on_a_turntable),
    Case("to and fro", "slip that turns four times", partial(to_and_fro, 0.3)),
    Case("belt under a block", "a rigid belt that starts under a block, mu 1", belt_under_block),
    Case("pushed by its side", "a prescribed side whose lowest node is a contactor, and back", by_its_side),
]
