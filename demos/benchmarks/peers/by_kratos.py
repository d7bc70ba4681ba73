"""The scene in Kratos: linear tetrahedra, mortar contact by an augmented Lagrangian with dual multipliers, one step; in 3D only.

Small strain, but the segments move with the bodies. Kratos' contact settings are its defaults but for tolerances and the number of
iterations. Its multipliers are scalars and unknowns of the linear system, which GMRES with AMGCL's smoothed aggregation solves to the
tolerance: on 3,000 nodes that took 5 s where Eigen's SparseLU took 14. Multipliers with components, which Kratos 10.4.4 condenses, took
21 s with SparseLU. For AMGCL with blocks its settings were refused ("direct_settings" is not in the defaults). Under another name, which
Kratos ignores, the run ended with "Invalid solver index: 2", or with normals that are no numbers. Seconds are those of the processor,
taken inside, from nodes, cells and surfaces in memory to the solution.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from benchmarks.peers import REPEATED, Answer, Hertz, PeerError, python_with, answer_of

INSTALL = "pip install KratosContactStructuralMechanicsApplication KratosLinearSolversApplication; --kratos names that python"
SETTINGS = "ALM mortar, dual scalar multipliers, GMRES with AMGCL, 1 step; time from nodes and cells in memory"
SCRIPT = Path(__file__).with_name("kratos_script.py")
#: AMGCL's GMRES with smoothed aggregation, for scalar unknowns.
LINEAR_SOLVER = {
    "solver_type": "amgcl",
    "krylov_type": "lgmres",
    "gmres_krylov_space_dimension": 100,
    "smoother_type": "ilu0",
    "coarsening_type": "smoothed_aggregation",
    "block_size": 1,
    "use_block_matrices_if_possible": False,
    "coarse_enough": 1000,
    "max_iteration": 500,
    "scaling": False,
    "verbosity": 0,
}
#: A Python that has Kratos, if it is not this one.
python = ""


def interpreter() -> str | None:
    """The Python that has Kratos: the one that was named, or this one."""
    return python_with("KratosMultiphysics.ContactStructuralMechanicsApplication", *filter(None, (python, sys.executable)))


def available() -> bool:
    """Whether a Python with Kratos is there."""
    return interpreter() is not None


def solve(scene: Hertz, runs: int, timeout: float, rtol: float) -> Answer:
    """Solve the scene.

    Args:
        scene: what to solve.
        runs: that are timed.
        timeout: seconds allowed for all of them.
        rtol: of residuals and linear solves.

    Raises:
        PeerError: it did not converge, or took too long.
    """
    found = interpreter()
    if found is None:
        raise PeerError(f"Kratos is not installed: {INSTALL}")
    surfaces = {"contactor": scene.contactor, "target": "block_top"}
    arrays = {f"facets_{of}": outward(scene, name) for of, name in surfaces.items()} | {
        name: scene.nodes(name) for name, *_ in scene.supports
    }
    numbers = {"E": scene.E, "nu": scene.nu, "runs": runs, "enough": REPEATED * timeout, "rtol": rtol}
    words = {"supports": json.dumps(scene.supports), "linear_solver": json.dumps(LINEAR_SOLVER | {"tolerance": rtol})}
    answer = answer_of("Kratos", found, SCRIPT, timeout, x=scene.x, cells=scene.cells, **arrays, **numbers, **words)
    return Answer(answer["seconds"], answer["iterations"], scene.parts * answer["P"], answer["p_max"])


def outward(scene: Hertz, name: str) -> np.ndarray:
    """Nodes of a surface's triangles, counterclockwise as seen from outside ``(n_facets, 3)``."""
    cell, opposite = scene.sides(name).T
    # of a tetrahedron of positive volume, the side that faces each node
    side = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])[opposite]
    return scene.cells[cell[:, None], side]
