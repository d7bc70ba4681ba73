"""The united system of a UFL residual: residual, tangent, contact pairs and P brought together for the Newton loop.

Seventh step on the data's way; it implements ``newton.UnitedSystem`` and leaves load steps and commits to the problem.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.dependent import Resolution
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.contact.checks import check_initial
from uem_dolfinx.errors import NotFiniteError
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.surfaces import followed_nodes
from uem_dolfinx.log import compiling, timed
from uem_dolfinx.solve.floating import HARDLY_HELD, OPEN, find_floating
from uem_dolfinx.solve.newton import United
from uem_dolfinx.solve.tangent import Inversions, Tangent, contact_curvature

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.contact.pair import ContactPair
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.geometry.configuration import Configuration
    from uem_dolfinx.materials.elastic import HistoryMaterial
    from uem_dolfinx.solve.floating import FloatingBodies

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Multiple of the rounding of K u that the residual may be left with.
ROUNDING = 4.0 * np.finfo(float).eps
#: Residual relative to the forces at work below which contact forces can be trusted to release a contactor for good.
SETTLED = 1e-6
#: A contactor comes nearer if it closes its gap by more than this part of the motion.
CLOSING = 1e-9
#: A body that falls touches ground after so many stations at most.
MOST_STATIONS = 200
#: Part of the model's size that an active contactor's gap may be left with.
CLOSED = 1e-13


class BodySystem:
    """Implements ``newton.UnitedSystem`` for bodies in statics and dynamics.

    Args:
        config: configuration of the displacement.
        F: UFL residual.
        bcs: Dirichlet conditions.
        solver: of the united system.
        newton: ``"full"`` or ``"modified"``.
        consistent_tangent: whether the curvature of the contact is added to K.
        check_inversion: whether to look for cells turned inside out.
        materials: with history, whose stresses are brought up to date before the residual is assembled.
        dynamics: inertia, or None in statics.
    """

    def __init__(
        self,
        config: Configuration,
        F: ufl.Form,
        bcs: Sequence[fem.DirichletBC],
        solver: UnitedSolver,
        *,
        newton: str,
        consistent_tangent: bool,
        check_inversion: bool | None,
        materials: Sequence[HistoryMaterial] = (),
        dynamics: Dynamics | None = None,
    ):
        self.materials, self.dynamics = list(materials), dynamics
        self.config, self.comm, self.u, self.bcs, self.solver = config, config.comm, config.u, list(bcs), solver
        self.newton, self.consistent_tangent = newton, consistent_tangent
        self.tangent = Tangent(F, self.u, self.materials, dynamics)
        with compiling("the residual"):
            self._F = compat.form(F)
        self._b = compat.create_vector(config.V)
        self._u = compat.petsc_vector(self.u)
        self.pairs: list[ContactPair] = []
        #: Whether a contactor of one pair may be a target node of another.
        self.stacked = False
        self.free = self._free_components()
        #: Displacement that the Dirichlet conditions ask for, at their components ``(n_local, gdim)``.
        self.wanted: Array = np.array(config.displacement)
        #: Bodies that contact must hold in this step, if there are any: in a step in time, inertia holds those that have mass.
        self.floating: FloatingBodies | None = None
        #: The same at rest (False) and in motion (True).
        self._floating: dict[bool, FloatingBodies | None] = {}
        self._open: Array = np.zeros((0, 0))
        #: Whether a node is a contactor of several pairs.
        self.shared = False
        #: Whether equations can get in each other's way.
        self.contestable = False
        #: Whether contact of bodies that only contact holds has yet to develop in this step.
        self._landing = False
        self._factored: object = None
        self._stiffness: Any = None
        check = not self.tangent.linear if check_inversion is None else check_inversion
        self._inversions = Inversions(config) if check else None

    def add_pairs(self, pairs: Sequence[ContactPair]) -> None:
        """Take in the contact pairs (collective)."""
        self.pairs = list(pairs)
        targets = [pair.target.facets for pair in pairs if isinstance(pair.target, MeshTarget)]
        followed = followed_nodes(self.config, targets) if targets else np.zeros(self.config.n_local, bool)
        chained = any(pair.control is not None and pair.control.chained for pair in pairs)
        self.stacked = any(self.comm.allgather(chained or any(followed[pair.nodes].any() for pair in pairs)))
        self._find_mutual(self.pairs)
        contactors = np.concatenate([np.zeros(0, np.int32), *(pair.nodes for pair in pairs)])
        if self.dynamics is not None:
            self.dynamics.make_contactors_massless(np.unique(contactors))
        if self.pairs:
            free, finite = self.free[: self.config.n_owned], not self.tangent.linear
            self.floating = self._floating[False] = find_floating(self.config, free, finite)
            if self.dynamics is not None:
                self._floating[True] = find_floating(self.config, free & ~self.dynamics.massy, finite)
        self.shared = any(self.comm.allgather(len(np.unique(contactors)) < len(contactors)))
        self.contestable = any(self.comm.allgather(self.shared or any(pair.prescribed or pair.mutual for pair in pairs)))
        self.place(returning=False)
        for pair in pairs:
            check_initial(pair)
            pair.touch()

    def _find_mutual(self, pairs: list[ContactPair]) -> None:
        """Mark pairs whose surfaces are contactor and target of each other (collective)."""
        if not self.stacked:
            return
        meshed = [(pair, pair.target) for pair in pairs if isinstance(pair.target, MeshTarget)]
        follows = [followed_nodes(self.config, [target.facets]) for _, target in meshed]
        meets = np.array([[f[pair.nodes].any() for f in follows] for pair, _ in meshed])
        meets = np.any(self.comm.allgather(meets), axis=0)
        for k, (pair, _) in enumerate(meshed):
            pair.mutual = bool((meets[k] & meets[:, k]).any())

    def _free_components(self) -> Bools:
        """Components without Dirichlet condition ``(n_local, gdim)``."""
        free = np.ones(self.config.n_local * self.config.gdim, dtype=bool)
        for bc in self.bcs:
            free[compat.bc_dofs(bc)[0]] = False
        return free.reshape(-1, self.config.gdim)

    # -- place -------------------------------------------------------------------------------------------------------

    def place(self, returning: bool) -> None:
        """Project the contactors; when returning, put the active ones back onto the moved target [UEM, 4.2]."""
        if not self.pairs:
            return
        if not np.isfinite(self._u.norm()):
            raise NotFiniteError("the displacement holds NaN or infinity: check its initial values and the Dirichlet conditions")
        with timed("search and projection"):
            for pair in self.pairs:
                pair.project()
            if returning and self._stiffness is not None:
                stiffness = self._local_stiffness()
                for k, pair in enumerate(self.pairs):
                    if self.shared and k > 0:
                        # what another pair has returned is returned
                        pair.project()
                    # surfaces that follow each other would both make up for the same gap
                    if not pair.mutual:
                        pair.return_to_target(stiffness)
                if self.shared:
                    for pair in self.pairs:
                        pair.project()
                self.u.x.scatter_forward()

    def land(self) -> None:
        """Begin a step: bodies that only contact holds fall until they touch (collective)."""
        if self.dynamics is not None:
            self.floating = self._floating.get(self.dynamics.moving)
        self._landing = self.floating is not None
        if self.floating is not None:
            self.floating.release()
        self.settle()

    def settle(self, fall: bool = True, nudge: bool = False) -> bool:
        """Let bodies that nothing holds move rigidly along their loads until contact holds them (collective).

        Args:
            fall: otherwise they only take hold of what they touch already.
            nudge: follow small loads as well, to what is near.

        Returns:
            Whether any body has moved or touched something.

        Raises:
            FloatingBodyError: naming a body, and the motion that nothing stops.
        """
        floating, changed = self.floating, False
        if floating is None:
            return changed
        for _ in range(MOST_STATIONS):
            self.place(returning=False)
            self.assemble_residual()
            motions = floating.open_motions(self._equations())
            motion = floating.load(motions, self.residual.array_r.reshape(-1, self.config.gdim))
            if not motion.any() or not floating.reach(nudge):
                return changed
            motion /= np.linalg.norm(motion)
            closing, distance = [], np.inf
            for pair in self.pairs:
                ahead = pair.approach
                rate = floating.rates(ahead) @ motion
                closing.append(rate < -CLOSING)
                way = np.where(rate < -CLOSING, np.maximum(ahead.gap, 0.0) / np.maximum(-rate, CLOSING), np.inf)
                distance = min(distance, float(way.min(initial=np.inf)))
            distance = min(self.comm.allgather(distance))
            if not any([pair.land(c) for pair, c in zip(self.pairs, closing)]):
                if not fall or floating.reach(nudge) < distance:
                    return changed
                if np.isinf(distance):
                    raise floating.error(motion)
                # on curved surfaces the touch may come later than it seems; then the next station is nearer
                floating.move(distance * motion)
            changed = True
        raise floating.error(motion)

    # -- residual and uniting equations ------------------------------------------------------------------------------

    def assemble_residual(self) -> bool:
        """Residual ``F(u)`` at the present displacement; whether it is finite on all ranks."""
        try:
            for material in self.materials:
                material.update()
        except NotFiniteError:
            return False
        with timed("assemble residual"):
            forms.assemble_vector(self._b, self._F)
            if self.dynamics is not None:
                self._b.array[:] += self.dynamics.load().array_r
        return bool(np.isfinite(self._b.norm()))

    @property
    def residual(self) -> PETSc.Vec:
        """Owned part of the assembled residual, internal minus external forces."""
        F = self._du_like()
        F.array[:] = self._b.array_r
        return F

    def accelerate(self) -> None:
        """Find the acceleration that the bodies start with (collective)."""
        if self.dynamics is not None and not self.dynamics.accelerated:
            self.place(returning=False)
            self.assemble_residual()
            self.floating = self._floating.get(True)
            self.dynamics.accelerate(self._restrict()[0], self.residual)

    def _du_like(self) -> PETSc.Vec:
        return PETSc.Vec().createMPI(self._b.getSizes(), bsize=self.config.gdim, comm=self.comm)

    def unite(self, cautious: bool) -> United:
        """Contact forces, activation and release, and the uniting equations that follow."""
        if self._stiffness is None and self.pairs:
            # what tells tension from rounding
            self.tangent.update()
            self._stiffness = self.tangent.K.getDiagonal()
        F, rounding = self.residual, self.rounding()
        with timed("uniting equations"):
            restriction, resolution = self._restrict()
            y = restriction.pass_on(F)
            self._read_forces(resolution, restriction.multipliers(y))
            settled = restriction.reduce(y).norm() <= max(SETTLED * F.norm(), rounding)
            # every pair decides, whatever the others did
            decisions = [pair.decide(rounding, cautious, settled) for pair in self.pairs]
            changed = any(decisions)
            if changed:
                for pair in self.pairs:
                    pair.refresh_corners()
            if self.floating is not None and self._landing and settled and not changed:
                # go on if more was held than must be
                self._landing = False
                changed = self._open.shape[1] > self.floating.open_motions(self._equations()).shape[1]
            if changed or settled:
                # a body that has lost its hold on the way falls only when the others have come to rest
                changed |= self.settle(fall=not changed, nudge=not changed)
            if changed:
                F = self.residual
                restriction, _ = self._restrict()
                y = restriction.pass_on(F)
            residual = restriction.reduce(y)
            step = self._restrict(chords=True)[0] if any(pair.chords for pair in self.pairs) else restriction
        gap = max((pair.largest_gap() for pair in self.pairs), default=0.0)
        active = sum(pair.n_active for pair in self.pairs)
        short = np.abs(self.wanted - self.config.displacement)[~self.free].max(initial=0.0)
        largest = np.abs(self.wanted[~self.free]).max(initial=0.0)
        short, largest = np.max(self.comm.allgather([short, largest]), axis=0)
        closed = gap <= CLOSED * self.config.size and short <= 4 * np.finfo(float).eps * largest
        return United(
            restriction,
            step,
            residual,
            residual.norm(),
            F.norm(),
            rounding,
            self._strain_rounding(),
            gap,
            active,
            changed,
            bool(closed),
        )

    def _equations(self) -> UnitingEquations:
        """Uniting equations of all pairs."""
        return UnitingEquations.join([pair.equations() for pair in self.pairs], self.config.gdim)

    def _restrict(self, chords: bool = False) -> tuple[Restriction, Resolution | None]:
        """P and c of the present uniting equations, and how those that got in each other's way were resolved."""
        n, free = self.config.n_owned, self.free[: self.config.n_owned]
        parts = [pair.equations(chords) for pair in self.pairs]
        equations, resolution = UnitingEquations.join(parts, self.config.gdim), None
        if self.floating is not None:
            self._open = self.floating.open_motions(equations, HARDLY_HELD if self._landing else OPEN)
            free = free & ~self.floating.supports(self._open, equations)
        if self.contestable:
            mutual = np.repeat([pair.mutual for pair in self.pairs], [len(part) for part in parts]).astype(bool)
            resolution = Resolution(self.config, equations, free, mutual)
            equations = resolution.equations
        prescribed = np.where(self.free, 0.0, self.wanted - self.config.displacement)[:n]
        stacked = self.stacked or (resolution is not None and resolution.found)
        return Restriction(self.config, equations, free, prescribed, stacked), resolution

    def _read_forces(self, resolution: Resolution | None, lam: Array) -> None:
        """Hand the contact forces to the pairs (collective)."""
        redundant = np.zeros(len(lam), dtype=bool)
        if resolution is not None:
            lam = resolution.forces(lam)
            redundant = resolution.redundant
        start = 0
        for pair in self.pairs:
            part = slice(start, start + pair.n_equations)
            pair.read_forces(lam[part], redundant[part])
            start += pair.n_equations

    def rounding(self) -> float:
        """Norm of the forces that rounding of the displacement, and of the active contactors' positions, can make."""
        if self._stiffness is None:
            return 0.0
        rounded = np.abs(self.config.displacement[: self.config.n_owned])
        for pair in self.pairs:
            i = pair.nodes[pair.trial.active]
            rounded[i] += np.abs(self.config.x[i])
        u = self._du_like()
        u.array[:] = rounded.ravel() * self._stiffness.array_r
        return float(ROUNDING * u.norm())

    def _strain_rounding(self) -> float:
        """Norm of the forces that rounding of ``1 + grad(u)`` can make."""
        return 0.0 if self._stiffness is None else float(np.finfo(float).eps * self._stiffness.norm() * self.config.size)

    def _local_stiffness(self) -> Array:
        """Diagonal of K at the owned nodes ``(n_owned, gdim)``."""
        return self._stiffness.array_r.reshape(-1, self.config.gdim)

    def forget(self) -> None:
        """Let the next step assemble and factorise anew, as the first of a run does (collective)."""
        self._factored = None
        self.solver.forget()

    def to_checkpoint(self, u: fem.Function) -> bool:
        """Write the diagonal of K, by which forces are told from rounding, into a Function; whether it is known yet (collective)."""
        if self._stiffness is None:
            return False
        u.x.array[: self._stiffness.getLocalSize()] = self._stiffness.array_r
        u.x.scatter_forward()
        return True

    def from_checkpoint(self, u: fem.Function | None) -> None:
        """Go on from a diagonal of K that was kept, None if none was known."""
        self._stiffness = None
        if u is not None:
            self._stiffness = self._du_like()
            self._stiffness.array[:] = u.x.array[: self._stiffness.getLocalSize()]

    def active_set(self) -> int:
        """Fingerprint of the active set, the same on all ranks."""
        return hash(tuple(self.comm.allgather(zlib.crc32(b"".join(pair.trial.united_to for pair in self.pairs)))))

    # -- linear system -----------------------------------------------------------------------------------------------

    def linearise(self, state: United, first: bool) -> PETSc.Vec:
        """Tangent and united matrix; returns the right-hand side ``P'(r - K c)``."""
        forms.free_petsc_garbage(self.comm)
        if first or self.newton == "full":
            self.tangent.update()
            self._stiffness = self.tangent.K.getDiagonal()
        K, restriction = self.tangent.K, state.step
        with timed("contact curvature"):
            curvature = self._curvature() if self.consistent_tangent else None
        # what the united matrix was made of; a modified Newton loop lets small changes of P pass
        exact = 0 if curvature is not None else restriction.fingerprint(values=self.newton == "full")
        made_of = self.comm.allgather((self.tangent.number, exact, restriction.fingerprint(values=False)))
        moving = curvature is not None and self.newton == "full"
        if moving or made_of != self._factored:
            self.solver.set_operator(restriction, K, curvature)
        self._factored = made_of
        c = restriction.c
        load = K * c
        if curvature is not None:
            load.axpy(1.0, curvature * c)
        load.axpy(1.0, self.residual)
        rhs = state.restriction.reduce(state.restriction.pass_on(load))
        rhs.scale(-1.0)
        return rhs

    def _curvature(self) -> PETSc.Mat | None:
        """``-sum lambda grad^2 g`` of all pairs, or None if no pair has any."""
        parts = [pair.curvature() for pair in self.pairs if pair.sliding == "finite"]
        # a plane has none
        if not self.comm.allreduce(any(blocks.any() for _, blocks in parts), op=MPI.LOR):
            return None
        return contact_curvature(parts, self._du_like())

    def solve(self, rhs: PETSc.Vec, accuracy: float) -> tuple[PETSc.Vec, int]:
        """Unknowns dq, whose residual need be no less than this part of ``rhs``, and the number of linear iterations."""
        return self.solver.solve(rhs, accuracy)

    # -- displacement ------------------------------------------------------------------------------------------------

    def move(self, state: United, dq: PETSc.Vec) -> PETSc.Vec:
        """``du = P dq + c``."""
        du = state.step.expand(dq)
        du.axpy(1.0, state.step.c)
        if self.floating is not None:
            du.array[:] -= self.floating.part(self._open, du.array_r.reshape(-1, self.config.gdim)).ravel()
        return du

    def displacement(self) -> PETSc.Vec:
        """Copy of the present displacement."""
        start = self._du_like()
        start.array[:] = self._u.array_r
        return start

    def displace(self, start: PETSc.Vec, du: PETSc.Vec, length: float) -> None:
        """Set the displacement to ``start + length du``; after a full step the Dirichlet values are met to the last bit."""
        self._u.array[:] = start.array_r + length * du.array_r
        if length == 1.0:
            n = self.config.n_owned
            self.config.displacement[:n][~self.free[:n]] = self.wanted[:n][~self.free[:n]]
        self.u.x.scatter_forward()

    @property
    def linear(self) -> bool:
        """Whether the bodies' forces are linear in the displacement."""
        return self.tangent.linear and not self.materials

    @property
    def in_contact(self) -> bool:
        """Whether there are contacts at all."""
        return bool(self.pairs)

    def reduced_residual(self, state: United) -> PETSc.Vec:
        """``P'F`` at the present displacement, with the active set of ``state``.

        P belongs to the present normals: the old P would take the turned contact forces for a residual.
        """
        self.place(returning=False)
        restriction, _ = self._restrict()
        return restriction.reduce(restriction.pass_on(self.residual))

    def inverted(self) -> str | None:
        """Where a cell is inside out, if one is (collective)."""
        return self._inversions.find() if self._inversions is not None else None
