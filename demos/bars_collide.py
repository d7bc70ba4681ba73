"""Two equal elastic bars collide and swap their velocities.

mpirun -n 2 python3 demos/bars_collide.py --dim 3

Options:
    n: cells along each bar
    n_width: cells across the lower bar; the upper one has one more
    v1: initial velocity of the lower bar, upwards
    v2: initial velocity of the upper bar, upwards
"""

# %% [markdown]
# # Two bars collide
#
# Equal bars fly along their axes and meet face to face. Waves run from the touch through both; when they come back from the free
# ends, the bars part and have swapped their velocities, without vibration, whatever those were. The pressure between is
# rho c (v2 - v1) / 2 for the time 2 L / c.
#
# No force comes from outside, so that the sum of the momenta stays the same to rounding: what the contact gives to one bar it takes
# from the other. The meshes do not match across the contact; with `--coupling mortar` a constant pressure passes
# between them all the same.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dim=2, n=100, n_width=2, cfl=0.7071, v1=4.0, v2=-6.0, coupling=("node_to_surface", "mortar"))
E, rho, L, gap, width = 900.0, 1.0, 10.0, 0.1, 1.0
c = np.sqrt(E / rho)

# %% [markdown]
# ## The scene
# The lower bar flies upwards with v1, the upper one with v2.

# %%
d = args.dim
sizes = {
    "dim": d,
    "bars": 2,
    "L": L,
    "gap": gap,
    "width": width,
    "n": args.n,
    "n_width": args.n_width,
    "n_upper": args.n_width + 1,
}
mesh, tags = uem.read_gmsh(common.MESHES / "bars.geo", comm, gdim=d, parameters=sizes)
V = uem.function_space(mesh, 1, (d,))
u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
mesh.topology.create_connectivity(d, d)
for name, value in (("lower", args.v1), ("upper", args.v2)):
    velocity.x.array[fem.locate_dofs_topological(V.sub(1), d, tags[name].entities)] = value
material = uem.LinearElastic(E, 0.0, kind="plane_stress" if d == 2 else "3d")
dynamics = uem.Dynamics(uem.consistent_mass(V, rho), velocity=velocity)
contact = uem.Contact(contactor=tags["upper_bottom"], target=tags["lower_top"], coupling=args.coupling)
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics, petsc_options_prefix="bars_", verbose=args.verbose
)

# %% [markdown]
# ## The collision
# A bar's velocity is the mean over its volume.

# %%
volume = L * width ** (d - 1)
means = [fem.form(dynamics.velocity[1] / volume * uem.dx(tags[name])) for name in ("lower", "upper")]
book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/energy.csv" if args.output else None)
writer = uem.ResultsWriter(f"{args.output}/bars_collide", problem) if args.output else None
meet = gap / (args.v1 - args.v2)
rows = []
for step in uem.time_steps(problem, args.cfl * L / args.n / c, meet + 3 * L / c, event_tolerance=1e-3):
    book.write(step)
    rows.append((step.time, *(uem.integrate(form) for form in means), contact.resultant().force[1]))
    if writer is not None and step.number % 10 == 0:
        writer.write(step)
book.close()
if writer is not None:
    writer.close()

# %% [markdown]
# ## Before and after

# %%
t, v1, v2, force = np.array(rows).T
momentum = np.array(book.momenta)[:, 1]
row = book.rows[-1]
results = {
    "v1": float(v1[-1]),
    "v2": float(v2[-1]),
    "restitution": float((v2[-1] - v1[-1]) / (args.v1 - args.v2)),
    "momentum_error": float(np.abs(momentum - momentum[0]).max() / (rho * volume * max(abs(args.v1), abs(args.v2)))),
    "energy_ratio": (row.kinetic + row.stored) / book.rows[0].kinetic,
    "mean_pressure": float(book.impulses[-1][0][1]) / (2 * L / c) / width ** (d - 1),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as panels:
        if panels[0] is not None:
            swap = [0.0, meet, meet + 2 * L / c, t[-1]]
            for v, label, ends in ((v1, "lower bar", (args.v1, args.v2)), (v2, "upper bar", (args.v2, args.v1))):
                panels[0].plot(swap, np.repeat(ends, 2), color="0.3", lw=2.5, alpha=0.4, label="exact" if v is v2 else None)
                panels[0].plot(t, v, label=label)
            panels[0].set(xlabel="time", ylabel="mean velocity")
            panels[0].legend(frameon=False)
            given = rho * c * (args.v1 - args.v2) / 2 * width ** (d - 1) * 2 * L / c
            impulse = np.array([row[0][1] for row in book.impulses])
            panels[1].plot(swap, (0.0, 0.0, 1.0, 1.0), color="0.3", lw=2.5, alpha=0.4, label="exact")
            panels[1].plot([row.time for row in book.rows], impulse / given, color="C2", label="impulse on the upper bar")
            total = np.abs(momentum - momentum[0]).max() / given
            panels[1].set(xlabel="time", ylabel="impulse of the contact / exact", title=f"momentum lost: {total:.0e}")
            panels[1].legend(frameon=False)
            for ax in panels:
                ax.grid(alpha=0.25)

# %%
assert results["momentum_error"] < 1e-12, results
if args.n >= 100:
    assert abs(results["v1"] / args.v2 - 1) < 5e-3 and abs(results["v2"] / args.v1 - 1) < 5e-3, results
