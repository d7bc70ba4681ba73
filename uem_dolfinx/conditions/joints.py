"""Declarations of joints and springs between rigid parts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.conditions.relations import RA, RB, TA, TB, Body, Scalar, angle, distance, projected, turning
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_set import Placement
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agreed


class Link(given.Sealed, ABC):
    """Common part of joints and springs: two rigid couplings, or one and the ground."""

    def __init__(self, a: RigidCoupling | None, b: RigidCoupling | None):
        self.name = type(self).__name__
        for what, one in (("a", a), ("b", b)):
            given.kind(what, one, one is None or isinstance(one, RigidCoupling), "a RigidCoupling, or None for the ground")
            if one is not None and one.distribute:
                raise InputError(
                    f"{what} of a {self.name}: the part of the RigidCoupling of '{one.name}' with distribute=True does not move rigidly; "
                    "leave distribute out"
                )
        if a is b:
            same = "the ground" if a is None else f"the same RigidCoupling, of '{a.name}'"
            raise InputError(f"a {self.name} has {same} on both sides: expected two different parts")
        self.a, self.b = a, b
        self.ends: list[RigidCoupling] = [one for one in (a, b) if one is not None]  # rigid couplings that it connects
        self._gdim = len(self.ends[0].point)
        if len(self.ends[-1].point) != self._gdim:
            raise InputError(
                f"a {self.name} of couplings in {self._gdim}D and {len(self.ends[-1].point)}D: expected one dimension"
            )
        self._attached = False
        self.stiffness = 0.0
        #: Force and moment on the coupling's point of each end ``(3,)``, of what stores energy; as last evaluated.
        self._loads: dict[int, tuple[Array, Array]] = {}
        self._energy = 0.0

    # -- in a problem ------------------------------------------------------------------------------------------------------

    def attach(self, config: Configuration, finite: bool) -> None:
        """Take part in a problem, whose couplings are attached (collective)."""
        with agreed(config.comm):
            if self._attached:
                raise SpaceError(f"a {self.name} belongs to another problem: make a new one for every problem")
            for one in self.ends:
                if not one.belongs_to(config):
                    raise InputError(
                        f"the RigidCoupling of '{one.name}', of a {self.name}, is not in the problem: give it in couplings, too"
                    )
            if len({one.nodes.large for one in self.ends}) > 1:
                raise InputError(
                    f"a {self.name} between '{self.ends[0].name}' and '{self.ends[1].name}', of large and of small rotations: expected the "
                    "same rotations= of both"
                )
        self._attached = True
        for one in self.ends:
            one.links.append(self)

    @property
    def large(self) -> bool:
        """Whether rotations are finite."""
        return self.ends[0].nodes.large

    def bodies(self, at: dict[int, Placement]) -> tuple[Body, Body]:
        """Both bodies in placements by id of their coupling."""
        a, b = (Body.of(None if one is None else at[id(one)]) for one in (self.a, self.b))
        return a, b

    def columns(self) -> list[tuple[RigidCoupling, slice | list[int]]]:
        """Each coupling with the components of its motion among ``pair_motion``'s z."""
        sides = ((self.a, TA, RA), (self.b, TB, RB))
        plane = [0, 1, 5]
        return [
            (one, slice(t.start, r.stop) if self._gdim == 3 else [t.start + i for i in plane])
            for one, t, r in sides
            if one is not None
        ]

    @abstractmethod
    def stored(self, at: dict[int, Placement], z: Array | None) -> tuple[float, Array, Array, Array]:
        """Energy, slope ``(12,)``, material and geometric second derivatives ``(12, 12)``; z are small motions from ``at``, or None."""

    def places(self) -> dict[int, Placement]:
        """Present placements by id of their coupling; the reference with small rotations (collective)."""
        sets = {id(one): one.nodes for one in self.ends}
        return {
            key: s.placement(s.config.displacement[: s.config.n_owned]) if s.large else s.reference for key, s in sets.items()
        }

    def small_motions(self) -> Array | None:
        """Small motions from the reference ``(12,)``; None with large rotations (collective)."""
        z = np.zeros(12)
        for one, columns in self.columns() if not self.large else ():
            z[columns] = one.nodes.motion_of(one.nodes.reference, one.nodes.config.displacement[: one.nodes.config.n_owned])
        return None if self.large else z

    def update(self) -> None:
        """Evaluate energy, force and moment of stiffness at the present displacement (collective)."""
        if not self.stiffness:
            return
        here = self.places()
        found = self.stored(here, self.small_motions())
        self._energy = found[0]
        for one, columns in self.columns():
            g, slope = self._gdim, found[1][columns]
            force, moment = -slope[:g], -slope[g:]
            arm = here[id(one)].arms(one.point[None])[0]
            back = np.cross(arm, force) if g == 3 else np.array([arm[0] * force[1] - arm[1] * force[0]])
            self._loads[id(one)] = force, moment - back

    @property
    def described(self) -> str:
        """Its name, with the parts that it connects."""
        ends = " and ".join("the ground" if one is None else f"'{one.name}'" for one in (self.a, self.b))
        return f"the {self.name} of {ends}"

    def load_on(self, one: RigidCoupling) -> tuple[Array, Array] | None:
        """Force ``(gdim,)`` and moment ``(n_turns,)`` of stiffness at the point of a coupling (collective)."""
        self.update()
        return self._loads.get(id(one))

    @property
    def energy(self) -> float:
        """Energy stored in its spring (collective)."""
        self.update()
        return self._energy

    def _spatial(self, point: Array) -> Array:
        """A point or direction in space ``(3,)``."""
        return np.append(point, np.zeros(3 - len(point)))


class Joint(Link):
    """Common part of joints: equations of projections that vanish, and one coordinate that is free.

    Subclasses set ``_shifts``, directions of a along which both points may not part, and ``_turns``, pairs of directions of a and of b
    that stay at right angles.
    """

    _shifts: list[Array]
    _turns: list[tuple[Array, Array]]

    def __init__(self, a: RigidCoupling | None, b: RigidCoupling | None, point: npt.ArrayLike, stiffness: float):
        super().__init__(a, b)
        self.point = given.vector("point", point, self._gdim)
        self.stiffness = given.number("stiffness", stiffness, given.NOT_NEGATIVE)
        self._at = self._spatial(self.point)
        self.known = 0.0  # last committed coordinate, which determines the number of full turns
        self._reaction: tuple[Array, Array] = np.zeros(3), np.zeros(3)  # force and moment on b, as last computed

    def rows(self, at: dict[int, Placement]) -> list[Scalar]:
        """Scalars that vanish."""
        a, b = self.bodies(at)
        shifts = [projected(a, b, v, v, self._at) for v in self._shifts]
        return shifts + [projected(a, b, v, w, None) for v, w in self._turns]

    @abstractmethod
    def _coordinate(self, at: dict[int, Placement]) -> Scalar:
        """The coordinate that is free."""

    def stored(self, at: dict[int, Placement], z: Array | None) -> tuple[float, Array, Array, Array]:
        """See ``Link``."""
        k, s = self.stiffness, self._coordinate(at)
        value = self._whole(s.value) if z is None else float(s.slope @ z)
        bend = k * value * s.bend if z is None else np.zeros((12, 12))
        return 0.5 * k * value**2, k * value * s.slope, k * np.outer(s.slope, s.slope), bend

    def _whole(self, value: float) -> float:
        """The coordinate with full turns."""
        return value

    @property
    def n_rows(self) -> int:
        """Number of its equations."""
        return len(self._shifts) + len(self._turns)

    def _now(self) -> float:
        """The coordinate (collective)."""
        s, z = self._coordinate(self.places()), self.small_motions()
        return self._whole(s.value) if z is None else float(s.slope @ z)

    def read(self, at: dict[int, Placement], forces: Array) -> None:
        """End a step with the multipliers of ``rows (k,)`` (collective)."""
        a, b = self.bodies(at)
        n = len(self._shifts)
        force = sum((f * (a.Q @ v) for f, v in zip(forces, self._shifts)), np.zeros(3))
        moment = sum((f * np.cross(b.Q @ w, a.Q @ v) for f, (v, w) in zip(forces[n:], self._turns)), np.zeros(3))
        self._reaction = force, moment
        self.known = self._now()

    @property
    def force(self) -> Array:
        """Force of the joint on b at b's point of the joint ``(gdim,)``; the opposite force acts on a."""
        return self._reaction[0][: self._gdim].copy()

    @property
    def moment(self) -> Any:
        """Moment of the joint on b about b's point of the joint, without the moment of ``stiffness``: a number in 2D, else ``(3,)``."""
        return float(self._reaction[1][2]) if self._gdim == 2 else self._reaction[1].copy()


class Ball(Joint):
    """Two rigid parts that share a point and rotate freely about it: a spherical joint; in 2D a hinge.

        uem.Ball(arm, socket, (1.0, 0.0, 0.0))

    Pass it to ``UnitedProblem(..., couplings=[arm, socket, ball])``.

    Args:
        a, b: rigid couplings of the problem; None is the ground.
        point: reference position of the common point ``(gdim,)``; it need not be a node.

    Raises:
        InputError, InputTypeError: for values of another form, for twice the same part, and for couplings with ``distribute=True``.
            When the problem is made: for parts that are not in it, and for large and small rotations together.
    """

    def __init__(self, a: RigidCoupling | None, b: RigidCoupling | None, point: npt.ArrayLike):
        super().__init__(a, b, point, 0.0)
        self._shifts, self._turns = list(np.eye(3)[: self._gdim]), []

    def _coordinate(self, at: dict[int, Placement]) -> Scalar:
        return Scalar(0.0, np.zeros(12), np.zeros((12, 12)))


class Hinge(Joint):
    """Two rigid parts that share a point and an axis, about which they rotate against each other.

        uem.Hinge(door, None, (0.0, 1.0, 0.0), axis=(0.0, 0.0, 1.0))              # None is the ground
        uem.Hinge(upper, lower, (2.0, 0.0), stiffness=30.0)                        # plane, with a torsional spring

    The axis moves with the parts. Pass it to ``UnitedProblem(..., couplings=[upper, lower, hinge])``. It has 5 equations in space and 2
    in the plane, satisfied exactly, without multipliers and without a penalty.

    Args:
        a, b, point: as in ``Ball``.
        axis: reference direction ``(3,)`` in space; none in the plane.
        stiffness: moment about the axis per angle, of a torsional spring without moment at angle 0.

    Raises:
        InputError, InputTypeError: as in ``Ball``, and for an axis without direction.
    """

    def __init__(
        self,
        a: RigidCoupling | None,
        b: RigidCoupling | None,
        point: npt.ArrayLike,
        axis: npt.ArrayLike | None = None,
        *,
        stiffness: float = 0.0,
    ):
        super().__init__(a, b, point, stiffness)
        if (axis is None) != (self._gdim == 2):
            expected = "a direction in space" if axis is None else "none in the plane, where it is normal to it"
            raise InputError(given.sentence("axis", axis, expected, "take Ball for a joint without an axis"))
        self.axis = np.eye(3)[2] if axis is None else given.direction("axis", axis, 3)
        self._x, self._y = across(self.axis)
        self._shifts = [self._x, self._y, self.axis][: self._gdim]
        self._turns = [(self._x, self.axis), (self._y, self.axis)] if self._gdim == 3 else []

    def _coordinate(self, at: dict[int, Placement]) -> Scalar:
        return angle(*self.bodies(at), self._x, self._y)

    def _whole(self, value: float) -> float:
        return float(value + 2.0 * np.pi * np.round((self.known - value) / (2.0 * np.pi)))

    @property
    def angle(self) -> float:
        """Rotation of b against a about the axis in radians, including full turns (collective)."""
        return self._now()


class Slider(Joint):
    """Two rigid parts of which the second slides along an axis of the first.

        uem.Slider(cylinder, piston, (0.0, 0.0, 1.0), axis=(0.0, 0.0, 1.0), stiffness=1e3)

    Args:
        a, b, point: as in ``Ball``; the point of b stays on the axis through the point of a.
        axis: reference direction ``(gdim,)``, fixed in a.
        turns: whether b may also rotate: about the axis in space, in the plane about the point.
        stiffness: force along the axis per displacement, of a spring that is free at displacement 0.

    Raises:
        InputError, InputTypeError: as in ``Ball``, and for an axis without direction.
    """

    def __init__(
        self,
        a: RigidCoupling | None,
        b: RigidCoupling | None,
        point: npt.ArrayLike,
        axis: npt.ArrayLike,
        *,
        turns: bool = False,
        stiffness: float = 0.0,
    ):
        super().__init__(a, b, point, stiffness)
        self.axis, self.turns = given.direction("axis", axis, self._gdim), given.flag("turns", turns)
        z = self._spatial(self.axis)
        plane = self._gdim == 2
        x, y = (np.cross([0.0, 0.0, 1.0], z), z) if plane else across(z)
        self._shifts = [x] if plane else [x, y]
        blocked = [] if turns else [(x, y)]
        self._turns = blocked if plane else [(x, z), (y, z), *blocked]

    def _coordinate(self, at: dict[int, Placement]) -> Scalar:
        z = self._spatial(self.axis)
        return projected(*self.bodies(at), z, z, self._at)

    @property
    def displacement(self) -> float:
        """Displacement of b's point along the axis from its reference position in a (collective)."""
        return self._now()


class Spring(Link):
    """A spring along the line between points of two rigid parts: its tension is ``stiffness * (length - free_length)``.

        uem.Spring(frame, wheel, 2e4)
        uem.Spring(None, mass, 50.0, points=((0.0, 0.0), (0.0, -1.0)), free_length=0.8)

    Pass it to ``UnitedProblem(..., couplings=[frame, wheel, spring])``. A torsional spring is ``stiffness`` of a ``Hinge``, a spring of
    a node to the ground a ``PointSpring``. Ends on bodies that deform have rigid couplings of the facets around them.

    Args:
        a, b: rigid couplings of the problem; None is the ground.
        stiffness: force per length.
        points: reference positions of its ends, on a and on b, each ``(gdim,)``; None takes the points of the couplings.
        free_length: None is the reference length; with 0 the spring is linear, of equal stiffness in all directions.

    Raises:
        InputError, InputTypeError: as in ``Ball``, for points that the ground lacks, and for a free length without direction.
    """

    def __init__(
        self,
        a: RigidCoupling | None,
        b: RigidCoupling | None,
        stiffness: float,
        *,
        points: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        free_length: float | None = None,
    ):
        super().__init__(a, b)
        self._shown = {"points": points, "free_length": free_length}
        self.stiffness = given.number("stiffness", stiffness, given.POSITIVE)
        if points is None and (a is None or b is None):
            raise InputError("points of a Spring to the ground: expected the positions of both ends, on a and on b")
        pair = (self.ends[0].point, self.ends[-1].point) if points is None else points
        given.kind("points", pair, isinstance(pair, tuple | list) and len(pair) == 2, "two positions, on a and on b")
        self.points = tuple(given.vector(f"points[{i}]", p, self._gdim) for i, p in enumerate(pair))
        self._from, self._to = map(self._spatial, self.points)
        self._drawn = float(np.linalg.norm(self._to - self._from))
        free = self._drawn if free_length is None else given.number("free_length", free_length, given.NOT_NEGATIVE)
        self.free_length = free
        if free > 0.0 and not self._drawn > 0.0:
            raise InputError(f"free_length = {free:.6g} of a Spring whose ends are at one point has no direction: expected 0")

    def stored(self, at: dict[int, Placement], z: Array | None) -> tuple[float, Array, Array, Array]:
        """See ``Link``."""
        k, free = self.stiffness, self.free_length
        D, slopes, from_a, from_b = distance(*self.bodies(at), self._from, self._to)
        if free == 0.0:
            D = D if z is None else D + slopes @ z
            return 0.5 * k * float(D @ D), k * D @ slopes, k * slopes.T @ slopes, self._bend(k * D, from_a, from_b, z)
        length = float(np.linalg.norm(D))
        n = D / length
        slope = n @ slopes
        tension = k * (length - free + (0.0 if z is None else float(slope @ z)))
        bend = self._bend(tension * n, from_a, from_b, z)
        if z is None:
            bend += tension / length * (slopes.T @ slopes - np.outer(slope, slope))
        return 0.5 * tension**2 / k, tension * slope, k * np.outer(slope, slope), bend

    def _bend(self, force: Array, from_a: Array, from_b: Array, z: Array | None) -> Array:
        """Second derivatives of ``force . D`` with large rotations."""
        bend = np.zeros((12, 12))
        if z is None:
            bend[RA, RA], bend[RB, RB] = -turning(force, from_a), turning(force, from_b)
        return bend

    @property
    def vector(self) -> Array:
        """Present vector from its end on a to its end on b ``(gdim,)`` (collective)."""
        D, slopes, _, _ = distance(*self.bodies(self.places()), self._from, self._to)
        z = self.small_motions()
        return np.asarray(D if z is None else D + slopes @ z)[: self._gdim]

    @property
    def length(self) -> float:
        """Present distance of its ends (collective)."""
        return float(np.linalg.norm(self.vector))

    @property
    def force(self) -> Array:
        """Force of the spring on b ``(gdim,)``; the opposite force acts on a (collective)."""
        self.update()
        if self.b is None:
            return -self._loads[id(self.a)][0]
        return self._loads[id(self.b)][0]


def across(axis: Array) -> tuple[Array, Array]:
    """Two directions that form a right-handed frame with an axis ``(3,)``."""
    if axis[2] == 1.0:
        return np.eye(3)[0], np.eye(3)[1]
    x = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    x /= np.linalg.norm(x)
    return x, np.cross(axis, x)
