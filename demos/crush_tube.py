"""A round tube of aluminium is crushed along its axis into rings of folds that touch themselves, against a published mean force.

mpirun -n 2 python3 demos/crush_tube.py --plot crush_tube.png

Options:
    n: cells through the thickness of the wall
    t: thickness of the wall in mm, of a tube of 40 mm in diameter
    length: of the tube in mm
    stroke: of the press in mm
    speed: of the press in m/s
    friction: coefficient between all surfaces
    film: file of a film, .gif or .mp4
"""

# %% [markdown]
# # A crushed tube
#
# Tubes absorb the energy of a crash: under an axial load a short one folds like a concertina, ring by ring. The force has a peak for
# each fold. Its mean for aluminium tubes was measured as
#
# $$
# F = 72.3\, M \left(\frac{D}{t}\right)^{0.32}, \qquad M = \frac{1}{4} \sigma t^2,
# $$
#
# with the yield stress $\sigma$ [Guillow, Lu and Grzebieta, International Journal of Mechanical Sciences 43 (2001) 2103-2123], for D/t
# from 10 to 450. Alexander's first estimate [Quarterly Journal of Mechanics and Applied Mathematics 13 (1960) 10-15] is lower for thick
# walls, $6\, \sigma t \sqrt{D t}$.
#
# The tube is of an alloy like theirs, which yields at 180 N/mm² and hardens to 225. It is a body of revolution. One declaration
# covers its contact with the press, the bed and itself. Steps are explicit, and the contactors keep their mass: all nodes of a thin
# wall are on its surface.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=2, t=2.0, length=60.0, stroke=36.0, speed=50.0, friction=0.2, film="")
# N, mm, tonnes, s
E, nu, sigma, rho, D = 70e3, 0.33, 180.0, 2.7e-9, 40.0
published = 72.3 * 0.25 * sigma * args.t**2 * (D / args.t) ** 0.32
alexander = 6.0 * sigma * args.t * np.sqrt(D * args.t)

# %%
sizes = {"R": D / 2, "t": args.t, "L": args.length, "n": args.n}
mesh, tags = uem.read_gmsh(common.MESHES / "thin_tube.geo", comm, gdim=2, parameters=sizes)
uem.axisymmetric(mesh)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
metal = uem.FinitePlasticity(u, E, nu, sigma, uem.Voce(increase=45.0, strain=0.05), kind="axisymmetric")

# %% [markdown]
# ## Press and bed
# The lower end cannot slide on the bed. The press moves downwards at a constant speed, so that the first fold forms at the press.

# %%
speed = 1e3 * args.speed
press = uem.RigidPlane((0.0, args.length), (0.0, -1.0), name="press")
bed = uem.RigidPlane((0.0, 0.0), (0.0, 1.0), name="bed")
contact = uem.GeneralContact(rigid=[press, bed], friction=args.friction)
dynamics = uem.Dynamics(uem.lumped_mass(V, rho), scheme=uem.CentralDifferences(), contactors="massy")
problem = uem.UnitedProblem(
    metal.residual(v), u, bcs=[uem.dirichlet(V, tags["bottom"], 0)], contacts=[contact], materials=[metal], dynamics=dynamics,
    load=lambda time: press.move((0.0, -speed * time)), petsc_options_prefix="crush_", verbose=args.verbose,
)  # fmt: skip

# %% [markdown]
# ## The run
# The force on the press is that of the step.

# %%
fields = metal.cell_averages()
look = {"field": fields["peeq"], "label": "plastic strain"}
book, rows = uem.EnergyBook(problem), []
writer = uem.ResultsWriter(f"{args.output}/tube", problem, fields=fields) if args.output else None


def steps():
    """Every 50th step; the book adds up the work of every step, as the force of the press is rough."""
    for step in uem.time_steps(problem, end=args.stroke / speed):
        rows.append((step.time * speed, contact.between("press").force[1]))
        book.write(step)
        if step.number % 50 == 0:
            metal.cell_averages()
            if writer is not None:
                writer.write(step)
            yield step


for _ in uem.animate(args.film, problem, steps(), every=4, **look) if args.film else steps():
    pass
if writer is not None:
    writer.close()

# %%
way, force = np.array(rows).T
force = np.abs(force)
work = float(np.sum(np.diff(way) * force[1:]))
mean = work / (way[-1] - way[0])
last = book.rows[-1]
spent = last.stored + last.dissipated + last.friction + last.kinetic
metal.cell_averages()
results = {
    "unknowns": 2 * V.dofmap.index_map.size_global,
    "steps": len(rows),
    "mean_force": mean,
    "published": published,
    "alexander": alexander,
    "force_error": mean / published - 1,
    "energy_error": max(abs(row.defect) for row in book.rows) / spent,
    "kinetic": last.kinetic / spent,
    "friction": last.friction / spent,
    "plastic_strain": comm.allreduce(float(fields["peeq"].x.array.max(initial=0.0)), op=max),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(4.6, 4.2)) as (left, right):
        uem.plot_scene(problem, left, **look)
        if right is not None:
            width = max(len(way) // 150, 1)
            smooth = np.convolve(force, np.ones(width) / width, "valid")
            right.plot(way[: len(smooth)] + 0.5 * width * (way[1] - way[0]), 1e-3 * smooth, label="press")
            right.axhline(1e-3 * mean, color="C0", ls="--", label="mean")
            right.axhline(1e-3 * published, color="k", lw=1, label="mean by the formula")
            right.set(xlabel="stroke / mm", ylabel="force / kN")
            right.legend(frameon=False, ncol=3, columnspacing=1.0, loc="lower center", bbox_to_anchor=(0.5, 1.0))
            right.grid(alpha=0.25)

# %%
if args.stroke >= 30.0:
    assert abs(results["force_error"]) < 0.15 and results["energy_error"] < 0.01, results
