"""Matrices of some nodes alone: the rows and columns of the whole, under numbers that lead back to it."""

from __future__ import annotations

import numpy as np
import pytest
from equation_scenes import CASES
from helpers import gathered_matrix

from uem_dolfinx.algebra.parts import Part


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("every", [1, 3])
def test_part_of_a_matrix(name, every):
    """Of every third node, and of all: the entries between them, at columns that are told and recognised on any number of ranks."""
    case = CASES[name]()
    config, K = case.config, case.stiffness()
    g, n = config.gdim, config.n_owned
    chosen = config.to_global(np.arange(n)) % every == 0
    part, first = Part(config, chosen), K.getOwnershipRange()[0]
    whole = np.concatenate(config.comm.allgather(part.components + first))
    assert part.sizes == ((g * chosen.sum(), len(whole)),) * 2
    A = part.of(K)
    assert np.array_equal(gathered_matrix(A), gathered_matrix(K)[np.ix_(whole, whole)])
    columns = A.getValuesCSR()[1]
    assert np.array_equal(part.in_whole(columns), whole[columns])
    asked = K.getValuesCSR()[1]
    assert np.array_equal(part.has(asked), np.isin(asked, whole))
