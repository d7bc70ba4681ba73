"""The constrained problem condensed onto the components in contact: one factorisation for every ``Q'(K + G)P`` of one K.

P and Q differ from the identity, and the curvature G from zero, only at eliminated nodes and the nodes that they follow. With C, the
components of these nodes, and I, all others,

    S = K_CC - K_CI K_II^-1 K_IC                                        MUMPS makes it with the factorisation of K_II
    Q'(S + G)P dq_C = Q'(r_C - K_CI K_II^-1 r_I)                        dense, by LAPACK on rank 0
    dq_I = K_II^-1 (r_I - K_IC P dq_C)

for the right-hand side ``(Q'r_C, r_I)``. C grows with the contact as long as K is unchanged. du is first computed with C at rest under
the forces on I. Other increments e_C under the same forces need dense algebra only, as long as only the unknowns on C are needed:

    K (du + e) = K du + S e_C on C, and as K du on I                    e_I = -K_II^-1 K_IC e_C in the end
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.blocks import SYMMETRIC, Blocks, blocks_of_matrix, stiffen
from uem_dolfinx.algebra.kept_factor import Returning
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import on_root, reduced

#: A sparse factorisation takes as long, in addition to its arithmetic, as so many floating-point operations for each unknown.
#: [heuristic; operations; test_condensed.py::test_which_way_is_cheaper]
FOR_EACH_UNKNOWN = 30_000


class Solved:
    """The solution of a constrained problem.

    Args:
        du: increment of the bodies.
        negative: whether the constrained matrix has a negative determinant.
        indefinite: whether it is symmetric, and has negative eigenvalues.
        left: part of the right-hand side that it leaves; 0 for rounding.
    """

    def __init__(self, du: PETSc.Vec, negative: bool, indefinite: bool, left: float = 0.0):
        self.du, self.negative, self.indefinite, self.left = du, negative, indefinite, left


class Condensed(Returning):
    """The factorisation of one K without the components of the contact, and the last constrained problem that uses it.

    Not for mixed problems: with those components fixed, an incompressible body may be enclosed, and its matrix singular.
    """

    def __init__(self, space: Nodes):
        self.space = space
        #: K, and the cost of its factorisation that MUMPS estimates from its sparsity pattern.
        self._expected: tuple[PETSc.Mat, mumps.Cost] | None = None
        self.drop()

    made, stays = "_pc", ("adjacent_nodes",)
    #: Mask of owned nodes ``(n_owned,)`` that may be followed next, from the mask of followed nodes ``(n_owned,)`` (collective), or None.
    adjacent_nodes: Callable[[Bools], Bools] | None = None

    def drop(self) -> None:
        """Forget K (collective)."""
        self.lose()
        self._pc: Any = None  # preconditioner that solves with K_II
        #: K, the state of its values, and the components without Dirichlet condition.
        self._made_for: tuple[PETSc.Mat, int, Bools] | None = None
        self._begins = False  # whether a step begins: its C must not depend on contacts of earlier steps
        #: Mask of the owned nodes of C, their components, on rank 0 the number of components of every rank and S', and whether K_II has
        #: a negative determinant, and negative eigenvalues.
        self._nodes: Bools = np.zeros(self.space.n_owned, dtype=bool)
        self._wide = False  # whether C included the nodes adjacent to the followed nodes when it was made
        self._at: Ints = np.zeros(0, np.int64)
        self._counts: Ints | None = None
        self._St: Any = None
        self._negative_inside = self._indefinite_inside = False
        self.made_of: Any = None  # P, Q, K and G of the constrained problem, and on rank 0 its dense matrix
        #: Its unknowns, if they are known without it.
        self._taken: PETSc.Vec | None = None
        self._dense: _Dense | None = None
        #: Whether the constrained matrix has a negative determinant, and, if it is symmetric, negative eigenvalues; see ``Solved``.
        self.negative, self.indefinite, self.left = False, False, 0.0
        self.begin_at(None)
        #: An increment du under the forces on I of the last solve, with K du, and whether the unknowns of I have been computed, too.
        self._known: tuple[PETSc.Vec, PETSc.Vec] | None = None
        self.whole = True

    def begin_step(self) -> None:
        """Let C depend on the contacts of this step only, so that a run restarted from a checkpoint uses the same C."""
        self._begins = True

    def serves(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> bool:
        """Whether this K is factorised, and C contains all nodes that P, Q and G need (collective)."""
        lacks = True
        if self._is_of(K):
            followed = self._followed(P, Q, holding=not self._begins)
            touched = self._touched(P, Q, G, followed, holding=not self._begins)
            if self._begins and self._wide and self.adjacent_nodes is not None:
                touched |= self.adjacent_nodes(followed)
            lacks = bool((touched & ~self._nodes).any() or (self._begins and (self._nodes & ~touched).any()))
        return not reduced(self.space.comm, int(lacks))

    def _is_of(self, K: PETSc.Mat) -> bool:
        return self._made_for is not None and self._made_for[0] == K and self._made_for[1] == K.stateGet()

    def _followed(self, P: Restriction, Q: Restriction, holding: bool) -> Bools:
        """Mask of owned nodes followed by equations of any rank, only the active ones if ``holding`` ``(n_owned,)`` (collective)."""
        n, first = self.space.n_owned, self.space.first
        marked = np.zeros(n, dtype=bool)
        for R in (P,) if P is Q else (P, Q):
            followed = R.followed(R.equations.active if holding else np.ones_like(R.equations.active))
            own = (followed >= first) & (followed < first + n)
            marked[followed[own] - first] = True
            marked[self.space.gather_owned(followed[~own])] = True
        return marked

    def _touched(self, P: Restriction, Q: Restriction, G: PETSc.Mat | None, followed: Bools, holding: bool) -> Bools:
        """Mask of nodes that C needs: of equations, if ``holding`` of active ones, in G, and with changed conditions ``(n_owned,)``."""
        touched = followed.copy()
        for R in (P,) if P is Q else (P, Q):
            touched[R.united if holding else R.nodes] = True
        if G is not None:
            # a node with a row of it is coupled with itself
            touched |= np.diff(G.getDiagonalBlock().getRowIJ()[0]).reshape(-1, self.space.block).any(axis=1)
        if self._made_for is not None:
            touched |= (P.free != self._made_for[2]).any(axis=1)
        return touched

    def factorise(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, pc: PETSc.PC, symmetric: bool) -> bool:
        """Factorise K without the nodes in contact; whether this is cheaper than a full factorisation and succeeded (collective)."""
        space, followed = self.space, self._followed(P, Q, holding=False)
        nodes = self._touched(P, Q, G, followed, holding=False)
        if self._is_of(K) and not self._begins:
            nodes |= self._nodes
        known = self._known if self._is_of(K) else None
        self.drop()
        # an increment of this K serves whichever nodes C has, and whether or not an earlier attempt has left its C
        self._known = known
        if not self._is_cheaper(nodes, K, pc):
            return False
        if self.adjacent_nodes is not None:
            # closest points that move to adjacent facets then need no new factorisation
            wide = nodes | self.adjacent_nodes(followed)
            self._wide = self._is_cheaper(wide, K, pc)
            nodes = wide if self._wide else nodes
        self._nodes = nodes
        self._at = (space.block * np.flatnonzero(nodes)[:, None] + np.arange(space.block)).ravel()
        counts = space.comm.gather(len(self._at))
        self._counts = None if counts is None else np.array(counts)
        A, kept = K.copy(), space.vector(P.free | nodes[:, None])
        A.diagonalScale(kept, kept)
        stiffen(A, K, kept.array_r == 0.0)
        A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        pc.setOperators(A)
        S = mumps.schur_complement(pc, self._at + space.block * space.first)
        if S is None:
            self.drop()
            return False
        self._negative_inside, self._indefinite_inside = mumps.is_negative(pc), mumps.is_indefinite(pc)
        if not mumps.solves_with_schur_complement(space.comm):
            inner = space.vector(P.free & ~nodes[:, None])
            A.diagonalScale(inner, inner)
            stiffen(A, K, inner.array_r == 0.0)
            pc.reset()
            pc.setOperators(A)
            pc.setUp()
            if pc.getFailedReason() != PETSc.PC.FailedReason.NOERROR:
                self.drop()
                return False
        self._pc, self._made_for = pc, (K, K.stateGet(), P.free)
        # transposed and contiguous, for products with sparse matrices
        self._St = np.ascontiguousarray(S.T)
        return True

    def _is_cheaper(self, nodes: Bools, K: PETSc.Mat, pc: PETSc.PC) -> bool:
        """Whether dense algebra of owned ``nodes (n_owned,)`` costs no more than a full factorisation, the same on all ranks (collective).

        ``size^3 / 3`` operations are compared with the count in MUMPS' analysis of K, which is made once and only if it is decisive.
        S must then not have more entries than these factors, either.
        """
        size = reduced(self.space.comm, self.space.block * int(nodes.sum()))
        dense, solves = size**3 / 3 * (1 if pc.getType() == "cholesky" else 2), FOR_EACH_UNKNOWN * K.getSize()[0]
        if dense <= solves:
            return True
        if self._expected is None or self._expected[0] != K:
            self._expected = K, mumps.expected(pc, K)
        flops, entries = self._expected[1]
        return dense <= flops + solves and size**2 <= entries

    def unite(self, P: Restriction, Q: Restriction, G: PETSc.Mat | None) -> None:
        """Make the dense constrained matrix; ``serves`` must be true (collective)."""
        assert self._made_for is not None
        nodes = np.flatnonzero(self._nodes)
        with timed("restriction matrix P"):
            rows = P.rows_of(nodes)
            test_rows = rows if P is Q else Q.rows_of(nodes)
        with timed("condensed matrix"):
            numbers = on_root(self.space.comm, nodes + self.space.first)
            trial = self._on_root(rows, numbers)
            test = trial if P is Q else self._on_root(test_rows, numbers)
            curvature = None if G is None else self._on_root(blocks_of_matrix(self.space, G), numbers)
            used = on_root(self.space.comm, P.used.ravel()[self._at].astype(float)) > 0
            self.made_of, self._dense, self._taken = (P, Q, self._made_for[0], G), None, None
            self.negative, self.left = False, 0.0
            if self.space.comm.rank == 0:
                self._dense = _Dense(self._St, curvature, trial[:, used], None if P is Q else test[:, used], used)
            negative, indefinite = self.space.comm.bcast(self._dense and (self._dense.negative, self._dense.indefinite))
            self.negative, self.indefinite = self._negative_inside != negative, self._indefinite_inside or indefinite

    def take(self, solved: Solved, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Use a known solution of the constrained problem (collective)."""
        self.made_of, self._dense, self._taken = (P, Q, K, G), None, P.unknowns(solved.du - P.c)
        self.negative, self.indefinite, self.left, self.whole = solved.negative, solved.indefinite, solved.left, True

    def begin_at(self, c: PETSc.Vec | None, rounding: float = 0.0) -> None:
        """Set the increment c to which the next solves add ``P dq``; None is zero, and they then complete the unknowns of I at once."""
        self._closure, self._rounding = c, rounding

    def solve(self, rhs: PETSc.Vec, again: bool = False, accuracy: float = 0.0) -> PETSc.Vec:
        """Unknowns dq of the constrained problem, to be completed on I; not finite if the matrix is singular (collective).

        Args:
            rhs: the right-hand side.
            again: whether the forces on I are the same as for the known increment.
            accuracy: relative residual that is acceptable on I if it is rounding, too.
        """
        if self._taken is not None:
            return self._taken
        (P, Q, K, _), at = self.made_of, self._at
        c = self.space.vector(np.zeros_like(rhs.array_r)) if self._closure is None else self._closure
        self._begins = self.whole = False
        with timed("linear solve"):
            if self._known is None or not again:
                self._known = self._resting(P, K, rhs, c, accuracy)
            du, forces = self._known
            left = forces - forms.product(K, c)
            left.array[at] += self._stiffness(c.array_r[at] - du.array_r[at])
            left = Q.transpose(left)
            dq = du.copy()
            on_c = on_root(self.space.comm, rhs.array_r[at] - left.array_r[at])
            dq.array[at] = self._scattered(None if self._dense is None else self._dense.solve(on_c))
            dq.array[~P.used.ravel()] = 0.0
        return self.complete(dq) if self._closure is None else dq

    def _resting(
        self, P: Restriction, K: PETSc.Mat, rhs: PETSc.Vec, c: PETSc.Vec, accuracy: float
    ) -> tuple[PETSc.Vec, PETSc.Vec]:
        """The increment du under the forces on I with C at rest, and ``K du`` (collective).

        The forces on I are ``r + K c`` with c set to zero on C. If K was used in the last solve and loads are unchanged, they are rounding.
        """
        inner, du = P.used.ravel().copy(), c.copy()
        inner[self._at] = False
        du.array[self._at] = 0.0
        moved = c - du
        inside = rhs + forms.product(K, moved)
        inside.array[~inner] = 0.0
        if inside.norm() > min(self._rounding, accuracy * rhs.norm()):
            du.axpy(1.0, self._solve_inside(P, inside))
        return du, forms.product(K, du)

    def forces(self, K: PETSc.Mat, du: PETSc.Vec, exact: bool) -> PETSc.Vec:
        """``K du`` of an increment of the last solve, not at prescribed components outside the contact; ``exact`` or not (collective)."""
        if not self.whole and self._known is not None:
            (before, known), at = self._known, self._at
            forces = known.copy()
            forces.array[at] += self._stiffness(du.array_r[at] - before.array_r[at])
            return forces
        forces = forms.product(K, du)
        self._known = (du.copy(), forces.copy()) if exact else None
        return forces

    def complete(self, dq: PETSc.Vec, needed: Callable[[], Sequence[Indices] | None] | None = None) -> PETSc.Vec:
        """Unknowns dq of the last solve, on I as well; only if one of the owned nodes that ``needed`` returns is not in C (collective)."""
        if self.whole:
            return dq
        some = None if needed is None else needed()
        if some is not None and not reduced(self.space.comm, int(any(not self._nodes[nodes].all() for nodes in some))):
            return dq
        assert self._known is not None
        (P, _, K, _), at = self.made_of, self._at
        with timed("linear solve"):
            du = P.expand(dq)
            if self._closure is not None:
                du.axpy(1.0, self._closure)
            du.axpy(-1.0, self._known[0])
            change = self.space.vector(np.zeros_like(du.array_r))
            change.array[at] = du.array_r[at]
            whole = dq - self._solve_inside(P, forms.product(K, change))
        self.whole = True
        return whole

    def _solve_inside(self, P: Restriction, rhs: PETSc.Vec) -> PETSc.Vec:
        """``K_II^-1 r_I``, zero on C and at unused unknowns (collective)."""
        found = rhs.duplicate()
        with timed("solve without the contact"):
            self._pc.apply(rhs, found)
        found.array[~P.used.ravel()] = 0.0
        found.array[self._at] = 0.0
        return found

    def _stiffness(self, du: Array) -> Array:
        """``S du_C`` at this rank's components of C (collective)."""
        every = on_root(self.space.comm, du)
        return self._scattered(every @ self._St if self.space.comm.rank == 0 else None)

    def _on_root(self, blocks: Blocks, numbers: Ints) -> Any:
        """A matrix of C, from ``blocks`` of owned rows and the numbers of its nodes, as SciPy's on rank 0, else None (collective)."""
        from scipy.sparse import bsr_matrix

        parts = self.space.comm.gather(blocks)
        if parts is None:
            return None
        row, column, value = (np.concatenate(arrays) for arrays in zip(*parts))
        order = np.argsort(row, kind="stable")
        indptr = np.append(0, np.cumsum(np.bincount(np.searchsorted(numbers, row), minlength=len(numbers))))
        size = self.space.block * len(numbers)
        return bsr_matrix((value[order], np.searchsorted(numbers, column[order]), indptr), shape=(size, size)).tocsr()

    def _scattered(self, values: Array | None) -> Array:
        """Values from rank 0 at this rank's components of C (collective)."""
        parts = None if values is None or self._counts is None else np.split(values, np.cumsum(self._counts)[:-1])
        return np.asarray(self.space.comm.scatter(parts))


class _Dense:
    """``Q'(S + G)P`` of the ``used`` components, factorised, from the transposed Schur complement, and Q None if it is P."""

    def __init__(self, transposed: Array, G: Any, P: Any, Q: Any, used: Bools):
        from scipy.linalg import lapack

        self._used, self._lapack = used, lapack
        A, trial = transposed if G is None else transposed + G.T.toarray(), P.T
        test = trial if Q is None else Q.T
        M = np.asarray(test @ np.ascontiguousarray((trial @ A).T))
        self._positive = self.negative = self.indefinite = False
        if not len(M):
            # every component is eliminated or prescribed
            return
        root = np.sqrt(np.abs(np.diag(M)))
        if Q is None and (np.abs(M - M.T) <= SYMMETRIC * root[:, None] * root).all():
            factor, failed = lapack.dpotrf(M, lower=1)
            self._positive = failed == 0
            self.indefinite = not self._positive
        if self._positive:
            self._factor = factor
            return
        self._factor, self._pivots, _ = lapack.dgetrf(M)
        swapped = (self._pivots != np.arange(len(self._pivots))).sum() % 2 == 1
        self.negative = bool(swapped != ((np.diag(self._factor) < 0.0).sum() % 2 == 1))

    def solve(self, rhs: Array) -> Array:
        """Unknowns ``(k,)``, zero where they are not used."""
        q, b = np.zeros(len(rhs)), rhs[self._used]
        if len(b) and self._positive:
            q[self._used], _ = self._lapack.dpotrs(self._factor, b, lower=1)
        elif len(b):
            q[self._used], _ = self._lapack.dgetrs(self._factor, self._pivots, b)
        return q
