"""The bodies without contact: forces and tangent of the UFL residual, Dirichlet conditions, materials with history, inertia."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import check_fields
from uem_dolfinx.arrays import AnyArray, Array, Bools, Ints, largest_of_groups
from uem_dolfinx.errors import InputError, NotFiniteError
from uem_dolfinx.geometry.bodies import find_bodies, linked_bodies
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.log import compiling, timed
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.bodies.field_scales import first
from uem_dolfinx.solve.bodies.tangent import Inversions, Tangent

if TYPE_CHECKING:
    from uem_dolfinx.conditions.at_points import AtPoints
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.materials.elastic import HistoryMaterial

#: Multiple of the rounding of K u that the residual may be left with.
#: [derived; rounding of K u; test_bodies.py::test_rounding_of_forces]
FORCE_ROUNDING = 4.0 * np.finfo(float).eps
#: A force is more than rounding where it is larger by this factor.
#: [convention; rounding of K u; test_bodies.py::test_forces_above_rounding]
ABOVE_ROUNDING = 100.0
#: Dirichlet values are met if they are to this part of the largest.
#: [derived; the largest prescribed value; test_bodies.py::test_dirichlet_values_are_met]
VALUE_ROUNDING = 4.0 * np.finfo(float).eps
#: Past the point where the residual does no more work, a step of bodies that yield may leave this part of it [Matthies and Strang,
#: International Journal for Numerical Methods in Engineering 14 (1979) 1613-1626]. Where it is longer, they yield far too much.
#: [convention; work or norm of the residual; test_newton_loop.py::test_what_the_line_search_accepts]
MOST_PAST = 0.5


class Bodies:
    """Bodies in statics and dynamics, before contact.

    Args:
        F: UFL residual, damping included.
        bcs: Dirichlet conditions.
        materials: with history, whose stresses are brought up to date before the residual is assembled.
        dynamics: inertia, or None in statics.
        points: loads and springs at nodes, or None.
        check_inversion: whether to look for cells turned inside out; None does so unless K is constant.
        J: tangent of users in place of the derivative of F, or None.

    Attributes:
        unknowns: rows of vectors and matrices; the nodes, unless there are other fields.
        held: unknowns with a Dirichlet condition, ghosts included ``(n,)``.
        free: components of the displacement without Dirichlet condition ``(n_local, gdim)``.
        free_rows: all unknowns without Dirichlet condition, in the rows of vectors ``(n_rows, gdim)``.
        dead: forces of fixed direction at all unknowns, such as forces of removed conditions, ghosts included ``(n,)``; None for zero.
        wanted: prescribed values at the unknowns with Dirichlet conditions, ghosts included ``(n,)``.
        tangent: K.
        inversions: search for cells turned inside out, or None.
        stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, for estimates of rounding in forces; None until known.
    """

    def __init__(
        self,
        config: Configuration,
        F: ufl.Form,
        bcs: Sequence[fem.DirichletBC],
        *,
        materials: Sequence[HistoryMaterial] = (),
        dynamics: Dynamics | None = None,
        points: AtPoints | None = None,
        check_inversion: bool | None = None,
        J: ufl.Form | None = None,
    ):
        self.config, self.comm, self.u, self.F = config, config.comm, config.whole, F
        self.unknowns = config.unknowns
        self.materials, self.dynamics = list(materials), dynamics
        self._added: list[Any] = [] if dynamics is None else dynamics.added  # masses at points
        self.tangent = Tangent(F, config, self.materials, dynamics, points, J)
        check = not self.tangent.linear if check_inversion is None else check_inversion
        self.inversions = Inversions(config) if check and config.moves else None
        with compiling("the residual"):
            self._F = forms.form(F if self.inversions is None else self.inversions.marked(F, dynamics))
        self._b = compat.create_vector(self.u.function_space)
        self._u = compat.petsc_vector(self.u)
        self._n_owned = len(self._b.array_r)
        #: Unknowns at which the residual is assembled under the present loads ``(n,)``, for the next call of ``assemble``; or None.
        self._assembled_at: Array | None = None
        self.hold(bcs)
        #: Writes F at the present displacement to a vector.
        self._assemble: Callable[[PETSc.Vec], None] = partial(forms.assemble_vector, L=self._F)
        if dynamics is not None:
            from uem_dolfinx.solve.bodies.linear_forces import explicit_forces

            dynamics.hold(~self.free[: config.n_owned])
            self._assemble = explicit_forces(self, self._F, J) or self._assemble
        self.wanted: Array = np.array(self.u.x.array)
        self.dead: Array | None = None
        self.stiffness: Array | None = None
        #: Its value at the end of the last step, with which the next starts, and the state counter of the K that it was taken from.
        self.stiffness_at_start: Array | None = None
        self._stiffness_of = -1
        #: Residual at the end of the last explicit step ``(n_rows * gdim,)``; None if another state is committed.
        self.driving: Array | None = None
        self._fields: Any = None
        self._linked: tuple[Ints, int] | None = None
        if self.unknowns.mixed:
            from uem_dolfinx.solve.bodies.field_scales import FieldScales

            #: Sizes of the terms in the equations of other fields; None without any.
            self._fields = FieldScales(self.unknowns, self.tangent)

    def link(self, eq: Any) -> None:
        """Take bodies that ``UnitingEquations`` of users connect as one, where forces are compared with rounding (collective)."""
        self._linked = linked_bodies(self.config, eq.node[eq.row], eq.followed)

    def begin_step(self) -> None:
        """Scale other fields by K at the beginning of the step, as a run restarted from a checkpoint does (collective)."""
        if self._fields is not None:
            self.tangent.update()

    # -- forces --------------------------------------------------------------------------------------------------------

    def assemble(self, write: Callable[[PETSc.Vec], None] | None = None) -> bool:
        """Assemble ``F(u)`` at the present displacement, or a part by ``write``; whether it is finite on all ranks (collective)."""
        known, self._assembled_at = self._assembled_at, None
        if known is not None and reduced(self.comm, bool(np.array_equal(known, self.u.x.array)), op=MPI.LAND):
            return True
        try:
            for material in self.materials:
                material.update()
        except NotFiniteError:
            return False
        if self.dynamics is not None:
            self.dynamics.update_rates()
        with timed("assemble residual"):
            (write or self._assemble)(self._b)
            if self.tangent.points is not None:
                self.tangent.points.add_forces(self._b.array)
            if self.dead is not None:
                self._b.array[:] -= self.dead[: self._n_owned]
            if self.dynamics is not None and (load := self.dynamics.load()) is not None:
                self.config.add_to(self._b.array, load)
        return bool(np.isfinite(self._b.norm()))

    @property
    def residual(self) -> PETSc.Vec:
        """Owned part of the assembled residual, internal minus external forces."""
        return self.unknowns.vector(self.config.rows(self._b.array_r))

    @property
    def residual_of_all(self) -> Array:
        """Copy of the assembled residual at all owned unknowns ``(n,)``."""
        return np.array(self._b.array_r)

    @property
    def forces(self) -> Array:
        """The assembled residual at the owned nodes of the displacement ``(n_owned, gdim)``."""
        return np.asarray(self.config.rows(self._b.array_r)[: self.config.n_owned])

    def forces_at_work(self, F: PETSc.Vec | None = None) -> Any:
        """Reference for residuals: the norm of forces F, by default those assembled, or one for each field ``(n_fields,)`` (collective)."""
        if self._fields is None:
            # PETSc keeps the norm of a vector that has not changed
            return self._with_masses((self._b if F is None else F).norm())
        return self._with_masses(np.maximum(self.unknowns.norms(self.residual if F is None else F), self._fields.terms()))

    def _with_masses(self, norm: Any) -> Any:
        """A norm of forces, or one for each field ``(n_fields,)``, combined with those of masses at points."""
        if not self._added:
            return norm
        return np.hypot(norm, self.of_fields(float(np.linalg.norm([one.size() for one in self._added]))))

    @property
    def linear(self) -> bool:
        """Whether the forces are linear in the displacement."""
        return self.tangent.linear and not self.materials

    @property
    def most_past(self) -> float:
        """Part of the residual's work that a step may leave past the point where it does none; see ``MOST_PAST``."""
        return MOST_PAST if self.materials else np.inf

    def update_tangent(self) -> PETSc.Mat:
        """K at the present displacement, and its diagonal (collective)."""
        self.tangent.update()
        if self.stiffness is None or self._stiffness_of != self.tangent.K.stateGet():
            self.stiffness, self._stiffness_of = self._diagonal(), self.tangent.K.stateGet()
        return self.tangent.K

    def initial_stiffness(self) -> Array:
        """Diagonal of K at the present displacement ``(n_owned, gdim)``; ``stiffness`` is not updated (collective)."""
        self.assemble()
        self.tangent.update()
        return self._diagonal()

    def _diagonal(self) -> Array:
        return np.array(self.tangent.K.getDiagonal().array_r).reshape(-1, self.config.block)[: self.config.n_owned]

    def rounding(self, positioned: npt.NDArray[np.integer]) -> Any:
        """Norm of the forces due to rounding of the displacement, and of the positions of nodes, repeated ones repeatedly (collective).

        With other fields one norm for each ``(n_fields,)``, from the terms of its equations.
        """
        if self.stiffness is None:
            return 0.0
        rounded = np.abs(self.config.displacement[: self.config.n_owned])
        if self.config.moves:
            np.add.at(rounded, positioned, np.abs(self.config.here(positioned)))
        of_displacement = float(FORCE_ROUNDING * self.config.vector(rounded * self.stiffness).norm())
        if self._added:
            of_points = FORCE_ROUNDING * np.linalg.norm([one.rounding() for one in self._added])
            of_displacement = float(np.hypot(of_displacement, of_points))
        return (
            of_displacement if self._fields is None else FORCE_ROUNDING * self._fields.largest() + self.of_fields(of_displacement)
        )

    def rounding_of_displacement(self) -> float:
        """Norm of the displacement's forces due to rounding of the displacement and of its gradient (collective)."""
        return first(np.maximum(self.rounding(np.zeros(0, np.int32)), self.strain_rounding()))

    def rounding_at(self, nodes: npt.NDArray[np.integer]) -> Array:
        """Forces due to rounding of the positions of owned nodes ``(n,)``, at these nodes ``(n,)``."""
        if self.stiffness is None:
            return np.zeros(len(nodes))
        forces = np.abs(self.config.here(nodes)) * np.abs(self.stiffness[nodes])
        return np.asarray(FORCE_ROUNDING * forces.max(axis=1, initial=0.0))

    def above_rounding(self, positioned: bool) -> Any:
        """Norm of the forces, or one for each field, at the components where they exceed rounding, also of positions (collective).

        Rounding of a body's displacement affects all of its nodes, also nodes with Dirichlet conditions, and bodies that are linked to it.
        """
        if self.stiffness is None:
            return self.unknowns.norms(self.residual)
        F, n = self.forces, self.config.n_owned
        body, count = self._linked or find_bodies(self.config)
        moved = np.abs(self.config.displacement[:n])
        rounded = largest_of_groups(body[:n], moved.max(axis=1, initial=0.0) if count > 1 else moved, count)
        self.comm.Allreduce(MPI.IN_PLACE, rounded, op=MPI.MAX)
        own = rounded[body[:n], None] if count > 1 else rounded
        limit = ABOVE_ROUNDING * FORCE_ROUNDING * (own + (self.config.size if positioned else 0.0)) * np.abs(self.stiffness)
        above = float(self.config.vector(np.where(np.abs(F) > limit, F, 0.0)).norm())
        if self._fields is None:
            return self._with_masses(above)
        return self._fields.above(self.residual.array_r, ABOVE_ROUNDING * FORCE_ROUNDING) + self.of_fields(above)

    def remembered(self, positioned: bool, before: Any) -> Any:
        """Norm, ``before`` at least, relative to which forces of later steps may be rounding, with terms of other fields (collective)."""
        if self._fields is None and self._with_masses(self._b.norm()) <= before:
            return before
        above = self.above_rounding(positioned)
        if self._fields is None:
            # laws of the deformation gradient round 1 + grad(u), however small u is; by how much is unknown before the first tangent
            return max(above, before) if self.linear or above > self.strain_rounding() > 0.0 else before
        terms, rounding = self._fields.terms(), np.maximum(FORCE_ROUNDING * self._fields.largest(), self.strain_rounding())
        return np.maximum(np.maximum(above, before), np.where(terms > ABOVE_ROUNDING * rounding, terms, 0.0))

    def strain_rounding(self) -> Any:
        """Norm of the forces due to rounding of ``1 + grad(u)``, or one for each field ``(n_fields,)`` (collective)."""
        if self.stiffness is None or not self.config.moves:
            return 0.0
        size = float(np.finfo(float).eps * self.config.vector(self.stiffness).norm() * self.config.size)
        return size if self._fields is None else self._fields.strain_rounding(self.config.size) + self.of_fields(size)

    def of_fields(self, of_displacement: float) -> Any:
        """A norm of the displacement's forces; with other fields, one for each field, zeros for the others ``(n_fields,)``."""
        return of_displacement if self._fields is None else np.append(of_displacement, np.zeros(self.unknowns.n_fields - 1))

    # -- Dirichlet conditions ------------------------------------------------------------------------------------------

    def hold(self, bcs: Sequence[fem.DirichletBC]) -> None:
        """Replace all Dirichlet conditions from the next step on; the ranks that own the nodes decide (collective).

        Raises InputError for a component that has a condition on a rank that does not own it, but not on its owner.
        """
        self.bcs, own = list(bcs), np.zeros(len(self.u.x.array), dtype=bool)
        for bc in self.bcs:
            own[compat.bc_dofs(bc)[0]] = True
        self.held: Bools = self.of_owners(own)
        with agreed(self.comm):
            if len(lost := np.flatnonzero(own & ~self.held)):
                raise InputError(
                    f"a Dirichlet condition holds {self.config.place_of(int(lost[0]))} on rank {self.comm.rank}, but not on the rank that "
                    "owns the node: expected conditions at the same nodes on all ranks; locate them by uem.dirichlet, or by "
                    "fem.locate_dofs_topological on all ranks with remote=True"
                )
        self._take_held()

    def _take_held(self) -> None:
        self.free: Bools = ~self.config.of(self.held)
        self.free_rows: Bools = self.config.rows(~self.held[: self._n_owned])
        self.tangent.hold(self.free_rows)

    @contextmanager
    def holding(self, more: Bools) -> Iterator[None]:
        """Context in which ``more`` unknowns, ghosts included ``(n,)``, have prescribed values, too, ``wanted``."""
        before, self.held = self.held, self.held | more
        self._take_held()
        try:
            yield
        finally:
            self.held = before
            self._take_held()

    @cached_property
    def _sent(self) -> fem.Function:
        """Buffer for values that owners send."""
        return fem.Function(self.u.function_space)

    def of_owners(self, values: AnyArray) -> AnyArray:
        """Values of all unknowns ``(n,)`` with ghosts copied from their owners, of the same type (collective)."""
        if self.comm.size == 1:
            return values
        self._sent.x.array[:] = values
        self._sent.x.scatter_forward()
        return np.array(self._sent.x.array).astype(values.dtype)

    @property
    def prescribed(self) -> Array:
        """Increments prescribed by the Dirichlet conditions, in the rows of vectors, zero where free ``(n_rows, gdim)``."""
        n = self._n_owned
        return np.asarray(self.config.rows(np.where(self.held[:n], self.wanted[:n] - self.u.x.array[:n], 0.0)))

    def dirichlet_met(self) -> bool:
        """Whether the Dirichlet values are met (collective)."""
        there, field = self.u.x.array, self.unknowns.field_of if self.unknowns.mixed else None
        if reduced(self.comm, not ((self.wanted != there) & self.held).any(), op=MPI.LAND):
            return True
        parts = [self.held] if field is None else [self.held & (field == i) for i in range(self.unknowns.n_fields)]
        both = np.array([[np.abs(a).max(initial=0.0) for a in (self.wanted[h] - there[h], self.wanted[h])] for h in parts])
        self.comm.Allreduce(MPI.IN_PLACE, both, op=MPI.MAX)
        return bool((both[:, 0] <= VALUE_ROUNDING * both[:, 1]).all())

    # -- displacement --------------------------------------------------------------------------------------------------

    def check_displacement(self, facets: float) -> None:
        """NotFiniteError for a displacement that is not finite, or whose rounding exceeds the length of ``facets`` (collective)."""
        if not np.isfinite(size := self._u.norm()):
            raise NotFiniteError("the displacement holds NaN or infinity: check its initial values and the Dirichlet conditions")
        if np.finfo(float).eps * size <= facets:
            return
        far = reduced(self.comm, float(np.abs(self.config.displacement).max(initial=0.0)), op=MPI.MAX)
        if np.finfo(float).eps * far > facets:
            raise NotFiniteError(
                f"nodes are displaced by {far:.3g}, whose rounding is more than the facets: loads drive bodies to where nothing holds "
                "them; take smaller load steps, hold the bodies, or give them inertia"
            )

    def displacement(self) -> PETSc.Vec:
        """Copy of the present displacement, and of all other fields."""
        return self.unknowns.vector(self.config.rows(self._u.array_r))

    def displace(self, start: PETSc.Vec, du: PETSc.Vec, length: float) -> None:
        """Set all unknowns to ``start + length du``; after a full step the Dirichlet values are met to the last bit (collective)."""
        self._u.array[:] = self.config.from_rows(start.array_r + length * du.array_r)
        if length == 1.0:
            held = np.flatnonzero(self.held[: self._n_owned])
            self._u.array[held] = self.wanted[held]
        self.u.x.scatter_forward()

    def assemble_once(self) -> bool:
        """As ``assemble``, whose next call at the same displacement then does nothing (collective)."""
        finite = self.assemble()
        self._assembled_at = np.array(self.u.x.array)
        return finite

    def move(self, du: PETSc.Vec, change: PETSc.Vec | None = None) -> None:
        """Add an increment to the displacement, and what it changes to the residual, if known, see ``assemble_once`` (collective)."""
        self._assembled_at = None
        self._u.array[:] += self.config.from_rows(du.array_r)
        self.u.x.scatter_forward()
        if change is not None:
            self._b.array[:] += self.config.from_rows(change.array_r)
            self._assembled_at = np.array(self.u.x.array)

    def inverted(self) -> str | None:
        """Position of an inverted cell, or None (collective)."""
        return self.inversions.find() if self.inversions is not None else None

    # -- checkpoints ---------------------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Commit the history of materials and the diagonal of K with the present displacement."""
        for material in self.materials:
            material.commit()
        self.stiffness_at_start = self.stiffness
        explicit = self.dynamics is not None and self.dynamics.moving and self.dynamics.scheme.explicit
        self.driving = self.config.rows(self.residual_of_all).ravel() if explicit else None

    def restore(self) -> None:
        """Restore the committed state, after the displacement has been reset to the committed one."""
        for material in self.materials:
            material.update()
        self.stiffness, self._stiffness_of = self.stiffness_at_start, -1

    def to_checkpoint(self, u: fem.Function) -> bool:
        """Write the diagonal of K into a Function; whether it is known (collective)."""
        if self.stiffness is None:
            return False
        u.x.array[: self.stiffness.size] = self.stiffness.ravel()
        u.x.scatter_forward()
        return True

    def from_checkpoint(self, u: fem.Function | None) -> None:
        """Restore the diagonal of K from a checkpoint; None if it was not known."""
        self.driving, n, g = None, self.config.n_owned, self.config.block
        self.stiffness = self.stiffness_at_start = None if u is None else np.array(u.x.array[: n * g]).reshape(n, g)


def configured(u: fem.Function, displacement: int | None) -> Configuration:
    """Configuration of u, of its displacement part with this number, or of a scalar field (collective)."""
    if displacement is None:
        V = u.function_space
        if V.dofmap.index_map_bs > 1 or compat.is_mixed(V):
            return Configuration(u)
        from uem_dolfinx.geometry.fields import ScalarConfiguration

        return ScalarConfiguration(u)
    from uem_dolfinx.geometry.fields import ConfigurationAmongFields

    return ConfigurationAmongFields(u, displacement)


def solver_of(config: Configuration, prefix: str, options: Any) -> UnitedSolver:
    """Solver of the constrained system, with field split for mixed problems; arguments as in ``UnitedSolver`` (collective)."""
    kind: type[UnitedSolver] = UnitedSolver
    if config.unknowns.mixed:
        from uem_dolfinx.algebra.field_split import SolverOfFields

        kind = SolverOfFields
    solver = kind(config.unknowns, prefix, options)
    with agreed(config.comm):
        check_fields(options, config.unknowns.names if config.unknowns.mixed else ["u"])
    return solver
