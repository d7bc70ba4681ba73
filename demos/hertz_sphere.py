"""Hertzian contact of two elastic bodies in 3D: a half sphere pressed onto a block, CG with algebraic multigrid.

mpirun -n 2 python3 demos/hertz_sphere.py --plot sphere.png

Options:
    h: size of the cells in the contact zone, on the finest mesh
    d: displacement of the half sphere's flat top, downwards
"""

# %% [markdown]
# # A half sphere on a block
#
# A half sphere of radius R = 1 is pressed by d into a block of the same material. A quarter of both is modelled with tetrahedra;
# the flat top of the half sphere moves down by d, the block's bottom stays at its height. Hertz, for half-spaces that approach
# each other by d, has
#
# $$
# a = \sqrt{R d}, \qquad F = \frac{4}{3} E^* \sqrt{R}\, d^{3/2}, \qquad p_0 = \frac{3 F}{2 \pi a^2},
# \qquad \frac{1}{E^*} = \frac{2 (1 - \nu^2)}{E}.
# $$
#
# The displacements around a contact fade like 1/r only, so a finite body is stiffer than a half-space, by a part of the order of
# a/R. The sphere here is 200 contact radii large, which leaves about 0.3 % of it in the force; the error of the mesh is larger, and
# falls as the mesh is refined. Graded meshes make such a range of sizes cheap. With `--coupling mortar` the equations come from the
# whole facets of both bodies, so that pressures do not scatter where nodes and facets lie against each other by chance.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, h=0.0005, ratio=1.0, coupling=("node_to_surface", "mortar"), normals=("facet", "averaged"), degree=1, steps=1,
    d=2.5e-5, refinements=3,
)  # fmt: skip
E, nu, R = 1e6, 0.3, 1.0
E_star, a = E / (2 * (1 - nu**2)), np.sqrt(R * args.d)
material = uem.LinearElastic(E, nu)
F_hertz = 4 / 3 * E_star * np.sqrt(R) * args.d**1.5


# %% [markdown]
# ## One scene
# `h` is the size of the cells under the contact; with the distance from there they grow in proportion.


# %%
def solve(h: float, coupling: str = args.coupling) -> tuple[uem.UnitedProblem, dict[str, float]]:
    """Press the bodies together on a mesh of size h: the problem and the figures measured."""
    mesh, tags = uem.read_gmsh(
        common.MESHES / "hertz_sphere.geo", comm, gdim=3,
        parameters={"h": h, "ratio": args.ratio, "R": R, "W": 2 * R, "zone": 1.4 * a, "growth": 0.8 / a,
                    "order": args.degree},
    )  # fmt: skip
    V = uem.function_space(mesh, args.degree, (3,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    residual = material.residual(u, v) * ufl.dx
    bcs = [
        uem.dirichlet(V, tags["symmetry_x"], 0),
        uem.dirichlet(V, tags["symmetry_y"], 1),
        uem.dirichlet(V, tags["block_bottom"], 2),
        uem.dirichlet(V, tags["sphere_top"], 2, -args.d),
    ]
    contact = uem.Contact(
        contactor=tags["sphere_cap"], target=tags["block_top"], coupling=coupling, normals=args.normals, name=coupling
    )
    problem = uem.UnitedProblem(
        residual, u, bcs=bcs, contacts=[contact], petsc_options_prefix="sphere_", petsc_options=common.cg(), verbose=args.verbose
    )
    start = time.perf_counter()
    steps = list(uem.load_steps(problem, args.steps))
    seconds = time.perf_counter() - start

    P = float(4 * contact.resultant().force[2])
    cap, balance = uem.ds(tags["sphere_cap"]), contact.balance()
    area = 4 * uem.integrate(contact.active * cap)
    return problem, {
        "h": h,
        "P": P,
        "error": P / F_hertz - 1,
        "a": float(np.sqrt(area / np.pi)),
        "p0_hertz": float(1.5 * P / (np.pi * a**2)),
        "p_max": contact.max_pressure(),
        "newton_iterations": sum(step.newton_iterations for step in steps),
        "exchanges": sum(step.exchanges for step in steps),
        "linear_iterations": sum(i.linear_iterations for step in steps for i in step.iterations),
        "steps": len(steps),
        "max_gap": contact.max_gap(),
        "force_imbalance": max(balance.force, balance.moment),
        "order": common.order(steps[-1]),
        "active": contact.n_active,
        "dofs": 3 * V.dofmap.index_map.size_global,
        "seconds": seconds,
    }


# %% [markdown]
# ## Three meshes
# The last one has the chosen size, each of the others twice the size of the next.

# %%
rows = []
for k in reversed(range(args.refinements)):
    problem, figures = solve(args.h * 2**k)
    rows.append(figures)
common.report(args, {"P_hertz": float(F_hertz), "a_hertz": float(a), **rows[-1], "meshes": rows})

# %% [markdown]
# ## The picture
# Pressures of both couplings, and the stress over p0 in the quarter, cut open around the contact.

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/hertz_sphere", problem) as writer:
        writer.write(1.0)
if args.plot:
    p0 = 1.5 * F_hertz / (np.pi * a**2)
    s = ufl.dev(material.stress(problem.u))
    von_mises = ufl.sqrt(1.5 * ufl.inner(s, s))
    solid = common.draws_3d()
    with uem.figure(args.plot, comm, panels=3 if solid else 2) as (*scene, right, left):
        if left is not None:
            cells, percent = [a / r["h"] for r in rows], [100 * abs(r["error"]) for r in rows]
            left.loglog(cells, percent, "o-")
            left.set_xticks(cells, [f"{n:g}" for n in cells])
            left.set_yticks(percent, [f"{e:.2g} %" for e in percent])
            left.minorticks_off()
            left.set_xlabel("cells over the contact radius")
            left.set_ylabel("error of the force")
            left.grid(alpha=0.25)
        other = solve(args.h, "mortar" if args.coupling == "node_to_surface" else "node_to_surface")[0]
        uem.plot_pressure([*problem.contacts, *other.contacts], right, window=(0.0, 1.3 * a), reference_label="Hertz",
                          reference=lambda r: p0 * np.sqrt(np.maximum(1 - (r / a) ** 2, 0)))  # fmt: skip
        if right is not None:
            # above the curves
            right.set_ylim(top=1.45 * p0)
            right.legend(frameon=False, loc="upper right")
        if solid:
            box = a * np.array([0.0, 1.6, 0.0, 1.6, -1.2, 1.2])
            uem.plot_scene(problem, scene[0], field=von_mises / p0, label="von Mises stress / p0", window=box, levels=8,
                           cells=False, view=(-1.0, -1.2, 0.5))  # fmt: skip

# %%
errors = [abs(r["error"]) for r in rows]
assert all(finer < coarser for coarser, finer in zip(errors, errors[1:])), errors
