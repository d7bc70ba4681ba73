"""Closure of constraint equations that follow each other in rings: pure algebra, for equations of any origin.

Of three bodies that meet in a point, each may be the target of the next, so that every equation contains a component that another one
eliminates. Equations ``A du = C du - gap`` that eliminate ``L``, with ``A L = 1``, follow each other by ``M = C L``. The equations of one
ring, strongly connected by M, are solved for their eliminated components,

    A du = W C (1 - L A) du - W gap,    W = (1 - M)^-1

and then no longer follow each other. Forces of the given equations are ``W'`` times the forces of the closed ones. If W is large, the
equations depend on each other and must be made independent first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, NEGLIGIBLE, UnitingEquations, send
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import agree, gathered, reduced

#: Parts of a unit displacement below it are rounding.
#: [derived; directions of length one; test_restriction.py::test_rings_that_fade]
FADED = np.finfo(float).eps
#: Closed equations of a ring are found for so many nodes that they follow at a time. [bound; number of nodes; -]
NODES_TOGETHER = 256


class DependentRingError(ConflictError):
    """Equations that follow each other in a ring and depend on each other: ``rows (m,)`` masks them on this rank."""

    rows: Bools


def components(comm: MPI.Comm, links: Ints, mine: Ints, strong: bool) -> tuple[Ints, Ints]:
    """Connected components of a distributed graph, and a rank for each (collective).

    Args:
        comm: communicator.
        links: edges of this rank, pairs of numbers ``(k, 2)`` from the first to the second.
        mine: numbers owned by this rank ``(m,)``; a component is assigned to the rank that owns most of it.
        strong: whether components are strongly connected.

    Returns:
        The component of each of ``mine``, -1 for numbers without edges, and the ranks of all components.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = np.concatenate(comm.allgather(links))
    known, place = np.unique(links, return_inverse=True)
    tail, head = place.reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(tail)), (tail, head)), shape=(len(known),) * 2)
    count, label = connected_components(graph, directed=strong, connection="strong")
    at = np.minimum(np.searchsorted(known, mine), len(known) - 1)
    here = np.where(known[at] == mine, label[at], -1) if len(known) else np.full(len(mine), -1)
    found = gathered(comm, np.bincount(here[here >= 0], minlength=count))
    return here.astype(np.int64), np.argmax(found, axis=0)


def in_rings(parts: PETSc.Mat) -> tuple[Ints, Ints]:
    """The ring of each of this rank's equations ``(m,)``, -1 if in no ring, and the rank that closes each ring (collective).

    Args:
        parts: magnitudes of the coefficients with which equations (rows) follow others (columns) ``(m, m)``.
    """
    comm, (first, end) = parts.comm.tompi4py(), parts.getOwnershipRange()
    follows = parts.copy()
    indptr, columns, values = parts.getValuesCSR()
    follows.setValuesCSR(indptr, columns, (values > NEGLIGIBLE).astype(float))
    follows.assemble()
    core = follows.createVecRight()
    core.set(1.0)
    left, before = core.sum(), np.inf
    # equations that follow no other remaining one, or that no other remaining one follows, are in no ring
    while 0.0 < left < before:
        ways = (follows * core).array_r * core.array_r
        core.array[:] = ways > 0
        back = follows.createVecRight()
        follows.multTranspose(core, back)
        core.array[:] = back.array_r * core.array_r > 0
        left, before = core.sum(), left
    follows.diagonalScale(core, core)
    indptr, columns, values = follows.getValuesCSR()
    row = np.repeat(np.arange(first, end), np.diff(indptr))
    links = np.stack([row, columns], axis=1).astype(np.int64)[values > 0]
    label, rank = components(comm, links, np.arange(first, end), strong=True)
    many = np.bincount(label[label >= 0], minlength=len(rank))
    alone = np.bincount(label[links[links[:, 0] == links[:, 1], 0] - first], minlength=len(rank))
    ring = (reduced(comm, many) > 1) | (reduced(comm, alone) > 0)
    return np.where(label >= 0, np.where(ring, np.cumsum(ring) - 1, -1)[label], -1), rank[ring]


@dataclass(frozen=True)
class _Closed:
    """One ring on the rank that closes it: its equations' numbers there, the factorised ``1 - M``, and the closed equations."""

    rows: Ints
    factor: Any
    equations: UnitingEquations


class Rings:
    """Closed equations in place of equations that follow each other in rings (collective).

    Args:
        space: the nodes whose components are restricted.
        equations: of this rank.
        lift: action of each equation on its node ``(m, block)``.
        parts: magnitudes of the coefficients with which equations (rows) follow others (columns) ``(m, m)``.

    Raises:
        DependentRingError: if equations of a ring depend on each other.
    """

    def __init__(self, space: Nodes, equations: UnitingEquations, lift: Array, parts: PETSc.Mat):
        label, rank = in_rings(parts)
        self._mine = np.flatnonzero(label >= 0)
        held = equations.select(label >= 0)
        held = replace(held, node=space.to_global(held.node))
        there, self._exchange = send(space.comm, held, rank[label[self._mine]])
        lift, label, place = self._exchange.send(lift[self._mine], label[self._mine], self._mine)
        rows = [np.flatnonzero(label == k) for k in np.unique(label)]
        closed = [_close(there, lift, own) for own in rows]
        self._check(space, equations, np.isin(label, [label[own[0]] for own, ring in zip(rows, closed) if ring is None]))
        self._rings = [ring for ring in closed if ring is not None]
        order = np.concatenate([np.zeros(0, np.int64), *(ring.rows for ring in self._rings)])
        solved = UnitingEquations.join([ring.equations for ring in self._rings], space.block)
        solved, back = send(space.comm, solved, self._exchange.origins[order])
        (at,) = back.send(place[order])
        self.equations = _replaced(equations, solved, at)  # in the order of the given ones

    def _check(self, space: Nodes, equations: UnitingEquations, bad: Bools) -> None:
        """Raise if any equations on any rank are in rings that could not be closed (collective)."""
        dependent, error = np.zeros(len(equations), dtype=bool), None
        (dependent[self._mine[self._exchange.rows]],) = self._exchange.back(bad)
        if dependent.any():
            node = int(equations.node[np.argmax(dependent)])
            error = DependentRingError(
                f"the contactor at {space.describe(node)} follows itself through its targets: surfaces are contactors and targets of "
                "each other in a ring; drop one of the contacts"
            )
        try:
            agree(space.comm, error)
        except DependentRingError as ring:
            ring.rows = dependent
            raise

    def forces(self, multipliers: Array, back: bool = False) -> Array:
        """Forces of the given equations ``(m,)`` from the forces of the closed ones, or the transpose of this map (collective)."""
        (mu,) = self._exchange.send(multipliers[self._mine])
        lam = np.zeros(len(mu))
        for ring in self._rings:
            lam[ring.rows] = ring.factor.solve(mu[ring.rows], "N" if back else "T")
        given = multipliers.copy()
        (given[self._mine[self._exchange.rows]],) = self._exchange.back(lam)
        return given


def _close(there: UnitingEquations, lift: Array, rows: Ints) -> _Closed | None:
    """Close a ring of equations ``rows`` of global nodes; None if they depend on each other."""
    from scipy.sparse import csr_matrix, identity
    from scipy.sparse.linalg import LinearOperator, onenormest, splu

    which = np.zeros(len(there), dtype=bool)
    which[rows] = True
    eq, m, g = there.select(which), len(rows), there.direction.shape[1]
    nodes, at = np.unique(np.concatenate([eq.node, eq.followed]), return_inverse=True)

    def matrix(row: Ints, node: Ints, values: Array) -> Any:
        columns = node[:, None] * g + np.arange(g)
        return csr_matrix((values.ravel(), (np.repeat(row, g), columns.ravel())), shape=(m, len(nodes) * g))

    own = np.arange(m), at[:m]
    C, A, L = matrix(eq.row, at[m:], eq.coefficients), matrix(*own, eq.direction), matrix(*own, lift[rows])
    M = C @ L.T
    try:
        factor = splu((identity(m) - M).tocsc())
    except RuntimeError:
        # 1 - M is singular to the last bit
        return None
    inverse = LinearOperator(
        (m, m), matvec=factor.solve, rmatvec=lambda v: factor.solve(v, "T"), matmat=factor.solve, dtype=float
    )
    if not onenormest(inverse) <= 1.0 / MOSTLY_PRESCRIBED:
        return None
    B = (C - M @ A).tocsc()
    used = np.unique(np.flatnonzero(np.diff(B.indptr)) // g)
    terms: list[tuple[Ints, Ints, Array]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, g)))]
    for some in np.split(used, np.arange(NODES_TOGETHER, len(used), NODES_TOGETHER)):
        X = factor.solve(B[:, (some[:, None] * g + np.arange(g)).ravel()].toarray()).reshape(m, len(some), g)
        row, column = np.nonzero((np.abs(X) > FADED).any(axis=2))
        terms.append((row, nodes[some[column]], X[row, column]))
    row, followed, coefficients = (np.concatenate(parts) for parts in zip(*terms))
    return _Closed(rows, factor, replace(eq, gap=factor.solve(eq.gap), row=row, followed=followed, coefficients=coefficients))


def _replaced(equations: UnitingEquations, solved: UnitingEquations, at: Ints) -> UnitingEquations:
    """The equations with those at positions ``at (k,)`` replaced by others of the same components."""
    gap, stays = equations.gap.copy(), np.ones(len(equations), dtype=bool)
    gap[at], stays[at] = solved.gap, False
    terms = stays[equations.row]
    return replace(
        equations,
        gap=gap,
        row=np.concatenate([equations.row[terms], at[solved.row]]),
        followed=np.concatenate([equations.followed[terms], solved.followed]),
        coefficients=np.concatenate([equations.coefficients[terms], solved.coefficients]),
    )
