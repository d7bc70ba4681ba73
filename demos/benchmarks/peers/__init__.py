"""Other codes on the scenes of ``hertz_cylinder.py`` and ``hertz_sphere.py``: what they are given and answer, how they are run.

Every code gets the same nodes, cells and facets as arrays, runs on one thread in a process without this one's MPI, and says how
long it took.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
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
    """Two bodies, a disc or a sphere over a block, as arrays in DOLFINx's input order; plane strain in 2D.

    Attributes:
        x: nodes ``(n, gdim)``.
        cells: nodes of the triangles, counterclockwise, or of the tetrahedra, of positive volume ``(n_cells, gdim + 1)``.
        upper: which cells are the disc's or the sphere's ``(n_cells,)``.
        facets: nodes of the facets of each named surface, ``(n_facets, gdim)``.
        contactor: name of the surface of the upper body that comes into contact; the other is ``block_top``.
        supports: names of surfaces, and the component and value that are prescribed there.
        led: those of a second step, in which friction acts.
        friction: coefficient of friction.
        parts: how many like it make the whole.
        h: size of the cells in the contact zone.
        E: Young's modulus of both bodies.
        nu: Poisson's ratio.
        R: radius of the disc or sphere.
    """

    x: np.ndarray = field(repr=False)
    cells: np.ndarray = field(repr=False)
    upper: np.ndarray = field(repr=False)
    facets: dict[str, np.ndarray] = field(repr=False)
    contactor: str
    supports: list[tuple[str, int, float]]
    parts: int
    h: float
    E: float
    nu: float
    R: float
    friction: float = 0.0
    led: list[tuple[str, int, float]] = field(default_factory=list)

    @property
    def gdim(self) -> int:
        """2 or 3."""
        return self.x.shape[1]

    def nodes(self, name: str) -> np.ndarray:
        """Nodes of a surface, ascending."""
        return np.unique(self.facets[name])

    def sides(self, name: str) -> np.ndarray:
        """Cell of each facet of a surface, and which of its nodes lies opposite ``(n_facets, 2)``."""
        n, own = len(self.x), np.sort(self.facets[name], axis=1)
        powers = n ** np.arange(self.gdim)
        opposite = [np.sort(np.delete(self.cells, k, axis=1), axis=1) @ powers for k in range(self.gdim + 1)]
        return np.argwhere(np.isin(np.stack(opposite, axis=1), own @ powers))

    def sizes(self, name: str) -> np.ndarray:
        """Length or area that belongs to each node of a surface, in the order of ``nodes`` ``(n,)``."""
        own = self.facets[name]
        along = self.x[own[:, 1:]] - self.x[own[:, :1]]
        size = np.sqrt(np.linalg.det(along @ along.transpose(0, 2, 1))) / (self.gdim - 1)
        return np.bincount(own.ravel(), np.repeat(size / self.gdim, self.gdim), len(self.x))[self.nodes(name)]


@dataclass(frozen=True)
class Answer:
    """What a code comes to.

    Attributes:
        seconds: of the processor, median of the runs that are counted.
        newton_iterations: of one run.
        P: force of all parts of the cylinder or sphere.
        p_max: largest pressure.
        Q: force along the surface.
    """

    seconds: float
    newton_iterations: int
    P: float
    p_max: float
    Q: float = 0.0


def gathered(mesh: Any, tags: Tags, upper: str, **scene: Any) -> Hertz | None:
    """Arrays of a distributed mesh of triangles or tetrahedra, on rank 0; None elsewhere (collective).

    Args:
        mesh: the mesh.
        tags: its tags, those of ``hertz_cylinder.geo`` or ``hertz_sphere.geo``.
        upper: tag of the upper body's cells.
        scene: the other attributes of ``Hertz``.
    """
    tdim, topology, comm = mesh.topology.dim, mesh.topology, mesh.comm
    topology.create_connectivity(tdim - 1, 0)
    number = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    vertices, links = number[forms.vertex_nodes(mesh)], topology.connectivity(tdim - 1, 0).array.reshape(-1, tdim)
    surfaces = {str(name): vertices[links[tag.entities]] for name, tag in tags.items() if tag.dim == tdim - 1}
    n_owned = topology.index_map(tdim).size_local
    above = np.isin(np.arange(n_owned), tags[upper].entities)
    cells = number[compat.geometry_dofs(mesh)[:n_owned]]
    parts = comm.gather((number, mesh.geometry.x[:, :tdim], cells, above, surfaces))
    if parts is None:
        return None
    numbers, places, cells, above = (np.concatenate([part[i] for part in parts]) for i in range(4))
    x = np.empty((numbers.max() + 1, tdim))
    x[numbers] = places
    turned = np.linalg.det(x[cells[:, 1:]] - x[cells[:, :1]]) < 0
    cells[turned] = cells[turned][:, [0, 2, 1, 3][: tdim + 1]]
    # a facet between the parts of two ranks is there twice
    facets = {name: np.unique(np.sort(np.concatenate([part[4][name] for part in parts]), axis=1), axis=0) for name in surfaces}
    return Hertz(x, cells, above, facets, **scene)


def run(command: Sequence[str], folder: Path, timeout: float) -> str:
    """Run a program in a folder, on one thread, without this process's MPI.

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


@cache
def python_with(module: str, *pythons: str) -> str | None:
    """The first of some Pythons that has a module, if one does."""
    for python in pythons:
        try:
            run([python, "-I", "-c", f"import numpy, {module}"], Path.cwd(), 60.0)
        except PeerError:
            continue
        return python
    return None


def answer_of(code: str, python: str, script: Path, timeout: float, **scene: Any) -> dict[str, Any]:
    """The answer of a script that solves the scene with another code, in a Python of its own: ``scene.npz answer.json``.

    Args:
        code: its name.
        python: that has it.
        script: what to run.
        timeout: seconds until it is stopped.
        scene: arrays, numbers and texts for it.

    Returns:
        Its answer, with the median of those ``seconds`` that count.

    Raises:
        PeerError: it failed, was stopped, or did not converge.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "scene.npz", **scene)
        run([python, "-I", str(script), "scene.npz", "answer.json"], folder, timeout)
        answer: dict[str, Any] = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
    if not answer["converged"]:
        raise PeerError(f"{code} did not converge in {answer['iterations']} iterations")
    return answer | {"seconds": float(np.median(answer["seconds"][1:] or answer["seconds"]))}


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
