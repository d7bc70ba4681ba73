"""A fibre pulled out of a matrix: its bond separates, the separated part rubs, against the theory of debonding with friction.

mpirun -n 2 python3 demos/fibre.py --plot fibre.png

Options:
    size: length of the cells along the fibre
    mu: coefficient of friction on the separated part
    pressure: on the matrix, and so on the fibre
"""

# %% [markdown]
# # Pull-out of a fibre
#
# A fibre of radius r is bonded over the length L to a matrix of radius R, whose face is held. Its end is pulled out by a displacement d.
# The bond takes the energy G per area. Where it has separated, the pressure p of the matrix makes friction, a force
# $q = 2 \pi r \mu p$ per length.
#
# Let the separated part have the length a. Behind the crack the fibre carries the force $F_0$ and the matrix $-F_0$; ahead of it neither
# is loaded. The stretch of both by one unit of force is c, with their sections $A_f$ and $A_m$. When the crack grows, elastic energy
# that is released is the energy of the new surfaces [Hutchinson, Jensen, Mechanics of Materials 9 (1990) 139-163],
#
# $$
# \frac{c\, F_0^2}{2} = 2 \pi r G, \qquad c = \frac{1}{E A_f} + \frac{1}{E A_m},
# $$
#
# and friction adds up to the force at the end, and stretch to its displacement,
#
# $$
# F = F_0 + q\, a, \qquad d = c \left(F_0\, a + \frac{q\, a^2}{2}\right).
# $$
#
# After the bond has separated as a whole, friction is left: $F = q L$, as long as the fibre has moved little against its length.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, size=0.05, mu=0.3, pressure=20.0, steps=60, degree=1, coupling=("node_to_surface", "mortar"))
r, R, L = 0.1, 0.3, 4.0  # mm
E, G, strength, delay = 70e3, 0.02, 50.0, 1e-4  # N/mm^2, N/mm, N/mm^2, part of the load factor
c = (1 / r**2 + 1 / (R**2 - r**2)) / (np.pi * E)
q, F_0 = 2 * np.pi * r * args.mu * args.pressure, np.sqrt(4 * np.pi * r * G / c)
largest = c * (F_0 * L + q * L**2 / 2)


def by_theory(d):
    """Force at a displacement, while the crack grows."""
    return F_0 + q * (np.sqrt(F_0**2 + 2 * q * d / c) - F_0) / q


# %% [markdown]
# ## The scene
# Both materials have the same modulus and no lateral strain, so that the pressure on the fibre is that on the matrix. It acts at first,
# and then the end of the fibre is moved. The bond has one energy and one strength; closed by the pressure, it separates by shear.
# Friction acts on bonds that were separated when a step began, and a small viscosity delays damage, so that the bodies find a way down
# where the last part of the bond separates at once.

# %%
sizes = {"r": r, "R": R, "L": L, "size": args.size}
mesh, tags = uem.read_gmsh(common.MESHES / "fibre.geo", comm, gdim=2, parameters=sizes)
uem.axisymmetric(mesh)
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
press, pulled = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
F = uem.LinearElastic(E, 0.0, kind="axisymmetric").residual(u, v) * ufl.dx + press * v[0] * uem.ds(tags["outside"])
law = uem.Cohesive(strength, G, viscosity=delay)
how = {"coupling": args.coupling, "sliding": "small", "name": "bond"}
bond = uem.Contact(tags["fibre_face"], tags["hole"], cohesion=law, friction=args.mu, **how)
bcs = [
    uem.dirichlet(V, tags["axis"], 0),
    uem.dirichlet(V, tags["matrix_top"], 1),
    uem.dirichlet(V, tags["fibre_end"], 1, value=pulled),
]
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[bond], petsc_options_prefix="fibre_", verbose=args.verbose)


def clamp(s: float) -> None:
    """The pressure."""
    press.value = args.pressure * s


def pull(s: float) -> None:
    """The displacement of the end."""
    pulled.value = 1.2 * largest * s


# %% [markdown]
# ## Pulling out

# %%
rows = []
stages = [uem.Step("press", 1, loads=clamp), uem.Step("pull", args.steps, loads=pull)]
writer = uem.ResultsWriter(f"{args.output}/fibre", problem) if args.output else None
for step in uem.load_steps(problem, stages):
    force, d = float(problem.reaction(tags["fibre_end"])[1]), float(pulled.value)
    crack = uem.integrate(bond.damage * uem.ds(tags["fibre_face"])) / (2 * np.pi * r)
    rows.append({"displacement": d, "force": force, "crack": crack, "theory": by_theory(d) if crack < 0.99 * L else q * L})
    rows[-1] |= {"iterations": step.newton_iterations}
    if writer:
        writer.write(step)
if writer:
    writer.close()
growing = [row for row in rows if 0.2 * L < row["crack"] < 0.8 * L]
results = {
    "rows": rows,
    "force_error": max(abs(row["force"] / row["theory"] - 1) for row in growing),
    "friction_error": abs(rows[-1]["force"] / (q * L) - 1),
    "iterations": max(row["iterations"] for row in rows),
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The force grows with the rubbing length. It falls when the crack reaches the end of the fibre, and friction remains.

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        way = np.linspace(0.0, largest, 200)
        panel.plot(np.append(0.0, way) * 1e3, np.append(0.0, by_theory(way)), "k-", lw=1, label="theory")
        panel.plot([1e3 * largest, 1.2e3 * largest], [q * L, q * L], "k-", lw=1)
        panel.plot([1e3 * row["displacement"] for row in rows], [row["force"] for row in rows], "o", ms=4, label="computed")
        panel.set(xlabel="displacement of the end / µm", ylabel="force / N")
        panel.legend(frameon=False)

# %%
assert results["force_error"] < 0.05 and results["friction_error"] < 0.01, results
