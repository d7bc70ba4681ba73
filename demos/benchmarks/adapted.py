"""All methods on the same meshes of a cylinder on a block: of one size, graded by hand, and adapted to the error of united elements.

``PYTHONPATH=demos python -m benchmarks.adapted`` prints the table of the report.
"""

from __future__ import annotations

from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import methods

import uem_dolfinx as uem

E, NU, R, DEGREE = 1e6, 0.3, 3.0, 2
#: Springs in multiples of E over the mean distance of contactors in contact; of the proximal point method in its first step.
PARAMETERS = {"penalty": 1e3, "penalty_surface": 1e3, "augmented": 1e2, "proximal": 1e-1}
#: Meshes by their names: file, its parameters, and the tolerance of an adaptation or None.
MESHES = {
    "uniform": ("adapt_hertz", {"h": 0.125}, None),
    "graded by hand": ("hertz_cylinder", {"h": 1 / 40}, None),
    "adapted, 2 %": ("adapt_hertz", {}, 0.02),
    "adapted, 0.35 %": ("adapt_hertz", {}, 0.0035),
}
REFERENCE = 0.001


def solved(mesh: Any, tags: Any, method: str, spacing: float) -> tuple[uem.UnitedProblem, uem.Contact, int]:
    """A problem by a method, its contact, and the number of linear solves (collective)."""
    V = uem.function_space(mesh, DEGREE, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(E, NU, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.006)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"], sliding="fixed")
    options = {"parameter": PARAMETERS[method] * E / spacing} if method in PARAMETERS else {}
    if method == "proximal":
        options["scale"] = E / spacing
    problem = methods.create(method, F, u, bcs=bcs, contacts=[contact], **options)
    return problem, contact, methods.counts(list(uem.load_steps(problem, 1)))[0]


def measured(contact: uem.Contact) -> tuple[float, float, float]:
    """Force, root mean square of the pressures' errors within 0.95 a over the largest pressure of Hertz, and spacing of contactors."""
    force = 2 * float(contact.resultant().force[1])
    p0 = np.sqrt(force * E / (2 * (1 - NU**2)) / (np.pi * R))
    a = 2 * force / (np.pi * p0)
    x, p = (np.concatenate(comm.allgather(part)) for part in (contact.points[:, 0], contact.pressures))
    inside = x < 0.95 * a
    rms = np.sqrt(np.mean((p[inside] / p0 - np.sqrt(1 - (x[inside] / a) ** 2)) ** 2))
    return force, float(rms), float(a / max(inside.sum(), 1))


def mesh_of(name: str) -> tuple[Any, Any]:
    """One of the meshes with its tags (collective)."""
    file, parameters, tolerance = MESHES[name]
    made: list[Any] = []

    def make(size: Any) -> uem.UnitedProblem:
        made[:] = uem.read_gmsh(common.MESHES / f"{file}.geo", comm, gdim=2, parameters=parameters | {"order": DEGREE}, size=size)
        return solved(*made, "mortar", 1.0)[0]

    make(None) if tolerance is None else uem.adapt(make, tolerance=tolerance, solve=lambda problem: None)
    return made[0], made[1]


if __name__ == "__main__":
    MESHES["reference"] = ("adapt_hertz", {}, REFERENCE)
    exact = measured(solved(*mesh_of("reference"), "mortar", 1.0)[1])[0]
    for name in list(MESHES)[:-1]:
        mesh, tags = mesh_of(name)
        spacing = measured(solved(mesh, tags, "mortar", 1.0)[1])[2]
        for method in ("united", "mortar", "penalty", "penalty_surface", "lagrange", "augmented", "proximal"):
            try:
                problem, contact, solves = solved(mesh, tags, method, spacing)
                force, rms, _ = measured(contact)
                found = f"{100 * abs(force / exact - 1):.2g} % | {100 * rms:.2g} % | {solves}"
            except uem.ConvergenceError as error:
                found = f"- | - | {type(error).__name__}"
            if comm.rank == 0:
                print(f"| {name} | {len(problem.u.x.array)} | {method} | {found} |", flush=True)
