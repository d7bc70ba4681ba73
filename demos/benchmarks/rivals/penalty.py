"""The penalty method and the augmented Lagrange method of Uzawa, on the surfaces, search and Newton loop of the package.

Points of the contactor surface are pushed back by springs, t = <lam - stiffness * area * gap>, that act on the nodes of the
contactor's facet and of the target's with their shape functions. The points are the contactors themselves (node to surface) or
quadrature points of the contactor's facets (integrated over the surface). Newton's method gets the exact tangent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from benchmarks.rivals.line_search import flat_length
from benchmarks.rivals.pushed import PushedSystem
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.log import timed
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState
from uem_dolfinx.geometry.projection import FacetProjection, Projection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.surfaces import tributary_areas
from uem_dolfinx.solve.bodies.bodies import FORCE_ROUNDING
from uem_dolfinx.solve.bodies.tangent import contact_curvature
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.solve.bodies.bodies import Bodies
    from uem_dolfinx.geometry.gmsh import Tag
    from uem_dolfinx.contact.pair.interface import Interface

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: A multiplier is brought up to date when the bodies are in equilibrium to this part of the forces.
IN_EQUILIBRIUM = 1e-7
#: The target's end holds points up to this part of its facet beyond.
HELD_AT_END = 1e-3
#: After so many full Newton steps of a load step the line search sees to it that springs do not come and go for ever.
FULL_STEPS = 2
#: So near to equilibrium, as part of the forces, Newton's method needs no line search.
NEAR_BY = 1e-5
#: After so many steps normals are averaged, so that they no longer jump under a point at a vertex.
AVERAGED_AFTER = 8


@dataclass(frozen=True)
class Springs:
    """Points of a contactor surface, and where they stand relative to the target.

    Attributes:
        nodes: local nodes that each point moves with ``(k, nb)``.
        shape: their shape functions ``(k, nb)``.
        area: reference area that each point stands for ``(k,)``.
        projection: of the points onto the target.
        force: with which each is pushed along the normal ``(k,)``.
        friction: force of friction on each ``(k, gdim)``, and what it would be without slip; None without friction.
    """

    nodes: Ints
    shape: Array
    area: Array
    projection: Projection
    force: Array
    friction: tuple[Array, Array] | None = None


def facet_rule(cell: str, n: int) -> tuple[Array, Array]:
    """Gauss points ``(k, fdim)`` and weights of a reference facet, n in every direction; on a triangle they collapse at a corner."""
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = 0.5 * (x + 1), 0.5 * w
    if cell == "interval":
        return x[:, None], w
    a, b = (grid.ravel() for grid in np.meshgrid(x, x, indexing="ij"))
    weights = np.outer(w, w).ravel()
    if cell == "quadrilateral":
        return np.column_stack([a, b]), weights
    return np.column_stack([a, b * (1 - a)]), weights * (1 - a)


def _past_the_end(projection: Projection) -> npt.NDArray[np.bool_]:
    """Points that have slid off the target; the end holds those that are near it ``(k,)``."""
    beyond = np.linalg.norm(projection.beyond, axis=1)
    if not isinstance(projection, FacetProjection):
        return beyond > 0
    return beyond > HELD_AT_END * np.linalg.norm(projection.x[:, 0] - projection.x[:, 1], axis=1)


class NodePoints:
    """The contactors themselves, each with its tributary area."""

    def __init__(self, pair: Interface, tag: Tag):
        self.pair = pair
        self.nodes = pair.nodes[:, None].astype(np.int64)
        self.shape = np.ones((len(pair.nodes), 1))
        self.area = tributary_areas(pair.config, tag)[pair.nodes]

    def project(self) -> Projection:
        """Where the points stand; the pair knows (collective)."""
        return self.pair.kinematics.projection

    def begin(self) -> None:
        """Begin a step."""


class SurfacePoints:
    """Quadrature points of the contactor's facets."""

    def __init__(self, pair: Interface, tag: Tag):
        self.pair, config = pair, pair.config
        facets = TargetFacets(config, tag)
        xi, w = facet_rule(facets.shape.cell, config.degree + 1)
        tab = facets.shape.tabulate(xi)
        t = np.einsum("qaf,mag->mqfg", tab.dN, config.X[facets.dofs])
        stretch = np.sqrt(np.linalg.det(np.einsum("mqfg,mqeg->mqfe", t, t)))
        self.area = (stretch * w).ravel()
        self.nodes = np.repeat(facets.dofs, len(w), axis=0).astype(np.int64)
        self.shape = np.tile(tab.N, (len(facets.dofs), 1))
        self._anchor: Any = None

    def project(self) -> Projection:
        """Where the points stand (collective)."""
        points = np.einsum("ka,kag->kg", self.shape, self.pair.config.x[self.nodes])
        if self.pair.discretisation.traits.sliding == "finite" or self._anchor is None:
            projection = self._anchor = self.pair.target.project(points)
            return projection
        return self.pair.target.follow(points, self._anchor)

    def begin(self) -> None:
        """Begin a step: small sliding looks for its feet anew."""
        if self.pair.discretisation.traits.sliding == "small":
            self._anchor = None


class PenaltySystem(PushedSystem):
    """Contact by springs; arguments beyond those of ``PushedSystem``:

    Args:
        tags: contactor of every contact.
        stiffness: of the springs, a pressure per length.
        points: ``NodePoints`` or ``SurfacePoints``.
        overlap: at which the multipliers are good enough, as part of the model's size; None is plain penalty.
        friction: coefficient of every contact.
    """

    def __init__(
        self,
        bodies: Bodies,
        pairs: list[Interface],
        solver: UnitedSolver,
        *,
        tags: list[Tag],
        stiffness: float,
        points: type,
        overlap: float | None = None,
        friction: Sequence[float] = (),
        **options: Any,
    ):
        self._stiffness_of_springs, self._overlap, self._mu = stiffness, overlap, list(friction) or [0.0] * len(pairs)
        self._springs: list[Springs] = []
        self._A: PETSc.Mat | None = None
        for pair in pairs:
            # springs know nothing of control gaps
            pair.discretisation = NodeToSurface.like(pair.discretisation)
        super().__init__(bodies, pairs, solver, **options)
        self._points = [points(pair, tag) for pair, tag in zip(pairs, tags)]
        self._none = [np.zeros(len(p.area)) for p in self._points]
        self._multipliers = self._committed = self._none
        self._frictional = any(self._mu)
        #: Friction at the start of the step, with Uzawa as last brought up to date, and the displacement there.
        self._held = self._held_before = [np.zeros((len(p.area), self.config.gdim)) for p in self._points]
        self._start = np.array(self.config.displacement)
        self._known = [pair.committed for pair in pairs]
        self._averaged = [pair.target.averaged for pair in pairs]

    def begin_step(self) -> None:
        """Begin a step with the multipliers of the last converged one."""
        super().begin_step()
        committed = [pair.committed for pair in self.pairs]
        if any(now is not then for now, then in zip(committed, self._known)):
            self._committed = [s.force for s in self._springs]
            self._held_before = [s.friction[0] if s.friction else held for s, held in zip(self._springs, self._held_before)]
        self._known, self._held, self._start = committed, list(self._held_before), np.array(self.config.displacement)
        for pair, points, averaged in zip(self.pairs, self._points, self._averaged):
            points.begin()
            if isinstance(pair.target, MeshTarget):
                pair.target.averaged = averaged
        self._multipliers = list(self._committed if self._overlap else self._none)

    # -- forces of the springs ---------------------------------------------------------------------------------------------

    def _stretch(self) -> tuple[PETSc.Vec, float]:
        """Forces of the springs on the bodies, and the deepest overlap (collective); keeps the springs."""
        self._springs, overlap = [], 0.0
        total = self.config.vector()
        for k, (pair, points) in enumerate(zip(self.pairs, self._points)):
            p = points.project()
            force = np.maximum(self._multipliers[k] - self._stiffness_of_springs * points.area * p.gap, 0.0) * ~_past_the_end(p)
            s = Springs(points.nodes, points.shape, points.area, p, force)
            pushed = force > 0
            overlap = max(overlap, float(np.max(np.abs(p.gap) if self._overlap else -p.gap, where=pushed, initial=0.0)))
            if self._mu[k]:
                s, crept = self._rub(k, s)
                overlap = max(overlap, crept if self._overlap else 0.0)
            self._springs.append(s)
            self._hand_on(total, s)
            self._tell(pair, s)
        total.assemble()
        return total, max(self.comm.allgather(overlap))

    def _rub(self, k: int, s: Springs) -> tuple[Springs, float]:
        """Springs along the target that slip on Coulomb's cone, and how far the others have crept (collective)."""
        p, config = s.projection, self.config
        moved = config.displacement - self._start
        along = np.einsum("ka,kag->kg", s.shape, moved[s.nodes])
        if p.nodes.shape[1]:
            theirs = config.ask_owners(p.nodes.ravel(), moved[: config.n_owned]).reshape(*p.nodes.shape, config.gdim)
            along = along - np.einsum("ka,kag->kg", p.weights, theirs)
        without_slip = self._held[k] - self._stiffness_of_springs * s.area[:, None] * along
        without_slip -= np.einsum("kg,kg->k", without_slip, p.normal)[:, None] * p.normal
        size, most = np.linalg.norm(without_slip, axis=1), self._mu[k] * s.force
        slips = size > most
        friction = without_slip * np.where(slips, most / np.where(size > 0, size, 1.0), 1.0)[:, None]
        along -= np.einsum("kg,kg->k", along, p.normal)[:, None] * p.normal
        crept = np.linalg.norm(along, axis=1).max(where=~slips & (s.force > 0), initial=0.0)
        return replace(s, friction=(friction, without_slip)), float(crept)

    def _hand_on(self, total: PETSc.Vec, s: Springs) -> None:
        """Add the forces of a pair's springs at the nodes of both bodies."""
        g = self.config.gdim
        nodes, weights = self._both(s)
        push = s.force[:, None] * s.projection.normal + (s.friction[0] if s.friction else 0.0)
        t = weights[..., None] * push[:, None, :]
        rows = (nodes[..., None] * g + np.arange(g)).ravel().astype(PETSc.IntType)
        total.setValues(rows, t.ravel(), addv=PETSc.InsertMode.ADD)

    def _both(self, s: Springs) -> tuple[Ints, Array]:
        """Global nodes on both sides of each spring, and the weights of the gap in their displacements ``(k, nb + nn)``."""
        return (
            np.concatenate([self.config.to_global(s.nodes), s.projection.nodes], axis=1),
            np.concatenate([s.shape, -s.projection.weights], axis=1),
        )

    def _tell(self, pair: Interface, s: Springs) -> None:
        """Let the pair know the nodal contact forces (collective)."""
        on_node = s.shape * s.force[:, None]
        lam = self.config.to_owners(s.nodes.ravel(), on_node.ravel())[pair.nodes]
        parts = (on_node[..., None] * s.projection.normal[:, None, :]).reshape(-1, self.config.gdim)
        force = np.column_stack([self.config.to_owners(s.nodes.ravel(), f)[pair.nodes] for f in parts.T])
        pair.set_forces(Traction(lam, lam, force), active=lam > 0)

    # -- the loop's questions ----------------------------------------------------------------------------------------------

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """Forces of the springs; Uzawa's update of the multipliers where the bodies have come to rest."""
        F = self.bodies.residual
        P = self.restriction()
        with timed("springs"):
            forces, overlap = self._stretch()
            R = P.reduce(F - forces)
            changed, rounding = False, self._rounding_of_springs()
            deep = self._overlap is not None and overlap > self._overlap * self.config.size
            if deep and R.norm() <= max(IN_EQUILIBRIUM * F.norm(), rounding):
                self._multipliers = [s.force for s in self._springs]
                self._held = [s.friction[0] if s.friction else held for s, held in zip(self._springs, self._held)]
                forces, _ = self._stretch()
                R, changed = P.reduce(F - forces), True
        return IterationState(
            trial=P,
            test=P,
            residual=R,
            norm=R.norm(),
            scale=F.norm(),
            rounding=rounding,
            gap=overlap,
            active=reduced(self.config.comm, sum(int(pair.united.sum()) for pair in self.pairs)),
            changed=changed,
            right=True,
            closed=self.bodies.dirichlet_met() and not deep,
            in_contact=bool(self.pairs),
        )

    def _rounding_of_springs(self) -> float:
        """Norm of the forces that rounding of positions can make, in bodies and springs (collective)."""
        rounding = self.rounding()
        for s in self._springs:
            on = s.force > 0
            x = np.abs(self.config.x[s.nodes[on, 0]]).max(initial=0.0)
            stiffest = (self._stiffness_of_springs * s.area[on]).max(initial=0.0) * np.sqrt(max(on.sum(), 1))
            rounding += FORCE_ROUNDING * max(self.comm.allgather(float(x * stiffest)))
        return rounding

    def tangent(self, state: IterationState, first: bool) -> PETSc.Mat:
        """Tangent of bodies and springs."""
        if first or self.newton == "full":
            self.bodies.update_tangent()
        self._solves = 1 if first else self._solves + 1
        if self._solves == AVERAGED_AFTER:
            for pair in self.pairs:
                if isinstance(pair.target, MeshTarget):
                    pair.target.averaged = True
        sliding = any(pair.discretisation.traits.sliding == "finite" for pair in self.pairs)
        on = hash(tuple((s.force > 0).tobytes() for s in self._springs))
        made_of = self.comm.allgather((self.bodies.tangent.number, on))
        if self._A is None or sliding or self._frictional or made_of != self.made_of:
            with timed("springs"):
                A = self._with_springs()
            self.solver.set_operator(state.trial, A, None)
            self._A = A
        self.made_of = made_of
        return self._A

    def _with_springs(self) -> PETSc.Mat:
        """``K + sum stiffness area grad g grad g' - t grad^2 g`` over the springs that push (collective)."""
        blocks = [self._blocks(s, mu) for s, mu in zip(self._springs, self._mu)]
        A = self.bodies.tangent.K.copy()
        if self.comm.allreduce(sum(len(nodes) for nodes, _ in blocks)):
            A.axpy(1.0, contact_curvature(blocks, self.config.vector()), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return A

    def _blocks(self, s: Springs, mu: float) -> tuple[Ints, Array]:
        """Global nodes and stiffness of each spring that pushes."""
        i = np.flatnonzero(s.force > 0)
        nodes, weights = self._both(s)
        nodes, size = nodes[i], nodes.shape[1] * self.config.gdim
        slope = (weights[i, :, None] * s.projection.normal[i, None, :]).reshape(len(i), size)
        blocks = self._stiffness_of_springs * s.area[i, None, None] * np.einsum("ki,kj->kij", slope, slope)
        finite = isinstance(s.projection, FacetProjection) or s.projection.nodes.shape[1] == 0
        if finite and self.consistent_tangent and any(pair.discretisation.traits.sliding == "finite" for pair in self.pairs):
            blocks -= s.force[i, None, None] * self._shape_operator(s, i)
        if s.friction:
            blocks += self._friction_blocks(s, i, weights[i], mu)
        return nodes, blocks

    def _friction_blocks(self, s: Springs, i: Ints, weights: Array, mu: float) -> Array:
        """Stiffness of friction: of springs along the target where they hold, of the cone where they slip."""
        n, (_, without_slip), g = s.projection.normal[i], s.friction, self.config.gdim
        size, most = np.linalg.norm(without_slip[i], axis=1), mu * s.force[i]
        across = np.eye(g) - n[:, :, None] * n[:, None, :]
        way = without_slip[i] / np.where(size > 0, size, 1.0)[:, None]
        turned = np.eye(g) - way[:, :, None] * way[:, None, :]
        slips = (size > most)[:, None, None]
        part = np.where(slips, (most / np.where(size > 0, size, 1.0))[:, None, None] * turned @ across, across)
        part = part + np.where(slips, mu * way[:, :, None] * n[:, None, :], 0.0)
        part = part * (self._stiffness_of_springs * s.area[i])[:, None, None]
        k, m = weights.shape
        return np.einsum("ka,kgh,kb->kagbh", weights, part, weights).reshape(k, m * g, m * g)

    def _shape_operator(self, s: Springs, i: Ints) -> Array:
        """Second derivative of the gap in the displacements of the nodes on both sides."""
        H = s.projection.hessians(i)
        nb, nn, g = s.shape.shape[1], s.projection.nodes.shape[1], self.config.gdim
        spread = np.zeros((len(i), 1 + nn, nb + nn))
        spread[:, 0, :nb] = s.shape[i]
        spread[:, np.arange(1, 1 + nn), nb + np.arange(nn)] = 1.0
        H = H.reshape(len(i), 1 + nn, g, 1 + nn, g)
        return np.einsum("kpa,kpgqh,kqb->kagbh", spread, H, spread, optimize=True).reshape(len(i), (nb + nn) * g, (nb + nn) * g)

    def longest(self, state: IterationState, dq: PETSc.Vec, du: PETSc.Vec) -> float:
        """Part of the increment along which the potential falls, after some full steps."""
        slope = dq.dot(state.residual)
        # friction has no potential
        if (
            self._frictional
            or self._solves <= FULL_STEPS
            or state.norm <= NEAR_BY * state.scale
            or state.trial.c.norm() > 0.0
            or slope >= 0.0
        ):
            return 1.0
        start = self.bodies.displacement()

        def look(length: float) -> tuple[float, float]:
            self.bodies.displace(start, du, length)
            if self.bodies.inverted() is not None or not self.bodies.assemble():
                return np.inf, np.inf
            self.place()
            residual = self.reduced_residual(state)
            return float(dq.dot(residual)), residual.norm()

        length = flat_length(look, (slope, state.norm))
        self.bodies.displace(start, du, 0.0)
        return length

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """Out-of-balance forces at the present displacement (collective)."""
        forces, _ = self._stretch()
        return state.test.reduce(self.bodies.residual - forces)
