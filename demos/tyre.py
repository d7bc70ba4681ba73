"""A solid tyre pressed onto the road: rubber at large strain, hexahedra, CG with multigrid, a film.

mpirun -n 2 python3 demos/tyre.py --plot tyre.png

Options:
    n: number of cells in every direction, as a multiple of those in the mesh file
    steps: load steps
    d: displacement of the rim towards the road, relative to the thickness of the tyre
    film: name of a film of the load steps
"""

# %% [markdown]
# # A tyre on the road
#
# A solid tyre with four grooves around it, of neo-Hookean rubber, is bonded to a stiff rim that moves down by d. The road is a rigid
# plane. Half of the tyre's width is modelled; where the ribs touch the road is part of the solution.
#
# Two balances check the result. The force on the rim equals the force on the road. The work of the rim, by the trapezoidal rule over
# all steps, equals the energy in the rubber, since nothing dissipates energy without friction.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=0.6, steps=4, d=0.16, film="")
E, nu, thickness, height = 6e6, 0.45, 0.1, 0.2  # Pa, m

# %% [markdown]
# ## The scene
# Rubber hardly changes its volume: the volumetric part of the stress is integrated with one point in every cell. The CG tolerance follows
# the Newton residual (inexact Newton), and the preconditioner is algebraic multigrid.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "tyre.geo", comm, gdim=3, parameters={"n": args.n})
V = uem.function_space(mesh, 1, (3,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
rubber = uem.NeoHooke(E, nu)
road = uem.RigidPlane((0.0, 0.0, -height), (0.0, 0.0, 1.0))
contact = uem.Contact(contactor=tags["tread"], target=road)
bcs = [uem.dirichlet(V, tags["rim"], c, value) for c, value in enumerate((0.0, 0.0, -args.d * thickness))]
bcs.append(uem.dirichlet(V, tags["middle"], 1))
problem = uem.UnitedProblem(
    rubber.residual_form(u, v), u, bcs=bcs, contacts=[contact], petsc_options_prefix="tyre_", petsc_options=common.cg(),
    verbose=args.verbose,
)  # fmt: skip

# %% [markdown]
# ## The run
# A film is made of the steps if it has a name.

# %%
density = rubber.energy(u) / E
look = {"field": density, "label": "strain energy density / E", "percentiles": (0, 99), "cells": False, "view": (0.5, -1.2, 0.3)}
run = uem.load_steps(problem, args.steps)
start, rows = time.perf_counter(), [{"d": 0.0, "force": 0.0, "patch": 0.0, "p_max": 0.0, "newton": 0, "cg": 0}]
for step in uem.animate(args.film, problem, run, frames_per_second=3, **look) if args.film else run:
    rows.append(
        {
            "d": step.factor * args.d * thickness,
            "force": float(2 * contact.resultant().force[2]),
            "patch": 2 * uem.integrate(contact.active * uem.ds(tags["tread"])),
            "p_max": contact.max_pressure(),
            "newton": step.newton_iterations,
            "cg": sum(i.linear_iterations for i in step.iterations),
        }
    )
seconds = time.perf_counter() - start

# %% [markdown]
# ## The figures
# Forces, energy and work of the whole tyre, all iterations, and the gap at the contactors on the road.

# %%
d, force = (np.array([row[name] for row in rows]) for name in ("d", "force"))
energy = 2 * uem.integrate(rubber.energy_form(u))
work = float(np.sum(np.diff(d) * (force[1:] + force[:-1]) / 2))
results = {
    "unknowns": 3 * V.dofmap.index_map.size_global,
    "force": float(force[-1]),
    "rim_error": float(abs(2 * problem.reaction(tags["rim"])[2] + force[-1]) / force[-1]),
    "energy": energy,
    "work_error": work / energy - 1,
    "max_gap": contact.max_gap(),
    "active": contact.n_active,
    "seconds": seconds,
    "steps": rows,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The middle plane of the tyre, and from below the pressure on the ribs, grey where they do not touch.

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/tyre", problem) as writer:
        writer.write(1.0)
if args.plot and common.draws_3d():
    with uem.figure(args.plot, comm, panels=3, size=(3.3, 3.6)) as (left, middle, right):
        uem.plot_scene(problem, left, **look)
        uem.plot_scene(
            problem, middle, field=contact, label="contact pressure / Pa", surface=tags["tread"], view=(0.0, -0.05, -1.0), rigid=False,
            window=(-0.1, 0.1, 0.0, 0.1, -0.25, -0.1), cells=False,
        )  # fmt: skip
        if right is not None:
            right.plot(1e3 * d, 1e-3 * force, "o-", ms=4)
            right.set(xlabel="displacement of the rim / mm", ylabel="force / kN")
            right.grid(alpha=0.25)

# %%
assert results["rim_error"] < 1e-4 and abs(results["work_error"]) < 0.4 / args.steps**2
