"""Verification decks of other programs, run from their own files, which are not part of this package.

python3 demos/benchmarks/reference/decks.py --deck test/cubesmortar.inp --json figures.json

The scene is named by its file. Meshes, sets and surfaces are read from it. Some decks are run with all that stands in them; for
the others materials, conditions and loads are written here in UFL.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, mesh

import uem_dolfinx as uem

comm = MPI.COMM_WORLD


def at(u: fem.Function, place: tuple[float, ...]) -> list[float]:
    """Displacement of the node at a place (collective)."""
    V = u.function_space
    x, n = V.tabulate_dof_coordinates(), V.dofmap.index_map.size_local
    far = np.linalg.norm(x[:n, : len(place)] - place, axis=1) if n else np.array([np.inf])
    distance, values = min(comm.allgather((far.min(), u.x.array.reshape(-1, len(place))[: max(n, 1)][far.argmin()].tolist())))
    assert distance < 1e-6, (place, distance)
    return list(values)


def sides(domain: Any, where: Callable[[Any], Any]) -> Any:
    """Exterior facets at a place."""
    return mesh.locate_entities_boundary(domain, domain.topology.dim - 1, where)


def held(V: Any, place: tuple[float, ...], components: str) -> list[fem.DirichletBC]:
    """Conditions that hold components of the node at a place."""
    found = []
    for c in components:
        sub = V.sub("xyz".index(c))
        dofs = fem.locate_dofs_geometrical(
            (sub, uem.function_space(V.mesh, 2)), lambda x: np.isclose(x.T[:, :3], place).all(axis=1)
        )[0]
        found.append(uem.compat.dirichletbc(0.0, dofs, sub))
    return found


def thick_tube(path: Path) -> dict[str, float]:
    """A tube of radii 50 and 100 under an inner pressure of 10 in plane strain, two axisymmetric serendipity cells (CAX8)."""
    domain, tags = uem.read_mesh(path, comm)
    uem.axisymmetric(domain)
    V = uem.function_space(domain, 2, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    inside = uem.ds(sides(domain, lambda x: np.isclose(x[0], 50.0)), domain)
    F = uem.LinearElastic(210000.0, 0.3, kind="axisymmetric").residual(u, v) * ufl.dx - 10.0 * v[0] * inside
    uem.UnitedProblem(F, u, bcs=[uem.dirichlet(V, tags[name], 1) for name in ("Nz0", "Nz1")]).solve()
    return {"u_inside": at(u, (50.0, 5.0))[0], "u_outside": at(u, (100.0, 5.0))[0]}


def prisms(path: Path) -> dict[str, float]:
    """A column of 24 quadratic prisms (C3D15) under a pressure of 20 on both ends."""
    domain, _ = uem.read_mesh(path, comm, cells="simplices")
    V = uem.function_space(domain, 2, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    ends = uem.ds(sides(domain, lambda x: np.isclose(x[2], 0.0) | np.isclose(x[2], 1.5)), domain)
    F = uem.LinearElastic(2.9e7, 0.32).residual(u, v) * ufl.dx + 20.0 * ufl.dot(v, ufl.FacetNormal(domain)) * ends
    bcs = [*held(V, (0.0, 0.0, 0.0), "xyz"), *held(V, (1.0, 0.0, 0.0), "yz"), *held(V, (0.0, 1.0, 0.0), "z")]
    uem.UnitedProblem(F, u, bcs=bcs).solve()
    found = at(u, (1.0, 1.0, 1.5))
    return {"settlement": found[2], "widening": found[0]}


def two_cubes(path: Path) -> dict[str, float]:
    """A cube of half the size on another one, a serendipity cell (C3D20) each, pressed with 100, friction 0.2."""
    domain, tags = uem.read_mesh(path, comm)
    V = uem.function_space(domain, 2, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    top = uem.ds(tags["Nfix2"])
    F = uem.StVenantKirchhoff(210000.0, 0.0).residual(u, v) * ufl.dx + 100.0 * v[2] * top
    bcs = [uem.dirichlet(V, tags["Nfix"]), *(uem.dirichlet(V, tags["Nfix2"], c) for c in (0, 1))]
    contact = uem.Contact(tags["Sslav"], tags["Smast"], coupling="mortar", friction=0.2)
    uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact]).solve()
    mean = uem.integrate(u[2] * top) / uem.integrate(fem.Constant(domain, 1.0) * top)
    return {"settlement": mean, "force": float(contact.resultant().force[2]), "corner": at(u, (0.75, 0.75, 1.5))[2]}


def tied_beam(path: Path) -> dict[str, Any]:
    """A beam of two parts (C3D20R) that are tied in the middle, clamped at both ends and compressed by 0.05: natural frequencies."""
    domain, tags = uem.read_mesh(path, comm)
    V = uem.function_space(domain, 2, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.StVenantKirchhoff(210000.0, 0.3).residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["FIX"]), uem.dirichlet(V, tags["fix2"], value=(0.0, 0.0, -0.05))]
    tie = uem.Contact(tags["depf"], tags["indf"], coupling="mortar", tied=True)
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[tie])
    problem.solve()
    found = uem.modes(problem, 5, mass=uem.consistent_mass(V, 7.8e-9)).frequencies
    return {f"frequency_{i}": float(f) for i, f in enumerate(found, 1)}


def as_it_stands(wanted: dict[str, tuple[int, int]]) -> Callable[[Path], dict[str, Any]]:
    """A deck with all that stands in it: components of displacements of nodes after its last step, by names."""

    def run(path: Path) -> dict[str, Any]:
        deck = uem.read_deck(path, comm)
        for _ in deck.run():
            pass
        return {name: float(deck.displacement(node)[component]) for name, (node, component) in wanted.items()}

    return run


#: Scenes by the names of their files.
SCENES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "08_lame_cax8.inp": thick_tube,
    "c3d15.inp": prisms,
    "cubesmortar.inp": two_cubes,
    "beamptied7.inp": tied_beam,
    "contact2.inp": as_it_stands({"end": (494, 1)}),
    "contact3.inp": as_it_stands({"raised": (9, 2)}),
    "contact6.inp": as_it_stands({"pressed": (3, 2), "raised": (9, 2), "bent": (11, 0)}),
    "ring1.inp": as_it_stands({"inside": (10, 0), "outside": (3, 0)}),
    "ring2.inp": as_it_stands({"outer": (13, 0), "inner": (6, 0)}),
}


def main() -> None:
    """Run one deck."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--deck", metavar="FILE", type=Path, required=True, help=f"one of {', '.join(SCENES)}")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the figures measured")
    args = parser.parse_args()
    if args.deck.name not in SCENES:
        parser.error(f"no scene for {args.deck.name}: known are {', '.join(SCENES)}")
    found = SCENES[args.deck.name](args.deck)
    if comm.rank == 0:
        print("\n".join(f"{name:>15}: {value:.9g}" for name, value in found.items()))
        if args.json is not None:
            args.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
