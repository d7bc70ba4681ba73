"""Drawing of a sketch of a problem's declarations into a panel, 2D by matplotlib, 3D by PyVista; bodies are grey."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.output import pictures3d
from uem_dolfinx.output.acting import Acting
from uem_dolfinx.output.declared import Declared, Surface
from uem_dolfinx.output.drawings import EVEN, draw_rigid, draw_triad

#: Greys of bodies, in turn, and the colour of surfaces held in all components.
SHADES, CLAMPED = ("#e9e9e9", "#d3d3d3", "#dedede", "#c8c8c8"), "#303030"
#: Opacity of these and of rigid surfaces in 3D.
THROUGH = {"opacity": 0.55}
#: Contactors and targets of a contact, of the next one, and so on.
PAIRS = (
    ("#d62728", "#1f77b4"), ("#ff8c00", "#139b9b"), ("#c2188b", "#27348b"), ("#8c564b", "#7a8b00"), ("#e6ab02", "#5b2a86"),
    ("#ff6f91", "#00695c"),
)  # fmt: skip
#: Colours of conditions and loads by kind.
COLOURS = {
    "held": "#303030", "prescribed": "#1a7f37", "value": "#1a7f37", "load": "#a0440a", "body load": "#a0440a", "velocity": "#6a2c91",
    "spring": "#139b9b", "equation": "#c2188b", "turn": "#a0440a", "arm": "#303030", "own": "#000000",
}  # fmt: skip
#: First kinds in the legend.
FIRST = ("surface", "rigid", "clamped", "held", "arrow")
#: Kinds whose arrows also show sizes.
SIZED = ("prescribed", "body load", "velocity")


@dataclass(frozen=True)
class Look:
    """Options of a sketch."""

    arrows: Sequence[tuple[Array, Array, str]]  # further arrows: positions, directions and names
    cells: bool  # draw the edges of the cells
    window: Array | None  # bounds of the visible part ``(gdim, 2)``; None shows everything
    view: Array  # direction from the scene to the eye ``(3,)``, in 3D
    legend: bool  # draw a legend
    triad: bool  # draw the axes in a corner, in 3D
    width: int  # of an image of a 3D scene, in points


def thinned(points: Array, spacing: float) -> Ints:
    """Numbers ``(k,)`` of points ``(n, gdim)`` at least a spacing apart, with all other points within this spacing of one of them.

    The selection does not depend on the order of the points.
    """
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros(0, dtype=np.int64)
    # rounding must not determine their order
    order = np.lexsort(np.round(points / spacing, 6).T)
    tree, left, found = cKDTree(points), np.ones(len(points), dtype=bool), []
    for i in order:
        if left[i]:
            found.append(i)
            left[tree.query_ball_point(points[i], spacing)] = False
    return np.array(found, dtype=np.int64)


class Sketch:
    """Symbols, arrows and names of a sketch, in 2D and 3D."""

    def __init__(self, found: Declared, look: Look):
        self.found, self.look = found, look
        corners = found.cells.reshape(-1, found.cells.shape[-1])
        ends = np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1) if look.window is None else look.window
        #: Longest side, and lengths of symbols and arrows.
        self.size = float(np.diff(ends, axis=1).max())
        flat = len(ends) == 2
        self.tick, self.unit = (0.025 if flat else 0.032) * self.size, 0.11 * self.size
        self.spacing = 2.0 if flat else 3.5  # distance between symbols of one kind, in these lengths
        #: Whether all contacts share one pair of colours, because there are too many.
        self.many = 1 + max((s.pair for s in found.surfaces), default=0) > len(PAIRS)
        #: Colours of drawn items by kind of symbol and name.
        self.names: dict[tuple[str, str], str] = {}
        self.triangles = list(self._triangles())
        self.arrows = list(self._arrows())
        seen = [ends.T, *(part for _, *both in self.arrows for part in (both[0], both[0] + both[1]))]
        seen += [rigid.at[None] + way for rigid in found.rigid for way in (0.0, rigid.way[None])]
        seen += [tips - 1.5 * self.tick * along for tips, along in self.triangles]
        inside = np.concatenate(seen)
        self.box = np.stack([inside.min(axis=0), inside.max(axis=0)], axis=1) if look.window is None else ends
        if look.window is None:
            self.box += (0.1 if found.rigid else 0.03) * self.size * np.array([-1.0, 1.0])

    def _name(self, kind: str, name: str, colour: str) -> str:
        """Add an item to the legend; returns the colour."""
        self.names.setdefault((kind, name), colour)
        return colour

    def acting(self, *kinds: str) -> Iterator[Acting]:
        """Conditions and loads of some kinds."""
        return (one for one in self.found.acting if one.kind in kinds)

    def colour_of(self, pair: int, side: str) -> str:
        """Colour of one side of a contact."""
        return PAIRS[0 if self.many else pair % len(PAIRS)][int(side == "target")]

    def name_surface(self, surface: Surface) -> str:
        """Colour of a surface, which is added to the legend."""
        count = 1 + max(s.pair for s in self.found.surfaces)
        name = (f"{count} contacts: contactors", "their targets")[int(surface.side == "target")] if self.many else surface.name
        return self._name("surface", name, self.colour_of(surface.pair, surface.side))

    def _triangles(self) -> Iterator[tuple[Array, Array]]:
        """Symbols of held components: tips ``(n, gdim)``, and unit vectors in which they point ``(n, gdim)``."""
        for one in self.acting("held"):
            for c, axis in enumerate(np.eye(one.at.shape[1])):
                which = np.flatnonzero(one.vectors[:, c] > 0)
                which = which[thinned(one.at[which], self.spacing * self.tick)]
                if len(which):
                    # symbols are outside of the body
                    side = np.where(one.outward[which, c] > EVEN, -1.0, 1.0)
                    self._name("held", "held component", COLOURS["held"])
                    yield one.at[which], side[:, None] * axis

    def _arrows(self) -> Iterator[tuple[str, Array, Array]]:
        """Colours, tails and arrows ``(n, gdim)``."""
        largest = {
            kind: max((np.linalg.norm(one.vectors, axis=1).max() for one in self.acting(kind)), default=1.0) for kind in SIZED
        }
        for one in self.acting("prescribed", "load", "body load", "velocity"):
            size = np.linalg.norm(one.vectors, axis=1)
            shown = np.flatnonzero(size > EVEN * size.max())
            # arrows along a surface would overlap
            along = np.abs(np.einsum("ng,ng->n", one.vectors[shown], one.outward[shown])).sum() < 0.5 * size[shown].sum()
            along &= one.outward[shown].any()
            shown = shown[thinned(one.at[shown], (1.3 if along else 0.35 * self.spacing) * self.unit)]
            length = size[shown] / largest[one.kind] if one.kind in SIZED and one.name != "gravity" else np.ones(len(shown))
            vectors = self.unit * (length / size[shown])[:, None] * one.vectors[shown]
            # the tips of arrows towards the body are on the surface
            pushes = np.einsum("ng,ng->n", vectors, one.outward[shown]) < -EVEN * self.unit
            colour = self._name("arrow", one.name, COLOURS[one.kind])
            yield colour, one.at[shown] - np.where(pushes[:, None], vectors, 0.0), vectors
        for rigid in self.found.rigid:
            if (length := np.linalg.norm(rigid.way)) > EVEN * self.size:
                colour = self._name("arrow", "motion of a rigid surface", COLOURS["prescribed"])
                yield colour, rigid.at[None], self.unit / length * rigid.way[None]
        for place, vector, name in self.look.arrows:
            scaled = self.unit / np.linalg.norm(vector) * vector
            yield self._name("arrow", name, COLOURS["own"]), place[None], scaled[None]

    def legend(self, ax: Any, tall: bool) -> None:
        """Draw the legend to the right of a ``tall`` picture, otherwise below the picture."""
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        handles, flat = [], self.found.cells.shape[-1] == 2
        markers = {"held": "^", "arrow": r"$\rightarrow$", "turn": r"$\circlearrowleft$", "arm": "P", "value": "s"}
        named = sorted(self.names.items(), key=lambda item: FIRST.index(item[0][0]) if item[0][0] in FIRST else len(FIRST))
        for (kind, name), colour in named:
            size = 13 if kind in ("arrow", "turn") else 7
            line: dict[str, Any] = {"color": colour, "label": name, "linestyle": "none", "markersize": size}
            if kind == "held" and flat:
                line["markerfacecolor"] = "w"
            if kind == "surface":
                handles.append(Line2D([], [], color=colour, label=name, linewidth=3.5))
            elif kind in ("clamped", "rigid"):
                flat_face = {"facecolor": "#e0e0e0" if kind == "rigid" else "w", "edgecolor": colour, "hatch": "////"}
                handles.append(Patch(label=name, **(flat_face if flat else {"color": colour, "alpha": THROUGH["opacity"]})))
            else:
                handles.append(Line2D([], [], marker=markers.get(kind, "o"), **line))
        if tall:
            where: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)}
        else:
            columns = min(len(handles), 3 if max((len(name) for _, name in self.names), default=0) < 30 else 2)
            # below the ticks and the name of an axis
            where = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 4.4 if flat else 1.5, "ncol": columns}
        if handles and self.look.legend:
            ax.legend(handles=handles, frameon=False, fontsize=8.5, handlelength=1.6, **where)


def draw_2d(ax: Any, found: Declared, look: Look) -> Sketch:
    """Draw a plane scene into a panel."""
    from matplotlib.collections import LineCollection, PolyCollection

    sketch = Sketch(found, look)
    tick = sketch.tick
    faces = [SHADES[b % len(SHADES)] for b in found.body]
    # edges in the colour of the cells, so that there are no visible gaps
    edge = {"edgecolors": "0.55", "linewidths": 0.25} if look.cells else {"edgecolors": "face", "linewidths": 0.3}
    ax.add_collection(PolyCollection(found.cells, facecolors=faces, zorder=1, **edge))
    ax.add_collection(LineCollection(found.outside, colors="0.25", linewidths=0.8, zorder=1.5))
    if found.axis:
        ax.axvline(0.0, color="0.2", linewidth=0.8, linestyle=(0, (8, 3, 1.5, 3)), zorder=2)
    for rigid in found.rigid:
        colour = sketch._name("rigid", rigid.name, sketch.colour_of(rigid.pair, "target"))
        draw_rigid(ax, rigid.shape, sketch.box, colors=[colour], linewidths=1.8)
    for surface in found.surfaces:
        colour = sketch.name_surface(surface)
        inside = surface.corners - (0.3 + 0.5 * surface.layer) * tick * surface.normals[:, None]
        ax.add_collection(LineCollection(inside, colors=colour, linewidths=2.6, zorder=3, capstyle="round"))
        ax.plot(*surface.points.T, "o", color=colour, markersize=4.5, zorder=3.5)
    _draw_clamped(ax, sketch)
    for tips, along in sketch.triangles:
        across = 0.45 * tick * np.stack([-along[:, 1], along[:, 0]], axis=1)
        back = tips - 0.9 * tick * along
        corners = np.stack([tips, back + across, back - across], axis=1)
        ax.add_collection(PolyCollection(corners, facecolors="w", edgecolors=COLOURS["held"], linewidths=0.9, zorder=4))
    _draw_points(ax, sketch)
    for colour, tails, ways in sketch.arrows:
        ax.quiver(
            *tails.T, *ways.T, angles="xy", scale_units="xy", scale=1.0, units="inches", color=colour, width=0.025, headwidth=4.2,
            zorder=5,
        )  # fmt: skip
    ax.set(xlim=sketch.box[0], ylim=sketch.box[1], aspect="equal", xlabel="x", ylabel="y")
    width, height = np.diff(sketch.box, axis=1)[:, 0]
    sketch.legend(ax, width < height)
    return sketch


def _draw_clamped(ax: Any, sketch: Sketch) -> None:
    """Draw surfaces held in all components: a line, hatched outside."""
    from matplotlib.collections import LineCollection

    corners, normals = sketch.found.clamped
    if not len(corners):
        return
    tick, colour = sketch.tick, sketch._name("clamped", "held in all components", CLAMPED)
    count = np.ceil(4.0 * np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1) / tick).astype(int) + 1
    of = np.repeat(np.arange(len(corners)), count)
    part = np.concatenate([np.linspace(0.0, 1.0, n) for n in count])[:, None]
    at = corners[of, 0] * (1.0 - part) + corners[of, 1] * part
    some = thinned(at, 0.8 * tick)
    n = normals[of[some]]
    lean = n + 0.8 * np.stack([-n[:, 1], n[:, 0]], axis=1)
    hatches = np.stack([at[some], at[some] + 0.8 * tick * lean], axis=1)
    ax.add_collection(LineCollection(hatches, colors=colour, linewidths=0.8, zorder=2.5))
    ax.add_collection(LineCollection(corners, colors=colour, linewidths=1.6, zorder=2.6))


def _draw_points(ax: Any, sketch: Sketch) -> None:
    """Draw nodes of equations, springs, prescribed values, rigid parts with their points, and moments or rotations."""
    from matplotlib.collections import LineCollection

    for one in sketch.acting("arm"):
        colour = sketch._name("arm", one.name, COLOURS["arm"])
        some = thinned(one.at, 3.0 * sketch.tick)
        ends = np.stack([one.at[some], one.at[some] + one.vectors[some]], axis=1)
        ax.add_collection(LineCollection(ends, colors=colour, linewidths=0.6, alpha=0.6, zorder=3))
        ax.plot(*ends[:1, 1].T, "P", color=colour, markersize=8, zorder=5)
    for one in sketch.acting("value", "spring", "equation"):
        colour = sketch._name(one.kind, one.name, COLOURS[one.kind])
        some = thinned(one.at, 2.0 * sketch.tick)
        ax.plot(*one.at[some].T, "s" if one.kind == "value" else "o", color=colour, markersize=4.5, zorder=4.5)
    for one in sketch.acting("turn"):
        colour = sketch._name("turn", one.name, COLOURS["turn"])
        marker = r"$\circlearrowleft$" if one.vectors[0, 0] > 0 else r"$\circlearrowright$"
        ax.plot(*one.at[:1].T, marker=marker, color=colour, markersize=20, linestyle="none", zorder=5)


def draw_3d(ax: Any, found: Declared, look: Look) -> Sketch:
    """Draw a 3D scene into a panel."""
    sketch = Sketch(found, look)
    with pictures3d.quiet():
        (image,) = pictures3d.without_margins([_image(sketch)])
    ax.imshow(image)
    ax.axis("off")
    if look.triad:
        draw_triad(ax, look.view, image.shape[1] / image.shape[0])
    sketch.legend(ax, image.shape[1] < 1.4 * image.shape[0])
    return sketch


def _image(sketch: Sketch) -> Array:
    """The image of a 3D scene, with transparent bodies."""
    import pyvista

    found, look, tick = sketch.found, sketch.look, sketch.tick
    plotter = pyvista.Plotter(off_screen=True, window_size=(look.width, 3 * look.width // 4))
    plotter.enable_depth_peeling(8)
    line = look.width / 1600
    for body in range(found.body.max() + 1):
        skin = _soup(found.cells[found.body == body])
        colour = SHADES[body % len(SHADES)]
        plotter.add_mesh(skin, color=colour, opacity=0.4, show_edges=look.cells, edge_color="gray", ambient=0.6, diffuse=0.4)
        outline = pictures3d.outlines(skin, EVEN)
        if outline.n_cells:
            plotter.add_mesh(outline, color="#505050", line_width=1.8 * line)
    for rigid in found.rigid:
        colour = sketch._name("rigid", rigid.name, sketch.colour_of(rigid.pair, "target"))
        pictures3d.add_rigid(plotter, rigid.shape, sketch.box, color=colour, **THROUGH)
    for surface in found.surfaces:
        colour = sketch.name_surface(surface)
        if len(surface.corners):
            inside = _soup(surface.corners - (0.1 + 0.2 * surface.layer) * tick * surface.normals[:, None])
            plotter.add_mesh(inside, color=colour, opacity=0.85, ambient=0.5, diffuse=0.5)
        _add_points(plotter, surface.points, colour, 0.4 * tick)
    if len(found.clamped[0]):
        plotter.add_mesh(_soup(found.clamped[0]), color=sketch._name("clamped", "held in all components", CLAMPED), **THROUGH)
    for tips, along in sketch.triangles:
        cones = pyvista.PolyData(tips - 0.45 * tick * along)
        cones["along"] = along
        cone = pyvista.Cone(center=(0, 0, 0), direction=(1, 0, 0), height=0.9 * tick, radius=0.35 * tick, resolution=12)
        plotter.add_mesh(cones.glyph(orient="along", scale=False, geom=cone), color=COLOURS["held"])
    for one in sketch.acting("arm"):
        colour = sketch._name("arm", one.name, COLOURS["arm"])
        some = thinned(one.at, 3.0 * tick)
        ends = np.stack([one.at[some], one.at[some] + one.vectors[some]], axis=1).reshape(-1, 3)
        plotter.add_lines(ends, color=colour, width=line)
        _add_points(plotter, ends[1:2], colour, 0.6 * tick)
    for one in sketch.acting("value", "spring", "equation"):
        colour, some = sketch._name(one.kind, one.name, COLOURS[one.kind]), thinned(one.at, 2.0 * tick)
        _add_points(plotter, one.at[some], colour, 0.35 * tick)
    every = list(sketch.arrows)
    for one in sketch.acting("turn"):
        vector = sketch.unit * one.vectors[:1] / np.linalg.norm(one.vectors[0])
        every.append((sketch._name("turn", one.name, COLOURS["turn"]), one.at[:1], vector))
    for colour, tails, vectors in every:
        arrows = pyvista.PolyData(tails)
        arrows["vector"] = vectors
        arrow = pyvista.Arrow(tip_length=0.35, tip_radius=0.11, shaft_radius=0.035)
        plotter.add_mesh(arrows.glyph(orient="vector", scale="vector", geom=arrow), color=colour, ambient=0.4)
    return pictures3d.taken(plotter, look.view, sketch.box)


def _soup(corners: Array) -> Any:
    """PyVista's surface of unconnected facets ``(m, k, 3)``."""
    return pictures3d.polygons(corners.reshape(-1, 3), np.arange(corners[..., 0].size).reshape(corners.shape[:2]))


def _add_points(plotter: Any, points: Array, colour: str, radius: float) -> None:
    """Balls at points ``(n, 3)``."""
    import pyvista

    if len(points):
        plotter.add_mesh(pyvista.PolyData(points).glyph(scale=False, geom=pyvista.Sphere(radius=radius)), color=colour)
