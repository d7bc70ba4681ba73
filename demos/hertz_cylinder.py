"""Hertzian contact of two elastic bodies: a cylinder pressed onto a block, plane strain.

python3 demos/hertz_cylinder.py --plot hertz.png

Options:
    tangent: tangent with the curvature of the contact, or without
    chords: 1: P is built with the chords of curved target facets
"""

# %% [markdown]
# # A cylinder on a block
#
# A quarter disc of radius R = 3 rests on a block of the same material. Its top is pushed down by 0.006 in five steps; the block's bottom
# slides on rollers and x = 0 is a plane of symmetry. Half-spaces under the line load P would, after Hertz, touch over the half width a
# and press each other with
#
# $$
# p(x) = p_0 \sqrt{1 - \frac{x^2}{a^2}}, \qquad p_0 = \sqrt{\frac{P E^*}{\pi R}}, \qquad a = \frac{2 P}{\pi p_0},
# \qquad \frac{1}{E^*} = \frac{2 (1 - \nu^2)}{E}.
# $$
#
# The bodies are finite, so P comes from the computation, and the pressure is compared with Hertz at that P.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__,
    h=1 / 120,
    ratio=1.0,
    coupling=("node_to_surface", "mortar"),
    normals=("facet", "averaged"),
    degree=1,
    steps=5,
    quads=0,
    tangent=("consistent", "without_contact"),
    chords=0,
)

# %% [markdown]
# ## The scene
# Bodies, surfaces and boundary conditions go by the names of their physical groups in the Gmsh file.

# %%
E, nu, R = 1e6, 0.3, 3.0
mesh, tags = uem.read_gmsh(
    common.MESHES / "hertz_cylinder.geo", comm, gdim=2,
    parameters={"h": args.h, "ratio": args.ratio, "quads": args.quads, "order": args.degree},
)  # fmt: skip
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, nu, kind="plane_strain")
F = material.residual(u, v) * ufl.dx
bcs = [
    uem.dirichlet(V, tags["symmetry"], 0),
    uem.dirichlet(V, tags["block_bottom"], 1),
    uem.dirichlet(V, tags["disc_top"], 1, -0.006),
]
contact = uem.Contact(
    contactor=tags["disc_arc"], target=tags["block_top"], coupling=args.coupling, normals=args.normals, chords=bool(args.chords)
)

# %% [markdown]
# ## The solution
# Every contactor that presses is united to the block's surface, `du = P dq + c`, and Newton's method runs on the united body.

# %%
start = time.perf_counter()
problem = uem.UnitedProblem(
    F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="hertz_", consistent_tangent=args.tangent == "consistent",
    verbose=args.verbose,
)  # fmt: skip
writer = uem.ResultsWriter(f"{args.output}/hertz_cylinder", problem) if args.output else None
steps = []
for step in uem.load_steps(problem, args.steps):
    steps.append(step)
    if writer:
        writer.write(step)
if writer:
    writer.close()
seconds = time.perf_counter() - start

# %% [markdown]
# ## The figures
# Both halves together carry P. The half width is the length of surface that belongs to active contactors, which is exact to
# half a cell. The scatter is the rms deviation of nodal pressures from Hertz, relative to p0, within 0.95 a: on meshes that
# do not match, as with `--ratio 1.3`, it is large and stays with node_to_surface, and is small with mortar.

# %%
P = 2 * contact.resultant().force[1]
E_star = E / (2 * (1 - nu**2))
p0 = np.sqrt(P * E_star / (np.pi * R))
a = 2 * P / (np.pi * p0)
arc = uem.ds(tags["disc_arc"])
x, pressure = (np.concatenate(comm.allgather(part)) for part in (contact.points[:, 0], contact.pressures))
inside = x < 0.95 * a
scatter = np.sqrt(np.mean((pressure[inside] / p0 - np.sqrt(1 - (x[inside] / a) ** 2)) ** 2))
balance = contact.balance()
results = {
    "P": float(P),
    "a": uem.integrate(contact.active * arc),
    "a_hertz": float(a),
    "p0_hertz": float(p0),
    "p_max": contact.max_pressure(),
    "p_max / p0_hertz": contact.max_pressure() / float(p0),
    "pressure_scatter": float(scatter),
    "newton_iterations": sum(step.newton_iterations for step in steps),
    "exchanges": sum(step.exchanges for step in steps),
    "steps": len(steps),
    "max_gap": contact.max_gap(),
    "model_size": float(np.hypot(6, 9)),
    "force_imbalance": max(balance.force, balance.moment),
    "residuals": [iteration.residual for iteration in steps[-1].iterations],
    "active": contact.n_active,
    "dofs": 2 * V.dofmap.index_map.size_global,
    "seconds": seconds,
}

# %% [markdown]
# ## The order of convergence
# The load steps end after two or three iterations, at rounding, too soon to see an order. So the solution is disturbed by a wave
# along the contact, once of height 0.00001 a and once of half of it: the first residual on the way back shrinks with the power
# that is the order: 2 with the consistent tangent, 1 without, as long as no contactor changes facets on the way.

# %%
solution, x = u.x.array.copy(), V.tabulate_dof_coordinates()[: len(u.x.array) // 2, :2] / results["a_hertz"]
wave = np.exp(-(x**2).sum(axis=1)) * np.sin(6 * x[:, 0])
after = []
for height in (1e-5, 0.5e-5):
    u.x.array[:] = solution
    u.x.array[1::2] += height * results["a_hertz"] * wave
    after.append(problem.solve()[1].residual)
results["order"] = float(np.log2(after[0] / after[1]))
common.report(args, results)

# %% [markdown]
# ## The picture
# Lines of equal shear stress, as photoelasticity shows them: the largest is 0.30 p0, at the depth 0.79 a.

# %%
if args.plot:
    s = material.stress(u)
    shear = ufl.sqrt((s[0, 0] - s[1, 1]) ** 2 / 4 + s[0, 1] ** 2) / p0
    with uem.figure(args.plot, comm, panels=2) as (left, right):
        uem.plot_scene(
            problem, left, field=shear, label="largest shear stress / $p_0$", levels=np.linspace(0.0, 0.3, 13),
            window=(-2.2 * a, 2.2 * a, -2.4 * a, 1.6 * a), mirror=True,
        )  # fmt: skip
        uem.plot_pressure(
            contact, right, mirror=True, reference=lambda x: p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0)),
            reference_label="Hertz",
        )  # fmt: skip

# %%
if args.h <= 1 / 120 and args.ratio == 1:
    assert abs(results["p_max / p0_hertz"] - 1) < 0.01
