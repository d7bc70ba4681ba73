"""Tied meshes: any stress passes through a tie of two meshes that do not match, and a tied cantilever bends as one piece.

python3 demos/tied_patch.py --plot tied_patch.png

Options:
    n: cells along each side of the coarser block, and over the height of the beam at its support
    load: downward force at the end of the cantilever per unit thickness
"""

# %% [markdown]
# # Tied meshes
#
# `tied=True` unites the contactor with its target in all components, for good: parts that were meshed by themselves, coarse here and fine
# there, become one. There are no multipliers and no penalty, and the system stays positive definite: the contactor's displacement is
# eliminated. With mortar this holds in means over the facets, and is exact for every constant stress; tied nodes are exact on nested
# meshes.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import patches

import uem_dolfinx as uem

args = common.arguments(__doc__, n=3, load=1e-3, coupling=("mortar", "node_to_surface"))
E, nu = 1.0, 0.3

# %% [markdown]
# ## The patch test
# Two unit blocks, one upon the other, whose outer nodes follow a linear displacement u = A x with all kinds of strain, or a linear
# temperature: a scalar field is tied in the same words. All others, those of the interface among them, must follow it, too. The error is
# the largest error of displacements, or of stresses in the middles of cells, relative to the largest value; likewise for temperatures and
# fluxes. Meshes are nested for nodes.


# %%
def patch(dim: int, degree: int, cells: tuple[int, int], quads: int, moved: float, scalar: bool) -> float:
    """Largest error of displacement and stress, or temperature and flux, of one scene; arguments as in ``patch_test``."""
    mesh, tags = uem.read_gmsh(
        common.MESHES / "blocks.geo", comm, gdim=dim, parameters={"dim": dim, "n_1": cells[0], "n_2": cells[1], "quads": quads}
    )
    patches.move_nodes(mesh.geometry.x, moved / max(cells))
    V = uem.function_space(mesh, degree, () if scalar else (dim,))
    u, v, exact = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    A = 0.1 * np.array([[1.0, 2.0, 3.0], [0.5, -1.0, 2.0], [1.0, -1.5, 2.0]])[:dim, :dim]
    exact.interpolate(lambda x: A[0] @ x[:dim] if scalar else A @ x[:dim])
    material = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d")
    stress_of = ufl.grad if scalar else material.stress
    outside = [tags[name] for name in ("bottom_1", "top_2", "sides_x", "sides_y") if name in tags]
    nodes = np.unique(np.concatenate([fem.locate_dofs_topological(V, dim - 1, tag.entities) for tag in outside]))
    tie = uem.Contact(tags["bottom_2"], tags["top_1"], coupling=args.coupling, tied=True)
    F = (ufl.inner(ufl.grad(u), ufl.grad(v)) if scalar else material.residual(u, v)) * ufl.dx
    bcs = [fem.dirichletbc(exact, nodes.astype(np.int32))]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[tie])
    problem.solve()
    stress = [fem.Function(uem.function_space(mesh, ("DG", 0), (dim,) if scalar else (dim, dim))) for _ in range(2)]
    for s, field in zip(stress, (u, exact)):
        uem.interpolate(s, stress_of(field))
    found = [(u.x.array, exact.x.array), tuple(s.x.array for s in stress)]
    return max(
        max(comm.allgather(np.abs(got - expected).max(initial=0.0))) / max(comm.allgather(np.abs(expected).max(initial=0.0)))
        for got, expected in found
    )


n = args.n
pairs = [(n, n + 1), (n + 1, n)] if args.coupling == "mortar" else [(n, 2 * n)]
errors: dict[bool, dict[str, float]] = {False: {}, True: {}}
for dim, degree, quads in ((2, 1, 0), (2, 2, 0), (2, 1, 1), (3, 1, 0), (3, 1, 1)):
    for cells in pairs:
        name, moved = f"{dim}d degree {degree}{', quads' if quads else ''}, {cells[0]}:{cells[1]}", 0.2 * (1 - quads)
        for scalar, found in errors.items():
            found[name] = patch(dim, degree, cells, quads, moved if args.coupling == "mortar" else 0.0, scalar)
error = max(max(found.values()) for found in errors.values())

# %% [markdown]
# ## The cantilever
# A beam of two parts that are tied in the middle, with n and n + 1 cells over the height, is compared with one piece with n
# cells. The deflection of the end by Timoshenko is P l^3 / (3 E I) + P l / (5/6 G A). All are of degree 2, in plane stress;
# finite strain makes no difference at this load.


# %%
def beam(parts: int) -> tuple[uem.UnitedProblem, float]:
    """Deflection of the end under a load P."""
    mesh, tags = uem.read_gmsh(common.MESHES / "tied_beam.geo", comm, gdim=2, parameters={"n_1": n, "n_2": n + 1, "parts": parts})
    V = uem.function_space(mesh, 2, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind="plane_stress")
    y = ufl.SpatialCoordinate(mesh)[1]
    # shear is a parabola over the height
    F = material.residual(u, v) * ufl.dx + args.load * 6 * y * (1 - y) * v[1] * uem.ds(tags["end"])
    ties = [uem.Contact(tags["start_2"], tags["end_1"], coupling=args.coupling, tied=True)] if parts == 2 else []
    problem = uem.UnitedProblem(F, u, bcs=[uem.dirichlet(V, tags["support"])], contacts=ties)
    problem.solve()
    return problem, -uem.integrate(u[1] * uem.ds(tags["end"]))


length, inertia, G = 10.0, 1 / 12, E / 2 / (1 + nu)
theory = args.load * (length**3 / (3 * E * inertia) + length / (5 / 6 * G))
(tied, deflection), (_, whole) = beam(2), beam(1)
results = {
    "tied_error": error, "patches": errors[False], "patches_scalar": errors[True],
    "deflection_over_theory": deflection / theory, "one_piece_over_theory": whole / theory,
    "tied_against_one_piece": abs(deflection / whole - 1), "force": float(-tied.contacts[0].resultant().force[1] / args.load),
}  # fmt: skip
common.report(args, results)

# %%
if args.plot:
    material, x = uem.LinearElastic(E, nu, kind="plane_stress"), ufl.SpatialCoordinate(tied.u.function_space.mesh)
    bending = material.stress(tied.u)[0, 0] / (6 * args.load * length)
    with uem.figure(args.plot, comm) as (panel,):
        uem.plot_scene(tied, panel, field=bending, label="bending stress / (6 P l)", levels=np.linspace(-0.8, 0.8, 17), arrows=False,
                       cmap="coolwarm")  # fmt: skip
if args.output:
    with uem.ResultsWriter(f"{args.output}/tied_patch", tied) as writer:
        writer.write(1.0)

# %%
assert error < 1e-11, errors
assert results["tied_against_one_piece"] < 1e-3 and abs(deflection / theory - 1) < 0.01
