"""A joint of rough surfaces under rising pressure: its closure by an exponential and a power law, and the limit of a stiff joint.

mpirun -n 2 python3 demos/rough.py --plot rough.png

Options:
    n: cells along the lower block, half as many again in the upper one with mortar, else twice as many
    steps: load steps of the rising pressure
"""

# %% [markdown]
# # A joint of rough surfaces
#
# Two machined blocks meet at the tips of their asperities. Under a pressure p these give way, and the mean planes of the surfaces
# come closer to each other by the closure c. Greenwood and Williamson find for asperities of exponentially distributed heights
#
# $$
# p = p_0 \, e^{c / h}, \qquad c = h \ln (p / p_0),
# $$
#
# and measured joints often follow a power law, $p = p_0 (c / h)^m$ with m near 2. Such a contact is soft: its contactors are not united
# with the target, the pressure is a function of the gap. A stack of two blocks and one joint is three springs in series. Between
# rollers, with nu = 0, it shortens by
#
# $$
# \frac{2 L p}{E} + c(p).
# $$

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=4, steps=12, degree=1, coupling=("node_to_surface", "mortar"))
L, E, p_max = 1.0, 2e11, 4e7  # blocks of steel of 1 m: m, N
laws = {"exponential": uem.Exponential(p0=1e6, h=2e-6), "power law": uem.PowerLaw(p0=1e6, h=2e-6, m=2.0)}


# %% [markdown]
# ## The scene
# The upper block rests on the joint alone: nothing else holds it along the vertical. Its top carries the pressure.


# %%
class Joint:
    """Two blocks, and the joint between them."""

    def __init__(self, normal):
        finer = args.n * (3 if args.coupling == "mortar" else 4) // 2
        sizes = {"n_lower": args.n, "n_upper": finer}
        mesh, tags = uem.read_gmsh(common.MESHES / "two_blocks.geo", comm, gdim=2, parameters=sizes)
        V = uem.function_space(mesh, args.degree, (2,))
        self.u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
        p, self.top = fem.Constant(mesh, 0.0), uem.ds(tags["upper_top"])
        F = E * ufl.inner(ufl.sym(ufl.grad(self.u)), ufl.sym(ufl.grad(v))) * ufl.dx + p * v[1] * self.top
        bcs = [uem.dirichlet(V, tags["sides"], 0), uem.dirichlet(V, tags["lower_bottom"], 1)]
        surfaces = tags["upper_bottom"], tags["lower_top"]
        self.contact = uem.Contact(*surfaces, normal=normal, coupling=args.coupling, name="joint")
        how = {"bcs": bcs, "contacts": [self.contact], "load": {p: p_max}, "petsc_options_prefix": "rough_"}
        self.problem = uem.UnitedProblem(F, self.u, **how)

    def shortening(self) -> float:
        """Mean motion of the top, downwards; the top is 1 long."""
        return -uem.integrate(self.u[1] * self.top)


def closure(law, p: float) -> float:
    """Closed form."""
    return law.h * (np.log(p / law.p0) if isinstance(law, uem.Exponential) else (p / law.p0) ** (1 / law.m))


# %% [markdown]
# ## Rising pressure
# The closure is what the stack shortens beyond the blocks, and minus the gap of the contact.

# %%
rows, errors = [], []
for name, law in laws.items():
    joint = Joint(uem.SoftContact(law))
    writer = uem.ResultsWriter(f"{args.output}/rough_{name.replace(' ', '_')}", joint.problem) if args.output else None
    for step in uem.load_steps(joint.problem, args.steps):
        p = step.factor * p_max
        found, exact = joint.shortening() - 2 * L * p / E, closure(law, p)
        errors.append(abs(found / exact - 1))
        rows.append({"law": name, "pressure": p, "closure": found, "exact": exact, "iterations": step.newton_iterations})
        if writer:
            writer.write(step)
    if writer:
        writer.close()

# %% [markdown]
# ## The limit
# A linear law of growing stiffness k tends to hard contact: the closure p/k vanishes with 1/k, and no stiffness takes more iterations.

# %%
hard = Joint(None)
list(uem.load_steps(hard.problem, 1))
limit = []
for k in (1e13, 1e15, 1e17):
    joint = Joint(uem.SoftContact(k))
    (step,) = uem.load_steps(joint.problem, 1)
    away = joint.shortening() - hard.shortening()
    limit.append({"stiffness": k, "shorter": away, "exact": p_max / k, "iterations": step.newton_iterations})
results = {
    "rows": rows,
    "limit": limit,
    "closure_error": max(errors),
    "limit_error": max(abs(row["shorter"] - row["exact"]) for row in limit) / hard.shortening(),
    "iterations": max(row["iterations"] for row in rows + limit),
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The joint stiffens as it closes.

# %%
with uem.figure(args.plot, comm, size=(5.0, 3.4)) as (panel,):
    if panel:
        fine = np.linspace(0.01, 1.0, 300) * p_max
        for mark, (name, law) in zip("os", laws.items()):
            own = [row for row in rows if row["law"] == name]
            (points,) = panel.plot(
                [1e6 * row["closure"] for row in own], [1e-6 * row["pressure"] for row in own], mark, label=name
            )
            panel.plot([1e6 * closure(law, p) for p in fine], 1e-6 * fine, "-", lw=1, color=points.get_color())
        panel.set(xlabel="closure / µm", ylabel="pressure / MPa")
        panel.legend(frameon=False, title="lines: closed form")

# %%
assert results["closure_error"] < 1e-9 and results["limit_error"] < 1e-9 and results["iterations"] <= 10, results
