"""A block on a rough base: driven, pushed, on an incline, and thrown along it until it stops; rigid and deformable base.

python3 demos/sliding_block.py --plot sliding_block.png

Options:
    n: cells along the block's height, an even number
    steps: time steps in which the thrown block comes to rest
"""

# %% [markdown]
# # Sliding block
#
# A block of unit weight lies on a base with Coulomb's friction. It slips where the friction force H reaches mu times the normal
# force N, and not before:
#
# - *driven* by its tail it sticks first, then slips from the tail to the front, and at last everywhere: H = mu N, and from there on
#   friction takes the energy H d over a way d;
# - *pushed* by a force it stays up to mu N, to either side; on an *incline* it stays up to tan(alpha) = mu. Weight, push and friction are
#   in balance. Beyond, there is no equilibrium, and a `FrictionError` is raised;
# - *thrown* with the velocity v it stops after the way v^2 / (2 mu g).
#
# No contactor that sticks moves along the base: stick is exact, without penalty.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=8, E=200.0, steps=200)
length, height, nu = 2.0, 0.5, 0.3
v0, g = 5.0, 10.0
near = 1e-6  # pushes so near to the threshold are to hold below it, and to be refused above


# %% [markdown]
# ## The scene
# Gravity turns with the incline. The bodies are linear, so the deformable base keeps its reference normals.


# %%
def scene(mu: float, rigid: bool, driven: bool = False, E: float = args.E, density: float = 0.0):
    """Block on its base: problem, contact, force on the block, place of its tail, stored energy."""
    parameters = {"n": args.n, "length": length, "height": height, "base": int(not rigid)}
    mesh, tags = uem.read_gmsh(common.MESHES / "sliding_block.geo", comm, gdim=2, parameters=parameters)
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    block = fem.Function(uem.function_space(mesh, ("DG", 0)))
    block.x.array[tags["block"].entities] = 1 / (length * height)
    material = uem.LinearElastic(E, nu, kind="plane_strain")
    force, tail = fem.Constant(mesh, np.zeros(2)), fem.Constant(mesh, 0.0)
    bcs = [uem.dirichlet(V, tags["block_tail"], 0, tail)] if driven else []
    bcs += [] if rigid else [uem.dirichlet(V, tags["base_bottom"])]
    target = uem.RigidPlane((0.0, 0.0), (0.0, 1.0)) if rigid else tags["base_top"]
    contact = uem.Contact(tags["block_bottom"], target, friction=mu, sliding="finite" if rigid else "fixed")
    F = material.residual(u, v) * ufl.dx - block * ufl.dot(force, v) * ufl.dx
    dynamics = None
    if density:
        damping = lambda velocity: 0.005 * material.residual(velocity, v) * ufl.dx  # noqa: E731
        dynamics = uem.Dynamics(uem.lumped_mass(V, density), velocity=(v0, 0.0), damping=damping)
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], dynamics=dynamics, rtol=1e-12, petsc_options_prefix="block_", verbose=args.verbose
    )
    return problem, contact, force, tail, tags


# %% [markdown]
# ## Driven, pushed, and on an incline


# %%
def drive(mu: float, rigid: bool):
    """Ways of the tail, friction over mu N, parts of the surface that stick; largest slip that sticks; what friction took in the end."""
    problem, contact, force, tail, tags = scene(mu, rigid, driven=True)
    bottom = uem.ds(tags["block_bottom"])
    force.value[:] = 0.0, -1.0
    rows = []
    writer = uem.ResultsWriter(f"{args.output}/block_{mu}_{'rigid' if rigid else 'elastic'}", problem) if args.output else None
    for way in np.linspace(0.0, 0.03, 16):
        tail.value, last = way, contact.dissipation
        for step in uem.load_steps(problem):
            if writer:
                writer.write(step)
        f = contact.resultant().force
        sticks = uem.integrate(ufl.conditional(ufl.lt(abs(contact.status - 1), 0.5), 1.0, 0.0) * bottom)
        rows.append((way, -f[0] / (mu * f[1]), sticks / length))
    if writer:
        writer.close()
    return np.array(rows), (contact.dissipation - last) / (mu * 0.002) - 1, problem


def push(mu: float, rigid: bool, incline: bool):
    """Largest imbalance of weight, push and friction up to the threshold, and whether more is refused by name."""
    problem, contact, force, *_ = scene(mu, rigid)
    worst = 0.0
    for part in (0.0, 0.5, 0.9, 1 - near, near - 1, 1 + near):
        alpha = np.arctan(part * mu)
        force.value[:] = (np.sin(alpha), -np.cos(alpha)) if incline else (part * mu, -1.0)
        try:
            problem.solve()
        except uem.FrictionError:
            return worst, part > 1
        worst = max(worst, float(np.abs(contact.resultant().force + force.value).max()))
    return worst, False


# %% [markdown]
# ## Thrown
# The block starts in the shape that it has while it slides, which is the one at the threshold, and is damped, or it would oscillate more
# and more. It is 50 times as stiff as before, for it leans forward while it slides, which is the error of the way that it stops after.


# %%
def throw(mu: float):
    """Way that the block has slid when it stops, over the exact one."""
    start, _, force, *_ = scene(mu, True, E=50 * args.E)
    problem, contact, load, _, tags = scene(mu, True, E=50 * args.E, density=1.0)
    load.value[:] = 0.0, -g
    for sideways in (0.0, (1 - near) * mu * g):
        force.value[:] = sideways, -g
        start.solve()
    problem.u.x.array[:] = start.u.x.array
    bottom = uem.ds(tags["block_bottom"])
    began = uem.integrate(problem.u[0] * bottom)
    end = v0 / (mu * g)
    for _ in uem.time_steps(problem, end / args.steps, 1.1 * end):
        pass
    slid = (uem.integrate(problem.u[0] * bottom) - began) / length
    return slid / (v0**2 / (2 * mu * g))


rows, curves = [], {}
for rigid in (True, False):
    for mu in (0.1, 0.3, 0.9):
        curve, taken, problem = drive(mu, rigid)
        curves[mu, rigid] = curve
        (pushed, named), (inclined, named_too) = push(mu, rigid, False), push(mu, rigid, True)
        stop = throw(mu) if rigid else np.nan
        rows.append({
            "base": "rigid" if rigid else "elastic", "mu": mu, "H/(mu N) - 1": float(curve[-1, 1] - 1), "dissipation - 1": taken,
            "balance": max(pushed, inclined), "refused beyond": named and named_too,
            "stop - 1": float(stop - 1),
        })  # fmt: skip
results = {
    "scene": rows,
    "threshold_error": max(abs(row["H/(mu N) - 1"]) for row in rows),
    "balance": max(row["balance"] for row in rows),
    "stopping_error": max(abs(row["stop - 1"]) for row in rows if row["base"] == "rigid"),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as (left, right):
        s = uem.LinearElastic(args.E, nu, kind="plane_strain").stress(problem.u)
        uem.plot_scene(problem, left, field=s[0, 1], label="shear stress", scale=5.0)
        if right:
            for (mu, rigid), curve in curves.items():
                right.plot(*curve.T[:2], ("-", "--")[not rigid], label=f"mu {mu}, {'rigid' if rigid else 'elastic'} base")
            right.set(xlabel="displacement of the tail", ylabel="H / (mu N)")
            right.grid(alpha=0.25)
            right.legend(frameon=False)

# %%
assert results["threshold_error"] < 1e-10 and results["balance"] < 1e-12 and results["stopping_error"] < 0.2 / args.steps, results
assert all(row["refused beyond"] and abs(row["dissipation - 1"]) < 1e-8 for row in rows), rows
