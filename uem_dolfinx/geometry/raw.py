"""A whole mesh on one rank, before it is distributed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt


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
