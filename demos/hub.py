"""Hub on a shaft: a press fit by an offset, a torque until it slips, and the contact released, in three steps of one problem.

python3 demos/hub.py --plot hub.png

Options:
    n_shaft: cells around the shaft, a multiple of 4
    n_hub: cells around the hub, a multiple of 4
    layers: cells through the shaft's wall; the hub has twice as many
    steps: load steps of the torque
"""

# %% [markdown]
# # A hub on a shaft
#
# A hollow shaft of radii a and b in a hub of radii b and c, meshed with the same radius at the seat: the interference is a number,
# `offset`, by which both surfaces together are thicker than in the mesh. So one mesh serves for every fit. What the meshes, which do not
# match, leave between them is less than a thousandth of it, and `adjust` takes it away.
#
# 1. The fit: the offset grows to delta. The shaft's hole and the hub's outside are held, and with Lamé's displacements
#    u = A r + B / r of both rings the pressure p follows from u_hub - u_shaft = delta at the seat.
# 2. The torque: the shaft's hole is turned. Friction carries T = mu p (2 pi b) b at most, per unit of thickness; from there on the
#    seat slips.
# 3. The release: the contact is switched off. Its pressure and torque decrease to zero in proportion, and nothing is left.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n_shaft=48, n_hub=40, layers=4, degree=2, coupling=("mortar", "node_to_surface"), steps=6)
a, b, c, delta, mu = 10.0, 20.0, 40.0, 0.02, 0.15  # mm
E, nu = 2.1e5, 0.3  # MPa

# %% [markdown]
# ## Lamé's pressure
# In plane strain, with lam and G: the radial stress of u = A r + B / r is 2 (lam + G) A - 2 G B / r^2. Unknown are A and B of the
# shaft, A and B of the hub, and p.

# %%
lam, G = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu)


def radial(r):
    """Radial stress over A and B."""
    return [2 * (lam + G), -2 * G / r**2]


equations = np.array([
    [a, 1 / a, 0, 0, 0],
    [*radial(b), 0, 0, 1],
    [0, 0, *radial(b), 1],
    [0, 0, c, 1 / c, 0],
    [-b, -1 / b, b, 1 / b, 0],
])  # fmt: skip
p = float(np.linalg.solve(equations, [0, 0, 0, 0, delta])[-1])
most = mu * p * 2 * np.pi * b**2

# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(
    common.MESHES / "hub.geo", comm, gdim=2,
    parameters={"a": a, "b": b, "c": c, "n_shaft": args.n_shaft, "n_hub": args.n_hub, "layers": args.layers, "order": args.degree},
)  # fmt: skip
V = uem.function_space(mesh, args.degree, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, nu, kind="plane_strain")
turned = fem.Function(V)
outside, hole = uem.dirichlet(V, tags["outside"]), uem.dirichlet(V, tags["hole"])
turn = fem.dirichletbc(turned, fem.locate_dofs_topological(V, 1, tags["hole"].entities))
contact = uem.Contact(tags["seat"], tags["bore"], coupling=args.coupling, sliding="small", friction=mu, adjust=True, name="fit")
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx,
    u,
    bcs=[outside, hole],
    contacts=[contact],
    petsc_options_prefix="hub_",
    verbose=args.verbose,
)


def mean_pressure() -> float:
    """Of the seat: the sum of the radial forces over its length."""
    x, f = contact.points, contact.force.x.array.reshape(-1, 2)[contact.nodes]
    return -float(comm.allreduce(np.einsum("ng,ng->", x, f) / b)) / (2 * np.pi * b)


# %% [markdown]
# ## The steps
# The hole turns by 1.5 times the angle at which the fit slips. In each step offsets, prescribed displacements and what is released follow
# the step's load factor; `step.time` counts on from step to step.

# %%
# angle over torque of a ring between two radii
compliance = (1 / a**2 - 1 / c**2) / (4 * np.pi * G)
angle = 1.5 * most * compliance
turned.interpolate(lambda x: angle * np.stack([-x[1], x[0]]))
steps = [
    uem.Step("fit", 2, offset={contact: delta}),
    uem.Step("torque", args.steps, bcs=[outside, turn]),
    uem.Step("release", 2, contacts={contact: False}),
]
x = ufl.SpatialCoordinate(mesh)
stress, around = material.stress(u) / p, ufl.as_vector((-x[1], x[0]))
# the torque through the hub, in the mean over its radii, and the mean square of the stress
torque = fem.form(p / most / (c - b) * ufl.dot(around, stress * x) / ufl.sqrt(ufl.dot(x, x)) * uem.dx(tags["hub"]))
square = fem.form(ufl.inner(stress, stress) * ufl.dx)
rows, writer = [], uem.ResultsWriter(f"{args.output}/hub", problem) if args.output else None
with uem.figure(args.plot, comm, panels=2) as (left, right):
    for step in uem.load_steps(problem, steps):
        s, slipping = step.factor, contact.status.x.array[contact.nodes] == 2
        rows.append({
            "step": step.step, "time": step.time, "pressure": mean_pressure() / p, "torque": abs(uem.integrate(torque)),
            "elastic": {"fit": 0.0, "torque": min(1.5 * s, 1.0), "release": 1.0 - s}[step.step],
            "slipping": int(comm.allreduce(int(slipping.sum()))), "stress": float(np.sqrt(uem.integrate(square) / (c**2 - a**2))),
            "newton": step.newton_iterations,
        })  # fmt: skip
        if writer:
            writer.write(step)
        if step.time == 2.0:
            carried = abs(float(contact.resultant().moment[0])) / most
            shear = ufl.dot(around, stress * x) / ufl.dot(x, x)
            if args.plot:
                uem.plot_scene(
                    problem, left, field=shear, label="shear stress / p", levels=np.linspace(-0.5, 0.1, 13), arrows=False
                )
    if right is not None:
        time = [0.0, *(r["time"] for r in rows)]
        for what, scale, label in (
            ("stress", rows[1]["stress"], "stress / that of the fit"),
            ("torque", 1.0, "torque / (2 pi mu p b^2)"),
        ):
            right.plot(time, [0.0, *(r[what] / scale for r in rows)], "o-", ms=4, label=label)
        right.plot([1, 1 + 1 / 1.5, 2, 3], [0, 1, 1, 0], "k--", lw=0.8, label="in closed form")
        right.set(xlabel="time: fit, torque, release")
        right.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.6, 0.1))
if writer:
    writer.close()

# %%
*_, last = (r for r in rows if r["step"] == "torque")
results = {
    "pressure_lame": p,
    "fit_error": abs(rows[1]["pressure"] - 1),
    "torque_error": abs(carried - 1),
    "release_error": max(abs(r["torque"] - r["elastic"] * last["torque"]) for r in rows if r["step"] == "release"),
    "stress_left": rows[-1]["stress"],
    "steps": rows,
}
common.report(args, results)
assert max(results["fit_error"], results["torque_error"]) < 0.005
assert max(results["release_error"], results["stress_left"]) < 1e-9
