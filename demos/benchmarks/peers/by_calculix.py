"""The scene in CalculiX: plane strain triangles CPE3 or tetrahedra C3D4, surface-to-surface penalty contact, SPOOLES, one increment.

Small strain (no NLGEOM), several springs on each edge of the arc, tolerance of residuals and corrections 1e-8. The stiffness of the
springs is chosen so that the overlap changes P by less than the mesh does: 0.07 E R / h^2; ten times as much takes half as many
iterations again. With friction there is as stiff a spring along the surface. Debian's CalculiX 2.20 has no PaStiX; its iterative
solver took about as long on 5,500 nodes and longer on 25,000. Node-to-surface contact came to two thirds of P. Mortar contact
refuses plane elements, whose nodes depend on others, and on a slab of prisms SPOOLES gave up in the second iteration. The largest
pressure is the largest mean over an edge; on 97,000 nodes one edge had 1.4 times p0, in 3D one triangle 1.7 times. Seconds are
those of the whole process, with its start and its reading of the input.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.peers import Answer, Hertz, PeerError, run, timed

INSTALL = "apt-get install calculix-ccx"
SETTINGS = "CPE3 or C3D4, surface-to-surface springs of 0.07 E R / h^2, SPOOLES, 1 step; time of the process"


#: Linear cells by dimension, and the number of the side opposite to each of their nodes.
KINDS = {2: ("CPE3", (2, 3, 1)), 3: ("C3D4", (3, 4, 2, 1))}


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
    kind, number = KINDS[scene.gdim]
    # numbers of more than 20 characters are cut without a word
    lines = ["*NODE, NSET=all", *(f"{i}," + ",".join(f"{c:.12e}" for c in (*x, 0.0)[:3]) for i, x in enumerate(scene.x, 1))]
    lines += [
        f"*ELEMENT, TYPE={kind}, ELSET=bodies",
        *(f"{i}," + ",".join(map(str, c)) for i, c in enumerate(scene.cells + 1, 1)),
    ]
    for name in dict.fromkeys(name for name, *_ in scene.supports):
        lines += [f"*NSET, NSET={name}", *(f"{i}," for i in scene.nodes(name) + 1)]
    for name in (scene.contactor, "block_top"):
        lines += [f"*SURFACE, NAME={name}, TYPE=ELEMENT", *(f"{cell + 1},S{number[node]}" for cell, node in scene.sides(name))]
    lines += ["*MATERIAL, NAME=elastic", "*ELASTIC", f"{scene.E:.12e},{scene.nu:.12e}"]
    lines += ["*SOLID SECTION, ELSET=bodies, MATERIAL=elastic", *["1."] * (scene.gdim == 2)]
    lines += ["*SURFACE INTERACTION, NAME=springs", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{stiffness:.12e}"]
    if scene.friction:
        lines += ["*FRICTION", f"{scene.friction:.12e},{stiffness:.12e}"]
    lines += ["*CONTACT PAIR, INTERACTION=springs, TYPE=SURFACE TO SURFACE", f"{scene.contactor},block_top"]
    for values in ([s for s in scene.supports if not s[2]], [s for s in scene.supports if s[2]], scene.led):
        given = ["*BOUNDARY", *(f"{name},{c + 1},{c + 1},{value:.12e}" for name, c, value in values)]
        if values and any(value for *_, value in values):
            lines += [
                "*STEP, INC=100",
                "*STATIC, SOLVER=SPOOLES",
                "1.,1.",
                "*CONTROLS, PARAMETERS=FIELD",
                f"{rtol:g},{rtol:g},,,,,,{rtol:g}",
            ]
            given += ["*NODE PRINT, NSET=block_bottom, TOTALS=ONLY", "RF", "*CONTACT PRINT", "CSTR", "*END STEP"]
        lines += given if values else []
    lines.append("")
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
            before = os.times()
            run(["ccx", "hertz"], folder, timeout)
            after = os.times()
            return after.children_user - before.children_user + after.children_system - before.children_system

        seconds = timed(once, runs, timeout)
        history = [line.split() for line in (folder / "hertz.sta").read_text().splitlines()[2:]]
        data = (folder / "hertz.dat").read_text()
    forces = re.findall(r"total force.*BLOCK_BOTTOM.*\n\s*\n\s*(\S+)\s+(\S+)\s+(\S+)", data)
    points = re.findall(r"^\s+(\d+)\s+\d+\s+(\S+)\s+\S+\s+\S+\s*$", data.rpartition("contact stress")[2], re.MULTILINE)
    if not history or float(history[-1][4]) < 1 or not forces or not points:
        raise PeerError("ccx did not reach the end of its step")
    edge, pressure = np.array(points, dtype=float).T
    _, edge = np.unique(edge, return_inverse=True)
    means = np.bincount(edge, pressure) / np.bincount(edge)
    Q, *_, P = (abs(scene.parts * float(force)) for force in forces[-1][: scene.gdim])
    return Answer(seconds, sum(int(line[3]) for line in history), P, float(means.max()), Q)
