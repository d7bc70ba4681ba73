"""A step after an attempt that failed is the step without it, to the last bits, whatever contacts remember.

The test to read first: ``test_a_failed_attempt_leaves_nothing``.
"""

from __future__ import annotations

import numpy as np
import pytest
from friction_scenes import driven
from helpers import clamp, highest, modulus, slow, st_venant
from ramp_scenes import COMM, RAMPS

import uem_dolfinx as uem

pytestmark = pytest.mark.every_case

#: Where the block's top goes, in steps.
WAY = [(0.0, -0.03), (0.07, -0.05), (0.16, -0.05), (0.21, -0.04)]
#: Where no attempt of two iterations comes to.
FAR = (0.7, -0.4)
MORTAR = {"coupling": "mortar"}


def general(**how):
    """The driven block, with all surfaces declared at once."""

    def make():
        scene = driven(mu=None, law=st_venant, n=(3, 5))
        b = scene.blocks
        contact = uem.GeneralContact(**how)
        top = scene.top
        held = [*clamp(b.V, b.bottom), *scene.problem.bodies.bcs[-1:]]
        problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=held, contacts=[contact])
        return problem, top

    return make


def hand(mu=0.3, cell="quadrilateral", rigid=False, degree=1, **how):
    """The driven block, with one contact."""

    def make():
        n = (3, 5) if cell in ("triangle", "quadrilateral") else (2, 3)
        scene = driven(cell, mu, law=st_venant, n=n, rigid=rigid, degree=degree, how=how)
        return scene.problem, scene.top

    return make


SCENES = {
    "without friction": hand(None),
    "friction": hand(),
    "degree 2": hand(degree=2),
    "Tresca": hand(uem.Tresca(0.02)),
    "averaged normals": hand(normals="averaged"),
    "small sliding": hand(sliding="small"),
    "mortar": hand(None, **MORTAR),
    "mortar with friction": hand(**MORTAR),
    "mortar, small sliding": hand(None, sliding="small", **MORTAR),
    "rigid target": hand(rigid=True),
    "wear": hand(wear=0.02),
    "offset": hand(offset=0.004),
    "tetrahedra": hand(cell="tetrahedron"),
    "general": general(friction=0.2),
    "general, mortar": general(friction=0.2, **MORTAR),
    "general, itself": general(self_contact=True),
}


def alike(own, whole):
    """Values are the same to the last bits; MUMPS adds in the order in which messages of other ranks come."""
    scale = highest(COMM, np.abs(whole))
    assert highest(COMM, np.abs(own - whole)) <= (1e-14 if COMM.size == 1 else 1e-11) * scale


#: Those that are always tested.
QUICK = {"friction", "mortar with friction", "wear", "general"}


def led(make, failing):
    """Lead a scene along ``WAY``, each step after an attempt that fails or not: residuals, displacements and forces of the steps."""
    problem, top = make()
    found, most = [], problem.max_iterations
    g = problem.config.gdim

    def to(place):
        there = [place[0], *[0.0] * (g - 2), place[1]]
        top.x.array[:] = np.tile(there, len(top.x.array) // g)
        return problem.solve()

    for place in WAY:
        if failing:
            problem.max_iterations = 2
            with pytest.raises(uem.ConvergenceError):
                to(FAR)
            problem.max_iterations = most
        norms = [one.residual for one in to(place)]
        active, forces = sum(c.n_active for c in problem.contacts), sum(c.force.x.array for c in problem.contacts)
        found.append((norms, active, np.array(problem.u.x.array), np.array(forces)))
    return found


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in SCENES])
def test_a_failed_attempt_leaves_nothing(name):
    """Lists, segments, anchors, facets, limits and whatever else an attempt changes come back: the next step starts from the last one."""
    for alone, after in zip(led(SCENES[name], False), led(SCENES[name], True)):
        # where equilibrium is near, residuals are rounding
        assert len(after[0]) == len(alone[0]) and after[1] == alone[1]
        assert np.allclose(after[0], alone[0], rtol=1e-9, atol=1e-9)
        alike(after[2], alone[2])
        alike(after[3], alone[3])


@pytest.mark.parametrize("name", [slow(name) for name in RAMPS if name != "sliding"])
def test_a_failed_solve_before_load_steps_leaves_nothing(name):
    """Likewise of load steps with laws that remember and with ramps, which begin after a solve that failed."""
    ends = []
    for failing in (False, True):
        scene = RAMPS[name](COMM)
        problem, steps = scene.problem, []
        for prepare, n in scene.calls:
            prepare()
            if failing:
                most, problem.max_iterations = problem.max_iterations, 1
                with pytest.raises(uem.ConvergenceError):
                    problem.solve()
                problem.max_iterations = most
            steps += [(s.factor, s.newton_iterations, s.cuts) for s in uem.load_steps(problem, n)]
        ends.append((steps, np.array(problem.u.x.array)))
    assert ends[0][0] == ends[1][0]
    alike(ends[1][1], ends[0][1])
