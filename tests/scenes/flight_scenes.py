"""A bar that flies onto a wall, or onto another bar, in explicit steps."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD
#: Without the checks of every state, which assemble residuals.
ATTEMPT = uem.UnitedProblem.attempt
SHAPES = {2: "quadrilateral", 3: "hexahedron"}


class Flight:
    """Bars along the last axis, of length 10, density 1 and wave speed 30, that fly downwards onto a wall or onto each other.

    Args:
        dim: of space.
        cells: along each bar.
        speed: of the uppermost bar.
        gap: below each bar.
        bars: their number; the lower of two stands on nothing.
        law: of both.
        impedance: of the lower of two bars over that of the upper, at the same wave speed.
        nu: Poisson's ratio.
        pose: of the mesh, see ``scene``.
        move: displacement of the wall by the time.
        how: arguments of the contact.
    """

    def __init__(
        self,
        dim=2,
        cells=40,
        speed=10.0,
        gap=0.5,
        bars=1,
        law=uem.LinearElastic,
        impedance=1.0,
        nu=0.0,
        pose=lambda x: x,
        move=None,
        **how,
    ):
        across = [1.0] * (dim - 1)
        places = [gap, 10.0 + 2 * gap][:bars]
        parts = [
            box(SHAPES[dim], [*[0.0] * (dim - 1), y], [*across, y + 10.0], [*[1 + k] * (dim - 1), cells])
            for k, y in enumerate(places)
        ]
        self.scene, self.dim = scene(COMM, SHAPES[dim], parts, pose=pose), dim
        V = compat.function_space(self.scene.mesh, 1, (dim,))
        self.u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
        self.split = 10.0 + 1.5 * gap if bars == 2 else -1.0
        upper = V.tabulate_dof_coordinates()[:, dim - 1] > self.split
        velocity.x.array.reshape(-1, dim)[upper, dim - 1] = -speed
        x = ufl.SpatialCoordinate(self.scene.mesh)
        density = ufl.conditional(ufl.lt(x[dim - 1], self.split), impedance, 1.0)
        material = law(900.0 * density, nu, kind="plane_stress" if dim == 2 else "3d")
        self.dynamics = uem.Dynamics(uem.lumped_mass(V, density), velocity=velocity, scheme=uem.CentralDifferences())
        bottom = self.scene.tag("bottom", bars - 1, at(dim - 1, places[-1]))
        plane = uem.RigidPlane(np.zeros(dim), np.eye(dim)[-1])
        load = None if move is None else lambda at: plane.move(move(at))
        target = plane if bars == 1 else self.scene.tag("top", 0, at(dim - 1, places[0] + 10.0))
        self.contact = uem.Contact(bottom, target, name="touch", **how)
        #: Load along the last axis, by volume.
        self.pull = fem.Constant(self.scene.mesh, 0.0)
        self.problem = uem.UnitedProblem(
            (material.residual(self.u, v) - self.pull * v[dim - 1]) * ufl.dx,
            self.u,
            contacts=[self.contact],
            dynamics=self.dynamics,
            rtol=1e-12,
            load=load,
        )
        self.stored = material.energy(self.u) * ufl.dx
        self.rows = []

    def run(self, end, dt=None, **how):
        """Columns time, force, sum of energies over the first, momentum along the last axis."""
        book = uem.EnergyBook(self.problem, self.stored)
        for step in uem.time_steps(self.problem, dt, end, **how):
            row = book.write(step)
            energy = (row.kinetic + row.stored) / book.rows[0].kinetic
            self.rows.append((row.time, self.contact.resultant().force[-1], energy, book.momenta[-1][-1]))
            self.last = step
        self.book = book
        return np.array(self.rows).T

    @property
    def size(self):
        """Norm of the displacement (collective)."""
        own = self.u.x.array[: self.problem.config.n_owned * self.dim]
        return float(np.sqrt(reduced(COMM, float(own @ own))))
