"""What decks declare: materials, interactions, pairs and steps, by names."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

#: Kinds of steps that are taken, and whether they have temperatures among their unknowns.
STEP_KINDS = {"STATIC": False, "COUPLED TEMPERATURE-DISPLACEMENT": True, "HEAT TRANSFER": True}
#: Number of the temperature among the degrees of freedom.
#: [format; number; -]
TEMPERATURE = 11

#: A set or a node, by name, and a degree of freedom, or the label of a load.
Where: TypeAlias = tuple[str, Any]


@dataclass
class Material:
    """Numbers of a material; None are not given."""

    elastic: tuple[float, float] | None = None
    density: float = 0.0
    expansion: float = 0.0
    conductivity: float | None = None
    heat_capacity: float = 0.0


@dataclass
class Interaction:
    """A surface interaction: its law of pressure with its numbers, friction and conductance."""

    overclosure: str = "HARD"
    numbers: list[list[float]] = field(default_factory=list)
    friction: float = 0.0
    conductance: list[list[float]] = field(default_factory=list)


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
class Step:
    """A step: its kind, times, and all conditions and loads that act in it, with their values at its end.

    Attributes:
        friction: coefficients that change, by the names of interactions.
    """

    kind: str = "STATIC"
    nlgeom: bool = False
    first: float = 1.0
    duration: float = 1.0
    steady: bool = False
    direct: bool = False
    held: dict[Where, float] = field(default_factory=dict)
    forces: dict[Where, float] = field(default_factory=dict)
    pressures: dict[Where, float] = field(default_factory=dict)
    temperatures: dict[str, float] = field(default_factory=dict)
    contacts: dict[tuple[str, str], bool] = field(default_factory=dict)
    friction: dict[str, float] = field(default_factory=dict)


@dataclass
class Model:
    """All of a deck but its mesh; names of sets are in capitals.

    Attributes:
        sections: set of elements and material of each section.
        thickness: of plane bodies.
        equations: lists of node, degree of freedom and coefficient.
        initial: temperatures at the start, by set or node.
        pretension: surface, reference node and axis of each section of a bolt.
        left_out: what has no counterpart here, or is read otherwise than it stands.
    """

    types: set[str] = field(default_factory=set)
    materials: dict[str, Material] = field(default_factory=dict)
    interactions: dict[str, Interaction] = field(default_factory=dict)
    sections: list[tuple[str, str]] = field(default_factory=list)
    thickness: float = 1.0
    pairs: list[Pair] = field(default_factory=list)
    equations: list[list[tuple[str, int, float]]] = field(default_factory=list)
    initial: dict[str, float] = field(default_factory=dict)
    pretension: list[tuple[str, str, list[float]]] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def thermal(self) -> bool:
        """Whether temperatures are unknown."""
        return any(STEP_KINDS[step.kind] for step in self.steps)
