"""A step after an attempt that failed is the step without it, to the last bits, whatever contacts and solvers remember.

Two tests to read first: ``test_a_failed_attempt_leaves_nothing``, ``test_factors_and_preconditioners_come_back``.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from contact_on_block import DIRECT
from driven_scenes import QUICK, SCENES, WAY
from friction_scenes import driven
from helpers import highest, linear, slow, st_venant
from ramp_scenes import COMM, RAMPS

import uem_dolfinx as uem
from uem_dolfinx.algebra.condensed import Condensed
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import has_hypre

pytestmark = pytest.mark.every_case

#: Where attempts lead that are refused: after two iterations, or as converged ones.
FAR = (0.7, -0.4)


def alike(own, whole):
    """Values are the same to the last bits; MUMPS adds in the order in which messages of other ranks come."""
    scale = highest(COMM, np.abs(whole))
    assert highest(COMM, np.abs(own - whole)) <= (0.0 if COMM.size == 1 else 1e-11) * scale


def led(make, failing, way=WAY, made=()):
    """Lead a scene along a way, each step after an attempt that fails or not: residuals, displacements, forces and set-ups of the steps."""
    problem, top = make()
    found, most = [], problem.max_iterations
    g = problem.config.gdim

    def lead(place):
        there = [place[0], *[0.0] * (g - 2), place[1]]
        top.x.array[:] = np.tile(there, len(top.x.array) // g)

    for place in way:
        if failing:
            lead(FAR)
            problem.max_iterations = 2
            # so far off the bodies' tangent may be indefinite, of which multigrid makes no preconditioner
            with suppress(uem.ConvergenceError, uem.LinearSolveError):
                problem.attempt()
                problem.restore()
            problem.max_iterations = most
        before = len(made)
        lead(place)
        norms = [one.residual for one in problem.solve()]
        active, forces = sum(c.n_active for c in problem.contacts), sum(c.force.x.array for c in problem.contacts)
        found.append((norms, active, np.array(problem.u.x.array), np.array(forces), len(made) - before))
    return found


@pytest.mark.long
@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in SCENES])
def test_a_failed_attempt_leaves_nothing(name):
    """Lists, segments, anchors, facets, limits and whatever else an attempt changes come back: the next step starts from the last one."""
    for alone, after in zip(led(SCENES[name], False), led(SCENES[name], True)):
        # where equilibrium is near, residuals are rounding
        assert len(after[0]) == len(alone[0]) and after[1] == alone[1]
        assert np.allclose(after[0], alone[0], rtol=1e-9, atol=1e-9)
        alike(after[2], alone[2])
        alike(after[3], alone[3])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "cell", "mu", "law"),
    [
        ("factor", "quadrilateral", 0.3, linear), slow("factor", "quadrilateral", None, linear),
        slow("factor", "tetrahedron", 0.3, linear), slow("factor", "tetrahedron", None, st_venant),
        slow("condensed", "tetrahedron", 0.3, linear), slow("modified", "quadrilateral", 0.3, st_venant),
        slow("hypre", "tetrahedron", None, linear), slow("hypre", "tetrahedron", 0.3, linear),
        slow("hypre", "tetrahedron", 0.3, st_venant), slow("hypre", "quadrilateral", 0.3, linear),
        slow("gamg", "quadrilateral", 0.3, linear),
    ],
)  # fmt: skip
def test_factors_and_preconditioners_come_back(solver, cell, mu, law, monkeypatch):
    """Whatever the attempt has made anew: the next step takes as many set-ups as without it."""
    if solver == "hypre" and not has_hypre():
        pytest.skip("PETSc was built without hypre")
    if solver == "factor":
        monkeypatch.setattr(Condensed, "_is_cheaper", lambda *_: False)
    made, set_up = [], UnitedSolver._set_up
    monkeypatch.setattr(UnitedSolver, "_set_up", lambda self, **options: made.append(set_up(self, **options)))
    options = {"ksp_type": "cg", **uem.multigrid_options(solver)} if solver in ("hypre", "gamg") else DIRECT
    how = {"petsc_options": options} | ({"newton": "modified", "max_iterations": 200} if solver == "modified" else {})

    def run(failing):
        scene = driven(cell, mu, law=law, n=(6, 9) if cell == "quadrilateral" else (2, 3), options=how)
        steps = led(lambda: (scene.problem, scene.top), failing, [*WAY, (0.215, -0.04)], made)
        return steps, [scene.blocks.scene.gather(f) for f in (scene.problem.u, scene.contact.force)]

    (alone, fields), (after, others) = run(False), run(True)
    for own, whole in zip(others, fields):
        # meshes of two runs may be divided among ranks in different ways
        assert np.abs(own - whole).max() <= (0.0 if COMM.size == 1 else 1e-6) * np.abs(whole).max()
    if COMM.size == 1:
        for one, other in zip(alone, after):
            assert one[0] == other[0] and one[4] == other[4]
            assert (one[2] == other[2]).all() and (one[3] == other[3]).all()


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
