"""A bar in motion, with and without a wall, for the tests of time steps and of what they cost."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import at, box, clamp, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


class Bar:
    """A bar ``[0, 1] x [gap, gap + 10]`` of linear material, E = 900 and density 1, above a rigid wall at y = 0."""

    def __init__(
        self, n=50, gap=5.0, v=-10.0, comm=COMM, cell="quadrilateral", law=uem.LinearElastic, unit=1.0, mass=uem.lumped_mass,
        wall=True, held=False, **how,
    ):  # fmt: skip
        g = 2 if cell in ("triangle", "quadrilateral") else 3
        across = [[0.0] * (g - 1), [unit] * (g - 1), [1] * (g - 1)]
        body = box(cell, [*across[0], gap * unit], [*across[1], (gap + 10) * unit], [*across[2], n])
        self.s = s = scene(comm, cell, [body])
        self.V = compat.function_space(s.mesh, 1, (g,))
        self.u, w = fem.Function(self.V), ufl.TestFunction(self.V)
        self.tip = s.tag("tip", 0, at(g - 1, gap * unit, 1e-9 * unit))
        material = law(900.0, 0.0, kind="plane_stress" if g == 2 else "3d")
        self.stored = material.energy(self.u) * ufl.dx
        self.contact = uem.Contact(self.tip, uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0]), name="wall")
        velocity = [*[0.0] * (g - 1), v * unit] if np.isscalar(v) else self.field(v)
        self.dynamics = uem.Dynamics(mass(self.V, 1.0 / unit**2), velocity=velocity, **how)
        self.problem = uem.UnitedProblem(
            material.residual(self.u, w) * ufl.dx, self.u, contacts=[self.contact] if wall else [], dynamics=self.dynamics,
            bcs=clamp(self.V, self.tip) if held else [],
        )  # fmt: skip
        self.book = uem.EnergyBook(self.problem, self.stored)
        self.forces, self.steps = [], []

    def field(self, f):
        """Function with the values ``f(X) (n, gdim)`` at the nodes."""
        field = fem.Function(self.V)
        values = field.x.array.reshape(-1, self.V.mesh.geometry.dim)
        values[:] = f(self.V.tabulate_dof_coordinates()[: len(values), : values.shape[1]])
        return field

    def run(self, dt, end, **how):
        """Step to the end, with the contact force ``(n, 2)`` over time."""
        for step in uem.time_steps(self.problem, dt, end, **how):
            self.steps.append(step)
            self.book.write(step)
            self.forces.append((step.time, self.contact.resultant().force[-1] if self.problem.contacts else 0.0))
        return np.array(self.forces)
