"""Implicit against explicit steps: error against run time of a bar that hits a wall, in 2D and 3D, against the exact wave.

``PYTHONPATH=demos python -m benchmarks.schemes --json FILE --plot FILE.png`` writes the figures and the picture of the report.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from common import comm
from benchmarks.measure import machine
from benchmarks.scenes import at, box, scene
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

#: The bar, of wave speed 30, from a gap of 0.5 at a speed of 10: touch at 0.05, departure at 0.05 + 2/3.
E, LENGTH, SPEED, GAP, END = 900.0, 10.0, 10.0, 0.5, 0.8
C = np.sqrt(E)
LEAVES = GAP / SPEED + 2 * LENGTH / C
#: Cells along the bar by dimension; in 3D a quarter as many across.
CELLS = {2: (20, 40, 80), 3: (16, 32, 48)}
#: Name, scheme, contactors and mass of each way.
WAYS = (
    ("trapezoidal rule", uem.newmark, "massless", uem.consistent_mass),
    ("generalised alpha", lambda: uem.generalised_alpha(0.8), "massless", uem.consistent_mass),
    ("explicit", uem.CentralDifferences, "massless", uem.lumped_mass),
    ("explicit, massy", uem.CentralDifferences, "massy", uem.lumped_mass),
)


def run(dim: int, cells: int, way: tuple[Any, ...]) -> dict[str, Any]:
    """Errors and time of one run, from the making of the problem to its last state; implicit steps have the length h/c.

    Displacements are compared with the exact ones after the rebound, in L2, over the shortening of the bar.
    """
    name, scheme, contactors, mass = way
    across = 1 if dim == 2 else cells // 4
    kind = "quadrilateral" if dim == 2 else "hexahedron"
    width = 1.0 if dim == 2 else LENGTH / 4
    lo, hi = [0.0] * (dim - 1) + [GAP], [width] * (dim - 1) + [GAP + LENGTH]
    s = scene(comm, kind, [box(kind, lo, hi, [across] * (dim - 1) + [cells])])
    V = compat.function_space(s.mesh, 1, (dim,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    material = uem.LinearElastic(E, 0.0, kind="plane_stress" if dim == 2 else "3d")
    up = np.eye(dim)[-1]
    there = fem.Constant(s.mesh, up * (SPEED * (END - LEAVES) - GAP))
    misplaced = forms.form(ufl.inner(u - there, u - there) * ufl.dx)
    start, history = time.perf_counter(), []
    dynamics = uem.Dynamics(mass(V, 1.0), velocity=tuple(-SPEED * up), scheme=scheme(), contactors=contactors)
    wall = uem.Contact(s.tag("bottom", 0, at(dim - 1, GAP)), uem.RigidPlane(np.zeros(dim), up), name="wall")
    problem = uem.UnitedProblem(
        material.residual(u, v) * ufl.dx,
        u,
        contacts=[wall],
        dynamics=dynamics,
        petsc_options={"ksp_type": "preonly", "pc_type": "lu"},
    )
    explicit = name.startswith("explicit")
    for step in uem.time_steps(
        problem, None if explicit else LENGTH / cells / C, END, event_tolerance=None if explicit else 1e-3
    ):
        history.append(step.dt * float(wall.resultant().force[-1]))
    seconds, area = time.perf_counter() - start, width ** (dim - 1)
    return {
        "dim": dim, "way": name, "cells": cells, "unknowns": dim * V.dofmap.index_map.size_global, "steps": len(history),
        "seconds": max(comm.allgather(seconds)),
        "error_displacement": float(np.sqrt(forms.assemble_scalar(misplaced, comm) / (area * LENGTH)) / (SPEED * LENGTH / C)),
        "error_impulse": float(abs(sum(history) / (2 * area * LENGTH * SPEED) - 1)),
    }  # fmt: skip


def draw(points: list[dict[str, Any]], path: str) -> None:
    """Error of the displacement after the rebound against run time."""
    with uem.figure(path, comm, panels=2, size=(4.6, 3.8)) as panels:
        for dim, panel in zip(CELLS, panels):
            for name, *_ in WAYS if panel is not None else ():
                own = [p for p in points if p["dim"] == dim and p["way"] == name]
                panel.loglog([p["seconds"] for p in own], [p["error_displacement"] for p in own], ".-", label=name)
            if panel is not None:
                panel.set(xlabel="run time / s", ylabel="error of the displacement", title=f"{dim}D")
                panel.grid(alpha=0.25)
                panel.minorticks_off()
                panel.set(
                    xticks=[0.1, 1.0] if dim == 2 else [0.1, 1.0, 10.0],
                    yticks=[5e-3, 1e-2, 2e-2, 4e-2],
                    xlim=(0.05, 1.2 if dim == 2 else 60.0),
                )
                panel.set(yticklabels=["0.5 %", "1 %", "2 %", "4 %"], ylim=(3.5e-3, 8e-2))
                panel.legend(frameon=False, ncol=2, loc="upper center", fontsize="small")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--json")
    arguments.add_argument("--plot")
    arguments.add_argument("--sizes", type=int, default=3, help="largest number of meshes")
    args = arguments.parse_args()
    for dim, sizes in CELLS.items():
        for way in WAYS:
            # compiles
            run(dim, sizes[0] // 2, way)
    points = []
    for dim, sizes in CELLS.items():
        for cells in sizes[: args.sizes]:
            for way in WAYS:
                points.append(run(dim, cells, way))
                if comm.rank == 0:
                    print({k: float(f"{p:.3g}") if isinstance(p, float) else p for k, p in points[-1].items()}, flush=True)
    if args.json and comm.rank == 0:
        Path(args.json).write_text(json.dumps({"points": points, "machine": machine()}, indent=1) + "\n", encoding="utf-8")
    if args.plot:
        draw(points, args.plot)
