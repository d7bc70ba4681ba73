"""Heat through two bars in series: the jump of temperatures between them, and a gap that heat closes.

mpirun -n 2 python3 demos/thermal_bars.py --coupling mortar --plot thermal_bars.png

Options:
    n: cells along a bar, half as many again in the upper one with mortar
    steps: load steps of the heating
"""

# %% [markdown]
# # Bars in series
#
# Two guided bars of different conductivities lie end to end between walls. The lower end is cold, the upper one hot. Where the bars touch
# the flux q passes by the conductance h of the contact, with a jump q/h of the temperatures: three resistances in series.
#
# With a gap between the bars the upper one is as hot as its end all along and grows. When it has grown by the gap it presses on the
# other, heat passes, and warms that one; it grows more than the upper one shrinks, for it conducts less. The conductance is
# proportional to the pressure, `h = c p`.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=8, steps=10, coupling=("node_to_surface", "mortar"))
L, k_low, k_high, E, alpha, hot = 1.0, 25.0, 50.0, 2e11, 1.2e-5, 200.0  # m, N, s, K


# %% [markdown]
# ## The scene
# A mixed Function holds displacement and temperature; with nu = 0 everything is one-dimensional. The conductance names the part of the
# space that is the temperature. The hot end's temperature follows the load factor, as all Dirichlet values do. The bars touch in the
# mesh, and the gap is an offset of the contact. With `--coupling mortar` their meshes do not match.


# %%
class Bars:
    """Two bars a gap apart, with a conductance between them."""

    def __init__(self, gap: float, h):
        sizes = {"n_lower": args.n, "n_upper": args.n + (args.n // 2 if args.coupling == "mortar" else 0)}
        mesh, tags = uem.read_gmsh(common.MESHES / "two_blocks.geo", comm, gdim=2, parameters=sizes)
        W = uem.function_space(mesh, [("Lagrange", 1, (2,)), 1])
        w, (v, q) = fem.Function(W), ufl.TestFunctions(W)
        u, T = ufl.split(w)
        stress = E * (ufl.sym(ufl.grad(u)) - alpha * T * ufl.Identity(2))
        F = ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx
        for name, k in (("lower", k_low), ("upper", k_high)):
            F += k * ufl.inner(ufl.grad(T), ufl.grad(q)) * uem.dx(tags[name])
        ends = (tags["lower_bottom"], tags["upper_top"])
        bcs = [uem.dirichlet(W.sub(0), tags["sides"], 0), *(uem.dirichlet(W.sub(0), end, 1) for end in ends)]
        bcs += [uem.dirichlet(W.sub(1), end, value=value) for end, value in zip(ends, (0.0, hot))]
        heat = uem.Conductance(h, field=1)
        surfaces = tags["upper_bottom"], tags["lower_top"]
        self.contact = uem.Contact(*surfaces, coupling=args.coupling, offset=-gap, heat=heat, name="joint")
        self.problem = uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=[self.contact], petsc_options_prefix="bars_")

    def at_joint(self):
        """Flux, pressure, and temperatures on both sides, at this rank's contactors."""
        c, T = self.contact, self.problem.config.functions()["field_1"]
        own, theirs = T.x.array[c.nodes], c.opposite(T).x.array[c.nodes]
        return c.heat_flux.x.array[c.nodes], c.pressures, own, theirs


# %% [markdown]
# ## The jump
# Without a gap both bars are heated. The flux is `T / (L/k1 + L/k2 + 1/h)`.


# %%
def largest(values) -> float:
    return float(comm.allreduce(np.abs(values).max(initial=0.0), op=common.MPI.MAX))


h, resistance = 40.0, L / k_low + L / k_high
touching = Bars(0.0, h)
list(uem.load_steps(touching.problem, 1))
flux, pressure, own, theirs = touching.at_joint()
wanted = hot / (resistance + 1 / h)
jump_error = max(largest((own - theirs) / (wanted / h) - 1), largest(flux / wanted - 1))
balance = touching.contact.heat_balance()


# %% [markdown]
# ## The gap
# With the hot end at T the bars together want to grow by `alpha L (T + q L (1/k1 - 1/k2) / 2)`: the part beyond the gap is pressed
# together. The gap closes at `gap / (alpha L)`, from where on pressure and flux depend on each other.

# %%
gap, c = 6e-4, 2e-7
closes_at = gap / (alpha * L)


def pressed(T: float) -> float:
    """Pressure with the hot end at T: p = E / (2 L) * growth, of which q = T c p / (1 + R c p) makes a quadratic equation."""
    if closes_at * (1 + 1e-12) >= T:  # a step may end at the instant of closing
        return 0.0
    drawn, by_flux = (E / (2 * L) * alpha * L * growth for growth in (T - closes_at, L / 2 * (1 / k_low - 1 / k_high) * T * c))
    return max(np.roots([resistance * c, 1 - by_flux - resistance * c * drawn, -drawn]).real)


apart = Bars(gap, lambda p, g: c * p)
rows, known = [], []
writer = uem.ResultsWriter(f"{args.output}/thermal_bars", apart.problem) if args.output else None
for step in uem.load_steps(apart.problem, args.steps):
    flux, pressure, own, theirs = (comm.allreduce(part.sum()) / comm.allreduce(len(part)) for part in apart.at_joint())
    T, p = hot * step.factor, pressed(hot * step.factor)
    exact = T / (resistance + 1 / (c * p)) if p > 0 else 0.0
    rows.append(
        {
            "T": T,
            "pressure": pressure,
            "exact_pressure": p,
            "flux": flux,
            "exact_flux": exact,
            "iterations": step.newton_iterations,
        }
    )
    known.append((own, theirs))
    if writer:
        writer.write(step)
if writer:
    writer.close()
closed = [row for row in rows if row["exact_pressure"] > 0]
opened = [row for row in rows if row["exact_pressure"] == 0]
errors = [abs(row[f"{what}"] / row[f"exact_{what}"] - 1) for row in closed for what in ("pressure", "flux")]
errors += [abs(row["flux"]) / closed[-1]["exact_flux"] for row in opened]
results = {
    "rows": rows,
    "jump_error": jump_error,
    "balance": max(balance, apart.contact.heat_balance()),
    "closing_error": max(errors),
    "closes_at": closes_at,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Temperatures on both sides of the gap, and the flux, as the hot end gets hotter.

# %%
with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.2)) as (left, right):
    if left:
        at, fine = [row["T"] for row in rows], np.linspace(0.0, hot, 200)
        left.plot(at, [own for own, _ in known], "o", label="upper bar")
        left.plot(at, [theirs for _, theirs in known], "s", label="lower bar")
        left.set(xlabel="temperature of the hot end / K", ylabel="temperature at the joint / K")
        left.legend(frameon=False)
        exact = [T / (resistance + 1 / (c * pressed(T))) if pressed(T) > 0 else 0.0 for T in fine]
        right.plot(fine, exact, "k-", lw=1, label="closed form")
        right.plot(at, [row["flux"] for row in rows], "o", label="flux")
        right.set(xlabel="temperature of the hot end / K", ylabel="flux / W/m²")
        right.legend(frameon=False)

# %%
assert results["jump_error"] < 1e-10 and results["balance"] < 1e-13 and results["closing_error"] < 1e-3, results
