"""Against other codes: CalculiX, GetFEM and Kratos on the same mesh of a cylinder or sphere on a block, with the same tolerance.

python3 demos/peers.py --plot peers.png

Options:
    friction: coefficient of friction, in 2D
    sizes: nodes of the meshes, comma-separated; none: sizes that fit the scene
    codes: codes to compare, comma-separated
    runs: timed runs, whose median counts
    timeout: seconds that a run of another code may take
    reference: size of the reference's cells in the contact zone, in 2D without friction
    kratos: Python interpreter that has Kratos; none: this one
"""

# %% [markdown]
# # Who is first on the same mesh?
#
# The scene is that of `hertz_cylinder.py`, two elastic bodies in plane strain, or with `--dim 3` of `hertz_sphere.py`, pushed together
# in one step. Gmsh makes the mesh once per size, and every code gets the same nodes and cells, one thread, and a relative tolerance of
# 1e-8:
#
# - `uem`: the united elements with the package's defaults, but with feet on the target that are found once, as GetFEM finds them;
# - `uem_finite`: the same with feet that move in every iteration, the default;
# - `uem_mortar`: mortar coupling, rows found once, which pairs whole facets;
# - `calculix`: a penalty, see `benchmarks/peers/by_calculix.py`;
# - `getfem`: multipliers, see `benchmarks/peers/by_getfem.py`;
# - `kratos`: mortar with an augmented Lagrangian, in 3D, see `benchmarks/peers/by_kratos.py`; `--kratos` names a Python that has it.
#
# With `--friction 0.3` the scene is that of `cattaneo_mindlin.py` in 2D, led down in one step and sideways in another, so that part of
# the contact slips. GetFEM's nodal contact has no history of friction, and is left out.
#
# Times are those of the processor, medians of warm runs, from the mesh in memory to the solution, without compilation: other work on
# the machine changes them little. CalculiX is timed as a process, with its start and its reading of the input. The error is that of
# P against quadratic elements of the size `--reference`, whose
# P changes by 3e-5 on finer meshes, in 3D against Hertz, from whose solution the bodies' finite size differs by 0.3 %; the difference is
# that of P against the united elements on the same mesh. A code that is not installed is left out, and named; one that fails at a size, or
# takes more than `--timeout` seconds, is listed with the reason.

# %%
import time

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import peers
from benchmarks.measure import machine
from benchmarks.peers import by_calculix, by_getfem, by_kratos
from benchmarks.problems import hertz_answer

import uem_dolfinx as uem

args = common.arguments(
    __doc__, dim=("2", "3"), friction=0.0, sizes="", codes="uem,uem_finite,uem_mortar,calculix,getfem,kratos", runs=3, timeout=300.0,
    reference=1 / 240, kratos="",
)  # fmt: skip
E, nu, rtol, dim, mu = 1e6, 0.3, 1e-8, int(args.dim), args.friction
E_star = E / (2 * (1 - nu**2))
if mu:
    if dim == 3:
        raise ValueError("--friction has a scene in 2D only")
    R, push, parts, upper, cap = 1.0, 0.0012, 1, "disc", "disc_arc"
    planes = [("block_bottom", 0, 0.0), ("block_bottom", 1, 0.0), ("disc_top", 0, 0.0), ("disc_top", 1, -push)]
elif dim == 2:
    R, push, parts, upper, cap = 3.0, 0.006, 2, "disc", "disc_arc"
    planes = [("symmetry", 0, 0.0), ("block_bottom", 1, 0.0), ("disc_top", 1, -push)]
else:
    R, push, parts, upper, cap = 1.0, 2.5e-5, 4, "sphere", "sphere_cap"
    planes = [("symmetry_x", 0, 0.0), ("symmetry_y", 1, 0.0), ("block_bottom", 2, 0.0), ("sphere_top", 2, -push)]
led = [("disc_top", 0, push / 3)] if mu else []
UNITED = {"uem": ("node_to_surface", "fixed"), "uem_finite": ("node_to_surface", "finite"), "uem_mortar": ("mortar", "fixed")}
PEERS = {"calculix": by_calculix, "getfem": by_getfem, "kratos": by_kratos}
by_kratos.python = args.kratos
CLOCK = "MUMPS or CG by size, 1 step; time from the mesh in memory; feet found "
SETTINGS = {code: CLOCK + {"fixed": "once", "finite": "in every iteration"}[how] for code, (_, how) in UNITED.items()} | {
    c: p.SETTINGS for c, p in PEERS.items()
}
sizes = common.numbers(args.sizes or ("2000,7000" if mu else {2: "1500,6000,25000,100000", 3: "3000,10000,20000"}[dim]))
codes = [code for code in args.codes.split(",") if not (code == "getfem" and mu or code == "kratos" and dim == 2)]
if unknown := set(codes) - set(UNITED) - set(PEERS):
    raise ValueError(f"--codes {args.codes}: {', '.join(unknown)} not known here: expected some of {', '.join(UNITED | PEERS)}")

# %% [markdown]
# ## United elements


# %%
def united(mesh, tags, coupling, sliding):
    """Solve on one mesh: the answer, and the problem (collective)."""
    found = []

    def once():
        common.free_memory()
        comm.barrier()
        start = time.process_time()
        V = uem.function_space(mesh, 1, (dim,))
        u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        F = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d").residual(u, v) * ufl.dx
        values = {(name, i): fem.Constant(mesh, value) for name, i, value in planes}
        bcs = [uem.dirichlet(V, tags[name], i, value) for (name, i), value in values.items()]
        contact = uem.Contact(contactor=tags[cap], target=tags["block_top"], coupling=coupling, sliding=sliding, friction=mu)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="peers_", rtol=rtol)
        steps = list(uem.load_steps(problem, 1))
        for name, i, value in led:
            values[name, i].value = value
            steps += uem.load_steps(problem, 1)
        found[:] = problem, steps
        return max(comm.allgather(time.process_time() - start))

    seconds = peers.timed(once, args.runs, args.timeout)
    problem, steps = found
    contact = problem.contacts[0]
    Q, *_, P = (abs(parts * float(force)) for force in contact.resultant().force)
    return peers.Answer(seconds, sum(step.newton_iterations for step in steps), P, contact.max_pressure(), Q), problem


# %% [markdown]
# ## The others
# They run on rank 0, and all ranks get their results.


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


def drawn(size):
    """The mesh of about so many nodes, its tags, and the size of the cells in the contact zone (collective)."""
    if mu:
        h, zone = 1 / 30 * (6500 / size) ** 0.5, 0.03
        return *uem.read_gmsh(
            common.MESHES / "cattaneo_mindlin.geo", comm, gdim=2, parameters={"h": h, "R": R, "zone": zone}
        ), h * zone
    if dim == 2:
        h = 0.615 / np.sqrt(size)
        return *uem.read_gmsh(common.MESHES / "hertz_cylinder.geo", comm, gdim=2, parameters={"h": h}), h
    a = np.sqrt(R * push)
    h = a / 4 * (3200 / size) ** 0.4
    drawing = {"h": h, "R": R, "W": 2 * R, "zone": 1.4 * a, "growth": 0.8 / a}
    return *uem.read_gmsh(common.MESHES / "hertz_sphere.geo", comm, gdim=3, parameters=drawing), h


# %% [markdown]
# With friction the answers are compared with those of the united elements on a mesh of four times as many nodes as the finest.

# %%
reference_Q = 0.0
if mu:
    mesh, tags, _ = drawn(4 * max(sizes))
    finest, _ = united(mesh, tags, "node_to_surface", "fixed")
    reference, reference_Q = finest.P, finest.Q
elif dim == 2:
    reference = 2 * hertz_answer(args.reference).force
else:
    reference = 4 / 3 * E_star * np.sqrt(R) * push**1.5
runs, failed, last = [], [], None
for size in sizes:
    mesh, tags, h = drawn(size)
    scene = peers.gathered(
        mesh, tags, upper, contactor=cap, supports=planes, parts=parts, h=h, E=E, nu=nu, R=R, friction=mu, led=led
    )
    nodes = mesh.geometry.index_map().size_global
    for code in (code for code in codes if code not in absent):
        if code in UNITED:
            try:
                (answer, last), reason = united(mesh, tags, *UNITED[code]), None
            except uem.UEMError as error:
                answer, reason = None, f"{type(error).__name__}: {error}"
        else:
            answer, reason = other(scene, PEERS[code].solve)
        if answer is None:
            failed.append({"code": code, "nodes": nodes, "reason": reason})
            continue
        p0 = np.sqrt(answer.P * E_star / (np.pi * R)) if dim == 2 else np.cbrt(6 * answer.P * E_star**2 / (np.pi**3 * R**2))
        runs.append({
            "code": code,
            "nodes": nodes,
            "seconds": answer.seconds,
            "newton_iterations": answer.newton_iterations,
            "P": answer.P,
            "p_max_ratio": answer.p_max / float(p0),
            "error": abs(answer.P / reference - 1),
            "difference": None,
            **({"Q/(mu P)": answer.Q / (mu * answer.P), "error_Q": abs(answer.Q / reference_Q - 1)} if mu else {}),
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
    "reference_Q": reference_Q,
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
        for code, marker in zip(dict.fromkeys(run["code"] for run in runs), "osv^DP"):
            own = [run for run in runs if run["code"] == code]
            panel.loglog([run["nodes"] for run in own], [run["seconds"] for run in own], marker + "-", label=code)
        panel.set(
            xlabel="nodes",
            ylabel="time [s]",
            title=f"A {('cylinder', 'sphere')[dim - 2]} on a block, the same mesh and tolerance",
        )
        panel.grid(alpha=0.25, which="both")
        panel.legend(frameon=False)
if args.output and last is not None:
    with uem.ResultsWriter(f"{args.output}/peers", last) as writer:
        writer.write(1.0)

# %% [markdown]
# ## The same scene
# On one mesh all codes agree in P: multipliers to rounding, a penalty but for its overlap, mortar but for its other equations, both of
# which coarse meshes in space show most. Nodal pressures scatter in 3D, and a penalty's may jump at one edge.

# %%
for run in runs:
    bound = {"calculix": 0.01 if dim == 2 else 0.02, "uem_mortar": 0.02, "kratos": 0.02}.get(run["code"], 1e-3)
    assert run["difference"] is None or abs(run["difference"]) < bound, run
    assert mu or dim == 3 or run["code"] == "calculix" or abs(run["p_max_ratio"] - 1) < 0.06, run
