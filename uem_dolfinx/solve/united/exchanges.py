"""Choice of the contactors that violate their conditions and change state, in each active-set change and each iteration.

A repeated state is detected, and another rule is then used. If no rule is left, an error names the contactors that cycle.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import label_of, name_at
from uem_dolfinx.contact.seam.active_set import TOUCHING, Pivoting, Rule, Violations
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import ConvergenceError, FrictionError
from uem_dolfinx.parallel import gathered, reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.rigid.first_touch import deepest_of

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.solve.united.newton import Increment

#: The order of contactors that are exchanged one by one is that of their places in the drawing along this direction.
#: [convention; a direction; test_exchanges.py::test_the_order_does_not_depend_on_ranks]
ALONG = np.sqrt([2.0, 3.0, 5.0])
#: The active set of a linearised problem settles within so many exchanges of many contactors, or the step is cut.
#: [bound; exchanges; -]
MOST_EXCHANGES = 100
#: Exchanges of the first contactor alone find the active set of every convex problem without friction; they may take so many of them.
#: [bound; exchanges for each contactor; -]
MOST_OF_EACH = 20
#: Condensing the bodies onto the slots of the contact takes as long as one factorisation, and as so many exchanges without.
#: [convention; exchanges; test_settle.py::test_when_arrays_are_used]
AS_LONG_IF_CHEAP = 10
#: A state that comes again with more than this part of the residual that it had has led nowhere.
#: [convention; norm of the residual; test_exchanges.py::test_states_that_come_again]
NO_LESS = 0.9
#: Curvature of contact that could make the tangent indefinite is left out until so much of the residual is left. Releases that let
#: bodies jump are delayed as often as the residual has fallen to this part.
#: [convention; norm of the residual; test_exchanges.py::test_convex_until_it_gets_better]
WHOLE_AGAIN = 0.1
#: States of a step may come again so often. [convention; rounds; test_exchanges.py::test_states_that_come_again]
MOST_ROUNDS = 6
#: A state that has come again so often although no contactor changes gets a convex tangent the next time.
#: [convention; iterations; test_exchanges.py::test_convex_until_it_gets_better]
OFTEN = 3
#: So many of the contactors that change sides for ever are named.
#: [convention; contactors; test_exchanges.py::test_contactors_in_a_cycle_are_named]
NAMED = 3


@dataclass(frozen=True)
class _Visit:
    """A state visited before equilibrium: its fingerprint, norm of the residual, patterns of pairs, contactors that have changed since."""

    state: object
    norm: float
    patterns: list[Ints]
    changed: list[Bools]


class Exchanges:
    """Chooses among the contactors that violate their conditions, in all pairs; all methods are collective.

    Attributes:
        frictional: whether any contact has friction.
        straight: whether the linearised problem neglects the curvature of contact, and softening where bodies may jump.
        may_jump: whether bodies may come down to another equilibrium from a path that has become unstable; not along an arc.
        convex: whether terms of the curvature that could make the tangent indefinite are neglected. Beyond a limit point, Newton's
            method does not leave the path by itself; with a convex tangent the bodies reach another equilibrium of lower energy.
        frozen: whether stick and slip states are fixed until the bodies have moved.
    """

    def __init__(self, pairs: Sequence[Interface]):
        self._pairs = pairs
        self.frictional, self.may_jump = any(pair.friction is not None for pair in pairs), True
        self.begin_step()

    def begin_step(self) -> None:
        """Forget the states of other steps."""
        self._visits: list[_Visit] = []
        self._rounds, self._cohesive = 0, any(pair.trial.cohesion is not None for pair in self._pairs)
        #: Whether the curvature is convex, and the residual norm at which it became so; zero to set it at the next visit.
        self.convex, self._from = False, 0.0
        #: Norm of the last residual, and of the last one at which contactors stayed that would have let bodies jump.
        self._norm = self._stayed = np.inf
        self.begin()

    @property
    def softens(self) -> bool:
        """Whether contacts soften, and bodies need not follow an unstable path: without softening their energy falls in any case."""
        return self.may_jump and self._cohesive

    @property
    def jumps(self) -> bool:
        """Whether softening is left out, after prescribed values have been reached."""
        return self.softens and self.straight and bool(self._visits)

    @staticmethod
    def climbs(solver: UnitedSolver, step: Increment) -> bool:
        """Whether the matrix of the last solve has negative eigenvalues, as far as its factors or the solution show (collective)."""
        return solver.indefinite or solver.negative if solver.exact else solver.space.work(step.dq, step.rhs) < 0.0

    @contextmanager
    def along_path(self) -> Iterator[None]:
        """Keep softening in all tangents, with which an arc finds the load."""
        self.may_jump = False
        try:
            yield
        finally:
            self.may_jump = True

    def begin(self) -> None:
        """Begin another linearised problem."""
        self._pivoting, self.straight, self.frozen = Pivoting(), False, False
        self._number, self._alone, self._rule, self._on_arrays = 0, 0, Rule.ALL, False
        #: States before contactors were released, and whether they are kept although these violate their conditions.
        self._before: list[PairState] | None = None
        self._stays = False
        #: Contactors that have changed state in this problem, and by the present rule.
        self._changed = self._lately = self._none()

    def take_long(self, violated: Sequence[Violations], cheap: bool, gives_way: bool = False) -> bool:
        """Whether the problem is now to be solved on arrays, which counts as an exchange (collective).

        It is not if contactors touch that have no rows yet: arrays hold those with rows alone.

        Args:
            violated: violations of every pair.
            cheap: whether an exchange needs no factorisation.
            gives_way: whether it needs one with friction that serves for all problems.
        """
        cheap = cheap and not (gives_way and self.frictional)
        if self._on_arrays or self.frozen or self._number < (AS_LONG_IF_CHEAP if cheap else 0) or not self._pairs:
            return False
        found = [(w.count, int((w.enter & ~pair.trial.reserved).sum())) for w, pair in zip(violated, self._pairs)]
        number, new = reduced(self._pairs[0].config.comm, np.sum(found, axis=0))
        if not number or new:
            return False
        self._number, self._pivoting, self._on_arrays = self._number + 1, Pivoting(), True
        return True

    def choose(
        self, violated: list[Violations], gaps: Sequence[Array], curved: bool, climbs: bool = False
    ) -> list[Violations] | None:
        """Contactors that change state now; None if the linearised problem is solved.

        Args:
            violated: violations of every pair.
            gaps: that decide on contact, of every pair ``(n,)``.
            curved: whether the linearised problem includes the curvature of contact.
            climbs: whether softening makes the linearised problem indefinite: it is left out, which bounds the energy from above.

        Raises:
            ConvergenceError, FrictionError: if no rule is left; names the contactors that cycle.
        """
        comm = self._pairs[0].config.comm
        if self.frozen:
            violated = [w.of_contact() for w in violated]
        if self._stays:
            return None
        if climbs and not self.straight:
            # far from equilibrium bodies may jump by an exchange that is none there: the last states without a jump are kept
            self._stays = self.softens and self._before is not None and self._norm <= WHOLE_AGAIN * self._stayed
            if self._stays and self._before is not None:
                self._stayed = self._norm if self._visits else np.inf
                for pair, before in zip(self._pairs, self._before):
                    pair.take(replace(before, reserved=pair.trial.reserved))
            self.straight = not self._stays
            return [w.among(np.zeros_like(w.enter)) for w in violated]
        both = zip(violated, self._pairs)
        own = np.sum([(w.count, w.enter.sum(), pair.trial.active.sum(), len(pair.nodes)) for w, pair in both], axis=0)
        sums = gathered(comm, np.array([*own, _fingerprint([_pattern(pair.trial) for pair in self._pairs])], dtype=np.int64))
        (number, entering, active, every), state = sums[:, :4].sum(axis=0), tuple(sums[:, 4])
        self._before = None if entering else [pair.trial for pair in self._pairs]
        if not number:
            return None
        chosen, rule = violated, self._pivoting.choose(int(number), state)
        if rule >= Rule.FIRST and (curved or self.softens) and not self.straight:
            # with curvature or softening the problem may have no solution or several; without it has exactly one
            self._pivoting, self.straight, self.convex = Pivoting(), True, True
        elif rule == Rule.FIRST:
            chosen = self._first(violated)
        elif rule == Rule.NONE:
            if not self.frictional or self.frozen:
                raise self._circle(self._lately)
            self._pivoting, self.frozen = Pivoting(), True
            return self.choose(violated, gaps, curved)
        elif entering > active:
            chosen = deepest_of(self._pairs, gaps, violated)
        if rule != self._rule:
            self._rule, self._lately = rule, self._none()
        self._changed, self._lately = ([c | w.which for c, w in zip(before, chosen)] for before in (self._changed, self._lately))
        if rule == Rule.FIRST:
            self._alone += 1
            if self._alone > MOST_OF_EACH * every:
                raise self._circle(self._lately)
            return chosen
        self._number += 1
        if self._number > MOST_EXCHANGES:
            raise self._circle(self._lately)
        return chosen

    def _none(self) -> list[Bools]:
        return [np.zeros(len(pair.nodes), dtype=bool) for pair in self._pairs]

    def _first(self, violated: Sequence[Violations]) -> list[Violations]:
        """The first violating contactor by position, with contactors of the same contact at the same position."""
        config = self._pairs[0].config
        along = [pair.config.X[pair.nodes] @ ALONG[: config.gdim] for pair in self._pairs]
        first = np.cumsum([0, *(len(pair.members) for pair in self._pairs)])
        label, least = [k + label_of(pair) for k, pair in zip(first, self._pairs)], np.full(first[-1], np.inf)
        for which, w, a in zip(label, violated, along):
            np.minimum.at(least, which, np.where(w.which, a, np.inf))
        config.comm.Allreduce(MPI.IN_PLACE, least, op=MPI.MIN)
        k = int(np.argmax(np.isfinite(least)))
        at = least[k] + TOUCHING * config.size
        return [w.among((a <= at) & (which == k)) for which, w, a in zip(label, violated, along)]

    def visit(self, norm: float) -> bool:
        """Record the present state, which is no equilibrium.

        Args:
            norm: of the residual.

        Returns:
            Whether the state is a repetition, and contactors that cycle at corners have averaged normals from now on.

        Raises:
            ConvergenceError, FrictionError: for other repetitions if no rule is left; names the contactors that cycle.
        """
        self._norm = norm
        if self.convex:
            self._from = self._from or norm
            self.convex = norm > WHOLE_AGAIN * self._from
        if not self.convex:
            self._from = 0.0
        patterns = [_pattern(pair.trial) for pair in self._pairs]
        state = tuple(gathered(self._pairs[0].config.comm, _fingerprint(patterns)))
        here = _Visit(state, norm, patterns, self._changed)
        back = [k for k, v in enumerate(self._visits) if v.state == here.state and norm > NO_LESS * v.norm > 0.0]
        self._visits.append(here)
        if not back:
            return False
        since = self._visits[back[-1] + 1 :]
        changed = [
            np.any([v.changed[i] | (v.patterns[i] != here.patterns[i]).any(axis=1) for v in since], axis=0)
            for i in range(len(self._pairs))
        ]
        comm = self._pairs[0].config.comm
        if not reduced(comm, sum(int(c.sum()) for c in changed)):
            if len(back) <= OFTEN:
                return False
            self.convex, self._from = True, max(norm, self._from)
            return False
        self._visits, self._rounds = [], self._rounds + 1
        calm = reduced(comm, np.array([_calm(pair, c) for pair, c in zip(self._pairs, changed)]), op=MPI.LOR)
        for pair in (pair for pair, some in zip(self._pairs, calm) if some):
            pair.project()
        # no rule has found the active set of the last linearised problem, and the same state was reached again
        if self._rounds == MOST_ROUNDS or (self.frozen and not calm.any()):
            raise self._circle(changed)
        return bool(calm.any())

    def _circle(self, changed: Sequence[Bools]) -> ConvergenceError:
        """The error for a cycle, with the names of contactors, marked in masks ``(n,)`` of every pair."""
        own = [
            (tuple(pair.config.X[pair.nodes[i]]), name_at(pair, int(i)), pair.config.describe(int(pair.nodes[i])))
            for pair, c in zip(self._pairs, changed)
            for i in np.flatnonzero(c)
        ]
        found = sorted(chain(*self._pairs[0].config.comm.allgather(own)), key=lambda f: (f[1], f[0]))
        names = ", ".join(f"{name} at {place}" for _, name, place in found[:NAMED])
        more = f", and {len(found) - NAMED} more" if len(found) > NAMED else ""
        why = "touch and separate, or stick and slip" if self.frictional else "touch and separate"
        return (FrictionError if self.frictional else ConvergenceError)(
            f"the active set cycles: contactors {why} in turn: {names}{more}; take smaller load steps, or a target of finer "
            f"facets there{', or less friction' if self.frictional else ''}"
        )


def _pattern(t: PairState) -> Ints:
    """Integers that identify the state of each contactor: active, corner, stick and direction of slip ``(n, k)``."""
    along = [] if t.friction is None else [t.friction.stick[:, None], np.rint(t.friction.direction)]
    return np.concatenate([t.active[:, None], t.held, *along], axis=1, dtype=np.int64, casting="unsafe")


def _fingerprint(patterns: Sequence[Ints]) -> int:
    """Fingerprint of the states of this rank's contactors, from the patterns of all pairs."""
    return zlib.crc32(b"".join([pattern.tobytes() for pattern in patterns]))


def _calm(pair: Interface, which: Bools) -> bool:
    """Set averaged normals in this step for contactors of ``which (n,)`` that alternate between facets: whether there are any."""
    from uem_dolfinx.contact.nodes.concave_edges import HOLD_AFTER, MOST_CHANGES

    changes = pair.trial.changes
    some = which & pair.trial.active & (changes >= HOLD_AFTER) & (changes < MOST_CHANGES)
    pair.take(replace(pair.trial, changes=np.where(some, MOST_CHANGES, changes)))
    return bool(some.any())


def foreseen(
    bodies: Bodies, forces: Iterable[tuple[Interface, Traction]], du: Array, moved: Array, way: float, left: float, swept: bool
) -> tuple[list[Array], list[Violations]]:
    """Gaps after increments du ``(n_owned, gdim)``, and contactors that violate contact conditions then under ``forces`` (collective).

    Gaps below ``way``, forces that move a contactor that far, and forces below ``left`` count as zero; see ``Interface.violated``.
    """
    gaps, violated = [], []
    for pair, own in forces:
        gap, found = pair.kinematics.gap, Violations.none(len(pair.nodes))
        if pair.in_reach:
            assert bodies.stiffness is not None
            gap = pair.kinematics.gap_rows.gaps(du)
            across = np.einsum("ng,ng->n", pair.kinematics.projection.normal**2, np.abs(bodies.stiffness[pair.nodes]))
            least = np.maximum(bodies.rounding_at(pair.nodes), np.maximum(way * across, left))
            found = pair.violated(gap, own, least, way, swept, moved)
        gaps.append(gap)
        violated.append(found)
    return gaps, violated


def count(pairs: Sequence[Interface], violated: Sequence[Violations]) -> int:
    """Number of violating contactors over all pairs and ranks (collective)."""
    return int(reduced(pairs[0].config.comm, sum([w.count for w in violated]))) if pairs else 0
