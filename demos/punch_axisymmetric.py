"""A rounded punch pressed into a cylinder, axisymmetric, with friction and without: the NAFEMS contact benchmark 2.

python3 demos/punch_axisymmetric.py --plot punch_axisymmetric.png

Options:
    n: cells around the punch's rounded edge, on the coarsest mesh
"""

# %% [markdown]
# # A rounded punch on a cylinder
#
# A punch of steel (E = 210 GPa, radius 50 mm, height 100 mm, its edge rounded by 10 mm) stands on a cylinder of aluminium. The
# cylinder (70 GPa, radius 100 mm, height 200 mm) is held at its bottom; nu = 0.3, and 100 MPa press on the punch, without
# friction and with mu = 0.1. It is benchmark 2 of A. Konter, *Advanced Finite Element Contact Benchmarks* (NAFEMS R0094, 2006),
# and test SSNA122 of code_aster, which compares the settlement at M, the middle of the cylinder's face: with quadratic cells
# (model B) -0.132941 mm and -0.130794 mm, of the law of St Venant-Kirchhoff under a dead load.
#
# These are figures of one mesh: at the end of the flat face pressures rise to six times their mean over less than a millimetre, and every
# mesh without cells as small is too stiff there. code_aster's linear cells (model A) give -0.130734 mm and -0.128580 mm. The mesh is not
# described; with 12 cells around the edge, as solids4foam uses for the same benchmark, the result agrees with code_aster's quadratic
# cells; finer cells give the converged value.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=12, refinements=3, degree=2, coupling=("node_to_surface", "mortar"), steps=2)
FRICTION = (0.0, 0.1)
#: Settlements of code_aster's test SSNA122B, in mm.
PUBLISHED = {0.0: -0.13294119, 0.1: -0.13079353}
PRESSURE = 100.0

# %% [markdown]
# ## One scene
# One half of the section, x is the radius: `uem.axisymmetric` says so, and laws are of that kind. Loads are per area, and forces those
# of the whole punch.


# %%
def settle(n: int, mu: float) -> tuple[uem.UnitedProblem, dict[str, float]]:
    """Press the punch down on a mesh with n cells around its edge: problem, and figures measured."""
    mesh, tags = uem.read_gmsh(common.MESHES / "punch_axisymmetric.geo", comm, gdim=2, parameters={"n": n, "order": args.degree})
    uem.axisymmetric(mesh)
    V = uem.function_space(mesh, args.degree, (2,))
    u, v, p = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Constant(mesh, 0.0)
    F = p * v[1] * uem.ds(tags["top"])
    for body, E in (("punch", 210e3), ("foundation", 70e3)):
        F += uem.StVenantKirchhoff(E, 0.3, kind="axisymmetric").residual(u, v) * uem.dx(tags[body])
    bcs = [uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["bottom"])]
    contact = uem.Contact(tags["punch_face"], tags["foundation_top"], coupling=args.coupling, friction=mu)
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], load={p: PRESSURE}, petsc_options_prefix="punch_", verbose=args.verbose
    )
    iterations = sum(len(step.iterations) - 1 for step in uem.load_steps(problem, args.steps))
    nodes, owned = fem.locate_dofs_topological(V, 0, tags["centre"].entities), problem.config.n_owned
    settlement = comm.allreduce(float(u.x.array[2 * nodes[nodes < owned] + 1].sum()))
    edge = max(comm.allgather(contact.points[contact.pressures > 0, 0].max(initial=0.0)))
    return problem, {
        "n": n,
        "friction": mu,
        "settlement": settlement,
        "error": abs(settlement / PUBLISHED[mu] - 1),
        "max_pressure": contact.max_pressure(),
        "contact_radius": float(edge),
        "force_error": float(abs(contact.resultant().force[1] / (PRESSURE * np.pi * 50.0**2) - 1)),
        "dissipation": contact.dissipation,
        "newton_iterations": iterations,
        "dofs": 2 * V.dofmap.index_map.size_global,
    }


# %% [markdown]
# ## The figures
# The first mesh is the one compared; every one after it has half the size of cells.

# %%
problems, rows = {}, []
for k in range(args.refinements):
    for mu in FRICTION:
        problem, figures = settle(args.n * 2**k, mu)
        rows.append(figures)
        problems[mu] = problem
first = rows[: len(FRICTION)]
common.report(args, {"punch_error": max(row["error"] for row in first), **rows[-1], "meshes": rows})

# %% [markdown]
# ## The picture
# The strain around the axis, and the pressures over the radius, on the last mesh; the settlements on all meshes and those published.

# %%
if args.plot:
    problem = problems[FRICTION[-1]]
    hoop = uem.StVenantKirchhoff(1.0, 0.3, kind="axisymmetric").strain(problem.u)[2, 2]
    with uem.figure(args.plot, comm, panels=3) as (left, middle, right):
        uem.plot_scene(problem, left, field=1e3 * hoop, label="hoop strain / 0.001", mirror=True, cells=False, arrows=False)
        uem.plot_pressure(problem.contacts, right, along=lambda x: x[:, 0], along_label="radius in mm", window=(0.0, 45.0))
        if middle is not None:
            for k, mu in enumerate(FRICTION):
                cells, settlements = zip(*((row["n"], 1e3 * row["settlement"]) for row in rows if row["friction"] == mu))
                middle.plot(cells, settlements, "o-", color=f"C{k}", label=f"mu = {mu:g}")
                middle.axhline(1e3 * PUBLISHED[mu], color=f"C{k}", ls="--", lw=1, label="code_aster")
            middle.set_xscale("log", base=2)
            middle.set_xticks(cells, [str(n) for n in cells])
            middle.set_xlabel("cells around the edge")
            middle.set_ylabel("settlement of M in micrometres")
            middle.grid(alpha=0.25)
            middle.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=2, columnspacing=1.0)
if args.output:
    with uem.ResultsWriter(f"{args.output}/punch_axisymmetric", problems[FRICTION[-1]]) as writer:
        writer.write(1.0)

# %%
assert max(row["force_error"] for row in rows) < 1e-8
if args.degree == 2 and args.n == 12:
    assert max(row["error"] for row in first) < 1e-3
