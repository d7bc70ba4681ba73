"""What makes patch tests harder: nodes moved at random, a load where nothing covers the target, and the body in one piece."""

from __future__ import annotations

from typing import Any

import common
import numpy as np
import ufl
from dolfinx import fem, mesh
from benchmarks import eigenvalues
from numpy.polynomial import Legendre

import uem_dolfinx as uem
from uem_dolfinx import compat

#: Pairs of meshes by dimension and name: cells along the lower and the upper block, and how they are made.
PAIRS: dict[int, dict[str, tuple[tuple[int, int], dict[str, Any]]]] = {
    2: {
        "5:3": ((5, 3), {}),
        "7:10": ((7, 10), {}),
        "random": ((7, 10), {"moved": 0.2}),
        "overhang": ((5, 3), {"width": 1.3}),
        "overhang of a hundredth": ((3, 5), {"width": 3 / 2.01}),
    },
    3: {
        "2:3": ((2, 3), {}),
        "4:3": ((4, 3), {}),
        "random": ((4, 3), {"moved": 0.1}),
        "overhang": ((3, 2), {"quads": 1, "width": 1.3}),
    },
}


def move_nodes(x: np.ndarray, most: float) -> None:
    """Move nodes ``x (n, 3)`` by up to ``most`` in each direction, but none off a plane with a whole number as coordinate."""
    inside = np.abs(x - x.round()) > 1e-9
    x += inside * most * np.sin(1e4 * (x @ np.array([[1.0, 0.3, 0.7], [0.6, 1.0, 0.2], [0.4, 0.8, 1.0]]) + [0.1, 0.2, 0.3]))


def widen(domain: mesh.Mesh, body: uem.Tag, width: float) -> None:
    """Stretch a body of one mesh along x."""
    domain.geometry.x[np.unique(compat.geometry_dofs(domain)[body.entities]), 0] *= width


def beyond(x: Any, end: float, h: float, degree: int) -> Any:
    """1 where x > end, and on the facet of the width h that has the end inside the polynomial that does the same work.

    Over every polynomial of the degree it has the integral of the jump, whose own the rules of quadrature miss.
    """
    a = h * np.floor(end / h)
    xi, there = 2 * (x - a) / h - 1, 2 * (end - a) / h - 1
    integrals = [Legendre.basis(k).integ() for k in range(degree + 1)]
    weights = [(2 * k + 1) / 2 * (whole(1.0) - whole(there)) for k, whole in enumerate(integrals)]
    part = sum(w * P for w, P in zip(weights, (1.0, xi, (3 * xi**2 - 1) / 2)))
    return ufl.conditional(ufl.gt(x, a + h), 1.0, ufl.conditional(ufl.lt(x, a), 0.0, part))


def strict_error(u: fem.Function, stress: Any, p: float, E: float, nu: float) -> float:
    """Largest error of any stress over p and of any displacement over the largest, of two unit blocks under p (collective).

    Each is an oedometer of modulus M = E (1 - nu) / ((1 + nu) (1 - 2 nu)): u_z = -p z / M.
    """
    V, dim = u.function_space, u.function_space.mesh.geometry.dim
    modulus, sideways, up = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)), nu / (1 - nu), ufl.unit_vector(dim - 1, dim)
    wrong = stress / p + sideways * ufl.Identity(dim) + (1 - sideways) * ufl.outer(up, up)
    family = "DQ" if compat.cell_name(V.mesh) in ("quadrilateral", "hexahedron") else "DG"
    found = fem.Function(uem.function_space(V.mesh, (family, 1))), fem.Function(V)
    uem.interpolate(found[0], ufl.sqrt(ufl.inner(wrong, wrong)))
    uem.interpolate(found[1], (u * modulus / p + ufl.SpatialCoordinate(V.mesh)[dim - 1] * up) / 2)
    return float(max(common.comm.allgather(max(np.abs(f.x.array).max(initial=0.0) for f in found))))


def condition_ratio(problem: uem.UnitedProblem, dim: int, n: int, degree: int, E: float, nu: float) -> float:
    """Condition number of the last united matrix over the bodies' own: their largest eigenvalue, the smallest in one piece (serial)."""
    largest = eigenvalues.largest_eigenvalue(problem.system.bodies.tangent.K)
    return eigenvalues.condition_number(problem.system.solver.A) / (largest / smallest_in_one_piece(dim, n, degree, E, nu))


def smallest_in_one_piece(dim: int, n: int, degree: int, E: float, nu: float) -> float:
    """Smallest eigenvalue of one body of the shape of both, with n cells along its sides, on rollers at its bottom and its sides."""
    corners = [[0.0] * dim, [1.0] * (dim - 1) + [2.0]]
    make = mesh.create_rectangle if dim == 2 else mesh.create_box
    domain = make(common.comm, corners, [n] * (dim - 1) + [2 * n])
    V = uem.function_space(domain, degree, (dim,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind="plane_strain" if dim == 2 else "3d")
    F = material.residual(u, v) * ufl.dx + v[dim - 1] * ufl.ds
    bcs = []
    for i in range(dim):
        sides = mesh.locate_entities_boundary(domain, dim - 1, lambda x, i=i: (x[i] < 1e-9) | ((x[i] > 1 - 1e-9) & (i < dim - 1)))
        bcs.append(uem.dirichlet(V, sides, i))
    problem = uem.UnitedProblem(F, u, bcs=bcs)
    problem.solve()
    return eigenvalues.extreme_eigenvalues(problem.system.solver.A)[1]
