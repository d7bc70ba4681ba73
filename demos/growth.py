"""What grows with the number of ranks: messages, collective calls and memory of a contact step, counted on 1 to 16 ranks, and a model.

python3 demos/growth.py --json growth.json --plot growth.png

Options:
    where: apart: a call of mpiexec for each number of ranks; here: the ranks of this call
    scenes: pair: a declared contact; friction: one with friction; general: a general contact; overhang: one at two edges of a block
    sizes: cells along a side of the blocks, comma-separated
    ranks: numbers of ranks, comma-separated; there may be more than cores, since nothing is timed
    memory: 1: the memory of Python and NumPy is counted, too
    unknowns: of the scene on paper, in millions
"""

# %% [markdown]
# # What grows with the ranks
#
# Two blocks are pressed onto each other and sheared. In the second of two load steps every call of MPI is counted, in all libraries,
# with its bytes, by stages of the solution. The linear solver's are PETSc's and hypre's; the rest is counted as that of bodies and contact.
# Counts are those of the busiest rank, over the number of linearisations: iterations and exchanges of the active set.
#
# | count | what it is |
# |---|---|
# | collectives | calls in which all ranks meet |
# | reduced_bytes | in sums and broadcasts, which go over log2 p ranks |
# | gathered_bytes | that every rank sends to every other: sizes of messages, boxes around surfaces |
# | row_bytes | rows of points, feet, equations and matrices, from the ranks that have them |
# | sent_bytes | in messages to single ranks: halos of vectors and matrices |
# | messages | to single ranks, those with rows too |
# | row_blocks, most_row_blocks | blocks of a row of P at an eliminated node, mean and largest |
# | python_bytes | memory of Python and NumPy, the largest from the making of the problem on |
#
# The model has a term for each part of the scene that a rank may have to do with; terms that grow with the number of ranks, or with the
# whole surface, do not scale.

# %%
import common
import numpy as np
from common import comm
from benchmarks import collectives, growth
from benchmarks.apart import run_on

import uem_dolfinx as uem

args = common.arguments(
    __doc__, where=("apart", "here"), scenes="pair,general,overhang", sizes="6,9,12", ranks="2,4,8,16", memory=1, unknowns=100.0
)
scenes = args.scenes.split(",")

# %% [markdown]
# ## The counts

# %%
if args.where == "here" or comm.size > 1:
    counting = collectives.counts()
    rows = [
        growth.step(n, declared, memory=not counting)
        for declared in scenes for n in common.numbers(args.sizes) if counting or args.memory
    ]  # fmt: skip
    stages = [
        {key: row[key] for key in ("scene", "n", "ranks")} | {"stage": stage} | counts
        for row in rows for stage, counts in row.pop("stages", {}).items()
    ]  # fmt: skip
else:
    rows, stages = [], []
    for ranks in common.numbers(args.ranks):
        options = {"scenes": args.scenes, "sizes": args.sizes, "memory": args.memory}
        found, memory = (
            run_on(ranks, __file__, counting=counting, verbose=args.verbose, **options) for counting in (True, False)
        )
        rows += [row | more for row, more in zip(found["counts"], memory["counts"] or [{}] * len(found["counts"]))]
        stages += found["stages"]

# %% [markdown]
# ## The model, and what it says on paper
# A thousand ranks of so many unknowns, and other numbers of ranks with as many each: `own` are terms of a rank's own part, which stay,
# `grows` terms that grow with the number of ranks or with the whole surface.

# %%
models, paper = [], []
each = args.unknowns * 1e6 / 1000
for declared in scenes:
    for count in growth.COUNTS:
        model = growth.fitted([row for row in rows if row["scene"] == declared], count)
        if not model:
            continue
        models.append({"scene": declared, "count": count} | model)
        for ranks in (16, 100, 1000, 10000):
            parts = growth.on_paper(model, each * ranks, ranks)
            grows = parts["each_rank"] + parts["whole_surface"]
            line = {"scene": declared, "count": count, "ranks": ranks, "own": sum(parts.values()) - grows, "grows": grows}
            paper.append(line)
common.report(args, {"counts": rows, "stages": stages, "models": models, "paper": paper})

# %% [markdown]
# ## The picture
# Bytes that the busiest rank receives for the contact in a linearisation, with as many unknowns a rank: its own rows, and data that every
# rank sends to every other. Points are counts at the sizes counted.

# %%
with uem.figure(args.plot, comm, panels=2) as panels:
    for panel, count, label in zip(panels, ("row_bytes", "gathered_bytes"), ("bytes of rows", "bytes from all to all")):
        if panel is None:
            continue
        for k, declared in enumerate(scenes):
            own = [row for row in rows if row["scene"] == declared and row.get(count) and row["ranks"] > 1]
            model = next((m for m in models if m["scene"] == declared and m["count"] == count), None)
            panel.plot([row["ranks"] for row in own], [row[count] for row in own], "o", ms=4, color=f"C{k}", label=declared)
            if model:
                ranks = np.geomspace(2, 8000, 60)
                panel.plot(ranks, [sum(growth.on_paper(model, each * p, p).values()) for p in ranks], "-", lw=1, color=f"C{k}")
        panel.set(xlabel="ranks", ylabel=label)
        if any(len(line.get_xdata()) for line in panel.lines):  # a single rank sends nothing
            panel.set(xscale="log", yscale="log")
            panel.legend(frameon=False)
