"""What a mesh has to have for an accuracy: errors of force and pressure under a cylinder, by cells per half of the contact's width.

``PYTHONPATH=demos python -m benchmarks.needed`` prints the table of the report.
"""

from __future__ import annotations

import numpy as np
from common import comm
from benchmarks import methods
from benchmarks.problems import HertzAnswer, hertz_answer, hertz_cylinder

#: Size of the cells of the reference.
FINE = 1 / 160
#: Sizes that are tried of each mesh, since it matters where a node comes to lie at the edge of the contact.
JITTER = (0.85, 1.0, 1.15)
#: Where the reference's pressure is above this part of its largest value there is contact.
TOUCHES = 1e-3


def worst(cells: float, degree: int, method: str, answer: HertzAnswer) -> dict[str, float]:
    """Largest errors of several meshes with so many cells per half-width: of force, largest pressure, and pressure in L2 (collective)."""
    half = answer.x[answer.pressure > TOUCHES * answer.pressure.max()].max()
    found = []
    for part in JITTER:
        scene = hertz_cylinder(half / cells * part, degree, answer)
        contact = scene.contact()
        problem = methods.create(method, scene.F, scene.u, bcs=scene.bcs, contacts=[contact], **scene.options(method))
        errors = scene.errors(problem, contact, list(scene.run(problem)))
        largest = max(comm.allgather(float(contact.pressure.x.array.max(initial=0.0))))
        found.append(
            {"force": errors["error_force"], "largest": abs(largest / answer.pressure.max() - 1), "l2": errors["error_pressure"]}
            | {"unknowns": float(scene.dofs)}
        )
    return {name: float(max(np.abs(one[name]) for one in found)) for name in found[0]}


if __name__ == "__main__":
    reference = hertz_answer(FINE)
    for degree, counts in ((1, (2, 4, 8, 16, 32)), (2, (2, 4, 8))):
        for cells in counts:
            row = worst(cells, degree, "mortar", reference)
            if comm.rank == 0:
                print(degree, cells, {name: float(f"{value:.2g}") for name, value in row.items()}, flush=True)
