"""Linear solver of the constrained system: pattern of ``P'KP`` reused, near-null space mapped to q, KSP and PC by size or options."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms, given
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.blocks import is_symmetric, rows_are_symmetric, stiffen
from uem_dolfinx.algebra.condensed import Condensed, Solved
from uem_dolfinx.algebra.deflation import MULTIGRID, in_deflation, near_null_space, pressed_hard
from uem_dolfinx.algebra.kept_factor import KeptFactor
from uem_dolfinx.algebra.ksp import KspOfOptions
from uem_dolfinx.algebra.options import NO_SUCH_TYPE, check_options, last_words, options_in_turn, tell_unused
from uem_dolfinx.algebra.products import UnitedMatrix, made_of
from uem_dolfinx.algebra.relative import KeptCondensation
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.errors import InputError, LinearSolveError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agreed, reduced

#: An iterative solve leaves at least this part of its right-hand side: what is below comes near to rounding.
#: [convention; ratio of norms; test_linear_solver.py::test_accuracy_of_an_iterative_solve]
MOST_ACCURATE = 1e-10


class UnitedSolver(KspOfOptions):
    """KSP for ``P'KP dq = P'(r - K c)``.

    PETSc's ``options`` are given without ``prefix``; defaults depend on the size. Without ``ksp_rtol`` the tolerance follows Newton.
    """

    parts = "_kept", "_preconditioner", "condensed", "slots", "_united", "_unsymmetric"

    def __init__(self, space: Nodes, prefix: str, options: dict[str, Any] | None):
        self.space = space
        size = space.block * space.n_global
        with agreed(space.comm):
            check_options({} if options is None else options, prefix)
        given.alike(space.comm, "UnitedProblem", petsc_options=options, petsc_options_prefix=prefix)
        self._prefix = prefix
        #: Options used first, options for the rest of a step if the first do not fit the matrix, and options used if they fail.
        self._first, self._instead, self._at_need = options_in_turn(options, prefix, size, space.gdim, space.mixed)
        #: Options of the user that PETSc has not used yet; None after the warning.
        self._unused: set[str] | None = set(options or ())
        self._fixed_accuracy = "ksp_rtol" in self._first or PETSc.Options(prefix).hasName("ksp_rtol")
        self._A: Any = None
        self.ksp: Any = None
        self._use(self._first)
        #: Storage of ``P'KP``, ``Q'KP`` and, without equations, of K without prescribed components.
        self._united, self._unsymmetric = (UnitedMatrix(space, not self.iterative) for _ in range(2))
        self._crossed: tuple[PETSc.Mat, PETSc.Mat] | None = None
        #: The last factorisation, and the constrained matrix that is solved with it, or None.
        self._kept = KeptFactor(space)
        self._served: tuple[Restriction, PETSc.Mat, PETSc.Mat | None, Restriction] | None = None
        #: K condensed onto the contact, and whether the present constrained matrix uses it.
        self.condensed, self._on_condensed = Condensed(space), False
        self.slots = KeptCondensation()  # K condensed onto slots of contactors
        #: Whether K is the same for every displacement, and K of the last constrained matrix with the state of its values.
        self.lasting = False
        self._of: tuple[PETSc.Mat, int] | None = None
        self._made_of: Any = None  # fingerprint of the matrices that the last constrained matrix was made of
        #: Arguments of the present constrained matrix.
        self._arguments: tuple[Restriction, PETSc.Mat, PETSc.Mat | None, Restriction] | None = None
        #: P, K and Q of the present constrained matrix, if it is factorised and the factorisation may serve others.
        self._factor_of: tuple[Restriction, PETSc.Mat, Restriction] | None = None
        self._petrov_galerkin = self._begins = False  # whether Q is not P, and whether a step begins
        self.commit()

    def forget(self) -> None:
        """Drop the constrained matrix, factorisations and the set-up of the preconditioner (collective)."""
        self._served = self._factor_of = self._of = self._made_of = self._arguments = None
        for made in (self._kept, self.condensed, self.slots):
            made.drop()
        self._make_anew(self._first)

    def _make_anew(self, options: dict[str, Any]) -> None:
        """Make KSP and constrained matrices anew, with these options (collective)."""
        self._A = self._crossed = None
        self._use(options)
        self._united, self._unsymmetric = (UnitedMatrix(self.space, not self.iterative) for _ in range(2))

    def restore(self) -> None:
        """Return to the last accepted step; a constrained matrix that has been overwritten since then is made again (collective)."""
        assert self._last is not None
        own, of, now = self.keeps, self._made_of, {name: self.__dict__[name] for name in ("_symmetric", "_types")}
        anew = self._united is not self._last["_united"]
        super().restore()
        symmetric = self._symmetric
        if own:
            self.__dict__.update(now)
            self._adapt(symmetric)
        if not (anew or (own and of == self._made_of)):
            self._made_of = None

    def begin_step(self) -> None:
        """Let sparsity and method of solution depend on this step only, but for preconditioners made of a constant K."""
        self._begins, self._of = True, None
        for made in () if self.lasting else (self._kept, self.condensed):
            made.drop()
        for part in (self.condensed, self._united, self._unsymmetric):
            part.begin_step()

    @property
    def cheap(self) -> bool:
        """Whether solves for another active set need no factorisation, and few solves by an earlier one."""
        return self.iterative or self._on_condensed or (self._served is not None and self._kept.cheap)

    @property
    def gives_way(self) -> bool:
        """Whether CG leaves unsymmetric matrices to a factorisation, which serves for all of them if K is constant."""
        return self.iterative and self.lasting and bool(self._instead)

    def set_operator(
        self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, test: Restriction | None = None, roughly: bool = False
    ) -> None:
        """Build ``Q'(K + G)P`` and set it as operator of the KSP, unless it is already set (collective).

        ``restriction`` is P, of the current constraint equations; ``test`` is Q, by default P, and the matrix is then symmetric if K
        is. ``K`` is the tangent matrix without boundary conditions, ``G`` the second derivatives of gaps times forces. With
        ``roughly``, matrices that differ only in coefficients of P, Q and G count as the same.
        """
        test = test or restriction
        self.condensed.begin_at(None)
        before, self._made_of = self._made_of, made_of(restriction, test, K, G, roughly)
        same = before is not None and before == self._made_of
        # the first solve of a step does not depend on earlier steps
        otherwise = self._on_condensed or self._served is not None or self.options is not self._first
        if same and not (self._begins and otherwise):
            self._begins, self._of = False, (K, K.stateGet())
            return
        self._petrov_galerkin, self._arguments = test is not restriction, (restriction, K, G, test)
        if self._begins and self.options is not self._first:
            self._use(self._first)
        self._begins = False
        if self._petrov_galerkin and self._instead and self.iterative:
            self._use(self._instead)  # a factorisation, which also yields the sign of the determinant
        self._served = None
        self._on_condensed = self._condense(restriction, test, K, G, same)
        if self._on_condensed or self._served is not None:
            return
        self._factor_of = None
        self._kept.drop()
        if self.keeps and self.lasting and not self.iterative:
            self._make_anew(self.options)
        if self._petrov_galerkin:
            if self.iterative:  # P'KP makes the preconditioner
                self._set_symmetric(restriction, K, G)
            self._adapt(False)
            self._set_unsymmetric(restriction, test, K, G)
            return
        if not self._symmetric and self.pc.getType() == "gamg":
            # its smoothers would keep eigenvalue bounds estimated by GMRES
            self._use(self.options)
        self._set_symmetric(restriction, K, G)

    def take(self, solved: Solved, P: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, Q: Restriction) -> None:
        """As ``set_operator``, for a constrained problem whose solution is known (collective)."""
        self.condensed.take(solved, P, Q, K, G)
        self._petrov_galerkin, self._on_condensed, self._served, self._made_of = Q is not P, True, None, None

    def _set_symmetric(self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Set ``P'(K + G)P`` as operator of the KSP (collective)."""
        if restriction.alone and G is None:
            with timed("cross out prescribed components"):
                if self._crossed is None or self._crossed[0] != K:
                    self._crossed = K, K.copy()
                self._A = K.copy(self._crossed[1], PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                restriction.cross_out(self._A)
                stiffen(self._A, K, ~restriction.used.ravel())
        else:
            self._A = self._united.update(restriction, restriction, K, G)
        pressed = pressed_hard(self.space, self._A, K, restriction) if self._deflates else np.zeros(0, dtype=bool)
        here = [not rows_are_symmetric(self._A, self.space), pressed.any(), *self._preconditioner.changes(restriction.equations)]
        unsymmetric, hard, *changes = reduced(self.space.comm, np.array(here, dtype=np.int64))
        if unsymmetric and self._instead and self.iterative:
            self._use(self._instead)
        symmetric = not unsymmetric
        self._adapt(symmetric)
        self._new = not (self.iterative and self._preconditioner.serves(restriction.equations, *changes))
        if self._new and self.iterative and self.keeps:
            self._use(self.options)
            self._adapt(symmetric)
            self._preconditioner.serves(restriction.equations, *changes)
        self.pc.setReusePreconditioner(not self._new)
        self._A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        # these preconditioners can use the rigid-body modes
        if self._new and self.pc.getType() in ("gamg", "ml", "bddc") and not self.space.mixed:
            self._A.setBlockSize(self.space.block)
            self._A.setNearNullSpace(near_null_space(self.space, self._A, restriction))
        self.pc.setOperators(self._A)
        if self._deflates:
            self.ksp.setPC(in_deflation(self.pc, self.space, self._A, restriction, pressed) if hard else self.pc)
        self.ksp.setOperators(self._A)
        if symmetric and not self.iterative and self.pc.getType() in mumps.FACTORISATIONS:
            self._factor_of = restriction, K, restriction

    @property
    def A(self) -> Any:
        """The constrained matrix of all unknowns (collective)."""
        if not self._on_condensed:
            return self._A
        P, Q, K, G = self.condensed.made_of
        return (self._united if P is Q else self._unsymmetric).update(P, Q, K, G)

    def _condense(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, same: bool) -> bool:
        """Constrain the condensed problem if this is cheaper; whether it is done (collective).

        A condensed solve costs two solves of the bodies, a factorisation about ten. So condensation pays if K is constant, or from the
        second matrix of a K on. A kept factorisation that can be used is noted.
        """
        again, self._of = self._of == (K, K.stateGet()), (K, K.stateGet())
        pays = not (self.iterative or self.space.mixed) and mumps.condenses(self.pc) and (P.n_equations > 0 or G is not None)
        pays = pays and (self.lasting or again)
        serves = pays and self.condensed.serves(P, Q, K, G)
        if not serves and not (self.lasting and pays and self._factorise_inside(P, Q, K, G)):
            if self._kept.serves(P, K, Q):
                self._served = P, K, G, Q
                return False
            if self.lasting or not (pays and self._factorise_inside(P, Q, K, G)):
                return False
        if not (serves and same):
            self.condensed.unite(P, Q, G)
        return True

    def _factorise_inside(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, **options: Any) -> bool:
        """Factorise K without the components of the contact; whether this is possible and cheaper (collective)."""
        pc, symmetric = PETSc.PC().create(self.space.comm), is_symmetric(K, self.space)
        pc.setOptionsPrefix(self._prefix)
        pc.setType((self.pc.getType() if self._symmetric else self._types[1]) if symmetric else "lu")
        with timed("factorisation or preconditioner set-up"), self._in_database(**options):
            if self.condensed.factorise(P, Q, K, G, pc, symmetric):
                return True
        if more := mumps.more_workspace(pc):
            logger.debug("MUMPS lacked workspace, and gets more: %s", more)
            return self._factorise_inside(P, Q, K, G, **options | more)
        return False

    @property
    def _deflates(self) -> bool:
        """Whether the preconditioner needs deflation of targets under much stiffer contactors."""
        return self.pc.getType() in MULTIGRID and not self.space.mixed

    def _set_unsymmetric(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> None:
        """Set ``Q'(K + curvature)P`` as operator of the KSP (collective)."""
        A = self._unsymmetric.update(P, Q, K, curvature)
        if not self.iterative:
            self._new, self._A, self._factor_of = True, A, (P, K, Q) if mumps.solves(self.pc) else None
            self.pc.setReusePreconditioner(False)
        self.ksp.setOperators(A, self._A)

    @property
    def tells_sign(self) -> bool:
        """Whether the solver yields the sign of the determinant of ``Q'KP``, for Q different from P."""
        return self._petrov_galerkin and mumps.solves(self.pc)

    @property
    def negative(self) -> bool:
        """Whether ``Q'KP`` of the last solve has a negative determinant; False if its sign is unknown."""
        if self._on_condensed:
            return self._petrov_galerkin and self.condensed.negative
        return self.tells_sign and not self._new and mumps.is_negative(self.pc)

    @property
    def indefinite(self) -> bool:
        """Whether the last factorised symmetric matrix has negative eigenvalues not due to multipliers, if known (collective)."""
        return self.condensed.indefinite if self._on_condensed else (not self._new and mumps.is_indefinite(self.pc, self.space))

    def negative_without(self, restriction: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> bool:
        """Whether ``P'KP`` has a negative determinant; arguments as in ``set_operator`` (collective)."""
        self._kept.drop()
        self.set_operator(restriction, K, curvature)
        if self._on_condensed:
            return self.condensed.negative
        self._set_up(**mumps.TELLS_SIGN)
        return mumps.is_negative(self.pc)

    def _set_up(self, **options: Any) -> None:
        """Set up the preconditioner for the present matrix, with further options (collective)."""
        with self._in_database(**options):
            self.ksp.setUp()
            self.ksp.setUpOnBlocks()
        if more := mumps.more_workspace(self.pc):
            logger.debug("MUMPS lacked workspace, and gets more: %s", more)
            operators = self.ksp.getOperators()
            self.pc.reset()
            self.ksp.setOperators(*operators)
            self._set_up(**options | more)
        self._new = False

    @property
    def inexact(self) -> bool:
        """Whether solves use the requested accuracy as tolerance."""
        return self.iterative and not self._fixed_accuracy

    @property
    def exact(self) -> bool:
        """Whether solves with the present matrix are exact up to rounding."""
        return not self.iterative and self._served is None

    def left(self, accuracy: float) -> float:
        """Part of its right-hand side that the last solve, of this ``accuracy``, may have left; 0 for rounding."""
        return self.condensed.left if self._on_condensed else 0.0 if self.exact else accuracy

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq, and the number of linear iterations (collective).

        An iterative solver whose options do not fix ``ksp_rtol`` uses the relative tolerance ``accuracy``. Its initial guess is ``near``,
        if given: the unknowns of the last solve under the same forces of the bodies.

        Raises:
            LinearSolveError: with PETSc's reason.
        """
        if self._on_condensed:
            dq = self.condensed.solve(rhs, near is not None, accuracy)
            self._tell_unused()
            if np.isfinite(dq.norm()):
                return dq, 1
            raise LinearSolveError("the united problem is singular: hold bodies that are free or slip by Dirichlet conditions")
        self.condensed.whole = True
        if self._served is not None:
            if accuracy > 0 and (found := self._kept.solve(*self._served, rhs, accuracy)) is not None:
                return found
            self._kept.drop()
            self._of = self._made_of = None
            self.set_operator(*self._served)
            return self.solve(rhs, accuracy, near)
        guess = near if self.iterative else None  # factorisations need none
        dq = rhs.duplicate() if guess is None else guess.copy()
        self.ksp.setInitialGuessNonzero(guess is not None)
        if self.inexact:
            self.ksp.setTolerances(rtol=max(0.0 if self.space.mixed else accuracy, MOST_ACCURATE))
        kinds = f"{self.ksp.getType()} and {self.pc.getType()}"
        try:
            if self._new:
                with timed("factorisation or preconditioner set-up"):
                    self._set_up(**(mumps.TELLS_SIGN if self.tells_sign else {}))
            with timed("linear solve"), self._in_database():
                slow = self._iterate(rhs, dq)
        except PETSc.Error as error:
            if error.ierr in NO_SUCH_TYPE:
                raise InputError(
                    f"PETSc cannot do with petsc_options = {given.shown(self.options)}, {kinds}: {last_words(error)}; choose others"
                ) from error
            raise LinearSolveError(
                f"PETSc error {error.ierr} in the united solve with {kinds} ({last_words(error)}): "
                "a body may be free to move as a rigid body; hold it by a Dirichlet condition or bring it into contact"
            ) from error
        self._tell_unused()
        reason, iterations = self.ksp.getConvergedReason(), int(self.ksp.getIterationNumber())
        if slow:
            logger.debug("the preconditioner is made anew after %d iterations with an earlier one", iterations)
            self._made_of = None
            self._use(self.options)
            assert self._arguments is not None
            self.set_operator(*self._arguments)
            dq, more = self.solve(rhs, accuracy, near)
            return dq, iterations + more
        if reason < 0 and self._at_need and self.iterative:
            logger.debug("%s left the system with reason %d after %d iterations: it is factorised", kinds, reason, iterations)
            self._A, symmetric = self.ksp.getOperators()[0], self._symmetric
            self._use(self._at_need)
            self._adapt(symmetric)
            self.ksp.setOperators(self._A)
            dq, more = self.solve(rhs)
            return dq, iterations + more
        if reason < 0 or not (self.iterative or np.isfinite(dq.norm())):
            raise LinearSolveError(
                f"the united solve with {kinds} failed, KSP reason {reason}, after {iterations} iterations{mumps.how_it_ended(self.pc)}: "
                "a body may be free to move as a rigid body, the tangent may be indefinite (use a direct solver), or ksp_max_it too small"
            )
        self._preconditioner.see(iterations, self.ksp.getConvergenceHistory())
        if self._factor_of is not None:
            self._kept.keep(self.pc, *self._factor_of)
        return dq, iterations

    def forces(self, K: PETSc.Mat, du: PETSc.Vec) -> PETSc.Vec:
        """``K du`` of an increment of the last solve; components that were not completed are in equilibrium (collective)."""
        return forms.product(K, du) if self.iterative else self.condensed.forces(K, du, self.exact)

    def begin_at(self, c: PETSc.Vec, rounding: float = 0.0) -> None:
        """Set the increment to which the next solves add ``P dq``, to be completed, and the norm below which forces are rounding."""
        self.condensed.begin_at(c, rounding)

    def complete(self, dq: PETSc.Vec, needed: Any = None) -> PETSc.Vec:
        """All unknowns of the last solve; completed only if one of the nodes that ``needed`` returns is missing (collective)."""
        return self.condensed.complete(dq, needed) if self._on_condensed else dq

    def _iterate(self, rhs: PETSc.Vec, dq: PETSc.Vec) -> bool:
        """Solve by the KSP from ``dq``; whether an earlier preconditioner takes too many iterations for that (collective)."""
        rtol, _, _, bound = self.ksp.getTolerances()
        most = self._preconditioner.most(rtol)
        kept = most is not None and most < bound
        if kept:
            self.ksp.setTolerances(max_it=most)
        self.ksp.solve(rhs, dq)
        self.ksp.setTolerances(max_it=bound)
        return kept and self.ksp.getConvergedReason() < 0

    def _tell_unused(self) -> None:
        """Warn, once, of options that PETSc has not used."""
        tell_unused(self._unused or (), self.options, f"{self.ksp.getType()} and {self.pc.getType()}")
        self._unused = None
