"""Signorini's problem of two elastic bodies with its exact solution: contact that ends at a point, for any ratio of the stiffnesses.

The upper body fills y > 0, the lower one y < 0, in plane strain; they press each other along x < 0 with c sqrt(-x), and part along
x > 0. With z = x + i |y|, Kolosov's constant k = 3 - 4 nu and

    Z = i c sqrt(z),    Zh = (2/3) i c z^(3/2),    Z' = i c / (2 sqrt(z))

Westergaard's stresses and displacements of the upper body are

    s_xx = Re Z - y Im Z',    s_yy = Re Z + y Im Z',    s_xy = -y Re Z',
    2 mu u_x = (k - 1)/2 Re Zh - y Im Z,    2 mu u_y = (k + 1)/2 Im Zh - y Re Z,

and those of the lower body their mirror image with its own mu and k. The displacement is of class H^(5/2 - eps), so that the
energy norm of the error falls at best like h with linear elements and like h^(3/2) with quadratic ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks.scene import Scene, overlap

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

#: Degree of quadrature of integrals with the exact solution.
QUADRATURE = {"quadrature_degree": 6}


@dataclass(frozen=True)
class Exact:
    """The exact solution; coordinates and constants are numbers, arrays or UFL expressions.

    Attributes:
        c: strength, a pressure over the root of a length.
        nu: Poisson's ratio of both bodies.
    """

    c: float = 1.0
    nu: float = 0.3

    def root(self, x: Any, y: Any, sqrt: Callable[[Any], Any]) -> tuple[Any, Any, Any]:
        """Real and imaginary part of the root of z = x + i y, y >= 0, and |z|."""
        r = sqrt(x**2 + y**2)
        return sqrt(abs(r + x) / 2), sqrt(abs(r - x) / 2), r

    def displacement(self, x: Any, y: Any, side: Any, mu: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> tuple[Any, Any]:
        """Components of the displacement.

        Args:
            x: coordinate.
            y: coordinate.
            side: 1 in the upper body, -1 in the lower one.
            mu: shear modulus there.
            sqrt: NumPy's or UFL's.
        """
        c, k, y = self.c, 3 - 4 * self.nu, abs(y)
        a, b, _ = self.root(x, y, sqrt)
        Z = -c * b, c * a
        Zh = -2 / 3 * c * (x * b + y * a), 2 / 3 * c * (x * a - y * b)
        return ((k - 1) / 2 * Zh[0] - y * Z[1]) / (2 * mu), side * ((k + 1) / 2 * Zh[1] - y * Z[0]) / (2 * mu)

    def stress(self, x: Any, y: Any, side: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> tuple[Any, Any, Any]:
        """Components xx, yy and xy of the stress, everywhere but at the origin; arguments as in ``displacement``."""
        c, y = self.c, abs(y)
        a, b, r = self.root(x, y, sqrt)
        dZ = c * b / (2 * r), c * a / (2 * r)
        return -c * b - y * dZ[1], -c * b + y * dZ[1], -side * y * dZ[0]

    def pressure(self, x: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> Any:
        """Contact pressure on y = 0."""
        return self.c * sqrt((abs(x) - x) / 2)

    @property
    def force(self) -> float:
        """Contact force over -1 < x < 0."""
        return 2 / 3 * self.c


def signorini(
    n: int, *, degree: int = 1, ratio: float = 1.0, finer: float = 2.0, contactor: str = "upper", graded: float = 1.0
) -> Scene:
    """Two bodies of one unit of height and two of length each, their outsides displaced as in the exact solution.

    Nodes at the ends of the contactor's surface are free to move across it, and the outsides bear the exact traction, which does
    work there alone: so no contactor is both prescribed and united. Feet are found once, which makes the problem linear but for
    contact, and c does not matter; a barrier, which knows but bodies where they are and a distance of its own, needs
    displacements much larger than the distance, and small ones: c is a tenth of E.

    Args:
        n: cells along each unit of length of the target's body.
        degree: of the displacement.
        ratio: Young's modulus of the target's body over that of the contactor's, which is 1.
        finer: cells of the contactor's body along each unit, over n; 1 makes matching meshes.
        contactor: ``"upper"`` or ``"lower"``.
        graded: power of the distance from both axes by which nodes gather at the origin; 1 keeps all cells alike.
    """
    target = {"upper": "lower", "lower": "upper"}[contactor]
    surfaces = {"upper": "upper_bottom", "lower": "lower_top"}
    fine = round(finer * n)
    mesh, tags = uem.read_gmsh(
        common.MESHES / "signorini.geo", comm, gdim=2,
        parameters={f"n_{contactor}": fine, f"n_{target}": n},
    )  # fmt: skip
    nodes = mesh.geometry.x
    nodes[:] = np.sign(nodes) * np.abs(nodes) ** graded
    exact = Exact(c=0.1)
    E, side = (fem.Function(compat.function_space(mesh, ("DG", 0))) for _ in range(2))
    for body, modulus, sign in ((contactor, 1.0, 1.0), (target, ratio, -1.0)):
        E.x.array[tags[body].entities] = modulus
        side.x.array[tags[body].entities] = sign if contactor == "upper" else -sign
    V = compat.function_space(mesh, degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, exact.nu, kind="plane_strain")

    x, y = ufl.SpatialCoordinate(mesh)
    u_exact = ufl.as_vector(exact.displacement(x, y, side, E / (2 * (1 + exact.nu)), ufl.sqrt))
    xx, yy, xy = exact.stress(x, y, side, ufl.sqrt)
    s_exact = ufl.as_tensor([[xx, xy], [xy, yy]])
    strain_exact = (1 + exact.nu) / E * (s_exact - exact.nu * (xx + yy) * ufl.Identity(2))

    outside = np.union1d(tags["lower_outside"].entities, tags["upper_outside"].entities).astype(np.int32)
    traction = ufl.dot(s_exact, ufl.FacetNormal(mesh))
    F = material.residual(u, v) * ufl.dx - ufl.dot(traction, v) * forms.surface_measure(mesh, outside, QUADRATURE)
    bcs = []
    for i in range(2):
        V_i, _ = V.sub(i).collapse()
        value = fem.Function(V_i)
        forms.interpolation(value, u_exact[i])()
        dofs = fem.locate_dofs_topological((V.sub(i), V_i), 1, outside)
        if i == 1:
            ends = fem.locate_dofs_topological((V.sub(i), V_i), 1, tags[surfaces[contactor]].entities)[0]
            held = ~np.isin(dofs[0], ends)
            dofs = [part[held] for part in dofs]
        bcs.append(fem.dirichletbc(value, dofs, V.sub(i)))

    dx, dC = ufl.dx(metadata=QUADRATURE), forms.surface_measure(mesh, tags[surfaces[contactor]].entities, QUADRATURE)
    lam, mu = material.lam, material.mu

    def energy(strain: Any) -> Any:
        return mu * ufl.inner(strain, strain) + lam / 2 * ufl.tr(strain) ** 2

    pressure = fem.Function(compat.function_space(mesh, degree))
    p_exact = exact.pressure(x, ufl.sqrt)
    parts = {
        "error_energy": (energy(material.strain(u) - strain_exact) * dx, energy(strain_exact) * dx),
        "error_l2": (ufl.inner(u - u_exact, u - u_exact) * dx, ufl.inner(u_exact, u_exact) * dx),
        "error_pressure": ((pressure - p_exact) ** 2 * dC, p_exact**2 * dC),
    }
    compiled = {name: tuple(map(forms.form, pair)) for name, pair in parts.items()}
    largest = fem.Function(V)
    forms.interpolation(largest, u_exact)()
    size = float(max(comm.allgather(np.abs(largest.x.array).max(initial=0.0))))

    def errors(problem: uem.UnitedProblem, contact: uem.Contact, steps: list[Any]) -> dict[str, float | None]:
        pressure.x.array[:] = contact.pressure.x.array
        found: dict[str, float | None] = {}
        for name, (difference, whole) in compiled.items():
            found[name] = float(np.sqrt(forms.assemble_scalar(difference, comm) / forms.assemble_scalar(whole, comm)))
        direction = 1.0 if contactor == "upper" else -1.0
        found["error_force"] = abs(direction * contact.resultant().force[1] / exact.force - 1)
        found["overlap"] = overlap(contact) / size
        return found

    def contact() -> uem.Contact:
        return uem.Contact(contactor=tags[surfaces[contactor]], target=tags[surfaces[target]], sliding="fixed", name="interface")

    kind = "matching" if finer == 1 else "nested" if fine % n == 0 else "not nested"
    kind += ", coarser contactor" * (finer < 1)
    return Scene(
        "signorini", degree, F, u, bcs, contact, errors, stiffness=min(1.0, ratio) * fine, h=1 / fine,
        facts={"ratio": float(ratio), "meshes": kind + ", graded" * (graded > 1)},
    )  # fmt: skip
