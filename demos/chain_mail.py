"""Four links of a chain hang in each other: each carries the weight of those below it, found at rest in statics by one declaration.

python3 demos/chain_mail.py --plot chain.png

Options:
    links: number of links
    h: size of the cells relative to the radius of a link
    gap: between one link and the next before they fall
    drag: of the medium at first, in parts of the weight over the radius
"""

# %% [markdown]
# # A chain
#
# Rings of radius R hang in each other, each turned by 90 degrees from the one above. The first is held at its top, the others fall by a
# small gap until they hang. Wherever they touch, at rest
#
#     link k carries the weight of the links below it,    f(k) = w (n - k).
#
# A link that hangs in another one touches it with one or two nodes. It swings about them like a pendulum, and turns about the vertical:
# the first motion is resisted by no contact, but by the weight, to second order, the other by nothing at all. Rigid motions along the
# loads, by which bodies otherwise come to rest in statics, would roll it from facet to facet for ever. Instead each step starts from the
# previous one, u_old, in a medium with the drag
#
#     c (u - u_old)   per unit of volume,    c -> 0,
#
# which holds all links. In the end they do not move any more, and then there is no drag: the result is a static equilibrium.
# With friction the links do not slip where they touch.

# %%
from collections.abc import Iterator

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, links=4, h=0.2, gap=0.02, friction=0.5, normals=("averaged", "facet"), E=1e4, nu=0.3, drag=40.0)
R, weight = 1.0, 1.0  # per unit of volume

# %% [markdown]
# ## The scene

# %%
sizes = {"links": args.links, "R": R, "h": args.h * R, "gap": args.gap}
mesh, tags = uem.read_gmsh(common.MESHES / "chain_mail.geo", comm, gdim=3, parameters=sizes)
links = {f"link {k}": tags[f"link {k}"] for k in range(1, args.links + 1)}
V = uem.function_space(mesh, 1, (3,))
u, v, u_old = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
c = fem.Constant(mesh, args.drag)
material = uem.StVenantKirchhoff(args.E, args.nu)
F = (material.residual(u, v) + weight * v[2] + c * ufl.inner(u - u_old, v)) * ufl.dx
contact = uem.GeneralContact(bodies=links, friction=args.friction, normals=args.normals)
problem = uem.UnitedProblem(
    F, u, bcs=[uem.dirichlet(V, tags["held"], i) for i in range(3)], contacts=[contact], rtol=1e-9,
    petsc_options=common.direct(), petsc_options_prefix="chain_", verbose=args.verbose,
)  # fmt: skip

# %% [markdown]
# ## To rest
# A step that fails, since it is too large, is taken again with four times the drag; after others the drag falls to a third.

# %%
rows = []


def to_rest() -> Iterator[float]:
    """Steps until nothing moves."""
    for _ in range(40):
        try:
            iterations = len(problem.solve()) - 1
        except uem.ConvergenceError:
            c.value *= 4.0
            continue
        way = float(comm.allreduce(np.abs(u.x.array - u_old.x.array).max(), op=common.MPI.MAX))
        drag = uem.integrate(c * (u[2] - u_old[2]) * ufl.dx)
        rows.append({"step": len(rows) + 1, "c": float(c.value), "way": way, "drag": abs(drag), "iterations": iterations})
        u_old.x.array[:] = u.x.array
        c.value *= 0.3
        yield float(len(rows))
        if way == 0.0:
            return


steps: Iterator[float] = to_rest()
writer = None
if args.output:
    writer = uem.ResultsWriter(f"{args.output}/chain_mail", problem)
    if common.draws_3d():
        steps = uem.animate(
            f"{args.output}/chain_mail.gif", problem, steps, cells=False, view=(1.0, -0.6, 0.3), frames_per_second=4
        )
for step in steps:
    if writer is not None:
        writer.write(step)
if writer is not None:
    writer.close()

# %% [markdown]
# ## What each link carries
# In parts of the weight of one link.

# %%
weights = [weight * uem.integrate(fem.Constant(mesh, 1.0) * uem.dx(link)) for link in links.values()]
touching = {(touch.first, touch.second): touch.n_active for touch in contact.touching()}
forces = []
for k in range(1, args.links):
    first, second, below = f"link {k}", f"link {k + 1}", sum(weights[k:])
    force = contact.between(first, second).force
    forces.append({
        "link": k,
        "carries": float(-force[2] / weights[0]),
        "error": float(abs(-force[2] / below - 1)),
        "sideways": float(np.abs(force[:2]).max() / below),
        "contactors": touching[first, second],
    })  # fmt: skip
results = {
    "links": forces,
    "link_error": max(row["error"] for row in forces),
    "drag_left": rows[-1]["drag"] / sum(weights),
    "newton_iterations": sum(row["iterations"] for row in rows),
    "dofs": 3 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
    "steps": rows,
}
common.report(args, results)

# %%
if args.plot and common.draws_3d():
    s = ufl.dev(material.stress(u))
    uem.plot_scene(
        problem,
        args.plot,
        field=ufl.sqrt(1.5 * ufl.inner(s, s)),
        label="von Mises stress",
        levels=8,
        percentiles=(0, 99),
        triad=False,
        view=(1.0, -0.6, 0.3),
    )

# %%
assert results["link_error"] < 1e-8, results
