"""Cases of how bodies come to touch: on a vertex, hardly at all, off an end, through supports, one after the other, or loose."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks.cases import BALANCE, COMM, FORCE, OVERLAP, Box, BoxScene, Case, Trial
from benchmarks.cases_laws import check_laws, overlap
from benchmarks.cases_scales import settled, springs
from benchmarks.scenes import CELLS, oedometric


def bend(height: float, nudge: float, lift: float) -> Callable[[np.ndarray, int], np.ndarray]:
    """Fold the lower body's top at x = 0, a ridge for a positive height and a valley for a negative one; shift the upper body."""

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        y = np.array(x)
        if body == 0:
            y[:, -1] -= height * (x[:, -1] + 1) * np.abs(x[:, 0])
        else:
            y[:, 0] += nudge
            y[:, -1] += lift + (x[:, 0] ** 2 * 0.2 if height > 0 else 0.6 * np.abs(x[:, 0])) * (1 - x[:, -1])
        return y

    return pose


#: Shifts from a vertex of the target, in the last bits of a place and more.
NUDGES = (0.0, *(s * np.spacing(0.5) for s in (1, -1, 4, -4)), 1e-12, -1e-9, 1e-6)


def vertex(height: float, law: type, trial: Trial) -> None:
    """A contactor on a vertex of the target, and a few bits off it: lawful, and the same force."""
    forces = []
    for nudge in (1e-3, -1e-3, *NUDGES):
        boxes = [Box((-1.0, -1.0), (1.0, 0.0), (8, 4)), Box((-0.5, 0.0), (0.5, 1.0), (4, 4), 2.0)]
        scene = BoxScene(boxes, "triangle", bend(height, nudge, 0.0), law=law)
        scene.hold(scene.side(0, 1, 0))
        scene.hold(scene.side(1, 1, 1), value=(0.0, -0.03))
        scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), max_penetration=0.2)
        scene.solve(trial, 0.25, 2)
        start = len(trial.checks)
        check_laws(trial, scene, 0.25)
        forces.append(scene.reaction(scene.side(0, 1, 0))[1])
        # on a ridge either side is an equilibrium
        low, high = min(forces[:2]), max(forces[:2])
        trial.check("force", (forces[-1] - np.clip(forces[-1], low, high)) / high if high > 0 else np.inf, FORCE)
        trial.about(f"nudge {nudge:.2g}", start)


def groove(trial: Trial) -> None:
    """A slim tip next to the bottom of grooves of 140 to 30 degrees, down in one step and in four: held by both flanks, and mirrored."""
    h, slopes = 0.25, (0.36, 0.9, 1.0, 1.1, 1.7, 3.7)
    if trial.column.method == "mortar":
        # one equation for a tip's node cannot keep it off either of two flanks that all but face each other
        slopes = slopes[:-1]
    for slope, steps in product(slopes, (1, 4)):
        forces = []
        for side in (1, -1):

            def pose(x: np.ndarray, body: int, slope: float = slope, side: int = side) -> np.ndarray:
                steep = slope * (x[:, 1] + 1) if body == 0 else 1.5 * slope * (1 - x[:, 1])
                lift = np.array([side * 0.005, 0.02]) if body else 0.0
                return np.column_stack([x[:, 0], x[:, 1] + steep * np.abs(x[:, 0])]) + lift

            scene = BoxScene([Box((-1.0, -1.0), (1.0, 0.0), (8, 4)), Box((-0.5, 0.0), (0.5, 1.0), (4, 4), 2.0)], pose=pose)
            scene.hold(scene.side(0, 1, 0))
            scene.hold(scene.side(1, 1, 1), value=(0.0, -0.05))
            scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
            scene.solve(trial, h, steps)
            start = len(trial.checks)
            check_laws(trial, scene, h)
            forces.append(scene.reaction(scene.side(0, 1, 0)) * (side, 1))
            trial.check("mirrored force", np.linalg.norm(forces[-1] - forces[0]) / np.linalg.norm(forces[0]), FORCE)
            trial.about(f"slope {slope:g}, {steps} steps", start)


def edge(trial: Trial) -> None:
    """The same in 3D: contactors on edges and vertices of the target's triangles, on a roof and in a valley."""
    for height in (0.2, -0.2):
        forces = []
        for nudge in NUDGES[:3]:
            boxes = [Box((-1.0, -0.5, -1.0), (1.0, 1.5, 0.0), (4, 4, 2)), Box((-0.5, 0.0, 0.0), (0.5, 1.0, 1.0), (2, 2, 2), 2.0)]
            scene = BoxScene(boxes, "tetrahedron", bend(height, nudge, 0.0), law=uem.StVenantKirchhoff)
            scene.hold(scene.side(0, 2, 0))
            scene.hold(scene.side(1, 2, 1), value=(0.0, 0.0, -0.03))
            scene.unite(scene.side(1, 2, 0), scene.side(0, 2, 1), max_penetration=0.2)
            scene.solve(trial, 0.5, 2)
            start = len(trial.checks)
            check_laws(trial, scene, 0.5)
            forces.append(scene.reaction(scene.side(0, 2, 0))[2])
            trial.check("force", forces[-1] / forces[0] - 1, FORCE)
            trial.about(f"{'roof' if height > 0 else 'valley'}, nudge {nudge:.2g}", start)


def rest(trial: Trial) -> None:
    """Touching with nothing that pushes: nothing moves, no force."""
    for law in (uem.LinearElastic, uem.NeoHooke):
        scene = BoxScene([Box((-0.5, -1.0), (1.5, 0.0), (8, 4)), Box((0.0, 0.0), (1.0, 1.0), (6, 6))], "triangle", law=law)
        scene.hold(scene.side(0, 1, 0))
        scene.hold(scene.side(1, 1, 1))
        scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
        scene.solve(trial, 1 / 6, 2)
        trial.check("force over E h", np.linalg.norm(scene.reaction(scene.side(0, 1, 0))) * 6, OVERLAP)
        trial.check("movement over h", float(np.abs(scene.u.x.array).max(initial=0.0)) * 6, OVERLAP)


def grazing(trial: Trial) -> None:
    """A block slides along a flat target at zero pressure, over its vertices and off its end, without force."""
    scene = BoxScene([Box((-0.5, -1.0), (1.5, 0.0), (8, 4)), Box((0.0, 0.0), (1.0, 1.0), (6, 6))], "triangle")
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(1.7, 0.0))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    problem = trial.create(scene.F, scene.u, scene.moduli, 1 / 6, bcs=scene.bcs, contacts=scene.contacts)
    for _ in trial.load_steps(problem, 13):
        trial.check("force over E h", np.linalg.norm(scene.reaction(scene.side(0, 1, 0))) * 6, OVERLAP)
        trial.check("overlap", overlap(scene, 1 / 6), OVERLAP)


def tangent_sphere(trial: Trial) -> None:
    """A round block comes down on a flat one until it just touches, and a little further and less far."""
    for more in (-1e-9, 0.0, 1e-9):

        def pose(x: np.ndarray, body: int) -> np.ndarray:
            return np.column_stack([x[:, 0], x[:, 1] + (0.1 + 0.4 * x[:, 0] ** 2 * (1 - x[:, 1]) if body else 0.0)])

        boxes = [Box((-1.0, -1.0), (1.0, 0.0), (15, 6)), Box((-0.5, 0.0), (0.5, 1.0), (10, 6))]
        scene = BoxScene(boxes, "triangle", pose)
        scene.hold(scene.side(0, 1, 0))
        scene.hold(scene.side(1, 1, 1), value=(0.0, -0.1 - more))
        scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
        scene.solve(trial, 0.1, 2)
        force = scene.reaction(scene.side(0, 1, 0))[1]
        trial.check(f"force over E h (way {more:+g})", force / 0.1, OVERLAP)
        trial.check("overlap", overlap(scene, 0.1), OVERLAP)


def off_the_end(trial: Trial) -> None:
    """A pressed round block is dragged off the end of its target: lawful while it presses, and without force at the end."""
    h = 1 / 12

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        return np.column_stack([x[:, 0], x[:, 1] + (0.8 * (x[:, 0] - 0.85) ** 2 * (0.5 - x[:, 1]) if body else 0.0)])

    boxes = [Box((0.0, -1.0), (2.0, 0.0), (10, 5)), Box((0.6, 0.0), (1.1, 0.5), (6, 6), 10.0)]
    scene = BoxScene(boxes, "triangle", pose, law=uem.NeoHooke)
    scene.hold(scene.side(0, 1, 0))
    lead = fem.Constant(scene.mesh, np.zeros(2))
    top = fem.locate_dofs_topological(scene.V, 1, scene.side(1, 1, 1).entities)
    scene.bcs.append(fem.dirichletbc(lead, top, scene.V))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))

    def drag(t: float) -> None:
        lead.value[:] = (1.7 * max(0.0, t - 0.1) / 0.9, -0.04 * min(1.0, t / 0.1))

    problem = trial.create(scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts, load=drag)
    pressed = 0.0
    for step in trial.load_steps(problem, 40):
        start = len(trial.checks)
        force = float(np.linalg.norm(scene.reaction(scene.side(0, 1, 0))))
        pressed = max(pressed, force)
        if force > 0.01 * pressed:
            check_laws(trial, scene, h)
        trial.about(f"at {step.factor:.3g}", start)
    trial.check("force at the end", force / pressed, BALANCE)


def led_contactor(trial: Trial) -> None:
    """The contactors themselves are led downwards by d and the target gives way: F = M d."""
    scene = springs(([4, 4], [8, 8]), d=0.01)
    scene.hold(scene.side(1, 1, 0), 1, value=-0.01)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 8)
    settled(trial, scene, 0.01 * oedometric(), 1 / 8)


def fought_contactor(trial: Trial) -> None:
    """The contactors are led into a target that is held: nothing can meet both."""
    scene = springs(([4, 4], [8, 8]), d=0.01)
    scene.hold(scene.side(1, 1, 0), 1, value=-0.01)
    scene.hold(scene.side(0, 1, 1), 1)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 8)
    trial.check("overlap", overlap(scene, 1 / 8), OVERLAP)


def clamped_corner(trial: Trial) -> None:
    """Contactors held sideways where the target is held fast: values that fit, and a target's node that cannot move."""
    scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), (5, 5)), Box((0.0, 0.0), (1.0, 1.0), (5, 5))])
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(0, 0, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.0, -0.01))
    scene.hold(scene.side(1, 0, 0), 0)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 0.2)
    check_laws(trial, scene, 0.2)


def two_pass(n: tuple[int, int], trial: Trial) -> None:
    """Meshes that are not nested, each side contactor and target: a uniform pressure passes."""
    scene = springs(([n[0], 4], [n[1], 4]))
    low, high = scene.side(0, 1, 1), scene.side(1, 1, 0)
    scene.unite_both(trial, high, low)
    scene.solve(trial, 1 / max(n))
    settled(trial, scene, 0.01 * oedometric() / 2, 1 / max(n))
    check_laws(trial, scene, 1 / max(n))


def two_pass_round(trial: Trial) -> None:
    """A round block on a flat one, meshes that are not nested, each side contactor and target."""

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        return np.column_stack([x[:, 0], x[:, 1] + (0.3 * x[:, 0] ** 2 * (1 - x[:, 1]) if body else 0.0)])

    scene = BoxScene([Box((-1.0, -1.0), (1.0, 0.0), (30, 12)), Box((-0.6, 0.0), (0.6, 1.0), (25, 12), 3.0)], "triangle", pose)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.0, -0.04))
    scene.unite_both(trial, scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 0.05)
    check_laws(trial, scene, 0.05)


def chain(E: tuple[float, float, float], trial: Trial) -> None:
    """Three blocks on each other, the middle one contactor and target: springs in series."""
    scene = BoxScene([Box((0.0, k), (1.0, k + 1.0), (2 * 2**k, 2 * 2**k), E[k]) for k in range(3)])
    scene.rollers()
    scene.hold(scene.side(0, 1, 0), 1)
    scene.hold(scene.side(2, 1, 1), 1, value=-0.01)
    for k in (1, 2):
        scene.unite(scene.side(k, 1, 0), scene.side(k - 1, 1, 1))
    scene.solve(trial, 1 / 8)
    settled(trial, scene, 0.01 * oedometric() / sum(1 / e for e in E), 1 / 8)
    check_laws(trial, scene, 1 / 8)


def loose(load: float, gap: float, sides: bool, trial: Trial) -> None:
    """A block that nothing but contact holds up is pushed down across a gap: the ground carries the load."""
    scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), (4, 4)), Box((0.0, gap), (1.0, 1.0 + gap), (8, 8))])
    scene.rollers(*((0, 1) if sides else (0,)))
    scene.hold(scene.side(0, 1, 0), 1)
    scene.push(scene.side(1, 1, 1), (0.0, -load))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 8)
    settled(trial, scene, load, 1 / 8)
    check_laws(trial, scene, 1 / 8)


def rocking(trial: Trial) -> None:
    """A loose round body, askew above the floor, falls and rocks until it lies under its weight.

    Only the slopes of facets determine its place along the floor; a force along it to 1 % of the weight is no error.
    """

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        if body == 0:
            return x
        x = np.column_stack([x[:, 0], x[:, 1] + 1.25 * x[:, 0] ** 2 * (0.4 - x[:, 1])])
        c, s = np.cos(0.2), np.sin(0.2)
        return np.column_stack([0.02 + c * x[:, 0] - s * x[:, 1], 0.2 + s * x[:, 0] + c * x[:, 1]])

    boxes = [Box((-1.0, -1.0), (1.0, 0.0), (16, 6)), Box((-0.3, 0.0), (0.3, 0.4), (12, 4))]
    scene = BoxScene(boxes, "triangle", pose, law=uem.StVenantKirchhoff)
    scene.hold(scene.side(0, 1, 0))
    scene.weigh(1, (0.0, -1e-2))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 0.05)
    trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / (1e-2 * scene.volume(1)) - 1, FORCE)
    check_laws(trial, scene, 0.05, supported=FORCE)


def lifted(trial: Trial) -> None:
    """A loose block that is pulled off its ground: nothing can hold it."""
    scene = BoxScene([Box((0.0, -1.0), (1.0, 0.0), (4, 4)), Box((0.0, 0.0), (1.0, 1.0), (8, 8))])
    scene.rollers()
    scene.hold(scene.side(0, 1, 0), 1)
    scene.push(scene.side(1, 1, 1), (0.0, 0.01))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 8)
    trial.check("force", np.inf, FORCE)


def beside(g: int, sliding: str, rollers: bool, trial: Trial) -> None:
    """A long block, its far end held, under a short stiff punch: whatever holds its contactors, nothing next to the punch is pressed."""
    h, length = 0.25 if g == 2 else 0.5, 30.0 if g == 2 else 8.0
    across, n = [1.0] * (g - 2), [round(1 / h)] * (g - 1)
    lower = Box([0.0] * (g - 1) + [-1.0], [length, *across, 0.0], [round(length / h), *n])
    scene = BoxScene([lower, Box([0.0] * g, [1.1, *across, 1.0], [round(1 / h), *n], 1e3)], CELLS[2 * (g - 2) + 1])
    scene.hold(scene.side(0, g - 1, 0))
    scene.hold(scene.side(0, 0, 1), *([0] if rollers else []))
    for body, (axis, end) in product((0, 1), ((0, 0), *((1, 0), (1, 1))[: 2 * (g - 2)])):
        scene.hold(scene.side(body, axis, end), axis)
    scene.hold(scene.side(1, g - 1, 1), value=[0.0] * (g - 1) + [-0.02])
    top = scene.side(0, g - 1, 1)
    scene.unite(top, scene.side(1, g - 1, 0), sliding=sliding)
    scene.solve(trial, h)
    nodes = scene.nodes(top)
    # mortar hands what a facet bears under the punch's end to all its nodes
    end = 1.1 + h * (trial.column.method == "mortar")
    far = nodes[scene.V.tabulate_dof_coordinates()[nodes, 0] > end]
    ground, punch = (scene.reaction(scene.side(body, g - 1, body))[-1] for body in (0, 1))
    trial.check("force beside the punch", COMM.allreduce(float(np.abs(scene.residual()[far, -1]).sum())) / ground, FORCE)
    # rollers carry a part of what is sheared next to the punch
    trial.check("force of ground and punch", punch / ground + 1, FORCE)
    check_laws(trial, scene, h)


CASES = [
    Case("vertex ridge", "contactor on a vertex of a ridge to the last bit", partial(vertex, 0.3, uem.StVenantKirchhoff)),
    Case("vertex flat", "contactor on a vertex of a plane to the last bit", partial(vertex, 0.0, uem.LinearElastic)),
    Case("vertex valley", "contactor on a vertex of a valley to the last bit", partial(vertex, -0.3, uem.StVenantKirchhoff)),
    Case("beside a groove", "a tip next to the bottom of grooves of 140 to 30 degrees", groove),
    Case("edge 3D", "contactors on edges of a roof and a valley to the last bit", edge),
    Case("rest", "touching, but nothing pushes", rest),
    Case("grazing", "sliding at zero pressure, and off the end", grazing),
    Case("tangent", "round block brought down until it touches", tangent_sphere),
    Case("off the end", "pressed block dragged off its target", off_the_end),
    *(
        Case(
            f"beside {g}D {sliding}{' rollers' * rollers}",
            "a far end that is held, next to a short punch",
            partial(beside, g, sliding, rollers),
            quick=(g == 2) == rollers,
        )
        for g, sliding, rollers in product((2, 3), ("finite", "small"), (False, True))
    ),
    Case("contactor led", "Dirichlet values on the contactors, the target gives way", led_contactor),
    Case("contactor fought", "contradicting Dirichlet values", fought_contactor),
    Case("clamped corner", "contactor next to a node of the target that is held", clamped_corner),
    Case("two-pass 3:4", "meshes that are not nested", partial(two_pass, (3, 4))),
    Case("two-pass 7:24", "meshes that are not nested", partial(two_pass, (7, 24))),
    Case("two-pass round", "a round block, meshes that are not nested", two_pass_round),
    Case("chain", "three blocks", partial(chain, (1.0, 1.0, 1.0))),
    Case("chain hard middle", "three blocks", partial(chain, (1.0, 1e4, 1.0))),
    Case("loose block", "rigid-body mode before touching", partial(loose, 0.01, 0.25, True)),
    Case("loose sideways", "also free to slide and tilt", partial(loose, 0.01, 0.25, False)),
    Case("force-driven", "small load across a large gap", partial(loose, 1e-6, 2.0, True)),
    Case("rocking", "loose round body that falls askew and comes to rest", rocking),
    Case("lifted", "nothing can hold", lifted),
]
