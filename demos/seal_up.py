"""A rubber seal pressed into its groove at nu = 0.5: the pressure is a field of its own, and contact leaves it alone.

python3 demos/seal_up.py --plot seal.png

Options:
    n: cells along each side of the core of the quarter; the reference has four times as many
    squeeze: relative reduction of the cord's height
    wall: distance of each side wall from the middle relative to the cord's radius
"""

# %% [markdown]
# # Seal in displacement and pressure
#
# An O-ring of rubber that keeps its volume is squeezed to three quarters of its height in a groove, until it touches both side walls.
# At nu = 0.5 the pressure no longer follows from the displacement: it is a second unknown, of one degree less (Taylor and Hood).
# The contacts unite components of the displacement; the pressure is a part of the same mixed space, and stays as it is.
#
# The force is compared with the result of `oring.py` on a mesh four times as fine, with displacements as the only unknowns, nu = 0.4999
# and reduced integration.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, squeeze=0.25, wall=1.12, steps=10)
R, E = 1.0, 1.0


# %% [markdown]
# ## The scene
# A quarter of the cord in plane strain: its plane of symmetry moves towards the plate, and it grows sideways up to the wall.


# %%
class Seal:
    """A quarter of the cord, pressed into the groove.

    Attributes:
        force: on the plate per length of the cord.
        side: on the wall.
        volume: of the cord, over the initial one.
    """

    def __init__(self, n: int, nu: float, mixed: bool):
        degree = 2 if mixed else 1
        mesh, tags = uem.read_gmsh(common.MESHES / "oring.geo", comm, gdim=2, parameters={"R": R, "n": n, "order": degree})
        parts = [("Lagrange", 2, (2,)), ("Lagrange", 1)]
        W = uem.function_space(mesh, parts) if mixed else uem.function_space(mesh, 1, (2,))
        w, test = fem.Function(W, name="displacement"), ufl.TestFunction(W)
        if mixed:
            (u, p), V = ufl.split(w), W.sub(0)
            grad, mu, compliance = ufl.Identity(2) + ufl.grad(u), E / (2 * (1 + nu)), (1 - 2 * nu) * (1 + nu) / (E * nu)
            J = ufl.det(grad)
            energy = mu / 2 * (ufl.inner(grad, grad) - 2 - 2 * ufl.ln(J)) + p * (J - 1) - compliance / 2 * p**2
            F = ufl.derivative(energy * ufl.dx, w, test)
        else:
            (u, V), F = (w, W), uem.NeoHooke(E, nu, kind="plane_strain").residual_form(w, test)
            J = ufl.det(ufl.Identity(2) + ufl.grad(u))
        bcs = [uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["middle"], 1, args.squeeze * R)]
        self.plate = uem.Contact(tags["arc"], uem.RigidPlane((0.0, R), (0.0, -1.0)), name="plate")
        self.wall = uem.Contact(tags["arc"], uem.RigidPlane((args.wall * R, 0.0), (-1.0, 0.0)), name="wall")
        self.problem = uem.UnitedProblem(
            F, w, displacement=0 if mixed else None, bcs=bcs, contacts=[self.plate, self.wall], verbose=args.verbose
        )
        self.steps = list(uem.load_steps(self.problem, args.steps))
        self.force, self.side = 2 * abs(float(self.plate.resultant().force[1])), 2 * abs(float(self.wall.resultant().force[0]))
        self.volume = uem.integrate(J * ufl.dx) / uem.integrate(fem.Constant(mesh, 1.0) * ufl.dx)


# %% [markdown]
# ## The figures
# A body of nu = 0.5 keeps its volume in the mean of every pressure's neighbourhood, and so in all.

# %%
reference = Seal(4 * args.n, 0.4999, mixed=False)
rows, seals = [], {}
for nu in (0.4999, 0.49999, 0.5):
    seal = seals[nu] = Seal(args.n, nu, mixed=True)
    rows.append({
        "nu": nu,
        "force": seal.force,
        "force_error": seal.force / reference.force - 1,
        "side": seal.side,
        "side_error": seal.side / reference.side - 1,
        "volume_change": seal.volume - 1,
        "newton_iterations": sum(step.newton_iterations for step in seal.steps),
    })  # fmt: skip
results = {
    "rows": rows,
    "reference_force": reference.force,
    "reference_side": reference.side,
    "seal_error": max(abs(rows[-1]["force_error"]), abs(rows[-1]["side_error"])),
}
common.report(args, results)
good = seals[0.5]
if args.output:
    with uem.ResultsWriter(f"{args.output}/seal", good.problem) as writer:
        writer.write(good.steps[-1])

# %%
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.6)) as (left, right):
    uem.plot_scene(good.problem, left, field=ufl.split(good.problem.u)[1], label="p / E", mirror=True)
    for name, seal in (("four times as fine, displacements", reference), ("displacement and pressure, nu = 0.5", good)):
        at = [np.concatenate(comm.allgather(part)) for part in (seal.plate.points[:, 0], seal.plate.pressures)]
        if right:
            order = np.argsort(at[0])
            right.plot(at[0][order], at[1][order], "0.5" if seal is reference else ".", label=name)
    if right:
        right.set(xlabel="distance from the middle", ylabel="pressure on the plate / E", ylim=(0.0, 1.0))
        right.grid(alpha=0.25)
        right.legend(frameon=False, loc="upper right")

# %%
assert results["seal_error"] < 0.02, results
