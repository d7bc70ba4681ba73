"""error_estimate: the error of a solution by its mesh, in the energy norm; ErrorLimit, a bound on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, given
from uem_dolfinx.accuracy.enriched import Enriched, FewFacets, energy, narrow_contacts, warn_of_few_facets
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.bodies import bodies_in_order, body_sums
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: With fewer facets in contact along each direction of the surface, estimates see less than half of the error.
#: [convention; facets; test_adapt.py::test_few_facets_in_contact]
FEWEST = 2
#: Where fewer are, the error is at most so many times the estimate.
#: [convention; estimate; test_adapt.py::test_few_facets_in_contact]
UNRESOLVED = 5.0


By: TypeAlias = Literal["residual", "recovery"]
WAYS: tuple[By, ...] = ("residual", "recovery")


@dataclass(frozen=True)
class ErrorEstimate:
    """An estimate of the error by the mesh, in the energy norm ``sqrt(e' K e)`` of displacements or the same norm of stresses.

    Attributes:
        total: of all bodies, the root of a work.
        norm: energy norm of the displacement itself, ``sqrt(u' K u)``.
        of_bodies: estimate of each body ``(n_bodies,)``, in the order in which their cells come in the mesh's input.
        cells: estimate of each cell, a Function that is constant in cells, for files and pictures.
        shares: squared estimates of this rank's cells ``(n_owned_cells,)``.
        narrow: contacts of fewer than ``FEWEST`` facets along each direction, where the estimate is only a part of the error.
    """

    total: float
    norm: float
    of_bodies: Array
    cells: fem.Function = field(repr=False)
    shares: Array = field(repr=False)
    narrow: list[FewFacets] = field(default_factory=list, repr=False)

    @property
    def relative(self) -> float:
        """Estimate over the norm of the displacement; NaN without displacement."""
        return self.total / self.norm if self.norm else float("nan")

    @property
    def at_most(self) -> float:
        """The value that a tolerance bounds: ``relative``, or ``UNRESOLVED`` times as much where few facets are in contact."""
        return self.relative * (UNRESOLVED if self.narrow else 1.0)

    def __str__(self) -> str:
        """The estimate in per cent."""
        return f"error by the mesh: {100 * self.relative:.3g} %"


def error_estimate(problem: UnitedProblem, by: By = "residual") -> ErrorEstimate:
    """Estimate the error of a solution by its mesh (collective).

    By default the residual of the solution is evaluated in a space of one degree more, with the contact tractions on both sides; see
    ``accuracy.enriched``. By recovery the stress is compared with polynomials that are fitted to it in patches of cells; see
    ``accuracy.recovered``. Any law, with history too, large strain and sliding, friction, and both couplings are included. The
    estimate is of the last step alone; errors of earlier steps in a history, and of steps of time, are not included. It warns where
    fewer than ``FEWEST`` facets are in contact along a direction: the error may then be ``UNRESOLVED`` times as large.

    Args:
        problem: in equilibrium, as ``solve`` or a step leaves it; in statics for ``"residual"``.
        by: ``"residual"``; or ``"recovery"``, which needs the stress alone, so that dynamics, mixed fields and equations are included.

    Returns:
        The estimate, in total, by body and by cell.

    Raises:
        InputError, InputTypeError: for other objects and scalar fields; by the residual for dynamics, mixed fields, or equations
            between nodes; by recovery where a body has too few cells.

    Example:
        ::

            problem.solve()
            estimate = uem.error_estimate(problem)
            print(estimate)
            uem.plot_scene(problem, field=estimate.cells)
    """
    estimate = estimated(problem, by)
    warn_of_few_facets(estimate.narrow, f"the error may be {UNRESOLVED:g} times the estimate")
    return estimate


def estimated(problem: UnitedProblem, by: By = "residual") -> ErrorEstimate:
    """As ``error_estimate``, without its warning (collective)."""
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        given.word("by", by, WAYS)
        refuse_estimate(problem, by)
    config = problem.config
    with timed("estimate errors"):
        if by == "residual":
            squared = Enriched(problem).energies()
        else:
            from uem_dolfinx.accuracy.recovered import Recovered

            squared = Recovered(problem).energies()
        body, count = bodies_in_order(config)
        of_cells = body[compat.cell_dofs(config.V)[: len(squared), 0]]
        sums = body_sums(config.comm, squared[:, None], of_cells, count)[:, 0]
        cells = fem.Function(compat.function_space(config.mesh, ("DG", 0)), name="error_estimate")
        cells.x.array[: len(squared)] = np.sqrt(squared)
        cells.x.scatter_forward()
    total, norm = float(np.sqrt(sums.sum())), float(np.sqrt(energy(problem)))
    return ErrorEstimate(total, norm, np.sqrt(sums), cells, squared, narrow_contacts(problem, FEWEST))


def refuse_estimate(problem: UnitedProblem, by: By = "residual") -> None:
    """Refuse problems without a stress, and by the residual those whose residual is more than a form of the displacement."""
    alone = by == "residual"
    for present, what in (
        (not problem.config.moves or (alone and problem.config.unknowns.mixed), "other fields than a displacement"),
        (alone and problem.dynamics is not None, "inertia"),
        (alone and bool(problem.equations), "equations between nodes"),
        (alone and any(one.distribute for one in problem.couplings), "couplings that distribute forces"),
        (
            alone and bool(problem.points) and problem.config.degree > 1,
            "forces or springs at points, which are nodes of degree 2",
        ),
        (alone and problem.bodies.dead is not None, "forces that a step has not released yet"),
    ):
        if present:
            other = '; error_estimate(problem, by="recovery") needs the stress alone' if problem.config.moves else ""
            raise InputError(
                f"the problem has {what}: an estimate of its error expects forms of a displacement alone, in statics{other}"
            )
    if not problem.progress.steps:
        raise InputError("the problem has no step yet: expected a solution, whose error is estimated")


@dataclass
class ErrorLimit:
    """Warns when the estimated mesh error of a load step first exceeds a bound, with the position of the largest share.

    Args:
        bound: on the estimate over the displacement, in the energy norm; 0.05 is 5 %.
        by: see ``error_estimate``.

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
    by: By = "residual"
    found: list[float] = field(default_factory=list, init=False)
    exceeded: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.bound = given.number("bound", self.bound, given.between(0.0, 1.0))
        given.word("by", self.by, WAYS)

    def __call__(self, problem: UnitedProblem) -> None:
        """Estimate the error of the committed step of a problem, and warn (collective)."""
        if problem.bodies.dead is not None:
            self.found.append(float("nan"))
            return
        estimate = estimated(problem, self.by)
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
