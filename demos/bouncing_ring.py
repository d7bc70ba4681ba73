"""A soft ring is thrown obliquely onto a wall and bounces along it, with large rotations and large deformations.

python3 demos/bouncing_ring.py --plot bouncing_ring.png

Options:
    n: cells around the ring, a multiple of 4
"""

# %% [markdown]
# # Bouncing ring
#
# A ring of St Venant-Kirchhoff material flies along a rigid floor, falls, is flattened by the impact, leaves again, and vibrates.
# Nothing in the scene takes energy away, and nothing pushes along the floor: at every time the sum of kinetic energy, strain
# energy and height must be what it was, and the momentum along the floor too.
#
# The contactors are massless: their mass is handed on to the nodes around before the first step. Then a touch is no collision of
# masses, it only begins to load a spring, and the trapezoidal rule keeps the energy.
# With `--coupling mortar` whole facets of the ring meet the floor, not its nodes.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dt=0.0015, end=6.6, n=48, layers=3, E=500.0, coupling=("node_to_surface", "mortar"))
g, height, along = 2.0, 0.25, 1.0  # gravity, height of fall, velocity along the floor

# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "ring.geo", comm, gdim=2, parameters={"n": args.n, "layers": args.layers})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.StVenantKirchhoff(args.E, 0.3, kind="plane_strain")
floor = uem.Contact(
    contactor=tags["outside"], target=uem.RigidPlane((0.0, -1.0 - height), (0.0, 1.0)), name="floor", coupling=args.coupling
)
dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(along, 0.0), gravity=(0.0, -g))
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx, u, contacts=[floor], dynamics=dynamics, rtol=1e-10,
    petsc_options_prefix="ring_", verbose=args.verbose,
)  # fmt: skip

# %% [markdown]
# ## The flight
# A bounce is a touch after which the middle of the ring rises again. Eight frames go into the picture; with `--output` one every
# 0.1 s is written to a film.

# %%
frames, falls = [], [True]
every = max(1, round(args.end / args.dt / 8))
book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/energy.csv" if args.output else None)
writer = uem.ResultsWriter(f"{args.output}/bouncing_ring", problem) if args.output else None
steps = uem.time_steps(problem, args.dt, args.end)
if args.output:
    steps = uem.animate(
        f"{args.output}/bouncing_ring.gif", problem, steps, every=max(1, round(0.1 / args.dt)), size=(7.2, 2.4),
        field=material.energy(u), label="strain energy density", levels=8, cells=False,
    )  # fmt: skip
for step in steps:
    book.write(step)
    falls.append(bool(book.momenta[-1][1] < 0))
    if step.number % every == 0:
        if writer is not None:
            writer.write(step)
        if args.plot:
            frames.append((step.time, uem.outline(problem)))
book.close()
if writer is not None:
    writer.close()

# %% [markdown]
# ## The balance
# Energies relative to what the ring starts with above the floor: its motion, and its height.

# %%
rows, weight = book.rows, g * dynamics.mass.total[1]
total = np.array([row.kinetic + row.stored - row.external for row in rows])
whole = rows[0].kinetic + weight * height
momentum = np.array(book.momenta)[:, 0]
results = {
    "bounces": sum(was and not now for was, now in zip(falls, falls[1:])),
    "energy_drift": float(np.abs(total / whole - total[0] / whole).max()),
    "tangential_momentum_drift": float(np.abs(momentum / momentum[0] - 1).max()),
    "contact_work": rows[-1].contact / whole,
    "largest_stored": max(row.stored for row in rows) / whole,
    "end_time": rows[-1].time,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.6)) as panels:
        book.plot(panels[1])
        if comm.rank == 0:
            import matplotlib

            ax, colours = panels[0], matplotlib.colormaps["viridis"]
            for time, lines in frames:
                ax.plot(*lines.transpose(2, 1, 0), color=colours(0.9 * time / args.end), lw=1.2)
            ax.axhline(-1.0 - height, color="0.3", lw=2)
            ax.set_aspect("equal")
            ax.set(xlabel="x", ylabel="y")
            ax.set_title(f"every {every * args.dt:.2g} s, from dark to light")

# %%
assert results["energy_drift"] < 5e-3, results
assert results["tangential_momentum_drift"] < 1e-8, results
