"""Deflation for multigrid with contactors much stiffer than their targets: a small part of the problem is solved exactly.

P adds the stiffness of a contactor to the nodes that it follows, as terms of low rank. If it exceeds the target's own stiffness, the
remaining modes of the target oscillate and have no coarse-grid representation; nor has the rigid motion of a stiff body. Both are deflated:
with W, whose columns are the unknowns of these nodes and their neighbours and the rigid motions of the stiff bodies, and B a multigrid
cycle,

    M^-1 = C + (1 - C A) B (1 - A C),    C = W (W'AW)^-1 W'

B excludes the target nodes completely, because the largest eigenvalues of the added terms would set the bounds of Chebyshev's smoother
for both bodies.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.options import has_mumps
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import gathered, reduced

#: Contactors that make the stiffness of a node they press on larger by this factor are much stiffer than their target.
#: [convention; diagonals of P'KP and K; test_deflation.py::test_much_stiffer_contactors_are_found]
MUCH_STIFFER = 10.0
#: Types of PC that need deflation for contactors much stiffer than their targets.
MULTIGRID = ("hypre", "gamg", "ml")
#: Up to so many bodies each have rigid-body modes of their own in the near-null space.
#: [convention; bodies; test_linear_solver.py::test_few_bodies_have_modes_of_their_own]
MODES_OF_THEIR_OWN = 4
#: A mode of which less than this part is new adds nothing to those before it.
#: [convention; part of its norm; test_linear_solver.py::test_modes_that_are_nearly_alike]
INDEPENDENT = 1e-6
#: Workspace of MUMPS beyond its estimate, which does not always do on several ranks; ``W'AW`` is small. [bound; per cent; -]
PLENTY = 200


class Deflation:
    """A deflated preconditioner, of PETSc's Python type, around an ``inner`` one."""

    def __init__(self, inner: PETSc.PC):
        self.inner, self.comm = inner, inner.comm
        self.W: Any = None

    def update(self, A: PETSc.Mat, W: PETSc.Mat) -> None:
        """Solve exactly for the columns of W from now on (collective)."""
        self.W, self.AW = W, A.matMult(W)
        self._solver = PETSc.KSP().create(self.comm)
        self._solver.setType("preonly")
        self._solver.setOperators(W.transposeMatMult(self.AW))
        pc = self._solver.getPC()
        if has_mumps():
            pc.setType("lu")
            pc.setFactorSolverType("mumps")
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setMumpsIcntl(14, PLENTY)
        else:
            pc.setType("redundant")

    def setUp(self, pc: PETSc.PC) -> None:  # noqa: N802
        """Set up the inner preconditioner (collective)."""
        self.inner.setUp()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """``y = M^-1 x`` (collective)."""
        force, moved, rest = self.W.createVecRight(), self.W.createVecRight(), x.duplicate()
        self.W.multTranspose(x, force)
        self._solver.solve(force, moved)
        self.AW.mult(moved, rest)
        rest.aypx(-1.0, x)
        self.inner.apply(rest, y)
        self.AW.multTranspose(y, force)
        back = moved.duplicate()
        self._solver.solve(force, back)
        moved.axpy(-1.0, back)
        self.W.multAdd(moved, y, y)


@timed_as("deflation")
def in_deflation(pc: PETSc.PC, space: Nodes, A: PETSc.Mat, P: Restriction, pressed: Bools) -> PETSc.PC:
    """Deflated preconditioner of A with multigrid ``pc``, which excludes nodes ``pressed (n_owned,)`` by stiff bodies (collective)."""
    pc.setOperators(without(space, A, P, pressed))
    deflation = Deflation(pc)
    deflation.update(A, deflated(space, A, P, pressed))
    return PETSc.PC().createPython(deflation, comm=space.comm)


@timed_as("deflation")
def pressed_hard(space: Nodes, A: PETSc.Mat, K: PETSc.Mat, P: Restriction) -> Bools:
    """Mask of owned nodes whose stiffness is mostly due to contactors that follow them ``(n_owned,)``."""
    followed = np.zeros(space.n_owned, dtype=bool)
    followed[P.followed_here] = True
    followed[P.nodes] = False
    both = space.vector(), space.vector()
    for M, diagonal in zip((A, K), both):
        M.getDiagonal(diagonal)
    stiffness, own = (diagonal.array_r.reshape(-1, space.block) for diagonal in both)
    return followed & (P.used & (stiffness > MUCH_STIFFER * own)).any(axis=1)


def without(space: Nodes, A: PETSc.Mat, P: Restriction, pressed: Bools) -> PETSc.Mat:
    """A copy of A with nodes ``pressed (n_owned,)`` by much stiffer contactors crossed out (collective)."""
    rest = A.copy()
    first = space.block * space.first
    rest.zeroRowsColumns((np.flatnonzero(P.used & pressed[:, None]) + first).astype(PETSc.IntType))
    rest.setBlockSize(space.block)
    rest.setNearNullSpace(A.getNearNullSpace())
    return rest


def deflated(space: Nodes, A: PETSc.Mat, P: Restriction, pressed: Bools) -> PETSc.Mat:
    """W for nodes ``pressed (n_owned,)`` by much stiffer contactors; the last rank has the columns of the modes (collective)."""
    g, n, comm = space.block, space.n_owned, space.comm
    first = g * space.first
    touched = PETSc.IS().createGeneral(np.flatnonzero(np.repeat(pressed, g)).astype(PETSc.IntType) + first, comm=PETSc.COMM_SELF)
    A.increaseOverlap(touched, 1)
    near = np.zeros((n, 1), dtype=bool)
    near[space.gather_owned(np.unique(touched.getIndices() // g).astype(np.int64))] = True
    alone = np.flatnonzero(P.used & near)
    counts = np.append(0, np.cumsum(gathered(comm, len(alone))))
    mode, row, value = _rigid_modes(space, P, pressed, ~near & P.used)
    n_modes = reduced(comm, int(mode.max(initial=-1)) + 1, op=MPI.MAX)
    rows, values = np.append(alone, row), np.append(np.ones(len(alone)), value)
    columns = np.append(counts[comm.rank] + np.arange(len(alone)), counts[-1] + mode)
    order = np.lexsort((columns, rows))
    indptr = np.append(0, np.cumsum(np.bincount(rows, minlength=g * n))).astype(PETSc.IntType)
    here = len(alone) + (n_modes if comm.rank == comm.size - 1 else 0)
    return PETSc.Mat().createAIJ(
        (A.getSizes()[0], (here, counts[-1] + n_modes)),
        csr=(indptr, columns[order].astype(PETSc.IntType), values[order]),
        comm=A.comm,
    )


def _rigid_modes(space: Nodes, P: Restriction, pressed: Bools, where: Bools) -> tuple[Ints, Ints, Array]:
    """Number, local component and value of the entries of the stiff bodies' rigid motions at components ``where (n_owned, block)``."""
    body, n_bodies = find_bodies(space)
    n, eq, comm = space.n_owned, P.equations, space.comm
    hard = (space.ask_owners(eq.followed, pressed[:, None].astype(float))[:, 0] > 0) & eq.active[eq.row]
    stiff = np.zeros(n_bodies, dtype=bool)
    stiff[body[eq.node[eq.row[hard]]]] = True
    comm.Allreduce(MPI.IN_PLACE, stiff, op=MPI.LOR)
    if not stiff.any():
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    mine = np.flatnonzero(stiff[body[:n]])
    number = (np.cumsum(stiff) - 1)[body[mine]]
    # in units of the model's size, rotations are as large as translations
    motions = space.modes(centred=True).transpose(1, 0, 2)
    modes = np.stack([P.reduce(space.vector(v)).array_r.reshape(n, -1) for v in motions], axis=2)
    modes = (modes * where[:, :, None])[mine]
    gram = np.zeros((stiff.sum(), modes.shape[2], modes.shape[2]))
    np.add.at(gram, number, np.einsum("ngk,ngl->nkl", modes, modes))
    comm.Allreduce(MPI.IN_PLACE, gram)
    size, mixed = np.linalg.eigh(gram)
    independent = size > INDEPENDENT**2 * size[:, -1:]
    column = (np.cumsum(independent) - 1).reshape(independent.shape)
    mixed = mixed / np.sqrt(np.where(independent, size, 1.0))[:, None, :]
    modes = np.einsum("ngk,nkl->ngl", modes, mixed[number])
    i, c, k = np.nonzero((modes != 0) & independent[number][:, None, :])
    return column[number[i], k], mine[i] * space.block + c, modes[i, c, k]


def near_null_space(space: Nodes, A: PETSc.Mat, restriction: Restriction) -> PETSc.NullSpace:
    """Rigid-body modes in the unknowns q: at a contactor their tangential components only.

    Bodies in contact may still slide along each other. If they are few, each gets its own modes, since aggregates across a contact
    would lock its sliding. In mixed problems the modes contain the displacement's unknowns only.
    """
    nodes: Nodes = getattr(space, "config", space)
    body, n_bodies = find_bodies(nodes)
    body, n = body[: nodes.n_owned], nodes.block * nodes.n_owned
    own = range(n_bodies - 1) if n_bodies <= MODES_OF_THEIR_OWN else ()
    joint = list(nodes.modes().transpose(1, 0, 2))
    vectors: list[PETSc.Vec] = []
    for mode in [*joint, *(m * (body == i)[:, None] for i in own for m in joint)]:
        full = A.createVecLeft()
        full.array[:n] = mode.ravel()
        q = restriction.reduce(full)
        if space.mixed:
            q = PETSc.Vec().createWithArray(np.array(q.array_r[:n]), comm=space.comm)
        before = q.norm()
        # orthogonalised twice, against rounding
        for other in [*vectors, *vectors]:
            q.axpy(-q.dot(other), other)
        if q.norm() > INDEPENDENT * before:
            q.normalize()
            vectors.append(q)
    return PETSc.NullSpace().create(vectors=vectors, comm=space.comm)
