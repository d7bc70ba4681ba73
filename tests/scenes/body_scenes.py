"""Many bodies, their surfaces as one skin, and what may touch what, found by loops over all nodes and facets."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from helpers import box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.skin import Skin

COMM = MPI.COMM_WORLD


def dimension(cell):
    return 2 if cell in ("triangle", "quadrilateral") else 3


def ball(cell, middle, radius, n):
    """Disc or ball whose surface has n facets, or n x n, on each of the sides of a box."""
    g = dimension(cell)

    def rounded(x):
        side, y = np.abs(x).max(axis=1, keepdims=True), np.tan(0.25 * np.pi * x)
        length = np.linalg.norm(y, axis=1, keepdims=True)
        return np.asarray(middle) + radius * side * y / np.where(length > 0, length, 1.0)

    return box(cell, [-1.0] * g, [1.0] * g, [n] * g).mapped(rounded)


def turned(body, angle):
    """A body turned about its middle, in the plane of the first two axes."""
    R = np.eye(body.x.shape[1])
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    middle = 0.5 * (body.x.min(axis=0) + body.x.max(axis=0))
    return body.mapped(lambda x: middle + (x - middle) @ R.T)


def all_facets(mesh, name="all"):
    """The exterior facets of a mesh."""
    mesh.topology.create_connectivity(mesh.topology.dim - 1, mesh.topology.dim)
    facets = np.asarray(exterior_facet_indices(mesh.topology), dtype=np.int32)
    return uem.Tag(name, 0, mesh.topology.dim - 1, mesh, facets)


def skin_of(cell, bodies, degree=1, comm=COMM, tag=None, **how):
    """Scene of bodies and the skin of all of them, or of what ``tag`` makes of the scene."""
    s = scene(comm, cell, bodies, **how)
    config = Configuration(fem.Function(compat.function_space(s.mesh, degree, (dimension(cell),))))
    return s, Skin(config, all_facets(s.mesh) if tag is None else tag(s))
