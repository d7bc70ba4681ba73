"""Inertia of a displacement among other fields: a pressure of its own changes nothing of a fall, an impact and a slide."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from block_scenes import blocks
from dolfinx import fem
from helpers import at, box, highest, refused, scene, slow

import uem_dolfinx as uem
from uem_dolfinx.algebra.restriction import Restriction

COMM = MPI.COMM_WORLD
E, NU, SPEED = 1000.0, 0.3, 1.0


@dataclass
class Fall:
    """A block that is thrown onto a rough floor: alone, or with its pressure in every cell as an unknown, which comes first or last."""

    pressure: int | None

    def __post_init__(self):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 2.0], [3, 6])])
        V, (mu, lam) = uem.function_space(s.mesh, 1, (2,)), (E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU)))
        if self.pressure is None:
            w = u = fem.Function(V)
            v = ufl.TestFunction(V)
            volumetric, among = lam * ufl.div(u) * ufl.div(v) * ufl.dx(metadata={"quadrature_degree": 0}), {}
        else:
            parts, which = [("Lagrange", 1, (2,)), ("DG", 0)], 1 - self.pressure
            W = uem.function_space(s.mesh, parts if which == 0 else parts[::-1])
            w = fem.Function(W)
            (u, p), (v, q) = ((f[which], f[self.pressure]) for f in (ufl.split(w), ufl.TestFunctions(W)))
            volumetric, among = -p * ufl.div(v) * ufl.dx - q * (ufl.div(u) + p / lam) * ufl.dx, {"displacement": which}
        F = 2 * mu * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx + volumetric
        floor = uem.RigidPlane((0.0, -0.015), (0.0, 1.0))
        self.contact = uem.Contact(s.tag("bottom", 0, at(1, 0.0)), floor, friction=0.2)
        self.dynamics = uem.Dynamics(
            uem.consistent_mass(V, 1.0), velocity=(0.3, -SPEED), gravity=(0.0, -1.0), scheme=uem.generalised_alpha(0.8),
            damping=lambda rate: 0.01 * ufl.inner(ufl.grad(rate), ufl.grad(v)) * ufl.dx,
        )  # fmt: skip
        self.problem = uem.UnitedProblem(F, w, contacts=[self.contact], dynamics=self.dynamics, **among)
        self.book = uem.EnergyBook(self.problem)

    def go(self, end: float, **kept) -> np.ndarray:
        """Times, forces, energies and momenta of the steps to an end."""
        rows = []
        for step in uem.time_steps(self.problem, 0.01, end, **kept):
            book = self.book.write(step)
            works = (book.kinetic, book.damped, book.contact, book.friction)
            rows.append([step.time, *self.contact.resultant().force, *works, *self.book.momenta[-1], len(step.iterations)])
        return np.array(rows)


@pytest.mark.long
@pytest.mark.parametrize("pressure", [0, 1])
def test_a_pressure_that_changes_nothing(pressure):
    """Forces of an impact with friction, works and momenta are those of the same block without it, in as many iterations."""
    alone, among_fields = Fall(None), Fall(pressure)
    a, b = alone.go(0.05), among_fields.go(0.05)
    assert a.shape == b.shape and a[:, 2].max() > 1.0 and a[-1, 1] != 0.0
    assert np.abs(a - b).max() < 1e-11 * np.abs(a).max()
    there, own = among_fields.problem.config.displacement, alone.problem.config.displacement
    assert highest(COMM, np.abs(np.linalg.norm(there, axis=1).sum() - np.linalg.norm(own, axis=1).sum())) < 1e-12


@pytest.mark.long
@pytest.mark.parametrize(
    "how", [{"coupling": "mortar"}, *(slow({"coupling": "node_to_surface", "general": g}) for g in (False, True))], ids=str
)
def test_heat_of_friction_in_time(how):
    """A block that is thrown onto a rough floor has the work of friction in it, however steps are divided; another duration is refused."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 2.0], [3, 6])])
    W = uem.function_space(s.mesh, [("Lagrange", 1, (2,)), ("Lagrange", 1)])
    floor, V = uem.RigidPlane((0.0, -0.015), (0.0, 1.0)), uem.function_space(s.mesh, 1, (2,))

    def slide(follows: bool) -> tuple[float, float, set[float]]:
        w, old, dt, last = fem.Function(W), fem.Function(W), fem.Constant(s.mesh, 0.01), [0.0]
        (u, T), (v, q) = ufl.split(w), ufl.TestFunctions(W)
        F = E * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx
        F += (3.0 * (T - ufl.split(old)[1]) / dt * q + ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
        heat = uem.Conductance(0.0, field=1, temperature=0.0, friction_share=1.0, dt=dt)
        if how.get("general"):
            contact = uem.GeneralContact(rigid=floor, friction=0.2, heat=heat)
        else:
            bottom = s.tag("bottom", 0, at(1, 0.0))
            contact = uem.Contact(bottom, floor, friction=0.2, heat=heat, coupling=how["coupling"])

        def load(t: float) -> None:
            if follows and t > last[0]:
                dt.value = t - last[0]

        dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.3, -SPEED), gravity=(0.0, -1.0))
        problem = uem.UnitedProblem(F, w, displacement=0, contacts=[contact], dynamics=dynamics, load=load, rtol=1e-10)
        book, lengths = uem.EnergyBook(problem), set()
        for step in uem.time_steps(problem, 0.01, 0.06, event_tolerance=0.1):
            last[0], row = step.time, book.write(step)
            lengths.add(round(step.dt, 6))
            old.x.array[:] = w.x.array
        return uem.integrate(3.0 * T * ufl.dx), row.friction, lengths

    inside, work, lengths = slide(True)
    assert len(lengths) > 2 and work > 1e-3
    assert inside == pytest.approx(work, rel=1e-8)
    refused(uem.InputError, ("dt = 0.01", "load"), lambda: slide(False))


def test_going_on_in_time(folder):
    """Read from a checkpoint amid the impact, the run continues to the last bit, on several ranks to rounding."""
    whole, first, last = Fall(1), Fall(1), Fall(1)
    rows = whole.go(0.04)
    first.go(0.02)
    uem.write_checkpoint(folder / "run", first.problem.state())
    uem.read_checkpoint(folder / "run", last.problem.state())
    rest = last.go(0.04)
    # on several ranks MUMPS adds what they send in the order in which it comes
    rounding = 0.0 if COMM.size == 1 else 1e-11
    assert len(rest) == 2
    for one, other in ((rest[:, :4], rows[2:, :4]), (last.problem.u.x.array, whole.problem.u.x.array)):
        assert np.abs(one - other).max() <= rounding * np.abs(other).max()


def test_the_mass_among_other_fields():
    """In the rows of the united system it is the mass of the displacement, and nothing in those of the pressure."""
    fall = Fall(1)
    M, own = fall.dynamics.matrix, fall.dynamics.mass.M
    rows, n = fall.problem.config.unknowns, fall.problem.config.n_owned
    ones, there = np.zeros((rows.n_owned, 2)), own.createVecRight()
    ones[:n], there.array[:] = (1.0, -2.0), np.tile((1.0, -2.0), n)
    product = (M * rows.vector(ones)).array_r
    assert np.array_equal(product[: 2 * n], (own * there).array_r) and not product[2 * n :].any()
    assert isinstance(fall.problem.system.restriction(), Restriction) and M.getSizes() == fall.problem.bodies.tangent.K.getSizes()


def test_heat_that_passes_in_time():
    """Through a conductance that grows with the pressure, between bodies of next to no mass: as in statics, and in balance."""

    def temperatures(in_time: bool) -> np.ndarray:
        b, dt = blocks(COMM, "triangle", 2, 2), 0.05
        W = uem.function_space(b.scene.mesh, [("Lagrange", 1, (2,)), ("Lagrange", 1)])
        w, old = fem.Function(W), fem.Function(W)
        (u, T), (v, q) = ufl.split(w), ufl.TestFunctions(W)
        F = 100.0 * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx
        F += ((T - old[2]) / dt * q + ufl.dot(ufl.grad(T), ufl.grad(q))) * ufl.dx
        bcs = [uem.dirichlet(W.sub(0), tag, c, -0.01 * c * k) for k, tag in enumerate((b.bottom, b.top)) for c in (0, 1)]
        bcs.append(uem.dirichlet(W.sub(1), b.top, value=1.0))
        contact = uem.Contact(b.high, b.low, heat=uem.Conductance(lambda p, g: 1.0 + p, field=1))
        mass = uem.nodal_mass(b.V, lambda X: np.where(np.abs(X[:, 1]) > 0.2, 1e-9, 0.0))
        moves = uem.Dynamics(mass, scheme=uem.generalised_alpha(0.0)) if in_time else None
        problem = uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=[contact], dynamics=moves)
        for _ in uem.time_steps(problem, dt, 3 * dt) if in_time else (problem.solve() for _ in range(3)):
            old.x.array[:] = w.x.array
            assert contact.heat_balance() < 1e-13
        return problem.config.functions()["field_1"].x.array

    a, b = temperatures(True), temperatures(False)
    assert highest(COMM, np.abs(a - b)) < 1e-9 and highest(COMM, b) == 1.0
