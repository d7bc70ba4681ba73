"""How methods are measured: one point per scene, method and parameter, and comparisons of all points together.

Times are the median of warm runs, from the making of the problem to its last state; the first run, in which forms are compiled,
is not counted, and reading the mesh and measuring errors are off the clock.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
from common import comm
from benchmarks import methods
from benchmarks.scene import Scene
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.algebra.kept_factor import MOST_SOLVES

Point = dict[str, Any]

#: Parameters that are tried: multiples of E/h of the softer body, of the barrier parts of h.
SWEEPS: dict[str, tuple[float | None, ...]] = {
    "united": (None,),
    "mortar": (None,),
    "lagrange": (None,),
    "penalty": (1.0, 10.0, 100.0, 1e3, 1e4),
    "penalty_surface": (1.0, 100.0, 1e4),
    "augmented": (1.0, 10.0, 100.0),
    "barrier": (0.1, 0.01, 0.001),
    "proximal": (1e-4, 1e-3, 1e-2, 0.1),
}
#: Condition numbers are found up to this number of unknowns.
CONDITION_UP_TO = 9000
#: What is measured of a run.
ERRORS = ("error_energy", "error_l2", "error_pressure", "error_force", "overlap")
LEVELS = (2e-2, 1e-2, 1e-3, 1e-4)
#: A parameter that takes so many times as long as the best is not tried again.
SLOW = 5.0
#: What decides which method is first; the energy of a bar after impact is mostly in the oscillations that its mesh leaves, and friction has
#: none.
DECISIVE = {"bar_impact": "error_l2", "cattaneo": "error_pressure"}


def measure(scene: Scene, method: str, parameter: float | None = None, runs: int = 5, *, progress: bool = False) -> Point:
    """Solve a scene several times by one method (collective).

    Args:
        scene: what to solve.
        method: one of ``methods.ALL``.
        parameter: multiple of the scene's stiffness, or of its h (barrier).
        runs: that are timed; with none the first counts.
        progress: print the point.

    Returns:
        The point. A method that failed has no errors but ``failed``, the name of what was raised.
    """
    scale = scene.h if method == "barrier" else scene.stiffness
    point: Point = {
        "problem": scene.problem,
        "method": method,
        "parameter": parameter,
        "degree": scene.degree,
        "dofs": scene.dofs,
    }
    point |= {"h": scene.h, **scene.facts}
    point |= dict.fromkeys(("seconds", *ERRORS, "newton_iterations", "linear_iterations", "condition"))
    seconds = []
    try:
        for _ in range(runs + 1):
            scene.u.x.array[:] = 0.0
            contact, options = scene.contact(), scene.options(method)
            forms.free_petsc_garbage(comm)
            comm.barrier()
            start = time.perf_counter()
            problem = methods.create(
                method, scene.F, scene.u, parameter=None if parameter is None else parameter * scale, bcs=scene.bcs,
                contacts=[contact], scale=scene.stiffness, petsc_options_prefix="precision_", **options,
            )  # fmt: skip
            steps = list(scene.run(problem))
            seconds.append(max(comm.allgather(time.perf_counter() - start)))
    except uem.UEMError as error:
        point["failed"] = type(error).__name__
    else:
        point["seconds"] = float(np.median(seconds[min(1, runs) :]))
        point |= scene.errors(problem, contact, steps)
        point["newton_iterations"], point["linear_iterations"] = methods.counts(steps)
        if comm.size == 1 and scene.dofs <= CONDITION_UP_TO:
            point["condition"] = methods.condition_number(problem)
    if progress and comm.rank == 0:
        what = point.get("failed") or f"error {decisive(point):.2e} in {point['seconds']:.2f} s"
        facts = ", ".join(f"{key} {value:g}" if isinstance(value, float) else str(value) for key, value in scene.facts.items())
        print(
            f"{scene.problem} ({facts}), degree {scene.degree}, {scene.dofs} d.o.f., {method} {parameter or ''}: {what}",
            file=sys.stderr, flush=True,
        )  # fmt: skip
    return point


def sweep(
    make: Callable[[int], Scene], sizes: Sequence[int], names: Iterable[str], runs: int, *, progress: bool = False
) -> list[Point]:
    """Points of several methods on a sequence of meshes (collective).

    All parameters are tried on all meshes but the last; there only the best one of the mesh before, and the next. One that
    failed, or took several times as long as the best, is not tried on finer meshes.

    Args:
        make: scene of a size.
        sizes: coarse to fine.
        names: of the methods.
        runs: that are timed; with none the first counts.
        progress: print every point.
    """
    points: list[Point] = []
    tried = {name: SWEEPS[name] for name in names}
    for i, size in enumerate(sizes):
        scene = make(size)
        for name, parameters in tried.items():
            here = [measure(scene, name, p, runs, progress=progress) for p in parameters]
            points += here
            winner = best(here)
            if winner is None or len(parameters) == 1:
                continue
            fast = [p["parameter"] for p in here if p["seconds"] is not None and p["seconds"] <= SLOW * winner["seconds"]]
            k = fast.index(winner["parameter"])
            tried[name] = tuple(fast[k : k + 2] if i == len(sizes) - 2 else fast)
    return points


def best(points: Iterable[Point]) -> Point | None:
    """Of points on one mesh that with the smallest error, or a cheaper one whose error is hardly larger."""
    found = [p for p in points if decisive(p) is not None]
    if not found:
        return None
    bound = 1.02 * min(map(decisive, found))
    return min((p for p in found if decisive(p) <= bound), key=lambda p: p["seconds"])


def decisive(point: Point) -> Any:
    """The error that methods are compared by; None where there is none."""
    return point[DECISIVE.get(point["problem"], "error_energy")]


def label(point: Point) -> str:
    """The scene of a point, without its size."""
    texts = [point["problem"]] + ([f"degree {point['degree']}"] if point["degree"] else [])
    texts += [point[key] for key in ("meshes",) if point.get(key)]
    texts += [f"E {point['ratio']:g} : 1"] if point.get("ratio") else []
    return ", ".join(texts)


def grouped(points: Iterable[Point], key: Callable[[Point], Any]) -> dict[Any, list[Point]]:
    """Points by a key, in order of appearance."""
    groups: dict[Any, list[Point]] = {}
    for point in points:
        groups.setdefault(key(point), []).append(point)
    return groups


def name_of(point: Point) -> str:
    """The method with what it comes in several kinds of."""
    return ", ".join([point["method"], *(point[key] for key in ("scheme", "contactors") if point.get(key))])


def at_a_glance(points: list[Point]) -> list[dict[str, str]]:
    """For every scene and method the cheapest point below each level of the decisive error; a star marks the first."""
    rows = []
    for scene, group in grouped(points, label).items():
        by_method = grouped(group, name_of)
        cheapest: dict[float, dict[str, Point]] = {}
        for level in LEVELS:
            for name, own in by_method.items():
                # errors below the accuracy of the reference are not known
                known = [p for p in own if decisive(p) is not None and level > p.get("reference", 0.0)]
                reached = [p for p in known if decisive(p) <= level]
                if reached:
                    cheapest.setdefault(level, {})[name] = min(reached, key=lambda p: p["seconds"])
        for name, own in by_method.items():
            row = {"scene": scene, "method": name}
            for level in LEVELS:
                there = cheapest.get(level, {})
                first = min(there, key=lambda n: there[n]["seconds"], default="")
                row[f"{100 * level:g} %"] = cell(there[name]) + " *" * (name == first) if name in there else "-"
            smallest = min((decisive(p) for p in own if decisive(p) is not None), default=None)
            row["smallest error"] = "failed" if smallest is None else f"{smallest:.1e}"
            rows.append(row)
    return rows


def at_equal_error(points: list[Point]) -> list[dict[str, Any]]:
    """For every scene the smallest error that all its methods reach, and the seconds that each takes for it, the quickest first.

    Between two meshes the seconds are interpolated, as powers of the error.
    """
    rows = []
    for scene, group in grouped(points, label).items():
        curves = {}
        for name, own in grouped((p for p in group if decisive(p) is not None), lambda p: p["method"]).items():
            # what takes longer for a larger error is left out
            front = [p for p in own if not any(q["seconds"] < p["seconds"] and decisive(q) <= decisive(p) for q in own)]
            curves[name] = np.array(sorted((decisive(p), p["seconds"]) for p in front)).T
        if len(curves) < 2:
            continue
        error = max(curve[0, 0] for curve in curves.values())
        seconds = {name: float(np.exp(np.interp(np.log(error), *np.log(curve)))) for name, curve in curves.items()}
        rows.append({"scene": scene, "error": float(error)} | dict(sorted(seconds.items(), key=lambda item: item[1])))
    return rows


def cell(point: Point) -> str:
    """Cost of a point in a table."""
    parameter = "" if point["parameter"] is None else f", {point['parameter']:g}"
    return f"{point['seconds']:.2g} s ({point['dofs']} d.o.f.{parameter})"


def rate(points: Sequence[Point], error: str = "error_energy") -> float | None:
    """Power of h by which an error falls from the last mesh but one to the last, of the best point on each."""
    meshes = [p for group in grouped(points, lambda p: p["h"]).values() if (p := best(group))]
    if len(meshes) < 2:
        return None
    coarse, fine = meshes[-2:]
    return float(np.log(coarse[error] / fine[error]) / np.log(coarse["h"] / fine["h"]))


def machine() -> dict[str, str]:
    """What the times were measured on."""
    cpu, blas = platform.processor() or platform.machine(), "unknown"
    if Path("/proc/cpuinfo").exists():
        models = [
            line.partition(":")[2].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
        ]
        cpu = models[0] if models else cpu
        libraries = {line.split("/")[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "blas" in line.lower()}
        blas = ", ".join(sorted(name for name in libraries if name.startswith(("libblas", "libopenblas")))) or blas
    return {
        "processor": cpu,
        "cores": str(os.cpu_count()),
        "ranks": str(comm.size),
        "threads": os.environ.get("OMP_NUM_THREADS", "not set"),
        "BLAS": blas,
        "DOLFINx": dolfinx.__version__,
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "NumPy": np.__version__,
        "Python": platform.python_version(),
    }


def linear_work(history: list, set_ups: int, iterative: bool) -> float:
    """Iterations of an iterative solver; factorisations of a direct one, of which solves by one that is kept are a part each."""
    solves = sum(i.linear_iterations for i in history)
    # as many solves by an old factorisation take as long as a new one in small problems, and no longer in others
    return float(solves) if iterative else set_ups + (solves - set_ups) / MOST_SOLVES
