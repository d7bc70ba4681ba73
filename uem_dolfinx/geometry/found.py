"""Content of a mesh file of another program: nodes, cells of all kinds, sets and surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Ints


@dataclass(frozen=True)
class Kind:
    """A kind of cells, with nodes in VTK's order: vertices, edge nodes, nodes of quadrilaterals, and one in the middle."""

    vertices: int  # number of vertices
    edges: Sequence[tuple[int, ...]]  # pairs of vertices
    #: vertices of the sides of 3D cells, in order around each, seen from outside; empty in 2D, where sides are edges.
    faces: Sequence[tuple[int, ...]] = ()
    quads: Sequence[tuple[int, ...]] = ()  # vertices of quadrilaterals with a middle node in the complete cell
    centre: bool = False  # whether the complete cell has a node in its middle

    @property
    def dim(self) -> int:
        """Dimension of the cells."""
        return 3 if self.faces else 2

    @property
    def sides(self) -> Sequence[tuple[int, ...]]:
        """Vertices of the facets."""
        return self.faces or self.edges

    @property
    def complete(self) -> int:
        """Number of nodes of a cell of degree 2."""
        return self.vertices + len(self.edges) + len(self.quads) + self.centre


_HEXAHEDRON = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_TETRAHEDRON = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
#: Kinds of cells by meshio's name of those of degree 1; sides in Abaqus' order.
KINDS = {
    "triangle": Kind(3, ((0, 1), (1, 2), (2, 0))),
    "quad": Kind(4, ((0, 1), (1, 2), (2, 3), (3, 0)), quads=((0, 1, 2, 3),)),
    "tetra": Kind(4, _TETRAHEDRON, ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))),
    "pyramid": Kind(
        5,
        ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)),
        ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
        ((0, 1, 2, 3),),
    ),
    "wedge": Kind(
        6,
        ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
        ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
        ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    ),
    "hexahedron": Kind(
        8,
        _HEXAHEDRON,
        ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
        ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7)),
        True,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Block:
    """Cells of one kind."""

    type: str  # meshio's name, such as ``"hexahedron20"``
    data: Ints  # nodes of each cell, in VTK's order ``(n, k)``
    numbers: Ints | None = None  # of the cells in the file ``(n,)``, if it has any

    @property
    def base(self) -> str:
        """Name of the kind with vertices only."""
        return self.type.rstrip("0123456789")

    @property
    def dim(self) -> int:
        """Dimension."""
        known = {"vertex": 0, "line": 1, "polyhedron": 3}
        return KINDS[self.base].dim if self.base in KINDS else known.get(self.base, 2)


@dataclass(frozen=True)
class Found:
    """A mesh as stored in a file."""

    points: Array  # all nodes, including nodes without cell ``(n, 2 or 3)``
    cells: list[Block]  # blocks of cells of any dimension
    cell_sets: dict[str, list[Ints]] = field(default_factory=dict)  # members of each set in every block, by name
    point_sets: dict[str, Ints] = field(default_factory=dict)  # nodes of each set, by name
    #: vertices of the facets of each surface, one array for each number of vertices, by name.
    sides: dict[str, list[Ints]] = field(default_factory=dict)
    cell_data: dict[str, list[Ints]] = field(default_factory=dict)  # integers of cells, in every block, by name
    as_points: frozenset[str] = frozenset()  # names of sets of nodes that are points, even if they have all nodes of facets

    @property
    def dim(self) -> int:
        """Dimension of the bodies."""
        return max((block.dim for block in self.cells), default=0)

    @property
    def bodies(self) -> list[Block]:
        """Blocks of cells of the bodies."""
        return [block for block in self.cells if block.dim == self.dim]


#: Data of Gmsh files from meshio that do not belong to the mesh.
NOT_OF_MESH = ("gmsh:geometrical", "gmsh:bounding_entities")
#: Node order of cells that meshio reads from Gmsh files without conversion to VTK's order.
OF_GMSH = {
    "wedge18": [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11, 15, 17, 16],
    "pyramid14": [0, 1, 2, 3, 4, 5, 8, 10, 6, 7, 9, 11, 12, 13],
}


def from_meshio(found: Any, of_gmsh: bool = False) -> Found:
    """A mesh read by meshio, possibly from a Gmsh file."""
    numbers = {}
    for name, values in found.cell_data.items():
        if name not in NOT_OF_MESH and all(np.issubdtype(np.asarray(v).dtype, np.integer) and np.ndim(v) == 1 for v in values):
            every = [np.asarray(v, dtype=np.int64) for v in values]
            # distinct values for all cells are numbers of cells
            if len(np.unique(np.concatenate(every))) < sum(map(len, every)):
                numbers[name] = every
    none = np.zeros(0, np.int64)
    sets = {
        name: [none if some is None else np.asarray(some, dtype=np.int64) for some in members]
        for name, members in found.cell_sets.items()
        if name not in NOT_OF_MESH
    }
    return Found(
        np.asarray(found.points, dtype=float),
        [Block(block.type, _in_order(block, of_gmsh)) for block in found.cells],
        sets,
        {name: np.asarray(nodes, dtype=np.int64) for name, nodes in found.point_sets.items()},
        cell_data=numbers,
    )


def _in_order(block: Any, of_gmsh: bool) -> Ints:
    """Nodes of meshio's cells in VTK's order."""
    data = np.asarray(block.data, dtype=np.int64)
    return data[:, OF_GMSH[block.type]] if of_gmsh and block.type in OF_GMSH else data
