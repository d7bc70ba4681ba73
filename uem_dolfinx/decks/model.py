"""What an input file of Abaqus or CalculiX declares beside its mesh: materials, conditions, contacts, steps and loads, by names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.decks import Deck

#: Requests of output and settings of the solver, which have no part in the model.
OUTPUT = (
    "HEADING", "NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "NODE OUTPUT", "ELEMENT OUTPUT", "CONTACT PRINT", "CONTACT FILE",
    "CONTACT OUTPUT", "OUTPUT", "RESTART", "CONTROLS", "END STEP", "PREPRINT", "SECTION PRINT", "FILE FORMAT", "ENERGY PRINT",
)  # fmt: skip
#: Kinds of steps that are taken, and whether they have temperatures among their unknowns.
KINDS = {"STATIC": False, "COUPLED TEMPERATURE-DISPLACEMENT": True, "HEAT TRANSFER": True}
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
    adjust: float | None = None
    tied: bool = False


@dataclass
class Step:
    """A step: its kind, times, and all conditions and loads that act in it, with their values at its end."""

    kind: str = "STATIC"
    nlgeom: bool = False
    first: float = 1.0
    duration: float = 1.0
    steady: bool = False
    held: dict[Where, float] = field(default_factory=dict)
    forces: dict[Where, float] = field(default_factory=dict)
    pressures: dict[Where, float] = field(default_factory=dict)
    temperatures: dict[str, float] = field(default_factory=dict)
    contacts: dict[tuple[str, str], bool] = field(default_factory=dict)


@dataclass
class Model:
    """All of a deck but its mesh; names of sets are in capitals.

    Attributes:
        sections: set of elements and material of each section.
        equations: lists of node, degree of freedom and coefficient.
        initial: temperatures at the start, by set or node.
        pretension: surface, reference node and axis of each section of a bolt.
        left_out: what has no counterpart here, or is read otherwise than it stands.
    """

    types: set[str] = field(default_factory=set)
    materials: dict[str, Material] = field(default_factory=dict)
    interactions: dict[str, Interaction] = field(default_factory=dict)
    sections: list[tuple[str, str]] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)
    equations: list[list[tuple[str, int, float]]] = field(default_factory=list)
    initial: dict[str, float] = field(default_factory=dict)
    pretension: list[tuple[str, str, list[float]]] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def thermal(self) -> bool:
        """Whether temperatures are unknown."""
        return any(KINDS[step.kind] for step in self.steps)


class _Reader:
    """Reads keywords one after the other; materials, interactions and steps collect what follows them."""

    def __init__(self, deck: Deck):
        self.model, self._deck = Model(types=deck.types), deck
        self._material, self._interaction, self._begin = Material(), Interaction(), Step()
        self._step = self._begin
        self._readers: dict[str, Callable[[dict[str, str], list[list[str]]], bool | None]] = {
            "MATERIAL": self._of_material, "ELASTIC": self._elastic, "DENSITY": self._number("density"),
            "EXPANSION": self._number("expansion"), "CONDUCTIVITY": self._number("conductivity"),
            "SPECIFIC HEAT": self._number("heat_capacity"), "SOLID SECTION": self._section,
            "SURFACE INTERACTION": self._of_interaction, "SURFACE BEHAVIOR": self._behaviour, "FRICTION": self._friction,
            "GAP CONDUCTANCE": self._conductance, "CONTACT PAIR": self._pair, "TIE": self._tie, "EQUATION": self._equation,
            "PRE-TENSION SECTION": self._pretension, "INITIAL CONDITIONS": self._initial, "STEP": self._new_step,
            "BOUNDARY": self._boundary, "CLOAD": self._cload, "DLOAD": self._dload, "DSLOAD": self._dload,
            "TEMPERATURE": self._temperature, "MODEL CHANGE": self._change,
        }  # fmt: skip

    def take(self, keyword: str, options: dict[str, str], rows: list[list[str]]) -> bool:
        """Store the data of a keyword; whether it has a counterpart here."""
        if keyword in KINDS:
            times = [*_numbers(rows[0] if rows else []), 0.0, 0.0]
            duration = times[1] or 1.0
            self._step.kind, self._step.first, self._step.duration = keyword, times[0] or duration, duration
            self._step.steady = "STEADY STATE" in options
            self.model.steps.append(self._step)
            return True
        reader = self._readers.get(keyword)
        return reader is not None and reader(options, rows) is not False

    # -- materials and interactions --------------------------------------------------------------------------------------

    def _of_material(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self._material = self.model.materials.setdefault(options["NAME"].upper(), Material())

    def _elastic(self, options: dict[str, str], rows: list[list[str]]) -> bool:
        E, nu = _numbers(rows[0])[:2]
        self._material.elastic = E, nu
        return options.get("TYPE", "ISO").upper().startswith("ISO") and len(rows) == 1

    def _number(self, what: str) -> Callable[[dict[str, str], list[list[str]]], bool]:
        def read(options: dict[str, str], rows: list[list[str]]) -> bool:
            setattr(self._material, what, _numbers(rows[0])[0])
            return len(rows) == 1

        return read

    def _section(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self.model.sections.append((options["ELSET"].upper(), options["MATERIAL"].upper()))

    def _of_interaction(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self._interaction = self.model.interactions.setdefault(options["NAME"].upper(), Interaction())

    def _behaviour(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self._interaction.overclosure = options.get("PRESSURE-OVERCLOSURE", "HARD").upper()
        self._interaction.numbers = [_numbers(row) for row in rows]

    def _friction(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self._interaction.friction = _numbers(rows[0])[0]

    def _conductance(self, options: dict[str, str], rows: list[list[str]]) -> bool:
        self._interaction.conductance = [_numbers(row) for row in rows]
        return len(rows) == 1

    # -- the model -------------------------------------------------------------------------------------------------------

    def _pair(self, options: dict[str, str], rows: list[list[str]]) -> None:
        adjust = options.get("ADJUST")
        for slave, master in (row[:2] for row in rows):
            self.model.pairs.append(
                Pair(
                    slave, master, options["INTERACTION"].upper(), not options.get("TYPE", "NODE").upper().startswith("NODE"),
                    "SMALL SLIDING" in options, float(adjust) if adjust and adjust[0] in ".0123456789" else None,
                )
            )  # fmt: skip

    def _tie(self, options: dict[str, str], rows: list[list[str]]) -> None:
        reach = options.get("POSITION TOLERANCE")
        self.model.pairs += [Pair(row[0], row[1], adjust=float(reach) if reach else None, tied=True) for row in rows]

    def _equation(self, options: dict[str, str], rows: list[list[str]]) -> None:
        left = [value for row in rows for value in row if value]
        while left:
            n, left = int(left[0]), left[1:]
            terms = [left[3 * k : 3 * k + 3] for k in range(n)]
            self.model.equations.append([(self._node(node), int(dof), float(c)) for node, dof, c in terms])
            left = left[3 * n :]

    def _pretension(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self.model.pretension.append((options["SURFACE"], options["NODE"], _numbers(rows[0])[:3] if rows else []))

    def _initial(self, options: dict[str, str], rows: list[list[str]]) -> bool:
        if options["TYPE"].upper() != "TEMPERATURE":
            return False
        self.model.initial |= {self._node(row[0]): _numbers(row[1:])[0] for row in rows}
        return True

    # -- steps -----------------------------------------------------------------------------------------------------------

    def _new_step(self, options: dict[str, str], rows: list[list[str]]) -> None:
        last = self.model.steps[-1] if self.model.steps else self._begin
        self._step = Step(
            nlgeom="NLGEOM" in options and options["NLGEOM"].upper() != "NO", held=dict(last.held), forces=dict(last.forces),
            pressures=dict(last.pressures), temperatures=dict(last.temperatures),
        )  # fmt: skip

    def _boundary(self, options: dict[str, str], rows: list[list[str]]) -> None:
        held = self._step.held
        if options.get("OP", "MOD").upper() == "NEW":
            held.clear()
            held |= self._begin.held
        for row in rows:
            where, first, last, value = [*row, "", ""][:4]
            for dof in range(int(first), int(last or first) + 1):
                held[self._node(where), dof] = _numbers([value])[0]

    def _cload(self, options: dict[str, str], rows: list[list[str]]) -> None:
        if options.get("OP", "MOD").upper() == "NEW":
            self._step.forces.clear()
        for where, dof, value in (row[:3] for row in rows):
            name = self._node(where)
            if name == where and name.upper() in self._deck.nsets:
                # a set may be a surface, and these are forces at its nodes
                name = f"nodes of {where}"
                self._deck.nsets[name.upper()] = (name, self._deck.nsets[where.upper()][1])
                self._deck.loaded.add(name)
            self._step.forces[name, int(dof)] = _numbers([value])[0]

    def _dload(self, options: dict[str, str], rows: list[list[str]]) -> bool:
        pressures = self._step.pressures
        if options.get("OP", "MOD").upper() == "NEW":
            pressures.clear()
        pressing = [row for row in rows if row[1].upper().startswith("P") and row[1].upper() != "PNU"]
        for value in dict.fromkeys(row[2] for row in pressing):
            sides = [[row[0], f"S{row[1][1:]}" if len(row[1]) > 1 else ""] for row in pressing if row[2] == value]
            # sides with one pressure are one surface
            same = [name for name, (_, own) in self._deck.surfaces.items() if name.startswith("pressed ") and own == sides]
            name = (
                sides[0][0] if len(sides) == 1 and not sides[0][1] else same[0] if same else f"pressed {len(self._deck.surfaces)}"
            )
            if name.startswith("pressed "):
                self._deck.surfaces[name] = (True, sides)
            pressures[name, "P"] = _numbers([value])[0]
        return len(pressing) == len(rows)

    def _temperature(self, options: dict[str, str], rows: list[list[str]]) -> None:
        self._step.temperatures |= {self._node(row[0]): _numbers(row[1:])[0] for row in rows}

    def _change(self, options: dict[str, str], rows: list[list[str]]) -> bool:
        if options.get("TYPE", "").upper() != "CONTACT PAIR":
            return False
        self._step.contacts |= {(row[0].upper(), row[1].upper()): "ADD" in options for row in rows}
        return True

    def _node(self, where: str) -> str:
        """A set as it is, and a node as the set of its own."""
        if not where.isdigit():
            return where
        # reference nodes of sections belong to no body
        return self._deck.name_node(int(where)) if int(where) in self._deck.nodes else f"node {int(where)}"


def model_of(deck: Deck) -> Model:
    """Read the keywords of a deck beside its mesh, and name the nodes and sides that they mention as sets and surfaces.

    Raises:
        InputError: for a keyword that cannot be read, or a deck without a step that is taken.
    """
    reader = _Reader(deck)
    left_out = reader.model.left_out
    for keyword, options, rows in deck.cards:
        if keyword in OUTPUT:
            continue
        try:
            taken = reader.take(keyword, options, rows)
        except (ValueError, KeyError, IndexError) as error:
            raise InputError(f"cannot read *{keyword} {', '.join(f'{k}={v}' for k, v in options.items())}: {error}") from error
        if not taken:
            left_out.append(f"*{keyword}")
        elif "AMPLITUDE" in options:
            left_out.append(f"AMPLITUDE of *{keyword}: values grow in proportion to the time of the step")
    left_out[:] = dict.fromkeys(left_out)
    if not reader.model.steps:
        raise InputError(f"the deck has no step that can be taken: expected *STEP with one of {', '.join(KINDS)}")
    return reader.model


def _numbers(row: list[str]) -> list[float]:
    """Numbers of a row; empty places are 0."""
    return [float(value.lower().replace("d", "e") or 0.0) for value in row]
