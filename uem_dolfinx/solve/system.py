"""The united system: bodies, contact pairs, P and Q brought together for the Newton loop.

It implements ``newton.UnitedSystem`` by elimination, and leaves load steps and commits to the problem.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.dependent import IndependentEquations
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.checks import check_initial, check_prescribed
from uem_dolfinx.contact.coupling import LabelledEquations
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.geometry.surfaces import followed_nodes
from uem_dolfinx.log import timed
from uem_dolfinx.solve.body_forces import BodyForces
from uem_dolfinx.solve.floating import FloatingBodies
from uem_dolfinx.solve.newton import IterationState
from uem_dolfinx.solve.tangent import contact_curvature

#: Residual relative to the forces at work below which contact forces can be trusted to release a contactor for good.
#: [heuristic; norm of the forces; -]
SETTLED = 1e-6
#: Part of the model's size that an active contactor's gap may be left with.
#: [convention; the model's size; test_system.py::test_gaps_that_count_as_closed]
CLOSED = 1e-13


class BodySystem:
    """Bodies whose active contactors are eliminated.

    Args:
        forces: of the bodies without contact.
        pairs: of all contacts, just made.
        solver: of the united system.
        newton: ``"full"`` or ``"modified"``.
        consistent_tangent: whether the curvature of the contact is added to K.
    """

    def __init__(
        self,
        forces: BodyForces,
        pairs: Sequence[ContactPair],
        solver: UnitedSolver,
        *,
        newton: str = "full",
        consistent_tangent: bool = True,
    ):
        self.forces, self.pairs, self.solver = forces, list(pairs), solver
        self.config, self.comm = forces.config, forces.comm
        self.newton, self.consistent_tangent = newton, consistent_tangent
        self._factored: object = None
        self._find_meetings()
        self.floating = FloatingBodies(forces, self.pairs)
        self.place(returning=False)
        for pair in self.pairs:
            check_initial(pair)
            pair.activate_touching()

    def _find_meetings(self) -> None:
        """Find out how equations of several contacts can meet (collective)."""
        config, pairs = self.config, self.pairs
        follows = [followed_nodes(config, pair.coupling.followed) for pair in pairs]
        meets = np.array([[f[pair.nodes].any() for f in follows] for pair in pairs], dtype=bool).reshape(len(pairs), len(pairs))
        contactors = np.concatenate([np.zeros(0, np.int32), *(pair.nodes for pair in pairs)])
        shared = len(np.unique(contactors)) < len(contactors)
        found = np.append(meets.ravel(), shared)
        self.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.LOR)
        meets = found[:-1].reshape(meets.shape)
        #: Whether a node is a contactor of several pairs.
        self.shared = bool(found[-1])
        #: Pairs whose surfaces are contactor and target of each other (two-pass).
        self.mutual: Bools = (meets & meets.T).any(axis=1)
        for pair, mutual in zip(pairs, self.mutual):
            pair.mutual = bool(mutual)
        #: Whether a node that is followed may itself be eliminated.
        self.stacked = bool(meets.any()) or any(pair.coupling.chained for pair in pairs)
        #: Whether equations can get in each other's way.
        self.contestable = self.shared or bool(self.mutual.any()) or any(pair.coupling.prescribed for pair in pairs)

    # -- where the contactors stand --------------------------------------------------------------------------------------

    def place(self, returning: bool) -> None:
        """Project the contactors; when returning, put the active ones back onto the moved target [UEM, 4.2]."""
        if not self.pairs:
            return
        self.forces.check_displacement()
        with timed("search and projection"):
            for pair in self.pairs:
                pair.project()
            stiffness = self.forces.stiffness
            if not returning or stiffness is None:
                return
            for k, pair in enumerate(self.pairs):
                if self.shared and k > 0:
                    # what another pair has returned is returned
                    pair.project()
                # surfaces that follow each other would both make up for the same gap
                if not self.mutual[k]:
                    pair.return_to_target(stiffness)
            if self.shared:
                for pair in self.pairs:
                    pair.project()
            self.forces.u.x.scatter_forward()

    def begin_step(self) -> None:
        """Begin a step: bodies that only contact holds fall until they touch."""
        self.floating.begin_step(lambda: self.place(returning=False))

    def end_step(self) -> None:
        """Refuse an equilibrium that contacts and conditions do not agree about (collective)."""
        for pair in self.pairs:
            check_prescribed(pair)
        self.floating.end_step()

    def deformation(self, du: Array) -> Array:
        """An increment ``(n_owned * gdim,)`` without rigid motions of bodies that only contact holds."""
        return self.floating.deformation(du)

    # -- equations and forces --------------------------------------------------------------------------------------------

    def assemble_residual(self) -> bool:
        """Residual at the present displacement; whether it is finite."""
        return self.forces.assemble()

    def unite(self, cautious: bool) -> IterationState:
        """Contact forces, active set and uniting equations at the present displacement.

        1. Read the contact forces from the residual with the present equations.
        2. Let every pair activate and release, whatever the others do.
        3. Put contactors whose equations have changed where they now belong.
        4. Let bodies that have lost their hold fall.
        5. Take the test rows Q of the equations that follow, and Q'F.
        6. Take the trial rows P, which are Q unless a coupling tells them apart.
        """
        forces, pairs = self.forces, self.pairs
        if forces.stiffness is None and pairs:
            # what tells tension from rounding
            forces.update_tangent()
        F, rounding = forces.residual, self.rounding()
        with timed("uniting equations"):
            equations = [pair.equations() for pair in pairs]
            Q, independent = self._restrict([e.test for e in equations])
            y = Q.pass_on(F)
            self._read_forces(equations, independent, Q.multipliers(y))
            settled = Q.reduce(y).norm() <= max(SETTLED * F.norm(), rounding)
            changed = any([pair.decide(rounding, cautious, settled) for pair in pairs])
            if changed:
                for pair in pairs:
                    pair.place_again()
            changed = self.floating.fall_again(lambda: self.place(returning=False), changed, settled)
            if changed:
                F, equations = forces.residual, [pair.equations() for pair in pairs]
                Q, _ = self._restrict([e.test for e in equations])
                y = Q.pass_on(F)
            P = Q if all(e.trial is e.test for e in equations) else self._restrict([e.trial for e in equations])[0]
            residual = Q.reduce(y)
        gap = max((pair.largest_gap() for pair in pairs), default=0.0)
        return IterationState(
            trial=P,
            test=Q,
            residual=residual,
            norm=residual.norm(),
            scale=F.norm(),
            rounding=rounding,
            strain_rounding=forces.strain_rounding(),
            gap=gap,
            active=sum(pair.n_active for pair in pairs),
            changed=changed,
            closed=gap <= CLOSED * self.config.size and forces.dirichlet_met(),
        )

    def restriction(self) -> Restriction:
        """Q of the present equations (collective)."""
        return self._restrict([pair.equations().test for pair in self.pairs])[0]

    def _restrict(self, parts: list[UnitingEquations]) -> tuple[Restriction, IndependentEquations | None]:
        """P and c of the equations of all pairs, and how those that got in each other's way were resolved."""
        equations, independent = UnitingEquations.join(parts, self.config.gdim), None
        free = self.floating.hold(self.forces.free[: self.config.n_owned], equations)
        if self.contestable:
            mutual = np.repeat(self.mutual, [len(part) for part in parts])
            independent = IndependentEquations(self.config, equations, free, mutual)
            equations = independent.equations
        stacked = self.stacked or (independent is not None and independent.found)
        return Restriction(self.config, equations, free, self.forces.prescribed, stacked), independent

    def _read_forces(self, equations: list[LabelledEquations], independent: IndependentEquations | None, lam: Array) -> None:
        """Hand the contact forces to the pairs (collective)."""
        redundant = np.zeros(len(lam), dtype=bool)
        if independent is not None:
            lam = independent.forces(lam)
            redundant = independent.redundant
        start = 0
        for pair, own in zip(self.pairs, equations):
            part = slice(start, start + len(own))
            pair.read_forces(own, lam[part], redundant[part])
            start += len(own)

    def rounding(self) -> float:
        """Norm of the forces that rounding of the displacement, and of the active contactors' positions, can make (collective)."""
        active = [pair.nodes[pair.trial.active] for pair in self.pairs]
        return self.forces.rounding(np.concatenate([np.zeros(0, np.int32), *active]))

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """``Q'F`` at the present displacement, with the active set of ``state``.

        Q belongs to the present normals: the old Q would take the turned contact forces for a residual.
        """
        self.place(returning=False)
        Q = self.restriction()
        return Q.reduce(Q.pass_on(self.forces.residual))

    def accelerate(self) -> None:
        """Find the acceleration that the bodies start with (collective)."""
        dynamics = self.forces.dynamics
        if dynamics is not None and not dynamics.accelerated:
            self.place(returning=False)
            self.forces.assemble()
            self.floating.begin_motion()
            dynamics.accelerate(self.restriction(), self.forces.residual)

    def active_set(self) -> int:
        """Fingerprint of the active set, the same on all ranks."""
        return hash(tuple(self.comm.allgather(zlib.crc32(b"".join(pair.trial.united_to for pair in self.pairs)))))

    # -- linear system ---------------------------------------------------------------------------------------------------

    def linearise(self, state: IterationState, first: bool) -> PETSc.Vec:
        """Tangent and united matrix ``Q'KP``; returns the right-hand side ``Q'(r - K c)``."""
        forms.free_petsc_garbage(self.comm)
        if first or self.newton == "full":
            self.forces.update_tangent()
        K, P, Q = self.forces.tangent.K, state.trial, state.test
        with timed("contact curvature"):
            curvature = self.curvature() if self.consistent_tangent else None
        # what the united matrix was made of; a modified Newton loop lets small changes of P pass
        exact = 0 if curvature is not None else P.fingerprint(values=self.newton == "full")
        made_of = self.comm.allgather((self.forces.tangent.number, exact, P.fingerprint(values=False)))
        moving = (curvature is not None or Q is not P) and self.newton == "full"
        if moving or made_of != self._factored:
            self.solver.set_operator(P, K, curvature, Q)
        self._factored = made_of
        c = P.c
        load = K * c
        if curvature is not None:
            load.axpy(1.0, curvature * c)
        load.axpy(1.0, self.forces.residual)
        rhs = Q.reduce(Q.pass_on(load))
        rhs.scale(-1.0)
        return rhs

    def curvature(self) -> PETSc.Mat | None:
        """``-sum lambda grad^2 g`` of all pairs, or None if no pair has any."""
        parts = [pair.curvature() for pair in self.pairs if pair.sliding == "finite"]
        # a plane has none
        if not self.comm.allreduce(any(blocks.any() for _, blocks in parts), op=MPI.LOR):
            return None
        return contact_curvature(parts, self.forces.vector())

    def solve(self, rhs: PETSc.Vec, accuracy: float) -> tuple[PETSc.Vec, int]:
        """Unknowns dq, whose residual need be no less than this part of ``rhs``, and the number of linear iterations."""
        return self.solver.solve(rhs, accuracy)

    def forget(self) -> None:
        """Let the next step assemble and factorise anew, as the first of a run does (collective)."""
        self._factored = None
        self.solver.forget()

    # -- displacement ----------------------------------------------------------------------------------------------------

    def move(self, state: IterationState, dq: PETSc.Vec) -> PETSc.Vec:
        """``du = P dq + c``; bodies stay where they are along neutral motions."""
        du = state.trial.expand(dq)
        du.axpy(1.0, state.trial.c)
        du.array[:] = self.floating.without_open_motions(du.array_r)
        return du

    def displacement(self) -> PETSc.Vec:
        """Copy of the present displacement."""
        return self.forces.displacement()

    def displace(self, start: PETSc.Vec, du: PETSc.Vec, length: float) -> None:
        """Set the displacement to ``start + length du``."""
        self.forces.displace(start, du, length)

    def inverted(self) -> str | None:
        """Where a cell is inside out, if one is (collective)."""
        return self.forces.inverted()

    @property
    def linear(self) -> bool:
        """Whether the bodies' forces are linear in the displacement."""
        return self.forces.linear

    @property
    def in_contact(self) -> bool:
        """Whether there are contacts at all."""
        return bool(self.pairs)
