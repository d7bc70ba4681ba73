"""All methods on the same meshes of a cylinder on a block: of one size, graded by hand, and adapted to the error of united elements.

Every rival has the best of a few parameters on each mesh: of those whose larger error, of the force or of the pressures, is at most
``AS_GOOD`` times the least of the method, the one with fewest linear solves. ``PYTHONPATH=demos python -m benchmarks.adapted --json
demos/benchmarks/report/adapted.json`` takes the times, and ``python demos/benchmarks/report/tables.py`` writes them into the report.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import methods
from benchmarks.measure import machine

import uem_dolfinx as uem

E, NU, R = 1e6, 0.3, 3.0
#: Springs in multiples of E over the mean distance of contactors in contact, of the proximal point method in its first step; of the
#: barrier the distance at which it begins, in multiples of that one.
PARAMETERS: dict[str, tuple[float, ...]] = {
    "penalty": (1e0, 1e1, 1e2, 1e3),
    "penalty_surface": (1e0, 1e1, 1e2, 1e3),
    "augmented": (1e2, 1e3, 1e4, 1e5),
    "proximal": (1e-4, 1e-3, 1e-2, 1e-1),
    "barrier": (1e-5, 1e-4, 1e-3, 1e-2),
}
#: With the parameter that is shown force and pressures err by at most so many times the least of the method.
AS_GOOD = 1.1
#: Meshes by their names: file, its parameters, degree, and the tolerance of an adaptation or None.
MESHES: dict[str, tuple[str, dict[str, float], int, float | None]] = {
    "degree 1, uniform": ("adapt_hertz", {"h": 0.125}, 1, None),
    "degree 1, graded by hand": ("hertz_cylinder", {"h": 1 / 40}, 1, None),
    "degree 1, adapted, 3 %": ("adapt_hertz", {}, 1, 0.03),
    "degree 2, uniform": ("adapt_hertz", {"h": 0.125}, 2, None),
    "degree 2, graded by hand": ("hertz_cylinder", {"h": 1 / 40}, 2, None),
    "degree 2, adapted, 2 %": ("adapt_hertz", {}, 2, 0.02),
    "degree 2, adapted, 0.35 %": ("adapt_hertz", {}, 2, 0.0035),
}
#: Tolerances of adaptations by degree, for a table of what they reach.
TOLERANCES = {1: (0.2, 0.1, 0.05, 0.02), 2: (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.003)}
REFERENCE = ("adapt_hertz", {}, 2, 0.001)


def solved(
    mesh: Any, tags: Any, degree: int, method: str, parameter: float | None = None, spacing: float = 1.0
) -> tuple[uem.UnitedProblem, uem.Contact, int]:
    """A problem by a method, its contact, and the number of linear solves (collective)."""
    V = uem.function_space(mesh, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(E, NU, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.006)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"], sliding="fixed")
    options = {} if parameter is None else {"parameter": parameter * (spacing if method == "barrier" else E / spacing)}
    if method == "proximal":
        options["scale"] = E / spacing
    problem = methods.create(method, F, u, bcs=bcs, contacts=[contact], **options)
    return problem, contact, methods.counts(list(uem.load_steps(problem, 1)))[0]


def measured(contact: uem.Contact) -> tuple[float, float, float, float]:
    """Force, root mean square of the pressures' errors within 0.95 a over the largest pressure of Hertz, spacing of contactors, and the
    largest pressure over that of Hertz."""
    force = 2 * float(contact.resultant().force[1])
    p0 = np.sqrt(force * E / (2 * (1 - NU**2)) / (np.pi * R))
    a = 2 * force / (np.pi * p0)
    x, p = (np.concatenate(comm.allgather(part)) for part in (contact.points[:, 0], contact.pressures))
    inside = x < 0.95 * a
    rms = np.sqrt(np.mean((p[inside] / p0 - np.sqrt(1 - (x[inside] / a) ** 2)) ** 2))
    return force, float(rms), float(a / max(inside.sum(), 1)), float(p.max() / p0)


def mesh_of(file: str, parameters: dict[str, float], degree: int, tolerance: float | None) -> tuple[Any, Any]:
    """A mesh with its tags (collective)."""
    made: list[Any] = []

    def make(size: Any) -> uem.UnitedProblem:
        made[:] = uem.read_gmsh(common.MESHES / f"{file}.geo", comm, gdim=2, parameters=parameters | {"order": degree}, size=size)
        return solved(*made, degree, "mortar")[0]

    make(None) if tolerance is None else uem.adapt(make, tolerance=tolerance, solve=lambda problem: None)
    return made[0], made[1]


def row(mesh: Any, tags: Any, degree: int, method: str, spacing: float, exact: float, runs: int) -> dict[str, Any]:
    """Errors, solves and seconds of a method with its best parameter (collective)."""
    found: list[dict[str, Any]] = []
    for parameter in PARAMETERS.get(method, (None,)):
        start = perf_counter()
        try:
            problem, contact, solves = solved(mesh, tags, degree, method, parameter, spacing)
        except uem.errors.UEMError:
            continue
        times = [perf_counter() - start]
        force, rms = measured(contact)[:2]
        found.append(
            {"unknowns": len(problem.u.x.array), "method": method, "parameter": parameter, "error_force": abs(force / exact - 1)}
            | {"error_pressure": rms, "solves": solves, "seconds": times}
        )
    if not found:
        return {"method": method}
    errors = [max(one["error_force"], one["error_pressure"]) for one in found]
    best = min((one for one, error in zip(found, errors) if error <= AS_GOOD * min(errors)), key=lambda one: one["solves"])
    for _ in range(runs - 1):
        start = perf_counter()
        solved(mesh, tags, degree, method, best["parameter"], spacing)
        best["seconds"].append(perf_counter() - start)
    return best | {"seconds": median(best["seconds"])}


def by_tolerance(exact: float) -> list[dict[str, Any]]:
    """Unknowns and errors of meshes that ``adapt`` makes for a tolerance in energy, with mortar (collective)."""
    rows = []
    for degree, tolerances in TOLERANCES.items():
        for tolerance in tolerances:
            problem, contact, _ = solved(*mesh_of("adapt_hertz", {}, degree, tolerance), degree, "mortar")
            force, rms, _, largest = measured(contact)
            V = problem.u.function_space
            unknowns = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
            errors = {"error_force": abs(force / exact - 1), "error_largest_pressure": abs(largest - 1), "error_pressure": rms}
            rows.append({"degree": degree, "tolerance": tolerance, "unknowns": unknowns} | errors)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", default="", help="part of the names of the meshes")
    args = parser.parse_args()
    exact = measured(solved(*mesh_of(*REFERENCE), 2, "mortar")[1])[0]
    rows: list[dict[str, Any]] = []
    for name, of in MESHES.items():
        if args.only not in name:
            continue
        mesh, tags = mesh_of(*of)
        spacing = measured(solved(mesh, tags, of[2], "mortar")[1])[2]
        for method in methods.ALL:
            if method == "barrier" and (of[2] > 1 or not methods.available(method)):
                continue
            rows.append({"mesh": name} | row(mesh, tags, of[2], method, spacing, exact, args.runs))
            if comm.rank == 0:
                print(rows[-1], flush=True)
    tolerances = by_tolerance(exact)
    if comm.rank == 0:
        print(*tolerances, sep="\n")
    if args.json and comm.rank == 0:
        args.json.write_text(
            json.dumps({"machine": machine(), "tolerances": tolerances, "rows": rows}, indent=1) + "\n", encoding="utf-8"
        )
