"""Cattaneo and Mindlin's contact: a cylinder is pressed onto a block, then pushed to and fro; part of the contact sticks, part slips.

python3 demos/cattaneo_mindlin.py --plot cattaneo_mindlin.png
"""

# %% [markdown]
# # Stick and slip under a cylinder
#
# A half disc is pressed onto a block of the same material. Its flat side, which is kept from turning, is then pushed sideways by a force
# Q up to 0.88 mu P, back to -0.88 mu P and forth again, twice. Between bodies of one material pressure and friction do not disturb each
# other: the pressure stays Hertz', and with f(x; c) = (c/a) sqrt(1 - x^2/c^2) within c, zero outside, the friction is
#
#     q / (mu p0) = f(x; a) - f(x; c),    c = a sqrt(1 - Q / (mu P)),
#
# with stick within c and slip outside. On the way back from Q1 everything sticks at first, then slips from the edge inwards the other way:
#
#     q / (mu p0) = f(x; a) - f(x; c1) - 2 (f(x; a) - f(x; b)),    b = a sqrt(1 - (Q1 - Q) / (2 mu P)),
#
# and so on in each reversal (Cattaneo, 1938; Mindlin, J. Appl. Mech. 16, 259, 1949; Mindlin and Deresiewicz, J. Appl. Mech. 20, 327, 1953;
# Johnson, Contact Mechanics, 7.2 and 7.4). The loop of force and displacement closes.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, h=1 / 60, mu=0.3, part=0.88, steps=4)
E, nu, R, depth, mu, reach = 1.0, 0.3, 1.0, 0.0012, args.mu, 0.03

# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "cattaneo_mindlin.geo", comm, gdim=2, parameters={"h": args.h, "R": R, "zone": reach})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, nu, kind="plane_strain")
top, push, drop = uem.ds(tags["disc_top"]), fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
F = material.residual(u, v) * ufl.dx - push / (2 * R) * v[0] * top
bcs = [uem.dirichlet(V, tags["block_bottom"]), uem.dirichlet(V, tags["disc_top"], 1, drop)]
contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], friction=mu)
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options_prefix="mindlin_", verbose=args.verbose)
writer = uem.ResultsWriter(f"{args.output}/cattaneo_mindlin", problem) if args.output else None


# %% [markdown]
# ## The closed form
# After every reversal friction changes by twice what a first loading by half as much would bring.


# %%
def mindlin(x: np.ndarray, a: float, limit: float, last: float, Q: float) -> tuple[np.ndarray, float]:
    """Friction over mu p0 at x after the push went from ``last``, where it turned or began, to Q; half width of what sticks."""

    def f(c: float) -> np.ndarray:
        return c / a * np.sqrt(np.maximum(1 - (x / c) ** 2, 0.0))

    def loaded(change: float) -> tuple[np.ndarray, float]:
        c = a * np.sqrt(max(1 - change / limit, 0.0))
        return f(a) - f(c), c

    if last == 0:
        return loaded(Q)
    change, c = loaded(abs(Q - last) / 2)
    return np.sign(last) * (loaded(abs(last))[0] - 2 * change), c


# %% [markdown]
# ## Pressed, then pushed
# The zone that sticks is as wide as the part of the surface that its nodes have. Nodes within a facet of the edge of the contact are
# left out of the error: Hertz' pressure falls with a vertical tangent there. The contact moves with the disc, by its middle x.

# %%
rows, profiles, facet = [], [], args.h * reach


def step_to(Q: float, last: float = 0.0) -> None:
    """One step, and what it shows; contact forces push the disc back."""
    push.value = Q
    (step,) = uem.load_steps(problem)
    if writer:
        writer.write(step)
    pair, P = contact.pair, contact.resultant().force[1]
    mine = [part[pair.nodes] for part in (contact.traction.x.array[::2], contact.status.x.array)]
    x, p, q, status = (np.concatenate(part) for part in zip(*comm.allgather((pair.points[:, 0], contact.pressures, *mine))))
    p0 = np.sqrt(P * E / (2 * (1 - nu**2)) / (np.pi * R))
    a, x, q = 2 * P / (np.pi * p0), x - (x * p).sum() / p.sum(), -q / (mu * p0)
    exact, c = mindlin(x, a, mu * P, last, Q)
    inside = np.abs(x) < a - facet
    rows.append({
        "Q/(mu P)": Q / (mu * P), "c/a": c / a, "stick": int((status == 1).sum()), "slip": int((status == 2).sum()),
        "traction_error": float(np.sqrt(np.mean((q - exact)[inside] ** 2))),
        "stick_edge_error": float(abs((status == 1).sum() / 2 - c / facet)), "iterations": step.newton_iterations,
        "way": uem.integrate(u[0] * top) / (2 * R),
    })  # fmt: skip
    order = np.argsort(x)
    profiles.append((Q / limit, last, a, mu * P, x[order] / a, q[order]))


for part in (0.25, 0.5, 0.75, 1.0):
    drop.value = -depth * part
    list(uem.load_steps(problem))
limit, n = args.part * mu * contact.resultant().force[1], args.steps
for k in range(1, n + 1):
    step_to(limit * k / n)
for sign in (-1, 1, -1, 1):
    for k in range(1, 2 * n + 1):
        step_to(sign * limit * (k / n - 1), -sign * limit)
if writer:
    writer.close()

# %% [markdown]
# ## The figures
# Stick edges in facets; the second loop is to end where the first did.

# %%
way = np.array([row["way"] for row in rows])
results = {
    "step": rows[: 5 * n],
    "traction_error": max(row["traction_error"] for row in rows),
    "stick_edge_error": max(row["stick_edge_error"] for row in rows),
    "loop_error": float(np.abs(way[5 * n :] - way[n : 5 * n])[-1] / way.max()),
    "iterations": max(row["iterations"] for row in rows),
    "dissipation": contact.dissipation,
    "dofs": 2 * V.dofmap.index_map.size_global,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Friction on the way up, on the way back, and the loop.

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(6.0, 4.2)) as (left, right):
        if left:
            line = np.linspace(-1, 1, 801)
            for k, colour in zip((n // 2 - 1, n - 1, n + n // 2 - 1, 2 * n - 1, 3 * n - 1), ("C0", "C1", "C2", "C3", "C4")):
                part, last, a, bound, x, q = profiles[k]
                exact, _ = mindlin(line * a, a, bound, last, part * limit)
                left.plot(line, exact, color=colour, lw=1)
                left.plot(x, q, ".", ms=3, color=colour, label=f"Q = {part * args.part:+.2f} mu P")
            left.set(xlim=(-1.15, 1.15), xlabel="x / a", ylabel="friction / (mu p0), lines: Mindlin")
            right.plot([0, *way], [0, *(row["Q/(mu P)"] for row in rows)], ".-", ms=3, lw=0.8)
            right.set(xlabel="way of the disc's flat side", ylabel="Q / (mu P)")
            for ax in (left, right):
                ax.grid(alpha=0.25)
            left.legend(frameon=False, fontsize="small", ncol=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))

# %%
assert results["stick_edge_error"] <= 1 and results["loop_error"] < 1e-8 and results["iterations"] <= 5, results
# of first order: friction has a vertical tangent where stick ends
if args.h <= 1 / 30:
    assert results["traction_error"] < 1.5 * args.h, results
