"""Rigid punches on an elastic half-space, against closed forms.

python3 demos/benchmarks/reference/closed_forms.py --scene cone --json figures.json

Each scene returns ratios of what is found to the closed form. A half-space is a block hundreds of contact radii large, of cells that
grow with the distance from the contact; a wavy surface is periodic, so that a strip of it is exact.
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
from scipy.special import ellipe, ellipk

import uem_dolfinx as uem

comm = MPI.COMM_WORLD
E, NU = 1.0, 0.3
#: Plane-strain modulus of the half-space, NU being its Poisson's ratio.
STIFF = E / (1 - NU**2)
#: Length of blocks that stand for half-spaces, over the contact radius.
LARGE = 1000.0


def graded(h: float, length: float, growth: float = 1.15) -> np.ndarray:
    """Places from 0 to a length; the first distance is about h, each of the others ``growth`` times the one before."""
    n = int(np.ceil(np.log1p(length * (growth - 1) / h) / np.log(growth)))
    ways = growth ** np.arange(n + 1.0) - 1.0
    return ways * (length / ways[-1])


def fine_to(end: float, h: float, length: float, growth: float = 1.15) -> np.ndarray:
    """Places from 0 to a length, at distances h up to an end and growing ones after it."""
    return np.concatenate([np.linspace(0.0, end, round(end / h) + 1)[:-1], end + graded(h, length, growth)])


def block(*axes: np.ndarray) -> tuple[Any, dict[str, uem.Tag]]:
    """A block of quadrilaterals or hexahedra, by places along its axes, and its sides ``x0``, ``x1``, ``y0``, ... (collective)."""
    n, g = [len(axis) - 1 for axis in axes], len(axes)
    make, cell = (mesh.create_rectangle, "quadrilateral") if g == 2 else (mesh.create_box, "hexahedron")
    domain = make(comm, [np.zeros(g), np.ones(g)], n, getattr(mesh.CellType, cell))
    x, tags = domain.geometry.x, {}
    for i, axis in enumerate(axes):
        x[:, i] = axis[np.rint(x[:, i] * n[i]).astype(int)]
    for i, axis in enumerate(axes):
        for side, place in enumerate((axis[0], axis[-1])):
            tags[f"{'xyz'[i]}{side}"] = where(domain, lambda x, i=i, place=place: x[i] == place)
    return domain, tags


def where(domain: Any, at: Callable[[Any], Any]) -> uem.Tag:
    """Exterior facets at a place."""
    g = domain.geometry.dim
    return uem.Tag("side", 1, g - 1, domain, mesh.locate_entities_boundary(domain, g - 1, at))


def pressed(
    domain: Any, held: list[uem.Tag], top: uem.Tag, punch: uem.RigidSurface, law: uem.LinearElastic, friction: float = 0.0
) -> Any:
    """Contact with a punch that overlaps the top at first, after one step (collective).

    Args:
        domain: the body.
        held: its sides that are held, each in the component of its place in the list.
        top: the surface that is pressed.
        punch: where it is at the end.
        law: of the body.
        friction: coefficient.
    """
    g = domain.geometry.dim
    V = uem.function_space(domain, 1, (g,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    contact = uem.Contact(top, punch, sliding="small", max_penetration=np.inf, friction=friction, name="punch")
    bcs = [uem.dirichlet(V, side, component) for component, side in enumerate(held)]
    F = law.residual(u, v) * ufl.dx
    uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], max_iterations=100, petsc_options_prefix="punch_").solve()
    return contact


def gathered(contact: uem.Contact) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference positions ``(n, gdim)``, pressures and nodal normal forces ``(n,)`` of all contactors (collective)."""
    pair = contact.pair
    parts = comm.allgather((contact.config.X[pair.nodes], np.array(contact.pressures), pair.trial.lam))
    x, p, forces = (np.concatenate(part) for part in zip(*parts))
    return x, p, forces


def wavy() -> dict[str, float]:
    """A rigid sine wave of length 1 on a half-plane, at three depths."""
    height, largest, scatter = 1e-4, 1.0, 0.0
    #: Mean pressure at which the surfaces touch all over.
    full = np.pi * STIFF * height
    domain, tags = block(np.linspace(0.0, 0.5, 129), -graded(1 / 256, 2.0, 1.03)[::-1])
    sides = {"held": [where(domain, lambda x: (x[0] == 0.0) | (x[0] == 0.5)), tags["y0"]], "top": tags["y1"]}
    for depth in (0.6 * height, 2.9 * height, 5.3 * height):
        wave = uem.RigidSurface(
            lambda x, depth=depth: height * (1 - np.cos(2 * np.pi * x[0])) - depth - x[1],
            lambda x: np.stack([2 * np.pi * height * np.sin(2 * np.pi * x[0]), -np.ones_like(x[0])]),
        )
        x, p, forces = gathered(pressed(domain, **sides, punch=wave, law=uem.LinearElastic(E, NU, kind="plane_strain")))
        share = 2 * forces.sum() / full
        exact = 2 * full * np.cos(np.pi * x[:, 0]) * np.sqrt(np.maximum(share - np.sin(np.pi * x[:, 0]) ** 2, 0.0))
        largest = max(largest, float(p.max() / exact.max()), key=lambda ratio: abs(ratio - 1))
        scatter = max(scatter, float(np.sqrt(np.mean((p - exact) ** 2)) / exact.max()))
    return {"largest": largest, "scatter": scatter}


def cone() -> dict[str, float]:
    """A rigid cone of slope 1e-3, so deep that its contact radius is 1."""
    slope = 1e-3
    depth = np.pi * slope / 2
    domain, tags = block(fine_to(1.2, 0.01, LARGE), -graded(0.01, LARGE, 1.1)[::-1])
    uem.axisymmetric(domain)
    tip = uem.RigidSurface(
        lambda x: slope * np.abs(x[0]) - depth - x[1], lambda x: np.stack([slope * np.sign(x[0]), -np.ones_like(x[0])])
    )
    contact = pressed(domain, [tags["x0"], tags["y0"]], tags["y1"], tip, uem.LinearElastic(E, NU, kind="axisymmetric"))
    x, _, forces = gathered(contact)
    force = abs(float(contact.resultant().force[1])) / (2 * STIFF * depth**2 / (np.pi * slope))
    # pressures arcosh(a / r) have the mean radius pi a / 6, and a is proportional to the root of the force
    return {"force": force, "mean_radius": float((forces @ x[:, 0]) / forces.sum() / (np.pi / 6 * np.sqrt(force)))}


def flat() -> dict[str, float]:
    """A flat punch of radius 1 on a half-space with nu = 0: smooth, and so rough that nothing slips; forces over 4 G a d."""
    found, depth, h = {}, 1e-3, 1e-4
    domain, tags = block(np.concatenate([1 - graded(h, 1.0)[::-1], 1 + graded(h, LARGE)[1:]]), -graded(h, LARGE)[::-1])
    uem.axisymmetric(domain)
    face = where(domain, lambda x: (x[1] == 0.0) & (x[0] < 1 + h / 2))
    plane, law = uem.RigidPlane((0.0, -depth), (0.0, -1.0)), uem.LinearElastic(E, 0.0, kind="axisymmetric")
    for name, friction in (("smooth", 0.0), ("rough", 10.0)):
        contact = pressed(domain, [tags["x0"], tags["y0"]], face, plane, law, friction)
        found[name] = abs(float(contact.resultant().force[1])) / (4 * E / 2 * depth)
    return found


def ellipse() -> dict[str, float]:
    """A rigid paraboloid of two curvatures, for which a half-space has a contact of half axes 2 and 1."""
    a, b, p0, h, large = 2.0, 1.0, 1e-3, 0.125, 150.0
    m = 1 - (b / a) ** 2
    scale, K, L = p0 * b / STIFF, ellipk(m), ellipe(m)
    A, B, depth = scale / (m * a**2) * (K - L), scale / (m * a**2) * ((a / b) ** 2 * L - K), scale * K
    domain, tags = block(fine_to(a + 2 * h, h, large, 1.5), fine_to(b + 2 * h, h, large, 1.5), -graded(h, large, 1.3)[::-1])
    bowl = uem.RigidSurface(
        lambda x: A * x[0] ** 2 + B * x[1] ** 2 - depth - x[2],
        lambda x: np.stack([2 * A * x[0], 2 * B * x[1], -np.ones_like(x[0])]),
    )
    x, p, forces = gathered(pressed(domain, [tags[k] for k in ("x0", "y0", "z0")], tags["z1"], bowl, uem.LinearElastic(E, NU)))
    force = float(4 * forces.sum() / (2 / 3 * np.pi * a * b * p0))
    # of Hertz' pressure the mean of x^2 is a^2 / 5; all lengths and the pressure go with the cube root of the force
    axes = np.sqrt(5 * (forces @ x[:, :2] ** 2) / forces.sum()) / (a, b) / force ** (1 / 3)
    return {"force": force, "long_axis": axes[0], "short_axis": axes[1], "largest": float(p.max() / p0 / force ** (1 / 3))}


#: Scenes by their names.
SCENES: dict[str, Callable[[], dict[str, float]]] = {"wavy": wavy, "cone": cone, "flat": flat, "ellipse": ellipse}


def main() -> None:
    """Run one scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scene", choices=SCENES, required=True)
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the figures measured")
    args = parser.parse_args()
    found = SCENES[args.scene]()
    if comm.rank == 0:
        print("\n".join(f"{name:>15}: {value:.9g}" for name, value in found.items()))
        if args.json is not None:
            args.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
