"""What an input file of Abaqus or CalculiX declares in addition to its mesh: materials, conditions, contacts, steps and loads, by names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

from uem_dolfinx.arrays import Array
from uem_dolfinx.decks.by_sets import Closing, local_axes, node_of, nodes_of
from uem_dolfinx.decks.parts import (
    STEP_KINDS,
    TEMPERATURE,
    Acting,
    BodyLoad,
    Course,
    Interaction,
    Linear,
    Material,
    Model,
    Pair,
    Step,
    Value,
    together,
)  # fmt: skip
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.decks import Deck, numbers_of

#: Requests of output and settings of the solver, which have no part in the model.
OUTPUT = (
    "HEADING", "NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "NODE OUTPUT", "ELEMENT OUTPUT", "CONTACT PRINT", "CONTACT FILE",
    "CONTACT OUTPUT", "OUTPUT", "RESTART", "CONTROLS", "END STEP", "PREPRINT", "SECTION PRINT", "FILE FORMAT", "ENERGY PRINT",
)  # fmt: skip
#: Element types that lack nodes in the middle of faces and cells, or are integrated with fewer points or with incompatible modes.
OTHERWISE = r"\d[RI]|C3D20|C(PS|PE|AX)8"
#: Names of Abaqus for degrees of freedom that are held, from the first to the last.
NAMED_HOLDS = {"ENCASTRE": ("1", "6"), "PINNED": ("1", "3"), "XSYMM": ("1", "1"), "YSYMM": ("2", "2"), "ZSYMM": ("3", "3")}
#: Keywords of a material, and of an interaction, with one number.
NUMBERS = {
    "DENSITY": "density", "EXPANSION": "expansion", "CONDUCTIVITY": "conductivity", "SPECIFIC HEAT": "heat_capacity",
    "GAP CONDUCTANCE": "conductance",
}  # fmt: skip
#: Options that are taken, or that change nothing here; all others are left out.
KNOWN_OPTIONS = {
    "ELASTIC": "TYPE", "EXPANSION": "TYPE ZERO", "SOLID SECTION": "ELSET MATERIAL ORIENTATION OFFSET", "MATERIAL": "NAME",
    "SURFACE INTERACTION": "NAME", "SURFACE BEHAVIOR": "PRESSURE-OVERCLOSURE", "CONTACT PAIR": "INTERACTION TYPE ADJUST SMALL_SLIDING",
    "TIE": "NAME POSITION_TOLERANCE ADJUST", "PRE-TENSION SECTION": "SURFACE NODE", "INITIAL CONDITIONS": "TYPE",
    "STEP": "INC NLGEOM NAME PERTURBATION", "FREQUENCY": "SOLVER STORAGE EIGENSOLVER",
    "BOUNDARY": "OP AMPLITUDE", "CLOAD": "OP AMPLITUDE", "DLOAD": "OP AMPLITUDE",
    "DSLOAD": "OP AMPLITUDE", "AMPLITUDE": "NAME TIME",
    "RIGID BODY": "NSET ELSET REF_NODE ROT_NODE", "TRANSFORM": "NSET TYPE", "TEMPERATURE": "OP",
    "MODEL CHANGE": "TYPE ADD REMOVE", "CHANGE FRICTION": "INTERACTION", "STATIC": "SOLVER DIRECT",
    "HEAT TRANSFER": "SOLVER DIRECT STEADY_STATE", "DYNAMIC": "SOLVER DIRECT ALPHA", "DAMPING": "ALPHA BETA",
    "COUPLED TEMPERATURE-DISPLACEMENT": "SOLVER DIRECT STEADY_STATE",
}  # fmt: skip

Options: TypeAlias = dict[str, str]
Rows: TypeAlias = list[list[str]]


class _Reader:
    """Reads keywords one after the other, ``*NAME`` by ``read_name``; materials, interactions and steps collect what follows them."""

    def __init__(self, deck: Deck):
        self.model, self._deck = Model(types=deck.types), deck
        self._material, self._interaction, self._begin = Material(), Interaction(), Step()
        self._amplitudes: dict[str, Course] = {}
        self.axes: dict[int, Array] = {}  # local directions of nodes
        self._changed = ""  # the interaction whose friction a step changes
        self._perturbs = False
        self._step, self._dim = self._begin, 3 if any(name.startswith("C3D") for name in deck.types) else 2
        #: Kinds of conditions of this step, and what they have set.
        self._met, self._own = set[str](), set[tuple[str, Any, Any]]()
        self.sets: dict[tuple[str, int], None] = {}

    def take(self, keyword: str, options: Options, rows: Rows) -> bool:
        """Store the data of a keyword; whether it has a counterpart here."""
        if keyword == "FREQUENCY":
            # about the state of a static step, which changes nothing
            if self.model.steps and not self._perturbs:
                self.model.left_out.append("*FREQUENCY without PERTURBATION: about the state of the last step")
            self.model.modes, keyword, rows = int(rows[0][0]), "STATIC", []
        elif keyword in STEP_KINDS and self._perturbs:
            self.model.left_out.append("PERTURBATION of *STEP")
        if keyword in STEP_KINDS:
            times = [*numbers_of(rows[0] if rows else []), 0.0, 0.0]
            duration = times[1] or 1.0
            self._step.kind, self._step.first, self._step.duration = keyword, times[0] or duration, duration
            self._step.steady, self._step.direct = "STEADY STATE" in options, "DIRECT" in options
            self._step.alpha = float(options.get("ALPHA", self._step.alpha))
            if "EXPLICIT" in options:
                raise InputError("EXPLICIT: expected implicit steps of time")
            self.model.steps.append(self._step)
            return True
        if keyword in ("ELASTIC", *NUMBERS) and not (kind := options.get("TYPE", "ISO").upper()).startswith("ISO"):
            raise InputError(f"TYPE={kind}: expected ISO, an isotropic material")
        if keyword in NUMBERS:
            setattr(self._interaction if keyword.startswith("GAP") else self._material, NUMBERS[keyword], numbers_of(rows[0])[0])
            return len(rows) == 1
        # *DSLOAD is read as *DLOAD
        name = keyword.replace("DSLOAD", "DLOAD").replace(" ", "_").replace("-", "_").lower()
        reader: Callable[[Options, Rows], bool | None] | None = getattr(self, f"read_{name}", None)
        return reader is not None and reader(options, rows) is not False

    # -- materials and interactions --------------------------------------------------------------------------------------

    def read_material(self, options: Options, rows: Rows) -> None:
        name = options["NAME"].upper()
        self._material = self.model.materials.setdefault(name, Material(name))

    def read_elastic(self, options: Options, rows: Rows) -> bool:
        self._material.elastic = numbers_of(rows[0])[0], numbers_of(rows[0])[1]
        return len(rows) == 1

    def read_damping(self, options: Options, rows: Rows) -> None:
        self._material.damping = float(options.get("ALPHA", 0.0)), float(options.get("BETA", 0.0))

    def read_solid_section(self, options: Options, rows: Rows) -> None:
        plane = any(name.startswith(("CPS", "CPE")) for name in self.model.types)
        t = (plane and rows and numbers_of(rows[0])[0]) or 1.0
        if self.model.sections and t != self.model.thickness:
            raise InputError(f"thicknesses {self.model.thickness} and {t}: expected one for all plane bodies")
        self.model.thickness = t
        self.model.sections.append((options["ELSET"].upper(), options["MATERIAL"].upper()))

    def read_surface_interaction(self, options: Options, rows: Rows) -> None:
        self._interaction = self.model.interactions.setdefault(options["NAME"].upper(), Interaction())

    def read_surface_behavior(self, options: Options, rows: Rows) -> None:
        self._interaction.overclosure = options.get("PRESSURE-OVERCLOSURE", "HARD").upper()
        self._interaction.numbers = [numbers_of(row) for row in rows]

    def read_friction(self, options: Options, rows: Rows) -> None:
        mu = numbers_of(rows[0])[0]
        if self._step is self._begin:
            self._interaction.friction = mu
        elif not self._changed:
            raise InputError("it is in a step: expected *CHANGE FRICTION before it, with the INTERACTION that it changes")
        else:
            self._step.friction[self._changed] = mu

    def read_change_friction(self, options: Options, rows: Rows) -> None:
        self._changed = options["INTERACTION"].upper()
        if self._changed not in self.model.interactions:
            raise InputError(f"there is no interaction '{self._changed}': expected one of {', '.join(self.model.interactions)}")

    # -- the model -------------------------------------------------------------------------------------------------------

    def read_contact_pair(self, options: Options, rows: Rows) -> None:
        adjust: Any = options.get("ADJUST") or None
        if adjust is not None and adjust[0] not in ".0123456789":
            self.model.left_out.append(f"ADJUST={adjust} of *CONTACT PAIR: all contactors near the surface are adjusted")
            adjust = True
        for slave, master in (row[:2] for row in rows):
            self.model.pairs.append(
                Pair(
                    slave, master, options["INTERACTION"].upper(), not options.get("TYPE", "NODE").upper().startswith("NODE"),
                    "SMALL SLIDING" in options, float(adjust) if isinstance(adjust, str) else adjust,
                )
            )  # fmt: skip

    def read_tie(self, options: Options, rows: Rows) -> bool:
        if "CYCLIC SYMMETRY" in options or "MULTISTAGE" in options:
            return False
        reach = options.get("POSITION TOLERANCE")
        self.model.pairs += [Pair(row[0], row[1], adjust=float(reach) if reach else None, tied=True) for row in rows]
        return True

    def read_equation(self, options: Options, rows: Rows) -> None:
        left = [value for row in rows for value in row if value]
        while left:
            n, left = int(left[0]), left[1:]
            terms = [left[3 * k : 3 * k + 3] for k in range(n)]
            if any(not 1 <= int(dof) <= self._dim for _, dof, _ in terms):
                raise InputError(f"terms {terms}: expected degrees of freedom 1 to {self._dim}")
            self.model.equations.append(Linear([(node_of(self._deck, node), (int(dof), float(c))) for node, dof, c in terms]))
            left = left[3 * n :]

    def read_pre_tension_section(self, options: Options, rows: Rows) -> None:
        self.model.pretension.append((options["SURFACE"], int(options["NODE"]), numbers_of(rows[0])[:3] if rows else []))

    def read_initial_conditions(self, options: Options, rows: Rows) -> bool:
        if (kind := options["TYPE"].upper()) == "VELOCITY":
            self.model.velocities |= {(node_of(self._deck, row[0]), int(row[1])): numbers_of(row[2:])[0] for row in rows}
        elif kind == "TEMPERATURE":
            _last(self.model.initial, {node_of(self._deck, row[0]): numbers_of(row[1:])[0] for row in rows})
        return kind in ("VELOCITY", "TEMPERATURE")

    def read_rigid_body(self, options: Options, rows: Rows) -> None:
        at = int(options["REF NODE"])
        # without a node of its own, degrees of freedom 4 to 6 are rotations
        self.model.rigid.append(
            (options.get("NSET") or options["ELSET"], self._deck.nodes[at], at, int(options.get("ROT NODE", "0")))
        )

    def read_transform(self, options: Options, rows: Rows) -> None:
        kind, numbers = options.get("TYPE", "R").upper(), numbers_of([value for row in rows for value in row if value])
        if kind not in ("R", "C") or len(numbers) != 6:
            raise InputError(f"TYPE={kind} with {len(numbers)} numbers: expected R or C, with two points")
        for one in nodes_of(self._deck, options["NSET"]):
            self.axes[one] = local_axes(kind, numbers, self._deck.nodes[one])

    def read_amplitude(self, options: Options, rows: Rows) -> None:
        numbers = numbers_of([value for row in rows for value in row if value])
        points = tuple(zip(numbers[::2], numbers[1::2]))
        times = [time for time, _ in points]
        if "USER" in options or options.get("DEFINITION", "TABULAR").upper() != "TABULAR":
            raise InputError("an amplitude by a function: expected a table of times and amplitudes")
        if not points or len(numbers) % 2 or sorted(set(times)) != times:
            raise InputError(f"{len(numbers)} numbers, with the times {times}: expected pairs, and times that grow")
        total = options.get("TIME", "").upper().startswith("TOTAL")
        self._amplitudes[options["NAME"].upper()] = Course(1.0, points, total)

    def _value(self, text: str, options: Options) -> Value:
        """A number of a row, which follows the amplitude in the options, if there is one."""
        value, name = numbers_of([text])[0], options.get("AMPLITUDE", "").upper()
        if not name:
            return value
        if name not in self._amplitudes:
            raise InputError(f"there is no amplitude '{name}' before it: expected one of {', '.join(self._amplitudes)}")
        return replace(self._amplitudes[name], value=value)

    # -- steps -----------------------------------------------------------------------------------------------------------

    def read_step(self, options: Options, rows: Rows) -> None:
        last = self.model.steps[-1] if self.model.steps else self._begin
        self._met, self._own, self._changed, self._perturbs = set(), set(), "", "PERTURBATION" in options
        self._step = Step(
            nlgeom="NLGEOM" in options and options["NLGEOM"].upper() != "NO", held=_kept(last.held, last),
            forces=_kept(last.forces, last), pressures=_kept(last.pressures, last), bodies=_kept(last.bodies, last),
            temperatures=dict(last.temperatures),
        )  # fmt: skip

    def _begins(self, kind: str, options: Options, *acting: dict[Any, Any]) -> None:
        """Let the first keyword of a kind in a step end what acted before, with ``OP=NEW``."""
        for one in acting if options.get("OP", "MOD").upper() == "NEW" and kind not in self._met else ():
            one.clear()
        self._met.add(kind)

    def _add(self, kind: str, acting: Acting, where: tuple[Any, Any], value: Value) -> None:
        """A load replaces that of steps before, and adds to others of its step, which have the same amplitude."""
        acting[where] = together(acting[where], value, where[0]) if (kind, *where) in self._own else value
        self._own.add((kind, *where))

    def _has(self, where: str, dof: int, value: float, keyword: str) -> bool:
        """Whether a set has a degree of freedom; only reference nodes have rotations, and motions out of the plane."""
        if dof <= 6 and where.isdigit() and int(where) in self.model.references:
            return True
        if dof <= self._dim or (dof == TEMPERATURE and self.model.thermal):
            if dof < 1:
                raise InputError(f"degree of freedom {dof}: expected 1 to {self._dim}, or {TEMPERATURE}, the temperature")
            return True
        if value:
            self.model.left_out.append(f"degree of freedom {dof} of *{keyword}: the bodies have none such")
        return False

    def read_boundary(self, options: Options, rows: Rows) -> None:
        if "FIXED" in options:
            raise InputError("FIXED holds displacements that steps before have reached: expected values")
        self._begins("BOUNDARY", options, self._step.held)
        for row in rows:
            where, first, last, value = [*row, "", ""][:4]
            first, last = NAMED_HOLDS.get(first.upper(), (first, last))
            for dof in range(int(first), int(last or first) + 1):
                if self._has(where, dof, numbers_of([value])[0], "BOUNDARY"):
                    self.sets[where, dof] = None
                    self._step.held |= {(one, dof): self._value(value, options) for one in nodes_of(self._deck, where)}

    def read_cload(self, options: Options, rows: Rows) -> None:
        self._begins("CLOAD", options, self._step.forces)
        for where, dof, value in (row[:3] for row in rows):
            if self._has(where, int(dof), numbers_of([value])[0], "CLOAD"):
                for one in nodes_of(self._deck, where):
                    self._add("CLOAD", self._step.forces, (one, int(dof)), self._value(value, options))

    def read_dload(self, options: Options, rows: Rows) -> bool:
        self._begins("DLOAD", options, self._step.pressures, self._step.bodies)
        of_bodies = [row for row in rows if row[1].upper() in ("GRAV", "CENTRIF")]
        for elements, label, value, *numbers in of_bodies:
            if elements.isdigit():
                self._deck.elsets.setdefault(f"ELEMENT {elements}", (f"element {elements}", [int(elements)]))
            where = f"element {elements}" if elements.isdigit() else elements, BodyLoad.of(label.upper(), numbers_of(numbers))
            self._add("DLOAD", self._step.bodies, where, self._value(value, options))
        pressing = [row for row in rows if re.fullmatch(r"P\d?", row[1].upper())]
        for name, label, value in (row[:3] for row in pressing):
            of_elements, sides = self._deck.surfaces.get(name, (False, []))
            if label[1:] or not (of_elements and all(side for _, side in sides)):
                sides = [[name, f"S{label[1:]}" if label[1:] else ""]]
            for member, side in sides:
                own = self._deck.elsets.get(member.upper(), ("", [member]))[1] if side else [member]
                for one in own:
                    self._add("DLOAD", self._step.pressures, (str(one), side.upper()), self._value(value, options))
        return len(pressing) + len(of_bodies) == len(rows)

    def read_temperature(self, options: Options, rows: Rows) -> None:
        self._begins("TEMPERATURE", options, self._step.temperatures)
        _last(self._step.temperatures, {node_of(self._deck, row[0]): numbers_of(row[1:])[0] for row in rows})

    def read_model_change(self, options: Options, rows: Rows) -> bool:
        if options.get("TYPE", "").upper() != "CONTACT PAIR":
            return False
        self._step.contacts |= {(row[0].upper(), row[1].upper()): "ADD" in options for row in rows}
        return True


def _kept(acting: Acting, last: Step) -> Acting:
    """Values that act on after a step: values that followed its time stay as they were at its end."""
    followed = {w: v.at(last.duration, 0.0) for w, v in acting.items() if isinstance(v, Course) and not v.total}
    return acting | followed


def _last(values: dict[str, float], more: dict[str, float]) -> None:
    """Let more values follow all others: sets may have nodes in common."""
    for name, value in more.items():
        values.pop(name, None)
        values[name] = value


def model_of(deck: Deck) -> Model:
    """Read the keywords of a deck that are not of its mesh, and name the nodes and sides that they mention as sets and surfaces.

    Raises InputError for a keyword that cannot be read, or a deck without a step that is taken.
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
            continue
        unknown = [name for name in options if name and name.replace(" ", "_") not in KNOWN_OPTIONS.get(keyword, "").split()]
        left_out += [f"{name} of *{keyword}" for name in unknown]
    left_out += [f"{n} elements of type {name}: they are no part of a body" for name, n in deck.left_out.items()]
    left_out += [f"{name}: complete cells, integrated fully" for name in sorted(deck.types) if re.search(OTHERWISE, name)]
    if reader.model.thickness != 1.0:
        left_out.append(f"thickness {reader.model.thickness}: forces of contacts and sections are those of a thickness of 1")
    if not reader.model.steps:
        raise InputError(f"the deck has no step that can be taken: expected *STEP with one of {', '.join(STEP_KINDS)}, FREQUENCY")
    Closing(deck, reader.model, reader.sets, reader.axes).close()
    left_out[:] = dict.fromkeys(left_out)
    return reader.model
