"""State of a run for restarts: Functions, states of contacts and numbers, in the input order of the mesh.

Checkpoints write and read it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar, Protocol

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.parallel import reduced
from uem_dolfinx.restart.numbering import Numbering, fingerprint, hashes, mesh_fingerprint, n_cells, node_numbering

#: Description of an item of ``State.motions()`` in messages.
A_MOTION = "what motions() of a state returned: None, or where a rigid surface is, as a dict"
#: Sides of a cell are fewer. [format; sides; -]
MOST_SIDES = 8


class Entry(Protocol):
    """Data with one row of numbers for each node."""

    name: str
    numbering: Numbering

    def describe(self) -> str:
        """Description, which is compared on reading (collective)."""

    def to_checkpoint(self) -> AnyArray:
        """Values at this rank's nodes ``(n, ...)`` (collective)."""

    def from_checkpoint(self, kept: AnyArray) -> None:
        """Restore the values (collective)."""


class FunctionEntry:
    """The values of a Function at its nodes, under a name in the file."""

    def __init__(self, name: str, u: fem.Function, numbering: Numbering):
        self.name, self.u, self.numbering = f"function '{name}'", u, numbering

    def describe(self) -> str:
        """Element and size."""
        family, degree = compat.element_family(self.u.function_space) or ("", 0)
        return f"{family} {degree}, {self.to_checkpoint().shape[1]} components at {self.numbering.total} nodes"

    def to_checkpoint(self) -> AnyArray:
        """A view of the owned part ``(n_owned, block size)``."""
        dofmap = self.u.function_space.dofmap
        return np.asarray(self.u.x.array.reshape(-1, dofmap.index_map_bs)[: dofmap.index_map.size_local])

    def from_checkpoint(self, kept: AnyArray) -> None:
        """Overwrite the Function."""
        self.to_checkpoint()[:] = kept
        self.u.x.scatter_forward()


class ContactEntry:
    """The committed states of a contact, with its number in the problem from 1, in a numbering of the displacement's nodes."""

    def __init__(self, number: int, contact: Contact, nodes: Numbering):
        self.name, self.contact = f"contact {number} '{contact.name}'", contact
        comm, pair = nodes.comm, contact.pair
        places = nodes.place[pair.nodes]
        self.numbering = Numbering(comm, places, nodes.total)
        surfaces = [hashes(self.numbering.to_table(places))]
        keys = pair.target.keys
        if reduced(comm, len(keys)):
            surfaces.append(hashes(Numbering(comm, keys, MOST_SIDES * n_cells(contact.config.mesh)).to_table(keys)))
        self._surfaces = fingerprint(comm, surfaces)
        self._columns = " ".join(self.to_checkpoint().dtype.names or ())

    def describe(self) -> str:
        """Number of contactors, fingerprint of the surfaces, and data of each contactor."""
        return f"{self.numbering.total} contactors, surfaces {self._surfaces}, each with {self._columns}"

    def to_checkpoint(self) -> AnyArray:
        """One record for each contactor ``(n,)``."""
        kept = self.contact.pair.to_checkpoint()
        rows = np.empty(len(self.contact.pair.nodes), dtype=[(name, a.dtype.str, a.shape[1:]) for name, a in kept.items()])
        for name, a in kept.items():
            rows[name] = a
        return rows

    def from_checkpoint(self, kept: AnyArray) -> None:
        """Restore the states of the pair."""
        self.contact.pair.from_checkpoint({name: kept[name] for name in kept.dtype.names or ()})


@dataclass
class State(given.Sealed):
    """State from which a run can continue; the input order of the mesh is determined at the first write or read.

    Attributes:
        mesh: of all functions and contacts.
        functions: by name: Lagrange of degree 1 or 2, discontinuous Lagrange or quadrature, with values of any shape.
            Functions must not be added after the first write or read.
        contacts: of a problem; their committed states and the motions of their rigid surfaces are stored.
        numbers: by name, any values that JSON can hold, floats to the last bit. Names must be the same on writing and reading.
        collect: called on all ranks before writing and reading, to update functions and numbers.
        restore: called on all ranks after reading, to continue from them.
        back: called on all ranks if an error ends a run within a step, to return to the last completed step. If empty, a loop of the
            script that ends by an error writes nothing.
        settings: settings of the run, by name; a file with other settings is refused, unless either has no settings.
        by_default: names of settings with default values; a file without them is not refused.
        steps: counted by a ``Checkpoint``, so that an interrupted run writes at the same steps as an uninterrupted one.
    """

    SETTABLE: ClassVar = dict.fromkeys(
        ("functions", "contacts", "numbers", "collect", "restore", "back", "steps", "settings", "by_default")
    )

    mesh: Any
    functions: dict[str, fem.Function] = field(default_factory=dict)
    contacts: list[Contact] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)
    collect: list[Callable[[], None]] = field(default_factory=list)
    restore: list[Callable[[], None]] = field(default_factory=list)
    back: list[Callable[[], None]] = field(default_factory=list)
    steps: int = 0
    settings: dict[str, str] = field(default_factory=dict)
    by_default: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Seal it."""
        self._made = True

    @property
    def comm(self) -> MPI.Comm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the mesh (collective)."""
        return mesh_fingerprint(self.mesh)

    @cached_property
    def entries(self) -> list[Entry]:
        """All data with a row for each node, in the order of the file (collective)."""
        known: dict[int, tuple[Any, Numbering]] = {}

        def numbering(V: Any) -> Numbering:
            if id(V) not in known:
                known[id(V)] = V, node_numbering(V)
            return known[id(V)][1]

        nodal = [FunctionEntry(name, u, numbering(u.function_space)) for name, u in self.functions.items()]
        return [*nodal, *(ContactEntry(i, contact, numbering(contact.config.V)) for i, contact in enumerate(self.contacts, 1))]

    def describe(self) -> dict[str, str]:
        """Description of the state, in the order of comparison (collective)."""
        cells = f"{n_cells(self.mesh)} {compat.cell_name(self.mesh)} cells in {self.mesh.geometry.dim}D"
        described = {"mesh": f"{cells}, fingerprint {self.fingerprint}", **{e.name: e.describe() for e in self.entries}}
        return described | {f"number '{name}'": "a value" for name in self.numbers}

    def motions(self) -> list[dict[str, Any] | None]:
        """Motions of the contacts' rigid surfaces."""
        motions = [contact.pair.target.motion for contact in self.contacts]
        return [None if m is None else {f.name: getattr(m, f.name).tolist() for f in fields(Motion)} for m in motions]

    def move(self, motions: list[dict[str, Any] | None]) -> None:
        """Restore the motions of the contacts' rigid surfaces.

        Raises:
            InputTypeError: for objects that ``motions`` does not return.
            InputError: for a wrong number of motions.
        """
        names = {f.name for f in fields(Motion)}
        given.items("motions", motions, lambda m: m is None or (isinstance(m, dict) and set(m) <= names), A_MOTION)
        if len(motions) != len(self.contacts):
            raise InputError(
                f"motions has {len(motions)} items: expected one for each of the {len(self.contacts)} contacts of the state"
            )
        for contact, motion in zip(self.contacts, motions):
            moved = None if motion is None else Motion(**{name: np.array(v) for name, v in motion.items()})
            contact.pair.target.motion = moved
