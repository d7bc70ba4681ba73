"""Loads that act from the start on nodes without mass: bodies feel them at once, through the strains of the surface.

Read ``test_a_step_load`` first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, highest, lowest, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
E, LENGTH, LOAD = 900.0, 4.0, 0.7
#: Speed of waves for density 1.
SPEED = np.sqrt(E)


class Bar:
    """A bar ``[0, 1] x [0, 4]`` of density 1, whose lower end is a contactor without mass, and its load there."""

    def __init__(
        self, scheme=None, cell="quadrilateral", degree=1, law=uem.LinearElastic, mass=uem.lumped_mass, others=lambda bar: {}, wall=-5.0,
        load=LOAD, fluid=None, held=False, damping=None, n=20,
    ):  # fmt: skip
        g = 2 if cell in ("triangle", "quadrilateral") else 3
        s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * (g - 1) + [LENGTH], [1] * (g - 1) + [n // degree])])
        self.V = V = compat.function_space(s.mesh, degree, (g,))
        self.u, self.g, w = fem.Function(V), g, ufl.TestFunction(V)
        self.end, self.top = s.tag("end", 0, at(g - 1, 0.0)), s.tag("top", 0, at(g - 1, LENGTH))
        self.sides = [s.tag(f"side {k}", 0, at(0, k)) for k in (0.0, 1.0)]
        F = law(E, 0.0, kind="plane_strain" if g == 2 else "3d").residual(self.u, w) * ufl.dx
        self.load = fem.Constant(s.mesh, load)
        F -= self.load * w[g - 1] * uem.ds(self.end)
        plane = uem.RigidPlane([0.0] * (g - 1) + [wall], [0.0] * (g - 1) + [1.0])
        leak = None if fluid is None else uem.Leak(fluid, inlet=self.sides[0])
        self.contact = uem.Contact(self.end, plane, leak=leak)
        form = None if damping is None else lambda rate: damping * ufl.inner(ufl.grad(rate), ufl.grad(w)) * ufl.dx
        self.dynamics = uem.Dynamics(mass(V, 1.0), scheme=scheme, damping=form)
        self.problem = uem.UnitedProblem(
            F, self.u, contacts=[self.contact], dynamics=self.dynamics, rtol=1e-12,
            bcs=[uem.dirichlet(V, self.end, g - 1)] if held else [], **others(self),
        )  # fmt: skip

    def nodal(self, f):
        """Axial components of a field at the owned nodes, and their heights."""
        n = self.V.dofmap.index_map.size_local
        return f.x.array.reshape(-1, self.g)[:n, -1], self.V.tabulate_dof_coordinates()[:n, self.g - 1]

    def momenta(self, dt, steps, **how):
        """Momentum along the bar after every step, over the impulse of the load."""
        every = uem.time_steps(self.problem, dt, self.dynamics.time + steps * dt, **how)
        return np.array([self.dynamics.momentum()[-1] / (LOAD * step.time) for step in every])


SCHEMES = {
    "trapezoidal rule": uem.newmark(), "Newmark": uem.newmark(0.3, 0.6), "generalised alpha": uem.generalised_alpha(0.8),
    "all damped": uem.generalised_alpha(0.0), "explicit": uem.CentralDifferences(),
}  # fmt: skip


@pytest.mark.parametrize("scheme", ["trapezoidal rule", *map(slow, list(SCHEMES)[1:])])
def test_a_step_load(scheme):
    """The momentum is ``p A t`` after every step; a wave runs up the bar, behind which it moves at ``p / (rho c)``."""
    bar, dt = Bar(SCHEMES[scheme], n=40), LENGTH / 40 / SPEED / 2
    assert np.abs(bar.momenta(dt, 40) - 1.0).max() < 1e-12
    t = 40 * dt
    moved, height = bar.nodal(bar.u)
    exact = LOAD / SPEED * np.maximum(t - height / SPEED, 0.0)
    # half a step less is another 1.25 % of the end's way
    assert highest(COMM, np.abs(moved - exact)[height < 0.25 * LENGTH]) < 1.1e-2 * LOAD / SPEED * t
    assert highest(COMM, np.abs(moved)[height > 0.75 * LENGTH]) < 5e-3 * LOAD / SPEED * t


@pytest.mark.parametrize(
    "how",
    [
        {"others": lambda bar: {"equations": [uem.periodic(*bar.sides)]}},
        {"others": lambda bar: {"couplings": [uem.RigidCoupling(bar.end, (0.5, 0.0), mass=2.0)]}},
        {"load": 0.0, "fluid": LOAD, "wall": 0.0},
        *map(
            slow,
            [
                {"cell": "triangle", "degree": 2, "mass": uem.consistent_mass, "law": uem.NeoHooke}, {"cell": "hexahedron"},
                {"cell": "tetrahedron", "law": uem.StVenantKirchhoff}, {"damping": 0.5, "scheme": uem.generalised_alpha(0.5)},
                {"others": lambda bar: {"couplings": [uem.RigidCoupling(bar.top, (0.5, LENGTH), mass=2.0)]}},
                {"others": lambda bar: {"couplings": [uem.RigidCoupling(bar.end, (0.5, 0.0))]}, "law": uem.NeoHooke},
                {"load": 0.0, "others": lambda bar: {"points": [uem.PointLoad((x, 0.0), (0.0, 0.5 * LOAD)) for x in (0.0, 1.0)]}},
                {"load": 0.0, "fluid": LOAD, "wall": 0.0, "law": uem.NeoHooke},
            ],
        ),
    ],
)  # fmt: skip
def test_whatever_it_acts_on(how):
    """Likewise, for all cells, masses, equations, couplings and kinds of loads."""
    assert np.abs(Bar(**how).momenta(2e-3, 3) - 1.0).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("displacement", [0, 1])
def test_among_other_fields(displacement):
    """A pressure in every cell stays where it is at the start."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, LENGTH], [1, 20])])
    parts = [("Lagrange", 1, (2,)), ("DG", 0)][:: 1 - 2 * displacement]
    z = fem.Function(W := uem.function_space(s.mesh, parts))
    (u, v), (p, q) = ((ufl.split(z)[k], ufl.TestFunctions(W)[k]) for k in (displacement, 1 - displacement))
    end = s.tag("end", 0, at(1, 0.0))
    F = E * ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) * ufl.dx - p * ufl.div(v) * ufl.dx
    F -= q * (ufl.div(u) + p / E) * ufl.dx + LOAD * v[1] * uem.ds(end)
    dynamics = uem.Dynamics(uem.lumped_mass(uem.function_space(s.mesh, 1, (2,)), 1.0))
    wall = uem.Contact(end, uem.RigidPlane((0.0, -5.0), (0.0, 1.0)))
    problem = uem.UnitedProblem(F, z, displacement=displacement, contacts=[wall], dynamics=dynamics)
    for step in uem.time_steps(problem, 2e-3, 6e-3):
        assert dynamics.momentum()[1] == pytest.approx(LOAD * step.time, rel=1e-10)


@pytest.mark.slow
def test_a_body_without_mass():
    """A block of no density that is tied below the bar hands its load on from the first step."""
    s = scene(
        COMM, "quadrilateral", [box("quadrilateral", [0.0, y], [1.0, y + LENGTH], [k, 8]) for k, y in ((2, 0.0), (3, -LENGTH))]
    )
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    foot, base, low = s.tag("foot", 0, at(1, 0.0)), s.tag("base", 1, at(1, 0.0)), s.tag("low", 1, at(1, -LENGTH))
    (density := fem.Function(compat.function_space(s.mesh, ("DG", 0)))).interpolate(lambda x: 1.0 * (x[1] > 0.0))
    F = uem.NeoHooke(E, 0.0, kind="plane_strain").residual(u, v) * ufl.dx - LOAD * v[1] * uem.ds(low)
    for contactor, target in ((foot, base), (base, foot)):
        u.x.array[:] = 0.0
        dynamics, tie = uem.Dynamics(uem.lumped_mass(V, density)), uem.Contact(contactor, target, tied=True)
        problem = uem.UnitedProblem(F, u, contacts=[tie], dynamics=dynamics, rtol=1e-12)
        for step in uem.time_steps(problem, 2e-3, 6e-3):
            assert dynamics.momentum()[1] == pytest.approx(LOAD * step.time, rel=1e-12)


def test_a_support_that_is_removed():
    """A load that a support of the surface bears acts on the bar from the instant on at which the support is removed."""
    bar, dt = Bar(held=True), 2e-3
    list(uem.time_steps(bar.problem, dt, 4 * dt))
    assert np.abs(bar.dynamics.momentum()).max() < 1e-14
    bar.problem.hold([])
    for step in uem.time_steps(bar.problem, dt, 8 * dt):
        assert bar.dynamics.momentum()[1] == pytest.approx(LOAD * (step.time - 4 * dt), rel=1e-12)


def test_resumed(folder):
    """A run that continues from the first step's checkpoint is the uninterrupted one to the last bit."""
    whole, first, second = (Bar(law=uem.NeoHooke) for _ in range(3))
    whole.momenta(2e-3, 4)
    first.momenta(2e-3, 1, checkpoint=uem.Checkpoint(folder / "run"))
    assert len(second.momenta(2e-3, 4, checkpoint=uem.Checkpoint(folder / "run"))) == 3
    assert lowest(COMM, np.array_equal(whole.u.x.array, second.u.x.array)) == 1.0


def test_what_is_in_equilibrium_stays():
    """A bar that statics has brought to rest under its load stays there to rounding."""
    bar = Bar(
        others=lambda bar: {"points": [uem.PointLoad((x, LENGTH), (0.0, -0.5 * LOAD)) for x in (0.0, 1.0)]}, wall=0.0, load=0.0
    )
    bar.problem.solve()
    before = np.array(bar.u.x.array)
    list(uem.time_steps(bar.problem, 2e-3, 6e-3))
    assert highest(COMM, np.abs(bar.u.x.array - before)) < 1e-11 * highest(COMM, np.abs(before))


def test_recorded(caplog):
    """No history has derivatives through the equilibrium of the surface at the start, which is said; a load that grows needs none."""
    bar = Bar()
    with uem.recording(bar.problem):
        late = bar.momenta(2e-3, 2)
    assert late == pytest.approx([0.5, 0.75], rel=1e-12) and ("act half a step late" in caplog.text) == (COMM.rank == 0)
    caplog.clear()
    bar = Bar(load=0.0)
    with uem.recording(bar.problem) as history:
        for _ in uem.time_steps(bar.problem, 2e-3, 4e-3):
            bar.load.value = LOAD
    assert len(history) == 2 and not caplog.text
