"""Cases of pressure that is hard to hold: round bodies, edges and corners that dig in, and scenes drawn at random."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks.cases import BALANCE, COMM, FORCE, OVERLAP, Box, BoxScene, Case, Trial
from benchmarks.cases_laws import check_laws, overlap
from benchmarks.scenes import NU, rotation
from uem_dolfinx import compat

#: What a scene and its mirror image may differ by; Hertz' half-spaces are not the bodies themselves.
MIRROR, HERTZ = 1e-9, 3 * FORCE


def _under_a_punch(boxes: list[Box]) -> BoxScene:
    """Half of a wide and deep block, even under the punch and growing beyond; with the half of a punch if there are two boxes."""

    def graded(x: np.ndarray, body: int) -> np.ndarray:
        if body:
            return x
        far = np.where(x[:, 0] > 1.5, 0.5 + np.exp(x[:, 0] - 1.5), x[:, 0])
        return np.column_stack([far, 1.0 - np.exp(-x[:, 1])])

    scene = BoxScene(boxes, pose=graded)
    scene.hold(scene.side(0, 1, 0))
    for body in range(len(boxes)):
        scene.hold(scene.side(body, 0, 0), 0)
    return scene


def flat_punch(trial: Trial) -> None:
    """A stiff flat punch on an elastic block, 16 elements wide: the same nodes led downwards by Dirichlet values.

    Pressure grows without bound towards the edge; forces are compared over parts of the width, and at the edge itself.
    """
    h, d = 0.125, 0.02
    block, punch = Box((0.0, -3.0), (4.5, 0.0), (36, 24)), Box((0.0, 0.0), (1.0, 1.0), (8, 8), 1e6)
    led = _under_a_punch([block])
    led.hold(led.side(0, 1, 1, lambda x: x[:, 0] < 1.0 + 1e-9), 1, value=-d)
    uem.UnitedProblem(led.F, led.u, bcs=led.bcs, petsc_options_prefix="led_").solve()
    scene = _under_a_punch([block, punch])
    scene.hold(scene.side(1, 1, 1), 1, value=-d)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, h)
    force = led.reaction(led.side(0, 1, 0))[1]
    for part in (0.25, 0.5, 0.75, 0.95):
        carried = []
        for s in (led, scene):
            nodes = s.nodes(s.side(0, 1, 1))
            inside = s.V.tabulate_dof_coordinates()[nodes, 0] < part + 1e-6
            carried.append(-COMM.allreduce(float(s.residual()[nodes[inside], 1].sum())))
        trial.check(f"force within {part:g} of the width", (carried[1] - carried[0]) / force, FORCE)
    trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / force - 1, FORCE)
    check_laws(trial, scene, h)


def sharp_corner(trial: Trial) -> None:
    """A square on its corner is pressed into a flat block, in finite strain."""

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        if body == 0:
            return x
        c = np.sqrt(0.5)
        return np.column_stack([0.013 + c * (x[:, 0] - x[:, 1]), c * (x[:, 0] + x[:, 1])])

    boxes = [Box((-1.0, -1.0), (1.0, 0.0), (24, 12)), Box((0.0, 0.0), (0.7, 0.7), (7, 7), 10.0)]
    scene = BoxScene(boxes, "triangle", pose, law=uem.NeoHooke)
    scene.hold(scene.side(0, 1, 0))
    for axis in (0, 1):
        scene.hold(scene.side(1, axis, 1), value=(0.0, -0.12))
        scene.unite(scene.side(1, axis, 0), scene.side(0, 1, 1))
    scene.solve(trial, 1 / 12, 6)
    check_laws(trial, scene, 1 / 12)


def corner_on_corner(trial: Trial) -> None:
    """A block that overhangs the edge of a lower one is pressed down: the target's corner lies between two contactors."""
    boxes = [Box((0.0, -1.0), (1.0, 0.0), (8, 8)), Box((0.53, 0.0), (1.53, 1.0), (10, 10), 2.0)]
    scene = BoxScene(boxes, "triangle", law=uem.NeoHooke)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.0, -0.1))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.solve(trial, 0.1, 4)
    check_laws(trial, scene, 0.1)


def wedge(trial: Trial) -> None:
    """A wedge pressed into a groove of another angle, until it bears on both sides."""

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        if body == 0:
            return np.column_stack([x[:, 0], x[:, 1] + 0.5 * np.abs(x[:, 0]) * (x[:, 1] + 1)])
        return np.column_stack([x[:, 0] + 0.01, x[:, 1] + 0.8 * np.abs(x[:, 0]) * (1 - x[:, 1])])

    boxes = [Box((-1.0, -1.0), (1.0, 0.0), (16, 8)), Box((-0.5, 0.0), (0.5, 1.0), (10, 10), 3.0)]
    scene = BoxScene(boxes, "triangle", pose, law=uem.StVenantKirchhoff)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(1, 1, 1), value=(0.0, -0.08))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), max_penetration=0.2)
    scene.solve(trial, 0.1, 4)
    check_laws(trial, scene, 0.1)


def random_scene(seed: int, g: int, law: type, angle: float) -> tuple[BoxScene, float, np.ndarray]:
    """A block on another one, whose sizes, shapes, stiffnesses, meshes and ways are drawn; turned by an angle.

    Returns:
        The scene, the size of its elements at the contact, and the rotation.
    """
    rng = np.random.default_rng(seed)
    n_low, n_high = rng.integers(3, 9 if g == 2 else 4, 2)
    wide, high = rng.uniform(1.3, 2.0), rng.uniform(0.6, 1.2)
    E = 10.0 ** rng.uniform(-3, 3)
    bump, crown, wave = rng.uniform(-0.25, 0.35), rng.uniform(-0.2, 0.2), rng.uniform(0.0, 0.04)
    shift = rng.uniform(-0.2, 0.2)
    gap = rng.uniform(0.0, 0.03)
    way = np.array([rng.uniform(-0.05, 0.05), *[0.0] * (g - 2), -gap - rng.uniform(0.02, 0.08)])
    jitter = [rng.uniform(-0.15, 0.15, ((n + 1) ** g, g)) for n in (n_low, n_high)]
    cell = [("triangle", "quadrilateral"), ("tetrahedron", "hexahedron")][g - 2][rng.integers(2)]
    R = rotation(g, angle)

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        y = np.array(x)
        depth = x[:, -1] + 1 if body == 0 else 0.0
        box = boxes[body]
        size = (np.array(box.hi) - np.array(box.lo)) / box.n
        inner = ((x > np.array(box.lo) + 1e-9) & (x < np.array(box.hi) - 1e-9)).all(axis=1)
        y += np.where(inner[:, None], jitter[body] * size, 0.0)
        if body == 0:
            y[:, -1] -= depth * (bump * (x[:, 0] - crown) ** 2 - wave * np.sin(9 * x[:, 0]))
        else:
            top = (x[:, -1] - box.lo[-1]) / high
            lift = max(0.0, -bump) * (0.5 + abs(shift) + abs(crown)) ** 2 + wave
            curved = (0.3 + max(0.0, -bump)) * ((x[:, 0] - shift) ** 2 if bump < 0.1 else 0.0 * x[:, 0])
            y[:, -1] += (1 - top) * curved + lift * 0.0
        return y @ R.T

    boxes = [
        Box([-wide / 2] * (g - 1) + [-1.0], [wide / 2] * (g - 1) + [0.0], [int(n_low)] * g),
        Box([-0.5 + shift] * (g - 1) + [gap], [0.5 + shift] * (g - 1) + [gap + high], [int(n_high)] * g, E),
    ]
    scene = BoxScene(boxes, cell, pose, law=law)
    scene.hold(scene.side(0, g - 1, 0))
    scene.hold(scene.side(1, g - 1, 1), value=R @ way)
    scene.unite(scene.side(1, g - 1, 0), scene.side(0, g - 1, 1), max_penetration=0.5)
    return scene, min(wide / n_low, 1.0 / n_high), R


def random_scenes(seeds: range, g: int, law: type, trial: Trial) -> None:
    """Lawful, and the same force when the scene is turned."""
    for seed in seeds:
        start, forces = len(trial.checks), []
        for angle in (0.0, 0.7 + seed):
            scene, h, R = random_scene(seed, g, law, angle)
            scene.solve(trial, h, 4)
            size = check_laws(trial, scene, h)
            forces.append(scene.reaction(scene.side(0, g - 1, 0)) @ R)
        trial.check("rotation", float(np.abs(forces[1] - forces[0]).max()) / size if size > 0 else np.inf, FORCE)
        trial.about(f"scene {seed}", start)


def mirrored(cell: str, degree: int, trial: Trial) -> None:
    """A round block on a flat one, and their mirror image: mirrored in every displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    n = 8 // (degree * (g - 1))
    mirror, found = np.array([-1.0, *[1.0] * (g - 1)]), []
    for sign in (np.ones(g), mirror):

        def pose(x: np.ndarray, body: int, sign: np.ndarray = sign) -> np.ndarray:
            bulge = 0.3 * (1.05 - x[:, -1]) * (x[:, :-1] ** 2).sum(axis=1) if body else 0.0
            return sign * np.column_stack([x[:, :-1], x[:, -1] + bulge])

        boxes = [Box([-1.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], [n] * (g - 1) + [n // 2])]
        boxes += [Box([-0.5] * (g - 1) + [0.05], [0.5] * (g - 1) + [1.05], [n] * g, 3.0)]
        scene = BoxScene(boxes, cell, pose, degree=degree)
        scene.hold(scene.side(0, g - 1, 0))
        scene.hold(scene.side(1, g - 1, 1), value=[0.0] * (g - 1) + [-0.2])
        scene.unite(scene.side(1, g - 1, 0), scene.side(0, g - 1, 1))
        before = trial.iterations
        scene.solve(trial, 1 / n, 2)
        ground, top = scene.reaction(scene.side(0, g - 1, 0)), scene.reaction(scene.side(1, g - 1, 1))
        trial.check("action - reaction", float(np.abs(ground + top).max()) / ground[-1], BALANCE)
        trial.check("overlap", overlap(scene, 1 / n), OVERLAP)
        corners = fem.Function(compat.function_space(scene.mesh, 1, (g,)))
        corners.interpolate(scene.u)
        found.append((sign * scene.gather(corners), sign * ground, trial.iterations - before))
    (u, force, iterations), (v, image, of_image) = found
    trial.check("force of the mirror image", float(np.abs(image - force).max() / force[-1]), MIRROR)
    trial.check("displacement of the mirror image", float(np.abs(v - u).max() / np.abs(u).max()), MIRROR)
    trial.check("iterations of the mirror image", of_image - iterations, 0.5)


def cylinder_on_block(trial: Trial, degree: int = 1, gap: float = 0.0, **options: Any) -> None:
    """A steel cylinder of radius 50 mm that 35 kN/mm press on an aluminium block, across a gap or not, in one step.

    NAFEMS' FENET-1, with half of a section of the cylinder: forces and the half-width of the contact, 6.21 mm, against Hertz.
    """
    R, load, E = 50.0, 35e3, (70e3, 210e3)

    def pose(x: np.ndarray, body: int) -> np.ndarray:
        size = np.array([100.0, 200.0]) if body == 0 else np.array([30.0, 50.0])
        y = size * np.sign(x) * np.abs(x) ** 2
        if body:
            y[:, 1] += (R - np.sqrt(R**2 - y[:, 0] ** 2)) * (1 - y[:, 1] / size[1]) + gap
        return y

    n = 48 // degree
    boxes = [Box((0.0, -1.0), (1.0, 0.0), (n, n // 2), E[0]), Box((0.0, 0.0), (1.0, 1.0), (n, n // 2), E[1])]
    scene = BoxScene(boxes, pose=pose, degree=degree)
    for body in (0, 1):
        scene.hold(scene.side(body, 0, 0), 0)
    scene.hold(scene.side(0, 1, 0), 1)
    scene.push(scene.side(1, 1, 1), (0.0, -load / 2 / 30.0))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), **options)
    h = 30.0 / n
    problem = trial.create(scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts)
    trial.check("cuts", sum(step.cuts for step in trial.load_steps(problem, 1)), 0.5)
    trial.check("force", scene.reaction(scene.side(0, 1, 0))[1] / (load / 2) - 1, FORCE)
    nodes = scene.nodes(scene.side(1, 1, 0))
    x, r = scene.V.tabulate_dof_coordinates()[nodes, 0], scene.residual()[nodes, 1]
    spread = COMM.allreduce(float(r @ x**2)) / COMM.allreduce(float(r.sum()))
    half_width = np.sqrt(4 * load * R / np.pi * (1 - NU**2) * sum(1 / e for e in E))
    trial.check("half-width of the contact", np.sqrt(max(4 * spread, 0.0)) / half_width - 1, HERTZ)
    trial.check("overlap", overlap(scene, h), OVERLAP)


CASES = [
    *(
        Case(
            f"mirrored {cell} {degree}",
            "a round block on a flat one, and its mirror image",
            partial(mirrored, cell, degree),
            cell == "triangle",
        )
        for cell, degree in (("triangle", 2), ("quadrilateral", 2), ("tetrahedron", 1), ("tetrahedron", 2), ("hexahedron", 2))
    ),
    Case("cylinder on block", "pressed on by a force in one step", cylinder_on_block),
    Case("cylinder averaged", "with averaged normals", partial(cylinder_on_block, normals="averaged")),
    Case("cylinder degree 2", "with quadratic elements", partial(cylinder_on_block, degree=2)),
    Case("cylinder falls", "pressed on across a gap of 1 mm", partial(cylinder_on_block, gap=1.0)),
    Case("flat punch", "stiff flat punch, singular at its edge", flat_punch),
    Case("sharp corner", "a square pressed in with its corner", sharp_corner),
    Case("corner on edge", "an overhanging block over the edge of its target", corner_on_corner),
    Case("wedge in a groove", "of another angle", wedge),
    Case("random 1-10", "small strain, 2D", partial(random_scenes, range(1, 11), 2, uem.LinearElastic)),
    Case("random 11-20", "finite strain, 2D", partial(random_scenes, range(11, 21), 2, uem.StVenantKirchhoff), quick=False),
    Case("random 21-30", "finite strain, 3D", partial(random_scenes, range(21, 31), 3, uem.StVenantKirchhoff), quick=False),
]
