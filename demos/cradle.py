"""Five equal bars in a row: the first arrives with a velocity, the last leaves with it, the others rest.

python3 demos/cradle.py --plot cradle.png

Options:
    bars: number of bars
    n: cells along each bar
    gap: gap between neighbouring bars
    v: initial velocity of the first bar
"""

# %% [markdown]
# # A cradle of bars
#
# Equal elastic bars lie in a row with small gaps between them, as the balls of Newton's cradle, but each long enough for waves: nu = 0,
# so that one dimension describes them. The first flies with v against the second, at time t_1 = gap / v. Between the two the pressure is
# rho c v / 2, for as long as waves take to the free ends and back, 2 L / c, and the force hands on all of the momentum. The far end of
# the second bar moves with v from t_1 + L / c on and reaches the third one after another gap / v, and so on:
#
# $$
# \text{contact } k \text{ lasts from } t_k = \frac{k\, g}{v} + \frac{(k - 1) L}{c} \text{ to } t_k + \frac{2 L}{c},
# \qquad r_k(t) = \frac{(t - t_k)\, c}{2 L} \text{ within 0 and 1}
# $$
#
# is the part of the momentum that it has handed on. Bar k has the mean velocity v (r_(k-1) - r_k), with r_0 = 1 for the first
# and r_N = 0 for the last. In the end the last bar has v, and the others rest without vibration.
#
# All contacts are one declaration, `GeneralContact`, of the ends of the bars.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, bars=5, n=50, cfl=0.66, gap=0.02, v=0.1)
E, rho, L, width = 1.0, 1.0, 1.0, 0.1
c = np.sqrt(E / rho)

# %% [markdown]
# ## The scene
# The bars are named, so that the contact can give the force between two of them.

# %%
parameters = {"bars": args.bars, "L": L, "width": width, "gap": args.gap, "n": args.n}
mesh, tags = uem.read_gmsh(common.MESHES / "cradle.geo", comm, gdim=2, parameters=parameters)
V = uem.function_space(mesh, 1, (2,))
u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
mesh.topology.create_connectivity(2, 2)
velocity.x.array[fem.locate_dofs_topological(V.sub(0), 2, tags["bar_1"].entities)] = args.v
names = [f"bar_{k + 1}" for k in range(args.bars)]
material = uem.LinearElastic(E, 0.0, kind="plane_stress")
dynamics = uem.Dynamics(uem.consistent_mass(V, rho), velocity=velocity)
contact = uem.GeneralContact(tags["ends"], bodies={name: tags[name] for name in names})
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx,
    u,
    contacts=[contact],
    dynamics=dynamics,
    petsc_options_prefix="cradle_",
    verbose=args.verbose,
)

# %% [markdown]
# ## The run
# A bar's velocity is the mean over its volume. At `--cfl` 2/3 the errors of linear cells and of the trapezoidal rule cancel nearly, so
# that fronts stay steep.

# %%
start = np.array([k * args.gap / args.v + (k - 1) * L / c for k in range(1, args.bars)])
means = [fem.form(dynamics.velocity[0] / (args.v * L * width) * uem.dx(tags[name])) for name in names]
middle = names[(args.bars - 1) // 2], names[(args.bars - 1) // 2 + 1]
writer = uem.ResultsWriter(f"{args.output}/cradle", problem) if args.output else None
times, velocities, forces = [], [], []
for step in uem.time_steps(problem, args.cfl * L / args.n / c, start[-1] + 2.5 * L / c, event_tolerance=1e-3):
    times.append(step.time)
    velocities.append([uem.integrate(form) for form in means])
    if args.plot:
        forces.append(contact.between(*reversed(middle)).force[0] / width)
    if writer is not None and step.number % 10 == 0:
        writer.write(step)
if writer is not None:
    writer.close()

# %% [markdown]
# ## Before and after
# Velocities are relative to v, `history_error` is the largest deviation of all bars at all times, the next two are those of the last step.

# %%
t, found = np.array(times), np.array(velocities)
handed_on = np.clip((t[:, None] - start) * c / (2 * L), 0.0, 1.0)
exact = -np.diff(handed_on, axis=1, prepend=1.0, append=0.0)
results = {
    "velocities": found[-1].tolist(),
    "momentum_error": float(np.abs(found.sum(axis=1) - 1).max()),
    "history_error": float(np.abs(found - exact).max()),
    "rest_error": float(np.abs(found[-1, :-1]).max()),
    "last_velocity_error": float(abs(found[-1, -1] - 1)),
    "steps": len(t),
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as panels:
        if panels[0] is not None:
            for k, name in enumerate(names):
                panels[0].plot(t, found[:, k], color=f"C{k}", label=name.replace("_", " "))
                panels[0].plot(t, exact[:, k], color="0.2", lw=0.7, ls="--", label="exact" if k == args.bars - 1 else None)
            panels[0].set(xlabel="time", ylabel="mean velocity / v")
            panels[0].legend(frameon=False)
            k = (args.bars - 1) // 2
            panels[1].plot(t, forces, lw=0.8, label=f"bars {k + 1} and {k + 2}")
            pressed = rho * c * args.v / 2
            panels[1].step(
                [0.0, start[k], start[k] + 2 * L / c, t[-1]],
                [0.0, pressed, 0.0, 0.0],
                "0.2",
                where="post",
                lw=0.7,
                ls="--",
                label="exact",
            )
            panels[1].set(xlabel="time", ylabel="contact pressure")
            panels[1].legend(frameon=False)
            for ax in panels:
                ax.grid(alpha=0.25)

# %%
assert results["momentum_error"] < 1e-12, results
if args.n >= 50 and args.bars <= 5:
    assert results["last_velocity_error"] < 1e-3 and results["rest_error"] < 1e-3, results
