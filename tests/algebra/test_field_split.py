"""Displacement and pressure by GMRES, with multigrid on the displacement alone: the answer of MUMPS, in whatever units.

Read first: ``test_the_answer_of_mumps``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from field_scenes import fields, with_pressure
from helpers import blocks, highest, run, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


class Pressed:
    """A block of displacements and pressures, pressed onto another and pushed sideways; ``most`` is what a linear solve has taken."""

    def __init__(self, nu, options, *, cell="triangle", E=1.0, size=1.0, displacement=0, push=0.0, **how):
        n = 3 if cell == "triangle" else 2
        b = blocks(COMM, cell, n, n + 1, degree=2, pose=lambda x: size * x)
        f = fields(b, 2, 1, displacement=displacement)
        g = b.gdim
        bcs = [uem.dirichlet(f.space, b.bottom, c) for c in range(g)]
        bcs += [uem.dirichlet(f.space, b.top, c, size * value) for c, value in zip(range(g), [push, *[0.0] * (g - 2), -0.05])]
        # one form for all of them
        numbers = [fem.Constant(b.scene.mesh, float(value)) for value in (E, nu)]
        c = uem.Contact(b.high, b.low, **how)
        of = {"displacement": displacement, "bcs": bcs, "contacts": [c], "petsc_options": options}
        self.problem = uem.UnitedProblem(with_pressure(f, *numbers), f.w, rtol=1e-10, **of)
        solver, self.most = self.problem.solver, 0
        solve = solver.solve

        def counting(*args):
            found, iterations = solve(*args)
            self.most = max(self.most, iterations)
            return found, iterations

        solver.solve = counting
        (self.step,) = run(self.problem)
        parts = self.problem.config.functions()
        #: Displacement and pressure, without units.
        self.found = parts["displacement"].x.array / size, parts[f"field_{1 - displacement}"].x.array / E

    def differs(self, other):
        """Largest difference of either field from another's, over its largest value."""
        return max(
            highest(COMM, np.abs(mine - theirs)) / highest(COMM, np.abs(theirs)) for mine, theirs in zip(self.found, other.found)
        )


@pytest.mark.parametrize(
    ("nu", "amg", "how"),
    [
        (0.3, "", {}), (0.49999, "gamg", {"friction": 0.1, "push": 0.03}), slow(0.49999, "gamg", {"displacement": 1}),
        slow(0.49999, "", {"friction": 0.1, "push": 0.03}), slow(0.5, "", {"coupling": "mortar"}),
        slow(0.49999, "gamg", {"friction": 0.1, "push": 0.03, "coupling": "mortar"}),
        slow(0.49999, "", {"cell": "tetrahedron"}), slow(0.3, "gamg", {"cell": "tetrahedron"}),
    ],
)  # fmt: skip
def test_the_answer_of_mumps(nu, amg, how):
    """To 1e-8, in a bounded number of iterations whatever Poisson's ratio is, and while contactors slip."""
    field = 1 - how.get("displacement", 0)
    split, direct = Pressed(nu, uem.saddle_options(field, amg), **how), Pressed(nu, None, **how)
    assert split.differs(direct) < 1e-8
    assert 10 < split.most < 70


def test_units_do_not_count():
    """Newtons and nanometres take the iterations that numbers near one take."""
    one = Pressed(0.49999, uem.saddle_options())
    other = Pressed(0.49999, uem.saddle_options(), E=2.1e11, size=1e-9)
    assert abs(other.most - one.most) <= 2 and other.step.newton_iterations == one.step.newton_iterations
    assert other.differs(one) < 1e-9
