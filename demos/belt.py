"""A belt on a pulley: how much more its tight end pulls than its slack end, against Euler and Eytelwein.

python3 demos/belt.py --plot belt.png

Options:
    n: cells along the half circle around the pulley
    t: thickness of the belt
"""

# %% [markdown]
# # Belt on a pulley
#
# A thin belt lies around half of a fixed pulley. The force T2 pulls its slack end. Its tight end is moved down until the belt slips
# everywhere. Where the tension is T, the belt presses the pulley by p = T/R per length, and friction mu p makes T grow along the belt by
#
# $$
# \frac{dT}{d\varphi} = \mu T, \qquad \frac{T_1}{T_2} = e^{\mu \varphi}
# $$
#
# (Euler, 1769; Eytelwein, 1808). Before, slip begins at the tight end and spreads along the belt; the remaining part sticks under T2.
# Friction acts on the inside of the belt, half its thickness t below its axis, which makes the exponent smaller by t / (2 R) of itself.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=80, t=0.01, E=1e4, steps=8)
R, nu, slack = 1.0, 0.0, 0.001


# %% [markdown]
# ## One belt
# The tight end moves by more than the elongation of the belt, so that all of the belt slips at the end.


# %%
def belt(mu: float):
    """Rows of tight force, contactors that stick and that slip, and iterations; angles and pressures at the end; the problem."""
    mesh, tags = uem.read_gmsh(common.MESHES / "belt.geo", comm, gdim=2, parameters={"R": R, "t": args.t, "n": args.n})
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(args.E, nu, kind="plane_stress")
    place = fem.Constant(mesh, 0.0)
    F = material.residual(u, v) * ufl.dx + slack / args.t * v[1] * uem.ds(tags["slack_end"])
    contact = uem.Contact(tags["inside"], uem.RigidSphere((0.0, 0.0), R), friction=mu)
    problem = uem.UnitedProblem(
        F, u, bcs=[uem.dirichlet(V, tags["tight_end"], 1, place)], contacts=[contact], petsc_options_prefix="belt_", rtol=1e-10,
        verbose=args.verbose,
    )  # fmt: skip
    writer = uem.ResultsWriter(f"{args.output}/belt_{mu}", problem) if args.output else None
    stretch = slack * np.exp(mu * np.pi) / (args.E * args.t) * np.pi * R
    rows = []
    for part in np.linspace(0.0, 2.0, args.steps + 1):
        place.value = -part * stretch
        steps = list(uem.load_steps(problem))
        if writer:
            writer.write(steps[-1])
        status = contact.status.x.array[contact.pair.nodes]
        stick, slip = (comm.allreduce(int((status == k).sum())) for k in (1, 2))
        rows.append({
            "mu": mu, "T1/T2": contact.resultant().force[1] / slack - 1, "stick": stick, "slip": slip,
            "iterations": sum(step.newton_iterations for step in steps),
        })  # fmt: skip
    if writer:
        writer.close()
    x, p = (np.concatenate(part) for part in zip(*comm.allgather((contact.points, contact.pressures))))
    angle = np.pi - np.arctan2(x[:, 1], x[:, 0])
    order = np.argsort(angle)
    return rows, angle[order], p[order] * R / slack, problem


# %% [markdown]
# ## The figures

# %%
rows, curves = [], {}
for mu in (0.1, 0.3, 0.5):
    history, angle, tension, problem = belt(mu)
    curves[mu] = angle, tension, history
    rows.append(history[-1] | {
        "exp(mu phi)": float(np.exp(mu * np.pi)), "error": float(history[-1]["T1/T2"] / np.exp(mu * np.pi) - 1),
        "thin belt": float(history[-1]["T1/T2"] / np.exp(mu * np.pi / (1 + args.t / (2 * R))) - 1),
    })  # fmt: skip
results = {
    "belt": rows,
    "capstan_error": max(abs(row["error"]) for row in rows),
    "iterations": max(row["iterations"] for _, _, history in curves.values() for row in history),
    "history": curves[0.3][2],
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.2)) as (left, right):
        if left:
            for k, (mu, (angle, tension, history)) in enumerate(curves.items()):
                left.plot(angle, tension, ".", ms=3, color=f"C{k}", label=f"mu = {mu}")
                left.plot(angle, np.exp(mu * angle), color=f"C{k}", lw=1)
                right.plot(np.linspace(0, 2, args.steps + 1), [row["T1/T2"] for row in history], ".-", color=f"C{k}")
                right.axhline(np.exp(mu * np.pi), color=f"C{k}", lw=0.8, ls="--")
            left.set(xlabel="angle from the slack end", ylabel="pressure R / T2, lines: exp(mu phi)", ylim=(0, 6))
            right.set(xlabel="displacement of the tight end / its elongation", ylabel="T1 / T2")
            for ax in (left, right):
                ax.grid(alpha=0.25)
            left.legend(frameon=False)

# %%
assert results["capstan_error"] < 0.01 and all(row["stick"] == 0 for row in rows), results
