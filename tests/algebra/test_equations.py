"""What counts as a part of an equation, and what as its rounding."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from equation_scenes import triangles, united

import uem_dolfinx as uem
from uem_dolfinx.algebra.dependent import _solve
from uem_dolfinx.algebra.equations import UnitingEquations


@pytest.mark.parametrize("part, enough", [(3e-7, False), (3e-6, True)])
def test_what_a_condition_leaves_of_a_normal(part, enough):
    """An equation can eliminate the free component of its node if its direction has some of it."""
    rows = [(0, [np.sqrt(1 - part**2), part], 3)]
    if enough:
        assert united(triangles(2), rows, fixed=[(0, 0)]).chain == 1
    else:
        with pytest.raises(uem.ConflictError, match="nothing is left to eliminate"):
            united(triangles(2), rows, fixed=[(0, 0)])


@pytest.mark.parametrize("size, rounding", [(3e-13, True), (3e-12, False)])
def test_coefficients_that_are_rounding(size, rounding):
    """They neither close a ring of equations nor make a new P."""
    ring = [(0, [0.0, 1.0], 3), (3, [0.0, 1.0], 0)]
    r = united(triangles(2), ring, coefficient=size)
    assert r.chain == (1 if rounding else 2) and r.fades != rounding
    prints = {united(triangles(2), ring[:1], coefficient=c).fingerprint(values=True) for c in (0.5, 0.5 + size)}
    assert len(prints) == (1 if rounding else 2)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize(("past", "left_out"), [(2e-7, 1), (1e-8, 1), (-6e-7, 0)])
def test_rows_past_an_end_are_left_out_first(past, left_out, size):
    """Two corners that meet: one lies on the other's facet, the other past its end by ``past`` of it or before it.

    Both equations nearly say the same; the one of the corner on a facet is kept, the other left out. Elsewhere the first is.
    """
    a, b = np.array([-0.227, 0.974]), np.array([0.2270002, -0.9739998])
    normals = np.array([a / np.linalg.norm(a), b / np.linalg.norm(b)])
    # nodes 0 and 1 are the corners, 2 and 3 the other ends of their facets
    followed = np.array([1, 3, 0, 2])
    weights = np.array([1.0 - 3e-7, 3e-7, 1.0 + past, -past])
    equations = UnitingEquations(
        node=np.array([0, 1], dtype=np.int32), direction=normals, gap=size * np.array([1e-6, 0.0]), active=np.ones(2, bool),
        row=np.array([0, 0, 1, 1]), followed=followed, coefficients=weights[:, None] * normals[[0, 0, 1, 1]],
    )  # fmt: skip
    space = SimpleNamespace(block=2, ask_owners=lambda node, values: values[node])
    (group,) = _solve(space, equations, np.ones((4, 2), bool), *np.zeros((3, 2), bool))
    assert list(group.redundant) == [left_out == 0, left_out == 1]
