"""A ball bounces on a rigid plane, by explicit steps: duration and force of the impact against Hertz.

python3 demos/hertz_impact.py --plot hertz_impact.png

Options:
    radius: largest radius of the contact by Hertz, over that of the ball
    cells: cells across that radius
    safety: length of a step over the critical one
"""

# %% [markdown]
# # A ball bounces
#
# While waves cross the ball much faster than it bounces, the contact is that of two bodies at rest. By Hertz
# the force is k d^1.5 for an approach d, with k = 4/3 E* sqrt(R). So the ball touches for the time 2.9432 d / v, with
# d^2.5 = 15 m v^2 / (16 E* sqrt(R)) at the turn.
#
# The half section is axisymmetric. Central differences move the nodes with mass; the surface around the lowest point has none and
# is in equilibrium under exact contact conditions, so that no stiffness of penalty is to be chosen, and none limits the steps.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, radius=0.03, cells=8, nu=0.3, safety=0.9)
E, rho, R = 1.0, 1.0, 1.0
stiffness, gap = E / (1 - args.nu**2), 0.02 * args.radius**2 * R
v0 = np.sqrt(16 * stiffness * np.sqrt(R) * (args.radius**2 * R) ** 2.5 / (15 * rho * 4 / 3 * np.pi * R**3))

# %% [markdown]
# ## The ball
# Its mass is that of the mesh, a little less than that of the round ball.

# %%
sizes = {"R": R, "gap": gap, "zone": 1.4 * args.radius * R, "h": args.radius * R / args.cells}
mesh, tags = uem.read_gmsh(common.MESHES / "ball.geo", comm, gdim=2, parameters=sizes)
uem.axisymmetric(mesh)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, args.nu, kind="axisymmetric")
dynamics = uem.Dynamics(uem.lumped_mass(V, rho), velocity=(0.0, -v0), scheme=uem.CentralDifferences(safety=args.safety))
plane = uem.Contact(tags["face"], uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), name="plane")
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx, u, bcs=[uem.dirichlet(V, tags["axis"], 0)], contacts=[plane], dynamics=dynamics,
    petsc_options_prefix="ball_",
)  # fmt: skip

mass = float(dynamics.mass.total[1])
approach = (15 * mass * v0**2 / (16 * stiffness * np.sqrt(R))) ** 0.4
lasts, largest = 2.9432 * approach / v0, 4 / 3 * stiffness * np.sqrt(R) * approach**1.5

# %% [markdown]
# ## The bounce

# %%
book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/energy.csv" if args.output else None)
rows = []
for step in uem.time_steps(problem, end=gap / v0 + 1.15 * lasts):
    if step.number % 10 == 0:
        row = book.write(step)
    rows.append((step.time, plane.resultant().force[1], plane.n_active))
    if rows[-1][1] >= max(row[1] for row in rows):
        flattest = u.x.array.copy()
book.close()

# %% [markdown]
# ## Against Hertz

# %%
t, force, active = np.array(rows).T
touching = t[active > 0]
energies = np.array([row.kinetic + row.stored for row in book.rows])
results = {
    "duration": float((touching[-1] - touching[0]) / lasts),
    "force": float(force.max() / largest),
    "duration_error": float(abs((touching[-1] - touching[0]) / lasts - 1)),
    "force_error": float(abs(force.max() / largest - 1)),
    "restitution": float(dynamics.momentum()[-1] / (mass * v0)),
    "energy_error": float(np.abs(energies / energies[0] - 1).max()),
    "steps": len(rows),
    "unknowns": 2 * V.dofmap.index_map.size_global,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as (left, right):
        u.x.array[:] = flattest
        a = np.sqrt(approach * R)
        uem.plot_scene(
            problem, left, field=material.stress(u)[1, 1] / (1.5 * largest / (np.pi * a**2)), mirror=True,
            label="vertical stress at the turn / $p_0$", window=(-4 * a, 4 * a, -a, 6 * a),
        )  # fmt: skip
        if right is not None:
            d, w, path = 0.0, v0, [(0.0, 0.0)]
            for k in range(1, 4001):
                w -= lasts / 4000 * 4 / 3 * stiffness * np.sqrt(R) * max(d, 0.0) ** 1.5 / mass
                d += lasts / 4000 * w
                path.append((k / 4000, 4 / 3 * stiffness * np.sqrt(R) * max(d, 0.0) ** 1.5 / largest))
            right.plot(*np.transpose(path), color="0.3", lw=2.5, alpha=0.4, label="Hertz")
            right.plot((t - gap / v0) / lasts, force / largest, lw=1, label="ball")
            right.set(xlabel="time over Hertz's duration", ylabel="force over Hertz's largest")
            right.legend(frameon=False)
            right.grid(alpha=0.25)

# %%
if args.cells >= 8 and args.radius <= 0.03:
    assert results["duration_error"] < 2e-2 and results["force_error"] < 2e-2 and results["energy_error"] < 1e-2, results
