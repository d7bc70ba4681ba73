"""What contact costs: its share of a Newton iteration, and CG iterations against the same bodies meshed as one.

python3 demos/contact_cost.py --json cost.json

Options:
    dofs: unknowns of each scene at degree 1, approximately
"""

# %% [markdown]
# # What contact costs
#
# Two measurements, each a ratio of things done in one run.
#
# 1. The Hertz scenes with about 100,000 unknowns in 2D and in 3D: how much of the time of the Newton iterations is spent on search and
#    projection, the uniting equations with the curvature of the contact, P and the product P'KP.
# 2. A block upon a block, once as two bodies in contact and once meshed as one body, fused over the contact area: how many iterations
#    CG takes with the same preconditioner and tolerance.

# %%
import time

import common
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dofs=100_000, degree=1, coupling=("node_to_surface", "mortar"))
CONTACT = ("search and projection", "uniting equations", "contact curvature", "united matrix P'KP")
OTHERS = ("assemble residual", "assemble tangent", "linear solve")
#: What has a timer of its own and counts towards another stage here.
PARTS = {
    "united matrix P'KP": ("restriction matrix P", "cross out prescribed components"),
    "linear solve": ("factorisation or preconditioner set-up",),
}
AMG = ("gamg", "hypre") if uem.multigrid_options()["pc_type"] == "hypre" else ("gamg",)


def elastic(mesh, dim: int) -> tuple[fem.Function, ufl.Form]:
    """Displacement and residual of a linear elastic body."""
    V = uem.function_space(mesh, args.degree, (dim,))
    u = fem.Function(V, name="displacement")
    law = uem.LinearElastic(1e6, 0.3, kind="plane_strain" if dim == 2 else "3d")
    return u, law.residual(u, ufl.TestFunction(V)) * ufl.dx


# %% [markdown]
# ## Share of a Newton iteration
# Read from DOLFINx's timers. MUMPS solves in 2D, CG with AMG in 3D, as `UnitedProblem` chooses by itself.


# %%
def clock(stage: str) -> float:
    """Seconds that a stage and its parts have taken so far."""
    return sum(uem.timing(timer)[1] for timer in (stage, *PARTS.get(stage, ())))


def share(dim: int) -> dict[str, object]:
    """Solve a Hertz scene and measure the shares of time, per cent of all Newton iterations."""
    if dim == 2:
        names, parameters = ("hertz_cylinder", "disc_arc", "disc_top"), {"h": (1 / 120) * (11_000 / args.dofs) ** 0.5}
        push, fixed = -0.006, ["symmetry"]
    else:
        a = 0.005
        names, parameters = ("hertz_sphere", "sphere_cap", "sphere_top"), {"zone": 1.4 * a, "growth": 0.8 / a}
        parameters["h"] = 0.1 * a * (102_000 / args.dofs) ** (1 / 3)
        push, fixed = -(a**2), ["symmetry_x", "symmetry_y"]
    mesh, tags = uem.read_gmsh(common.MESHES / f"{names[0]}.geo", comm, gdim=dim, parameters=parameters)
    u, F = elastic(mesh, dim)
    bcs = [uem.dirichlet(u.function_space, tags[name], i) for i, name in enumerate(fixed)]
    bcs += [
        uem.dirichlet(u.function_space, tags[name], dim - 1, value) for name, value in (("block_bottom", 0.0), (names[2], push))
    ]
    contact = uem.Contact(contactor=tags[names[1]], target=tags["block_top"], coupling=args.coupling)
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="share_")
    before = {stage: clock(stage) for stage in CONTACT + OTHERS}
    start = time.perf_counter()
    steps = list(uem.load_steps(problem, 2))
    wall = time.perf_counter() - start
    spent = {stage: clock(stage) - before[stage] for stage in CONTACT + OTHERS}
    iterations = sum(step.newton_iterations for step in steps)
    row: dict[str, object] = {"dim": dim, "dofs": dim * u.function_space.dofmap.index_map.size_global, "active": contact.n_active}
    row |= {"newton_iterations": iterations, "seconds_per_iteration": wall / iterations}
    row["contact_share"] = sum(spent[stage] for stage in CONTACT) / wall
    row |= {stage: seconds / wall for stage, seconds in spent.items()}
    return row | {"rest": 1 - sum(spent.values()) / wall}


# %% [markdown]
# ## CG iterations


# %%
def cg_iterations(dim: int, amg: str, fused: bool) -> tuple[int, int]:
    """Mean number of CG iterations of a solve, and the number of unknowns."""
    h = (1.25 * 2 / args.dofs) ** 0.5 if dim == 2 else (1.125 * 3 * 1.1 / args.dofs) ** (1 / 3)
    mesh, tags = uem.read_gmsh(
        common.MESHES / "stacked_blocks.geo", comm, gdim=dim, parameters={"dim": dim, "h": h, "fused": int(fused)}
    )
    u, F = elastic(mesh, dim)
    V = u.function_space
    bcs = [uem.dirichlet(V, tags[name], i) for name in ("bottom", "top") for i in range(dim - 1)]
    bcs += [uem.dirichlet(V, tags["bottom"], dim - 1), uem.dirichlet(V, tags["top"], dim - 1, -0.01)]
    contacts = [] if fused else [uem.Contact(contactor=tags["upper_bottom"], target=tags["lower_top"], coupling=args.coupling)]
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=contacts, petsc_options_prefix="cg_", petsc_options=common.cg(amg, 1e-8), rtol=1e-6
    )
    solves = [i.linear_iterations / (1 + i.exchanges) for i in problem.solve() if i.linear_iterations]
    return round(sum(solves) / len(solves)), dim * V.dofmap.index_map.size_global


def compare(dim: int, amg: str) -> dict[str, object]:
    """Contact against fused."""
    (contact, dofs), (fused, _) = cg_iterations(dim, amg, False), cg_iterations(dim, amg, True)
    return {"dim": dim, "amg": amg, "dofs": dofs, "contact": contact, "fused": fused, "ratio": contact / fused}


# %%
common.report(args, {"share": [share(dim) for dim in (2, 3)], "cg": [compare(dim, amg) for dim in (2, 3) for amg in AMG]})
