"""Reference sizes and rounding of residuals of other fields, from the terms of their own equations.

Fields have different units, and equations such as incompressibility have no reactions. So residuals of fields other than the displacement
are compared with the terms ``K_ij w_j`` of their rows of K. Constants in a row count as one sum, deviations from the mean term by term, so
that neither a rigid translation nor a temperature far from zero makes an equation seem solved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.solve.bodies.tangent import Tangent

if TYPE_CHECKING:
    from uem_dolfinx.geometry.fields import Unknowns

#: A norm of forces; in mixed problems one for each field, with the displacement's first ``(n_fields,)``.
Norm: TypeAlias = float | Array


def first(norm: Norm) -> float:
    """The displacement's part of a norm."""
    return float(np.ravel(norm)[0])


def ratio(norm: Norm, scale: Norm) -> float:
    """The largest ratio of a norm to a scale over all fields; 0 for a zero scale."""
    return float(np.max(np.divide(norm, scale, out=np.zeros(np.shape(norm)), where=np.asarray(scale) > 0)))


def worst(norm: Norm, rounding: Norm, real: Norm) -> tuple[float, float, float]:
    """Residual, rounding and forces of the field with the largest residual relative to its forces."""
    every = [np.atleast_1d(a) for a in np.broadcast_arrays(norm, rounding, real)]
    k = int(np.argmax(every[0] / np.where(every[2] > 0.0, every[2], np.inf)))
    return float(every[0][k]), float(every[1][k]), float(every[2][k])


def driving(bodies: Any, test: Restriction, rhs: PETSc.Vec, du: PETSc.Vec) -> float:
    """Norm of the forces that drive the displacement: right-hand side, and forces of increments of other fields (collective).

    Where only another field changes, as a temperature in equilibrium, the right-hand side of the displacement vanishes.

    Args:
        bodies: ``Bodies`` with the tangent of the linearised problem.
        test: Q.
        rhs: of the linearised problem.
        du: its solution.
    """
    unknowns = bodies.unknowns
    own = first(unknowns.norms(rhs))
    if not unknowns.mixed:
        return own
    others = du.copy()
    others.array[unknowns.field == 0] = 0.0
    return max(own, first(unknowns.norms(test.transpose(forms.product(bodies.tangent.K, others)))))


class FieldScales:
    """Sizes of the terms in the equations of a mixed problem, from a tangent that is not yet assembled (collective)."""

    def __init__(self, unknowns: Unknowns, tangent: Tangent):
        self._unknowns, self._tangent = unknowns, tangent
        g = unknowns.block
        indptr, columns, _ = tangent.K.getValuesCSR()
        nodes, place = np.unique(columns // g, return_inverse=True)
        self._halo = Halo(unknowns, nodes.astype(np.int64))
        #: Column of each entry among the fetched components, and its local row.
        column, row = place * g + columns % g, np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        field, kind = (self._halo.take(a.reshape(-1, g).__getitem__).ravel() for a in (unknowns.field, unknowns.kind))
        #: Entries in equations of other fields, and entries of other fields in equations of the displacement.
        self._which: Ints = np.flatnonzero(((unknowns.field[row] > 0) | (field[column] > 0)) & (field[column] >= 0))
        self._row, self._column = row[self._which], column[self._which]
        self._by_displacement = field[self._column] == 0
        kinds = int(unknowns.kind.max(initial=0)) + 1
        #: Entries of one row in columns of one component, which are averaged.
        self._group: Ints = self._row * kinds + kind[self._column]
        self._kinds = kinds
        self._values, self._number = np.zeros(0), -1

    def _known(self) -> tuple[Array, Array]:
        """Values of the entries, and of the unknowns in their columns, ``(k,)`` each (collective)."""
        if self._number != self._tangent.number:
            self._values, self._number = self._tangent.K.getValuesCSR()[2][self._which], self._tangent.number
        config = self._unknowns.config
        rows = config.rows(config.whole.x.array[: len(self._unknowns.place)])
        return self._values, self._halo.take(rows.__getitem__).ravel()[self._column]

    def terms(self) -> Array:
        """Norm of the terms in the equations of each field, zero for the displacement ``(n_fields,)`` (collective)."""
        K, w = self._known()
        weight, size = np.abs(K), len(self._unknowns.field) * self._kinds
        total, sums, weighted = (np.bincount(self._group, a, size) for a in (weight, K, weight * w))
        mean = weighted / np.where(total > 0.0, total, 1.0)
        apart = np.bincount(self._row, weight * np.abs(w - mean[self._group]), size // self._kinds)
        return self._of_others(np.asarray(apart + np.abs(sums * mean).reshape(-1, self._kinds).sum(axis=1)))

    def _of_others(self, each: Array) -> Array:
        norms = self._unknowns.norms_of(each)
        norms[0] = 0.0
        return norms

    def _largest(self) -> Array:
        """Sum of the terms' sizes in every equation ``(n_rows * gdim,)``; in the displacement's only terms of other fields."""
        K, w = self._known()
        return np.asarray(np.bincount(self._row, np.abs(K * w), len(self._unknowns.field)), dtype=float)

    def largest(self) -> Array:
        """Norm of the sums of the terms' sizes in the equations of each field ``(n_fields,)`` (collective)."""
        return self._unknowns.norms_of(self._largest())

    def strain_rounding(self, size: float) -> Array:
        """Norm of residuals due to rounding of ``1 + grad(u)`` in the equations of each field, zero for the displacement ``(n_fields,)``.

        Equations such as ``det(1 + grad(u)) = 1`` have this residual for any small u. Collective; ``size`` is the model's, a length.
        """
        K, _ = self._known()
        of_displacement = np.where(self._by_displacement, np.abs(K), 0.0)
        each = np.bincount(self._row, np.finfo(float).eps * size * of_displacement, len(self._unknowns.field))
        return self._of_others(np.asarray(each, dtype=float))

    def above(self, F: Array, part: float) -> Array:
        """Norm of the residual ``F (n_rows * gdim,)`` where it exceeds a part of the terms, zero for the displacement (collective)."""
        return self._of_others(np.where(np.abs(F) > part * self._largest(), F, 0.0))
