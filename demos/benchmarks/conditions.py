"""Condition numbers of the systems that all methods solve, over the size of cells and the ratio of the bodies' stiffnesses.

Signorini's problem of two bodies on nested meshes of linear cells. Every method has the parameter with the least condition number among
those whose pressures err by at most ``AS_GOOD`` times the least of the method. ``PYTHONPATH=demos python -m benchmarks.conditions --json
demos/benchmarks/report/conditions.json`` takes a few minutes on one rank; ``python demos/benchmarks/report/tables.py`` writes the table.

Options:
    sizes: number of meshes
"""

from __future__ import annotations

from typing import Any

from common import arguments, comm, report
from benchmarks import methods
from benchmarks.adapted import AS_GOOD
from benchmarks.measure import measure
from benchmarks.signorini import signorini

#: Springs in multiples of E/h of the softer body; of the barrier the distance at which it begins, in parts of h.
PARAMETERS: dict[str, tuple[float | None, ...]] = {
    "penalty": (1e1, 1e2, 1e3),
    "penalty_surface": (1e1, 1e2, 1e3),
    "augmented": (1e1, 1e2),
    "barrier": (1e-1, 1e-2, 1e-3),
    "proximal": (1e-2, 1e-1, 1e0),
}


def row(n: int, ratio: float) -> dict[str, Any]:
    """Condition numbers, and iterations in brackets, of all methods on one mesh (serial)."""
    scene = signorini(n, ratio=ratio)
    found: dict[str, Any] = {"E ratio": ratio, "unknowns": scene.dofs}
    for name in methods.ALL:
        points = [measure(scene, name, p, 0) for p in PARAMETERS.get(name, (None,)) if methods.available(name)]
        points = [p for p in points if p["error_pressure"] is not None]
        if points:
            least = min(p["error_pressure"] for p in points)
            best = min((p for p in points if p["error_pressure"] <= AS_GOOD * least), key=lambda p: p["condition"])
            found[name] = f"{best['condition']:.1e} ({best['newton_iterations']})"
    return found


if __name__ == "__main__":
    args = arguments(__doc__, sizes=3)
    if comm.size > 1:
        raise SystemExit("eigenvalues are found on one rank: run this without mpirun")
    rows: list[dict[str, Any]] = []
    for ratio in (1.0, 1e3, 1e6):
        for n in (4, 8, 16)[: args.sizes]:
            rows.append(row(n, ratio))
            print(rows[-1], flush=True)
    report(args, {"rows": rows})
