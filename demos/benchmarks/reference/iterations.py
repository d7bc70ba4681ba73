"""Run a script, and count the Newton iterations of all steps that converged.

python3 demos/benchmarks/reference/iterations.py COUNT.json demos/press_fit.py --h 0.1
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

from uem_dolfinx.solve import problem


def count(script: str, arguments: list[str]) -> int:
    """Run a script, and return the number of iterations of all steps that converged; explicit steps have none."""
    solved, iterations = problem.solve_united, 0

    def counted(*args: Any, **options: Any) -> Any:
        nonlocal iterations
        history = solved(*args, **options)
        # the last entry is the converged state
        iterations += len(history) - 1
        return history

    problem.solve_united = counted
    sys.argv, sys.path[0] = [script, *arguments], str(Path(script).resolve().parent)
    try:
        runpy.run_path(script, run_name="__main__")
    finally:
        problem.solve_united = solved
    return iterations


if __name__ == "__main__":
    file, script, *arguments = sys.argv[1:]
    found = count(script, arguments)
    Path(file).write_text(json.dumps(found), encoding="utf-8")
