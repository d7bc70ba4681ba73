"""Scenes of boxes, of the extreme cases and of the tests, from DOLFINx alone: bodies, named surfaces and Dirichlet conditions.

Surfaces and nodes are found by their places in the *drawing*, before a scene is turned, scaled or renumbered. So the same scene
can be solved in many poses and on any number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
NU = 0.3


def oedometric(E: float = 1.0, nu: float = NU) -> float:
    """Modulus of a block that is held at its sides."""
    return E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))


def rotation(g: int, angle: float) -> Array:
    """Rotation in the plane of the first and the last axis, as a matrix ``(g, g)``."""
    R = np.eye(g)
    R[0, 0] = R[-1, -1] = np.cos(angle)
    R[-1, 0], R[0, -1] = np.sin(angle), -np.sin(angle)
    return R


@dataclass(frozen=True)
class Body:
    """Nodes ``(n, gdim)`` and cells in Gmsh's node order ``(n_cells, k)``."""

    x: Array
    cells: Ints

    def mapped(self, f: Callable[[Array], Array]) -> Body:
        """The body with its nodes moved."""
        return Body(f(self.x), self.cells)


def box(cell: str, lo: Sequence[float], hi: Sequence[float], n: Sequence[int]) -> Body:
    """Box ``[lo, hi]`` with ``n`` divisions per direction."""
    g = len(lo)
    axes = [np.linspace(a, b, k + 1) for a, b, k in zip(lo, hi, n)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, g)
    stride = np.cumprod([1, *(k + 1 for k in n[:0:-1])])[::-1]
    first = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, g) @ stride
    ring = [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = {
        "triangle": [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]],
        "quadrilateral": [ring],
        # Kuhn's six tetrahedra, one per order in which a path climbs from corner to corner
        "tetrahedron": [np.cumsum([[0] * 3, *np.eye(3, dtype=int)[list(p)]], axis=0) for p in permutations(range(3))],
        "hexahedron": [[(*c, z) for z in (0, 1) for c in ring]],
    }[cell]
    cells = np.concatenate([first[:, None] + np.array(c) @ stride for c in corners])
    return Body(x, cells.astype(np.int64))


@dataclass(eq=False)
class Scene:
    """Bodies in one distributed mesh.

    Attributes:
        mesh: the mesh.
        drawing: nodes before the pose ``(n, gdim)``, all of them on every rank, numbered body after body.
        body: body of each local cell, ghosts included.
    """

    mesh: Any
    drawing: Array
    body: Ints

    def tag(self, name: str, body: int, where: Callable[[Array], npt.NDArray[np.bool_]], number: int = 1) -> uem.Tag:
        """Facets of a body all of whose vertices satisfy ``where``, a function of places in the drawing ``(k, gdim)``."""
        mesh, tdim = self.mesh, self.mesh.topology.dim
        for a, b in ((tdim - 1, 0), (tdim - 1, tdim), (tdim, tdim - 1)):
            mesh.topology.create_connectivity(a, b)
        on = where(self.drawing[self.input_nodes[forms.vertex_nodes(mesh)]])
        f2v, f2c = mesh.topology.connectivity(tdim - 1, 0), mesh.topology.connectivity(tdim - 1, tdim)
        index = mesh.topology.index_map(tdim - 1)
        facets = [
            f
            for f in range(index.size_local + index.num_ghosts)
            if on[f2v.links(f)].all() and (self.body[f2c.links(f)] == body).any()
        ]
        return uem.Tag(name, number, tdim - 1, mesh, np.array(facets, dtype=np.int32))

    @property
    def input_nodes(self) -> Ints:
        """Number in the drawing of each local geometry node."""
        return np.asarray(self.mesh.geometry.input_global_indices, dtype=np.int64)

    def numbering(self, V: Any) -> Ints:
        """Number in the drawing of each local node of a P1 space."""
        out = np.empty(V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts, dtype=np.int64)
        out[compat.cell_dofs(V)] = self.input_nodes[compat.geometry_dofs(self.mesh)]
        return out

    def gather(self, f: fem.Function) -> Array:
        """Values of a P1 Function in the drawing's order ``(n, block size)``, on every rank (collective)."""
        V = f.function_space
        bs, n = V.dofmap.index_map_bs, V.dofmap.index_map.size_local
        parts = self.mesh.comm.allgather((self.numbering(V)[:n], f.x.array.reshape(-1, bs)[:n]))
        out = np.full((len(self.drawing), bs), np.nan)
        for nodes, values in parts:
            out[nodes] = values
        return out


def scene(
    comm: MPI.Comm, cell: str, bodies: Sequence[Body], *, pose: Callable[[Array], Array] = lambda x: x, shuffle: int | None = None
) -> Scene:
    """Merge bodies into one mesh (collective).

    Args:
        comm: communicator.
        cell: kind of all the cells.
        bodies: nodes are never shared between them, even where they coincide.
        pose: moves the nodes from the drawing to where they start.
        shuffle: seed of a random order of nodes and cells handed to DOLFINx.
    """
    first = np.cumsum([0, *(len(b.x) for b in bodies)])
    drawing = np.concatenate([b.x for b in bodies])
    cells = np.concatenate([b.cells + f for b, f in zip(bodies, first)])
    body = np.repeat(np.arange(len(bodies)), [len(b.cells) for b in bodies])
    nodes = np.arange(len(drawing))
    if shuffle is not None:
        rng = np.random.default_rng(shuffle)
        nodes, order = rng.permutation(nodes), rng.permutation(len(cells))
        place = np.argsort(nodes)
        cells, body = place[cells[order]], body[order]
    given = slice(None) if comm.rank == 0 else slice(0)
    mesh = compat.create_mesh(comm, cells[given], pose(drawing)[nodes][given], cell, 1)
    return Scene(mesh, drawing[nodes], body[forms.original_cells(mesh)])


def at(axis: int, value: float, tol: float = 1e-9) -> Callable[[Array], npt.NDArray[np.bool_]]:
    """Predicate of the plane ``x[axis] = value``."""
    return lambda x: np.abs(x[:, axis] - value) < tol


def clamp(V: Any, tag: uem.Tag, *components: int, value: float | Sequence[float] = 0.0) -> list[fem.DirichletBC]:
    """Prescribe components of the displacement on a tag's facets; ``value`` is one number, or a vector for all components."""
    if not np.isscalar(value):
        dofs = fem.locate_dofs_topological(V, tag.dim, tag.entities)
        return [fem.dirichletbc(np.array(value, dtype=PETSc.ScalarType), dofs, V)]
    bcs = []
    for c in components or range(V.mesh.geometry.dim):
        dofs = fem.locate_dofs_topological(V.sub(c), tag.dim, tag.entities)
        bcs.append(fem.dirichletbc(PETSc.ScalarType(value), dofs, V.sub(c)))
    return bcs
