"""What a picture shows besides facets and cells of the mesh: sections through solids where a window cuts them, and rigid surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.geometry.rigid import Motion, RigidSurface

#: Tetrahedra of a cell by its vertices; those of a hexahedron are around its diagonal.
TETRAHEDRA = {
    "tetrahedron": [[0, 1, 2, 3]],
    "hexahedron": [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]],
}
#: Edges that a plane cuts, in their order around the section, by the number of vertices behind it; vertices by their height.
CUT = {1: [(0, 1), (0, 2), (0, 3)], 2: [(0, 2), (0, 3), (1, 3), (1, 2)], 3: [(0, 3), (1, 3), (2, 3)]}


@dataclass(frozen=True)
class Shape:
    """A rigid surface where it was when a frame was taken."""

    surface: RigidSurface
    motion: Motion | None

    def height(self, points: Array) -> Array:
        """Its function of ``points (n, gdim)``, zero on the surface and negative behind it ``(n,)``."""
        X = points if self.motion is None else self.motion.back(points)
        with np.errstate(all="ignore"):
            return np.asarray(self.surface.distance(X), dtype=float)


def rigid_shapes(contacts: Sequence[Contact]) -> list[Shape]:
    """Rigid targets of contacts, each once, where they are now."""
    found = {id(c.target): c.target for c in contacts if isinstance(c.target, RigidSurface)}
    return [Shape(surface, surface.motion) for surface in found.values()]


def grid(box: Array, cells: int) -> tuple[list[Array], Array]:
    """Coordinates along each axis of a box ``(gdim, 2)``, so many cells along its longest side, and all points ``(n, gdim)``, x last."""
    sides = np.diff(box, axis=1)[:, 0]
    axes = [np.linspace(ends[0], ends[1], 2 + int(cells * side / sides.max())) for ends, side in zip(box, sides)]
    all_axes = np.meshgrid(*axes[::-1], indexing="ij")[::-1]
    return axes, np.column_stack([a.ravel() for a in all_axes])


def tetrahedra(mesh: Any) -> Ints:
    """Owned cells as tetrahedra by d.o.f. of the P1 space ``(n, 4)``."""
    dofs = compat.cell_dofs(compat.function_space(mesh, 1))[: mesh.topology.index_map(3).size_local].astype(np.int64)
    return np.concatenate([dofs[:, part] for part in TETRAHEDRA[compat.cell_name(mesh)]])


def section(x: Array, values: Array, cells: Ints, axis: int, bound: float) -> tuple[Array, Array]:
    """Where the plane ``x[axis] = bound`` cuts tetrahedra.

    Args:
        x: their vertices ``(n, 3)``.
        values: a field there ``(n,)``.
        cells: vertices of each ``(m, 4)``.
        axis: which coordinate is constant.
        bound: its value.

    Returns:
        Triangles of the section ``(k, 3, 3)`` and the field at their corners ``(k, 3)``.
    """
    points, found = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    height = x[cells, axis] - bound
    behind = (height < 0).sum(axis=1)
    for number, edges in CUT.items():
        which = behind == number
        order = np.argsort(height[which], axis=1)
        at, h = np.take_along_axis(cells[which], order, axis=1), np.take_along_axis(height[which], order, axis=1)
        begin, end = np.transpose(edges)
        # an edge has the same point in all its cells, to the last digit: from its lower end, by x, then y, then z
        turned = np.sign(x[at[:, end]] - x[at[:, begin]]) @ [4.0, 2.0, 1.0] < 0
        begin, end = (np.where(turned, first, second) for first, second in ((end, begin), (begin, end)))
        a, b = (np.take_along_axis(at, side, axis=1) for side in (begin, end))
        h_a, h_b = (np.take_along_axis(h, side, axis=1) for side in (begin, end))
        t = h_a / (h_a - h_b)
        corners = x[a] + t[:, :, None] * (x[b] - x[a])
        there = values[a] + t * (values[b] - values[a])
        for k in range(1, len(edges) - 1):
            points.append(corners[:, [0, k, k + 1]])
            found.append(there[:, [0, k, k + 1]])
    return np.concatenate(points), np.concatenate(found)
