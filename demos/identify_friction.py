"""Modulus and coefficient of friction of a block from the force that drags it, by exact gradients through all steps of stick and slip.

python3 demos/identify_friction.py --plot identify_friction.png

Options:
    n: cells along the block's height, an even number
    steps: displacements of the tail at which the force is measured
    way: largest displacement of the tail
    modulus: Young's modulus of the block
    friction: coefficient of friction
    noise: standard deviation of the noise in the forces, relative to the largest
    compare: 1 to count the solves with differences as well
"""

# %% [markdown]
# # Which modulus, and how rough?
#
# A block that lies on a rough base is dragged by its tail. It sticks first, then slips from the tail to the front, and at last everywhere:
# the slope of the force determines the modulus, its last value the coefficient of friction, the part between them both.
#
# Each step depends on where contactors stuck in the steps before. `uem.recording` keeps the steps, and one sweep backwards over them gives
# the derivatives of a sum over all steps, exactly those of the discrete steps, for any number of parameters. Differences need one run more
# for each parameter.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from scipy.optimize import minimize

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, steps=4, way=0.008, modulus=200.0, friction=0.4, noise=0.01, compare=1)
truth = np.array([args.modulus, args.friction])
length, height, weight = 2.0, 0.5, 1.0

# %% [markdown]
# ## The scene

# %%
parameters = {"n": args.n, "length": length, "height": height, "base": 0}
mesh, tags = uem.read_gmsh(common.MESHES / "sliding_block.geo", comm, gdim=2, parameters=parameters)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
E, tail = fem.Constant(mesh, args.modulus), fem.Constant(mesh, args.way)
F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(u, v) * ufl.dx + weight / (length * height) * v[1] * ufl.dx
bcs = [uem.dirichlet(V, tags["block_tail"], 0, tail)]
# a unit motion of the tail, along which the residual's work is the force that drags it
drag = fem.Function(V)
drag.x.array[fem.locate_dofs_topological(V.sub(0), 1, tags["block_tail"].entities)] = 1.0
drag.x.scatter_forward()
force = ufl.replace(F, {v: drag})
shares = [fem.Constant(mesh, 0.0) for _ in range(args.steps)]
work: dict = {}


# %%
def pull(values: np.ndarray, measured: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Forces in all steps ``(steps,)``, and derivatives by modulus and friction of half the sum of their squared misfits ``(2,)``."""
    E.value, mu = values
    u.x.array[:] = 0.0
    contact = uem.Contact(tags["block_bottom"], uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), friction=float(mu))
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options_prefix="identify_friction_", verbose=args.verbose
    )
    forces = []
    with uem.recording(problem) as history:
        for step in uem.load_steps(problem, args.steps):
            work["solves"] = work.get("solves", 0) + step.newton_iterations + step.exchanges
            forces.append(uem.integrate(force))
    work["problem"], by = problem, np.zeros(2)
    if measured is not None:
        for share, now, then in zip(shares, forces, measured):
            share.value = (now - then) / measured.max() ** 2
        by = np.array(history.gradient([share * force for share in shares], [E, uem.ContactParameter(contact, "friction")]))
        work["adjoint"] = work.get("adjoint", 0) + len(history)
    return np.array(forces), by


# %%
def identify(measured: np.ndarray, exact: bool) -> dict[str, object]:
    """Modulus and coefficient that fit best, in logarithms, from a start far off; with gradients or with differences."""
    work.update(solves=0, adjoint=0)

    def misfit(x: np.ndarray):
        forces, by = pull(np.exp(x), measured if exact else None)
        value = 0.5 * float((((forces - measured) / measured.max()) ** 2).sum())
        return (value, by * np.exp(x)) if exact else value

    found = minimize(misfit, np.log(truth * [1.5, 0.75]), jac=exact or None, method="BFGS", options={"gtol": 1e-5})
    work["fit"] = np.exp(found.x)
    modulus, friction = np.abs(work["fit"] / truth - 1)
    return {
        "modulus_error": float(modulus), "friction_error": float(friction), "evaluations": int(found.nfev), "solves": work["solves"],
        "adjoint": work["adjoint"],
    }  # fmt: skip


measured, _ = pull(truth)
noisy = measured + args.noise * measured.max() * np.random.default_rng(1).normal(size=args.steps)
cases = [("exact", "differences", measured)] if args.compare else []
cases += [("exact", "gradient", measured), ("noisy", "gradient", noisy)]
rows = [{"forces": name, "derivatives": how, **identify(values, how == "gradient")} for name, how, values in cases]

# %%
results = {
    "fits": rows,
    "modulus_error": rows[-2]["modulus_error"],
    "friction_error": rows[-2]["friction_error"],
    "friction_error_noisy": rows[-1]["friction_error"],
    "solves": rows[-2]["solves"] + rows[-2]["adjoint"],
    "solves_by_differences": rows[0]["solves"] if args.compare else None,
    "ranks": comm.size,
}
common.report(args, results)

# %%
if args.plot:
    way = args.way * np.arange(1, args.steps + 1) / args.steps
    fit, _ = pull(work["fit"])
    with uem.figure(args.plot, comm, panels=2) as panels:
        uem.plot_scene(work["problem"], panels[0], label="displacement")
        if panels[1] is not None:
            panels[1].plot(way, measured, "k-", lw=1, label="true parameters")
            panels[1].plot(way, noisy, "o", label="measured, with noise")
            panels[1].plot(way, fit, "x", label="fitted")
            panels[1].set(xlabel="prescribed displacement", ylabel="force", ylim=(0.0, None))
            panels[1].legend(frameon=False)
if args.output:
    with uem.ResultsWriter(f"{args.output}/identify_friction", work["problem"]) as writer:
        writer.write(1.0)

# %%
assert max(results["modulus_error"], results["friction_error"]) < 1e-3
