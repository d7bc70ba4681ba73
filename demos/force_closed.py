"""Contact closed by a force: a half disc falls onto a block under nothing but its weight, plane strain.

python3 demos/force_closed.py --plot force_closed.png

Options:
    gap: initial gap between the bodies
    weight: weight of the half disc per unit thickness
"""

# %% [markdown]
# # Held by its weight
#
# Half a disc of radius R = 3, round side down, is a little above a block that is clamped at its bottom. No Dirichlet condition
# holds the half disc: without contact its stiffness is singular, and its weight has nothing to lean on. It has to come down over
# the gap as a rigid body, and then presses on the block with exactly its weight P. It stays upright since its
# centre of gravity lies below the centre of its arc.
#
# Half-spaces under the line load P would touch over the half width a and press each other with at most p0, after Hertz:
#
# $$
# p_0 = \sqrt{\frac{P E^*}{\pi R}}, \qquad a = \frac{2 P}{\pi p_0}, \qquad \frac{1}{E^*} = \frac{2 (1 - \nu^2)}{E}.
# $$
#
# Only the slopes of the facets determine where along the block it comes to rest. With either coupling, `node_to_surface` or `--coupling
# mortar`, P is the weight.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, h=1 / 60, ratio=1.5, gap=0.05, weight=1000.0, steps=1, degree=1, coupling=("node_to_surface", "mortar"),
    normals=("facet", "averaged")
)  # fmt: skip
E, nu, R, W = 1e6, 0.3, 3.0, 6.0

# %% [markdown]
# ## The scene
# The weight is a body force in the half disc alone.

# %%
mesh, tags = uem.read_gmsh(
    common.MESHES / "force_closed.geo", comm, gdim=2,
    parameters={"h": args.h, "ratio": args.ratio, "gap": args.gap, "R": R, "W": W, "order": args.degree},
)  # fmt: skip
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, nu, kind="plane_strain")
inside = fem.Function(uem.function_space(mesh, ("DG", 0)), name="inside")
inside.x.array[tags["disc"].entities] = 1.0
load = fem.Constant(mesh, 0.0)
density = args.weight / (np.pi * R**2 / 2) * inside
F = material.residual(u, v) * ufl.dx + load * density * v[1] * ufl.dx
bcs = [uem.dirichlet(V, tags["block_bottom"])]
contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], coupling=args.coupling, normals=args.normals)

# %% [markdown]
# ## The solution

# %%
problem = uem.UnitedProblem(
    F, u, bcs=bcs, contacts=[contact], load=load, petsc_options_prefix="weight_", verbose=args.verbose
)  # fmt: skip
steps = list(uem.load_steps(problem, args.steps))

# %% [markdown]
# ## The figures
# The weight is that of the mesh, whose arc is a polygon.

# %%
weight = uem.integrate(density * ufl.dx)
P = contact.resultant().force
p0 = np.sqrt(P[1] * E / (2 * (1 - nu**2)) / (np.pi * R))
results = {
    "weight": float(weight),
    "P": float(P[1]),
    "P_horizontal": float(P[0]),
    "force_error": float(np.hypot(P[0], P[1] - weight) / weight),
    "gap_error": contact.max_gap() / problem.config.size,
    "p0_hertz": float(p0),
    "p_max": contact.max_pressure(),
    "p_max / p0_hertz": contact.max_pressure() / float(p0),
    "newton_iterations": sum(step.newton_iterations for step in steps),
    "exchanges": sum(step.exchanges for step in steps),
    "steps": len(steps),
    "active": contact.n_active,
    "dofs": 2 * V.dofmap.index_map.size_global,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Lines of equal shear stress at the contact, and the contact pressures of both couplings, of which the other one is solved for here.

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/force_closed", problem) as writer:
        writer.write(steps[-1])
if args.plot:
    a = float(2 * P[1] / (np.pi * p0))
    s = material.stress(u)
    shear = ufl.sqrt((s[0, 0] - s[1, 1]) ** 2 / 4 + s[0, 1] ** 2) / p0
    with uem.figure(args.plot, comm, panels=2) as (left, right):
        uem.plot_scene(
            problem, left, field=shear, label="largest shear stress / $p_0$", levels=np.linspace(0.0, 0.3, 13),
            window=(-2.2 * a, 2.2 * a, -2.4 * a, 1.6 * a),
        )  # fmt: skip
        window = (-1.5 * a, 1.5 * a)
        uem.plot_pressure(
            contact, right, reference=lambda x: p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0)), reference_label="Hertz",
            contact_label=args.coupling, window=window,
        )  # fmt: skip
        u.x.array[:] = 0.0
        name = "mortar" if args.coupling == "node_to_surface" else "node_to_surface"
        other = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], coupling=name, normals=args.normals)
        for _ in uem.load_steps(
            uem.UnitedProblem(F, u, bcs=bcs, contacts=[other], load=load, petsc_options_prefix="other_"), args.steps
        ):
            pass
        uem.plot_pressure(other, right, contact_label=name, window=window)

# %%
assert results["force_error"] < 1e-8
