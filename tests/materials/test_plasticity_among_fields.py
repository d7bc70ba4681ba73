"""Plasticity of a displacement among other fields: a temperature that changes nothing, one whose strains make it flow, checkpoints.

The test to read first is ``test_heated_and_cooled_between_walls``.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields
from helpers import at, blocks, highest, refused, run, slow
from plastic_scenes import FY, MU, NU, TABLE, E, H, Masing, block, spread

import uem_dolfinx as uem
from uem_dolfinx.algebra import kept_factor

COMM = MPI.COMM_WORLD


def conduction(T: Any, q: Any) -> ufl.Form:
    return 1e7 * ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx


@pytest.mark.long
def test_heated_and_cooled_between_walls(comm):
    """In plane strain, free in the third direction: the deviator's strain is twice the thermal one, less what the pressure takes."""
    s, _ = block(comm, "quadrilateral")
    W = uem.function_space(s.mesh, [("Lagrange", 1), ("Lagrange", 1, (2,))])
    w, (q, v), heat = fem.Function(W), ufl.TestFunctions(W), fem.Constant(s.mesh, 0.0)
    T, alpha, bulk = ufl.split(w)[0], 1e-5, E / (3 * (1 - 2 * NU))
    material = uem.VonMises(w, E, NU, FY, kinematic_hardening=TABLE, displacement=1, kind="plane_strain")
    F = material.residual(v) - 3 * bulk * alpha * T * ufl.div(v) * ufl.dx + conduction(T, q)
    walls = [s.tag("wall", 0, at(0, x)) for x in (0.0, 1.0)]
    bcs = [uem.dirichlet(W.sub(1), wall, 0) for wall in walls] + [uem.dirichlet(W.sub(0), wall, value=heat) for wall in walls]
    bcs.append(uem.dirichlet(W.sub(1), s.tag("floor", 0, at(1, 0.0)), 1))
    problem = uem.UnitedProblem(F, w, displacement=1, bcs=bcs, materials=[material], rtol=1e-12)
    bar = Masing(TABLE, 1 / (1 / (3 * MU) + 4 / (9 * bulk)))
    for part in (0.5, 10.0, -4.0, 6.0, 30.0):
        heat.value = part * FY / E / alpha
        problem.solve()
        stress = -bar.to(2 * alpha * heat.value)
        mean, scatter = spread(material, "stress")
        # the law's own stress is without the heat's part
        assert mean[[0, 2]] == pytest.approx(stress + 3 * bulk * alpha * heat.value, abs=1e-9 * FY)
        assert scatter < 1e-9 * FY
    assert problem.reaction(walls[1])[0] == pytest.approx(stress, rel=1e-9)


class Pressed:
    """Two blocks that flow under each other's pressure and friction, by themselves or with a temperature."""

    def __init__(self, law: Any, displacement: int | None = None):
        b = blocks(COMM, "quadrilateral", 2, 3, overhang=0.5)
        how = {"kinematic_hardening": [(0.0, 0.0), (0.01, 0.01), (0.1, 0.02)], "kind": "plane_strain"}
        u, space, others = b.u, b.V, []
        v = ufl.TestFunction(b.V)
        if displacement is not None:
            f = fields(b, 1, 1, displacement=displacement)
            u, space, (v, q) = f.w, f.space, f.split(ufl.TestFunction(f.w.function_space))
            others = [uem.dirichlet(f.other, b.bottom, value=300.0), uem.dirichlet(f.other, b.top, value=320.0)]
        self.law = law(u, 1.0, 0.3, 0.02, displacement=displacement, **how)
        F = self.law.residual(v)
        if displacement is not None:
            F += conduction(f.split(u)[1], q)
        bcs = [
            uem.dirichlet(space, tag, c, value)
            for tag, way in ((b.bottom, (0, 0)), (b.top, (0.02, -0.06)))
            for c, value in enumerate(way)
        ]
        self.contact = uem.Contact(b.high, b.low, friction=0.2)
        self.problem = uem.UnitedProblem(
            F, u, displacement=displacement, bcs=bcs + others, contacts=[self.contact], materials=[self.law]
        )

    def compare(self, other: Pressed, bound: float) -> None:
        """Assert that displacement, history and stress are alike to this part."""
        pairs = [(self.problem.config.displacement, other.problem.config.displacement)]
        laws = self.law, other.law
        pairs += [tuple(f.x.array for f in both) for both in zip(*([law.stress, *law.history.values()] for law in laws))]
        for here, there in pairs:
            assert highest(COMM, np.abs(here - there)) <= bound * highest(COMM, np.abs(here))


@pytest.mark.long
@pytest.mark.parametrize(
    "law, displacement", [(uem.VonMises, 0), slow(uem.VonMises, 1), slow(uem.FinitePlasticity, 0), slow(uem.FinitePlasticity, 1)]
)
def test_a_field_that_is_not_coupled_changes_nothing(law, displacement, monkeypatch):
    """Displacement, stress, history and iterations are those of the displacement alone."""
    # an earlier factorisation, which mixed problems do not keep, would leave a part of the right-hand side
    monkeypatch.setattr(kept_factor, "OF_CHANGES", np.nan)
    alone, among = Pressed(law), Pressed(law, displacement)
    steps = [[step.newton_iterations for step in run(one.problem, 2)] for one in (alone, among)]
    assert steps[0] == steps[1]
    alone.compare(among, 1e-13)
    assert alone.law.dissipation() == pytest.approx(among.law.dissipation(), rel=1e-12)
    assert alone.law.dissipation() > 0.2 * alone.law.energy()


def test_going_on_from_a_checkpoint(folder):
    """To the last bit on one rank, but for MUMPS' order of messages on several."""
    straight, again = Pressed(uem.VonMises, 0), Pressed(uem.VonMises, 0)
    for step in uem.load_steps(straight.problem, 3):
        if step.number == 1:
            uem.write_checkpoint(folder / "run.uem", straight.problem.state())
    uem.read_checkpoint(folder / "run.uem", again.problem.state())
    assert len(list(uem.load_steps(again.problem, 3))) == 2
    straight.compare(again, 0.0 if COMM.size == 1 else 1e-11)


def test_which_part_is_the_displacement(comm):
    s, _ = block(comm, "quadrilateral")
    W = uem.function_space(s.mesh, [("Lagrange", 1, (2,)), ("Lagrange", 1)])
    w = fem.Function(W)

    def law(displacement: Any) -> uem.VonMises:
        return uem.VonMises(w, E, NU, FY, H, kind="plane_strain", displacement=displacement)

    refused(uem.SpaceError, "name its part of the mixed space, as displacement=0", lambda: law(None))
    refused(uem.SpaceError, ("displacement = 1", "take displacement=0"), lambda: law(1))
    refused(uem.InputError, "displacement = 2", lambda: law(2))
    other = uem.VonMises(w, E, NU, FY, H, kind="plane_strain", displacement=0)
    other.__dict__["displacement"] = None
    F = other.residual(ufl.TestFunctions(W)[0]) + conduction(w[2], ufl.TestFunctions(W)[1])
    refused(uem.SpaceError, "displacement=None", lambda: uem.UnitedProblem(F, w, displacement=0, materials=[other]))
