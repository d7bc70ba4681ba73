"""The scene in GetFEM: linear triangles or tetrahedra, its nodal contact between meshes that do not match, MUMPS, one step.

Small strain and feet on the target found once, which makes its discrete problem that of the united elements with
``sliding="fixed"``. The contact forces are multipliers at the nodes of the arc with the augmentation 100 E, which took as few
iterations as any from 0.01 E to 10,000 E. Supports are multipliers as well, as one matrix with a row for each value: what GetFEM
makes of a region by itself took three times as long on 25,000 nodes. Its contact by rays took 1.7 times as long there. Forces
are in units of E, without which its residuals stay above 1e-8. Seconds are those of the processor, taken inside, warm, from meshes
with their regions in memory to the solution.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from benchmarks.peers import REPEATED, Answer, Hertz, PeerError, python_with, answer_of

INSTALL = "apt-get install python3-getfem"
SETTINGS = "nodal multipliers, augmentation 100 E, feet found once, MUMPS, 1 step; time from meshes in memory"
SCRIPT = Path(__file__).with_name("getfem_script.py")


def interpreter() -> str | None:
    """The Python that has GetFEM: this one, or the system's."""
    return python_with("getfem", sys.executable, "/usr/bin/python3")


def available() -> bool:
    """Whether a Python with GetFEM is there."""
    return interpreter() is not None


def solve(scene: Hertz, runs: int, timeout: float, rtol: float) -> Answer:
    """Solve the scene.

    Args:
        scene: what to solve.
        runs: that are timed.
        timeout: seconds allowed for all of them.
        rtol: of the residual.

    Raises:
        PeerError: it did not converge, or took too long.
    """
    python = interpreter()
    if python is None:
        raise PeerError(f"GetFEM is not installed: {INSTALL}")
    surfaces = {"contactor": scene.contactor, "target": "block_top"}
    arrays = {f"sides_{of}": scene.sides(name) for of, name in surfaces.items()} | {
        name: scene.nodes(name) for name, *_ in scene.supports
    }
    numbers = {"nu": scene.nu, "supports": json.dumps(scene.supports), "runs": runs, "enough": REPEATED * timeout, "rtol": rtol}
    bodies = {"x": scene.x, "cells": scene.cells, "upper": scene.upper}
    answer = answer_of("GetFEM", python, SCRIPT, timeout, **bodies, **arrays, **numbers)
    # GetFEM has its own numbers of the nodes
    here, there = (np.lexsort(np.round(x.T / scene.h, 6)) for x in (scene.x[scene.nodes(scene.contactor)], np.array(answer["x"])))
    pressures = scene.E * np.array(answer["forces"])[there] / scene.sizes(scene.contactor)[here]
    return Answer(answer["seconds"], answer["iterations"], scene.parts * scene.E * answer["P"], float(pressures.max()))
