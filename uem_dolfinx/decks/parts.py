"""What decks declare: materials, interactions, pairs and steps, by names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import ufl

from uem_dolfinx.contact.laws.soft import Exponential, SoftContact
from uem_dolfinx.errors import InputError

#: Kinds of steps that are taken, and whether they have temperatures among their unknowns.
STEP_KINDS = {"STATIC": False, "COUPLED TEMPERATURE-DISPLACEMENT": True, "HEAT TRANSFER": True, "DYNAMIC": False}
#: Number of the temperature among the degrees of freedom. [format; number; -]
TEMPERATURE = 11
#: Steps of time of heat grow by this factor, up to a tenth of the step's duration.
#: [convention; length of the step of time before; test_deck_runs.py::test_heat_in_steps_of_time]
LONGER = 1.5
#: Steps that are longer by less than this part are equally long. [bound; length of the step; -]
SAME_LENGTH = 1e-6
#: Number of steps of time of the greatest length.
#: [convention; duration of the step; test_deck_runs.py::test_heat_in_steps_of_time]
LEAST_STEPS = 10

#: A set by name, or a reference node by number, and a degree of freedom, or the label of a load.
Where: TypeAlias = tuple[Any, Any]


@dataclass(frozen=True)
class Course:
    """A value that follows an amplitude: linear between its points, constant beyond them."""

    value: float  # at the amplitude 1
    points: tuple[tuple[float, float], ...]  # times and amplitudes
    total: bool = False  # whether times are those since the start of the first step, not of its own

    def at(self, time: float, total: float) -> float:
        """The value at a time of the step and in all."""
        return self.value * float(np.interp(total if self.total else time, *np.transpose(self.points)))

    def __mul__(self, factor: float) -> Course:
        """The value times a number."""
        return replace(self, value=self.value * factor)


#: A value at the end of a step, to which it grows in proportion to time, or one that follows an amplitude.
Value: TypeAlias = float | Course
#: Values at single nodes, or sides of elements, in turn with the same of a step.
Acting: TypeAlias = dict[tuple[Any, Any], Value]


def together(one: Value, other: Value, where: Any) -> Value:
    """The sum of two values at a place; InputError for two amplitudes."""
    if not isinstance(one, Course) and not isinstance(other, Course):
        return one + other
    if one == 0.0 or other == 0.0:
        return other if one == 0.0 else one
    if isinstance(one, Course) and isinstance(other, Course) and replace(one, value=other.value) == other:
        return replace(one, value=one.value + other.value)
    raise InputError(f"loads of two amplitudes act at {where}: expected one")


@dataclass(frozen=True)
class BodyLoad:
    """A load on the mass of elements."""

    label: str  # ``"GRAV"`` along a direction, or ``"CENTRIF"`` away from an axis
    numbers: tuple[float, ...]  # a point of the axis ``(3,)``, and its direction, or that of gravity, of length 1

    @staticmethod
    def of(label: str, numbers: list[float]) -> BodyLoad:
        """From the numbers of a row; InputError for a direction of no length."""
        n = 3 if label == "GRAV" else 6
        numbers = [*numbers, *6 * [0.0]][:n]
        length = float(np.linalg.norm(numbers[-3:]))
        if not length:
            raise InputError(f"{label} along {numbers[-3:]}: expected a direction")
        return BodyLoad(label, (*numbers[:-3], *(value / length for value in numbers[-3:])))

    def acceleration(self, x: Any) -> Any:
        """At positions x, an expression, for a value of 1, which about an axis is the square of a speed."""
        g, along = len(x), ufl.as_vector(self.numbers[-3:])
        if self.label == "CENTRIF":
            arm = ufl.as_vector([(x[c] if c < g else 0.0) - self.numbers[c] for c in range(3)])
            along = arm - ufl.dot(arm, along) * along
        return ufl.as_vector([along[c] for c in range(g)])


@dataclass
class Material:
    """Numbers of a material; None are not given."""

    name: str = ""
    elastic: tuple[float, float] | None = None
    density: float = 0.0
    expansion: float = 0.0
    conductivity: float | None = None
    heat_capacity: float = 0.0
    damping: tuple[float, float] = (0.0, 0.0)  # parts of mass and of stiffness that damp


@dataclass
class Interaction:
    """A surface interaction: its law of pressure with its numbers, friction and conductance."""

    overclosure: str = "HARD"
    numbers: list[list[float]] = field(default_factory=list)
    friction: float = 0.0
    conductance: float = 0.0

    def soft(self) -> SoftContact:
        """Its law of pressure; InputError for another word than those of CalculiX."""
        first, *rest = self.numbers[0]
        if self.overclosure == "LINEAR":
            return SoftContact(first)
        if self.overclosure == "EXPONENTIAL":
            # the pressure at c0 is a hundredth of p0
            return SoftContact(Exponential(p0=rest[0], h=first / np.log(100.0)))
        if self.overclosure == "TABULAR":
            return SoftContact(sorted((-overclosure, p) for p, overclosure in self.numbers))
        raise InputError(f"PRESSURE-OVERCLOSURE = {self.overclosure}: expected HARD, LINEAR, EXPONENTIAL, TABULAR or TIED")


@dataclass
class Pair:
    """A contact pair or a tie."""

    slave: str
    master: str
    interaction: str = ""
    surfaces: bool = True
    small: bool = False
    adjust: float | bool | None = None
    tied: bool = False


@dataclass
class Linear:
    """A linear equation: sets or nodes with degree of freedom and coefficient, or with vectors, and values in all steps if any."""

    terms: list[tuple[str, Any]]
    values: list[Value] = field(default_factory=list)


@dataclass
class Step:
    """A step: its kind, times, and all conditions and loads that act in it, with their values at its end."""

    kind: str = "STATIC"
    nlgeom: bool = False
    first: float = 1.0
    duration: float = 1.0
    steady: bool = False
    direct: bool = False
    alpha: float = -0.05  # of the Hilber-Hughes-Taylor method, in ``*DYNAMIC``
    held: dict[Where, Value] = field(default_factory=dict)
    forces: dict[Where, Value] = field(default_factory=dict)  # for a thickness of 1
    pressures: dict[Where, Value] = field(default_factory=dict)
    bodies: dict[tuple[str, BodyLoad], Value] = field(default_factory=dict)
    temperatures: dict[str, float] = field(default_factory=dict)
    contacts: dict[tuple[str, str], bool] = field(default_factory=dict)
    friction: dict[str, float] = field(default_factory=dict)  # coefficients that change, by the names of interactions

    def times(self) -> Iterator[tuple[float, float]]:
        """Beginnings and ends of steps of time, which grow."""
        time, dt = 0.0, self.first
        while time < self.duration:
            dt = self.first if self.direct else min(dt, self.duration / LEAST_STEPS)
            end = time + dt if time + (1.0 + SAME_LENGTH) * dt < self.duration else self.duration
            yield time, end
            time, dt = end, dt * LONGER


@dataclass
class Model:
    """All of a deck but its mesh; names of sets are in capitals."""

    types: set[str] = field(default_factory=set)
    materials: dict[str, Material] = field(default_factory=dict)
    interactions: dict[str, Interaction] = field(default_factory=dict)
    sections: list[tuple[str, str]] = field(default_factory=list)  # set of elements and material of each section
    thickness: float = 1.0  # of plane bodies
    pairs: list[Pair] = field(default_factory=list)
    equations: list[Linear] = field(default_factory=list)  # linear equations among nodes
    initial: dict[str, float] = field(default_factory=dict)  # temperatures at the start, by set or node
    velocities: dict[tuple[str, int], float] = field(default_factory=dict)  # at the start, by set or node, and degree of freedom
    #: set, position, and nodes of translation and rotation of each rigid body.
    rigid: list[tuple[str, list[float], int, int]] = field(default_factory=list)
    #: surface, reference node and axis of each section of a bolt.
    pretension: list[tuple[str, int, list[float]]] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    modes: int = 0  # number of vibrations that are wanted after the last step; 0 for none
    left_out: list[str] = field(default_factory=list)  # what has no counterpart here, or is read otherwise than it stands

    @property
    def references(self) -> set[int]:
        """Reference nodes of rigid bodies and of sections of bolts."""
        return {node for _, _, *nodes in self.rigid for node in nodes} | {node for _, node, _ in self.pretension}

    @property
    def thermal(self) -> bool:
        """Whether temperatures are unknown."""
        return any(STEP_KINDS[step.kind] for step in self.steps)
