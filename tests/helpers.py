"""Small scenes for the tests, built from DOLFINx alone: bodies, named surfaces, laws and Dirichlet conditions.

Surfaces and nodes are found by their places in the *drawing*, before a scene is turned, scaled or renumbered, so that one test can
look at the same scene in many poses and on any number of ranks.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


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


@dataclass(frozen=True)
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

    def tag(self, name: str, body: int, where: Callable[[Array], npt.NDArray[np.bool_]]) -> uem.Tag:
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
        return uem.Tag(name, 1, tdim - 1, mesh, np.array(facets, dtype=np.int32))

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
    comm: MPI.Comm,
    cell: str,
    bodies: Sequence[Body],
    *,
    pose: Callable[[Array], Array] = lambda x: x,
    shuffle: int | None = None,
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
    return Scene(mesh, drawing[nodes], body[np.asarray(mesh.topology.original_cell_index)])


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


def modulus(s: Scene, *E: float) -> fem.Function:
    """Young's modulus of each body as a DG0 field."""
    f = fem.Function(compat.dg0_space(s.mesh), name="E")
    f.x.array[compat.cell_dofs(f.function_space)[:, 0]] = np.array(E, dtype=float)[s.body]
    return f


def linear(u: fem.Function, E: Any, nu: float = 0.3) -> ufl.Form:
    """Small-strain elasticity (plane strain in 2D)."""
    v, g = ufl.TestFunction(u.function_space), u.function_space.mesh.geometry.dim
    eps = ufl.sym(ufl.grad(u))
    sigma = E / (1 + nu) * (eps + nu / (1 - 2 * nu) * ufl.tr(eps) * ufl.Identity(g))
    return ufl.inner(sigma, ufl.sym(ufl.grad(v))) * ufl.dx


def st_venant(u: fem.Function, E: Any, nu: float = 0.3) -> ufl.Form:
    """St Venant-Kirchhoff (plane strain in 2D)."""
    v, g = ufl.TestFunction(u.function_space), u.function_space.mesh.geometry.dim
    F = ufl.Identity(g) + ufl.grad(u)
    strain = 0.5 * (F.T * F - ufl.Identity(g))
    S = E / (1 + nu) * (strain + nu / (1 - 2 * nu) * ufl.tr(strain) * ufl.Identity(g))
    return ufl.inner(F * S, ufl.grad(v)) * ufl.dx


@dataclass
class Blocks:
    """Two boxes, the upper on the lower, their tags and a displacement."""

    scene: Scene
    V: Any
    u: fem.Function
    bottom: uem.Tag
    low: uem.Tag
    high: uem.Tag
    top: uem.Tag
    n_high_nodes: int

    @property
    def gdim(self) -> int:
        return self.scene.mesh.geometry.dim

    def oedometer(self, settlement: float) -> list[fem.DirichletBC]:
        """Conditions of one-dimensional compression: rollers at the sides and the bottom, the top pushed down."""
        g, x = self.gdim, self.scene.drawing
        bcs = [*clamp(self.V, self.bottom, g - 1), *clamp(self.V, self.top, g - 1, value=-settlement)]
        for c in range(g - 1):
            for end, body in product((x[:, c].min(), x[:, c].max()), (0, 1)):
                bcs += clamp(self.V, self.scene.tag("side", body, at(c, end)), c)
        return bcs


def blocks(
    comm: MPI.Comm,
    cell: str,
    n_low: int = 2,
    n_high: int = 4,
    *,
    gap: float = 0.0,
    degree: int = 1,
    overhang: float = 0.0,
    **how: Any,
) -> Blocks:
    """Unit block on unit block; ``low`` and ``high`` are the surfaces that face each other, ``gap`` apart.

    Args:
        comm: communicator.
        cell: kind of cells.
        n_low: divisions of the lower block in every direction.
        n_high: divisions of the upper block.
        gap: between them.
        degree: of the displacement.
        overhang: by how much the lower block is wider on every side.
        how: see ``scene``.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    lower = box(cell, [-overhang] * (g - 1) + [-1.0], [1.0 + overhang] * (g - 1) + [0.0], [n_low] * g)
    upper = box(cell, [0.0] * (g - 1) + [gap], [1.0] * (g - 1) + [1.0 + gap], [n_high] * g)
    s = scene(comm, cell, [lower, upper], **how)
    V = compat.function_space(s.mesh, degree, (g,))
    return Blocks(
        s, V, fem.Function(V, name="u"),
        s.tag("bottom", 0, at(g - 1, -1.0)), s.tag("low", 0, at(g - 1, 0.0)),
        s.tag("high", 1, at(g - 1, gap)), s.tag("top", 1, at(g - 1, 1.0 + gap)), len(upper.x),
    )  # fmt: skip


def run(problem: uem.UnitedProblem, steps: int = 1) -> list[uem.LoadStep]:
    """All load steps."""
    return list(uem.load_steps(problem, steps))


def gathered_matrix(A: PETSc.Mat) -> Array:
    """A distributed matrix as a dense one on every rank (collective)."""
    indptr, columns, values = A.getValuesCSR()
    first, _ = A.getOwnershipRange()
    rows = first + np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    dense = np.zeros(A.getSize())
    for r, c, v in A.comm.tompi4py().allgather((rows, columns, values)):
        np.add.at(dense, (r, c), v)
    return dense


def gathered_vector(x: PETSc.Vec) -> Array:
    """A distributed vector on every rank (collective)."""
    return np.concatenate(x.comm.tompi4py().allgather(np.array(x.array_r)))


def scattered(values: Array, like: PETSc.Vec) -> PETSc.Vec:
    """The distributed vector with these global values."""
    x = like.duplicate()
    x.array[:] = values[slice(*x.getOwnershipRange())]
    return x


def complementary(contact: uem.Contact, length: float, force: float) -> None:
    """Assert ``lambda >= 0, gap >= 0, lambda gap = 0`` at every contactor (collective, alike on all ranks).

    Args:
        contact: after a converged step.
        length: gaps below it are rounding.
        force: nodal forces below it are rounding.
    """
    pair, comm = contact.pair, contact.config.comm
    lam, gap, active = pair.trial.lam, pair.gap, pair.trial.active
    assert lowest(comm, lam) >= -force
    assert lowest(comm, gap[~pair.off]) >= -length
    assert highest(comm, np.abs(lam[~active])) <= 0.0
    assert highest(comm, np.abs(gap[active])) <= length


def lowest(comm: MPI.Comm, values: npt.ArrayLike) -> float:
    """Smallest value over all ranks (collective); an assertion must not fail on one rank only."""
    return float(min(comm.allgather(np.min(np.asarray(values, dtype=float), initial=np.inf))))


def highest(comm: MPI.Comm, values: npt.ArrayLike) -> float:
    """Largest value over all ranks; NaN anywhere makes it NaN, -inf stands for no value (collective)."""
    return float(np.max(comm.allgather(np.max(np.asarray(values, dtype=float), initial=-np.inf))))


def tangent_by_differences(problem: uem.UnitedProblem, contact: uem.Contact) -> tuple[PETSc.Vec, PETSc.Vec, PETSc.Vec]:
    """Change of ``F - sum lambda grad g`` along a smooth direction, all contactors active and contact forces held (collective).

    Returns:
        By differences, by ``K - sum lambda grad^2 g``, and by K alone.
    """
    system, pair, g, comm = problem.system, contact.pair, problem.config.gdim, problem.comm
    x = problem.config.X
    smooth = np.stack([0.05 * np.sin(2 * x[:, i] + i) * np.cos(x[:, (i + 1) % g]) for i in range(g)], axis=1)
    direction = np.stack([np.cos(3 * x[:, i] + 2 * i) + 0.3 * x[:, (i + 1) % g] for i in range(g)], axis=1)
    lam = 0.3 + 0.2 * np.sin(5 * x[pair.nodes].sum(axis=1))
    pair.trial = replace(pair.trial, active=np.ones(len(lam), bool), lam=lam, nodal=lam)

    def residual(u: Array) -> PETSc.Vec:
        problem.u.x.array[:] = u.ravel()
        system.place(returning=False)
        system.assemble_residual()
        pair.trial = replace(pair.trial, force=lam[:, None] * pair.projection.normal)
        r = system.residual
        r.axpy(-1.0, compat.petsc_vector(contact.force))
        return r

    residual(smooth)
    facets = pair.projection.facet.copy()
    system.tangent.update()
    A = system.tangent.K.copy()
    curvature = system._curvature()
    assert curvature is not None
    du = A.createVecRight()
    du.array[:] = direction[: problem.config.n_owned].ravel()
    plain = A * du
    full = plain + curvature * du
    h = 1e-5
    ahead = residual(smooth + h * direction)
    assert highest(comm, np.abs(pair.projection.facet - facets)) == 0
    difference = ahead - residual(smooth - h * direction)
    difference.scale(0.5 / h)
    return difference, full, plain


def outside_mpi() -> dict[str, str]:
    """Environment for a process that is told from this one's MPI."""
    own = ("OMPI_", "PMI", "HYD", "MPI_")
    return {k: v for k, v in os.environ.items() if not k.startswith(own) or k.startswith("OMPI_ALLOW")}


def start_process(script: str) -> subprocess.Popen[str]:
    """A Python process of its own that runs a script, told from this one's MPI."""
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=outside_mpi())
