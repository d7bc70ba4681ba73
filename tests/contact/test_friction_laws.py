"""Laws of friction as functions of arrays, limits of Coulomb's, and friction that follows the load factor or the time.

Read first: ``test_friction_follows_the_load``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem, mesh
from helpers import at, box, linear, raised, scene, slow
from restart_scenes import continues_alike

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.laws.law import follows_load

COMM = MPI.COMM_WORLD
COUPLINGS = ["node_to_surface", "mortar"]


class Dragged:
    """A block that is pressed onto a rigid floor by the first load step of four, and dragged along it by the others."""

    def __init__(self, friction, *, coupling="node_to_surface", cell="quadrilateral", size=1.0, points=False):
        g = 3 if cell in ("hexahedron", "tetrahedron") else 2
        s = scene(COMM, cell, [box(cell, [0.0] * g, [size] * g, [2] * g)])
        self.V = compat.function_space(s.mesh, 1, (g,))
        self.u, place = fem.Function(self.V), fem.Constant(s.mesh, np.zeros(g))
        low, top = s.tag("low", 0, at(g - 1, 0.0)), s.tag("top", 0, at(g - 1, size))
        if points:
            corners = mesh.locate_entities(s.mesh, 0, lambda x: np.isclose(x[g - 1], 0.0))
            low = uem.Tag("corners", 1, 0, s.mesh, corners.astype(np.int32))
        floor = uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0])
        self.contact = uem.Contact(low, floor, friction=friction, coupling=coupling, name="sole")

        def load(t):
            place.value[:] = [0.05 * size * max(t - 0.25, 0.0), *[0.0] * (g - 2), -0.01 * size * min(4.0 * t, 1.0)]

        lid = fem.dirichletbc(place, fem.locate_dofs_topological(self.V, g - 1, top.entities), self.V)
        self.problem = uem.UnitedProblem(linear(self.u, 1.0, 0.0), self.u, bcs=[lid], contacts=[self.contact], load=load)

    def run(self, **how):
        """Forces at the end of each step ``(n, gdim)``."""
        return np.array([self.contact.resultant().force for _ in uem.load_steps(self.problem, 4, **how)])


LAWS = {
    "Coulomb": uem.Coulomb(0.3),
    "stress": uem.Coulomb(0.3, limit=2.0),
    "force": uem.Coulomb(0.3, force=0.5),
    "Tresca": uem.Tresca(2.0),
    "Thirion": uem.Thirion(0.3, 2.0),
    "stiction": uem.Stribeck(0.3, 0.2),
    "Stribeck": uem.Stribeck(0.3, 0.2, 0.5, viscous=0.1),
    "growing": uem.Stribeck(0.2, 0.4, 0.5),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_derivatives_of_laws(law):
    """With the force along the normal and with the speed, against central differences."""
    rng, h = np.random.default_rng(3), 1e-6
    lam, area, speed = rng.uniform(0.2, 4.0, 40), rng.uniform(0.1, 0.4, 40), rng.uniform(0.1, 2.0, 40)
    value = np.full(40, law.field)
    difference = (law.limit(value, lam + h, area)[0] - law.limit(value, lam - h, area)[0]) / (2 * h)
    np.testing.assert_allclose(law.limit(value, lam, area)[1], difference, atol=1e-8)
    if not isinstance(law, uem.Stribeck):
        return
    force, slope, rate = law.sliding(value, lam, area, speed)
    by_lam = (law.sliding(value, lam + h, area, speed)[0] - law.sliding(value, lam - h, area, speed)[0]) / (2 * h)
    by_speed = (law.sliding(value, lam, area, speed + h)[0] - law.sliding(value, lam, area, speed - h)[0]) / (2 * h)
    np.testing.assert_allclose(slope, by_lam, atol=1e-8)
    np.testing.assert_allclose(rate, by_speed, atol=1e-8)
    assert (force > 0).all()


def test_values_of_stribecks_law():
    """Static at rest, kinetic far beyond, and with zero velocity as soon as anything slips."""
    one, area = np.ones(3), np.zeros(3)
    law = uem.Stribeck(0.5, 0.2, 0.1, viscous=0.01)
    mu = law.sliding(0.5 * one, one, area, np.array([0.0, 0.1, 100.0]))[0]
    np.testing.assert_allclose(mu, [0.5, 0.2 + 0.3 / np.e + 0.001, 0.2 + 1.0], rtol=1e-14)
    assert law.timed and not uem.Stribeck(0.5, 0.2).timed
    assert uem.Stribeck(0.5, 0.2).sliding(0.5 * one, one, area, 0.0 * one)[0] == pytest.approx(0.2 * one)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_limits_of_coulombs_law(coupling):
    """Stress: friction of the whole face is ``min(mu N, limit A)``. Force: that of n points is ``n min(mu lam, force)``."""
    for limit in (1e-3, 1e-2):
        last = Dragged(uem.Coulomb(0.3, limit=limit), coupling=coupling, size=2.0).run()[-1]
        assert -last[0] == pytest.approx(min(0.3 * last[1], limit * 2.0), rel=1e-9)
    for force in (1e-4, 1.0):
        points = Dragged(uem.Coulomb(0.3, force=force), points=True)
        last, lam = points.run()[-1], points.contact.pair.trial.lam
        exact = COMM.allreduce(np.minimum(0.3 * lam, force).sum())
        assert -last[0] == pytest.approx(exact, rel=1e-9) and exact <= 3 * force
    raised(uem.InputError, "contact 'sole': a limit of the force", lambda: Dragged(uem.Coulomb(0.3, force=1.0)))
    raised(uem.InputError, "contact 'sole': Coulomb needs areas", lambda: Dragged(uem.Coulomb(0.3, limit=1.0), points=True))
    raised(uem.InputError, "give one of them", lambda: uem.Coulomb(0.3, limit=1.0, force=1.0))


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_coefficient_by_the_pressure(coupling, cell):
    """Where contactors slip the force on each is ``mu p A / (1 + mu p / stress)``; the limits are Coulomb's and Tresca's laws."""
    stress = 2e-3
    block = Dragged(uem.Thirion(0.3, stress), coupling=coupling, cell=cell)
    last, contact = block.run()[-1], block.contact
    lam, tangential = contact.pressing()
    area, borne = contact.measured_areas(), np.linalg.norm(tangential, axis=1)
    expected = 0.3 * lam / (1.0 + 0.3 * lam / np.where(area > 0.0, stress * area, 1.0))
    assert contact.pair.friction.slipping(contact.pair.trial).all()
    assert borne == pytest.approx(expected, rel=1e-9, abs=1e-15)
    # at this pressure by more than half
    assert 0.0 < -last[0] < 0.5 * 0.3 * last[-1] and contact.dissipation > 0.0
    for law, limit in ((uem.Thirion(0.3, 1e6), 0.3), (uem.Thirion(1e9, stress), uem.Tresca(stress))):
        ends = [Dragged(one, coupling=coupling, cell=cell).run()[-1] for one in (law, limit)]
        np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-6 * np.abs(ends[1]).max())


def test_thirion_is_refused():
    """A stress that is not positive, and points, which have no area."""
    raised(uem.InputError, "stress", lambda: uem.Thirion(0.3, 0.0))
    raised(uem.InputError, "contact 'sole': Thirion needs areas", lambda: Dragged(uem.Thirion(0.3, 1.0), points=True))


def test_stiction_in_statics():
    """A block that is dragged in steps slips at the kinetic coefficient once the static one is reached."""
    forces = Dragged(uem.Stribeck(0.5, 0.2)).run()
    assert -forces[-1, 0] == pytest.approx(0.2 * forces[-1, 1], rel=1e-9)
    held = Dragged(uem.Stribeck(10.0, 0.2)).run()
    stuck = Dragged(10.0).run()
    np.testing.assert_allclose(held, stuck, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("coupling", "cell"), [*((c, "quadrilateral") for c in COUPLINGS), ("node_to_surface", "hexahedron")])
def test_friction_follows_the_load(coupling, cell):
    """Coefficients of place and load factor: each step's force is that of the factor that it ends at, zero before friction starts."""
    dragged = Dragged(lambda x, t: np.where(x[0] > -1.0, 0.2 * max(t - 0.5, 0.0), 0.0), coupling=coupling, cell=cell)
    forces = dragged.run()
    np.testing.assert_allclose(-forces[:, 0], 0.2 * np.array([0.0, 0.0, 0.25, 0.5]) * forces[:, -1], rtol=1e-9, atol=1e-14)
    assert dragged.contact.dissipation > 0
    # a number for all of it
    limited = Dragged(uem.Coulomb(lambda x, t: 0.2 * t, limit=1e-3), coupling=coupling, cell=cell).run()
    exact = np.minimum(0.2 * np.array([0.25, 0.5, 0.75, 1.0]) * limited[:, -1], 1e-3)
    assert -limited[2:, 0] == pytest.approx(exact[2:], rel=1e-9)


def test_which_functions_follow_the_load():
    """Those of two arguments that have no default."""
    found = [follows_load(uem.Coulomb(f)) for f in (0.3, lambda x: x[0], lambda x, t: x[0], lambda x, mu=0.3: mu * x[0], np.sum)]
    assert found == [False, False, True, False, False]
    bad = Dragged(lambda x, t: np.array([-1.0 if t > 0.5 else 0.1] * x.shape[1]))
    raised(uem.InputError, r"contact 'sole': friction\(x, 0.75\)", bad.run)
    raised(
        uem.InputError,
        "arc_length controls loads only, but friction of contact 'sole'",
        lambda: Dragged(lambda x, t: t).run(arc_length=True),
    )


def test_friction_that_follows_the_load_continues_from_a_checkpoint(folder):
    """Where it begins with zero, too: what slips continues slipping."""

    def friction(x, t):
        return 0.2 * max(t - 0.25, 0.0)

    whole, first, last = (Dragged(friction) for _ in range(3))
    whole.run(checkpoint=uem.Checkpoint(folder / "whole", every=1))
    for step in uem.load_steps(first.problem, 4, checkpoint=uem.Checkpoint(folder / "run", every=1)):
        if step.number == 2:
            break
    found = last.run(checkpoint=uem.Checkpoint(folder / "run", every=1))
    assert len(found) == 2
    continues_alike(last.u.x.array, whole.u.x.array)
    continues_alike(last.contact.slip.x.array, whole.contact.slip.x.array)


def test_a_step_that_is_taken_again_has_its_friction():
    """Friction that follows the load is that of the step, however often it is taken."""
    once, twice = Dragged(lambda x, t: 0.2 * t), Dragged(lambda x, t: 0.2 * t)
    expected = once.run()[-1]
    for _ in uem.load_steps(twice.problem, 4):
        twice.problem.solve()
        twice.problem.solve()
    np.testing.assert_allclose(twice.contact.resultant().force, expected, rtol=1e-12)
    assert twice.contact.dissipation == pytest.approx(once.contact.dissipation, rel=1e-12)
