"""The clip that is strained least at a given insertion force, by exact gradients through the contact, against beam theory.

python3 demos/snap_fit.py --plot snap_fit.png

Options:
    n: cells through the arm of the clip
    knots: lengths along the arm between which its thickness is linear
    power: of the norm that stands for the largest stress
    iterations: largest number of SLSQP iterations
"""

# %% [markdown]
# # A snap fit
#
# An arm with a ramp at its end is pushed over the corner of a wall, without friction, and snaps in behind the ramp. At the ramp's end the
# force of insertion is largest, and so is the stress. Which thickness along the arm needs the same force, and is stressed least?
#
# By beam theory the one whose surface is stressed alike everywhere: `h0 sqrt(1 - x / l)` under a force P at the distance l. With the
# deflection d, for a constant thickness h and for that one,
#
#     P = E h^3 d / (4 l^3),   slope 3 d / (2 l),  stress 3 E h d / (2 l^2)
#     P = E h0^3 d / (8 l^3),  slope 3 d / l,      stress 3 E h0 d / (4 l^2)
#
# The force of insertion is `P tan(angle of the ramp + slope)`, which determines h0. Unknowns are thicknesses at knots; of the stress
# along the upper side a norm of high power is taken. The gradients of both take an adjoint problem each (`uem.gradient`), by the places
# of all nodes.

# %%
import functools
import warnings

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import minimize

import uem_dolfinx as uem

args = common.arguments(__doc__, n=6, knots=8, power=20, steps=3, iterations=60)
E, L, H, HEAD, HOOK, TIP, START, WAY = 1.0, 20.0, 2.0, 4.0, 1.0, 0.4, 0.5, 3.0

# %%
sizes = {"n": args.n, "l": L, "h": H, "a": HEAD, "hook": HOOK, "tip": TIP, "start": START}
mesh, tags = uem.read_gmsh(common.MESHES / "snap_fit.geo", comm, gdim=2, parameters=sizes)
V = uem.function_space(mesh, 1, (2,))
u, v, X = fem.Function(V, name="displacement"), ufl.TestFunction(V), ufl.SpatialCoordinate(mesh)
material = uem.LinearElastic(E, 0.0, kind="plane_stress")
F, push = material.residual(u, v) * ufl.dx, fem.Constant(mesh, -WAY)
bcs = [uem.dirichlet(V, tags["root"]), uem.dirichlet(V, tags["wall_sides"], 0, push), uem.dirichlet(V, tags["wall_sides"], 1)]
forward = fem.Function(V)  # a unit motion of the root, along which the residual's work is the force
forward.x.array[fem.locate_dofs_topological(V.sub(0), 1, tags["root"].entities)] = 1.0
forward.x.scatter_forward()
force = ufl.replace(F, {v: forward})
# beam theory: deflection and angle at the end, ratio of the forces P, thickness, and ratio of the stresses
reach, d, angle = L + HEAD - START - WAY, (HOOK - TIP) / HEAD * WAY, np.arctan((HOOK - TIP) / HEAD)
stress = 1.5 * E * H * d / reach**2
weaker = np.tan(angle + 1.5 * d / reach) / np.tan(angle + 3 * d / reach)
h0 = H * (2 * weaker) ** (1 / 3)
even = material.stress(u)[0, 0] / stress
norm = even**args.power * uem.ds(tags["top"], quadrature_degree=8)
# upper sides move with the thickness at the knots, and what is below them in proportion
knots, drawn, owned = np.linspace(0.0, L, args.knots + 1), np.array(mesh.geometry.x), V.dofmap.index_map.size_local


def hats(x: np.ndarray) -> np.ndarray:
    """How far up places move with each thickness ``(n, knots + 1)``."""
    of_clip = np.clip(x[:, 1] / H, 0.0, 1.0)
    return of_clip[:, None] * np.stack([np.interp(x[:, 0], knots, one) for one in np.eye(len(knots))], axis=1)


at_nodes, at_vertices = hats(V.tabulate_dof_coordinates()[:owned]), hats(drawn)


# %%
def insert(thickness: np.ndarray) -> uem.UnitedProblem:
    """Push a clip up to the end of the ramp."""
    mesh.geometry.x[:, 1] = drawn[:, 1] + at_vertices @ (thickness - H)
    u.x.array[:] = 0.0
    contact = uem.Contact(contactor=tags["corner"], target=tags["ramp"])
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options_prefix="snap_", verbose=args.verbose)
    for _ in uem.load_steps(problem, args.steps):
        pass
    return problem


@functools.cache
def measured(*thickness: float) -> tuple[float, np.ndarray, float, np.ndarray]:
    """Force and norm of the stress of a clip, each with its derivatives by the thicknesses."""
    problem = insert(np.array(thickness))
    by = [uem.gradient(problem, J, X)[0].x.array.reshape(-1, 2)[:owned, 1] for J in (force, norm)]
    of_force, of_norm = (comm.allreduce(at_nodes.T @ one) for one in by)
    N = uem.integrate(norm)
    return uem.integrate(force), of_force, N ** (1 / args.power), of_norm * N ** (1 / args.power - 1) / args.power


# %%
warnings.filterwarnings("ignore", "Values in x were outside bounds")  # by rounding
constant, designs = np.full(args.knots + 1, H), []
first, _, before, _ = measured(*constant)
found = minimize(
    lambda h: (measured(*h)[2] / before, measured(*h)[3] / before), constant, jac=True, method="SLSQP",
    bounds=[(0.15 * H, 2 * H)] * len(knots), options={"maxiter": args.iterations, "ftol": 1e-5},
    constraints={"type": "eq", "fun": lambda h: measured(*h)[0] / first - 1, "jac": lambda h: measured(*h)[1] / first},
    callback=lambda h: designs.append(np.array(h)),
)  # fmt: skip
last, _, after, _ = measured(*found.x)
closed = h0 * np.sqrt(1 - knots / reach)
# norms of a stress that grows from the force on, and of one that is the same everywhere
theory = weaker * (H / h0) ** 2 / ((1 - (1 - L / reach) ** (args.power + 1)) * reach / L / (args.power + 1)) ** (1 / args.power)

# %%
results = {
    "stress_ratio": after / before,
    "stress_ratio_theory": theory,
    "objective_error": abs(after / before / theory - 1),
    "force_error": abs(last / first - 1),
    "thickness_error": float(np.abs(found.x - closed)[knots < 0.8 * L].max() / h0),
    "iterations": int(found.nit),
    "insertions": measured.cache_info().misses,
    "dofs": 2 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %%
how = {"field": abs(even), "label": "relative stress", "levels": np.linspace(0.0, 1.0, 11), "cells": False, "arrows": False}
if args.plot:
    with uem.figure(args.plot, comm, panels=3, size=(6.4, 2.4), columns=1) as panels:
        for panel, thickness in zip(panels, (constant, found.x)):
            uem.plot_scene(insert(thickness), panel, window=(-0.6, 1.23 * L, -2.9, 3.0), **how)
        if panels[2] is not None:
            panels[2].plot(knots, closed, "k-", lw=1, label="beam theory")
            panels[2].plot(knots, found.x, "x", label="optimised")
            panels[2].set(xlabel="x", ylabel="thickness", xlim=(-0.6, 1.23 * L), ylim=(0.0, 1.3 * H))
            panels[2].legend()
if args.output:
    film = f"{args.output}/snap_fit.gif"
    for _ in uem.animate(film, insert(constant), map(insert, [constant, *designs]), every=2, size=(6.4, 2.4), **how):
        pass

# %%
assert results["objective_error"] < 0.05 and results["thickness_error"] < 0.05 and results["force_error"] < 1e-3
