"""What contact costs: time, memory and iterations with contact over those of the same bodies without, and where the time goes.

python3 demos/cost.py --json cost.json --plot cost.png

Options:
    linear: sizes of linear elastic scenes, dimension:unknowns, comma-separated
    finite: sizes of scenes at finite strain, dimension:unknowns, comma-separated
    cg: unknowns of the 3D scenes in which CG iterations are counted, comma-separated
    stiffness: Young's moduli of the sphere relative to the block's, comma-separated, at the first size of --cg; 1 at others
    amg: multigrid of these scenes; best: hypre where PETSc has it
"""

# %% [markdown]
# # Contact for the price of a few linear solves
#
# A cylinder on a block (2D) and a sphere on a block (3D) are meshed by Gmsh with more and more unknowns. Each is solved twice
# with the same solver and tolerance, from the making of the problem to its last state:
#
# - *with contact*: pressed together by Dirichlet conditions, in one load step from scratch;
# - *without*: no contact, and a body force, so that there is something to solve. What is prescribed would only move the bodies.
#
# Linear bodies slide little (`sliding="small"`); bodies at finite strain, neo-Hookean, slide as far as they like. Then one united solve to
# 1e-8 is looked at: how many iterations CG with multigrid takes for more and more unknowns, and for a sphere that is stiffer than the
# block. Forms were compiled before. Lists are parted by commas, so that `--linear 3:100000,3:500000` means two sizes in 3D.

# %%
import time
from pathlib import Path

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks.measure import linear_work, machine

import uem_dolfinx as uem

args = common.arguments(
    __doc__,
    linear="2:20000,2:100000,2:200000,3:20000,3:100000,3:500000",
    finite="2:200000,3:200000",
    cg="20000,100000,500000,1000000",
    stiffness="1,0.01,0.0001,100,10000",
    amg=("best", "hypre", "gamg"),
    coupling=("node_to_surface", "mortar"),
    runs=1,
)
#: Timers of the parts due to contact, and of the others; some include others.
CONTACT = (
    "search and projection", "uniting equations", "contact curvature", "restriction matrix P", "united matrix P'KP",
    "united matrix Q'KP", "condensed matrix", "deflation",
)  # fmt: skip
SET_UP = "factorisation or preconditioner set-up"
BODIES = ("assemble residual", "assemble tangent", SET_UP, "linear solve")
STAGES = (*CONTACT, "cross out prescribed components", *BODIES)
TOLERANCE = 1e-8


def pairs(text: str) -> list[list[int]]:
    """Dimensions and numbers of unknowns."""
    return [common.numbers(word, ":") for word in text.split(",") if word]


# %% [markdown]
# ## The scene


# %%
class Hertz:
    """A cylinder or a sphere on a block with about so many unknowns, the same mesh with contact and without."""

    def __init__(self, dim: int, dofs: int):
        a = 0.005
        names = ("hertz_cylinder", "disc_arc", "disc_top") if dim == 2 else ("hertz_sphere", "sphere_cap", "sphere_top")
        if dim == 2:
            parameters, self.push, held = {"h": (1 / 120) * (11_000 / dofs) ** 0.5}, -0.006, ["symmetry"]
        else:
            parameters = {"zone": 1.4 * a, "growth": 0.8 / a, "h": 0.1 * a * (89_000 / dofs) ** (1 / 3)}
            self.push, held = -(a**2), ["symmetry_x", "symmetry_y"]
        self.mesh, tags = uem.read_gmsh(common.MESHES / f"{names[0]}.geo", comm, gdim=dim, parameters=parameters)
        self.V = uem.function_space(self.mesh, 1, (dim,))
        self.dim, self.tags, self.surface = dim, tags, names[1]
        self.bcs = [uem.dirichlet(self.V, tags[name], i) for i, name in enumerate([*held, "block_bottom"])]
        self.bcs.append(uem.dirichlet(self.V, tags[names[2]], dim - 1, self.push))
        self.dofs = dim * self.V.dofmap.index_map.size_global
        #: Young's modulus of the cells.
        self.E = fem.Function(uem.function_space(self.mesh, ("DG", 0)))

    def problem(
        self, contact: bool, finite: bool = False, stiffness: float = 1.0, options: dict | None = None
    ) -> uem.UnitedProblem:
        """The problem, with contact or without."""
        V, dim = self.V, self.dim
        self.E.interpolate(lambda x: np.where(x[dim - 1] > 0.0, 1e6 * stiffness, 1e6))
        u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        law = uem.NeoHooke if finite else uem.LinearElastic
        F = law(self.E, 0.3, kind="plane_strain" if dim == 2 else "3d").residual(u, v) * ufl.dx
        contacts = []
        if contact:
            sliding = "finite" if finite else "small"
            contactor, target = self.tags[self.surface], self.tags["block_top"]
            contacts = [uem.Contact(contactor=contactor, target=target, sliding=sliding, coupling=args.coupling)]
        else:
            weight = np.array([0.0] * (dim - 1) + [-1e3])
            F = F - ufl.inner(fem.Constant(self.mesh, weight), v) * ufl.dx
        return uem.UnitedProblem(
            F, u, bcs=self.bcs, contacts=contacts, petsc_options_prefix="cost_", petsc_options=options, rtol=TOLERANCE,
            verbose=args.verbose,
        )  # fmt: skip


# %% [markdown]
# ## Time and memory
# The memory is the largest that the process had while it solved, mesh and libraries included.


# %%
def clocks() -> dict[str, float]:
    """Seconds that each stage has taken so far."""
    return {stage: uem.timing(stage)[1] for stage in STAGES}


def measure(scene: Hertz, contact: bool, finite: bool) -> tuple[dict[str, float], list, float, float | None]:
    """Solve some times: seconds of the stages and of "all" in the quickest, its history and work, and bytes of memory (collective)."""
    best: tuple[dict[str, float], list, float] | None = None
    common.free_memory()
    forget_peak()
    for _ in range(args.runs):
        comm.barrier()
        before, made, start = clocks(), uem.timing(SET_UP)[0], time.perf_counter()
        problem = scene.problem(contact, finite)
        history = problem.solve()
        spent = {"all": max(comm.allgather(time.perf_counter() - start))}
        work = linear_work(history, uem.timing(SET_UP)[0] - made, problem.system.solver.iterative)
        spent |= {stage: seconds - before[stage] for stage, seconds in clocks().items()}
        if best is None or spent["all"] < best[0]["all"]:
            best = spent, history, work
        common.free_memory()
    assert best is not None
    return *best, peak()


def forget_peak() -> None:
    """Let Linux measure the peak of this process's memory anew."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def peak() -> float | None:
    """Peak of the memory of all ranks, in bytes, None where the system does not report it (collective)."""
    try:
        line = next(line for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines() if "VmHWM" in line)
        here = 1024.0 * float(line.split()[1])
    except (OSError, StopIteration):
        here = float("nan")
    total = sum(comm.allgather(here))
    return total if np.isfinite(total) else None


def row(dim: int, dofs: int, finite: bool) -> dict[str, object]:
    """One size, with contact and without."""
    scene = Hertz(dim, dofs)
    bare, path, least, memory = measure(scene, False, finite)
    spent, history, work, more = measure(scene, True, finite)
    nodes = fem.locate_dofs_topological(scene.V, dim - 1, scene.tags[scene.surface].entities)
    contactors = int((nodes < scene.V.dofmap.index_map.size_local).sum())
    return {
        "scene": "finite" if finite else "linear",
        "dim": dim,
        "dofs": scene.dofs,
        "contactors": sum(comm.allgather(contactors)),
        "uncontacted_seconds": bare["all"],
        "contact_seconds": spent["all"],
        "ratio": spent["all"] / bare["all"],
        "newton_iterations": len(history) - 1,
        "newton_iterations_uncontacted": len(path) - 1,
        "exchanges": sum(i.exchanges for i in history),
        "contact_share": sum(spent[stage] for stage in CONTACT) / spent["all"],
        "linear_iterations": sum(i.linear_iterations for i in history),
        "linear_iterations_uncontacted": sum(i.linear_iterations for i in path),
        "linear_work": work,
        "linear_work_uncontacted": least,
        "memory_ratio": more / memory if more and memory else None,
    } | {stage: spent[stage] for stage in STAGES}


# %% [markdown]
# ## Iterations of CG


# %%
def iterations(scene: Hertz, stiffness: float) -> dict[str, object]:
    """Iterations of a united solve, the mean of a Newton iteration in which contact is known, and of one without contact."""
    found = {}
    for name, contact in (("contact", True), ("uncontacted", False)):
        options = common.cg("" if args.amg == "best" else args.amg, 1e-8)
        history = scene.problem(contact, False, stiffness, options).solve()
        solves = [round(i.linear_iterations / (1 + i.exchanges)) for i in history if i.linear_iterations]
        # the one before looks for the contact
        found[name] = solves[1] if contact else solves[0]
        common.free_memory()
    return {"coupling": args.coupling, "multigrid": args.amg, "dofs": scene.dofs, "stiffness": stiffness} | found


# %%
for dim in sorted({pair[0] for pair in pairs(args.linear) + pairs(args.finite)}):
    for finite in (False, True):
        # whatever is compiled or imported at first use
        for contact in (False, True):
            Hertz(dim, 2000).problem(contact, finite).solve()
rows = [row(dim, dofs, False) for dim, dofs in pairs(args.linear)] + [row(dim, dofs, True) for dim, dofs in pairs(args.finite)]
cg = []
for dofs in common.numbers(args.cg):
    scene, first = Hertz(3, dofs), not cg
    cg += [iterations(scene, s) for s in ([float(s) for s in args.stiffness.split(",")] if first else [1.0])]
growth = []
for dim in sorted({r["dim"] for r in rows}):
    own = [r for r in rows if r["scene"] == "linear" and r["dim"] == dim]
    if len(own) > 1:
        n = np.log([r["dofs"] for r in own])
        slopes = {
            name: float(np.polyfit(n, np.log([r[name] for r in own]), 1)[0])
            for name in ("uncontacted_seconds", "contact_seconds")
        }
        growth.append({"dim": dim} | slopes)
common.report(args, {"machine": machine(), "coupling": args.coupling, "sizes": rows, "cg": cg, "growth": growth})

# %% [markdown]
# ## Where the time goes

# %%
with uem.figure(args.plot, comm, panels=2) as panels:
    for dim, panel in zip((2, 3), panels):
        own = [r for r in rows if r["scene"] == "linear" and r["dim"] == dim]
        if panel is None or not own:
            continue
        n = [r["dofs"] for r in own]
        for stage in STAGES:
            seconds = [r[stage] for r in own]
            if max(seconds) > 1e-3 * max(r["contact_seconds"] for r in own):
                panel.loglog(n, seconds, "--" if stage in CONTACT else "-", marker=".", lw=1, label=stage)
        for name, style in (("contact_seconds", "k-o"), ("uncontacted_seconds", "k--s")):
            panel.loglog(n, [r[name] for r in own], style, label=name.replace("_seconds", ", all"))
        panel.set(xlabel="degrees of freedom", ylabel="time [s]", title=f"{dim}D, linear bodies, one step from scratch")
        panel.grid(alpha=0.25, which="both")
        panel.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1.0))

# %% [markdown]
# ## What must hold on any machine
# Contact adds solves, Newton iterations and exchanges of the active set, few of them, and each takes hardly more iterations of CG, or
# factorisations, than one without contact.

# %%
for r in rows:
    per_solve = r["linear_work"] / (r["newton_iterations"] + r["exchanges"])
    assert per_solve <= 1.5 * r["linear_work_uncontacted"] / r["newton_iterations_uncontacted"], r
    assert r["newton_iterations"] + r["exchanges"] <= 4 + 4 * r["newton_iterations_uncontacted"], r
