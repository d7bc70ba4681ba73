"""Heat of friction: a pad on a rigid disc, whose temperature is known, and an elastic block on a base that is drawn under it.

mpirun -n 2 python3 demos/brake.py --plot brake.png

Options:
    n: cells over the height of the block
    steps: time steps until 0.4 of the time that heat takes through the block
"""

# %% [markdown]
# # Brake
#
# A pad is pressed by a pressure p onto a disc that moves past it with the speed v. Friction makes the heat `mu p v` per area, of which
# the share f enters the pad. A guided and insulated pad has the temperature of a slab of thickness H under a constant flux: a series at
# first, later a parabola that rises at a constant rate.
#
# An elastic block that is held at its tail tilts under the drag: pressures differ from place to place, and a base of the same material
# takes the other half of the heat. What both have in them is the work of friction, to rounding.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=8, steps=30, coupling=("node_to_surface", "mortar"))
mu, pressure, speed, rho_c, k, H, E, nu = 0.4, 1e6, 1.0, 2e6, 40.0, 0.05, 1e10, 0.2  # m, s, N, K
end = 0.4 * H**2 * rho_c / k


# %% [markdown]
# ## The scene
# The residual has heat by backward differences in time, from the state `w_old` of the last step; the conductance gets the same `dt`, by
# which the work of a step becomes a power. The weight presses. The block is as wide as four times its height.


# %%
class Brake:
    """A block of height H that friction heats, on a rigid disc or on a base.

    Attributes:
        contact: of the block's bottom.
        problem: displacement and temperature.
    """

    def __init__(self, base: bool):
        sizes = {"n": args.n, "length": 4 * H, "height": H, "base": int(base), "apron": H, "depth": H, "n_base": args.n - 1}
        mesh, tags = uem.read_gmsh(common.MESHES / "sliding_block.geo", comm, gdim=2, parameters=sizes)
        W = uem.function_space(mesh, [("Lagrange", 1, (2,)), 1])
        self.w, self.old, (v, q) = fem.Function(W), fem.Function(W), ufl.TestFunctions(W)
        (u, self.T), T_old = ufl.split(self.w), ufl.split(self.old)[1]
        self.dt, self.way = fem.Constant(mesh, end / args.steps), fem.Constant(mesh, 0.0)
        F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx + pressure / H * v[1] * uem.dx(tags["block"])
        F += (rho_c * (self.T - T_old) / self.dt * q + k * ufl.inner(ufl.grad(self.T), ufl.grad(q))) * ufl.dx
        self.disc = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
        if base:
            bcs = [uem.dirichlet(W.sub(0), tags["base_bottom"], 0, self.way), uem.dirichlet(W.sub(0), tags["base_bottom"], 1)]
            bcs += [uem.dirichlet(W.sub(0), tags["block_tail"], 0)]
            heat = uem.Conductance(k / H, field=1, friction_share=0.5, dt=self.dt)
        else:
            # guided along the disc, and cold behind the contact, which conducts nothing
            bcs = [uem.dirichlet(W.sub(0), tags["block"], 0)]
            heat = uem.Conductance(0.0, field=1, temperature=0.0, friction_share=0.5, dt=self.dt)
        target = tags["base_top"] if base else self.disc
        self.contact = uem.Contact(tags["block_bottom"], target, friction=mu, coupling=args.coupling, heat=heat, name="brake")
        self.problem = uem.UnitedProblem(F, self.w, displacement=0, bcs=bcs, contacts=[self.contact], rtol=1e-11)

    def slide(self, way: float) -> None:
        """Press, and draw the disc or the base under the block by ``way`` in all, in equal steps."""
        for i in range(-1, args.steps + 1):
            # under the first pressure by a little before, so that there is friction where the first step begins
            self.way.value = way * (i if i > 0 else 1e-3 * i) / args.steps
            self.disc.move((self.way.value, 0.0))
            self.problem.solve()
            if i > 0:
                self.old.x.array[:] = self.w.x.array
            else:
                self.work_before = self.contact.dissipation

    @property
    def work(self) -> float:
        """Of friction in the time steps."""
        return self.contact.dissipation - self.work_before

    @property
    def heat(self) -> float:
        """What the bodies have more of than at the start."""
        return uem.integrate(rho_c * self.T * ufl.dx)


# %% [markdown]
# ## The pad
# Temperatures of all nodes of the contact are compared with the slab's.


# %%
def slab(depth, t: float):
    """Temperature under the flux ``mu p v / 2`` from one side, at depths below it."""
    n, z, flux = np.arange(1, 200)[:, None], 1.0 - np.atleast_1d(depth) / H, 0.5 * mu * pressure * speed
    series = ((-1.0) ** n / n**2 * np.exp(-((n * np.pi) ** 2) * k * t / (rho_c * H**2)) * np.cos(n * np.pi * z)).sum(axis=0)
    return flux * t / (rho_c * H) + flux * H / k * ((3 * z**2 - 1) / 6 - 2 / np.pi**2 * series)


pad = Brake(base=False)
pad.slide(speed * end)
temperature = pad.problem.config.functions()["field_1"]
x, T = temperature.function_space.tabulate_dof_coordinates()[:, 1], temperature.x.array
exact = slab(x, end)
temperature_error = comm.allreduce(np.abs(T - exact).max(initial=0.0), op=common.MPI.MAX) / float(slab(0.0, end)[0])
pad_error = pad.heat / (0.5 * pad.work) - 1
work_error = pad.work / (mu * pressure * 4 * H * speed * end) - 1

# %% [markdown]
# ## The block on a base

# %%
block = Brake(base=True)
block.slide(0.9 * H)
block_error = block.heat / block.work - 1
results = {
    "heat_error": max(abs(pad_error), abs(block_error), abs(work_error)),
    "temperature_error": temperature_error,
    "pad_error": pad_error,
    "work_error": work_error,
    "block_error": block_error,
    "balance": block.contact.heat_balance(),
    "surface_temperature": float(slab(0.0, end)[0]),
    "steps": args.steps,
}
common.report(args, results)
if args.output:
    with uem.ResultsWriter(f"{args.output}/brake", block.problem) as writer:
        writer.write(args.steps)

# %% [markdown]
# ## The picture
# The temperature through the pad, and in block and base.

# %%
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.0)) as (left, right):
    uem.plot_scene(block.problem, right, field=block.T, label="T / K")
    depth, found = (np.concatenate(comm.allgather(part)) for part in (x, T))
    if left:
        order = np.argsort(depth)
        left.plot(depth[order] / H, found[order], ".", label="pad")
        left.plot(np.linspace(0, 1), slab(np.linspace(0, H), end), "k-", lw=1, label="slab")
        left.set(xlabel="distance from the disc / H", ylabel="temperature / K")
        left.legend(frameon=False)

# %%
assert results["heat_error"] < 1e-10 and results["temperature_error"] < 0.01, results
