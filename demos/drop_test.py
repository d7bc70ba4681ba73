"""Drop test: an instrument's cover of aluminium falls on its corner onto a rigid floor, with plasticity, friction and self contact.

mpirun -n 2 python3 demos/drop_test.py --plot drop_test.png

Options:
    h: size of cells along the walls in mm; 0.7 with n = 2 gives 100,000 unknowns
    n: cells through the thickness of 2 mm
    speed: at the floor in m/s
    friction: coefficient between floor and cover, and between parts of the cover
    end: end of the run in milliseconds
    film: file of a film, .gif or .mp4
"""

# %% [markdown]
# # Drop test
#
# A cover of 60 x 40 x 12 mm with walls and a rib of 2 mm falls with one corner ahead. The corner is crushed, the cover rebounds and
# turns. One declaration covers contact with the floor and of the cover with itself.
#
# Steps are explicit, by central differences. All nodes of thin walls are on surfaces, so contactors keep their mass: nodes move freely in
# a step, and the united system of masses PᵀMP then brings them back onto the surfaces they have entered. There is no penalty to choose,
# gaps are closed to rounding, and the cells alone limit the step. A node that hits the floor is stopped as in a plastic impact.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, h=2.0, n=1, speed=10.0, friction=0.2, end=0.3, film="")
# N, mm, tonnes, s
E, nu, yield_stress, hardening, rho = 70e3, 0.33, 150.0, 1000.0, 2.7e-9

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "cover.geo", comm, gdim=3, parameters={"h": args.h, "n": args.n})
V = uem.function_space(mesh, 1, (3,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
metal = uem.FinitePlasticity(u, E, nu, yield_stress, hardening, kind="3d")

# %% [markdown]
# ## The fall
# The floor passes through the lowest corner, and its normal points to the middle of the cover.

# %%
upwards = np.array([1.0, 1.4, 2.0]) / np.linalg.norm([1.0, 1.4, 2.0])
speed = 1e3 * args.speed
floor = uem.RigidPlane(np.zeros(3), upwards)
contact = uem.GeneralContact(rigid=[floor], friction=args.friction)
mass = uem.lumped_mass(V, rho)
dynamics = uem.Dynamics(mass, velocity=-speed * upwards, scheme=uem.CentralDifferences(), contactors="massy")
problem = uem.UnitedProblem(
    metal.residual(v),
    u,
    contacts=[contact],
    materials=[metal],
    dynamics=dynamics,
    petsc_options_prefix="drop_",
    verbose=args.verbose,
)

# %% [markdown]
# ## The run
# In explicit steps the force of a step acts for all of it, so that its impulse is the change of momentum. Forces of nodes that hit the
# floor are rough, so that the energy book adds up the work of every step.

# %%
own = slice(3 * problem.config.n_owned)
fields = metal.cell_averages()
look = {"field": fields["peeq"], "label": "plastic strain", "view": (-1.0, -0.6, -0.7), "window": (-8, 24, -8, 20, -4, 13),
        "rigid": False}  # fmt: skip
book, impulse, rows, seconds = uem.EnergyBook(problem), np.zeros(3), [], []
writer = uem.ResultsWriter(f"{args.output}/cover", problem, fields=fields) if args.output else None


def steps():
    """Every 25th step, after its figures."""
    start = time.perf_counter()
    for step in uem.time_steps(problem, end=1e-3 * args.end):
        seconds.append(time.perf_counter() - start)
        force = comm.allreduce(contact.force.x.array[own].reshape(-1, 3).sum(axis=0))
        impulse[:] += step.dt * force
        rows.append((step.time, float(force @ upwards), step.newton_iterations))
        book.write(step)
        if step.number % 25 == 0:
            metal.cell_averages()
            if writer is not None:
                writer.write(step)
            yield step
        start = time.perf_counter()


for _ in uem.animate(args.film, problem, steps(), **look) if args.film else steps():
    pass
if writer is not None:
    writer.close()

# %% [markdown]
# ## The figures
# The momentum of all nodes in the last step against the impulses of the floor, the energy balance, and the cost of a step over that of its
# residual.

# %%
m = mass.of_nodes
momentum = comm.allreduce((m * dynamics.mean_velocity.x.array[own].reshape(-1, 3)).sum(axis=0))
total = comm.allreduce(float(m[:, 0].sum()))
start = time.perf_counter()
for _ in range(5):
    problem.bodies.assemble()
residual = (time.perf_counter() - start) / 5
t, force, iterations = np.array(rows).T
first, last = book.rows[0], book.rows[-1]
metal.cell_averages()
results = {
    "unknowns": 3 * V.dofmap.index_map.size_global,
    "steps": len(rows),
    "momentum_error": float(np.linalg.norm(momentum + total * speed * upwards - impulse) / (total * speed)),
    "energy_error": max(abs(row.defect) for row in book.rows) / first.kinetic,
    "kinetic": last.kinetic / first.kinetic,
    "dissipated": last.dissipated / first.kinetic,
    "largest_force": float(force.max()),
    "rebound": float(momentum @ upwards / (total * speed)),
    "iterations": float(iterations.mean()),
    "cost_of_a_step": float(np.mean(seconds)) / residual,
}
common.report(args, results)

# %%
if args.plot and common.draws_3d():
    with uem.figure(args.plot, comm, panels=3, size=(3.3, 3.8)) as (left, middle, right):
        uem.plot_scene(problem, left, **look)
        if middle is not None:
            middle.plot(1e3 * t, 1e-3 * force)
            middle.set(xlabel="time / ms", ylabel="force of the floor / kN")
            times = [1e3 * row.time for row in book.rows]
            for name in ("kinetic", "stored", "dissipated", "friction"):
                right.plot(times, [getattr(row, name) / first.kinetic for row in book.rows], label=name)
            right.set(xlabel="time / ms", ylabel="energy / kinetic energy at impact")
            right.legend(frameon=False)
            for axes in (middle, right):
                axes.grid(alpha=0.25)

# %%
assert results["momentum_error"] < 1e-9 and results["energy_error"] < 0.01
