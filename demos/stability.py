"""Stability: every method of contact in extreme cases, and whether it is right, says why not, or is wrong.

python3 demos/stability.py --methods united --quick

Options:
    quick: quick cases alone, no condition numbers
    methods: methods or columns of the table, comma-separated, or all
    cases: rows of the table, comma-separated, or all
    known: JSON files of earlier runs, comma-separated, whose cells are not run again
"""

# %% [markdown]
# # Stability
#
# Each row is an extreme case: stiffnesses nine orders apart, contactors on a vertex to the last bit,
# bodies that nothing holds, steps that fly through the target. Each column is a method. A cell is
#
# - *correct*: force and energy are right to 1 %, no contactor is deeper in its target than 1e-3 of an element, and forces are in
#   equilibrium, along normals and in pairs, to 1e-3; with mortar, whose conditions hold in the mean over the facets around a
#   contactor, gaps are these means, and forces lie along the target's normals, but for 1e-2 where a mesh ends over a facet;
# - a *named error*: the method names its limit, as it should if a case contradicts itself;
# - *wrong*: anything else, with the figure that shows it.
#
# The right result follows from a closed form, from balances, or from the conditions of contact, which are read from the bodies and not
# from the method (`benchmarks/cases_laws.py`). The cases are in `benchmarks/cases_*.py`.

# %%
import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from common import comm
from benchmarks import methods
from benchmarks.cases import COLUMNS, Column, Trial, judge
from benchmarks.cases_scales import springs
from benchmarks.every_case import CASES

import uem_dolfinx as uem

args = common.arguments(__doc__, quick=False, methods="all", cases="all", known="")
chosen, picked = args.methods.split(","), args.cases.split(",")
COLUMN_NAMES = [column.name for column in COLUMNS]
columns = [c for c in COLUMNS if args.methods == "all" or c.name in chosen or c.method in chosen]
rows = [c for c in CASES if (args.cases == "all" and (c.quick or not args.quick)) or c.name in picked]
if not columns or not rows:
    sys.exit(f"nothing to do: --methods are {', '.join(COLUMN_NAMES)}; --cases are {', '.join(c.name for c in CASES)}")
# results of other runs, by case and method, and their condition numbers: files of theirs are --known
known = [json.loads(Path(file).read_text(encoding="utf-8")) for file in args.known.split(",") if file]
known_cells = {(cell["case"], cell["method"]): cell for run in known for cell in run["cells"]}
known_curves = [curve for run in known for curve in run.get("condition", ())]

# %% [markdown]
# ## The table

# %%
MARK = {"correct": "ok ", "named error": "", "wrong": "WRONG ", "not applicable": "-"}


def figure_of(cell: dict) -> str:
    """The figure of a cell in few letters."""
    figure = cell["figure"]
    if cell["verdict"] == "not applicable":
        return ""
    return f"{abs(figure):.0e}" if isinstance(figure, float) else figure.replace("Error", "")


def say(name: str, texts: list[str]) -> None:
    """Print a row on rank 0."""
    if comm.rank == 0:
        print(f"{name:22}" + "".join(f"{text:>19}" for text in texts), flush=True)


def keep(results: dict) -> None:
    """Write the JSON file, after every row, so that a run that is stopped keeps its results."""
    if args.json and comm.rank == 0:
        Path(args.json).parent.mkdir(parents=True, exist_ok=True)
        Path(args.json).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


start, cells = time.perf_counter(), []
say("case", [column.name for column in columns])
for row in rows:
    cells += [known_cells.get((row.name, column.name)) or judge(row, column) for column in columns]
    say(row.name, [MARK[cell["verdict"]] + figure_of(cell) for cell in cells[-len(columns) :]])
    keep({"cells": cells})
seconds = time.perf_counter() - start
wrong = [cell for cell in cells if cell["verdict"] == "wrong"]
if comm.rank == 0:
    for cell in wrong:
        print(f"wrong: {cell['case']}, {cell['method']}: {cell['what']}: {cell['figure']} (at most {cell['tolerance']})")
totals = []
for column in columns:
    mine = [cell for cell in cells if cell["method"] == column.name]
    counted = {verdict: sum(cell["verdict"] == verdict for cell in mine) for verdict in MARK}
    totals.append({"method": column.name} | counted | {"iterations": sum(cell["iterations"] for cell in mine)})

# %% [markdown]
# ## Condition numbers
# Of the last linear system of two blocks, against the ratio of their stiffnesses, the size of their elements, and the methods' own
# parameter. Serial only.

# %%


def condition(column: Column, ratio: float = 1.0, n: int = 4, factor: float | None = None) -> float | None:
    """Condition number of two blocks; ``factor`` replaces the column's own; None if the method cannot solve them."""
    scene = springs(([n, n], [2 * n, 2 * n]), (1.0, ratio), gap=1e-3 / n if column.method == "barrier" else 0.0)
    scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
    column = replace(column, factor=column.factor if factor is None else factor)
    try:
        return methods.condition_number(scene.solve(Trial(column), 0.5 / n))
    except uem.UEMError:
        return None


LADDER = {"ratio": [10.0**k for k in range(-9, 10, 3)], "n": [2, 4, 8, 16], "factor": [10.0**k for k in range(-2, 7)]}
curves = []
if comm.size == 1 and args.cases == "all" and not args.quick:
    for column in (c for c in columns if methods.available(c.method)):
        found = [curve for curve in known_curves if curve["method"] == column.name]
        curves += found
        if found:
            continue
        for against, values in LADDER.items():
            if against == "factor" and column.stiffer:
                # the same curve again
                continue
            free = against == "factor" and not column.factor
            constant = condition(column) if free else None
            for value in values:
                number = constant if free else condition(column, **{against: value})
                curves.append({"method": column.name, "against": against, "value": value, "condition": number})

common.report(argparse.Namespace(json=None), {"totals": totals, "seconds": seconds, "ranks": comm.size})
keep({"cells": cells, "totals": totals, "condition": curves, "seconds": seconds, "ranks": comm.size})

# %% [markdown]
# ## The pictures

# %%
COLOUR = {
    "correct": (0.75, 0.89, 0.75),
    "named error": (0.97, 0.89, 0.62),
    "wrong": (0.91, 0.55, 0.51),
    "not applicable": (0.9, 0.9, 0.9),
}
by_place = {(c["case"], c["method"]): c for c in cells}
if args.plot:
    with uem.figure(args.plot, comm, size=(2.2 + 1.2 * len(columns), 1.2 + 0.24 * len(rows))) as panels:
        if panels[0] is not None:
            ax = panels[0]
            ax.imshow([[COLOUR[by_place[r.name, c.name]["verdict"]] for c in columns] for r in rows], aspect="auto")
            for i, row in enumerate(rows):
                for j, column in enumerate(columns):
                    ax.text(j, i, figure_of(by_place[row.name, column.name]), ha="center", va="center", fontsize=6.5)
            ax.set_xticks(np.arange(len(columns)), [f"{c.name}\n{c.words}" for c in columns], fontsize=6.5)
            ax.set_yticks(np.arange(len(rows)), [row.name for row in rows], fontsize=7.5)
            ax.set_xticks(np.arange(len(columns) - 1) + 0.5, minor=True)
            ax.set_yticks(np.arange(len(rows) - 1) + 0.5, minor=True)
            ax.grid(which="minor", color="white", lw=1.5)
            ax.xaxis.tick_top()
            ax.tick_params(which="both", length=0)
            for spine in ax.spines.values():
                spine.set_visible(False)
    path = Path(args.plot)
    conditions = path.with_name(f"{path.stem}_condition{path.suffix}")
    with uem.figure(conditions if curves else None, comm, panels=3, size=(3.3, 3.9)) as panels:
        if panels[0] is not None:
            labels = {
                "ratio": "upper over lower Young's modulus",
                "n": "elements across a block, 1/h",
                "factor": "parameter over E/h (barrier: over h)",
            }
            for ax, (against, label) in zip(panels, labels.items()):
                for k, column in enumerate(columns):
                    mine = [c for c in curves if (c["method"], c["against"]) == (column.name, against) and c["condition"]]
                    x, y = [c["value"] for c in mine], [c["condition"] for c in mine]
                    ax.loglog(x, y, "osv^Dx+*"[k] + "-", color=f"C{k}", ms=4, lw=1, label=column.name)
                ax.set(xlabel=label, ylabel="condition number")
                if against == "n":
                    ax.set_xticks(LADDER["n"], LADDER["n"])
                    ax.minorticks_off()
                ax.grid(alpha=0.25)
            panels[0].legend(frameon=False, fontsize=7)

# %%
assert not [c for c in wrong if c["method"] == "united"], [c for c in wrong if c["method"] == "united"]
