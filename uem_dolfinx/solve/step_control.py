"""Length of load steps and time steps: halved where a step fails, doubled again up to the nominal one where steps are easy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx import errors
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


#: What a shorter step may mend.
MENDABLE = (
    errors.ConvergenceError, errors.LinearSolveError, errors.NotFiniteError, errors.InvertedElementError,
    errors.TunnellingError, errors.EnergyGivenError, errors.ThrownBodyError, errors.OverdeterminedError,
)  # fmt: skip


class StepControl:
    """Length of the next step, and what is known of the steps before it.

    Args:
        nominal: length of the steps where nothing fails, in load factor or time.

    Attributes:
        longest: bound on the length of the next step.
        number: of steps done.
        largest_energy: largest kinetic energy of the bodies that a time step has been judged by.
    """

    def __init__(self, nominal: float = 1.0):
        self.nominal, self.longest, self.number, self.largest_energy = nominal, np.inf, 0, 0.0
        self._cuts, self._read, self._longest_before = 0, False, np.inf

    def begin(self, nominal: float) -> None:
        """Go on with steps of another nominal length, and say so if it is another than that of the run that is gone on with."""
        if self._read and nominal != self.nominal:
            logger.warning("going on with steps of %.6g; those of the run before the checkpoint were %.6g", nominal, self.nominal)
        self.nominal, self._cuts, self._read = nominal, 0, False

    @property
    def length(self) -> float:
        """Length of the next step, where nothing else ends it."""
        return min(self.longest, self.nominal)

    def shorten(self, length: float, error: errors.UEMError) -> bool:
        """Halve a step of this length that failed.

        Returns:
            Whether to try again: not if the error has nothing to do with the length, or if the step would become too short.
        """
        mendable = isinstance(error, MENDABLE)
        if not mendable or 0.5 * length < SHORTEST_LENGTH * self.nominal:
            if mendable:
                error.amend(f"shorter steps, down to {length:.3g}, are no better")
            self.give_up()
            return False
        self.longest, self._cuts = 0.5 * length, self._cuts + 1
        logger.info("step %d failed (%s); cut to %.3g", self.number + 1, error, self.longest)
        return True

    def give_up(self) -> None:
        """After a step that fails for good, make the next one as long as that one was meant to be."""
        self.longest = self._longest_before

    def done(self, iterations: Sequence[object]) -> tuple[int, int]:
        """Count a step that converged with this history; returns its number and how often it had been cut."""
        if len(iterations) - 1 <= EASY:
            self.longest *= 2.0
        self._longest_before = self.longest
        cuts, self._cuts, self.number = self._cuts, 0, self.number + 1
        return self.number, cuts

    def to_checkpoint(self) -> dict[str, Any]:
        """Numbers that a run goes on from, by name."""
        kept = {"steps done": self.number, "longest step": self.longest, "largest energy": self.largest_energy}
        return kept | {"nominal length": self.nominal}

    def from_checkpoint(self, kept: dict[str, Any]) -> None:
        """Go on from what ``to_checkpoint`` returned; other numbers may stand beside them."""
        self.number, self.longest, self.largest_energy, self.nominal = (kept[name] for name in self.to_checkpoint())
        self._read, self._longest_before = True, self.longest
