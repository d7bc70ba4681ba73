"""Other codes on the scene of ``hertz_cylinder.py``: what they are given, what they answer, and how their processes are run.

Every code gets the same nodes, cells and edges as arrays, runs on one thread in a process told from this one's MPI, and says how
long it took.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from common import outside_mpi

from uem_dolfinx import compat, forms

if TYPE_CHECKING:
    from uem_dolfinx.geometry.gmsh import Tags

#: One run, and the start of another one if it took less than this part of the time allowed.
REPEATED = 0.1


class PeerError(RuntimeError):
    """A code that did not come to an answer."""


@dataclass(frozen=True)
class Hertz:
    """Two bodies, a disc over a block, as arrays in DOLFINx's input order; plane strain.

    Attributes:
        x: nodes ``(n, 2)``.
        cells: nodes of the triangles, counterclockwise ``(n_cells, 3)``.
        disc: which cells are the disc's ``(n_cells,)``.
        edges: nodes of the edges of each named line, ``(n_edges, 2)``: ``symmetry``, ``block_bottom``, ``disc_top``, ``disc_arc``
            and ``block_top``.
        h: size of the cells in the contact zone.
        E: Young's modulus of both bodies.
        nu: Poisson's ratio.
        R: radius of the disc.
        push: by how much ``disc_top`` goes down.
    """

    x: np.ndarray = field(repr=False)
    cells: np.ndarray = field(repr=False)
    disc: np.ndarray = field(repr=False)
    edges: dict[str, np.ndarray] = field(repr=False)
    h: float
    E: float
    nu: float
    R: float
    push: float

    def nodes(self, name: str) -> np.ndarray:
        """Nodes of a line, ascending."""
        return np.unique(self.edges[name])

    def sides(self, name: str) -> np.ndarray:
        """Cell and number k of each edge of a line, from the cell's node k to the next ``(n_edges, 2)``."""
        n = len(self.x)
        sides = np.sort(np.stack([self.cells, np.roll(self.cells, -1, axis=1)], axis=2), axis=2) @ [n, 1]
        return np.argwhere(np.isin(sides, np.sort(self.edges[name], axis=1) @ [n, 1]))

    def lengths(self, name: str) -> np.ndarray:
        """Length of line that belongs to each of its nodes, in the order of ``nodes`` ``(n,)``."""
        a, b = self.edges[name].T
        half = np.linalg.norm(self.x[a] - self.x[b], axis=1) / 2
        return np.bincount(np.concatenate([a, b]), np.concatenate([half, half]), len(self.x))[self.nodes(name)]


@dataclass(frozen=True)
class Answer:
    """What a code comes to.

    Attributes:
        seconds: median of the runs that are counted.
        newton_iterations: of one run.
        P: force of both halves of the cylinder.
        p_max: largest pressure.
    """

    seconds: float
    newton_iterations: int
    P: float
    p_max: float


def gathered(mesh: Any, tags: Tags, **scene: float) -> Hertz | None:
    """Arrays of a distributed mesh of triangles with the tags of ``hertz_cylinder.geo``, on rank 0; None elsewhere (collective).

    Args:
        mesh: the mesh.
        tags: its tags.
        scene: the numbers of ``Hertz``.
    """
    tdim, topology, comm = mesh.topology.dim, mesh.topology, mesh.comm
    topology.create_connectivity(tdim - 1, 0)
    number = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    vertices, links = number[forms.vertex_nodes(mesh)], topology.connectivity(tdim - 1, 0).array.reshape(-1, 2)
    lines = {str(name): vertices[links[tag.entities]] for name, tag in tags.items() if tag.dim == tdim - 1}
    n_owned = topology.index_map(tdim).size_local
    disc = np.isin(np.arange(n_owned), tags["disc"].entities)
    cells = number[compat.geometry_dofs(mesh)[:n_owned]]
    parts = comm.gather((number, mesh.geometry.x[:, :2], cells, disc, lines))
    if parts is None:
        return None
    numbers, places, cells, disc = (np.concatenate([part[i] for part in parts]) for i in range(4))
    x = np.empty((numbers.max() + 1, 2))
    x[numbers] = places
    a, b, c = (x[cells[:, i]] for i in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    cells[clockwise] = cells[clockwise][:, [0, 2, 1]]
    # an edge between the parts of two ranks is there twice
    edges = {name: np.unique(np.sort(np.concatenate([part[4][name] for part in parts]), axis=1), axis=0) for name in lines}
    return Hertz(x, cells, disc, edges, **scene)


def run(command: Sequence[str], folder: Path, timeout: float) -> str:
    """Run a program in a folder, on one thread, told from this process's MPI.

    Args:
        command: program and arguments.
        folder: where it runs.
        timeout: seconds until it is stopped.

    Returns:
        What it printed.

    Raises:
        PeerError: it failed, or was stopped.
    """
    environment = outside_mpi() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    name = Path(command[0]).name
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        raise PeerError(f"{name} was stopped after {timeout:g} s") from None
    except OSError as error:
        raise PeerError(f"{name} could not be started: {error}") from None
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise PeerError(f"{name} ended with {done.returncode}: {last.strip()}")
    return done.stdout


def timed(solve: Callable[[], float], runs: int, timeout: float) -> float:
    """Median time of several runs after a first one that is not counted; a long first run is the only one, and counts.

    Args:
        solve: one run; returns its seconds.
        runs: that are counted.
        timeout: seconds allowed for one.
    """
    seconds = [solve()]
    while len(seconds) <= runs and sum(seconds) < REPEATED * timeout:
        seconds.append(solve())
    return float(np.median(seconds[1:] or seconds))
