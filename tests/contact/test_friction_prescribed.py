"""Contactors with friction whose components are prescribed: driven over the target, or on a plane of symmetry."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, linear, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat


def test_contactors_that_are_driven():
    """A contactor whose motion along the target is prescribed feels no friction, so it may not be driven over it."""
    plane = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
    for way, fits in ((1e-12, True), (1e-3, False)):
        b = blocks(MPI.COMM_WORLD, "quadrilateral", 2, 2, overhang=0.5)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.high, 0, value=way), *clamp(b.V, b.top, 1, value=-0.01)]
        contact = uem.Contact(b.high, plane, friction=0.3)
        problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
        if fits:
            problem.solve()
        else:
            refused(uem.FrictionError, "prescribed component", problem.solve)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_half_model(coupling):
    """With half the force of the whole one; mortar's relative motions, means over facets, have parts across the plane of symmetry."""

    def pushed(half):
        y, n = (0.0, 1) if half else (-1.0, 2)
        lower = box("hexahedron", [-0.4, 1.4 * y, -1.0], [1.4, 1.4, 0.0], [4, 3 * n, 2])
        upper = box("hexahedron", [0.0, y, 0.0], [1.0, 1.0, 1.0], [3, 4 * n, 3])
        s = scene(MPI.COMM_WORLD, "hexahedron", [lower, upper])
        V = compat.function_space(s.mesh, 1, (3,))
        u, low, high, top = (
            fem.Function(V),
            s.tag("low", 0, at(2, 0.0)),
            s.tag("high", 1, at(2, 0.0)),
            s.tag("top", 1, at(2, 1.0)),
        )
        bcs = [
            *clamp(V, s.tag("bottom", 0, at(2, -1.0))),
            *clamp(V, top, 0, value=0.05),
            *clamp(V, top, 1),
            *clamp(V, top, 2, value=-0.02),
        ]
        for body in (0, 1) if half else ():
            bcs += clamp(V, s.tag(f"middle {body}", body, at(1, 0.0)), 1)
        contact = uem.Contact(high, low, coupling=coupling, friction=0.3)
        problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact])
        for _ in uem.load_steps(problem, 2):
            pass
        assert MPI.COMM_WORLD.allreduce(int(contact.pair.slipping.sum())) > 0
        return np.asarray(contact.resultant().force)

    whole, half = pushed(False), pushed(True)
    np.testing.assert_allclose(2 * half[[0, 2]], whole[[0, 2]], rtol=1e-6)
