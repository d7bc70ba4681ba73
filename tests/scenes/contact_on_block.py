"""A block with a round bottom on a wider one, which slides as it is pressed."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
#: A direct solver by name, for any size and dimension.
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


def pressed(law=linear, ratio=1.0, way=0.02, dim=2, friction=0.0, options=DIRECT):
    """A block with a round bottom, pressed into a wider one and pushed aside."""
    side, n = dim - 1, (16, 12) if dim == 2 else (6, 5)
    cell = "triangle" if dim == 2 else "tetrahedron"
    low = box(cell, [-0.5] * side + [-1.0], [1.5] * side + [0.0], [n[0]] * side + [8 // side])
    high = box(cell, [0.0] * dim, [1.0] * dim, [n[1]] * side + [6 // side])

    def pose(x):
        y = x.copy()
        bent = np.arange(len(x)) >= len(low.x)
        y[bent, side] += 0.2 * (1 - x[bent, side]) * ((x[bent, :side] - 0.5) ** 2).sum(axis=1)
        return y

    s = scene(COMM, cell, [low, high], pose=pose)
    V = compat.function_space(s.mesh, 1, (dim,))
    u = fem.Function(V)
    push = [way / 2, *[0.0] * (dim - 2), -way]
    bcs = [*clamp(V, s.tag("bottom", 0, at(side, -1.0))), *clamp(V, s.tag("top", 1, at(side, 1.0)), value=push)]
    contact = uem.Contact(s.tag("high", 1, at(side, 0.0)), s.tag("low", 0, at(side, 0.0)), sliding="finite", friction=friction)
    problem = uem.UnitedProblem(law(u, modulus(s, 1.0, ratio)), u, bcs=bcs, contacts=[contact], petsc_options=options)
    return s, contact, problem
