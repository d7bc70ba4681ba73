"""Parts of a picture other than facets and cells of the mesh: sections through solids where a window cuts them, and rigid surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.geometry.rigid import Motion, RigidSurface

#: VTK's types of solid cells.
SOLIDS = {"tetrahedron": 10, "hexahedron": 12}


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


def solid_cells(mesh: Any) -> dict[int, Ints]:
    """Owned cells by d.o.f. of the P1 space, as VTK numbers their vertices, by their type there ``{type: (n, n_vertices)}``."""
    cell = compat.cell_name(mesh)
    dofs = compat.cell_dofs(compat.function_space(mesh, 1))[: mesh.topology.index_map(3).size_local]
    return {SOLIDS[cell]: compat.vtk_nodes(cell, dofs.astype(np.int64))}


def sections(x: Array, values: Array, cells: dict[int, Ints], planes: Sequence[tuple[int, float]]) -> tuple[Array, Array]:
    """Where planes ``x[axis] = bound`` cut solid cells, by PyVista.

    Args:
        x: their vertices ``(n, 3)``.
        values: a field there ``(n,)``.
        cells: as returned by ``solid_cells``.
        planes: axis and bound of each.

    Returns:
        Triangles of the sections ``(k, 3, 3)`` and the field at their corners ``(k, 3)``.
    """
    points, found = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    if planes and any(len(some) for some in cells.values()):
        import pyvista

        solid = pyvista.UnstructuredGrid(cells, x)
        solid.point_data["field"] = values
        for axis, bound in planes:
            normal = np.eye(3)[axis]
            cut = solid.slice(normal=normal, origin=bound * normal).triangulate()
            if cut.n_points:
                corners = cut.faces.reshape(-1, 4)[:, 1:]
                points.append(np.asarray(cut.points, dtype=float)[corners])
                found.append(np.asarray(cut.point_data["field"], dtype=float)[corners])
    return np.concatenate(points), np.concatenate(found)
