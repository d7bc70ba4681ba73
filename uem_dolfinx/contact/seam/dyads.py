"""Matrices ``sum_i scale_i v_i w_i'`` of linear functions of the unknowns, one for each contactor, in blocks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Ints


class Terms(NamedTuple):
    """Terms of linear functions of the unknowns, one function per contactor.

    Attributes:
        row: index of the contactor ``(k,)``.
        node: global row of vectors ``(k,)``.
        vector: coefficients of the components there ``(k, gdim)``.
    """

    row: Ints
    node: Ints
    vector: Array


def dyads(scale: Array, left: Terms, right: Terms) -> tuple[Ints, Array]:
    """``sum_i scale_i v_i w_i'`` of linear functions v and w of contactors.

    Returns:
        Global rows ``(k, m)``, -1 for no row, and blocks ``(k, m gdim, m gdim)``.
    """
    rows, which, v, w = grouped(scale, left, right)
    return rows, scale[which, None, None] * v[:, :, None] * w[:, None, :]


def grouped(scale: Array, left: Terms, right: Terms) -> tuple[Ints, Ints, Array, Array]:
    """Global rows of the contactors with a ``scale (n,)`` other than 0 ``(k, m)``, their indices, and v and w there ``(k, m gdim)``."""
    sides = (left,) if right is left else (left, right)
    row, node, vectors = (np.concatenate(parts) for parts in zip(*sides))
    some = np.flatnonzero(scale[row] != 0.0)
    # group the terms of each contactor
    order = some[np.argsort(row[some], kind="stable")]
    which, first, i = np.unique(row[order], return_index=True, return_inverse=True)
    place = np.arange(len(order)) - first[i]
    rows = np.full((len(which), int(place.max(initial=-1)) + 1), -1, dtype=np.int64)
    rows[i, place] = node[order]
    of_left, g = order < len(left.row), vectors.shape[1]
    both = np.zeros((2, *rows.shape, g))
    both[0, i, place], both[1, i, place] = (vectors[order] * own[:, None] for own in (of_left, of_left == (right is left)))
    v, w = both.reshape(2, len(which), rows.shape[1] * g)
    return rows, which, v, w
