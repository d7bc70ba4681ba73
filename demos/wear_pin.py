"""Wear by Archard's law: a flat pin and a round one on a floor that is drawn under them, plane strain.

python3 demos/wear_pin.py --plot wear.png

Options:
    h: size of the round pin's cells in the contact zone
    steps: steps in which the floor is drawn under the pins
"""

# %% [markdown]
# # Pins that wear
#
# Two elastic pins are pressed onto a rigid floor, which is pulled by s under them without friction. What a pin loses is `k N s`, the
# coefficient k times force and slip. The flat pin loses the depth `k p s` everywhere. The round one, a cylinder of radius R, touches
# first over Hertz' half width; as it wears its pressure falls and its flat grows. Once elastic strains no longer matter, the half width
# is half of the chord that cuts off the worn volume, `2 a^3 / (3 R) = k N s`.
#
# In between there is no closed form. The answer is compared with a calculation of another kind: Hertz' half-plane, whose surface
# sinks by the logarithm of the distance, in strips of constant pressure on a profile that wears.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, h=1 / 250, steps=60, coupling=("node_to_surface", "mortar"))

# %% [markdown]
# ## The scene
# Both pins wear by the same coefficient. Half of the round one is meshed.

# %%
E, nu, R, width, worn = 1e6, 0.3, 1.0, 0.02, 0.04
E_star = E / (1 - nu**2)
N = np.pi * E_star * width**2 / (4 * R)  # presses the round pin to Hertz' half width
k, p, way = 1e-6, 2e3, 2 * worn**3 / (3 * R) / (1e-6 * N)
mesh, tags = uem.read_gmsh(common.MESHES / "wear_pin.geo", comm, gdim=2, parameters={"h": args.h, "R": R})
V = uem.function_space(mesh, 1, (2,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
F += p * v[1] * uem.ds(tags["flat_top"]) + N / (2 * R) * v[1] * uem.ds(tags["round_top"])
bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["flat_side"], 0)]
floor = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
flat, pin = (
    uem.Contact(contactor=tags[f"{name}_foot"], target=floor, wear=k, coupling=args.coupling, name=name)
    for name in ("flat", "round")
)
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[flat, pin], petsc_options_prefix="wear_")

# %% [markdown]
# ## The run
# The first solution presses, which wears the round pin a little as it flattens; every further one draws the floor on. Gaps are
# larger by the depth worn after each. A step may not wear a contactor by more than it springs back under its load: the finer the
# mesh, the more steps.

# %%
start = time.perf_counter()
writer = uem.ResultsWriter(f"{args.output}/wear_pin", problem) if args.output else None
widths = []
for i in range(args.steps + 1):
    floor.move([-way * i / args.steps, 0.0])
    problem.solve()
    widths.append(uem.integrate(pin.active * uem.ds(tags["round_foot"])))
    if writer:
        writer.write(i)
if writer:
    writer.close()
seconds = time.perf_counter() - start

# %% [markdown]
# ## The other calculation
# Strips of a half-plane under symmetric pressure; where they touch, `sinking + profile + wear = const`, and the strips with tension, at
# the rim, are let go.


# %%
def half_plane(strips=80, steps=800):
    """Places and depths worn of the right half of the round pin."""
    d = 1.3 * worn / strips
    x = (np.arange(strips) + 0.5) * d
    primitive = lambda y: y * np.log(np.abs(y))  # noqa: E731
    strip = lambda y: primitive(y + d / 2) - primitive(y - d / 2) - d  # noqa: E731
    sink = -2 / (np.pi * E_star) * (strip(x[:, None] - x) + strip(x[:, None] + x))
    depth, m = np.zeros(strips), strips
    for _ in range(steps):
        m = min(m + 2, strips)
        while True:
            A = np.block([[sink[:m, :m], -np.ones((m, 1))], [np.full((1, m), 2 * d), np.zeros((1, 1))]])
            pressure = np.linalg.solve(A, np.append(-(x[:m] ** 2) / (2 * R) - depth[:m], N))[:-1]
            if (pressure > 0).all():
                break
            m -= 1
        depth[:m] += k * pressure * way / steps
    return x, depth, (m + 0.5) * d


x, depth, half_width = half_plane()
foot = flat.wear.x.array[flat.nodes]
here = pin.points[:, 0], pin.wear.x.array[pin.nodes]
place, found = (np.concatenate(comm.allgather(part)) for part in here)
inside = place < 0.8 * half_width
other = np.interp(place[inside], x, depth)

# %% [markdown]
# ## The figures
# Volumes are exact. Depths of the round pin are compared with the half-plane's where it touches, relative to the deepest.

# %%
largest = comm.allreduce(np.abs(foot - k * p * way).max(initial=0.0), op=common.MPI.MAX)
results = {
    "wear_error": float(np.abs(found[inside] - other).max() / depth.max()),
    "flat_error": float(largest / (k * p * way)),
    "volume / (k N s)": 2 * pin.worn_volume / (k * N * way),
    "half_width_hertz": width,
    "half_width_first": widths[0],
    "half_width_last": widths[-1],
    "half_width_half_plane": float(half_width),
    "half_width_chord": worn,
    "p_max": pin.max_pressure(),
    "steps": args.steps,
    "dofs": 2 * V.dofmap.index_map.size_global,
    "seconds": seconds,
}
common.report(args, results)

# %% [markdown]
# ## The picture
# The worn pins, and the worn depth of the round one against the half-plane solution.

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.0)) as (left, right):
        uem.plot_scene(problem, left, window=(-1.5 * worn, 1.5 * worn, -0.4 * worn, 2.2 * worn), mirror=True)
        if right:
            order = np.argsort(place)
            right.plot(x / width, depth / worn * 1e3, "k--", label="half-plane")
            right.plot(place[order] / width, found[order] / worn * 1e3, ".", label="pin")
            right.set(xlim=(0.0, 1.3 * worn / width), xlabel="x / a of Hertz", ylabel="1000 depth / half width worn to")
            right.legend()

# %%
assert results["flat_error"] < 1e-9 and abs(results["volume / (k N s)"] - 1) < 1e-2
if args.h <= 1 / 250:
    assert results["wear_error"] < 0.02
