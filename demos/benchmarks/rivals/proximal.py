"""The latent variable proximal point method, also called proximal Galerkin, without friction, at the contactors.

B. Keith, T. M. Surowiec, Foundations of Computational Mathematics (2024); J. S. Dokken, P. E. Farrell, B. Keith, I. P. A. Papadopoulos,
T. M. Surowiec, Computer Methods in Applied Mechanics and Engineering 445 (2025).

The gap is d exp(psi) with a latent field psi on the contactor's surface, so that it is positive for every psi. With steps a(k) of the
proximal point method, and the area A of a contactor,

    F(u) = sum A lam grad g,    g(u) = d exp(psi),    lam = (psi(k-1) - psi) / a(k)

Areas lump the mass of psi. Newton's method in u and psi has a block for each node in psi, which is condensed: springs of the stiffness
A / (a d exp(psi)). This needs no forms of several meshes or of facets alone, and the matrix stays symmetric and positive definite.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from benchmarks.rivals.penalty import Ints, NodePoints, PenaltySystem, Springs, _past_the_end
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState

Array = np.ndarray
#: Each proximal step is so many times as long as the one before.
GROWTH = 2.0
#: The next one begins when forces, and gaps relative to the spacing of contactors, are left with this part.
INNER = 1e-2
#: At the end they are left with this part.
AT_END = 1e-6
#: Pressures do this part of the work of the force along the spacing of contactors, and less, over gaps at the end.
COMPLEMENTARY = 1e-6
#: Springs are at most so much stiffer than the bodies, beyond which digits of the displacement are lost.
STIFFEST = 1e4


class ProximalSystem(PenaltySystem):
    """Contact by a latent variable; arguments beyond those of ``PushedSystem``:

    Args:
        tags: contactor of every contact.
        stiffness: of the springs in the first proximal step, a pressure per length, which is its length.
        scale: stiffness of the bodies at the contactors, a pressure per length.
    """

    #: Steps are full, as in the papers.
    fits = True

    def __init__(self, *args: Any, tags: list[Any], stiffness: float, scale: float, **options: Any):
        super().__init__(*args, tags=tags, stiffness=stiffness, points=NodePoints, **options)
        self._first, self._cap = stiffness, STIFFEST * scale
        if any(pair.discretisation.traits.sliding == "finite" and self.config.degree > 1 for pair in self.pairs):
            raise SpaceError("areas of contactors that are zero or negative: take degree 1, or sliding='fixed'")
        areas = np.concatenate([points.area for points in self._points])
        sums = reduced(self.comm, np.array([areas.sum(), float(len(areas))]))
        self._d = float((sums[0] / max(sums[1], 1.0)) ** (1.0 / (self.config.gdim - 1)))
        self._psi, self._psi_before = ([np.zeros(len(points.area)) for points in self._points] for _ in range(2))

    def begin_step(self) -> None:
        """Begin a step: proximal steps are short again."""
        super().begin_step()
        self._psi, self._psi_before = ([np.zeros(len(points.area)) for points in self._points] for _ in range(2))
        self._length = 1.0 / (self._first * self._d)
        self._fresh = True

    def _slope(self, psi: Array) -> Array:
        """Derivative of the gap by the latent variable, not below what springs of the largest stiffness have."""
        return np.maximum(self._d * np.exp(np.clip(psi, -700.0, 700.0)), 1.0 / (self._length * self._cap))

    def _follow(self) -> None:
        """The latent variable after an increment of the displacement, by its condensed row."""
        for k, points in enumerate(self._points):
            gap, psi = points.project().gap, self._psi[k]
            slope = self._slope(psi)
            change = (gap - self._d * np.exp(np.clip(psi, -700.0, 700.0))) / slope
            # where the gap opens its logarithm is exact
            self._psi[k] = psi + np.where(change > 0.0, np.log1p(np.maximum(change, 0.0)), change)

    def _stretch(self) -> tuple[PETSc.Vec, float]:
        """Forces on the bodies, and by how much gaps differ from those of the latent variable at most (collective)."""
        self._springs, differ = [], 0.0
        total = self.config.vector()
        for k, (pair, points) in enumerate(zip(self.pairs, self._points)):
            p, psi = points.project(), self._psi[k]
            lam = (self._psi_before[k] - psi) / self._length
            off = p.gap - self._d * np.exp(np.clip(psi, -700.0, 700.0))
            force = points.area * (lam - off / (self._length * self._slope(psi))) * ~_past_the_end(p)
            s = Springs(points.nodes, points.shape, points.area, p, force)
            differ = max(differ, float(np.abs(off / np.maximum(p.gap, self._d)).max(initial=0.0)))
            self._springs.append(s)
            self._hand_on(total, s)
            self._tell(pair, s)
        total.assemble()
        return total, max(self.comm.allgather(differ))

    def _work(self) -> tuple[float, float]:
        """Work of the forces over the gaps, and of the forces over the spacing of contactors (collective)."""
        parts = [(np.abs(s.force * s.projection.gap).sum(), self._d * np.abs(s.force).sum()) for s in self._springs]
        work, size = reduced(self.comm, np.sum(parts, axis=0) if parts else np.zeros(2))
        return float(work), float(size)

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """Forces; the next proximal step where bodies and latent variable have come to rest."""
        F, P = self.bodies.residual, self.restriction()
        if not self._fresh:
            self._follow()
        self._fresh = False
        forces, differ = self._stretch()
        R, changed = P.reduce(F - forces), False
        rounding = self._rounding_of_springs()
        work, size = self._work()
        far = work > COMPLEMENTARY * size or differ > AT_END
        if far and differ <= INNER and R.norm() <= max(INNER * F.norm(), rounding):
            self._psi_before, self._psi = [np.array(psi) for psi in self._psi], list(self._psi)
            # the force stays as it is
            self._length *= GROWTH
            for k, s in enumerate(self._springs):
                area = np.where(s.area != 0.0, s.area, 1.0)
                self._psi[k] = self._psi_before[k] - self._length * np.maximum(s.force / area, 0.0)
            forces, _ = self._stretch()
            R, changed = P.reduce(F - forces), True
        return IterationState(
            trial=P, test=P, residual=R, norm=R.norm(), scale=F.norm(), rounding=rounding, gap=0.0,
            active=reduced(self.comm, sum(int(pair.united.sum()) for pair in self.pairs)), changed=changed, right=True,
            closed=self.bodies.dirichlet_met() and not far, in_contact=bool(self.pairs),
        )  # fmt: skip

    def tangent(self, state: IterationState, first: bool) -> PETSc.Mat:
        """Tangent of bodies and springs, which change in every iteration."""
        self.bodies.update_tangent()
        self._A = self._with_springs()
        self.solver.set_operator(state.trial, self._A, None)
        return self._A

    def _blocks(self, s: Springs, mu: float) -> tuple[Ints, Array]:
        """Global nodes and stiffness of every spring."""
        k = next(i for i, one in enumerate(self._springs) if one is s)
        nodes, weights = self._both(s)
        slope = (weights[:, :, None] * s.projection.normal[:, None, :]).reshape(len(nodes), nodes.shape[1] * self.config.gdim)
        stiffness = s.area / (self._length * self._slope(self._psi[k])) * ~_past_the_end(s.projection)
        return nodes, stiffness[:, None, None] * np.einsum("ki,kj->kij", slope, slope)

    def _tell(self, pair: Any, s: Springs) -> None:
        """Let the pair know the nodal contact forces: those that push (collective)."""
        super()._tell(pair, Springs(s.nodes, s.shape, s.area, s.projection, np.maximum(s.force, 0.0)))

    def longest(self, state: IterationState, dq: PETSc.Vec, du: PETSc.Vec) -> float:
        """Steps are full."""
        return 1.0
