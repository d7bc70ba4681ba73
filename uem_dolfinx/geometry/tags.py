"""Parts of a mesh: physical groups, and whatever else a user names bodies, surfaces and supports by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Indices
from uem_dolfinx.errors import SpaceError, TagError
from uem_dolfinx.given import did_you_mean, shown
from uem_dolfinx.parallel import agree, reduced

Key: TypeAlias = "str | int | tuple[int, str | int]"

Part: TypeAlias = Any
"""A ``Tag``; ``(meshtags, value)`` or ``(meshtags, values)`` with DOLFINx MeshTags; local indices of facets (of cells where cells
are required), which each rank may give for entities that it owns, or also for ghosts; or a list of any of these, their union."""


@dataclass(frozen=True)
class Tag(given.Copied):
    """A physical group of a mesh.

    Attributes:
        name: physical name; None for a group that has only a number.
        number: physical number, unique within a dimension.
        dim: dimension of the entities.
        mesh: the mesh they belong to.
        entities: local indices of the entities on this rank, ghosts included, ascending, shape ``(n,)``.
        insides: of a set of nodes, whose entities are vertices, the edges, faces and cells in whose middle it has a node, one array for
            each dimension 1, 2 ...; empty for all other groups.
    """

    name: str | None
    number: int
    dim: int
    mesh: Any = field(repr=False, compare=False)
    entities: Indices = field(repr=False, compare=False)
    insides: tuple[Indices, ...] = field(default=(), repr=False, compare=False)

    def __str__(self) -> str:
        """Name where there is one, else number."""
        return f"'{self.name}'" if self.name else f"number {self.number}"

    @property
    def size(self) -> int:
        """Number of entities on this rank, ghosts and those with a node in the middle included."""
        return len(self.entities) + sum(map(len, self.insides))


class Tags(Mapping[Key, Tag]):
    """Physical groups of a mesh by name, by number, or by ``(dim, name or number)``.

    Args:
        tags: all groups, equal on all ranks except for their entities.
        sizes: number of entities of each over all ranks, shape ``(len(tags),)``.
    """

    def __init__(self, tags: list[Tag], sizes: npt.NDArray[np.int64]):
        self._tags = tags
        self._empty = {(tag.dim, tag.number) for tag, size in zip(tags, sizes) if size == 0}

    def __getitem__(self, key: Key) -> Tag:
        """Look a group up; no communication, and all ranks get the same answer.

        Args:
            key: name, number, or ``(dim, name or number)``.

        Returns:
            The group.

        Raises:
            TagError: no such group, several of them, or one without any entity in the mesh.
        """
        dim, label = key if isinstance(key, tuple) else (None, key)
        found = [t for t in self._tags if label in (t.name, t.number) and label is not None and dim in (None, t.dim)]
        if not found:
            raise TagError(f"no physical group {key!r}{self._hint(label)}: {self._listing()}")
        if len(found) > 1:
            choices = " or ".join(f"({t.dim}, {label!r})" for t in found)
            raise TagError(f"physical group {key!r} is ambiguous: ask for {choices}")
        tag = found[0]
        if (tag.dim, tag.number) in self._empty:
            raise TagError(
                f"physical group {tag} (dimension {tag.dim}) has no entity in the mesh: "
                f"check that its geometry is meshed and belongs to the bodies; {self._listing()}"
            )
        return tag

    def __iter__(self) -> Iterator[Key]:
        """Keys of the groups that have entities: the name, or ``(dim, number)`` where there is no unique name."""
        names = [t.name for t in self._tags]
        for tag in self._tags:
            if (tag.dim, tag.number) not in self._empty:
                yield tag.name if tag.name and names.count(tag.name) == 1 else (tag.dim, tag.number)

    def __len__(self) -> int:
        """Number of groups that have entities."""
        return len(self._tags) - len(self._empty)

    def __repr__(self) -> str:
        """List the groups."""
        return f"Tags({self._listing()})"

    def _hint(self, label: object) -> str:
        hint = did_you_mean(label, [t.name for t in self._tags if t.name])
        return f", {hint}" if hint else ""

    def _listing(self) -> str:
        if not self._tags:
            return "the mesh has no physical group"
        return "the mesh has " + ", ".join(f"{t.name or t.number!r} (dimension {t.dim})" for t in self._tags)


# ---------------------------------------------------------------------------------------------- whatever names a part


def name_of(part: Part) -> str:
    """Name of a part of a mesh, for messages and files."""
    if isinstance(part, Tag):
        return part.name or str(part.number)
    if _with_value(part):
        return f"tagged {' or '.join(map(str, np.ravel(part[1])))}"
    return " and ".join(map(name_of, part)) if _is_list(part) else "by index"


def communicator_of(part: Any) -> MPI.Comm | None:
    """Communicator of the mesh of a part, None if the part does not determine its mesh."""
    if isinstance(part, Tag):
        return part.mesh.comm
    if _with_value(part):
        return compat.communicator_of(part[0])
    known = (communicator_of(one) for one in part) if _is_list(part) else ()
    return next((comm for comm in known if comm is not None), None)


def as_tag(part: Part, mesh: Any, dims: Sequence[int], role: str) -> Tag:
    """The tag of what a user names a part of the mesh by, with its ghosts (collective).

    A ``Tag`` is returned as it is. Entities of any of the dimensions ``dims`` will do, indices are of the first; messages call the
    part by its ``role``.

    Raises:
        TagError: nothing of that kind, of another dimension, out of range, or empty on all ranks.
        SpaceError: of another mesh.
    """
    mesh.topology.create_entities(dims[0])
    error, tags = None, []
    try:
        tags = _read(part, mesh, dims, role)
    except (TagError, SpaceError) as found:
        error = found
    agree(mesh.comm, error)
    tag = tags[0]
    if not isinstance(part, Tag):
        entities = compat.shared_by_ranks(mesh.topology.index_map(tag.dim), np.concatenate([t.entities for t in tags]))
        insides = [
            compat.shared_by_ranks(mesh.topology.index_map(dim), np.concatenate([t.insides[dim - 1] for t in tags if t.insides]))
            for dim in range(1, 1 + max(len(t.insides) for t in tags))
        ]
        tag = Tag(name_of(part), 0, tag.dim, mesh, entities, tuple(insides))
    if reduced(mesh.comm, tag.size) == 0:
        raise TagError(f"{role} '{name_of(part)}' holds no {_word(mesh, tag.dim)}: check the physical group in the gmsh model")
    return tag


def locate_dofs(V: Any, tag: Tag) -> Any:
    """D.o.f. at the nodes of a tag, ascending, as ``fem.locate_dofs_topological`` finds them (collective).

    Args:
        V: a space or a part of one, or one of these and the space of the values for it.
        tag: of any dimension.

    Returns:
        Local d.o.f. ``(n,)``, or one such array for each of two spaces.

    Raises:
        SpaceError: if the tag has nodes in the middle of edges, faces or cells alone, and the space has none there.
    """
    parts, topology = [_on_closure(V, tag.dim, tag.entities)], tag.mesh.topology
    for dim, entities in enumerate(tag.insides, 1):
        topology.create_connectivity(dim, dim - 1)
        sides = topology.connectivity(dim, dim - 1)
        n = len(sides.offsets) - 1
        bounds = np.unique(np.asarray(sides.array).reshape(n, len(sides.array) // max(n, 1))[entities])
        whole, around = _on_closure(V, dim, entities), _on_closure(V, dim - 1, bounds.astype(np.int32))
        parts.append(whole[:, ~np.isin(whole[0], around[0])])
    found = np.concatenate(parts, axis=1)
    found = np.ascontiguousarray(found[:, np.unique(found[0], return_index=True)[1]])
    if tag.insides and reduced(tag.mesh.comm, found.shape[1]) == 0:
        raise SpaceError(
            f"the nodes of {tag} are in the middle of edges, faces or cells, where this space has none: take one of degree 2, or a set "
            "that has vertices"
        )
    return list(found) if isinstance(V, (tuple, list)) else found[0]


def _on_closure(V: Any, dim: int, entities: Indices) -> Indices:
    """D.o.f. of one or of two spaces on entities and all that bounds them ``(1 or 2, n)`` (collective)."""
    mesh = (V[0] if isinstance(V, (tuple, list)) else V).mesh
    mesh.topology.create_connectivity(dim, mesh.topology.dim)
    return np.atleast_2d(fem.locate_dofs_topological(V, dim, entities))


def _read(part: Part, mesh: Any, dims: Sequence[int], role: str) -> list[Tag]:
    """The tags that a part consists of on this rank, at least one."""
    if _is_list(part):
        tags = [tag for one in part for tag in _read(one, mesh, dims, role)]
        if len({tag.dim for tag in tags}) > 1:
            raise TagError(f"{role} '{name_of(part)}' is of several dimensions: give parts of one")
        return tags
    if isinstance(part, Tag):
        tag, same = part, part.mesh is mesh
    elif _with_value(part):
        meshtags, values = part
        entities = np.asarray(meshtags.indices)[np.isin(meshtags.values, values)]
        tag, same = Tag(name_of(part), 0, meshtags.dim, mesh, entities), compat.belongs_to(meshtags, mesh)
    else:
        local, index_map = np.ravel(part), mesh.topology.index_map(dims[0])
        n = index_map.size_local + index_map.num_ghosts
        if local.shape != np.shape(part) or (len(local) and local.dtype.kind not in "iu"):
            raise TagError(
                f"{role} = {shown(part)}: expected a tag of read_gmsh, (meshtags, value), local indices of "
                f"{_word(mesh, dims[0])}, or a list of these"
                + (f"; a name does not determine the mesh: give tags[{part!r}]" if isinstance(part, str) else "")
            )
        if len(local) and not 0 <= local.min() <= local.max() < n:
            raise TagError(f"{role} has the indices {local.min()} to {local.max()}: expected local ones, 0 to {n - 1}")
        return [Tag(name_of(part), 0, dims[0], mesh, local.astype(np.int32))]
    if not same:
        raise SpaceError(f"{role} '{name_of(part)}' belongs to another mesh than the displacement: read both from one mesh")
    if tag.dim not in dims:
        known = ", or ".join(f"{_word(mesh, d)}, dimension {d}" for d in dims)
        raise TagError(f"{role} '{name_of(part)}' has dimension {tag.dim}: expected {known}")
    return [tag]


def _with_value(part: Part) -> bool:
    """Whether a part is MeshTags with a value."""
    return isinstance(part, (tuple, list)) and len(part) == 2 and hasattr(part[0], "indices") and hasattr(part[0], "values")


def _is_list(part: Part) -> bool:
    """Whether a part is a list of parts; one of numbers, or an empty one, holds indices."""
    numbers = isinstance(part, (tuple, list)) and all(isinstance(i, (int, np.integer)) for i in part)
    return isinstance(part, (tuple, list)) and not numbers and not _with_value(part)


def _word(mesh: Any, dim: int) -> str:
    return "points" if dim == 0 else {0: "cells", 1: "facets"}.get(mesh.topology.dim - dim, "edges")
