"""The united matrix from its changes: the same as the whole products, while equations come, go and follow other nodes.

The test to read first is ``test_united_matrix_follows_its_equations``.
"""

from __future__ import annotations

import numpy as np
import pytest
from equation_scenes import CASES, Case, turned
from helpers import gathered_matrix
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.algebra.blocks import Entries
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.algebra.restriction import Restriction

EXACT = 1e-14


def unsymmetric(case: Case) -> PETSc.Mat:
    """A matrix with the pattern of K and numbers of no symmetry."""
    K = case.stiffness()
    indptr, columns, values = K.getValuesCSR()
    first = K.getOwnershipRange()[0]
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr)) + first
    K.setValuesCSR(indptr, columns, values * (1.0 + 0.3 * np.sin(rows + 2.0 * columns)))
    K.assemble()
    return K


def product(K: PETSc.Mat, P: Restriction, Q: Restriction) -> np.ndarray:
    """``Q'KP`` of dense matrices, and the diagonal of K in idle columns."""
    k, p, q = (gathered_matrix(A) for A in (K, P.P, Q.P))
    return q.T @ k @ p + np.diag(np.where(np.abs(p).max(axis=0) == 0, np.diag(k), 0.0))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("reserving", [False, True])
def test_united_matrix_follows_its_equations(name, reserving, monkeypatch):
    """Symmetric or not, P'KP and Q'KP are the dense products to rounding, and PETSc's PtAP, from one change to the next."""
    case = CASES[name]()
    if reserving:
        # as where PETSc does not tell where the entries of K are
        monkeypatch.setattr(compat, "arrays_of", lambda A: None)
    K, G = unsymmetric(case), case.stiffness()
    e, united, tested = case.equations, *(UnitedMatrix(case.config, reserving) for _ in range(2))
    some, none = e.active.copy(), np.zeros_like(e.active)
    some[::2] = False
    other = np.roll(e.followed, 1)
    chained = "chain" in name
    states = [(0.0, None, None), (0.0, some, None), (0.0, none, None), (0.0, None, None if chained else other), (0.0, None, None)]
    for angle, active, followed in states:
        P = turned(case, angle, active, followed)
        Q = P if chained else turned(case, angle + 0.1, active, followed)
        A, B = united.update(P, P, K, None), tested.update(P, Q, K, None)
        size = np.abs(product(K, P, P)).max()
        assert np.abs(gathered_matrix(A) - product(K, P, P)).max() <= EXACT * size
        assert np.abs(gathered_matrix(B) - product(K, P, Q)).max() <= EXACT * size
        whole = gathered_matrix(K.PtAP(P.P))
        idle = np.abs(gathered_matrix(P.P)).max(axis=0) == 0
        assert np.abs((gathered_matrix(A) - whole)[~idle]).max() <= EXACT * size
        C = tested.update(P, Q, K, G)
        K2 = K.copy()
        K2.axpy(1.0, G, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        expected = product(K2, P, Q) - np.diag(np.where(idle, np.diag(gathered_matrix(G)), 0.0))
        assert np.abs(gathered_matrix(C) - expected).max() <= 2 * EXACT * size


def test_matrix_stays_while_its_places_do():
    """K's values, directions and the active set come and go in one matrix; so do places that were there before."""
    case = CASES["hexahedra"]()
    K, e, united = case.stiffness(), case.equations, UnitedMatrix(case.config, False)
    some = e.active.copy()
    some[::2] = False
    first = united.update(*(turned(case, 0.0),) * 2, K, None)
    K.scale(2.0)
    P = turned(case, 0.3, some)
    second = united.update(P, P, K, None)
    assert second.handle == first.handle and second.getBlockSize() == K.getBlockSize()
    assert np.abs(gathered_matrix(second) - product(K, P, P)).max() <= EXACT * np.abs(gathered_matrix(K)).max()


@pytest.mark.parametrize("name", CASES)
def test_entries_are_found_where_they_are(name):
    """Of a matrix's places and others, those that it has are found, with their values, on any number of ranks."""
    K = CASES[name]().stiffness()
    entries, (first, last) = Entries.as_in(K), K.getOwnershipRange()
    K.copy(entries.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    indptr, columns, values = K.getValuesCSR()
    known = np.zeros((last - first, K.getSize()[0]), dtype=bool)
    expected = np.zeros(known.shape)
    rows = np.repeat(np.arange(last - first), np.diff(indptr))
    known[rows, columns], expected[rows, columns] = True, values
    row, column = (a.ravel() for a in np.indices(known.shape))
    places, there = entries.find(np.where((column >= first) & (column < last), row, row + last - first), column)
    assert np.array_equal(there.reshape(known.shape), known)
    assert np.array_equal(entries.values[places[there]], expected[known])
    within = Entries.within(K)
    assert within is None or K.comm.size == 1
    if within is not None:
        K.scale(2.0)
        assert np.array_equal(within.values[places[there]], 2.0 * expected[known])
