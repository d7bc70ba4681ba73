"""Images of 3D scenes by PyVista, without a window on any screen."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import InputError, MissingBackendError
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


def images(
    points: Sequence[Array],
    faces: Ints,
    values: Sequence[Array],
    arrows: Sequence[tuple[Array, Array]],
    colours: Any,
    box: Array,
    window: Array | None,
    view: Array,
    edges: bool,
) -> list[Array]:
    """One image of a surface for each state, all from the same place and of the same size.

    Args:
        points: vertices in each state ``(n, 3)``.
        faces: vertices in their order around each facet ``(m, 3 or 4)``.
        values: at the vertices in each state ``(n,)``, from 0 to the number of colours.
        arrows: in each state where they begin, and from there to their tips ``(k, 3)``.
        colours: matplotlib's colour map, with its number of colours.
        box: bounds of what is looked at ``(3, 2)``.
        window: the same where the surface is cut off at them; None draws it whole.
        view: direction from the scene to the eye ``(3,)``.
        edges: draw the edges of the facets.

    Returns:
        Images ``(height, width, 4)``, with their margins cut off.

    Raises:
        InputError: if nothing is in the window.
    """
    import pyvista

    # films are smaller
    size = (1600, 1200) if len(points) == 1 else (800, 600)
    table = np.column_stack([np.full(len(faces), faces.shape[1]), faces]).ravel()
    found = []
    for x, v, (at, to) in zip(points, values, arrows):
        surface = pyvista.PolyData(x, table)
        surface["values"] = v
        for axis, (low, high) in enumerate(() if window is None else window):
            for bound, side in ((low, -1.0), (high, 1.0)):
                surface = surface.clip(normal=side * np.eye(3)[axis], origin=bound * np.eye(3)[axis])
        if not surface.n_cells:
            raise InputError(f"window = {np.ravel(box).tolist()}: no part of the scene is in it")
        with _quiet():
            plotter = pyvista.Plotter(off_screen=True, window_size=size)
            plotter.add_mesh(
                surface, scalars="values", cmap=colours, n_colors=colours.N, clim=(0, colours.N), show_scalar_bar=False, show_edges=edges,
                edge_color="black", edge_opacity=0.35, line_width=size[0] / 1600, ambient=0.7, diffuse=0.3, specular=0.0,
            )  # fmt: skip
            shown = ((at >= box[:, 0]) & (at <= box[:, 1])).all(axis=1)
            if shown.any():
                plotter.add_arrows(
                    at[shown], to[shown], color="white", show_edges=True, edge_color="gray", line_width=size[0] / 1600
                )
            up = (0.0, 0.0, 1.0) if np.hypot(*view[:2]) > 0 else (0.0, 1.0, 0.0)
            plotter.view_vector(view, up)
            plotter.reset_camera(bounds=box.ravel())
            found.append(np.array(plotter.screenshot(None, transparent_background=True, return_img=True)))
            plotter.close()
    seen = np.any([image[..., 3] > 0 for image in found], axis=0)
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    return [image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] for image in found]


@contextmanager
def _quiet() -> Iterator[None]:
    """VTK warns where there is no screen before it does without one."""
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)
