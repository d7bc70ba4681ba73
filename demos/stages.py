"""Scenes run only the stages that they need: how often every demo runs each stage of the method, and the cost of its active set.

python3 demos/stages.py --plot stages.png

Options:
    demos: demos to run, comma-separated; none: all
    seconds: 1: a table of the time as well
"""

# %% [markdown]
# # What a scene does not need
#
# Every demo runs in its small configuration, in a process of its own, and reports how often each stage was run. A zero is a stage that
# the scene did not need:
#
# - *search* for the facets near the contactors: not on rigid surfaces, which are projected onto at once;
# - *projection* onto the target, with the search in it, and then *P* and the product *P'KP*: not where nothing touches;
# - assembly of the *tangent* K and *factorisation*, or set-up of the preconditioner: once where bodies are linear and contacts stay;
# - *mass*: not in statics;
# - *history*, return mapping and commits: not in elastic bodies;
# - *output*, fields, tables and checkpoints: only if a file is given. With --output the demos write theirs to folders in DIR.
#
# Who touches, sticks or slips is found by exchanges of contactors within a linearised problem. A second table lists how many load or time
# steps, Newton iterations and exchanges there were, and how many factorisations, or set-ups of a preconditioner, did for all of them.
#
# The demos run on one process each, however many ranks this script has. --demos names some of them, parted by commas; --seconds 1 adds
# a table of the time.

# %%
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import common
import numpy as np
from common import comm

import uem_dolfinx as uem

args = common.arguments(__doc__, demos="", seconds=0)
HERE = Path(__file__).resolve().parent

#: The timers of each stage.
STAGES = {
    "search": ["search"],
    "projection": ["projection"],
    "P": ["restriction matrix P"],
    "P'KP": ["united matrix P'KP", "condensed matrix"],
    "tangent": ["assemble tangent"],
    "factorisation": ["factorisation or preconditioner set-up"],
    "mass": ["assemble mass", "redistribute mass", "first acceleration", "inertia forces"],
    "history": ["return mapping", "commit history"],
    "output": ["write fields", "write table", "write checkpoint", "read checkpoint"],
}

#: Runs a demo and writes down the counts of DOLFINx's timers: script, file, names of timers, options.
RUNNER = """
import json, runpy, sys, time
script, file, timers, *options = sys.argv[1:]
sys.argv = [script, *options]
sys.path.insert(0, script.rpartition("/")[0])
from uem_dolfinx.solve.problem import UnitedProblem
attempt, counts = UnitedProblem.attempt, {"steps": 0, "iterations": 0, "exchanges": 0}
def counted(*args, **how):
    history = attempt(*args, **how)
    for name, n in (("steps", 1), ("iterations", len(history)), ("exchanges", sum(i.exchanges for i in history))):
        counts[name] += n
    return history
UnitedProblem.attempt = counted
start = time.perf_counter()
runpy.run_path(script, run_name="__main__")
wall = time.perf_counter() - start
import uem_dolfinx
measured = {t: uem_dolfinx.timing(t) for t in json.loads(timers)}
with open(file, "w", encoding="utf-8") as out:
    json.dump({"timers": measured, "wall": wall, "counts": counts}, out)
"""

# %% [markdown]
# ## The small configurations


# %%
def small() -> dict[str, list[str]]:
    """Options of every demo's first small configuration, but of this one."""
    lines = (HERE / "small.txt").read_text(encoding="utf-8").splitlines()
    parted = [line.partition(":") for line in lines if line and not line.startswith("#")]
    return {name: options.partition(";")[0].split() for name, _, options in parted if name != Path(__file__).stem}


# %% [markdown]
# ## One demo


# %%
def run(name: str, options: list[str]) -> tuple[dict[str, int], dict[str, float], dict[str, int]]:
    """Calls and seconds of every stage of a demo, with the seconds of the whole, and how often contactors were exchanged."""
    timers = [timer for stage in STAGES.values() for timer in stage]
    if args.output:
        options = [*options, "--output", str(Path(args.output).resolve() / name)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "timers.json"
        command = [sys.executable, "-c", RUNNER, str(HERE / f"{name}.py"), str(file), json.dumps(timers), *options]
        done = subprocess.run(command, cwd=folder, env=common.outside_mpi(), capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{name} {' '.join(options)} failed:\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
        measured = json.loads(file.read_text(encoding="utf-8"))
    if args.verbose:
        print(f"{name} {' '.join(options)}: {measured['wall']:.1f} s", flush=True)
    calls = {stage: sum(measured["timers"][timer][0] for timer in timers) for stage, timers in STAGES.items()}
    seconds = {stage: sum(measured["timers"][timer][1] for timer in timers) for stage, timers in STAGES.items()}
    return calls, seconds | {"wall": measured["wall"]}, measured["counts"] | {"factorisations": calls["factorisation"]}


# %%
configurations = small()
names = args.demos.split(",") if args.demos else sorted(configurations)
if unknown := set(names) - set(configurations):
    raise ValueError(f"--demos {args.demos}: {', '.join(unknown)} not known here: expected some of {', '.join(configurations)}")
found, failure = {}, None
if comm.rank == 0:
    try:
        found = {name: run(name, configurations[name]) for name in names}
    except RuntimeError as error:
        failure = error
# whatever happens to a demo happens on all ranks
found, failure = comm.bcast((found, failure))
if failure is not None:
    raise failure
results = {"rows": [{"demo": name} | calls for name, (calls, _, _) in found.items()]}
results["exchanges"] = [{"demo": name} | counts for name, (_, _, counts) in found.items() if counts["exchanges"]]
if args.seconds:
    results["seconds"] = [{"demo": name} | seconds for name, (_, seconds, _) in found.items()]
common.report(args, results)

# %% [markdown]
# ## The picture
# Number of calls; the colour is the stage's part of the demo's time, imports and meshing included.

# %%
with uem.figure(args.plot, comm, size=(9.5, 1.2 + 0.33 * len(found))) as (panel,):
    if panel is not None:
        calls = np.array([[row[stage] for stage in STAGES] for row, _, _ in found.values()])
        share = np.array([[s[stage] / s["wall"] for stage in STAGES] for _, s, _ in found.values()])
        image = panel.imshow(np.ma.masked_where(calls == 0, 100 * share), aspect="auto", cmap="YlOrRd", vmin=0.0)
        panel.set_xticks(range(len(STAGES)), STAGES)
        panel.set_yticks(range(len(found)), [name.replace("_", " ") for name in found])
        panel.xaxis.tick_top()
        panel.tick_params(length=0)
        panel.set_frame_on(False)
        for (i, j), n in np.ndenumerate(calls):
            dark = share[i, j] > 0.6 * share.max()
            panel.text(j, i, f"{n}" if n else "–", ha="center", va="center", fontsize=9, color="white" if dark else "black")
        panel.figure.colorbar(image, ax=panel, label="% of the demo's time", fraction=0.03, pad=0.02)

# %% [markdown]
# ## What is known of some demos
# The bodies of the Hertz scenes are linear, those of the stack stay in contact from the start, walls and paraboloids are rigid.

# %%
static = {"mass": 0, "history": 0}
known = {
    "bar_impact": {"search": 0, "history": 0},
    "bars_collide": {"history": 0},
    "exact_impact": {"search": 0},
    "hertz_cylinder": {"tangent": 1} | static,
    "hertz_penalty": {"search": 0} | static,
    "hertz_sphere": {"tangent": 1} | static,
    "ironing": static,
    "stack": {"P": 1, "P'KP": 1, "tangent": 1, "factorisation": 1} | static,
}
for name, (calls, _, _) in found.items():
    for stage, n in known.get(name, {}).items():
        assert calls[stage] == n, (name, stage, calls)
    assert calls["tangent"] > 0 and calls["factorisation"] > 0, (name, calls)
