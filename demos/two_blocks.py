"""Two blocks of very different stiffness, one pushed onto the other, against the closed form.

python3 demos/two_blocks.py --plot two_blocks.png

Options:
    n: cells along each side of the coarser block
    d: displacement of the upper block's top, downwards
"""

# %% [markdown]
# # Two blocks
#
# Two unit squares lie one upon the other between lateral rollers, in plane strain, so that each is an oedometer of modulus M = E (1 - nu)
# / ((1 + nu) (1 - 2 nu)). The lower one lies on the ground; the top of the upper one is pushed down by d. Shortened by e, a block pushes
# back with
#
# $$
# F = M e \quad \text{(linear)}, \qquad F = \frac{M}{2}\, e\, (1 - e)(2 - e) \quad \text{(St Venant-Kirchhoff)}
# $$
#
# and the interface moves down by e of the lower block, so that the linear blocks carry F = d k1 k2 / (k1 + k2). Multipliers
# and penalties lose digits as the blocks' stiffnesses drift apart; elimination has no parameter that could.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, d=0.25, steps=1, degree=1)
LAWS = {
    "linear": (uem.LinearElastic, lambda e: e),
    "st_venant_kirchhoff": (uem.StVenantKirchhoff, lambda e: e * (1 - e) * (2 - e) / 2),
}

# %% [markdown]
# ## The closed form
# Bisection on the balance of the blocks' forces, always for the stiffer block's shortening, keeps the digits of the smaller one.

# %%


def interface_displacement(ratio: float, force, d: float) -> float:
    """How far the interface moves down; ratio is the upper block's modulus over the lower one's."""
    stiffer = max(ratio, 1 / ratio)
    low, high = 0.0, d
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if stiffer * force(middle) < force(d - middle) else (low, middle)
    return d - middle if ratio > 1 else middle


# %% [markdown]
# ## One scene
# The contactor is the finer side, and its nodes contain the target's: only so does a constant pressure pass exactly.


# %%
def solve(ratio: float, law: str, contactor: str) -> tuple[uem.UnitedProblem, dict[str, object]]:
    """Push the blocks together; the row of the table that comes of it."""
    fine = {side: args.n * (2 if side == contactor else 1) for side in ("lower", "upper")}
    mesh, tags = uem.read_gmsh(
        common.MESHES / "two_blocks.geo", comm, gdim=2, parameters={f"n_{side}": n for side, n in fine.items()}
    )
    E = fem.Function(uem.function_space(mesh, ("DG", 0)), name="E")
    for side, value in (("lower", min(1.0, 1 / ratio)), ("upper", min(1.0, ratio))):
        E.x.array[tags[side].entities] = value
    V = uem.function_space(mesh, args.degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material, force = LAWS[law]
    F = material(E, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [
        uem.dirichlet(V, tags["sides"], 0),
        uem.dirichlet(V, tags["lower_bottom"], 1),
        uem.dirichlet(V, tags["upper_top"], 1, -args.d),
    ]
    surfaces = {"upper": tags["upper_bottom"], "lower": tags["lower_top"]}
    target = surfaces["lower" if contactor == "upper" else "upper"]
    contact = uem.Contact(contactor=surfaces[contactor], target=target)
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="blocks_", verbose=args.verbose)
    iterations = sum(step.newton_iterations for step in uem.load_steps(problem, args.steps))

    exact = interface_displacement(ratio, force, args.d)
    nodes = np.concatenate([fem.locate_dofs_topological(V, 1, tag.entities) for tag in surfaces.values()])
    error = np.abs(-u.x.array.reshape(-1, 2)[nodes, 1] / exact - 1).max(initial=0.0)
    row = {
        "ratio": ratio,
        "law": law,
        "contactor": contactor,
        "error": float(max(comm.allgather(error))),
        "newton_iterations": iterations,
    }
    return problem, row


# %% [markdown]
# ## The figures
# Relative error of the interface displacement, the largest over both sides of the interface.

# %%
ratios = [10.0**k for k in range(-9, 10, 3)]
rows = [solve(ratio, law, contactor)[1] for law in LAWS for contactor in ("upper", "lower") for ratio in ratios]
common.report(args, {"rows": rows})

# %% [markdown]
# ## The picture
# The upper block ten times softer than the lower one, and the errors of the table.

# %%
if args.plot or args.output:
    problem, _ = solve(0.1, "st_venant_kirchhoff", "upper")
    if args.plot:
        with uem.figure(args.plot, comm, panels=2, size=(4.8, 4.4)) as (left, right):
            uem.plot_scene(problem, left, field=-problem.u[1], label="settlement")
            for law in LAWS if right is not None else ():
                for side, marker in (("upper", "o-"), ("lower", "s--")):
                    errors = [max(row["error"], 1e-17) for row in rows if (row["law"], row["contactor"]) == (law, side)]
                    right.loglog(ratios, errors, marker, ms=4, label=f"{law.replace('_', ' ')}, {side} as contactor")
            if right is not None:
                right.set(xlabel="E above / E below", ylabel="error of the interface displacement", ylim=(1e-17, 1e-1))
                right.grid(alpha=0.25)
                right.legend(frameon=False)
    if args.output:
        with uem.ResultsWriter(f"{args.output}/two_blocks", problem) as writer:
            writer.write(1.0)

# %%
for row in rows:
    assert row["error"] < (1e-5 if row["ratio"] in (ratios[0], ratios[-1]) else 1e-8), row
