"""Cattaneo and Mindlin's contact: a body is pressed onto a block, then pushed to and fro; part of the contact sticks, part slips.

python3 demos/cattaneo_mindlin.py --plot cattaneo_mindlin.png

Options:
    h: size of the cells relative to the contact zone; 0: 1/60 in 2D, 1/5 in 3D
    part: largest tangential force relative to mu P
    steps: load steps of the first push, and of each half of a reversal; 0: 4 in 2D, 2 in 3D
    loops: how often it is pushed back and forth again; 0: 2 in 2D, 1 in 3D
"""

# %% [markdown]
# # Stick and slip under a cylinder, or a sphere
#
# A half disc, with `--dim 3` a half sphere, is pressed onto a block of the same material. Its flat side, which is kept from turning, is
# then pushed sideways by a force Q up to 0.88 mu P, back to -0.88 mu P and forth again, twice. Between bodies of one material pressure and
# friction do not disturb each other: the pressure stays Hertz', and with f(r; c) = (c/a) sqrt(1 - r^2/c^2) within c, zero outside, the
# friction is
#
# $$
# \frac{q}{\mu p_0} = f(r; a) - f(r; c),
# \qquad c = a \left(1 - \frac{Q}{\mu P}\right)^{1/2}, \quad \text{under a sphere } c = a \left(1 - \frac{Q}{\mu P}\right)^{1/3},
# $$
#
# with stick within c and slip outside. On the way back from Q1 everything sticks at first, then slips from the edge inwards the other way:
#
# $$
# \frac{q}{\mu p_0} = f(r; a) - f(r; c_1) - 2\,(f(r; a) - f(r; b)),
# \qquad b = a \left(1 - \frac{Q_1 - Q}{2 \mu P}\right)^{1/2 \text{ or } 1/3},
# $$
#
# and so on in each reversal (Cattaneo, 1938; Mindlin, J. Appl. Mech. 16, 259, 1949; Mindlin and Deresiewicz, J. Appl. Mech. 20, 327, 1953;
# Johnson, Contact Mechanics, 7.2 to 7.4). The loop of force and displacement closes. Under the sphere distant points of both bodies move
# against each other by
#
# $$
# \delta = \frac{3 \mu P (2 - \nu)}{8 G a} \left(1 - \frac{c^2}{a^2}\right),
# $$
#
# and by twice the half of that in each reversal. Its bodies are 200 contact radii large, and half of both is modelled. Mindlin lets
# all points slip along the push; across it the bodies would move by a part of nu / (4 - 2 nu), which he leaves aside.

# %%
import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(__doc__, dim=("2", "3"), h=0.0, mu=0.3, part=0.88, steps=0, loops=0)
dim, E, nu, R, mu = int(args.dim), 1.0, 0.3, 1.0, args.mu
E_star, G = E / (2 * (1 - nu**2)), E / (2 * (1 + nu))
#: How far it is pressed down, the size of the contact zone that h is a part of, h, steps of a push, loops.
depth, reach, h, n, loops = (0.0012, 0.03, 1 / 60, 4, 2) if dim == 2 else (2.5e-5, 0.005, 1 / 5, 2, 1)
h, n, loops = args.h or h, args.steps or n, args.loops or loops

# %% [markdown]
# ## The scene

# %%
if dim == 2:
    scene, sizes = "cattaneo_mindlin.geo", {"h": h, "zone": reach}
else:
    scene, sizes = "hertz_sphere.geo", {"h": h * reach, "W": 2 * R, "zone": 1.1 * reach, "growth": 0.4 / (h * reach)}
    sizes |= {"half": 1, "flat": 1, "order": 2}
mesh, tags = uem.read_gmsh(common.MESHES / scene, comm, gdim=dim, parameters={"R": R, **sizes})
V = uem.function_space(mesh, dim - 1, (dim,))
u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
material = uem.LinearElastic(E, nu, kind="plane_strain") if dim == 2 else uem.LinearElastic(E, nu)
curved, flat = (tags[name] for name in (("disc_arc", "disc_top") if dim == 2 else ("sphere_cap", "sphere_top")))
cap, top, push, drop = uem.ds(curved), uem.ds(flat), fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
area = uem.integrate(fem.Constant(mesh, 1.0) * top)
F = material.residual(u, v) * ufl.dx - push / area * v[0] * top
bcs = [uem.dirichlet(V, tags["block_bottom"]), uem.dirichlet(V, flat, dim - 1, drop)]
if dim == 3:
    bcs.append(uem.dirichlet(V, tags["symmetry_y"], 1))
contact = uem.Contact(contactor=curved, target=tags["block_top"], friction=mu, sliding=("finite", "fixed")[dim - 2])
problem = uem.UnitedProblem(
    F, u, bcs=bcs, contacts=[contact], rtol=1e-10, petsc_options=common.cg() if dim == 3 else None, petsc_options_prefix="mindlin_",
    verbose=args.verbose,
)  # fmt: skip
writer = uem.ResultsWriter(f"{args.output}/cattaneo_mindlin", problem) if args.output else None


# %% [markdown]
# ## The closed form
# The change of friction after a reversal is twice the friction of a first loading by half of the amplitude.


# %%
def mindlin(r: np.ndarray, a: float, limit: float, last: float, Q: float) -> tuple[np.ndarray, float, float]:
    """Friction over mu p0 at r after the push went from ``last``, where it turned or began, to Q; radius of the stick zone; delta."""

    def f(c: float) -> np.ndarray:
        return c / a * np.sqrt(np.maximum(1 - (r / c) ** 2, 0.0))

    def loaded(change: float) -> tuple[np.ndarray, float, float]:
        c = a * (1 - change / limit) ** (1 / dim)
        return f(a) - f(c), c, 3 * limit * (2 - nu) / (8 * G * a) * (1 - (c / a) ** 2)

    if last == 0:
        return loaded(Q)
    (q1, _, way1), (change, c, way) = loaded(abs(last)), loaded(abs(Q - last) / 2)
    return np.sign(last) * (q1 - 2 * change), c, np.sign(last) * (way1 - 2 * way)


# %% [markdown]
# ## Pressed, then pushed
# The zone that sticks is as large as the part of the surface that its nodes have. Nodes within a facet of the edge of the contact are
# left out of the error: Hertz' pressure falls with a vertical tangent there. The contact moves with the body, by its middle x. Under a
# sphere nodes and facets lie against each other by chance, and nodal tractions scatter: means over rings a facet wide are compared.
# Surfaces there are of degree 2: linear tetrahedra err three times as much on cells half as large.

# %%
rows, profiles, facet = [], [], h * reach
sticking = fem.Function(contact.status.function_space)
# the forms of all steps are compiled once
stick_area, way_area = fem.form(sticking * cap), fem.form(u[0] * top)


def step_to(Q: float, last: float = 0.0) -> None:
    """One step and its results; contact forces push the body back."""
    push.value = Q
    (step,) = uem.load_steps(problem)
    if writer:
        writer.write(step)
    pair, P = contact.pair, contact.resultant().force[dim - 1]
    mine = pair.points, contact.pressures, contact.traction.x.array[::dim][pair.nodes]
    x, p, q = (np.concatenate(part) for part in zip(*comm.allgather(mine)))
    sticking.x.array[:] = contact.status.x.array == 1
    stick = uem.integrate(stick_area)
    if dim == 2:
        p0 = np.sqrt(P * E_star / (np.pi * R))
        a, stick = 2 * P / (np.pi * p0), stick / 2
    else:
        a, stick = np.cbrt(3 * 2 * P * R / (4 * E_star)), np.sqrt(2 * stick / np.pi)
        p0 = 3 * P / (np.pi * a**2)
    x[:, 0] -= (x[:, 0] * p).sum() / p.sum()
    r, q = np.linalg.norm(x[:, : dim - 1], axis=1), -q / (mu * p0)
    exact, c, way = mindlin(r, a, (dim - 1) * mu * P, last * (dim - 1), Q * (dim - 1))
    inside = r < a - facet
    wrong, ring = (q - exact)[inside], (r[inside] / facet).astype(int)
    if dim == 3:
        wrong = (np.bincount(ring, wrong) / np.maximum(np.bincount(ring), 1))[ring]
    rows.append({
        "Q/(mu P)": Q / (mu * P), "c/a": c / a, "traction_error": float(np.sqrt(np.mean(wrong**2))),
        "stick_edge_error": float(abs(stick - c) / facet), "iterations": step.newton_iterations,
        "way": uem.integrate(way_area) / area, **({"mindlin": way} if dim == 3 else {}),
    })  # fmt: skip
    # the picture shows those in the plane of symmetry
    order = np.flatnonzero((dim == 2) | (x[:, 1] < facet / 2))
    profiles.append((Q / limit, last, a, mu * P, x[order, 0] / a, q[order]))


for part in (0.25, 0.5, 0.75, 1.0):
    drop.value = -depth * part
    list(uem.load_steps(problem))
limit = args.part * mu * contact.resultant().force[dim - 1]
for k in range(1, n + 1):
    step_to(limit * k / n)
for sign in (-1, 1) * loops:
    for k in range(1, 2 * n + 1):
        step_to(sign * limit * (k / n - 1), -sign * limit)
if writer:
    writer.close()

# %% [markdown]
# ## The figures
# Stick edges in facets; a loop is to end where it began, from the second on to rounding.

# %%
way = np.array([row["way"] for row in rows])
results = {
    "step": rows[: 5 * n],
    "traction_error": max(row["traction_error"] for row in rows),
    "stick_edge_error": max(row["stick_edge_error"] for row in rows),
    "loop_error": float(abs(way[-1] - way[-1 - 4 * n]) / way.max()),
    "newton_iterations": max(row["iterations"] for row in rows),
    "dissipation": contact.dissipation,
    "dofs": dim * V.dofmap.index_map.size_global,
}
if dim == 3:
    delta = np.array([row["mindlin"] for row in rows])
    results["compliance_error"] = float(np.abs(way - delta).max() / delta.max())
common.report(args, results)

# %% [markdown]
# ## The picture
# Friction on the way up, on the way back, and the loop.

# %%
if args.plot:
    with uem.figure(args.plot, comm, panels=2, size=(5.0, 4.2)) as (left, right):
        if left:
            line = np.linspace(-1, 1, 801)
            shown = sorted({max(n // 2 - 1, 0), n - 1, n + n // 2 - 1, 2 * n - 1, 3 * n - 1})
            for k, colour in zip(shown, ("C0", "C1", "C2", "C3", "C4")):
                part, last, a, bound, x, q = profiles[k]
                exact, *_ = mindlin(np.abs(line) * a, a, bound, last, part * limit)
                left.plot(line, exact, color=colour, lw=1)
                left.plot(
                    x,
                    q,
                    ".",
                    ms=3,
                    color=colour,
                    label=f"Q = {round(part * args.part, 2) + 0.0:.2f} mu P, {'first loading' if k < n else 'cycle'}",
                )
            left.set(xlim=(-1.15, 1.15), xlabel="x / a", ylabel="friction / (mu p0), lines: Mindlin")
            if dim == 3:
                right.plot(
                    [0, *delta], [0, *(row["Q/(mu P)"] for row in rows)], "o", mfc="none", ms=6, color="C1", label="Mindlin"
                )
                right.legend(frameon=False)
            right.plot([0, *way], [0, *(row["Q/(mu P)"] for row in rows)], ".-", ms=3, lw=0.8)
            right.set(xlabel="tangential displacement of the flat side", ylabel="Q / (mu P)")
            for ax in (left, right):
                ax.grid(alpha=0.25)
            left.legend(
                frameon=False, ncol=2, columnspacing=0.8, handletextpad=0.1, loc="lower center", bbox_to_anchor=(0.5, 1.0)
            )

# %%
assert results["stick_edge_error"] <= 1 and results["newton_iterations"] <= (5 if dim == 2 else 8), results
assert results["loop_error"] < (1e-8 if loops > 1 and dim == 2 else 0.01), results
# friction has a vertical tangent where stick ends
if h <= (1 / 30, 1 / 4)[dim - 2]:
    assert results["traction_error"] < (1.5, 0.3)[dim - 2] * h and results.get("compliance_error", 0.0) < 0.3 * h, results
