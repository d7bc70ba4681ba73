"""The stiffest beam that lies on its supports: topology optimisation by exact gradients through the contact.

python3 demos/topology.py --plot topology.png

Options:
    n: cells through the height of the beam
    rest: length at each end of the beam that lies on a plane
    volume: part of the beam's area that is filled
    radius: of the filter, in cells
    iterations: steps of the optimality criteria
"""

# %% [markdown]
# # Supports that do not pull
#
# A beam is loaded in its middle, and its ends lie on planes. How is a given amount of material stiffest? Rollers that hold the ends up and
# down clamp them, and a design that is made on rollers relies on their pull; on planes such ends lift off.
#
# Densities x of the cells are filtered, `rho - r^2 div grad rho = x` (Lazarov and Sigmund, 2011, doi:10.1002/nme.3072), and Young's modulus
# is `rho^3` (SIMP), at least 1e-9. The middle moves down by a unit, so that the largest force is the least compliance. The gradient of the
# force takes an adjoint problem (`uem.gradient`) and one of the filter. Optimality criteria multiply densities by the root of what they add
# to the force, and keep the area.
#
# One design is made on planes and one on rollers; then both lie on planes. Two checks:
#
# - a support in one point cannot let go: the plane must lead to the design of the roller. This is the beam of Andreassen et al. (2011,
#   doi:10.1007/s00158-010-0594-7), of compliance 233.71 with 60 x 20 cells and a filter by weighted means of the same radius;
# - if contactors press at the edges of the planes alone in the end, the force is that on rollers there.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc
from scipy.optimize import brentq

import uem_dolfinx as uem

args = common.arguments(__doc__, n=20, rest=1.0, volume=0.3, radius=2.4, iterations=60)
MOVE, PUBLISHED = 0.2, 233.71

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "topology.geo", comm, gdim=2, parameters={"n": args.n, "rest": args.rest})
V, S, D = uem.function_space(mesh, 1, (2,)), uem.function_space(mesh, 1), uem.function_space(mesh, ("DG", 0))
u, v, rho = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(S, name="density")
material = uem.LinearElastic(1e-9 + (1 - 1e-9) * rho**3, 0.3, kind="plane_stress")
F = material.residual(u, v) * uem.dx(tags["beam"], quadrature_degree=2)
down = fem.Function(V)  # a unit motion of the loaded point, along which the residual's work is the force
down.x.array[fem.locate_dofs_topological(V.sub(1), 0, tags["load"].entities)] = -1.0
down.x.scatter_forward()
force, work = ufl.replace(F, {v: down}), {"solves": 0, "gradients": 0}


def beam(part: str, support: str) -> uem.UnitedProblem:
    """The beam with a part on a plane, or on rollers."""
    u.x.array[:] = 0.0
    bcs, contacts = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["load"], 1, -1.0)], []
    if support == "plane":
        contacts = [uem.Contact(tags[part], uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))]
    else:
        bcs.append(uem.dirichlet(V, tags[part], 1))
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=contacts, rtol=1e-10, petsc_options_prefix="topology_", verbose=args.verbose)


# %%
p, q, w, r = ufl.TrialFunction(D), ufl.TrialFunction(S), ufl.TestFunction(S), args.radius / args.n / np.sqrt(12)
filtering = q * w + r**2 * ufl.dot(ufl.grad(q), ufl.grad(w))
A, B = (petsc.assemble_matrix(fem.form(a * ufl.dx)) for a in (filtering, p * w))
A.assemble(), B.assemble()
ksp, (cells, nodes) = PETSc.KSP().create(comm), B.createVecs()
ksp.setOperators(A)
ksp.setTolerances(rtol=1e-13)


def load(problem: uem.UnitedProblem, x: np.ndarray) -> float:
    """The force on a design, of densities of the owned cells."""
    cells.array[:] = x
    ksp.solve(B * cells, nodes)
    rho.x.array[: nodes.local_size] = nodes.array
    rho.x.scatter_forward()
    work["solves"] += len(problem.solve()) - 1
    return uem.integrate(force)


def designs(problem: uem.UnitedProblem, volume: float):
    """Densities of the owned cells, and the force, of one design after the other."""
    x = np.full(cells.local_size, volume)
    yield x, load(problem, x)
    for _ in range(args.iterations):
        nodes.array[:] = uem.gradient(problem, force, rho)[0].x.array[: nodes.local_size]
        work["gradients"] += 1
        ksp.solve(nodes.copy(), nodes)
        B.multTranspose(nodes, cells)
        x = grown(x, np.maximum(cells.array, 0.0) / cells.max()[1], volume)
        yield x, load(problem, x)


def grown(x: np.ndarray, gains: np.ndarray, volume: float) -> np.ndarray:
    """Densities by the optimality criteria."""
    at = lambda m: np.clip(x * np.sqrt(gains / m), np.maximum(x - MOVE, 0.0), np.minimum(x + MOVE, 1.0))  # noqa: E731
    return at(brentq(lambda m: comm.allreduce(at(m).sum()) / cells.size - volume, 1e-12, 1 / volume**2))


# %%
*_, (x_plane, single) = designs(beam("end", "plane"), 0.5)
*_, (x_roller, _) = designs(beam("end", "roller"), 0.5)
*_, (x_held, _) = designs(beam("rest", "roller"), args.volume)
problem = beam("rest", "plane")
steps = designs(problem, args.volume)
how = {"field": rho, "label": "density", "cmap": "Greys", "scale": 0.15, "cells": False, "mirror": True}
how["levels"] = np.linspace(0.0, 1.0, 6)
if args.output:
    steps = uem.animate(f"{args.output}/topology.gif", problem, steps, every=2, size=(7.2, 2.4), **how)
*_, (x, lying) = steps
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.0)) as panels:
    uem.plot_scene(problem, panels[1], **how)
    released = load(problem, x_held)
    uem.plot_scene(problem, panels[0], **how)
    if panels[0]:
        panels[0].set_title(f"optimised on rollers: compliance {1 / released:.1f}")
        panels[1].set_title(f"optimised on planes: compliance {1 / lying:.1f}")

# %%
results = {
    "compliance": 1 / lying,
    "compliance_made_on_rollers": 1 / released,
    "gain": lying / released - 1,
    "objective_error": abs(load(beam("edge", "roller"), x) / lying - 1),
    "design_error": comm.allreduce(float(np.abs(x_plane - x_roller).max()), common.MPI.MAX),
    "published_error": abs(1 / single / PUBLISHED - 1),
    **work,
    "dofs": 2 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %%
assert results["objective_error"] < 1e-8 and results["design_error"] < 1e-8 and results["gain"] > 0
