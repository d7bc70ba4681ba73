"""A mass on an elastic-plastic spring falls onto the ground: every phase of the motion against its exact solution.

python3 demos/exact_impact.py --plot exact_impact.png

Options:
    length: length of the spring
"""

# %% [markdown]
# # Impact with an exact solution
#
# The third example of Farahani, Mofid and Vafai (2001), with its misprints corrected. A unit mass on a spring of stiffness 200
# falls with a velocity of 10 under a gravity of 10 from 3.5805 above the ground. The spring yields at a force of 150. With the
# displacement u upwards, omega = sqrt(200) and each phase's own time, the motion is
#
# | phase | position |
# |---|---|
# | fall | $-10\, t - 5\, t^2$ |
# | elastic | $-3.5805 - \frac{13.1}{\omega} \sin \omega t + 0.05 \cos \omega t - 0.05$ |
# | plastic | $-4.3305 + 70\, t^2 - 8.608717\, t$ |
# | unloading | $-3.845179 - 0.7 \cos \omega t - 0.05$ |
# | flight | $-3.845179 + 9.874209\, t - 5\, t^2$ |
# | second contact | $-3.845179 - \frac{9.874209}{\omega} \sin \omega t + 0.05 \cos \omega t - 0.05$ |
#
# Here the spring is a quadrilateral 20 wide and `length` high in plane stress, free sideways, with half the mass at each of its
# upper nodes, upwards only. Its Green-Lagrange strain differs from shortening over length by a part of 0.75 / (2 length).

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from dolfinx.mesh import locate_entities_boundary
from scipy.interpolate import CubicHermiteSpline

import uem_dolfinx as uem

args = common.arguments(__doc__, length=6000.0, dt=0.001)
k, G, V0, gap, width, Fy, w = 200.0, 10.0, 10.0, 3.5805, 20.0, 7.5, np.sqrt(200.0)

# %% [markdown]
# ## The exact motion
# The constants of each phase follow from the end of the phase before.

# %%
fallen = (-V0 + np.sqrt(V0**2 + 2 * G * gap)) / G
v1 = -V0 - G * fallen  # 13.1 downwards at the touch
reach = np.hypot(v1 / w, G / k)
t_yield = (np.arcsin((150.0 / k - G / k) / reach) - np.arctan2(-G / k, -v1 / w)) / w
v2 = v1 * np.cos(w * t_yield) - G / k * w * np.sin(w * t_yield)
t_stop = -v2 / (150.0 - G)
set_ = -(v2 * t_stop + 70.0 * t_stop**2)  # plastic shortening
t_rise = np.arccos(-(G / k) / (0.75 - G / k)) / w
v3 = (0.75 - G / k) * w * np.sin(w * t_rise)
swing = 2 * (np.pi - np.arctan2(v3 / w, G / k)) / w
rest = -gap - set_
PHASES = [  # name, duration, u and v in the phase's own time
    ("fall", fallen, lambda t: -V0 * t - G / 2 * t**2, lambda t: -V0 - G * t),
    ("elastic", t_yield, lambda t: -gap + v1 / w * np.sin(w * t) + G / k * np.cos(w * t) - G / k,
     lambda t: v1 * np.cos(w * t) - G / k * w * np.sin(w * t)),
    ("plastic", t_stop, lambda t: -gap - 0.75 + v2 * t + 70.0 * t**2, lambda t: v2 + 140.0 * t),
    ("unloading", t_rise, lambda t: rest - (0.75 - G / k) * np.cos(w * t) - G / k, lambda t: (0.75 - G / k) * w * np.sin(w * t)),
    ("flight", 2 * v3 / G, lambda t: rest + v3 * t - G / 2 * t**2, lambda t: v3 - G * t),
    ("second contact", swing, lambda t: rest - v3 / w * np.sin(w * t) + G / k * np.cos(w * t) - G / k,
     lambda t: -v3 * np.cos(w * t) - G / k * w * np.sin(w * t)),
]  # fmt: skip
STARTS = np.cumsum([0.0, *(phase[1] for phase in PHASES)])


def exact(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and force over mass at the times ``t (n,)``."""
    which = np.clip(np.searchsorted(STARTS, t, side="right") - 1, 0, len(PHASES) - 1)
    u = np.array([PHASES[i][2](s - STARTS[i]) for i, s in zip(which, t)])
    pressed = np.isin(which, (1, 3, 5))
    plastic = np.where(which > 2, -set_, 0.0)
    return u, np.where(which == 2, 150.0, np.where(pressed, k * (plastic - gap - u), 0.0))


# %% [markdown]
# ## The scene
# One square of the mesh, stretched to the length of the spring. The mass moves upwards only, so the left side slides on rollers.

# %%
L = args.length
mesh, tags = uem.read_gmsh(
    common.MESHES / "bars.geo", comm, gdim=2, parameters={"L": L, "width": width, "gap": gap, "n": 1, "n_width": 1}
)
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
law = uem.VonMises(u, k * L / width, 0.3, Fy, kind="plane_stress", strain="green_lagrange")
left = locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[0], -width / 2))
bcs = [uem.dirichlet(V, left, 0)]
mass = uem.nodal_mass(V, lambda x: np.where(x[:, 1] > L / 2, 0.5, 0.0)[:, None] * [0.0, 1.0])
ground = uem.Contact(contactor=tags["lower_bottom"], target=uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), name="ground")
problem = uem.UnitedProblem(
    law.residual(v), u, bcs=bcs, contacts=[ground], materials=[law], petsc_options_prefix="spring_", verbose=args.verbose,
    dynamics=uem.Dynamics(mass, velocity=(0.0, -V0), gravity=(0.0, -G)), rtol=1e-10,
)  # fmt: skip

# %% [markdown]
# ## The motion
# Touches and departures are found by the time stepping to a thousandth of a step. Yielding starts when the elastic shortening is
# used up, and the mass turns where its velocity vanishes: both within a step, by the cubic through its ends.

# %%
top = fem.locate_dofs_topological(V.sub(1), 1, tags["lower_top"].entities)
top = top[top < 2 * V.dofmap.index_map.size_local]


def mean(field: fem.Function) -> float:
    """Mean over the two upper nodes."""
    parts = comm.allgather((float(field.x.array[top].sum()), len(top)))
    return sum(part[0] for part in parts) / sum(part[1] for part in parts)


def between(before: tuple, after: tuple, derivative: int, value: float) -> tuple[float, float, float]:
    """Time, u and v within a step where u (derivative 0) or v (1) has a value: a root of the cubic through its ends."""
    cubic = CubicHermiteSpline([before[0], after[0]], [before[1], after[1]], [before[2], after[2]])
    curve = cubic.derivative() if derivative else cubic
    t = float(curve.solve(value, extrapolate=False)[0])
    return t, float(cubic(t)), float(cubic(t, 1))


writer = uem.ResultsWriter(f"{args.output}/exact_impact", problem) if args.output else None
rows, phases = [(0.0, 0.0, -V0, 0.0)], [{"name": "fall", "t": 0.0, "u": 0.0, "v": -V0}]
yield_shortening = L * (1 - np.sqrt(1 - 2 * Fy / (k * L / width)))
for step in uem.time_steps(problem, args.dt, 2.8, event_tolerance=1e-3):
    rows.append((step.time, mean(u), mean(problem.dynamics.velocity), ground.resultant().force[1]))
    before, after, name = rows[-2], rows[-1], phases[-1]["name"]
    found = None
    if step.touched:
        found = ("elastic" if name == "fall" else "second contact", *before[:3])
    elif step.left:
        found = ("flight" if name == "unloading" else "end", *before[:3])
    elif name == "elastic" and -gap - after[1] > yield_shortening:
        found = ("plastic", *between(before, after, 0, -gap - yield_shortening))
    elif name == "plastic" and after[2] > 0:
        found = ("unloading", *between(before, after, 1, 0.0))
    if found:
        phases.append(dict(zip(("name", "t", "u", "v"), found)))
    if writer is not None:
        writer.write(step)
if writer is not None:
    writer.close()

# %% [markdown]
# ## Against the exact solution

# %%
t, u_top, v_top, force = np.array(rows).T
u_exact, force_exact = exact(t)
by_name = {phase["name"]: phase for phase in phases}
results = {
    "length": L,
    "dt": args.dt,
    "phases": phases,
    "plastic_set": -gap - by_name["flight"]["u"],
    "yield_shortening": -gap - by_name["plastic"]["u"],
    "deepest": -gap - by_name["unloading"]["u"],
    "peak_force_per_mass": float(force.max()),
    "max_error_u": float(np.abs(u_top - u_exact)[t <= STARTS[-1]].max()),
    "dissipation_per_mass": law.dissipation(),
}
common.report(args, results)

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2) as panels:
        if panels[0] is not None:
            fine = np.linspace(0.0, STARTS[-1], 4000)
            labels, places = ("displacement", "contact force / mass"), ("lower center", "upper center")
            for ax, computed, curve, label, place in zip(panels, (u_top, force), exact(fine), labels, places):
                ax.plot(fine, curve, color="0.3", lw=1.0, label="exact")
                few = max(len(t) // 280, 1)
                ax.plot(t[::few], computed[::few], ".", ms=3, label=f"dt = {args.dt:g}, length {L:g}")
                ax.set(xlabel="time", ylabel=label)
                ax.grid(alpha=0.25)
                ax.legend(frameon=False, loc=place)

# %%
if args.dt <= 0.001 and L >= 6000:
    starts = [(STARTS[i], phase[2](0.0), phase[3](0.0)) for i, phase in enumerate(PHASES)] + [(STARTS[-1], rest, v3)]
    assert len(phases) == len(starts)
    for phase, wanted in zip(phases, starts):
        for name, value, size in zip(("t", "u", "v"), wanted, (1.0, 1.0, V0)):
            assert abs(phase[name] - value) < 5e-4 * max(abs(value), 0.1 * size), (phase, name, value)
    assert abs(results["plastic_set"] / set_ - 1) < 5e-4
if args.dt <= 0.001 and L == 60:
    wanted = {"yield_shortening": 0.754747, "peak_force_per_mass": 148.113, "deepest": 1.024042}
    for name, value in wanted.items():
        assert abs(results[name] / value - 1) < 2e-4, (name, results[name], value)
    for name, which, value in (("unloading", "t", 0.437270), ("flight", "t", 0.554939), ("flight", "v", 9.865952)):
        assert abs(by_name[name][which] / value - 1) < 2e-4, (name, which, by_name[name], value)
