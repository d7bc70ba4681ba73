"""Pictures of 2D scenes, of pressure profiles and of whatever else is drawn into their panels, gathered to rank 0 for drawing alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.errors import InputError, MissingBackendError, OutputError
from uem_dolfinx.files import REMEDY
from uem_dolfinx.parallel import agree, agreed
from uem_dolfinx.solve.problem import UnitedProblem

#: Gmsh and DOLFINx nodes of a cell's triangles, by cell.
TRIANGLES = {"triangle": [[0, 1, 2]], "quadrilateral": [[0, 1, 3], [0, 3, 2]]}
#: Outline of a cell, by cell.
OUTLINE = {"triangle": [0, 1, 2, 0], "quadrilateral": [0, 1, 3, 2, 0]}


@contextmanager
def figure(
    path: str | Path | None, comm: MPI.Comm, panels: int = 1, size: tuple[float, float] = (6.4, 4.8)
) -> Iterator[list[Any]]:
    """Canvas with panels side by side, saved at the end; the backend of matplotlib stays as it is (collective).

    Args:
        path: name of the picture; its folder is made. None draws nothing.
        comm: communicator; rank 0 draws, and to it alone everything is gathered.
        panels: number of panels.
        size: width and height of a panel in inches.

    Yields:
        The panels: matplotlib Axes on rank 0, None elsewhere. Hand them to :func:`plot_scene` and :func:`plot_pressure`.

    Raises:
        MissingBackendError: if matplotlib cannot be imported.
        OutputError: if the picture cannot be written.
        Exception: what rank 0 raises in drawing, on all ranks.
    """
    if path is None or comm.rank != 0:
        agree(comm, None)
        with agreed(comm):
            yield [None] * panels
        return
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as missing:
        agree(comm, MissingBackendError(f"the picture {path} needs matplotlib ({missing}): install it, or leave the picture out"))
        raise
    agree(comm, None)
    with agreed(comm):
        canvas = Figure(figsize=(panels * size[0], size[1]), constrained_layout=True)
        FigureCanvasAgg(canvas)
        yield list(np.atleast_1d(canvas.subplots(1, panels)))
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            canvas.savefig(path, dpi=150, bbox_inches="tight")
        except OSError as error:
            raise OutputError(f"the picture {path} cannot be written ({error}): {REMEDY}") from error


@contextmanager
def _panel(picture: str | Path | Any, comm: MPI.Comm) -> Iterator[Any]:
    """The panel that is given, or the one of a picture of this name; what is raised in drawing is raised on all ranks (collective)."""
    if isinstance(picture, (str, Path)):
        with figure(picture, comm) as (panel,):
            yield panel
    else:
        with agreed(comm):
            yield picture


def plot_scene(
    problem: UnitedProblem,
    picture: str | Path | Any,
    *,
    field: Any = None,
    label: str = "",
    levels: int | Sequence[float] = 12,
    scale: float = 1.0,
    window: tuple[float, float, float, float] | None = None,
    mirror: bool = False,
    cells: bool = True,
    arrows: bool = True,
    cmap: str = "viridis",
) -> None:
    """Draw a 2D scene where it is now, coloured by a field, contact forces per area as arrows (collective).

    Args:
        problem: the scene.
        picture: name of the picture, or a panel of :func:`figure` (None where rank is not 0).
        field: scalar UFL expression, averaged at the nodes of each body; None is the size of the displacement.
        label: of the colour bar.
        levels: number of colours, or their bounds.
        scale: magnification of the displacement.
        window: ``(x_min, x_max, y_min, y_max)`` to show; None shows everything.
        mirror: draw the reflection at ``x = 0`` too, for half models.
        cells: draw the edges of the cells.
        arrows: draw the contact forces per tributary area, on the contactors.
        cmap: colour map.

    Raises:
        MissingBackendError: if matplotlib cannot be imported.
        InputError: if the scene is not 2D.
    """
    if problem.config.gdim != 2:
        dimension = f"this one has dimension {problem.config.gdim}"
        raise InputError(f"plot_scene draws 2D scenes, {dimension}: open the XDMF file in ParaView")
    config, comm = problem.config, problem.comm
    if field is None:
        field, label = ufl.sqrt(ufl.dot(problem.u, problem.u)), label or "|u|"
    x, values = _vertex_positions(problem, scale), nodal_average(field, config.mesh)
    triangles, outline = _vertex_cells(config.mesh)
    parts = comm.gather((x, triangles, outline, values))
    forces = [_gather_contactors(contact, scale) for contact in problem.contacts] if arrows else []
    with _panel(picture, comm) as panel:
        if panel is None or parts is None:
            return
        start = np.cumsum([0, *(len(p[0]) for p in parts)])
        shifted = [(x, t + s, o + s, v) for (x, t, o, v), s in zip(parts, start)]
        x, triangles, outline, values = (np.concatenate(part) for part in zip(*shifted))
        _draw_scene(panel, x, triangles, outline, values, levels, label, window, mirror, cells, cmap)
        longest = max((float(p.max(initial=0.0)) for _, _, p in forces), default=0.0)
        for at, force, pressure in forces:
            _draw_arrows(panel, at, force, pressure, longest, mirror)


def outline(problem: UnitedProblem, scale: float = 1.0) -> Array | None:
    """Where the bodies of a 2D scene end now: segments ``(n, 2, 2)`` on rank 0, None elsewhere (collective).

    Args:
        problem: the scene.
        scale: magnification of the displacement.
    """
    mesh = problem.config.mesh
    around = _vertex_cells(mesh)[1]
    numbers = (
        compat.function_space(mesh, 1).dofmap.index_map.local_to_global(around.ravel().astype(np.int32)).reshape(around.shape)
    )
    edges = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=2).reshape(-1, 2)
    ends = _vertex_positions(problem, scale)[around]
    segments = np.stack([ends[:, :-1], ends[:, 1:]], axis=2).reshape(-1, 2, problem.config.gdim)
    parts = problem.comm.gather((edges, segments))
    if parts is None:
        return None
    edges, segments = (np.concatenate(part) for part in zip(*parts))
    # a side that two cells have is inside
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(segments[first[count == 1]])


def _draw_scene(
    ax: Any, x: Array, triangles: Ints, outline: Ints, values: Array, levels: int | Sequence[float], label: str,
    window: tuple[float, float, float, float] | None, mirror: bool, cells: bool, cmap: str,
) -> None:  # fmt: skip
    """Coloured cells, their edges, the colour bar."""
    from matplotlib.collections import LineCollection
    from matplotlib.ticker import MaxNLocator

    if window is None:
        lo, hi = x.min(axis=0), x.max(axis=0)
        pad = 0.02 * (hi - lo).max()
        window = ((-hi[0] if mirror else lo[0]) - pad, hi[0] + pad, lo[1] - pad, hi[1] + pad)
    used = np.isin(np.arange(len(x)), triangles)
    reach = np.abs(x[:, 0]) if mirror else x[:, 0]
    shown = used & (reach <= window[1]) & (x[:, 1] >= window[2]) & (x[:, 1] <= window[3])
    seen = values[shown] if shown.any() else values[used]
    least, most, coloured = float(seen.min()), float(seen.max()), None
    bounds: Any = MaxNLocator(levels).tick_values(least, most) if isinstance(levels, int) else levels
    extend = ("neither", "min", "max", "both")[int(least < bounds[0]) + 2 * int(most > bounds[-1])]
    for side in (1.0, -1.0) if mirror else (1.0,):
        y = x * [side, 1.0]
        coloured = ax.tricontourf(y[:, 0], y[:, 1], triangles, values, levels=bounds, cmap=cmap, extend=extend)
        if cells:
            ax.add_collection(LineCollection(y[outline], colors="k", linewidths=0.25, alpha=0.35))
    ax.figure.colorbar(coloured, ax=ax, label=label, shrink=0.85)
    ax.set(xlim=window[:2], ylim=window[2:], aspect="equal", xlabel="x", ylabel="y")


def _draw_arrows(ax: Any, at: Array, force: Array, pressure: Array, longest: float, mirror: bool) -> None:
    """Contact pressures in the direction of the contact forces, the longest an eighth of the picture."""
    size = np.linalg.norm(force, axis=1)
    pressed = size > 0
    if not pressed.any():
        return
    at, arrow = at[pressed], force[pressed] / size[pressed, None] * pressure[pressed, None]
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    unit = longest / (0.125 * min(right - left, top - bottom))
    for side in (1.0, -1.0) if mirror else (1.0,):
        ax.quiver(
            side * at[:, 0], at[:, 1], side * arrow[:, 0], arrow[:, 1], angles="xy", scale_units="xy", scale=unit,
            color="w", edgecolor="k", linewidth=0.4, width=0.005, zorder=3,
        )  # fmt: skip


def plot_pressure(
    contacts: Contact | Sequence[Contact],
    picture: str | Path | Any,
    *,
    along: Callable[[Array], Array] | None = None,
    reference: Callable[[Array], Array] | None = None,
    reference_label: str = "reference",
    label: str = "contact pressure",
    along_label: str | None = None,
    window: tuple[float, float] | None = None,
    mirror: bool = False,
) -> None:
    """Draw the contact pressure at the contactors over a coordinate (collective).

    Args:
        contacts: one contact or several.
        picture: name of the picture, or a panel of :func:`figure`.
        along: coordinate of reference points ``(n, gdim)`` to draw over ``(n,)``; None is x in 2D, and in 3D the distance
            from the axis through the origin, ``sqrt(x^2 + y^2)``.
        reference: exact pressure as a function of that coordinate.
        reference_label: in the legend.
        label: of the pressure axis.
        along_label: of the other axis.
        window: part of the coordinate to show; None shows half as much again as the pressed part.
        mirror: draw the reflection at 0 too, for half models.

    Raises:
        MissingBackendError: if matplotlib cannot be imported.
    """
    pairs: list[Contact] = list(contacts) if isinstance(contacts, Sequence) else [contacts]
    found = [_gather_contactors(contact, 0.0) for contact in pairs]
    with _panel(picture, pairs[0].config.comm) as ax:
        if ax is None:
            return
        gdim = pairs[0].config.gdim
        along = along or ((lambda x: x[:, 0]) if gdim == 2 else (lambda x: np.hypot(x[:, 0], x[:, 1])))
        curves = [(along(at), pressure) for at, _, pressure in found]
        pressed = np.concatenate([s[p > 0] for s, p in curves])
        if window is None:
            lo, hi = (pressed.min(), pressed.max()) if len(pressed) else (0.0, 1.0)
            lo = -hi if mirror else (0.0 if gdim == 3 else lo)
            window = (lo - 0.25 * (hi - lo) if lo < 0 or gdim == 2 else lo, hi + 0.25 * (hi - lo))
        if reference is not None:
            s = np.linspace(*window, 1001)
            ax.plot(s, reference(s), color="0.25", lw=1.2, label=reference_label, zorder=1)
        for contact, (s, p) in zip(pairs, curves):
            if mirror:
                s, p = np.concatenate([-s, s]), np.concatenate([p, p])
            ax.plot(s, p, ".", ms=7 if len(p) < 400 else 3, label=contact.name if len(pairs) > 1 else "contactors", zorder=2)
        ax.set(xlim=window, xlabel=along_label or ("x" if gdim == 2 else "r"), ylabel=label)
        ax.set_ylim(bottom=0.0)
        ax.grid(alpha=0.25)
        ax.legend(frameon=False)


def nodal_average(expression: Any, mesh: Any) -> Array:
    """Scalar UFL expression averaged over the cells around each d.o.f. of the mesh's P1 space ``(n_local incl. ghosts,)`` (collective)."""
    S = compat.function_space(mesh, 1)
    v, total = ufl.TestFunction(S), fem.Function(S)
    cells = fem.Function(compat.function_space(mesh, ("DG", 0)))
    compat.interpolate_expression(cells, expression)
    sums = []
    for weight in (cells, fem.Constant(mesh, 1.0)):
        own = forms.assemble_array(S, forms.form(weight * v * ufl.dx))
        total.x.array[: len(own)] = own
        total.x.scatter_forward()
        sums.append(np.array(total.x.array))
    return np.divide(sums[0], sums[1], out=np.zeros_like(sums[0]), where=sums[1] != 0)


def _vertex_positions(problem: UnitedProblem, scale: float) -> Array:
    """Displaced positions of the d.o.f. of the mesh's P1 space ``(n_local incl. ghosts, gdim)``."""
    config = problem.config
    u = fem.Function(compat.function_space(config.mesh, 1, (config.gdim,)))
    u.interpolate(problem.u)
    u.x.scatter_forward()
    moved = u.x.array.reshape(-1, config.gdim)
    return np.array(u.function_space.tabulate_dof_coordinates()[: len(moved), : config.gdim] + scale * moved)


def _vertex_cells(mesh: Any) -> tuple[Ints, Ints]:
    """Owned cells by d.o.f. of the P1 space: their triangles ``(n, 3)`` and outlines ``(n_cells, n_nodes + 1)``."""
    name, owned = compat.cell_name(mesh), mesh.topology.index_map(2).size_local
    dofs = compat.cell_dofs(compat.function_space(mesh, 1))[:owned].astype(np.int64)
    return np.concatenate([dofs[:, t] for t in TRIANGLES[name]]), dofs[:, OUTLINE[name]]


def _gather_contactors(contact: Contact, scale: float) -> tuple[Array, Array, Array]:
    """Positions, displaced by ``scale`` times the displacement, forces and pressures of all contactors on rank 0 (collective)."""
    config, nodes = contact.config, contact.pair.nodes
    at = config.X[nodes] + scale * config.displacement[nodes]
    # points have no area; their forces stand for themselves
    size = contact.pressures if contact.contactor.dim else contact.pair.trial.nodal
    parts = config.comm.gather((at, contact.pair.trial.force, size)) or [(at[:0], at[:0], np.zeros(0))]
    return tuple(np.concatenate(columns) for columns in zip(*parts))  # type: ignore[return-value]
