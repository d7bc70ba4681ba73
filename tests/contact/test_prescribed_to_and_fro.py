"""Blocks whose contactors have prescribed motions to and fro over a rough plane; friction alone holds them across these motions."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, scene, slow

import uem_dolfinx as uem
from uem_dolfinx.contact.friction.stick_slip import continues

MU, PRESSURE, WAY = 0.2, 100.0, 0.3


def test_slip_along_conditions_continues():
    """Slip along a prescribed component continues, slip across it or without a direction does not, nor that of those that have moved."""
    free = np.zeros((6, 2, 3))
    free[:, 0, 0] = 1.0
    direction = np.array([[0.0, 1.0, 0.0], [0.4, 0.9, 0.0], [0.7, 0.7, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    away = np.zeros((6, 3))
    away[5] = 1e-3
    assert continues(direction, free, away, 1e-9).tolist() == [True, True, False, False, False, False]


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "n", "coupling", "size"),
    [
        ("hexahedron", 2, "node_to_surface", 1.0), slow("hexahedron", 3, "node_to_surface", 1.0), slow("hexahedron", 1, "mortar", 1.0),
        slow("hexahedron", 4, "mortar", 1.0), slow("tetrahedron", 3, "node_to_surface", 1.0),
        slow("hexahedron", 4, "node_to_surface", 1e-6), slow("hexahedron", 4, "node_to_surface", 1e3),
    ],
)  # fmt: skip
def test_friction_across_the_way(cell, n, coupling, size):
    """Friction is mu N against the way in every step, nothing drifts across, and no step is cut."""
    s = scene(MPI.COMM_WORLD, cell, [box(cell, [0.0] * 3, [size] * 3, [n] * 3)])
    low, top = s.tag("low", 0, at(2, 0.0)), s.tag("top", 0, at(2, size))
    V = uem.function_space(s.mesh, 1, (3,))
    u, v, p = fem.Function(V), ufl.TestFunction(V), fem.Constant(s.mesh, 0.0)
    F = uem.LinearElastic(2100.0 * PRESSURE, 0.3).residual(u, v) * ufl.dx + p * v[2] * uem.ds(top, s.mesh)
    held = [uem.dirichlet(V, top, 0), uem.dirichlet(V, top, 1)]
    contact = uem.Contact(low, uem.RigidPlane((0.0,) * 3, (0.0, 0.0, 1.0)), coupling=coupling, friction=MU)
    problem = uem.UnitedProblem(F, u, bcs=held, contacts=[contact])
    steps = [uem.Step("press", 1, bcs=held, loads={p: PRESSURE})]
    steps += [
        uem.Step(f"way {k}", number, bcs=[uem.dirichlet(V, low, 1, way * size)])
        for k, (number, way) in enumerate([(3, WAY), (6, -WAY), (4, WAY)])
    ]
    force = PRESSURE * size**2
    iterations = []
    for step in uem.load_steps(problem, steps):
        found = contact.resultant().force / force
        iterations.append(step.newton_iterations)
        assert step.cuts == 0
        assert found[2] == pytest.approx(1.0, rel=1e-8)
        if step.step != "press":
            # reactions of the pressed top are released along the first way
            assert abs(found[0]) < 1e-6 or (step.step == "way 0" and step.factor < 1.0)
            assert abs(found[1]) == pytest.approx(MU, rel=1e-4)
    assert max(iterations) <= 5
