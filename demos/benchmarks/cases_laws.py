"""The conditions of frictionless contact, read from the bodies: residuals, places of nodes and facets, and nothing of the method.

Every contactor is compared with every facet of its target, one by one, so that no search is trusted either. Of mortar, whose
conditions hold in the mean, the weighted gaps are its own: the tests of the package compare them with a slow reference. Its forces
lie along the normals of the target, where this takes them.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from scipy.optimize import nnls

import uem_dolfinx as uem
from benchmarks.cases import BALANCE, COMM, OVERLAP, BoxScene, Trial
from benchmarks.scenes import Array
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.shapes import closest_point, unit_normals

#: Facets that are as near as the nearest, but for this part of an element, share in the cone of normals at a vertex.
AS_NEAR = 1e-3
#: Forces of mortar have a potential. Where a mesh ends over a facet they lean by the gap there over the size of the facet. Between
#: facets that lean they also act on the neighbours of the node that touches, by the gap and the lean over the size.
LEAN = 1e-2
#: A contactor that is past the end of the target by less than this part of an element may still bear on the end.
PAST_END = 0.1


@dataclass(frozen=True)
class Place:
    """Where a contactor is relative to its target.

    Attributes:
        gap: distance, negative inside the target, infinite past its end.
        normals: outward normals of the nearest facets ``(k, gdim)``.
        above: whether the contactor is above or below the target, and not past its end at all.
    """

    gap: float
    normals: Array
    above: bool


def places(scene: BoxScene, contact: uem.Contact, h: float) -> list[Place]:
    """Places of this rank's contactors (collective)."""
    points, target = contact.pair.points, contact.pair.target
    if isinstance(contact.pair.discretisation, Mortar):
        return _mean_places(contact)
    if not isinstance(contact.target, uem.Tag):
        p = target.project(points)
        return [Place(float(gap), normal[None], True) for gap, normal in zip(p.gap, p.normal)]
    facets = target.facets
    parts = COMM.allgather((contact.config.x[facets.dofs], facets.sign))
    x, sign = (np.concatenate(part) for part in zip(*parts))
    found = []
    for point in points:
        near = np.full(len(x), True)
        p = np.tile(point, (len(x), 1))
        xi, d2 = closest_point(facets.shape, x, p)
        near = np.sqrt(d2) <= np.sqrt(d2.min()) + AS_NEAR * h
        tab = facets.shape.tabulate(xi[near])
        normals = sign[near, None] * unit_normals(tab, x[near])
        nearest = np.argmin(d2[near])
        arm = point - np.einsum("a,ag->g", tab.N[nearest], x[near][nearest])
        away, inside = _off_cone(normals, arm), _off_cone(normals, -arm)
        height = float(normals[nearest] @ arm)
        if min(away, inside) > PAST_END * h:
            height = np.inf
        elif len(normals) > 1 and np.linalg.norm(arm) > AS_NEAR * h:
            height = float(np.copysign(np.linalg.norm(arm), inside - away))
        found.append(Place(height, normals, min(away, inside) <= AS_NEAR * h))
    return found


def _mean_places(contact: uem.Contact) -> list[Place]:
    """Places of this rank's contactors with mortar, whose conditions hold in the mean over the facets around each.

    The gap is the weighted one, infinite where the target covers none of a node's facets, and none where their neighbours' equations
    take in what is hardly covered.
    """
    pair = contact.pair
    gaps = np.where(pair.off, np.where(pair.kinematics.rows.ratio > 0, 0.0, np.inf), pair.kinematics.gap)
    return [Place(float(gap), np.zeros((0, contact.config.gdim)), bool(np.isfinite(gap))) for gap in gaps]


def _normals_around(surface: TargetFacets) -> dict[int, Array]:
    """Outward normals of a surface's facets around each of this rank's nodes ``(k, gdim)`` (collective)."""
    config = surface.config
    known = COMM.allgather((surface.nodes.ravel(), surface.normals().reshape(-1, config.gdim)))
    nodes, normals = (np.concatenate(part) for part in zip(*known))
    own = config.to_global(np.arange(config.n_owned))
    return {i: normals[nodes == node] for i, node in enumerate(own) if (nodes == node).any()}


def _mean(normals: Array) -> Array:
    """Unit vector along the mean of some normals ``(k, gdim)``."""
    total = normals.sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _off_cone(normals: Array, force: Array) -> float:
    """Distance of a vector from the cone of some normals ``(k, gdim)``."""
    return float(nnls(normals.T, force)[1])


def _forces_around(surface: TargetFacets, forces: Array) -> dict[int, float]:
    """The largest of this rank's ``forces (n, gdim)``, and the others', at the nodes of the facets around each (collective)."""
    config = surface.config
    own = config.to_global(np.arange(config.n_owned))
    sizes = np.zeros(config.index_map.size_global)
    sizes[own] = np.linalg.norm(forces, axis=1)
    sizes = np.asarray(COMM.allreduce(sizes))
    facets = np.concatenate(COMM.allgather(surface.nodes))
    at = [(facets == node).any(axis=1) for node in own]
    return {i: float(sizes[facets[which]].max()) for i, which in enumerate(at) if which.any()}


def _off_line(normals: Array, force: Array, largest: float) -> float:
    """What a force has across the mean of some normals ``(k, gdim)``, but for what these differ by from each other.

    Pressures between the nodes of mortar may be negative, so that forces between facets that lean need not lie in their cone, and
    those of two facets may cancel but for their lean: the scale is the ``largest`` force on the facets.
    """
    mean = _mean(normals)
    spread = np.linalg.norm(normals - np.outer(normals @ mean, mean), axis=1).max()
    return max(0.0, float(np.linalg.norm(force - (force @ mean) * mean) - 2 * spread * largest))


def overlap(scene: BoxScene, h: float) -> float:
    """How deep the deepest contactor is inside its target, over the size of an element (collective)."""
    depths = [-place.gap for contact in scene.contacts for place in places(scene, contact, h) if place.above]
    return max(0.0, *COMM.allgather(max(depths, default=0.0))) / h


def check_laws(trial: Trial, scene: BoxScene, h: float, supported: float = BALANCE) -> float:
    """Check equilibrium and contact conditions; returns the sum of the contact forces' sizes (collective).

    Equilibrium where no contact is, forces along the normals that press and never pull, action equal to reaction in force and
    moment, no overlap, and forces only where the gap is closed.

    Args:
        trial: notes the figures.
        scene: after a solution, without inertia.
        h: size of the elements at the contact.
        supported: part of the contact forces that may be missing in the equilibrium where no contact is.
    """
    r, free = scene.residual(), scene.free()
    contactor, target = np.zeros((2, len(r)), dtype=bool)
    normals: dict[int, list[Array]] = {}
    gaps = np.full(len(r), np.inf)
    meshed = True
    for contact in scene.contacts:
        contactor[contact.pair.nodes] = True
        for node, place in zip(contact.pair.nodes, places(scene, contact, h)):
            gaps[node] = min(gaps[node], abs(place.gap))
            normals.setdefault(int(node), []).append(place.normals)
        if isinstance(contact.target, uem.Tag):
            target[scene.nodes(contact.target)] = True
        else:
            meshed = False
    touching = contactor | target
    size = COMM.allreduce(float(np.linalg.norm(np.where(free, r, 0.0)[contactor], axis=1).sum()))
    scale = size if size > 0 else 1.0
    inner = np.where(free & ~touching[:, None], r, 0.0)
    trial.check("equilibrium", COMM.allreduce(float(np.linalg.norm(inner, axis=1).sum())) / scale, supported)
    trial.check("overlap", overlap(scene, h), OVERLAP)
    averaged = [contact.pair for contact in scene.contacts if isinstance(contact.pair.discretisation, Mortar)]
    leans = {i: _mean(n) for pair in averaged for i, n in _normals_around(pair.discretisation.surface).items()}
    astray = work = lost = 0.0
    for node in np.flatnonzero(contactor & ~target & free.all(axis=1)):
        if len(cone := np.concatenate(normals[node])):
            astray += _off_cone(cone, r[node])
        # with mortar, neighbours that press pull an open contactor to and fro along the facets
        force = float(np.linalg.norm(r[node]) if node not in leans else abs(r[node] @ leans[node]))
        if np.isfinite(gaps[node]):
            work += force * gaps[node]
        else:
            lost += force
    for pair in averaged:
        if pair.target.n_nodes:
            facets = pair.target.facets
            around, largest = _normals_around(facets), _forces_around(facets, r)
            astray += sum(_off_line(around[i], r[i], largest[i]) for i in around if free[i].all() and not contactor[i])
    ratios = [pair.kinematics.rows.ratio for pair in averaged]
    ends = COMM.allreduce(any(((ratio > 0) & (ratio < 1 - OVERLAP)).any() for ratio in ratios), op=MPI.LOR)
    trial.check("force off the normals", COMM.allreduce(astray) / scale, LEAN if ends else BALANCE)
    trial.check("force times gap", COMM.allreduce(work) / (scale * h), LEAN if averaged else OVERLAP)
    trial.check("force off the target", COMM.allreduce(lost) / scale, BALANCE)
    if meshed:
        _action_and_reaction(trial, scene, r, touching, free, scale)
    return size


def _action_and_reaction(trial: Trial, scene: BoxScene, r: Array, touching: Array, free: Array, scale: float) -> None:
    """Check the sums of forces and of moments on all surfaces, where no support shares in them (collective)."""
    g = scene.g
    whole = np.array([COMM.allreduce(int((~free[touching, c]).sum())) == 0 for c in range(g)])
    total = np.asarray(COMM.allreduce(r[touching].sum(axis=0)))
    trial.check("action - reaction", float(np.abs(total[whole]).max(initial=0.0)) / scale, BALANCE)
    if whole.all():
        x = scene.V.tabulate_dof_coordinates()[: len(r), :g] + scene.u.x.array.reshape(-1, g)[: len(r)]
        x, f = x[touching], r[touching]
        centre = np.asarray(COMM.allreduce(x.sum(axis=0))) / COMM.allreduce(len(x))
        a, b = np.pad(x - centre, ((0, 0), (0, 3 - g))), np.pad(f, ((0, 0), (0, 3 - g)))
        moment = np.asarray(COMM.allreduce(np.cross(a, b).sum(axis=0)))
        arm = COMM.allreduce(float(np.linalg.norm(a, axis=1).max(initial=0.0)), op=MPI.MAX)
        trial.check("moment", float(np.abs(moment).max()) / (scale * arm), BALANCE)
