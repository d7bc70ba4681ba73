"""Rigid boxes in a row, for joints and equations of rigid parts."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from helpers import box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat


class RigidBoxes:
    """Rigid boxes of length 2 in a row, with gaps of 0.5 between them, and the middle of a line at ``height`` as their points."""

    def __init__(self, cell, n, comm=MPI.COMM_WORLD, height=0.0):
        g = self.g = 2 if cell in ("quadrilateral", "triangle") else 3
        ends = [([2.5 * i, *[0.0] * (g - 1)], [2.5 * i + 2.0, *[1.0] * (g - 1)]) for i in range(n)]
        self.scene = scene(comm, cell, [box(cell, *end, [2, *[1] * (g - 1)]) for end in ends])
        self.V = compat.function_space(self.scene.mesh, 1, (g,))
        self.u, self.height = fem.Function(self.V, name="u"), height
        self.tags = [self.scene.tag(f"body {i}", i, lambda x: x[:, 0] >= -1.0) for i in range(n)]

    def at(self, x, y=None, z=None):
        """A position, on the line of the points by default."""
        return np.array([x, *(self.height if c is None else c for c in (y, z))])[: self.g]

    def part(self, i, **how):
        """Body i with its point."""
        return uem.RigidCoupling(self.tags[i], self.at(2.5 * i + 1.0), **how)


def quadratic(iterations):
    """Whether some residual is at most ten times the square of the one before it."""
    r = [i.residual for i in iterations]
    return any(1e-9 < a < 1e-2 and after <= 10.0 * a**2 + 1e-13 for a, after in zip(r, r[1:]))
