"""The shape of a stiff punch that presses evenly, by exact gradients through the contact, against the closed form.

python3 demos/punch_shape.py --plot punch_shape.png

Options:
    n: cells along half of the punch's bottom
    width: half width, and depth, of the base relative to the half width of the punch
    stiff: Young's modulus of the punch relative to that of the base
    pressure: mean contact pressure relative to Young's modulus of the base
    iterations: largest number of L-BFGS iterations
"""

# %% [markdown]
# # A punch that presses evenly
#
# Under a flat stiff punch the pressure on an elastic base is largest at the edges. Which shape makes it the same all over? The one that a
# surface takes under a uniform pressure p over `|x| < a`, for a half space in plane strain (Johnson, Contact Mechanics, 1985, eq. 2.30a):
#
#     w(x) - w(0) = 2 (1 - nu^2) p a / (pi E) [ (1 + x/a) ln(1 + x/a) + (1 - x/a) ln(1 - x/a) ]
#
# Unknowns are the heights of the nodes along the punch's bottom, the functional is `int (p / p0 - 1)^2 ds`, and L-BFGS minimises it with
# its gradient by the places of all nodes (`uem.gradient`): one adjoint problem for all heights. Bodies are linear elastic, the base is a
# large block, and nodes lie opposite each other, so that an even pressure can be even on both sides.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import minimize

import uem_dolfinx as uem

args = common.arguments(__doc__, n=20, width=40.0, stiff=1e3, pressure=1e-3, iterations=200)
E, NU, A = 1.0, 0.3, 1.0
#: Height of the punch, and the gap that it is drawn with.
HEIGHT, GAP = 0.5 * A, 0.02 * A

# %% [markdown]
# ## The scene
# A change of the heights moves the nodes of the punch above them along, less and less up to its top.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "punch.geo", comm, gdim=2, parameters={"n": args.n, "gap": GAP, "width": args.width})
V = uem.function_space(mesh, 1, (2,))
u, v, X = fem.Function(V, name="displacement"), ufl.TestFunction(V), ufl.SpatialCoordinate(mesh)
modulus = fem.Function(uem.function_space(mesh, ("DG", 0)))
modulus.interpolate(lambda x: np.where(x[1] > 0.5 * GAP, args.stiff * E, E))
material = uem.LinearElastic(modulus, NU, kind="plane_strain")
F = material.residual(u, v) * ufl.dx
push, bottom = fem.Constant(mesh, 0.0), uem.ds(tags["punch_bottom"])
bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["base_bottom"], 1)]
bcs += [uem.dirichlet(V, tags["punch_top"], 0), uem.dirichlet(V, tags["punch_top"], 1, push)]
knots, drawn, owned = A * np.linspace(0.0, 1.0, args.n + 1), np.array(mesh.geometry.x), V.dofmap.index_map.size_local


# %%
def hats(x: np.ndarray) -> np.ndarray:
    """How far up places move with each height ``(n, n + 1)``."""
    found = np.stack([np.interp(x[:, 0], knots, one) for one in np.eye(len(knots))], axis=1)
    return found * np.where(x[:, 1] > 0.5 * GAP, 1.0 - (x[:, 1] - GAP) / HEIGHT, 0.0)[:, None]


at_nodes, at_vertices = hats(V.tabulate_dof_coordinates()[:owned]), hats(drawn)
state: dict = {"solves": 0}


def press(heights: np.ndarray) -> tuple[float, np.ndarray]:
    """The functional for these heights above the base, and its derivatives by them."""
    mesh.geometry.x[:, 1] = drawn[:, 1] + at_vertices @ heights
    u.x.array[:] = 0.0
    contact = uem.Contact(contactor=tags["punch_bottom"], target=tags["base_top"])
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options_prefix="punch_", verbose=args.verbose
    )
    problem.solve()
    p = contact.pressure
    J = (p / args.pressure - 1) ** 2 * bottom
    (by,) = uem.gradient(problem, J, X)
    slopes = comm.allreduce(at_nodes.T @ by.x.array.reshape(-1, 2)[:owned, 1])
    mean = uem.integrate(p * bottom) / uem.integrate(fem.Constant(mesh, 1.0) * bottom)
    state.update(
        problem=problem, contact=contact, mean=mean, evenness=contact.max_pressure() / mean - 1, solves=state["solves"] + 1
    )
    return uem.integrate(J), slopes


def profile() -> np.ndarray:
    """Pressures of the nodes along the bottom, from the middle to the edge, on rank 0."""
    x, p = state["contact"].points[:, 0], state["contact"].pressures
    parts = comm.gather((x, p))
    x, p = (np.concatenate(part) for part in zip(*parts)) if parts else (x, p)
    return p[np.argsort(x)]


# %% [markdown]
# ## Flat, and then even
# The flat punch is pressed until its mean pressure is p0: the bodies are linear.

# %%
push.value = -GAP - 1e-3
press(np.zeros(args.n + 1))
push.value = -GAP - 1e-3 * args.pressure / state["mean"]
press(np.zeros(args.n + 1))
flat, before, steps = state["evenness"], profile(), [np.zeros(args.n + 1)]
size = args.pressure * A / E
found = minimize(
    lambda y: (lambda J, by: (J, by * size))(*press(y * size)), np.zeros(args.n + 1), jac=True, method="L-BFGS-B",
    bounds=[(-2.0, 2.0)] * (args.n + 1), options={"maxiter": args.iterations, "ftol": 1e-12, "gtol": 1e-8, "maxcor": 30},
    callback=lambda y: steps.append(np.array(y)),
)  # fmt: skip
press(found.x * size)
shape, s = (found.x - found.x[0]) * size, knots / A
closed = np.log1p(s) * (1 + s) + np.where(s < 1, np.log1p(-np.minimum(s, 1 - 1e-16)) * (1 - s), 0.0)
closed *= 2 * (1 - NU**2) * args.pressure * A / (np.pi * E)

# %%
results = {
    "evenness": state["evenness"],
    "evenness_flat": flat,
    "shape_error": float(np.abs(shape - closed).max() / closed[-1]),
    "mean_pressure_error": state["mean"] / args.pressure - 1,
    "iterations": int(found.nit),
    "solves": state["solves"],
    "dofs": 2 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    after = profile()
    with uem.figure(args.plot, comm, panels=2) as panels:
        if panels[0] is not None:
            panels[0].plot(knots, before / args.pressure, "o-", label="flat punch")
            panels[0].plot(knots, after / args.pressure, "x-", label="shape found")
            panels[0].set(xlabel="x / a", ylabel="pressure / mean pressure p0", ylim=(0.0, 3.0))
            panels[0].legend(frameon=False)
            panels[1].plot(knots, closed / size, "k-", lw=1, label="closed form")
            panels[1].plot(knots, shape / size, "x", label="shape found")
            panels[1].set(xlabel="x / a", ylabel="height of the punch / (p0 a / E)")
            panels[1].legend(frameon=False)
if args.output:
    film = uem.animate(
        f"{args.output}/punch_shape.gif", state["problem"], (press(y * size) for y in steps), label="vertical pressure / p0",
        field=-material.stress(u)[1, 1] / args.pressure, levels=np.arange(0.1, 3.0, 0.2), window=(-1.5, 1.5, -0.7, 0.55),
        mirror=True, cells=False, arrows=False, size=(6.4, 3.0), every=2, frames_per_second=4,
    )  # fmt: skip
    for _ in film:
        pass
    with uem.ResultsWriter(f"{args.output}/punch_shape", state["problem"]) as writer:
        writer.write(1.0)

# %%
assert results["evenness"] < 0.02 and results["shape_error"] < 0.05
