"""Pictures of scenes, setups and pressure profiles, with panels for further plots; data are gathered to rank 0 for drawing only."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.results import ManyContacts
from uem_dolfinx.errors import InputError, InputTypeError, MissingBackendError, OutputError
from uem_dolfinx.files import REMEDY
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.output.drawings import Drawing, checked_size, checked_view, checked_window
from uem_dolfinx.output.frames import gather_contactors
from uem_dolfinx.parallel import agreed, ask
from uem_dolfinx.solve.problem import UnitedProblem

#: Width of a picture of several panels: on a page 736 pixels wide letters of 10 points have 10. [format; inches; -]
PAGE = 10.0
#: Margin of a picture. [format; inches; -]
MARGIN = 0.1
PICTURE = "the name of a picture, an open file, or a panel of uem.figure"


class Picture:
    """A picture in memory: Jupyter shows it if it is the value of a cell.

    Attributes:
        png: its bytes; empty on ranks other than 0.
    """

    def __init__(self, png: bytes):
        self.png = png

    def _repr_png_(self) -> bytes | None:
        return self.png or None


def new_canvas(what: str, size: tuple[float, float]) -> Any:
    """Figure of this size in inches, without a window; a MissingBackendError that names ``what`` if matplotlib cannot be imported."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as missing:
        raise MissingBackendError(f"{what} needs matplotlib ({missing}): install it, or leave it out") from missing
    canvas = Figure(figsize=size, constrained_layout=True)
    FigureCanvasAgg(canvas)
    return canvas


def _check_ending(path: str | Path, known: Sequence[str]) -> None:
    """Refuse a picture in a format that matplotlib does not write; without an ending it is a .png."""
    ending = Path(path).suffix
    if ending and ending[1:].lower() not in known:
        remedy = given.did_you_mean(ending, [f".{one}" for one in known], "rename it")
        raise InputError(given.sentence("picture", str(path), f"a name that ends in .{', .'.join(known)}", remedy))


@contextmanager
def figure(
    path: str | Path | BinaryIO | None,
    comm: MPI.Comm,
    panels: int = 1,
    size: tuple[float, float] | None = None,
    dpi: float = 150,
    columns: int | None = None,
) -> Iterator[list[Any]]:
    """Canvas with panels in rows, saved at the end; the backend of matplotlib is not changed (collective).

    Args:
        path: name of the picture, whose folder is made, or an open file. None draws nothing.
        comm: communicator; data are gathered to rank 0, which draws.
        panels: number of panels.
        size: width and height of a panel in inches. None is (6.4, 4.8), or less for several panels, so that letters of 10 points
            are legible where the whole picture is as wide as a page.
        dpi: points of the picture per inch; ``.pdf`` and ``.svg`` have vector graphics instead, except for images of 3D scenes.
            The text ``Panels`` of a ``.png`` has the corners of each panel, for programs that cut the picture into panels.
        columns: number of panels in a row; None puts all side by side.

    Yields:
        The panels: matplotlib Axes on rank 0, None elsewhere. Pass them to :func:`plot_scene` and :func:`plot_pressure`.

    Raises:
        InputError, InputTypeError: for an argument out of its range, or a name whose ending is no format of matplotlib.
        MissingBackendError: if matplotlib cannot be imported.
        OutputError: if the picture cannot be written.
        Exception: any error of drawing on rank 0, on all ranks.
    """
    given.kind("comm", comm, isinstance(comm, MPI.Comm), "a communicator, as problem.comm")
    with agreed(comm):
        drawn = path is not None and comm.rank == 0
        dpi = given.number("dpi", dpi, given.POSITIVE)
        panels = given.count("panels", panels)
        columns = panels if columns is None else min(panels, given.count("columns", columns))
        rows, share = -(-panels // columns), PAGE / columns
        size = (min(6.4, share), min(4.8, 1.2 + 0.55 * share)) if size is None else size
        width, height = checked_size(size, dpi, rows, columns)
        canvas = new_canvas(f"the picture {path}", (columns * width, rows * height)) if drawn else None
        if canvas is not None and isinstance(path, (str, Path)):
            _check_ending(path, list(canvas.canvas.get_supported_filetypes()))
    with agreed(comm):
        if path is None or canvas is None:
            yield [None] * panels
            return
        canvas.set_dpi(dpi)
        axes = list(canvas.subplots(rows, columns, squeeze=False).ravel())
        while len(axes) > panels:
            axes.pop().remove()
        yield axes
        try:
            if isinstance(path, (str, Path)):
                Path(path).parent.mkdir(parents=True, exist_ok=True)
            kind = None if isinstance(path, (str, Path)) else "png"
            png = kind or Path(str(path)).suffix.lower() in ("", ".png")
            text = {"Panels": _corners(canvas, axes, dpi)} if png else None
            canvas.savefig(path, format=kind, dpi=dpi, bbox_inches="tight", pad_inches=MARGIN, metadata=text)
        except OSError as error:
            raise OutputError(f"the picture {path} cannot be written ({error}): {REMEDY}") from error


def _corners(canvas: Any, axes: list[Any], dpi: float) -> str:
    """The panels with their labels in the saved picture: ``left,top,right,bottom`` in points from its upper left corner."""
    canvas.draw_without_rendering()
    whole, inches = canvas.get_tightbbox(), canvas.dpi_scale_trans.inverted()
    boxes = [ax.get_tightbbox().transformed(inches) for ax in axes if ax.figure is canvas]
    left, top = whole.x0 - MARGIN, whole.y1 + MARGIN
    ends = np.array([(box.x0 - left, top - box.y1, box.x1 - left, top - box.y0) for box in boxes]).reshape(-1, 4)
    return " ".join(",".join(map(str, one)) for one in np.rint(dpi * ends).astype(int))


@contextmanager
def panel_of(
    picture: str | Path | BinaryIO | Any, comm: MPI.Comm, size: tuple[float, float] = (6.4, 4.8), dpi: float = 150
) -> Iterator[Any]:
    """A given panel, or the panel of a new picture of this name; errors in drawing are raised on all ranks (collective)."""
    if isinstance(picture, (str, Path, BytesIO)):
        with figure(picture, comm, size=size, dpi=dpi) as (panel,):
            yield panel
    else:
        with agreed(comm):
            yield given.kind("picture", picture, picture is None or hasattr(picture, "get_window_extent"), PICTURE)


def _image_width(panel: Any) -> int:
    """Width in points of an image of a 3D scene in a panel."""
    return max(1600, round(2.0 * panel.get_window_extent().width))


def plot_scene(
    problem: UnitedProblem,
    picture: str | Path | Any = ...,
    *,
    field: Any = None,
    label: str = "",
    levels: int | Sequence[float] = 12,
    scale: float = 1.0,
    window: Sequence[float] | None = None,
    mirror: bool = False,
    cells: bool = True,
    arrows: bool | None = None,
    cmap: str = "viridis",
    view: str | Sequence[float] | None = None,
    surface: Part | None = None,
    percentiles: Sequence[float] | None = None,
    rigid: bool = True,
    triad: bool = True,
    size: tuple[float, float] = (6.4, 4.8),
    dpi: float = 150,
) -> Picture | None:
    """Draw the deformed bodies, coloured by a field: the cells in 2D, the surface in 3D (collective).

    Args:
        problem: the problem.
        picture: name of the picture, or a panel of :func:`figure` (None on ranks other than 0). By default the picture is returned, and
            Jupyter shows it.
        field: scalar UFL expression, averaged at the nodes of each body; a scalar Lagrange Function, drawn with its values at the
            vertices. Or a contact, a general contact, its ``pressure`` or a list of contacts, for their pressure, grey elsewhere and where
            they are open; None is the magnitude of the displacement.
        label: of the colour bar.
        levels: number of colours, or their bounds.
        scale: magnification of the displacement.
        window: visible part ``(x_min, x_max, y_min, y_max)``, in 3D with ``z_min, z_max``, where bodies are cut and the field is drawn
            on the sections; None shows everything.
        mirror: draw the reflection at ``x = 0`` too, for half models; 2D only.
        cells: draw the edges of the cells.
        arrows: draw the contact forces per tributary area, on the contactors; the default in 2D. In 3D they are visible if only the
            contactor is drawn, by ``surface``.
        cmap: colour map.
        view: direction from the scene to the eye ``(3,)``; ``"iso"`` is (1, 1, 1), and so is None, with signs by which the
            sections of a ``window`` are seen; 3D only.
        surface: draw only these facets, such as a contactor hidden by bodies: a tag, or any surface of a contact; 3D only.
        percentiles: percentiles of the visible values for the range of colours, such as ``(1, 99)``, so that a few large values, e.g.
            at corners, do not dominate; None uses all values.
        rigid: draw rigid targets.
        triad: draw the axes in a corner; 3D only.
        size: width and height in inches; ignored for a panel of :func:`figure`.
        dpi: points per inch; ignored for a panel of :func:`figure`.

    Returns:
        The picture if it has neither name nor panel.

    Raises:
        MissingBackendError: if matplotlib cannot be imported, or in 3D PyVista.
        InputError, InputTypeError: for an argument that does not exist in this dimension, or out of its range.
    """
    drawing = Drawing(
        problem, field=field, label=label, levels=levels, scale=scale, window=window, mirror=mirror, cells=cells, arrows=arrows,
        cmap=cmap, view=view, surface=surface, percentiles=percentiles, rigid=rigid, triad=triad,
    )  # fmt: skip
    frame, file = drawing.take(), BytesIO()
    with panel_of(file if picture is ... else picture, problem.comm, size, dpi) as panel:
        if panel is not None and frame is not None:
            # margins are cut off
            drawing.over([frame], _image_width(panel)).draw(panel, frame)
    return Picture(file.getvalue()) if picture is ... else None


def plot_setup(
    problem: UnitedProblem,
    picture: str | Path | Any = ...,
    *,
    at: float | None = None,
    loads: bool = True,
    arrows: Sequence[tuple[Any, Any, str]] = (),
    cells: bool = False,
    window: Sequence[float] | None = None,
    view: str | Sequence[float] | None = None,
    legend: bool = True,
    triad: bool = True,
    size: tuple[float, float] = (6.4, 4.8),
    dpi: float = 150,
) -> Picture | None:
    """Draw the setup of a problem: undeformed bodies, supports, prescribed motions, loads, contactors and targets (collective).

    Bodies have different greys. Contactors and targets are coloured and named; rigid targets are hatched, in 3D transparent. Supports
    in all components are hatched, in 3D dark; a triangle, in 3D a cone, is a support along one component, drawn from outside. Arrows
    are prescribed displacements, motions of rigid surfaces, loads on surfaces and points, forces on bodies, gravity and the initial
    velocity. Arrows of displacements, velocities and forces on bodies are scaled by magnitude, other arrows show directions only.

    Args:
        problem: the problem.
        picture: name of the picture, or a panel of :func:`figure` (None on ranks other than 0). By default the picture is returned, and
            Jupyter shows it.
        at: load factor or time whose loads, Dirichlet values and rigid surfaces are drawn, as the problem's ``load`` sets them; the
            present values are restored. None is the full load in statics, and the present time in dynamics.
        loads: find the loads in the residual: it is assembled at zero displacement, surface integrals separately.
        arrows: further arrows, such as values that are prescribed later: positions, directions ``(gdim,)`` and names.
        cells: draw the edges of the cells.
        window: as in :func:`plot_scene`; bodies are not cut.
        view: direction from the scene to the eye ``(3,)``; None or ``"iso"`` is (1, 1, 1); 3D only.
        legend: draw a legend.
        triad: draw the axes in a corner; 3D only.
        size: width and height in inches; ignored for a panel of :func:`figure`.
        dpi: points per inch; ignored for a panel of :func:`figure`.

    Returns:
        The picture if it has neither name nor panel.

    Raises:
        MissingBackendError: if matplotlib cannot be imported, or in 3D PyVista.
        InputError, InputTypeError: for an argument that does not exist in this dimension, or out of its range.
        UserFunctionError: if a function in ``load`` raises.
    """
    from uem_dolfinx.output.declared import Declarations
    from uem_dolfinx.output.sketches import Look, draw_2d, draw_3d

    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    gdim = problem.config.gdim
    with agreed(problem.comm):
        toward, box = checked_view(gdim, view), checked_window(gdim, window)
        loads, cells, legend, triad = (
            given.flag(name, value) for name, value in (("loads", loads), ("cells", cells), ("legend", legend), ("triad", triad))
        )
        if at is not None:
            at = given.number("at", at)
        elif problem.dynamics is None and problem.stage is None:
            at = 1.0
        for one in arrows:
            given.kind("arrows", arrows, isinstance(one, Sequence) and len(one) == 3, "a list of places, directions and names")
        more = [
            (given.vector("a place in arrows", place, gdim), given.direction("a direction in arrows", way, gdim), str(name))
            for place, way, name in arrows
        ]
    if gdim == 3:
        from uem_dolfinx.output import pictures3d

        pictures3d.require(problem.comm)
    found, file = Declarations(problem, at, loads).found, BytesIO()
    with panel_of(file if picture is ... else picture, problem.comm, size, dpi) as panel:
        if panel is not None and found is not None:
            look = Look(more, cells, box, toward, legend, triad, _image_width(panel))
            (draw_2d if gdim == 2 else draw_3d)(panel, found, look)
    return Picture(file.getvalue()) if picture is ... else None


def plot_pressure(
    contacts: Contact | Sequence[Contact],
    picture: str | Path | Any = ...,
    *,
    along: Callable[[Array], Array] | None = None,
    reference: Callable[[Array], Array] | None = None,
    reference_label: str = "reference",
    contact_label: str = "contactors",
    label: str = "contact pressure",
    along_label: str | None = None,
    window: tuple[float, float] | None = None,
    mirror: bool = False,
) -> Picture | None:
    """Plot the contact pressure at the contactors over a coordinate (collective).

    Args:
        contacts: one contact or several.
        picture: name of the picture, or a panel of :func:`figure`. By default the picture is returned, and Jupyter shows it.
        along: coordinate of reference points ``(n, gdim)`` to draw over ``(n,)``; None is x in 2D, and in 3D the distance
            from the axis through the origin, ``sqrt(x^2 + y^2)``.
        reference: exact pressure as a function of that coordinate.
        reference_label: in the legend.
        contact_label: in the legend, for a single contact; several contacts are labelled by their names.
        label: of the pressure axis.
        along_label: of the other axis.
        window: visible range of the coordinate; None shows the part with pressure, with a margin.
        mirror: draw the reflection at 0 too, for half models.

    Returns:
        The picture if it has neither name nor panel.

    Raises:
        MissingBackendError: if matplotlib cannot be imported.
        InputError, InputTypeError: for an object that is no contact, or a function that does not return one number per point.
        UserFunctionError: if a function raises.
    """
    kinds = Contact | ManyContacts
    listed = [contacts] if isinstance(contacts, kinds) else contacts
    pairs: list[Contact] = given.items("contacts", listed, lambda one: isinstance(one, kinds), "a contact")
    if not pairs:
        raise InputError(given.sentence("contacts", contacts, "a contact or several"))
    with agreed(pairs[0].config.comm):
        shown, mirror = checked_window(1, window), given.flag("mirror", mirror)
    found = [gather_contactors(contact, 0.0) for contact in pairs]
    file = BytesIO()
    with panel_of(file if picture is ... else picture, pairs[0].config.comm) as ax:
        if ax is not None:
            gdim = pairs[0].config.gdim
            along = along or ((lambda x: x[:, 0]) if gdim == 2 else (lambda x: np.hypot(x[:, 0], x[:, 1])))
            curves = [(_curve("along", along, at, len(at)), pressure) for at, _, pressure in found]
            pressed = np.concatenate([s[p > 0] for s, p in curves])
            if shown is None:
                lo, hi = (pressed.min(), pressed.max()) if len(pressed) else (0.0, 1.0)
                lo = -hi if mirror else (0.0 if gdim == 3 else lo)
                shown = np.array([[lo - 0.25 * (hi - lo) if lo < 0 or gdim == 2 else lo, hi + 0.25 * (hi - lo)]])
            if reference is not None:
                s = np.linspace(shown[0, 0], shown[0, 1], 1001)
                ax.plot(s, _curve("reference", reference, s, len(s)), color="0.25", lw=1.2, label=reference_label, zorder=1)
            for contact, (s, p) in zip(pairs, curves):
                if mirror:
                    s, p = np.concatenate([-s, s]), np.concatenate([p, p])
                ax.plot(s, p, ".", ms=7 if len(p) < 400 else 3, label=contact.name if len(pairs) > 1 else contact_label, zorder=2)
            ax.set(xlim=shown[0], xlabel=along_label or ("x" if gdim == 2 else "r"), ylabel=label)
            # margin above uniform pressures
            ax.set_ylim(0.0, max(ax.get_ylim()[1], 1.05 * max(float(p.max(initial=0.0)) for _, p in curves)))
            ax.grid(alpha=0.25)
            ax.legend(frameon=False)
    return Picture(file.getvalue()) if picture is ... else None


def _curve(what: str, f: Callable[[Array], Any], at: Array, n: int) -> Array:
    """Values ``(n,)`` of a function of the user, ``what`` in messages, at n points; raises as ``plot_pressure``, on this rank."""
    found = ask(what, f, at)
    try:
        values = np.asarray(found, dtype=float)
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence(f"{what}(x)", found, f"{n} numbers")) from None
    if values.shape != (n,):
        raise InputError(f"{what}(x) has shape {values.shape}: expected {n} numbers")
    return values
