"""Messages, collective calls and memory of a contact step, counted a rank; a model of the counts, and what it says for more ranks.

A count q of the busiest of p ranks, of N unknowns in all, is fitted by

    q = a + b (N / p)^(2/3) + c N / p + m min(p - 1, 26) + d (p - 1) + e N^(2/3)

what every rank does in any case; the surfaces and the halo of its part; its volume, of memory only; for each other rank, of rows and
messages; what it sends to every other rank; and the whole surface. The last two are what does not scale. No coefficient is negative, and
relative errors are least squares, so that a term that does not help is zero.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from common import cg, comm
from dolfinx import fem
from benchmarks import collectives
from benchmarks.collectives import KINDS
from benchmarks.scenes import at, box, scene
from scipy.optimize import nnls

import uem_dolfinx as uem
from uem_dolfinx.parallel import reduced

#: Counts that are fitted.
COUNTS = (*KINDS, "python_bytes")
#: Ranks that a rank has rows for: of parts like the cubes of a grid as many as have a corner in common.
MOST_PARTNERS = 26.0
#: Terms of counts that go with surfaces or volumes; all others are numbers of calls, and of what is said to each rank.
COUNTED_BY = {"row_bytes": ("always", "own_surface", "partners", "whole_surface"), "messages": ("always", "partners")}
COUNTED_BY["sent_bytes"] = COUNTED_BY["row_bytes"]
COUNTED_BY["python_bytes"] = (*COUNTED_BY["row_bytes"], "own_volume")
#: Terms of the model, by the part that a rank has.
TERMS: dict[str, Callable[[float, float], float]] = {
    "always": lambda N, p: 1.0,
    "own_surface": lambda N, p: (N / p) ** (2 / 3),
    "own_volume": lambda N, p: N / p,
    "partners": lambda N, p: min(p - 1.0, MOST_PARTNERS),
    "each_rank": lambda N, p: p - 1.0,
    "whole_surface": lambda N, p: N ** (2 / 3),
}
#: Stages of linear solvers, which are PETSc's and hypre's.
SOLVER = ("linear solve", "factorisation or preconditioner set-up")


def blocks(n: int, declared: str) -> Callable[[], uem.UnitedProblem]:
    """A block of n x n x n / 2 hexahedra is pressed onto a wider one and sheared on it: a function that makes the problem (collective).

    Args:
        n: cells along a side.
        declared: ``"pair"``, a declared contact; ``"friction"``, one with friction; ``"general"``, a general contact;
            ``"overhang"``, a general contact of a block that hangs over two edges of the other one.
    """
    below, lo = box("hexahedron", (0, 0, -0.5), (1, 1, 0), (n, n, n // 2)), np.array([0.11, 0.09, 0])
    if declared == "overhang":
        lo += [0.3, 0.3, 0]
    s = scene(comm, "hexahedron", [below, box("hexahedron", lo, lo + [0.8, 0.8, 0.5], (n, n, n // 2))])
    V = uem.function_space(s.mesh, 1, (3,))
    tags = {"bottom": s.tag("bottom", 0, at(2, -0.5), 1), "top": s.tag("top", 1, at(2, 0.5), 2)}
    surfaces = s.tag("upper", 1, at(2, 0.0), 3), s.tag("lower", 0, at(2, 0.0), 4)

    def make() -> uem.UnitedProblem:
        u, top = fem.Function(V, name="displacement"), fem.Function(V)

        def move(factor: float) -> None:
            top.x.array.reshape(-1, 3)[:] = np.array([0.02, 0.01, -0.01]) * factor

        bcs = [uem.dirichlet(V, tags["bottom"]), uem.dirichlet(V, tags["top"], value=top)]
        contact: Any = uem.Contact(*surfaces, friction=0.3 if declared == "friction" else 0.0)
        if declared in ("general", "overhang"):
            contact = uem.GeneralContact()
        F = uem.LinearElastic(1.0, 0.3).residual(u, ufl.TestFunction(V)) * ufl.dx
        how = {"contacts": [contact], "load": move, "petsc_options": cg(), "petsc_options_prefix": "growth_"}
        return uem.UnitedProblem(F, u, bcs=bcs, **how)

    return make


def step(n: int, declared: str, memory: bool = False) -> dict[str, Any]:
    """Counts of the busiest rank in the second of two load steps, a linearisation each (collective).

    Args:
        n: cells along a side.
        declared: see ``blocks``.
        memory: count the largest memory of Python and NumPy from the making of the problem on, not what is sent.
    """
    make = blocks(n, declared)
    if memory:
        tracemalloc.start()
    problem = make()
    steps = uem.load_steps(problem, 2)
    next(steps)
    row: dict[str, Any] = {"scene": declared, "ranks": comm.size, "n": n, "dofs": 3 * problem.config.index_map.size_global}
    if memory:
        done = next(steps)
        row["python_bytes"] = int(reduced(comm, tracemalloc.get_traced_memory()[1], op=MPI.MAX))
        tracemalloc.stop()
    else:
        with collectives.traffic() as stages:
            done = next(steps)
        names = sorted(set().union(*comm.allgather(set(stages))))
        linearisations = done.newton_iterations + done.exchanges
        most = {name: reduced(comm, stages[name], op=MPI.MAX) / linearisations for name in names}
        for prefix, within in (("", set(names) - set(SOLVER)), ("solver_", set(SOLVER) & set(names))):
            total = reduced(comm, sum((stages[name] for name in within), np.zeros(len(KINDS), np.int64)), op=MPI.MAX)
            row |= {prefix + kind: float(count) / linearisations for kind, count in zip(KINDS, total)}
        row["stages"] = {name: dict(zip(KINDS, map(float, most[name]))) for name in names}
        row |= blocks_of_rows(problem)
    steps.close()
    return row | {"iterations": done.newton_iterations, "exchanges": done.exchanges}


def blocks_of_rows(problem: uem.UnitedProblem) -> dict[str, float]:
    """Blocks of rows of P at eliminated nodes, their mean and largest number; also how many equations there are (collective)."""
    restriction = problem.system.restriction()
    _, counts = np.unique(restriction.rows().row, return_counts=True)
    total, many = reduced(comm, np.array([counts.sum(), len(counts)]))
    most = reduced(comm, int(counts.max(initial=0)), op=MPI.MAX)
    return {"equations": restriction.n_equations, "row_blocks": float(total / max(many, 1)), "most_row_blocks": int(most)}


def fitted(rows: list[dict[str, Any]], count: str) -> dict[str, float]:
    """Coefficients of the model of a count, and its root mean square error relative to the counts on several ranks."""
    rows = [row for row in rows if row["ranks"] > 1 and row.get(count)]
    terms = COUNTED_BY.get(count, ("always", "each_rank"))
    if len(rows) <= len(terms):
        return {}
    counted = np.array([row[count] for row in rows])
    A = np.array([[TERMS[name](row["dofs"], row["ranks"]) for name in terms] for row in rows]) / counted[:, None]
    scale = np.linalg.norm(A, axis=0)
    x, left = nnls(A / scale, np.ones(len(rows)))
    return (
        dict.fromkeys(TERMS, 0.0)
        | {name: float(value) for name, value in zip(terms, x / scale)}
        | {"error": float(left / np.sqrt(len(rows)))}
    )


def on_paper(model: dict[str, float], dofs: float, ranks: int) -> dict[str, float]:
    """Parts of a count by the model."""
    return {name: model.get(name, 0.0) * term(dofs, ranks) for name, term in TERMS.items()}
