"""How contact scales: speed-up of a Hertz scene on several ranks, data that ranks receive in a search, and its time over its size.

python3 demos/scaling.py --json scaling.json --plot scaling.png

Options:
    where: apart: a call of mpiexec for each number of ranks; here: the ranks of this call
    dofs: unknowns of the timed scene, approximately; 0: not measured
    ranks: numbers of ranks on which it is timed, comma-separated
    plates: cells along a side of the plates whose traffic is measured, comma-separated
    plate_ranks: numbers of ranks for --plates, comma-separated
    searches: cells along a side of the plates whose search is timed on one rank, comma-separated
    counted: unknowns of the scene in which collective calls are counted, approximately; 0: not measured
    count_ranks: numbers of ranks for --counted, comma-separated
"""

# %% [markdown]
# # Ranks
#
# Four measurements, of which no time hangs on another run:
#
# 1. A half sphere on a block, linear elastic, small sliding, one load step, CG with multigrid: seconds from the making of the problem to
#    its solution, without reading the mesh and compiling forms, in the quickest run, since the first one imports parts of SciPy.
# 2. Two plates, one cell thick, that touch all over: bytes that a rank receives from others while all contactors are projected,
#    against its share of the surfaces, its own contactors and facets. Nothing is timed: there may be more ranks than cores.
# 3. The time of that search on one rank against the number of contactors.
# 4. Collective calls of MPI in the second step of the first scene, by stage, in all libraries: where ranks wait for each other.
#
# Called on one rank the script starts `mpiexec` of itself for each number of ranks; on several, or with `--where here`, it measures on
# those that it has. Numbers of a list are parted by commas.

# %%
import time
from collections.abc import Callable

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import collectives
from benchmarks.apart import run_on
from benchmarks.traffic import Surfaces, plates, search_traffic

import uem_dolfinx as uem

args = common.arguments(
    __doc__,
    where=("apart", "here"),
    dofs=500_000,
    ranks="1,2",
    runs=3,
    plates="60,120",
    plate_ranks="1,2,4,8",
    searches="40,80,160,320",
    counted=35_000,
    count_ranks="2,4",
)

#: Timers of the stages of a solution.
STAGES = {
    "search and projection": ["projection"],
    "uniting equations": ["uniting equations", "contact curvature"],
    "assembly": ["assemble residual", "assemble tangent"],
    "P and P'KP": [
        "restriction matrix P",
        "united matrix P'KP",
        "condensed matrix",
        "cross out prescribed components",
        "deflation",
    ],
    "multigrid and CG": ["factorisation or preconditioner set-up", "linear solve"],
}

# %% [markdown]
# ## The scene


# %%
a = 0.005


def scene(dofs: int) -> Callable[[], uem.UnitedProblem]:
    """A Hertz scene with about so many unknowns: a function that makes its problem (collective)."""
    parameters = {"h": 0.1 * a * (89_000 / dofs) ** (1 / 3), "zone": 1.4 * a, "growth": 0.8 / a}
    mesh, tags = uem.read_gmsh(common.MESHES / "hertz_sphere.geo", comm, gdim=3, parameters=parameters)
    V = uem.function_space(mesh, 1, (3,))
    bcs = [uem.dirichlet(V, tags[name], i) for i, name in enumerate(("symmetry_x", "symmetry_y", "block_bottom"))]
    bcs.append(uem.dirichlet(V, tags["sphere_top"], 2, -(a**2)))

    def make() -> uem.UnitedProblem:
        u = fem.Function(V, name="displacement")
        F = uem.LinearElastic(1e6, 0.3).residual(u, ufl.TestFunction(V)) * ufl.dx
        contact = uem.Contact(contactor=tags["sphere_cap"], target=tags["block_top"], sliding="small")
        return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="scaling_", verbose=args.verbose)

    return make


def solve(dofs: int, runs: int) -> dict[str, object]:
    """Solve a Hertz scene with about so many unknowns some times: the quickest run, and the data that its search sends (collective)."""
    found, make = [], scene(dofs)
    for _ in range(runs):
        common.free_memory()
        comm.barrier()
        before, start = clocks(), time.perf_counter()
        problem = make()
        (step,) = uem.load_steps(problem)
        seconds = [time.perf_counter() - start, *(clocks() - before)]
        found.append([float(max(s)) for s in zip(*comm.allgather(seconds))])
    seconds, *stages = min(found)
    contact = problem.contacts[0]
    pair = contact.pair
    searched = search_traffic(Surfaces(problem.config, pair.target, pair.points))
    return {
        "ranks": comm.size,
        "dofs": 3 * problem.config.index_map.size_global,
        "seconds": seconds,
        "search_bytes_max": searched["bytes_max"],
        "contact_imbalance": searched["imbalance"],
        "contactors": searched["contactors"],
        "active": contact.n_active,
        "newton_iterations": step.newton_iterations,
        "cg_iterations": sum(i.linear_iterations for i in step.iterations),
    } | dict(zip(STAGES, stages))


def clocks() -> np.ndarray:
    """Seconds that each stage has taken so far on this rank."""
    return np.array([sum(uem.timing(timer)[1] for timer in timers) for timers in STAGES.values()])


def count(dofs: int) -> dict[str, object]:
    """Collective calls in the second step of the scene, by stage (collective)."""
    problem = scene(dofs)()
    steps = uem.load_steps(problem, 2)
    next(steps)
    with collectives.counted() as calls:
        step = next(steps)
    steps.close()
    solver = sum(calls.pop(stage, 0) for stage in ("linear solve", "factorisation or preconditioner set-up"))
    row = {"ranks": comm.size, "dofs": 3 * problem.config.index_map.size_global, "newton_iterations": step.newton_iterations}
    return row | {"all": sum(calls.values()), "solver": solver} | dict(calls.most_common())


# %% [markdown]
# ## On paper: a thousand ranks
# Bytes that go with a rank's own contactors and facets are those of the most ranks that were measured, as many for each; bytes that
# every rank sends to every other are as many for each pair.


# %%
def on_paper(row: dict, share: int) -> list[dict[str, float]]:
    """Bytes that a rank with so many contactors and facets receives in one search on more and more ranks, from a row of "plates"."""
    own = row["bytes_per_share"] - row["bytes_per_rank"] * (row["ranks"] - 1) / row["share_max"]
    return [
        {
            "ranks": ranks,
            "contactors_and_facets": share * ranks,
            "bytes_own": own * share,
            "bytes_told_by_all": row["bytes_per_rank"] * (ranks - 1),
            "partners": min(row["partners"], ranks - 1),
        }
        for ranks in (8, 64, 512, 1000, 4096)
    ]


# %% [markdown]
# ## Here: on the ranks of this call


# %%
def best_time(surfaces: Surfaces) -> float:
    """Seconds of the quicker of two searches of all contactors (collective)."""
    seconds = []
    for _ in range(2):
        comm.barrier()
        start = time.perf_counter()
        surfaces.target.project(surfaces.points)
        seconds.append(max(comm.allgather(time.perf_counter() - start)))
    return min(seconds)


def here(dofs: int, sizes: str, searches: str, counted: int) -> dict[str, list]:
    """All measurements on the ranks of this call (collective)."""
    found: dict[str, list] = {"ranks": [], "plates": [], "search": [], "collectives": []}
    if counted and collectives.counts():
        found["collectives"].append(count(counted))
    if dofs:
        # whatever is compiled or imported at first use
        solve(min(dofs, 2000), 1)
        found["ranks"].append(solve(dofs, args.runs))
    for n in common.numbers(sizes):
        found["plates"].append({"ranks": comm.size} | search_traffic(plates(n)))
    for n in common.numbers(searches):
        surfaces = plates(n)
        found["search"].append({"contactors": sum(comm.allgather(len(surfaces.points))), "seconds": best_time(surfaces)})
    return found


# %% [markdown]
# ## Apart: one call for each number of ranks


# %%
def apart(ranks: int, **options: object) -> dict[str, list]:
    """Results of this script on so many ranks, in a process of its own."""
    parts = {"runs": args.runs, "dofs": 0, "plates": "", "searches": "", "counted": 0} | options
    return run_on(ranks, __file__, counting=bool(parts["counted"]), verbose=args.verbose, **parts)


# %%
if args.where == "here" or comm.size > 1:
    if comm.rank == 0 and args.where != "here":
        print(f"measured on the {comm.size} ranks of this call alone; call it on one rank to compare numbers of ranks")
    results = here(args.dofs, args.plates, args.searches, args.counted)
else:
    results = {
        "ranks": [row for k in common.numbers(args.ranks) if args.dofs for row in apart(k, dofs=args.dofs)["ranks"]],
        "plates": [
            row for k in common.numbers(args.plate_ranks) if args.plates for row in apart(k, plates=args.plates)["plates"]
        ],
        "search": apart(1, searches=args.searches)["search"] if args.searches else [],
        "collectives": [
            row for k in common.numbers(args.count_ranks) if args.counted for row in apart(k, counted=args.counted)["collectives"]
        ],
    }

# %% [markdown]
# ## Ratios
# The exponent of the search is that between a row and the one before.

# %%
for row in results["ranks"]:
    alone = [r["seconds"] for r in results["ranks"] if r["ranks"] == 1]
    row["speedup"] = alone[0] / row["seconds"] if alone else None
for row, last in zip(results["search"], [None, *results["search"]]):
    more, longer = (1.0, 1.0) if last is None else (row[key] / last[key] for key in ("contactors", "seconds"))
    row["exponent"] = float(np.log(longer) / np.log(more)) if last is not None else None
widest = max(
    (row for row in results["plates"] if row["ranks"] > 1), key=lambda row: (row["ranks"], row["contactors"]), default=None
)
results["paper"] = on_paper(widest, 2000) if widest else []
common.report(args, {name: rows for name, rows in results.items() if rows})

# %% [markdown]
# ## The picture

# %%
with uem.figure(args.plot, comm, panels=2) as (left, right):
    if left is not None:
        k = [row["ranks"] for row in results["ranks"]]
        left.plot(k, k, "k:", label="ideal")
        left.plot(k, [row["speedup"] or np.nan for row in results["ranks"]], "o-", label="from problem to solution")
        for stage in STAGES:
            alone = [row[stage] for row in results["ranks"] if row["ranks"] == 1]
            left.plot(k, [alone[0] / row[stage] if alone else np.nan for row in results["ranks"]], ".--", lw=0.8, label=stage)
        left.set_xlabel("ranks")
        left.set_ylabel("speed-up")
        left.set_xticks(k)
        left.legend(fontsize=8)
        several = [row for row in results["plates"] if row["ranks"] > 1]
        for count in sorted({row["contactors"] for row in several}):
            rows = [row for row in several if row["contactors"] == count]
            right.loglog([count / r["ranks"] for r in rows], [r["bytes_max"] for r in rows], "o-", label=f"{count} contactors")
        if several:
            ends = np.array([f(row["contactors"] / row["ranks"] for row in several) for f in (min, max)])
            right.loglog(ends, ends / ends[1] * max(row["bytes_max"] for row in several), "k:", label="in proportion")
            right.legend()
        right.set_xlabel("contactors per rank")
        right.set_ylabel("most bytes that a rank receives in a search")

# %% [markdown]
# ## What must hold
# What a rank receives is bounded by its own part of the surfaces and the number of ranks, whatever the whole surface.

# %%
#: Bytes for each contactor and facet of a rank's own, two answers at most, and for every rank that talks to it.
PER_OWN, PER_RANK = 550, 64
for row in results["plates"]:
    assert row["bytes_max"] <= (PER_OWN * row["share_max"] + PER_RANK * row["ranks"]) * (row["ranks"] > 1), row
