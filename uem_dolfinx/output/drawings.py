"""Drawing of deformed bodies into the panel of a figure, 2D by matplotlib, 3D by PyVista, uniform for all frames of a film."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.results import ManyContacts
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import check_values
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.output.frames import Frame, Gathering, Pieces, Shape, grid
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: A field that varies by less is uniform, and drawn in one colour. Points that are outside the window by less are in it; smaller forces
#: have no arrow, and smaller prescribed values are zero. In searches for outlines nearer points are one.
#: [convention; largest value, window's size, largest force; test_pictures.py::test_a_field_that_is_the_same_everywhere]
EVEN = 1e-9
#: Colours of surfaces without contact pressure, and of rigid surfaces.
NO_PRESSURE, RIGID = "#d2d2d2", "#b2b2b2"
#: Scenes that are wider than this have their colour bar above. [format; height of the scene; -]
BAR_ABOVE = 1.8
#: Colour of contact forces, which viridis does not have.
FORCE = "#d62728"
#: Largest number of colours, as many as colour maps have. [format; colours; -]
MOST_COLOURS = 256
#: Largest side of a picture: a square of this side takes 1 GB. [bound; points; -]
LARGEST = 2**14
FIELD = "a scalar expression, a contact or several, or None for the size of the displacement"


class Drawing:
    """Collects frames and draws them (the constructor is collective); arguments and errors as in :func:`plot_scene`."""

    def __init__(
        self, problem: UnitedProblem, *, field: Any, label: str, levels: int | Sequence[float], scale: float,
        window: Sequence[float] | None, mirror: bool, cells: bool, arrows: bool | None, cmap: str, view: str | Sequence[float] | None,
        surface: Part | None, percentiles: Sequence[float] | None, rigid: bool, triad: bool,
    ):  # fmt: skip
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        # the pressure of a contact is drawn as the contact itself: up to date, and grey where it is open
        field = next((one for one in problem.declared if field is not None and field is one._fields.get("pressure")), field)
        gdim, pressed = problem.config.gdim, isinstance(field, Contact | ManyContacts)
        with agreed(problem.comm):
            for what, flag in (("mirror", mirror), ("cells", cells), ("arrows", arrows), ("rigid", rigid), ("triad", triad)):
                if flag is not None:
                    given.flag(what, flag)
            for name, value in ({"mirror": mirror} if gdim == 3 else {"surface": surface}).items():
                _refuse_of_other_dimension(gdim, name, value)
            if np.ndim(levels) == 0:
                levels = given.count("levels", levels)
            elif len(levels) < 2 or not (np.diff(given.vector("levels", levels, len(levels))) > 0).all():  # type: ignore[arg-type]
                raise InputError(given.sentence("levels", levels, "the number of colours, or two or more bounds that grow"))
            if (levels if isinstance(levels, int) else len(levels) - 1) > MOST_COLOURS:
                raise InputError(given.sentence("levels", levels, f"no more than {MOST_COLOURS} colours"))
            if isinstance(field, (list, tuple)) and len(field):
                pressed = bool(given.items("field", field, lambda one: isinstance(one, Contact | ManyContacts), "a contact"))
            elif not (field is None or pressed or getattr(field, "ufl_shape", None) == ()):
                raise InputError(given.sentence("field", field, FIELD))
            scale = given.number("scale", scale)
            box = checked_window(gdim, window)
            if percentiles is not None:
                least, most = given.vector("percentiles", percentiles, 2)
                if not 0 <= least < most <= 100:
                    raise InputError(
                        given.sentence("percentiles", percentiles, "two of them, from 0 to 100, the smaller one first")
                    )
            self.view = checked_view(gdim, view)
            found = np.array([problem.config.x.min(axis=0, initial=np.inf), -problem.config.x.max(axis=0, initial=-np.inf)])
            if hasattr(field, "ufl_shape"):
                check_values("field", field, problem.config.mesh.ufl_domain(), "the displacement's mesh")
            if problem.comm.rank == 0:
                _check_colours(cmap)
        if gdim == 3:
            from uem_dolfinx.output import pictures3d

            pictures3d.require(problem.comm)
            low, high = reduced(problem.comm, found, op=MPI.MIN) * [[1.0], [-1.0]]
            if view is None and box is not None:
                # towards the sections, where the window cuts at one side
                self.view = np.where((box[:, 0] > low) & (box[:, 1] >= high), -1.0, 1.0) * self.view
        size = "|u|" if problem.config.moves else problem.u.name
        self.label = label or (size if field is None else "contact pressure" if pressed else "")
        self.levels, self.window, self.mirror, self.cells, self.cmap = levels, window, mirror, cells, cmap
        self.percentiles, self.triad, self.pressed = percentiles, triad, pressed
        self.comm = problem.comm
        gathering = Gathering(problem, field, scale, gdim == 2 if arrows is None else bool(arrows), surface, box, rigid)
        self.take, self.pieces = gathering.take, gathering.pieces

    def over(self, frames: Sequence[Frame], width: int) -> Drawn:
        """Draws these frames, on rank 0, with one window, colours and scale of arrows; images of 3D scenes have a ``width`` in points."""
        assert self.pieces is not None
        if frames[0].x.shape[1] == 3:
            return Drawn3D(self, self.pieces, frames, width)
        return Drawn2D(self, self.pieces, frames)


def checked_view(gdim: int, view: str | Sequence[float] | None) -> Array:
    """Direction from the scene to the eye ``(3,)``, with the errors of ``plot_scene``."""
    if gdim == 2:
        _refuse_of_other_dimension(gdim, "view", view)
    return given.direction("view", (1.0, 1.0, 1.0) if view is None or (isinstance(view, str) and view == "iso") else view, 3)  # type: ignore[arg-type]


def checked_window(gdim: int, window: Sequence[float] | None) -> Array | None:
    """Bounds ``(gdim, 2)``, None for everything, with the errors of ``plot_scene``."""
    if window is None:
        return None
    ends = given.vector("window", window, 2 * gdim).reshape(gdim, 2)
    if not (np.diff(ends) > 0).all():
        raise InputError(given.sentence("window", window, "on each axis a lower bound and a larger upper one"))
    return ends


def checked_size(size: Any, dpi: float, rows: int = 1, columns: int = 1) -> tuple[float, float]:
    """Width and height in inches of a panel of a picture with ``rows`` and ``columns``, with the errors of ``plot_scene``."""
    width, height = given.vector("size", size, 2)
    if not min(width, height) > 0:
        raise InputError(given.sentence("size", size, "a positive width and height in inches"))
    across, high = columns * width * dpi, rows * height * dpi
    if min(width, height) * dpi < 1.0 or max(across, high) > LARGEST:
        raise InputError(
            f"size = {given.shown(size)} makes a picture of {across:.4g} by {high:.4g} points: expected at most {LARGEST} on a side, and "
            "a point in each panel at least; take another size or dpi, or other numbers of panels"
        )
    return float(width), float(height)


def _check_colours(name: Any) -> None:
    """Refuse a colour map that matplotlib does not know; without matplotlib, drawing raises the error."""
    with suppress(ImportError):
        from matplotlib import colormaps
        from matplotlib.colors import Colormap

        if not isinstance(name, Colormap):
            known = list(colormaps)
            given.kind("cmap", name, isinstance(name, str), "the name of a colour map of matplotlib, or one of them")
            if name not in known:
                remedy = given.did_you_mean(name, known, "matplotlib.colormaps lists them")
                raise InputError(given.sentence("cmap", name, "the name of a colour map of matplotlib", remedy))


def _refuse_of_other_dimension(gdim: int, name: str, value: Any) -> None:
    if value is not None and value is not False:
        raise InputError(f"{name} = {given.shown(value)} is for {5 - gdim}D scenes, this one is {gdim}D: leave it out")


class Drawn(ABC):
    """Frames with a common window, common bounds of colours and a common colour bar."""

    def __init__(self, how: Drawing, pieces: Pieces, frames: Sequence[Frame]):
        self.how, self.pieces, self.frames = how, pieces, frames
        self.box = self._everything() if how.window is None else np.reshape(how.window, (-1, 2))
        if how.window is None and any(f.rigid for f in frames):
            sides = np.diff(self.box, axis=1)
            self.box = self.box + np.minimum(0.06 * sides.max(), 0.25 * sides) * np.array([-1.0, 1.0])
        # sides of bodies at the limits of the window are visible, in spite of rounding
        self.box = self.box + EVEN * np.diff(self.box, axis=1) * np.array([-1.0, 1.0])
        seen = np.concatenate([self._seen(f) for f in frames])
        if not len(seen):
            seen = np.concatenate([f.values for f in frames])
        least, most = float(seen.min()), float(seen.max())
        # values outside the percentiles have the end colours
        ends = (least, most) if how.percentiles is None else np.percentile(seen, how.percentiles)
        #: Bounds of the colours.
        self.bounds = np.array(
            how.levels if not isinstance(how.levels, int) else _bounds(float(ends[0]), float(ends[1]), how.levels), dtype=float
        )
        if how.pressed and self.bounds[0] == 0.0:
            self.bounds[0] = EVEN * self.bounds[-1]
        self.extend = "neither"  # ends of the colour bar with an arrow
        if not isinstance(how.levels, int) or how.percentiles is not None or how.pressed:
            self.extend = ("neither", "min", "max", "both")[int(least < self.bounds[0]) + 2 * int(most > self.bounds[-1])]
        self.cmap = _colours(how.cmap, how.pressed)

    def _everything(self) -> Array:
        """Bounds of all frames ``(gdim, 2)``."""
        return np.stack(
            [np.min([f.x.min(axis=0) for f in self.frames], axis=0), np.max([f.x.max(axis=0) for f in self.frames], axis=0)],
            axis=1,
        )

    def _shown(self, x: Array) -> Array:
        """Mask of points in the window."""
        return np.asarray(((x >= self.box[:, 0]) & (x <= self.box[:, 1])).all(axis=1))

    def _seen(self, frame: Frame) -> Array:
        """Values with colours in the window ``(n,)``, of vertices and of sections."""
        corners = frame.cuts[0].reshape(-1, 3)[:, : len(self.box)]
        return np.concatenate([frame.values[self._shown(frame.x)], frame.cuts[1].ravel()[self._shown(corners)]])

    def _arrows(self, frame: Frame) -> tuple[Array, Array]:
        """Contact forces per tributary area: positions and arrows ``(n, gdim)``; the longest is an eighth of the picture."""
        longest = max((float(p.max(initial=0.0)) for f in self.frames for _, _, p in f.forces), default=0.0)
        # of its second largest side, since a surface may be flat
        unit = 0.125 * np.sort(np.ravel(np.diff(self.box, axis=1)))[-2] / (longest or 1.0)
        none = np.zeros((0, frame.x.shape[1]))
        found = [(none, none)]
        for at, force, pressure in frame.forces:
            size = np.linalg.norm(force, axis=1)
            # vertices of quadratic triangles have pressures, but forces of rounding only
            pressed = size > EVEN * size.max(initial=0.0)
            found.append((at[pressed], unit * force[pressed] / size[pressed, None] * pressure[pressed, None]))
        where, arrows = (np.concatenate(part) for part in zip(*found))
        return where, arrows

    @abstractmethod
    def draw(self, ax: Any, frame: Frame) -> None:
        """Draw a frame into a panel."""


def _bounds(least: float, most: float, levels: int) -> Array:
    """Rounded bounds of a number of colours; a single colour for uniform values."""
    from matplotlib.ticker import MaxNLocator

    if most - least <= EVEN * max(abs(least), abs(most)):
        return 0.5 * (least + most) + 0.05 * (max(abs(least), abs(most)) or 1.0) * np.array([-1.0, 1.0])
    return np.asarray(MaxNLocator(levels).tick_values(least, most))


def _colours(name: str, pressed: bool) -> Any:
    """A colour map, for pressures with grey for zero."""
    from matplotlib.cm import ScalarMappable

    colours = ScalarMappable(cmap=name).cmap
    return colours.with_extremes(under=NO_PRESSURE) if pressed else colours


class Drawn2D(Drawn):
    """Coloured cells, their edges, the colour bar, contact forces as arrows."""

    @property
    def sides(self) -> tuple[float, ...]:
        """Signs of x that are drawn."""
        return (1.0, -1.0) if self.how.mirror else (1.0,)

    def _everything(self) -> Array:
        box = super()._everything()
        if self.how.mirror:
            box[0, 0] = -box[0, 1]
        return np.asarray(box + 0.02 * np.diff(box, axis=1).max() * np.array([-1.0, 1.0]))

    def _shown(self, x: Array) -> Array:
        return np.any([super(Drawn2D, self)._shown(x * [side, 1.0]) for side in self.sides], axis=0)

    def _seen(self, frame: Frame) -> Array:
        # also of cells that reach into the window with none of their vertices
        seen = self._shown(frame.x)
        for side in self.sides:
            corners = (frame.x * [side, 1.0])[self.pieces.faces]
            inside = (corners.max(axis=1) >= self.box[:, 0]) & (corners.min(axis=1) <= self.box[:, 1])
            seen[self.pieces.faces[inside.all(axis=1)]] = True
        return np.asarray(frame.values[seen])

    def draw(self, ax: Any, frame: Frame) -> None:
        """Draw a frame into a panel."""
        from matplotlib.collections import LineCollection

        how = self.how
        for side in self.sides:
            x = frame.x * [side, 1.0]
            coloured = ax.tricontourf(
                *x.T, self.pieces.faces, frame.values, levels=self.bounds, cmap=self.cmap, extend=self.extend
            )
            if how.cells:
                ax.add_collection(LineCollection(x[self.pieces.edges], colors="k", linewidths=0.25, alpha=0.35))
        add_colour_bar(ax, coloured, how.label, float(np.divide(*np.diff(self.box, axis=1).ravel())))
        for shape in frame.rigid:
            draw_rigid(ax, shape, self.box, how.mirror)
        ax.set(xlim=self.box[0], ylim=self.box[1], aspect="equal", xlabel="x", ylabel="y")
        at, arrows = self._arrows(frame)
        for side in self.sides if len(at) else ():
            ax.quiver(
                *(at * [side, 1.0]).T, *(arrows * [side, 1.0]).T, angles="xy", scale_units="xy", scale=1.0,
                color=FORCE, edgecolor="w", linewidth=0.4, units="inches", width=0.03, zorder=3,
            )  # fmt: skip


def add_colour_bar(ax: Any, colours: Any, label: str, aspect: float, **how: Any) -> None:
    """A colour bar as long as a scene whose width is ``aspect`` times its height: to its right, or above a scene that is flat."""
    from matplotlib.transforms import Bbox

    above, inset = aspect > BAR_ABOVE, ax.inset_axes((0.0, 0.0, 1.0, 1.0))

    def place(*_: Any) -> Any:
        """Where it is in the figure, whatever the panel's shape."""
        points, inch = ax.figure.transFigure, ax.figure.dpi
        scene = ax.get_position().transformed(points)
        if above:
            bar = Bbox.from_bounds(scene.x0, scene.y1 + 0.12 * inch, scene.width, 0.16 * inch)
        else:
            bar = Bbox.from_bounds(scene.x1 + 0.12 * inch, scene.y0, 0.16 * inch, scene.height)
        return bar.transformed(points.inverted())

    inset.set_axes_locator(place)
    ax.figure.colorbar(colours, cax=inset, label=label, orientation="horizontal" if above else "vertical", **how)
    if above:
        inset.xaxis.set_ticks_position("top")
        inset.xaxis.set_label_position("top")


def draw_rigid(ax: Any, shape: Shape, box: Array, mirror: bool = False, **line: Any) -> None:
    """Draw a rigid surface in a box ``(2, 2)``, hatched behind it; ``line`` are options of matplotlib's contour for its boundary."""
    (x, y), points = grid(box, 400)
    if mirror:
        points[:, 0] = np.abs(points[:, 0])
    height = shape.height(points).reshape(len(y), len(x))
    if np.nanmin(height) < 0 < np.nanmax(height):
        ax.contourf(x, y, height, levels=[np.nanmin(height), 0.0], colors=RIGID, hatches=["////"], alpha=0.6, zorder=0.5)
        ax.contour(x, y, height, levels=[0.0], **({"colors": "k", "linewidths": 0.8, "zorder": 2} | line))


class Drawn3D(Drawn):
    """An image of the bodies' surface by PyVista, with matplotlib's colour bar."""

    def __init__(self, how: Drawing, pieces: Pieces, frames: Sequence[Frame], width: int):
        super().__init__(how, pieces, frames)
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import BoundaryNorm, ListedColormap

        from uem_dolfinx.output import pictures3d

        n = len(self.bounds) - 1
        colours = ListedColormap(self.cmap(np.linspace(0.0, 1.0, n))).with_extremes(under=self.cmap.get_under())
        self.colours = ScalarMappable(BoundaryNorm(self.bounds, n), colours)
        look = pictures3d.Look(
            colours, NO_PRESSURE if how.pressed else None, self.box, how.window is not None, how.view, how.cells, width, EVEN
        )
        solids = [
            pictures3d.Solid(f.x, self._between(f.values), (f.cuts[0], self._between(f.cuts[1])), self._arrows(f), f.rigid)
            for f in frames
        ]
        images = pictures3d.images(pieces.faces, solids, look)
        self.images = {id(f): image for f, image in zip(frames, images)}

    def _between(self, values: Array) -> Array:
        """Values as numbers of colours from 0; negative for zero pressure."""
        number = np.interp(values, self.bounds, np.arange(len(self.bounds)))
        return np.where(values < self.bounds[0], -1.0, number) if self.how.pressed else number

    def draw(self, ax: Any, frame: Frame) -> None:
        """Draw a frame into a panel."""
        image = self.images[id(frame)]
        ax.imshow(image)
        ax.axis("off")
        add_colour_bar(
            ax, self.colours, self.how.label, image.shape[1] / image.shape[0], extend=self.extend, spacing="proportional"
        )
        if self.how.triad:
            draw_triad(ax, self.how.view, image.shape[1] / image.shape[0])


def draw_triad(ax: Any, view: Array, aspect: float) -> None:
    """The axes of the scene as the eye sees them, at the lower left of a panel whose width is ``aspect`` times its height."""
    from uem_dolfinx.output import pictures3d

    right, up = pictures3d.screen(view)
    # as large in small and narrow panels as in others
    extent, inch = ax.get_window_extent(), ax.figure.dpi
    wide = 0.7 * inch / min(extent.width, aspect * extent.height)
    high = aspect * wide
    inset = ax.inset_axes((-0.4 * wide, -0.4 * high, wide, high))
    for name, axis in zip("xyz", np.eye(3)):
        to = np.array([axis @ right, axis @ up])
        inset.annotate("", to, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "lw": 1.0, "color": "k", "shrinkA": 0, "shrinkB": 0})
        if np.linalg.norm(to) > 0.2:
            inset.text(*(1.35 * to), name, ha="center", va="center", fontsize=8)
    inset.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal")
    inset.axis("off")
