"""Contact patch test: a constant pressure between two blocks whose meshes do not match.

python3 demos/patch_test.py --plot patch_test.png

Options:
    n: cells along each side of the coarser block; mortar has meshes of its own, but for the picture
"""

# %% [markdown]
# # The contact patch test
#
# Two unit blocks lie one upon the other between lateral rollers. The lower one stands on rollers too, and a pressure p = 1 acts on
# the top of the upper one. Nothing holds the upper block but the contact, through which p must pass unchanged:
#
# $$
# \sigma_{zz} = -p \quad \text{everywhere.}
# $$
#
# Contactors are nodes, and each hands its force to the target's nodes with the weights of the target's shape functions. The target
# receives a constant pressure exactly if every function of its surface is one of the contactor's surface too, that is, if the
# meshes are **nested**. In a **single pass** over other meshes it receives the same resultants, but unevenly. In **two passes**
# each surface is once the contactor and once the target, and a constant pressure passes through other meshes too.
#
# With `--coupling mortar` contact is united in integrals over both surfaces instead of nodes, and the pressure passes exactly, in a
# single pass, through any pair of meshes.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

from benchmarks import patches

import uem_dolfinx as uem

args = common.arguments(
    __doc__, n=4, quads=0, dim=("both", "2", "3"), degree=("both", "1", "2"), coupling=("node_to_surface", "mortar")
)
E, nu, p = 100.0, 0.3, 1.0


# %% [markdown]
# ## One scene
# The error is the largest deviation of the vertical stress, over the middles of all cells; the strict one is the largest of any
# stress over p, at the nodes of each cell, or of any displacement over the largest.


# %%
def solve(
    dim: int,
    degree: int,
    n: tuple[int, int],
    passes: tuple[str, ...],
    *,
    quads: int = args.quads,
    moved: float = 0.0,
    width: float = 1.0,
    coupling: str = args.coupling,
) -> tuple[uem.UnitedProblem, fem.Function, float, float]:
    """Press the blocks together.

    Args:
        dim: 2 (plane strain) or 3.
        degree: of the displacement.
        n: cells along the sides of the lower and of the upper block.
        passes: the contactor of each pass, ``"lower"`` or ``"upper"``.
        quads: 1 for quadrilaterals and hexahedra.
        moved: how far nodes are moved at random, over the size of a cell.
        width: of the lower block, at least 1; the part beyond the upper one is loaded by p.
        coupling: nodes on facets, or mortar.

    Returns:
        The problem, its vertical stress over p in each cell, the error of that, and the strict error.
    """
    mesh, tags = uem.read_gmsh(
        common.MESHES / "blocks.geo", comm, gdim=dim, parameters={"dim": dim, "n_1": n[0], "n_2": n[1], "quads": quads}
    )
    patches.move_nodes(mesh.geometry.x, moved / max(n))
    patches.widen(mesh, tags["block_1"], width)
    V = uem.function_space(mesh, degree, (dim,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d")
    F = material.residual(u, v) * ufl.dx + p * v[dim - 1] * uem.ds(tags["top_2"])
    x = ufl.SpatialCoordinate(mesh)
    if width > 1:
        F += p * patches.beyond(x[0], 1.0, width / n[0], degree) * v[dim - 1] * uem.ds(tags["top_1"])
    bcs = [uem.dirichlet(V, tags["bottom_1"], dim - 1)]
    bcs += [uem.dirichlet(V, tags[sides], i) for i, sides in enumerate(("sides_x", "sides_y")[: dim - 1])]
    lower, upper = tags["top_1"], tags["bottom_2"]
    contacts = [uem.Contact(*((lower, upper) if side == "lower" else (upper, lower)), coupling=coupling) for side in passes]
    # the stress is exact but for rounding; CG leaves more
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=contacts, petsc_options_prefix="patch_", petsc_options=common.direct(), verbose=args.verbose
    )
    problem.solve()
    stress = fem.Function(uem.function_space(mesh, ("DG", 0)), name="vertical_stress")
    uem.interpolate(stress, material.stress(u)[dim - 1, dim - 1] / p)
    error = np.abs(stress.x.array + 1).max(initial=0.0)
    strict = patches.strict_error(u, material.stress(u), p, E, nu)
    return problem, stress, float(max(comm.allgather(error))), strict


# %% [markdown]
# ## The cases of nodes on facets
# The finer mesh has twice as many cells along each side if it is nested, and one less if it is not. With quadratic displacements
# the nodes between the vertices are contactors as well. Two passes unite linear bodies exactly on any two of these meshes: traces
# that agree at the nodes of both sides agree everywhere. Quadratic traces may still differ between those nodes, so that two passes
# are exact on nested meshes only.

# %%
scenes = {
    f"{dim}d_degree{degree}": (dim, degree)
    for dim in ((2, 3) if args.dim == "both" else (int(args.dim),))
    for degree in ((1, 2) if args.degree == "both" else (int(args.degree),))
}
n, exact, results = args.n, {}, {}
nested, others = (n, 2 * n), (n, 2 * n - 1)
if args.coupling == "node_to_surface":
    table, sides = [], {"finer": "upper", "coarser": "lower"}
    single = {(case, body): solve(*scene, others, (side,))[2] for case, scene in scenes.items() for body, side in sides.items()}
    exact = {case: solve(*scene, nested, ("upper",))[2] for case, scene in scenes.items()}
    both = {
        case: solve(d, degree, others if degree == 1 else nested, ("lower", "upper"))[2] for case, (d, degree) in scenes.items()
    }
    for case in scenes:
        table.append({"case": case, "nested": exact[case]})
        table[-1] |= {f"{body} on {other}": single[case, body] for body, other in zip(sides, reversed(sides))}
        table[-1]["two passes"] = both[case]
    results |= {"error": table, "nested_error": dict(exact), "two_pass_error": both}
    results["single_pass_error"] = {"_".join(which): error for which, error in single.items()}
    exact |= {f"{case}, two passes": error for case, error in both.items()}

# %% [markdown]
# ## The cases of mortar
# Meshes n:m that are not nested; nodes moved at random; a wider lower block, whose contact ends within a facet and covers a part
# of it, or only a hundredth; and each side once as contactor. In 3D the wider block is of hexahedra. Uniting in integrals does
# not spoil the condition of the system: it is compared with the largest eigenvalue of the bodies without contact over the smallest of
# one body of their shape, with the finer cells.

# %%
if args.coupling == "mortar":
    conditions = {}
    for case, (dim, degree) in scenes.items():
        for name, (cells, how) in patches.PAIRS[dim].items():
            for side in ("lower", "upper"):
                problem, _, _, exact[f"{case}_{name}_{side}"] = solve(dim, degree, cells, (side,), **how)
                if not how and comm.size == 1:
                    conditions[f"{case}_{name}_{side}"] = patches.condition_ratio(problem, dim, max(cells), degree, E, nu)
    results = {"mortar_error": exact, "condition_ratio": max(conditions.values(), default=None), "condition_ratios": conditions}
common.report(args, results)

# %% [markdown]
# ## The picture
# The vertical stress over p with linear triangles: nodes in a single pass, with the finer body as contactor, and in two passes, and
# mortar in a single pass.

# %%
if args.plot or args.output:
    nodes = "node_to_surface"
    shown = {"nodes": (nodes, ("upper",)), "nodes, two passes": (nodes, ("lower", "upper")), "mortar": ("mortar", ("upper",))}
    solved = [solve(2, 1, others, passes, coupling=coupling) for coupling, passes in shown.values()]
    if args.plot:
        levels = np.linspace(-1.055, -0.945, 12)
        with uem.figure(args.plot, comm, panels=3, size=(3.3, 4.8)) as panels:
            for panel, (problem, stress, error, _), label in zip(panels, solved, shown):
                uem.plot_scene(problem, panel, field=stress, label="$\\sigma_{yy} / p$", levels=levels, cmap="RdBu_r")
                if panel is not None:
                    panel.set_title(f"{label}\nerror {error:.0e}")
    if args.output:
        with uem.ResultsWriter(f"{args.output}/patch_test", solved[-1][0]) as writer:
            writer.write(1.0)

# %%
assert max(exact.values()) < {"node_to_surface": 1e-12, "mortar": 1e-11}[args.coupling], exact
