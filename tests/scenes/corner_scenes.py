"""Wedges in grooves and tips in pits of any opening, and how deep contactors are inside a body, by its boundary alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from benchmarks.scenes import Array, Body, Scene, at, box, clamp
from benchmarks.scenes import scene as create_scene
from block_scenes import linear, modulus
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.shapes import closest_point, facet_shape

COMM = MPI.COMM_WORLD
E = 1e-9


def notched(cell: str, lo: list[float], hi: list[float], n: list[int], axes: int) -> Body:
    """A box without the part of it that is positive in the first ``axes`` coordinates."""
    whole = box(cell, lo, hi, n)
    cells = whole.cells[~(whole.x[whole.cells].mean(axis=1)[:, :axes] > 0).all(axis=1)]
    used, inverse = np.unique(cells, return_inverse=True)
    return Body(whole.x[used], inverse.reshape(cells.shape))


@dataclass
class InCorner:
    """A body in the concave corner of another; its far sides are driven."""

    scene: Scene
    problem: uem.UnitedProblem
    contact: uem.Contact
    target_body: int

    def inside(self) -> float:
        """How deep the deepest contactor is inside the target's body, through the target, a length (collective)."""
        return depth(self.scene, self.contact, self.target_body)


def groove(
    cell: str, angle: float, apex: float, start: float, shift: Any, push: Any, *, tilt: float | None = None, degree: int = 1,
    swap: bool = False, floor: bool = False, path: Any = None, n: int = 2, **how: Any,
) -> InCorner:  # fmt: skip
    """A wedge in a groove that opens by ``angle``; in space both continue along the third axis.

    Args:
        cell: kind of all cells.
        angle: between the flanks, degrees.
        apex: of the wedge, degrees.
        start: from the first flank to the wedge, degrees.
        shift: of the wedge from the groove's bottom.
        push: how far its sides that are driven go.
        tilt: of the first flank from the horizontal, degrees; None has the groove open upwards.
        degree: of the displacement.
        swap: whether the wedge is the target.
        floor: whether the wedge is driven by its upper side alone, and not by the one that looks along the first flank.
        path: part of ``push`` at a load factor; None takes the factor.
        n: divisions of a flank.
        how: of the contact.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    low = notched(cell, [-1, -1] + [-0.25] * (g - 2), [1, 1] + [1.25] * (g - 2), [2 * n, 2 * n] + [3] * (g - 2), 2)
    high = box(cell, [0] * g, [1] * g, [n, n] + [2] * (g - 2))
    tilt = 90 - angle / 2 if tilt is None else tilt

    def pose(x: Array) -> Array:
        y, upper = x.copy(), np.arange(len(x)) >= len(low.x)
        r, phi = np.hypot(x[:, 0], x[:, 1]), np.degrees(np.arctan2(x[:, 1], x[:, 0])) % 360
        phi[~upper & (phi < 45)] = 360.0
        phi = np.where(upper, start + phi * apex / 90, angle + (phi - 90) * (360 - angle) / 270) + tilt
        y[:, 0], y[:, 1] = r * np.cos(np.radians(phi)), r * np.sin(np.radians(phi))
        y[upper, : len(shift)] += shift
        return y

    s = create_scene(COMM, cell, [low, high], pose=pose)

    def flanks(x: Array) -> Any:
        return (np.abs(x[:, :2]) < E).any(axis=1) & (x[:, :2] > -E).all(axis=1)

    held = [s.tag("held", 0, at(axis, -1.0)) for axis in (0, 1)]
    driven = [s.tag("driven", 1, at(axis, 1.0)) for axis in ((1,) if floor else (0, 1))]
    return _in_corner(s, g, degree, s.tag("wedge", 1, flanks), s.tag("flanks", 0, flanks), held, driven, push, swap, path, how)


def pit(cell: str, stretch: float, shift: Any, push: Any, *, swap: bool = False, **how: Any) -> InCorner:
    """A tip in a pit of three facets that opens upwards, deeper than a cube's corner if stretched; other arguments as of ``groove``."""
    low, high = notched(cell, [-1] * 3, [1] * 3, [2] * 3, 3), box(cell, [0] * 3, [1] * 3, [1] * 3)
    pose = upright(stretch)

    def posed(x: Array) -> Array:
        y = x.copy()
        # the tip is slimmer than the pit
        y[len(low.x) :] = 0.5 * y[len(low.x) :] + 0.5 * y[len(low.x) :].mean(axis=1, keepdims=True)
        y = pose(y)
        y[len(low.x) :] += shift
        return y

    s = create_scene(COMM, cell, [low, high], pose=posed)

    def flanks(x: Array) -> Any:
        return (np.abs(x) < E).any(axis=1) & (x > -E).all(axis=1)

    held = [s.tag("held", 0, at(axis, -1.0)) for axis in range(3)]
    driven = [s.tag("driven", 1, at(axis, 1.0)) for axis in range(3)]
    return _in_corner(s, 3, 1, s.tag("tip", 1, flanks), s.tag("flanks", 0, flanks), held, driven, push, swap, None, how)


def upright(stretch: float) -> Any:
    """Stretch along a cube's diagonal, which is turned upright."""
    d = np.full(3, 3**-0.5)
    e, m = np.array([0.0, 0.0, 1.0]), np.eye(3) + (stretch - 1) * np.outer(d, d)
    half = (d + e) / np.linalg.norm(d + e)
    turn = 2 * np.outer(half, half) - np.eye(3)
    return lambda x: x @ (turn @ m).T


def _in_corner(
    s: Scene, g: int, degree: int, upper: uem.Tag, lower: uem.Tag, held: Any, driven: Any, push: Any, swap: bool, path: Any, how: Any
) -> InCorner:  # fmt: skip
    V = compat.function_space(s.mesh, degree, (g,))
    u, lead = fem.Function(V), fem.Function(V)
    dofs = np.unique(np.concatenate([fem.locate_dofs_topological(V, g - 1, tag.entities) for tag in driven]))
    way = np.pad(np.asarray(push, dtype=float), (0, g - len(push)))

    def load(factor: float) -> None:
        lead.x.array.reshape(-1, g)[:] = way * (factor if path is None else path(factor))

    bcs = [*sum((clamp(V, tag) for tag in held), []), fem.dirichletbc(lead, dofs)]
    contact = uem.Contact(*((lower, upper) if swap else (upper, lower)), max_penetration=0.5, **how)
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0)), u, bcs=bcs, contacts=[contact], load=load)
    return InCorner(s, problem, contact, int(swap))


def boundary(s: Scene, body: int, number: int = 1) -> uem.Tag:
    """All facets of a body's surface."""
    tdim = s.mesh.topology.dim
    s.mesh.topology.create_connectivity(tdim - 1, tdim)
    facets = dolfinx_mesh.exterior_facet_indices(s.mesh.topology)
    cells = s.mesh.topology.connectivity(tdim - 1, tdim)
    mine = [f for f in facets if s.body[cells.links(f)[0]] == body]
    return uem.Tag("boundary", number, tdim - 1, s.mesh, np.array(mine, dtype=np.int32))


def depth(s: Scene, contact: uem.Contact, body: int) -> float:
    """How deep the deepest contactor is inside a body, of those that are nearest to the target, a length (collective).

    The boundary is cut into straight pieces; its winding number about a point determines whether this is inside.
    """
    pieces, of_target = _pieces(contact.config, boundary(s, body), contact.target)
    shape, deepest = facet_shape("interval" if pieces.shape[1] == 2 else "triangle", 1), 0.0
    for point in contact.pair.points:
        if abs(_winding(pieces - point)) > 0.5:
            d2 = closest_point(shape, pieces, np.tile(point, (len(pieces), 1)))[1]
            if of_target[d2 <= d2.min() * (1 + 1e-9)].any():
                deepest = max(deepest, float(np.sqrt(d2.min())))
    return float(max(COMM.allgather(deepest)))


def _pieces(config: Any, whole: uem.Tag, target: Any) -> tuple[Array, Any]:
    """Straight pieces ``(k, gdim, gdim)`` of a surface, oriented outwards, and which are the target's ``(k,)`` (collective)."""
    facets = TargetFacets(config, whole)
    shape = facets.shape
    m = 1 if shape.degree == 1 and shape.cell != "quadrilateral" else (64 if shape.dim == 1 else 8)
    if shape.dim == 1:
        xi = np.array([[[i], [i + 1]] for i in range(m)])
    else:
        i, j = (k.ravel() for k in np.meshgrid(range(m), range(m)))
        first = np.stack([np.column_stack(p) for p in ((i, j), (i + 1, j), (i, j + 1))], axis=1)
        second = np.stack([np.column_stack(p) for p in ((i + 1, j), (i + 1, j + 1), (i, j + 1))], axis=1)
        keep = [i + j < m, i + j < m - 1] if shape.cell == "triangle" else [i >= 0] * 2
        xi = np.concatenate([first[keep[0]], second[keep[1]]])
    N = shape.functions(xi.reshape(-1, shape.dim) / m)
    x = np.einsum("ka,nag->nkg", N, facets.x).reshape(len(facets.x), len(xi), shape.dim + 1, config.gdim)
    turned = facets.sign < 0
    x[turned] = x[turned][:, :, ::-1]
    mine = np.isin(_with_own_cells(whole), target.entities)
    parts = COMM.allgather((x.reshape(-1, *x.shape[2:]), np.repeat(mine, len(xi))))
    pieces, of_target = (np.concatenate(part) for part in zip(*parts))
    return pieces, of_target


def _with_own_cells(tag: uem.Tag) -> Any:
    """A boundary's facets whose cells this rank owns, in their order."""
    mesh = tag.mesh
    cells = mesh.topology.connectivity(tag.dim, tag.dim + 1)
    n = mesh.topology.index_map(tag.dim + 1).size_local
    return np.array([f for f in tag.entities if cells.links(f)[0] < n], dtype=np.int64)


def _winding(r: Array) -> float:
    """How often pieces ``r (k, gdim, gdim)`` go round the origin."""
    if r.shape[1] == 2:
        a, b = r[:, 0], r[:, 1]
        return float(np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)).sum() / (2 * np.pi))
    length = np.linalg.norm(r, axis=2)
    volume = np.einsum("kg,kg->k", r[:, 0], np.cross(r[:, 1], r[:, 2]))
    rest = sum(np.einsum("kg,kg->k", r[:, i], r[:, i - 1]) * length[:, i - 2] for i in range(3))
    return float(np.arctan2(volume, length.prod(axis=1) + rest).sum() / (2 * np.pi))
