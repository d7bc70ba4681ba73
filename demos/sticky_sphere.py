"""A sphere that sticks to an elastic half-space: the force that pulls it off, and the contact on the way, against JKR theory.

mpirun -n 2 python3 demos/sticky_sphere.py --plot sticky_sphere.png

Options:
    strength: largest attraction over (16 pi w E*^2 / (9 R))^(1/3); JKR theory is the limit of large ones
    steps: load steps in which the sphere is pulled off
"""

# %% [markdown]
# # A sphere that sticks
#
# A rigid sphere of radius R touches an elastic half-space of the plane-strain modulus $E^* = E / (1 - \nu^2)$. Surfaces attract each
# other, and it takes the energy w per area to separate them. Johnson, Kendall and Roberts (1971) find for the contact radius a
#
# $$
# F = \frac{4 E^* a^3}{3 R} - \sqrt{8 \pi w E^* a^3}.
# $$
#
# Without a load the contact radius is $a_0$ with $a_0^3 = 9 \pi w R^2 / (2 E^*)$, and the smallest force is
# $-\tfrac{3}{2} \pi w R$, whatever the modulus.
#
# The attraction acts within a short zone around the contact, which cells must resolve. It falls linearly with the gap, and JKR theory
# is the limit in which its range vanishes.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, h=1.5e-3, steps=36, strength=1.5, degree=1, coupling=("mortar", "node_to_surface"))
E, nu, R, a_0 = 1.0, 0.3, 1.0, 0.1
stiff = E / (1 - nu**2)
w = 2 * stiff * a_0**3 / (9 * np.pi * R**2)
strength = args.strength * (16 * np.pi * w * stiff**2 / (9 * R)) ** (1 / 3)
pull_off = 1.5 * np.pi * w * R

# %% [markdown]
# ## The scene
#
# The sphere stays where it is, pressed into the block's top at first; the block's bottom moves down. Near the contact the sphere is a
# paraboloid, as in the theory. The block is as high and wide as R, ten times the contact radius.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "sticky_sphere.geo", comm, gdim=2, parameters={"h": args.h})
uem.axisymmetric(mesh)
V = uem.function_space(mesh, args.degree, (2,))
u, v, base = fem.Function(V, name="u"), ufl.TestFunction(V), fem.Function(V)
depth, way = 0.007, 0.0086


def radius(force):
    """Contact radius by JKR theory, on the branch that is stable at a given force."""
    half = 3 * np.pi * w * R
    return (0.75 * R / stiff * (force + half + np.sqrt(np.maximum(2 * half * force + half**2, 0.0)))) ** (1 / 3)


def move(factor: float) -> None:
    """A tenth of the load factor is contact alone, the rest the way of the bottom."""
    base.x.array[1::2] = -way * max(factor - 0.1, 0.0) / 0.9


sphere = uem.RigidParaboloid((0, -depth), (0, 1), R)
law = uem.Adhesion(w, strength)
contact = uem.Contact(tags["top"], sphere, cohesion=law, coupling=args.coupling, name="sphere")
bcs = [uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["bottom"], value=base)]
F = uem.LinearElastic(E, nu, kind="axisymmetric").residual(u, v) * ufl.dx
how = {"bcs": bcs, "contacts": [contact], "load": move, "max_iterations": 100, "petsc_options_prefix": "sticky_sphere_"}
problem = uem.UnitedProblem(F, u, **how)

# %% [markdown]
# ## Pulling off
# The block's reaction is the force on the sphere. The contact radius is the radius of a circle with the area in contact.

# %%
rows = []
writer = uem.ResultsWriter(f"{args.output}/sticky_sphere", problem) if args.output else None
for step in uem.load_steps(problem, 10 * args.steps // 9):
    force, opposite = float(problem.reaction(tags["bottom"])[1]), float(contact.resultant().force[1])
    area = uem.integrate(contact.active * uem.ds(tags["top"]))
    found = {"radius": float(np.sqrt(area / np.pi)), "radius_jkr": float(radius(force))}
    row = {"way": way * max(step.factor - 0.1, 0.0) / 0.9, "force": force, "balance": abs(force + opposite)}
    rows.append(row | found | {"iterations": step.newton_iterations})
    if writer:
        writer.write(step)
if writer:
    writer.close()
least = min(row["force"] for row in rows)
results = {
    "rows": rows,
    "pull_off": -least,
    "pull_off_jkr": pull_off,
    "pull_off_error": abs(-least / pull_off - 1),
    "radius_error": max(abs(row["radius"] - row["radius_jkr"]) for row in rows if row["force"] > -0.9 * pull_off) / a_0,
    "balance": max(row["balance"] for row in rows) / pull_off,
    "iterations": max(row["iterations"] for row in rows),
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Theory ends at the smallest force, where a weight would pull the sphere off. The closed circle, without the zone of attraction
# around it, is smaller than the circle of the theory by some per cent.

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        forces = np.linspace(-pull_off, 2 * pull_off, 400)
        panel.plot(radius(forces) / a_0, forces / pull_off, "k-", lw=1, label="JKR theory")
        panel.plot([row["radius"] / a_0 for row in rows], [row["force"] / pull_off for row in rows], "o", ms=4, label="computed")
        panel.axhline(-1.0, color="0.6", lw=0.8, ls="--")
        panel.set(xlabel="contact radius / radius without load", ylabel="force / pull-off force of JKR")
        panel.legend(frameon=False)

# %%
assert results["pull_off_error"] < (0.045 / args.strength if args.coupling == "mortar" else 0.05), results
assert results["radius_error"] < 0.08, results
assert results["balance"] < 1e-6, results
