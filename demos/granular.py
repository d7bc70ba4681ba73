"""Elastic discs fall into a box and come to rest in a heap: all of them against each other and the walls by one declaration.

python3 demos/granular.py --plot granular.png

Options:
    rows: rows of discs
    columns: discs in a row
    n: facets around each disc
    gamma: drag of the medium per unit of mass and velocity, an inverse time
    tau: viscosity of the discs divided by E, a time
    falling: time steps of the run without contact, whose time is compared
"""

# %% [markdown]
# # A heap of discs
#
# Rows of elastic discs fall into a box of three rigid planes. Which of them will meet is not known beforehand, and need not be:
#
# ```python
# contact = uem.GeneralContact(rigid=walls, friction=mu)
# ```
#
# The discs move in a viscous medium, whose drag on a volume is gamma rho v, and their material is viscous as well, so that they come
# to rest. Two sums need no reference solution. In every step the momentum grows by the impulses of weight W, medium and contacts,
#
# $$
# p_{n+1} - p_n = \Delta t\, W + \frac{\Delta t}{2} (f_n + f_{n+1}) - \frac{\Delta t}{2} (d_n + d_{n+1}),
# \qquad d = \gamma \rho \int v\, dx,
# $$
#
# where f is the sum of all nodal contact forces, in which those between the discs must cancel. At rest the floor, with the
# friction of the walls, carries the weight.

# %%
from time import process_time
from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, rows=8, columns=5, friction=0.3, dt=0.04, end=14.0, n=24, E=1000.0, gamma=3.0, tau=0.02, falling=20
)
g, rho, R, apart = 2.0, 1.0, 0.5, 1.15

# %% [markdown]
# ## The scene
# Every second row is shifted by half of the distance between the discs. The viscous stress is tau E times the rate of the Green strain,
# which no rigid motion changes.

# %%
d = 2 * R * apart
sizes = {"rows": args.rows, "columns": args.columns, "R": R, "apart": apart, "n": args.n}
mesh, _ = uem.read_gmsh(common.MESHES / "granular.geo", comm, gdim=2, parameters=sizes)
V = uem.function_space(mesh, 1, (2,))
material = uem.StVenantKirchhoff(args.E, 0.3, kind="plane_strain")
walls = [
    uem.RigidPlane((0.0, -0.02), (0.0, 1.0)),
    uem.RigidPlane((-0.6 * d, 0.0), (1.0, 0.0)),
    uem.RigidPlane((d * (args.columns + 0.1), 0.0), (-1.0, 0.0)),
]


def discs(contacts: list[uem.GeneralContact]) -> tuple[uem.UnitedProblem, uem.Dynamics, list[Any]]:
    """The discs at rest above the floor, and the components of the medium's drag on all of them."""
    u, v, drag = fem.Function(V, name="displacement"), ufl.TestFunction(V), []

    def strain_rate(velocity: Any) -> Any:
        return ufl.sym((ufl.Identity(2) + ufl.grad(u)).T * ufl.grad(velocity))

    def damping(velocity: Any) -> Any:
        drag.extend(fem.form(args.gamma * rho * velocity[i] * ufl.dx) for i in range(2))
        viscous = args.tau * args.E * ufl.inner(strain_rate(velocity), strain_rate(v))
        return (args.gamma * rho * ufl.inner(velocity, v) + viscous) * ufl.dx

    dynamics = uem.Dynamics(uem.lumped_mass(V, rho), gravity=(0.0, -g), damping=damping)
    problem = uem.UnitedProblem(
        material.residual(u, v) * ufl.dx, u, contacts=contacts, dynamics=dynamics, rtol=1e-9,
        petsc_options_prefix="heap_", verbose=args.verbose,
    )  # fmt: skip
    return problem, dynamics, drag


# %% [markdown]
# ## Without contact
# The same bodies falling freely, to compare the time that a step takes, of the processor.

# %%
problem, *_ = discs([])
begun = process_time()
without = sum(1 for _ in uem.time_steps(problem, args.dt, args.falling * args.dt))
seconds_without = (process_time() - begun) / without

# %% [markdown]
# ## The fall
# Pictures show the root of the strain energy density W over E / 2, a strain.

# %%
contact = uem.GeneralContact(rigid=walls, friction=args.friction)
problem, dynamics, drag = discs([contact])
mass = dynamics.mass.total[1]


def outer_forces() -> np.ndarray:
    """Sum of the forces of contacts and of the medium, without the weight."""
    forces = contact.force.x.array.reshape(-1, 2)[: problem.config.n_owned].sum(axis=0)
    return np.sum(comm.allgather(forces), axis=0) - [uem.integrate(form) for form in drag]


strain, label = ufl.sqrt(2 * material.energy(problem.u) / args.E), "square root of 2 W / E"
steps = uem.time_steps(problem, args.dt, args.end)
if args.output:
    steps = uem.animate(
        f"{args.output}/granular.gif", problem, steps, every=max(1, round(0.16 / args.dt)), size=(4.8, 6.0),
        field=strain, label=label, cells=False,
    )  # fmt: skip
writer = uem.ResultsWriter(f"{args.output}/granular", problem) if args.output else None
rows, frames, unbalanced, seconds, iterations = [], [], 0.0, 0.0, 0
momentum, forces, begun = dynamics.momentum(), outer_forces(), process_time()
for step in steps:
    seconds, iterations = seconds + process_time() - begun, iterations + len(step.iterations)
    before, momentum = momentum, dynamics.momentum()
    earlier, forces = forces, outer_forces()
    given = step.dt * ((earlier + forces) / 2 + [0.0, -mass * g])
    unbalanced += float(np.abs(momentum - before - given).sum())
    carried = sum(part.resultant().force[1] for part in contact.parts[-len(walls) :])
    rows.append((step.time, carried / (mass * g), dynamics.kinetic_energy(), contact.n_active))
    if writer is not None and step.number % 10 == 0:
        writer.write(step)
    begun = process_time()
if writer is not None:
    writer.close()

# %% [markdown]
# ## The balance
# The imbalance is summed over all steps, relative to the impulse of the weight in this time.

# %%
time, carried, kinetic, active = np.array(rows).T
bodies = args.rows * args.columns
results = {
    "discs": bodies,
    "weight_error": float(abs(carried[-1] - 1)),
    "momentum_error": unbalanced / (mass * g * time[-1]),
    "seconds_per_step": seconds / len(rows),
    "seconds_per_step_without": seconds_without,
    "iterations_per_step": iterations / len(rows),
    "kinetic_energy": float(kinetic[-1] / (mass * g * R)),
    "contactors": int(active[-1]),
    "pairs": len(contact.touching()),
    "steps": len(rows),
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(4.4, 4.6)) as panels:
        uem.plot_scene(problem, panels[0], field=strain, label=label, cells=False, percentiles=(0, 98))
        if panels[1] is not None:
            panels[1].plot(time, carried, lw=0.8)
            panels[1].axhline(1.0, color="0.3", lw=1)
            panels[1].set(xlabel="time", ylabel="vertical force of floor and walls / weight")
            panels[1].grid(alpha=0.25)

# %%
assert results["momentum_error"] < 1e-10, results
if args.end >= 14:
    assert results["weight_error"] < 1e-6, results
