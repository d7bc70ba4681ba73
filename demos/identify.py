"""Two moduli of a coated block from the forces with which a disc indents it, by exact gradients through the contact.

python3 demos/identify.py --plot identify.png

Options:
    depth: largest displacement of the disc's top, downwards
    steps: depths at which the force is measured
    layer: thickness of the coating
    soft: Young's modulus of the coating
    hard: Young's modulus of the block under it
    noise: relative standard deviation of the noise in the forces
"""

# %% [markdown]
# # What is the coating made of?
#
# A stiff disc is pressed into a block with a coating. The deeper the indentation, the wider the contact, and the less the coating alone
# determines the force: both moduli follow from forces F_k at some depths, by least squares of F_k(E) / F_k - 1.
#
# One adjoint problem with the united matrix gives the derivatives of a force by both moduli (`uem.gradient`), exactly those of the discrete
# contact problem. The force is a functional of the displacement: the work of the residual on a unit motion of the disc's top. "Measured"
# are forces of the same model, once as they are and once with noise. Differences of forces need one run more for each modulus.

# %%
import functools

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import least_squares

import uem_dolfinx as uem

args = common.arguments(
    __doc__, h=1 / 60, depth=0.012, steps=6, layer=0.06, soft=3e5, hard=1e6, noise=0.01, coupling=("node_to_surface", "mortar")
)
truth = np.array([args.soft, args.hard])

# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "hertz_cylinder.geo", comm, gdim=2, parameters={"h": args.h})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
moduli = [fem.Constant(mesh, value) for value in truth]
coated = fem.Function(uem.function_space(mesh, ("DG", 0)))
coated.interpolate(lambda x: 1.0 * (x[1] > -args.layer))
E = coated * moduli[0] + (1 - coated) * moduli[1]
F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(u, v) * uem.dx(tags["block"])
F += uem.LinearElastic(1e8, 0.3, kind="plane_strain").residual(u, v) * uem.dx(tags["disc"])
push = fem.Constant(mesh, 0.0)
bcs = [
    uem.dirichlet(V, tags["symmetry"], 0),
    uem.dirichlet(V, tags["block_bottom"], 1),
    uem.dirichlet(V, tags["disc_top"], 1, push),
]
# a unit motion of the disc's top, along which the residual's work is the force that presses it down
down = fem.Function(V)
down.x.array[fem.locate_dofs_topological(V.sub(1), 1, tags["disc_top"].entities)] = -1.0
down.x.scatter_forward()
force = ufl.replace(F, {v: down})
work: dict = {"solves": 0, "adjoint": 0}


# %%
def press(values: np.ndarray, derivatives: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Forces at all depths with these moduli ``(steps,)``, and their derivatives ``(steps, 2)``."""
    for constant, value in zip(moduli, values):
        constant.value = value
    u.x.array[:] = 0.0
    contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], coupling=args.coupling)
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options_prefix="identify_", verbose=args.verbose
    )
    forces, by = np.zeros(args.steps), np.zeros((args.steps, 2))
    for k in range(args.steps):
        push.value = -args.depth * (k + 1) / args.steps
        work["solves"] += len(problem.solve()) - 1
        forces[k] = uem.integrate(force)
        if derivatives:
            by[k] = uem.gradient(problem, force, moduli)
            work["adjoint"] += 1
    work["problem"] = problem
    return forces, by


# %%
def identify(measured: np.ndarray, exact: bool) -> dict[str, object]:
    """The moduli that fit best, in logarithms, from a start far off; with gradients or with differences."""
    work.update(solves=0, adjoint=0)
    start = np.log([np.sqrt(truth.prod())] * 2)
    at = functools.cache(lambda x: press(np.exp(x), exact))
    jac = (lambda x: at(tuple(x))[1] * np.exp(x) / measured[:, None]) if exact else "2-point"
    found = least_squares(lambda x: at(tuple(x))[0] / measured - 1, start, jac=jac, xtol=1e-10, ftol=1e-12, gtol=1e-12)
    work["moduli"] = np.exp(found.x)
    error = float(np.abs(work["moduli"] / truth - 1).max())
    return {"modulus_error": error, "evaluations": int(found.nfev), "solves": work["solves"], "adjoint": work["adjoint"]}


measured, _ = press(truth)
noisy = measured * (1 + args.noise * np.random.default_rng(1).normal(size=args.steps))
rows = [
    {"forces": name, "derivatives": how, **identify(values, how == "gradient")}
    for name, values in (("exact", measured), ("noisy", noisy))
    for how in ("gradient", "differences")
]

# %%
results = {
    "fits": rows,
    "modulus_error": rows[0]["modulus_error"],
    "modulus_error_noisy": rows[2]["modulus_error"],
    "solves": rows[0]["solves"] + rows[0]["adjoint"],
    "solves_by_differences": rows[1]["solves"],
    "dofs": 2 * V.dofmap.index_map.size_global,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    depth = args.depth * np.arange(1, args.steps + 1) / args.steps
    fit, _ = press(work["moduli"])
    with uem.figure(args.plot, comm, panels=2) as panels:
        uem.plot_scene(work["problem"], panels[0], window=(0.0, 0.3, -0.3, 0.1), label="displacement")
        if panels[1] is not None:
            panels[1].plot(depth, measured, "k-", lw=1, label="true moduli")
            panels[1].plot(depth, noisy, "o", label="measured, with noise")
            panels[1].plot(depth, fit, "x", label="fitted to that")
            panels[1].set(xlabel="depth", ylabel="force")
            panels[1].legend()
if args.output:
    with uem.ResultsWriter(f"{args.output}/identify", work["problem"]) as writer:
        writer.write(1.0)

# %%
assert results["modulus_error"] < 1e-5
