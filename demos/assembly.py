"""Forces of the bolts of a joint from strains next to them, by exact derivatives through ties, preloads and contact.

python3 demos/assembly.py --plot assembly.png

Options:
    n: number of cells in every direction, as a multiple of those in the mesh file
    first: true force of one bolt in two in N
    second: true force of the others
    pull: known pull of the pipe, over the mean force of a bolt
    noise: standard deviation of the noise in strains, over the largest one
"""

# %% [markdown]
# # How tight are the bolts?
#
# The flanges of [flange.py](flange.py), with one bolt in two tighter than the others. Heads and nuts are tied to their seats, the flanges
# touch on their pads, which open where the pipe is pulled: the strains on the flange are not linear in the forces of the bolts.
#
# Six gauges measure the vertical strain of the rim and of the pipe. The forces that explain them best are found by least squares, with
# the derivatives of all gauges by both forces: `uem.tangent` by `uem.ContactParameter(bolt, "force")`, one solve for each force.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import least_squares

import uem_dolfinx as uem

args = common.arguments(__doc__, n=0.5, first=60e3, second=42e3, pull=0.5, noise=0.01, coupling=("mortar", "node_to_surface"))
E, nu = 2.1e5, 0.3  # MPa, lengths in mm
truth = np.array([args.first, args.second])

# %% [markdown]
# ## The scene
# A quarter of the flanges, with half of a bolt on either plane of symmetry.

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "flange.geo", comm, gdim=3, parameters={"n": args.n})
V = uem.function_space(mesh, 1, (3,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
end = uem.ds(tags["pipe_top"])
pull = args.pull * truth.mean() / uem.integrate(fem.Constant(mesh, 1.0) * end)
F = uem.LinearElastic(E, nu, kind="3d").residual(u, v) * ufl.dx - pull * v[2] * end
bcs = [uem.dirichlet(V, tags[name], c) for c, name in enumerate(("plane_x", "plane_y", "pipe_bottom"))]
faces = {"head": ("under_head", "head_seat"), "nut": ("under_nut", "nut_seat")}
tied = [uem.Contact(tags[one], tags[other], coupling=args.coupling, name=name, tied=True) for name, (one, other) in faces.items()]
joint = uem.Contact(tags["upper_face"], tags["lower_face"], coupling=args.coupling, name="joint")
sections = [(tags[f"upper_section_{i}"], tags[f"lower_section_{i}"]) for i in (1, 2)]
bolts = [uem.Preload(*section, axis=(0, 0, 1), force=0.0, coupling=args.coupling) for section in sections]
problem = uem.UnitedProblem(
    F, u, bcs=bcs, contacts=[*bolts, *tied, joint], rtol=1e-10, petsc_options_prefix="assembly_", verbose=args.verbose
)
x, turns = ufl.SpatialCoordinate(mesh), np.pi / 180 * np.array([10.0, 45.0, 80.0])
places = [(r * np.cos(a), r * np.sin(a), z) for r, z in ((97.0, 12.0), (48.0, 30.0)) for a in turns]
weights = [ufl.exp(-sum((x[i] - p[i]) ** 2 for i in range(3)) / (2 * 6.0**2)) for p in places]
sizes = [uem.integrate(w * ufl.dx) for w in weights]
work = {"solves": 0, "tangents": 0}


# %%
def strains(f: fem.Function) -> np.ndarray:
    """Vertical strains of a displacement at all gauges, means over cells next to them ``(6,)``."""
    return np.array([uem.integrate(w * f[2].dx(2) * ufl.dx) / size for w, size in zip(weights, sizes)])


def tightened(forces: np.ndarray) -> np.ndarray:
    """Strains with these forces of whole bolts."""
    for bolt, force in zip(bolts, forces):
        bolt.tighten(float(force) / 2)
    work["solves"] += len(problem.solve()) - 1
    return strains(u)


def slopes(forces: np.ndarray) -> np.ndarray:
    """Derivatives of the strains by the forces of whole bolts ``(6, 2)``, at the forces of the last solution."""
    tightened(forces)
    work["tangents"] += len(bolts)
    return np.column_stack([strains(uem.tangent(problem, [(uem.ContactParameter(bolt, "force"), 0.5)])) for bolt in bolts])


# %% [markdown]
# ## Measured and identified
# The largest strain is the unit of all. A second set of strains has noise.

# %%
measured = tightened(truth)
unit = np.abs(measured).max()
noisy = measured + args.noise * unit * np.random.default_rng(1).normal(size=len(measured))
rows = []
for name, values in (("exact", measured), ("noisy", noisy)):
    work.update(solves=0, tangents=0)
    found = least_squares(
        lambda f, values=values: (tightened(f * truth.mean()) - values) / unit, np.ones(2),
        jac=lambda f: slopes(f * truth.mean()) * truth.mean() / unit, xtol=1e-12, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    error = float(np.abs(found.x * truth.mean() / truth - 1).max())
    rows.append({"strains": name, "forces": (found.x * truth.mean()).tolist(), "error": error, **work})

way = np.array([1e4, -2e4])
J, slope = tightened(truth), slopes(truth) @ way
order = uem.taylor_test(
    lambda h: float((tightened(truth + h * way)[0] / unit) ** 2), float(2 * J[0] * slope[0] / unit**2), 1e-2, 2, comm
)
tightened(truth)
results = {
    "fits": rows,
    "force_error": rows[0]["error"],
    "force_error_noisy": rows[1]["error"],
    "taylor": order,
    "touching": joint.n_active,
    "joint": joint.resultant().force[2] / (truth.mean() * (1 - args.pull)),
    "unknowns": 3 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Vertical stress in the joint, with displacements 30 times as large.

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/assembly", problem) as writer:
        writer.write(1.0)
if args.plot:
    stress = uem.LinearElastic(E, nu, kind="3d").stress(u)[2, 2]
    solid = common.draws_3d()
    with uem.figure(args.plot, comm, panels=2 if solid else 1) as (*scene, panel):
        if solid:
            uem.plot_scene(problem, scene[0], field=stress, label="vertical stress / MPa", scale=30.0, view=(-1.0, -0.8, 0.55))
        if panel is not None:
            gauges = 1 + np.arange(len(measured))
            panel.plot(gauges, measured * 1e6, "ks", label="measured")
            panel.plot(gauges, noisy * 1e6, "x", label="with noise")
            panel.set(xlabel="gauge", ylabel="vertical strain / 1e-6")
            panel.grid(alpha=0.25)
            panel.legend(frameon=False)

# %%
assert rows[0]["error"] < 1e-6
assert order > 1.9
