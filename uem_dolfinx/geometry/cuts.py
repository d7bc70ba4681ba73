"""A whole mesh on one rank, which may be cut along a tagged section, as of a bolt: its nodes are doubled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.errors import MeshError


@dataclass(frozen=True)
class Group:
    """A physical group, or a set of another program.

    Its ``rows`` are, for the bodies, the input index of their cells, shape ``(n,)``; else the vertices of each entity as ascending
    input node index, shape ``(n, n_vertices)``. Of a set of nodes its ``middles`` are those that are no vertices, shape ``(m,)``.
    """

    name: str | None
    number: int
    dim: int
    rows: npt.NDArray[np.int64]
    middles: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True)
class RawMesh:
    """A whole mesh on one rank: ``points (n_nodes, gdim)``, and ``cells (n_cells, n_nodes_per_cell)`` of nodes in Gmsh's order.

    ``of_file`` are the nodes' places in a file of another program ``(n_nodes,)``, or None.
    """

    cell: str
    degree: int
    points: npt.NDArray[np.float64]
    cells: npt.NDArray[np.int64]
    groups: list[Group]
    of_file: npt.NDArray[np.int64] | None = None


#: Name of the other face of a section.
BACK = "{} back"
#: A section whose nodes are off their plane by less than this part of its size is plane.
#: [convention; size of the section; test_cuts.py::test_how_plane_a_section_must_be]
PLANE = 1e-6


def cut_along(raw: RawMesh, names: str | Sequence[str]) -> RawMesh:
    """Cut a mesh along one group of facets, or several; InputTypeError for anything else than names, and errors as of ``cut``."""
    several = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
    given.kind("cut", names, isinstance(names, str) or several, "the name of a group of facets, or a list of names")
    for name in [names] if isinstance(names, str) else names:
        raw = cut(raw, name)
    return raw


def cut(raw: RawMesh, name: str) -> RawMesh:
    """Double the nodes of a group of facets inside the bodies; the group keeps one face, ``name back`` is the other one.

    The section is plane, and divides the body that it is in. Groups of nodes keep both copies, and facets follow their cells.

    Args:
        raw: the whole mesh.
        name: of the group.

    Raises:
        MeshError: if there is no such group, or if the section is not inside, not plane, or does not reach the surface all around.
    """
    topology = forms.reference_topology(raw.cell)
    section = [group for group in raw.groups if group.name == name and group.dim == len(topology) - 2]
    if len(section) != 1 or not len(section[0].rows):
        raise MeshError(
            f"cut: no group of facets is named '{name}': expected one of {sorted({g.name for g in raw.groups if g.name})}"
        )
    nodes, (group,) = compat.from_gmsh(raw.cell, raw.cells), section
    local, closure = topology[-2], forms.create_lagrange_element(raw.cell, raw.degree).entity_closure_dofs[-2]
    # vertices of every facet of every cell, ascending, as one number
    known, faces = np.unique(np.concatenate([np.sort(nodes[:, list(own)], axis=1) for own in local]), axis=0, return_inverse=True)
    faces = faces.reshape(len(local), -1)
    count = np.bincount(faces.ravel(), minlength=len(known))
    number = {tuple(row): k for k, row in enumerate(known.tolist())}
    inside = np.array([number.get(tuple(row), -1) for row in group.rows.tolist()])
    if (inside < 0).any() or (count[inside] != 2).any():
        raise MeshError(f"cut: the section '{name}' has facets that are not between two cells: expected facets inside a body")
    of_section = np.isin(faces, inside)
    doubled = np.unique(np.concatenate([nodes[of_section[k]][:, list(own)].ravel() for k, own in enumerate(closure)]))
    x = raw.points[doubled]
    middle = x.mean(axis=0)
    *_, directions = np.linalg.svd(x - middle)
    normal, size = directions[-1], np.linalg.norm(np.ptp(x, axis=0))
    normal = normal * np.sign(normal[np.abs(normal).argmax()])
    if np.abs((x - middle) @ normal).max() > PLANE * size:
        raise MeshError(f"cut: the section '{name}' is not plane: expected facets in one plane")
    moved: Ints = np.arange(len(raw.points))
    moved[doubled] = len(raw.points) + np.arange(len(doubled))
    beyond = (raw.points[nodes].mean(axis=1) - middle) @ normal > 0.0
    touching = np.asarray(np.isin(nodes, doubled).any(axis=1))
    _check_through(name, faces, of_section, count, beyond, touching, (known, doubled))
    cells = np.where((beyond & touching)[:, None], moved[raw.cells], raw.cells)
    owner = np.full(len(known), -1)
    owner[faces.ravel()] = np.tile(np.arange(len(nodes)), len(local))
    groups = [_followed(one, group, number, owner, beyond, moved, doubled, len(topology) - 2) for one in raw.groups]
    groups.append(Group(BACK.format(name), max(g.number for g in raw.groups) + 1, group.dim, np.sort(moved[group.rows], axis=1)))
    of_file = None if raw.of_file is None else np.append(raw.of_file, raw.of_file[doubled])
    return replace(raw, points=np.concatenate([raw.points, x]), cells=cells, groups=groups, of_file=of_file)


def _check_through(
    name: str, faces: Ints, of_section: Bools, count: Ints, beyond: Bools, touching: Bools, of: tuple[Ints, Ints]
) -> None:
    """Refuse a section that ends inside the body: its cells on both sides have another facet with doubled nodes in common."""
    known, doubled = of
    first = np.full(len(known), -1)
    second = first.copy()
    order = np.argsort(faces.ravel(), kind="stable")
    at, cell = faces.ravel()[order], np.tile(np.arange(faces.shape[1]), len(faces))[order]
    new = np.append(True, at[1:] != at[:-1])
    first[at[new]], second[at[~new]] = cell[new], cell[~new]
    crossing = (count == 2) & (second >= 0) & (beyond[first] != beyond[second]) & np.isin(known, doubled).any(axis=1)
    crossing[faces[of_section]] = False
    if (crossing & touching[first] & touching[second]).any():
        raise MeshError(
            f"cut: the section '{name}' ends inside the body: expected facets that divide it, from surface to surface"
        )


def _followed(
    one: Group,
    section: Group,
    number: dict[tuple[int, ...], int],
    owner: Ints,
    beyond: Bools,
    moved: Ints,
    doubled: Ints,
    dim: int,
) -> Group:
    """A group after the cut."""
    if one is section or one.dim > dim:
        return one
    if one.dim == dim:
        # facets of the surface belong to one cell
        cell = owner[[number[tuple(row)] for row in one.rows.tolist()]]
        return replace(one, rows=np.sort(np.where(beyond[cell][:, None], moved[one.rows], one.rows), axis=1))
    both = one.rows[np.isin(one.rows, doubled).all(axis=1)]
    middles = one.middles[np.isin(one.middles, doubled)]
    return replace(
        one, rows=np.concatenate([one.rows, np.sort(moved[both], axis=1)]), middles=np.concatenate([one.middles, moved[middles]])
    )
