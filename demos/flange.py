"""Bolted flanges: tightened to a given force, locked, and pulled apart until the joint opens: the joint diagram in 3D, with friction.

python3 demos/flange.py --plot flange.png

Options:
    n: number of cells in every direction on the last mesh, as a multiple of those in the mesh file
    steps: load steps of the pull
    preload: force of a bolt in N
    pull: largest pull per bolt, over the preload
"""

# %% [markdown]
# # A bolted flange
#
# Two pipes with flanges, joined by four bolts: a quarter of them, with half of a bolt on either plane of symmetry. The flanges meet on
# pads around the holes, and head, nut and joint are in contact with friction. Meshes do not match anywhere.
#
# 1. Tightening: every bolt is cut at a section, whose opening is an unknown that carries the force F_0: `uem.Preload`.
# 2. Locked at the opening found, it is a spring among others, and the pipe is pulled by P per bolt.
#
# As long as nothing opens or slips, the structure is linear and the bolt carries
#
# $$
# F = F_0 + \varphi P
# $$
#
# with phi from one solve of the linear structure, in which all faces are tied. The joint itself carries F - P. Its pads are pulled
# eccentrically: they open from the pipe outwards, and then the bolt takes up ever more, as it is pried.

# %%
from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, n=1.0, refinements=2, steps=8, friction=0.2, coupling=("mortar", "node_to_surface"), preload=60e3, pull=0.8
)
E, nu = 2.1e5, 0.3  # MPa, lengths in mm
# half of a bolt on either plane
half = args.preload / 2

# %% [markdown]
# ## The scene
# The pipe's lower end is held along the axis, the upper one is pulled.


# %%
def make(n: float, tied: bool) -> tuple[uem.UnitedProblem, list[uem.Preload], fem.Constant]:
    """The structure on a mesh with n times the cells in every direction, its bolts and the pull; ``tied`` is the linear one."""
    mesh, tags = uem.read_gmsh(common.MESHES / "flange.geo", comm, gdim=3, parameters={"n": n})
    V = uem.function_space(mesh, 1, (3,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    pull = fem.Constant(mesh, 0.0)
    end = uem.ds(tags["pipe_top"])
    area = uem.integrate(fem.Constant(mesh, 1.0) * end)
    F = uem.LinearElastic(E, nu, kind="3d").residual(u, v) * ufl.dx - pull / area * v[2] * end
    bcs = [uem.dirichlet(V, tags[name], c) for c, name in enumerate(("plane_x", "plane_y", "pipe_bottom"))]
    how: dict[str, Any] = {"tied": True} if tied else {"friction": args.friction, "sliding": "small"}
    faces = {"head": ("under_head", "head_seat"), "nut": ("under_nut", "nut_seat"), "joint": ("upper_face", "lower_face")}
    contacts = [
        uem.Contact(tags[one], tags[other], coupling=args.coupling, name=name, **how) for name, (one, other) in faces.items()
    ]
    sections = [(tags[f"upper_section_{i}"], tags[f"lower_section_{i}"]) for i in (1, 2)]
    bolts = [uem.Preload(*section, axis=(0, 0, 1), force=half, coupling=args.coupling) for section in sections]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[*bolts, *contacts], petsc_options_prefix="flange_", verbose=args.verbose)
    return problem, bolts, pull


# %% [markdown]
# ## phi
# The linear structure, with bolts of their initial length.


# %%
def share(n: float) -> float:
    """Part of the pull that the bolts of the linear structure carry."""
    problem, bolts, pull = make(n, tied=True)
    for bolt in bolts:
        bolt.lock()
    pull.value = 2 * half
    problem.solve()
    return sum(bolt.carried for bolt in bolts) / (2 * half)


# %% [markdown]
# ## Tightened, locked and pulled
# All forces are per bolt. The joint is said to open at the load at which the bolt carries 2 % of F_0 more than the linear structure's.


# %%
def forces(problem: uem.UnitedProblem) -> dict[str, float]:
    """Forces along the axis in the bolts, under their heads and in the joint, over F_0, and the number of contactors of the joint."""
    *bolts, head, _, joint = problem.contacts
    found = {"bolt": sum(b.carried for b in bolts), "head": head.resultant().force[2], "joint": joint.resultant().force[2]}
    return {name: float(f / args.preload) for name, f in found.items()} | {"touching": joint.n_active}


def joint_diagram(n: float) -> tuple[uem.UnitedProblem, dict[str, Any]]:
    """The structure in its last state, and the results."""
    phi = share(n)
    problem, bolts, pull = make(n, tied=False)
    problem.solve()
    rows = [{"load": 0.0, **forces(problem)}]
    halves = [bolt.carried / half for bolt in bolts]
    for bolt in bolts:
        bolt.lock()
    problem.load = {pull: args.pull * args.preload}
    for step in uem.load_steps(problem, args.steps):
        rows.append({"load": step.factor * args.pull, **forces(problem)})
    load, bolt, touching = (np.array([row[name] for row in rows]) for name in ("load", "bolt", "touching"))
    closed, over = touching == touching[0], bolt - 1 - phi * load - 0.02
    k = int(np.argmax(over > 0))
    figures = {
        "phi": phi,
        "preload_error": max(abs(f - 1) for f in [*halves, *(rows[0][name] for name in ("bolt", "head", "joint"))]),
        "joint_diagram_error": float(np.abs(bolt / (1 + phi * load) - 1)[closed].max()),
        "opening_load": float(np.interp(0.0, over[k - 1 : k + 1], load[k - 1 : k + 1])) if k else float("nan"),
        "shortening": -sum(b.opening for b in bolts) / 2,
        "unknowns": 3 * problem.u.function_space.dofmap.index_map.size_global,
    }
    return problem, figures | {"steps": rows}


meshes = []
for k in reversed(range(args.refinements)):
    problem, found = joint_diagram(args.n / 2**k)
    steps = found.pop("steps")
    meshes.append(found)
common.report(args, {**meshes[-1], "steps": steps, "meshes": meshes})

# %% [markdown]
# ## The picture
# Axial stress over the bolts' mean one, with displacements 30 times as large.

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/flange", problem) as writer:
        writer.write(1.0)
if args.plot:
    load, bolt, joint = (np.array([row[name] for row in steps]) for name in ("load", "bolt", "joint"))
    axial = uem.LinearElastic(E, nu, kind="3d").stress(problem.u)[2, 2] / (args.preload / (np.pi * 8.0**2))
    solid = common.draws_3d()
    with uem.figure(args.plot, comm, panels=2 if solid else 1) as (*scene, panel):
        if solid:
            uem.plot_scene(
                problem, scene[0], field=axial, label="axial stress / bolt's preload", levels=np.linspace(-1.8, 1.8, 19),
                cmap="RdBu_r", scale=30.0, view=(-1.0, -0.8, 0.55),
            )  # fmt: skip
        if panel is not None:
            panel.plot(load, bolt, "o-", ms=4, label="bolt")
            panel.plot(load, joint, "s-", ms=4, label="joint")
            panel.plot(load, 1 + found["phi"] * load, "k--", lw=0.8, label="linear: 1 + phi P")
            panel.plot(load, 1 + (found["phi"] - 1) * load, "k:", lw=0.8, label="linear: joint")
            panel.set(xlabel="pull per bolt / preload", ylabel="force / preload")
            panel.grid(alpha=0.25)
            panel.legend(frameon=False)

# %%
assert meshes[-1]["preload_error"] < 1e-8
assert meshes[-1]["joint_diagram_error"] < 0.02
