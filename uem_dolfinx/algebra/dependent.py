"""Conflicting constraint equations, replaced by independent ones: pure algebra, for equations of any origin.

Most equations eliminate the normal component of their own contactor, independently of others. A few cannot [UEM, 4.1]:

- the contactor's normal displacement is prescribed, so that a component of the target is eliminated instead;
- several equations of one node have dependent directions, e.g. if two targets lie in one plane;
- equations follow each other in a ring, and depend on each other, e.g. if two surfaces are contactor and target of each other.

These are solved for one component each by Gauss-Jordan elimination with pivoting, in the order of their largest coefficients.
Rows that depend on others become zero and are dropped: they are satisfied already, or cannot be satisfied.
"""

from __future__ import annotations

from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, NEGLIGIBLE, UnitingEquations, least_left, send
from uem_dolfinx.algebra.rings import components
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import gathered, reduced


def least_squares(E: Array, e: Array, quick: bool = True) -> Array:
    """``x >= 0 (n,)`` that minimises ``|E x - e|``, ``E (m, n)``: ``quick`` is not accurate to rounding in every SciPy."""
    from scipy.optimize import lsq_linear, nnls

    most = 30 * E.shape[1]
    if quick:
        # nnls raises after too many iterations
        with suppress(RuntimeError):
            return np.asarray(nnls(E, e, maxiter=most)[0])
    # its bounds hold to rounding
    return np.maximum(lsq_linear(E, e, (0.0, np.inf), "bvls", 1e-15, max_iter=most).x, 0.0)


#: A weight that exceeds one by more extrapolates: the contactor is past an end of the target.
#: [bound; weight; test_equations.py::test_rows_past_an_end_are_left_out_first]
EXTRAPOLATED = 1e-9


class Rank(IntEnum):
    """Ranks of equations; the equations of the highest rank are dropped first."""

    FIRM = 0  # equations that are never dropped in favour of others
    WITHIN = 1  # equations of contactors in front of a facet
    LEFT_OUT = 2  # equations that have been dropped before
    PAST_END = 3  # equations of contactors past an end of the target


@dataclass(frozen=True)
class Group:
    """Conflicting equations that share nodes, and the independent ones that replace them.

    ``given (m,)`` are the numbers of the conflicting equations, ``redundant (m,)`` marks dropped ones. ``independent (k,)`` are of
    global nodes, on any rank; ``shares (m, k)`` maps forces of the independent equations to forces of the conflicting ones.
    ``nodes (n_nodes,)`` are all nodes that the equations act on, ascending; ``movable (m, n)`` are the free components of the
    conflicting equations, and ``pushing (m,)`` marks those with forces that cannot be negative.
    """

    given: Ints
    independent: UnitingEquations
    shares: Array
    redundant: Bools
    nodes: Ints
    movable: Array
    pushing: Bools

    def forces(self, mu: Array, gap: Array) -> Array:
        """Forces of the conflicting equations ``(m,)`` from those of the independent ones ``(k,)``: the least, if none pulls.

        Otherwise none pulls, if forces without a pull balance the same loads; else those pull whose contactors the loads lift off
        while the others stay. Where a dropped equation has a negative ``gap (m,)``, one pulls in its place, see ``_exchanged``.
        """
        return self._exchanged(self._shared(mu), gap)

    def _exchanged(self, lam: Array, gap: Array) -> Array:
        """Forces ``lam (m,)`` with a pull of the equation that a dropped one of negative ``gap (m,)`` replaces, if none pulls yet.

        The dropped equation is a combination of others. It takes over their forces by its coefficients, until the first is zero:
        without that one, the dropped equation is independent, and closes its gap [Dantzig's ratio test].
        """
        most, inside = np.abs(lam).max(initial=0.0), np.where(self.redundant & self.pushing, gap, 0.0)
        if inside.min(initial=0.0) >= 0.0 or (lam[self.pushing] < -NEGLIGIBLE * most).any():
            return lam
        i, kept = int(inside.argmin()), np.flatnonzero(~self.redundant)
        c = _least(self.movable[kept], self.movable[[i]])[:, 0]
        gives = self.pushing[kept] & (c > NEGLIGIBLE)
        if gives.any():
            lam[kept[gives][np.argmin(lam[kept[gives]] / c[gives])]] = -most
        return lam

    def _shared(self, mu: Array) -> Array:
        """Forces of the conflicting equations ``(m,)`` from those of the independent ones ``(k,)``, see ``forces``."""
        lam = self.shares @ mu
        if not (lam[self.pushing] < -NEGLIGIBLE * np.abs(lam).max(initial=0.0)).any():
            return lam
        both = np.flatnonzero(~self.pushing)
        A = np.concatenate([self.movable, -self.movable[both]])
        loads = self.movable.T @ lam
        x = least_squares(A.T, loads)
        opened = self.movable @ (loads - A.T @ x)
        lam, pulled = x[: len(lam)], self.pushing & (x[: len(lam)] <= 0.0)
        lam[both] -= x[len(lam) :]
        return np.where(pulled, np.minimum(opened, lam), lam)

    def rotated(self, rows: UnitingEquations) -> Group:
        """The group of the conflicting equations, ``rows`` in their order, in other directions, with the same eliminated components.

        With the given rows ``A`` and the shares ``S`` the independent rows are again ``S'A``. They are solved for the same components, or a
        LinAlgError is raised, so that forces of the given equations keep their ratios.
        """
        own, m, terms = self.independent, len(self.given), np.flatnonzero(np.isin(rows.row, self.given))
        nodes = np.union1d(self.nodes, rows.followed[terms])
        A = np.zeros((m, len(nodes), rows.direction.shape[1]))
        np.add.at(A, (np.arange(m), np.searchsorted(nodes, rows.node[self.given])), rows.direction[self.given])
        at = np.searchsorted(self.given, rows.row[terms]), np.searchsorted(nodes, rows.followed[terms])
        np.add.at(A, at, -rows.coefficients[terms])
        B, k, pivot = np.einsum("mk,mng->kng", self.shares, A), np.arange(len(own)), np.searchsorted(nodes, own.node)
        solve = np.linalg.inv(np.einsum("kjg,jg->kj", B[:, pivot], own.direction))
        B = np.einsum("kj,jng->kng", solve, B)
        B[k, pivot] -= own.direction
        row, column = np.nonzero((np.abs(B) > NEGLIGIBLE).any(axis=2))
        independent = replace(own, row=row, followed=nodes[column], coefficients=-B[row, column])
        # friction follows the forces along the normals, which other shares would change
        return replace(self, independent=independent, shares=self.shares @ solve.T, pushing=np.zeros(m, dtype=bool))


class IndependentEquations:
    """Independent equations in place of conflicting ones, and the forces of the given equations from theirs (collective).

    Conflicting equations that share nodes are solved together on the rank that has most of them; other equations are not moved.

    Args:
        space: the nodes whose components are restricted.
        equations: of this rank's contactors.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, block)``.
        ring: mask of equations that follow each other in rings and depend on each other ``(m,)``, or None.
        firm: mask of equations that are never dropped, and depend on no other firm ones ``(m,)``, or None.
        pushing: mask of equations with forces that cannot be negative ``(m,)``, or None.
        left_out: mask of equations that have been dropped before, and are dropped again where they depend on others ``(m,)``, or None.
    """

    def __init__(
        self,
        space: Nodes,
        equations: UnitingEquations,
        free: Bools,
        ring: Bools | None = None,
        firm: Bools | None = None,
        pushing: Bools | None = None,
        left_out: Bools | None = None,
    ):
        #: mask of given equations that were dropped because they depend on others ``(m,)``, known after ``forces``.
        self.redundant: Bools = np.zeros(len(equations), dtype=bool)
        #: mask of given equations that, after rotation, no longer determine their eliminated components ``(m,)``.
        self.undetermined: Bools = self.redundant
        conflicting = equations.active & _cannot_eliminate(equations, free)
        if ring is not None:
            conflicting |= ring
        self.found = bool(reduced(space.comm, int(conflicting.any())))  # whether any equations on any rank conflict
        self.equations = equations  # the independent ones
        if not self.found:
            return
        self._conflicting = _with_neighbours(space, equations, conflicting)
        self._space, self._rank = space, _ranks_of_groups(space, equations, self._conflicting)
        together = self._gather(equations)
        none = np.zeros(len(equations), dtype=bool)
        masks = (none if mask is None else mask for mask in (firm, pushing, left_out))
        self._groups = _solve(space, together, free, *self._gathered.send(*(mask[self._conflicting] for mask in masks)))
        self._scatter(equations)

    def rotated(self, equations: UnitingEquations) -> IndependentEquations:
        """The same equations in the same order in other directions, with the same eliminated components (collective).

        Equations that no longer determine these components are unchanged and marked in ``undetermined``.
        """
        other, rows = copy(self), self._gather(equations)
        other.redundant, other._groups, singular = self.redundant.copy(), [], np.zeros(len(rows), dtype=bool)
        for group in self._groups:
            try:
                other._groups.append(group.rotated(rows))
            except np.linalg.LinAlgError:
                other._groups.append(group)
                singular[group.given] = True
        other.undetermined = np.zeros(len(equations), dtype=bool)
        (other.undetermined[self._sent],) = self._gathered.back(singular)
        other._scatter(equations)
        return other

    def _gather(self, equations: UnitingEquations) -> UnitingEquations:
        """Conflicting equations of all ranks, with global nodes, on the rank that solves them (collective)."""
        mine = equations.select(self._conflicting)
        mine = replace(mine, node=self._space.to_global(mine.node))
        together, self._gathered = send(self._space.comm, mine, self._rank)
        return together

    @property
    def _sent(self) -> Ints:
        """The conflicting equations in the order in which they were sent to the ranks that solve them."""
        return np.flatnonzero(self._conflicting)[self._gathered.rows]

    def _scatter(self, equations: UnitingEquations) -> None:
        """Replace conflicting equations by the groups' independent ones, each on the rank that owns its node (collective)."""
        space = self._space
        independent = UnitingEquations.join([group.independent for group in self._groups], space.block)
        solved, self._scattered = send(space.comm, independent, space.owner_of(independent.node))
        solved = replace(solved, node=(solved.node - space.first).astype(np.int32))
        self.equations = UnitingEquations.join([equations.select(~self._conflicting), solved], space.block)

    def of_given(self, of_independent: Bools) -> Bools:
        """Mask of the given equations ``(m,)`` from a mask of the independent ones; conflicting equations are False."""
        if not self.found:
            return of_independent
        given = np.zeros(len(self._conflicting), dtype=bool)
        given[~self._conflicting] = of_independent[: int((~self._conflicting).sum())]
        return given

    def forces(self, multipliers: Array, gap: Array) -> Array:
        """Contact forces of the given equations from the ``multipliers`` of ``equations`` (collective).

        ``gap (m,)``: negative gaps that are to be closed; 0 for all other equations.
        """
        if not self.found:
            return multipliers
        n = int((~self._conflicting).sum())
        mu = np.empty(len(self._scattered.rows))
        (mu[self._scattered.rows],) = self._scattered.back(multipliers[n:])
        total, end = sum(len(group.given) for group in self._groups), 0
        lam, redundant, (gap,) = np.zeros(total), np.zeros(total, dtype=bool), self._gathered.send(gap[self._conflicting])
        for group in self._groups:
            start, end = end, end + len(group.independent)
            lam[group.given], redundant[group.given] = group.forces(mu[start:end], gap[group.given]), group.redundant
        given = np.empty(len(self._conflicting))
        given[~self._conflicting] = multipliers[:n]
        given[self._sent], self.redundant[self._sent] = self._gathered.back(lam, redundant)
        return given


def _solve(space: Nodes, rows: UnitingEquations, free: Bools, firm: Bools, pushing: Bools, left_out: Bools) -> list[Group]:
    """Solve conflicting equations group by group, on the rank that has them (collective)."""
    node, place = np.unique(np.concatenate([rows.node, rows.followed]), return_inverse=True)
    movable = space.ask_owners(node, free.astype(float)) > 0
    m, g = len(rows), space.block
    if m == 0:
        return []
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(m + len(rows.row)), (np.concatenate([np.arange(m), rows.row]), place)), shape=(m, len(node)))
    weight = np.einsum("kg,kg->k", rows.coefficients, rows.direction[rows.row])
    past = np.bincount(rows.row, weight > 1.0 + EXTRAPOLATED, m) > 0
    count, label = connected_components(links @ links.T, directed=False)
    groups = []
    for k in range(count):
        which = np.flatnonzero(label == k)
        terms = np.flatnonzero(label[rows.row] == k)
        columns, at = np.unique(np.concatenate([place[which], place[m + terms]]), return_inverse=True)
        A = np.zeros((len(which), len(columns), g))
        np.add.at(A, (np.arange(len(which)), at[: len(which)]), rows.direction[which])
        np.add.at(A, (np.searchsorted(which, rows.row[terms]), at[len(which) :]), -rows.coefficients[terms])
        within = np.where(left_out[which], Rank.LEFT_OUT, Rank.WITHIN)
        rank = np.where(firm[which], Rank.FIRM, np.where(past[which], Rank.PAST_END, within))
        groups.append(_eliminate(A, -rows.gap[which], movable[columns], node[columns], which, rank, pushing[which]))
    return groups


def _cannot_eliminate(equations: UnitingEquations, free: Bools) -> Bools:
    """Mask of active equations that cannot each eliminate a component of their own node ``(m,)``."""
    unable = np.zeros(len(equations), dtype=bool)
    for nodes, rows in equations.by_node():
        unable[rows] = (least_left(equations.direction[rows] * free[nodes, None, :]) < MOSTLY_PRESCRIBED)[:, None]
    return unable


def _with_neighbours(space: Nodes, equations: UnitingEquations, conflicting: Bools) -> Bools:
    """Add the equations of all nodes that conflicting equations act on, until there are no more (collective)."""
    conflicting = conflicting.copy()
    here = np.zeros(space.n_owned, dtype=bool)
    while True:
        rows = conflicting[equations.row]
        touched = np.unique(np.concatenate([equations.followed[rows], space.to_global(equations.node[conflicting])]))
        here[space.gather_owned(touched)] = True
        more = equations.active & ~conflicting & here[equations.node]
        conflicting |= more
        if not reduced(space.comm, int(more.any())):
            return conflicting


def _ranks_of_groups(space: Nodes, equations: UnitingEquations, conflicting: Bools) -> Ints:
    """The rank that solves each of the conflicting equations, the same for equations that share nodes (collective)."""
    mine, counts = np.flatnonzero(conflicting), gathered(space.comm, len(equations))
    number, total = mine + int(counts[: space.comm.rank].sum()), int(counts.sum())
    terms = np.flatnonzero(conflicting[equations.row])
    place = np.searchsorted(mine, equations.row[terms])
    row = np.concatenate([number, number[place]])
    node = np.concatenate([space.to_global(equations.node[mine]), equations.followed[terms]])
    label, rank = components(space.comm, np.stack([row, total + node], axis=1), number, strong=False)
    return rank[label]


def _eliminate(
    A: Array, h: Array, free: Bools, node: Ints, given: Ints, rank: Ints | None = None, pushing: Bools | None = None
) -> Group:
    """Gauss-Jordan elimination of ``A du = h`` in the free components, one direction of one node after the other.

    Rows are normalised first. A row depends on the chosen rows if its part orthogonal to all of them, which does not depend on the
    pivots, is negligible; it is then dropped.

    In ``A (m, n_nodes, block)`` and ``free (n_nodes, block)`` each of the global nodes ``node (n_nodes,)`` has its block of columns;
    ``given (m,)`` are the numbers of these equations, ``h (m,)`` their right-hand sides; the lowest ``rank (m,)`` is eliminated
    first, see ``Rank``; those of ``pushing (m,)`` have no negative forces.
    """
    m, flat = len(A), (len(A), free.size)
    movable = (A * free).reshape(flat)
    length = np.linalg.norm(movable, axis=1)
    rest = length > MOSTLY_PRESCRIBED * np.linalg.norm(A.reshape(flat), axis=1)
    scale = np.where(rest, length, 1.0)
    A, h, across = A / scale[:, None, None], h / scale, movable / scale[:, None]
    rank = np.full(m, Rank.WITHIN) if rank is None else rank
    k, pivot, direction = _pivots(A, h, across, free, rest, rank)
    shares: Array = np.zeros((m, 0))
    if len(k):
        shares = _shares(movable, (A[k] * free).reshape(len(k), free.size), rank == Rank.FIRM)
    terms = A[k]
    # the rest of the pivot's block is orthogonal to the eliminated direction, and followed like any other node
    terms[np.arange(len(k)), pivot] -= direction
    row, column = np.nonzero((np.abs(terms) > NEGLIGIBLE).any(axis=2))
    independent = UnitingEquations(node[pivot], direction, -h[k], np.ones(len(k), bool), row, node[column], -terms[row, column])
    redundant = np.ones(m, dtype=bool)
    redundant[k] = False
    pushing = np.zeros(m, dtype=bool) if pushing is None else pushing
    return Group(given, independent, shares, redundant, node, movable, pushing)


def _pivots(A: Array, h: Array, across: Array, free: Bools, rest: Bools, rank: Ints) -> tuple[Ints, Ints, Array]:
    """Eliminate one direction after the other from the rows ``A du = h``, in place; zeros are skipped.

    Args:
        A: the rows ``(m, n_nodes, block)``.
        h: their right-hand sides ``(m,)``.
        across: their free components ``(m, n_nodes * block)``, of length one; overwritten.
        free: components that may be eliminated ``(n_nodes, block)``.
        rest: mask of rows with free components ``(m,)``.
        rank: of the rows ``(m,)``: see ``Rank``.

    Returns:
        The independent rows in the order of elimination ``(k,)``, the node and the direction that each eliminates ``(k,)``, ``(k, block)``.
    """
    from scipy.linalg import solve_triangular

    rows, nodes, directions = list[int](), list[int](), list[Array]()
    size, left = np.linalg.norm(A * free, axis=2), np.linalg.norm(across, axis=1)
    where = size.argmax(axis=1)
    largest = size[np.arange(len(A)), where]
    while (rest := rest & (left > MOSTLY_PRESCRIBED)).any():
        among = rest & (rank == rank[rest].min())
        i = int(np.argmax(np.where(among, largest, -1.0)))
        t, rest[i] = int(where[i]), False
        # chosen and dropped rows are not updated any more
        q, coupled = across[i] / left[i], np.flatnonzero(rest)
        filled = np.flatnonzero(q)
        along = across[coupled[:, None], filled] @ q[filled]
        coupled, along = coupled[along != 0], along[along != 0]
        across[coupled[:, None], filled] -= along[:, None] * q[filled]
        left[coupled] = np.linalg.norm(across[coupled], axis=1)
        d = A[i, t] * free[t]
        d /= (pushed := np.linalg.norm(d))
        A[i], h[i] = A[i] / pushed, h[i] / pushed
        others, filled = np.flatnonzero(rest), np.flatnonzero(A[i].any(axis=1))
        factor = A[others, t] @ d
        others, factor = others[factor != 0], factor[factor != 0]
        block = A[others[:, None], filled] - factor[:, None, None] * A[i, filled]
        A[others[:, None], filled], size[others[:, None], filled] = block, np.linalg.norm(block * free[filled], axis=2)
        h[others] -= factor * h[i]
        where[others] = size[others].argmax(axis=1)
        largest[others] = size[others, where[others]]
        rows.append(i)
        nodes.append(t)
        directions.append(d)
    k, pivot, direction = np.array(rows, np.int64), np.array(nodes, np.int64), np.reshape(directions, (len(rows), A.shape[2]))
    if not rows:
        return k, pivot, direction
    # each row still contains components eliminated by later rows
    later = np.einsum("ksg,sg->ks", A[k][:, pivot], direction)
    both = solve_triangular(later, np.column_stack([A[k].reshape(len(k), -1), h[k]]), unit_diagonal=True, check_finite=False)
    A[k], h[k] = both[:, :-1].reshape(-1, *A.shape[1:]), both[:, -1]
    return k, pivot, direction


def _shares(given: Array, independent: Array, firm: Bools) -> Array:
    """Combinations of the given rows ``(m, n)`` that equal the independent rows ``(k, n)``: ``(m, k)``.

    Their norm is the least in the rows that are not ``firm (m,)``: contactors with equal rows have equal parts of the force.
    """
    from scipy.linalg import qr

    shares = np.zeros((len(given), len(independent)))
    if firm.any() and not firm.all():
        across = qr(given[firm].T, mode="full", check_finite=False)[0][:, firm.sum() :]
        shares[~firm] = _least(given[~firm] @ across, independent @ across)
        shares[firm] = _least(given[firm], independent - shares[~firm].T @ given[~firm])
        return shares
    return _least(given, independent)


def _least(given: Array, independent: Array) -> Array:
    """The combinations of least norm of given rows ``(m, n)`` that are closest to independent rows ``(k, n)``: ``(m, k)``."""
    from scipy.linalg import lstsq

    # a complete orthogonal factorisation is ten times as fast as a singular value decomposition
    rounding = np.finfo(float).eps * max(given.shape)
    return np.asarray(lstsq(given.T, independent.T, cond=rounding, lapack_driver="gelsy", check_finite=False)[0])
