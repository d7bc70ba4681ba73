"""A bar with mass above a rigid floor, for the tests of rest, of failed steps and of tables."""

from __future__ import annotations

from mpi4py import MPI

import ufl
from dolfinx import fem
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
LENGTH, E, DENSITY = 10.0, 900.0, 2.0


class Bar:
    """A bar ``[0, 1] x [gap, gap + LENGTH]`` without any support above a rigid floor."""

    def __init__(self, gravity, *, gap=0.0, finite=False, contactors="massless", load=None, eta=0.0):
        self.s = s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, gap], [1.0, gap + LENGTH], [2, 12])])
        self.V = compat.function_space(s.mesh, 1, (2,))
        self.u = fem.Function(self.V)
        law = (uem.StVenantKirchhoff if finite else uem.LinearElastic)(E, 0.0, kind="plane_stress")
        self.floor = uem.Contact(s.tag("foot", 0, at(1, gap)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
        v = ufl.TestFunction(self.V)
        damping = (lambda rate: eta * ufl.inner(ufl.grad(rate), ufl.grad(v)) * ufl.dx) if eta else None
        self.dynamics = uem.Dynamics(uem.lumped_mass(self.V, DENSITY), gravity=gravity, contactors=contactors, damping=damping)
        self.problem = uem.UnitedProblem(
            law.residual(self.u, v) * ufl.dx, self.u, contacts=[self.floor], dynamics=self.dynamics, load=load
        )
