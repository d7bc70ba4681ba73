"""Load steps that fail at a limit point, the largest load that the bodies bear: explanations and remedies in their errors.

Newton's method finds no equilibrium beyond a limit point, even with short steps: contactors cycle, cells are inverted or bodies flow away,
with any mesh. It differs from other failures by negative eigenvalues of the constrained matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uem_dolfinx import compat
from uem_dolfinx.errors import ConvergenceError, InvertedElementError, NotFiniteError, UEMError
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.solve.problem import UnitedProblem

#: Errors at a limit point.
FAILURES = (ConvergenceError, InvertedElementError, NotFiniteError)
#: The remedy if no static path continues.
IN_TIME = "give them a mass and take time steps"
#: The remedies on a path with decreasing load.
WAYS_ON = "prescribe a displacement, or use load_steps(..., arc_length=True); where the bodies jump, give them a mass and take time steps"


class LimitPoint:
    """Data of a failed load step, or step of an ``arc``, before the committed state is restored (collective)."""

    def __init__(self, problem: UnitedProblem, arc: bool):
        self._problem, self._arc, self._motions = problem, arc, problem.rigid_motions()
        solver = problem.solver
        #: Whether the constrained matrix of the last attempt had a negative eigenvalue; False if unknown.
        self.indefinite = bool(solver.indefinite or solver.negative)
        self._loose = self._may_slide()

    def name(self, error: UEMError, reached: float, unstable: float | None) -> None:
        """Add to an error that there may be no equilibrium beyond; the committed state must be restored (collective).

        Args:
            error: of the last attempt.
            reached: load factor of the committed state.
            unstable: the last load factor with an unstable equilibrium, or None.
        """
        by_load = not self._arc and not self._is_led()
        # a known cause replaces advice on meshes and numbers of iterations
        known = isinstance(error, ConvergenceError) and (unstable is not None or self.indefinite) and by_load
        if unstable is not None:
            on = f"there: {WAYS_ON}" if by_load else f"there, and there may be no static path beyond; {IN_TIME}"
            error.amend(
                f"at the load factor {unstable:.4g} the equilibrium was unstable, as the united matrix had negative eigenvalues: the "
                f"bodies buckle or snap {on}",
                instead=known,
            )
        elif by_load and reached > 0.0 and isinstance(error, FAILURES):
            seen = ", and beyond it the united matrix has negative eigenvalues: it may be" if self.indefinite else "; if it is"
            error.amend(
                f"{reached:.4g} is the last load factor with an equilibrium{seen} the largest that the bodies bear (a limit point)"
                f"{': ' if self.indefinite else ', '}{WAYS_ON}",
                instead=known,
            )
        if self._loose and not known and isinstance(error, ConvergenceError):
            error.amend(
                "contact without friction is all that holds a body, which may slide or roll there almost freely: hold it by a Dirichlet "
                "condition or by friction, or let it come to rest with a decaying drag"
            )

    def _may_slide(self) -> bool:
        """Whether conditions leave a body several motions that only contact without friction resists (collective)."""
        floating = getattr(self._problem.system, "floating", None)
        if floating is None or floating.motions is None or any(pair.friction is not None for pair in self._problem.pairs):
            return False
        # each column is of one body
        motions = floating.motions.open_motions(None).tocsc()
        body = motions.indices[motions.indptr[:-1]] // floating.motions.n_modes
        return len(np.unique(body)) < len(body)

    def _is_led(self) -> bool:
        """Whether Dirichlet values or rigid surfaces move with the load factor (displacement control)."""
        problem = self._problem
        wanted = np.array(problem.committed)
        compat.set_bc_values(wanted, problem.bodies.bcs)
        wanted = problem.bodies.of_owners(wanted)
        moved = any(a is not b for a, b in zip(self._motions, problem.rigid_motions()))
        return bool(reduced(problem.comm, int(moved or not np.array_equal(wanted, problem.committed))))
