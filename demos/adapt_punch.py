"""A flat punch with sharp corners: uniform meshes, and meshes that follow the estimated error.

python3 demos/adapt_punch.py --plot adapt_punch.png

Options:
    halvings: uniform meshes of each degree, each of half the size of the one before
    tolerances: number of tolerances, each half of the one before
"""

# %% [markdown]
# # A sharp corner
#
# A rigid flat punch is pressed onto an elastic block without friction. Next to its corner the pressure grows like $1/\sqrt{r}$, so that
# the displacement is no smoother than $\sqrt{r}$. On uniform meshes the error in the energy norm then falls like $h^{1/2}$, or like
# $N^{-1/4}$ with the number N of unknowns, *for every degree*: finer cells far from the corner serve nothing.
#
# On meshes that follow the error it falls like $N^{-p/2}$, as if the solution were smooth.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, halvings=5, tolerances=5)
pressed = 0.01


# %% [markdown]
# ## The scene
# Half of the block, whose bottom is moved up. Where the punch is, the block's surface touches a rigid plane.


# %%
def punch(degree: int, size=None, h: float = 0.5) -> uem.UnitedProblem:
    mesh, tags = uem.read_gmsh(common.MESHES / "adapt_punch.geo", comm, gdim=2, parameters={"h": h}, size=size)
    V = uem.function_space(mesh, degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["bottom"], 1, pressed)]
    contact = uem.Contact(tags["under_punch"], uem.RigidPlane((0.0, 0.0), (0.0, -1.0)), name="punch")
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], verbose=args.verbose)


# %% [markdown]
# ## The meshes
# Uniform ones, and for each tolerance those of an adaptation, of which the last one counts. The squared error is the difference of the
# energy from that of the finest adapted mesh of degree 2.

# %%
uniform, adapted = {}, {}
for degree in (1, 2):
    uniform[degree], adapted[degree] = [], []
    for k in range(args.halvings):
        problem = punch(degree, h=0.5 / 2**k)
        problem.solve()
        uniform[degree].append((len(problem.u.x.array), uem.error_estimate(problem)))
    for k in range(args.tolerances):
        found = uem.adapt(lambda size, degree=degree: punch(degree, size), tolerance=(0.14, 0.07)[degree - 1] / 2**k)
        adapted[degree].append((found.meshes[-1].unknowns, found.estimate))
finest = uem.adapt(lambda size: punch(2, size), tolerance=0.03 / 2**args.tolerances)
exact = uem.error_estimate(finest.problem).norm ** 2

# %% [markdown]
# ## The orders
# Of the error in N, between the last two uniform meshes, and from the first to the last adapted one.

# %%
rows, orders = [], {}
for name, kinds in (("uniform", uniform), ("adapted", adapted)):
    for degree, meshes in kinds.items():
        own = []
        for _, estimate in meshes:
            V = estimate.cells.function_space
            cells = V.dofmap.index_map.size_global
            error = float(np.sqrt(abs(estimate.norm**2 - exact) / exact))
            own.append({"mesh": name, "degree": degree, "cells": cells, "estimate": estimate.relative, "error": error})
        first, last = own[-2 if name == "uniform" else 0], own[-1]
        orders[f"order_{name}_{degree}"] = -float(np.log(last["error"] / first["error"]) / np.log(last["cells"] / first["cells"]))
        rows += own
effectivities = [row["estimate"] / row["error"] for row in rows]
results = {"rows": rows, **orders, "least_effectivity": min(effectivities), "largest_effectivity": max(effectivities)}
common.report(args, results)

# %% [markdown]
# ## The picture

# %%
if args.output:
    with uem.ResultsWriter(
        f"{args.output}/adapt_punch", finest.problem, fields={"error_estimate": finest.estimate.cells}
    ) as writer:
        writer.write(1.0)
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.2)) as (left, right):
    shown = uem.adapt(lambda size: punch(2, size), tolerance=0.02).problem
    uem.plot_scene(shown, left, label="displacement", window=(0, 2, -2, 0.1))
    if right:
        for name, marker in (("uniform", "s--"), ("adapted", "o-")):
            for degree, colour in ((1, "C0"), (2, "C1")):
                own = [row for row in rows if row["mesh"] == name and row["degree"] == degree]
                x, y = ([row[key] for row in own] for key in ("cells", "error"))
                right.loglog(x, y, marker, color=colour, ms=4, label=f"{name}, degree {degree}")
        right.set(xlabel="number of cells", ylabel="error in the energy norm", ylim=(5e-5, 0.5))
        right.legend(loc="lower left")
