"""Images of 3D scenes by PyVista, without a window on any screen."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import InputError, MissingBackendError
from uem_dolfinx.output.frames import Shape, grid
from uem_dolfinx.parallel import agree


def require(comm: MPI.Comm) -> None:
    """Raise a MissingBackendError on all ranks where rank 0, which draws, has no PyVista, or VTK nothing to draw with (collective)."""
    error: Exception | None = None
    if comm.rank == 0:
        from ctypes.util import find_library

        try:
            import pyvista  # noqa: F401
        except ImportError as missing:
            error = MissingBackendError(f"plot_scene in 3D needs PyVista ({missing}): pip install pyvista")
        # VTK ends the process where it finds neither
        if (
            error is None
            and sys.platform == "linux"
            and "DISPLAY" not in os.environ
            and not any(map(find_library, ("EGL", "OSMesa")))
        ):
            needs = "plot_scene in 3D needs a screen, or Mesa's libEGL or libOSMesa"
            error = MissingBackendError(f"{needs}: apt-get install libegl1 libgl1-mesa-dri")
    agree(comm, error)


@dataclass(frozen=True)
class Look:
    """What all images of a film have in common."""

    colours: Any  # matplotlib's colour map, with its number of colours
    below: str | None  # colour of values below 0; None is the first of the map
    box: Array  # bounds of the visible part ``(3, 2)``
    cut: bool  # whether the surface is cut off at them
    view: Array  # direction from the scene to the eye ``(3,)``
    edges: bool  # draw the edges of the facets
    width: int  # of an image before its margins are cut off, in points
    same: float  # points that are nearer than this part of the scene's size are one


@dataclass(frozen=True)
class Solid:
    """The scene in one state."""

    points: Array  # vertices ``(n, 3)``
    values: Array  # there, from 0 to the number of colours ``(n,)``
    cuts: tuple[Array, Array]  # triangles in which bodies are cut open ``(k, 3, 3)``, and values at their corners ``(k, 3)``
    arrows: tuple[Array, Array]  # where they begin, and from there to their tips ``(m, 3)``
    rigid: Sequence[Shape]  # rigid surfaces


def images(faces: Ints, solids: Sequence[Solid], look: Look) -> list[Array]:
    """Images ``(height, width, 4)`` of all states, from the same place, without margins; InputError if nothing is in the window."""
    with quiet():
        found = [_image(faces, solid, look) for solid in solids]
    return without_margins(found)


def without_margins(found: Sequence[Array]) -> list[Array]:
    """Images of the same size without margins that are empty in all of them."""
    seen = np.any([image[..., 3] > 0 for image in found], axis=0)
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    return [image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] for image in found]


def screen(view: Array) -> tuple[Array, Array]:
    """Directions to the right and upwards of an eye in this direction from the scene."""
    up = np.array([0.0, 0.0, 1.0] if np.hypot(*view[:2]) > 0 else [0.0, 1.0, 0.0])
    right = np.cross(up, view)
    right /= np.linalg.norm(right)
    return right, np.cross(view, right) / np.linalg.norm(view)


def _image(faces: Ints, solid: Solid, look: Look) -> Array:
    """The image of one state."""
    import pyvista

    line = look.width / 1600
    plotter = pyvista.Plotter(off_screen=True, window_size=(look.width, 3 * look.width // 4))
    skin = _polygons(solid.points, faces, solid.values)
    corners = np.arange(3 * len(solid.cuts[0])).reshape(-1, 3)
    section = _polygons(solid.cuts[0].reshape(-1, 3), corners, solid.cuts[1].ravel())
    parts = [(_inside(surface, look), edges) for surface, edges in ((skin, look.edges), (section, False))]
    if not any(surface.n_cells for surface, _ in parts):
        raise InputError(f"window = {np.ravel(look.box).tolist()}: no part of the scene is in it")
    for surface, edges in parts:
        if surface.n_cells:
            n = look.colours.N
            plotter.add_mesh(
                surface, scalars="values", cmap=look.colours, n_colors=n, clim=(0, n), below_color=look.below, show_scalar_bar=False,
                show_edges=edges, edge_color="black", edge_opacity=0.3, line_width=line, ambient=0.75, diffuse=0.25, specular=0.0,
            )  # fmt: skip
    for surface in (skin, section):
        outline = _inside(outlines(surface, look.same), look)
        if outline.n_cells:
            plotter.add_mesh(outline, color="black", line_width=2.0 * line)
    for shape in solid.rigid:
        add_rigid(plotter, shape, look.box)
    at, to = solid.arrows
    shown = ((at >= look.box[:, 0]) & (at <= look.box[:, 1])).all(axis=1)
    if shown.any():
        plotter.add_arrows(at[shown], to[shown], color="#d62728")
    return taken(plotter, look.view, look.box)


def taken(plotter: Any, view: Array, box: Array) -> Array:
    """The image of a plotter, which is then closed, from a direction ``(3,)``, filled by a box ``(3, 2)``."""
    plotter.enable_anti_aliasing("ssaa")
    plotter.view_vector(view, screen(view)[1])
    plotter.reset_camera(bounds=box.ravel())
    image = np.array(plotter.screenshot(None, transparent_background=True, return_img=True))
    plotter.close()
    return image


def _polygons(points: Array, faces: Ints, values: Array) -> Any:
    """PyVista's surface of these facets, with values at their vertices."""
    surface = polygons(points, faces)
    surface["values"] = values
    return surface


def polygons(points: Array, faces: Ints) -> Any:
    """PyVista's surface of these facets."""
    import pyvista

    return pyvista.PolyData(points, np.column_stack([np.full(len(faces), faces.shape[1]), faces]).ravel())


def outlines(surface: Any, same: float) -> Any:
    """Edges of a surface, whose facets may come from several ranks, at which it ends or turns."""
    whole = surface.clean(tolerance=same, absolute=False)
    if whole.n_cells:
        whole = whole.compute_normals(point_normals=False, consistent_normals=True, non_manifold_traversal=False)
    return whole.extract_feature_edges(feature_angle=35.0, boundary_edges=True, manifold_edges=False, non_manifold_edges=False)


def _inside(surface: Any, look: Look) -> Any:
    """What of a surface is in the window."""
    for axis, (low, high) in enumerate(look.box if look.cut else ()):
        for bound, side in ((low, -1.0), (high, 1.0)):
            if surface.n_cells:
                surface = surface.clip(normal=side * np.eye(3)[axis], origin=bound * np.eye(3)[axis])
    return surface


def add_rigid(plotter: Any, shape: Shape, box: Array, color: str = "lightsteelblue", opacity: float = 0.45) -> None:
    """A rigid surface in a box ``(3, 2)``, where its function vanishes; bodies are seen through it."""
    import pyvista

    axes, points = grid(box, 60)
    volume = pyvista.RectilinearGrid(*axes)
    volume["height"] = shape.height(points)
    surface = volume.contour([0.0], scalars="height")
    if surface.n_cells:
        plotter.add_mesh(surface, color=color, opacity=opacity, show_scalar_bar=False, smooth_shading=True)


@contextmanager
def quiet() -> Iterator[None]:
    """VTK warns where there is no screen before it does without one."""
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)
