"""Refusal of steps that lead contactors through a body: they end on its other side, in an equilibrium that nobody would reach.

What counts is the converged step, not the iterates of Newton's method: the straight ways of contactors and target from the committed
to the new configuration. A contactor passes if it enters the target in one place and leaves it in another that faces away from the
first. One that only cuts an edge or a crest short, or slides past an end, comes to the same place by shorter steps; in motion it has
missed a blow. One that touches at the end has come to the wrong face if it comes from behind this, or from the sector in front of
both faces of an edge, where a straight way does not tell which of them it meets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.checks import CORNER
from uem_dolfinx.contact.interface import Interface
from uem_dolfinx.errors import TunnellingError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.crossings import Crossings, find_crossings
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import Exchange, agree

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
    """Refuse a step that leads a contactor through its target (collective).

    Steps within which nothing moves by half a facet, or half the thickness of a body of one cell, are not looked at.

    Args:
        config: configuration of the displacement at the end of the step.
        pairs: of all contacts; those that keep their facets for a step cannot pass, nor can what is tied.
        start: all unknowns at the beginning, ghosts included ``(n,)``.
        motions: of the pairs' rigid targets at the beginning.
        moving: whether bodies have inertia, so that none may cut a crest short.

    Raises:
        TunnellingError: naming the deepest such contactor of the first rank that has one.
    """
    du = config.displacement - config.of(start)
    looked_at = [(pair, motion) for pair, motion in zip(pairs, motions) if pair.sliding == "finite"]
    ways = [_ways(pair, du, motion) for pair, motion in looked_at]
    # of one contact: the longest ways of both sides, the sum of the target's and their number
    mine = np.array(
        [[*(np.linalg.norm(w, axis=1).max(initial=0.0) for w in way), *way[1].sum(axis=0), len(way[1])] for way in ways]
    )
    all_ways = np.array(config.comm.allgather(mine))
    for k, (pair, motion) in enumerate(looked_at):
        longest = all_ways[:, k, :2].max(axis=0).sum()
        if longest <= pair.target.stride:
            continue
        if isinstance(pair.target, MeshTarget):
            total = all_ways[:, k, 2:].sum(axis=0)
            depth = _through_mesh(pair, pair.target, start, du - total[:-1] / max(total[-1], 1.0), moving)
            behind, unsure = _came_from(pair, pair.target, start)
        else:
            depth, behind = _through_surface(pair, ways[k][0], motion, longest, moving)
            unsure = np.zeros(len(depth))
        _refuse(pair, depth, "passes through the target within a step, {:.4g} inside on its way", moving)
        behind = np.where(behind > PASSAGE_DEPTH * pair.target.stride, behind, 0.0)
        _refuse(pair, behind, "touches the target from behind after a step, {:.4g} inside on its way", moving)
        _refuse(pair, unsure, "comes to a face beside an edge of the target within a step, from {:.4g} away", moving)


def _refuse(pair: Interface, by: Array, how: str, moving: bool) -> None:
    """Raise if a contactor has passed, by a length that is positive ``(n,)``; ``moving`` as of ``refuse_passages`` (collective)."""
    error = None
    if (by > 0.0).any():
        i = int(np.argmax(by))
        where = pair.config.describe(int(pair.nodes[i]))
        advice = "" if moving else ", or give the bodies inertia if they snap from one equilibrium to another"
        error = TunnellingError(f"{pair.name}: the contactor at {where} {how.format(by[i])}: take smaller steps{advice}")
    agree(pair.config.comm, error)


def _ways(pair: Interface, du: Array, motion: Motion | None) -> tuple[Array, Array]:
    """Ways of the contactors, relative to a rigid target, and of the nodes of a meshed one, ``(n, gdim)`` each."""
    way, now = du[pair.nodes], pair.target.motion
    if motion is not now:
        still = Motion.none(du.shape[1])
        before = pair.points - way
        way = pair.points - (now or still).since(motion or still, 1.0).carry(before)
    return way, du[pair.target.dofs.ravel()]


# -- meshed targets ------------------------------------------------------------------------------------------------------


def _through_mesh(pair: Interface, target: MeshTarget, start: Array, du: Array, moving: bool) -> Array:
    """How deep contactors that pass are in a mesh, from displacements ``du (n_local, gdim)`` relative to its mean ``(n,)`` (collective)."""
    comm, points, way = pair.config.comm, pair.points, du[pair.nodes]
    moved = du[target.dofs]
    length = np.linalg.norm(way, axis=1) + max(comm.allgather(np.linalg.norm(moved, axis=2).max(initial=0.0)))
    reach = PASSAGE_DEPTH * target.stride
    # only those that the target could have met on its way
    p = pair.projection
    near = np.flatnonzero((length > target.stride) & ~pair.tied & (np.linalg.norm(points - p.foot, axis=1) <= length + reach))
    depth = np.zeros(len(points))
    if not any(comm.allgather(len(near))):
        return depth
    found = _crossings(target, near, points[near] - way[near], points[near], moved, reach)
    entry, leaving, out = _entries_and_exits(found)
    i = found.point[entry]
    cosine = _dot(found.normal[entry], found.normal[leaving])
    # half of the way between two faces where they are parallel, less where they meet
    inside = (found.time[leaving] - found.time[entry]) * length[i] * np.sqrt(np.maximum(1.0 - cosine, 0.0) / 8.0)
    passed = (inside > reach) & ((cosine < LOOKING_AWAY) | (moving & ~pair.trial.active[i]))
    np.maximum.at(depth, i[passed], inside[passed])
    # those that leave without having entered began inside, or on a curved facet that its pieces cut short
    i = np.unique(found.point[out])
    if any(comm.allgather(len(i))):
        i = found.point[out]
        back = _dot(_normals_at_start(pair, target, start, i), found.normal[out]) < LOOKING_AWAY
        depth[i[back]] = np.maximum(depth[i[back]], reach)
    return depth


def _crossings(target: MeshTarget, which: Ints, p0: Array, p1: Array, moved: Array, reach: float) -> Crossings:
    """Crossings of the points ``which (k,)`` from ``p0`` to ``p1 (k, gdim)`` with the whole target, on their own rank (collective)."""
    comm, g = target.comm, p0.shape[1]
    pieces = target.shape.pieces
    x1 = target.facets.x
    x0 = x1 - moved
    nodes = np.concatenate([x0, x1]).reshape(-1, g)
    box = np.array([nodes.min(axis=0, initial=np.inf) - reach, nodes.max(axis=0, initial=-np.inf) + reach])
    low, high = np.minimum(p0, p1), np.maximum(p0, p1)
    rows = [np.flatnonzero(((low <= b[1]) & (high >= b[0])).all(axis=1)) for b in comm.allgather(box)]
    there = Exchange(comm, rows)
    q0, q1, number, told, home = there.send(p0, p1, which, target.told(which), np.full(len(which), comm.rank))
    sign = np.repeat(target.facets.sign, len(pieces))
    ways = (q0, x0[:, pieces].reshape(-1, g, g)), (q1, x1[:, pieces].reshape(-1, g, g))
    found = find_crossings(*ways, sign, reach, lambda i, f: target.may_touch(told[i], f // len(pieces)))
    back = Exchange.to(comm, home[found.point])
    return Crossings(*back.send(number[found.point], found.time, found.inwards, found.normal))


def _entries_and_exits(found: Crossings) -> tuple[Ints, Ints, Ints]:
    """Pairs of an entry and a later exit of the same point ``(k,)`` each, and the exits that no entry comes before."""
    ins, outs = np.flatnonzero(found.inwards), np.flatnonzero(~found.inwards)
    ins = ins[np.argsort(found.point[ins], kind="stable")]
    first, last = (np.searchsorted(found.point[ins], found.point[outs], side=side) for side in ("left", "right"))
    leaving = np.repeat(outs, last - first)
    begins = np.repeat(np.cumsum(last - first) - (last - first), last - first)
    entry = ins[np.repeat(first, last - first) + np.arange(len(leaving)) - begins]
    later = found.time[leaving] > found.time[entry]
    entry, leaving = entry[later], leaving[later]
    return entry, leaving, np.setdiff1d(outs, leaving)


def _normals_at_start(pair: Interface, target: MeshTarget, start: Array, which: Ints) -> Array:
    """Normals of the target at contactors ``which (k,)`` that began on it or inside, zero for others ``(k, gdim)`` (collective)."""
    with pair.config.at(start):
        p = target.project(pair.points[which], which)
    began = pair.committed.active[which] | (p.gap < 0.0)
    return np.where(began[:, None], p.normal, 0.0)


def _came_from(pair: Interface, target: MeshTarget, start: Array) -> tuple[Array, Array]:
    """Where contactors that have come to a mesh in a step began (collective).

    Returns:
        How far behind the facet that they touch, and, of those that began in front of both faces of an edge or nearer to another face,
        how far from this facet; lengths ``(n,)``, zero for all others.
    """
    behind, unsure = np.zeros((2, len(pair.nodes)))
    new = np.flatnonzero(pair.trial.active & ~pair.committed.active)
    if any(pair.config.comm.allgather(len(new))):
        with pair.config.at(start):
            x = pair.points[new]
            nearest, touched = target.project(x, new), target.project_on(x, pair.projection.facet[new])
        behind[new] = np.where(nearest.gap >= 0.0, -touched.gap, 0.0)
        outward, away = target.outward(nearest), x - nearest.foot
        beside = np.linalg.norm(away - _dot(away, outward)[:, None] * outward, axis=1) > PASSAGE_DEPTH * target.stride
        beside &= ~(nearest.beyond != 0.0).any(axis=1)
        # the mean of the normals about an edge leans from those of both faces
        sharp = 1.0 / np.hypot(1.0, CORNER)
        normal = target.outward(touched)
        # from a face that stands before the one that they touch, they come by a concave edge or across free space
        turned = (_dot(normal, outward) < sharp) & (_dot(nearest.foot - touched.foot, normal) <= PASSAGE_DEPTH * target.stride)
        other = (beside & (_dot(nearest.averaged, outward) < sharp)) | turned
        way = np.linalg.norm(x - touched.foot, axis=1)
        unsure[new] = np.where(other & (way > target.stride) & (nearest.facet >= 0), way, 0.0)
    return behind, unsure


def _dot(a: Array, b: Array) -> Array:
    """Products of vectors ``a`` and ``b (k, gdim)``: ``(k,)``."""
    return np.asarray(np.einsum("kg,kg->k", a, b))


# -- other targets -------------------------------------------------------------------------------------------------------


def _through_surface(pair: Interface, way: Array, motion: Motion | None, longest: float, moving: bool) -> tuple[Array, Array]:
    """Contactors that pass through a surface without facets, by its gaps at places a stride apart (collective).

    Returns:
        How deep those that pass are inside, and how far behind the place that they touch those have begun that have come to it in the
        step; lengths ``(n,)``.
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
        # where the target will be when the rest of its motion is done
        if motion is not now:
            x = (now or still).since(motion or still, 1.0 - part).carry(x)
        p = target.project(x)
        if k == 0:
            new = active & ~pair.committed.active & (p.gap >= 0.0)
            behind[new] = np.einsum("ng,ng->n", end - x, pair.projection.normal)[new]
        outside = (p.gap >= 0.0) | (k == 0) | ((k == places) & active)
        passed = outside & (deepest > PASSAGE_DEPTH * target.stride) & ~pair.tied
        passed &= (_dot(entry, p.normal) < LOOKING_AWAY) | (moving & ~active)
        depth = np.where(passed, np.maximum(depth, deepest), depth)
        deepest = np.where(outside, 0.0, np.maximum(deepest, -p.gap))
        entry = np.where(outside[:, None], p.normal, entry)
    return depth, behind
