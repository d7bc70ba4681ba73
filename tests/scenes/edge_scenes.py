"""Bodies whose sharp edges cross: roofs, ridge over ridge, and rods of square section, edge over edge or face over face."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from benchmarks.scenes import Array, Body, Scene, box, scene
from block_scenes import linear
from body_scenes import without
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from helpers import run
from restart_scenes import continues_alike

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E = 1e3


def roof(cell: str, top: bool, shift: Sequence[float] = (0.0, 0.0), slopes: tuple[float, float] = (0.5, 0.5), n: int = 4) -> Body:
    """A block ``[-1, 1]^2`` with its ridge along x at z = 0; for the ``top`` one turned over, with the ridge along y."""
    b = box(cell, (-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), (n, n, 1))
    x, y, t = b.x.T
    across = x if top else y
    # heights from the base, which is 1.5 away from the ridge
    z = -1.5 + t * (1.5 - np.where(across < 0.0, -slopes[0], slopes[1]) * across)
    return Body(np.column_stack([x + shift[0], y + shift[1], -z if top else z]), b.cells)


def rod(cell: str, n: int, length: float, top: bool, angle: float, on_edge: bool, along: float = 0.0) -> Body:
    """A rod of section 1 by 1 that touches the plane z = 0 from above or below, turned by an angle from x and shifted ``along``."""
    b = box(cell, (-0.5 * length, -0.5, -0.5), (0.5 * length, 0.5, 0.5), (n, 2, 2))
    x, y, z = b.x.T
    if on_edge:
        y, z = np.sqrt(0.5) * (y - z), np.sqrt(0.5) * (y + z)
    half = np.sqrt(0.5) if on_edge else 0.5
    x, z = x + along, z + (half if top else -half)
    c, s = np.cos(angle), np.sin(angle)
    return Body(np.column_stack([c * x - s * y, s * x + c * y, z]), b.cells)


@dataclass
class Crossed:
    """Two bodies that cross, the lower one held and the upper one moved.

    Attributes:
        scene: the bodies.
        u: displacement.
        contact: of both, the upper one's surface on the lower one's if it is declared by hand.
        problem: with all.
        R: turns the drawing into the scene ``(3, 3)``.
    """

    scene: Scene
    u: fem.Function
    contact: Any
    problem: uem.UnitedProblem
    R: Array

    @property
    def force(self) -> Array:
        """On the lower body, in the drawing ``(3,)`` (collective)."""
        if isinstance(self.contact, uem.GeneralContact):
            return self.contact.between("body 1").force @ self.R
        return self.contact.resultant(on="contactor" if self.contact.contactor.name == "side 0" else "target").force @ self.R

    @property
    def edges(self) -> list[uem.Contact]:
        """The contacts at crossings."""
        if isinstance(self.contact, uem.GeneralContact):
            return [part for part in self.contact.parts if "at edges" in part.name]
        return [part for part in self.contact.further if "edges" in part.name]

    @property
    def n_crossings(self) -> int:
        """Active ones (collective)."""
        return COMM.allreduce(sum(int(part.pair.united.sum()) for part in self.edges))


def crossed(
    cell: str,
    bodies: Sequence[Body],
    held: Sequence[Callable[[Array], Any]] = (),
    way: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    degree: int = 1,
    R: Array | None = None,
    size: float = 1.0,
    law: Callable[..., Any] = linear,
    dynamics: Callable[[Any], Any] | None = None,
    first: int | None = None,
    surfaces: Sequence[Callable[[Array], Any]] | None = None,
    **contact: Any,
) -> Crossed:
    """Two bodies, the upper one moved by ``way (3,)`` of the drawing in the last step (collective).

    Args:
        cell: kind of the cells.
        bodies: the lower one and the upper one.
        held: functions that find the held and the moved nodes in the drawing.
        way: displacement of the moved nodes at load factor 1.
        degree: of the displacement.
        R: rotation of the scene ``(3, 3)``.
        size: of the whole scene over that of the drawing.
        law: see ``linear``.
        dynamics: function of the space that returns inertia, or None.
        first: number of the body whose nodes are contactors, or None.
        surfaces: functions that find the surfaces of both bodies in the drawing, for a contact that is declared; None: general contact.
        contact: its arguments.
    """
    R = np.eye(3) if R is None else R
    s = scene(COMM, cell, bodies, pose=lambda x: size * x @ R.T)
    V = uem.function_space(s.mesh, degree, (3,))
    u = fem.Function(V)
    tags = [s.tag(f"held {k}", min(k, len(bodies) - 1), where) for k, where in enumerate(held)]
    values = np.zeros(3), size * R @ np.asarray(way, dtype=float)
    bcs = [uem.dirichlet(V, tag, value=value.tolist()) for tag, value in zip(tags, values)]
    how = {"max_penetration": size} | contact
    if surfaces is not None:
        outer, sides = exterior_facet_indices(s.mesh.topology), []
        for k, where in enumerate(surfaces):
            facets = np.intersect1d(s.tag(f"side {k}", k, where).entities, outer).astype(np.int32)
            sides.append(uem.Tag(f"side {k}", 1, 2, s.mesh, facets))
        both: Any = uem.Contact(*(sides if first == 0 else sides[::-1]), **how)
    else:
        both = uem.GeneralContact(**how | ({} if first is None else {"order": [tags[first]]}))
    more = {} if dynamics is None else {"dynamics": dynamics(V)}
    problem = uem.UnitedProblem(law(u, E), u, bcs=bcs, contacts=[both], **more)
    return Crossed(s, u, both, problem, R)


def roofs(
    cell: str = "hexahedron",
    shift: Sequence[float] = (0.0, 0.0),
    depth: float = 0.02,
    slopes: tuple[float, float] = (0.5, 0.5),
    **how: Any,
) -> Crossed:
    """Two roofs, the upper one shifted, and moved down by a depth."""
    held = [lambda x: np.abs(x[:, 2] + 1.5) < 1e-9, lambda x: np.abs(x[:, 2] - 1.5) < 1e-9]
    bodies = [roof(cell, False, slopes=slopes), roof(cell, True, shift, slopes)]
    return crossed(cell, bodies, held, (0.0, 0.0, -depth), **how)


def rods(
    n: Sequence[int] = (24, 24), *, length: float = 24.0, angle: float = 0.5 * np.pi, on_edge: bool = True, cell: str = "hexahedron",
    along: Sequence[float] = (0.0, 0.0), way: Sequence[float] = (0.0, 0.0, -0.1), **how: Any,
) -> Crossed:  # fmt: skip
    """Two rods clamped at their ends, the upper one's moved by a ``way (3,)``."""
    bodies = [rod(cell, n[k], length, k > 0, k * angle, on_edge, along[k]) for k in (0, 1)]
    c, s = np.cos(angle), np.sin(angle)

    def ends(x: Array, k: int) -> Any:
        at = x[:, 0] if k == 0 else c * x[:, 0] + s * x[:, 1]
        return np.abs(np.abs(at - along[k]) - 0.5 * length) < 1e-9

    return crossed(cell, bodies, [lambda x: ends(x, 0), lambda x: ends(x, 1)], way, **how)


def turned(seed: int) -> Array:
    """A rotation ``(3, 3)`` by chance."""
    Q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(r))
    return Q * np.linalg.det(Q)


def folded(
    shift: float, *, link: bool = True, R: Array | None = None, way: Sequence[float] = (0.0, 0.0, -0.1), **how: Any
) -> Crossed:
    """Rods across each other, face on face, 0.02 apart, held at their ends; an arm behind these makes both one body.

    Args:
        shift: moves the nodes of both rods near the crossing along these.
        link: whether the arm is whole; without, there are two bodies.
        R: rotation of the scene ``(3, 3)``.
        way: of the upper rod's ends.
        how: arguments of the contact, and of ``crossed``.
    """
    L, gap = 3.0, 0.02
    along, up = np.linspace(-L, L + 1.0, 15), np.array([-1.0, -0.5, 0.0, gap, gap + 0.5, gap + 1.0])
    whole = box("hexahedron", (0.0, 0.0, 0.0), (14.0, 14.0, 5.0), (14, 14, 5))
    i, j, k = np.rint(whole.x).astype(int).T
    whole = Body(np.column_stack([along[i], along[j], up[k]]), whole.cells)

    def hole(x: Array) -> Any:
        a, b, z = x.T
        low = (z < 0.0) & ((np.abs(b) < 0.5) | ((a > L) & (b > -0.5)))
        high = (z > gap) & ((np.abs(a) < 0.5) | ((b > L) & (a > -0.5)))
        column = (a > L) & (b > L) if link else (a < -L) & (b < -L)
        return ~(low | high | column) | ((not link) & (a > L - 1.0) & (b > L - 1.0))

    def moved(x: Array) -> Array:
        near = shift * np.sin(np.pi * np.clip(x[:, :2], -L, L) / L)
        low = x[:, 2] < 0.5 * gap
        return x + np.column_stack(
            [near[:, 0] * (low & (np.abs(x[:, 1]) < 0.6)), near[:, 1] * (~low & (np.abs(x[:, 0]) < 0.6)), 0.0 * x[:, 2]]
        )

    def ends(x: Array, k: int) -> Any:
        low = x[:, 2] < 0.5 * gap
        return (low != bool(k)) & (np.abs(np.abs(x[:, k]) - L) < 1e-9) & (np.abs(x[:, 1 - k]) < 0.6)

    body = without(whole, hole).mapped(moved)
    return crossed("hexahedron", [body], [lambda x: ends(x, 0), lambda x: ends(x, 1)], way, R=R, max_penetration=0.5, **how)


def continues_from_checkpoints(begun, folder):
    """Assert that a run of four steps that continues from a checkpoint ends like one that was left alone.

    Args:
        begun: makes the scene, with its ``problem``.
        folder: of the checkpoint.
    """
    whole = begun()
    run(whole.problem, 4)
    for stop in (2, 9):
        r = begun()
        for step in uem.load_steps(r.problem, 4, checkpoint=uem.Checkpoint(folder / "run", every=1)):
            if step.number == stop:
                break
    assert r.problem.progress.steps == 4
    continues_alike(r.problem.u.x.array, whole.problem.u.x.array)
