"""A rubber seal in a groove: meshes for one number, the force on the side wall, with its error estimated.

python3 demos/adapt_seal.py --plot adapt_seal.png

Options:
    tolerance: bound on the estimated error of the force, over the force
    reference: the same for the mesh whose force, with its estimated error added, measures the errors of the others
    squeeze: relative reduction of the seal's height
    uniform: number of uniform meshes, each of half the size of the one before
"""

# %% [markdown]
# # The error of one number
#
# A round seal is squeezed by a plate until it touches the side wall of its groove. The force on that wall keeps the seal tight. It
# is a small difference: most of the deformation is under the plate.
#
# `uem.goal_error` estimates the error of a functional J of the displacement, with its sign. It solves one linear problem of one degree
# more, in which contact is active where that problem needs it. `uem.adapt(make, goal=)` makes meshes for J: an adjoint
# problem gives the cells that the error comes from.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

couplings = ("node_to_surface", "mortar")
args = common.arguments(__doc__, tolerance=0.001, reference=0.00002, squeeze=0.3, uniform=3, coupling=couplings)
law = uem.NeoHooke(1.0, 0.4, kind="plane_strain")


# %% [markdown]
# ## The scene
# A quarter of the seal in plane strain. Its plane of symmetry moves towards the plate, and the arc comes to lie on both sides.


# %%
def make(size, h: float = 0.25) -> uem.UnitedProblem:
    mesh, tags = uem.read_gmsh(common.MESHES / "adapt_seal.geo", comm, gdim=2, parameters={"h": h}, size=size)
    V = uem.function_space(mesh, 2, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["middle"], 1, args.squeeze)]
    plate = uem.Contact(tags["arc"], uem.RigidPlane((0.0, 1.0), (0.0, -1.0)), name="plate", coupling=args.coupling)
    wall = uem.Contact(tags["arc"], uem.RigidPlane((1.05, 0.0), (-1.0, 0.0)), name="wall", coupling=args.coupling)
    return uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, bcs=bcs, contacts=[plate, wall], verbose=args.verbose)


# %% [markdown]
# ## The goal
# The force on the wall is in balance with the force on the vertical plane of symmetry: the work of the residual along a unit
# displacement of its nodes.


# %%
def force(problem: uem.UnitedProblem) -> ufl.Form:
    w = fem.Function(problem.u.function_space)
    w.interpolate(lambda x: np.stack([np.isclose(x[0], 0.0), np.zeros_like(x[0])]).astype(float))
    return law.residual(problem.u, w) * ufl.dx


def solve(problem: uem.UnitedProblem) -> list:
    steps = list(uem.load_steps(problem, 2))
    measured.append(uem.goal_error(problem, force(problem)))
    return steps


# %% [markdown]
# ## Adapted and uniform meshes

# %%
measured: list[uem.GoalError] = []
found = uem.adapt(make, goal=force, tolerance=args.tolerance, solve=solve)
unknowns = [mesh.unknowns for mesh in found.meshes]
for k in range(args.uniform):
    problem = make(None, h=0.25 / 2**k)
    solve(problem)
    unknowns.append(2 * problem.u.function_space.dofmap.index_map.size_global)
best = uem.adapt(make, goal=force, tolerance=args.reference, solve=lambda problem: list(uem.load_steps(problem, 2))).estimate
adapted = len(found.meshes)
exact = best.value + best.error

rows = [
    {
        "mesh": "adapted" if i < adapted else "uniform",
        "unknowns": number,
        "force": one.value,
        "estimate": one.relative,
        "error": one.value / exact - 1,
        "corrected_error": (one.value + one.error) / exact - 1,
        "effectivity": one.error / (exact - one.value),
    }
    for i, (number, one) in enumerate(zip(unknowns, measured))
]
results = {"rows": rows, "force": exact, "reached": found.reached}
results |= {"goal_error": abs(rows[adapted - 1]["error"]), "effectivity": rows[adapted - 1]["effectivity"]}
common.report(args, results)

# %% [markdown]
# ## The picture

# %%
if args.output:
    with uem.ResultsWriter(f"{args.output}/adapt_seal", found.problem, fields={"goal_error": found.estimate.cells}) as writer:
        writer.write(1.0)
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.2)) as (left, right):
    uem.plot_scene(found.problem, left, label="displacement")
    if right:
        for name, marker in (("uniform", "s--"), ("adapted", "o-")):
            own = [row for row in rows if row["mesh"] == name]
            right.loglog(*([abs(row[key]) for row in own] for key in ("unknowns", "error")), marker, ms=4, label=name)
        right.set(xlabel="number of unknowns", ylabel="error of the force on the wall")
        right.legend()
