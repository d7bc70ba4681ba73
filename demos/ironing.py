"""Ironing: a stiff rounded tool is pressed into a soft slab, dragged along it and off its end, with friction or without.

python3 demos/ironing.py --plot ironing.png

Options:
    tool: deformable tool, or rigid one
    n: elements along the slab
    n_tip: elements along the tool's tip; 0: 9 in 2D, 8 in 3D
    layers: elements through the slab's height; 0: 5 in 2D, 3 in 3D
    steps_per_pitch: load steps per element along the slab
    samples: load steps over the one element where mean forces are taken
"""

# %% [markdown]
# # Ironing
#
# A tool 1000 times as stiff as the neo-Hookean slab below it is pressed in by half an element, dragged over 20 elements and more,
# and then on past the slab's end until nothing touches. All the while its nodes slide from facet to facet.
#
# Without friction the slab stores energy and gives it back: after one pitch of the mesh the scene looks the same again, so that
# the drag force does no work over a pitch and its mean is zero. The faceted surface makes it go up and down between. With
# `--coupling mortar` whole facets slide over each other: no node jumps from facet to facet, and no step is cut for it.
# As the tool leaves the slab, the slab's corner is inside one of its facets for a moment, which the package warns of.

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
    dim=2,
    tool=("elastic", "rigid"),
    n=30,
    n_tip=0,
    layers=0,
    steps_per_pitch=4,
    samples=20,
    friction=0.0,
    coupling=("node_to_surface", "mortar"),
    normals=("facet", "averaged"),
)

# %% [markdown]
# ## The scene
# The motion of the tool's top is prescribed: down by `depth`, along the slab, off its end. A rigid tool is a disc or a ball that moves, and
# then the slab's nodes are the contactors.

# %%
E, nu, L, R, begin = 1.0, 0.3, 3.0, 0.5, 0.5
g, rigid, pitch = args.dim, args.tool == "rigid", L / args.n
depth = 0.5 * L / 30
mesh, tags = uem.read_gmsh(
    common.MESHES / "ironing.geo", comm, gdim=g,
    parameters={
        "dim": g, "tool": int(not rigid), "n": args.n, "L": L, "R": R, "start": begin,
        "n_tip": args.n_tip or (9, 8)[g - 2], "layers": args.layers or (5, 3)[g - 2],
    },
)  # fmt: skip
V = uem.function_space(mesh, 1, (g,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
stiffness = fem.Function(uem.function_space(mesh, ("DG", 0)), name="E")
stiffness.x.array[:] = E
material = uem.NeoHooke(stiffness, nu, kind="plane_strain" if g == 2 else "3d")
bcs = [uem.dirichlet(V, tags["slab_bottom"])]
if g == 3:
    bcs.append(uem.dirichlet(V, tags["symmetry"], 1))
if rigid:
    ball = uem.RigidSphere((begin, *[0.0] * (g - 2), R), R)
    contact = uem.Contact(contactor=tags["slab_top"], target=ball, coupling=args.coupling, friction=args.friction)
else:
    stiffness.x.array[tags["tool"].entities] = 1000 * E
    place = fem.Constant(mesh, np.zeros(g))
    bcs.append(uem.dirichlet(V, tags["tool_top"], value=place))
    contact = uem.Contact(
        contactor=tags["tool_tip"], target=tags["slab_top"], coupling=args.coupling, normals=args.normals, friction=args.friction
    )

# %% [markdown]
# ## The way
# Stations of the tool: pressed in, dragged in even steps, and in finer ones over one pitch in the slab's middle, where the mean
# forces are taken.

# %%
samples = args.samples
first = pitch * round((L / 2 - begin) / pitch - 0.5)
before = np.linspace(0.0, first, round(args.steps_per_pitch * first / pitch) + 1)
window = np.linspace(first, first + pitch, samples + 1)
after = np.arange(first + pitch, L + 0.6 * R - begin + pitch, pitch / args.steps_per_pitch)
travel = np.concatenate([[0.0, 0.0], before, window[1:], after[1:]])
drop = np.minimum(np.arange(len(travel)) / 2, 1.0) * depth
steps = len(travel) - 1


def lead(factor: float) -> None:
    """Put the tool where it is at a load factor."""
    s = factor * steps
    there = [np.interp(s, range(steps + 1), travel), *[0.0] * (g - 2), -np.interp(s, range(steps + 1), drop)]
    if rigid:
        ball.move(there)
    else:
        place.value[:] = there


# %% [markdown]
# ## The solution
# Two points of integration in each direction are exact enough for linear elements, whatever the law.

# %%
start = time.perf_counter()
problem = uem.UnitedProblem(
    material.residual(u, v) * ufl.dx(degree=2), u, bcs=bcs, contacts=[contact], petsc_options_prefix="ironing_", load=lead,
    verbose=args.verbose,
)  # fmt: skip
writer = uem.ResultsWriter(f"{args.output}/ironing", problem) if args.output else None
done, forces, balances, local, middle = [], [], [], [], u.x.array.copy()
for step in uem.load_steps(problem, steps):
    done.append(step)
    forces.append(contact.resultant(on="target" if rigid else "contactor").force)
    state = contact.pair.trial
    tau = np.zeros(1) if state.friction is None else np.linalg.norm(state.friction.tau, axis=1)
    local.append(comm.allreduce(np.array([tau.sum(), state.lam.sum()])))
    balance = contact.balance()
    balances.append((0.0, 0.0) if balance is None else (balance.force, balance.moment))
    if step.factor * steps <= 2 + len(before) - 1 + samples // 2:
        middle = u.x.array.copy()
    if writer:
        writer.write(step)
if writer:
    writer.close()
seconds = time.perf_counter() - start

# %% [markdown]
# ## The figures
# Forces on the tool; in 3D those on its half. A rigid tool has no nodes at which a balance could be taken.

# %%
force, at = np.array(forces), np.interp([step.factor * steps for step in done], range(steps + 1), travel)
pressed = np.array([step.factor * steps > 1.5 for step in done])
inside = pressed & (at > first - 1e-9) & (at < first + pitch + 1e-9)
mean = ((force[inside][1:] + force[inside][:-1]) * np.diff(at[inside])[:, None]).sum(axis=0) / (2 * pitch)
worst_force, worst_moment = np.max(balances, axis=0)
results = {
    "steps": len(done),
    "cuts": sum(step.cuts for step in done),
    "newton_iterations": sum(step.newton_iterations for step in done),
    "exchanges": sum(step.exchanges for step in done),
    "max_newton_per_step": max(step.newton_iterations for step in done),
    "force_imbalance": None if rigid else float(worst_force),
    "moment_imbalance": None if rigid else float(worst_moment),
    "force": float(mean[-1]),
    "mean_drag_ratio": float(abs(mean[0] / mean[-1])),
    # each contactor's friction along the surface over its force normal to it; the drag is another ratio:
    # the slab's surface is shorter under the tool, so that slip and frictional work are less than by the motion of the tool
    "local_drag_ratio": float(np.divide(*np.array(local)[inside].sum(axis=0))),
    "largest_drag_ratio": float(np.abs(force[inside][:, 0] / force[inside][:, -1]).max()),
    "return_error": float(np.abs(force[inside][-1] - force[inside][0]).max() / mean[-1]),
    "drag_elements": float((L - begin) / pitch),
    "released": contact.n_active == 0 and not force[-1].any(),
    "dofs": g * V.dofmap.index_map.size_global,
    "seconds": seconds,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The slab under the tool in mid-drag, and the forces over the way; at the end of the slab the tool is pushed off it.

# %%
if args.plot:
    u.x.array[:] = middle
    with uem.figure(args.plot, comm, panels=4 - g) as panels:
        if g == 2:
            across = material.first_piola(u)[1, 1] * ufl.conditional(ufl.gt(stiffness, E), 0.0, 1.0)
            uem.plot_scene(
                problem, panels[0], field=across / E, label="vertical stress / E", arrows=False, cmap="magma",
                window=(0.6, 2.4, -0.55, 0.55), levels=15,
            )  # fmt: skip
        if panels[-1]:
            for i, label in ((g - 1, "normal force"), (0, "drag")):
                panels[-1].plot(at[pressed] / pitch, force[pressed, i], label=label)
            panels[-1].axvline((L - begin) / pitch, color="0.6", lw=0.8, label="end of the slab")
            panels[-1].set(xlabel="displacement of the tool, in elements", ylabel="force on the tool")
            panels[-1].grid(alpha=0.25)
            panels[-1].legend(frameon=False)

# %%
assert results["released"]
assert abs(results["mean_drag_ratio"] - args.friction) < 0.01
