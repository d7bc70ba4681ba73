"""Finite plasticity in problems: no locking, rigid and soft tools with friction, steps that fail, impact, checkpoints, ranks.

The test to read first is ``test_a_tube_widens_without_locking``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, clamp, highest, raised, refused, run, scene, slow
from plastic_scenes import FY, NU, E, H, block, deform, tube

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def widened(cell: str, n: int, degree: int) -> tuple[float, list[uem.LoadStep]]:
    """Inner pressure of a rigid, perfectly plastic tube in plane strain, b = 2 a, after a has grown by half, over the exact one."""
    opening = 0.5
    pressure, steps = tube(COMM, cell, n, degree, opening, uem.FinitePlasticity, 10)
    inner, outer = 1 + opening, np.sqrt(4 + 2 * opening + opening**2)
    return pressure / inner / (2 / 3**0.5 * np.log(outer / inner)), steps


@pytest.mark.parametrize(
    "cell, n, degree, error",
    [
        ("quadrilateral", 4, 1, 0.004), ("hexahedron", 3, 1, 0.007), ("triangle", 2, 2, 0.02),
        slow("quadrilateral", 2, 2, 0.02), slow("tetrahedron", 2, 2, 0.02),
    ],
)  # fmt: skip
def test_a_tube_widens_without_locking(cell, n, degree, error):
    """Against ``2 FY / sqrt(3) ln(b / a)`` of the present radii; Newton's method is quadratic."""
    ratio, steps = widened(cell, n, degree)
    assert abs(ratio - 1) < error
    assert max(step.newton_iterations for step in steps) <= 8


@pytest.mark.long
def test_linear_simplices_lock():
    assert widened("triangle", 2, 1)[0] > 1.1


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_strain"), ("hexahedron", "3d")])
def test_a_smooth_press_flattens_to_half_the_height(cell, kind):
    """Uniform compression by a rigid plane: the force of the closed form, in plane strain that of a rigid, perfectly plastic block."""
    s, u = block(COMM, cell)
    V, g = u.function_space, len(u)
    material = uem.FinitePlasticity(u, E, NU, FY, H if g == 3 else 0.0, kind=kind)
    plane = uem.RigidPlane([*[0.0] * (g - 1), 1.0], [*[0.0] * (g - 1), -1.0])
    contact = uem.Contact(contactor=s.tag("top", 0, at(g - 1, 1.0)), target=plane)
    bcs = [bc for c in range(g) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, contacts=[contact], materials=[material], rtol=1e-10,
        load=lambda factor: plane.move([*[0.0] * (g - 1), -0.5 * factor]),
    )  # fmt: skip
    run(problem, 5)
    force = contact.resultant().force[-1] * 0.5
    if g == 3:
        tau = -(FY + H * np.log(2)) / (1 + H / E)
        assert force == pytest.approx(tau, rel=1e-8)
    else:
        # the height's part of J is elastic
        assert force == pytest.approx(-2 / 3**0.5 * FY, rel=2 * FY / E)


class Upset:
    """A soft block is pressed to three quarters of its height by a wider hard one that slips on it, both of one law."""

    def __init__(
        self, cell: str = "quadrilateral", coupling: str = "node_to_surface", comm: MPI.Comm = COMM, max_iterations: int = 25
    ):
        g = 2 if cell in ("triangle", "quadrilateral") else 3
        soft = box(cell, [0.0] * g, [*[0.5] * (g - 1), 0.5], [3] * g)
        hard = box(cell, [*[-0.1] * (g - 1), 0.5], [*[0.8] * (g - 1), 0.7], [*[2] * (g - 1), 1])
        self.s = s = scene(comm, cell, [soft, hard])
        V, S = compat.function_space(s.mesh, 1, (g,)), compat.function_space(s.mesh, ("DG", 0))
        self.u, strength = fem.Function(V), fem.Function(S)
        strength.x.array[compat.cell_dofs(S)[:, 0]] = np.array([FY, np.inf])[s.body]
        self.law = uem.FinitePlasticity(self.u, E, NU, strength, H / 10, kind="3d" if g == 3 else "plane_strain")
        low, high, top = (s.tag("face", body, at(g - 1, z)) for body, z in ((0, 0.5), (1, 0.5), (1, 0.7)))
        self.contact = uem.Contact(low, high, coupling=coupling, friction=0.1)
        bcs = [bc for c in range(g) for bc in clamp(V, s.tag("side", 0, at(c, 0.0)), c)]
        bcs += clamp(V, top, value=[*[0.0] * (g - 1), -0.125])
        self.problem = uem.UnitedProblem(
            self.law.residual(ufl.TestFunction(V)), self.u, bcs=bcs, contacts=[self.contact], materials=[self.law],
            rtol=1e-10, max_iterations=max_iterations,
        )  # fmt: skip

    def figures(self) -> list[float]:
        """What any number of ranks must agree on."""
        force = self.contact.resultant().force
        return [*force, self.law.energy(), self.law.dissipation(), self.contact.dissipation]


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell, coupling",
    [
        ("quadrilateral", "node_to_surface"),
        ("quadrilateral", "mortar"),
        ("hexahedron", "node_to_surface"),
        slow("hexahedron", "mortar"),
    ],
)
def test_upset_by_a_block_with_friction(cell, coupling):
    """Forces of any number of ranks; work of the press is stored, dissipated or taken by friction."""
    upset = Upset(cell, coupling)
    work, last = 0.0, None
    for step in uem.load_steps(upset.problem, 5):
        way, force = 0.125 * step.factor, upset.contact.resultant(on="target").force[-1]
        # it yields at once
        last = (0.0, force) if last is None else last
        work, last = work + (force + last[1]) / 2 * (way - last[0]), (way, force)
    stored, dissipated, friction = upset.figures()[-3:]
    assert friction > 0.01 * work and dissipated > 0.8 * work
    assert stored + dissipated + friction == pytest.approx(work, rel=0.03)
    if COMM.size > 1:
        alone = Upset(cell, coupling, MPI.COMM_SELF)
        run(alone.problem, 5)
        assert upset.figures() == pytest.approx(alone.figures(), rel=1e-6)
        assert np.abs(upset.s.gather(upset.u) - alone.s.gather(alone.u)).max() < 1e-7


@pytest.mark.slow
def test_a_step_that_failed_leaves_no_trace():
    """Fields, history and dissipation of friction are those of a run without failures, which makes the same steps."""
    straight, troubled = Upset(), Upset()
    for _ in range(3):
        troubled.problem.max_iterations = 1
        raised(uem.ConvergenceError, "no convergence", lambda: troubled.problem.solve(fraction=0.9))
        troubled.problem.max_iterations = 25
        for upset in (straight, troubled):
            upset.problem.solve(fraction=0.3)
        assert highest(COMM, np.abs(straight.u.x.array - troubled.u.x.array)) < 1e-9
        for name, f in straight.law.history.items():
            assert highest(COMM, np.abs(f.x.array - troubled.law.history[name].x.array)) < 1e-8
        assert straight.figures() == pytest.approx(troubled.figures(), rel=1e-8)
    assert straight.law.dissipation() > 0


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
@pytest.mark.slow
def test_impact_on_a_wall(coupling):
    """A body flies against a block that does not yield and flattens: momentum changes by the impulse, no energy is made."""
    law = Thrown(coupling)
    with uem.EnergyBook(law.problem) as book:
        for _ in uem.time_steps(law.problem, 0.02, 0.4):
            book.write()
    first, last = book.rows[0], book.rows[-1]
    assert last.dissipated > 0.3 * first.kinetic
    assert all(b.dissipated >= a.dissipated for a, b in zip(book.rows, book.rows[1:]))
    assert max(abs(row.defect) for row in book.rows) < 0.02 * first.kinetic
    momenta = np.array(book.momenta)
    assert np.abs(momenta - momenta[0]).max() < 1e-8 * np.abs(momenta[0]).max()


class Thrown:
    """A plastic body that flies against a heavy one at rest."""

    def __init__(self, coupling: str):
        low = box("quadrilateral", [-0.3, -1.0], [0.8, 0.0], [4, 5])
        high = box("quadrilateral", [0.0, 0.01], [0.5, 1.01], [3, 6])
        self.s = s = scene(COMM, "quadrilateral", [low, high])
        V, S = compat.function_space(s.mesh, 1, (2,)), compat.function_space(s.mesh, ("DG", 0))
        u, velocity, strength = fem.Function(V), fem.Function(V), fem.Function(S)
        velocity.x.array.reshape(-1, 2)[V.tabulate_dof_coordinates()[: len(u.x.array) // 2, 1] > 0.005] = [0.0, -1.0]
        strength.x.array[compat.cell_dofs(S)[:, 0]] = np.array([np.inf, FY])[s.body]
        self.law = uem.FinitePlasticity(u, E, NU, strength, H / 10, kind="plane_strain")
        contact = uem.Contact(s.tag("nose", 1, at(1, 0.01)), s.tag("wall", 0, at(1, 0.0)), coupling=coupling, friction=0.1)
        dynamics = uem.Dynamics(uem.consistent_mass(V, 1.0), velocity=velocity)
        F = self.law.residual(ufl.TestFunction(V))
        self.problem = uem.UnitedProblem(F, u, contacts=[contact], materials=[self.law], dynamics=dynamics)


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given, words",
    [
        ({"kind": "plane_stress"}, ("kind = 'plane_stress'", "'3d', 'plane_strain' or 'axisymmetric'")),
        ({"kind": "3d"}, ("kind = '3d'", "2 components")),
        ({"kind": "axisymmetric"}, ("kind = 'axisymmetric'", "uem.axisymmetric(mesh)")),
        ({"E": 0.0}, ("E = 0.0", "a positive number")),
        ({"nu": 0.5}, ("nu = 0.5", "between -1 and 0.5")),
        ({"yield_stress": -1.0}, ("yield_stress = -1.0", "a positive number, or infinity")),
        ({"yield_stress": [(0.1, 1.0), (0.2, 2.0)]}, ("yield_stress = [(0.1, 1.0)", "strains from 0 upwards")),
        ({"yield_stress": [(0.0, 2.0), (0.2, 1.0)]}, ("yield_stress = [(0.0, 2.0)", "not falling")),
        ({"yield_stress": [1.0, 2.0]}, ("yield_stress = [1.0, 2.0]", "pairs")),
        ({"yield_stress": [("soft", 2.0)]}, ("yield_stress = [('soft', 2.0)]", "pairs")),
        ({"hardening": -1.0}, ("hardening = -1.0", "0 or a positive number")),
        ({"yield_stress": [(0.0, 1.0)], "hardening": uem.Voce(1.0, 0.1)}, ("hardening = a Voce", "0 or a positive number")),
    ],
)
def test_bad_input_is_refused(given, words):
    _, u = block(COMM, "quadrilateral")
    good = {"E": E, "nu": NU, "yield_stress": FY, "kind": "plane_strain"}
    error = uem.InputTypeError if "Voce" in words[0] or "soft" in words[0] else uem.InputError
    refused(error, words, lambda: uem.FinitePlasticity(u, **good | given))


def test_bad_saturation_is_refused():
    for given, words in (((0.0, 0.1), "increase = 0.0"), ((1.0, -0.1), "strain = -0.1"), ((1.0, 0.1, -1.0), "slope = -1.0")):
        refused(uem.InputError, words, lambda given=given: uem.Voce(*given))


def test_a_body_turned_inside_out_is_refused_by_all_ranks():
    _, u = block(COMM, "hexahedron", 3)
    material = uem.FinitePlasticity(u, E, NU, FY)
    for bad in (np.nan, -2.0, 1e200):
        deform(u, (bad if COMM.rank == COMM.size - 1 else 0.0) * np.eye(3))
        raised(uem.NotFiniteError, "cell at", material.update)
    u.x.array[:] = 0.0
    material.update()
    assert highest(COMM, np.abs(material.stress.x.array)) <= 0.0
