"""Gears: two spur gears turn in mesh, with the driver's or the driven one's teeth as contactors, against the law of gearing.

python3 demos/gears.py --plot gears.png

Options:
    z1: teeth of the driver
    z2: teeth of the driven gear
    h: size of the cells on the flanks, over the module
    contactor: whose flanks are contactors
    wind: angle by which the driver is turned against the driven gear, in degrees: it makes the torque
    pitches: by how many teeth the gears turn
    steps: load steps to each tooth
"""

# %% [markdown]
# # Gears in mesh
#
# The bores of two involute gears of z1 and z2 teeth rotate by theta and `-theta z1 / z2`, after a small rotation of the driver against the
# other gear. Rigid involutes touch along the line of action. Its angle with the tangent of the pitch circles is the pressure angle of 20
# degrees, and its distances from the two centres have the ratio z2 / z1. So `T2 / T1 = z2 / z1` holds for the torques in every position
# without friction. Elastic teeth bend, so the next pair meets too early, at the corner of a tip. The contact force then deviates briefly
# from the line of action, by an amount that decreases with the torque.
#
# A tip is a sharp corner. With `node_to_surface` a tip of the target may enter a facet between two contactors; a warning states how
# deep. `mortar` integrates over both surfaces. `--contactor` selects the gear whose nodes are eliminated.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, z1=16, z2=24, h=0.15, E=1000.0, wind=0.3, pitches=2.0, steps=20, friction=0.0, contactor=("driver", "driven"),
    coupling=("mortar", "node_to_surface"),
)  # fmt: skip
distance = (args.z1 + args.z2) / 2
n = round(args.steps * args.pitches)

# %% [markdown]
# ## The scene
# The bores follow Functions of the displacement's space, set from the load factor: rotations may be as large as one likes.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "gears.geo", comm, gdim=2, parameters={"z1": args.z1, "z2": args.z2, "h": args.h})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.NeoHooke(args.E, 0.3, kind="plane_strain")
F = material.residual(u, v) * ufl.dx
driver, driven = fem.Function(V), fem.Function(V)
bcs = [uem.dirichlet(V, tags["driver_bore"], None, driver), uem.dirichlet(V, tags["driven_bore"], None, driven)]


def turn(bore: fem.Function, x: float, angle: float) -> None:
    """Turn a bore around (x, 0)."""
    c, s = np.cos(angle) - 1, np.sin(angle)
    bore.interpolate(lambda X: np.stack([c * (X[0] - x) - s * X[1], s * (X[0] - x) + c * X[1]]))


def load(factor: float) -> None:
    """Wind up in the first step, and turn in all."""
    angle = args.pitches * 2 * np.pi / args.z1 * factor
    turn(driver, 0.0, angle + np.radians(args.wind) * min(1.0, n * factor))
    turn(driven, distance, -angle * args.z1 / args.z2)


sides = [tags["driver_flanks"], tags["driven_flanks"]]
contactor, target = sides if args.contactor == "driver" else sides[::-1]
contact = uem.Contact(contactor, target, coupling=args.coupling, friction=args.friction, name="flanks")
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load=load, verbose=args.verbose, petsc_options_prefix="gears_")

# %% [markdown]
# ## Turning
# Torques about both centres and the angle of the line of action, of the force that the driver receives, in each step.

# %%
of = {"on": "contactor" if args.contactor == "driver" else "target"}
writer = uem.ResultsWriter(f"{args.output}/gears", problem) if args.output else None
rows, spent = [], []
for step in uem.load_steps(problem, n):
    first, second = contact.resultant((0.0, 0.0), **of), contact.resultant((distance, 0.0), **of)
    (across, along), torques = np.abs(first.force), [abs(float(np.sum(one.moment))) for one in (first, second)]
    rows.append((step.factor * args.pitches, *torques, np.degrees(np.arctan2(across, along))))
    spent.append((len(step.iterations) - 1, sum(one.exchanges for one in step.iterations), step.cuts))
    if writer:
        writer.write(step)
if writer:
    writer.close()
pitches, T1, T2, angle = np.array(rows).T
iterations, exchanges, cuts = np.sum(spent, axis=0)
ratio = T2.sum() / T1.sum()
results = {
    "torque": float(T1.mean()), "ratio": float(ratio), "ratio_error": float(abs(ratio * args.z1 / args.z2 - 1)),
    "angle": float(angle.mean()), "steps": len(rows), "iterations": int(iterations), "exchanges": int(exchanges), "cuts": int(cuts),
    "dofs": 2 * V.dofmap.index_map.size_global,
}  # fmt: skip
common.report(args, results)

# %% [markdown]
# ## The picture
# The teeth in mesh at the end with their stress, and both torques over the turn.

# %%
if args.plot:
    stress = material.stress(u)
    size = ufl.sqrt(ufl.inner(ufl.dev(stress), ufl.dev(stress)))
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.2)) as (left, right):
        reach, middle = 4.5, args.z1 / 2
        uem.plot_scene(
            problem, left, field=size / args.E, label="deviatoric stress / E", cells=False, levels=np.linspace(0, 2e-3, 11),
            window=(middle - reach, middle + reach, -reach, reach),
        )  # fmt: skip
        if right:
            for values, line in ((T1, "driver: T1"), (T2 * args.z1 / args.z2, "driven gear: T2 z1 / z2")):
                right.plot(pitches, values, "--" if "z" in line else "-", label=line)
            right.set(xlabel="rotation in teeth", ylabel="torque", ylim=(0.0, 1.2 * T1.max()))
            right.grid(alpha=0.25)
            right.legend(frameon=False, loc="upper left", ncol=2)
