"""Block on block, the scene of most tests: its bodies, their laws, poses of its surfaces, and its load steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from benchmarks.scenes import NU, Array, Scene, at, box, clamp, scene
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat


def arch(height: float, crown: float = 0.5) -> Callable[[Array], Array]:
    """Pose that bends the top of a lower block: an arch for a positive height, a bowl for a negative one."""

    def pose(x: Array) -> Array:
        y = x.copy()
        y[:, -1] -= height * np.where(x[:, -1] <= 1e-12, x[:, -1] + 1, 0.0) * (x[:, 0] - crown) ** 2
        return y

    return pose


def modulus(s: Scene, *E: float) -> fem.Function:
    """Young's modulus of each body as a DG0 field."""
    f = fem.Function(compat.function_space(s.mesh, ("DG", 0)), name="E")
    f.x.array[compat.cell_dofs(f.function_space)[:, 0]] = np.array(E, dtype=float)[s.body]
    return f


def linear(u: fem.Function, E: Any, nu: float = NU) -> ufl.Form:
    """Small-strain elasticity (plane strain in 2D)."""
    v, g = ufl.TestFunction(u.function_space), u.function_space.mesh.geometry.dim
    eps = ufl.sym(ufl.grad(u))
    sigma = E / (1 + nu) * (eps + nu / (1 - 2 * nu) * ufl.tr(eps) * ufl.Identity(g))
    return ufl.inner(sigma, ufl.sym(ufl.grad(v))) * ufl.dx


def st_venant(u: fem.Function, E: Any, nu: float = NU) -> ufl.Form:
    """St Venant-Kirchhoff (plane strain in 2D)."""
    v, g = ufl.TestFunction(u.function_space), u.function_space.mesh.geometry.dim
    F = ufl.Identity(g) + ufl.grad(u)
    strain = 0.5 * (F.T * F - ufl.Identity(g))
    S = E / (1 + nu) * (strain + nu / (1 - 2 * nu) * ufl.tr(strain) * ufl.Identity(g))
    return ufl.inner(F * S, ufl.grad(v)) * ufl.dx


@dataclass
class Blocks:
    """Two boxes, the upper on the lower, their tags and a displacement."""

    scene: Scene
    V: Any
    u: fem.Function
    bottom: uem.Tag
    low: uem.Tag
    high: uem.Tag
    top: uem.Tag
    n_high_nodes: int

    @property
    def gdim(self) -> int:
        return self.scene.mesh.geometry.dim

    def oedometer(self, settlement: float) -> list[fem.DirichletBC]:
        """Conditions of one-dimensional compression: rollers at the sides and the bottom, the top pushed down."""
        g, x = self.gdim, self.scene.drawing
        bcs = [*clamp(self.V, self.bottom, g - 1), *clamp(self.V, self.top, g - 1, value=-settlement)]
        for c in range(g - 1):
            for end, body in product((x[:, c].min(), x[:, c].max()), (0, 1)):
                bcs += clamp(self.V, self.scene.tag("side", body, at(c, end)), c)
        return bcs


def blocks(
    comm: MPI.Comm,
    cell: str,
    n_low: int = 2,
    n_high: int = 4,
    *,
    gap: float = 0.0,
    degree: int = 1,
    overhang: float = 0.0,
    **how: Any,
) -> Blocks:
    """Unit block on unit block; ``low`` and ``high`` are the surfaces that face each other, ``gap`` apart.

    Args:
        comm: communicator.
        cell: kind of cells.
        n_low: divisions of the lower block in every direction.
        n_high: divisions of the upper block.
        gap: between them.
        degree: of the displacement.
        overhang: by how much the lower block is wider on every side.
        how: see ``scene``.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    lower = box(cell, [-overhang] * (g - 1) + [-1.0], [1.0 + overhang] * (g - 1) + [0.0], [n_low] * g)
    upper = box(cell, [0.0] * (g - 1) + [gap], [1.0] * (g - 1) + [1.0 + gap], [n_high] * g)
    s = scene(comm, cell, [lower, upper], **how)
    V = compat.function_space(s.mesh, degree, (g,))
    return Blocks(
        s, V, fem.Function(V, name="u"),
        s.tag("bottom", 0, at(g - 1, -1.0)), s.tag("low", 0, at(g - 1, 0.0)),
        s.tag("high", 1, at(g - 1, gap)), s.tag("top", 1, at(g - 1, 1.0 + gap)), len(upper.x),
    )  # fmt: skip


def run(problem: uem.UnitedProblem, steps: int = 1) -> list[uem.LoadStep]:
    """All load steps."""
    return list(uem.load_steps(problem, steps))
