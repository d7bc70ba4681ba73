"""A decaying drag brings bodies to rest that only contact holds, where rigid motions along their loads have not.

The facets of a bowl are a polygon: on two of its straight sides a body slides or rolls on, and it rests in corners between facets.
Rigid motions to first order and Newton's method, in turn, may go round between such states for ever. The drag
``c_k (u - u_k)`` makes a problem of every step ``k`` that the energy decreases in, as in an overdamped motion; ``c_k`` decays
geometrically, and the last state is an equilibrium without drag.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.arrays import AnyArray, Array
from uem_dolfinx.contact.seam.active_set import GAP_ROUNDING
from uem_dolfinx.errors import ConvergenceError, FloatingBodyError, OverdeterminedError, UEMError
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced

#: All loads move a body against the first drag by this part of its radius. [bound; radius; -]
FIRST_WAY = 0.3
#: The drag of the next step over that of the last one; after a failed step it grows by as much. [bound; drag; -]
DECAY = 0.3
#: Steps in all, and steps that fail among them. [bound; steps; -]
MOST_DRAGGED, MOST_FAILED = 40, 6


class _Drag:
    """Drag at the nodes, up to ``largest (n_owned,)``, with the loads and springs at points of the problem, in the place of these."""

    def __init__(self, problem: Any, largest: Array):
        self._config, self._points, self._largest, self.factor = problem.config, problem.bodies.tangent.points, largest, 1.0
        self._unknowns = self._config.of(np.arange(len(problem.u.x.array)))[: self._config.n_owned]
        self.begin()

    def begin(self) -> None:
        """Begin a step at the present displacement."""
        self.start = np.array(self._config.displacement[: self._config.n_owned])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._points, name)

    def forces(self) -> Array:
        """Drag at the owned nodes ``(n_owned, gdim)``."""
        moved = self._config.displacement[: self._config.n_owned] - self.start
        return np.asarray(self.factor * self._largest[:, None] * moved)

    def add_forces(self, b: AnyArray) -> None:
        """See ``AtPoints``."""
        if self._points is not None:
            self._points.add_forces(b)
        b[self._unknowns] += self.forces()

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """See ``AtPoints``."""
        if self._points is not None:
            self._points.add_stiffness(K)
        diagonal = K.getDiagonal()
        diagonal.array[:] = np.repeat(self.factor * self._largest, self._config.gdim)
        K.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD)
        K.assemble()


def converge_or_rest(problem: Any, start: Array, fraction: float, along: Any, system: Any) -> list[Any]:
    """Converge; if bodies without friction that only contact holds do not come to rest, once more by a decaying drag (collective).

    Surfaces wear by the forces at both ends of the step (Heun's method): it converges once more on the worn ones, but not along an arc.
    Arguments as of ``UnitedProblem.attempt``; raises as the first attempt, if the drag does not bring them to rest, either.
    """
    converge = partial(problem.converge, problem.bodies, system, start, fraction, along)
    try:
        history: list[Any] = converge()
    except (ConvergenceError, FloatingBodyError, OverdeterminedError) as error:
        problem.watch.advise(error)
        may_rest = along is None and not isinstance(error, OverdeterminedError) and _may_rest(problem)
        rested = _rest(problem, converge) if may_rest else None
        if rested is None:
            raise error
        history = rested
    return [*history, *converge()] if along is None and _wear_on(problem.interfaces) else history


def _wear_on(pairs: Sequence[Any]) -> bool:
    """Increase the gaps of all pairs by their depths at the end of the present step; return whether any wear in it (collective).

    Slips of rounding, where all stick, wear nothing.
    """
    wearing = [pair for pair in pairs if pair.friction is not None and pair.friction.wear is not None]
    depths = [pair.friction.worn(pair.trial, pair.committed, pair.kinematics) for pair in wearing]
    some = any(
        (now - p.committed.friction.worn).max(initial=0.0) > GAP_ROUNDING * p.config.size for p, now in zip(wearing, depths)
    )
    if not wearing or not reduced(wearing[0].config.comm, some, op=MPI.LOR):
        return False
    for pair, now in zip(wearing, depths):
        pair.friction.wear.apply(now)
        pair.project()
    return True


def _may_rest(problem: Any) -> bool:
    """Whether only frictionless contact holds a body, in statics; not again in a step that has been cut, as a drag needs no shorter one."""
    floating = getattr(problem.system, "floating", None)
    pairs = problem.interfaces
    alone = (
        problem.dynamics is None and not problem.step_control.cut and problem.linear is None and not problem.config.unknowns.mixed
    )
    return (
        alone
        and floating is not None
        and floating.motions is not None
        and bool(pairs)
        and not any(p.friction is not None for p in pairs)
    )


def _rest(problem: Any, converge: Callable[[], list[Any]]) -> list[Any] | None:
    """Equilibrium without drag, and all iterations; None if bodies do not come to rest (collective)."""
    bodies, config, motions = problem.bodies, problem.config, problem.system.floating.motions
    problem.restore()
    if not bodies.assemble():
        return None
    scale = motions.forces(bodies.forces)[1]
    if scale == 0.0:
        return None
    body, count = find_bodies(config)
    number = reduced(config.comm, np.bincount(body[: config.n_owned], minlength=count))
    drag = _Drag(problem, (scale / (FIRST_WAY * motions.radius * number))[body[: config.n_owned]])
    history, failed, start = list[Any](), 0, np.array(problem.u.x.array)
    with _dragged(problem, drag):
        for _ in range(MOST_DRAGGED):
            problem.system.forget()
            bodies.tangent.take_points(drag)
            try:
                history += converge()
            except UEMError as error:
                failed, drag.factor = failed + 1, drag.factor / DECAY
                logger.debug("a step with drag failed: %s", error)
                if failed > MOST_FAILED:
                    return None
                problem.restore()
                problem.u.x.array[:] = start
                for pair in problem.interfaces:
                    pair.project()
                continue
            left = np.sqrt(reduced(config.comm, float((drag.forces() ** 2).sum())))
            way = float(reduced(config.comm, float(np.abs(config.displacement).max(initial=0.0)), op=MPI.MAX))
            if way > config.size:
                return None
            start = np.array(problem.u.x.array)
            drag.begin()
            if left <= problem.rtol * scale:
                break
            drag.factor *= DECAY
        else:
            return None
    try:
        return history + converge()
    except UEMError as error:
        logger.debug("without drag: %s", error)
        return None


@contextmanager
def _dragged(problem: Any, drag: _Drag) -> Iterator[None]:
    """Context in which a drag holds all bodies, so that none falls."""
    bodies = problem.bodies
    points = bodies.tangent.points
    try:
        with problem.system.floating.held():
            yield
    finally:
        bodies.tangent.take_points(points)
        problem.system.forget()
