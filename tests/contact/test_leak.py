"""A fluid between surfaces: the pressure at which a joint opens and closes, and how far, in closed form; what it reaches; restart."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
E, STIFFNESS, PRELOAD, LENGTH = 1e3, 5.0, 1.0, 4.0
SHAPES = {2: "quadrilateral", 3: "hexahedron"}


class Joint:
    """A block under springs with a preload on a rigid plane, or on a second block as long; the fluid comes from the ends along x."""

    def __init__(self, pressure, dim=2, target="plane", coupling="mortar", degree=1, inlet="ends", scale=1.0, **how):
        below = [box(SHAPES[dim], [0.0] * (dim - 1) + [-1.0], [LENGTH] + [1.0] * (dim - 2) + [0.0], [9] + [2] * (dim - 1))]
        above = [box(SHAPES[dim], [0.0] * dim, [LENGTH] + [1.0] * (dim - 1), [12] + [2] * (dim - 1))]
        s = scene(COMM, SHAPES[dim], above + (below if target == "block" else []), pose=lambda x: scale * x)
        V = compat.function_space(s.mesh, degree, (dim,))
        self.u, v = fem.Function(V), ufl.TestFunction(V)
        self.dim, self.scale, up = dim, scale, dim - 1
        self.top, self.foot = s.tag("top", 0, at(up, 1.0)), s.tag("foot", 0, at(up, 0.0))
        F = uem.LinearElastic(E, 0.0, kind="plane_strain" if dim == 2 else "3d").residual(self.u, v) * ufl.dx
        F += (PRELOAD + STIFFNESS / scale * self.u[up]) * v[up] * uem.ds(self.top)
        bcs = [uem.dirichlet(V, s.tag("end", 0, at(0, 0.0)), 0)]
        bcs += [uem.dirichlet(V, s.tag("front", 0, at(1, 0.0)), 1)] if dim == 3 else []
        plane = uem.RigidPlane(np.zeros(dim), np.eye(dim)[-1])
        if target == "block":
            plane = s.tag("base", 1, at(up, 0.0))
            bcs += [uem.dirichlet(V, s.tag("bed", 1, at(up, -1.0)), c) for c in range(dim)]
            bcs += [uem.dirichlet(V, s.tag("sides", 1, at(0, end)), 0) for end in (0.0, LENGTH)]
        inner = {"ends": (0.0, LENGTH), "left": (0.0,)}[inlet]
        where = s.tag("inlet", 0, lambda x: np.any([np.abs(x[:, 0] - end) < 1e-9 for end in inner], axis=0))
        self.contact = uem.Contact(self.foot, plane, leak=uem.Leak(pressure, inlet=where), coupling=coupling, name="seal", **how)
        self.problem = uem.UnitedProblem(F, self.u, bcs=bcs, contacts=[self.contact])
        self.area = scale ** (dim - 1) * LENGTH
        self.heights = 2 if target == "block" else 1

    def mean(self, what, tag):
        """Mean over a surface."""
        return uem.integrate(what * uem.ds(tag)) / self.area

    @property
    def wet(self):
        """Part of the surface that the fluid has reached."""
        return self.mean(self.contact.wet, self.foot)

    @property
    def lift(self):
        """Mean motion of the block's top over its height."""
        return self.mean(self.u[self.dim - 1], self.top) / self.scale

    @property
    def limit(self):
        """Contact pressure of the closed joint."""
        return PRELOAD / (1 + self.heights * STIFFNESS / E)


HOWS = [
    {}, {"coupling": "node_to_surface"}, {"degree": 2}, {"degree": 2, "coupling": "node_to_surface"}, {"target": "block"},
    {"target": "block", "degree": 2}, {"dim": 3}, {"dim": 3, "target": "block"}, {"scale": 1e-6}, {"friction": 0.3}, {"inlet": "left"},
]  # fmt: skip


@pytest.mark.parametrize("how", HOWS, ids=str)
def test_a_joint_opens_at_its_contact_pressure(how):
    """Two per cent below it the fluid stays at the inlet, and what it carries the solids do not; two per cent above it lifts the block."""
    closed = Joint(0.98 * Joint(1.0, **how).limit, **how)
    (step,) = uem.load_steps(closed.problem, 1)
    assert closed.wet < 0.1 and closed.lift < 0.0
    # an end of a quadratic facet has a third of it in Bernstein's basis, and a sixth in Lagrange's
    fluid = 0.98 * closed.limit * closed.area * closed.wet * how.get("degree", 1)
    total = closed.limit * closed.area
    assert abs((closed.contact.resultant().force[-1] + fluid) / total - 1) < 2e-3
    p = 1.02 * closed.limit if how.get("inlet") != "left" else 1.2
    opened = Joint(p, **how)
    (step,) = uem.load_steps(opened.problem, 1)
    assert abs(opened.wet - 1) < 1e-9 and step.newton_iterations <= 15
    assert abs(opened.lift - (p - PRELOAD) / STIFFNESS) < 1e-6
    assert np.abs(opened.contact.resultant().force).max() < 1e-8 * opened.area


@pytest.mark.parametrize("coupling", ["mortar", "node_to_surface"])
def test_supports_bear_the_fluid(coupling):
    """Two blocks held apart, the lower one at all nodes: each support bears pressure times area, until the contact is switched off."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, k - 1.0], [1.0, float(k)], [3 + k, 2]) for k in range(2)])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    low, top = s.tag("low", 0, lambda x: x[:, 0] > -1.0), s.tag("top", 1, at(1, 1.0))
    leak = uem.Leak(0.3, inlet=s.tag("inlet", 1, at(0, 0.0)))
    seal = uem.Contact(s.tag("foot", 1, at(1, 0.0)), s.tag("base", 0, at(1, 0.0)), leak=leak, coupling=coupling)
    bcs = [uem.dirichlet(V, low), uem.dirichlet(V, top, 0), uem.dirichlet(V, top, 1, 0.01)]
    F = uem.LinearElastic(10.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[seal])
    for step in uem.load_steps(problem, [uem.Step("on"), uem.Step("off", contacts={seal: False})]):
        push = 0.3 if step.step == "on" else 0.0
        below, above = problem.reaction(low), problem.reaction(top)
        assert abs(below[1] - push) < 1e-10 and np.abs(below + above).max() < 1e-10


def test_a_piston():
    """The energies of a block that a fluid drives off are the pressure's work on its way."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 2.0], [2, 8])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law, foot = uem.StVenantKirchhoff(1e4, 0.0, kind="plane_strain"), s.tag("foot", 0, at(1, 0.0))
    plane = uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0]))
    seal = uem.Contact(foot, plane, leak=uem.Leak(2.0, inlet=s.tag("inlet", 0, at(0, 0.0))))
    bcs = [uem.dirichlet(V, s.tag("side", 0, at(0, x)), 0) for x in (0.0, 1.0)]
    problem = uem.UnitedProblem(
        law.residual(u, v) * ufl.dx, u, bcs=bcs, contacts=[seal], dynamics=uem.Dynamics(uem.lumped_mass(V, 1.0))
    )
    book = uem.EnergyBook(problem, law.energy(u) * ufl.dx)
    for step in uem.time_steps(problem, 0.05, 0.5):
        row = book.write(step)
    way = uem.integrate(u[1] * uem.ds(foot))
    assert way > 0.1 and abs(row.external / (2.0 * way) - 1.0) < 5e-3
    assert abs(row.defect) < 2e-3 * row.kinetic


def test_it_closes_where_it_opened():
    """A pressure that falls below the contact pressure lets the joint close, and the fluid leaves it."""
    joint = Joint(lambda s: 1.5 * (1 - abs(2 * s - 1)))
    for step in uem.load_steps(joint.problem, 10):
        p = 1.5 * (1 - abs(2 * step.factor - 1))
        if p > joint.limit:
            assert abs(joint.wet - 1) < 1e-9 and abs(joint.lift - (p - PRELOAD) / STIFFNESS) < 1e-6
        else:
            assert joint.wet < 0.1


def test_a_closed_joint_cuts_the_fluid_off():
    """What lies behind closed contactors stays dry, although it is open: a block with a recess in the middle of its foot."""
    x = np.array([0.0, 1.0, 3.0, 4.0])
    parts = [box("quadrilateral", [0.0, 0.0], [LENGTH, 1.0], [16, 3])]

    def recess(points):
        moved = np.array(points)
        low = (points[:, 1] < 1e-9) & (points[:, 0] > x[1] - 0.01) & (points[:, 0] < x[2] + 0.01)
        moved[low, 1] = 0.1
        return moved

    s = scene(COMM, "quadrilateral", parts, pose=recess)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(E, 0.0, kind="plane_strain").residual(u, v) * ufl.dx
    F += (PRELOAD + STIFFNESS * u[1]) * v[1] * uem.ds(s.tag("top", 0, at(1, 1.0)))
    bcs = [uem.dirichlet(V, s.tag("end", 0, at(0, 0.0)), 0)]
    foot = s.tag("foot", 0, lambda x: (x[:, 1] < 0.11) & (x[:, 1] > -1e-9))
    inlet = s.tag("inlet", 0, at(0, 0.0))
    contact = uem.Contact(foot, uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0])), leak=uem.Leak(0.3, inlet=inlet))
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    list(uem.load_steps(problem, 1))
    assert 0.0 < uem.integrate(contact.wet * uem.ds(foot)) < 0.5


def test_switched_off_and_on():
    """Switched off, the contact has no fluid and the block rests on its springs alone; switched on, the fluid comes back."""
    joint = Joint(lambda s: 1.5 * s, target="block", coupling="mortar")
    off, on = {joint.contact: False}, {joint.contact: True}
    lifts = []
    for step in uem.load_steps(
        joint.problem, [uem.Step("a", 4), uem.Step("off", 1, contacts=off), uem.Step("on", 4, contacts=on)]
    ):
        if step.factor == 1.0:
            lifts.append((joint.lift, joint.wet))
    opened = (1.5 - PRELOAD) / STIFFNESS, 1.0
    assert np.allclose(lifts, [opened, (-PRELOAD / STIFFNESS, 0.0), opened], atol=1e-6)


def test_restart(tmp_path):
    """A run that continues from a checkpoint is the uninterrupted one."""
    path = COMM.bcast(str(tmp_path / "kept"))
    whole, first, second = (Joint(lambda s: 1.5 * s, target="block") for _ in range(3))
    list(uem.load_steps(whole.problem, 10))
    steps = uem.load_steps(first.problem, 10, checkpoint=uem.Checkpoint(path))
    for step in steps:
        if step.number == 7:
            break
    steps.close()
    list(uem.load_steps(second.problem, 10, checkpoint=uem.Checkpoint(path)))
    assert abs(second.lift - whole.lift) < 1e-12 and whole.lift > 0


@pytest.mark.parametrize(
    ("how", "words"),
    [({"normal": uem.SoftContact(1.0)}, "normal does not go with leak"), ({"tied": True}, "tied does not go with leak"),
     ({"cohesion": uem.Cohesive(1.0, 1.0)}, "cohesion does not go with leak")],
)  # fmt: skip
def test_what_does_not_go_is_refused(how, words):
    """By name."""
    with pytest.raises(uem.InputError, match=words):
        Joint(1.0, **how)


def test_wrong_pressures():
    """Negative ones, also from functions, and an inlet that no contactor is at."""
    with pytest.raises(uem.InputError, match="pressure"):
        Joint(-1.0)
    with pytest.raises(uem.InputError, match="not negative"):
        list(uem.load_steps(Joint(lambda s: -1.0).problem, 1))
    with pytest.raises(uem.InputError, match="no contactor is at the inlet"):
        joint = Joint(1.0)
        other = uem.Contact(
            joint.foot, uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0])), leak=uem.Leak(1.0, inlet=joint.top), name="other"
        )
        form = uem.LinearElastic(E, 0.0, kind="plane_strain").residual(joint.u, ufl.TestFunction(joint.u.function_space)) * ufl.dx
        uem.UnitedProblem(form, joint.u, contacts=[other])
