"""The mesh in an input file of Abaqus or CalculiX: nodes, elements, and sets of nodes, of elements and of their sides.

The keywords ``*NODE``, ``*ELEMENT``, ``*NSET``, ``*ELSET``, ``*SURFACE`` and ``*INCLUDE`` are read. Keywords that create nodes or
elements are refused, and all others are kept as they stand, for ``uem_dolfinx.decks``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from uem_dolfinx.arrays import Ints
from uem_dolfinx.errors import MeshError
from uem_dolfinx.geometry.found import KINDS, Block, Found
from uem_dolfinx.log import logger

#: Families of element types, and the kind by the digits after the name: solids; plane bodies, shells and membranes; lines.
FAMILIES = (
    (r"(?:C3D|DC3D|AC3D)(\d+)[A-Z]*", {
        4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13", 15: "wedge15", 20: "hexahedron20",
    }),
    (r"(?:CPS|CPE|CPEG|CAX|CGAX|DC2D|DCAX|AC2D|ACAX|M3D|SFM3D|S|STRI|R3D|DS)(\d)[A-Z0-9]*", {
        3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9",
    }),
    (r"(?:T2D|T3D|DC1D|R2D|RAX)(\d)[A-Z]*", {2: "line", 3: "line3"}),
    (r"(?:B2|B3|PIPE2|PIPE3|SAX|MAX)(\d)[A-Z]*", {1: "line", 2: "line3", 3: "line"}),
)  # fmt: skip
#: Element types that are not part of a body.
BESIDE = r"(?:SPRING|DASHPOT|MASS|ROTARYI|HEATCAP|GAP|CONN|DCOUP|FRAME|JOINT|ITT|ISL|DRAG|US?\d).*|D"
#: Keywords that create or move nodes and elements.
MAKING = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "SUBMODEL")
NODES_OF = {"line": 2, "line3": 3} | {
    name: int(digits or KINDS[name.rstrip("0123456789")].vertices)
    for _, kinds in FAMILIES[:2]
    for name in kinds.values()
    for digits in [re.sub(r"\D", "", name)]
}


#: A keyword and its options in capitals, and its data rows.
Card: TypeAlias = tuple[str, dict[str, str], list[list[str]]]


@dataclass
class Deck:
    """Data read from a file, by its numbers and names; names of sets are case-insensitive.

    Attributes:
        nodes: positions.
        elements: kinds, and numbers of nodes.
        nsets: names and numbers of nodes, by the name in capitals; ``elsets`` the same for elements.
        surfaces: names, whether of elements, and pairs of a member and a side.
        left_out: number of elements of each type that is not part of a body; ``others`` are the numbers of these elements.
        parts: numbers of parts and of instances.
        types: types of the elements that are parts of bodies.
        cards: keywords that are no part of the mesh, in order, with options and rows.
        loaded: names of sets of nodes that are points, even if they have all nodes of facets.
    """

    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, tuple[str, list[int]]] = field(default_factory=dict)
    nsets: dict[str, tuple[str, list[int]]] = field(default_factory=dict)
    elsets: dict[str, tuple[str, list[int]]] = field(default_factory=dict)
    surfaces: dict[str, tuple[bool, list[list[str]]]] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    others: set[int] = field(default_factory=set)
    parts: dict[str, int] = field(default_factory=dict)
    types: set[str] = field(default_factory=set)
    cards: list[Card] = field(default_factory=list)
    loaded: set[str] = field(default_factory=set)

    def name_node(self, number: int) -> str:
        """Name of a set that has this node alone, which is made."""
        name = f"node {number}"
        self.nsets.setdefault(name.upper(), (name, [number]))
        return name


def read_found(path: Path, nodes: Sequence[int] = ()) -> Found:
    """Read the mesh of an input file, with some ``nodes`` as sets of their own; MeshError if it cannot be read."""
    deck = read_numbers(path)
    for node in nodes:
        deck.name_node(node)
    return found_of(deck, path)


def read_numbers(path: Path) -> Deck:
    """Read the numbers and names of an input file; MeshError if it cannot be read."""
    deck = Deck()
    for keyword, options, rows in _keywords(path):
        try:
            _take(deck, keyword, options, rows)
        except (ValueError, KeyError, IndexError) as error:
            raise MeshError(
                f"{path}: cannot read *{keyword} {', '.join(f'{k}={v}' for k, v in options.items())}: {error}"
            ) from error
    if not deck.elements:
        raise MeshError(f"{path} has no *ELEMENT that is a part of a body: expected an input file of Abaqus or CalculiX")
    if deck.left_out:
        what = ", ".join(f"{n} of type {name}" for name, n in deck.left_out.items())
        logger.info("%s: elements that are no part of a body are left out: %s", path, what)
    return deck


def found_of(deck: Deck, path: Path) -> Found:
    """The mesh of a deck, without its numbers; MeshError for sets and surfaces of what does not exist."""
    try:
        return _found(deck)
    except (KeyError, ValueError) as error:
        raise MeshError(f"{path}: {error.args[0] if error.args else error}") from error


def _keywords(path: Path, around: tuple[Path, ...] = ()) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """Keywords and options in capitals, with data rows, of a file and those it includes; MeshError if one is missing or includes itself."""
    keyword, options, rows = "", dict[str, str](), list[list[str]]()
    lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())
    for line in lines:
        text = line.strip()
        if not text or text.startswith("**"):
            continue
        if not text.startswith("*"):
            rows.append([part.strip() for part in text.split(",")])
            continue
        while text.endswith(","):
            text += next(lines, "").strip() or " "
        yield keyword, options, rows
        parts = [part.partition("=") for part in text[1:].split(",")]
        keyword, rows = parts[0][0].strip().upper(), []
        options = {name.strip().upper(): value.strip().strip('"') for name, _, value in parts[1:]}
        if keyword == "INCLUDE":
            included, around_it = path.parent / options.get("INPUT", ""), (*around, path.resolve())
            if not included.is_file():
                raise MeshError(f"{path} includes '{options.get('INPUT', '')}', which is not in its folder")
            if included.resolve() in around_it:
                raise MeshError(f"{path} includes '{included.name}', which it is included by: leave that line out")
            yield from _keywords(included, around_it)
    yield keyword, options, rows


def _take(deck: Deck, keyword: str, options: dict[str, str], rows: list[list[str]]) -> None:
    """Store the data of a keyword."""
    if keyword in ("PART", "INSTANCE"):
        # a single part in its own position is the model
        deck.parts[keyword] = deck.parts.get(keyword, 0) + 1
        if deck.parts[keyword] > 1 or (keyword == "INSTANCE" and rows):
            raise ValueError(
                "several parts, or one that is moved, number their nodes anew: write the model as one flat input file"
            )
    if keyword in MAKING:
        raise ValueError("it makes or moves nodes or elements: write them out")
    if keyword == "NODE":
        of_block = [int(row[0]) for row in rows]
        for row in rows:
            x = numbers_of(row[1:4])
            _once(deck.nodes, "node", int(row[0]), x + [0.0] * (3 - len(x)))
        if "NSET" in options:
            _named(deck.nsets, options["NSET"]).extend(of_block)
    elif keyword == "ELEMENT":
        _elements(deck, options, rows)
    elif keyword in ("NSET", "ELSET"):
        sets = deck.nsets if keyword == "NSET" else deck.elsets
        members = _named(sets, options[keyword])
        for row in rows:
            values = [value for value in row if value]
            if "GENERATE" in options:
                members.extend(_generated(*map(int, values)))
            else:
                members.extend(number for value in values for number in _members(sets, value))
    elif keyword == "SURFACE":
        of_elements = options.get("TYPE", "ELEMENT").upper() == "ELEMENT"
        deck.surfaces[options["NAME"]] = (of_elements, [[*row, ""][:2] for row in rows])
    elif keyword:
        deck.cards.append((keyword, options, rows))


def numbers_of(row: list[str]) -> list[float]:
    """Numbers of a row; empty places are 0."""
    return [float(value.lower().replace("d", "e") or 0.0) for value in row]


def _generated(first: int, last: int, step: int = 1) -> range:
    """Numbers from the first to the last one."""
    if last < first or step < 1:
        raise ValueError(
            f"GENERATE from {first} to {last} by {step} gives no number: expected first <= last, and a step of 1 or more"
        )
    return range(first, last + 1, step)


def _once(known: dict[int, Any], what: str, number: int, value: Any) -> None:
    """Store a node or an element with a unique number."""
    if known.setdefault(number, value) != value:
        raise ValueError(f"there are two {what}s {number}, as in an assembly: write the model as one flat input file")


def _named(sets: dict[str, tuple[str, list[int]]], name: str) -> list[int]:
    """Members of a set, which is created if necessary."""
    return sets.setdefault(name.upper(), (name, []))[1]


def _members(sets: dict[str, tuple[str, list[int]]], value: str) -> list[int]:
    """A number, or the numbers of a set."""
    if value.lstrip("+-").isdigit():
        return [int(value)]
    if value.upper() not in sets:
        raise ValueError(f"there is no set '{value}' before it")
    return sets[value.upper()][1]


def _elements(deck: Deck, options: dict[str, str], lines: list[list[str]]) -> None:
    """Store elements of one type."""
    name = options["TYPE"].upper()
    for pattern, kinds in FAMILIES:
        match = re.fullmatch(pattern, name)
        kind = None if match is None else kinds.get(int(match[1]))
        if kind is not None:
            break
    else:
        if re.fullmatch(BESIDE, name) is None:
            raise ValueError(f"the element type {name} is not known")
        deck.left_out[name] = deck.left_out.get(name, 0) + len(lines)
        # a comma at the end continues an element in the next line
        firsts = [line[0] for before, line in zip([[], *lines], lines) if before[-1:] != [""]]
        numbers = [int(number) for number in firsts if number.isdigit()]
        deck.others.update(numbers)
        if "ELSET" in options:
            _named(deck.elsets, options["ELSET"]).extend(numbers)
        return
    deck.types.add(name)
    width, numbers = NODES_OF[kind] + 1, [int(value) for line in lines for value in line if value]
    if len(numbers) % width:
        raise ValueError(f"{len(numbers)} numbers are no whole number of elements with {width - 1} nodes")
    rows = np.array(numbers, dtype=np.int64).reshape(-1, width)
    for row in rows.tolist():
        _once(deck.elements, "element", row[0], (kind, row[1:]))
    if "ELSET" in options:
        _named(deck.elsets, options["ELSET"]).extend(rows[:, 0].tolist())


# ---------------------------------------------------------------------------------------------- from numbers to places


def _found(deck: Deck) -> Found:
    """Nodes, blocks of cells and sets of a deck, without its numbers."""
    numbers = np.array(sorted(deck.nodes), dtype=np.int64)
    kinds = list(dict.fromkeys(kind for kind, _ in deck.elements.values()))
    of_kind = {kind: np.array([n for n, (k, _) in deck.elements.items() if k == kind], dtype=np.int64) for kind in kinds}
    cells = [
        Block(kind, _places_of_cells(numbers, own, np.array([deck.elements[n][1] for n in own.tolist()])), own)
        for kind, own in of_kind.items()
    ]
    elements = np.array(sorted({*deck.elements, *deck.others}), dtype=np.int64)
    for name, members in deck.elsets.values():
        _places(elements, np.array(members, dtype=np.int64), "element", f"the set of elements '{name}' holds")
    cell_sets = {
        name: [np.flatnonzero(np.isin(own, members)) for own in of_kind.values()] for name, members in deck.elsets.values()
    }
    point_sets = {
        name: _places(numbers, np.unique(members).astype(np.int64), "node", f"the set of nodes '{name}' holds")
        for name, members in deck.nsets.values()
    }
    points = np.array([deck.nodes[n] for n in numbers.tolist()])
    found = Found(points, cells, cell_sets, point_sets, as_points=frozenset(deck.loaded))
    sides = _Sides(found, of_kind)
    for name, (of_elements, rows) in deck.surfaces.items():
        if of_elements:
            own = [(np.array(_members(deck.elsets, part), dtype=np.int64), side.upper()) for part, side in rows]
            for some, _ in own:
                _places(elements, some, "element", f"the surface '{name}' holds")
            found.sides[name] = sides.of(name, own)
        else:
            nodes = [number for part, _ in rows for number in _members(deck.nsets, part)]
            point_sets[name] = _places(numbers, np.unique(nodes).astype(np.int64), "node", f"the surface '{name}' holds")
    return found


def _places(numbers: Ints, wanted: Ints, what: str, by: str) -> Ints:
    """Indices of numbers of the file in an ascending list; ``by`` describes their source for messages."""
    place = np.minimum(np.searchsorted(numbers, wanted), max(len(numbers) - 1, 0))
    missing = wanted[numbers[place] != wanted] if len(numbers) else wanted
    if missing.size:
        raise ValueError(f"there is no {what} {missing.ravel()[0]}, which {by}: expected only {what}s of the file; mend the deck")
    return place


def _places_of_cells(numbers: Ints, cells: Ints, nodes: Ints) -> Ints:
    """Indices of the nodes ``(n, k)`` of elements with these numbers ``(n,)``."""
    missing = ~np.isin(nodes, numbers)
    first = cells[int(missing.any(axis=1).argmax())]
    return _places(numbers, nodes, "node", f"element {first} has")


class _Sides:
    """Sides of elements by their names; ``numbers`` of the elements of every block."""

    def __init__(self, found: Found, numbers: dict[str, Ints]):
        self._found, self._numbers = found, numbers

    def of(self, surface: str, members: list[tuple[Ints, str]]) -> list[Ints]:
        """Vertices of the sides of a surface, one array for each number of vertices, from elements ``(n,)`` and side names."""
        rows: dict[int, list[Ints]] = {}
        for elements, side in members:
            for block, own in zip(self._found.cells, self._numbers.values()):
                which = np.flatnonzero(np.isin(own, elements))
                if not len(which) or block.dim == 1:
                    continue
                named = side or block.dim < self._found.dim
                for found in [self._named(surface, block, which, side)] if named else self._free(block, which):
                    rows.setdefault(found.shape[1], []).append(found)
        return [np.concatenate(parts) for parts in rows.values()]

    def _named(self, surface: str, block: Block, which: Ints, side: str) -> Ints:
        """Vertices of one side of some cells, or of surface elements ``(n, k)``."""
        sides = KINDS[block.base].sides
        if block.dim < self._found.dim and side in ("", "SPOS", "SNEG"):
            return block.data[which, : KINDS[block.base].vertices]
        if not re.fullmatch(r"S\d", side) or not 1 <= int(side[1]) <= len(sides):
            raise ValueError(f"the surface '{surface}' has the side {side} of {block.type}: expected S1 to S{len(sides)}")
        return block.data[which[:, None], list(sides[int(side[1]) - 1])]

    @cached_property
    def _single(self) -> dict[int, set[tuple[int, ...]]]:
        """Vertices of the sides that belong to a single cell, ascending, by the number of vertices."""
        rows: dict[int, list[Ints]] = {}
        for block in self._found.bodies:
            for side in KINDS[block.base].sides:
                rows.setdefault(len(side), []).append(np.sort(block.data[:, list(side)], axis=1))
        found = {}
        for width, parts in rows.items():
            known, count = np.unique(np.concatenate(parts), axis=0, return_counts=True)
            found[width] = set(map(tuple, known[count == 1].tolist()))
        return found

    def _free(self, block: Block, which: Ints) -> list[Ints]:
        """Vertices of the sides of some cells that belong to no other cell."""
        found = []
        for side in KINDS[block.base].sides:
            rows, single = block.data[which[:, None], list(side)], self._single[len(side)]
            found.append(rows[[tuple(row) in single for row in np.sort(rows, axis=1).tolist()]])
        return found
