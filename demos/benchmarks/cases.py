"""What a case of the stability table is: bodies made of boxes, a method to be tried on them, and figures with their tolerances.

Every figure is an error against an answer known otherwise: a closed form, or the conditions of contact themselves, which are read
from the residual of the bodies and not from the method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from benchmarks import methods
from benchmarks.scenes import NU, Array, Ints, Scene, at, box, clamp, scene

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD

#: What counts as right, for all methods alike: forces and works to 1 %, overlaps to 1e-3 of the smallest element at the contact.
FORCE, OVERLAP, BALANCE = 1e-2, 1e-3, 1e-3
#: A method does not converge if it has spent more Newton iterations than this for each planned load step, or more time steps than this
#: times the planned ones, and is not at the end.
PATIENCE = 20
#: Newton iterations that a cut step has spent.
LOST = 50


class NotApplicable(Exception):
    """A method does not have what a case is about."""


@dataclass(frozen=True)
class Check:
    """A figure measured: an error without dimension, what it may be, and what it is the error of."""

    what: str
    value: float
    tolerance: float

    @property
    def severity(self) -> float:
        """Value over tolerance; infinite if it is no number."""
        return float(abs(self.value) / self.tolerance) if np.isfinite(self.value) else np.inf


@dataclass(frozen=True)
class Column:
    """A method with its setting.

    Attributes:
        name: of the column.
        method: as ``methods.create`` knows it.
        factor: of the parameter: of E/h, or of the size of an element for a distance.
        stiffer: whether E is that of the stiffer body.
        words: of the setting, for the head of the table.
    """

    name: str
    method: str
    factor: float = 0.0
    stiffer: bool = False
    words: str = ""

    def parameter(self, E: Sequence[float], h: float) -> float | None:
        """Parameter in a scene with these moduli and this size of the elements at the contact."""
        if self.method == "barrier":
            return self.factor * h
        return self.factor * (max(E) if self.stiffer else min(E)) / h if self.factor else None


COLUMNS = (
    Column("united", "united", words="nodes on facets"),
    Column("mortar", "mortar", words="integrals over facets"),
    Column("penalty", "penalty", 10.0, words="10 E/h of the softer body"),
    Column("penalty_stiff", "penalty", 100.0, True, "100 E/h of the stiffer body"),
    Column("penalty_surface", "penalty_surface", 10.0, words="10 E/h of the softer body"),
    Column("surface_stiff", "penalty_surface", 100.0, True, "100 E/h of the stiffer body"),
    Column("lagrange", "lagrange"),
    Column("augmented", "augmented", 10.0, words="10 E/h of the softer body"),
    Column("barrier", "barrier", 1e-3, words="distance 1e-3 h"),
)


@dataclass
class Trial:
    """A method on its way through a case; it counts what the case costs.

    Attributes:
        column: the method and its setting.
        iterations: Newton iterations of all problems so far.
        checks: figures so far.
    """

    column: Column
    iterations: int = 0
    checks: list[Check] = field(default_factory=list)

    def create(self, F: ufl.Form, u: fem.Function, E: Sequence[float], h: float, **options: Any) -> uem.UnitedProblem:
        """A problem in which this method makes the contact.

        Args:
            F: residual.
            u: displacement.
            E: moduli of the bodies.
            h: size of the elements at the contact.
            options: of ``UnitedProblem``.
        """
        options.setdefault("petsc_options_prefix", "stability_")
        options.setdefault("rtol", 1e-10 if self.column.method in methods.OWN else 1e-8)
        return methods.create(self.column.method, F, u, parameter=self.column.parameter(E, h), **options)

    def load(self, problem: uem.UnitedProblem, steps: int = 1) -> None:
        """Load a problem in steps."""
        for _ in self.load_steps(problem, steps):
            pass

    def load_steps(self, problem: uem.UnitedProblem, steps: int) -> Iterator[uem.LoadStep]:
        """Load steps, counted."""
        spent = 0
        for step in uem.load_steps(problem, steps):
            self.iterations += step.newton_iterations
            # a step that was cut has spent its iterations in vain
            spent += step.newton_iterations + LOST * step.cuts
            yield step
            self._give_up(spent > PATIENCE * (steps + 4) and step.number > steps, step.number, steps)

    def time_steps(self, problem: uem.UnitedProblem, dt: float, end: float, event: float | None) -> Iterator[uem.TimeStep]:
        """Time steps, counted."""
        steps = round(end / dt)
        for step in uem.time_steps(problem, dt, end, event_tolerance=event):
            self.iterations += step.newton_iterations
            yield step
            self._give_up(step.number > PATIENCE * (steps + 4), step.number, steps)

    @staticmethod
    def _give_up(hopeless: bool, number: int, planned: int) -> None:
        if hopeless:
            raise uem.ConvergenceError(f"given up after {number} steps instead of {planned}, cut for want of convergence")

    def check(self, what: str, value: float, tolerance: float) -> None:
        """Note a figure; all ranks must know the same."""
        self.checks.append(Check(what, float(value), tolerance))

    def about(self, words: str, start: int) -> None:
        """Say of the checks since ``start`` which variant of the scene they are of."""
        self.checks[start:] = [replace(c, what=f"{c.what} ({words})") for c in self.checks[start:]]


@dataclass(frozen=True)
class Case:
    """A row of the table.

    Attributes:
        name: of the row.
        what: is tried, in words.
        run: notes the figures of a trial.
        quick: whether the short table has it.
        moving: whether it steps through time.
    """

    name: str
    what: str
    run: Callable[[Trial], None]
    quick: bool = True
    moving: bool = False


def judge(case: Case, column: Column) -> dict[str, Any]:
    """Cell of the table: verdict, worst figure and what it is (collective)."""
    trial = Trial(column)
    cell: dict[str, Any] = {"case": case.name, "method": column.name}
    try:
        if not methods.available(column.method):
            raise NotApplicable("ipctk is not installed")
        if column.method == "barrier" and (COMM.size > 1 or case.moving):
            raise NotApplicable("the barrier is serial and static")
        case.run(trial)
        worst = max(trial.checks, key=lambda check: check.severity)
        cell |= {
            "verdict": "correct" if worst.severity <= 1.0 else "wrong",
            "figure": worst.value if np.isfinite(worst.value) else str(worst.value),
            "what": worst.what,
            "tolerance": worst.tolerance,
        }
    except NotApplicable as reason:
        cell |= {"verdict": "not applicable", "figure": str(reason), "what": "", "tolerance": None}
    except uem.UEMError as error:
        cell |= {"verdict": "named error", "figure": type(error).__name__, "what": str(error), "tolerance": None}
    except Exception as error:
        cell |= {"verdict": "wrong", "figure": type(error).__name__, "what": str(error), "tolerance": None}
    forms.free_petsc_garbage(COMM)
    return cell | {"iterations": trial.iterations}


# -- bodies --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Box:
    """Box ``[lo, hi]`` with ``n`` divisions in each direction, of Young's modulus E."""

    lo: Sequence[float]
    hi: Sequence[float]
    n: Sequence[int]
    E: float = 1.0


class BoxScene(Scene):
    """Boxes in one mesh, whose surfaces are found by their places in the drawing, before it is bent, turned and scaled.

    Args:
        boxes: the bodies; they share no nodes.
        cell: kind of all cells.
        pose: where the drawing's nodes ``(n, gdim)`` of each body, by its number, start.
        nu: Poisson's ratio.
        law: of the bodies.
        degree: of the displacement.
    """

    def __init__(
        self,
        boxes: Sequence[Box],
        cell: str = "quadrilateral",
        pose: Callable[[Array, int], Array] | None = None,
        nu: float = NU,
        law: type[Any] = uem.LinearElastic,
        degree: int = 1,
    ):
        self.boxes, self.g = list(boxes), len(boxes[0].lo)
        parts = [box(cell, b.lo, b.hi, b.n) for b in boxes]
        bodies = np.split(np.arange(sum(len(part.x) for part in parts)), np.cumsum([len(part.x) for part in parts])[:-1])

        def posed(x: Array) -> Array:
            return x if pose is None else np.concatenate([pose(x[nodes], k) for k, nodes in enumerate(bodies)])

        made = scene(COMM, cell, parts, pose=posed)
        super().__init__(made.mesh, made.drawing, made.body)
        self.V = compat.function_space(self.mesh, degree, (self.g,))
        self.u = fem.Function(self.V, name="displacement")
        self.E = fem.Function(compat.function_space(self.mesh, ("DG", 0)), name="E")
        self.E.x.array[compat.cell_dofs(self.E.function_space)[:, 0]] = np.array([box.E for box in boxes])[self.body]
        self.material = law(self.E, nu, kind="plane_strain" if self.g == 2 else "3d")
        self.F = self.material.residual(self.u, ufl.TestFunction(self.V)) * ufl.dx(degree=2 * degree)
        self.bcs: list[fem.DirichletBC] = []
        self.contacts: list[uem.Contact] = []

    @property
    def moduli(self) -> list[float]:
        """Young's moduli of the bodies."""
        return [box.E for box in self.boxes]

    def side(self, body: int, axis: int, end: int, within: Callable[[Array], npt.NDArray[np.bool_]] | None = None) -> uem.Tag:
        """Facets of a body on its lower (0) or upper (1) end along an axis, as a tag.

        Args:
            body: its number.
            axis: number of the coordinate.
            end: 0 or 1.
            within: places of the drawing ``(n, gdim)`` that count; None takes all.
        """
        lo, hi = self.boxes[body].lo, self.boxes[body].hi
        value = (lo, hi)[end][axis]
        on = at(axis, value, 1e-9 * max(abs(value), hi[axis] - lo[axis]))
        where = on if within is None else lambda x: on(x) & within(x)
        return self.tag(f"body_{body + 1}_{'xyz'[axis]}{end}", body, where, 10 * body + 2 * axis + end + 1)

    def hold(self, tag: uem.Tag, *components: int, value: float | npt.ArrayLike = 0.0) -> None:
        """Prescribe components of the displacement on a tag; a vector prescribes all."""
        self.bcs += clamp(self.V, tag, *components, value=value)

    def rollers(self, *bodies: int) -> None:
        """Hold the sides of bodies, all when none is named, as an oedometer does."""
        for body in bodies or range(len(self.boxes)):
            for axis in range(self.g - 1):
                for end in (0, 1):
                    self.hold(self.side(body, axis, end), axis)

    def push(self, tag: uem.Tag, traction: Sequence[float]) -> None:
        """Load a surface by a force per reference area."""
        v = ufl.TestFunction(self.V)
        self.F -= ufl.inner(ufl.as_vector(list(traction)), v) * forms.surface_measure(self.mesh, tag.entities)

    def weigh(self, body: int, force: Sequence[float]) -> None:
        """Load a body by a force per reference volume."""
        v = ufl.TestFunction(self.V)
        self.F -= ufl.inner(ufl.as_vector(list(force)), v) * self.part(body)

    def volume(self, body: int) -> float:
        """Reference volume of a body (collective)."""
        return forms.assemble_scalar(forms.form(fem.Constant(self.mesh, 1.0) * self.part(body)), COMM)

    def part(self, body: int) -> Any:
        """Integration measure over a body."""
        return forms.cell_measure(self.mesh, np.flatnonzero(self.body == body).astype(np.int32))

    def unite(self, contactor: uem.Tag, target: Any, **options: Any) -> uem.Contact:
        """Let two surfaces touch."""
        self.contacts.append(uem.Contact(contactor=contactor, target=target, **options))
        return self.contacts[-1]

    def unite_both(self, trial: Trial, one: uem.Tag, other: uem.Tag) -> None:
        """Let two surfaces touch, each contactor and target; mortar, which is exact so, in one pass."""
        self.unite(one, other)
        if trial.column.method != "mortar":
            self.unite(other, one)

    def solve(self, trial: Trial, h: float, steps: int = 1, **options: Any) -> uem.UnitedProblem:
        """Set the problem up for a method and load it."""
        problem = trial.create(self.F, self.u, self.moduli, h, bcs=self.bcs, contacts=self.contacts, **options)
        trial.load(problem, steps)
        return problem

    # -- what the bodies themselves say ------------------------------------------------------------------------------------------

    def nodes(self, tag: uem.Tag) -> Ints:
        """Nodes of a tag that this rank owns ``(n,)``."""
        nodes = np.asarray(fem.locate_dofs_topological(self.V, tag.dim, tag.entities), dtype=np.int64)
        return nodes[nodes < self.V.dofmap.index_map.size_local]

    def nodes_of(self, body: int) -> Ints:
        """Nodes of a body on this rank, ghosts included ``(n,)``."""
        return np.unique(compat.cell_dofs(self.V)[self.body == body])

    def residual(self) -> Array:
        """Internal minus external forces of the owned nodes ``(n_owned, gdim)`` (collective)."""
        b = compat.create_vector(self.V)
        forms.assemble_vector(b, forms.form(self.F))
        return np.array(b.array_r).reshape(-1, self.g)

    def reaction(self, tag: uem.Tag) -> Array:
        """Force of the supports on a tag ``(gdim,)``, from the residual alone (collective)."""
        return np.asarray(COMM.allreduce(self.residual()[self.nodes(tag)].sum(axis=0)))

    def free(self) -> npt.NDArray[np.bool_]:
        """Components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``."""
        n = self.V.dofmap.index_map.size_local * self.g
        free = np.ones(n, dtype=bool)
        for bc in self.bcs:
            dofs, _ = compat.bc_dofs(bc)
            free[dofs[dofs < n]] = False
        return free.reshape(-1, self.g)


def largest(values: npt.ArrayLike) -> float:
    """Largest absolute value over all ranks, 0 if there is none; NaN anywhere is NaN (collective)."""
    return float(np.max(COMM.allgather(np.abs(np.asarray(values, dtype=float)).max(initial=0.0))))
