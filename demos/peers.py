"""Against other codes: CalculiX and GetFEM on the same mesh of a cylinder on a block, with the same tolerance.

python3 demos/peers.py --plot peers.png
"""

# %% [markdown]
# # Who is first on the same mesh?
#
# The scene is that of `hertz_cylinder.py`, two elastic bodies in plane strain, pushed together in one step. Gmsh makes the mesh
# once per size, and every code gets the same nodes and triangles, one thread, and a relative tolerance of 1e-8:
#
# - `uem`: the united elements with the package's defaults, but with feet on the target that are found once, as GetFEM finds them;
# - `uem_finite`: the same with feet that move in every iteration, the default;
# - `calculix`: a penalty, see `evidence/peers/by_calculix.py`;
# - `getfem`: multipliers, see `evidence/peers/by_getfem.py`.
#
# Times are medians of warm runs, from the mesh in memory to the solution, without compilation. CalculiX is timed as a process,
# with its start and its reading of the input. The error is that of P against quadratic elements of the size `--reference`, whose
# P changes by 3e-5 on finer meshes; the difference is that of P against the united elements on the same mesh. A code that is not
# installed is left out, and named; one that fails at a size, or takes more than `--timeout` seconds, is listed with the reason.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from evidence import peers
from evidence.measure import machine
from evidence.peers import by_calculix, by_getfem
from evidence.problems import hertz_answer

import uem_dolfinx as uem

args = common.arguments(
    __doc__, sizes="1500,6000,25000,100000", codes="uem,uem_finite,calculix,getfem", runs=3, timeout=300.0, reference=1 / 240
)
E, nu, R, push, rtol = 1e6, 0.3, 3.0, 0.006, 1e-8
UNITED = {"uem": "fixed", "uem_finite": "finite"}
PEERS = {"calculix": by_calculix, "getfem": by_getfem}
CLOCK = "MUMPS or CG by size, 1 step; time from the mesh in memory; feet found "
SETTINGS = {"uem": CLOCK + "once", "uem_finite": CLOCK + "in every iteration"} | {c: p.SETTINGS for c, p in PEERS.items()}
sizes, codes = common.numbers(args.sizes), args.codes.split(",")
if unknown := set(codes) - set(UNITED) - set(PEERS):
    raise ValueError(f"--codes {args.codes}: {', '.join(unknown)} not known here: expected some of {', '.join(UNITED | PEERS)}")

# %% [markdown]
# ## United elements


# %%
def united(mesh, tags, sliding):
    """Solve on one mesh: the answer, and the problem (collective)."""
    found = []

    def once():
        common.free_memory()
        comm.barrier()
        start = time.perf_counter()
        V = uem.function_space(mesh, 1, (2,))
        u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
        bcs = [
            uem.dirichlet(V, tags["symmetry"], 0),
            uem.dirichlet(V, tags["block_bottom"], 1),
            uem.dirichlet(V, tags["disc_top"], 1, -push),
        ]
        contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], sliding=sliding)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="peers_", rtol=rtol)
        found[:] = problem, list(uem.load_steps(problem, 1))
        return max(comm.allgather(time.perf_counter() - start))

    seconds = peers.timed(once, args.runs, args.timeout)
    problem, steps = found
    contact = problem.contacts[0]
    P, iterations = 2 * float(contact.resultant().force[1]), sum(step.newton_iterations for step in steps)
    return peers.Answer(seconds, iterations, P, contact.max_pressure()), problem


# %% [markdown]
# ## The others
# They run on rank 0, and all ranks hear of what they come to.


# %%
def other(scene, solve):
    """Answer of another code, or the reason why there is none (collective)."""
    answer = reason = None
    if comm.rank == 0:
        try:
            answer = solve(scene, args.runs, args.timeout, rtol)
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
    return comm.bcast((answer, reason))


# %%
here = comm.bcast({name: peer.available() for name, peer in PEERS.items()} if comm.rank == 0 else None)
absent = {name: f"not installed: {PEERS[name].INSTALL}" for name in codes if not here.get(name, True)}
reference = 2 * hertz_answer(args.reference).force
E_star = E / (2 * (1 - nu**2))
runs, failed, last = [], [], None
for size in sizes:
    h = 0.615 / np.sqrt(size)
    mesh, tags = uem.read_gmsh(common.MESHES / "hertz_cylinder.geo", comm, gdim=2, parameters={"h": h})
    scene = peers.gathered(mesh, tags, h=h, E=E, nu=nu, R=R, push=push)
    nodes = mesh.geometry.index_map().size_global
    for code in (code for code in codes if code not in absent):
        if code in UNITED:
            try:
                (answer, last), reason = united(mesh, tags, UNITED[code]), None
            except uem.UEMError as error:
                answer, reason = None, f"{type(error).__name__}: {error}"
        else:
            answer, reason = other(scene, PEERS[code].solve)
        if answer is None:
            failed.append({"code": code, "nodes": nodes, "reason": reason})
            continue
        runs.append({
            "code": code,
            "nodes": nodes,
            "seconds": answer.seconds,
            "newton_iterations": answer.newton_iterations,
            "P": answer.P,
            "p_max_ratio": answer.p_max / float(np.sqrt(answer.P * E_star / (np.pi * R))),
            "error": abs(answer.P / reference - 1),
            "difference": None,
        })  # fmt: skip
        if args.verbose and comm.rank == 0:
            print(", ".join(f"{key} {common.show(value)}" for key, value in runs[-1].items()), flush=True)

# %% [markdown]
# ## Side by side

# %%
same = {run["nodes"]: run["P"] for run in runs if run["code"] == "uem"}
for run in runs:
    run["difference"] = run["P"] / same[run["nodes"]] - 1 if run["nodes"] in same else None
ranking = []
for nodes in dict.fromkeys(run["nodes"] for run in runs):
    seconds = {run["code"]: run["seconds"] for run in runs if run["nodes"] == nodes}
    quickest = min(seconds, key=seconds.__getitem__)
    times = {code: seconds[code] / seconds[quickest] if code in seconds else None for code in codes}
    ranking.append({"nodes": nodes, "first": quickest} | times)
results = {
    "machine": machine(),
    "reference_P": reference,
    "runs": runs,
    "times_of_the_first": ranking,
    "failed": failed,
    "absent": absent,
    "settings": [{"code": code, "settings": SETTINGS[code]} for code in codes],
}
common.report(args, results)

# %% [markdown]
# ## The picture

# %%
with uem.figure(args.plot, comm) as (panel,):
    if panel is not None:
        for code, marker in zip(dict.fromkeys(run["code"] for run in runs), "osv^"):
            own = [run for run in runs if run["code"] == code]
            panel.loglog([run["nodes"] for run in own], [run["seconds"] for run in own], marker + "-", label=code)
        panel.set(xlabel="nodes", ylabel="time [s]", title="A cylinder on a block, the same mesh and tolerance")
        panel.grid(alpha=0.25, which="both")
        panel.legend(frameon=False)
if args.output and last is not None:
    with uem.ResultsWriter(f"{args.output}/peers", last) as writer:
        writer.write(1.0)

# %% [markdown]
# ## The same scene
# On one mesh all codes agree in P: multipliers to rounding, a penalty but for its overlap. Its pressure may jump at one edge.

# %%
for run in runs:
    assert run["difference"] is None or abs(run["difference"]) < (0.01 if run["code"] == "calculix" else 1e-3), run
    assert run["code"] == "calculix" or abs(run["p_max_ratio"] - 1) < 0.06, run
