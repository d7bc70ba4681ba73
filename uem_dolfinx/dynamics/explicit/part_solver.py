"""Solves with united systems of explicit steps in which only the unknowns of some nodes are coupled: these are factorised.

Equilibrium of the surface with the contacts as they are, by a matrix of the surface alone that is factorised once.

The Newton loop of the united system then has nothing left to do but to check forces and gaps, unless the contact changes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.blocks import Blocks, blocks_of_matrix, product, rows_at, summed, to_owners, together
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.products import made_of
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import LinearSolveError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import compiling, timed
from uem_dolfinx.parallel import gathered, reduced


class PartSolver(UnitedSolver):
    """Solver of ``Q'(K + G)P`` by a factorisation of a few unknowns; methods are those of ``UnitedSolver``."""

    cheap = True
    tells_sign = False

    def __init__(self, space: Nodes, prefix: str):
        super().__init__(space, prefix, {"ksp_type": "preonly", "pc_type": "lu"})
        self.lasting = True
        self._pc: PETSc.PC | None = None
        self._at: Ints = np.zeros(0, np.int64)
        #: Columns of P in use, and fingerprint of the matrix without coefficients of P.
        self._used: Bools = np.zeros(0, bool)
        self._alike: tuple[Any, ...] | None = None

    def set_operator(
        self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, test: Restriction | None = None, roughly: bool = False
    ) -> None:
        """Set ``Q'(K + G)P``, and factorise its coupled part; without slip and ``roughly``, not where P's coefficients alone change.

        Collective.
        """
        P, Q = restriction, test or restriction
        made = made_of(P, Q, K, G, False)
        if made is not None and made == self._made_of:
            return
        alike = made_of(P, Q, K, G, True)
        if roughly and made is not None and alike == self._alike:
            return
        self._made_of, self._alike, self._used = made, alike, P.used.ravel()
        with timed("united matrix of explicit steps"):
            self._unite(P, Q, K, G)

    def renew(self) -> None:
        """Let no factorisation of an earlier step serve, which a run continued from a checkpoint does not have."""
        self._alike = None

    def take(self, solved: Any, P: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, Q: Restriction) -> None:
        """As ``set_operator``: a factorisation costs no more than it saves (collective)."""
        self.set_operator(P, K, G, Q)

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the coupled nodes (collective)."""
        raise NotImplementedError

    def _factorise(self, nodes: Ints, A: Blocks, idle: Array, symmetric: bool) -> None:
        """Factorise a matrix of owned ``nodes (k,)``, with entries ``idle (k block,)`` on the diagonal of idle unknowns (collective)."""
        space, g = self.space, self.space.block
        self._at, self._pc = (g * nodes[:, None] + np.arange(g)).ravel(), None
        counts = gathered(space.comm, len(nodes))
        size, first = int(counts.sum()), int(counts[: space.comm.rank].sum())
        if not size:
            return
        numbers = np.zeros((space.n_owned, 1), dtype=np.int64)
        numbers[nodes, 0] = first + np.arange(len(nodes))
        A = to_owners(space, A)
        found, place = np.unique(A.column, return_inverse=True)
        columns = space.ask_owners(found, numbers)[place, 0]
        diagonal = np.where(self._used[self._at], 0.0, idle).reshape(-1, g, 1) * np.eye(g)
        own, here = Blocks(numbers[A.row - space.first, 0] - first, columns, A.value), np.arange(len(nodes))
        lines = _lines(together(own, Blocks(here, first + here, diagonal)), len(nodes))
        matrix = PETSc.Mat().createAIJ(((g * len(nodes), None), (g * len(nodes), None)), csr=lines, comm=space.comm)
        self._rhs, self._dq = matrix.createVecs()
        self._pc = factorised(matrix, symmetric)

    def _uncoupled(self, rhs: PETSc.Vec) -> Array | None:
        """Solution at all unknowns that are not coupled ``(n,)``, zero where idle; None if all are zero."""
        return None

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq, and 1 for the number of linear iterations; LinearSolveError if the matrix is singular (collective)."""
        with timed("linear solve"):
            dq, found = self.space.vector(self._uncoupled(rhs)), np.zeros(0)
            if self._pc is not None:
                used = self._used[self._at]
                self._rhs.array[:] = np.where(used, rhs.array_r[self._at], 0.0)
                self._pc.apply(self._rhs, self._dq)
                dq.array[self._at] = found = np.where(used, self._dq.array_r, 0.0)
        if reduced(self.space.comm, bool(np.isfinite(found).all()), op=MPI.LAND):
            return dq, 1
        raise LinearSolveError(
            "the united system of an explicit step is singular: equations conflict, a surface without mass is loose, or friction leaves "
            "no solution"
        )

    def forces(self, K: PETSc.Mat, du: PETSc.Vec) -> PETSc.Vec:
        """``K du`` (collective)."""
        return forms.product(K, du)


def factorised(A: PETSc.Mat, symmetric: bool) -> PETSc.PC:
    """A matrix, factorised (collective)."""
    A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
    pc = PETSc.PC().create(A.comm)
    pc.setType("cholesky" if symmetric else "lu")
    if A.comm.size > 1:
        pc.setFactorSolverType("mumps")
    pc.setOperators(A)
    with timed("factorisation or preconditioner set-up"):
        pc.setUp()
    return pc


def _lines(A: Blocks, n: int) -> tuple[Array, Array, Array]:
    """Compressed lines of n rows of blocks, from the local row and the column of each block; repeated ones add."""
    A, g = summed(A), A.value.shape[1]
    counts, k = np.bincount(A.row, minlength=n), np.arange(g)
    first = (np.cumsum(counts) - counts)[A.row]
    # the entries of a block lie in g lines
    place = g * (g * first + np.arange(len(first)) - first)[:, None, None] + (g * counts[A.row])[:, None, None] * k[:, None] + k
    columns, values = np.empty(place.size, PETSc.IntType), np.empty(place.size)
    columns[place], values[place] = g * A.column[:, None, None] + k, A.value
    return np.append(0, np.repeat(g * counts, g).cumsum()).astype(PETSc.IntType), columns, values


class MassSolver(PartSolver):
    """Solver of ``Q'(M + G)P`` for diagonal masses M: a small factorisation, and a division at all other unknowns.

    G are terms of friction at active contactors.
    """

    _state = -1  # state of the values of M

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the coupled nodes (collective)."""
        if self._state != K.stateGet():
            self._state, self._mass = K.stateGet(), np.array(K.getDiagonal().array_r)
        space, g = self.space, self.space.block
        more = None if G is None else blocks_of_matrix(space, G)
        coupled = np.zeros(space.n_owned, dtype=bool)
        for R in (P, Q):
            coupled[R.united] = coupled[R.followed_here] = True
        if more is not None:
            coupled[more.row - space.first] = True
        nodes = np.flatnonzero(coupled)
        trial = P.rows_of(nodes)
        test = trial if P is Q else Q.rows_of(nodes)
        forces = Blocks(trial.row, trial.column, self._mass.reshape(-1, g)[trial.row - space.first][:, :, None] * trial.value)
        if more is not None:
            forces = together(forces, product(more, rows_at(space, trial, np.unique(more.column))))
        idle = self._mass.reshape(-1, g)[nodes].ravel()
        self._factorise(nodes, product(test.transposed, forces), idle, P is Q and G is None)

    def _uncoupled(self, rhs: PETSc.Vec) -> Array:
        """Forces over masses."""
        return np.where(self._used, rhs.array_r / self._mass, 0.0)


class SurfaceSolver(PartSolver):
    """Solver of ``Q'(K + G)P`` at the nodes with free components alone: the rows of K at other nodes are not read."""

    def __init__(self, space: Nodes, prefix: str):
        super().__init__(space, prefix)
        #: Free components, K and the state of its values that the rows of K have been read for.
        self._read_for: tuple[bytes, PETSc.Mat, int] | None = None

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the free nodes (collective)."""
        space, g = self.space, self.space.block
        nodes = np.flatnonzero(P.free.any(axis=1))
        key = P.free.tobytes(), K, K.stateGet()
        if space.comm.allreduce(int(self._read_for != key)):
            self._read_for, own = key, (g * nodes[:, None] + np.arange(g)).ravel()
            columns = numbers(space, np.arange(g * space.n_owned))
            rows = blocks_of_matrix(space, K.createSubMatrix(numbers(space, own), columns))
            self._rows = Blocks(nodes[rows.row - space.first] + space.first, rows.column, rows.value)
            self._diagonal = np.array(K.getDiagonal().array_r[own])
        stiffness = self._rows if G is None else together(self._rows, blocks_of_matrix(space, G))
        trial = P.rows_of(nodes)
        test = trial if P is Q else Q.rows_of(nodes)
        forces = product(stiffness, rows_at(space, trial, np.unique(stiffness.column)))
        # a tangent may be unsymmetric
        self._factorise(nodes, product(test.transposed, forces), self._diagonal, False)


def numbers(space: Nodes, own: Ints) -> PETSc.IS:
    """Global numbers of owned unknowns ``(n,)``."""
    return PETSc.IS().createGeneral((own + space.block * space.first).astype(PETSc.IntType), comm=space.comm)


#: Solves with the kept matrix in one step, before Newton's method continues with a new one.
#: [convention; solves; test_explicit.py::test_how_long_a_factor_of_the_surface_serves]
MOST_SURFACE_SOLVES = 4
#: The kept matrix serves as long as Newton's method needs no more iterations after it.
#: [convention; iterations; test_explicit.py::test_how_long_a_factor_of_the_surface_serves]
ITERATIONS_OF_KEPT = 1


class Prediction:
    """Moves the surface of a problem with the equations of its last state (collective).

    Args:
        problem: a ``UnitedProblem``, whose nodes with mass are held while it is used.
        system: its united system, of which the surface is solved.
        massive: mask of the unknowns that are held, ghosts included ``(n,)``.

    Attributes:
        kept: whether the factorisation is of the present contact, and good enough.
    """

    def __init__(self, problem: Any, system: Any, massive: Bools):
        self.problem, self.system, self.kept = problem, system, False
        self._massive, self._solver = massive, SurfaceSolver(problem.bodies.unknowns, "uem_prediction_")
        self._state = -1  # state of the values of K whose columns at the surface are known
        #: Writes the residual of the cells behind the surface; None if it is as well to write that of all.
        self._write: Callable[[PETSc.Vec], None] | None = None

    def learn(self, history: Any) -> None:
        """Take note of how much the Newton loop has had to do in a step."""
        self.kept = self.kept and len(history) <= ITERATIONS_OF_KEPT + 1 and not any(one.changed for one in history)

    def predict(self, start: Any) -> None:
        """Move nodes with mass to ``start (n,)``, ghosts included, and the surface from there into equilibrium with the last contact.

        ``start`` gets the values of conditions.
        """
        problem, bodies, system = self.problem, self.problem.bodies, self.system
        if system.rows is None:
            # the first step of a continued run
            bodies.update_tangent()
        system.rows_of_last()
        if not self.kept:
            self._prepare()
        compat.set_bc_values(start, bodies.bcs)
        bodies.u.x.array[:] = start
        bodies.u.x.scatter_forward()
        fine, before = self._assemble(), np.inf
        enough = problem.rtol * bodies.residual.norm()
        for _ in range(MOST_SURFACE_SOLVES):
            F = self._Q.transpose(system.residual())
            norm = F.norm()
            if not fine or norm >= before or norm <= enough:
                break
            dq, _ = self._solver.solve(-F)
            du, before = self._P.expand(dq), norm
            if bodies.linear:
                self._du.array[:] = du.array_r[self._light]
                change = du.duplicate()
                self._K.mult(self._du, change)
                bodies.move(du, change)
            else:
                bodies.move(du)
                fine = self._assemble()
        if not fine:
            # Newton's method has a line search
            bodies.u.x.array[:] = problem.committed

    def _assemble(self) -> bool:
        """Assemble the forces at the surface at least; whether they are finite on all ranks (collective)."""
        bodies = self.problem.bodies
        return bool(bodies.assemble_once() if self._write is None else bodies.assemble(self._write))

    def _prepare(self) -> None:
        """Factorise ``Q'KP`` of the surface's unknowns, and find what their motion changes (collective)."""
        system, bodies = self.system, self.problem.bodies
        self._P, self._Q = system.rows.frictionless, system.rows.test
        self._solver.set_operator(self._P, K := bodies.update_tangent(), None, self._Q)
        space, self.kept = bodies.unknowns, True
        if bodies.linear and self._state != K.stateGet():
            self._state, self._light = K.stateGet(), np.flatnonzero(bodies.free_rows)
            self._K = K.createSubMatrix(numbers(space, np.arange(bodies.free_rows.size)), numbers(space, self._light))
            self._du = self._K.createVecRight()
        elif not bodies.linear and self._write is None and not bodies.materials:
            config = bodies.config
            cells = np.flatnonzero(~config.of(self._massive).all(axis=1)[compat.cell_dofs(config.V)].all(axis=1))
            if (F := _in_cells(bodies.F, cells)) is not None:
                with compiling("the residual behind the surface"):
                    self._write = partial(forms.assemble_vector, L=forms.form(F))


def _in_cells(F: ufl.Form, cells: npt.ArrayLike) -> ufl.Form | None:
    """A form whose integrals over cells are restricted to some cells ``(n,)``; None if they have other marks than MeshTags."""
    integrals, mesh = [], F.arguments()[0].ufl_function_space().mesh
    for integral in F.integrals():
        of = integral.subdomain_data()
        if integral.integral_type() == "cell":
            own, ids = cells, np.ravel(integral.subdomain_id())
            if "everywhere" not in ids:
                if not hasattr(of, "indices"):
                    return None
                own = np.intersect1d(cells, of.indices[np.isin(of.values, ids.astype(np.int32))])
            tags = forms.mesh_tags(mesh, mesh.topology.dim, own, 1)
            integral = integral.reconstruct(subdomain_data=tags, subdomain_id=1)
        integrals.append(integral)
    return ufl.Form(integrals)
