"""A ring whose lips close on each other, self contact without any declaration of surfaces, against its half on a rigid plane.

python3 demos/clamp.py --plot clamp.png

Options:
    n: cells across the ring
    m: cells along half of the ring
    slot: width of the slot
    way: displacement of each grip
"""

# %% [markdown]
# # A clamp
#
# A ring with a slot is gripped at its top and bottom and pressed until the lips of the slot meet with their whole faces. Nothing is
# declared but that the ring may touch itself. By symmetry its upper half does the same on a rigid plane: where the faces are flat the two
# must agree to rounding, force by force.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=6, m=60, slot=0.1, way=0.0416, steps=4, degree=1, nu=0.3)

# %% [markdown]
# ## The ring and its half


# %%
def press(halves: int) -> tuple[uem.UnitedProblem, uem.Contact | uem.GeneralContact, int, uem.LoadStep]:
    """The ring, or its upper half on a plane, gripped and pressed: the problem, its contact, Newton iterations and the last step."""
    mesh, tags = uem.read_gmsh(
        common.MESHES / "clamp.geo", comm, gdim=2, parameters={"halves": halves, "n": args.n, "m": args.m, "slot": args.slot}
    )
    V = uem.function_space(mesh, args.degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    F = uem.StVenantKirchhoff(1.0, args.nu, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["back"], 1), uem.dirichlet(V, tags["root"], 0), uem.dirichlet(V, tags["upper"], 1, -args.way)]
    contact: uem.Contact | uem.GeneralContact
    if halves == 2:
        bcs.append(uem.dirichlet(V, tags["lower"], 1, args.way))
        contact = uem.GeneralContact(self_contact=True)
    else:
        contact = uem.Contact(tags["lips"], uem.RigidPlane((0, 0), (0, 1)))
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], rtol=1e-12, petsc_options_prefix="clamp_", verbose=args.verbose
    )
    steps = list(uem.load_steps(problem, args.steps))
    return problem, contact, sum(step.newton_iterations for step in steps), steps[-1]


def upper(problem: uem.UnitedProblem, field: fem.Function) -> dict[tuple[float, float], np.ndarray]:
    """Values of a field at the nodes of the upper half, by their places, on every rank."""
    n = problem.config.n_owned
    values = np.column_stack([problem.config.X[:n], field.x.array.reshape(-1, 2)[:n]])
    every = np.concatenate(comm.allgather(values[values[:, 1] > args.slot / 4]))
    return {(round(x, 9), round(y, 9)): value for x, y, *value in every}


ring, own, iterations, last = press(2)
half, plane, iterations_of_half, _ = press(1)

# %% [markdown]
# ## The comparison
# Displacements relative to the way of the grips, forces to the sum of all.

# %%
moved, force = ({k: np.array(v) for k, v in upper(ring, f).items()} for f in (ring.u, own.force))
moved_half, force_half = ({k: np.array(v) for k, v in upper(half, f).items()} for f in (half.u, plane.force))
closing = float(sum(np.linalg.norm(f) for f in force_half.values()))
results = {
    "half_model_error": max(float(np.abs(moved[k] - moved_half[k]).max()) for k in moved_half) / args.way,
    "force_error": max(float(np.abs(force[k] - force_half[k]).max()) for k in force_half) / closing,
    "closing_force": closing,
    "contactors": own.n_active,
    "contactors_of_half": plane.n_active,
    "newton_iterations": iterations,
    "newton_iterations_of_half": iterations_of_half,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2) as panels:
        uem.plot_scene(ring, panels[0], field=ufl.sqrt(ufl.inner(ring.u, ring.u)), label="displacement")
        uem.plot_scene(ring, panels[1], window=(0.6, 1.1, -0.25, 0.25), label="displacement")
if args.output:
    with uem.ResultsWriter(f"{args.output}/clamp", ring) as writer:
        writer.write(last)

# %%
assert max(results["half_model_error"], results["force_error"]) < 1e-11
