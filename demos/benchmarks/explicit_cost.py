"""What an explicit step costs: time over that of the residual, share of contact, calls of Python, traffic, and what memory allows.

``PYTHONPATH=demos python demos/benchmarks/explicit_cost.py --json FILE`` measures on 1 and 2 ranks, in processes of their own.
A bar with a square section hits a rigid wall; steps are timed while it stays there, each after an assembly of its residual. On one rank
times are those of the processor, which other work on the machine hardly changes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from common import comm
from benchmarks import collectives
from benchmarks.apart import run_on
from benchmarks.measure import machine
from benchmarks.scenes import at, box, scene
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat, forms, log

LAWS, CELLS = {"linear": uem.LinearElastic, "NeoHooke": uem.NeoHooke}, ("tetrahedron", "hexahedron")
#: Stages of a step that contact makes.
CONTACT = ("search and projection", "uniting equations", "united matrix of explicit steps")
STEPS, LENGTH, GAP, C = 20, 3, 0.01, 30.0
#: Numbers in an array of the triad, over all ranks, far more than the caches hold.
TRIAD = 20_000_000


def bandwidth() -> float:
    """Bytes a second that all ranks of this call together move between memory and processors, by ``a = b + 3 c`` in two sweeps."""
    a, b, c = (np.full(TRIAD // comm.size, value) for value in (0.0, 1.0, 2.0))
    times = []
    for _ in range(5):
        comm.barrier()
        start = time.perf_counter()
        np.multiply(c, 3.0, out=a)
        np.add(a, b, out=a)
        comm.barrier()
        times.append(time.perf_counter() - start)
    # two arrays in the first sweep, three in the second
    return 5 * 8 * TRIAD / max(comm.allgather(min(times)))


def cost(law: str, cell: str, n: int, contactors: str = "massless") -> dict[str, Any]:
    """Figures of one scene with n cells across, on the ranks of this call."""
    s = scene(comm, cell, [box(cell, [0.0, 0.0, GAP], [1.0, 1.0, GAP + LENGTH], [n, n, LENGTH * n])])
    V = compat.function_space(s.mesh, 1, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    material = LAWS[law](C**2, 0.3, kind="3d")
    wall = uem.Contact(s.tag("bottom", 0, at(2, GAP)), uem.RigidPlane(np.zeros(3), (0.0, 0.0, 1.0)), name="wall")
    mass, scheme = uem.lumped_mass(V, 1.0), uem.CentralDifferences()
    dynamics = uem.Dynamics(mass, velocity=(0.0, 0.0, -1.0), scheme=scheme, contactors=contactors)
    problem = uem.UnitedProblem(material.residual(u, v) * ufl.dx, u, contacts=[wall], dynamics=dynamics)
    steps, residual, b = uem.time_steps(problem, end=1.0), forms.form(problem.bodies.F), compat.create_vector(V)
    while next(steps).time < 2.0 * GAP:
        pass
    clock = time.process_time if comm.size == 1 else time.perf_counter
    times, passed, before = [], 0.0, sum(log.timing(stage)[1] for stage in CONTACT)
    for _ in range(STEPS):
        comm.barrier()
        start = clock()
        forms.assemble_vector(b, residual)
        between, begin = clock(), time.perf_counter()
        next(steps)
        passed += time.perf_counter() - begin
        times.append((between - start, clock() - between))
    within = sum(log.timing(stage)[1] for stage in CONTACT) - before
    calls = []
    for _ in range(STEPS):
        calls.append(0)
        sys.setprofile(lambda frame, event, arg: calls.append(calls.pop() + 1) if event in ("call", "c_call") else None)
        next(steps)
        sys.setprofile(None)
    sent: dict[str, int] = {}
    if collectives.counts():
        with collectives.traffic() as stages:
            next(steps)
        sent = dict(zip(collectives.KINDS, map(int, sum(stages.values(), np.zeros(len(collectives.KINDS), np.int64)))))
    every = np.array(comm.allgather(times))
    of_residual, of_step = np.median(every, axis=1).max(axis=0)
    # strains of cells are looked at every few steps, which a median leaves out
    mean = every.mean(axis=1).max(axis=0)[1]
    return {
        "law": law, "cell": cell, "contactors": contactors, "ranks": comm.size, "unknowns": 3 * V.dofmap.index_map.size_global,
        "residual": float(of_residual), "step": float(of_step), "over_residual": float(of_step / of_residual),
        "mean_over_residual": float(mean / of_residual),
        "contact_share": max(comm.allgather(within / passed)), "calls": int(np.median(calls)), "mean_calls": float(np.mean(calls)),
        "cells": comm.allgather(s.mesh.topology.index_map(3).size_local), "sent": comm.allgather(sent),
    }  # fmt: skip


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--json")
    arguments.add_argument("--where", choices=("apart", "here"), default="apart")
    arguments.add_argument("--ranks", default="1,2", help="numbers of ranks, comma-separated")
    arguments.add_argument(
        "--sizes", default="10,22", help="cells across, comma-separated: 10 has 11,000 unknowns, 22 has 106,000"
    )
    args = arguments.parse_args()
    points: list[dict[str, Any]] = []
    if args.where == "apart":
        for ranks in map(int, args.ranks.split(",")):
            points += run_on(ranks, __file__, counting=True, sizes=args.sizes)["points"]
    else:
        moved = bandwidth()
        scenes = [(law, cell, "massless") for law in LAWS for cell in CELLS] + [("linear", "hexahedron", "massy")]
        points = [cost(*one[:2], n, one[2]) | {"bandwidth": moved} for n in map(int, args.sizes.split(",")) for one in scenes]
    alone = {(p["law"], p["cell"], p["contactors"], p["unknowns"]): p["step"] for p in points if p["ranks"] == 1}
    for p in points if args.where == "apart" else ():
        p["speed_up"] = alone.get((p["law"], p["cell"], p["contactors"], p["unknowns"]), np.nan) / p["step"]
        print(
            f"{p['law']:9} {p['cell']:12} {p['contactors']:9} {p['unknowns']:8d} unknowns, {p['ranks']} ranks: {1e3 * p['step']:.3g} ms, "
            f"{p['over_residual']:.2f} x residual ({p['mean_over_residual']:.2f} in the mean), contact {p['contact_share']:.0%}, "
            f"{p['calls']} calls ({p['mean_calls']:.0f} in the mean), {1e-9 * p['bandwidth']:.3g} GB/s, speed-up {p['speed_up']:.2f}, "
            f"cells {p['cells']}, messages {[sent.get('messages', 0) for sent in p['sent']]}"
        )
    if args.json and comm.rank == 0:
        Path(args.json).write_text(json.dumps({"points": points, "machine": machine()}, indent=1) + "\n", encoding="utf-8")
