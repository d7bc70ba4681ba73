"""What travels in a search: a communicator that counts what it receives, and two plates that are nearly all surface.

`watched` looks at one target while it searches; nothing in the package knows of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from common import comm
from dolfinx import fem
from dolfinx.mesh import locate_entities

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.surfaces import surface_nodes

#: Gap between the plates in cells of the upper one.
GAP = 0.01
#: Cells of the lower plate per cell of the upper one, along a side; the meshes do not match.
COARSER = 0.8


class Counting:
    """A communicator that counts the bytes that this rank receives from others, in the buffers that MPI fills.

    It has only the calls that are counted: whatever else is called fails.

    Attributes:
        received: bytes so far.
        by_ranks: bytes of them in calls in which every rank sends the same number of them to every other.
        partners: number of ranks that have sent rows here.
    """

    def __init__(self, whole: MPI.Comm):
        self._whole, self.size, self.rank = whole, whole.size, whole.rank
        self.received, self.by_ranks, self.partners = 0, 0, 0

    def Alltoall(self, sent: np.ndarray, received: np.ndarray) -> None:
        """As many bytes of an array to every rank (collective)."""
        self._whole.Alltoall(sent, received)
        self._count_all_but_mine(received)

    def Allgather(self, sent: np.ndarray, received: np.ndarray) -> None:
        """An array to all ranks (collective)."""
        self._whole.Allgather(sent, received)
        self._count_all_but_mine(received)

    def Alltoallv(self, sent: Sequence[Any], received: Sequence[Any]) -> None:
        """As many rows of bytes as the counts say to every rank (collective)."""
        self._whole.Alltoallv(sent, received)
        (_, (counts, _), row) = received
        self.received += int(np.sum(counts) - counts[self.rank]) * row.Get_size()
        self.partners = max(self.partners, int((np.delete(counts, self.rank) > 0).sum()))

    def _count_all_but_mine(self, received: np.ndarray) -> None:
        figures = received.nbytes * (self.size - 1) // self.size
        self.received, self.by_ranks = self.received + figures, self.by_ranks + figures


class Watch:
    """What one rank has to do with the searches of a target.

    Attributes:
        counting: the communicator.
        projected: number of points that it has projected, its own and others'.
    """

    def __init__(self, counting: Counting):
        self.counting, self.projected = counting, 0


@contextmanager
def watched(target: MeshTarget) -> Iterator[Watch]:
    """Count what a target receives and projects inside."""
    whole, project_here = target.comm, target._project_here
    watch = Watch(Counting(whole))

    def counted(points: Any, *more: Any) -> Any:
        watch.projected += len(points)
        return project_here(points, *more)

    target.comm, target._project_here = watch.counting, counted  # type: ignore[assignment, method-assign]
    try:
        yield watch
    finally:
        target.comm = whole
        del target._project_here


@dataclass(frozen=True)
class Surfaces:
    """A contactor and a target of one displacement.

    Attributes:
        config: its configuration.
        target: to be searched.
        points: this rank's contactors ``(n, gdim)``.
    """

    config: Configuration
    target: MeshTarget
    points: np.ndarray


def plates(n: int) -> Surfaces:
    """A square plate of n x n hexahedra, one cell thick, over a coarser one (collective).

    Args:
        n: cells along a side of the upper plate, all of whose lower nodes are contactors.
    """
    gap = GAP / n
    lower, upper = _plate(max(1, round(COARSER * n)), -1.0 / n), _plate(n, gap)
    cells = np.concatenate([lower[1], upper[1] + len(lower[0])])
    given = slice(None) if comm.rank == 0 else slice(0)
    mesh = compat.create_mesh(comm, cells[given], np.concatenate([lower[0], upper[0]])[given], "hexahedron", 1)
    u = fem.Function(compat.function_space(mesh, 1, (3,)))
    config = Configuration(u)
    near = 0.1 * gap
    high, low = (uem.Tag(name, i, 2, mesh, locate_entities(mesh, 2, lambda x, z=z: np.abs(x[2] - z) < near))
                 for i, (name, z) in enumerate((("high", gap), ("low", 0.0)), 1))  # fmt: skip
    return Surfaces(config, MeshTarget(TargetFacets(config, low)), config.X[surface_nodes(config, high)])


def _plate(n: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and cells in Gmsh's order of a plate of n x n cells on the unit square, as thick as a cell is wide, from z upwards.

    A plate below z = 0 ends there.
    """
    axis = np.linspace(0.0, 1.0, n + 1)
    top = z + 1.0 / n if z >= 0.0 else 0.0
    nodes = np.stack(np.meshgrid([z, top], axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    ring = np.array([0, 1, n + 2, n + 1])
    return nodes, corner[:, None] + np.concatenate([ring, ring + (n + 1) ** 2])


def search_traffic(surfaces: Surfaces) -> dict[str, Any]:
    """What ranks receive and do in one search of all contactors, the same on all ranks (collective).

    Returns:
        ``contactors`` and ``facets`` on all ranks; ``share_max``, the most contactors and facets that a rank has; ``bytes_max``, the
        most bytes that a rank receives; ``bytes_per_share``, the most per contactor and facet of its own; ``searched_ranks``, ranks that a
        contactor asks; ``bytes_per_rank``, those of them that every other rank sends; ``partners``, the most ranks that send a rank rows
        in one call; ``halo_bytes_max``, the most bytes that come with the values at ghost nodes of which nodal normals are made;
        ``imbalance``, the most contactors owned and points projected over the mean.
    """
    config, target, points = surfaces.config, surfaces.target, surfaces.points
    with watched(target) as watch:
        target.project(points)
    ghosts = np.arange(config.n_owned, config.n_local, dtype=np.int32)
    elsewhere = comm.alltoall(list(np.bincount(config.owner_of(config.to_global(ghosts)), minlength=comm.size)))
    # sums go to the owners, and back to the ghosts
    halo = 8 * config.gdim * (len(ghosts) + sum(elsewhere))
    figures = (len(points), len(target.facets.dofs), watch.counting.received, watch.projected, halo)
    figures += (watch.counting.by_ranks, watch.counting.partners)
    contactors, facets, received, projected, halos, by_ranks, partners = np.array(comm.allgather(figures)).T
    shares, work = contactors + facets, contactors + projected
    return {
        "contactors": int(contactors.sum()),
        "facets": int(facets.sum()),
        "share_max": int(shares.max()),
        "bytes_max": int(received.max()),
        "bytes_per_share": float((received / np.maximum(shares, comm.size)).max()),
        "bytes_per_rank": float(by_ranks.max() / max(comm.size - 1, 1)),
        "partners": int(partners.max()),
        "searched_ranks": float(projected.sum() / contactors.sum()),
        "halo_bytes_max": int(halos.max()),
        "imbalance": float(work.max() / work.mean()),
    }
