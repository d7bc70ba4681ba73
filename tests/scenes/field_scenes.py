"""Block on block with other fields in addition to the displacement: pressures, temperatures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl
from benchmarks.scenes import NU, at
from block_scenes import Blocks
from dolfinx import fem

import uem_dolfinx as uem


@dataclass
class Fields:
    """A mixed space on blocks.

    Attributes:
        b: the blocks.
        w: Function of the space.
        displacement: which part of it is the displacement.
    """

    b: Blocks
    w: fem.Function
    displacement: int

    def split(self, f: Any) -> list[Any]:
        """Parts of a Function or of a test function, the displacement first."""
        parts = list(ufl.split(f))
        return [parts.pop(self.displacement), *parts]

    @property
    def space(self) -> Any:
        """The displacement's part of the space."""
        return self.w.function_space.sub(self.displacement)

    @property
    def other(self) -> Any:
        """The first of the other parts."""
        return self.w.function_space.sub(1 if self.displacement == 0 else 0)

    def rollers(self) -> list[Any]:
        """Of the bottom, and of the sides through the origin."""
        b, g = self.b, self.b.gdim
        sides = [b.scene.tag("side", body, at(c, 0.0)) for c in range(g - 1) for body in (0, 1)]
        bcs = [uem.dirichlet(self.space, side, c) for c in range(g - 1) for side in sides[2 * c : 2 * c + 2]]
        return [uem.dirichlet(self.space, b.bottom, g - 1), *bcs]

    def confined(self) -> list[Any]:
        """Rollers at all sides, and at the bottom."""
        b, g = self.b, self.b.gdim
        ends = [(c, b.scene.tag("side", body, at(c, end))) for c in range(g - 1) for end in (0.0, 1.0) for body in (0, 1)]
        return [uem.dirichlet(self.space, b.bottom, g - 1), *(uem.dirichlet(self.space, tag, c) for c, tag in ends)]


def fields(b: Blocks, degree: int, *others: Any, displacement: int = 0) -> Fields:
    """Blocks with other fields of these elements and a displacement of some degree."""
    parts = list(others)
    parts.insert(displacement, ("Lagrange", degree, (b.gdim,)))
    return Fields(b, fem.Function(uem.function_space(b.scene.mesh, parts)), displacement)


def strain(u: Any) -> Any:
    """Of small displacements."""
    return ufl.sym(ufl.grad(u))


def stress(u: Any, E: Any, nu: float = NU) -> Any:
    """Hooke's law (plane strain in 2D)."""
    eps = strain(u)
    return E / (1 + nu) * (eps + nu / (1 - 2 * nu) * ufl.tr(eps) * ufl.Identity(len(u)))


def with_pressure(f: Fields, E: float, nu: float) -> ufl.Form:
    """Small strains with the pressure as a field of its own, up to nu = 0.5; symmetric."""
    (u, p), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    mu, compliance = E / (2 * (1 + nu)), (1 - 2 * nu) * (1 + nu) / (E * nu)
    return (2 * mu * ufl.inner(strain(u), strain(v)) - p * ufl.div(v) - q * (ufl.div(u) + compliance * p)) * ufl.dx


def neo_hooke_with_pressure(f: Fields, E: float, nu: float) -> ufl.Form:
    """Finite strains with the pressure as a field of its own, up to nu = 0.5 (plane strain in 2D)."""
    (u, p), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    mu, compliance = E / (2 * (1 + nu)), (1 - 2 * nu) * (1 + nu) / (E * nu)
    F = ufl.Identity(len(u)) + ufl.grad(u)
    J, inverse = ufl.det(F), ufl.inv(F).T
    return (ufl.inner(mu * (F - inverse) - p * J * inverse, ufl.grad(v)) - q * (J - 1 + compliance * p)) * ufl.dx
