"""Length of load steps and time steps: halved on failure, doubled after easy steps, up to the nominal length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import errors
from uem_dolfinx.arrays import Array
from uem_dolfinx.dynamics.scheme import MOST_GIVEN, SHORTEST_GIVEN, is_explicit
from uem_dolfinx.log import logger

#: A step may be cut to this part of its nominal length.
#: [convention; nominal length; test_step_control.py::test_steps_are_cut_ten_times]
SHORTEST_LENGTH = 1.0 / 1024
#: A step that needs no more linear solves than this is easy: the next one may be twice as long.
#: [convention; linear solves; test_step_control.py::test_easy_steps_are_doubled]
EASY = 6
#: What is left to the end, or to a multiple of the nominal length, is rounding below this part of it.
#: [convention; nominal length; test_thresholds_motion.py::test_no_step_for_rounding]
REMAINDER = 1e-9
#: Two attempts of a step with as many equal iterations, to the last bit, do not depend on its length.
#: [convention; iterations; test_step_control.py::test_attempts_that_repeat]
REPEATED = 3


#: Errors that a shorter step may avoid.
MENDABLE = (
    errors.ConvergenceError, errors.LinearSolveError, errors.NotFiniteError, errors.InvertedElementError,
    errors.TunnellingError, errors.EnergyGivenError, errors.ThrownBodyError, errors.OverdeterminedError, errors.StepAccuracyError,
)  # fmt: skip


class StepControl:
    """Length of the next step, with data of earlier steps.

    Args:
        nominal: length of steps without failures, in load factor or time.

    Attributes:
        longest: bound on the length of the next step.
        number: number of completed steps.
        largest_energy: largest kinetic energy of the bodies in checks of the energy added by contacts.
        largest_speed: largest speed of the bodies in estimates of errors in time, a root of an energy.
        accurate: longest step that errors of the last ones in time let expect to be accurate.
    """

    def __init__(self, nominal: float = 1.0):
        self.nominal, self.longest, self.number, self.largest_energy, self.largest_speed = nominal, np.inf, 0, 0.0, 0.0
        self._cuts, self._read, self._longest_before, self.accurate = 0, False, np.inf, np.inf
        self._failed: list[object] = []  # history of the last attempt of this step, which failed

    def begin(self, nominal: float) -> None:
        """Set the nominal length, with a warning if it differs from the length in a checkpoint."""
        if self._read and nominal != self.nominal:
            logger.warning("continuing with steps of %.6g; the steps before the checkpoint were %.6g", nominal, self.nominal)
        self.nominal, self._cuts, self._read = nominal, 0, False

    def lower(self, nominal: float) -> float:
        """Lower the nominal length to this one, if it is less, within a step; returns the nominal length."""
        self.nominal = min(self.nominal, nominal)
        return self.nominal

    @property
    def cut(self) -> bool:
        """Whether the present step has been cut."""
        return self._cuts > 0

    @property
    def length(self) -> float:
        """Length of the next step, if nothing else limits it."""
        return min(self.longest, self.nominal)

    def shorten(self, length: float, error: errors.UEMError, part: float = 0.5) -> bool:
        """Shorten a step of this length that failed to a part of it.

        Returns whether to try again: not if the error does not depend on the length, or if the step would become too short.
        """
        mendable, before = isinstance(error, MENDABLE), self._failed
        self._failed = getattr(error, "history", [])
        repeats = len(before) >= REPEATED and self._failed == before
        if not mendable or repeats or part * length < SHORTEST_LENGTH * self.nominal:
            if repeats:
                error.amend("shorter steps repeat the same iterations: none of what the step changes has an effect")
            elif mendable:
                error.amend(f"shorter steps, down to {length:.3g}, are no better")
            self.give_up()
            return False
        self.longest, self._cuts = part * length, self._cuts + 1
        logger.info("step %d failed (%s); cut to %.3g", self.number + 1, error, self.longest)
        return True

    def too_much(
        self, given: float, length: float, kinetic: Callable[[], float], held: Callable[[], float] = float
    ) -> str | None:
        """Words for an energy that contacts give the bodies in a step beyond the limit, or None (collective).

        Args:
            given: the energy.
            length: of the step.
            kinetic: returns the kinetic energy of the bodies.
            held: returns other energy at work.
        """
        if given <= MOST_GIVEN * self.largest_energy:
            return None
        self.largest_energy = max(self.largest_energy, kinetic())
        if given <= MOST_GIVEN * (at_work := self.largest_energy + held()):
            return None
        return f"contacts give the bodies {given:.3g} of energy within a step of {length:.3g}, which have {at_work:.3g}"

    def refuse_energy(self, words: str, length: float, again: bool = False) -> None:
        """Refuse a step in which contacts give too much energy, or warn of it where the step is short and not better ``again``."""
        if length > SHORTEST_GIVEN * self.nominal or again:
            raise errors.EnergyGivenError(words)
        logger.warning("%s, and shorter steps are no better: refine the meshes of the surfaces that touch", words)

    def give_up(self) -> None:
        """After a final failure, reset the length to its value before the failed step."""
        self.longest, self._failed = self._longest_before, []

    def done(self, iterations: Sequence[Any], longer: float = 2.0) -> tuple[int, int]:
        """Count a step that converged with this history; returns its number and the number of its cuts.

        Args:
            iterations: the history, of one Newton loop or several, each of which ends without a linear solve.
            longer: by how much the next step may be longer if this one was easy, at least 1.
        """
        solves = len(iterations) - 1
        if solves <= EASY or solves <= EASY * [one.linear_iterations for one in iterations].count(0):
            self.longest *= longer
        self._longest_before, self._failed = self.longest, []
        cuts, self._cuts, self.number = self._cuts, 0, self.number + 1
        return self.number, cuts

    def to_checkpoint(self) -> dict[str, Any]:
        """Numbers for a checkpoint, by name."""
        kept = {"steps done": self.number, "longest step": self.longest, "largest energy": self.largest_energy}
        return kept | {"nominal length": self.nominal, "largest speed": self.largest_speed, "accurate step": self.accurate}

    def from_checkpoint(self, kept: dict[str, Any]) -> None:
        """Restore the numbers of ``to_checkpoint``; other numbers are ignored."""
        # files of earlier versions lack these
        kept = {"largest speed": 0.0, "accurate step": np.inf} | kept
        self.number, self.longest, self.largest_energy = (kept[name] for name in ("steps done", "longest step", "largest energy"))
        self.nominal, self.largest_speed, self.accurate = (
            kept[name] for name in ("nominal length", "largest speed", "accurate step")
        )
        self._read, self._longest_before = True, self.longest


class ExplicitControl(StepControl):
    """Length of explicit steps, with what is known of the critical step and of the cells.

    Args:
        V: space of the displacement.

    Attributes:
        due: number of the step after which the stepper looks at how fast cells are strained.
        known_at: displacement where the critical step was last found, from where strains count.
        resolved: bound on the length of steps that resolve contacts on a stiff surface.
        of_contact: whether contacts change the critical step.
        shortest: height of a cell when the stepper last looked at them, a length.
    """

    def __init__(self, V: fem.FunctionSpace):
        super().__init__()
        self.known_at = fem.Function(V)
        self.due, self.resolved, self.of_contact, self.shortest = 0, np.inf, False, np.inf

    def know(self, displacement: Array) -> None:
        """Note that the critical step is known at this displacement, ghosts included ``(n,)``."""
        self.known_at.x.array[:] = displacement

    def depend(self, of_contact: bool) -> None:
        """Note whether contacts change the critical step."""
        self.of_contact = of_contact

    def resolve(self, length: float) -> float:
        """Lower the bound that resolves contacts to this length, if it is less; returns the bound."""
        self.resolved = min(self.resolved, length)
        return self.resolved

    def looked(self, shortest: float, steps: int = 1) -> None:
        """Note the least height of the cells, and that the next look is due after so many steps, at least one."""
        self.shortest, self.due = shortest, self.number + max(steps, 1)

    def to_checkpoint(self) -> dict[str, Any]:
        """Numbers for a checkpoint, by name."""
        return super().to_checkpoint() | {
            "critical step due": self.due,
            "resolved step": self.resolved,
            "steps of contact": self.of_contact,
            "least height": self.shortest,
        }

    def from_checkpoint(self, kept: dict[str, Any]) -> None:
        """Restore the numbers of ``to_checkpoint``; other numbers are ignored."""
        super().from_checkpoint(kept)
        self.due, self.resolved = kept["critical step due"], kept["resolved step"]
        self.of_contact, self.shortest = kept["steps of contact"], kept["least height"]


def control_of(dynamics: Any, V: fem.FunctionSpace) -> StepControl:
    """Control of the steps of a problem with these dynamics, or None, and a displacement in ``V``."""
    return ExplicitControl(V) if is_explicit(dynamics) else StepControl()
