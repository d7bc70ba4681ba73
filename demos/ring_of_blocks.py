"""Bodies about a line, each contactor of the next: nobody comes first, and the ring of equations is closed.

python3 demos/ring_of_blocks.py --plot ring_of_blocks.png

Options:
    sectors: number of sectors, 3 or more
    cells: cells along the sides of the first sector on each mesh, comma-separated
    more: cells more along the sides of each further sector
    eps: inward displacement of the rim relative to the radius
"""

# %% [markdown]
# # A ring of bodies
#
# A disc is cut into sectors that meet in its centre. Each lies with its last side, as contactor, on the first side of the next one, its
# target, all the way round. The rim is pushed inwards by eps R, so that the whole disc shrinks evenly,
#
# $$
# u = -\varepsilon x, \qquad \sigma = -p, \qquad p = 2 \varepsilon (\lambda + \mu) \quad \text{in plane strain,}
# $$
#
# and every side carries p, whatever the number of sectors and wherever their nodes are.
#
# In the centre one node of each body meets all others. The equation of the first eliminates a component of its displacement in terms of
# the second's, that of the second in terms of the third's, and the last one's in terms of the first's: for three sectors each follows
# the next by cos 120 degrees. Such rings have no order of elimination; they are solved as a small system, `algebra/rings.py`:
#
# $$
# A\, du = W C (1 - L A)\, du - W g, \qquad W = (1 - C L)^{-1}
# $$
#
# With nodes the meshes match at the sides; with `--coupling mortar` give `--more 1`, which divides every sector more finely than the
# one before: pressures stay even all the same.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, sectors=3, cells="2,4,8,16", more=0, degree=1, eps=1e-3, nu=0.3, coupling=("node_to_surface", "mortar"),
)  # fmt: skip
E, nu = 1.0, args.nu
p = 2 * args.eps * (E * nu / ((1 + nu) * (1 - 2 * nu)) + E / (2 * (1 + nu)))


# %% [markdown]
# ## The scene


# %%
def disc(n: int) -> tuple[uem.UnitedProblem, list[uem.Contact]]:
    """All sectors, with so many cells along the sides of the first, pushed in at the rim."""
    parameters = {"sectors": args.sectors, "n": n, "more": args.more}
    mesh, tags = uem.read_gmsh(common.MESHES / "sectors.geo", comm, gdim=2, parameters=parameters)
    V = uem.function_space(mesh, args.degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
    shrunk = fem.Function(V)
    shrunk.interpolate(lambda x: -args.eps * x[:2])
    of = range(1, args.sectors + 1)
    bcs = [uem.dirichlet(V, [tags[f"rim_{k}"] for k in of], value=shrunk)]
    contacts = [
        uem.Contact(contactor=tags[f"last_{k}"], target=tags[f"first_{k % args.sectors + 1}"], coupling=args.coupling) for k in of
    ]
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, petsc_options_prefix="ring_", verbose=args.verbose), contacts


# %% [markdown]
# ## The solutions
# Errors are the largest, relative to eps R and to p. At the rim both bodies are prescribed, so that contactors there carry nothing.

# %%
rows = []
for n in common.numbers(args.cells):
    problem, contacts = disc(n)
    (step,) = uem.load_steps(problem)
    x, u = problem.config.X, problem.config.displacement
    wrong = np.linalg.norm(u + args.eps * x[:, :2], axis=1).max(initial=0.0) / args.eps
    uneven = [np.abs(c.pressures[np.linalg.norm(c.pair.points, axis=1) < 0.99] / p - 1).max(initial=0.0) for c in contacts]
    of_all = np.array(comm.allgather((wrong, max(uneven)))).max(axis=0)
    rows.append({
        "cells": n,
        "displacement_error": float(of_all[0]),
        "pressure_error": float(of_all[1]),
        "balance": max(contact.balance().force for contact in contacts),
        "contactors": sum(contact.n_active for contact in contacts),
        "newton_iterations": step.newton_iterations,
    })  # fmt: skip
results = {
    "meshes": rows,
    "pressure": p,
    "displacement_error": max(row["displacement_error"] for row in rows),
    "pressure_error": max(row["pressure_error"] for row in rows),
    "sectors": args.sectors,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2) as panels:
        uem.plot_scene(problem, panels[0], label="displacement")
        uem.plot_pressure(contacts, panels[1], along=lambda x: np.linalg.norm(x, axis=1), reference=lambda r: np.full_like(r, p),
                          reference_label="closed form", along_label="distance from the centre", window=(0.0, 1.0))  # fmt: skip
if args.output:
    with uem.ResultsWriter(f"{args.output}/ring_of_blocks", problem) as writer:
        writer.write(step)

# %% [markdown]
# The remaining error is the rounding of coordinates relative to eps R.

# %%
if args.coupling == "mortar" or not args.more:
    assert max(results["displacement_error"], results["pressure_error"]) < 1e-13 / args.eps
