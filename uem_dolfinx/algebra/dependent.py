"""Uniting equations that get in each other's way, turned into independent ones.

Between the fourth and the fifth step on the data's way, pure algebra. Most equations eliminate the normal component of their own
contactor and ask nobody. A few cannot:

- the contactor's normal is prescribed, so that a component of the target must go instead [UEM, 4.1, end];
- several equations of one node have dependent directions, as where two targets lie in one plane;
- two surfaces are contactor and target of each other (two-pass), and each follows the other.

These are solved for one component each by Gauss-Jordan elimination with pivoting, in the order of their largest coefficients.
Rows that depend on others end as zeros and are left out: what they ask for holds already, or nothing could make it hold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, ROUNDING, UnitingEquations

if TYPE_CHECKING:
    from uem_dolfinx.geometry.configuration import Configuration

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: A row that has lost all but this part of its length depends on the others; the rows of surfaces that bend under load do so
#: only to the first order of their strain.
DEPENDENT = 0.05
#: A contactor's own component is eliminated unless another coefficient is larger by this factor.
OWN_FIRST = 1.5


@dataclass(frozen=True)
class Group:
    """Contested equations that share nodes, and the independent ones that replace them; lives on the home rank.

    Attributes:
        origin: rank and place of each contested equation ``(m, 2)``.
        independent: equations of global nodes, which may live on any rank ``(k,)``.
        shares: forces of the contested equations from those of the independent ones ``(m, k)``.
        redundant: contested equations that were left out ``(m,)``.
    """

    origin: Ints
    independent: UnitingEquations
    shares: Array
    redundant: Bools


class Resolution:
    """Independent equations in place of contested ones, and the way back of their forces (collective).

    Contested equations meet on one rank, where they are solved; all others stay where they are.

    Args:
        config: the space whose displacement is restricted.
        equations: of this rank's contactors.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        mutual: equations of surfaces that are contactor and target of each other ``(m,)``.

    Attributes:
        equations: the independent ones.
        redundant: which of the given equations were left out because they depend on others ``(m,)``, known after ``forces``.
        found: whether any equation on any rank was contested.
    """

    def __init__(self, config: Configuration, equations: UnitingEquations, free: Bools, mutual: Bools):
        self.config, self.comm = config, config.comm
        self.redundant: Bools = np.zeros(len(equations), dtype=bool)
        contested = equations.active & (mutual | _hopeless(equations, free))
        counts = self.comm.allgather(int(contested.sum()))
        self.found = any(counts)
        self.equations = equations
        if not self.found:
            return
        contested = _with_neighbours(config, equations, contested)
        self._given, self._plain = len(equations), np.flatnonzero(~contested)
        self._home = int(np.argmax(counts))
        self._groups = self._solve(equations, contested, free)
        self.equations = self._take_home(equations.select(~contested), self._groups)

    def _solve(self, equations: UnitingEquations, contested: Bools, free: Bools) -> list[Group]:
        """Bring the contested equations together and solve them group by group."""
        config, comm = self.config, self.comm
        mine = equations.select(contested)
        origin = np.column_stack([np.full(len(mine), comm.rank), np.flatnonzero(contested)])
        parts = comm.gather((mine, config.to_global(mine.node), origin), root=self._home)
        empty = np.zeros(0, np.int64)
        node, groups = empty, []
        if parts is not None:
            rows = UnitingEquations.join([p[0] for p in parts], config.gdim)
            own, origin = np.concatenate([p[1] for p in parts]), np.concatenate([p[2] for p in parts])
            node, place = np.unique(np.concatenate([own, rows.followed]), return_inverse=True)
        movable = config.ask_owners(node, free.astype(float)) > 0
        if parts is None:
            return []
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        m, g = len(rows), config.gdim
        links = coo_matrix((np.ones(m + len(rows.row)), (np.concatenate([np.arange(m), rows.row]), place)), shape=(m, len(node)))
        _, label = connected_components(links @ links.T, directed=False)
        for k in range(label.max(initial=-1) + 1):
            which = np.flatnonzero(label == k)
            terms = np.flatnonzero(label[rows.row] == k)
            # the group's own columns
            columns, at = np.unique(np.concatenate([place[which], place[m + terms]]), return_inverse=True)
            at_row = np.searchsorted(which, rows.row[terms])
            A = np.zeros((len(which), len(columns), g))
            np.add.at(A, (np.arange(len(which)), at[: len(which)]), rows.direction[which])
            np.add.at(A, (at_row, at[len(which) :]), -rows.coefficients[terms])
            groups.append(_eliminate(A, -rows.gap[which], at[: len(which)], movable[columns], node[columns], origin[which]))
        return groups

    def _take_home(self, plain: UnitingEquations, groups: list[Group]) -> UnitingEquations:
        """Send every independent equation to the rank that owns the node it eliminates."""
        comm, config = self.comm, self.config
        outgoing: list[list[UnitingEquations]] = [[] for _ in range(comm.size)]
        self._sent: list[list[tuple[int, Ints]]] = [[] for _ in range(comm.size)]
        for k, group in enumerate(groups):
            owner = config.owner_of(group.independent.node)
            for r in np.unique(owner):
                outgoing[r].append(group.independent.select(owner == r))
                self._sent[r].append((k, np.flatnonzero(owner == r)))
        first = config.index_map.local_range[0]
        solved = [replace(p, node=(p.node - first).astype(np.int32)) for parts in comm.alltoall(outgoing) for p in parts]
        return UnitingEquations.join([plain, *solved], config.gdim)

    def forces(self, multipliers: Array) -> Array:
        """Contact forces of the given equations from those of the independent ones (collective).

        Args:
            multipliers: in the order of ``equations``.
        """
        if not self.found:
            return multipliers
        comm = self.comm
        given = np.zeros(self._given)
        n = len(self._plain)
        given[self._plain] = multipliers[:n]
        answers = comm.gather(multipliers[n:], root=self._home)
        back: list[list[tuple[Ints, Array, Bools]]] = [[] for _ in range(comm.size)]
        if answers is not None:
            mu = [np.zeros(len(group.independent)) for group in self._groups]
            for values, sent in zip(answers, self._sent):
                start = 0
                for k, rows in sent:
                    mu[k][rows] = values[start : start + len(rows)]
                    start += len(rows)
            for group, values in zip(self._groups, mu):
                lam = group.shares @ values
                for r in np.unique(group.origin[:, 0]):
                    here = group.origin[:, 0] == r
                    back[r].append((group.origin[here, 1], lam[here], group.redundant[here]))
        self.redundant[:] = False
        for places, lam, redundant in comm.scatter(back, root=self._home):
            given[places] = lam
            self.redundant[places] = redundant
        return given


def _hopeless(equations: UnitingEquations, free: Bools) -> Bools:
    """Active equations that cannot eliminate a component of their own node each ``(m,)``."""
    which = np.flatnonzero(equations.active)
    hopeless = np.zeros(len(equations), dtype=bool)
    order = which[np.argsort(equations.node[which], kind="stable")]
    _, first, counts = np.unique(equations.node[order], return_index=True, return_counts=True)
    for k in np.unique(counts):
        rows = order[first[counts == k][:, None] + np.arange(k)]
        A = equations.direction[rows] * free[equations.node[rows]]
        if k > A.shape[2]:
            hopeless[rows] = True
        else:
            hopeless[rows] = (np.linalg.svd(A, compute_uv=False)[:, -1] < MOSTLY_PRESCRIBED)[:, None]
    return hopeless


def _with_neighbours(config: Configuration, equations: UnitingEquations, contested: Bools) -> Bools:
    """Add the equations of all nodes that contested ones act on, until none is left (collective)."""
    contested = contested.copy()
    here = np.zeros(config.n_owned, dtype=bool)
    while True:
        rows = contested[equations.row]
        touched = np.unique(np.concatenate([equations.followed[rows], config.to_global(equations.node[contested])]))
        here[config.gather_owned(touched)] = True
        more = equations.active & ~contested & here[equations.node]
        contested |= more
        if not config.comm.allreduce(int(more.any())):
            return contested


def _eliminate(A: Array, h: Array, own: Ints, free: Bools, node: Ints, origin: Ints) -> Group:
    """Gauss-Jordan elimination of ``A du = h`` in the free components, one direction of one node after the other.

    Args:
        A: ``(m, n_nodes, gdim)``; every node has its own block of columns.
        h: ``(m,)``.
        own: column of each equation's contactor ``(m,)``.
        free: ``(n_nodes, gdim)``.
        node: global numbers ``(n_nodes,)``.
        origin: rank and place of each equation ``(m, 2)``.
    """
    m, _, g = A.shape
    given = (A * free).reshape(m, -1)
    A, h = A.copy(), h.copy()
    rest = np.ones(m, dtype=bool)
    start = np.maximum(np.linalg.norm(given, axis=1), MOSTLY_PRESCRIBED * np.linalg.norm(A.reshape(m, -1), axis=1))
    order: list[int] = []
    pivot, direction = np.zeros(m, np.int64), np.zeros((m, g))
    size = np.linalg.norm(A * free, axis=2)
    while rest.any():
        size[np.arange(m), own] *= OWN_FIRST
        i, t = np.unravel_index(np.argmax(np.where(rest[:, None], size, -1.0)), size.shape)
        if size[i, t] <= DEPENDENT * start[i]:
            break
        d = A[i, t] * free[t]
        length = np.linalg.norm(d)
        d /= length
        A[i], h[i] = A[i] / length, h[i] / length
        factor = A[:, t] @ d
        factor[i] = 0.0
        A -= factor[:, None, None] * A[i]
        h -= factor * h[i]
        pivot[i], direction[i] = t, d
        rest[i] = False
        order.append(int(i))
        size = np.linalg.norm(A * free, axis=2)
    k = np.array(order, dtype=np.int64)
    solved = (A[k] * free).reshape(len(k), -1)
    shares: Array = np.zeros((m, 0))
    if len(k):
        shares = np.asarray(np.linalg.lstsq(given.T, solved.T, rcond=None)[0])
    terms = A[k].copy()
    # what is left of the pivot's own block is across the eliminated direction, and followed like any other node
    terms[np.arange(len(k)), pivot[k]] -= direction[k]
    row, column = np.nonzero((np.abs(terms) > ROUNDING).any(axis=2))
    independent = UnitingEquations(
        node[pivot[k]], direction[k], -h[k], np.ones(len(k), bool), row, node[column], -terms[row, column]
    )
    return Group(origin, independent, shares, rest)
