"""Values of decks at single nodes and sides as those of sets, in global directions, after all keywords."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.decks.parts import Acting, Linear, Model, Value, Where, together
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.decks import Deck

#: A local direction is a global one if its other components are smaller. [bound; 1; -]
NO_COMPONENT = 1e-12


def node_of(deck: Deck, where: str) -> str:
    """A set as it is, and a node as the set of its own."""
    return deck.name_node(int(where)) if where.isdigit() else where


def nodes_of(deck: Deck, where: str) -> list[Any]:
    """Nodes of a set or a node by their numbers, or the name of a set that there is not."""
    found: list[Any] = [int(where)] if where.isdigit() else deck.nsets.get(where.upper(), ("", [where]))[1]
    if not found:
        raise InputError(f"the set '{where}' has no nodes: expected one node or more")
    return found


def local_axes(kind: str, numbers: list[float], place: list[float]) -> Array:
    """Axes of a ``*TRANSFORM`` at a node, one a row ``(3, 3)``: Cartesian, ``"R"``, or radial, tangential and axial, ``"C"``."""
    a, b = np.reshape(numbers, (2, 3))
    first, third = (a, np.cross(a, b)) if kind == "R" else (np.array(place) - a, b - a)
    third = third / (np.linalg.norm(third) or 1.0)
    first = first - (first @ third) * third
    if not (np.linalg.norm(third) and np.linalg.norm(first)):
        raise InputError(
            f"*TRANSFORM by {numbers} has no directions at {place}: expected two that differ, and nodes off the axis"
        )
    first = first / np.linalg.norm(first)
    return np.array([first, np.cross(third, first), third])


class Closing:
    """What reading ends with.

    Args:
        deck: the mesh, whose sets grow.
        model: whose steps have values at nodes and sides.
        sets: conditions as the file has them, by set and degree of freedom.
        axes: local directions of nodes.
    """

    def __init__(self, deck: Deck, model: Model, sets: dict[tuple[str, int], None], axes: dict[int, Array]):
        self._deck, self.model, self._sets, self._axes = deck, model, sets, axes

    def close(self) -> None:
        """Let values at single nodes and sides be those of sets, and check that elements have materials."""
        steps, deck = self.model.steps, self._deck
        for elements, name in self.model.sections:
            if name not in self.model.materials:
                raise InputError(
                    f"there is no material '{name}': expected one of {', '.join(self.model.materials) or 'the deck'}"
                )
            if elements not in deck.elsets:
                raise InputError(f"there is no set of elements '{elements}', which a *SOLID SECTION holds")
        count = Counter(one for elements, _ in self.model.sections for one in set(deck.elsets[elements][1]))
        if twice := [one for one, n in count.items() if n > 1]:
            raise InputError(f"element {min(twice)} has two sections: expected one")
        bodies = all(name.startswith(("C3D", "CP", "CAX")) for name in self.model.types)
        if bodies and (bare := set(deck.elements).difference(count)):
            raise InputError(f"element {min(bare)} has no *SOLID SECTION: expected a material of all elements")
        self._turn()
        references = self.model.references
        held, forces, pressures = ([getattr(step, what) for step in steps] for what in ("held", "forces", "pressures"))
        for step in steps:
            step.held, step.forces = (
                {at: acting.pop(at) for at in list(acting) if at[0] in references} for acting in (step.held, step.forces)
            )
            step.pressures = {}
        for (where, dof), history in self._in_sets(held):
            self._give("held", (self._named("held", where), dof), history)
        by_node: dict[Any, dict[int, list[Value | None]]] = {}
        for (one, dof), history in _histories(forces).items():
            by_node.setdefault(one, {})[dof] = history
        for nodes in _alike(by_node):
            name = self._named("loaded", nodes)
            for dof, history in by_node[nodes[0]].items():
                self._give("forces", (name, dof), history)
        of_sides = _histories(pressures)
        for group in _alike(of_sides):
            name = group[0][0] if not group[0][1] else f"pressed {len(deck.surfaces)}"
            if group[0][1]:
                deck.surfaces[name] = (True, [list(side) for side in group])
            self._give("pressures", (name, "P"), of_sides[group[0]])

    def _turn(self) -> None:
        """Let values in local directions be those in global ones, forces those of a thickness of 1, and terms of equations vectors."""
        for one, dof in [at for step in self.model.steps for at in (*step.held, *step.forces)]:
            if one in self._axes and 3 < dof <= 6:
                raise InputError(
                    f"degree of freedom {dof} of node {one} with a *TRANSFORM: expected rotations without one, or a ROT NODE"
                )
        for step in self.model.steps:
            turned: Acting = {}
            for (one, dof), value in step.forces.items():
                for c, part in enumerate(self._axis(one, dof), 1):
                    if part:
                        turned[one, c] = together(turned.get((one, c), 0.0), value * float(part / self.model.thickness), one)
            step.forces = turned
        self._turn_held()
        for equation in self.model.equations:
            for k, (name, term) in enumerate(equation.terms):
                if isinstance(term, tuple):
                    dof, c = term
                    nodes = self._deck.nsets.get(name.upper(), ("", []))[1]
                    equation.terms[k] = name, c * self._axis(nodes[0] if len(nodes) == 1 else None, dof)

    def _turn_held(self) -> None:
        """Let values in local directions be those in global ones, or equations; InputError for these but in all steps."""
        steps, turned = self.model.steps, dict[tuple[Any, int], list[Value | None]]()
        for one, dof in {at: None for step in steps for at in step.held if at[0] in self._axes and at[1] <= 3}:
            axis, values = self._axis(one, dof), [step.held.pop((one, dof), None) for step in steps]
            along = np.flatnonzero(axis)
            if len(along) == 1:
                c = int(along[0])
                turned[one, c + 1] = [value if value is None else value * float(axis[c]) for value in values]
            elif one in self.model.references:
                raise InputError(f"*BOUNDARY of reference node {one} in a local direction: expected one along a global axis")
            elif any(value is None for value in values):
                raise InputError(
                    f"*BOUNDARY of node {one} in a local direction: expected it in all steps, or no *TRANSFORM there"
                )
            else:
                given = [value for value in values if value is not None]
                self.model.equations.append(Linear([(node_of(self._deck, str(one)), axis)], given))
        for at, history in turned.items():
            self._give("held", at, history)

    def _axis(self, one: Any, dof: int) -> Array:
        """Global components of a degree of freedom of a node ``(3,)``."""
        if dof > 3 or one not in self._axes:
            return np.eye(max(dof, 3))[dof - 1]
        axis = self._axes[one][dof - 1]
        return np.where(np.abs(axis) > NO_COMPONENT, axis, 0.0)

    def _give(self, what: str, where: Where, history: list[Value | None]) -> None:
        for step, value in zip(self.model.steps, history):
            if value is not None:
                getattr(step, what)[where] = value

    def _in_sets(self, held: list[Acting]) -> Iterator[tuple[tuple[Any, int], list[Value | None]]]:
        """Sets of the file that have one history each, and what is left, in sets of nodes with the same history."""
        left = by_node = _histories(held)
        for where, dof in self._sets:
            nodes = nodes_of(self._deck, where)
            own = set(nodes)
            # values at reference nodes are no values of bodies
            if all(by_node.get((one, dof)) == by_node.get((nodes[0], dof)) is not None for one in nodes):
                yield (where if not where.isdigit() else [int(where)], dof), by_node[nodes[0], dof]
                left = {at: history for at, history in left.items() if at[1] != dof or at[0] not in own}
        for dof in dict.fromkeys(dof for _, dof in left):
            of_dof = {one: history for (one, other), history in left.items() if other == dof}
            for nodes in _alike(of_dof):
                yield (nodes, dof), of_dof[nodes[0]]

    def _named(self, what: str, nodes: Any) -> str:
        """The name of a set of these nodes, which is made if there is none."""
        if isinstance(nodes, str) or isinstance(nodes[0], str):
            return nodes if isinstance(nodes, str) else nodes[0]
        if len(nodes) == 1:
            return node_of(self._deck, str(nodes[0]))
        name = f"{what} {len(self._deck.nsets)}"
        self._deck.nsets[name.upper()] = (name, nodes)
        if what == "loaded":
            # a set may be a surface, and these are forces at its nodes
            self._deck.loaded.add(name)
        return name


def _histories(acting: list[Acting]) -> dict[Any, list[Value | None]]:
    """Values in all steps, by their places; None where there is none."""
    return {at: [one.get(at) for one in acting] for at in dict.fromkeys(at for one in acting for at in one)}


def _alike(histories: dict[Any, Any]) -> list[list[Any]]:
    """Places with the same values; a name has a list of its own."""
    found: dict[str, list[Any]] = {}
    for at, history in histories.items():
        named = isinstance(at, str) or (isinstance(at, tuple) and not at[1])
        found.setdefault(f"{at if named else ''} {history}", []).append(at)
    return list(found.values())
