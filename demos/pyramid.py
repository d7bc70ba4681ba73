"""Pyramids of 3, 6 and 10 discs without friction between two walls: the forces on the floor and the walls.

python3 demos/pyramid.py --plot pyramid.png

Options:
    bases: discs in the lowest row of each pyramid, comma-separated
    n: sides of the coarsest discs, a multiple of 24
    apart: gap between the discs of a row relative to their diameter
"""

# %% [markdown]
# # Pyramids of discs
#
# Equal discs of weight w lie in rows on a floor, one less in each row above, between two walls and without friction. Discs of one row
# touch only where they are pushed together. A disc then rests on two below, at 30 degrees from the vertical. Its force on each of them
# is the force from the disc above on the same side, plus w / sqrt 3. So the k-th disc from the top of a side pushes with k w / sqrt 3, and
#
# $$
# F_{floor} = \frac{n (n + 1)}{2} w,
# \qquad F_{wall} = \left\lfloor \frac{n^2}{4} \right\rfloor \frac{w}{2 \sqrt 3} \quad \text{for } n \text{ discs in the lowest row.}
# $$
#
# For n = 4 the outer discs of the lowest row touch the inner ones, which are pushed outwards as well.
#
# Nothing holds the discs but contact, and nothing keeps smooth discs from turning. Here they are polygons whose sides rest on each
# other, so that contact does: turned, they would stand higher. Those that meet have different numbers of sides, so that the nodes of one
# side lie within the other. With equally many sides the nodes of both coincide, a node may as well touch the next side, whose normal is
# another one, and ten discs turn into another equilibrium. The density makes up for the areas of the polygons.
#
# There are no supports, no springs and no inertia: the discs are found at rest in one load step. All contacts are one declaration.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, bases="2,3,4", n=24, E=1e7, apart=1e-4)
R, g, w = 0.5, 1.0, 1.0


# %% [markdown]
# ## The scene
# Discs are so stiff that their deformation, some w / E of their size, hardly changes the angles.


# %%
def pyramid(base: int) -> tuple[uem.UnitedProblem, uem.GeneralContact]:
    """A pyramid with so many discs in its lowest row."""
    sizes = {"base": base, "R": R, "apart": args.apart, "n": args.n}
    mesh, tags = uem.read_gmsh(common.MESHES / "pyramid.geo", comm, gdim=2, parameters=sizes)
    rho = fem.Function(uem.function_space(mesh, ("DG", 0)))
    for name, times in (("coarse", 1.0), ("middle", 1.5), ("fine", 2.5)):
        sides = times * args.n
        rho.x.array[tags[name].entities] = w / (g * sides * R**2 * np.tan(np.pi / sides))
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.StVenantKirchhoff(args.E, 0.3, kind="plane_strain")

    right = 2 * R * (1 + args.apart) * (base - 1) + R
    walls = [
        uem.RigidPlane((0.0, 0.0), (0.0, 1.0)),
        uem.RigidPlane((-R, 0.0), (1.0, 0.0)),
        uem.RigidPlane((right, 0.0), (-1.0, 0.0)),
    ]
    contact = uem.GeneralContact(rigid=walls)
    F = (material.residual(u, v) + rho * g * v[1]) * ufl.dx
    return uem.UnitedProblem(F, u, contacts=[contact], petsc_options_prefix="pyramid_", verbose=args.verbose), contact


# %% [markdown]
# ## At rest
# Between discs, the horizontal parts of all forces are whole multiples of w / (2 sqrt 3).

# %%
rows, unit = [], w / (2 * np.sqrt(3))
for base in common.numbers(args.bases):
    problem, contact = pyramid(base)
    (step,) = uem.load_steps(problem)
    floor, left, right = (part.resultant().force for part in contact.parts[-3:])
    weight, wall = base * (base + 1) / 2 * w, base**2 // 4 * unit
    between = np.array([touch.force[0] for touch in contact.touching() if not touch.second.startswith("rigid")]) / unit
    rows.append({
        "discs": base * (base + 1) // 2,
        "floor": float(floor[1] / w),
        "wall": float(left[0] / w),
        "floor_error": float(abs(floor[1] / weight - 1)),
        "wall_error": float(max(abs(left[0] / wall - 1), abs(right[0] / wall + 1))),
        "sides_error": float(np.abs(between - np.round(between)).max()),
        "pairs": len(contact.touching()),
        "contactors": contact.n_active,
        "newton_iterations": step.newton_iterations,
    })  # fmt: skip
results = {
    "pyramids": rows,
    "floor_error": max(row["floor_error"] for row in rows),
    "wall_error": max(row["wall_error"] for row in rows),
    "sides_error": max(row["sides_error"] for row in rows),
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    uem.plot_scene(problem, args.plot, field=contact.parts, label="contact pressure", cells=True)
if args.output:
    with uem.ResultsWriter(f"{args.output}/pyramid", problem) as writer:
        writer.write(step)

# %% [markdown]
# What the walls lack is of the order of w / E, by which the discs come down.

# %%
assert results["floor_error"] < 1e-9, results
assert results["wall_error"] < 10 * w / args.E and results["sides_error"] < 10 * w / args.E, results
