"""A beam is loaded from afar by a rigid coupling and by a spread load, then a rigid flywheel strikes it.

mpirun -n 2 python3 demos/remote.py --plot remote.png

Options:
    n: cells along the beam
    spin: angular velocity of the wheel before it strikes
"""

# %% [markdown]
# # Remote loads and a rigid flywheel
#
# The tip of a beam moves rigidly with a point outside of it, where a force and a moment act. Elements of degree 2 without lateral
# contraction carry tension and pure bending exactly, so that the motions of the point equal those of beam theory. Under a shear force
# its rotation does, by reciprocity. With `distribute=True` the tip is not stiffened, and forces and moments still balance at the root.
#
# Then a spinning wheel strikes the beam, which is free. The wheel has no stiffness, only the mass of its mesh, and 3 unknowns.
# The beam gains the momentum that the wheel loses.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=18, dt=0.01, end=0.6, spin=6.0, friction=0.2)
L, h, E, rho = 6.0, 1.0, 5000.0, 1.0
point, middle = np.array([7.5, 0.7]), np.array([4.8, 1.8])  # where the loads act; of the wheel
mesh, tags = uem.read_gmsh(common.MESHES / "remote.geo", comm, gdim=2, parameters={"L": L, "h": h, "n": args.n})

# %% [markdown]
# ## Statics
# The root is held by a coupling with zero motion, whose reactions are force and moment there; so is the wheel while it waits.

# %%
V = uem.function_space(mesh, 2, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
law = uem.LinearElastic(E, 0.0, kind="plane_stress")
form = law.residual(u, v) * uem.dx(tags["beam"])
e, y = point - (L, 0.0)
EI = E * h**3 / 12
# force and moment, and the parts of the motion (u_x, u_y, angle) that beam theory gives; tension acts through the middle of the beam
loads = {
    "tension": ((1.0, 0.0), y, (L / E, 0.0, 0.0)),
    "bending": ((0.0, 0.0), 1.0, (-L * y / EI, (L**2 / 2 + L * e) / EI, L / EI)),
    "shear": ((0.0, 1.0), 0.0, (np.nan, np.nan, (L**2 / 2 + L * e) / EI)),
}
rows, motions = [], {}
for coupling in ("rigid", "spread"):
    for name, (force, moment, theory) in loads.items():
        root, wheel = (
            uem.RigidCoupling(tags[part], at, motion=(0.0, 0.0, 0.0)) for part, at in (("root", (0.0, 0.0)), ("wheel", middle))
        )
        tip = uem.RigidCoupling(tags["tip"], point, force=force, moment=moment, distribute=coupling == "spread")
        uem.UnitedProblem(form, u, couplings=[root, wheel, tip], rtol=1e-13, petsc_options_prefix="remote_").solve()
        motion = motions[coupling, name] = np.append(tip.displacement, tip.rotation)
        at_root, turn = root.reaction
        lever = point[0] * force[1] - point[1] * force[0]
        left = np.abs(np.append(at_root + force, turn + moment + lever)).max() / (1.0 + abs(lever))
        off = np.nanmax(np.abs(motion - theory)) / np.nanmax(np.abs(theory))
        rows.append({"coupling": coupling, "load": name, "root": float(left), "beam theory": float(off)})
# each load does the same work in the motion of the other
reciprocity = max(abs(motions[c, "shear"][2] / motions[c, "bending"][1] - 1.0) for c in ("rigid", "spread"))

# %% [markdown]
# ## The strike
# The beam has finite strain, the wheel large rotations; neither is held.

# %%
V = uem.function_space(mesh, 1, (2,))
u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
mesh.topology.create_connectivity(2, 2)
nodes = fem.locate_dofs_topological(V, 2, tags["wheel"].entities)
arms = V.tabulate_dof_coordinates()[nodes, :2] - middle
velocity.x.array.reshape(-1, 2)[nodes] = (0.0, -2.0) + args.spin * np.stack([-arms[:, 1], arms[:, 0]], axis=1)
law = uem.StVenantKirchhoff(E, 0.3, kind="plane_stress")
dynamics = uem.Dynamics(uem.lumped_mass(V, rho), velocity=velocity)
wheel = uem.RigidCoupling(tags["wheel"], middle)
contact = uem.Contact(contactor=tags["top"], target=tags["rim"], friction=args.friction)
problem = uem.UnitedProblem(
    law.residual(u, v) * uem.dx(tags["beam"]), u, contacts=[contact], couplings=[wheel], dynamics=dynamics, rtol=1e-13,
    petsc_options_prefix="strike_", verbose=args.verbose,
)  # fmt: skip
writer = uem.ResultsWriter(f"{args.output}/remote", problem) if args.output else None
history, frames = [], []
for step in uem.time_steps(problem, args.dt, args.end):
    history.append((step.time, wheel.rotation, *contact.resultant().force, *dynamics.momentum()))
    if step.number % max(1, round(args.end / args.dt / 4)) == 1:
        frames.append((step.time, uem.outline(problem)))
    if writer is not None:
        writer.write(step)
if writer is not None:
    writer.close()

# %% [markdown]
# ## The figures
# The nodes of the wheel are compared with its reference shape moved rigidly.

# %%
t, angle, along, across, *momentum = np.array(history).T
c, s = np.cos(angle[-1]), np.sin(angle[-1])
apart = problem.config.x[nodes] - middle - wheel.displacement - arms @ np.array([[c, s], [-s, c]])
results = {
    "statics": rows,
    "reciprocity": float(reciprocity),
    "remote_error": float(max(reciprocity, *(row["root"] for row in rows), *(row["beam theory"] for row in rows[:3]))),
    "momentum_error": float(np.ptp(momentum, axis=1).max() / np.linalg.norm(np.array(momentum)[:, 0])),
    "rigidity_error": float(max(comm.allgather(np.abs(apart).max(initial=0.0))) / 1.2),
    "spin_after": float((angle[-1] - angle[-2]) / (t[-1] - t[-2])),
    "largest_force": float(np.abs(across).max()),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.6)) as panels:
        if panels[0] is not None:
            from matplotlib import colormaps
            from matplotlib.collections import LineCollection

            for k, (time, lines) in enumerate(frames):
                colour = colormaps["viridis_r"](0.1 + 0.9 * k / len(frames))
                panels[0].add_collection(LineCollection(lines, colors=[colour], linewidths=1.5, label=f"time {time:.2f}"))
            panels[0].autoscale()
            panels[0].set(aspect="equal", xlabel="x", ylabel="y")
            panels[0].legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.98))
            panels[1].plot(t, across, ".-", ms=4, label="normal to the beam")
            panels[1].plot(t, along, ".-", ms=4, label="along the beam")
            panels[1].set(xlabel="time", xlim=(0.0, 0.25), ylabel="contact force on the beam")
            panels[1].grid(alpha=0.25)
            panels[1].legend(frameon=False, loc="lower right")

# %%
assert results["remote_error"] < 1e-10, results
assert results["momentum_error"] < 1e-12 and results["rigidity_error"] < 1e-12, results
