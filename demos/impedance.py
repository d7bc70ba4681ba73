"""A bar hits a longer-ringing one of twice its impedance, by explicit steps: force, rebound and momentum against characteristics.

python3 demos/impedance.py --plot impedance.png

Options:
    n: cells along each bar
    n_width: cells across the lower bar; the upper one has one more
    impedance: rho c of the lower bar over that of the upper bar, at least 1
    v: speed of the upper bar, downwards
    safety: length of a step over the critical one
"""

# %% [markdown]
# # Bars of different impedance
#
# A bar flies against one at rest whose impedance Z = rho c is larger. The contact feels v Z1 Z2 / (Z1 + Z2) until the wave has come
# back from the free end of the flying bar, for the time 2 L / c. Then this bar leaves as a whole, without vibration, at
# v (Z1 - Z2) / (Z1 + Z2), and a wave of the same length runs to and fro in the other bar.
#
# Central differences move the nodes with mass. The nodes on both surfaces have none: they are in equilibrium under exact contact
# conditions in every step, as in statics. So there is no penalty that could determine the force, or shorten the steps.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, dim=2, n=100, n_width=2, impedance=2.0, v=1.0, safety=0.9, coupling=("node_to_surface", "mortar")
)
E, rho, L, gap, width, d = 900.0, 1.0, 10.0, 0.1, 1.0, args.dim
c, area = np.sqrt(E / rho), width ** (args.dim - 1)

# %% [markdown]
# ## The scene
# The lower bar has the same stiffness and more mass, so that its waves are slower.

# %%
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
V, x = uem.function_space(mesh, 1, (d,)), ufl.SpatialCoordinate(mesh)
u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
mesh.topology.create_connectivity(d, d)
velocity.x.array[fem.locate_dofs_topological(V.sub(1), d, tags["upper"].entities)] = -args.v
density = ufl.conditional(ufl.lt(x[1], L + 1.5 * gap), rho * args.impedance**2, rho)
material = uem.LinearElastic(E, 0.0, kind="plane_stress" if d == 2 else "3d")
dynamics = uem.Dynamics(uem.lumped_mass(V, density), velocity=velocity, scheme=uem.CentralDifferences(safety=args.safety))
contact = uem.Contact(contactor=tags["upper_bottom"], target=tags["lower_top"], coupling=args.coupling)
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics, petsc_options_prefix="impedance_", rtol=1e-12
)

# %% [markdown]
# ## The impact
# `time_steps` without `dt` chooses steps by the critical one.

# %%
meet, lasts = gap / args.v, 2 * L / c
force = args.v * rho * c * args.impedance / (1 + args.impedance) * area
means = [fem.form(dynamics.velocity[1] / (L * area) * uem.dx(tags[name])) for name in ("lower", "upper")]
book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/energy.csv" if args.output else None)
writer = uem.ResultsWriter(f"{args.output}/impedance", problem) if args.output else None
rows = []
for step in uem.time_steps(problem, end=meet + 1.5 * lasts):
    book.write(step)
    rows.append((step.time, contact.resultant().force[1], *(uem.integrate(form) for form in means)))
    if writer is not None and step.number % 10 == 0:
        writer.write(step)
book.close()
if writer is not None:
    writer.close()

# %% [markdown]
# ## Against the characteristics
# The plateau is the middle 80 % of the contact. Velocities are means over the bars, after the contact.

# %%
t, pressed, lower, upper = np.array(rows).T
plateau = pressed[(t > meet + 0.1 * lasts) & (t < meet + 0.9 * lasts)].mean() / force
leaves = args.v * (args.impedance - 1) / (args.impedance + 1)
carries = -force * lasts / (rho * args.impedance**2 * L * area)
energies = [row.kinetic + row.stored for row in book.rows]
momenta = np.array(book.momenta)[:, 1]
results = {
    "force": float(plateau),
    "impulse": float(book.impulses[-1][0][1] / (force * lasts)),
    "upper_velocity": float(upper[-1]),
    "lower_velocity": float(lower[-1]),
    "wave_error": float(max(abs(plateau - 1), abs(upper[-1] - leaves) / args.v, abs(lower[-1] - carries) / args.v)),
    "energy_error": float(np.abs(np.array(energies) / energies[0] - 1).max()),
    "momentum_error": float(np.abs(momenta / momenta[0] - 1).max()),
    "steps": len(rows),
    "dt_over_cell": float(step.dt * c * args.n / L),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as panels:
        if panels[0] is not None:
            exact = [0.0, meet, meet, meet + lasts, meet + lasts, t[-1]], [0.0, 0.0, force, force, 0.0, 0.0]
            panels[0].plot(*exact, color="0.3", lw=2.5, alpha=0.4, label="characteristics")
            panels[0].plot(t, pressed, label="contact force")
            ends = [0.0, meet, meet + lasts, t[-1]]
            for v, label, after in ((lower, "lower bar", carries), (upper, "upper bar", leaves)):
                start = -args.v if v is upper else 0.0
                panels[1].plot(ends, [start, start, after, after], color="0.3", lw=2.5, alpha=0.4)
                panels[1].plot(t, v, label=label)
            for ax, what in zip(panels, ("force", "mean velocity")):
                ax.set(xlabel="time", ylabel=what)
                ax.legend(frameon=False)
                ax.grid(alpha=0.25)

# %%
assert results["momentum_error"] < 1e-12, results
if args.n >= 100:
    assert results["wave_error"] < 1e-2 and results["energy_error"] < 5e-3, results
