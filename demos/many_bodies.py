"""What general contact costs by the number of bodies: seconds to set a problem up and for a step, with contact and without.

python3 demos/many_bodies.py --json bodies.json --plot bodies.png

Options:
    sizes: numbers of discs, comma-separated
    columns: discs in a row
    n: facets around each disc
    steps: time steps that are timed, after a first one
    apart: gap between the discs of a row relative to their diameter
"""

# %% [markdown]
# # The price of a body
#
# Rows of elastic discs whose neighbours move towards each other and collide, all at once, and stay in contact while waves run through
# them and back. Five discs make a row, and rows are added. With one declaration for all of them,
#
# ```python
# contact = uem.GeneralContact(friction=mu)
# ```
#
# a step should take time in proportion to the number of bodies, as it does without contact. Only pairs that come near each other are
# looked at, and dense matrices are at most of the bodies that touch. Times are those of the processor, of the slowest rank.

# %%
from time import process_time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from mpi4py import MPI

import uem_dolfinx as uem

args = common.arguments(__doc__, sizes="10,30,100,300", columns=5, friction=0.3, n=24, steps=5, dt=0.01, apart=1e-4)
R, E, rho, approach = 0.5, 10.0, 1.0, 0.02


# %% [markdown]
# ## The scene
# The discs of a row are `--apart` of their size from each other, and close this in the first step; rows do not meet.


# %%
def rows_of_discs(bodies: int, with_contact: bool) -> tuple[uem.UnitedProblem, uem.GeneralContact | None]:
    """So many discs, in rows of ``--columns``, in motion."""
    rows = max(1, bodies // args.columns)
    d = 2 * R * (1 + args.apart)
    sizes = {"rows": rows, "columns": args.columns, "R": R, "apart": 1 + args.apart, "n": args.n}
    mesh, _ = uem.read_gmsh(common.MESHES / "granular.geo", comm, gdim=2, parameters=sizes)
    V = uem.function_space(mesh, 1, (2,))
    u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)

    def towards_the_middle(x: np.ndarray) -> np.ndarray:
        column = np.round(x[0] / d - np.floor(x[1] / d + 1e-6) % 2 / 2)
        return np.array([approach * ((args.columns - 1) / 2 - column), 0 * column])

    velocity.interpolate(towards_the_middle)
    material = uem.StVenantKirchhoff(E, 0.3, kind="plane_strain")
    contact = uem.GeneralContact(friction=args.friction) if with_contact else None
    problem = uem.UnitedProblem(
        material.residual(u, v) * ufl.dx, u, contacts=[contact] if contact else [],
        dynamics=uem.Dynamics(uem.lumped_mass(V, rho), velocity=velocity), petsc_options_prefix="bodies_", verbose=args.verbose,
    )  # fmt: skip
    return problem, contact


# %% [markdown]
# ## Timed
# The first step, in which all is made for the first time, belongs to neither figure.


# %%
def seconds(since: float) -> float:
    """Seconds of the processor since then, of the slowest rank."""
    return float(comm.allreduce(process_time() - since, op=MPI.MAX))


def timed(bodies: int, with_contact: bool) -> dict[str, float]:
    """Seconds of the set-up and of a step, linear solves of a step, and contactors in the end."""
    begun = process_time()
    problem, contact = rows_of_discs(bodies, with_contact)
    set_up, spent, solves = seconds(begun), [], []
    begun = process_time()
    for step in uem.time_steps(problem, args.dt, (args.steps + 1) * args.dt):
        spent.append(seconds(begun))
        solves.append(sum(i.linear_iterations for i in step.iterations))
        begun = process_time()
    count = args.columns * max(1, bodies // args.columns)
    return {
        "bodies": count,
        "dofs": 2 * problem.u.function_space.dofmap.index_map.size_global,
        "set_up": set_up,
        "step": float(np.mean(spent[1:])),
        "solves": float(np.mean(solves[1:])),
        "contactors": contact.n_active if contact else 0,
    }


# forms are compiled, and modules imported, once
timed(args.columns, True)
rows = []
for bodies in common.numbers(args.sizes):
    without, row = timed(bodies, False), timed(bodies, True)
    row |= {"set_up_without": without["set_up"], "step_without": without["step"], "ratio": row["step"] / without["step"]}
    rows.append(row)


# %% [markdown]
# ## By the number of bodies
# `slope` is the exponent p of the last two sizes, where seconds go with the number to the power of p.


# %%
def slope(what: str) -> float:
    """Exponent of a figure between the last two sizes."""
    (a, b), (x, y) = ([row[key] for row in rows[-2:]] for key in (what, "bodies"))
    return float(np.log(b / a) / np.log(y / x))


results = {"rows": rows, "ranks": comm.size}
if len(rows) > 1:
    results |= {f"{what}_slope": slope(what) for what in ("set_up", "step", "step_without")}
common.report(args, results)

# %%
if args.plot:
    number = np.array([row["bodies"] for row in rows])
    with uem.figure(args.plot, comm, size=(5.6, 4.2)) as (ax,):
        if ax is not None:
            for what, style, label in (
                ("step", "o-", "step"),
                ("step_without", "o--", "step without contact"),
                ("set_up", "s-", "set-up"),
                ("set_up_without", "s--", "set-up without contact"),
            ):
                ax.loglog(number, [row[what] for row in rows], style, label=label, lw=1)
            ax.loglog(number, rows[-1]["step"] * number / number[-1], "0.6", lw=0.8, ls=":", label="slope 1")
            ax.set(xlabel="bodies", ylabel="processor time / s")
            ax.legend(frameon=False)
            ax.grid(alpha=0.25)

# %%
# every disc touches its neighbours
assert all(row["contactors"] >= row["bodies"] * (1 - 1 / args.columns) for row in rows), results
