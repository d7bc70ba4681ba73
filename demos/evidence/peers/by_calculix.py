"""The scene in CalculiX: plane strain triangles CPE3, surface-to-surface penalty contact, SPOOLES, one increment.

Small strain (no NLGEOM), several springs on each edge of the arc, residuals and corrections asked for to 1e-8. The stiffness of
the springs is chosen so that the overlap changes P by less than the mesh does: 0.07 E R / h^2; ten times as much takes half as
many iterations again. Debian's CalculiX 2.20 has no PaStiX; its iterative solver took about as long on 5,500 nodes and longer on
25,000. Node-to-surface contact came to two thirds of P. Mortar contact refuses plane elements, whose nodes depend on others, and
on a slab of prisms SPOOLES gave up in the second iteration. The largest pressure is the largest mean over an edge; on 97,000
nodes one edge had 1.4 times p0. Seconds are those of the whole process, with its start and its reading of the input.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from evidence.peers import Answer, Hertz, PeerError, run, timed

INSTALL = "apt-get install calculix-ccx"
SETTINGS = "CPE3, surface-to-surface springs of 0.07 E R / h^2, SPOOLES, 1 step; time of the process"


def available() -> bool:
    """Whether the program is there."""
    return shutil.which("ccx") is not None


def write(path: Path, scene: Hertz, stiffness: float, rtol: float) -> None:
    """Write the input.

    Args:
        path: of the ``.inp`` file.
        scene: what to solve.
        stiffness: of the springs, pressure over overlap.
        rtol: of residual and correction.
    """
    # numbers of more than 20 characters are cut without a word
    lines = ["*NODE, NSET=all", *(f"{i},{x:.12e},{y:.12e},0." for i, (x, y) in enumerate(scene.x, 1))]
    lines += ["*ELEMENT, TYPE=CPE3, ELSET=bodies", *(f"{i},{a},{b},{c}" for i, (a, b, c) in enumerate(scene.cells + 1, 1))]
    for name in ("symmetry", "block_bottom", "disc_top"):
        lines += [f"*NSET, NSET={name}", *(f"{i}," for i in scene.nodes(name) + 1)]
    for name in ("disc_arc", "block_top"):
        lines += [f"*SURFACE, NAME={name}, TYPE=ELEMENT", *(f"{cell},S{side}" for cell, side in scene.sides(name) + 1)]
    lines += ["*MATERIAL, NAME=elastic", "*ELASTIC", f"{scene.E:.12e},{scene.nu:.12e}"]
    lines += ["*SOLID SECTION, ELSET=bodies, MATERIAL=elastic", "1."]
    lines += ["*SURFACE INTERACTION, NAME=springs", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{stiffness:.12e}"]
    lines += ["*CONTACT PAIR, INTERACTION=springs, TYPE=SURFACE TO SURFACE", "disc_arc,block_top"]
    lines += ["*BOUNDARY", "symmetry,1,1", "block_bottom,2,2"]
    lines += ["*STEP, INC=100", "*STATIC, SOLVER=SPOOLES", "1.,1."]
    lines += ["*CONTROLS, PARAMETERS=FIELD", f"{rtol:g},{rtol:g},,,,,,{rtol:g}"]
    lines += ["*BOUNDARY", f"disc_top,2,2,{-scene.push:.12e}"]
    lines += ["*NODE PRINT, NSET=block_bottom, TOTALS=ONLY", "RF", "*CONTACT PRINT", "CSTR", "*END STEP", ""]
    path.write_text("\n".join(lines), encoding="utf-8")


def solve(scene: Hertz, runs: int, timeout: float, rtol: float) -> Answer:
    """Solve the scene.

    Args:
        scene: what to solve.
        runs: that are timed.
        timeout: seconds allowed for one.
        rtol: of residual and correction.

    Raises:
        PeerError: it did not converge, or took too long.
    """
    stiffness = 0.07 * scene.E * scene.R / scene.h**2
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "hertz.inp", scene, stiffness, rtol)

        def once() -> float:
            start = time.perf_counter()
            run(["ccx", "hertz"], folder, timeout)
            return time.perf_counter() - start

        seconds = timed(once, runs, timeout)
        history = [line.split() for line in (folder / "hertz.sta").read_text().splitlines()[2:]]
        data = (folder / "hertz.dat").read_text()
    forces = re.findall(r"total force.*BLOCK_BOTTOM.*\n\s*\n\s*\S+\s+(\S+)", data)
    points = re.findall(r"^\s+(\d+)\s+\d+\s+(\S+)\s+\S+\s+\S+\s*$", data, re.MULTILINE)
    if not history or float(history[-1][4]) < 1 or not forces or not points:
        raise PeerError("ccx did not reach the end of its step")
    edge, pressure = np.array(points, dtype=float).T
    _, edge = np.unique(edge, return_inverse=True)
    means = np.bincount(edge, pressure) / np.bincount(edge)
    return Answer(seconds, sum(int(line[3]) for line in history), 2 * float(forces[-1]), float(means.max()))
