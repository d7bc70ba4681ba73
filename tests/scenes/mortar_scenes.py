"""Blocks of any meshes upon each other, for the tests of mortar."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, scene

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD


class Blocks:
    """Two blocks of any meshes between rollers; the upper one may be narrower, and surfaces may wave.

    Args:
        cell: of both bodies.
        n: divisions of the lower and of the upper block.
        degree: of the displacement.
        contactor: ``"upper"`` or ``"lower"``.
        seed: moves the inner nodes of the surfaces at random.
        narrow: width of the upper block.
        wave: height of waves of both surfaces.
        hollow: inner radius of axisymmetric blocks, rings if it is positive; None are blocks in the plane.
        how: arguments of the contact.
    """

    def __init__(
        self,
        cell,
        n=(5, 3),
        degree=1,
        contactor="upper",
        *,
        seed=None,
        narrow=1.0,
        wave=0.0,
        gap=0.0,
        comm=COMM,
        E=(1.0, 2.0),
        hollow=None,
        **how,
    ):
        g = 2 if cell in ("triangle", "quadrilateral") else 3
        self.g, self.comm, rng = g, comm, np.random.default_rng(seed)

        def moved(body, k):
            x, h = body.x.copy(), 1.0 / k
            if seed is not None:
                inner = (x[:, : g - 1] > 1e-9) & (x[:, : g - 1] < 1 - 1e-9)
                x[:, : g - 1] += 0.25 * h * rng.uniform(-1, 1, inner.shape) * inner
            x[:, -1] += wave * np.sin(7 * x[:, 0]) * np.prod(1 + 0.3 * x[:, : g - 1], axis=1)
            return replace(body, x=x)

        bodies = [box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], [n[0]] * g)]
        bodies.append(box(cell, [0.0] * (g - 1) + [gap], [narrow] * (g - 1) + [1.0 + gap], [n[1]] * g))
        tagged = scene(comm, cell, bodies)
        self.scene = s = scene(comm, cell, [moved(body, k) for body, k in zip(bodies, n)])
        s.drawing = tagged.drawing
        if hollow is not None:
            s.mesh.geometry.x[:, 0] += hollow
            uem.axisymmetric(s.mesh)
        self.V = compat.function_space(s.mesh, degree, (g,))
        self.u = fem.Function(self.V)
        self.low, self.high = s.tag("low", 0, at(g - 1, 0.0)), s.tag("high", 1, at(g - 1, gap))
        self.top, self.E = s.tag("top", 1, at(g - 1, 1.0 + gap)), modulus(s, *E)
        pair = (self.high, self.low) if contactor == "upper" else (self.low, self.high)
        self.contact = uem.Contact(*pair, coupling="mortar", **how)
        self.bcs = clamp(self.V, s.tag("bottom", 0, at(g - 1, -1.0)), g - 1)
        for c, end, body in product(range(g - 1), (0.0, narrow, 1.0), (0, 1)):
            self.bcs += clamp(self.V, s.tag("side", body, at(c, end)), c)

    def problem(self, F, **how):
        return uem.UnitedProblem(F, self.u, bcs=self.bcs, contacts=[self.contact], **how)

    def pressed(self, p=1e-3, **how):
        v = ufl.TestFunction(self.V)
        load = p * v[self.g - 1] * forms.surface_measure(self.scene.mesh, self.top.entities)
        return self.problem(linear(self.u, self.E) + load, **how)


def disturbed(b, seed, size):
    """Both bodies displaced at random, alike on any number of ranks."""
    x = b.contact.pair.config.X if b.contact.taken else b.V.tabulate_dof_coordinates()[:, : b.g]
    rng = np.random.default_rng(seed)
    k, phase = 9 * rng.standard_normal((b.g, b.g)), rng.uniform(0, 6, b.g)
    b.u.x.array[:] = (size * np.sin(x @ k + phase)).ravel()[: len(b.u.x.array)]
    b.u.x.scatter_forward()
