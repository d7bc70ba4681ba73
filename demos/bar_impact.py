"""An elastic bar hits a rigid wall, and is dropped onto it: impact, plateau and rebound against the exact solution.

python3 demos/bar_impact.py --plot bar_impact.png

Options:
    n: cells along the bar
    mass: consistent or lumped mass matrix
"""

# %% [markdown]
# # Bar on a wall
#
# A bar of length L = 10, Young's modulus 900 and density 1 flies against a rigid wall at v = 10. The wave that starts at the touch
# runs with c = 30 to the free end and back. All the while the wall feels the pressure rho c v = 300; then the bar leaves as fast as
# it came, without any vibration: contact from 0.5 to 1.166667.
#
# Dropped from a height of 5 under a gravity of 10 it touches at 1, 11/3, 19/3 and leaves at 5/3, 13/3, 7. Since the bar keeps falling
# during contact, the pressure rises from 300 to 500 in the first contact. The bar leaves vibrating, so that it falls from 500 to 300 in
# the second; then all begins anew.
#
# Contactors with mass collide with the wall, which takes some energy; held by it, their velocity changes its sign in every step, and the
# pressure alternates about the exact one. By default their mass is handed on to the nodes around, which keeps mass, centre and inertia.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=100, cfl=1.0, mass=("consistent", "lumped"))
E, rho, L, v0, gap, g = 900.0, 1.0, 10.0, 10.0, 5.0, 10.0
c = np.sqrt(E / rho)

# %% [markdown]
# ## One bar
# Touches and departures are found within a thousandth of a step, unless the contactors have mass.


# %%
def bar(dt: float, end: float, name: str, *, fall: bool = False, contactors: str = "massless", swing: bool = False):
    """A bar that flies, falls or swings on the wall: its history, touches, departures, and the last displacement.

    The columns of the history are time, contact pressure, mean velocity, and energy over the energy of the impact.
    """
    mesh, tags = uem.read_gmsh(
        common.MESHES / "bars.geo", comm, gdim=2, parameters={"n": args.n, "L": L, "gap": 0.0 if swing else gap}
    )
    V = uem.function_space(mesh, 1, (2,))
    u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
    y = V.tabulate_dof_coordinates()[: len(velocity.x.array) // 2, 1]
    velocity.x.array[1::2] = -v0 * np.sin(np.pi * y / (2 * L)) if swing else 0.0 if fall else -v0
    material = uem.LinearElastic(E, 0.0, kind="plane_stress")
    mass = {"consistent": uem.consistent_mass, "lumped": uem.lumped_mass}[args.mass](V, rho)
    dynamics = uem.Dynamics(mass, velocity=velocity, gravity=(0.0, -g if fall else 0.0), contactors=contactors)
    wall = uem.Contact(contactor=tags["lower_bottom"], target=uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), name="wall")
    problem = uem.UnitedProblem(
        material.residual(u, v) * ufl.dx, u, contacts=[wall], dynamics=dynamics, petsc_options_prefix="bar_", verbose=args.verbose
    )
    book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/{name}_energy.csv" if args.output else None)
    rows, touches, departures = [], [], []
    for step in uem.time_steps(problem, dt, end, event_tolerance=1e-3 if contactors == "massless" else None):
        row = book.write(step)
        energy = (row.kinetic + row.stored - row.external + (weight * gap if fall else 0.0)) / (
            weight * gap if fall else rho * L * v0**2 / 2
        )
        rows.append((step.time, wall.resultant().force[1], book.momenta[-1][1] / mass.total[1], energy))
        touches += [step.start] * bool(step.touched)
        departures += [step.start] * bool(step.left)
    book.close()
    return np.array(rows), touches, departures, u


# %% [markdown]
# ## Impact on the wall, and the effect of contactors with mass
# The plateau is the middle 80 % of the contact: a mesh cannot resolve the front of the wave.

# %%
weight, dt = rho * L * g, args.cfl * L / args.n / c
flight, (start,), (end,), _ = bar(dt, 1.5, "flight")
plateau = flight[(flight[:, 0] > start + 0.1 * (end - start)) & (flight[:, 0] < end - 0.1 * (end - start)), 1]
massy, _, _, _ = bar(dt, 1.5, "massy", contactors="massy")
drop, impacts, releases, _ = bar(dt, 7.3, "drop", fall=True)

# %% [markdown]
# ## Order in time
# A bar that stands on the wall and swings in its first mode is smooth in time while it presses. Halving the step must
# quarter the error; errors are differences from the next finer step.

# %%
ends = [bar(0.02 / 2**k, 0.3, "swing", swing=True)[3].x.array for k in range(5)]
errors = [max(comm.allgather(float(np.abs(a - b).max(initial=0.0)))) for a, b in zip(ends, ends[1:])]
convergence = [
    {"dt": 0.02 / 2**k, "error": e, "order": float(np.log2(errors[k - 1] / e)) if k else float("nan")}
    for k, e in enumerate(errors)
]
results = {
    "energy_ratio": float(flight[-1, 3]),
    "plateau_min": float(plateau.min()),
    "plateau_max": float(plateau.max()),
    "rebound_velocity": float(flight[-1, 2]),
    "contact_start": start,
    "contact_end": end,
    "impacts": impacts,
    "releases": releases,
    "drop_energy_drift": float(np.abs(drop[:, 3] - 1).max()),
    "massy_energy_ratio": float(massy[-1, 3]),
    "massy_largest_pressure": float(massy[:, 1].max()),
    "convergence": convergence,
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as panels:
        if panels[0] is not None:
            exact = [(0.0, 0.5, 7 / 6, 1.5), (0.0, 300.0, 0.0, 0.0)]
            falls = [(0, 1, 1, 5 / 3, 5 / 3, 11 / 3, 11 / 3, 13 / 3, 13 / 3, 19 / 3, 19 / 3, 7, 7, 7.3),
                     (0, 0, 300, 500, 0, 0, 500, 300, 0, 0, 300, 500, 0, 0)]  # fmt: skip
            panels[0].plot(massy[:, 0], massy[:, 1], ".-", ms=2, lw=0.7, color="C3", alpha=0.35, label="contactors with mass")
            panels[0].step(*exact, where="post", color="k", lw=2.5, label="exact")
            panels[0].plot(flight[:, 0], flight[:, 1], lw=1.5, color="C9", label="massless contactors")
            time, pressure = (np.array(part, dtype=float) for part in falls)
            fine = np.linspace(0.0, time[-1], 2001)
            p = np.interp(fine, time + 1e-9 * np.arange(len(time)), pressure)
            pushed = np.concatenate([[0.0], np.cumsum(np.diff(fine) * (p[1:] + p[:-1]) / 2)])
            panels[1].plot(fine, -g * fine + pushed / (rho * L), color="0.3", lw=2.5, alpha=0.4, label="exact")
            panels[1].plot(drop[:, 0], drop[:, 2], lw=1, label="dropped bar, massless contactors")
            panels[1].set(ylabel="mean velocity")
            for ax in panels:
                ax.set(xlabel="time", ylabel=ax.get_ylabel() or "contact pressure")
                ax.grid(alpha=0.25)
                ax.set_ylim(top=1.35 * ax.get_ylim()[1])
                ax.legend(frameon=False, loc="upper left")

# %%
assert abs(results["energy_ratio"] - 1) < 1e-3 and results["drop_energy_drift"] < 1e-3, results
if args.n >= 100 and args.cfl <= 1:
    assert plateau.min() > 291 and plateau.max() < 309, (plateau.min(), plateau.max())
    assert abs(results["rebound_velocity"] / v0 - 1) < 0.02, results
    for found, exact in ((impacts, (1, 11 / 3, 19 / 3)), (releases, (5 / 3, 13 / 3, 7))):
        assert np.allclose(found, exact, atol=0.03), (found, exact)
assert all(row["order"] > 1.9 for row in convergence[1:]), convergence
