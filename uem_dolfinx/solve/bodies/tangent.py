"""Derivatives at the present displacement: the tangent K of the bodies, the curvature of the contact, and inverted cells.

K is assembled only if something that it depends on has changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.blocks import SYMMETRIC
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import slides
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import InvertedElementError, MeshError, NotFiniteError, SpaceError, UEMError
from uem_dolfinx.geometry.axisymmetry import displacement_gradient, revolved
from uem_dolfinx.geometry.cells import flat_cells
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import described
from uem_dolfinx.log import compiling, timed
from uem_dolfinx.materials.elastic import differentiate
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.conditions.at_points import AtPoints
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.materials.elastic import HistoryMaterial


class Tangent:
    """K = dF/du, with the mass term in dynamics, assembled when it has changed.

    Args:
        F: UFL residual.
        materials: laws with stresses that are no expressions of u; they add their stiffness.
        dynamics: inertia, which adds a multiple of M, or None.
        points: loads and springs at nodes, or None.
        J: bilinear form in place of the derivative of F, or None.

    Raises:
        SpaceError: if F does not depend on u.
    """

    def __init__(
        self,
        F: ufl.Form,
        config: Configuration,
        materials: Sequence[HistoryMaterial] = (),
        dynamics: Dynamics | None = None,
        points: AtPoints | None = None,
        J: ufl.Form | None = None,
    ):
        u = config.whole
        #: Whether the tangent is a form of the user, and may differ from the derivative.
        self.given = J is not None
        derivative = ufl.derivative(F, u)
        J = derivative if J is None else forms.with_diagonal(revolved(J), config.unknowns.mixed)
        for material in materials:
            J += revolved(material.stiffness(ufl.TrialFunction(u.function_space), F.arguments()[0]))
        J, self._inputs = forms.with_derivatives(J)
        if J.empty():
            raise SpaceError("the residual F does not depend on u: build it from the same Function that the problem gets")
        self.linear: bool = not any(f is u for f in self._inputs)  # whether K is the same for every u
        if self.given:
            self.linear = self.linear and not any(f is u for f in forms.with_derivatives(derivative)[1])
        self._dynamics, self._factor, self.points = dynamics, 0.0, points
        self._values: list[Array] | None = None
        with compiling("the tangent"):
            self._form = forms.form(J)
        self._materials, self._unknowns = materials, config.unknowns
        self.K: PETSc.Mat = self._unknowns.create_matrix(self._form)
        self._free: Bools = np.ones((0, 0), dtype=bool)  # components without Dirichlet condition ``(n_rows, gdim)``
        #: Mask of free components without stiffness ``(n_rows * gdim,)``; None if there are none on any rank.
        self.bare: Bools | None = None
        self._lacks = config.unknowns.mixed  # whether K has zeros on its diagonal, which is completed at prescribed components
        self.number = 0  # number of assemblies

    @property
    def completed(self) -> bool:
        """Whether K has entries on its diagonal that are no derivatives."""
        return self._lacks

    def hold(self, free: Bools) -> None:
        """Set the mask of components without Dirichlet condition ``(n_rows, gdim)``; the sparsity of K includes all components."""
        self._free = free
        if self._lacks:
            # its diagonal was completed for other conditions
            self._values = None

    def take_points(self, points: Any) -> None:
        """Replace the loads and springs at nodes; K is assembled anew."""
        self.points, self._values = points, None

    def update(self) -> None:
        """Assemble K if something that it depends on has changed (collective)."""
        differentiate(self._materials)
        values, same = forms.read_values(self._inputs, self._values)
        factor = self._dynamics.factor if self._dynamics is not None else 0.0
        same &= factor == self._factor
        comm = self.K.comm.tompi4py()
        if reduced(comm, int(same)) == comm.size:
            return
        with timed("assemble tangent"):
            forms.assemble_matrix(self.K, self._form)
            if self.points is not None:
                self.points.add_stiffness(self.K)
            if self._dynamics is not None and factor:
                self.K.axpy(factor, self._dynamics.matrix, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
            self._complete(comm)
        self._values, self._factor = values, factor
        self.number += 1

    def _complete(self, comm: MPI.Comm) -> None:
        """Complete the diagonal of K, and find free components without stiffness of the bodies (collective)."""
        zero, mixed = self.K.getDiagonal().array_r == 0.0, self._unknowns.mixed
        self._lacks = bool(reduced(comm, int(zero.any()), op=MPI.MAX)) or mixed
        self.bare = None
        if not self._lacks:
            return
        self._unknowns.complete(self.K, self._free)
        # other fields may have no diagonal
        free = zero & self._free.ravel()
        self.bare = free if not mixed and reduced(comm, int(free.any()), op=MPI.MAX) else None


def contact_curvature(parts: Sequence[tuple[Ints, Array]], du: PETSc.Vec) -> PETSc.Mat:
    """Matrix of ``-sum lambda grad^2 g``, to be added to K (collective).

    Args:
        parts: of every pair, global nodes ``(k, m)``, negative if missing, and the blocks ``(k, r gdim, m gdim)``, whose rows are of the
            first ``r`` of the nodes.
        du: a vector with the displacement's layout.
    """
    g = du.getBlockSize()
    # the number of blocks at each node bounds the length of its rows
    counts = du.duplicate()
    counts.set(0.0)
    for nodes, blocks in parts:
        width, rows_of = nodes.shape[1], nodes[:, : blocks.shape[1] // g]
        flat = rows_of[rows_of >= 0].astype(PETSc.IntType)
        index = (flat[:, None] * g + np.arange(g, dtype=PETSc.IntType)).ravel()
        counts.setValues(index, np.full(len(index), float(width * g)), addv=PETSc.InsertMode.ADD)
    counts.assemble()
    n = counts.getLocalSize()
    rows = np.minimum(counts.array_r, counts.getSize())
    G = PETSc.Mat().createAIJ(
        (du.getSizes(), du.getSizes()),
        bsize=g,
        nnz=(np.minimum(rows, n).astype(PETSc.IntType), np.minimum(rows, counts.getSize() - n).astype(PETSc.IntType)),
        comm=du.comm,
    )
    G.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, False)
    # set explicitly, since ranks without nodes would otherwise assemble differently
    G.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, True)
    for nodes, blocks in parts:
        if len(nodes):
            which = nodes.astype(PETSc.IntType)
            G.setValuesBlockedRCV(which[:, : blocks.shape[1] // g], which, blocks, addv=PETSc.InsertMode.ADD)
    G.assemble()
    return G


def convex_part(blocks: Array) -> Array:
    """Blocks ``(k, n, n)``, without negative eigenvalues in symmetric blocks."""
    out = blocks.copy()
    which = np.flatnonzero((blocks == blocks.transpose(0, 2, 1)).all(axis=(1, 2)))
    value, vector = np.linalg.eigh(blocks[which])
    out[which] = (vector * np.maximum(value, 0.0)[:, None]) @ vector.transpose(0, 2, 1)
    return out


def symmetric(blocks: Array) -> Array:
    """Symmetric parts of blocks ``(k, n, n)``."""
    return np.asarray(0.5 * (blocks + blocks.transpose(0, 2, 1)))


def is_skew(blocks: Array) -> bool:
    """Whether blocks ``(k, n, n)`` have a skew part that is more than rounding."""
    skew = np.abs(blocks - blocks.transpose(0, 2, 1)).max(initial=0.0)
    return bool(skew > SYMMETRIC * np.abs(blocks).max(initial=0.0))


def curvature_of(
    pairs: Sequence[Interface],
    du: PETSc.Vec,
    apart: bool,
    convex: bool,
    linear: UserRows | None = None,
    states: Sequence[PairState] | None = None,
) -> PETSc.Mat | None:
    """``-sum lambda grad^2 g`` of all pairs and of rigid couplings, or None if it vanishes (collective).

    Args:
        pairs: of all contacts.
        du: a vector with the displacement's layout.
        apart: whether P differs from Q; otherwise only the symmetric part is used, but of moments whose axes do not turn with a part.
        convex: whether terms that could make the tangent indefinite are neglected.
        linear: equations of users, or None.
        states: whose forces act; None for the trial states.
    """
    found = zip(pairs, states or [pair.trial for pair in pairs])
    moving = [(pair, state) for pair, state in found if slides(pair)]
    if not moving and linear is None:
        return None
    parts = [part for pair, state in moving for part in _curvature(pair, state, apart, convex)]
    contacts = len(parts)
    parts += [] if linear is None else linear.curvature()
    for i, (nodes, blocks) in enumerate(parts):
        # in place, to save memory
        blocks = convex_part(blocks) if convex else blocks
        whole = apart or (i >= contacts and not convex and is_skew(blocks))
        parts[i] = nodes, blocks if whole else symmetric(blocks)
    # it vanishes e.g. for a plane
    if not reduced(du.comm.tompi4py(), any([blocks.any() for _, blocks in parts])):
        return None
    return contact_curvature(parts, du)


def _curvature(pair: Interface, state: PairState, apart: bool, convex: bool) -> list[tuple[Ints, Array]]:
    """See ``Interface.curvature``; with averaged normals the symmetric part alone where P and Q are equal, or ``convex`` (collective)."""
    parts = pair.curvature(state)
    if not pair.target.averaged or (apart and not convex):
        return parts
    return [(nodes, symmetric(blocks)) for nodes, blocks in parts if blocks.shape[1] == blocks.shape[2]]


def known_forces(pairs: Sequence[Interface]) -> list[tuple[Ints, Array]]:
    """Frictional forces that are independent of normal forces, of pairs with such forces on any rank (collective)."""
    rubbing = [(pair, pair.friction) for pair in pairs if pair.friction is not None]
    if not rubbing:
        return []
    some = reduced(pairs[0].config.comm, np.array([own.has_known_forces(pair.trial) for pair, own in rubbing]), op=MPI.LOR)
    return [own.known_forces(pair.trial, pair.kinematics) for pair, own in compress(rubbing, some)]


def slip_terms(
    pairs: Sequence[Interface], du: PETSc.Vec, linear: UserRows | None = None, convex: bool = False
) -> tuple[PETSc.Mat | None, PETSc.Vec | None]:
    """Tangent terms of slip directions, heat through contacts, masses at points and springs, and residual terms of slip (collective).

    Args:
        pairs: of all contacts.
        du: a vector with the layout of all unknowns.
        linear: equations of users, or None.
        convex: whether softening is neglected.

    Returns:
        Matrix and vector, each None if it vanishes.
    """
    g, comm = du.getBlockSize(), du.comm.tompi4py()
    parts = [terms for pair in pairs if (terms := pair.slip_terms(convex)) is not None]
    heat = [part for pair in pairs for one in pair.heats for part in one.tangent()]
    slips = bool(parts) and reduced(comm, sum(len(nodes) for nodes, _, _ in parts)) > 0
    passes = bool(heat) and reduced(comm, sum(len(nodes) for nodes, _ in heat)) > 0
    masses = [] if linear is None else [*linear.added_mass(), *linear.stiffness()]
    if not (slips or passes or masses):
        return None, None
    added = contact_curvature([*((nodes, blocks) for nodes, blocks, _ in parts), *heat, *masses], du)
    if not slips:
        return added, None
    held = du.duplicate()
    held.set(0.0)
    for nodes, _, forces in parts:
        there = nodes >= 0
        index = (nodes[there][:, None] * g + np.arange(g)).ravel().astype(PETSc.IntType)
        held.setValues(index, forces.reshape(*nodes.shape, g)[there].ravel(), addv=PETSc.InsertMode.ADD)
    held.assemble()
    return added, held


def added_mass(linear: UserRows | None, like: PETSc.Vec) -> PETSc.Mat | None:
    """Masses at points of rigid couplings as a matrix for vectors like this one, or None (collective)."""
    parts = [] if linear is None else linear.added_mass(1.0)
    return contact_curvature(parts, like) if parts else None


def together(A: PETSc.Mat | None, B: PETSc.Mat | None) -> PETSc.Mat | None:
    """The sum of two matrices, either of which may be None."""
    if A is None or B is None:
        return B if A is None else A
    both = A.copy()
    both.axpy(1.0, B, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    return both


class Inversions:
    """Search for cells that the displacement inverts."""

    def __init__(self, config: Configuration):
        self.config = config
        G = displacement_gradient(config.u)
        self._J = ufl.det(ufl.Identity(G.ufl_shape[0]) + G)
        one = fem.Constant(config.mesh, 1.0)
        with compiling("the search for cells turned inside out"):
            self._volume = forms.form(ufl.conditional(ufl.le(self._J, 0.0), one, 0.0 * one) * ufl.dx(domain=config.mesh))

    def marked(self, F: ufl.Form, dynamics: Dynamics | None) -> ufl.Form:
        """The residual that steps of ``dynamics`` assemble, F: in explicit steps NaN where points of its cells are turned inside out."""
        if dynamics is None or not dynamics.scheme.explicit:
            return F
        nothing = (
            ufl.conditional(ufl.gt(self._J, 0.0), 0.0, fem.Constant(self.config.mesh, np.nan)) * ufl.grad(F.arguments()[0])[0, 0]
        )
        return ufl.Form(
            [one.reconstruct(one.integrand() + nothing) if one.integral_type() == "cell" else one for one in F.integrals()]
        )

    def find(self, vertices: bool = False) -> str | None:
        """Position of the worst cell that is inverted at its middle, or at one of its ``vertices``; or None (collective)."""
        config = self.config
        if not vertices and forms.assemble_scalar(self._volume, config.comm) == 0.0:
            return None
        determinant = fem.Function(compat.function_space(config.mesh, ("DG", int(vertices))))
        forms.interpolation(determinant, self._J)()
        least = determinant.x.array[compat.cell_dofs(determinant.function_space)].min(axis=1, initial=np.inf)
        here = (np.inf, "")
        if len(least):
            cell = int(least.argmin())
            here = (float(least[cell]), str(np.round(config.X[compat.cell_dofs(config.V)[cell]].mean(axis=0), 6)))
        worst, where = min(config.comm.allgather(here))
        return where if worst <= 0.0 or not vertices else None


def not_finite(bodies: Any, when: str, remedy: str) -> UEMError:
    """The error for forces that are not finite: a flat cell, or one turned inside out, or ``remedy`` for anything else (collective)."""
    if where := _flat_cell(bodies.config):
        return MeshError(f"the cell of the mesh at {where} is flat, so that strains in it are not finite: mend the mesh")
    inversions = bodies.inversions
    if inversions is not None and (where := inversions.find() or inversions.find(vertices=True)) is not None:
        return InvertedElementError(f"the cell at {where} is turned inside out: take smaller load steps or a finer mesh there")
    return NotFiniteError(f"the residual is not finite {when}: {remedy}")


def _flat_cell(config: Configuration) -> str:
    """Position of the first cell without area or volume of the first rank with one; empty without any (collective)."""
    cell, mesh = compat.cell_name(config.mesh), config.mesh
    nodes = compat.geometry_dofs(mesh)[:, : len(forms.reference_topology(cell)[0])].astype(np.int64)
    flat = np.flatnonzero(flat_cells(cell, 1, nodes, mesh.geometry.x))
    found = described(mesh.geometry.x[nodes[flat[0]]].mean(axis=0)[: config.gdim]) if len(flat) else ""
    return next(filter(None, config.comm.allgather(found)), "")


def driven_on(config: Any, diagonal: Array, rounding: float) -> str | None:
    """Words for what the ``diagonal`` of K ``(n_owned, gdim)`` drives on beyond a part ``rounding``, or None (collective)."""
    largest = reduced(config.comm, float(np.abs(diagonal).max(initial=0.0)), op=MPI.MAX)
    node, axis = (some[:1] for some in np.nonzero(diagonal < -rounding * largest))
    offers = config.comm.allgather([f"{'xyz'[axis[0]]} at {config.describe(int(node[0]))}"] if len(node) else [])
    place = next(filter(None, offers), None)
    return place and (
        f"the tangent of the bodies is indefinite: a displacement along {place[0]} alone is driven on, not resisted; check "
        "the sign of F, and that moduli are positive"
    )
