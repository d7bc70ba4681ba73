"""A spinning ring is thrown obliquely onto a rough wall, and rolls away from it.

python3 demos/spinning_ring.py --plot spinning_ring.png

Options:
    n: cells around the ring, a multiple of 4
    spin: initial angular velocity, counterclockwise: backspin
    along: initial velocity along the wall
    fall: initial velocity towards the wall
"""

# %% [markdown]
# # Spinning ring
#
# An elastic ring, without spin or with backspin, flies against a rough wall without gravity. Nothing but the wall acts on it, so that
#
# - the impulse along the wall is at most mu times the impulse normal to it, and equal to it where the ring slips all the while;
# - its momentum changes by the wall's impulse, and its angular momentum about the origin by the moment of that impulse.
#
# The trapezoidal rule does not keep the angular momentum `L(x, v) = sum m x x v` itself: that swings by what is of second order in the
# step. But its states are the midpoints of a path of the midpoint rule, which does: from step to step, to rounding,
#
# $$
# L_{n+1} = L_n + \Delta t\, m_n,
# \qquad L = L\!\left(x - \frac{\Delta t}{2} v,\; v - \frac{\Delta t}{2} a\right), \quad m_n \text{ the moment of the wall's forces at } n.
# $$
#
# Friction takes energy, and no more than there was.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dt=0.006, end=1.2, n=48, layers=3, E=500.0, spin=1.0, along=1.0, fall=1.0)
gap = 0.1


def motion(problem: uem.UnitedProblem, dynamics: uem.Dynamics) -> tuple[np.ndarray, ...]:
    """Places, velocities and accelerations of the owned nodes ``(n, 2)``."""
    size = dynamics.mass.M.getLocalSize()[0]
    u, v, a = (f.x.array[:size].reshape(-1, 2) for f in (problem.u, dynamics.velocity, dynamics.acceleration))
    return problem.u.function_space.tabulate_dof_coordinates()[: len(u), :2] + u, v.copy(), a.copy()


def angular_momentum(dynamics: uem.Dynamics, dt: float, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> float:
    """About the origin, of the path of the midpoint rule half a step before (collective)."""
    velocity = dynamics.mass.M.createVecRight()
    velocity.array[:] = (v - dt / 2 * a).ravel()
    p, x = (dynamics.mass.M * velocity).array_r.reshape(-1, 2), x - dt / 2 * v
    return float(comm.allreduce(x[:, 0] @ p[:, 1] - x[:, 1] @ p[:, 0]))


# %% [markdown]
# ## One throw
# The ring turns as a rigid body before it touches: its velocity consists of the velocity of its centre and the spin about it. A turn
# strains no St Venant-Kirchhoff material.


# %%
def throw(mu: float):
    """Figures of one throw, and its frames."""
    mesh, tags = uem.read_gmsh(common.MESHES / "ring.geo", comm, gdim=2, parameters={"n": args.n, "layers": args.layers})
    V = uem.function_space(mesh, 1, (2,))
    u, v, velocity = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
    velocity.interpolate(lambda x: np.array([args.along - args.spin * x[1], -args.fall + args.spin * x[0]]))
    material = uem.StVenantKirchhoff(args.E, 0.3, kind="plane_strain")
    wall = uem.Contact(contactor=tags["outside"], target=uem.RigidPlane((0.0, -1.0 - gap), (0.0, 1.0)), friction=mu, name="wall")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity)
    problem = uem.UnitedProblem(
        material.residual(u, v) * ufl.dx, u, contacts=[wall], dynamics=dynamics, rtol=1e-11, petsc_options_prefix="ring_",
        verbose=args.verbose,
    )  # fmt: skip
    book = uem.EnergyBook(problem, material.energy(u) * ufl.dx, path=f"{args.output}/energy_{mu}.csv" if args.output else None)
    writer = uem.ResultsWriter(f"{args.output}/ring_{mu}", problem) if args.output else None
    frames, every, turned, turning = [], max(1, round(args.end / args.dt / 6)), [0.0], []
    last, before, moment = 0.0, motion(problem, dynamics), 0.0
    for step in uem.time_steps(problem, args.dt, args.end):
        book.write(step)
        now = motion(problem, dynamics)
        turning.append(angular_momentum(dynamics, 0.0, *now))
        if len(turning) > 1:
            dt = step.time - last
            ends = (angular_momentum(dynamics, dt, *state) for state in (before, now))
            turned.append(turned[-1] - next(ends) + next(ends) - dt * moment)
        last, before, moment = step.time, now, float(wall.resultant().moment[0])
        if step.number % every == 1:
            if writer:
                writer.write(step)
            if args.plot:
                frames.append(uem.outline(problem))
    book.close()
    if writer:
        writer.close()
    rows, (along, normal) = book.rows, book.impulses[-1][0]
    change = book.momenta[-1] - book.momenta[0] - book.impulses[-1][0] + book.impulses[0][0]
    return {
        "mu": mu, "impulse ratio": float(abs(along) / normal), "momentum": float(np.abs(change).max() / normal),
        "angular momentum": float(np.abs(turned).max() / normal), "turning": turning[-1],
        "friction": rows[-1].friction / rows[0].kinetic,
        "energy": (rows[-1].kinetic + rows[-1].stored + rows[-1].friction) / rows[0].kinetic - 1,
    }, frames  # fmt: skip


rows, pictures = [], {}
for mu in (0.1, 0.3, 0.9):
    row, pictures[mu] = throw(mu)
    rows.append(row)
results = {
    "throw": rows,
    "cone_excess": max(row["impulse ratio"] / row["mu"] - 1 for row in rows),
    "momentum_error": max(row["momentum"] for row in rows),
    "angular_momentum_error": max(row["angular momentum"] for row in rows),
}
common.report(args, results)

# %% [markdown]
# ## The picture
# Rings at equal times, each to the right of the one before.

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 3.8)) as (left, right):
        if left:
            for row, (mu, frames) in enumerate(pictures.items()):
                for k, lines in enumerate(frames):
                    left.plot(*(lines + [2.3 * k, -2.6 * row]).transpose(2, 1, 0), color=f"C{row}", lw=0.8)
                left.plot([-1.4, 2.3 * len(frames)], 2 * [-1.0 - gap - 2.6 * row], color="0.3", lw=2)
                left.text(-1.6, -2.6 * row, f"mu = {mu}", ha="right", va="center")
            left.set_aspect("equal")
            left.axis("off")
            mus, ratios = np.array([(row["mu"], row["impulse ratio"]) for row in rows]).T
            right.plot([0.0, 1.0], [0.0, 1.0], color="0.3", lw=1, label="slip throughout: mu")
            right.plot(mus, ratios, "o", label="rings")
            right.set(xlabel="coefficient of friction mu", ylabel="tangential / normal impulse")
            right.grid(alpha=0.25)
            right.legend(frameon=False)

# %%
assert results["cone_excess"] < 1e-10 and results["momentum_error"] < 1e-10 and results["angular_momentum_error"] < 1e-10, results
# the error due to steps in which contact begins or ends is of first order in their length
assert all(row["friction"] > 0 > row["energy"] > -args.dt for row in rows), rows
