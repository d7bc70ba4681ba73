"""Contact patch test: a constant pressure between two blocks whose meshes do not match.

python3 demos/patch_test.py --plot patch_test.png
"""

# %% [markdown]
# # The contact patch test
#
# Two unit blocks lie one upon the other between lateral rollers. The lower one stands on rollers too, and a pressure p = 1 acts on
# the top of the upper one. Nothing holds the upper block but the contact, through which p must pass unchanged:
#
#     sigma_zz = -p    everywhere.
#
# Contactors are nodes, and each hands its force to the target's nodes with the weights of the target's shape functions. The target
# receives a constant pressure exactly if every function of its surface is one of the contactor's surface too, that is, if the
# meshes are **nested**. In a **single pass** over other meshes it receives the same resultants, but unevenly. In **two passes**
# each surface is once the contactor and once the target, and a constant pressure passes through other meshes too.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, quads=0, dim=("both", "2", "3"), degree=("both", "1", "2"))
E, nu, p = 100.0, 0.3, 1.0


# %% [markdown]
# ## One scene
# The error is the largest deviation of the vertical stress, over the middles of all cells.


# %%
def solve(dim: int, degree: int, n: tuple[int, int], passes: tuple[str, ...]) -> tuple[uem.UnitedProblem, fem.Function, float]:
    """Press the blocks together.

    Args:
        dim: 2 (plane strain) or 3.
        degree: of the displacement.
        n: cells along the sides of the lower and of the upper block.
        passes: the contactor of each pass, ``"lower"`` or ``"upper"``.

    Returns:
        The problem, its vertical stress over p in each cell, and the error of that.
    """
    mesh, tags = uem.read_gmsh(
        common.MESHES / "blocks.geo", comm, gdim=dim, parameters={"dim": dim, "n_1": n[0], "n_2": n[1], "quads": args.quads}
    )
    V = uem.function_space(mesh, degree, (dim,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d")
    F = material.residual(u, v) * ufl.dx + p * v[dim - 1] * uem.ds(tags["top_2"])
    bcs = [uem.dirichlet(V, tags["bottom_1"], dim - 1)]
    bcs += [uem.dirichlet(V, tags[sides], i) for i, sides in enumerate(("sides_x", "sides_y")[: dim - 1])]
    lower, upper = tags["top_1"], tags["bottom_2"]
    contacts = [
        uem.Contact(contactor=lower, target=upper) if side == "lower" else uem.Contact(contactor=upper, target=lower)
        for side in passes
    ]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, petsc_options_prefix="patch_", verbose=args.verbose)
    problem.solve()
    stress = fem.Function(uem.function_space(mesh, ("DG", 0)), name="vertical_stress")
    uem.interpolate(stress, material.stress(u)[dim - 1, dim - 1] / p)
    error = np.abs(stress.x.array + 1).max(initial=0.0)
    return problem, stress, float(max(comm.allgather(error)))


# %% [markdown]
# ## The cases
# The finer mesh has twice as many cells along each side if it is nested, and one less if it is not. With quadratic displacements
# the nodes between the vertices are contactors as well. Two passes unite linear bodies exactly on any two of these meshes: traces
# that agree at the nodes of both sides agree everywhere. Quadratic traces may still differ between those nodes, so that two passes
# are exact on nested meshes only.

# %%
nested, others = (args.n, 2 * args.n), (args.n, 2 * args.n - 1)
cases = {
    f"{dim}d_degree{degree}": (dim, degree)
    for dim in ((2, 3) if args.dim == "both" else (int(args.dim),))
    for degree in ((1, 2) if args.degree == "both" else (int(args.degree),))
}
sides = {"finer": "upper", "coarser": "lower"}
nested_error = {case: solve(*scene, nested, ("upper",))[2] for case, scene in cases.items()}
single_pass_error = {
    f"{case}_{body}": solve(*scene, others, (side,))[2] for case, scene in cases.items() for body, side in sides.items()
}
two_pass_error = {
    case: solve(dim, degree, others if degree == 1 else nested, ("lower", "upper"))[2] for case, (dim, degree) in cases.items()
}

# %% [markdown]
# ## The figures

# %%
table = [
    {
        "case": case,
        "nested": nested_error[case],
        "finer on coarser": single_pass_error[f"{case}_finer"],
        "coarser on finer": single_pass_error[f"{case}_coarser"],
        "two passes": two_pass_error[case],
    }
    for case in cases
]
errors = {"nested_error": nested_error, "single_pass_error": single_pass_error, "two_pass_error": two_pass_error}
common.report(args, {"error": table, **errors})

# %% [markdown]
# ## The picture
# The vertical stress over p with linear triangles: in a single pass, with the finer body as contactor, and in two passes.

# %%
if args.plot or args.output:
    single, both = (solve(2, 1, others, passes) for passes in (("upper",), ("lower", "upper")))
    if args.plot:
        levels = np.linspace(-1.055, -0.945, 12)
        with uem.figure(args.plot, comm, panels=2) as (left, right):
            for panel, (problem, stress, _), label in ((left, single, "single pass"), (right, both, "two passes")):
                uem.plot_scene(problem, panel, field=stress, label=f"$\\sigma_{{yy}} / p$, {label}", levels=levels)
    if args.output:
        with uem.ResultsWriter(f"{args.output}/patch_test", both[0]) as writer:
            writer.write(1.0)

# %%
assert max(*nested_error.values(), *two_pass_error.values()) < 1e-12
