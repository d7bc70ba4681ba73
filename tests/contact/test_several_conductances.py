"""Heat and current through one contact: each of its conductances has the whole pressure; contacts that share a pressure are refused.

Read first: ``test_heat_and_current``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.scenes import at
from dolfinx import fem
from helpers import blocks, highest, refused, run, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, PRESS, K = 1e3, 0.02, {1: 2.0, 2: 3.0}
ENDS = {1: (100.0, 300.0), 2: (0.0, 4.0)}
KINDS = {"triangle": "plane_strain", "quadrilateral": "plane_strain", "tetrahedron": "3d", "hexahedron": "3d"}


class Joint:
    """Guided blocks that are pressed on each other, with a temperature and a potential as further fields; all is linear in height.

    Args:
        contacts: makes them from the blocks.
        cell: of the mesh.
        degree: of all fields.
        n: divisions of the upper block.
        axisymmetric: whether the blocks are cylinders.
        wall: whether a wall stands where the upper block's top is pressed.
    """

    def __init__(self, contacts, cell="triangle", degree=1, *, n=3, axisymmetric=False, wall=False):
        b = self.b = blocks(COMM, cell, 3, n, degree=degree)
        mesh, g, kind = b.scene.mesh, b.gdim, "axisymmetric" if axisymmetric else KINDS[cell]
        if axisymmetric:
            uem.axisymmetric(mesh)
        W = uem.function_space(mesh, [("Lagrange", degree, (g,)), degree, degree])
        w = self.w = fem.Function(W)
        (u, *fields), (v, *tests) = ufl.split(w), ufl.split(ufl.TestFunction(W))
        F = uem.LinearElastic(E, 0.0, kind=kind).residual(u, v) * ufl.dx
        for k, (f, q) in enumerate(zip(fields, tests), 1):
            F += K[k] * ufl.inner(ufl.grad(f), ufl.grad(q)) * ufl.dx
        sides = [(c, b.scene.tag("side", body, at(c, end))) for c in range(g - 1) for end in (0.0, 1.0) for body in (0, 1)]
        bcs = [uem.dirichlet(W.sub(0), b.bottom, g - 1), *(uem.dirichlet(W.sub(0), tag, c) for c, tag in sides)]
        bcs += [uem.dirichlet(W.sub(k), b.bottom, value=ENDS[k][0]) for k in ENDS]
        if not wall:
            bcs.append(uem.dirichlet(W.sub(0), b.top, g - 1, -PRESS))
            bcs += [uem.dirichlet(W.sub(k), b.top, value=ENDS[k][1]) for k in ENDS]
        self.contacts = contacts(b)
        self.problem = uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=self.contacts, rtol=1e-10)


def through(k, h, n=1):
    """Flux of a field through two blocks and ``n`` joints."""
    return (ENDS[k][1] - ENDS[k][0]) / (2.0 / K[k] + n / h)


@pytest.mark.parametrize(
    ("cell", "coupling", "degree", "how"),
    [
        ("triangle", "node_to_surface", 1, {}), ("triangle", "mortar", 1, {}), ("quadrilateral", "mortar", 1, {"axisymmetric": True}),
        ("triangle", "node_to_surface", 1, {"axisymmetric": True}), slow("triangle", "mortar", 2, {}),
        slow("triangle", "node_to_surface", 2, {}), slow("tetrahedron", "node_to_surface", 1, {}), slow("hexahedron", "mortar", 1, {}),
    ],
)  # fmt: skip
def test_heat_and_current(cell, coupling, degree, how):
    """Both conductances grow with the pressure, of which each has the whole; powers are fluxes times areas."""
    pressure = E * PRESS / 2.0
    heat = [uem.Conductance(lambda p, g: 0.5 * p, field=1), uem.Conductance(lambda p, g: 2.0 * p, field=2)]
    joint = Joint(
        lambda b: [uem.Contact(b.high, b.low, coupling=coupling, heat=heat)],
        cell,
        degree,
        n=6 if coupling != "mortar" else 4,
        **how,
    )
    run(joint.problem)
    (contact,) = joint.contacts
    assert highest(COMM, np.abs(contact.pressures / pressure - 1.0)) < 1e-8
    area = np.pi if how else 1.0
    for k, h in ((1, 0.5 * pressure), (2, 2.0 * pressure)):
        flux = contact.heat_flux_of(k).x.array[contact.nodes]
        assert highest(COMM, np.abs(flux / through(k, h) - 1.0)) < 1e-8
        assert contact.heat_power_of(k) == pytest.approx(area * through(k, h), rel=1e-8)
    assert contact.heat_power == contact.heat_power_of(1)
    assert contact.heat_flux is contact.heat_flux_of(1) and contact.heat_balance() < 1e-14


def test_newtons_method_is_quadratic():
    """The tangent has how both depend on the pressure; temperature that expands the blocks is not needed for that."""
    heat = [uem.Conductance(lambda p, g: 0.5 * p, field=1), uem.Conductance(lambda p, g: 2.0 * p, field=2)]
    joint = Joint(lambda b: [uem.Contact(b.high, b.low, heat=heat)])
    (step,) = run(joint.problem)
    assert step.newton_iterations <= 3


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_united_fields(folder, coupling):
    """Both are the same on both sides, by equations of both; their powers are multipliers of their own, in checkpoints as well."""
    heat = [uem.Conductance(np.inf, field=2), uem.Conductance(np.inf, field=1)]
    first, other = (Joint(lambda b: [uem.Contact(b.high, b.low, coupling=coupling, heat=heat)]) for _ in range(2))
    run(first.problem)
    uem.write_checkpoint(folder / "run.uem", first.problem.state())
    uem.read_checkpoint(folder / "run.uem", other.problem.state())
    for joint in (first, other):
        (contact,) = joint.contacts
        for k in (1, 2):
            assert contact.heat_power_of(k) == pytest.approx(through(k, np.inf), rel=1e-10)
        assert contact.heat_flux is contact.heat_flux_of(2)


def test_conductances_of_one_field_add_up():
    """What passes where surfaces touch, and what a film lets through everywhere."""
    heat = [uem.Conductance(3.0, field=1), uem.Conductance(lambda p, g: 2.0 + 0.0 * p, field=1)]
    joint = Joint(lambda b: [uem.Contact(b.high, b.low, heat=heat)])
    run(joint.problem)
    assert joint.contacts[0].heat_power == pytest.approx(through(1, 5.0), rel=1e-10)


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_general_contact(folder, coupling):
    """As by hand, by name of the bodies; the results have a field for each."""
    heat = [uem.Conductance(5.0, field=1), uem.Conductance(2.0, field=2)]
    joint = Joint(lambda b: [uem.GeneralContact(heat=heat, order=[b.high], coupling=coupling)])
    run(joint.problem)
    (contact,) = joint.contacts
    for k, h in ((1, 5.0), (2, 2.0)):
        assert contact.heat_power("body 2", "body 1", field=k) == pytest.approx(through(k, h), rel=1e-9)
        flux = contact.heat_flux_of(k).x.array
        assert highest(COMM, np.abs(flux[flux != 0] / through(k, h) - 1.0)) < 1e-9
    assert contact.heat_power("body 2") == pytest.approx(through(1, 5.0), rel=1e-9)
    with uem.ResultsWriter(folder / "run", joint.problem) as writer:
        writer.write(1.0)
    text = (folder / "run.xdmf").read_text()
    assert 'Name="heat_flux"' in text and 'Name="heat_flux_of_field_2"' in text
    refused(uem.InputError, ("field 3", "[1, 2]"), lambda: contact.heat_power("body 1", field=3))


def test_rigid_surfaces_have_a_temperature_and_a_potential():
    """The wall is hot, and has a potential of its own."""

    def contacts(b):
        wall = uem.RigidPlane([0.0, 1.0 - PRESS], [0.0, -1.0])
        heat = [uem.Conductance(5.0, field=k, temperature=ENDS[k][1]) for k in ENDS]
        return [uem.GeneralContact(rigid=wall, heat=heat, max_penetration=0.1, order=[b.high])]

    joint = Joint(contacts, wall=True)
    run(joint.problem)
    for k in ENDS:
        assert joint.contacts[0].heat_power("body 2", "rigid plane", field=k) == pytest.approx(-through(k, 5.0, 2), rel=1e-9)


def test_what_is_refused():
    """Two that unite one field or take its heat of friction; contacts that share a pressure, with what to do instead."""
    by_pressure, constant = uem.Conductance(lambda p, g: p, field=1), uem.Conductance(1.0, field=2)
    united, rubbed = uem.Conductance(np.inf, field=1), uem.Conductance(1.0, field=1, friction_share=0.5)
    b = blocks(COMM, "triangle", 2, 2)
    for wrong, words in (([united, united], "h = inf"), ([rubbed, rubbed], "friction_share")):
        refused(uem.InputError, ("2 conductances of field 1", words), lambda wrong=wrong: uem.Contact(b.high, b.low, heat=wrong))
    refused(uem.InputTypeError, ("heat = [3.0]", "a list"), lambda: uem.Contact(b.high, b.low, heat=[3.0]))

    def made(*how, swap=False):
        sides = [("high", "low"), ("low", "high") if swap else ("high", "low")]
        return Joint(
            lambda b: [uem.Contact(getattr(b, one), getattr(b, other), name=one, **h) for h, (one, other) in zip(how, sides)]
        )

    words = ("contact 'high'", "share the pressure", "heat=[...]")
    refused(uem.ConflictError, words, lambda: made({"heat": by_pressure}, {"heat": constant}))
    refused(uem.ConflictError, words, lambda: made({"friction": 0.3}, {"heat": constant}))
    refused(uem.ConflictError, words, lambda: made({}, {"wear": 1e-9}))
    refused(uem.ConflictError, "sides swapped", lambda: made({"heat": by_pressure}, {}, swap=True))
    # each conducts, and none needs the pressure
    joint = made({"heat": constant}, {"heat": uem.Conductance(1.0, field=1)})
    run(joint.problem)
    assert joint.contacts[1].heat_power == pytest.approx(through(1, 1.0), rel=1e-9)
    refused(uem.InputError, ("field 1", "[2]"), lambda: joint.contacts[0].heat_flux_of(1))
    plane = uem.RigidPlane([0.0, -0.5], [0.0, 1.0])
    both = lambda b: [uem.Contact(b.low, plane, name=name, friction=mu) for name, mu in (("one", 0.3), ("other", 0.0))]  # noqa: E731
    refused(uem.ConflictError, "share the pressure", lambda: Joint(both))
