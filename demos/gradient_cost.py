"""What a gradient through contact costs: its time over that of the forward solve, for 1, 100 and 10,000 moduli.

python3 demos/gradient_cost.py --json gradient_cost.json

Options:
    linear: sizes of linear elastic scenes, dimension:unknowns, comma-separated
    finite: sizes of scenes at finite strain, dimension:unknowns, comma-separated
    controls: numbers of moduli by which the force is differentiated, comma-separated
"""

# %% [markdown]
# # A gradient for less than half a solve
#
# A cylinder on a block (2D) and a sphere on a block (3D). The functional is the force; controls are a factor of all moduli (1), or
# the moduli of parts of the bodies (100 and 10,000, as many as there are cells at most): a `DG0` field is differentiated by all of its
# entries at once, and the derivative by a part's modulus is a sum of those by its cells.
#
# - *Linear bodies*: the stiffness that the forward solve factorised serves the adjoint problem too; there remain two solves with
#   the factors. The forward solve is one with new moduli, as in an iteration of an optimisation.
# - *Finite strain*: the tangent at the state that was found is assembled and factorised, as in one more Newton iteration. The forward solve
#   is one load step; the cost of a gradient is also given in Newton iterations.
#
# Forms were compiled before; each time is the least of some runs.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

args = common.arguments(
    __doc__, linear="2:20000,2:100000,3:40000", finite="2:20000,2:100000", controls="1,100,10000", runs=3,
    coupling=("node_to_surface", "mortar"),
)  # fmt: skip
NUMBERS = common.numbers(args.controls)


# %%
class Scene:
    """Two bodies of about so many unknowns, of linear material or at finite strain."""

    def __init__(self, dim: int, dofs: int, finite: bool):
        if dim == 2:
            names, parameters = ("hertz_cylinder", "disc_arc", "disc_top"), {"h": (1 / 120) * (11_000 / dofs) ** 0.5}
            push, held = -0.006, ["symmetry"]
        else:
            names, a = ("hertz_sphere", "sphere_cap", "sphere_top"), 0.005
            parameters = {"zone": 1.4 * a, "growth": 0.8 / a, "h": 0.1 * a * (89_000 / dofs) ** (1 / 3)}
            push, held = -(a**2), ["symmetry_x", "symmetry_y"]
        mesh, tags = uem.read_gmsh(common.MESHES / f"{names[0]}.geo", comm, gdim=dim, parameters=parameters)
        V = uem.function_space(mesh, 1, (dim,))
        self.finite, self.dim, self.dofs = finite, dim, dim * V.dofmap.index_map.size_global
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.factor, self.field = fem.Constant(mesh, 1.0), fem.Function(uem.function_space(mesh, ("DG", 0)))
        self.field.x.array[:] = 1e6
        law = uem.NeoHooke if finite else uem.LinearElastic
        stress = law(self.factor * self.field, 0.3, kind="plane_strain" if dim == 2 else "3d")
        self.F = stress.residual(self.u, v) * ufl.dx
        self.bcs = [uem.dirichlet(V, tags[name], i) for i, name in enumerate([*held, "block_bottom"])]
        self.bcs.append(uem.dirichlet(V, tags[names[2]], dim - 1, push))
        self.surfaces = {"contactor": tags[names[1]], "target": tags["block_top"]}
        # a unit motion of the top, along which the residual's work is the force that presses it down
        down = fem.Function(V)
        down.x.array[fem.locate_dofs_topological(V.sub(dim - 1), dim - 1, tags[names[2]].entities)] = -1.0
        down.x.scatter_forward()
        self.force = ufl.replace(self.F, {v: down})

    def solve(self) -> tuple[uem.UnitedProblem, list]:
        """The state under the present moduli, from scratch, and its iterations."""
        self.u.x.array[:] = 0.0
        contact = uem.Contact(**self.surfaces, coupling=args.coupling)
        problem = uem.UnitedProblem(
            self.F, self.u, bcs=self.bcs, contacts=[contact], petsc_options=common.direct(), petsc_options_prefix="gradient_",
            rtol=1e-10, verbose=args.verbose,
        )  # fmt: skip
        return problem, problem.solve()

    def gradient(self, problem: uem.UnitedProblem, n: int) -> np.ndarray:
        """Derivatives by the moduli of so many parts (collective)."""
        if n == 1:
            return uem.gradient(problem, self.force, self.factor)[0].ravel()
        (by_cell,) = uem.gradient(problem, self.force, self.field)
        cells = by_cell.function_space.dofmap.index_map
        part = (cells.local_range[0] + np.arange(cells.size_local)) % min(n, cells.size_global)
        sums = np.bincount(part, by_cell.x.array[: cells.size_local], min(n, cells.size_global))
        return comm.allreduce(sums)


def clock(call) -> tuple[float, object]:
    """Seconds that a call takes on the slowest rank, and its result."""
    comm.barrier()
    start = time.perf_counter()
    found = call()
    return max(comm.allgather(time.perf_counter() - start)), found


def measure(dim: int, dofs: int, finite: bool) -> dict[str, object]:
    """Time of a forward solve, and of gradients by more and more moduli over it."""
    scene = Scene(dim, dofs, finite)
    forward: list[float] = []
    spent: dict[int, list[float]] = {n: [] for n in NUMBERS}
    checks = np.zeros(len(NUMBERS))
    for run in range(args.runs + 1):
        scene.field.x.array[:] *= 1.01
        seconds, (problem, history) = clock(scene.solve)
        forward.append(seconds)
        for k, n in enumerate(NUMBERS):
            seconds, by = clock(lambda n=n, problem=problem: scene.gradient(problem, n))
            spent[n].append(seconds)
            checks[k] = np.sum(by) * (1.0 if n == 1 else scene.field.x.array[0])
    # every sum of derivatives, times the modulus, is the derivative by the common factor
    assert np.allclose(checks, checks[0], rtol=1e-8, atol=0.0)
    # the first run compiles
    best = min(forward[1:])
    row: dict[str, object] = {"strain": "finite" if finite else "small", "dim": dim, "dofs": scene.dofs}
    row |= {"iterations": len(history) - 1, "forward_seconds": best}
    row |= {f"gradient_{n}": min(spent[n][1:]) / best for n in NUMBERS}
    return row | {"in_iterations": (len(history) - 1) * max(min(spent[n][1:]) for n in NUMBERS) / best}


# %%
def worst(rows: list[dict]) -> float:
    """The largest cost of a gradient."""
    return max((row[f"gradient_{n}"] for row in rows for n in NUMBERS), default=float("nan"))


sizes = [(False, words) for words in args.linear.split(",")] + [(True, words) for words in args.finite.split(",")]
rows = [measure(*common.numbers(words, ":"), finite) for finite, words in sizes if words]
results = {
    "costs": rows,
    "cost_of_gradient": worst([row for row in rows if row["strain"] == "small"]),
    "cost_of_gradient_finite": worst([row for row in rows if row["strain"] == "finite"]),
    "ranks": comm.size,
}
common.report(args, results)
