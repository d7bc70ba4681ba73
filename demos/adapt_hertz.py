"""A cylinder on a block from a mesh that does not know where they touch: cells follow the estimated error.

python3 demos/adapt_hertz.py --plot adapt_hertz.png

Options:
    tolerance: bound on the estimated error in the energy norm
    reference: tolerance of the mesh whose energy measures the errors of the others
"""

# %% [markdown]
# # A mesh that finds the contact
#
# A quarter disc is pressed onto a block, as in `hertz_cylinder.py`. That demo's mesh is graded by hand: the cells at the contact are a
# hundred times smaller than those far away, since the author knew its width. Here the first mesh has cells of one size, eight times the
# half width of the contact.
#
# `uem.error_estimate` evaluates the residual of a solution in a space of one degree more, with the contact pressure on both bodies.
# `uem.adapt` gives each cell the same share of the squared error, and Gmsh meshes the bodies anew.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, tolerance=0.0035, reference=0.001, degree=2, coupling=("mortar", "node_to_surface"),
)  # fmt: skip
E, nu, R = 1e6, 0.3, 3.0
material = uem.LinearElastic(E, nu, kind="plane_strain")


# %% [markdown]
# ## The scene
# It is a function of the sizes of cells, which go to `read_gmsh`. Curved cells follow the arc on every mesh.


# %%
def make(size) -> uem.UnitedProblem:
    mesh, tags = uem.read_gmsh(common.MESHES / "adapt_hertz.geo", comm, gdim=2, parameters={"order": args.degree}, size=size)
    V = uem.function_space(mesh, args.degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    F = material.residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.006)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"], coupling=args.coupling)
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], verbose=args.verbose)


# %% [markdown]
# ## Against Hertz
# The bodies are finite, so the force P comes from the computation, and pressures are compared with Hertz at that P.


# %%
def hertz(contact: uem.Contact):
    """Largest pressure and half width after Hertz, positions and pressures on this mesh in the order of x."""
    P = 2 * float(contact.resultant().force[1])
    p0 = np.sqrt(P * E / (2 * (1 - nu**2)) / (np.pi * R))
    x, p = (np.concatenate(comm.allgather(part)) for part in (contact.points[:, 0], contact.pressures))
    order = np.argsort(x)
    return p0, 2 * P / (np.pi * p0), x[order], p[order]


def pressure_error(contact: uem.Contact) -> float:
    """Root mean square of the pressures' errors within 0.95 a, over the largest pressure."""
    p0, a, x, p = hertz(contact)
    inside = x < 0.95 * a
    return float(np.sqrt(np.mean((p[inside] / p0 - np.sqrt(1 - (x[inside] / a) ** 2)) ** 2)))


# %% [markdown]
# ## The error of the estimate
# A solution on a finer mesh has less energy. In a linear problem under prescribed displacements the squared error is the difference of
# the energies, but for the small work of gaps between nodes.

# %%
energies, errors = [], []


def solve(problem: uem.UnitedProblem):
    steps = problem.solve()
    energies.append(2 * comm.allreduce(fem.assemble_scalar(uem.form(material.energy(problem.u) * ufl.dx))))
    errors.append(pressure_error(problem.contacts[0]))
    return steps


found = uem.adapt(make, tolerance=args.tolerance, solve=solve)
exact = uem.error_estimate(uem.adapt(make, tolerance=args.reference).problem).norm ** 2
by_hand, _ = uem.read_gmsh(common.MESHES / "hertz_cylinder.geo", comm, gdim=2)  # of degree 1, with an error of pressures of 0.5 %
rows = [
    {
        "cells": mesh.cells,
        "unknowns": mesh.unknowns,
        "estimate": mesh.estimate,
        "error": np.sqrt(abs(energy - exact) / energy),
        "pressure_error": error,
        "iterations": mesh.iterations,
        "seconds": mesh.seconds,
    }
    for mesh, energy, error in zip(found.meshes, energies, errors)
]
results = {
    "rows": rows,
    "effectivity": rows[-1]["estimate"] / rows[-1]["error"],
    "pressure_error": rows[-1]["pressure_error"],
    "unknowns_ratio": rows[-1]["unknowns"] / (2 * by_hand.topology.index_map(0).size_global),
    "reached": found.reached,
}
common.report(args, results)

# %% [markdown]
# ## The picture

# %%
p0, a, x, p = hertz(found.problem.contacts[0])
if args.output:
    with uem.ResultsWriter(
        f"{args.output}/adapt_hertz", found.problem, fields={"error_estimate": found.estimate.cells}
    ) as writer:
        writer.write(1.0)
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.2)) as (left, right):
    uem.plot_scene(found.problem, left, window=(0, 6 * a, -3 * a, 3 * a), label="displacement")
    if right:
        fine = np.linspace(0.0, 1.0, 200)
        right.plot(fine, np.sqrt(1 - fine**2), "k-", lw=1, label="Hertz")
        right.plot(x / a, p / p0, "o", ms=3, label="solution")
        right.set(xlabel="position x / a", ylabel="pressure p / p0", xlim=(0, 1.3))
        right.legend()
