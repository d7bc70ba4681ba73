"""Three blocks on each other, hard between soft, the middle one contactor below and target above.

python3 demos/stack.py --plot stack.png

Options:
    n: cells along each side of the lowest block; those above have 2 and 4 times as many
    ratio: Young's modulus of the middle block relative to that of the others
    d: displacement of the stack's top, downwards
"""

# %% [markdown]
# # A stack of three blocks
#
# Three unit blocks lie on each other between lateral rollers, the lowest on the ground. Their Young's moduli alternate between 1 and
# `ratio`; the top of the stack is pushed down by d. Held at its sides, a block is an oedometer of modulus
#
# $$
# M = \frac{E (1 - \nu)}{(1 + \nu)(1 - 2 \nu)},
# $$
#
# so that the stack is three springs in series, which carry F = d / (1/M1 + 1/M2 + 1/M3), and interface k settles by
# F (1/M1 + ... + 1/Mk). The meshes grow finer from the bottom to the top, and every block rests with its bottom, as contactor, on
# the top of the one below, its target. Each node of the middle block's bottom is eliminated; its top is followed by the contactors
# of the upper block. Chains of bodies ask for nothing else than that P is built in the order in which bodies follow each other. With
# `--coupling mortar` the meshes need not be nested.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, dim=("2", "3"), degree=1, ratio=1e4, d=0.1, quads=0, coupling=("node_to_surface", "mortar"))
dim, nu = int(args.dim), 0.3
E_of = (1.0, args.ratio, 1.0)

# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(
    common.MESHES / "blocks.geo", comm, gdim=dim,
    parameters={"dim": dim, "n_1": args.n, "n_2": 2 * args.n, "n_3": 4 * args.n, "quads": args.quads},
)  # fmt: skip
E = fem.Function(uem.function_space(mesh, ("DG", 0)), name="E")
for k, value in enumerate(E_of, start=1):
    E.x.array[tags[f"block_{k}"].entities] = value
V = uem.function_space(mesh, args.degree, (dim,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
F = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d").residual(u, v) * ufl.dx
bcs = [uem.dirichlet(V, tags["bottom_1"], dim - 1), uem.dirichlet(V, tags["top_3"], dim - 1, -args.d)]
bcs += [uem.dirichlet(V, tags[sides], i) for i, sides in enumerate(("sides_x", "sides_y")[: dim - 1])]
contacts = [uem.Contact(contactor=tags[f"bottom_{k + 1}"], target=tags[f"top_{k}"], coupling=args.coupling) for k in (1, 2)]

# %% [markdown]
# ## The solution

# %%
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, petsc_options_prefix="stack_", verbose=args.verbose)
steps = list(uem.load_steps(problem))

# %% [markdown]
# ## The figures
# Errors are relative to the closed form; those of a settlement are the largest over the nodes of both sides of an interface.

# %%
flexibility = np.array([(1 + nu) * (1 - 2 * nu) / (E * (1 - nu)) for E in E_of])
force = args.d / flexibility.sum()
settlement = force * np.cumsum(flexibility)
rows = []
for k, contact in enumerate(contacts, start=1):
    sides = [fem.locate_dofs_topological(V, dim - 1, tags[name].entities) for name in (f"top_{k}", f"bottom_{k + 1}")]
    u_k = u.x.array.reshape(-1, dim)[np.concatenate(sides), dim - 1]
    settlement_error = np.abs(-u_k / settlement[k - 1] - 1).max(initial=0.0)
    rows.append({
        "settlement": float(settlement[k - 1]),
        "settlement_error": float(max(comm.allgather(settlement_error))),
        "force": float(contact.resultant().force[dim - 1]),
        "force_error": float(abs(contact.resultant().force[dim - 1] / force - 1)),
        "contactors": contact.n_active,
    })  # fmt: skip
results = {
    "interface": rows,
    "force_exact": float(force),
    "error": max(max(row["settlement_error"], row["force_error"]) for row in rows),
    "max_gap": max(contact.max_gap() for contact in contacts),
    "newton_iterations": sum(step.newton_iterations for step in steps),
    "exchanges": sum(step.exchanges for step in steps),
    "dofs": dim * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The hard block settles without being shortened.

# %%
if args.plot:
    if dim == 2:
        x, down = (comm.gather(part) for part in (problem.config.X[:, 1], -problem.config.displacement[:, 1]))
        with uem.figure(args.plot, comm, panels=2, size=(4.2, 4.8)) as (left, right):
            uem.plot_scene(problem, left, field=-u[1], label="settlement")
            if right is not None:
                right.plot(np.concatenate(down), np.concatenate(x), ".", ms=4, label="nodes")
                right.plot([0.0, *settlement], range(4), color="0.25", lw=1, label="three springs in series")
                right.set(xlabel="settlement", ylabel="y")
                right.grid(alpha=0.25)
                right.legend(frameon=False)
    else:
        solid = common.draws_3d()
        with uem.figure(args.plot, comm, panels=2 if solid else 1) as panels:
            uem.plot_pressure(contacts, panels[0], reference=lambda r: np.full_like(r, force), reference_label="closed form")
            if solid:
                uem.plot_scene(problem, panels[1], label="settlement", view=(1.0, -1.5, 0.6))
if args.output:
    with uem.ResultsWriter(f"{args.output}/stack", problem) as writer:
        writer.write(steps[-1])

# %% [markdown]
# What remains is the rounding of the hard block's forces, seen from the soft ones, and therefore grows with the ratio.

# %%
assert results["error"] < 1e-12 * max(args.ratio, 1 / args.ratio, 1e3)
