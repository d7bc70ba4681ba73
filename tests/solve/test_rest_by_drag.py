"""Bodies that rest in a polygonal bowl: rigid motions and Newton's method in turn go round, and a decaying drag brings them to rest.

The test to read first is ``test_a_block_rests_in_a_polygonal_bowl``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks import cases, cases_touching
from block_scenes import arch, blocks, st_venant
from helpers import clamp, modulus

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.errors import FloatingBodyError

COMM = MPI.COMM_WORLD
LOAD = 0.02


def in_bowl(cell, degree, n_low, gap, size=1.0, **how):
    """A block that falls from a height ``gap`` into a bowl of ``n_low`` facets, which carries its load alone."""
    bowl = arch(-0.3)
    b = blocks(COMM, cell, n_low, 3, degree=degree, gap=gap, overhang=0.5, pose=lambda x: size * bowl(x))
    top = forms.surface_measure(b.scene.mesh, b.top.entities)
    F = st_venant(b.u, modulus(b.scene, 1.0, 2.0)) + LOAD * ufl.TestFunction(b.V)[b.gdim - 1] * top
    contact = uem.Contact(b.high, b.low, max_penetration=size, **how)
    return uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-10), contact


def centre(problem, contact, size):
    """Mean position of the block's lower side on all ranks, over the size."""
    config, nodes = problem.config, contact.pair.nodes
    x = config.X[nodes] + config.displacement[nodes]
    total = COMM.allreduce(np.append(x.sum(axis=0), len(x)))
    return total[:-1] / total[-1] / size


@pytest.mark.parametrize(
    "cell, degree, n_low, how",
    [
        ("triangle", 2, 4, {}), ("quadrilateral", 1, 4, {}), ("triangle", 1, 5, {}), ("triangle", 2, 5, {}),
        ("triangle", 1, 5, {"coupling": "mortar"}), ("quadrilateral", 2, 5, {}),
    ],
)  # fmt: skip
def test_a_block_rests_in_a_polygonal_bowl(cell, degree, n_low, how):
    """It carries its load without a force sideways, in one load step without cuts."""
    gap = 0.1 if n_low == 4 else 0.05
    problem, contact = in_bowl(cell, degree, n_low, gap, **how)
    steps = list(uem.load_steps(problem, 1))
    assert len(steps) == 1 and steps[0].cuts == 0
    assert contact.resultant().force == pytest.approx([0.0, LOAD], abs=1e-8 * LOAD)
    # nothing is left that moves it: the same step again stays where it is
    before = problem.u.x.array.copy()
    problem.solve()
    assert COMM.allreduce(float(np.abs(problem.u.x.array - before).max(initial=0.0)), op=MPI.MAX) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, 2])
def test_a_block_rests_with_averaged_normals(degree):
    """From starts that differ by rounding, in metres and kilometres, a few iterations without drag lead to one place."""
    found = []
    for more, size in ((0.0, 1.0), (7e-9, 1.0), (0.0, 1e3)):
        problem, contact = in_bowl("quadrilateral", degree, 4, 0.1 + more, size, normals="averaged")
        (step,) = uem.load_steps(problem, 1)
        force = contact.resultant().force / size
        assert step.cuts == 0 and step.newton_iterations <= 8 and force == pytest.approx([0.0, LOAD], abs=1e-8 * LOAD)
        found.append(centre(problem, contact, size))
    assert found[1] == pytest.approx(found[0], abs=1e-6) and found[2] == pytest.approx(found[0], abs=1e-6)


@pytest.mark.parametrize("cell, degree", [("quadrilateral", 1), ("triangle", 2)])
def test_the_rest_does_not_depend_on_the_fall_or_the_size(cell, degree):
    """Blocks that fall from two heights, and a thousand times as large, come to one place in the bowl's corners."""
    found = []
    for gap, size in ((0.1, 1.0), (0.15, 1.0), (0.1, 1e3)):
        problem, contact = in_bowl(cell, degree, 4, gap, size)
        list(uem.load_steps(problem, 1))
        found.append(centre(problem, contact, size))
    assert found[1] == pytest.approx(found[0], abs=1e-6) and found[2] == pytest.approx(found[0], abs=1e-6)
    assert found[0][0] == pytest.approx(0.5, abs=1e-6 if cell == "quadrilateral" else 0.01)


def test_nothing_rests_on_a_slope():
    """A block slides down a plane for ever, drag or not; the error is the one without it, and the problem is as before."""
    slope = {"pose": lambda x: x + np.array([0.0, 0.2]) * x[:, :1]}
    b = blocks(COMM, "quadrilateral", 4, 3, gap=0.1, overhang=0.5, **slope)
    top = forms.surface_measure(b.scene.mesh, b.top.entities)
    F = st_venant(b.u, modulus(b.scene, 1.0, 2.0)) + LOAD * ufl.TestFunction(b.V)[1] * top
    contact = uem.Contact(b.high, b.low, max_penetration=1.0)
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    with pytest.raises(FloatingBodyError, match="no contact stops it"):
        list(uem.load_steps(problem, 1))
    assert not problem.u.x.array.any() and problem.bodies.tangent.points is None and problem.system.floating.motions is not None


@pytest.mark.slow
def test_a_body_that_rocks():
    """A round body falls askew and rests on a contactor in a corner between two facets, which holds it both ways across."""
    trial = cases.Trial(cases.COLUMNS[0])
    cases_touching.rocking(trial)
    assert trial.checks and max(check.severity for check in trial.checks) <= 1.0
