"""A seal of rubber that is squeezed against a wall, with the force on the wall as the work of the residual."""

from __future__ import annotations

from mpi4py import MPI

import ufl
from dolfinx import fem

import uem_dolfinx as uem


def force(F, tag, component=1):
    """The upward force on a part, or the one to the right, as the work of the residual along a unit displacement of its nodes."""
    v = F.arguments()[0]
    w = fem.Function(v.ufl_function_space())
    dofs = fem.locate_dofs_topological(w.function_space, tag.dim, tag.entities)
    w.x.array.reshape(-1, w.function_space.num_sub_spaces)[dofs, component] = 1.0
    w.x.scatter_forward()
    return ufl.replace(F, {v: w})


class Seal:
    """A quarter of a round seal of rubber between a plate and a wall, of curved cells; ``goals`` are forces on the wall."""

    def __init__(self, coupling="node_to_surface", wall=1.05):
        self.coupling, self.wall, self.goals, self.on_plate = coupling, wall, {}, {}

    def make(self, size=None, h=0.25):
        mesh, tags = uem.read_gmsh(uem.example_mesh("adapt_seal"), MPI.COMM_WORLD, gdim=2, parameters={"h": h}, size=size)
        V = uem.function_space(mesh, 2, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = uem.NeoHooke(1.0, 0.4, kind="plane_strain").residual(u, v) * ufl.dx
        bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["middle"], 1, 0.3)]
        planes = uem.RigidPlane((0.0, 1.0), (0.0, -1.0)), uem.RigidPlane((self.wall, 0.0), (-1.0, 0.0))
        contacts = [uem.Contact(tags["arc"], plane, name=name, coupling=self.coupling) for name, plane in zip("pw", planes)]
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts)
        self.goals[problem], self.on_plate[problem] = force(F, tags["symmetry"], 0), force(F, tags["middle"])
        return problem

    def solve(self, problem):
        return list(uem.load_steps(problem, 2))

    def adapt(self, **options):
        return uem.adapt(self.make, goal=self.goals.get, solve=self.solve, **options)
