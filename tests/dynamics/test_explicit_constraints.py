"""Central differences with ties and linear equations, for nodes that keep their mass.

Read first: ``test_a_wave_through_a_tie``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
C = 30.0


def bars(coupling="node_to_surface", tied=True, equations=lambda s: (), contactors="massy", couplings=lambda s: ()):
    """Two bars in line, of 20 and 14 cells, at rest and in flight; the problem, its book of energies, the tie and the scene."""
    shapes = [box("quadrilateral", [0.0, y], [1.0, y + 5.0], [wide, n]) for y, wide, n in ((0.0, 2, 20), (5.0, 1, 14))]
    s = scene(COMM, "quadrilateral", shapes)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    upper = V.tabulate_dof_coordinates()[:, 1] > 5.0 + 1e-9
    velocity.x.array.reshape(-1, 2)[upper, 1] = -1.0
    law = uem.LinearElastic(C**2, 0.0, kind="plane_stress")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors=contactors)
    tie = uem.Contact(s.tag("top", 0, at(1, 5.0)), s.tag("bottom", 1, at(1, 5.0)), coupling=coupling, tied=tied)
    problem = uem.UnitedProblem(
        law.residual(u, v) * ufl.dx, u, contacts=[tie] if tied else [], equations=list(equations(s)), couplings=list(couplings(s)),
        dynamics=dynamics, rtol=1e-11,
    )  # fmt: skip
    return problem, uem.EnergyBook(problem, law.energy(u) * ufl.dx), tie, s


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_wave_through_a_tie(coupling):
    """A moving bar tied to one at rest: momentum to rounding, the surfaces together, both as fast after the wave has been to and fro."""
    problem, book, tie, s = bars(coupling)
    u, touching = problem.u, 0.0
    top, bottom = s.tag("top", 0, at(1, 5.0)), s.tag("bottom", 1, at(1, 5.0))
    fast = []
    for step in uem.time_steps(problem, end=4 * 10.0 / C):
        row = book.write(step)
        apart = uem.integrate(u[1] * uem.ds(bottom)) - uem.integrate(u[1] * uem.ds(top))
        touching = max(touching, abs(apart))
        if step.time > 2 * 10.0 / C:
            fast.append(row.kinetic)
    momenta = np.array(book.momenta)[:, 1]
    assert np.abs(momenta / momenta[0] - 1).max() < 1e-9
    assert touching < 1e-9
    first = book.rows[0].kinetic
    assert all(abs((row.kinetic + row.stored) / first - 1.0) < 0.01 for row in book.rows)
    # half of the energy is that of the common motion, and half of the rest is kinetic in the mean
    assert abs(np.mean(fast) / first - 0.75) < 0.05


def test_led_in_the_mean():
    """A bar whose foot is led in its mean: exactly, as it is told."""
    lead = lambda s: [uem.MeanMotion(s.tag("foot", 0, at(1, 0.0)), (0, 1), b=lambda t: 0.3 * t**2)]  # noqa: E731
    problem, _, _, s = bars(equations=lead)
    foot = s.tag("foot", 0, at(1, 0.0))
    for step in uem.time_steps(problem, end=0.2):
        assert uem.integrate(problem.u[1] * uem.ds(foot)) == pytest.approx(0.3 * step.time**2, abs=1e-12)


def test_what_is_refused():
    """Massless surfaces, and rigid parts."""
    refused(uem.InputError, ("tied", "massy"), lambda: bars(contactors="massless"))
    lead = lambda s: [uem.MeanMotion(s.tag("foot", 0, at(1, 0.0)), (0, 1))]  # noqa: E731
    refused(uem.InputError, ("equations", "massy"), lambda: bars(tied=False, equations=lead, contactors="massless"))
    rigid = lambda s: [uem.RigidCoupling(s.tag("foot", 0, at(1, 0.0)), (0.5, 0.0))]  # noqa: E731
    refused(uem.InputError, "couplings does not go", lambda: bars(couplings=rigid))
