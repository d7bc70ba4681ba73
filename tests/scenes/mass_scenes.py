"""Boxes and their masses of every kind, for the tests of mass."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from helpers import box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
BUILD = {"lumped": uem.lumped_mass, "consistent": uem.consistent_mass}
KINDS = ("lumped", "consistent", "nodal", "nodal per component")


def dimension(cell):
    return 2 if cell in ("triangle", "quadrilateral") else 3


def space(s, degree=1):
    return compat.function_space(s.mesh, degree, (s.mesh.geometry.dim,))


def block(cell, n, degree=1, size=None, comm=COMM, **how):
    """Space of a box with ``n`` divisions in every direction."""
    g = dimension(cell)
    s = scene(comm, cell, [box(cell, [0.0] * g, size or [1.0] * g, np.broadcast_to(n, g))], **how)
    return space(s, degree)


def places(mass):
    """Owned nodes as drawn."""
    return mass.config.X[: mass.config.n_owned]


def make(kind, V, rho=1.3):
    """Mass of any kind that varies from place to place."""
    X = ufl.SpatialCoordinate(V.mesh)
    if kind in BUILD:
        return BUILD[kind](V, rho * (1 + X[0] ** 2))
    weight = uem.lumped_mass(V, rho)
    if kind == "nodal":
        return uem.nodal_mass(V, weight.of_nodes[:, 0] * (1 + places(weight)[:, 0]))
    return uem.nodal_mass(V, weight.of_nodes * (1 + places(weight)))
