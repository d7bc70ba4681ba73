"""A step after an attempt that failed is the step without it, to the last bits, whatever contacts remember.

The test to read first: ``test_a_failed_attempt_leaves_nothing``.
"""

from __future__ import annotations

import numpy as np
import pytest
from driven_scenes import QUICK, SCENES, WAY
from helpers import highest, slow
from ramp_scenes import COMM, RAMPS

import uem_dolfinx as uem

pytestmark = pytest.mark.every_case

#: Where no attempt of two iterations comes to.
FAR = (0.7, -0.4)


def alike(own, whole):
    """Values are the same to the last bits; MUMPS adds in the order in which messages of other ranks come."""
    scale = highest(COMM, np.abs(whole))
    assert highest(COMM, np.abs(own - whole)) <= (1e-14 if COMM.size == 1 else 1e-11) * scale


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
            steps += [(s.factor, s.newton_iterations, s.cuts) for s in uem.load_steps(problem, n, **scene.how)]
        ends.append((steps, np.array(problem.u.x.array)))
    assert ends[0][0] == ends[1][0]
    alike(ends[1][1], ends[0][1])
