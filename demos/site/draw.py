"""Pictures of the pages that no demo makes: scripts of how-to pages run as they stand there, and their results are drawn.

.ci/with python demos/site/draw.py FOLDER [PAGE...]        writes FOLDER/page_NAME.png
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

import uem_dolfinx as uem

PAGES = Path(__file__).parent / "howto"
COMM = MPI.COMM_WORLD
FOLDER = Path(sys.argv[1])


def scripts(page: str) -> list[str]:
    """Complete scripts of a page."""
    return re.findall(r"```python\n(from mpi4py.*?)```", (PAGES / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)


def run(page: str, which: int = 0) -> dict[str, Any]:
    """Names that a script of a page has in the end."""
    known: dict[str, Any] = {}
    exec(compile(scripts(page)[which], f"{page}.md", "exec"), known)
    return known


def cyclic(path: Path) -> None:
    """Stress over strain of the bar in cycles, and Masing's rule."""
    strain, stress, masing = np.transpose(run("cyclic")["rows"])
    with uem.figure(path, COMM, size=(5.0, 3.6)) as (panel,):
        panel.plot([0, *(100 * strain)], [0, *masing], "k-", lw=1, label="Masing's rule")
        panel.plot(100 * strain, stress, "o", ms=4, label="computed")
        panel.set(xlabel="strain in %", ylabel="stress in MPa", ylim=(None, 560))
        panel.grid(alpha=0.25)
        panel.legend(frameon=False, loc="upper left")


def staggered(path: Path) -> None:
    """Forces of both scripts over load and stretch, and their closed forms."""
    punch, bar = run("staggered"), run("staggered", 1)
    E, alpha, q, h, d = (punch[name] for name in ("E", "alpha", "q", "h", "d"))
    factor, force = np.transpose(punch["forces"])
    share = np.linspace(0.0, 1.0, 101)
    warm = 0.5 * (E * d * share + np.sqrt((E * d * share) ** 2 + 4 * E * alpha * q / h))
    E, Gc, size = (bar[name] for name in ("E", "Gc", "size"))
    eps, pull = np.transpose(bar["forces"])
    fine = np.linspace(0.0, eps[-1], 101)
    damage = E * size * fine**2 / (Gc + E * size * fine**2)
    with uem.figure(path, COMM, panels=2, size=(5.0, 3.4)) as (left, right):
        left.plot(share, warm, "k-", lw=1, label="closed form")
        left.plot(share, punch["E"] * d * share, "0.6", ls="--", lw=1, label="cold punch")
        left.plot(factor, force, "o", label="warm punch")
        left.set(xlabel="load factor", ylabel="contact force", ylim=(0, None))
        right.plot(fine, (1 - damage) ** 2 * E * fine, "k-", lw=1, label="closed form")
        right.plot(eps, pull, "o", label="phase field")
        right.set(xlabel="strain", ylabel="stress", ylim=(0, None))
        for panel in (left, right):
            panel.grid(alpha=0.25)
            panel.legend(frameon=False, loc="lower right")


def hertz(h: float) -> tuple[uem.UnitedProblem, uem.Contact, Any]:
    """The script of the README."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("hertz_cylinder"), COMM, gdim=2, parameters={"h": h})
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1e6, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.006)]
    contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"])
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="page_"), contact, tags


def meshes(path: Path) -> None:
    """A graded mesh and its tags, and its facets in the contact zone."""
    problem, *_ = hertz(0.02)
    with uem.figure(path, COMM, panels=2, size=(5.0, 4.8), dpi=100) as (left, right):
        uem.plot_setup(problem, left, cells=True)
        problem.solve()
        uem.plot_scene(problem, right, window=(0.0, 0.24, -0.12, 0.12), label="displacement")


def solvers(path: Path) -> None:
    """The table of the page."""
    text = (PAGES / "solvers.md").read_text(encoding="utf-8").replace(",", "")
    rows = re.findall(r"^\| (\d+) \| \d+ \| \d+ \| ([\d.]+) s \| ([\d.]+) s \| ([\d.]+) GB \| ([\d.]+) GB", text, re.MULTILINE)
    unknowns, *columns = np.array(rows, dtype=float).T
    with uem.figure(path, COMM, panels=2, size=(5.0, 3.2)) as panels:
        for panel, pair, label in zip(panels, (columns[:2], columns[2:]), ("CPU time of a solve in s", "memory in GB")):
            for values, name, mark in zip(pair, ("GMRES, field split", "MUMPS"), ("o-", "s--")):
                panel.loglog(unknowns, values, mark, label=name)
            panel.set(xlabel="unknowns", ylabel=label, yscale="linear" if "GB" in label else "log")
            panel.grid(alpha=0.25)
            panel.legend(frameon=False)


def restart(path: Path) -> None:
    """Forces of a run that is left in the middle, of the run that continues from its checkpoint, and of one in one go."""

    def go(folder: str, end: int) -> np.ndarray:
        problem, contact, _ = hertz(0.04)
        rows = []
        with uem.Checkpoint(f"{folder}/run.uem") as checkpoint:
            checkpoint.begin(problem.state())
            for step in uem.load_steps(problem, 10, checkpoint=checkpoint):
                rows.append((step.factor, 2 * contact.resultant().force[1]))
                if step.number >= end:
                    break
        return np.array(rows)

    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
        whole, first, second = go(one, 10), go(two, 4), go(two, 10)
    with uem.figure(path, COMM, size=(5.0, 3.4)) as (panel,):
        panel.plot(*whole.T, "k-", lw=1, label="one run")
        panel.plot(*first.T, "o", label="first run, ended at step 4")
        panel.plot(*second.T, "s", label="second run, from the checkpoint")
        panel.set(xlabel="load factor", ylabel="contact force")
        panel.grid(alpha=0.25)
        panel.legend(frameon=False)


#: Two blocks of which the lower one, the target, ends below the middle of a facet of the upper one.
LEDGE = """SetFactory("OpenCASCADE");
Rectangle(1) = {0, 0, 0, 3, 1}; Rectangle(2) = {-0.5, -1, 0, 2, 1};
Transfinite Curve {1, 3} = 4; Transfinite Curve {2, 4} = 3; Transfinite Curve {5, 7} = 13; Transfinite Curve {6, 8} = 7;
Transfinite Surface {1, 2}; Recombine Surface {1, 2};
Physical Curve("contactor") = {1}; Physical Curve("top") = {3}; Physical Curve("bottom") = {5}; Physical Curve("target") = {7};
Physical Surface("upper") = {1}; Physical Surface("lower") = {2};
"""


def errors(path: Path) -> None:
    """A convex corner of the target inside a facet of the contactor, and with contactors at such corners."""
    with tempfile.TemporaryDirectory() as folder, uem.figure(path, COMM, panels=2, size=(5.0, 3.6)) as panels:
        geo = Path(folder) / "ledge.geo"
        geo.write_text(LEDGE, encoding="utf-8")
        for panel, corners in zip(panels, (False, True)):
            mesh, tags = uem.read_gmsh(geo, COMM, gdim=2)
            V = uem.function_space(mesh, 1, (2,))
            u, v = fem.Function(V), ufl.TestFunction(V)
            F = uem.StVenantKirchhoff(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
            bcs = [uem.dirichlet(V, tags["bottom"]), uem.dirichlet(V, tags["top"], 1, -0.15), uem.dirichlet(V, tags["top"], 0)]
            contact = uem.Contact(tags["contactor"], tags["target"], corners=corners)
            problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
            list(uem.load_steps(problem, 4))
            uem.plot_scene(problem, panel, window=(0.85, 1.85, -0.45, 0.35), label="displacement")
            panel.set_title("" if panel is None else f"corners={corners}", loc="left", pad=10)


def cluster(path: Path) -> None:
    """Stages of the README's scene on a finer mesh: to be drawn in a process of its own, since timings are those of the process."""
    problem, *_ = hertz(0.002)
    list(uem.load_steps(problem, 5))
    rows = re.findall(r"^ *([\d.]+) +(\d+)  (.*)$", str(uem.timings()), re.MULTILINE)
    seconds, times, names = zip(*[row for row in rows if row[2] not in ("read mesh", "compile forms")][:10])
    with uem.figure(path, COMM, size=(6.4, 3.6)) as (panel,):
        bars = panel.barh(range(len(names)), [float(s) for s in seconds], color="C0")
        panel.bar_label(bars, [f" {n} times" for n in times])
        panel.set_yticks(range(len(names)), names)
        panel.invert_yaxis()
        panel.set(xlabel="time in s; stages are nested", xlim=(0, 1.35 * float(seconds[0])))


def elimination(path: Path) -> None:
    """A contactor above a facet of the target: closest point, normal, gap, and nodes of the facet with their shape functions."""
    target = np.array([(-1.2, -0.15), (0.0, 0.0), (2.0, 0.2), (3.2, -0.05)])
    body = np.array([(-0.6, 1.15), (1.1, 0.75), (2.7, 1.0)])
    along = (target[2] - target[1]) / np.linalg.norm(target[2] - target[1])
    n, x = np.array([-along[1], along[0]]), body[1]
    y = target[1] + along * ((x - target[1]) @ along)
    with uem.figure(path, COMM, size=(6.4, 3.2)) as (panel,):
        panel.fill_between(*target.T, -0.9, color="0.88")
        panel.fill_between(*body.T, 1.9, color="0.94")
        panel.plot(*target.T, "o-", color="C0", lw=2)
        panel.plot(*body.T, "o-", color="C3", lw=2)
        panel.plot(*np.transpose([x, y]), "k--", lw=1)
        panel.plot(*y, "ks", ms=5)
        panel.annotate("", y + 0.5 * n - 0.45 * along, y - 0.45 * along, arrowprops={"arrowstyle": "->", "lw": 1.5})
        for text, place in (
            ("contactor $x_i$", x + (-0.4, 0.22)), ("gap $g_i$", 0.5 * (x + y) + (0.1, 0)),
            ("closest point $y = N_1 x_1 + N_2 x_2$", y + (-0.7, -0.6)),
            ("$x_1$", target[1] + (-0.05, -0.28)), ("$x_2$", target[2] + (-0.05, -0.28)), ("$n$", y + 0.5 * n - (0.68, 0.05)),
            ("target", (-1.1, -0.7)), ("body of the contactor", (-0.4, 1.6)),
        ):  # fmt: skip
            panel.text(*place, text)
        panel.set(xlim=(-1.2, 3.2), ylim=(-0.9, 1.9), aspect="equal")
        panel.set_axis_off()


if __name__ == "__main__":
    drawn: dict[str, Callable[[Path], None]] = {
        one.__name__: one for one in (cyclic, staggered, meshes, solvers, restart, errors, cluster, elimination)
    }
    for name in sys.argv[2:] or drawn:
        drawn[name](FOLDER / f"page_{name}.png")
