"""Bodies that loads alone move: boxes, discs and halves of discs under weight and tractions."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import box, linear, modulus, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD
LAWS = {"linear": linear, "finite": st_venant}


class Falling:
    """Bodies that fall under weight, or under tractions on named facets.

    Args:
        cell: kind of cells.
        bodies: boxes and others.
        law: ``"linear"`` or ``"finite"``.
        E: modulus of each body.
        how: see ``helpers.scene``.
    """

    def __init__(self, cell, bodies, law="linear", E=(1.0, 1.0), nu=0.0, comm=COMM, **how):
        self.s = scene(comm, cell, bodies, **how)
        self.g = self.s.mesh.geometry.dim
        self.V = compat.function_space(self.s.mesh, 1, (self.g,))
        self.u = fem.Function(self.V)
        self.F = LAWS[law](self.u, modulus(self.s, *E), nu)
        self.bodies = np.repeat(np.arange(len(bodies)), [len(b.x) for b in bodies])

    def weigh(self, *density, way=None):
        """Weight per volume of each body, against the last axis or another way up; it can be turned later."""
        load = self.load = fem.Constant(self.s.mesh, -(np.eye(self.g)[-1] if way is None else way))
        self.F -= ufl.inner(load, modulus(self.s, *density) * ufl.TestFunction(self.V)) * ufl.dx

    def pull(self, tag, traction):
        """Dead traction on facets."""
        t = fem.Constant(self.s.mesh, np.array(traction, dtype=float))
        self.F -= ufl.inner(t, ufl.TestFunction(self.V)) * forms.surface_measure(self.s.mesh, tag.entities)

    def problem(self, bcs=(), contacts=(), **options):
        self.contacts = list(contacts)
        self.p = uem.UnitedProblem(self.F, self.u, bcs=list(bcs), contacts=self.contacts, **options)
        return self.p

    def moved(self, body=None):
        """Displacements of a body's nodes, in the drawing's order, on every rank."""
        u = self.s.gather(self.u)
        return u if body is None else u[self.bodies == body]


def half_disc(n, middle=(0.0, 1.0), radius=1.0):
    """Lower half of a disc, flat above."""

    def onto(x):
        y = np.column_stack([x[:, 0] * np.sqrt(1 - x[:, 1] ** 2 / 2), x[:, 1] * np.sqrt(1 - x[:, 0] ** 2 / 2)])
        return radius * y + middle

    return box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [2 * n, n]).mapped(onto)


def arc(middle=(0.0, 1.0), radius=1.0):
    """Predicate of the nodes on a half disc's arc."""
    return lambda x: np.abs(np.linalg.norm(x - middle, axis=1) - radius) < 1e-9
