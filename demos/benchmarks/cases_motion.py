"""Cases of impact: steps from a hundredth of the Courant limit to a hundred times it, and speeds that cross the target in a step.

What is known of a bar that hits a rigid wall, of a block that hits a plate and of one that lands on a rod are momentum, energy, and which
side they are on.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import ufl
from dolfinx import fem

import uem_dolfinx as uem
from benchmarks.cases import COMM, FORCE, OVERLAP, Box, BoxScene, Case, Trial
from benchmarks.cases_laws import overlap
from uem_dolfinx import forms

RHO, V0 = 1.0, 1.0
#: Fronts of waves spread over a few elements, and steps beyond the Courant limit do not resolve them.
WAVES = 5 * FORCE
#: Touches are found to this part of a step.
EVENT = 1e-3
#: Energy and overlap are looked at every so many steps.
LOOK = 10


class Motion:
    """Energy and momentum of a scene in motion without loads.

    Args:
        problem: with dynamics.
        scene: its bodies.
    """

    def __init__(self, problem: uem.UnitedProblem, scene: BoxScene):
        assert problem.dynamics is not None
        self._dynamics = problem.dynamics
        self._stored = forms.form(scene.material.energy(scene.u) * ufl.dx)
        self.start_energy, self._start_momentum = self._energy(), self._dynamics.momentum()

    def _energy(self) -> float:
        return self._dynamics.kinetic_energy() + forms.assemble_scalar(self._stored, COMM)

    def gained(self) -> float:
        """Energy won since the start, as part of that at the start; negative if lost (collective)."""
        return self._energy() / self.start_energy - 1

    def impulse(self) -> float:
        """Momentum upwards won since the start (collective)."""
        return float((self._dynamics.momentum() - self._start_momentum)[-1])


def bar_on_wall(courant: float, event: float | None, trial: Trial) -> None:
    """A bar hits a rigid wall: no energy won, none lost where touches are found, and an impulse that is right.

    Steps that resolve the wave see it run through 9 elements, at the Courant limit through all and back, with a pressure of
    rho c v. With longer ones the energy of vibrations is not known: between a plastic impact and an elastic one all is right.
    """
    n, c = 16, 10.0
    h = 1 / n
    dt = courant * h / c
    gap = 0.3 * V0 * dt
    scene = BoxScene([Box((0.0, gap), (h, gap + 1.0), (1, n), RHO * c**2)], nu=0.0)
    scene.unite(scene.side(0, 1, 0), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    dynamics = uem.Dynamics(uem.consistent_mass(scene.V, RHO), velocity=(0.0, -V0))
    problem = trial.create(scene.F, scene.u, scene.moduli, h, contacts=scene.contacts, dynamics=dynamics)
    motion = Motion(problem, scene)
    seen = 9 * h / c if courant < 1 else 2.2 / c
    deep = 0.0
    for step in trial.time_steps(problem, dt, gap / V0 + max(seen, 8.4 * dt), event):
        if step.number % LOOK == 0 or courant >= 1:
            deep = max(deep, overlap(scene, h))
            trial.check("energy gained", max(0.0, motion.gained()), FORCE)
    trial.check("overlap", deep, OVERLAP)
    if event is not None:
        trial.check("energy lost", min(0.0, motion.gained()), WAVES)
    impulse, momentum = motion.impulse(), RHO * V0 * h
    if courant <= 1:
        trial.check("impulse", impulse / (RHO * c * V0 * h * min(seen, 2 / c)) - 1, WAVES)
    else:
        trial.check("impulse", impulse / np.clip(impulse, momentum, 2 * momentum) - 1, FORCE)


def through(passes: float, trial: Trial) -> None:
    """A block flies at a thin held plate, by a part of its thickness or by several in a step: it must not come out behind."""
    thickness, h, dt = 0.2, 0.1, 1e-2
    speed = passes * thickness / dt
    E = RHO * (speed / 0.3) ** 2
    boxes = [Box((-1.0, -thickness), (1.0, 0.0), (20, 2), E), Box((-0.43, 0.05), (0.43, 0.85), (8, 8), E)]
    scene = BoxScene(boxes, nu=0.0)
    for end in (0, 1):
        scene.hold(scene.side(0, 0, end))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    v = fem.Function(scene.V)
    v.x.array.reshape(-1, 2)[scene.nodes_of(1), 1] = -speed
    dynamics = uem.Dynamics(uem.consistent_mass(scene.V, RHO), velocity=v)
    problem = trial.create(scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts, dynamics=dynamics)
    motion = Motion(problem, scene)
    block, plate = scene.nodes(scene.side(1, 1, 0)), scene.nodes(scene.side(0, 1, 1, lambda x: np.abs(x[:, 0]) < 0.45))
    y = scene.V.tabulate_dof_coordinates()[:, 1]
    for _ in trial.time_steps(problem, dt, 4 * dt / min(1.0, passes), EVENT):
        trial.check("energy gained", max(0.0, motion.gained()), FORCE)
        trial.check("overlap", overlap(scene, h), OVERLAP)
        now = y + scene.u.x.array.reshape(-1, 2)[:, 1]
        # both vibrate, and what is above what node by node is the overlap's matter
        sums = [(now[nodes].sum(), len(nodes)) for nodes in (block, plate)]
        (above, n), (below, m) = np.sum(COMM.allgather(sums), axis=0)
        trial.check("block behind the plate", min(0.0, above / n - below / m) / h, 0.5)


def pushed(thickness: float, trial: Trial) -> None:
    """A block is pushed by 0.7 through a thin held plate in one load step, whose whole boundary is the target: as in 20 steps."""
    h, forces = 0.08, []
    for steps in (20, 1):
        boxes = [Box((-1.0, -thickness), (1.0, 0.0), (20, 1)), Box((-0.2, 0.05), (0.2, 0.35), (5, 3), 10.0)]
        scene = BoxScene(boxes)
        for end in (0, 1):
            scene.hold(scene.side(0, 0, end))
        scene.hold(top := scene.side(1, 1, 1), value=(0.0, -0.7))
        sides = [scene.side(0, axis, end) for axis in (0, 1) for end in (0, 1)]
        whole = replace(sides[0], name="plate", entities=np.unique(np.concatenate([side.entities for side in sides])))
        scene.unite(scene.side(1, 1, 0), whole)
        problem = trial.create(scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts)
        # steps that are cut are the subject of this case
        trial.iterations += sum(step.newton_iterations for step in uem.load_steps(problem, steps))
        forces.append(scene.reaction(top)[1])
    trial.check("force in one step over that in many", forces[1] / forces[0] - 1, FORCE)
    trial.check("overlap", overlap(scene, h), OVERLAP)


def block_on_rod(ratio: float, trial: Trial) -> None:
    """A block lands on a rod that stands on the ground, its face the contactor: mass and stiffness are ``ratio`` times the rod's.

    Until the first wave is back the stress is that of two half-spaces, by their impedances. Both swell sideways, edge above edge.
    """
    n, w, nu = 20, 0.1, 0.3
    dt = h = 1 / n
    speed = 1e-3 * V0
    gap = 0.3 * speed * dt
    # waves run along both at speed 1
    E = RHO * (1 - nu**2)
    boxes = [Box((0.0, -1.0), (w, 0.0), (2, n), E), Box((0.0, gap), (w, gap + 1.0), (3, n), ratio * E)]
    scene = BoxScene(boxes, nu=nu)
    scene.hold(scene.side(0, 1, 0))
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    v = fem.Function(scene.V)
    v.x.array.reshape(-1, 2)[scene.nodes_of(1), 1] = -speed
    dynamics = uem.Dynamics(uem.consistent_mass(scene.V, scene.E / (1 - nu**2)), velocity=v)
    problem = trial.create(scene.F, scene.u, scene.moduli, h, bcs=scene.bcs, contacts=scene.contacts, dynamics=dynamics)
    motion = Motion(problem, scene)
    momentum = forms.form(ratio * RHO * dynamics.velocity[1] * scene.part(1))
    start, touch, echo = forms.assemble_scalar(momentum, COMM), gap / speed, 2.0
    stress = speed * RHO * ratio / (1 + ratio)
    impulses = []
    for step in trial.time_steps(problem, dt, touch + 3 * echo, EVENT):
        trial.check("energy gained", max(0.0, motion.gained()), FORCE)
        since = step.time - touch
        if 0.5 * echo < since < 0.9 * echo:
            impulses.append((forms.assemble_scalar(momentum, COMM) - start) / (stress * w * since))
        if step.number % LOOK == 0:
            trial.check("overlap", overlap(scene, h), OVERLAP)
    trial.check("impulse", np.mean(impulses) - 1, WAVES)


CASES = [
    *(
        Case(f"{c:g} CFL", "a bar hits a rigid wall", partial(bar_on_wall, c, EVENT), quick=c >= 1, moving=True)
        for c in (0.01, 0.1, 1.0, 10.0, 100.0)
    ),
    Case("100 CFL no events", "touches are not looked for within steps", partial(bar_on_wall, 100.0, None), moving=True),
    *(
        Case(f"{p:g} thickness a step", "a block flies at a thin plate", partial(through, p), quick=p == 1, moving=True)
        for p in (0.1, 1.0, 10.0)
    ),
    *(
        Case(
            f"pushed through {t:g}", "a block is pushed through a thin plate in one load step", partial(pushed, t), quick=t == 0.1
        )
        for t in (0.02, 0.1)
    ),
    *(
        Case(f"block {r:g}", "a block lands on a rod, face on face", partial(block_on_rod, r), quick=r < 10, moving=True)
        for r in (1.5, 1e3)
    ),
]
