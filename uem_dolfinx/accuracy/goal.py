"""goal_error: the error of a functional by the mesh, from a linear problem of both bodies in a space of one degree more.

With the residual r of a solution u in that space, its stiffness K there, and active contacts B with their gaps g and forces C
(``enriched_rows``), which are B but for friction,

    [ K  C' ] [ w ]   [ -r ]          [ K  C' ]' [ z ]   [ dJ/du ]
    [ B  0  ] [ . ] = [ -g ]          [ B  0  ]  [ . ] = [   0   ]

w leads to the solution of one degree more, in which contactors become active and are released as in the first one. So ``J'(w)``
estimates the error of J [R. Becker, R. Rannacher, Acta Numerica 10 (2001) 1-102]. The adjoint solution z gives the cells that it
comes from: with its part z_h of the solution's own degree, they are those of ``r (z - z_h)``, where r includes the contact tractions, and
those of the gaps times the adjoint pressures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from scipy.sparse import coo_matrix, diags

from uem_dolfinx import compat, forms, given
from uem_dolfinx.accuracy.enriched import Enriched, narrow_contacts, warn_of_few_facets
from uem_dolfinx.accuracy.enriched_rows import EnrichedRows, enriched_rows
from uem_dolfinx.accuracy.estimate import refuse_estimate
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.errors import InputError, LinearSolveError, MissingBackendError
from uem_dolfinx.form_checks import check_functional
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import Exchange, agreed, gathered, reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: With fewer facets in contact along each direction of the surface, the solution of one degree more has another contact.
#: [convention; facets; test_goal.py::test_few_facets_in_contact]
FEW = 3
#: Changes of the active set in the linear problem of a goal's error. [bound; factorisations; -]
MOST_SETS = 10


@dataclass(frozen=True)
class GoalError:
    """An estimate of the error of a functional by the mesh.

    Attributes:
        value: of the functional.
        error: estimate of the exact value minus this one.
        rounding: part of the value that the tolerance of equilibrium leaves open.
        parts: sum of the parts of all cells, in which errors of opposite signs do not cancel.
        cells: part of each cell, without sign, a Function that is constant in cells, for files and pictures.
        shares: the same of this rank's cells ``(n_owned_cells,)``.
    """

    value: float
    error: float
    rounding: float
    parts: float
    cells: fem.Function = field(repr=False)
    shares: Array = field(repr=False)

    @property
    def relative(self) -> float:
        """Size of the estimate over that of the value; NaN for a value that is zero to rounding."""
        return abs(self.error / self.value) if abs(self.value) > self.rounding else float("nan")

    def __str__(self) -> str:
        """The value, and the estimate in per cent."""
        return f"value {self.value:.6g}, error by the mesh: {100 * self.relative:.3g} %"


def goal_error(problem: UnitedProblem, J: ufl.Form) -> GoalError:
    """Estimate the error of a functional of the displacement by its mesh (collective).

    A linear problem of one degree more is solved for both bodies together, on the same mesh and with the same contactors. It takes the time
    of a factorisation of about four times as many unknowns as degree 1 has, and of twice as many as degree 2 has.

    Args:
        problem: in statics, in equilibrium, as ``solve`` or a step leaves it.
        J: a UFL form of the displacement, e.g. ``u[0] * uem.ds(tags["top"])``, or for the force on a part the residual with a Function
            in place of its test function.

    Returns:
        The value, the estimate, and the parts of the cells.

    Raises:
        InputError, InputTypeError: for problems that ``error_estimate`` refuses, friction other than Coulomb's, histories, couplings and
            general contact.
        MissingBackendError: if PETSc has neither MUMPS nor SuperLU_DIST.

    Example:
        ::

            problem.solve()
            print(uem.goal_error(problem, problem.u[1] * uem.ds(tags["top"])))
    """
    check_goal(problem, J)
    config, whole = problem.config, revolved(J)
    warn_of_few_facets(
        narrow_contacts(problem, FEW), "the goal's estimate may be off by a factor of five, or have the wrong sign"
    )
    with timed("estimate errors"):
        enriched = Enriched(problem)
        value = forms.assemble_scalar(forms.form(whole), config.comm)
        of_u = enriched.assembled(forms.expanded(ufl.derivative(whole, config.whole, enriched.test)))
        u = fem.Function(enriched.W)
        u.interpolate(config.u)
        terms = reduced(config.comm, float(np.abs(of_u.ravel() * u.x.array[: of_u.size]).sum()))
        rows = enriched_rows(enriched)
        system = _System(enriched, rows)
        error = reduced(config.comm, float((of_u * system.correction(-enriched.forces)).sum()))
        z = fem.Function(enriched.W)
        solution, pressures = system.solve(of_u, np.zeros(len(system.gaps)), back=True)
        z.x.array[: of_u.size] = solution.ravel()
        z.x.scatter_forward()
        system.close()
        z_h, again = fem.Function(config.V), fem.Function(enriched.W)
        z_h.interpolate(z)
        again.interpolate(z_h)
        away = (z.x.array - again.x.array)[: of_u.size].reshape(of_u.shape)
        of_nodes = np.abs((enriched.residual * away).sum(axis=1))
        np.add.at(of_nodes, rows.own, np.abs(pressures * np.where(system.active, system.gaps, 0.0)))
        shares = enriched.of_cells(of_nodes)
    cells = fem.Function(compat.function_space(config.mesh, ("DG", 0)), name="goal_error")
    cells.x.array[: len(shares)] = shares
    cells.x.scatter_forward()
    parts = reduced(config.comm, float(shares.sum()))
    return GoalError(float(value), float(error), problem.rtol * terms, parts, cells, shares)


def check_goal(problem: UnitedProblem, J: ufl.Form) -> None:
    """Refuse problems without an enriched linear problem, and functionals of more than the displacement (collective)."""
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        refuse_estimate(problem)
        given.kind("goal", J, isinstance(J, ufl.Form) and not J.empty(), "a UFL form with an integral, of the displacement")
        check_functional("goal", J, problem.config.mesh)
        if any(f.name.startswith("contact_") for f in J.coefficients()):
            raise InputError("goal: holds a result of a contact: expected the displacement; of forces take the residual")
        if not any(f is problem.u for f in J.coefficients()):
            raise InputError("goal: holds nothing that the problem solves for: expected problem.u")
        for present, what in (
            (bool(problem.materials), "a law with history"),
            (
                any(pair.friction is not None and not _proportional(pair.friction.limits.law) for pair in problem.pairs),
                "friction other than Coulomb's",
            ),
            (
                any(c.normal is not None or c.cohesion is not None or c.leak is not None for c in problem.contacts),
                "a law of gaps",
            ),
            (bool(problem.couplings) or bool(problem.points), "rigid couplings, or forces or springs at points"),
            (any(hasattr(contact, "parts") for contact in problem.declared), "general contact"),
            (
                any(not _of_facets(problem, contact) for contact in problem.contacts),
                "contactors that are points, or corners=True or edges=True",
            ),
        ):
            if present:
                raise InputError(f"the problem has {what}, which an estimate of a goal's error does not include")


def _proportional(law: FrictionLaw) -> bool:
    """Whether friction is a coefficient times the pressure."""
    return isinstance(law, Coulomb) and law.most is None and law.force is None


def _of_facets(problem: UnitedProblem, contact: Contact) -> bool:
    """Whether contactors are the nodes of facets."""
    tag = contact.contactor
    return isinstance(tag, Tag) and tag.dim == problem.config.tdim - 1 and not contact.further_parts_touch()


class _System:
    """The linear problem of one degree more; unknowns of a rank are its components of nodes, then its multipliers."""

    ksp: PETSc.KSP | None = None
    matrix: PETSc.Mat

    def __init__(self, enriched: Enriched, rows: EnrichedRows):
        comm, g = enriched.problem.comm, enriched.g
        self.comm, self.shape, self.n = comm, enriched.residual.shape, enriched.residual.size
        self.active, self.tied, m = rows.active.copy(), rows.tied, len(rows.active)
        self.first = first = np.append(0, np.cumsum(gathered(comm, self.n + m)))
        nodes = enriched.nodes

        def of_components(components: Ints) -> Ints:
            owner = nodes.owner_of(components // g)
            return np.asarray(first[owner] + components - g * nodes.first_of(owner))

        def of_rows(row: Ints) -> Ints:
            owner = np.searchsorted(rows.first, row, side="right") - 1
            # multipliers come last on each rank
            return np.asarray(first[owner + 1] - rows.first[owner + 1] + row)

        A = enriched.stiffness()
        starts, columns, values = A.getValuesCSR()
        i = np.repeat(np.arange(self.n), np.diff(starts))
        there = Exchange.to(comm, nodes.owner_of(rows.curvature[0] // g))
        k, turned, more = there.send(*rows.curvature)
        i, columns = np.concatenate([i, k - g * nodes.first]), np.concatenate([columns, turned]).astype(np.int64)
        of_K = np.concatenate([values, more]), (i, of_components(columns))
        self._K = coo_matrix(of_K, shape=(self.n + m, int(first[-1]))).tocsr()
        A.destroy()
        row, entries, forces = np.repeat(of_rows(rows.row), g), rows.value.ravel(), rows.force.ravel()
        column = of_components((rows.node[:, None] * g + np.arange(g)).ravel())
        # zeros stay in both alike
        there = Exchange.to(comm, np.where((entries != 0.0) | (forces != 0.0), np.searchsorted(first, row, side="right") - 1, -1))
        at, column, entries, forces = there.send(row, column, entries, forces)
        B, self._C = (
            coo_matrix((one, (at - first[comm.rank] - self.n, column)), shape=(m, int(first[-1]))).tocsr()
            for one in (entries, forces)
        )
        self._B, layout = B, ((m, int(rows.first[-1])), (self.n + m, int(first[-1])))
        self._openings = PETSc.Mat().createAIJ(layout, csr=(B.indptr, B.indices, B.data), comm=comm)
        gap_row, gap = Exchange.to(comm, np.searchsorted(rows.first, rows.gap_row, side="right") - 1).send(rows.gap_row, rows.gap)
        self.gaps: Array = np.asarray(np.bincount(gap_row - rows.first[comm.rank], gap, m), dtype=float)
        self.active &= np.asarray(abs(B).sum(axis=1)).ravel() > 0

    def _factorise(self) -> None:
        """Factorise with the equations that are active; others keep their multipliers at zero (collective)."""
        self.close()
        begin, last = self.first[self.comm.rank], self.first[self.comm.rank] + self.n + np.arange(len(self.active))
        B, C = (diags(1.0 * self.active) @ one for one in (self._B, self._C))
        for one in (B, C):
            one.eliminate_zeros()
        B, C = B.tocoo(), C.tocoo()
        there = Exchange.to(self.comm, np.searchsorted(self.first, C.col, side="right") - 1)
        i, j, v = there.send(C.col.astype(np.int64), (begin + self.n + C.row).astype(np.int64), C.data)
        entries = (np.concatenate([i - begin, self.n + B.row, last - begin]), np.concatenate([j, B.col, last]))
        values = np.concatenate([v, B.data, np.where(self.active, 0.0, 1.0)])
        whole = (self._K + coo_matrix((values, entries), shape=self._K.shape)).tocsr()
        sizes = whole.shape
        self.matrix = PETSc.Mat().createAIJ((sizes, sizes), csr=(whole.indptr, whole.indices, whole.data), comm=self.comm)
        self.ksp = _factorised(self.matrix)

    def close(self) -> None:
        """Destroy the matrix and its factors (collective)."""
        if self.ksp is not None:
            self.ksp.destroy()
            self.matrix.destroy()

    def correction(self, forces: Array) -> Array:
        """The displacement w by forces on the bodies ``(n, gdim)``, with the active contactors found anew (collective)."""
        for _ in range(MOST_SETS):
            self._factorise()
            w, lam = self.solve(forces, np.where(self.active, -self.gaps, 0.0))
            x, opening = self._openings.createVecs()
            x.array[: self.n] = w.ravel()
            self._openings.mult(x, opening)
            opened = self.gaps + opening.array_r
            active = self.tied & self.active | np.where(self.active, lam < 0.0, opened < 0.0)
            if not reduced(self.comm, int((active != self.active).sum())):
                break
            self.active = active
        return w

    def solve(self, forces: Array, gaps: Array, back: bool = False) -> tuple[Array, Array]:
        """Displacements ``(n, gdim)`` and multipliers ``(m,)`` by forces and right hand sides of equations, or of the adjoint problem."""
        b, x = self.matrix.createVecs()
        b.array[:] = np.concatenate([forces.ravel(), gaps])
        assert self.ksp is not None
        (self.ksp.solveTranspose if back else self.ksp.solve)(b, x)
        if self.ksp.getConvergedReason() < 0:
            raise LinearSolveError(
                "the linear problem of a goal's error has no solution: are bodies held, by contact or conditions?"
            )
        return np.array(x.array_r[: self.n]).reshape(self.shape), np.array(x.array_r[self.n :])


def _factorised(A: PETSc.Mat) -> PETSc.KSP:
    """A direct solver for a symmetric indefinite matrix that may have null pivots, of redundant equations (collective)."""
    has = [name for name in ("mumps", "superlu_dist") if PETSc.Sys.hasExternalPackage(name)]
    if not has:
        raise MissingBackendError("an estimate of a goal's error needs a direct solver: PETSc with MUMPS or SuperLU_DIST")
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType("preonly")
    ksp.setOperators(A)
    pc = ksp.getPC()
    pc.setType("lu")
    pc.setFactorSolverType(has[0])
    if has[0] == "mumps":
        pc.setFactorSetUpSolverType()
        factors = pc.getFactorMatrix()
        # null pivots are detected; more workspace than estimated, for the zero diagonal
        factors.setMumpsIcntl(24, 1)
        factors.setMumpsIcntl(14, 100)
    ksp.setUp()
    return ksp
