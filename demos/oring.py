"""A rubber cord squeezed between plates: nu = 0.4999 from displacements alone, without locking, against a fine mesh.

python3 demos/oring.py --plot oring.png

Options:
    n: cells along each side of the core of the quarter; the reference has four times as many
    squeeze: relative reduction of the cord's height
"""

# %% [markdown]
# # O-ring
#
# The cord of an O-ring is squeezed to three quarters of its height between rigid, greased plates. Rubber hardly changes its volume:
# with nu = 0.4999 bilinear cells that keep it at every point of integration cannot bend, and come out far too stiff; they lock.
# `residual_form` integrates the volumetric part with fewer points.
#
# The pressure on the plates is compared with that on a mesh four times as fine.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=6, degree=1, nu=0.4999, squeeze=0.25, steps=10)
R, E = 1.0, 1.0


# %% [markdown]
# ## The scene
# A quarter in plane strain. Its plane of symmetry is moved towards the plate, on which the arc comes to lie.


# %%
class Cord:
    """A quarter of the cord, squeezed.

    Attributes:
        force: on the plate per length of the cord.
        s, pressure: of all contactors, by their distance from the middle along the arc.
    """

    def __init__(self, n: int, degree: int, full: bool):
        mesh, tags = uem.read_gmsh(common.MESHES / "oring.geo", comm, gdim=2, parameters={"R": R, "n": n, "order": degree})
        V = uem.function_space(mesh, degree, (2,))
        u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.law = uem.NeoHooke(E, args.nu, kind="plane_strain")
        F = self.law.residual(u, v) * ufl.dx if full else self.law.residual_form(u, v)
        bcs = [uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["middle"], 1, args.squeeze * R)]
        self.contact = uem.Contact(tags["arc"], uem.RigidPlane((0.0, R), (0.0, -1.0)), name="plate")
        self.problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[self.contact], verbose=args.verbose)
        self.steps = list(uem.load_steps(self.problem, args.steps))
        self.force = 2 * abs(float(self.contact.resultant().force[1]))
        at = R * np.arctan2(*self.contact.points.T)
        s, p = (np.concatenate(comm.allgather(part)) for part in (at, self.contact.pressures))
        self.s, self.pressure = s[np.argsort(s)], p[np.argsort(s)]

    @property
    def iterations(self) -> int:
        """Newton iterations of all steps."""
        return sum(step.newton_iterations for step in self.steps)


# %% [markdown]
# ## The figures
# The error of the pressure is the rms deviation of nodal pressures, over the largest pressure.

# %%
reference = Cord(4 * args.n, args.degree, full=False)
rows, cords = [], {}
for integration in ("fewer points", "full"):
    cord = cords[integration] = Cord(args.n, args.degree, full=integration == "full")
    wanted = np.interp(cord.s, reference.s, reference.pressure)
    rows.append(
        {
            "integration": integration,
            "force": cord.force,
            "force_error": cord.force / reference.force - 1,
            "pressure_error": float(np.sqrt(np.mean((cord.pressure - wanted) ** 2)) / reference.pressure.max()),
            "largest": float(cord.pressure.max()),
            "newton_iterations": cord.iterations,
            "cuts": sum(step.cuts for step in cord.steps),
        }
    )
results = {
    "rows": rows,
    "reference_force": reference.force,
    "reference_largest": float(reference.pressure.max()),
    "force_error": abs(rows[0]["force_error"]),
    "pressure_error": rows[0]["pressure_error"],
    "locking": rows[1]["force_error"],
}
common.report(args, results)
good = cords["fewer points"]
if args.output:
    with uem.ResultsWriter(f"{args.output}/oring", good.problem) as writer:
        writer.write(good.steps[-1])

# %%
with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.4)) as (left, right):
    uem.plot_scene(good.problem, left, mirror=True)
    if right:
        right.plot(reference.s, reference.pressure, "0.5", label="four times as fine")
        for name, cord in cords.items():
            right.plot(cord.s, cord.pressure, ".", label=name)
        right.set(xlabel="distance from the middle along the arc", ylabel="pressure / E", xlim=(0.0, 1.2), ylim=(0.0, None))
        right.grid(alpha=0.25)
        right.legend(frameon=False)

# %%
if args.nu > 0.49:
    assert results["force_error"] < 0.02 and results["pressure_error"] < 0.06, results
