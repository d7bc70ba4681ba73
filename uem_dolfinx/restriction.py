"""From uniting equations to the restriction matrix P and the united system ``P'KP``.

Fifth step on the data's way, pure algebra that knows nothing of contact. With the free unknowns q,

    du = P dq + c                        P: n x n with idle columns, m = n - (number of equations) of them in use
    P'KP dq = P'(r - K c)                [UEM, 6.6]

Every equation eliminates one component of a node in a frame rotated to its direction [UEM, 4.1]:

    du = T dq + M du + d    so    P = (1 + M + M^2 + ...) T,    c = (1 + M + M^2 + ...) d

T rotates each node's free components, M lets an eliminated component follow other nodes, d closes gaps and carries prescribed
increments. The powers of M end after as many terms as bodies are stacked upon each other.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from uem_dolfinx.errors import ConflictError, agree

if TYPE_CHECKING:
    from uem_dolfinx.surfaces import Configuration
    from uem_dolfinx.uniting import UnitingEquations

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: An equation whose direction has less than this part left in the free components of its node is a conflict.
MOSTLY_PRESCRIBED = 1e-6
#: Stacks of bodies higher than this are taken for a cycle.
LONGEST_CHAIN = 16


class Restriction:
    """P and c of one set of uniting equations.

    Args:
        config: the space whose displacement is restricted.
        equations: uniting equations of the nodes this rank owns.
        free: components without Dirichlet condition, of the owned nodes ``(n_owned, gdim)``.
        prescribed: increments that the Dirichlet conditions ask for ``(n_owned, gdim)``, zero where free.

    Raises:
        ConflictError: if the equations leave a node no free component to eliminate, or follow each other in a circle.
    """

    def __init__(self, config: Configuration, equations: UnitingEquations, free: Bools, prescribed: Array):
        self.config, self.equations, self.free = config, equations, free
        self.comm = config.comm
        g, n = config.gdim, config.n_owned
        self.first_row = g * int(config.index_map.local_range[0])
        self.blocks, self.lift = self._eliminate()
        self.idle: Bools = ~(self.blocks != 0).any(axis=1)
        closure = np.array(prescribed)
        known = np.einsum("mg,mg->m", equations.direction, prescribed[equations.node])
        np.add.at(closure, equations.node, -self.lift * (equations.gap + known)[:, None])
        self.n_equations = int(self.comm.allreduce(len(equations)))
        N = g * n
        self._sizes = ((N, g * config.index_map.size_global), (N, g * config.index_map.size_global))
        self.d = PETSc.Vec().createWithArray(closure.ravel(), size=self._sizes[0], bsize=g, comm=self.comm)
        self.T = self._rotation()
        self.M = self._coupling() if self.n_equations else None
        self._refuse_cycle()

    # -- elimination in each node's frame --------------------------------------------------------------------------

    def _eliminate(self) -> tuple[Array, Array]:
        """Blocks of T per owned node ``(n_owned, g, g)``, and how each equation acts on its node ``(m, g)``."""
        g, eq = self.config.gdim, self.equations
        blocks = self.free[:, None, :] * np.eye(g)
        lift = np.zeros_like(eq.direction)
        order = np.argsort(eq.node, kind="stable")
        nodes, first, counts = np.unique(eq.node[order], return_index=True, return_counts=True)
        error = None
        for k in np.unique(counts):
            at = nodes[counts == k]
            rows = order[first[counts == k][:, None] + np.arange(k)]
            A = eq.direction[rows] * self.free[at, None, :]
            if k > g or (np.linalg.svd(A, compute_uv=False)[:, -1] < MOSTLY_PRESCRIBED).any():
                error = error or self._conflict(at, A)
                continue
            pinv = np.linalg.pinv(A)
            lift[rows] = pinv.transpose(0, 2, 1)
            blocks[at] = _frames(A, pinv, self.free[at])
        agree(self.comm, error)
        return blocks, lift

    def _conflict(self, nodes: npt.NDArray[np.int32], A: Array) -> ConflictError:
        bad = 0 if A.shape[1] > A.shape[2] else int(np.argmin(np.linalg.svd(A, compute_uv=False)[:, -1]))
        fixed = [c for c, f in zip("xyz", self.free[nodes[bad]]) if not f]
        return ConflictError(
            f"the contactor at {self.config.describe(int(nodes[bad]))} has {A.shape[1]} uniting equation(s) but its displacement in "
            f"{', '.join(fixed) or 'no direction'} is prescribed, so nothing is left to eliminate: release the Dirichlet condition "
            "there, or make the other surface the contactor"
        )

    # -- matrices ----------------------------------------------------------------------------------------------------

    def _rotation(self) -> PETSc.Mat:
        """T: block diagonal; zeros are stored, so that ``P'KP`` holds the diagonal of idle columns."""
        g, n = self.config.gdim, self.config.n_owned
        full = np.zeros(n, dtype=bool)
        full[self.equations.node] = True
        # plain nodes need their diagonal only
        counts = np.where(np.repeat(full, g), g, 1)
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(PETSc.IntType)
        row_node = np.repeat(np.arange(n * g) // g, counts)
        within = np.arange(indptr[-1]) - np.repeat(indptr[:-1], counts)
        component = np.repeat(np.arange(n * g) % g, counts)
        column = np.where(full[row_node], within, component)
        values = self.blocks[row_node, component, column]
        T = PETSc.Mat().createAIJ(
            self._sizes, bsize=g, csr=(indptr, (self.first_row + row_node * g + column).astype(PETSc.IntType), values), comm=self.comm
        )
        return T

    def _coupling(self) -> PETSc.Mat:
        """M: rows of the eliminated nodes, columns of the nodes they follow."""
        g, n, eq = self.config.gdim, self.config.n_owned, self.equations
        order = np.argsort(eq.node, kind="stable")
        i, a = np.nonzero(eq.targets[order] >= 0)
        i = order[i]
        values = self.lift[i][:, :, None] * (eq.weights[i, a][:, None] * eq.direction[i])[:, None, :]
        rows = (eq.node[i][:, None, None] * g + np.arange(g)[None, :, None] + np.zeros((1, 1, g), int)).ravel()
        columns = (eq.targets[i, a][:, None, None] * g + np.arange(g)[None, None, :] + np.zeros((1, g, 1), int)).ravel()
        rows, columns, values = _sum_duplicates(rows, columns, values.ravel())
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n * g))]).astype(PETSc.IntType)
        return PETSc.Mat().createAIJ(
            self._sizes, bsize=g, csr=(indptr, columns.astype(PETSc.IntType), values), comm=self.comm
        )

    def _refuse_cycle(self) -> None:
        """Follow the equations from node to node until they end; note how long the longest chain is."""
        self.chain = 0
        if self.M is None:
            return
        at = self.M.createVecRight()
        at.set(1.0)
        M = self.M.copy()
        indptr, columns, values = M.getValuesCSR()
        M.setValuesCSR(indptr, columns, np.ones_like(values))
        M.assemble()
        while self.chain <= LONGEST_CHAIN:
            at = M * at
            if at.norm(PETSc.NormType.INFINITY) == 0.0:
                M.destroy()
                return
            # only whether a path exists matters
            at.array[:] = at.array_r > 0
            self.chain += 1
        rows = np.flatnonzero(at.array_r)
        error = None
        if len(rows):
            error = ConflictError(
                f"the contactor at {self.config.describe(int(rows[0]) // self.config.gdim)} follows itself through its targets: "
                "two surfaces are contactor and target of each other; drop one of the two contacts"
            )
        agree(self.comm, error)

    @property
    def P(self) -> PETSc.Mat:
        """The restriction matrix P (computed once)."""
        if not hasattr(self, "_P"):
            self._P = self.T.copy()
            X = self.T
            for _ in range(self.chain):
                assert self.M is not None
                X = self.M.matMult(X)
                self._P.axpy(1.0, X, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return self._P

    # -- the maps of the united system ---------------------------------------------------------------------------------

    @property
    def c(self) -> PETSc.Vec:
        """Increment that closes the gaps and carries the prescribed displacements."""
        c, part = self.d.copy(), self.d
        for _ in range(self.chain):
            part = self.M * part
            c.axpy(1.0, part)
        return c

    def pass_on(self, F: PETSc.Vec) -> PETSc.Vec:
        """Hand the contactors' forces on to their targets [UEM, 4.3]: ``(1 + M + M^2 + ...)' F``."""
        y, part = F.copy(), F
        for _ in range(self.chain):
            moved = self.M.createVecRight()
            self.M.multTranspose(part, moved)
            part = moved
            y.axpy(1.0, part)
        return y

    def reduce(self, y: PETSc.Vec) -> PETSc.Vec:
        """``T' y``; with y from ``pass_on`` this is ``P'F``."""
        q = self.T.createVecRight()
        self.T.multTranspose(y, q)
        return q

    def expand(self, dq: PETSc.Vec) -> PETSc.Vec:
        """``P dq``, without c."""
        du = self.T * dq
        part = du
        for _ in range(self.chain):
            part = self.M * part
            du.axpy(1.0, part)
        return du

    def multipliers(self, y: PETSc.Vec) -> Array:
        """Contact force of each equation along its direction ``(m,)``, positive where the contactor is pushed."""
        nodal = y.array_r.reshape(-1, self.config.gdim)
        return np.einsum("mg,mg->m", self.lift, nodal[self.equations.node])

    def fingerprint(self, *, values: bool) -> int:
        """Hash of this rank's part of P: of its sparsity, or of its values too."""
        eq = self.equations
        parts = [eq.node.tobytes(), eq.targets.tobytes()]
        if values:
            parts += [eq.direction.tobytes(), eq.weights.tobytes()]
        return zlib.crc32(b"".join(parts))


def _frames(A: Array, pinv: Array, free: Bools) -> Array:
    """Blocks of T: an orthonormal frame of what the equations leave free; eliminated and prescribed columns are zero.

    A single direction is reflected onto the nearest axis (Householder), so that the frame stays close to the axes and the
    two tangential unknowns keep the places of the components they resemble.

    Args:
        A: directions in the free components ``(k, r, g)``.
        pinv: their pseudo-inverses ``(k, g, r)``.
        free: free components ``(k, g)``.
    """
    k, r, g = A.shape
    eye = np.eye(g)
    n_free = free.sum(axis=1)
    left = n_free - r
    blocks = np.zeros((k, g, g))
    axis = np.zeros((k, g))
    if r == 1:
        single = left > 0
        axis[single] = A[single, 0] / np.linalg.norm(A[single, 0], axis=1, keepdims=True)
    else:
        # the one direction left, from the projector onto the null space
        single = left == 1
        null = free[single, None, :] * eye - pinv[single] @ A[single]
        column = np.argmax(np.einsum("kgg->kg", null), axis=1)
        t = null[np.arange(len(column)), :, column]
        axis[single] = t / np.linalg.norm(t, axis=1, keepdims=True)
    H, main = _reflection(axis[single])
    keep = free[single].copy()
    if r == 1:
        keep[np.arange(len(main)), main] = False
    else:
        keep = np.arange(g)[None, :] == main[:, None]
    blocks[single] = H * keep[:, None, :]
    return blocks


def _reflection(axis: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Householder matrices that map the nearest coordinate axis onto ``axis (k, g)`` up to sign, and which it is."""
    main = np.argmax(np.abs(axis), axis=1)
    rows = np.arange(len(axis))
    v = axis.copy()
    v[rows, main] += np.where(axis[rows, main] >= 0, 1.0, -1.0)
    vv = np.einsum("kg,kg->k", v, v)[:, None, None]
    return np.eye(axis.shape[1]) - 2.0 * v[:, :, None] * v[:, None, :] / vv, main


def _sum_duplicates(rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], values: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """Coordinate triplets sorted by row and column, equal places added."""
    order = np.lexsort((columns, rows))
    rows, columns, values = rows[order], columns[order], values[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
    return rows[new], columns[new], np.add.reduceat(values, np.flatnonzero(new)) if len(rows) else values
