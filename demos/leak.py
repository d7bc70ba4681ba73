"""A seal between two flanges: the pressure of a fluid at which it opens, how far it opens, and how it closes again.

mpirun -n 2 python3 demos/leak.py --plot leak.png

Options:
    n: cells along the lower flange, half as many again in the upper one
    steps: load steps in which the pressure rises and falls again
"""

# %% [markdown]
# # A seal that leaks
#
# Two flanges of width and height 1 are pressed together by bolts, which act like a bed of springs of stiffness k per area with the
# preload q. A fluid of pressure p acts on both sides of the joint. It enters where the joint is open and connected with a side.
#
# With the heights h of the flanges the contact pressure is $q / (1 + 2 h k / E)$ as long as the joint is closed. A fluid of a lower
# pressure reaches the outermost contactors only. At a higher pressure it runs through the joint and lifts the upper flange, until
# bolts balance it:
#
# $$
# p > \frac{q}{1 + 2 h k / E}: \qquad \text{opening} = \frac{p - q}{k} + \frac{2 h p}{E}.
# $$
#
# The contact stays hard: no stiffness is chosen. Where the fluid touches closed contactors, these carry the rest. The coupling is mortar,
# since it is the pressure between the flanges that decides.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=8, steps=16, degree=1, coupling=("mortar", "node_to_surface"))
E, h, k, q, p_max = 1e3, 1.0, 5.0, 1.0, 1.6
limit = q / (1 + 2 * h * k / E)

# %% [markdown]
# ## The scene
# The pressure is a function of the load factor. The fluid comes from the sides, whose nodes at the joint it always reaches.


# %%
def pressure(factor: float) -> float:
    """Up to p_max, and down to 0."""
    return p_max * (1.0 - abs(2.0 * factor - 1.0))


sizes = {"n_lower": args.n, "n_upper": 3 * args.n // 2}
mesh, tags = uem.read_gmsh(common.MESHES / "two_blocks.geo", comm, gdim=2, parameters=sizes)
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
top, joint = uem.ds(tags["upper_top"]), tags["upper_bottom"]
F = E * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) * ufl.dx + (q + k * u[1]) * v[1] * top
bcs = [uem.dirichlet(V, tags["sides"], 0), uem.dirichlet(V, tags["lower_bottom"], 1)]
fluid = uem.Leak(pressure, inlet=tags["sides"])
contact = uem.Contact(joint, tags["lower_top"], leak=fluid, coupling=args.coupling, name="joint")
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="leak_")

# %% [markdown]
# ## Up and down
# The joint is 1 long, so that integrals are means.

# %%
rows = []
writer = uem.ResultsWriter(f"{args.output}/leak", problem) if args.output else None
for step in uem.load_steps(problem, args.steps):
    p = pressure(step.factor)
    opening = uem.integrate(u[1] * uem.ds(joint)) - uem.integrate(u[1] * uem.ds(tags["lower_top"]))
    exact = (p - q) / k + 2 * h * p / E if p > limit else 0.0
    wet = uem.integrate(contact.wet * uem.ds(joint))
    rows.append({"pressure": p, "wet": wet, "opening": opening, "exact": exact, "iterations": step.newton_iterations})
    if writer:
        writer.write(step)
if writer:
    writer.close()
is_open = [row["pressure"] > limit for row in rows]
largest = max(row["exact"] for row in rows)
results = {
    "rows": rows,
    "leak_pressure": limit,
    "opening_error": max(abs(row["opening"] - row["exact"]) for row, on in zip(rows, is_open) if on) / largest,
    "closed_error": max(abs(row["opening"]) for row, on in zip(rows, is_open) if not on) / largest,
    "wet_if_closed": max(row["wet"] for row, on in zip(rows, is_open) if not on),
    "iterations": max(row["iterations"] for row in rows),
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The way back is the way there.

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        fine = np.linspace(0.0, p_max, 300)
        panel.plot(fine, np.where(fine > limit, (fine - q) / k + 2 * h * fine / E, 0.0), "k-", lw=1, label="closed form")
        half = len(rows) // 2
        for mark, name, part in (("o", "rising", rows[:half]), ("x", "falling", rows[half:])):
            panel.plot([row["pressure"] for row in part], [row["opening"] for row in part], mark, label=name)
        panel.set(xlabel="pressure of the fluid / preload", ylabel="opening of the joint / its length")
        panel.legend(frameon=False)

# %%
# between meshes that do not match, nodes transmit pressures to some per cent, and just above the limit some contactors stay closed
within = 1e-6 if args.coupling == "mortar" else 0.03
assert results["opening_error"] < within and results["closed_error"] < 1e-4 and results["wet_if_closed"] < 2.0 / args.n, results
