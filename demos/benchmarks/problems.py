"""Further problems with known answers: two elastic bodies after Hertz, a rigid indenter in 3D, and a bar that hits a wall.

Each function makes the scene of one mesh; what the errors are measured against is in its docstring.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import common
import numpy as np
import ufl
from common import comm
from dolfinx import fem
from benchmarks import methods
from benchmarks.scene import DIRECT, Scene, overlap

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.surfaces import tributary_areas


def gathered(contact: uem.Contact) -> tuple[np.ndarray, ...]:
    """Reference positions, pressures, tributary areas and gaps of all contactors, in the order of their positions (collective)."""
    pair = contact.pair
    areas = tributary_areas(contact.config, contact.contactor)[pair.nodes]
    parts = comm.allgather((contact.config.X[pair.nodes], np.array(contact.pressures), areas, pair.kinematics.projection.gap))
    X, p, areas, gap = (np.concatenate(part) for part in zip(*parts))
    order = np.lexsort(X.T.round(12))
    return X[order], p[order], areas[order], gap[order]


def norm(values: np.ndarray, areas: np.ndarray) -> float:
    """Norm in L2 of nodal values."""
    return float(np.sqrt((np.abs(areas) * values**2).sum()))


# -- Hertz -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HertzAnswer:
    """What the two bodies of ``hertz_cylinder`` come to on a fine mesh.

    Attributes:
        energy: stored.
        force: on half of the cylinder.
        x: positions along the arc ``(n,)``.
        pressure: there ``(n,)``.
        accuracy: of the energy, as an error in energy norm: how far the answer is from that of a mesh twice as coarse.
    """

    energy: float
    force: float
    x: np.ndarray
    pressure: np.ndarray
    accuracy: float = 0.0


def hertz_cylinder(h: float, degree: int, answer: HertzAnswer | None = None) -> Scene:
    """A cylinder on a block, see ``hertz_cylinder.py``: one mesh, in one step whose feet are found once.

    The reference u lives on another mesh. Since it is in equilibrium, any u_h with the same prescribed displacements has the error

        a(u_h - u, u_h - u) / 2 = W(u_h) - W(u) - integral of p g_h

    with the stored energy W, the pressure p of the reference, and the gap g_h, negative where bodies overlap. There is no L2 norm
    of the displacement; the pressure is compared along the arc.

    Args:
        h: size of the cells in the contact zone.
        degree: of the displacement and of the arc.
        answer: to compare with; without, ``hertz_answer`` makes it of the scene.
    """
    E, nu, d = 1e6, 0.3, 0.006
    mesh, tags = uem.read_gmsh(
        common.MESHES / "hertz_cylinder.geo", comm, gdim=2, parameters={"h": h, "ratio": 1.0, "order": degree}
    )
    V = compat.function_space(mesh, degree, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, nu, kind="plane_strain")
    bcs = [
        uem.dirichlet(V, tags["symmetry"], 0),
        uem.dirichlet(V, tags["block_bottom"], 1),
        uem.dirichlet(V, tags["disc_top"], 1, -d),
    ]
    energy = forms.form(material.energy(u) * ufl.dx)

    def errors(problem: uem.UnitedProblem, contact: uem.Contact, steps: list[Any]) -> dict[str, float | None]:
        if answer is None:
            return {}
        X, p, areas, gap = gathered(contact)
        reference = np.interp(X[:, 0], answer.x, answer.pressure)
        excess = forms.assemble_scalar(energy, comm) - answer.energy - (areas * reference * gap).sum()
        return {
            "error_energy": float(np.sqrt(abs(excess) / answer.energy)),
            "error_pressure": norm(p - reference, areas) / norm(reference, areas),
            "error_force": abs(contact.resultant().force[1] / answer.force - 1),
            "overlap": overlap(contact) / d,
        }

    return Scene(
        "hertz_cylinder", degree, material.residual(u, v) * ufl.dx, u, bcs,
        lambda: uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], sliding="fixed"),
        errors, stiffness=E / h, h=h, facts={} if answer is None else {"reference": answer.accuracy},
    )  # fmt: skip


def hertz_answer(h: float) -> HertzAnswer:
    """Solve ``hertz_cylinder`` with quadratic elements of size h and 2 h (collective)."""
    answers = []
    for size in (2 * h, h):
        scene = hertz_cylinder(size, 2)
        contact = scene.contact()
        problem = uem.UnitedProblem(scene.F, scene.u, bcs=scene.bcs, contacts=[contact], rtol=1e-11, **scene.options("united"))
        for _ in scene.run(problem):
            pass
        (v,) = scene.F.arguments()
        stored = forms.assemble_scalar(forms.form(0.5 * ufl.replace(scene.F, {v: scene.u})), comm)
        X, p, _, _ = gathered(contact)
        order = np.argsort(X[:, 0])
        answers.append(HertzAnswer(stored, float(contact.resultant().force[1]), X[order, 0], p[order]))
    coarse, fine = answers
    return replace(fine, accuracy=float(np.sqrt(abs(coarse.energy / fine.energy - 1))))


# -- Cattaneo and Mindlin ------------------------------------------------------------------------------------------------------


def cattaneo(h: float) -> Scene:
    """A cylinder pressed onto a block, and its flat side led to the side, see ``cattaneo_mindlin.py``: one mesh of linear elements.

    The error is that of friction, read from the residual of the bodies, against Mindlin for the forces that they feel, in L2 where
    Hertz' pressure has no vertical tangent; relative to mu times Hertz' pressure, and of what is even about the middle.
    """
    E, nu, R, depth, way, mu, reach = 1.0, 0.3, 1.0, 0.0012, 0.0004, 0.3, 0.03
    mesh, tags = uem.read_gmsh(common.MESHES / "cattaneo_mindlin.geo", comm, gdim=2, parameters={"h": h, "R": R, "zone": reach})
    V = compat.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    place = fem.Constant(mesh, np.zeros(2))
    F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["block_bottom"]), uem.dirichlet(V, tags["disc_top"], value=place)]
    residual = forms.form(F)

    def nodal_forces(contact: uem.Contact) -> tuple[np.ndarray, np.ndarray]:
        """Contact forces ``(n, 2)`` of this rank's contactors, and their areas (collective)."""
        b = compat.create_vector(V)
        forms.assemble_vector(b, residual)
        nodes = contact.pair.nodes
        # the arc ends where the disc is held
        loose = ~np.isin(nodes, fem.locate_dofs_topological(V, 1, tags["disc_top"].entities))
        return np.array(b.array_r).reshape(-1, 2)[nodes] * loose[:, None], tributary_areas(contact.config, contact.contactor)[
            nodes
        ]

    def run(problem: uem.UnitedProblem) -> Iterable[Any]:
        for aside, down in ((0.0, 0.5), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0)):
            place.value[:] = way * aside, -depth * down
            yield from uem.load_steps(problem)

    def errors(problem: uem.UnitedProblem, contact: uem.Contact, steps: list[Any]) -> dict[str, float | None]:
        force, area = nodal_forces(contact)
        parts = comm.allgather((contact.pair.points[:, 0], force, area))
        x, force, area = (np.concatenate(part) for part in zip(*parts))
        Q, P = -force[:, 0].sum(), force[:, 1].sum()
        p0 = np.sqrt(P * E / (2 * (1 - nu**2)) / (np.pi * R))
        a, x = 2 * P / (np.pi * p0), x - (x * force[:, 1]).sum() / P
        c = a * np.sqrt(max(1 - Q / (mu * P), 0.0))
        whole, stuck = (np.sqrt(np.maximum(part**2 - x**2, 0.0)) / a for part in (a, c))
        exact, q = whole - stuck, -force[:, 0] / np.where(area > 0, area, 1.0) / (mu * p0)
        # the slopes of the surfaces, which Mindlin leaves out, turn some of the pressure to the side, either way on either side
        order = np.argsort(x)
        q = (q + np.interp(-x, x[order], q[order])) / 2
        inside = np.abs(x) < a - h * reach
        return {
            "error_pressure": norm((q - exact)[inside], area[inside]) / norm(whole[inside], area[inside]),
            "overlap": overlap(contact) / depth,
        }

    return Scene(
        "cattaneo", 1, F, u, bcs, lambda: uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], friction=mu, sliding="fixed"),
        errors, stiffness=E / (h * reach), h=h * reach, run=run,
    )  # fmt: skip


# -- a rigid indenter --------------------------------------------------------------------------------------------------------


def indenter(N: int) -> Scene:
    """A rigid paraboloid pressed into a block, see ``hertz_penalty.py``: one mesh of N x N x N/2 hexahedra, CG with multigrid.

    Multipliers get a factorisation instead, since MINRES did not converge. All methods share one mesh and its error. So they are
    compared with the exact solution of the discrete problem, one for each coupling, found by elimination with a direct solver to
    rounding; springs spread over the surface lead to another discrete problem, for which it is no answer.
    """
    E, R, d = 10.0, 0.5, 0.02
    mesh, tags = uem.read_gmsh(common.MESHES / "hertz_penalty.geo", comm, gdim=3, parameters={"N": N})
    mesh.geometry.x[:] = mesh.geometry.x**2 * [1, 1, -1]
    V = compat.function_space(mesh, 1, (3,))
    u, v, exact = fem.Function(V, name="displacement"), ufl.TestFunction(V), fem.Function(V)
    material = uem.LinearElastic(E, 0.3)
    F = material.residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["bottom"], i) for i in range(3)]
    bcs += [uem.dirichlet(V, tags["side_x0"], 0), uem.dirichlet(V, tags["side_y0"], 1)]
    paraboloid = uem.RigidSurface(
        lambda x: (x[:, 0] ** 2 + x[:, 1] ** 2) / (2 * R) - d - x[:, 2], lambda x: np.tile([0.0, 0.0, -1.0], (len(x), 1))
    )

    def contact() -> uem.Contact:
        return uem.Contact(contactor=tags["top"], target=paraboloid, sliding="fixed", name="indenter")

    @cache
    def answer(coupling: str) -> tuple[np.ndarray, np.ndarray, float]:
        """Displacements, pressures and force of the discrete problem."""
        found, known = u.x.array.copy(), contact()
        u.x.array[:] = 0.0
        method = "mortar" if coupling == "mortar" else "united"
        methods.create(method, F, u, bcs=bcs, contacts=[known], petsc_options=common.direct(), rtol=1e-12).solve()
        solution = u.x.array.copy()
        u.x.array[:] = found
        return solution, gathered(known)[1], float(known.resultant().force[2])

    pairs = {
        "error_energy": [forms.form(material.energy(w) * ufl.dx) for w in (u - exact, exact)],
        "error_l2": [forms.form(ufl.inner(w, w) * ufl.dx) for w in (u - exact, exact)],
    }

    def errors(problem: uem.UnitedProblem, contact: uem.Contact, steps: list[Any]) -> dict[str, float | None]:
        found: dict[str, float | None] = {}
        exact.x.array[:], pressure, force = answer(contact.coupling)
        _, p, areas, _ = gathered(contact)
        for name, (difference, whole) in pairs.items():
            found[name] = float(np.sqrt(forms.assemble_scalar(difference, comm) / forms.assemble_scalar(whole, comm)))
        found["error_pressure"] = norm(p - pressure, areas) / norm(pressure, areas)
        found["error_force"] = abs(float(contact.resultant().force[2]) / force - 1)
        found["overlap"] = overlap(contact) / d
        return found

    return Scene(
        "hertz_penalty", 1, F, u, bcs, contact, errors, stiffness=E * N**2, h=1 / N**2,
        options=lambda method: {"petsc_options": DIRECT if method == "lagrange" else common.cg(rtol=1e-8)},
    )  # fmt: skip


# -- a bar hits a wall -------------------------------------------------------------------------------------------------------


def bar_impact(n: int, cfl: float, *, scheme: str = "trapezoidal", contactors: str = "massless") -> Scene:
    """A bar thrown against a wall, see ``bar_impact.py``: one mesh and one time step.

    Exactly, the wall feels 300 from t = 1/2 to 7/6, and then the bar flies back at 10 without strain. Until t = 1.4 the errors
    are: the energy of what differs from that at the end, over the energy of the impact, its root; the displacement at the end
    in L2; the pressure in L2 over time; the impulse. The deepest overlap is relative to the shortening of the bar.

    Args:
        n: cells along the bar.
        cfl: time step over the time in which the wave passes a cell.
        scheme: ``"trapezoidal"`` or ``"generalised_alpha"``.
        contactors: ``"massless"`` or ``"massy"``.
    """
    E, rho, L, v0, gap, end = 900.0, 1.0, 10.0, 10.0, 5.0, 1.4
    c = np.sqrt(E / rho)
    dt, touch, leave = cfl * L / n / c, gap / v0, gap / v0 + 2 * L / c
    mesh, tags = uem.read_gmsh(common.MESHES / "bars.geo", comm, gdim=2, parameters={"n": n, "L": L, "gap": gap})
    V = compat.function_space(mesh, 1, (2,))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = uem.LinearElastic(E, 0.0, kind="plane_stress")
    wall = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    there = fem.Constant(mesh, np.array([0.0, v0 * (end - leave) - gap]))
    rebound = fem.Constant(mesh, np.array([0.0, v0]))
    velocity = fem.Function(V)
    differs = forms.form((material.energy(u) + rho / 2 * ufl.inner(velocity - rebound, velocity - rebound)) * ufl.dx)
    misplaced = forms.form(ufl.inner(u - there, u - there) * ufl.dx)
    history: list[tuple[float, float, float, float]] = []

    def options(method: str) -> dict[str, Any]:
        rule = {"trapezoidal": uem.newmark, "generalised_alpha": lambda: uem.generalised_alpha(0.8)}[scheme]()
        dynamics = uem.Dynamics(uem.consistent_mass(V, rho), velocity=(0.0, -v0), scheme=rule, contactors=contactors)
        return {"dynamics": dynamics, "petsc_options": DIRECT}

    def run(problem: uem.UnitedProblem) -> Iterable[Any]:
        history.clear()
        (contact,) = problem.contacts
        for step in uem.time_steps(problem, dt, end, event_tolerance=1e-3 if contactors == "massless" else None):
            history.append((step.dt, step.time, float(contact.resultant().force[1]), overlap(contact)))
            yield step

    def errors(problem: uem.UnitedProblem, contact: uem.Contact, steps: list[Any]) -> dict[str, float | None]:
        velocity.x.array[:] = problem.dynamics.velocity.x.array
        length, time, force, deep = np.array(history).T
        plateau = rho * c * v0
        # what a step overlaps of the contact
        inside = np.clip(np.minimum(time, leave) - np.maximum(time - length, touch), 0.0, None)
        square = (length * force**2 - 2 * inside * force * plateau).sum() + plateau**2 * (leave - touch)
        return {
            "error_energy": float(np.sqrt(forms.assemble_scalar(differs, comm) / (rho * L * v0**2 / 2))),
            "error_l2": float(np.sqrt(forms.assemble_scalar(misplaced, comm) / (L * there.value[1] ** 2))),
            "error_pressure": float(np.sqrt(square / (plateau**2 * (leave - touch)))),
            "error_force": float(abs((length * force).sum() / (2 * rho * L * v0) - 1)),
            "overlap": float(deep.max() / (v0 * L / c)),
        }

    return Scene(
        "bar_impact", 1, material.residual(u, v) * ufl.dx, u, [],
        lambda: uem.Contact(contactor=tags["lower_bottom"], target=wall, name="wall"),
        errors, stiffness=E * n / L, h=L / n, options=options, run=run,
        facts={"dt": dt, "cfl": cfl, "scheme": scheme, "contactors": contactors},
    )  # fmt: skip
