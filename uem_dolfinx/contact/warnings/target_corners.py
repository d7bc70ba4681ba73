"""Detect and warn of convex target corners that penetrate contactor facets, which node-to-surface contact does not prevent.

Between two contactors, no condition keeps a target corner out of the facet. Its depth times the stiffness of both bodies there
estimates the missing force. The ratio of this force to the contact force measures the error, independent of the load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_rows
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import label_of
from uem_dolfinx.contact.warnings.checks import CONFORMING, facet_curvatures
from uem_dolfinx.errors import OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, facets_of, nodes_of_facets
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget, nearest_of
from uem_dolfinx.geometry.sharp import CORNER, sharp_nodes
from uem_dolfinx.geometry.surfaces import followed_nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import reduced

#: Corners that penetrate a facet by less than this part of its size lie on the facet, as Newton's method is no more accurate.
#: [bound; size of the facet; test_target_corners.py::test_what_a_warning_of_corners_contains]
ON_FACET = 1e-8
#: A warning is given if the missing force of corners exceeds this part of the contact force: resultants are wrong by one per cent or more.
#: [convention; largest contact force so far; test_target_corners.py::test_what_a_warning_of_corners_contains]
LACKING = 0.1
#: Vertices of a target that its contactor conforms to, but which are no corners, are named if more than this part is missing: a contactor
#: coarser than a round target lacks a fifth.
#: [convention; largest contact force so far; test_target_corners.py::test_a_polygon_that_turns_in_its_hole]
LACKING_AT_VERTICES = 1.0
#: Corners whose depths differ by less than this part are equally deep, as solutions are no more accurate.
#: [bound; depth of a corner; -]
EQUALLY_DEEP = 1e-6


@dataclass(frozen=True)
class CornerInside:
    """Corners of a target that penetrate the contactors' surface."""

    place: str  # reference position of the corner that is deepest relative to its facet, as text
    depth: float  # of this corner, a length
    part: float  # depth over the size of the facet
    lacking: float  # missing force of all corners over the largest contact force so far
    #: whether contactors at corners or ends of their own surface are in contact, too; swapping the surfaces is then no remedy.
    both: bool = False
    round: bool = False  # whether they are vertices of a round target, which ``corners = True`` does not hold

    def __str__(self) -> str:
        remedy = "take corners = True, or take coupling = 'mortar', as the contactor has corners in contact, too"
        if not self.both:
            remedy = f"{'' if self.round else 'take corners = True, '}swap the two, or take coupling = 'mortar'"
        return (
            f"a convex corner of the target, at {self.place}, is {self.depth:.3g} inside a facet of the contactor, "
            f"{100 * self.part:.2g} % of its size, between contactors, where no condition prevents it: {remedy}"
        )


class TargetCorners:
    """Convex corners of targets, and the contactors' surfaces, with ``tags``, that they may penetrate (collective)."""

    def __init__(self, pairs: Sequence[Interface], tags: Sequence[Tag]):
        self.pairs, self.whole = pairs, pairs[0].whole
        config = self._config = self.whole.config
        known: dict[Any, Indices] = {}
        own, corners = [], []
        for pair, conforms in zip(pairs, conforming(self.whole)):
            nodes = corner = np.zeros(0, np.int32)
            if isinstance(target := pair.target, MeshTarget):
                if id(target.facets) not in known:
                    known[id(target.facets)] = corner_nodes(config, target.facets)
                nodes = corner = known[id(target.facets)]
                if conforms:
                    nodes = np.union1d(corner, corner_nodes(config, target.facets, 1.0 - EQUALLY_DEEP)).astype(np.int32)
            own.append(nodes)
            corners.append(np.isin(nodes, corner))
        #: Owned nodes of the targets at corners and ends, or at vertices of those that contactors conform to ``(k,)``, which are corners
        #: or ends, the contacts, and which contacts have such nodes on any rank.
        self.nodes, self._sharp = np.concatenate(own), np.concatenate(corners)
        self.label: Ints = np.repeat(np.arange(len(pairs)), [len(nodes) for nodes in own])
        self.some: Bools = np.asarray(reduced(config.comm, np.bincount(self.label, minlength=len(pairs))) > 0)
        n = len(pairs)
        #: The largest contact force so far, and sizes of the largest and of the smallest facet of each contact, lengths ``(n_pairs,)``.
        self.largest, self.reach, self.smallest = np.zeros(n), np.zeros(n), np.full(n, np.inf)
        self._tags = tags
        sizes: dict[Any, tuple[float, float]] = {}
        for k, tag in enumerate(tags):
            if self.some[k] and id(tag) not in sizes:
                x = config.x[nodes_of_facets(config, tag).dofs]
                sides = np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
                sizes[id(tag)] = np.ptp(x, axis=1).max(initial=0.0), sides.min(initial=np.inf)
            if self.some[k]:
                self.reach[k], self.smallest[k] = sizes[id(tag)]
        self.reach, lowest = reduced(config.comm, np.stack([self.reach, -self.smallest]), op=MPI.MAX)
        self.smallest = -lowest

    @cached_property
    def surface(self) -> tuple[Any, Ints]:
        """Surfaces of the contactors, and which of these each contact has ``(n_pairs,)``; -1 inside a body (first time: collective).

        A surface inside a body has no outer side from which a corner could enter.
        """
        found: dict[Any, TargetFacets | None] = {}
        for tag in (tag for tag, some in zip(self._tags, self.some) if some and id(tag) not in found):
            try:
                found[id(tag)] = facets_of(self._config, tag, "contactor")
            except OrientationError:
                found[id(tag)] = None
        place = {key: k for k, key in enumerate(key for key, facets in found.items() if facets is not None)}
        of_contact = np.array([place.get(id(tag), -1) for tag in self._tags])
        surfaces = [facets for facets in found.values() if facets is not None]
        if not surfaces:
            return None, of_contact
        from uem_dolfinx.geometry.joined import JoinedFacets, JoinedTarget

        return JoinedTarget(JoinedFacets(self._config, surfaces), False, of_contact), of_contact

    @timed_as("corners of the target")
    def find(self, stiffness: Array, checked: Bools) -> dict[int, CornerInside]:
        """Penetrating corners in the current configuration, by number of the contact, for contacts in which they matter (collective).

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, a force per length.
            checked: contacts to be checked ``(n_pairs,)``.
        """
        whole, config, comm, n = self.whole, self._config, self._config.comm, len(self.pairs)
        checked = checked & self.some & ~whole.discretisation.setting.mutual
        if not checked.any():
            return {}
        i = self._near(checked)
        near, label, sharp = self.nodes[i], self.label[i], self._sharp[i]
        pressing = sums_of_rows(label_of(whole), whole.trial.lam[:, None], n)[:, 0]
        some, force = reduced(comm, np.stack([np.bincount(label, minlength=n), pressing]))
        # separating bodies have small forces, so that the largest so far counts
        self.largest[checked] = np.maximum(force, self.largest)[checked]
        if not some.any():
            return {}
        # a corner near a contactor is no deeper than its distance from it
        least = ON_FACET * float(self.smallest[checked].min())
        away = 4.0 * config.size * np.arange(1, n + 1)
        places, points = (np.column_stack([x, away[k]]) for x, k in ((config.x[near], label), (whole.points, label_of(whole))))
        distance, _ = nearest_of(comm, places, points, least, np.zeros((len(points), 1)))
        near, label, sharp = near[distance > least], label[distance > least], sharp[distance > least]
        if not reduced(comm, len(near)):
            return {}
        surface, of_contact = self.surface
        outside = of_contact[label] >= 0
        near, label, sharp = near[outside], label[outside], sharp[outside]
        if surface is None:
            return {}
        p = surface.project_onto(config.x[near], of_contact[label])
        depth, part = -p.gap, -p.gap / p.facet_size
        inside = (part > ON_FACET) & (p.from_end > 0.0) & (p.beyond == 0.0).all(axis=1)
        # a corner deeper than the cell behind the facet may have left the body at its back, but not without any force
        inside &= (depth < surface.of_facets(p.facet, surface.facets.depth)) | (self.largest == 0.0)[label]
        if not reduced(comm, int(inside.sum())):
            return {}
        stiffness = np.abs(stiffness)
        of_facet = config.ask_owners(p.nodes.ravel(), stiffness).reshape(*p.nodes.shape, config.gdim)
        theirs = np.einsum("na,nag,ng->n", p.weights, of_facet, p.normal**2)
        own = np.einsum("ng,ng->n", stiffness[near], p.normal**2)
        both = np.where(inside, theirs * own / np.where(theirs + own > 0.0, theirs + own, 1.0), 0.0)
        each = np.column_stack([both * depth * sharp, both * depth * ~sharp, inside & sharp])
        of_corners, of_vertices, some = reduced(comm, sums_of_rows(label, each, n).T)
        # without any contact force every corner inside matters, also in a body without stiffness
        at_corners = (some > 0) & (of_corners >= LACKING * self.largest)
        at_vertices, harmful = of_vertices > LACKING_AT_VERTICES * self.largest, {}
        for k in np.flatnonzero(at_corners | at_vertices).tolist():
            which = np.flatnonzero(inside & (label == k) & (sharp | at_vertices[k]))
            found = [(float(part[i]), config.describe(int(near[i])), float(depth[i])) for i in which]
            everywhere = sorted((one for there in comm.allgather(found) for one in there), reverse=True)
            # of equally deep corners, take the first by position, independent of rounding and partition
            deepest = min(place for part, place, _ in everywhere if part >= (1.0 - EQUALLY_DEEP) * everywhere[0][0])
            size, place, deep = next(one for one in everywhere if one[1] == deepest)
            lacking = of_corners[k] + at_vertices[k] * of_vertices[k]
            missing = lacking / self.largest[k] if self.largest[k] > 0.0 else np.inf
            pair, own = self.pairs[k], corner_nodes(config, facets_of(config, self._tags[k], "contactor"))
            both_sides = bool(reduced(comm, int(np.isin(pair.nodes[pair.trial.active], own).sum())))
            harmful[k] = CornerInside(place, deep, size, missing, both_sides, bool(at_vertices[k] and not at_corners[k]))
        return harmful

    def _near(self, checked: Bools) -> Ints:
        """Indices of corners inside the box around contactors within one facet size of the target ``(k,)`` (collective)."""
        whole, config, g = self.whole, self._config, self._config.gdim
        points, label = whole.points, label_of(whole)
        near = checked[label] & (np.linalg.norm(points - whole.kinematics.projection.foot, axis=1) <= self.reach[label])
        bounds = np.full((len(self.pairs), 2 * g), -np.inf)
        np.maximum.at(bounds, label[near], np.column_stack([-points, points])[near])
        config.comm.Allreduce(MPI.IN_PLACE, bounds, op=MPI.MAX)
        x, reach, bounds = config.x[self.nodes], self.reach[self.label, None], bounds[self.label]
        inside = checked[self.label] & ((x >= -bounds[:, :g] - reach) & (x <= bounds[:, g:] + reach)).all(axis=1)
        return np.flatnonzero(inside)


def conforming(whole: Interface) -> Bools:
    """Contacts whose contactors' gaps differ little from zero relative to the sag of convex targets' facets ``(n_pairs,)`` (collective).

    On as many facets as in the warning of conforming surfaces. If such a target turns, its vertices meet the middles of facets.
    """
    n, target, p = len(whole.members), whole.target, whole.kinematics.projection
    if not isinstance(target, MeshTarget) or not isinstance(p, FacetProjection):
        return np.zeros(n, dtype=bool)
    arms = p.x - p.x.mean(axis=1, keepdims=True)
    sag = 0.5 * np.einsum("nag,ngh,nah->na", arms, target.of_facets(p.facet, facet_curvatures(target)), arms).mean(axis=1)
    close = (LACKING * np.abs(p.gap) < sag) & ~p.beyond.any(axis=1)
    of_contact = np.unique(np.column_stack([label_of(whole), p.facet])[close], axis=0)
    everywhere = np.unique(np.concatenate(whole.config.comm.allgather(of_contact)), axis=0)
    return np.asarray(np.bincount(everywhere[:, 0], minlength=n) > CONFORMING ** (whole.config.gdim - 1))


def corner_nodes(config: Configuration, facets: TargetFacets, cosine: float | None = None) -> Indices:
    """Owned nodes of a surface at its convex corners and edges, by the ``cosine`` of normals, and at its ends ``(k,)`` (collective)."""
    at_corner = facets.dofs[sharp_nodes(facets, cosine or CORNER, convex=True) | facets.open_nodes]
    return np.flatnonzero(followed_nodes(config, at_corner)[: config.n_owned]).astype(np.int32)
