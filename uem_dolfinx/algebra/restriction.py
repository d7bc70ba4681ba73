"""The restriction matrix P of constraint equations of any origin, and the constrained system ``P'KP`` [UEM, 6].

With the free unknowns q,

    du = P dq + c                        P: n x n with idle columns, m = n - (number of equations) of them in use
    P'KP dq = P'(r - K c)                [UEM, 6.6]

Every equation eliminates one component of a node, in a frame rotated to its direction [UEM, 4.1]:

    du = T dq + M du + d    so    P = (1 + M + M^2 + ...) T,    c = (1 + M + M^2 + ...) d

T rotates each node's free components, M makes eliminated components follow other nodes, and d contains gaps and prescribed increments.
The number of powers of M is the number of bodies stacked upon each other. If equations follow each other in rings with small
coefficients, the powers decay and the series is cut at rounding; other rings are closed first.
"""

from __future__ import annotations

import zlib
from copy import copy
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from uem_dolfinx.algebra.blocks import Blocks, product, rows_at, summed, together
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, NEGLIGIBLE, UnitingEquations, least_left
from uem_dolfinx.algebra.rings import FADED, Rings
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_rows
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.nodes import Halo, Nodes
from uem_dolfinx.parallel import agree, gathered, reduced

#: Rings of equations are closed unless what has gone through so many of them is rounding.
#: [convention; number of equations; test_restriction.py::test_rings_that_fade]
MOST_ROUND = 32


class Restriction:
    """P and c of one set of constraint equations.

    Args:
        space: the nodes whose components are restricted.
        equations: constraint equations of the nodes that this rank owns.
        free: components without Dirichlet condition, of the owned nodes ``(n_owned, block)``.
        prescribed: increments prescribed by the Dirichlet conditions ``(n_owned, block)``, zero where free.
        stacked: whether a node that is followed may itself be eliminated.
        like: restriction of the same equations in other directions, with the same eliminated components and the same unknowns.

    Raises:
        ConflictError: if the equations leave a node no free component to eliminate.
        DependentRingError: if they follow each other in a ring and depend on each other.
    """

    def __init__(
        self,
        space: Nodes,
        equations: UnitingEquations,
        free: Bools,
        prescribed: Array,
        stacked: bool = True,
        like: Restriction | None = None,
    ):
        self.space, self.equations, self.free, self.stacked = space, equations, free, stacked
        self.comm, self._like = space.comm, like
        g, n = space.block, space.n_owned
        self._sizes = ((g * n, g * space.n_global),) * 2
        self._first = g * space.first
        #: Eliminated nodes, and all nodes of equations, including inactive ones in the sparsity of P.
        self.united: Indices = np.unique(equations.node[equations.active])
        self.nodes: Indices = np.unique(equations.node)
        self.frames, self.lift, error = self._eliminate() if like is None else self._eliminate_like(like)
        terms = equations.active[equations.row].sum()
        sums = np.array([equations.active.sum(), len(equations), terms, error is not None], dtype=np.int64)
        self.n_equations, self._n_rows, self._n_terms, wrong = reduced(self.comm, sums).tolist()
        if wrong:
            agree(self.comm, error)
        self.used: Bools = free.copy()  # columns of P that are in use ``(n_owned, block)``
        self.used[self.nodes] = (self.frames != 0).any(axis=1)
        self.rings: Rings | None = None
        self._hold(equations, prescribed)
        #: The number of powers of M in the series of P and c, and whether equations follow each other in rings that decay.
        self.chain, self.fades = 1 if self._n_terms else 0, False
        if self._n_terms and stacked:
            self.chain, parts = self._longest_chain()
            if parts is not None:
                self.chain = _fading(parts)
                self.fades = self.chain > 0
                if not self.fades:
                    self.rings = Rings(space, equations, self.lift, parts)
                    self._hold(self.rings.equations, prescribed)
                    self.chain, _ = self._longest_chain()

    def _hold(self, equations: UnitingEquations, prescribed: Array) -> None:
        """Set the equations, with known eliminated components, and the increments d that close their gaps (collective)."""
        self.equations = equations
        self.d = self._closing(prescribed, equations.gap)
        #: Active equations, whose terms form M, their part of L, and the nodes that they follow.
        self._held, self._lift = equations.select(equations.active), self.lift[equations.active]
        self._follows, self._term = np.unique(self._held.followed, return_inverse=True)
        self._halo = Halo(self.space, self._follows) if self._n_terms else None

    def with_gaps(self, equations: UnitingEquations, free: Bools, prescribed: Array, stacked: bool) -> Restriction | None:
        """The same P with other increments c; None if more than gaps and prescribed increments differs on any rank (collective)."""
        pairs = zip((self.free, *self.equations.but_gaps), (free, *equations.but_gaps))
        alike = all(len(a) == len(b) and not (a != b).any() for a, b in pairs)
        if self.rings is not None or self.stacked != stacked or not reduced(self.comm, alike, op=MPI.LAND):
            return None
        other = copy(self)
        other.equations, other.d = equations, self._closing(prescribed, equations.gap)
        other.__dict__.pop("c", None)
        return other

    @property
    def alone(self) -> bool:
        """Whether there are no equations on any rank, so that P only crosses out prescribed components."""
        return not self._n_rows

    # -- elimination in each node's frame ------------------------------------------------------------------------------

    def _eliminate(self) -> tuple[Array, Array, ConflictError | None]:
        """Blocks of T at ``nodes (k, g, g)``, the action L of each equation on its node ``(m, g)``, and an error or None."""
        g, eq = self.space.block, self.equations
        frames = self.free[self.nodes, None, :] * np.eye(g)
        lift = np.zeros_like(eq.direction)
        error = None
        for at, rows in eq.by_node():
            A = eq.direction[rows] * self.free[at, None, :]
            left = least_left(A)
            if (left < MOSTLY_PRESCRIBED).any():
                error = error or self._conflict(int(at[np.argmin(left)]), rows.shape[1])
                continue
            # of one direction, without singular values
            pinv = np.asarray(np.linalg.pinv(A)) if rows.shape[1] > 1 else A.transpose(0, 2, 1) / (A**2).sum(axis=2)[:, :, None]
            lift[rows] = pinv.transpose(0, 2, 1)
            frames[np.searchsorted(self.nodes, at)] = _frames(A, pinv, self.free[at])
        return frames, lift, error

    def _eliminate_like(self, like: Restriction) -> tuple[Array, Array, None]:
        """As ``_eliminate``, from the frames T and the lift L of the restriction ``like``.

        With the directions ``A`` of these equations, the lift is ``L (A L)^-1`` and the frame ``(1 - L (A L)^-1 A) T``: no longer
        orthonormal, with the same unknowns.
        """
        eq, frames, lift = self.equations, like.frames.copy(), np.zeros_like(like.lift)
        for at, rows in eq.by_node():
            A = eq.direction[rows] * self.free[at, None, :]
            L = like.lift[rows].transpose(0, 2, 1)
            own = L @ np.linalg.inv(A @ L)
            lift[rows] = own.transpose(0, 2, 1)
            place = np.searchsorted(self.nodes, at)
            frames[place] -= own @ (A @ frames[place])
        return frames, lift, None

    def _conflict(self, node: int, n_equations: int) -> ConflictError:
        fixed = [c for c, f in zip("xyz", self.free[node]) if not f]
        return ConflictError(
            f"the contactor at {self.space.describe(node)} has {n_equations} uniting equation(s) but its displacement "
            f"in {', '.join(fixed) or 'no direction'} is prescribed, so nothing is left to eliminate: release the Dirichlet "
            "condition there, or make the other surface the contactor"
        )

    def _matrix(self, rows: Ints, columns: Ints, values: Array, sizes: Any = None) -> PETSc.Mat:
        """Matrix from sorted local rows, global columns and values, by default of the displacement's size."""
        bsize = self.space.block if sizes is None else None
        sizes = sizes or self._sizes
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=sizes[0][0]))]).astype(PETSc.IntType)
        return PETSc.Mat().createAIJ(sizes, bsize=bsize, csr=(indptr, columns.astype(PETSc.IntType), values), comm=self.comm)

    def _longest_chain(self) -> tuple[int, PETSc.Mat | None]:
        """Length of the longest chain of equations, and, if chains are endless, the matrix of their coefficients (collective).

        An equation follows another if its terms contain the component that the other eliminates; free components end a chain.
        """
        g, eq = self.space.block, self.equations
        m, k = len(eq), np.arange(g)
        counts = gathered(self.comm, m)
        first, sizes = int(counts[: self.comm.rank].sum()), (m, int(counts.sum()))
        # terms at nodes without eliminated components end a chain
        eliminated = np.zeros((self.space.n_owned, 1))
        eliminated[eq.node[(self.lift != 0).any(axis=1)]] = 1.0
        on = self.space.ask_owners(eq.followed, eliminated)[:, 0] > 0
        if not reduced(self.comm, int(on.any())):
            return int(sizes[1] > 0), None
        terms = np.broadcast_to(eq.row[on, None], (on.sum(), g)), eq.followed[on, None] * g + k, eq.coefficients[on]
        own = eq.node[:, None] * g + k, np.broadcast_to(first + np.arange(m)[:, None], eq.direction.shape), self.lift
        C = self._matrix(*_sum_duplicates(*(np.ascontiguousarray(a).ravel() for a in terms)), (sizes, self._sizes[1]))
        L = self._matrix(*_sum_duplicates(*(np.ascontiguousarray(a).ravel() for a in own)), (self._sizes[0], sizes))
        parts = C.matMult(L)
        indptr, columns, values = parts.getValuesCSR()
        follows = parts.duplicate()
        for matrix, entries in ((parts, np.abs(values)), (follows, (np.abs(values) > NEGLIGIBLE).astype(float))):
            matrix.setValuesCSR(indptr, columns, entries)
            matrix.assemble()
        at = follows.createVecRight()
        at.set(1.0)
        length, left, before = 0, at.sum(), np.inf
        # equations at the start of chains of this length; if their number does not decrease, chains are endless
        while 0.0 < left < before:
            at, length, before = follows * at, length + 1, left
            at.array[:] = at.array_r > 0
            left = at.sum()
        return length, parts if left > 0.0 else None

    # -- P as a matrix -------------------------------------------------------------------------------------------------

    def rows(self) -> Blocks:
        """Rows of P at the owned eliminated nodes; other rows are rows of the identity in free components (collective)."""
        T = self._turned(self.united)
        if self.chain == 0:
            return T
        assert self._halo is not None
        M = self._couplings(self._held, self._lift)
        # T is block-diagonal
        turned = self._halo.take(lambda i: self._turned(i).value)
        terms, power = [T], Blocks(M.row, M.column, M.value @ turned[self._term])
        while True:
            if self.fades:
                power = power.some((np.abs(power.value) > FADED).any(axis=(1, 2)))
            terms.append(power)
            if len(terms) > self.chain:
                return summed(together(*terms))
            power = product(M, rows_at(self.space, power, self._follows))

    def rows_of(self, nodes: npt.NDArray[np.integer]) -> Blocks:
        """Rows of P at owned nodes ``(k,)``, which must include all eliminated nodes (collective)."""
        return together(self._turned(np.setdiff1d(nodes, self.united)), self.rows())

    def reserved(self) -> Blocks:
        """Sparsity of ``rows`` if all equations were active, without chains."""
        return together(self._turned(self.nodes), self._couplings(self.equations, self.lift))

    @property
    def followed_here(self) -> Ints:
        """Local numbers of the owned nodes that active equations of any rank follow, possibly repeated."""
        return np.zeros(0, np.int64) if self._halo is None else self._halo.needed

    def followed(self, which: Bools) -> Ints:
        """Global nodes that some of the equations follow, each once."""
        eq = self.equations
        return np.unique(eq.followed[which[eq.row]])

    def _turned(self, nodes: npt.NDArray[np.integer]) -> Blocks:
        """T at owned nodes ``(k,)``."""
        value = self.free[nodes, None, :] * np.eye(self.space.block)
        if len(self.nodes):
            at = np.minimum(np.searchsorted(self.nodes, nodes), len(self.nodes) - 1)
            here = self.nodes[at] == nodes
            value[here] = self.frames[at[here]]
        numbers = nodes + self.space.first
        return Blocks(numbers.astype(np.int64), numbers.astype(np.int64), value)

    def _couplings(self, eq: UnitingEquations, lift: Array) -> Blocks:
        """M for some equations, with their part of L."""
        rows = eq.node[eq.row] + self.space.first
        return Blocks(rows.astype(np.int64), eq.followed, lift[eq.row][:, :, None] * eq.coefficients[:, None, :])

    @cached_property
    def P(self) -> PETSc.Mat:
        """The restriction matrix; idle columns are stored as zeros, so that ``P'KP`` holds their diagonal (collective)."""
        return self._matrix(*self._entries(self.rows_of(np.arange(self.space.n_owned))))

    def _entries(self, blocks: Blocks) -> tuple[Ints, Ints, Array]:
        """Sorted local rows, global columns and values of blocks in owned rows; zeros are stored, duplicates added."""
        g, value = self.space.block, blocks.value
        k = np.arange(g)
        rows = np.broadcast_to((blocks.row[:, None] * g + k - self._first)[:, :, None], value.shape)
        columns = np.broadcast_to((blocks.column[:, None] * g + k)[:, None, :], value.shape)
        return _sum_duplicates(rows.ravel(), columns.ravel(), value.ravel())

    def cross_out(self, A: PETSc.Mat) -> None:
        """Replace A by ``P'AP`` if there are no equations: P then only crosses out the prescribed components."""
        used = self.space.vector(self.used.astype(float))
        A.diagonalScale(used, used)

    # -- P as a map ----------------------------------------------------------------------------------------------------

    @cached_property
    def c(self) -> PETSc.Vec:
        """Increment that closes the gaps and contains the prescribed increments; read-only (first time: collective)."""
        return self._series(self.d)

    def carried(self, prescribed: Array) -> PETSc.Vec:
        """Part of c due to prescribed increments p ``(n_owned, block)``: ``S (1 - L A) p`` with the series S of P (collective)."""
        return self._series(self._closing(prescribed, np.zeros(len(self.equations))))

    def _closing(self, prescribed: Array, gap: Array) -> PETSc.Vec:
        """``p - L (gap + A p)``: increments of each node alone that close gaps ``(m,)`` under prescribed increments p."""
        eq, closure = self.equations, np.array(prescribed)
        known = np.einsum("mg,mg->m", eq.direction, prescribed[eq.node])
        np.add.at(closure, eq.node, -self.lift * (gap + known)[:, None])
        return self.space.vector(closure)

    def carried_back(self, F: PETSc.Vec) -> Array:
        """The transpose of ``carried``: ``(1 - A'L') S'F (n_owned, block)`` (collective)."""
        eq, t = self.equations, self.pass_on(F).array_r.reshape(-1, self.space.block).copy()
        along = np.einsum("mg,mg->m", self.lift, t[eq.node])
        np.add.at(t, eq.node, -along[:, None] * eq.direction)
        return t

    @cached_property
    def _moving(self) -> Ints:
        """Nodes with free components."""
        return np.flatnonzero(self.free.any(axis=1))

    def _free_part(self, values: Array) -> Array:
        """Values of owned nodes ``(n_owned, block)`` with zeros at components that are not free; quick where few nodes are."""
        if 2 * len(at := self._moving) > len(values):
            return values * self.free
        found = np.zeros(values.shape)
        found[at] = values[at] * self.free[at]
        return found

    def expand(self, dq: PETSc.Vec) -> PETSc.Vec:
        """``P dq``, without c."""
        q = dq.array_r.reshape(-1, self.space.block)
        du = self._free_part(q)
        du[self.nodes] = np.einsum("kij,kj->ki", self.frames, q[self.nodes])
        return self._series(self.space.vector(du))

    def pass_on(self, F: PETSc.Vec) -> PETSc.Vec:
        """Transfer the contactors' forces to their targets [UEM, 4.3]: ``(1 + M + M^2 + ...)' F`` (collective).

        It is F itself where no equation follows a node.
        """
        if not self.chain:
            return F
        part = F.array_r.reshape(-1, self.space.block)
        total, eq = part.copy(), self._held
        for _ in range(self.chain):
            along = np.einsum("mg,mg->m", self._lift, part[eq.node])
            assert self._halo is not None
            part = self._halo.add(sums_of_rows(self._term, eq.coefficients * along[eq.row][:, None], len(self._follows)))
            total += part
        return self.space.vector(total)

    def reduce(self, y: PETSc.Vec) -> PETSc.Vec:
        """``T' y``; with y from ``pass_on`` this is ``P'F``."""
        full = y.array_r.reshape(-1, self.space.block)
        q = self._free_part(full)
        q[self.nodes] = np.einsum("kij,ki->kj", self.frames, full[self.nodes])
        return self.space.vector(q)

    def unknowns(self, du: PETSc.Vec) -> PETSc.Vec:
        """The unknowns q of an increment ``P q``, by the orthonormal frames of the restriction that this one is ``like``."""
        return (self if self._like is None else self._like).reduce(du)

    def transpose(self, F: PETSc.Vec) -> PETSc.Vec:
        """``P'F``."""
        return self.reduce(self.pass_on(F))

    def multipliers(self, y: PETSc.Vec) -> Array:
        """Contact force of each equation along its direction ``(m,)``, positive in compression (collective with rings)."""
        nodal = y.array_r.reshape(-1, self.space.block)
        along = np.einsum("mg,mg->m", self.lift, nodal[self.equations.node])
        return along if self.rings is None else self.rings.forces(along)

    def read_back(self, weights: Array) -> PETSc.Vec:
        """The transpose of ``multipliers`` of ``pass_on``: ``S L w`` for weights of the equations ``(m,)`` (collective)."""
        w = weights if self.rings is None else self.rings.forces(weights, back=True)
        v = self.space.vector(sums_of_rows(self.equations.node.astype(np.int64), self.lift * w[:, None], self.space.n_owned))
        return self._series(v)

    def _series(self, v: PETSc.Vec) -> PETSc.Vec:
        """``(1 + M + M^2 + ...) v``, or v itself where no equation follows a node (collective)."""
        if not self.chain:
            return v
        part = v.array_r.reshape(-1, self.space.block)
        total, eq = part.copy(), self._held
        for _ in range(self.chain):
            assert self._halo is not None
            there = self._halo.take(part.__getitem__)[self._term]
            along = np.bincount(eq.row, np.einsum("kg,kg->k", eq.coefficients, there), len(eq))
            part = sums_of_rows(eq.node.astype(np.int64), self._lift * along[:, None], self.space.n_owned)
            total += part
        return self.space.vector(total)

    def fingerprint(self, *, values: bool) -> int:
        """Hash of this rank's part of P: free components, columns in use, sparsity, active equations, perhaps values up to rounding."""
        eq = self.equations
        parts = [
            *(v.tobytes() for v in (self.free, self.used, eq.node, eq.row, eq.followed, eq.active)),
            str(self.chain).encode(),
        ]
        if values:
            # closest points that have moved by rounding do not change P
            parts += [(np.rint(v / NEGLIGIBLE) + 0.0).tobytes() for v in (eq.direction, eq.coefficients)]
        return zlib.crc32(b"".join(parts))


def _fading(parts: PETSc.Mat) -> int:
    """Number of powers of these magnitudes ``(m, m)`` after which the series in rings is rounding; 0 if it decays too slowly."""
    at = parts.createVecRight()
    at.set(1.0)
    for length in range(1, MOST_ROUND + 1):
        at = parts * at
        if at.norm(PETSc.NormType.INFINITY) <= FADED:
            return length
    return 0


def _frames(A: Array, pinv: Array, free: Bools) -> Array:
    """Blocks of T: an orthonormal frame of the directions that equations leave free; eliminated and prescribed columns are zero.

    A single direction is reflected onto the nearest axis (Householder), so that the frame is close to the axes and the
    two tangential unknowns take the columns of the nearest components.

    ``A (k, r, g)`` are directions in the free components ``free (k, g)``, and ``pinv (k, g, r)`` their pseudo-inverses.
    """
    k, r, g = A.shape
    left, blocks = free.sum(axis=1) - r, np.zeros((k, g, g))
    if r == 1:
        some = left > 0
        H, main = _reflection(A[some, 0] / np.linalg.norm(A[some, 0], axis=1, keepdims=True))
        blocks[some] = H * (free[some] & (np.arange(g) != main[:, None]))[:, None, :]
        return blocks
    # free directions one after the other, each in the nearest column, from the projector onto the null space
    null = free[:, None, :] * np.eye(g) - pinv @ A
    for n in range(left.max(initial=0)):
        more = np.flatnonzero(left > n)
        column = np.argmax(np.einsum("kgg->kg", null[more]), axis=1)
        t = null[more, :, column]
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        blocks[more, :, column] = t
        null[more] -= t[:, :, None] * t[:, None, :]
    return blocks


def _reflection(axis: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Householder matrices that map the nearest coordinate axis onto ``axis (k, g)`` up to sign, and the axis' number."""
    main = np.argmax(np.abs(axis), axis=1)
    rows = np.arange(len(axis))
    v = axis.copy()
    v[rows, main] += np.where(axis[rows, main] >= 0, 1.0, -1.0)
    vv = np.einsum("kg,kg->k", v, v)[:, None, None]
    return np.eye(axis.shape[1]) - 2.0 * v[:, :, None] * v[:, None, :] / vv, main


def _sum_duplicates(rows: Ints, columns: Ints, values: Array) -> tuple[Ints, Ints, Array]:
    """Coordinate triplets sorted by row and column, duplicates added."""
    order = np.lexsort((columns, rows))
    rows, columns, values = rows[order], columns[order], values[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
    return rows[new], columns[new], np.add.reduceat(values, np.flatnonzero(new)) if len(rows) else values
