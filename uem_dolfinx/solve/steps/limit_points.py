"""Load steps that fail where the load is the largest that the bodies bear: what their errors say of it, and which ways lead on.

Newton's method finds no equilibrium beyond a limit point, however short the steps: contactors change sides for ever there, cells turn
inside out or bodies flow away, whatever the mesh. The united matrix, which has negative eigenvalues beyond, tells it from other failures.
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
#: The remedy where no static path continues.
IN_TIME = "give them a mass and take time steps"
#: The remedy on a path on which the load falls.
WAYS_ON = "prescribe a displacement, or use load_steps(..., arc_length=True); where the bodies jump, give them a mass and take time steps"


class LimitPoint:
    """What is known of a load step that has failed for good, before the problem is back in its committed state (collective).

    Args:
        problem: as the last attempt has left it.
        arc: whether steps of given arc length were taken.
    """

    def __init__(self, problem: UnitedProblem, arc: bool):
        self._problem, self._arc, self._motions = problem, arc, problem.rigid_motions()
        solver = problem.solver
        #: Whether the united matrix of the last attempt had a negative eigenvalue, as far as the solver tells.
        self.indefinite = bool(solver.indefinite or solver.negative)

    def name(self, error: UEMError, reached: float, unstable: float | None) -> None:
        """Say in an error that there may be no equilibrium farther on; the problem is in its committed state again (collective).

        Args:
            error: of the last attempt.
            reached: load factor of the committed state.
            unstable: the last one at which an equilibrium was unstable.
        """
        by_load = not self._arc and not self._is_led()
        # an answer that is known takes the place of advice on meshes and numbers of iterations
        known = isinstance(error, ConvergenceError) and (unstable is not None or self.indefinite) and by_load
        if unstable is not None:
            on = f"there: {WAYS_ON}" if by_load else f"there, and no static path may go on; {IN_TIME}"
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

    def _is_led(self) -> bool:
        """Whether displacements that change with the load factor lead the bodies: Dirichlet values, or those of rigid surfaces."""
        problem = self._problem
        wanted = np.array(problem.committed)
        compat.set_bc_values(wanted, problem.bodies.bcs)
        wanted = problem.bodies.of_owners(wanted)
        moved = any(a is not b for a, b in zip(self._motions, problem.rigid_motions()))
        return bool(reduced(problem.comm, int(moved or not np.array_equal(wanted, problem.committed))))
