"""An elastic-plastic column falls onto a massless beam: impact forces, rebound and the plastic strain that stays.

python3 demos/beam_impact.py --plot beam_impact.png
"""

# %% [markdown]
# # Impact of an elastic-plastic body on a beam
#
# The second example of Farahani, Mofid and Vafai (2001). A column of eight quadrilaterals in plane stress, with unit masses at all
# its nodes but the two that will touch, hits the middle of a clamped beam without mass at a speed of 32: once elastic, once with
# a yield stress of 800 and no hardening. There is no gravity.
#
# The contactors are massless, so that impact itself takes no energy: the elastic column leaves almost as fast as it came, what it
# lacks is its own vibration. What the plastic one loses stays in it as plastic work.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dt=0.01, end=0.6)
V0, E_beam, E_column, yield_stress = 32.0, 6e4, 2e4, 800.0

# %% [markdown]
# ## One impact
# Green-Lagrange strain and second Piola-Kirchhoff stress; in plane stress nothing locks.


# %%
def solve(name: str, limit: float, panels: list[object]) -> tuple[dict[str, float], np.ndarray]:
    """The figures of an impact, and its history: time, force, contact or not."""
    mesh, tags = uem.read_gmsh(common.MESHES / "beam_impact.geo", comm, gdim=2)
    V, S = uem.function_space(mesh, 1, (2,)), uem.function_space(mesh, ("DG", 0))
    u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
    E, strength = fem.Function(S), fem.Function(S)
    E.x.array[:], strength.x.array[:] = E_beam, np.inf
    E.x.array[tags["column"].entities], strength.x.array[tags["column"].entities] = E_column, limit
    mesh.topology.create_connectivity(2, 2)
    velocity.x.array[fem.locate_dofs_topological(V.sub(1), 2, tags["column"].entities)] = -V0
    law = uem.VonMises(u, E, 0.3, strength, kind="plane_stress", strain="green_lagrange")
    mass = uem.nodal_mass(V, lambda x: np.where(x[:, 1] > 1.01, 1.0, 0.0))
    contact = uem.Contact(contactor=tags["column_bottom"], target=tags["beam_top"])
    problem = uem.UnitedProblem(
        law.residual(v), u, bcs=[uem.dirichlet(V, tags["beam_ends"])], contacts=[contact], materials=[law],
        dynamics=uem.Dynamics(mass, velocity=velocity), petsc_options_prefix="beam_", verbose=args.verbose,
    )  # fmt: skip
    writer = uem.ResultsWriter(f"{args.output}/{name}", problem) if args.output else None
    book = uem.EnergyBook(problem, path=f"{args.output}/{name}_energy.csv" if args.output else None)
    frames = [0.04, 0.15, 0.3, 0.5][: len(panels)]
    history = []
    for step in uem.time_steps(problem, args.dt, args.end):
        history.append((step.time, contact.resultant().force[1], contact.n_active > 0))
        book.write(step)
        if writer is not None:
            writer.write(step)
        if frames and step.time > frames[0] - 1e-9:
            frames.pop(0)
            panel = panels.pop(0)
            peeq = law.cell_averages()["peeq"]
            uem.plot_scene(problem, panel, field=peeq, label="plastic strain", levels=PEEQ, arrows=False,
                           window=(-16, 16, -12, 42))  # fmt: skip
            if panel is not None:
                panel.set_title(f"t = {step.time:.2f}")
    for opened in (book, writer):
        if opened is not None:
            opened.close()
    t, force, touching = np.array(history).T
    largest = max(comm.allgather(float(law.peeq.x.array.max(initial=0.0))))
    rows = book.rows
    return {
        "peak_force": float(force.max()),
        "peak_time": float(t[force.argmax()]),
        "contact_start": float(t[touching > 0][0]),
        "contact_end": float(t[touching > 0][-1]),
        "final_velocity": float(book.momenta[-1][1] / mass.total[1]),
        "peeq": largest,
        "dissipated": rows[-1].dissipated / rows[0].kinetic,
        "energy_defect": rows[-1].defect / rows[0].kinetic,
    }, np.array(history)


# %% [markdown]
# ## Elastic and plastic
# The force is the vertical resultant of the contact forces.

# %%
PEEQ = list(np.linspace(0.0, 0.2, 11))
if args.plot:
    frames_file = args.plot.replace(".png", "_frames.png")
    with uem.figure(frames_file, comm, panels=4, columns=2, size=(4.4, 4.2)) as panels:
        plastic, plastic_history = solve("plastic", yield_stress, list(panels))
else:
    plastic, plastic_history = solve("plastic", yield_stress, [])
elastic, elastic_history = solve("elastic", np.inf, [])
common.report(args, {"dt": args.dt, "elastic": elastic, "plastic": plastic})

# %%
if args.plot:
    with uem.figure(args.plot, comm) as (panel,):
        if panel is not None:
            for label, history in (("elastic", elastic_history), ("yield stress 800", plastic_history)):
                panel.plot(history[:, 0], history[:, 1], ".-", ms=3, label=label)
            panel.set(xlabel="time", ylabel="contact force")
            panel.grid(alpha=0.25)
            panel.legend(frameon=False)

# %% [markdown]
# Figures of an independent code, for the two time steps that it was run with.

# %%
reference = {
    0.01: {"elastic": (4701.23, 0.22, 0.04, 0.38, 31.811), "plastic": (3871.42, 0.15, 0.04, 0.41, 18.912, 0.2527)},
    0.0025: {"elastic": (4726.93, None, None, None, 31.829), "plastic": (3896.22, None, None, None, 19.237, 0.2457)},
}
for name, found in (("elastic", elastic), ("plastic", plastic)):
    for value, expected in zip(found.values(), reference.get(args.dt, {}).get(name, ())):
        assert expected is None or abs(value / expected - 1) < 2e-3, (name, value, expected)
