"""The profile of a rubber seal that presses evenly on its lid, at finite strain, by exact gradients through the contact.

python3 demos/seal_shape.py --plot seal_shape.png

Options:
    n: number of cells along half of the profile
    squeeze: displacement of the lid over the seal's half width
    wanted: even pressure that is wanted, over Young's modulus
    knots: number of parameters of the profile
    iterations: of the optimiser
"""

# %% [markdown]
# # A seal that presses evenly
#
# A flat rubber block, bonded to its groove, bulges at its free side when a lid presses it: the pressure is highest on the axis, and falls
# towards the side. Which profile of its upper side makes the pressure even?
#
# The profile is raised by a sum of cosines with coefficients c, and all nodes move with it in proportion to their height. With
#
# $$
# J(c) = \int (p / p_0 - 1)^2 \, ds
# $$
#
# one adjoint problem gives the derivatives of J by the positions of all nodes (`uem.gradient`); products with the cosines are those by c.
# Contact pressures are parts of J. The gradient is exact for the discrete problem, at any strain.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import minimize

import uem_dolfinx as uem

args = common.arguments(__doc__, n=16, squeeze=0.12, wanted=0.3, knots=8, iterations=40)
E, nu = 1.0, 0.45

# %% [markdown]
# ## The scene
# The groove is lifted against a lid at rest, at first in the distance `apart`.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "seal.geo", comm, gdim=2, parameters={"n": args.n})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
F = uem.NeoHooke(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
height, apart = 0.8, 0.1
bcs = [uem.dirichlet(V, tags["groove"], 0), uem.dirichlet(V, tags["groove"], 1, apart + args.squeeze)]
bcs.append(uem.dirichlet(V, tags["symmetry"], 0))
X = ufl.SpatialCoordinate(mesh)
drawn = np.array(mesh.geometry.x)
modes = []
for k in range(args.knots):
    mode = fem.Function(V)
    mode.interpolate(lambda x, k=k: np.stack([0 * x[0], np.cos(k * np.pi * x[0]) * x[1] / height]))
    mode.x.scatter_forward()
    modes.append(mode)


# %%
def shaped(c: np.ndarray) -> None:
    """Move the nodes to the profile with these coefficients."""
    x = drawn.copy()
    for k, size in enumerate(c):
        x[:, 1] += size * np.cos(k * np.pi * drawn[:, 0]) * drawn[:, 1] / height
    mesh.geometry.x[:] = x


def pressed(c: np.ndarray) -> tuple[uem.UnitedProblem, ufl.Form]:
    """The seal with this profile under its lid, and J."""
    shaped(c)
    u.x.array[:] = 0.0
    lid = uem.RigidPlane((0.0, height + apart), (0.0, -1.0))
    contact = uem.Contact(tags["profile"], lid, coupling="mortar", max_penetration=0.3)
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], rtol=1e-11, petsc_options_prefix="seal_shape_", verbose=args.verbose
    )
    for _ in uem.load_steps(problem, 3):
        pass
    return problem, (contact.pressure / args.wanted - 1) ** 2 * uem.ds(tags["profile"])


def dot(f: fem.Function, g: fem.Function) -> float:
    """Product of the values of two Functions (collective)."""
    n = V.dofmap.index_map.size_local * 2
    return comm.allreduce(float(f.x.array[:n] @ g.x.array[:n]))


def objective(c: np.ndarray) -> tuple[float, np.ndarray]:
    """J, and its derivatives by the coefficients ``(knots,)``."""
    problem, J = pressed(c)
    (by,) = uem.gradient(problem, J, X)
    return uem.integrate(J), np.array([dot(by, mode) for mode in modes])


# %% [markdown]
# ## The flat seal, and the best
# The deviation is the standard deviation of the pressure over its mean: of all the profile, and without its outer tenth, since the pressure
# vanishes at a free edge of rubber.


# %%
def figures(c: np.ndarray) -> dict[str, float]:
    """Mean of the pressure over the wanted one, its standard deviation over its mean, that of the inner part, and the force."""
    problem, _ = pressed(c)
    p, ds, found = problem.contacts[0].pressure, uem.ds(tags["profile"]), []
    for part in (fem.Constant(mesh, 1.0), ufl.conditional(ufl.lt(X[0], 0.9), 1.0, 0.0)):
        size = uem.integrate(part * ds)
        mean = uem.integrate(part * p * ds) / size
        found.append((mean, np.sqrt(uem.integrate(part * (p - mean) ** 2 * ds) / size) / mean))
    force = problem.contacts[0].resultant().force[1]
    return {"mean": found[0][0] / args.wanted, "deviation": float(found[0][1]), "inner": float(found[1][1]), "force": force}


flat = np.zeros(args.knots)
value, slope = objective(flat)
way = np.linspace(1.0, 0.5, args.knots)
order = uem.taylor_test(lambda h: uem.integrate(pressed(flat + h * way)[1]), float(slope @ way), 2e-3, 2, comm)
before = figures(flat)
found = minimize(
    objective,
    flat,
    jac=True,
    method="L-BFGS-B",
    bounds=[(-0.1 / (1 + k), 0.1 / (1 + k)) for k in range(args.knots)],
    options={"maxiter": args.iterations, "ftol": 1e-8},
)
after = figures(found.x)
problem, _ = pressed(found.x)
results = {
    "flat": before,
    "best": after,
    "objective": [value, float(found.fun)],
    "evaluations": int(found.nfev),
    "taylor": order,
    "coefficients": found.x.tolist(),
    "ranks": comm.size,
}
common.report(args, results)

# %% [markdown]
# ## The picture

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/seal_shape", problem) as writer:
        writer.write(1.0)
if args.plot:
    curves = []
    for c in (flat, found.x):
        problem, _ = pressed(c)
        contact = problem.contacts[0]
        x = V.tabulate_dof_coordinates()[contact.nodes, 0]
        curves.append(comm.gather((x, contact.pressure.x.array[contact.nodes])))
    with uem.figure(args.plot, comm, panels=2) as (scene, panel):
        uem.plot_scene(problem, scene, label="displacement")
        if panel is not None:
            for curve, label in zip(curves, ("flat", "best")):
                x, p = (np.concatenate([part[i] for part in curve]) for i in range(2))
                panel.plot(x[np.argsort(x)], p[np.argsort(x)] / args.wanted, "o-", ms=3, label=label)
            panel.set(xlabel="x", ylabel="pressure / wanted")
            panel.grid(alpha=0.25)
            panel.legend(frameon=False)

# %%
assert order > 1.9
assert after["deviation"] < 0.5 * before["deviation"]
