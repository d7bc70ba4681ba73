"""ErrorLimit: a bound on the estimated error of every load step."""

from __future__ import annotations

from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, given
from uem_dolfinx.accuracy.estimate import UNRESOLVED, ErrorEstimate, estimated
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


@dataclass
class ErrorLimit:
    """Warns where the estimated error of a load step, by the mesh, comes to exceed a bound, with the place of the largest share.

    Args:
        bound: on the estimate over the displacement, in the energy norm; 0.05 is 5 %.

    Attributes:
        found: estimated error of every step so far; NaN without displacement, and while a step releases forces.
        exceeded: whether the last one exceeds the bound; where few facets are in contact, ``UNRESOLVED`` times the estimate.

    Raises:
        InputError, InputTypeError: for bounds that are not between 0 and 1; and in steps for problems that ``error_estimate`` refuses.

    Example:
        ::

            limit = uem.ErrorLimit(0.05)
            for step in uem.load_steps(problem, 10, estimate=limit):
                print(step.factor, limit.found[-1])
    """

    bound: float
    found: list[float] = field(default_factory=list, init=False)
    exceeded: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.bound = given.number("bound", self.bound, given.between(0.0, 1.0))

    def __call__(self, problem: UnitedProblem) -> None:
        """Estimate the error of the committed step of a problem, and warn (collective)."""
        if problem.bodies.dead is not None:
            self.found.append(float("nan"))
            return
        estimate = estimated(problem)
        self.found.append(estimate.relative)
        below, self.exceeded = not self.exceeded, estimate.at_most > self.bound
        if below and self.exceeded:
            x = ", ".join(f"{c:.4g}" for c in _worst(problem, estimate))
            few = f", and may be {UNRESOLVED:g} times as large, since few facets are in contact" if estimate.narrow else ""
            logger.warning(
                "the estimated error by the mesh is %.3g %% of the displacement in the energy norm%s; the bound is %.3g %%, and most of it "
                "is in a cell at (%s): refine the mesh there, or let adapt do so",
                100 * estimate.relative, few, 100 * self.bound, x,
            )  # fmt: skip


def _worst(problem: UnitedProblem, estimate: ErrorEstimate) -> np.ndarray:
    """Middle of the cell with the largest share ``(gdim,)`` (collective)."""
    mesh, shares = problem.config.mesh, estimate.shares
    largest = float(shares.max(initial=0.0))
    place = np.full(problem.config.gdim, np.inf)
    if largest == reduced(mesh.comm, largest, op=MPI.MAX):
        nodes = compat.geometry_dofs(mesh)[int(np.argmax(shares))] if len(shares) else []
        place = mesh.geometry.x[nodes].mean(axis=0)[: len(place)]
    places = [tuple(one) for one in mesh.comm.allgather(place)]
    return np.array(min(places))
