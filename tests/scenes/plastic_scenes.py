"""Bodies of von Mises material for the tests of the law, of limit loads and of the return mapping."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from dolfinx import fem
from helpers import Scene, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

E, NU, FY, H = 200.0, 0.3, 0.4, 15.0
MU = E / (2 * (1 + NU))


# -- scenes ------------------------------------------------------------------------------------------------------------


def block(comm: MPI.Comm, cell: str, n: int = 2, degree: int = 1, **how: Any) -> tuple[Scene, fem.Function]:
    """Unit square or cube with a displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], **how)
    return s, fem.Function(compat.function_space(s.mesh, degree, (g,)), name="u")


def reaction(problem: uem.UnitedProblem) -> float:
    """Work of the internal forces on the present displacement."""
    problem.bodies.assemble()
    r = problem.bodies.residual.array_r
    return problem.comm.allreduce(float(r @ problem.u.x.array[: len(r)]))
