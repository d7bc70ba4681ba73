"""Taylor's test: a copper rod hits a rigid wall at 227 m/s and stays behind as a mushroom, against published figures.

mpirun -n 2 python3 demos/taylor_rod.py --plot taylor_rod.png

Options:
    n: cells along half of the radius
    layers: cells along the rod
    dt: time step in microseconds
    end: end of the run in microseconds
    kind: a quarter in 3D, or half of the section of a body of revolution
    rho_inf: part of the fastest motions that a time step keeps, 0 to 1
    contactors: contactors with their mass, or without
    scheme: implicit or explicit steps
"""

# %% [markdown]
# # Taylor's rod
#
# A copper rod of 32.4 mm in length and 3.2 mm in radius flies against a rigid wall without friction. A plastic wave runs up the
# rod. After 80 microseconds the rod is at rest, a third shorter and twice as thick at its foot [Taylor, Proceedings of the Royal
# Society A 194 (1948) 289-299; Wilkins and Guinan, Journal of Applied Physics 44 (1973) 1200-1206]. Codes agree on the length,
# 21.4 to 21.5 mm, and nearly on the radius of the foot, 7.0 to 7.2 mm [Kamoulakos, Benchmark (1990); Zhu and Cescotto,
# International Journal for Numerical Methods in Engineering 38 (1995) 3945-3973].
#
# The wall is imposed in two ways. By contact the foot may leave it: its rim, thrown outwards, lifts off and curls up. Held by
# Dirichlet conditions the foot stays flat. Here contactors keep their mass, as they do in the codes compared, and the touch itself
# takes 0.2 % of the energy; with `--contactors massless` it takes none, steps are cut at first, and the rim comes out 8 % too wide.
# The time integration damps motions that the steps do not resolve. A quarter is modelled with hexahedra, or half of the section with
# quadrilaterals by `--kind axisymmetric`. With `--scheme explicit` steps are central differences without damping.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__,
    n=2,
    layers=24,
    dt=1.0,
    end=80.0,
    rho_inf=0.3,
    kind=("3d", "axisymmetric"),
    contactors=("massy", "massless"),
    scheme=("implicit", "explicit"),
    coupling=("node_to_surface", "mortar"),
)
# N, mm, tonnes, s
E, nu, Y, hardening, rho, speed, L, R = 117e3, 0.35, 400.0, 100.0, 8.93e-9, 227e3, 32.4, 3.2
PUBLISHED = {"length": 21.45, "foot": 7.1}


# %% [markdown]
# ## One rod
# Strains come to 3 at the foot.


# %%
def impact(wall: str) -> tuple[dict[str, float], np.ndarray, uem.EnergyBook]:
    """The figures measured, the outline of the section at the end ``(n, 2)``, and the energies."""
    if args.kind == "3d":
        parameters = {"R": R, "L": L, "n": args.n, "layers": args.layers}
        mesh, tags = uem.read_gmsh(common.MESHES / "rod.geo", comm, gdim=3, parameters=parameters)
        foot, held = tags["foot"], [tags["on_x"], tags["on_y"]]
    else:
        parameters = {"W": R, "H": L, "n_w": 2 * args.n, "n_h": args.layers}
        mesh, tags = uem.read_gmsh(common.MESHES / "billet.geo", comm, gdim=2, parameters=parameters)
        uem.axisymmetric(mesh)
        foot, held = tags["middle"], [tags["axis"]]
    gdim = mesh.geometry.dim
    upwards = np.eye(gdim)[-1]
    V = uem.function_space(mesh, 1, (gdim,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    copper = uem.FinitePlasticity(u, E, nu, Y, hardening, kind=args.kind)
    bcs = [uem.dirichlet(V, tag, component) for component, tag in enumerate(held)]
    contacts = []
    if wall == "contact":
        contacts = [uem.Contact(foot, uem.RigidPlane(0 * upwards, upwards), coupling=args.coupling)]
    else:
        bcs.append(uem.dirichlet(V, foot, gdim - 1))
    explicit = args.scheme == "explicit"
    dynamics = uem.Dynamics(
        (uem.lumped_mass if explicit else uem.consistent_mass)(V, rho),
        velocity=-speed * upwards,
        scheme=uem.CentralDifferences() if explicit else uem.generalised_alpha(args.rho_inf),
        contactors=args.contactors,
    )
    problem = uem.UnitedProblem(
        copper.residual(v), u, bcs=bcs, contacts=contacts, materials=[copper], dynamics=dynamics,
        petsc_options_prefix="rod_", verbose=args.verbose,
    )  # fmt: skip
    fields = {"peeq": copper.cell_averages()["peeq"]}
    writer = uem.ResultsWriter(f"{args.output}/rod_{wall}", problem, fields=fields) if args.output else None
    book = uem.EnergyBook(problem, path=f"{args.output}/rod_{wall}_energy.csv" if args.output else None)
    steps, iterations, every = 0, 0, 20 if explicit else 1
    for step in uem.time_steps(problem, None if explicit else args.dt * 1e-6, args.end * 1e-6):
        steps, iterations = steps + 1, iterations + step.newton_iterations
        if steps % every == 0:
            book.write(step)
        if writer is not None and steps % every == 0:
            copper.cell_averages()
            writer.write(step)
    for opened in (book, writer):
        if opened is not None:
            opened.close()
    config = problem.config
    X, x = config.X[: config.n_owned], config.x[: config.n_owned]
    # radius and height, before and now, and which nodes are of the section y = 0
    r, z = np.linalg.norm(X[:, :-1], axis=1), X[:, -1]
    radii, heights, section = np.linalg.norm(x[:, :-1], axis=1), x[:, -1], np.abs(X[:, 1]) < 1e-9 if gdim == 3 else r > -1
    length, radius, peeq = (
        float(max(comm.allgather(values.max(initial=0.0)))) for values in (heights, radii, copper.peeq.x.array)
    )
    # along the foot, up the side and back along the rear
    way = np.where(z < 1e-9, r, np.where(z > L - 1e-9, 2 * R + L - r, R + z))
    outer = section & ((z < 1e-9) | (z > L - 1e-9) | (r > R - 1e-9))
    outline = np.concatenate(comm.allgather(np.column_stack([way, radii, heights])[outer]))
    outline = outline[outline[:, 0].argsort(), 1:]
    first, last = book.rows[0], book.rows[-1]
    figures = {
        "wall": wall,
        "length": length,
        "foot": radius,
        "peeq": peeq,
        "length_error": abs(length / PUBLISHED["length"] - 1),
        "foot_error": abs(radius / PUBLISHED["foot"] - 1),
        "kinetic": last.kinetic / first.kinetic,
        "dissipated": last.dissipated / first.kinetic,
        "contact_work": last.contact / first.kinetic,
        "energy_defect": last.defect / first.kinetic,
        "steps": steps,
        "iterations": iterations,
    }
    return figures, outline, book


# %% [markdown]
# ## Both walls

# %%
touching, shape, book = impact("contact")
held, flat, _ = impact("held")
results = {
    "forming_error": max(touching["length_error"], touching["foot_error"]),
    "length_error": touching["length_error"],
    "foot_error": touching["foot_error"],
    "walls": [touching, held],
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.4)) as (left, right):
        if left is not None:
            left.plot([0, R, R, 0], [0, 0, L, L], "0.6", lw=1, label="before")
            left.plot([0, -R, -R, 0], [0, 0, L, L], "0.6", lw=1)
            left.plot(-shape[:, 0], shape[:, 1], label="contact")
            left.plot(*flat.T, label="no lift-off")
            left.plot([-PUBLISHED["foot"], PUBLISHED["foot"]], [0.0, 0.0], "k|", ms=12)
            left.plot(0.0, PUBLISHED["length"], "k_", ms=12, label="published")
            left.set(xlabel="radius in mm", ylabel="height in mm", aspect="equal", xlim=(-9, 9))
            left.grid(alpha=0.25)
            left.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        book.plot(right)

# %%
if args.end >= 80.0:
    assert results["length_error"] < 0.01 and results["foot_error"] < (0.05 if args.contactors == "massy" else 0.1), results
    assert held["length_error"] < 0.01 and held["foot_error"] < 0.05, results
assert all(abs(row["energy_defect"]) < 0.05 for row in results["walls"]), results
