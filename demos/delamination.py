"""Beams that delaminate, in opening, shear and both, against beam theory: force and energy release rate while the crack grows.

mpirun -n 2 python3 demos/delamination.py --plot delamination.png

Options:
    specimen: dcb: double cantilever beam; enf: end-notched flexure; mmb: mixed-mode bending
    share: of shear in the energy release rate of mmb, for which the lever is made
    mixed: mixed mode of enf and mmb: bk (Benzeggagh, Kenane) or power
    size: length of the cells along the beam
    steps: load steps
"""

# %% [markdown]
# # Delamination of beams
#
# Two arms of height h are bonded beyond a crack of length a. The bond is a cohesive surface: it carries tractions up to a strength,
# softens, and takes the energy G per area until it is separated, G1 in opening and G2 in shear. Three specimens are tested so:
#
# - The ends of the double cantilever beam (DCB) are pulled apart.
# - End-notched flexure (ENF) is a beam on two supports, 2 L apart, with a load in the middle: the crack is sheared.
# - In mixed-mode bending (MMB) a rigid lever presses on the middle of this beam and pulls at the end of its upper arm. It is loaded
#   at a distance c beyond the middle, and c determines the share of shear.
#
# Of the load P a part $P_1$ opens the crack and a part $P_2$ bends the beam: $P_1 = P$ for DCB, $P_2 = P$ for ENF, and
# $P_1 = P (3 c - L) / (4 L)$, $P_2 = P (c + L) / L$ for MMB [Reeder, Crews 1990]. Energy release rates and the displacement d of the load
# are
#
# $$
# \mathcal{G}_1 = \frac{12 P_1^2 a_1^2}{E' h^3}, \quad \mathcal{G}_2 = \frac{9 P_2^2 a_2^2}{16 E' h^3}, \quad
# P d = \frac{8 P_1^2 a_1^3}{E' h^3} + P_2^2 \left(\frac{3 a_2^3 + 2 L^3}{8 E' h^3} + \frac{3 L}{10\, G_s h}\right),
# $$
#
# with $G_s$ for shear of the arms, $a_1 = a + \chi h$ and $a_2 = a + 0.42 \chi h$, where chi counts rotation at the root and
# shear (Williams), for isotropic arms
#
# $$
# \chi^2 = \frac{2 (1 + \nu)}{11} \left(3 - 2 \left(\frac{\Gamma}{1 + \Gamma}\right)^2\right), \quad \Gamma = 2.36\, (1 + \nu).
# $$
#
# Force and displacement alone give a, and with it the rates that the beam feels: no length of a crack has to be read off.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import brentq

import uem_dolfinx as uem

args = common.arguments(
    __doc__,
    specimen=("dcb", "enf", "mmb"),
    share=0.5,
    mixed=("bk", "power"),
    size=0.625,
    steps=15,
    degree=2,
    coupling=("node_to_surface", "mortar"),
)
dcb = args.specimen == "dcb"
h, E, nu = 5.0, 70e3, 0.3  # mm, N/mm^2
length, crack, opening = (100.0, 40.0, 6.0) if dcb else (200.0, 50.0, 0.0)  # mm
L = length / 2
G1, G2, strength = (1.0, 1.0, 20.0) if dcb else (0.5, 1.0, 40.0)  # N/mm, N/mm^2
mixed = uem.BenzeggaghKenane(2.0) if args.mixed == "bk" else uem.Power(1.5)
law = uem.Cohesive(strength, G1) if dcb else uem.Cohesive(strength, G1, shear_energy=G2, mixed=mixed)

# %% [markdown]
# ## Beam theory

# %%
stiff, shear = E / (1 - nu**2), E / (2 * (1 + nu))
gamma = 2.36 * (1 + nu)
chi = np.sqrt(2 * (1 + nu) / 11 * (3 - 2 * (gamma / (1 + gamma)) ** 2))
ratio = np.sqrt(0.75 * (1 - args.share) / args.share)
c = L * (1 + ratio) / (3 - ratio)
opens, bends = {"dcb": (1.0, 0.0), "enf": (0.0, 1.0), "mmb": ((3 * c - L) / (4 * L), (c + L) / L)}[args.specimen]


def compliance(a: float) -> float:
    """Displacement of the load over the load."""
    shears = 0.0 if dcb else 0.3 * L / (shear * h)
    bent = (3 * (a + 0.42 * chi * h) ** 3 + 2 * L**3) / (8 * stiff * h**3)
    return opens**2 * 8 * (a + chi * h) ** 3 / (stiff * h**3) + bends**2 * (bent + shears)


def rates(P: float, a: float) -> tuple[float, float]:
    """Energy release rates in opening and in shear."""
    sides = (12 * opens**2 * (a + chi * h) ** 2, 9 / 16 * bends**2 * (a + 0.42 * chi * h) ** 2)
    return sides[0] * P**2 / (stiff * h**3), sides[1] * P**2 / (stiff * h**3)


def over_toughness(P: float, a: float) -> float:
    """Energy release rate over the energy of the bond in its mode."""
    opening, sliding = rates(P, a)
    energy = G1 if dcb else mixed.between(G1, G2, sliding / (opening + sliding))
    return (opening + sliding) / energy


def growing(a: float) -> float:
    """Force at which a crack grows."""
    return 1 / np.sqrt(over_toughness(1.0, a))


def by_theory(d: float) -> float:
    """Force at a displacement: with the first crack, or with the crack that grows there."""
    if d / compliance(crack) < growing(crack):
        return d / compliance(crack)
    return growing(brentq(lambda a: growing(a) * compliance(a) - d, crack, 10 * length))


# %% [markdown]
# ## The scene
# The ends of the double cantilever beam are moved apart. The other beams have dead loads, which the lever distributes, and supports at
# points. Only the bonded part of the upper arm is a contactor of the bond; where faces of the crack are pressed together, they touch
# without friction. Contactors that close are united with the lower arm, as in any contact.

# %%
sizes = {"size": args.size, "n": 2 if args.degree == 2 else 4, "length": length, "crack": crack}
sizes |= {} if dcb else {"middle": L}
mesh, tags = uem.read_gmsh(common.MESHES / "delamination.geo", comm, gdim=2, parameters=sizes)
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
how = {"coupling": args.coupling, "sliding": "small"}
contacts = [uem.Contact(tags["upper_bond"], tags["lower_bond"], cohesion=law, name="bond", **how)]
if dcb:
    bcs = [
        uem.dirichlet(V, tags["upper_left"], 1, value=opening / 2),
        uem.dirichlet(V, tags["lower_left"], 1, value=-opening / 2),
        uem.dirichlet(V, tags["lower_right"], 0),
    ]
    loads, full = {}, 1.0
else:
    bcs = [uem.dirichlet(V, tags["lower_left_corner"], 1), uem.dirichlet(V, tags["lower_right_corner"])]
    middle, end, full = fem.Constant(mesh, (0.0, 0.0)), fem.Constant(mesh, (0.0, 0.0)), 2 * growing(crack)
    loads = {middle: (0.0, -bends * full), end: (0.0, (bends - 1) * full)}
    contacts += [uem.Contact(tags["upper_crack"], tags["lower_crack"], name="crack", **how)]
points = {} if dcb else {middle: tags["upper_middle"], end: tags["upper_left_corner"]}
problem = uem.UnitedProblem(
    F,
    u,
    bcs=bcs,
    contacts=contacts,
    points=[uem.PointLoad(points[force], force) for force in points],
    load=loads or None,
    petsc_options_prefix="delamination_",
    verbose=args.verbose,
)

# %% [markdown]
# ## The crack grows
# Bending first, then growth: `damage` is 1 where the bond is separated, and its integral is the new surface. As long as the crack is
# shorter than about 0.7 L, flexure snaps back: both force and displacement of the load fall while it grows. No load and no displacement
# leads there, but the energy that the crack takes, `uem.Dissipation`: a step lets it grow by about half an arm's height.


# %%
def at(point: uem.Tag) -> float:
    """Vertical displacement of a point."""
    nodes = fem.locate_dofs_topological(V, 0, point.entities)
    owned = nodes[nodes < V.dofmap.index_map.size_local]
    return float(comm.allreduce(u.x.array[2 * owned + 1].sum()))


def force_and_displacement(factor: float) -> tuple[float, float]:
    """Of the load at a load factor."""
    if dcb:
        return float(problem.reaction(tags["upper_left"])[1]), opening * factor
    return full * factor, (bends - 1) * at(points[end]) - bends * at(points[middle])


rows, bond = [], contacts[0]
by = False if dcb else uem.Dissipation(G1 * h / 2)
writer = uem.ResultsWriter(f"{args.output}/delamination", problem) if args.output else None
for step in uem.load_steps(problem, args.steps, arc_length=by):
    P, d = force_and_displacement(step.factor)
    arm = brentq(lambda a, d=d, P=P: compliance(a) * P - d, 0.0, 10 * length)
    a = crack + uem.integrate(bond.damage * uem.ds(tags["upper_bond"]))
    row = {"displacement": d, "force": P, "theory": by_theory(d) if dcb else growing(max(arm, crack))}
    row |= {"rate": over_toughness(P, arm), "share": rates(P, arm)[1] / sum(rates(P, arm)), "crack": a}
    rows.append(row | {"iterations": step.newton_iterations})
    if writer:
        writer.write(step)
    if not dcb and a > L - 3 * h:
        break
if writer:
    writer.close()

# %% [markdown]
# The rate is that of the bond once the cohesive zone, about an arm's height long, has formed.

# %%
grown = [row for row in rows if row["crack"] > crack + 2 * h]
results = {
    "rows": rows,
    "toughness_error": max(abs(row["rate"] - 1) for row in grown),
    "force_error": max(abs(row["force"] / row["theory"] - 1) for row in grown),
    "iterations": max(row["iterations"] for row in rows),
}
common.report(args, results)

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        lengths = np.linspace(crack, rows[-1]["crack"], 200)
        forces = np.array([growing(a) for a in lengths])
        way = forces * [compliance(a) for a in lengths]
        panel.plot(np.append(0.0, way), np.append(0.0, forces), "k-", lw=1, label="beam theory")
        panel.plot([row["displacement"] for row in rows], [row["force"] for row in rows], "o", label="cohesive bond")
        panel.set(xlabel=f"{'opening' if dcb else 'displacement of the load'} / mm", ylabel="force per width / N/mm")
        panel.legend(frameon=False)

# %%
assert results["toughness_error"] < 0.02 and results["force_error"] < 0.02, results
