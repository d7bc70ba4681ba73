"""A metal billet is upset between rough tools to half its height, against the slab method.

python3 demos/upsetting.py --plot upsetting.png

Options:
    n: cells along half of the height; half of the width has three times as many
    reduction: relative reduction of the billet's height
    hardening: increase of the yield stress per equivalent plastic strain
    kind: a long billet in plane strain, or a disc
"""

# %% [markdown]
# # Upsetting with friction
#
# A long billet, as wide as twice its height, is pressed flat between two rigid plates. Friction holds the metal back at the tools,
# the pressure rises towards the middle like a hill, and with it the force. Of the section a quarter is modelled in plane strain.
#
# The slab method takes stresses to be the same over the height. Equilibrium of a slab of the width dx, perfectly plastic with the yield
# stress Y, gives the pressure over x and the mean of it [Hosford and Caddell, Metal Forming, ch. 7]
#
# $$
# p = \frac{2 Y}{\sqrt 3} e^{2 \mu (b/2 - x) / h}, \qquad \bar p = \frac{2 Y}{\sqrt 3} \frac{e^q - 1}{q}, \qquad q = \frac{\mu b}{h},
# $$
#
# where the width b grows as the height h shrinks. `--kind axisymmetric` makes the billet a disc of the same section, for which
#
# $$
# p = Y e^{2 \mu (a - r) / h}, \qquad \bar p = 2 Y \frac{e^q - 1 - q}{q^2}, \qquad q = \frac{2 \mu a}{h}
# $$
#
# with the radius a. The method neglects the shear at the tools and bulging sides, and is good to some per cent where the billet is wider
# than high. With `--hardening` the yield stress follows from the mean strain ln(h0 / h).

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, mu=0.1, n=6, steps=60, reduction=0.5, hardening=0.0, kind=("plane_strain", "axisymmetric"),
    coupling=("node_to_surface", "mortar"),
)  # fmt: skip
E, nu, Y, width, height = 500.0, 0.3, 1.0, 2.0, 1.0

# %% [markdown]
# ## The scene
# Strains come to 2 and cells shear by as much. `FinitePlasticity` takes them, and does not lock, as plastic flow keeps the volume. The side
# belongs to the contactor as well, since it folds onto the tool.

# %%
mesh, tags = uem.read_gmsh(
    common.MESHES / "billet.geo", comm, gdim=2, parameters={"W": width / 2, "H": height / 2, "n_w": 3 * args.n, "n_h": args.n}
)
disc = args.kind == "axisymmetric"
if disc:
    uem.axisymmetric(mesh)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
metal = uem.FinitePlasticity(u, E, nu, Y, args.hardening, kind=args.kind)
tool = uem.RigidPlane([0.0, height / 2], [0.0, -1.0])
contact = uem.Contact(contactor=[tags["face"], tags["side"]], target=tool, friction=args.mu, coupling=args.coupling)
problem = uem.UnitedProblem(
    metal.residual(v),
    u,
    bcs=[uem.dirichlet(V, tags["axis"], 0), uem.dirichlet(V, tags["middle"], 1)],
    contacts=[contact],
    materials=[metal],
    load=lambda factor: tool.move([0.0, -args.reduction * factor * height / 2]),
    petsc_options_prefix="upsetting_",
    verbose=args.verbose,
)


# %% [markdown]
# ## The force
# Of the whole billet, per length in plane strain.


# %%
# the model is half of the width, or all of the disc; strains, and stresses in flow, over those of uniaxial compression
wide, strain = (1, 1.0) if disc else (2, 2 / 3**0.5)


def slab(reduction: float) -> float:
    """Force by the slab method."""
    h = height * (1 - reduction)
    flow = Y + args.hardening * strain * np.log(height / h)
    if disc:
        a = width / 2 * np.sqrt(height / h)
        q = 2 * args.mu * a / h
        return flow * np.pi * a**2 * (2 * (np.expm1(q) - q) / q**2 if q else 1.0)
    b = width * height / h
    q = args.mu * b / h
    return strain * flow * b * (np.expm1(q) / q if q else 1.0)


rows, iterations = [], 0
writer = (
    uem.ResultsWriter(f"{args.output}/upsetting", problem, fields={"peeq": metal.cell_averages()["peeq"]})
    if args.output
    else None
)
for step in uem.load_steps(problem, args.steps):
    iterations += step.newton_iterations
    reduction = args.reduction * step.factor
    force = wide * float(contact.resultant(on="target").force[1])
    rows.append({"reduction": reduction, "force": force, "slab": slab(reduction), "error": force / slab(reduction) - 1})
    if writer is not None:
        metal.cell_averages()
        writer.write(step)
if writer is not None:
    writer.close()

# %% [markdown]
# ## The table
# The change of volume shows whether the cells lock; the work of the tool is dissipated by plastic flow and friction.

# %%
F = uem.displacement_gradient(u)
J = ufl.det(ufl.Identity(len(F[0, :])) + F)
present, drawn = (uem.integrate(volume * ufl.dx(domain=mesh)) for volume in (J, 1.0))
peeq = metal.cell_averages()["peeq"]
largest = max(comm.allgather(float(peeq.x.array.max(initial=0.0))))
results = {
    "forming_error": max(abs(row["error"]) for row in rows),
    "force": rows[-1]["force"],
    "slab": rows[-1]["slab"],
    "volume_change": present / drawn - 1,
    "plastic_work": 2 * wide * metal.dissipation(),
    "friction_work": 2 * wide * contact.dissipation,
    "peeq": largest,
    "iterations_per_step": iterations / len(rows),
    "curve": rows[:: max(1, len(rows) // 10)],
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.6)) as (left, right):
        uem.plot_scene(problem, left, field=peeq, label="equivalent plastic strain", mirror=True, arrows=False)
        if right is not None:
            reductions = np.linspace(0.0, args.reduction, 100)
            right.plot(reductions, [slab(r) for r in reductions], "k", lw=1, label="slab method")
            right.plot([row["reduction"] for row in rows], [row["force"] for row in rows], ".", label="computed")
            right.set(xlabel="reduction of the height", ylabel="force" if disc else "force per length", ylim=(0, None))
            right.grid(alpha=0.25)
            right.legend(frameon=False)

# %%
assert results["forming_error"] < 0.05, results
assert abs(results["volume_change"]) < 0.01, results
