"""A shallow arch snaps through under dead load, followed by arc length past both limit points and down onto a floor.

python3 demos/arch.py --plot arch.png

Options:
    n: cells along half of the arch
    steps: the first step applies 1/steps of the load, and its displacement sets the arc length of all others
    depth: distance of the floor below the clamps
"""

# %% [markdown]
# # Snap-through under dead load
#
# A shallow clamped arch with the middle line w = e/2 (1 + cos kx), k = 2 pi / L, carries the dead load q cos kx. Shallow arches
# under it keep their shape, w = a/2 (1 + cos kx), and
#
# $$
# q = E A k^4 \left( \frac{(e - a)\, t^2}{24} + \frac{a\,(e^2 - a^2)}{32} \right).
# $$
#
# Beyond the limit point the load must decrease to follow the equilibrium path; before it increases again, the arch meets a floor. With
# `arc_length=True` only the first step has a prescribed load. All others have the same displacement length, and the load is found.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=40, steps=20, depth=1.5)
L, e, t, E = 200.0, 2.0, 1.0, 1000.0
k = 2 * np.pi / L


def shallow(a):
    """Load of a shallow arch whose middle is at a."""
    return E * t * k**4 * ((e - a) * t**2 / 24 + a * (e**2 - a**2) / 32)


# the extrema of the cubic
a_limit = np.sqrt((e**2 / 32 - t**2 / 24) * 32 / 3)
full = 3 * shallow(a_limit)

# %% [markdown]
# ## The scene
# One half, by symmetry, of quadratic cells. The floor lies at `depth` under the plane of the clamps.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "arch.geo", comm, gdim=2, parameters={"L": L, "e": e, "t": t, "n": args.n})
V = uem.function_space(mesh, 2, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material, q = uem.StVenantKirchhoff(E, 0.0, kind="plane_stress"), fem.Constant(mesh, 0.0)
F = material.residual(u, v) * ufl.dx + q / t * ufl.cos(k * ufl.SpatialCoordinate(mesh)[0]) * v[1] * ufl.dx
bcs = [uem.dirichlet(V, tags["clamped"]), uem.dirichlet(V, tags["middle"], 0)]
floor = uem.Contact(tags["below"], uem.RigidPlane((0.0, -args.depth - t / 2), (0.0, 1.0)), name="floor")
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[floor], load={q: full}, verbose=args.verbose)

# %% [markdown]
# ## The path
# The matrix is indefinite between the limit points, where no dead load would leave the arch; symmetric factorisation does not mind.

# %%
middle = uem.ds(tags["middle"])
rows, steps = [], []
for step in uem.load_steps(problem, args.steps, arc_length=True):
    a = e + uem.integrate(u[1] * middle) / t
    rows.append({"a": a, "q": float(q.value), "touching": floor.n_active, "floor": float(floor.resultant().force[1])})
    steps.append(step)

a, load, touching = (np.array([row[key] for row in rows]) for key in ("a", "q", "touching"))
free = touching == 0
peak = int(load[free].argmax())
valley = peak + int(load[free][peak:].argmin())


def extremum(i: int) -> float:
    """Of the parabola through three stations about it."""
    c = np.polyfit(a[i - 1 : i + 2] - a[i], load[i - 1 : i + 2], 2)
    return float(c[2] - c[1] ** 2 / (4 * c[0]))


results = {
    "limit_load": extremum(peak),
    "limit_error": abs(extremum(peak) / shallow(a_limit) - 1),
    "lower_limit_error": abs(extremum(valley) / shallow(-a_limit) - 1) if valley + 1 < free.sum() else None,
    "path_error": float(np.abs(load - shallow(a))[free].max() / shallow(a_limit)),
    "load_at_floor": float(load[~free][0]),
    "final_load": float(load[-1] / full),
    "steps": len(steps),
    "cuts": sum(step.cuts for step in steps),
    "newton_iterations": sum(step.newton_iterations for step in steps),
    "exchanges": sum(step.exchanges for step in steps),
}
common.report(args, results)

# %%
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.6)) as (left, right):
    uem.plot_scene(problem, left, mirror=True, arrows=True)
    if right:
        left.set_aspect("auto")
        s = np.linspace(-e, e, 201)
        right.plot(e - s, shallow(s), "0.6", label="shallow arch, closed form")
        right.plot(e - a, load, ".-", ms=4, label="by arc length")
        right.plot(e - a[~free], load[~free], "r.", ms=5, label="on the floor")
        right.set(xlabel="deflection of the middle", ylabel="dead load q", ylim=(0.0, 1.05 * full))
        right.grid(alpha=0.25)
        right.legend(frameon=False)

# %%
assert results["limit_error"] < 0.01 and results["path_error"] < 0.01, results
assert results["final_load"] == 1.0 and touching[-1] > 0
