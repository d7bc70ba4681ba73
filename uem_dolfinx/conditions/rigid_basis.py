"""Components of rigid sets that are kept as unknowns: well-conditioned, and the same on any number of ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.rings import DEPENDENT
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.places import COINCIDENT, NEAR
from uem_dolfinx.conditions.rigid_set import Placement, RigidSets
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.parallel import gathered, reduced


@dataclass(frozen=True)
class Basis:
    """Components q that sets keep, the same on all ranks.

    Attributes:
        node: global nodes ``(k,)``.
        component: of each ``(k,)``.
        part: set of each ``(k,)``.
        X: positions of the nodes in the reference configuration ``(k, gdim)``.
        kept: rows of C that are independent of those before them ``(n_kept,)``.
        least: smallest singular value of their rows and the rows of the prescribed motion, when they were chosen.
        halo: fetches values from the owners.
    """

    node: Ints
    component: Ints
    part: Ints
    X: Array
    kept: Ints
    least: float
    halo: Halo

    @cached_property
    def nodes(self) -> tuple[Ints, Ints]:
        """Distinct nodes, ascending, and the index of each component's node among them ``(k,)``."""
        nodes, which = np.unique(self.node, return_inverse=True)
        return nodes, which


def chosen(
    config: Configuration, s: RigidSets, names: Sequence[str], at: Sequence[Placement], C: Array, masks: tuple[Bools, Bools]
) -> Basis:
    """Components q that determine the motion together with C, each with the largest row orthogonal to the previous rows (collective).

    Args:
        config: configuration of the displacement.
        s: the sets.
        names: of their parts.
        at: their placements.
        C: scaled rows of length 1 ``(k, n_z)``.
        masks: free components of the nodes ``(n, gdim)``, and nodes that are preferably eliminated ``(n,)``.

    Raises:
        SurfaceError: if there are too few.
    """
    g, (free, avoided) = config.gdim, masks
    across, rest = s.velocities(at, s.X, s.part), C.copy()
    taken: list[Array] = []
    kept: list[int] = []
    for i in range(len(C)):
        if np.linalg.norm(rest[i]) > DEPENDENT:
            kept.append(i)
            across, rest = _without(across, rest[i]), _without(rest, rest[i])
    places = np.round(s.X / (COINCIDENT * config.size))
    numbers = config.to_global(s.nodes)
    for allowed in (~free, free & ~avoided[:, None], free):
        while len(taken) + len(kept) < across.shape[2]:
            size = np.where(allowed, np.linalg.norm(across, axis=2), 0.0)
            largest = float(reduced(config.comm, size.max(initial=0.0), op=MPI.MAX))
            if largest <= DEPENDENT:
                break
            # of equal candidates the first by position, on any number of ranks
            node, component = np.nonzero(size >= (1.0 - NEAR) * largest)
            order = np.lexsort([component, *places[node].T[::-1]])[:1]
            offer = np.full(2 * g + 3 + across.shape[2], np.inf)
            if len(order):
                i, j = node[order[0]], component[order[0]]
                offer = np.concatenate([places[i], [j, numbers[i], s.part[i]], s.X[i], across[i, j]])
            every = gathered(config.comm, offer)
            best = every[np.lexsort([*every[:, g::-1].T])[0]]
            taken.append(best[: 2 * g + 3])
            across = _without(across, best[2 * g + 3 :])
    if len(taken) + len(kept) < across.shape[2]:
        every_name = "', '".join(names)
        raise SurfaceError(
            f"the RigidCoupling of '{every_name}': its nodes do not determine its motion, given the prescribed "
            "components; give it more nodes, or leave out components of its motion"
        )
    table = np.array(taken).reshape(-1, 2 * g + 3)
    component, node, part = table[:, g : g + 3].astype(np.int64).T
    return Basis(node, component, part, table[:, g + 3 :], np.array(kept, dtype=np.int64), 0.0, Halo(config, node))


def _without(rows: Array, row: Array) -> Array:
    """Rows ``(..., n)`` without their components along another row."""
    q = row / np.linalg.norm(row)
    return rows - (rows @ q)[..., None] * q
