"""Work-precision pictures: error against time and against unknowns with measured slopes, and condition numbers, one curve a method.

Where a method has a parameter the curve is the best of them on each mesh, and what the others gave are dots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import comm
from benchmarks.measure import DECISIVE, Point, best, grouped, label, name_of

import uem_dolfinx as uem

MARKERS = "osv^D*Px"
AXES = {"seconds": "time [s]", "dofs": "degrees of freedom", "dt": "time step", "condition": "condition number"}
ERRORS = {
    "error_energy": "error in energy norm",
    "error_l2": "error of the displacement in $L_2$",
    "error_pressure": "error of the contact pressure or friction in $L_2$",
}


def curve(points: Sequence[Point], x: str, y: str, mesh: Callable[[Point], Any]) -> list[Point]:
    """The best point on every mesh that has both figures."""
    winners = [best(group) for group in grouped(points, mesh).values()]
    return [p for p in winners if p is not None and p[x] is not None and p[y]]


def slope(points: Sequence[Point], x: str, y: str) -> float | None:
    """Slope through all points of a curve in logarithms."""
    if len(points) < 2:
        return None
    return float(np.polyfit(np.log([p[x] for p in points]), np.log([p[y] for p in points]), 1)[0])


def draw(panel: Any, points: Sequence[Point], x: str, y: str, title: str = "") -> None:
    """Draw the points of all methods into a panel; None on other ranks than 0."""
    if panel is None:
        return
    varied = "dt" if "dt" in points[0] else "dofs"
    for i, (name, own) in enumerate(grouped(points, name_of).items()):
        shown = curve(own, x, y, lambda p: p[varied])
        parameters = {p["parameter"] for p in own}
        text = name + (", best" if len(parameters) > 1 else "")
        power = slope(shown, x, y) if x != "seconds" else None
        text += "" if power is None else f", slope {power:.2f}"
        color, marker = f"C{i}", MARKERS[i % len(MARKERS)]
        front = {"zorder": 3, "lw": 2.0} if name.startswith(("united", "mortar")) else {"lw": 1.0}
        panel.loglog([p[x] for p in shown], [p[y] for p in shown], marker + "-", color=color, ms=5, label=text, **front)
        others = [p for p in own if p not in shown and p.get(x) and p.get(y)]
        panel.loglog([p[x] for p in others], [p[y] for p in others], ".", color=color, alpha=0.35, ms=4)
    panel.set(xlabel=AXES[x], ylabel=ERRORS.get(y) or AXES[y])
    for axis in (panel.xaxis, panel.yaxis):
        tidy(axis)
    panel.set_title(title, fontsize=10)
    panel.grid(alpha=0.25, which="both")
    panel.legend(frameon=False, fontsize=7)


def tidy(axis: Any) -> None:
    """Number an axis of less than two decades at 1, 2 and 5, and only there."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    if high < 100 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_scene(path: Path, points: Sequence[Point]) -> None:
    """One picture of one scene: time, unknowns or time step, and condition numbers (collective)."""
    in_time = "dt" in points[0]
    y = DECISIVE.get(points[0]["problem"], "error_energy")
    last = ("dt", "error_pressure") if in_time else ("dofs", "condition")
    with uem.figure(path, comm, panels=3, size=(5.4, 4.6)) as panels:
        draw(panels[0], points, "seconds", y, label(points[0]))
        draw(panels[1], points, "dt" if in_time else "dofs", y)
        draw(panels[2], points, *last)


def draw_all(path: str, points: Sequence[Point]) -> list[str]:
    """A picture of every scene in the folder of ``path``, which itself shows up to three of them against time (collective).

    Returns:
        The names of the pictures.
    """
    main, scenes = Path(path), grouped(points, label)
    names = []
    for name, group in scenes.items():
        plain = "_".join("".join(c if c.isalnum() else " " for c in name).split())
        names.append(str(main.with_name(f"{main.stem}_{plain}{main.suffix}")))
        draw_scene(Path(names[-1]), group)
    chosen = [group for group in scenes.values() if "dt" not in group[0]]
    chosen = [max(own, key=len) for own in grouped(chosen, lambda g: (g[0]["problem"], g[0]["degree"])).values()][:3]
    if chosen:
        with uem.figure(main, comm, panels=len(chosen), size=(5.4, 4.6)) as panels:
            for panel, group in zip(panels, chosen):
                draw(panel, group, "seconds", DECISIVE.get(group[0]["problem"], "error_energy"), label(group[0]))
    return [str(main), *names]
