"""Energy balance: energies, works and momenta of a run after every step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import ufl

from uem_dolfinx import forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.files import given_resume
from uem_dolfinx.form_checks import check_functional, check_linear
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.log import logger
from uem_dolfinx.output.results import contact_suffixes
from uem_dolfinx.output.tables import Closing, CsvTable
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import TimeStep


@dataclass(frozen=True)
class Energies:
    """Energies at an instant and work since the start.

    Attributes:
        time: of the instant.
        kinetic: ``v'Mv / 2``.
        stored: in the bodies' strain.
        dissipated: by plastic flow.
        damped: by the damping form.
        external: work of the external forces, of gravity, of fluids in contacts and of the reactions of Dirichlet conditions.
        contact: work of the contact forces; zero except for friction, rounding, moving rigid targets, forces of preloads, the
            step of first contact, and soft contacts, which store it.
        friction: energy dissipated by friction, and by damping of soft contacts; with fixed targets and hard contact its sum with
            ``contact`` is zero to rounding.
        defect: change of the sum of energies minus the work of the external and contact forces.
    """

    time: float
    kinetic: float
    stored: float
    dissipated: float
    damped: float
    external: float
    contact: float
    friction: float
    defect: float


class EnergyBook(Closing, given.Sealed):
    """Energy balance and momenta, one row per time step, optionally as a CSV file.

    Columns: the fields of ``Energies``, the momentum ``momentum_x`` ..., and for every contact the impulse ``impulse_x`` ... on the
    contactor's body. Works are integrated by the trapezoidal rule. In explicit steps with massy contactors, contact acts on masses for
    the whole step: ``contact`` adds up its work in every step, also between rows, the energy lost in plastic impacts of these masses, and
    rows at both ends of a step give its exact impulse.

    Args:
        problem: with ``dynamics``.
        stored: strain energy of the bodies as a UFL form; the energy of materials with history is added.
        external: virtual work of the external forces as a UFL form, linear in a test function: the terms with a minus sign in F.
            Loads and springs at nodes, fluids in contacts, and linear equations, are included by default.
        path: name of the CSV file; None writes none.
        resume: keep the rows of an existing file up to the present time, and append to them.

    Raises:
        InputError, InputTypeError: for an argument that is no problem, or no form of the required kind.
        SpaceError: if the problem has no dynamics, or a form is of another displacement, space or mesh.
        CheckpointError, OSError: see ``CsvTable``.
    """

    def __init__(
        self,
        problem: UnitedProblem,
        stored: ufl.Form | None = None,
        *,
        external: ufl.Form | None = None,
        path: str | Path | None = None,
        resume: bool = False,
    ):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        if problem.dynamics is None:
            raise SpaceError("EnergyBook needs inertia: give the problem dynamics=Dynamics(mass)")
        self.problem, self.dynamics = problem, problem.dynamics
        with agreed(problem.comm):
            if external is not None:
                check_linear("external", external, problem.u.function_space)
            if stored is not None:
                check_functional("stored", stored, problem.config.mesh)
            if stored is not None and problem.u not in stored.coefficients():
                raise SpaceError("stored does not depend on the problem's displacement: expected the energy of its u")
        works = *(None if work is None else revolved(work) for work in (stored, external)), self.dynamics.damping_form
        self._stored, self._external, self._damping = (None if work is None else forms.form(work) for work in works)
        self.rows: list[Energies] = []  #: Rows written, in order.
        #: Momenta ``(gdim,)`` and impulses on the contactors' bodies ``(n_contacts, gdim)`` of the rows.
        self.momenta: list[Array] = []
        self.impulses: list[Array] = []
        axes, names = "xyz"[: problem.config.gdim], [f.name for f in fields(Energies)]
        self._contacts = [contact for contact in problem.contacts if not contact.is_further_part]
        suffixes = contact_suffixes(self._contacts)
        columns = [*names, *(f"momentum_{a}" for a in axes), *(f"impulse_{a}{s}" for s in suffixes for a in axes)]
        resume_at = self.dynamics if given_resume(resume, problem.comm) else None
        self.table = None if path is None else CsvTable(path, problem.comm, columns, resume_at, whose="an EnergyBook")
        begin = {} if self.table is None else self.table.last
        self._works = np.array([begin.get(name, 0.0) for name in ("damped", "external", "contact")])
        # contacts read from a checkpoint include earlier frictional dissipation
        self._before = begin.get("friction", 0.0) - sum(c.dissipation for c in self._contacts)
        impulse = [begin.get(f"impulse_{a}{s}", 0.0) for s in suffixes for a in axes]
        self._impulse = np.reshape(impulse, (len(suffixes), len(axes)))
        if begin and begin["time"] != self.dynamics.time:
            logger.warning(
                "%s ends at time %.6g and is gone on with at %.6g: the work in between is missing; write a row after every step",
                path, begin["time"], self.dynamics.time,
            )  # fmt: skip
        #: Whether contact strikes masses for whole explicit steps.
        self._strikes = is_explicit(self.dynamics) and self.dynamics.contactors == "massy"
        whole = [] if problem.impacts is None else problem.impacts.pairs
        #: Contacts whose forces act for whole implicit steps ``(n_contacts,)``.
        self._lasting = np.array([any(c.pair.whole is pair for pair in whole) for c in self._contacts], dtype=bool)
        self._spreads = not self.dynamics.accelerated  # whether fluids spread at the start, in no time, before the next row
        # the work of the first step uses the initial load, too
        problem.set_load(self.dynamics.time)
        self._read_forces()
        # the initial sum, for the defect
        if self.table is not None and begin:
            self._first = sum(self.table.first[name] for name in ("kinetic", "stored", "dissipated"))
        else:
            self._first = sum(energies := self._energies())
            self._append(energies)

    def _read_forces(self) -> None:
        """Read the forces and the displacement of this instant (collective)."""
        problem, n = self.problem, self.problem.config.n_owned * self.problem.config.gdim
        u = np.array(problem.config.displacement[: problem.config.n_owned].ravel())
        self._u, self._time, self._driven, self._struck = u, self.dynamics.time, self.dynamics.driven, self.dynamics.struck
        #: Number of steps up to this instant, and the mean velocity of the last one ``(n,)``.
        self._steps, self._rate = problem.step_control.number, np.array(self.dynamics.mean_velocity.x.array[:n])
        forces = np.array([c.force.x.array[:n] for c in self._contacts]).reshape(-1, n)
        contact, lasting = forces[~self._lasting].sum(axis=0), forces[self._lasting].sum(axis=0)
        # the work of supports on mass, with jumps of velocity, is the change of its kinetic energy, see ``driven``
        if (known := problem.bodies.driving) is None:
            problem.bodies.assemble()
            known = problem.bodies.residual.array_r[:n] - self.dynamics.forces.x.array[:n]
        linear = 0.0 if problem.linear is None else problem.linear.forces(problem.linear.multipliers).ravel()
        leaking: list[Any] = [c.pair for c in self._contacts if c.leak is not None and c.on]
        self._fluid = fluid = sum((pair.on_nodes().ravel() for pair in leaking), np.zeros(n))
        held = ~problem.bodies.free[: problem.config.n_owned].ravel()
        reaction = (known[:n] - contact - linear - fluid) * held
        outer = reaction + fluid + self.dynamics.weight() + self._assembled(self._external)
        if problem.bodies.tangent.points is not None:
            outer += problem.bodies.tangent.points.loads().ravel()
        if added := self.dynamics.added:
            # forces of masses at points on their couplings, with the opposite sign
            outer -= self.dynamics.added_forces(carried=True)
        #: Forces from outside on these masses, and their displacements.
        self._at_points = [(one.pushed, one.places) for one in added]
        # what strikes masses works as much as ``struck``: the rest is that of supports, which reactions balance
        contact = held * (contact + linear) if self._strikes else contact
        #: Forces of damping, from outside, of contact, and of equations, from outside as well, then of contact that acts for whole steps,
        #: and of the supports that it presses ``(6, n)``.
        self._forces = np.stack([self._assembled(self._damping), outer, contact, linear + np.zeros(n), lasting, held * -lasting])
        self._resultants = np.array([c.resultant().force for c in self._contacts]).reshape(-1, problem.config.gdim)

    def _assembled(self, form: Any) -> Array:
        """Nodal forces of a compiled linear form at the owned components, zero without one."""
        config = self.problem.config
        if form is None:
            return np.zeros(config.n_owned * config.gdim)
        own = forms.assemble_array(self.problem.u.function_space, form)
        return np.asarray(config.rows(own)[: config.n_owned].ravel())

    def _energies(self) -> tuple[float, float, float]:
        """Energies kinetic, stored and dissipated (collective)."""
        stored = forms.assemble_scalar(self._stored, self.problem.comm) if self._stored is not None else 0.0
        stored += sum(material.energy() for material in self.problem.materials)
        stored += 0.0 if (points := self.problem.bodies.tangent.points) is None else points.energy()
        dissipated = float(sum(material.dissipation() for material in self.problem.materials))
        return self.dynamics.kinetic_energy(), stored, dissipated

    def write(self, step: TimeStep | None = None) -> Energies:
        """Append the present state; call it after every step (collective).

        Args:
            step: the step, not used and optional.

        Returns:
            The new row.
        """
        u, forces, resultants, time, driven, struck = (
            self._u, self._forces, self._resultants, self._time, self._driven, self._struck,
        )  # fmt: skip
        before, rate, steps = self._at_points, self._rate, self.problem.step_control.number - self._steps
        fluid = self._fluid
        self._read_forces()
        # NumPy's sums do not depend on where arrays lie in memory, those of BLAS do
        works, impulse = 0.5 * ((forces + self._forces) * (self._u - u)).sum(axis=1), 0.5 * (resultants + self._resultants)
        if self._spreads:
            works[1] += 0.5 * ((self._fluid - fluid) * (self._u - u)).sum()
            self._spreads = False
        if self._strikes:
            if steps == 1:
                # the forces act between the mean velocities of two steps
                works[3] = 0.5 * self.dynamics.dt * (self._forces[3] * (rate + self._rate)).sum()
                impulse = self._resultants
            works[2] += self._struck - struck - works[3]
        elif steps == 1:
            works[4:] = (self._forces[4:] * (self._u - u)).sum(axis=1)
            works[1:3] += 0.0 if self.problem.impacts is None else self.problem.impacts.excess
            impulse[self._lasting] = self._resultants[self._lasting]
        works[1:3] += self._driven - driven + works[3] + works[5], works[4]
        self._works += reduced(self.problem.comm, works[:3])
        pairs = zip(before, self._at_points)
        self._works[1] += sum(0.5 * float(((push + pushed) * (place - was)).sum()) for (push, was), (pushed, place) in pairs)
        self._impulse += impulse * (self._time - time)
        return self._append(self._energies())

    def _append(self, energies: tuple[float, float, float]) -> Energies:
        damped, external, contact = (float(w) for w in self._works)
        defect = sum(energies) + damped - external - contact - self._first
        friction = self._before + sum(c.dissipation for c in self._contacts)
        row = Energies(self._time, *energies, damped, external, contact, friction, defect)
        self.rows.append(row)
        self.momenta.append(self.dynamics.momentum())
        self.impulses.append(self._impulse.copy())
        if self.table is not None:
            self.table.write([*astuple(row), *map(float, self.momenta[-1]), *map(float, self._impulse.ravel())])
        return row

    def plot(self, panel: Any) -> None:
        """Plot the energies over time in a panel of :func:`uem_dolfinx.figure`; nothing for None, as on ranks other than 0."""
        if panel is None:
            return
        draw_energies(panel, self.columns())

    def columns(self) -> dict[str, Array]:
        """Energies and works of all rows by name ``(n_rows,)``."""
        return {one.name: np.array([getattr(row, one.name) for row in self.rows]) for one in fields(Energies)}

    def close(self) -> None:
        """Close the file."""
        if self.table is not None:
            self.table.close()


def draw_energies(panel: Any, columns: Mapping[str, Array]) -> None:
    """Draw energies and works by name ``(n,)`` over time in a panel, except negligible ones."""
    kept = ("kinetic", "stored", "dissipated", "damped")
    total = sum(columns[name] for name in kept) - columns["external"]
    for name in (*kept, "external", "contact", "friction"):
        if np.abs(columns[name]).max(initial=0.0) > 1e-6 * np.abs(total).max(initial=0.0):
            panel.plot(
                columns["time"], columns[name], label=name, ls="--" if name in ("external", "contact", "friction") else "-"
            )
    panel.plot(columns["time"], total, "k", lw=1.2, label="sum less external work")
    panel.set_xlabel("time")
    panel.set_ylabel("energy")
    panel.grid(alpha=0.25)
    panel.legend(frameon=False, ncol=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
