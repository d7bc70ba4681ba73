"""Refusal of steps in which contactors pass through a body and end on its other side, in an unreachable equilibrium.

The check uses the converged step, not the Newton iterates: straight paths of contactors and target from the committed to the new
configuration. A contactor passes if it enters the target through one face and leaves it through another that faces away from the first.
Contactors that only cut an edge or a crest, or slide past an end, are accepted in statics; in dynamics they have missed an
impact. A contactor that touches at the end of the step has reached the wrong face if it comes from behind this face, or from
the sector in front of both faces of an edge. In the second case its straight path does not determine which face it meets.

For a body that may touch itself, paths are straight relative to its facets, and each facet rotates with its surroundings. So a body that
rotates, rolls or bends does not approach itself, and the surface around a facet moves with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any, TypeGuard

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import slides
from uem_dolfinx.errors import TunnellingError
from uem_dolfinx.geometry.bodies import carried_along
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import described
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.sharp import SHARP_EDGE, to_mean
from uem_dolfinx.parallel import agree, reduced

if TYPE_CHECKING:
    from uem_dolfinx.geometry.crossings import Crossings
    from uem_dolfinx.geometry.neighbours import Neighbour

#: A contactor passes through a target when it is deeper inside on its way than this part of the target's stride.
#: [convention; the target's stride; test_thresholds_motion.py::test_depth_of_a_passage]
PASSAGE_DEPTH = 0.1
#: A step that would have to be examined at more places than this is too long.
#: [bound; places; test_thresholds_motion.py::test_too_many_places]
MOST_PLACES = 256
#: Faces look away from each other if their normals' cosine is less: the sides of a plate do, those of a right-angled edge do not.
#: [convention; cosine; test_passages.py::test_what_looks_away]
LOOKING_AWAY = -0.5


def refuse_passages(
    config: Configuration, pairs: Sequence[Interface], start: Array, motions: Sequence[Motion | None], moving: bool = False
) -> None:
    """Refuse a step in which a contactor passes through its target (collective).

    Steps with motions below half a facet, or half the thickness of a body of one cell, are not examined.

    Args:
        config: configuration of the displacement at the end of the step.
        pairs: of all contacts; contactors that keep their facets for a step, and tied contactors, cannot pass.
        start: all unknowns at the beginning, ghosts included ``(n,)``.
        motions: of the pairs' rigid targets at the beginning.
        moving: whether bodies have inertia, so that contactors must not cut a crest.

    Raises:
        TunnellingError: names the deepest such contactor of the first rank that has one.
    """
    du = config.displacement - config.of(start)
    # nothing that could pass is on an empty list
    may = [slides(pair) and (pair.in_reach or not _listed(pair.target)) for pair in pairs]
    looked_at = list(compress(zip(pairs, motions), may))
    ways = [_ways(pair, du, motion) for pair, motion in looked_at]
    # for each contact: the longest displacements of both sides, the sum of the target's displacements and their number
    mine = np.array(
        [[*(np.linalg.norm(w, axis=1).max(initial=0.0) for w in way), *way[1].sum(axis=0), len(way[1])] for way in ways]
    )
    all_ways = np.array(config.comm.allgather(mine))
    for k, (pair, motion) in enumerate(looked_at):
        longest = all_ways[:, k, :2].max(axis=0).sum()
        if longest <= pair.target.stride:
            continue
        if len(pair.members) > 1:
            each = getattr(motion, "each", [None] * len(pair.members))
            on = pair.discretisation.setting.on
            refuse_passages(config, list(compress(pair.members, on)), start, list(compress(each, on)), moving)
            continue
        if isinstance(pair.target, MeshTarget):
            total = all_ways[:, k, 2:].sum(axis=0)
            depth = _through_mesh(pair, pair.target, start, du - total[:-1] / max(total[-1], 1.0), moving)
            behind, unsure = _came_from(pair, pair.target, start)
            if _listed(pair.target) and pair.target.neighbours.itself.any():
                inside, facet = _through_itself(pair, pair.target, du, moving)
                places = pair.target.of_facets(facet, pair.target.facets.middles(config.X[pair.target.dofs])[0])
                _refuse(
                    pair, inside, "passes through its own body within a step, up to {:.4g} inside, through {}", moving, places
                )
        else:
            depth, behind = _through_surface(pair, ways[k][0], motion, longest, moving)
            unsure = np.zeros(len(depth))
        _refuse(pair, depth, "passes through the target within a step, up to {:.4g} inside", moving)
        behind = np.where(behind > PASSAGE_DEPTH * pair.target.stride, behind, 0.0)
        _refuse(pair, behind, "touches the target from behind after a step, up to {:.4g} inside before", moving)
        _refuse(pair, unsure, "comes to a face next to an edge of the target within a step, from {:.4g} away", moving)


def _listed(target: Any) -> TypeGuard[Neighbour]:
    """Whether contactors search only the neighbour list of a general contact."""
    return hasattr(target, "neighbours")


def _refuse(pair: Interface, by: Array, how: str, moving: bool, places: Array | None = None) -> None:
    """Raise, with the sentence ``how``, if a contactor has passed by a positive length ``(n,)``, at ``places`` (collective)."""
    error = None
    if (by > 0.0).any():
        i = int(np.argmax(by))
        where, at = pair.config.describe(int(pair.nodes[i])), "" if places is None else described(places[i])
        advice = "" if moving else ", or give the bodies inertia if they snap from one equilibrium to another"
        error = TunnellingError(f"{pair.name}: the contactor at {where} {how.format(by[i], at)}: take smaller steps{advice}")
    agree(pair.config.comm, error)


def _ways(pair: Interface, du: Array, motion: Motion | None) -> tuple[Array, Array]:
    """Displacements of the contactors, relative to a rigid target, and of the nodes of a meshed target, ``(n, gdim)`` each."""
    way, now = du[pair.nodes], pair.target.motion
    if motion is not now:
        still = Motion.none(du.shape[1])
        before = pair.points - way
        way = pair.points - (now or still).since(motion or still, 1.0).carry(before)
    return way, du[pair.target.dofs.ravel()]


# -- meshed targets ------------------------------------------------------------------------------------------------------


def _through_mesh(pair: Interface, target: MeshTarget, start: Array, du: Array, moving: bool) -> Array:
    """Depth of passing contactors in a mesh ``(n,)``, from displacements ``du (n_local, gdim)`` relative to its mean (collective)."""
    comm, points, way = pair.config.comm, pair.points, du[pair.nodes]
    moved = du[target.dofs]
    length = np.linalg.norm(way, axis=1) + max(comm.allgather(np.linalg.norm(moved, axis=2).max(initial=0.0)))
    reach = PASSAGE_DEPTH * target.stride
    # only contactors that the target could have met
    p = pair.kinematics.projection
    follow = target.behind_others if _listed(target) else ~pair.tied
    near = np.flatnonzero((length > target.stride) & follow & (np.linalg.norm(points - p.foot, axis=1) <= length + reach))
    depth = np.zeros(len(points))
    if not any(comm.allgather(len(near))):
        return depth
    from uem_dolfinx.geometry.crossings import cross_target

    x, ends = points[near], target.facets.x
    found = cross_target(
        target, near, (x - way[near], x), (ends - moved, ends), reach, target.visibility_keys(near), target.may_touch
    )
    entry, out, inside = _inside(found, length[found.point], reach, moving & ~pair.trial.active)
    np.maximum.at(depth, found.point[entry], inside)
    # contactors that leave without having entered began inside, or on a curved facet outside its flat pieces
    i = np.unique(found.point[out])
    if any(comm.allgather(len(i))):
        i = found.point[out]
        back = _dot(_normals_at_start(pair, target, start, i), found.normal[out]) < LOOKING_AWAY
        depth[i[back]] = np.maximum(depth[i[back]], reach)
    return depth


def _inside(found: Crossings, way: Array, reach: float, at_all: Bools) -> tuple[Ints, Ints, Array]:
    """Passages.

    Args:
        found: crossings.
        way: lengths of the contactors' paths ``(k,)``.
        reach: minimum depth of a passage.
        at_all: mask of contactors that pass if they leave by any face ``(n,)``; others pass if the face looks away.

    Returns:
        Crossings by which passing contactors enter, crossings by which others leave without having entered, and the depths of entries.
    """
    from uem_dolfinx.geometry.crossings import entries_and_exits

    entry, leaving, out = entries_and_exits(found)
    cosine = _dot(found.normal[entry], found.normal[leaving])
    # half of the way between two faces where they are parallel, less where they meet
    inside = (found.time[leaving] - found.time[entry]) * way[entry] * np.sqrt(np.maximum(1.0 - cosine, 0.0) / 8.0)
    passed = (inside > reach) & ((cosine < LOOKING_AWAY) | at_all[found.point[entry]])
    return entry[passed], out, inside[passed]


def _through_itself(pair: Interface, target: Neighbour, du: Array, moving: bool) -> tuple[Array, Ints]:
    """Depth of passing contactors in their own body, and the facets by which they enter, ``(n,)`` each (collective).

    Only contactors with their own body on their neighbour list are examined, and only if the body deforms. Paths are relative to the
    facets, since the surface around a node moves and rotates with it.

    Args:
        pair: the contact.
        target: its target.
        du: displacements in the step ``(n_local, gdim)``.
        moving: as in ``refuse_passages``.
    """
    config, skin, which = pair.config, target.neighbours.skin, target.beside_themselves
    depth, facet = np.zeros(len(pair.nodes)), np.full(len(pair.nodes), -1)
    if not reduced(config.comm, len(which)):
        return depth, facet
    now = config.x
    before = carried_along(config, skin.body_of_node, skin.n_bodies, now - du, now)
    farthest = reduced(config.comm, float(np.linalg.norm(now - before, axis=1).max(initial=0.0)), op=MPI.MAX)
    if 2.0 * farthest <= target.stride:
        return depth, facet
    from uem_dolfinx.geometry.crossings import cross_target

    reach, nodes = PASSAGE_DEPTH * target.stride, pair.nodes[which]
    found = cross_target(
        target, which, (before[nodes], now[nodes]), (before[target.dofs], now[target.dofs]), reach, target.visibility_keys(which),
        target.of_itself, turning=True,
    )  # fmt: skip
    entry, _, inside = _inside(found, found.way, reach, moving & ~pair.trial.active)
    # the deepest of several passages is last, and is kept
    order = np.argsort(inside, kind="stable")
    i = found.point[entry[order]]
    depth[i], facet[i] = inside[order], found.facet[entry[order]]
    return depth, facet


def _normals_at_start(pair: Interface, target: MeshTarget, start: Array, which: Ints) -> Array:
    """Normals of the target at contactors ``which (k,)`` that began on or inside it, zero for others ``(k, gdim)`` (collective)."""
    with pair.config.at(start):
        p = target.project(pair.points[which], which)
    began = pair.committed.active[which] | (p.gap < 0.0)
    return np.where(began[:, None], p.normal, 0.0)


def _came_from(pair: Interface, target: MeshTarget, start: Array) -> tuple[Array, Array]:
    """Initial positions of contactors that have come into contact with a mesh in a step (collective).

    Returns:
        Initial distance behind the touched facet; and, for contactors that began in front of both faces of an edge or nearer to another
        face, the initial distance from the touched facet. Lengths ``(n,)``, zero for all other contactors.
    """
    behind, unsure = np.zeros((2, len(pair.nodes)))
    new = np.flatnonzero(pair.trial.active & ~pair.committed.active)
    if any(pair.config.comm.allgather(len(new))):
        with pair.config.at(start):
            x = pair.points[new]
            nearest, touched = target.project(x, new), target.project_on(x, pair.kinematics.projection.facet[new])
        behind[new] = np.where(nearest.gap >= 0.0, -touched.gap, 0.0)
        outward, away = target.outward(nearest), x - nearest.foot
        lateral = np.linalg.norm(away - _dot(away, outward)[:, None] * outward, axis=1) > PASSAGE_DEPTH * target.stride
        lateral &= ~(nearest.beyond != 0.0).any(axis=1)
        # the mean normal at an edge is inclined to the normals of both faces
        sharp = to_mean(SHARP_EDGE)
        normal = target.outward(touched)
        # from a face in front of the touched face, contactors come along a concave edge or across free space
        turned = (_dot(normal, outward) < sharp) & (_dot(nearest.foot - touched.foot, normal) <= PASSAGE_DEPTH * target.stride)
        other = (lateral & (_dot(nearest.averaged, outward) < sharp)) | turned
        way = np.linalg.norm(x - touched.foot, axis=1)
        unsure[new] = np.where(other & (way > target.stride) & (nearest.facet >= 0), way, 0.0)
    return behind, unsure


def _dot(a: Array, b: Array) -> Array:
    """Products of vectors ``a`` and ``b (k, gdim)``: ``(k,)``."""
    return np.asarray(np.einsum("kg,kg->k", a, b))


# -- other targets -------------------------------------------------------------------------------------------------------


def _through_surface(pair: Interface, way: Array, motion: Motion | None, longest: float, moving: bool) -> tuple[Array, Array]:
    """Contactors that pass through a surface without facets, from gaps at positions a stride apart (collective).

    Returns:
        Depth of passing contactors; and, for contactors that have come into contact in the step, their initial distance behind the
        touched point. Lengths ``(n,)``.
    """
    target, end, active = pair.target, pair.points, pair.trial.active
    places = np.ceil(longest / target.stride)
    if places > MOST_PLACES:
        raise TunnellingError(
            f"{pair.name}: the surfaces move by {longest:.4g} within a step, {places:.3g} times what a contactor may pass without being "
            "noticed: take smaller steps"
        )
    now, still = target.motion, Motion.none(end.shape[1])
    turned = (now or still).since(motion or still, 1.0)
    start = turned.back(end - way)
    depth, deepest, behind = np.zeros((3, len(end)))
    entry = np.zeros_like(end)
    for k in range(int(places) + 1):
        part = k / places
        x = start + part * (end - start)
        # relative to the target at the end of the step
        if motion is not now:
            x = (now or still).since(motion or still, 1.0 - part).carry(x)
        p = target.project(x)
        if k == 0:
            new = active & ~pair.committed.active & (p.gap >= 0.0)
            behind[new] = np.einsum("ng,ng->n", end - x, pair.kinematics.projection.normal)[new]
        # at the end contactors may be on a face up to rounding
        outside = (p.gap >= (-PASSAGE_DEPTH * target.stride if k == places else 0.0)) | (k == 0) | ((k == places) & active)
        passed = outside & (deepest > PASSAGE_DEPTH * target.stride) & ~pair.tied
        passed &= (_dot(entry, p.normal) < LOOKING_AWAY) | (moving & ~active)
        depth = np.where(passed, np.maximum(depth, deepest), depth)
        deepest = np.where(outside, 0.0, np.maximum(deepest, -p.gap))
        entry = np.where(outside[:, None], p.normal, entry)
    return depth, behind
