"""Press fit: a solid disc slightly too large for the ring around it, against Lamé's pressure.

python3 demos/press_fit.py --plot press_fit.png

Options:
    h: size of the disc's cells at the interface, on the finest mesh
    delta: interference: the disc's radius less that of the bore
    sliding: contactors are projected in every iteration, once per step, or once for all
    kind: plane strain, or plane stress
"""

# %% [markdown]
# # A press fit
#
# A disc of radius b + delta sits in a ring of radii b and c, of other elastic constants. After Lamé the disc shrinks and the ring
# grows under the pressure p between them by
#
# $$
# u_{disc} = \frac{p\, b\, (1 - \nu_1')}{E_1'}, \qquad u_{ring} = \frac{p\, b}{E_2'} \left( \frac{c^2 + b^2}{c^2 - b^2} + \nu_2' \right),
# $$
#
# where in plane strain E' = E / (1 - nu^2) and nu' = nu / (1 - nu). Both make up for the interference: u_disc + u_ring = delta gives
# p. There is no other load: both meshes overlap at the start, and the first solve takes the overlap away.
#
# The meshes do not match, and an overlap of b / 1000 is less than the sagitta of straight cells on an arc. Cells with curved sides,
# of degree 2 like the displacement, follow it closely: contactors project onto the true, curved facets of the bore. With
# `--degree 1` the polygons' own gaps and overlaps fade with the square of h only.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, h=0.05, ratio=1.5, degree=2, delta=1e-3, coupling=("node_to_surface", "mortar"), sliding=("finite", "small", "fixed"),
    normals=("facet", "averaged"), kind=("plane_strain", "plane_stress"), refinements=3,
)  # fmt: skip
b, c = 1.0, 2.0
E_disc, nu_disc, E_ring, nu_ring = 2.1e5, 0.3, 0.7e5, 0.33


# %% [markdown]
# ## Lamé's pressure


# %%
def lame(E: float, nu: float) -> tuple[float, float]:
    """Young's modulus and Poisson's ratio that turn plane stress into the chosen kind."""
    return (E / (1 - nu**2), nu / (1 - nu)) if args.kind == "plane_strain" else (E, nu)


(E_1, nu_1), (E_2, nu_2) = lame(E_disc, nu_disc), lame(E_ring, nu_ring)
p = args.delta / (b * ((1 - nu_1) / E_1 + ((c**2 + b**2) / (c**2 - b**2) + nu_2) / E_2))


# %% [markdown]
# ## One scene
# A quarter of both bodies between planes of symmetry. The mean pressure is the sum of the contact forces over the length of the
# bore; the scatter is the largest deviation of a nodal pressure from Lamé's. It remains with node_to_surface on meshes that do not
# match, since that hands a constant pressure to the target unevenly; with mortar it falls with h.


# %%
def solve(h: float, coupling: str = args.coupling) -> tuple[uem.UnitedProblem, uem.LinearElastic, dict[str, float]]:
    """Let the disc and the ring find each other on a mesh of size h: problem, material and figures measured."""
    mesh, tags = uem.read_gmsh(
        common.MESHES / "press_fit.geo", comm, gdim=2,
        parameters={"b": b, "c": c, "delta": args.delta, "h": h, "ratio": args.ratio, "order": args.degree},
    )  # fmt: skip
    E, nu = (fem.Function(uem.function_space(mesh, ("DG", 0)), name=name) for name in ("E", "nu"))
    for body, E_body, nu_body in (("disc", E_disc, nu_disc), ("ring", E_ring, nu_ring)):
        E.x.array[tags[body].entities], nu.x.array[tags[body].entities] = E_body, nu_body
    V = uem.function_space(mesh, args.degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind=args.kind)
    F = material.residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry_x"], 0), uem.dirichlet(V, tags["symmetry_y"], 1)]
    contact = uem.Contact(
        contactor=tags["disc_arc"], target=tags["ring_bore"], coupling=coupling, name=coupling, sliding=args.sliding, normals=args.normals,
        max_penetration=0.01 * b,
    )  # fmt: skip
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="press_", verbose=args.verbose)
    history = problem.solve()

    radial = sum(comm.allgather(contact.pair.trial.lam.sum()))
    mean = radial / (b * np.pi / 2)
    pressures = np.concatenate(comm.allgather(contact.pressures))
    figures = {
        "h": h,
        "pressure": float(mean),
        "pressure_error": float(abs(mean / p - 1)),
        "pressure_scatter": float(np.abs(pressures / p - 1).max()),
        "contactors": len(pressures),
        "active_at_first": history[0].active,
        "active": contact.n_active,
        "newton_iterations": len(history) - 1,
        "exchanges": sum(i.exchanges for i in history),
        "max_gap": contact.max_gap(),
        "dofs": 2 * V.dofmap.index_map.size_global,
    }
    return problem, material, figures


# %% [markdown]
# ## The figures
# The last mesh has the chosen size, each of the others twice the size of the next.

# %%
rows = []
for k in reversed(range(args.refinements)):
    problem, material, figures = solve(args.h * 2**k)
    rows.append(figures)
common.report(args, {"pressure_lame": float(p), **rows[-1], "meshes": rows})

# %% [markdown]
# ## The picture
# The radial stress, the same on both sides of the interface, and the nodal pressures over the angle in degrees, with either coupling.

# %%
if args.plot:
    x = ufl.SpatialCoordinate(problem.u.function_space.mesh)
    radial = ufl.dot(x, material.stress(problem.u) * x) / (ufl.dot(x, x) * p)
    with uem.figure(args.plot, comm, panels=2) as (left, right):
        uem.plot_scene(problem, left, field=radial, label="radial stress / p", levels=np.linspace(-1.1, 0.1, 13), arrows=False)
        other = solve(args.h, "mortar" if args.coupling == "node_to_surface" else "node_to_surface")[0]
        uem.plot_pressure(
            [*problem.contacts, *other.contacts], right,
            along=lambda x: np.degrees(np.arctan2(x[:, 1], x[:, 0])), along_label="angle in degrees",
            reference=lambda angle: np.full_like(angle, p), reference_label="Lamé", window=(0.0, 90.0),
        )  # fmt: skip
if args.output:
    with uem.ResultsWriter(f"{args.output}/press_fit", problem) as writer:
        writer.write(1.0)

# %%
if args.degree == 2:
    assert rows[-1]["pressure_error"] < 0.005
