"""The Incremental Potential Contact barrier (ipctk), as the reference for robustness; serial, degree 1.

Nodes of the two surfaces that come nearer than a distance dhat are pushed apart by a potential that is infinite at contact,
in its physical scaling (stiffness in Pa, weights by area). No step may pass through anything: its length is bounded by
continuous collision detection. Bodies that touch at the start are lifted by half of dhat first, since the barrier knows no contact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import ipctk
import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import coo_matrix

from benchmarks.rivals.line_search import flat_length
from benchmarks.rivals.pushed import PushedSystem
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.errors import ConvergenceError, SpaceError
from uem_dolfinx.log import timed
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.surfaces import tributary_areas
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.solve.bodies.bodies import Bodies
    from collections.abc import Sequence

    from uem_dolfinx.contact.contact import Contact
    from uem_dolfinx.contact.pair.interface import Interface

Array = npt.NDArray[np.float64]

#: A step that would collide is shortened to this part of the way to the collision.
SHY = 0.9
#: Surfaces nearer than this part of dhat are given up.
CRUSHED = 1e-7
#: So many iterations in a row they may be that near.
MOST_SQUEEZES = 20
#: Bodies nearer than this part of dhat at the start are lifted.
TOO_NEAR = 1e-3


class BarrierSystem(PushedSystem):
    """Contact by a barrier; arguments beyond those of ``PushedSystem``:

    Args:
        contacts: the contacts of the problem.
        distance: dhat, at which the barrier begins, a length.
        stiffness: of the barrier, a pressure; None takes the mean diagonal of K over the nodes' mean spacing.
    """

    def __init__(
        self,
        bodies: Bodies,
        pairs: list[Interface],
        solver: UnitedSolver,
        *,
        contacts: Sequence[Contact],
        distance: float,
        stiffness: float | None = None,
        **options: Any,
    ):
        self._contacts, self.distance, self.stiffness = list(contacts), distance, stiffness
        super().__init__(bodies, pairs, solver, **options)
        if self.comm.size > 1 or self.config.degree > 1:
            raise SpaceError("the barrier is for one rank and degree 1: ipctk takes straight surfaces, whole")
        self._make_collision_mesh()

    def _make_collision_mesh(self) -> None:
        """Collision mesh of the pairs' surfaces."""
        config = self.config
        surfaces = [TargetFacets(config, contact.contactor) for contact in self._contacts]
        meshed = [pair.target.facets for pair in self.pairs if isinstance(pair.target, MeshTarget)]
        self._areas = [
            tributary_areas(config, contact.contactor)[pair.nodes] for contact, pair in zip(self._contacts, self.pairs)
        ]
        self._mesh: Any = None
        if meshed:
            facets = np.concatenate([s.dofs for s in [*surfaces, *meshed]])
            self._nodes, inverse = np.unique(facets, return_inverse=True)
            facets = inverse.reshape(facets.shape)
            X = np.asfortranarray(config.X[self._nodes])
            if config.gdim == 2:
                self._mesh = ipctk.CollisionMesh(X, np.asfortranarray(facets.astype(np.int32)))
            else:
                faces = facets if facets.shape[1] == 3 else np.concatenate([facets[:, [0, 1, 3]], facets[:, [0, 3, 2]]])
                faces = np.asfortranarray(np.unique(faces, axis=0).astype(np.int32))
                self._mesh = ipctk.CollisionMesh(X, ipctk.edges(faces), faces)
            self._mesh.can_collide = ipctk.make_vertex_patches_filter(find_bodies(config)[0][self._nodes].astype(np.int32))
        self._collisions = ipctk.NormalCollisions()
        self._collisions.use_area_weighting = True

    # -- the potential -----------------------------------------------------------------------------------------------------

    def _vertices(self, displacement: Array | None = None) -> Array:
        u = self.config.displacement if displacement is None else displacement.reshape(-1, self.config.gdim)
        return np.asfortranarray(self.config.X[self._nodes] + u[self._nodes])

    @property
    def _pressure(self) -> float:
        """Stiffness of the barrier."""
        if self.stiffness is None:
            self.bodies.update_tangent()
            spacing = np.concatenate(self._areas).mean() ** (1.0 / (self.config.gdim - 1))
            diagonal = self.bodies.stiffness.ravel()
            self.stiffness = float(diagonal[diagonal > 0].min()) / spacing ** (self.config.gdim - 2)
        return self.stiffness

    @property
    def _potential(self) -> Any:
        return ipctk.BarrierPotential(self.distance, self._pressure, True)

    def _push(self) -> Array:
        """Forces of the barrier on all nodes ``(n, gdim)``; keeps the collisions, and reports the pairs."""
        forces = np.zeros((self.config.n_local, self.config.gdim))
        if self._mesh is not None:
            V = self._vertices()
            self._collisions.build(self._mesh, V, self.distance)
            gradient = self._potential.gradient(self._collisions, self._mesh, V)
            forces[self._nodes] -= np.asarray(gradient).reshape(-1, self.config.gdim)
        for pair, areas in zip(self.pairs, self._areas):
            p = pair.kinematics.projection
            if not isinstance(pair.target, MeshTarget):
                forces[pair.nodes] -= (areas * self._rigid(p.gap)[0])[:, None] * p.normal
            force = forces[pair.nodes]
            lam = np.einsum("ng,ng->n", force, p.normal)
            pair.set_forces(Traction(lam, lam, force), active=lam > 0)
        return forces

    def _rigid(self, gap: Array) -> tuple[Array, Array]:
        """First and second derivative of the potential per area at distances from a rigid surface."""
        d2, h2 = gap**2, self.distance**2
        scale = self._pressure * self.distance / h2**2
        near = (gap > 0) & (gap < self.distance)
        first, second = np.zeros_like(gap), np.zeros_like(gap)
        for i in np.flatnonzero(near):
            b1, b2 = ipctk.barrier_first_derivative(d2[i], h2), ipctk.barrier_second_derivative(d2[i], h2)
            first[i], second[i] = 2 * gap[i] * b1, 2 * b1 + 4 * d2[i] * b2
        return scale * first, scale * second

    def _hessian(self) -> PETSc.Mat:
        """``K`` with the barrier's second derivative, made positive."""
        A = self.bodies.tangent.K.copy()
        rows, columns, values = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)], [np.zeros(0)]
        g = self.config.gdim
        if self._mesh is not None:
            H = self._potential.hessian(self._collisions, self._mesh, self._vertices(), ipctk.PSDProjectionMethod.CLAMP).tocoo()
            rows.append(self._nodes[H.row // g] * g + H.row % g)
            columns.append(self._nodes[H.col // g] * g + H.col % g)
            values.append(H.data)
        for pair, areas in zip(self.pairs, self._areas):
            if not isinstance(pair.target, MeshTarget):
                n = pair.kinematics.projection.normal
                blocks = (
                    (areas * np.maximum(self._rigid(pair.kinematics.projection.gap)[1], 0.0))[:, None, None]
                    * n[:, :, None]
                    * n[:, None, :]
                )
                dofs = pair.nodes[:, None] * g + np.arange(g)
                rows.append(np.broadcast_to(dofs[:, :, None], blocks.shape).ravel())
                columns.append(np.broadcast_to(dofs[:, None, :], blocks.shape).ravel())
                values.append(blocks.ravel())
        S = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=A.getSize()).tocsr()
        if S.nnz:
            csr = (S.indptr.astype(PETSc.IntType), S.indices.astype(PETSc.IntType), S.data)
            A.axpy(
                1.0, PETSc.Mat().createAIJ(A.getSizes(), csr=csr, comm=self.comm), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            )
        return A

    # -- the loop's questions ----------------------------------------------------------------------------------------------

    def begin_step(self) -> None:
        """Begin a step; bodies that are too near for the barrier are lifted."""
        super().begin_step()
        self._squeezes = 0
        for pair in self.pairs:
            self.place()
            gap = np.where(pair.off, np.inf, pair.kinematics.projection.gap)
            near = gap.min(initial=np.inf)
            if near < TOO_NEAR * self.distance:
                body, _ = find_bodies(self.config)
                normal = pair.kinematics.projection.normal[gap.argmin()]
                self.config.displacement[body == body[pair.nodes[0]]] += (0.5 * self.distance - near) * normal
        self.place()

    def _out_of_balance(self, restriction: Restriction) -> PETSc.Vec:
        R = self.bodies.residual
        R.array[:] -= self._push()[: self.config.n_owned].ravel()
        return restriction.reduce(R)

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """Forces of the barrier."""
        P = self.restriction()
        with timed("barrier"):
            R = self._out_of_balance(P)
        return IterationState(
            trial=P,
            test=P,
            residual=R,
            norm=R.norm(),
            scale=self.bodies.residual.norm(),
            rounding=self.rounding(),
            gap=0.0,
            active=reduced(self.config.comm, sum(int(pair.united.sum()) for pair in self.pairs)),
            changed=False,
            right=True,
            closed=self.bodies.dirichlet_met(),
            in_contact=bool(self.pairs),
        )

    def tangent(self, state: IterationState, first: bool) -> PETSc.Mat:
        """Tangent of bodies and barrier."""
        self.bodies.update_tangent()
        with timed("barrier"):
            A = self._hessian()
        self.solver.set_operator(state.trial, A, None)
        # the solver distinguishes matrices by their handles, so that one must live until the next is made
        self._A = A
        return A

    #: ``longest`` has searched along the line.
    fits = True

    def longest(self, state: IterationState, dq: PETSc.Vec, du: PETSc.Vec) -> float:
        """Part of the increment that meets nothing on its way and does not pass the potential's minimum."""
        start = np.array(self.bodies.u.x.array)
        step = du.array_r.copy()
        with timed("barrier"):
            length = self._free_way(start, step)
            slope = dq.dot(state.residual)
            if state.trial.c.norm() == 0.0 and slope < 0.0:

                def look(length: float) -> tuple[float, float]:
                    self.bodies.u.x.array[:] = start + length * step
                    self.place()
                    if self.bodies.inverted() is not None or not self.bodies.assemble():
                        return np.inf, np.inf
                    residual = self._out_of_balance(state.trial)
                    return float(dq.dot(residual)), residual.norm()

                length = flat_length(look, (slope, state.norm), length)
        self.bodies.u.x.array[:] = start
        self.place()
        return length

    def _free_way(self, start: Array, step: Array) -> float:
        """Part of a step that meets nothing."""
        length = 1.0
        if self._mesh is not None:
            self._squeezes = self._squeezes + 1 if self._squeezed() else 0
            if self._squeezes > MOST_SQUEEZES:
                raise ConvergenceError(
                    f"the barrier is squeezed to less than {CRUSHED:.0e} of its distance {self.distance:.3g}: take smaller steps"
                )
            ends = self._vertices(start), self._vertices(start + step)
            # the default one's tree of intervals can outgrow any memory
            free = ipctk.compute_collision_free_stepsize(self._mesh, *ends, narrow_phase_ccd=ipctk.AdditiveCCD())
            length = free if free == 1.0 else SHY * free
        for pair in self.pairs:
            if not isinstance(pair.target, MeshTarget):
                points = pair.points
                now = pair.target.project(points).gap
                while (
                    pair.target.project(points + length * step.reshape(-1, self.config.gdim)[pair.nodes]).gap <= (1 - SHY) * now
                ).any():
                    length *= 0.5
        return length

    def _squeezed(self) -> bool:
        """Whether surfaces are so near that collision detection has no digits left to distinguish them."""
        if self._collisions.empty():
            return False
        nearest = self._collisions.compute_minimum_distance(self._mesh, self._vertices())
        return bool(nearest < (CRUSHED * self.distance) ** 2)
