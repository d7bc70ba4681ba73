"""Bodies that only contact holds: how they come to rest, and what keeps the united system regular until they do.

A body without enough Dirichlet conditions can move as a rigid body until contact holds it. Each motion that conditions and active
contacts leave open is either loaded, and then the body falls along it until it touches something, or neutral, and then it is held in a
statically determinate way, where the reaction is zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.log import logger
from uem_dolfinx.solve.body_forces import BodyForces
from uem_dolfinx.solve.rigid_motions import LOADED, OPEN, RigidMotions

#: Until contact has developed, motions that it resists with less than this part are held as well: a body that has touched ground
#: with one or two nodes would else swing about them.
#: [heuristic; size of the motion; -]
HARDLY_HELD = 0.03
#: Forces up to this part of all forces take a body no farther than ``SHORT_WAY`` of the model's size: on a single facet it would slide
#: away as soon as the facet tilts in the least.
#: [heuristic; sum of all forces; -]
BARELY_LOADED = 1e-3
#: See ``BARELY_LOADED``.
#: [heuristic; the model's size; -]
SHORT_WAY = 0.01
#: Bodies that slide without end are taken so many sizes of the model, to ask which contactors that would turn back.
#: [convention; the model's size; test_friction.py::test_what_slides_away]
FAR = 1e3
#: A body that falls touches ground after so many stations at most.
#: [bound; stations; -]
MOST_STATIONS = 200


class FloatingBodies:
    """What a step does about bodies that only contact holds.

    Args:
        forces: of the bodies.
        pairs: of all contacts; without any, nothing is done about bodies that float.

    Attributes:
        rigid: rigid motions of the bodies; None without contacts.
        motions: those of the present step, None if conditions and inertia hold all bodies.
    """

    def __init__(self, forces: BodyForces, pairs: Sequence[ContactPair]):
        self._forces, self._pairs = forces, pairs
        config, dynamics = forces.config, forces.dynamics
        self.rigid: RigidMotions | None = None
        self._at_rest: RigidMotions | None = None
        self._in_motion: RigidMotions | None = None
        if pairs:
            free, finite = forces.free[: config.n_owned], not forces.tangent.linear
            self.rigid = RigidMotions(config, free, finite)
            self._at_rest = self.rigid if self.rigid.any_open() else None
            if dynamics is not None:
                # in a step in time, inertia holds what has mass
                moving = RigidMotions(config, free & ~dynamics.massy, finite)
                self._in_motion = moving if moving.any_open() else None
        self.motions = self._at_rest
        #: Those that conditions and contacts leave open and that supports hold ``(n_motions, k)``.
        self._open: Array = np.zeros((0, 0))
        #: Likewise with those that friction alone resists, where all contactors slip.
        self._sliding: Array = np.zeros((0, 0))
        #: Whether contact has yet to develop in this step.
        self._developing = False

    def begin_step(self, place: Callable[[], None]) -> None:
        """Let bodies fall until they touch; ``place`` projects all contactors (collective).

        Raises:
            FloatingBodyError: naming a body, and the motion that nothing stops.
        """
        if self._forces.dynamics is not None:
            self.motions = self._in_motion if self._forces.dynamics.moving else self._at_rest
        self._developing = self.motions is not None
        if self.motions is not None:
            self.motions.forget_supports()
            self._fall(place, freely=True, small_loads=False)

    def begin_motion(self) -> None:
        """Take the motions of a step in time for the first acceleration."""
        self.motions = self._in_motion

    def end_step(self) -> None:
        """Say so if supports carry more than rounding."""
        if self.motions is not None and self.motions.share > LOADED:
            logger.warning(
                "a body that only contact holds is driven sideways by %.1g of the forces, and is held where it is: its contact does "
                "not tell its place", self.motions.share,
            )  # fmt: skip

    def hold(self, free: Bools, equations: UnitingEquations, resisting: UnitingEquations) -> Bools:
        """Free components ``(n_owned, gdim)`` without those that hold neutral motions (collective).

        Args:
            free: components without Dirichlet condition ``(n_owned, gdim)``.
            equations: rows of the relative motions that contacts do not let go on without end.
            resisting: rows of all relative motions that contacts resist, the same object without friction.
        """
        if self.motions is None:
            return free
        resistance = HARDLY_HELD if self._developing else OPEN
        self._open = self._sliding = self.motions.open_motions(resisting, resistance)
        if resisting is not equations:
            self._sliding = self.motions.open_motions(equations, resistance)
        return free & ~self.motions.supports(self._sliding, equations)

    def slide(self, driving: Array, forces: Array) -> Array | None:
        """Increment, far beyond all others, of bodies that slide under what the supports carry; None if none does (collective).

        Args:
            driving: forces that are not in equilibrium, at the owned nodes ``(n_owned, gdim)``.
            forces: all forces of the bodies, beside which they may be rounding ``(n_owned, gdim)``.
        """
        if self.motions is None or self._sliding.shape[1] == self._open.shape[1]:
            return None
        motion = self.motions.load(self._sliding, driving, forces)
        return FAR * self._forces.config.size * self.motions.field(motion / size) if (size := np.linalg.norm(motion)) else None

    @property
    def adrift(self) -> bool:
        """Whether loads drive a body along a motion that supports alone hold, so that no active set is its equilibrium (collective)."""
        if self.motions is None:
            return False
        force = self.motions.load(self._open, self._forces.residual.array_r.reshape(-1, self._forces.config.gdim))
        return bool(force.any())

    def fall_again(self, place: Callable[[], None], changed: bool, settled: bool) -> bool:
        """Let bodies that have lost their hold fall (collective).

        Args:
            place: projects all contactors (collective).
            changed: whether the active set has, or is about to.
            settled: whether the bodies are in equilibrium.

        Returns:
            Whether anything else has changed now.
        """
        if self.motions is None:
            return False
        more = False
        if self._developing and settled and not changed:
            # go on if more was held than must be
            self._developing = False
            more = self._open.shape[1] > self.motions.open_motions(self._equations()).shape[1]
        if changed or more or settled:
            # a body that has lost its hold on the way falls only when the others have come to rest
            freely = not (changed or more)
            more |= self._fall(place, freely=freely, small_loads=freely)
        return more

    def without_open_motions(self, du: Array) -> Array:
        """An increment ``(n_owned * gdim,)`` without what it holds of neutral motions, along which bodies stay (collective)."""
        if self.motions is None:
            return du
        return du - self.motions.part(self._sliding, du.reshape(-1, self._forces.config.gdim)).ravel()

    def _equations(self) -> UnitingEquations:
        """Uniting equations of all pairs, the derivatives of their gaps."""
        return UnitingEquations.join([pair.equations().resisting for pair in self._pairs], self._forces.config.gdim)

    def _fall(self, place: Callable[[], None], freely: bool, small_loads: bool) -> bool:
        """Move bodies rigidly along their loads until contact holds them (collective).

        Args:
            place: projects all contactors (collective).
            freely: otherwise they only take hold of what they touch already.
            small_loads: follow small loads as well, to what is near.

        Returns:
            Whether any body has moved or touched something.

        Raises:
            FloatingBodyError: naming a body, and the motion that nothing stops.
        """
        motions, config = self.motions, self._forces.config
        assert motions is not None
        changed, motion = False, motions.every_motion[0]
        for _ in range(MOST_STATIONS):
            place()
            self._forces.assemble()
            motion = motions.load(motions.open_motions(self._equations()), self._forces.residual.array_r.reshape(-1, config.gdim))
            way = np.inf if motions.share > BARELY_LOADED else SHORT_WAY * config.size if small_loads else 0.0
            if not motion.any() or not way:
                return changed
            motion /= np.linalg.norm(motion)
            closing, distance = [], np.inf
            for pair in self._pairs:
                ahead = pair.approach
                rate = motions.rates(ahead) @ motion
                # one that closes more slowly would not resist
                closing.append(rate < -OPEN)
                ways = np.where(rate < -OPEN, np.maximum(ahead.gap, 0.0) / np.maximum(-rate, OPEN), np.inf)
                distance = min(distance, float(ways.min(initial=np.inf)))
            distance = config.comm.allreduce(distance, op=MPI.MIN)
            if not any([pair.activate_closing(c) for pair, c in zip(self._pairs, closing)]):
                if not freely or way < distance:
                    return changed
                if np.isinf(distance):
                    raise motions.error(motion)
                # on curved surfaces the touch may come later than it seems; then the next station is nearer
                motions.move(distance * motion)
            changed = True
        raise motions.error(motion)
