"""Work and precision: the united elements and other methods of contact, error against time, on problems with known answers.

python3 demos/work_precision.py --plot work_precision.png

Options:
    sizes: largest number of meshes, or time steps, of each problem
    runs: timed runs, whose median counts; 0: the first run counts
    problems: problems to solve, comma-separated
    methods: methods to compare, comma-separated
"""

# %% [markdown]
# # Which method reaches 1 %, 0.1 %, 0.01 % first?
#
# Five problems, each solved by every method on the same meshes, surfaces, search and Newton loop:
#
# - `signorini`: two elastic bodies, in contact for x < 0, with their exact solution, for three ratios of their stiffnesses;
# - `hertz_cylinder`: an elastic cylinder on an elastic block, against quadratic elements on a fine mesh;
# - `hertz_penalty`: a rigid paraboloid in 3D, against the exact solution of the discrete problem, which springs spread over the
#   surface and a barrier do not aim at;
# - `cattaneo`: the cylinder pushed to the side, with friction, against Mindlin's solution;
# - `bar_impact`: a bar hits a wall, against the exact wave.
#
# A penalty, Uzawa's iteration and the proximal point method need a number: multiples of E/h of the softer body are tried, and the
# best value on each mesh counts. This favours them, since it is not known beforehand. Times are medians of warm runs without
# compilation and without reading the mesh.

# %%
import csv
import json
import logging
from argparse import Namespace
from functools import partial
from pathlib import Path

import common
from common import comm
from benchmarks import methods
from benchmarks.graphs import draw_all
from benchmarks.measure import at_a_glance, at_equal_error, grouped, label, machine, measure, name_of, rate, sweep
from benchmarks.problems import bar_impact, cattaneo, hertz_answer, hertz_cylinder, indenter
from benchmarks.signorini import signorini

args = common.arguments(
    __doc__, sizes=4, runs=5, problems="signorini,hertz_cylinder,hertz_penalty,cattaneo,bar_impact", methods=",".join(methods.ALL)
)
# the indenter's overlap at the start is meant
logging.getLogger("uem_dolfinx").setLevel(logging.ERROR)
points = []


def keep(results: dict) -> None:
    """Write the JSON file; after every problem, so that a run that is stopped keeps its results."""
    if args.json and comm.rank == 0:
        Path(args.json).parent.mkdir(parents=True, exist_ok=True)
        Path(args.json).write_text(json.dumps(results | {"points": points}, indent=1) + "\n", encoding="utf-8")


def names(degree: int, *without: str) -> list[str]:
    """The methods wanted; the barrier is for one rank and degree 1."""
    if degree > 1 or comm.size > 1 or not methods.available("barrier"):
        without += ("barrier",)
    return [name for name in methods.ALL if name in args.methods.split(",") and name not in without]


# %% [markdown]
# ## Signorini
# The displacement is of class H^(5/2 - eps). So linear elements can reach the order 1 in energy, quadratic ones 3/2, or 2 with
# meshes graded towards the end of the contact. Meshes whose nodes do not include the target's fail the patch test in a
# single pass of nodes on facets, which shows where both bodies are equally stiff; mortar passes it, with either body as contactor.

# %%
if "signorini" in args.problems:
    most = ("penalty", "augmented", "barrier", "proximal")
    for degree, finer, graded, sizes, ratios, without in (
        (1, 2.0, 1.0, (4, 8, 16, 32), (1.0, 1e6), ()),
        (1, 2.0, 1.0, (4, 8, 16), (1e3,), ()),
        (1, 1.5, 1.0, (4, 8, 16, 32), (1.0, 1e6), most),
        (1, 2 / 3, 1.0, (6, 12, 24, 48), (1.0,), most),
        (2, 1.0, 1.0, (4, 8, 16), (1.0, 1e3, 1e6), ()),
        (2, 1.5, 1.0, (4, 8, 16), (1.0, 1e6), most),
        (2, 2 / 3, 1.0, (6, 12, 24), (1.0,), most),
        (2, 1.0, 2.0, (8, 16, 32), (1.0,), ()),
        (2, 1.5, 2.0, (8, 16, 32), (1.0,), most),
    ):
        for ratio in ratios:
            scene = partial(signorini, degree=degree, ratio=ratio, finer=finer, graded=graded)
            points += sweep(scene, sizes[: args.sizes], names(degree, *without), args.runs, progress=args.verbose)
            keep({})

# %% [markdown]
# ## Hertz

# %%
if "hertz_cylinder" in args.problems:
    sizes = (1 / 30, 1 / 60, 1 / 120)[: args.sizes]
    answer = hertz_answer(sizes[-1] / 2)
    for degree in (1, 2):
        points += sweep(
            lambda h, degree=degree: hertz_cylinder(h, degree, answer), sizes[: 4 - degree], names(degree), args.runs,
            progress=args.verbose,
        )  # fmt: skip
    keep({})
if "hertz_penalty" in args.problems:
    points += sweep(indenter, (8, 16)[: args.sizes], names(1, "penalty_surface", "barrier"), args.runs, progress=args.verbose)
if "cattaneo" in args.problems:
    without = set(methods.ALL) - set(methods.RUB)
    points += sweep(
        cattaneo, (1 / 15, 1 / 30, 1 / 45)[: args.sizes], names(1, *without), min(args.runs, 1), progress=args.verbose
    )

# %% [markdown]
# ## Impact
# The united elements leave their contactors without mass, with either coupling. Other methods are as they usually are, with mass
# at the contactors, and with the trapezoidal rule or one that damps.

# %%
if "bar_impact" in args.problems:
    for cfl in (2.0, 1.0, 0.5)[: args.sizes]:
        for method, parameter, scheme, contactors in (
            ("united", None, "trapezoidal", "massless"),
            ("mortar", None, "trapezoidal", "massless"),
            ("lagrange", None, "trapezoidal", "massy"),
            ("penalty", 1.0, "trapezoidal", "massy"),
            ("penalty", 10.0, "trapezoidal", "massy"),
            ("penalty", 10.0, "generalised_alpha", "massy"),
        ):
            if method not in names(1):
                continue
            scene = bar_impact(25, cfl, scheme=scheme, contactors=contactors)
            points.append(measure(scene, method, parameter, args.runs, progress=args.verbose))

# %% [markdown]
# ## The table
# The cheapest point of every method below each error; a star marks the first. Then the time of each for the same error.

# %%
glance, equal = at_a_glance(points), at_equal_error(points)
rates = []
for scene, group in grouped(points, label).items():
    if group[0]["problem"] == "signorini" and len({p["dofs"] for p in group}) > 1:
        for name, own in grouped(group, name_of).items():
            rates.append(
                {"scene": scene, "method": name, "order in h": rate(own), "of the pressure": rate(own, "error_pressure")}
            )
results = {"machine": machine(), "rates": rates, "glance": glance, "equal error": equal}
common.report(Namespace(json=None), results)
keep(results)
if args.output and comm.rank == 0:
    Path(args.output).mkdir(parents=True, exist_ok=True)
    with open(f"{args.output}/work_precision.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(dict.fromkeys(key for point in points for key in point)))
        table.writeheader()
        table.writerows(points)
if args.plot:
    draw_all(args.plot, points)

# %%
for row in rates if args.sizes > 1 else ():
    kind = "graded" if "graded" in row["scene"] else "degree 1" if "degree 1" in row["scene"] else "degree 2"
    if row["method"] == "united" and "not nested" not in row["scene"]:
        assert row["order in h"] >= {"degree 1": 0.95}.get(kind, 1.4), row
    if row["method"] == "mortar":
        least = {"degree 1": 0.99, "degree 2": 1.4, "graded": 1.9}[kind]
        assert row["order in h"] >= (least if args.sizes > 2 else 0.95 * least), row
        assert row["of the pressure"] >= 0.95, row
