"""Friction that follows the temperature at the contactors: a block that slides once it is warm, on meshes and on rigid surfaces.

Read first: ``test_a_block_that_is_warmed_slides``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields, strain, stress
from helpers import blocks, highest, linear, refused, slow
from restart_scenes import continues_alike

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
COLD, HOT, H, K = 20.0, 420.0, 4.0, 2.0


def falling(T):
    """From 0.5 to 0.1 over a hundred degrees."""
    return np.clip(0.5 - 0.004 * (T - COLD), 0.1, 0.5)


def warm(x, t, T):
    """The same at any place and time."""
    return falling(T)


class Warmed:
    """A block that is pressed onto another by the first of three load steps, pushed by the second, and warmed at the top by the last.

    Args:
        mu: of places, load factor and temperatures.
        rigid: whether it lies on a rigid surface that is as cold as the other block's bottom.
        passes: whether heat passes through the contact; else all of the upper block is warmed.
        cell: kind of cells.
        how: of the contact.
    """

    def __init__(self, mu=warm, *, rigid=False, passes=False, cell="triangle", **how):
        b = self.b = blocks(COMM, cell, 3, 3, gap=0.5 if rigid else 0.0, overhang=0.5)
        f = self.f = fields(b, 1, 1)
        (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
        F = (ufl.inner(stress(u, 10.0, 0.0), strain(v)) + K * ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
        g = b.gdim
        down, push, warm = (fem.Constant(b.scene.mesh, 0.0) for _ in range(3))
        bcs = [uem.dirichlet(f.space, b.bottom, c) for c in range(g)]
        bcs += [uem.dirichlet(f.space, b.top, c, value) for c, value in zip(range(g), [push, *[0.0] * (g - 2), down])]
        bcs += [uem.dirichlet(f.other, b.bottom, value=COLD), uem.dirichlet(f.other, b.top, value=warm)]
        if not passes:
            bcs.append(uem.dirichlet(f.other, b.high, value=warm))

        def load(t):
            down.value, push.value = -0.05 * min(3.0 * t, 1.0), 0.04 * min(max(3.0 * t - 1.0, 0.0), 1.0)
            warm.value = COLD + (HOT - COLD) * max(3.0 * t - 2.0, 0.0)

        heat = uem.Conductance(H, field=1, temperature=COLD if rigid else None) if passes else None
        floor = uem.RigidPlane([0.0] * (g - 1) + [0.5], [0.0] * (g - 1) + [1.0]) if rigid else b.low
        how = {"friction": uem.OfTemperature(mu, field=1), "heat": heat, "name": "sole"} | how
        c = self.contact = uem.Contact(b.high, floor, **how)
        self.problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[c], load=load, rtol=1e-10)

    def run(self, **how):
        """Force against the push at the end of each step ``(n,)``."""
        return np.array([-self.contact.resultant().force[0] for _ in uem.load_steps(self.problem, 3, **how)])

    def temperatures(self):
        """Of this rank's contactors and of what they face ``(n,)`` each."""
        c, T = self.contact, self.problem.config.functions()["field_1"]
        own = fem.Function(c.heat_flux.function_space)
        own.interpolate(T)
        return own.x.array[c.nodes], c.opposite(T).x.array[c.nodes]


@pytest.mark.parametrize(
    ("cell", "how"),
    [
        ("triangle", {}), ("triangle", {"passes": True, "coupling": "mortar"}), slow("triangle", {"coupling": "mortar"}),
        slow("triangle", {"passes": True}), slow("tetrahedron", {"passes": True}),
    ],
)  # fmt: skip
def test_a_block_that_is_warmed_slides(cell, how):
    """It sticks cold, although pushed; warm, each contactor bears ``mu(T) lam`` with the mean of both sides' temperatures."""
    scene = Warmed(cell=cell, **how)
    c, steps = scene.contact, []
    for step in uem.load_steps(scene.problem, 3):
        steps.append((c.status.x.array[c.nodes], -c.resultant().force[0], c.resultant().force[-1], step.newton_iterations))
    (_, stuck, _, _), (status, force, N, iterations) = steps[1:]
    own, theirs = scene.temperatures()
    mu, state = falling(0.5 * (own + theirs)), c.pair.committed
    assert highest(COMM, steps[1][0]) == 1.0
    assert highest(COMM, np.abs(np.linalg.norm(state.friction.tau, axis=1) - mu * state.lam)) < 1e-9 * N
    assert set(status) <= {2.0} and force < 0.8 * stuck and iterations < 12
    if not how.get("passes"):
        # the block below is as cold as its bottom
        assert highest(COMM, np.abs(own - HOT) + np.abs(theirs - COLD)) < 1e-9 and highest(COMM, np.abs(mu - 0.1)) == 0.0
    assert c.balance().force < 1e-13 and c.heat_balance() < 1e-13


@pytest.mark.parametrize(
    ("cell", "h"), [("triangle", 20.0), ("quadrilateral", 20.0), ("tetrahedron", 200.0), slow("tetrahedron", 20.0)]
)
def test_a_conductance_by_the_pressure(cell, h):
    """Heat that passes by the pressure, and warms what presses: with friction in as few iterations as without, by exact derivatives."""
    for mu in (0.0, 0.3, 5.0):
        b = blocks(COMM, cell, 3, 3, overhang=0.5)
        f, g = fields(b, 1, 1), b.gdim
        (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
        warmed = stress(u, 10.0, 0.3) - 0.02 * T * ufl.Identity(g)
        F = (ufl.inner(warmed, strain(v)) + K * ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
        bcs = [uem.dirichlet(f.space, b.bottom, c) for c in range(g)]
        bcs += [uem.dirichlet(f.space, b.top, c, value) for c, value in enumerate([0.02, *[0.0] * (g - 2), -0.02])]
        bcs += [uem.dirichlet(f.other, part, value=value) for part, value in ((b.bottom, 0.0), (b.top, 100.0))]
        heat = uem.Conductance(lambda p, gap: h * p + 0.0 * gap, field=1)
        contact = uem.Contact(b.high, b.low, friction=mu, heat=heat)
        (step,) = uem.load_steps(uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[contact], rtol=1e-12), 1)
        assert step.newton_iterations <= 9 and contact.heat_balance() < 1e-12
        if mu == 5.0:
            assert highest(COMM, contact.status.x.array[contact.nodes]) == 1.0


@pytest.mark.parametrize("coupling", ["mortar", slow("node_to_surface")])
def test_a_rigid_surface_is_as_warm_as_the_conductance_says(coupling):
    """Resistances of block and contact in series tell the contactors' temperature; without heat it is theirs alone that counts."""
    flux = (HOT - COLD) / (1 / K + 1 / H)
    for passes, mu in ((True, falling(COLD + 0.5 * flux / H)), (False, 0.1)):
        scene = Warmed(
            rigid=True, passes=passes, coupling=coupling, friction=uem.Coulomb(uem.OfTemperature(warm, field=1), limit=9.0)
        )
        forces, N = scene.run(), scene.contact.resultant().force[1]
        assert 0.1 <= mu < 0.25 and forces[1] > 1.2 * mu * N
        assert abs(forces[2] / (mu * N) - 1.0) < 1e-9 and abs(N - 0.5) < 1e-9


def test_going_on_from_a_checkpoint(folder):
    """Where friction follows place and load factor, too."""

    def mu(x, t, T):
        return (1.5 - t) * falling(T) * (1.0 + x[0])

    whole, first, last = (Warmed(mu, passes=True) for _ in range(3))
    forces = whole.run(checkpoint=uem.Checkpoint(folder / "whole", every=1))
    assert forces[2] < 0.8 * forces[1]
    for step in uem.load_steps(first.problem, 3, checkpoint=uem.Checkpoint(folder / "run", every=1)):
        if step.number == 1:
            break
    assert len(last.run(checkpoint=uem.Checkpoint(folder / "run", every=1))) == 2
    for own, alone in zip(last.f.w.split(), whole.f.w.split()):
        continues_alike(own.collapse().x.array, alone.collapse().x.array)
    continues_alike(last.contact.slip.x.array, whole.contact.slip.x.array)


def test_what_is_refused():
    """Each with what to do instead."""
    refused(uem.InputTypeError, ("f = 0.3", "f(x, t, T)"), lambda: uem.OfTemperature(0.3, field=1))
    refused(uem.InputTypeError, ("field = 'T'", "number of the part"), lambda: uem.OfTemperature(falling, field="T"))
    refused(uem.InputError, ("contact 'sole'", "field = 0", "[1]"), lambda: Warmed(friction=uem.OfTemperature(falling, field=0)))
    refused(uem.InputError, ("contact 'sole'", "friction(x, 0, T)", "positive"), lambda: Warmed(lambda x, t, T: T - 2 * HOT))
    b = blocks(COMM, "triangle", 2, 2)
    plain = uem.Contact(b.high, b.low, friction=uem.OfTemperature(falling, field=1), name="c")
    refused(uem.InputError, ("contact 'c'", "displacement="), lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, contacts=[plain]))
    scene = Warmed()
    scene.problem.load = None
    step = uem.Step(friction={scene.contact: 0.3})
    refused(uem.InputError, ("contact 'sole'", "OfTemperature"), lambda: list(uem.load_steps(scene.problem, [step])))
