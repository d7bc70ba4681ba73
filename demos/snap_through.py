"""Snap-through of two cantilevers in contact, by displacement control past the limit point and off the target's end.

python3 demos/snap_through.py --plot snap_through.png

Options:
    dw: prescribed displacement per load step, rounded so that 1/dw is whole
"""

# %% [markdown]
# # Snap-through
#
# Two slender cantilevers reach over each other. A point of the upper one is moved down by w; its tip A meets the lower beam, bends it
# down and slides towards its end, with large rotations: the first example of [UEM], in dimensions that let every phase of it occur. The
# load P that this takes grows up to a limit point, at which the beams would snap through under a dead load, falls, and grows again. P has
# kinks where A moves to the next facet. At last A slides off, and the lower beam springs back.
#
# Led by its displacement, the limit point is a state like any other: the direction in which the load would snap is prescribed,
# and P'KP stays positive definite. Without friction contact does no work, so that as long as it lasts the work of the load is
# stored as strain energy.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dw=0.05, coupling=("node_to_surface", "mortar"))
depth, per_unit = 28, max(round(1 / args.dw), 1)  # whole w are always among the stations
# P, lambda and u_A by w, from an independent code
reference = {
    -2: (-2.392874, 0.797241, -0.108996, -2.921683),
    -5: (-8.397949, 3.344452, -0.318189, -5.928732),
    -10: (-16.959881, 7.457627, -1.270472, -11.817085),
    -15: (-18.982676, 10.575886, -3.970813, -21.919700),
    -20: (-11.430279, 8.517514, -12.307128, -37.177760),
}

# %% [markdown]
# ## The scene
# Each beam is 8 x 1 bilinear elements with 2 x 2 points of integration, of St Venant-Kirchhoff's law in plane stress. The point A
# is the only contactor: of the whole tip, the upper corner would come to lie on the lower beam as well, from w = -20.2 on.
#
# A point has no facet to integrate over: with `--coupling mortar` it keeps the equation of a node, and the figures are the same.
#
# The beam that springs back passes the one that held it. A is then far below the lower beam's top, and yet not in this beam but behind
# it; `thickness` distinguishes the two for a contactor that has been past the target's end.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "cantilevers.geo", comm, gdim=2)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material, dx = uem.StVenantKirchhoff(1000.0, 0.3, kind="plane_stress"), ufl.dx(degree=2)
bcs = [uem.dirichlet(V, [tags["upper_held"], tags["lower_held"]]), uem.dirichlet(V, tags["load"], 1, -depth)]
contact = uem.Contact(contactor=tags["A"], target=tags["lower_top"], coupling=args.coupling, thickness=4.0)
problem = uem.UnitedProblem(
    material.residual(u, v) * dx, u, bcs=bcs, contacts=[contact], petsc_options_prefix="snap_", verbose=args.verbose
)
energy = fem.form(material.energy(u) * dx)

# %% [markdown]
# ## The way
# How the departure is passed: its step begins in contact. After the first iteration A is found beyond the target's end and
# released. Nothing holds the lower beam then, whose tip is 50 away from its place, and the same united Newton loop brings it home
# within the step; the line search shortens a few of its 18 iterations, the first to an eighth. A may only come into contact again
# when the bodies are in equilibrium, and there it lies behind the beam. No step is cut.


# %%
def at(point: str) -> np.ndarray:
    """Displacement of a point, on all ranks."""
    nodes = fem.locate_dofs_topological(V, 0, tags[point].entities)
    owned = nodes[nodes < V.dofmap.index_map.size_local]
    return comm.allreduce(u.x.array.reshape(-1, 2)[owned].sum(axis=0))


def station(w: float) -> dict:
    """What is measured in a state of equilibrium."""
    return {
        "w": w,
        "P": float(problem.reaction(tags["load"])[1]),
        "lam": float(np.linalg.norm(contact.resultant().force)),
        "u_A": at("A").tolist(),
        "gap": float(comm.allreduce(contact.pair.kinematics.gap.sum())),
        "to_end": float(np.linalg.norm(at("A") - at("end") + [40.0, 2.0])),
        "lower_tip": float(np.linalg.norm(at("end"))),
        "energy": uem.integrate(energy),
        "active": contact.n_active,
    }


writer = uem.ResultsWriter(f"{args.output}/snap_through", problem) if args.output else None
steps, path, shapes = [], [station(0.0)], {}
for step in uem.load_steps(problem, depth * per_unit):
    steps.append(step)
    path.append(station(-depth * step.factor))
    if np.isclose(step.factor * depth % 1.0, (0.0, 1.0)).any():
        shapes[round(-step.factor * depth)] = u.x.array.copy()
        if writer:
            writer.write(step)
if writer:
    writer.close()

# %% [markdown]
# ## The figures
# Between the stations: contact begins where the gap vanishes and ends where A is at the target's end, both continued by
# parabolas from one side; the limit point is the vertex of the parabola through the stations about it. The work of the load is
# compared until departure. There equilibrium jumps, and in statics the energy that the lower beam releases is lost; a dynamic
# analysis would find it in its vibrations.

# %%
w, P, lam, u_A, gap, to_end, lower_tip, stored, active = (np.array([s[key] for s in path]) for key in path[0])
first, last = np.flatnonzero(active)[[0, -1]]
before, held, free = slice(max(first - 3, 0), first), slice(last - 2, last + 1), slice(last + 1, last + 4)


def extrapolate(x: np.ndarray, y: np.ndarray, to: float) -> float:
    """Value of the parabola through three points, or the line through two."""
    return float(np.polyval(np.polyfit(x - x[-1], y, len(x) - 1), to - x[-1]))


def vertex(y: np.ndarray, k: int) -> tuple[float, float]:
    """Place and value of the extremum close to station k."""
    a, b, c = np.polyfit(w[k - 1 : k + 2] - w[k], y[k - 1 : k + 2], 2)
    return float(w[k] - b / (2 * a)), float(c - b**2 / (4 * a))


onset, departure = extrapolate(gap[before], w[before], 0.0), extrapolate(to_end[held], w[held], 0.0)
limit_w, limit_P = vertex(P, int(P.argmin()))
work = np.sum((P[1:] + P[:-1])[:last] / 2 * np.diff(w)[:last])
rows = []
for k, wanted in reference.items():
    s = path[int(np.abs(w - k).argmin())]
    error = np.abs(np.array([s["P"], s["lam"], *s["u_A"]]) / wanted - 1).max()
    rows.append({key: s[key] for key in ("w", "P", "lam", "u_A")} | {"error": float(error)})
iterations = [step.newton_iterations for step in steps]
results = {
    "rows": rows,
    "onset_w": onset,
    "limit_w": limit_w,
    "limit_P": limit_P,
    "largest_lam": vertex(lam, int(lam.argmax()))[1],
    "slide_off_w": departure,
    "P_before": extrapolate(w[held], P[held], departure),
    "P_after": extrapolate(w[free], P[free], departure),
    "work_error": float(abs(work / stored[last] - 1)),
    "energy_before": extrapolate(w[held], stored[held], departure),
    "energy_after": extrapolate(w[free], stored[free], departure),
    "lower_tip_before": float(lower_tip[last]),
    "lower_tip_after": float(lower_tip[last + 1 :].max()),
    "steps": len(steps),
    "cuts": sum(step.cuts for step in steps),
    "newton_iterations": sum(iterations),
    "exchanges": sum(step.exchanges for step in steps),
    "newton_iterations_at_departure": iterations.pop(last),
    "max_newton_elsewhere": max(iterations),
}
results["energy_released"] = results["energy_before"] - results["energy_after"]
common.report(args, results)

# %% [markdown]
# ## The picture
# Colours show the stress of the outer fibres over that of the middle.

# %%
phases = {-5: "in contact", -13: "close to the limit point", -26: "close to the target's end", -27: "after departure"}
with uem.figure(args.plot, comm, size=(10.0, 6.4)) as (page,):
    panels = dict.fromkeys(phases)
    if page:
        canvas = page.figure
        page.remove()
        panels = canvas.subplot_mosaic([[-5, -13, "P"]] * 2 + [[-5, -13, "lam"], [-26, -27, "lam"]] + [[-26, -27, "u"]] * 2)
    for name in phases if args.plot else ():
        u.x.array[:] = shapes[name]
        uem.plot_scene(
            problem, panels[name], field=2 * ufl.grad(material.stress(u)[0, 0])[1], label="bending stress", arrows=False,
            levels=range(-25, 86, 10), cmap="plasma", window=(-3, 123, -56, 8),
        )  # fmt: skip
    if page:
        for letter, (name, caption) in zip("abcd", phases.items()):
            panels[name].set_title(f"({letter}) w = {name}: {caption}")
            here = (-name, P[np.isclose(w, name)][0])
            panels["P"].plot(*here, "k.")
            panels["P"].annotate(letter, here, xytext=(0, 6), textcoords="offset points", ha="center")
        curves = {"P": {"load P": P}, "lam": {"contact force": lam}, "u": {"$u_x$ of A": u_A[:, 0], "$u_y$ of A": u_A[:, 1]}}
        for name, lines in curves.items():
            for label, values in lines.items():
                # nothing is drawn across the jump
                panels[name].plot(np.insert(-w, last + 1, np.nan), np.insert(values, last + 1, np.nan), label=label)
            panels[name].set_ylabel(", ".join(lines))
            panels[name].grid(alpha=0.25)
            for where, label in ((onset, "contact"), (limit_w, "limit point"), (departure, "departure")):
                panels[name].axvline(-where, color="0.5", lw=0.8, ls="--")
                if name == "P":
                    panels[name].text(-where, 1.02, label, transform=panels[name].get_xaxis_transform(), ha="center")
        panels["u"].legend(frameon=False, loc="lower left", bbox_to_anchor=(0.1, 0.0))
        panels["u"].set_xlabel("-w")

# %%
bound = 1e-3 * max(1.0, 4 * args.dw)
assert all(row["error"] < 1e-4 for row in rows), rows
assert abs(onset / -1.056221 - 1) < 1e-3
assert abs(limit_w / -13.5306 - 1) < bound and abs(limit_P / -19.8116 - 1) < bound
assert abs(results["largest_lam"] / 10.6431 - 1) < bound
assert abs(departure - -26.456) < 0.05 and w[last + 1] < departure < w[last]
assert abs(results["P_before"] - -12.42) < 0.05 and abs(results["P_after"] - -15.26) < 0.05
assert results["work_error"] < 1e-3
assert not active[last + 1 :].any() and results["lower_tip_after"] < 1e-6 * results["lower_tip_before"]
