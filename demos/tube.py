"""A thin tube that collapses under pressure from outside until its wall touches itself, against the elastica.

python3 demos/tube.py --plot tube.png

Options:
    n: cells around the tube, a multiple of 4
    t: thickness of the wall relative to R
    out_of_round: relative deviation of the radius
    load: largest pressure, in EI / R^3
"""

# %% [markdown]
# # A tube that touches itself
#
# A tube under pressure p from outside buckles at p R^3 / EI = 3, flattens, and at p R^3 / EI = 5.247 opposite sides of a wall without
# thickness meet; from then on they press on each other (Flaherty, Keller and Rubinow, 1972, doi:10.1137/0123047). Nothing is declared but
# that the tube may touch itself: no pairs of surfaces, no thickness, no distance.
#
# The reference is the inextensible elastica of a quarter of the tube, with the thickness of the wall t between the middles of both sides:
#
# $$
# x' = \cos a, \quad y' = \sin a, \quad a' = k, \quad E I\, k' = N \sin a - Q \cos a, \quad N' = -p \sin a, \quad Q' = p \cos a
# $$

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.integrate import solve_ivp
from scipy.optimize import root

import uem_dolfinx as uem

args = common.arguments(__doc__, n=160, layers=1, degree=2, t=0.02, out_of_round=0.003, load=9.0, steps=40, nu=0.3)
EI = args.t**3 / 12 / (1 - args.nu**2)

# %% [markdown]
# ## The reference
# From the top, where the wall is horizontal, to the side, where it is vertical. Lengths in R, forces in EI / R^2. Unknown are the curvature
# and the normal force at the top, and there the pressure at which it comes down to t / 2, or the force Q that holds it there.


# %%
def quarter(load: float, shear: float, unknown: np.ndarray) -> np.ndarray:
    """End of the quarter ``(x, y, a, k, N, Q)``; ``shear`` is Q at its beginning, half of the force on the other side."""

    def slopes(s: float, z: np.ndarray) -> list[float]:
        _, _, a, k, N, Q = z
        return [np.cos(a), np.sin(a), k, N * np.sin(a) - Q * np.cos(a), -load * np.sin(a), load * np.cos(a)]

    start = [0.0, args.t / 2, 0.0, unknown[0], unknown[1], shear]
    return solve_ivp(slopes, (0, np.pi / 2), start, rtol=1e-10, atol=1e-12).y[:, -1]


def missed(end: np.ndarray) -> list[float]:
    """What does not hold at the side: vertical, at half height, without shear."""
    return [end[2] + np.pi / 2, end[1], end[4]]


curvature, normal, touch = root(lambda z: missed(quarter(z[2], 0.0, z)), [0.4, -2.0, 5.0]).x


def force(load: float) -> float:
    """Force between the sides after they have met, over EI / R^2."""
    return -2 * root(lambda z: missed(quarter(load, z[2], z)), [curvature, normal, 0.8 * (touch - load)]).x[2]


# %% [markdown]
# ## The tube
# Pressure follows the outside; that this is longer than the middle of the wall adds a force along the wall, which bends nothing. The tube
# is slightly out of round, so that it buckles on its own.

# %%
mesh, tags = uem.read_gmsh(
    common.MESHES / "tube.geo", comm, gdim=2, parameters={"n": args.n, "layers": args.layers, "t": args.t, "e": args.out_of_round}
)
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
pressure = fem.Constant(mesh, 0.0)
turned = ufl.cofac(ufl.Identity(2) + ufl.grad(u)) * ufl.FacetNormal(mesh)
F = uem.StVenantKirchhoff(1.0, args.nu, kind="plane_strain").residual(u, v) * ufl.dx
F += pressure * ufl.inner(turned, v) * uem.ds(tags["outside"])
bcs = [uem.dirichlet(V, tags["sections_x"], 1), uem.dirichlet(V, tags["sections_y"], 0)]
contact = uem.GeneralContact(self_contact=True)
problem = uem.UnitedProblem(
    F,
    u,
    bcs=bcs,
    contacts=[contact],
    load={pressure: args.load * EI},
    rtol=1e-7,
    petsc_options_prefix="tube_",
    verbose=args.verbose,
)

# %%
rows, shapes = [], []
upper = problem.config.X[: problem.config.n_owned, 1] > 0
writer = uem.ResultsWriter(f"{args.output}/tube", problem) if args.output else None
steps = uem.load_steps(problem, args.steps)
if args.output:
    steps = uem.animate(
        f"{args.output}/tube.gif", problem, steps, field=ufl.sqrt(ufl.inner(u, u)), label="displacement", cells=False
    )
for step in steps:
    load = float(pressure.value) / EI
    pushed = comm.allreduce(float(contact.force.x.array[1 : 2 * problem.config.n_owned : 2][upper].sum())) / EI
    rows.append({"load": load, "force": pushed, "active": contact.n_active, "iterations": step.newton_iterations})
    if writer is not None:
        writer.write(step)
    if args.plot and step.number % max(1, args.steps // 4) == 0:
        shapes.append((f"p R^3 / EI = {load:.3g}", uem.outline(problem)))
if writer is not None:
    writer.close()

# %% [markdown]
# ## Touch and force
# The pressure of the first touch is where the line through the first two forces begins.

# %%
after = [row for row in rows if row["force"] > 0]
a, b = after[:2]
met = a["load"] - a["force"] * (b["load"] - a["load"]) / (b["force"] - a["force"])
expected = [force(row["load"]) for row in after]
results = {
    "touch": met,
    "touch_reference": float(touch),
    "touch_error": abs(met / touch - 1),
    "force_error": max(abs(row["force"] - f) for row, f in zip(after, expected)) / expected[-1],
    "steps_in_contact": len(after),
    "newton_iterations": sum(row["iterations"] for row in rows),
    "balance": max(part.balance().force for part in contact.parts),
    "dofs": 2 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2) as panels:
        if panels[0] is not None:
            for k, (label, lines) in enumerate(shapes):
                panels[0].plot(*np.moveaxis(lines, -1, 0).swapaxes(1, 2), f"C{k}-", lw=1)
                panels[0].plot([], [], f"C{k}-", lw=1, label=label)
            panels[0].set(aspect="equal")
            panels[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=2, frameon=False)
            panels[1].plot([row["load"] for row in rows], [row["force"] for row in rows], ".", label="tube")
            panels[1].plot([touch, *(row["load"] for row in after)], [0.0, *expected], "k-", lw=1, label="elastica")
            panels[1].set(xlabel="p R^3 / EI", ylabel="force between the sides, over EI / R^2")
            panels[1].legend()

# %%
assert results["touch_error"] < 0.02 and results["balance"] < 1e-12
