"""Hertzian contact with a rigid indenter: united elements and the penalty method on the same mesh in one run.

python3 demos/hertz_penalty.py --plot penalty.png

Options:
    N: cells along each horizontal side of the block; half as many over its height
"""

# %% [markdown]
# # A rigid indenter, with and without a penalty
#
# A rigid paraboloid of radius R = 0.5 is pressed by d = 0.02 into an elastic block. A quarter of it is modelled,
# [0, 1]^2 x [-1, 0], with hexahedra that get smaller towards the origin. The surface z = 0 must stay below the indenter,
#
# $$
# u_z \le h(x, y) = -d + \frac{x^2 + y^2}{2 R}.
# $$
#
# The penalty method presses with pen <u_z - h>+ wherever the surface has gone too far, so it needs the overlap it forbids, and
# a number. The united elements eliminate u_z at the nodes that press. The exact solution of the discrete problem on the default
# mesh has the force F = 0.032099; Hertz, on a half-space, 0.029304.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc

import uem_dolfinx as uem

args = common.arguments(__doc__, N=30, degree=1)
R, d = 0.5, 0.02
OPTIONS = common.cg(rtol=1e-8)


def h(x):
    """Height of the indenter's surface over points (n, 3)."""
    return -d + (x[:, 0] ** 2 + x[:, 1] ** 2) / (2 * R)


# %% [markdown]
# ## The scene

# %%
mesh, tags = uem.read_gmsh(common.MESHES / "hertz_penalty.geo", comm, gdim=3, parameters={"N": args.N})
x = mesh.geometry.x
x[:] = x**2 * [1, 1, -1]
V = uem.function_space(mesh, args.degree, (3,))
u, v, du = fem.Function(V, name="displacement"), ufl.TestFunction(V), ufl.TrialFunction(V)
F = uem.LinearElastic(10.0, 0.3).residual(u, v) * ufl.dx
bcs = [uem.dirichlet(V, tags["bottom"]), uem.dirichlet(V, tags["side_x0"], 0), uem.dirichlet(V, tags["side_y0"], 1)]
top = fem.locate_dofs_topological(V, 2, tags["top"].entities)
X_top = V.tabulate_dof_coordinates()[top]

# %% [markdown]
# ## United elements
# The indenter is a height with its gradient. Both are taken where the contactors started, as in the penalty problem.

# %%
indenter = uem.RigidSurface(lambda x: h(x) - x[:, 2], lambda x: np.tile([0.0, 0.0, -1.0], (len(x), 1)))


def united() -> tuple[uem.UnitedProblem, uem.Contact, dict[str, float]]:
    """Solve by elimination."""
    u.x.array[:] = 0.0
    contact = uem.Contact(contactor=tags["top"], target=indenter, sliding="fixed", name="united elements")
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="united_", petsc_options=OPTIONS, verbose=args.verbose
    )
    start = time.perf_counter()
    history = problem.solve()
    seconds = time.perf_counter() - start
    linear = sum(iteration.linear_iterations for iteration in history)
    return problem, contact, row(-4 * contact.resultant().force[2], contact.max_pressure(), len(history) - 1, linear, seconds)


def row(force: float, p_max: float, newton: int, linear: int, seconds: float) -> dict[str, float]:
    """What is compared; the overlap is that of the deepest node."""
    depth = (u.x.array.reshape(-1, 3)[top, 2] - h(X_top)).max(initial=0.0)
    figures = {"F": float(force), "p_max": float(p_max), "overlap": float(max(comm.allgather(depth)))}
    return figures | {"newton_iterations": newton, "linear_iterations": linear, "seconds": seconds}


# %% [markdown]
# ## Penalty
# Plain DOLFINx: the pressure is one more term of the residual, and Newton's method does the rest, with the same linear solver,
# tolerances and near-null space.

# %%
pen, X = fem.Constant(mesh, 1.0), ufl.SpatialCoordinate(mesh)
ds = uem.ds(tags["top"], quadrature_degree=2)
pressure = pen * ufl.max_value(u[2] + d - (X[0] ** 2 + X[1] ** 2) / (2 * R), 0.0)
residual = F + pressure * v[2] * ds
form_b, form_A, form_F = map(fem.form, (residual, ufl.derivative(residual, u, ufl.TrialFunction(V)), pressure * ds))


def penalty(value: float) -> dict[str, float]:
    """Solve by penalty."""
    u.x.array[:] = 0.0
    pen.value = value
    A, ksp, n = petsc.create_matrix(form_A), PETSc.KSP().create(comm), 3 * V.dofmap.index_map.size_local
    for key, option in OPTIONS.items():
        PETSc.Options()["penalty_" + key] = option
    ksp.setOptionsPrefix("penalty_")
    ksp.setFromOptions()
    fixed = np.concatenate([bc.dof_indices()[0] for bc in bcs])
    fixed = fixed[fixed < n]
    A.setNearNullSpace(near_null_space(A.createVecRight(), fixed))
    start, newton, linear, first = time.perf_counter(), 0, 0, None
    while newton < 50:
        b = petsc.assemble_vector(form_b)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        b.array[fixed] = 0.0
        first = first or b.norm()
        if b.norm() <= 1e-8 * first:
            break
        A.zeroEntries()
        petsc.assemble_matrix(A, form_A, bcs)
        A.assemble()
        ksp.setOperators(A)
        step = b.duplicate()
        ksp.solve(b, step)
        u.x.array[:n] -= step.array
        u.x.scatter_forward()
        newton, linear = newton + 1, linear + ksp.getIterationNumber()
    seconds = time.perf_counter() - start
    depth = (u.x.array.reshape(-1, 3)[top, 2] - h(X_top)).max(initial=0.0)
    p_max = value * max(comm.allgather(depth))
    return {"penalty": value} | row(4 * uem.integrate(form_F), p_max, newton, linear, seconds)


def near_null_space(b: PETSc.Vec, fixed: np.ndarray) -> PETSc.NullSpace:
    """Rigid-body modes, zero where the displacement is prescribed."""
    vectors: list[PETSc.Vec] = []
    places = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local]
    for k in range(6):
        mode, (i, j) = np.zeros_like(places), ((0, 1), (0, 2), (1, 2))[k % 3]
        if k < 3:
            mode[:, k] = 1.0
        else:
            mode[:, i], mode[:, j] = -places[:, j], places[:, i]
        vector = b.duplicate()
        vector.array[:] = mode.ravel()
        vector.array[fixed] = 0.0
        for other in vectors:
            vector.axpy(-vector.dot(other), other)
        vector.normalize()
        vectors.append(vector)
    return PETSc.NullSpace().create(vectors=vectors, comm=comm)


# %% [markdown]
# ## The figures
# Every method runs once before it is timed, so that nothing is compiled or loaded on the clock.

# %%
united(), penalty(1e2)
penalties = [penalty(10.0**k) for k in range(2, 7)]
problem, contact, figures = united()
common.report(args, {"uem": figures, "penalty": penalties, "dofs": 3 * V.dofmap.index_map.size_global})

# %%
if args.plot:
    a, p0 = np.sqrt(R * d), 2 * 10.0 / (1 - 0.3**2) * np.sqrt(d / R) / np.pi
    with uem.figure(args.plot, comm, panels=2) as (left, right):
        if left is not None:
            left.loglog([r["penalty"] for r in penalties], [r["overlap"] / d for r in penalties], "o-", label="overlap / d")
            left.loglog([r["penalty"] for r in penalties], [abs(r["F"] / figures["F"] - 1) for r in penalties], "s-",
                        label="|F / F(united) - 1|")  # fmt: skip
            for r in penalties:
                left.annotate(
                    f"{r['newton_iterations']} its", (r["penalty"], r["overlap"] / d), (4, 6), textcoords="offset points"
                )
            left.margins(0.18)
            left.set_xlabel("penalty")
            left.set_title(
                f"united elements: overlap {figures['overlap']:.0e}, {figures['newton_iterations']} iterations", fontsize=10
            )
            left.legend(frameon=False)
            left.grid(alpha=0.25)
        uem.plot_pressure(contact, right, reference=lambda r: p0 * np.sqrt(np.maximum(1 - (r / a) ** 2, 0)),
                          reference_label="Hertz, half-space")  # fmt: skip
if args.output:
    with uem.ResultsWriter(f"{args.output}/hertz_penalty", problem) as writer:
        writer.write(1.0)

# %%
if args.N == 30:
    assert abs(figures["F"] / 0.032099 - 1) < 5e-4
