"""The linear solve of the united system: ``P'KP`` with its pattern reused, near-null space carried to q, KSP and PC by size.

Any KSP and PC can be chosen through ``petsc_options``.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, given
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.deflation import INDEPENDENT, Deflation, deflated, pressed_hard, without
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.kept_factor import KeptFactor
from uem_dolfinx.algebra.options import OFTEN_USED, check_options, default_options
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.errors import InputError, LinearSolveError
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agreed

#: Up to so many bodies each have rigid-body modes of their own in the near-null space.
#: [convention; bodies; test_linear_solver.py::test_few_bodies_have_modes_of_their_own]
MODES_OF_THEIR_OWN = 4
#: An iterative solve leaves at least this part of its right-hand side: what is below comes near to rounding.
#: [convention; ratio of norms; test_linear_solver.py::test_accuracy_of_an_iterative_solve]
MOST_ACCURATE = 1e-10
#: A preconditioner is kept for matrices that differ from its own in no more than this part of the equations.
#: [convention; part of the equations; test_linear_solver.py::test_preconditioner_is_kept]
KEPT_CHANGES = 0.1
#: A preconditioner is kept while it takes no more than this times as many iterations for each digit as at first.
#: [convention; ratio of iterations; test_linear_solver.py::test_preconditioner_is_kept]
KEPT_SLOWER = 2.0
#: A matrix is symmetric if no entry differs from the one across by more than this part of the root of their diagonals' product.
#: [convention; entries; test_linear_solver.py::test_what_counts_as_symmetric]
SYMMETRIC = 1e-11
#: Types of PC that cannot see contactors much stiffer than their targets.
MULTIGRID = ("hypre", "gamg", "ml")
#: Errors of PETSc that say that it has no such type, or no such factorisation.
NO_SUCH_TYPE = (86, 92)


def _last_words(error: PETSc.Error) -> str:
    """What PETSc says about an error, without where in its sources."""
    return str(error).splitlines()[-1].partition("] ")[2] or str(error)


class UnitedSolver:
    """KSP for ``P'KP dq = P'(r - K c)``.

    PETSc's ``options`` are given without their ``prefix``; None chooses by size. Without ``ksp_rtol`` every solve is as accurate as
    its Newton iteration can use.
    """

    def __init__(self, space: Nodes, prefix: str, options: dict[str, Any] | None):
        self.space = space
        size = space.block * space.index_map.size_global
        with agreed(space.comm):
            check_options({} if options is None else options, prefix)
        given.alike(space.comm, "UnitedProblem", petsc_options=options, petsc_options_prefix=prefix)
        self._prefix = prefix
        #: Options that are asked for first, and those that take over for the rest of a step where they fail or do not suit.
        self._first, self._instead = default_options(size, space.gdim) if options is None else (dict(options), {})
        self.options = self._first
        #: Options of the user's that PETSc has not asked for yet; None once the user was told.
        self._unused: set[str] | None = set(options or ())
        self._fixed_accuracy = "ksp_rtol" in self.options or PETSc.Options(prefix).hasName("ksp_rtol")
        self.A: Any = None
        self.ksp: Any = None
        self._use(self._first)
        #: Where ``P'KP``, ``Q'KP`` and, without equations, K without prescribed components are kept.
        self._united, self._unsymmetric = (UnitedMatrix(space, not self.iterative) for _ in range(2))
        self._crossed: tuple[PETSc.Mat, PETSc.Mat] | None = None
        #: The last factorisation, and the united matrix that it serves to solve with, if it does.
        self._kept = KeptFactor(space)
        self._served: tuple[Restriction, PETSc.Mat, PETSc.Mat | None] | None = None
        #: P and K of the present united matrix, if it is symmetric and factorised.
        self._factor_of: tuple[Restriction, PETSc.Mat] | None = None
        #: Iterations per digit that the preconditioner took at first and takes now.
        self._first_pace = self._pace = 0.0
        #: Whether Q is not P, and whether a step begins.
        self._apart = self._begins = False

    def _create_ksp(self) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.space.comm)
        #: The preconditioner that the options ask for, which the KSP may have inside another one.
        self.pc = ksp.getPC()
        ksp.setOptionsPrefix(self._prefix)
        ksp.setErrorIfNotConverged(False)
        ksp.setConvergenceHistory(reset=True)
        with self._in_database():
            try:
                ksp.setFromOptions()
            except PETSc.Error as error:
                raise InputError(
                    f"PETSc refuses petsc_options = {given.shown(self.options)}: {_last_words(error)}; correct them"
                ) from error
        return ksp

    def _use(self, options: dict[str, Any]) -> None:
        """Make a KSP with these options, which knows nothing yet (collective)."""
        self.options = options
        if self.ksp is not None:
            self.ksp.destroy()
        #: Whether the preconditioner has yet to see the present matrix; equations that it was made with.
        self._new = True
        self._made_with: UnitingEquations | None = None
        self.ksp = self._create_ksp()
        #: Whether the KSP is for symmetric matrices, and the types of KSP and PC that the options ask for.
        self._symmetric = True
        self._types = self.ksp.getType(), self.pc.getType()

    def forget(self) -> None:
        """Drop the united matrix and everything that the preconditioner has learnt of it (collective)."""
        self.A = self._crossed = self._served = self._factor_of = None
        self._kept.drop()
        self._use(self._first)
        self._united, self._unsymmetric = (UnitedMatrix(self.space, not self.iterative) for _ in range(2))

    def begin_step(self) -> None:
        """Let what the united matrix has room for, and how it is solved, depend on this step alone."""
        self._begins = True
        self._kept.drop()
        self._united.begin_step()
        self._unsymmetric.begin_step()

    @contextmanager
    def _in_database(self, **instead: Any) -> Iterator[None]:
        """Show PETSc the options, some with another value; levels of a multigrid read theirs only when they are set up."""
        database, prefix, options = PETSc.Options(), self._prefix, self.options | instead
        for key, value in options.items():
            database[prefix + key] = value
        try:
            yield
        finally:
            for key in options:
                if self._unused and compat.petsc_option_used(prefix + key) is not False:
                    self._unused.discard(key)
                del database[prefix + key]

    @property
    def iterative(self) -> bool:
        """Whether solves have a tolerance."""
        return bool(self.ksp.getType() != "preonly")

    @property
    def needs_near_null_space(self) -> bool:
        """Whether the preconditioner can use the rigid-body modes."""
        return self.pc.getType() in ("gamg", "ml", "bddc")

    def set_operator(
        self, restriction: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None, test: Restriction | None = None
    ) -> None:
        """Build ``Q'(K + curvature)P`` and give it to the KSP (collective).

        ``restriction`` is P, of the current uniting equations, ``test`` is Q: if None, or the same object, P, and the matrix is
        symmetric if K is. ``K`` is the tangent matrix without boundary conditions, ``curvature`` second derivatives of gaps times forces.
        """
        test = test or restriction
        self._apart = test is not restriction
        if self._begins and self.options is not self._first:
            self._use(self._first)
        self._begins = False
        self._served = (restriction, K, curvature) if not self._apart and self._kept.serves(restriction, K) else None
        if self._served is not None:
            return
        self._factor_of = None
        self._kept.drop()
        if self._apart:
            if self._instead and self.iterative:
                # it tells the sign of the determinant as well
                self._use(self._instead)
            # direct solvers need no P'KP; for others it makes the preconditioner
            if self.iterative:
                self.set_operator(restriction, K, curvature)
                self._apart = True
            self._adapt(False)
            self._set_unsymmetric(restriction, test, K, curvature)
            return
        if restriction.alone and curvature is None:
            with timed("cross out prescribed components"):
                if self._crossed is None or self._crossed[0] != K:
                    self._crossed = K, K.copy()
                self.A = K.copy(self._crossed[1], PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                restriction.cross_out(self.A)
                _stiffen_idle(self.A, K, restriction)
        else:
            self.A = self._united.update(restriction, restriction, K, curvature)
        symmetric = is_symmetric(self.A)
        if not symmetric and self._instead and self.iterative:
            self._use(self._instead)
        self._adapt(symmetric)
        self._keep_preconditioner(restriction.equations)
        self.A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        if self._new and self.needs_near_null_space:
            self.A.setBlockSize(self.space.block)
            self.A.setNearNullSpace(self._near_null_space(restriction))
        self.pc.setOperators(self.A)
        self._deflate(restriction, K)
        self.ksp.setOperators(self.A)
        if symmetric and not self.iterative and self.pc.getType() in mumps.FACTORISATIONS:
            self._factor_of = restriction, K

    def _deflate(self, restriction: Restriction, K: PETSc.Mat) -> None:
        """Put multigrid into a deflation where contactors are much stiffer than what they press on (collective)."""
        if self.pc.getType() not in MULTIGRID:
            return
        with timed("deflation"):
            pressed = pressed_hard(self.space, self.A, K, restriction)
            if not self.space.comm.allreduce(int(pressed.any())):
                self.ksp.setPC(self.pc)
                return
            self.pc.setOperators(without(self.space, self.A, restriction, pressed))
            deflation = Deflation(self.pc)
            deflation.update(self.A, deflated(self.space, self.A, restriction, pressed))
            self.ksp.setPC(PETSc.PC().createPython(deflation, comm=self.space.comm))

    def _adapt(self, symmetric: bool) -> None:
        """Take the KSP and PC of the options, or ones for unsymmetric matrices in place of those for symmetric ones."""
        if symmetric == self._symmetric:
            return
        self._symmetric = symmetric
        pc, before = self.pc, self.pc.getType()
        if symmetric:
            self.ksp.setType(self._types[0])
            pc.setType(self._types[1])
        else:
            self._types = self.ksp.getType(), before
            self.ksp.setType({"cg": "gmres", "minres": "gmres"}.get(self._types[0], self._types[0]))
            pc.setType({"cholesky": "lu", "icc": "ilu"}.get(before, before))
        # the others have options of their own; one that stays is not shown its options again: hypre would lose what it has set up
        reader = pc
        if pc.getType() == before:
            reader = PETSc.PC().create(self.space.comm)
            reader.setType("none")
        self.ksp.setPC(reader)
        with self._in_database(ksp_type=self.ksp.getType(), pc_type=reader.getType()):
            self.ksp.setFromOptions()
        self.ksp.setPC(pc)

    def _set_unsymmetric(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> None:
        """Give ``Q'(K + curvature)P`` to the KSP (collective)."""
        A = self._unsymmetric.update(P, Q, K, curvature)
        if self.iterative:
            self.ksp.setOperators(A, self.A)
            return
        self._new, self.A = True, A
        self.pc.setReusePreconditioner(False)
        self.ksp.setOperators(A)

    def _keep_preconditioner(self, equations: UnitingEquations) -> None:
        """Decide whether the preconditioner serves the present matrix as well (collective)."""
        keep, before = False, self._made_with
        if self.iterative and before is not None:
            same = np.array_equal(equations.node, before.node)
            changed = (equations.active != before.active).sum() if same else len(before) + 1
            changed, present = self.space.comm.allreduce(np.array([changed, before.active.sum()]))
            keep = changed <= KEPT_CHANGES * present and 0.0 < self._pace <= KEPT_SLOWER * self._first_pace
        if not keep:
            self._made_with, self._first_pace = equations, 0.0
        self._new = not keep
        self.pc.setReusePreconditioner(bool(keep))

    def _near_null_space(self, restriction: Restriction) -> PETSc.NullSpace:
        """Rigid-body modes in the unknowns q: at a contactor their tangential components only.

        Bodies in contact may still slide along each other; a few of them get modes of their own, or aggregates that reach
        across a contact would lock its sliding.
        """
        body, n_bodies = find_bodies(self.space)
        body = body[: self.space.n_owned]
        own = range(n_bodies - 1) if n_bodies <= MODES_OF_THEIR_OWN else ()
        joint = list(self.space.modes().transpose(1, 0, 2))
        vectors: list[PETSc.Vec] = []
        for mode in [*joint, *(m * (body == i)[:, None] for i in own for m in joint)]:
            full = self.A.createVecLeft()
            full.array[:] = mode.ravel()
            q = restriction.reduce(full)
            before = q.norm()
            # twice is enough
            for other in [*vectors, *vectors]:
                q.axpy(-q.dot(other), other)
            if q.norm() > INDEPENDENT * before:
                q.normalize()
                vectors.append(q)
        return PETSc.NullSpace().create(vectors=vectors, comm=self.space.comm)

    @property
    def _tells_sign(self) -> bool:
        """Whether the solver tells the sign of the determinant of ``Q'KP`` where Q is not P."""
        return self._apart and mumps.solves(self.pc)

    @property
    def negative(self) -> bool:
        """Whether ``Q'KP`` of the last solve has a negative determinant, as far as the solver tells it."""
        return self._tells_sign and mumps.is_negative(self.pc)

    def negative_without(self, restriction: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> bool:
        """Whether ``P'KP`` has a negative determinant, arguments as those of ``set_operator`` (collective)."""
        self._kept.drop()
        self.set_operator(restriction, K, curvature)
        self._set_up(**mumps.TELLS_SIGN)
        return mumps.is_negative(self.pc)

    def _set_up(self, **options: Any) -> None:
        """Let the preconditioner see the present matrix, with these options beside its own (collective)."""
        with self._in_database(**options):
            self.ksp.setUp()
            self.ksp.setUpOnBlocks()
        more = mumps.more_room(self.pc)
        if more:
            logger.debug("MUMPS lacked room, and gets more: %s", more)
            operators = self.ksp.getOperators()
            self.pc.reset()
            self.ksp.setOperators(*operators)
            self._set_up(**options | more)
        self._new = False

    @property
    def inexact(self) -> bool:
        """Whether solves are as accurate as asked, and no more."""
        return self.iterative and not self._fixed_accuracy

    @property
    def exact(self) -> bool:
        """Whether solves with the present matrix leave no more than rounding."""
        return not self.iterative and self._served is None

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq, and the number of linear iterations (collective).

        An iterative solver whose options do not fix its ``ksp_rtol`` may leave the part ``accuracy`` of the right-hand side; it begins
        with the unknowns ``near``, if they are given.

        Raises:
            LinearSolveError: with PETSc's reason.
        """
        if self._served is not None:
            found = self._kept.solve(*self._served, rhs, accuracy) if accuracy > 0 else None
            if found is not None:
                return found
            self._kept.drop()
            self.set_operator(*self._served)
        dq = rhs.duplicate()
        # a factorisation has no use for a guess
        near = near if self.iterative else None
        self.ksp.setInitialGuessNonzero(near is not None)
        if near is not None:
            near.copy(dq)
        if self.inexact:
            self.ksp.setTolerances(rtol=max(accuracy, MOST_ACCURATE))
        try:
            if self._new:
                with timed("factorisation or preconditioner set-up"):
                    self._set_up(**(mumps.TELLS_SIGN if self._tells_sign else {}))
            with timed("linear solve"), self._in_database():
                self.ksp.solve(rhs, dq)
        except PETSc.Error as error:
            kinds = f"{self.ksp.getType()} and {self.pc.getType()}"
            if error.ierr in NO_SUCH_TYPE:
                raise InputError(
                    f"PETSc cannot do with petsc_options = {given.shown(self.options)}, {kinds}: {_last_words(error)}; choose others"
                ) from error
            raise LinearSolveError(
                f"PETSc error {error.ierr} in the united solve with {kinds} ({_last_words(error)}): "
                "a body may be free to move as a rigid body; hold it by a Dirichlet condition or bring it into contact"
            ) from error
        self._tell_unused()
        reason, iterations = self.ksp.getConvergedReason(), int(self.ksp.getIterationNumber())
        if reason < 0 and self._instead and self.iterative:
            logger.debug("CG left the united system with reason %d after %d iterations: it is factorised", reason, iterations)
            matrix, _ = self.ksp.getOperators()
            self._use(self._instead)
            self.ksp.setOperators(matrix)
            dq, more = self.solve(rhs)
            return dq, iterations + more
        if reason < 0 or not np.isfinite(dq.norm()):
            raise LinearSolveError(
                f"the united solve with {self.ksp.getType()} and {self.pc.getType()} failed with KSP reason {reason} after "
                f"{iterations} iterations{mumps.how_it_ended(self.pc)}: a body may be free to move as a rigid body, the tangent may be "
                "indefinite (use a direct solver), or ksp_max_it too small"
            )
        self._keep_pace(iterations)
        if self._factor_of is not None:
            self._kept.keep(self.pc, *self._factor_of)
        return dq, iterations

    def _keep_pace(self, iterations: int) -> None:
        """Note how many iterations a digit has taken."""
        norms = self.ksp.getConvergenceHistory()
        if iterations > 0 and len(norms) > iterations and norms[iterations] > 0:
            self._pace = iterations / max(np.log10(norms[0] / norms[iterations]), np.finfo(float).eps)
            self._first_pace = self._first_pace or self._pace

    def _tell_unused(self) -> None:
        """Warn, once, of options that PETSc has had no use for."""
        for key in sorted(self._unused or ()):
            near = difflib.get_close_matches(key, OFTEN_USED, n=1)
            logger.warning(
                "petsc_options[%r] = %s was not used by PETSc with %s and %s: %s",
                key, given.shown(self.options[key]), self.ksp.getType(), self.pc.getType(),
                f"did you mean {near[0]!r}?" if near else "check its spelling, or leave it out",
            )  # fmt: skip
        self._unused = None


def _stiffen_idle(A: PETSc.Mat, K: PETSc.Mat, P: Restriction) -> None:
    """Give A the diagonal of K where columns of P are idle (collective)."""
    diagonal, idle = A.getDiagonal(), ~P.used.ravel()
    diagonal.array[idle] = K.getDiagonal().array_r[idle]
    A.setDiagonal(diagonal)


def is_symmetric(A: PETSc.Mat) -> bool:
    """Whether A is symmetric but for rounding: entries are compared across all at once, in a random combination (collective)."""
    scale, size = A.getDiagonal(), A.createVecLeft()
    scale.sqrtabs()
    if scale.min()[1] == 0.0:
        return False
    scale.reciprocal()
    size.array[:] = scale.array_r * np.random.default_rng(A.comm.rank).choice([-1.0, 1.0], size.local_size)
    difference, across = A * size, size.duplicate()
    A.multTranspose(size, across)
    difference.axpy(-1.0, across)
    difference.pointwiseMult(difference, scale)
    return bool(difference.norm(PETSc.NormType.INFINITY) <= SYMMETRIC)
