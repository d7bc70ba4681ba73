"""A disc rolls down a rough incline, or slides, against the closed forms of a rigid one.

python3 demos/rolling.py --plot rolling.png

Options:
    n: cells around the disc, a multiple of 4
    layers: cells along the radius
"""

# %% [markdown]
# # Rolling down an incline
#
# A disc with a narrow hole, of radii R and r, lies on a rough rigid plane, which is tilted by alpha at once. With `k = (1 + r^2/R^2) / 2`
# its moment of inertia over m R^2, a rigid disc rolls with the acceleration
#
# $$
# \frac{g \sin \alpha}{1 + k} \quad \text{while} \quad \tan \alpha < \mu \left(1 + \frac{1}{k}\right),
# $$
#
# which is 2/3 g sin(alpha) up to 3 mu without a hole. Beyond, friction is not enough: it slides and turns with
#
# $$
# g\, (\sin \alpha - \mu \cos \alpha), \qquad \text{angular acceleration } \frac{\mu\, g \cos \alpha}{k R}.
# $$
#
# This disc is elastic: it rests on some of its nodes, whose anchors it leaves one after the other as it rolls over them.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, n=64, layers=5, E=400.0, mu=0.3, dt=0.02, end=3.0)
R, r, g = 1.0, 0.1, 1.0
k = (1 + (r / R) ** 2) / 2


# %% [markdown]
# ## One disc
# It is pressed on by its weight across the plane first. Its displacement is the displacement of its centre of mass; its angular velocity
# that about it.


# %%
def run(alpha: float):
    """Times, ways and angular velocities; the share of steps in which contactors slip; frames; k of the masses at the nodes."""
    mesh, tags = uem.read_gmsh(
        common.MESHES / "ring.geo", comm, gdim=2, parameters={"R": R, "r": r, "n": args.n, "layers": args.layers}
    )
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.StVenantKirchhoff(args.E, 0.3, kind="plane_strain")
    weight = fem.Constant(mesh, (0.0, -g * np.cos(alpha)))
    F = material.residual(u, v) * ufl.dx - ufl.inner(weight, v) * ufl.dx
    plane = uem.RigidPlane((0.0, -R), (0.0, 1.0))
    lies = uem.UnitedProblem(
        F, u, contacts=[uem.Contact(tags["outside"], plane, friction=args.mu)], petsc_options_prefix="lying_"
    )
    lies.solve()

    contact = uem.Contact(tags["outside"], plane, friction=args.mu)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=uem.generalised_alpha(0.5))
    problem = uem.UnitedProblem(
        F, u, contacts=[contact], dynamics=dynamics, petsc_options_prefix="rolling_", verbose=args.verbose
    )  # fmt: skip
    weight.value[:] = g * np.sin(alpha), -g * np.cos(alpha)
    writer = uem.ResultsWriter(f"{args.output}/rolling_{alpha:.2f}", problem) if args.output else None
    M, X = dynamics.mass.M, V.tabulate_dof_coordinates()[:, :2]
    vector, frames, every, slips = M.createVecRight(), [], max(1, round(args.end / args.dt / 6)), 0

    def moments(values: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Integral of the mass times values, and of their moment about the origin (collective)."""
        vector.array[:] = values[: len(vector.array) // 2].ravel()
        p = (M * vector).array_r.reshape(-1, 2)
        x = x[: len(p)]
        return comm.allreduce(np.array([*p.sum(axis=0), (x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0]).sum()]))

    def look() -> tuple[float, float]:
        """Where the centre is along the plane, and how fast the disc turns about it (collective)."""
        x = X + u.x.array.reshape(-1, 2)
        x = x - moments(x, x)[:2] / dynamics.mass.total[0]
        turning = moments(dynamics.velocity.x.array.reshape(-1, 2), x)[2] / moments(x[:, ::-1] * (-1, 1), x)[2]
        return float((X + u.x.array.reshape(-1, 2) - x)[0, 0]), -float(turning)

    rows = [(0.0, *look())]
    for step in uem.time_steps(problem, args.dt, args.end):
        rows.append((step.time, *look()))
        slips += comm.allreduce(int((contact.status.x.array[contact.pair.nodes] == 2).sum())) > 0
        if step.number % every == 1:
            if writer:
                writer.write(step)
            if args.plot:
                frames.append(uem.outline(problem))
    if writer:
        writer.close()
    t, x, omega = np.array(rows).T
    inertia = moments(X[:, ::-1] * (-1, 1), X)[2] / (dynamics.mass.total[0] * R**2)
    return t, x - x[0], omega, slips / (len(t) - 1), frames, float(inertia)


# %% [markdown]
# ## The figures
# After the tilt friction grows with the shear of the disc first, and the disc vibrates. Accelerations are fitted by a parabola and a line
# to the displacements and speeds of the last three quarters.

# %%
rows, curves = [], []
for part in (0.5, 0.9, 1.25, 2.0):
    alpha = float(np.arctan(part * args.mu * (1 + 1 / k)))
    t, x, omega, slips, frames, inertia = run(alpha)
    rolls = part < 1
    exact = g * (np.sin(alpha) / (1 + inertia) if rolls else np.sin(alpha) - args.mu * np.cos(alpha))
    turns = exact / R if rolls else args.mu * g * np.cos(alpha) / (inertia * R)
    later = t >= args.end / 4
    along, about = 2 * np.polyfit(t[later], x[later], 2)[0], np.polyfit(t[later], omega[later], 1)[0]
    rows.append({
        "tan(alpha)/mu": part * (1 + 1 / k), "acceleration": float(along), "exact": exact, "angular": float(about), "exact ": turns,
        "slipping": float(slips), "k": inertia, "error": float(max(abs(along / exact - 1), abs(about / turns - 1))),
    })  # fmt: skip
    curves.append((t, x, exact, frames))
results = {
    "disc": rows,
    "rolling_error": max(row["error"] for row in rows[:2]),
    "sliding_error": max(row["error"] for row in rows[2:]),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as (left, right):
        if left:
            for k, lines in enumerate(curves[1][3]):
                left.plot(*lines.transpose(2, 1, 0), color="C1", lw=1.0, alpha=0.25 + 0.75 * (k + 1) / len(curves[1][3]))
            left.axhline(-R, color="0.3", lw=2)
            left.set_title(f"tan(alpha) = {rows[1]['tan(alpha)/mu']:.2f} mu: it rolls, at equal times")
            left.set_aspect("equal")
            for (t, x, exact, _), row in zip(curves, rows):
                (line,) = right.plot(t, x, label=f"tan(alpha) = {row['tan(alpha)/mu']:.2f} mu")
                right.plot(t[::10], exact * t[::10] ** 2 / 2, "o", ms=3, color=line.get_color())
            right.set(xlabel="time", ylabel="displacement along the plane; dots: rigid disc")
            right.legend(frameon=False)

# %%
# a polygon rolls over its corners: it vibrates less the more of them there are, and the mean is the better the longer it rolls
bound = 0.02 * (64 / args.n) * (3.0 / args.end)
assert results["rolling_error"] < bound and results["sliding_error"] < bound, results
