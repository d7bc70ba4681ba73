"""Lagrange multipliers: the saddle point of the same uniting equations, with the same active sets and Newton loop.

    [K  G'] [du]   [-F]
    [G  0 ] [mu] = [-g]        lam = -mu

An increment solves both rows exactly, as the united system does; what differs is the linear algebra: more unknowns instead of
fewer, and a matrix that is indefinite.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc
from scipy.sparse import coo_matrix

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.errors import InputError, LinearSolveError
from uem_dolfinx.log import timed
from uem_dolfinx.solve.bodies.far_apart import FarApart
from uem_dolfinx.solve.rigid.floating import FloatingBodies
from uem_dolfinx.solve.united.newton import Increment, LinearisedProblem
from uem_dolfinx.solve.united.system import BodySystem

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.solve.bodies.bodies import Bodies
    from uem_dolfinx.contact.pair.interface import Interface
    from uem_dolfinx.solve.united.newton import IterationState

DIRECT = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
#: For large bodies that are held: Murphy, Golub and Wathen's block diagonal, with the Schur complement from the diagonal of K.
ITERATIVE = {
    "ksp_type": "minres",
    "ksp_max_it": 2000,
    "pc_type": "fieldsplit",
    "pc_fieldsplit_type": "schur",
    "pc_fieldsplit_schur_fact_type": "diag",
    "pc_fieldsplit_schur_precondition": "selfp",
    "fieldsplit_u_ksp_type": "preonly",
    "fieldsplit_lam_ksp_type": "preonly",
    "fieldsplit_lam_pc_type": "jacobi",
}


class LagrangeSystem(BodySystem):
    """Contact by multipliers; arguments as those of ``BodySystem``."""

    def __init__(self, bodies: Bodies, pairs: list[Interface], solver: UnitedSolver, **options: Any):
        super().__init__(bodies, pairs, solver, **options)
        if any(pair.target.averaged and pair.discretisation.traits.sliding == "finite" for pair in pairs):
            raise InputError("averaged normals do not go with multipliers, whose saddle point is symmetric: take facets' normals")
        # nothing holds what floats
        self.floating = FloatingBodies(bodies, [], None, FarApart(bodies.config, []))
        #: The saddle-point matrix of the last solve.
        self.saddle: PETSc.Mat | None = None
        self._made_of: object = None
        direct = self.solver.options.get("pc_type") in ("lu", "cholesky")
        self._options = dict(DIRECT)
        if not direct:
            amg = {key: value for key, value in self.solver.options.items() if key.startswith(("pc_", "mg_"))}
            self._options = ITERATIVE | {"ksp_rtol": self.solver.options.get("ksp_rtol", 1e-10)}
            self._options |= {f"fieldsplit_u_{key}": value for key, value in amg.items()}
        self._prefix = f"saddle_{id(self)}_"

    def linearise(self, state: IterationState, iteration: int | None) -> LinearisedProblem:
        """Saddle-point matrix, and what drives the step, as the united system would feel it."""
        if iteration is not None:
            self._differentiate(first=iteration == 0)
        curvature = self.curvature
        equations = UnitingEquations.join([pair.equations().P for pair in self.pairs], self.config.gdim)
        equations = equations.select(equations.active)
        self._c = self.config.vector(self.bodies.prescribed)
        if curvature is None and not any(pair.discretisation.traits.sliding == "finite" for pair in self.pairs):
            made_of = (
                self.bodies.tangent.number,
                equations.node.tobytes(),
                equations.direction.tobytes(),
                equations.coefficients.tobytes(),
            )
            made_of = self.comm.allgather(hash(made_of))
        else:
            made_of = None
        with timed("saddle point"):
            if made_of is None or made_of != self._made_of:
                self._build(equations, curvature)
        self._made_of = made_of
        free = self.bodies.free[: self.config.n_owned]
        load = self._A * self._c
        load.axpy(1.0, self.bodies.residual)
        self._short = self._G_all * self._c
        self._short.array[:] += equations.gap
        self._short.array[:] *= -self._scale
        self._load = self.config.vector(-np.where(free, load.array_r.reshape(free.shape), 0.0))
        load = self._A * state.trial.c
        load.axpy(1.0, self.bodies.residual)
        driving = state.test.transpose(load)
        driving.scale(-1.0)
        return LinearisedProblem(
            state, driving, exact=True, iterative=False, passing=False, fits=self.bodies.linear, convex=False
        )

    def _build(self, equations: UnitingEquations, curvature: PETSc.Mat | None) -> None:
        """Matrix, and the solver for it (collective)."""
        n = self.config.n_owned
        free = self.bodies.free[:n]
        self._A = self.bodies.tangent.K if curvature is None else self.bodies.tangent.K.copy()
        if curvature is not None:
            self._A.axpy(1.0, curvature, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        used, own = self.config.vector(free.astype(float)), self.config.vector(self.bodies.stiffness)
        mean = own.sum() / own.getSize()
        self._scale = float(mean)
        self._G_all = self._constraints(equations)
        G = self._G_all.copy()
        G.diagonalScale(None, used)
        G.scale(self._scale)
        K = self._A.copy()
        K.diagonalScale(used, used)
        diagonal = K.getDiagonal()
        diagonal.array[~free.ravel()] = own.array_r[~free.ravel()]
        K.setDiagonal(diagonal)
        nest = PETSc.Mat().createNest([[K, G.transpose(PETSc.Mat())], [G, None]], comm=self.comm)
        self._split = nest.getNestISs()[0]
        if self.saddle is not None:
            self.saddle.destroy()
        self.saddle = PETSc.Mat()
        nest.convert("aij", self.saddle)
        self.saddle.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._ksp = PETSc.KSP().create(self.comm)
        self._ksp.setOptionsPrefix(self._prefix)
        if self._options["pc_type"] == "fieldsplit":
            self._ksp.getPC().setType("fieldsplit")
            self._ksp.getPC().setFieldSplitIS(("u", self._split[0]), ("lam", self._split[1]))
        self._with_options(self._ksp.setFromOptions)
        self._ksp.setOperators(self.saddle)

    def _constraints(self, equations: UnitingEquations) -> PETSc.Mat:
        """G: a row per equation, a column per displacement (collective)."""
        g, m = self.config.gdim, len(equations)
        sizes = self.config.vector().getSizes()
        own = self.config.to_global(equations.node.astype(np.int32))
        rows = np.concatenate([np.repeat(np.arange(m), g), np.repeat(equations.row, g)])
        nodes = np.concatenate([own, equations.followed])
        columns = (nodes[:, None] * g + np.arange(g)).ravel()
        values = np.concatenate([equations.direction.ravel(), -equations.coefficients.ravel()])
        # a quadratic surface may name a node twice in one equation
        G = coo_matrix((values, (rows, columns)), shape=(m, sizes[1])).tocsr()
        csr = (G.indptr.astype(PETSc.IntType), G.indices.astype(PETSc.IntType), G.data)
        return PETSc.Mat().createAIJ(((m, PETSc.DETERMINE), sizes), csr=csr, comm=self.comm)

    def _with_options(self, do: Any, *args: Any) -> None:
        database = PETSc.Options()
        for key, value in self._options.items():
            database[self._prefix + key] = value
        try:
            do(*args)
        finally:
            for key in self._options:
                del database[self._prefix + key]

    def solve(self, problem: LinearisedProblem, accuracy: float, near: PETSc.Vec | None) -> Increment:
        """Unknowns q, by which the loop judges its steps, and the increment with the prescribed displacements."""
        b, x = self.saddle.createVecs()
        n = problem.rhs.getLocalSize()
        b.array[:n] = self._load.array_r
        b.array[n:] = self._short.array_r
        with timed("linear solve"):
            try:
                self._with_options(self._ksp.solve, b, x)
            except PETSc.Error as error:
                raise LinearSolveError(
                    f"PETSc error {error.ierr} in the saddle point: the equations may depend on each other"
                ) from error
        reason = self._ksp.getConvergedReason()
        b.axpy(-1.0, self.saddle * x)
        if reason < 0 or not np.isfinite(x.norm()) or b.norm() > 1e-3 * max(self._load.norm(), self._short.norm()):
            raise LinearSolveError(f"the saddle point is singular, or its solve failed with KSP reason {reason}")
        found = self.config.vector(x.array_r[:n])
        free = self.bodies.free[: self.config.n_owned].ravel()
        du = self.config.vector(np.where(free, found.array_r, self._c.array_r))
        return Increment(problem.state.test.reduce(found), du, problem.rhs, int(self._ksp.getIterationNumber()), 0.0)

    def complete(self, problem: LinearisedProblem, step: Increment) -> Increment:
        """Every solve is of all unknowns."""
        return step
