"""Impact of bodies of revolution along their axis: a rod's closed form, energies and momenta of whole bodies."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from helpers import slow
from revolved_scenes import Revolved, rectangle

import uem_dolfinx as uem

E, RHO, L, R, V0 = 100.0, 1.0, 2.0, 0.5, 0.1
C = np.sqrt(E / RHO)


@pytest.mark.parametrize(("degree", "lumped", "coupling"), [
    (1, False, "node_to_surface"), slow(1, True, "mortar"), slow(2, False, "node_to_surface"),
])  # fmt: skip
@pytest.mark.slow
def test_rod_on_a_wall(degree, lumped, coupling):
    """A round rod without Poisson's effect: the wall bears rho c v A for 2 L / c, and the rod flies off as fast as it came."""
    s = Revolved(rectangle((0, 0), (R, L), (1, 30 // degree)), degree=degree)
    s.hold_axis()
    law = uem.LinearElastic(E, 0.0, kind="axisymmetric")
    mass = (uem.lumped_mass if lumped else uem.consistent_mass)(s.V, RHO)
    contact = uem.Contact(s.side(1, 0.0), uem.RigidPlane((0, 0), (0, 1)), coupling=coupling)
    dynamics = uem.Dynamics(mass, velocity=(0.0, -V0))
    problem = s.problem(law.residual(s.u, s.v) * ufl.dx, [contact], dynamics=dynamics)
    book, area = uem.EnergyBook(problem, law.energy(s.u) * ufl.dx), np.pi * R**2
    assert dynamics.momentum() == pytest.approx([0.0, -RHO * L * area * V0])
    times, forces = [], []
    for _ in uem.time_steps(problem, dt=L / C / 30, end=2.3 * L / C):
        book.write()
        times.append(dynamics.time * C / L)
        forces.append(contact.resultant().force[1] / (RHO * C * V0 * area))
    t, f = np.array(times), np.array(forces)
    assert f[(t > 0.1) & (t < 1.9)].mean() == pytest.approx(1.0, abs=0.01)
    assert t[f > 0.1].max() == pytest.approx(2.0, abs=0.1)
    first, last = book.rows[0], book.rows[-1]
    assert first.kinetic == pytest.approx(0.5 * RHO * L * area * V0**2)
    assert last.kinetic + last.stored == pytest.approx(first.kinetic, rel=2e-3)
    assert abs(last.defect) < 1e-10 * first.kinetic
    assert dynamics.momentum()[1] == pytest.approx(RHO * L * area * V0, rel=0.06)
    assert book.impulses[-1][0] == pytest.approx(dynamics.momentum() - book.momenta[0], rel=1e-9, abs=1e-12)


@pytest.mark.long
def test_free_fall_and_weight():
    """Gravity along the axis pulls at the whole body, and its kinetic energy is that of the whole body."""
    s = Revolved(rectangle((0, 0), (R, L), (1, 2)))
    law = uem.LinearElastic(E, 0.3, kind="axisymmetric")
    dynamics = uem.Dynamics(uem.consistent_mass(s.V, RHO), gravity=(0.0, -2.0))
    problem = s.problem(law.residual(s.u, s.v) * ufl.dx, dynamics=dynamics)
    for _ in uem.time_steps(problem, dt=0.05, end=0.2):
        pass
    m = RHO * L * np.pi * R**2
    assert dynamics.momentum() == pytest.approx([0.0, -2.0 * 0.2 * m])
    assert dynamics.kinetic_energy() == pytest.approx(0.5 * m * 0.4**2)
