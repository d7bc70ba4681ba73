"""A double cantilever beam that delaminates, against beam theory: force and energy release rate while the crack grows.

mpirun -n 2 python3 demos/delamination.py --plot delamination.png

Options:
    size: length of the cells along the beam
    steps: load steps of the opening
"""

# %% [markdown]
# # Delamination of a double cantilever beam
#
# Two arms of height h are bonded beyond a crack of length a, and are pulled apart at their ends by d. The bond is a cohesive surface: it
# carries tractions up to a strength, softens, and takes the energy G per area until it is separated. Each arm bends as a cantilever of
# the length $l = a + \chi h$, where chi counts what rotates at the root and shears (Williams), for isotropic arms
#
# $$
# d = \frac{2 P l^3}{3 E' I}, \quad \mathcal{G} = \frac{12 P^2 l^2}{E' h^3}, \quad
# \chi^2 = \frac{2 (1 + \nu)}{11} \left(3 - 2 \left(\frac{\Gamma}{1 + \Gamma}\right)^2\right), \quad \Gamma = 2.36\, (1 + \nu).
# $$
#
# While the crack grows, the energy release rate is G, so that P falls with the root of the opening. Force and opening alone give l, and
# with it the rate that the beam feels: no length of a crack has to be read off.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, size=0.625, steps=15, degree=2, coupling=("node_to_surface", "mortar"))
length, h, crack = 100.0, 5.0, 40.0  # mm
E, nu, G, strength = 70e3, 0.3, 1.0, 20.0  # N/mm^2, N/mm
opening = 6.0
stiff, inertia = E / (1 - nu**2), h**3 / 12
gamma = 2.36 * (1 + nu)
chi = np.sqrt(2 * (1 + nu) / 11 * (3 - 2 * (gamma / (1 + gamma)) ** 2))

# %% [markdown]
# ## The scene
# The ends are held at their faces by vertical displacements. Only the bonded part of the upper arm is a contactor: cracked surfaces do
# not touch. Contactors that close are united with the lower arm, as in any contact.

# %%
sizes = {"size": args.size, "n": 2 if args.degree == 2 else 4}
mesh, tags = uem.read_gmsh(common.MESHES / "delamination.geo", comm, gdim=2, parameters=sizes)
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
bcs = [
    uem.dirichlet(V, tags["upper_left"], 1, value=opening / 2),
    uem.dirichlet(V, tags["lower_left"], 1, value=-opening / 2),
    uem.dirichlet(V, tags["lower_right"], 0),
]
bond = uem.Contact(
    tags["upper_bond"],
    tags["lower_bond"],
    cohesion=uem.Cohesive(strength, G),
    coupling=args.coupling,
    sliding="small",
    name="bond",
)
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[bond], petsc_options_prefix="delamination_")


# %% [markdown]
# ## The crack grows
# Bending first, then growth: `damage` is 1 where the bond is separated, and its integral is the new surface.


# %%
def by_theory(d: float) -> float:
    """Force of beam theory: of the arms as they are, or of those whose energy release rate is G."""
    bent = 3 * stiff * inertia * d / 2
    growing = np.sqrt(G * stiff * h**3 / 12)
    return min(bent / (crack + chi * h) ** 3, growing / np.sqrt(bent / growing))


rows = []
writer = uem.ResultsWriter(f"{args.output}/delamination", problem) if args.output else None
for step in uem.load_steps(problem, args.steps):
    d, P = opening * step.factor, problem.reaction(tags["upper_left"])[1]
    arm = (3 * stiff * inertia * d / (2 * P)) ** (1 / 3)
    a = crack + uem.integrate(bond.damage * uem.ds(tags["upper_bond"]))
    rate = 12 * P**2 * arm**2 / (stiff * h**3)
    row = {"opening": d, "force": P, "theory": by_theory(d), "rate": rate, "crack": a, "iterations": step.newton_iterations}
    rows.append(row)
    if writer:
        writer.write(step)
if writer:
    writer.close()

# %% [markdown]
# The rate is G once the cohesive zone, about an arm's height long, has formed.

# %%
grown = [row for row in rows if row["crack"] > crack + 2 * h]
results = {
    "rows": rows,
    "toughness_error": max(abs(row["rate"] / G - 1) for row in grown),
    "force_error": max(abs(row["force"] / row["theory"] - 1) for row in grown),
    "iterations": max(row["iterations"] for row in rows),
}
common.report(args, results)

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        fine = np.linspace(0.0, opening, 200)[1:]
        panel.plot(fine, [by_theory(d) for d in fine], "k-", lw=1, label="beam theory")
        panel.plot([row["opening"] for row in rows], [row["force"] for row in rows], "o", label="cohesive bond")
        panel.set(xlabel="opening / mm", ylabel="force per width / N/mm")
        panel.legend(frameon=False)

# %%
assert results["toughness_error"] < 0.02 and results["force_error"] < 0.02, results
