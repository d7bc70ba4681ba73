"""Equations of joints and energies of springs by the motions z of all rigid sets that they connect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.joints import Joint, Link
from uem_dolfinx.conditions.relations import Relation
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_set import Placement, RigidSets
from uem_dolfinx.errors import ConflictError

#: Newton's method closes joints in so many steps; where it does not, the united system continues. [bound; steps; -]
MOST_CLOSINGS = 12


class Linked:
    """Joints, springs and relations, all of whose ends are among the couplings, with a common vector of motions."""

    def __init__(self, couplings: Sequence[RigidCoupling], links: Sequence[Link | Relation], sets: RigidSets):
        self._couplings, self._links, self._sets = couplings, [one for one in links if isinstance(one, Link)], sets
        self._relations = [one for one in links if isinstance(one, Relation)]
        #: All that have equations, relations first.
        self.joints: list[Joint | Relation] = [*self._relations, *(one for one in self._links if isinstance(one, Joint))]
        self.springy = any(one.stiffness for one in self._links)
        #: Number of relations, and mask of the values of all rows that are ramped with the Dirichlet values ``(k,)``.
        self.n_relations, n_rows = len(self._relations), sum(one.n_rows for one in self.joints)
        self.ramped = np.append([one.ramped for one in self._relations], np.zeros(n_rows - self.n_relations)).astype(bool)

    def values(self) -> Array:
        """Present values of all rows ``(k,)``, 0 of joints (collective)."""
        return np.append([one.wanted for one in self._relations], np.zeros(len(self.ramped) - self.n_relations))

    def values_at(self, places: Sequence[Placement]) -> Array:
        """Values of the rows in placements of each set ``(k,)``, 0 of joints."""
        at = self._places(places)
        return np.append([one.value_at(at) for one in self._relations], np.zeros(len(self.ramped) - self.n_relations))

    def _places(self, places: Sequence[Placement]) -> dict[int, Placement]:
        return {id(one): place for one, place in zip(self._couplings, places)}

    def rows(self, places: Sequence[Placement]) -> tuple[Array, Array, Array]:
        """Rows of joints ``(k, n_z)``, their values ``(k,)``, and second derivatives ``(k, n_z, n_z)``, 0 with small rotations."""
        n, at = len(self._sets.scale), self._places(places)
        found = [(joint, one) for joint in self.joints for one in joint.rows(at)]
        C = np.array([self._by_motions(joint, one.slope) for joint, one in found]).reshape(-1, n)
        value = np.array([one.value for _, one in found], dtype=float)
        if not self._sets.large:
            return C, 0.0 * value, np.zeros((len(C), n, n))
        return C, value, np.array([self._by_motions(joint, one.bend) for joint, one in found]).reshape(-1, n, n)

    def _by_motions(self, link: Link | Relation, array: Array) -> Array:
        """A slope ``(12,)`` or second derivatives ``(12, 12)`` of a link by the motions of its ends, by all motions z."""
        out = np.zeros([len(self._sets.scale)] * array.ndim)
        ends = [(self._sets[self._index(one)], columns) for one, columns in link.columns()]
        for to, columns in ends:
            if array.ndim == 1:
                out[to] = array[columns]
            for other, others in ends if array.ndim == 2 else ():
                out[to, other] = array[columns][:, others]
        return out

    def _index(self, coupling: RigidCoupling) -> int:
        return next(i for i, one in enumerate(self._couplings) if one is coupling)

    def closed(self, places: Sequence[Placement], wanted: Array, kept: Ints, firm: Array) -> list[Placement]:
        """The nearest placements in which joints are closed, by Newton's method, with finite rotations.

        Args:
            places: of each set.
            wanted: values of the rows ``(k,)``.
            kept: rows that do not depend on others ``(n_kept,)``.
            firm: rows of scaled motions that do not change ``(k, n_z)``.
        """
        best, now, least, scale = list(places), list(places), np.inf, self._sets.scale
        _, size, axes = np.linalg.svd(firm)
        open_ = axes[np.count_nonzero(size > MOSTLY_PRESCRIBED) :].T
        for _ in range(MOST_CLOSINGS):
            C, value, _ = self.rows(now)
            C, off = C[kept], (value - wanted)[kept]
            miss = float(np.abs(off).max(initial=0.0))
            if not miss < least:
                break
            best, least = now, miss
            dz = scale * (open_ @ np.linalg.lstsq(C * scale @ open_, -off, rcond=MOSTLY_PRESCRIBED)[0])
            now = [at.moved(dz[self._sets[i]]) for i, at in enumerate(now)]
        return best

    def stiffness(self, places: Sequence[Placement]) -> tuple[Array, Array]:
        """Material and geometric stiffness of all springs by the motions z, both ``(n_z, n_z)`` (collective)."""
        n, at = len(self._sets.scale), self._places(places)
        material, geometric = np.zeros((2, n, n))
        for link in self._links if self.springy else ():
            _, _, first, second = link.stored(at, link.small_motions())
            material += self._by_motions(link, first)
            geometric += self._by_motions(link, second)
        return material, geometric

    def check(self, off: Array, bound: float) -> None:
        """ConflictError for the first joint whose equations leave distances ``(k,)`` larger than a bound, as others contradict them."""
        first = 0
        for joint in self.joints:
            own = off[first : first + joint.n_rows]
            first += joint.n_rows
            if (own > bound).any():
                raise ConflictError(
                    f"{joint.described}: missed by {own.max():.4g}, as no motion satisfies it together with the other joints, equations "
                    "and prescribed values; give values that agree, or leave one of them out"
                )

    def read(self, places: Sequence[Placement], multipliers: Array) -> None:
        """End a step with the multipliers of the rows ``(k,)`` (collective)."""
        at, first = self._places(places), 0
        for joint in self.joints:
            joint.read(at, multipliers[first : first + joint.n_rows])
            first += joint.n_rows
