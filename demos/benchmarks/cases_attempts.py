"""Cases in which a solver is led astray: attempts that fail, bodies without support, offsets of nothing, and slip that turns round.

A right method solves them as it solves the same scene without the difficulty, or names the difficulty.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks import methods
from benchmarks.cases import COMM, FORCE, OVERLAP, Box, BoxScene, Case, NotApplicable, Trial
from uem_dolfinx import forms

#: A body whose displacement exceeds so many times the size of its scene has left it.
LEFT = 1.0


def own(trial: Trial, *, mortar: bool = True) -> None:
    """Refuse rivals, which have neither general contact nor searches of their own."""
    if trial.column.method not in (methods.OWN if mortar else ("united",)):
        raise NotApplicable("self contact is by nodes alone" if trial.column.method == "mortar" else "united elements alone")


def farthest(scene: BoxScene) -> float:
    """Largest displacement of a node, a length (collective)."""
    return float(max(COMM.allgather(np.abs(scene.u.x.array).max(initial=0.0))))


def closing_ring(steps: int, trial: Trial) -> None:
    """An open ring is closed by a pressure that follows its outer face, so fast that the first attempt of a step fails."""
    own(trial, mortar=False)
    t, opening, n = 0.12, 0.15, (80, 5)
    lo, hi = opening, 2 * np.pi - opening

    def bent(x: np.ndarray, _: int) -> np.ndarray:
        return np.column_stack([x[:, 1] * np.cos(x[:, 0]), x[:, 1] * np.sin(x[:, 0])])

    scene = BoxScene([Box((lo, 1 - t), (hi, 1.0), n)], pose=bent, law=uem.NeoHooke)
    scene.hold(scene.side(0, 1, 1, lambda x: np.abs(x[:, 0] - np.pi) < 0.2))
    outer, v, pressure = scene.side(0, 1, 1), ufl.TestFunction(scene.V), fem.Constant(scene.mesh, 0.0)
    deformed = ufl.Identity(2) + ufl.grad(scene.u)
    area = ufl.det(deformed) * ufl.inv(deformed).T * ufl.FacetNormal(scene.mesh)
    scene.F += pressure * ufl.dot(area, v) * forms.surface_measure(scene.mesh, outer.entities)
    contact = uem.GeneralContact(self_contact=True)
    problem = trial.create(
        scene.F, scene.u, scene.moduli, t / n[1], bcs=scene.bcs, contacts=[contact], load={pressure: 2e-4}, rtol=1e-8
    )
    ends = [scene.nodes(scene.side(0, 0, end)) for end in (0, 1)]
    X, bottom = scene.V.tabulate_dof_coordinates()[:, :2], -np.inf
    for _ in trial.load_steps(problem, steps):
        x = X + scene.u.x.array.reshape(-1, 2)
        faces = [np.concatenate(COMM.allgather(x[nodes])) for nodes in ends]
        upper, lower = (face[np.argsort(face[:, 0])] for face in faces)
        at = np.linspace(max(upper[0, 0], lower[0, 0]), min(upper[-1, 0], lower[-1, 0]), 20)
        bottom = max(bottom, float((np.interp(at, *lower.T) - np.interp(at, *upper.T)).max()))
    trial.check("overlap of the end faces over a facet", max(bottom, 0.0) / (t / n[1]), OVERLAP)


def without_support(half: bool, field: str, trial: Trial) -> None:
    """A body without contact is loaded along a motion that nothing restrains: there is no answer."""
    own(trial)
    scene = BoxScene([Box((0.0, 0.0), (1.0, 1.0), (4, 4))])
    if field == "scalar":
        V = uem.function_space(scene.mesh, ("Lagrange", 1))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx - v * ufl.dx
        problem = uem.UnitedProblem(F, u, petsc_options_prefix="stability_")
        trial.load(problem)
        trial.check("temperature without a support", float(np.abs(u.x.array).max(initial=0.0)), FORCE)
        return
    if half:
        scene.hold(scene.side(0, 1, 0), 1)
    scene.weigh(0, (0.5, 1.0))
    scene.solve(trial, 0.25)
    trial.check("displacement without a support", farthest(scene), FORCE)


def free_between(trial: Trial) -> None:
    """A block lies between a clamped and a driven one, all with wavy faces, and no friction holds it sideways."""
    own(trial)

    def wavy(x: np.ndarray, _: int) -> np.ndarray:
        return x + 2e-5 * np.column_stack([np.sin(3 * x[:, 0] + 2 * x[:, 1]), np.sin(3 * x[:, 0] + 2 * x[:, 1] + 1)])

    boxes = [
        Box((0, 0), (2, 1), (6, 3), 100.0),
        Box((0.3, 1), (1.7, 1.6), (5, 2), 100.0),
        Box((0.6, 1.6), (1.4, 2.2), (3, 2), 100.0),
    ]
    scene = BoxScene(boxes, pose=wavy)
    scene.hold(scene.side(0, 1, 0))
    scene.hold(scene.side(2, 1, 1), value=(0.04, -0.06))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    scene.unite(scene.side(2, 1, 0), scene.side(1, 1, 1))
    scene.solve(trial, 0.25, 4)
    trial.check("displacement over the scene's size", farthest(scene) / 2.2, LEFT)


def slid(trial: Trial, **how: Any) -> tuple[np.ndarray, int]:
    """Force ``(2,)`` and Newton iterations of a guided punch that slides over an elastic block by 0.4 facets and back."""
    scene = BoxScene([Box((0, 0), (1, 0.6), (20, 10), 1000.0), Box((0.3, 0.6), (0.7, 1.0), (12, 8), 1000.0)])
    scene.hold(scene.side(0, 1, 0))
    top, way = scene.side(1, 1, 1), fem.Constant(scene.mesh, np.zeros(2))
    scene.bcs.append(uem.dirichlet(scene.V, top, value=way))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1), friction=0.3, **how)

    def load(k: float) -> None:
        way.value[:] = np.interp(3 * k, range(4), [0.0, 0.0, 0.02, 0.0]), -0.004 * min(3 * k, 1.0)

    problem = trial.create(scene.F, scene.u, scene.moduli, 0.05, bcs=scene.bcs, contacts=scene.contacts, load=load)
    before = trial.iterations
    trial.load(problem, 3)
    return scene.reaction(top), trial.iterations - before


def offset_of_nothing(how: Callable[[], dict[str, Any]], trial: Trial) -> None:
    """An offset, a wear or an adjustment that changes nothing leaves the answer and the iterations as they are."""
    own(trial)
    (plain, least), (force, iterations) = slid(trial), slid(trial, **how())
    trial.check("force", float(np.abs(force - plain).max() / np.abs(plain).max()), FORCE)
    trial.check("iterations over those without", iterations / least - 1, 0.5)


def rubbed_in_3d(trial: Trial) -> None:
    """Block on block in 3D, pressed and sheared, with the solver that is the default: as fast as without friction."""
    own(trial)
    n, spent, forces = 20, [], []
    for mu, options in ((0.0, {}), (0.3, {}), (0.3, {"petsc_options": {"ksp_type": "preonly", "pc_type": "lu"}})):
        boxes = [Box((0, 0, -0.3), (1.2, 1.2, 0), (n + 3, n + 3, 3), 1e3), Box((0.1, 0.1, 0), (1.1, 1.1, 0.3), (n, n, 3), 1e3)]
        scene = BoxScene(boxes, "hexahedron")
        scene.hold(scene.side(0, 2, 0))
        top, way = scene.side(1, 2, 1), fem.Constant(scene.mesh, np.zeros(3))
        scene.bcs.append(uem.dirichlet(scene.V, top, value=way))
        scene.unite(scene.side(1, 2, 0), scene.side(0, 2, 1), friction=mu)

        def load(k: float, way: fem.Constant = way) -> None:
            way.value[:] = 0.0008 * max(2 * k - 1, 0.0), 0.0, -0.004 * min(2 * k, 1.0)

        problem = trial.create(
            scene.F, scene.u, scene.moduli, 1 / n, bcs=scene.bcs, contacts=scene.contacts, load=load, rtol=1e-8, **options
        )
        steps = list(trial.load_steps(problem, 4))
        trial.check("cuts", sum(step.cuts for step in steps), 0.5)
        spent.append(max(sum(i.linear_iterations for i in step.iterations) for step in steps))
        forces.append(scene.reaction(top))
    trial.check(
        "force by the default solver and by LU", float(np.abs(forces[1] - forces[2]).max() / np.abs(forces[2]).max()), FORCE
    )
    trial.check("linear iterations over those without friction", spent[1] / max(spent[0], 1), 10.0)


def pushed_to_and_fro(trial: Trial) -> None:
    """A cube on a rough rigid floor, pressed, its lower face moved to and fro; sideways nothing but friction holds it."""
    own(trial)
    mu, pressure = 0.2, 100.0
    scene = BoxScene([Box((0, 0, 0), (1, 1, 1), (1, 1, 1), 210000.0)], "hexahedron")
    low, top = scene.side(0, 2, 0), scene.side(0, 2, 1)
    p = fem.Constant(scene.mesh, 0.0)
    scene.F += p * ufl.TestFunction(scene.V)[2] * forms.surface_measure(scene.mesh, top.entities)
    first = [uem.dirichlet(scene.V, top, component) for component in (0, 1)]
    contact = scene.unite(low, uem.RigidPlane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), friction=mu)
    problem = trial.create(scene.F, scene.u, scene.moduli, 1.0, bcs=first, contacts=[contact])
    ways = (("out", 0.3, 5), ("back", -0.3, 10), ("out again", 0.3, 10))
    moved = [uem.Step(name, n, bcs=[uem.dirichlet(scene.V, low, 1, way)]) for name, way, n in ways]
    cuts = 0
    for step in uem.load_steps(problem, [uem.Step("press", 2, bcs=first, loads={p: pressure}), *moved]):
        trial.iterations += step.newton_iterations
        cuts += step.cuts
        if step.step != "press":
            force = contact.resultant().force
            trial.check("friction over mu N", abs(force[1]) / (mu * pressure) - 1, FORCE)
            trial.check("pressure", force[2] / pressure - 1, FORCE)
    trial.check("cuts", cuts, 4.5)


CASES = [
    *(
        Case(
            f"closing ring {words}",
            "an open ring is closed onto itself by a pressure",
            partial(closing_ring, steps),
            quick=steps == 1,
        )
        for words, steps in (("in a step", 1), ("in 2 steps", 2))
    ),
    *(
        Case(
            f"no support {words}",
            "a load along a motion that nothing restrains, no contact",
            partial(without_support, half, field),
        )
        for words, half, field in (("at all", False, "vector"), ("sideways", True, "vector"), ("of a scalar", False, "scalar"))
    ),
    Case("free between two", "a block that only two wavy faces hold", free_between),
    *(
        Case(f"no {words}", f"{words} of 1e-12 under friction, a slide by 0.4 facets", partial(offset_of_nothing, how))
        for words, how in (
            ("offset", lambda: {"offset": 1e-12}),
            ("wear", lambda: {"wear": 1e-12}),
            ("adjustment", lambda: {"adjust": True}),
        )
    ),
    Case("friction 3D default", "a zone of 441 contactors with the default solver", rubbed_in_3d, quick=False),
    Case("to and fro on a floor", "a cube that friction alone holds sideways", pushed_to_and_fro),
]
