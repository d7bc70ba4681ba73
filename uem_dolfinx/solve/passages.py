"""Refusal of steps that lead contactors through a body: they end on its other side, in an equilibrium that nobody would reach.

What counts is the converged step, not the iterates of Newton's method: the straight ways of contactors and target from the committed
to the new configuration. A contactor passes if it enters the target in one place and leaves it in another that faces away from the
first. One that only cuts an edge or a crest short, or slides past an end, comes to the same place by shorter steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.errors import TunnellingError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.crossings import Crossings, find_crossings
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import Exchange, agree
from uem_dolfinx.solve.tunnelling import MOST_PLACES, PASSAGE_DEPTH

#: Faces look away from each other if their normals' cosine is less: the sides of a plate do, those of a right-angled edge do not.
#: [convention; cosine; test_passages.py::test_what_looks_away]
LOOKING_AWAY = -0.5


def refuse_passages(config: Configuration, pairs: Sequence[ContactPair], start: Array, motions: Sequence[Motion | None]) -> None:
    """Refuse a step that leads a contactor through its target (collective).

    Steps within which nothing moves by half a facet, or half the thickness of a body of one cell, are not looked at.

    Args:
        config: configuration of the displacement at the end of the step.
        pairs: of all contacts; those that keep their facets for a step cannot pass.
        start: displacement at the beginning ``(n_local incl. ghosts,)``.
        motions: of the pairs' rigid targets at the beginning.

    Raises:
        TunnellingError: naming a contactor.
    """
    du = config.displacement - start.reshape(-1, config.gdim)
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
            passed = _through_mesh(pair, pair.target, start, du - total[:-1] / max(total[-1], 1.0))
        else:
            passed = _through_surface(pair, ways[k][0], motion, longest)
        error = None
        if passed.any():
            i = int(np.flatnonzero(passed)[0])
            error = TunnellingError(
                f"{pair.name}: the contactor at {config.describe(int(pair.nodes[i]))} passes through the target within a step: "
                "take smaller steps"
            )
        agree(config.comm, error)


def _ways(pair: ContactPair, du: Array, motion: Motion | None) -> tuple[Array, Array]:
    """Ways of the contactors, relative to a rigid target, and of the nodes of a meshed one, ``(n, gdim)`` each."""
    way, now = du[pair.nodes], pair.target.motion
    if motion is not now:
        still = Motion.none(du.shape[1])
        before = pair.points - way
        way = pair.points - (now or still).since(motion or still, 1.0).carry(before)
    return way, du[pair.target.dofs.ravel()]


# -- meshed targets ------------------------------------------------------------------------------------------------------


def _through_mesh(pair: ContactPair, target: MeshTarget, start: Array, du: Array) -> Bools:
    """Contactors that pass through a mesh, from displacements ``du (n_local, gdim)`` relative to its mean ``(n,)`` (collective)."""
    comm, points, way = pair.config.comm, pair.points, du[pair.nodes]
    moved = du[target.dofs]
    length = np.linalg.norm(way, axis=1) + max(comm.allgather(np.linalg.norm(moved, axis=2).max(initial=0.0)))
    reach = PASSAGE_DEPTH * target.stride
    # only those that the target could have met on its way
    p = pair.projection
    near = np.flatnonzero((length > target.stride) & (np.linalg.norm(points - p.foot, axis=1) <= length + reach))
    if not any(comm.allgather(len(near))):
        return np.zeros(len(points), bool)
    found = _crossings(target, near, points[near] - way[near], points[near], moved, reach)
    entry, leaving, out = _entries_and_exits(found)
    inside = (found.time[leaving] - found.time[entry]) * length[found.point[entry]]
    away = _look_away(found.normal[entry], found.normal[leaving]) & (inside > reach)
    passed = np.zeros(len(points), bool)
    passed[found.point[entry[away]]] = True
    # those that leave without having entered began inside, or on a curved facet that its pieces cut short
    i = np.unique(found.point[out])
    if any(comm.allgather(len(i))):
        passed[found.point[out]] |= _look_away(_normals_at_start(pair, start, found.point[out]), found.normal[out])
    return passed


def _crossings(target: MeshTarget, who: Ints, p0: Array, p1: Array, moved: Array, reach: float) -> Crossings:
    """Crossings of the points ``who (k,)`` from ``p0`` to ``p1 (k, gdim)`` with the whole target, on their own rank (collective)."""
    comm, g = target.comm, p0.shape[1]
    pieces = target.shape.pieces
    x1 = target.facets.x
    x0 = x1 - moved
    nodes = np.concatenate([x0, x1]).reshape(-1, g)
    box = np.array([nodes.min(axis=0, initial=np.inf) - reach, nodes.max(axis=0, initial=-np.inf) + reach])
    low, high = np.minimum(p0, p1), np.maximum(p0, p1)
    rows = [np.flatnonzero(((low <= b[1]) & (high >= b[0])).all(axis=1)) for b in comm.allgather(box)]
    there = Exchange(comm, rows)
    q0, q1, number, home = there.send(p0, p1, who, np.full(len(who), comm.rank))
    sign = np.repeat(target.facets.sign, len(pieces))
    found = find_crossings((q0, x0[:, pieces].reshape(-1, g, g)), (q1, x1[:, pieces].reshape(-1, g, g)), sign, reach)
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


def _normals_at_start(pair: ContactPair, start: Array, who: Ints) -> Array:
    """Normals of the target at contactors ``who (k,)`` that began on it or inside, zero for others ``(k, gdim)`` (collective)."""
    u = pair.config.u.x.array
    end = np.array(u)
    u[:] = start
    p = pair.target.project(pair.points[who])
    u[:] = end
    began = pair.committed.active[who] | (p.gap < 0.0)
    return np.where(began[:, None], p.normal, 0.0)


def _look_away(a: Array, b: Array) -> Bools:
    """Whether faces with normals ``a`` and ``b (k, gdim)`` look away from each other ``(k,)``."""
    return np.asarray(np.einsum("kg,kg->k", a, b) < LOOKING_AWAY)


# -- other targets -------------------------------------------------------------------------------------------------------


def _through_surface(pair: ContactPair, way: Array, motion: Motion | None, longest: float) -> Bools:
    """Contactors that pass through a surface without facets, by its gaps at places a stride apart ``(n,)`` (collective)."""
    target, end = pair.target, pair.points
    places = np.ceil(longest / target.stride)
    if places > MOST_PLACES:
        raise TunnellingError(
            f"{pair.name}: contactors move by {longest:.4g} past the target within a step, {places:.3g} times what they may pass "
            "without being noticed: take smaller steps"
        )
    now, still = target.motion, Motion.none(end.shape[1])
    turned = (now or still).since(motion or still, 1.0)
    start = turned.back(end - way)
    passed, deep = np.zeros((2, len(end)), bool)
    entry = np.zeros_like(end)
    for k in range(int(places) + 1):
        part = k / places
        x = start + part * (end - start)
        # where the target will be when the rest of its motion is done
        if motion is not now:
            x = (now or still).since(motion or still, 1.0 - part).carry(x)
        p = target.project(x)
        outside = (p.gap >= 0.0) | (k == 0) | ((k == places) & pair.trial.active)
        passed |= outside & deep & _look_away(entry, p.normal)
        deep = ~outside & (deep | (p.gap < -PASSAGE_DEPTH * target.stride))
        entry = np.where(outside[:, None], p.normal, entry)
    return passed
