"""Rigid motions of bodies: open motions under conditions and contacts, loaded motions, and supports of the neutral ones.

Matrices are sparse: a motion that nothing resists concerns a single body, and others concern bodies that touch each other.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_rows
from uem_dolfinx.errors import FloatingBodyError, ThrownBodyError
from uem_dolfinx.forms import product
from uem_dolfinx.geometry.bodies import find_bodies, middle, rigid_velocities
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.rigid import rotation_matrix
from uem_dolfinx.parallel import reduced

#: A motion is open if conditions and contacts resist it with less than this part of its size.
#: [convention; size of the motion; test_rigid_motions.py::test_what_counts_as_open]
OPEN = 1e-5
#: Coordinates that differ by less are the same: nodes are put in order by their places on any number of ranks.
#: [bound; the model's size; -]
SAME_PLACE = 1e-9
#: A motion is loaded if the forces along it exceed this part of all forces; supports may be left with less.
#: [convention; sum of all forces; test_rigid_motions.py::test_what_counts_as_loaded]
LOADED = 1e-6
#: Springs hold a body along a motion if they resist it with more than this part of the diagonal of K; the rest is rounding.
#: [convention; work of the diagonal of K; test_rigid_motions.py::test_what_counts_as_held_by_springs]
SPRINGY = 1e-12


class RigidMotions:
    """Rigid motions of the bodies of a scene that its Dirichlet conditions do not hold.

    A motion is a vector with as many entries per body as it has rigid-body modes: translations, then rotations about the body's
    middle in units of its radius, so that all entries are lengths. Several motions are the columns of a sparse matrix.

    Args:
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        finite: whether rotations of bodies are finite, not linearised.
    """

    def __init__(self, config: Configuration, free: Bools, finite: bool):
        self.config, self.comm, self.free, self.finite = config, config.comm, free, finite
        self._body, self.count = find_bodies(config)
        own = self._body[: config.n_owned]
        self.middle = self._middles()
        radius = np.zeros(self.count)
        np.maximum.at(radius, own, np.linalg.norm(config.X[: config.n_owned] - self.middle[own], axis=1))
        self.comm.Allreduce(MPI.IN_PLACE, radius, op=MPI.MAX)
        self.radius: Array = radius
        #: Modes that are no rigid-body motions: in axisymmetry all except the translation along the axis.
        self._strained = [0, 2] if config.axisymmetric else []
        self._supports: tuple[Array, Bools] | None = None
        #: Motions that forces of the form resist, e.g. springs, for each body; None if not determined.
        self._springs: Array | None = None
        #: Motions that the conditions leave open, a sparse matrix ``(n_motions, k)``; constant for linearised rotations.
        self._unheld: Any | None = None
        #: Velocities of the owned nodes in the modes of their bodies, constant for linearised rotations; None until needed.
        self._drawn: Array | None = None
        self.share = 0.0  # largest force along an open motion relative to the sum of all forces, at the last call of ``load``

    # -- motions ---------------------------------------------------------------------------------------------------------

    @property
    def _places(self) -> Array:
        """Positions of the owned nodes for the modes ``(n_owned, gdim)``: present, or of reference if rotations are linearised."""
        return (self.config.x if self.finite else self.config.X)[: self.config.n_owned]

    def _middles(self) -> Array:
        """Means of the bodies' nodes ``(count, gdim)`` (collective)."""
        own = self._body[: self.config.n_owned]
        sums = reduced(self.comm, sums_of_rows(own, np.column_stack([np.ones(len(own)), self._places]), self.count))
        return np.asarray(sums[:, 1:] / sums[:, :1])

    def _modes(self, x: Array, body: Ints) -> Array:
        """Velocities of points ``x (n, gdim)`` of bodies ``(n,)`` in each mode of their body ``(n, n_modes, gdim)``."""
        modes = rigid_velocities((x - self.middle[body]) / self.radius[body][:, None])
        modes[:, self._strained] = 0.0
        return modes

    def _own_modes(self) -> Array:
        """Velocities of the owned nodes in the modes of their bodies ``(n_owned, n_modes, gdim)``."""
        if self.finite or self._drawn is None:
            self._drawn = self._modes(self._places, self._body[: self.config.n_owned])
        return self._drawn

    @property
    def n_modes(self) -> int:
        """Number of rigid-body modes of one body."""
        return 3 if self.config.gdim == 2 else 6

    def _spread(self, values: Array, body: Ints, row: Ints | None = None, number: int | None = None) -> Any:
        """Rows in all motions, as sums of rows in the modes of single bodies.

        Args:
            values: rows in the modes of a body ``(n, n_modes)``.
            body: of each row ``(n,)``.
            row: number of the sum that each row belongs to ``(n,)``; None for separate rows.
            number: of sums.

        Returns:
            Sparse matrix ``(number, n_motions)``.
        """
        from scipy.sparse import csr_matrix

        n = self.n_modes
        column = (body[:, None] * n + np.arange(n)).ravel()
        if row is None or number is None:
            starts = np.arange(0, values.size + 1, n)
            return csr_matrix((values.ravel(), column, starts), shape=(len(values), self.count * n))
        return csr_matrix((values.ravel(), (np.repeat(row, n), column)), shape=(number, self.count * n))

    def rates(self, equations: UnitingEquations) -> Any:
        """Rate of the gap of each equation in each motion, a sparse matrix ``(m, n_motions)`` (collective)."""
        config, g = self.config, self.config.gdim
        if self.finite:
            self.middle = self._middles()
        own, x = self._body[: config.n_owned], self._places
        known = config.ask_owners(equations.followed, np.column_stack([own, x]))
        body = np.append(own[equations.node], known[:, 0].astype(np.int64))
        modes = self._modes(np.concatenate([x[equations.node], known[:, 1 : 1 + g]]), body)
        terms = np.einsum("nmg,ng->nm", modes, np.concatenate([equations.direction, -equations.coefficients]))
        return self._spread(terms, body, np.append(np.arange(len(equations)), equations.row), len(equations))

    def open_motions(self, rates: Any | None) -> Any:
        """Orthonormal motions that neither conditions nor equations with these ``rates`` resist, sparse ``(n_motions, k)`` (collective)."""
        if self.finite and rates is None:
            self.middle = self._middles()
        if self.finite or self._unheld is None:
            body, modes, _ = self._held()
            resisted = reduced(self.comm, self._products(body, modes, modes))
            # the stiffness of the bodies resists these modes
            resisted[:, self._strained, self._strained] = 1.0
            if self._springs is not None:
                resisted += self._springs
            values, vectors = np.linalg.eigh(resisted)
            b, k = np.nonzero(values < OPEN**2)
            self._unheld = self._spread(vectors[b, :, k], b).T.tocsr()
        free = self._unheld
        if rates is None:
            return free
        here = rates @ free
        resisted = sum(self.comm.allgather((here.T @ here).tocsc()))

        def least(blocks: Array) -> tuple[Array, Bools]:
            values, vectors = np.linalg.eigh(blocks)
            return vectors, values < OPEN**2

        return (free @ by_block(resisted, least)).tocsc()

    def ask_stiffness(self, K: PETSc.Mat) -> None:
        """Treat motions that K resists, e.g. by springs in a form, as held, unless K is not finite (collective).

        With the modes R of a body and the work D of each on the diagonal of K, these are the eigenvectors of ``D^-1/2 R'KR D^-1/2`` with
        eigenvalues above rounding.
        """
        config, unknowns, own = self.config, self.config.unknowns, self._body[: self.config.n_owned]
        modes, size = self._modes(self._places, own), config.n_owned * config.gdim
        sides = []
        for k in range(self.n_modes):
            v = unknowns.vector()
            v.array[:size] = modes[:, k].ravel()
            sides.append(product(K, v).array_r[:size].reshape(-1, config.gdim))
        work = np.einsum("nmg,kng->nmk", modes, np.array(sides))
        diagonal = np.abs(K.getDiagonal().array_r[:size].reshape(-1, config.gdim))
        parts = np.concatenate([work, np.einsum("nmg,ng->nm", modes**2, diagonal)[:, :, None]], axis=2)
        sums = reduced(self.comm, sums_of_rows(own, parts.reshape(len(own), self.n_modes * (self.n_modes + 1)), self.count))
        if not np.isfinite(sums).all():
            return
        G, D = np.split(sums.reshape(self.count, self.n_modes, -1), [self.n_modes], axis=2)
        # the work is zero for a body without stiffness, e.g. one that a coupling makes rigid
        S = np.sqrt(D / np.maximum(D.max(axis=1, keepdims=True), np.finfo(float).tiny))
        scale = np.where(D > 0, 1.0 / np.sqrt(np.where(D > 0, D, 1.0)), 0.0)
        values, vectors = np.linalg.eigh(0.5 * (G + G.transpose(0, 2, 1)) * scale * scale.transpose(0, 2, 1))
        held = S * np.where(values > SPRINGY, 1.0, 0.0)[:, None, :] * vectors
        self._springs, self._unheld = held @ held.transpose(0, 2, 1), None

    def any_open(self) -> bool:
        """Whether the conditions leave any motion open (collective)."""
        return bool(self.open_motions(None).shape[1])

    def _held(self) -> tuple[Ints, Array, tuple[Ints, Ints]]:
        """Components with a Dirichlet condition: bodies ``(n,)``, velocities in the modes ``(n, n_modes)``, nodes and components."""
        i, c = np.nonzero(~self.free)
        body = self._body[i]
        return body, self._modes(self._places[i], body)[np.arange(len(i)), :, c], (i, c)

    def _products(self, body: Ints, a: Array, b: Array) -> Array:
        """Sums of the products of rows of ``a (n, j)`` and ``b (n, k)`` for each body ``(count, j, k)``."""
        sums = sums_of_rows(body, (a[:, :, None] * b[:, None, :]).reshape(len(a), a.shape[1] * b.shape[1]), self.count)
        return sums.reshape(self.count, a.shape[1], b.shape[1])

    def following(self, prescribed: Array) -> Array:
        """The motion that follows increments ``(n_owned, gdim)`` of Dirichlet values by least squares, not along open ones (collective)."""
        if self.finite:
            self.middle = self._middles()
        body, modes, at = self._held()
        sums = self._products(body, modes, np.column_stack([modes, prescribed[at]]))
        sums = reduced(self.comm, sums)
        return np.asarray(np.linalg.pinv(sums[:, :, :-1], OPEN**2, hermitian=True) @ sums[:, :, -1:]).ravel()

    def forces(self, residual: Array, among: Array | None = None) -> tuple[Array, float]:
        """Forces along all motions ``(n_motions,)``, and the sum of all nodal forces (collective).

        Args:
            residual: ``F`` at the owned nodes ``(n_owned, gdim)``.
            among: forces whose sum is returned ``(n_owned, gdim)``; None for the residual.
        """
        own = self._body[: self.config.n_owned]
        work = -np.einsum("nmg,ng->nm", self._own_modes(), residual)
        force = sums_of_rows(own, work, self.count)
        total, scale = (
            sum(part) for part in zip(*self.comm.allgather((force.ravel(), np.abs(residual if among is None else among).sum())))
        )
        return total, scale

    def load(self, motions: Array, residual: Array, among: Array | None = None) -> Array:
        """Force along those of the given motions that are loaded, as a motion; zero if no motion is loaded (collective).

        Args:
            motions: sparse matrix ``(n_motions, k)``.
            residual: see ``forces``.
            among: see ``forces``.
        """
        if not motions.shape[1]:
            self.share = 0.0
            return np.zeros(motions.shape[0])
        total, scale = self.forces(residual, among)
        along = np.asarray(motions.T @ total)
        self.share = float(np.abs(along).max(initial=0.0) / scale) if scale > 0 else 0.0
        force = motions @ np.where(np.abs(along) > LOADED * scale, along, 0.0)
        # held bodies do not move, to the last bit
        return np.where(np.abs(force) > OPEN**2 * np.abs(force).max(initial=0.0), force, 0.0)

    def field(self, motion: Array) -> Array:
        """The velocities of the owned nodes in a motion ``(n_owned, gdim)``."""
        own = self._body[: self.config.n_owned]
        parts = motion.reshape(self.count, self.n_modes)
        return np.asarray(np.einsum("nmg,nm->ng", self._own_modes(), parts[own]))

    def part(self, motions: Array, du: Array) -> Array:
        """Part of an increment ``(n_owned, gdim)`` along some motions ``(n_motions, k)``, of the same shape (collective).

        Without this part the increment does not depend on the supports, and bodies do not move along neutral motions.
        """
        from scipy.sparse.linalg import spsolve

        if not motions.shape[1]:
            return np.zeros_like(du)
        own = self._body[: self.config.n_owned]
        modes = self._own_modes().transpose(0, 2, 1).reshape(du.size, self.n_modes)
        fields = self._spread(modes, np.repeat(own, self.config.gdim)) @ motions
        gram, along = (sum(a) for a in zip(*self.comm.allgather(((fields.T @ fields).tocsc(), fields.T @ du.ravel()))))
        return np.asarray(fields @ spsolve(gram, along)).reshape(du.shape)

    def ways(self, motion: Array) -> Array:
        """Displacements of nodes in a motion, ghosts included ``(n_local, gdim)``."""
        config, g = self.config, self.config.gdim
        parts = motion.reshape(self.count, self.n_modes)
        body = self._body
        if not self.finite:
            return np.asarray(np.einsum("nmg,nm->ng", self._modes(config.X, body), parts[body]))
        x = config.x
        turns = np.array([rotation_matrix(_turn(angles)) for angles in parts[:, g:] / self.radius[:, None]]) - np.eye(g)
        return np.asarray(np.einsum("nab,nb->na", turns[body], x - self.middle[body]) + parts[body, :g])

    # -- supports ----------------------------------------------------------------------------------------------------------

    def supports(self, motions: Any, equations: UnitingEquations, left: Bools | None = None) -> Bools:
        """Mask of components of owned nodes that hold neutral motions without reaction ``(n_owned, gdim)`` (collective).

        One component per motion: the one with the largest velocity in the motions that earlier supports leave open.

        Args:
            motions: sparse matrix ``(n_motions, k)``.
            equations: their nodes are not used as supports.
            left: mask of components that rigid couplings do not eliminate ``(n_owned, gdim)``; None for all.
        """
        if not motions.shape[1]:
            return np.zeros((self.config.n_owned, self.config.gdim), dtype=bool)
        if self._supports is not None:
            before, pins = self._supports
            gone = left is not None and reduced(self.comm, bool((pins & ~left).any()), op=MPI.LOR)
            if not gone and before.shape == motions.shape and abs(before @ (before.T @ motions) - motions).max() < OPEN:
                return pins
        from scipy.sparse import csr_matrix

        config, g, comm = self.config, self.config.gdim, self.comm
        pins = np.zeros((config.n_owned, g), dtype=bool)
        # motions of bodies that touch each other form a group
        terms = motions.tocoo()
        moved = csr_matrix((np.ones(terms.nnz), (terms.row // self.n_modes, terms.col)), shape=(self.count, motions.shape[1]))
        group, place, number = blocks_of(moved.T @ moved)
        of_body = np.full(self.count, -1)
        of_body[terms.row // self.n_modes] = group[terms.col]
        own = self._body[: config.n_owned]
        allowed = self.free & (of_body[own] >= 0)[:, None] & (True if left is None else left)
        allowed[equations.node] = False
        i, c = np.nonzero(allowed)
        own, of = own[i], of_body[own[i]]
        # rounding of positions depends on the partition
        places = np.round(config.X[i] / (SAME_PLACE * config.size))
        order = np.lexsort([c, *places.T[::-1]])
        rows = np.zeros((len(i), place.max(initial=-1) + 1))
        full = (self._spread(self._modes(self._places[i], own)[np.arange(len(i)), :, c], own) @ motions).tocoo()
        rows[full.row, place[full.col]] = full.data
        for k in range(rows.shape[1]):
            size = np.linalg.norm(rows, axis=1)
            largest = np.zeros(len(number))
            np.maximum.at(largest, of, size)
            comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
            # of equally good components the first by its reference position, on any rank
            good = order[(size >= (1.0 - OPEN) * largest[of])[order] & (number[of] > k)[order]]
            first = good[np.unique(of[good], return_index=True)[1]]
            offers = [((*places[j], c[j]), of[j], comm.rank, j, rows[j] / size[j]) for j in first]
            offered = sorted(chain(*comm.allgather(offers)), key=lambda offer: offer[0], reverse=True)
            best = {offer[1]: offer for offer in offered}
            direction = np.zeros((len(number), rows.shape[1]))
            for n, (_, _, rank, j, way) in best.items():
                direction[n] = way
                if rank == comm.rank:
                    pins[i[j], c[j]] = True
            rows -= np.einsum("nk,nk->n", rows, direction[of])[:, None] * direction[of]
        self._supports = motions, pins
        return pins

    def forget_supports(self) -> None:
        """Choose the supports anew, so that a step does not depend on earlier steps."""
        self._supports = None

    def error(self, motion: Array) -> FloatingBodyError:
        """The error for an unrestrained loaded motion: the body that moves most, and its motion."""
        g = self.config.gdim
        parts = motion.reshape(self.count, self.n_modes)
        b = int(np.abs(parts).max(axis=1).argmax())
        size = np.abs(parts[b]).max() or 1.0
        shift, turn = parts[b, :g] / size, parts[b, g:] / size
        ways = []
        if np.abs(shift).max() > 1e-6:
            ways.append("moves along (" + ", ".join(f"{c:.3g}" for c in shift / np.linalg.norm(shift)) + ")")
        if np.abs(turn).max() > 1e-6:
            axis = "" if g == 2 else " about (" + ", ".join(f"{c:.3g}" for c in _turn(turn)) + ")"
            ways.append("turns" + axis)
        middle = np.where(np.abs(self.middle[b]) > 1e-9 * self.config.size, self.middle[b], 0.0)
        where = "(" + ", ".join(f"{c:.4g}" for c in middle) + ")"
        return FloatingBodyError(
            f"the body with its middle at {where} {' and '.join(ways)} under its loads and no contact stops it: "
            "hold it by a Dirichlet condition, or give its surface a contact with the surface that is to stop it; "
            "bodies that swing or roll come to rest with a decaying drag"
        )

    def thrown(self, ways: Array, most: float) -> ThrownBodyError:
        """The error for a body that contact has pushed by ``ways (n_owned, gdim)``, above ``most``, and holds no more (collective)."""
        size, own = np.linalg.norm(ways, axis=1), self._body[: self.config.n_owned]
        far = np.zeros(self.count)
        np.maximum.at(far, own, size)
        far = reduced(self.comm, far, op=MPI.MAX)
        b = int(far.argmax())
        where = middle(self.comm, (self.config.x[: self.config.n_owned] - ways)[own == b])
        return ThrownBodyError(
            f"contact throws the body with its middle at {where} out of the scene: it goes {far[b]:.3g} in "
            f"this step, where all else goes less than {most:.3g}, and nothing holds it there; take smaller load steps, hold it by a "
            "Dirichlet condition or by friction, or give it inertia"
        )


def _turn(angles: Array) -> Array:
    """Angle ``(1,)`` or rotation vector ``(3,)`` from rotations in the planes that ``rigid_velocities`` lists."""
    return angles if len(angles) == 1 else np.array([angles[2], -angles[1], angles[0]])


def blocks_of(H: Any) -> tuple[Ints, Ints, Ints]:
    """Diagonal blocks of a symmetric sparse matrix ``(n, n)``: each row's block and its position there ``(n,)``, and block sizes."""
    from scipy.sparse.csgraph import connected_components

    number, block = connected_components(H, directed=False)
    size = np.bincount(block, minlength=number)
    place = np.empty(len(block), dtype=np.int64)
    place[np.argsort(block, kind="stable")] = np.arange(len(block)) - np.repeat(np.cumsum(size) - size, size)
    return block.astype(np.int64), place, size


def by_block(H: Any, make: Callable[[Array], tuple[Array, Bools]]) -> Any:
    """Columns computed from the diagonal blocks of a symmetric sparse matrix.

    Args:
        H: the matrix ``(n, n)``.
        make: returns columns ``(b, s, s)`` of blocks ``(b, s, s)`` of one size, and the mask of columns to keep ``(b, s)``.

    Returns:
        Sparse matrix ``(n, k)``.
    """
    from scipy.sparse import csc_matrix

    block, place, size = blocks_of(H)
    entries = H.tocoo()
    rows, columns, values, number = [], [], [], 0
    for s in np.unique(size):
        number_of = np.cumsum(size == s) - 1
        inside, here = size[block[entries.row]] == s, np.flatnonzero(size[block] == s)
        dense, own = np.zeros(((size == s).sum(), s, s)), np.empty(((size == s).sum(), s), dtype=np.int64)
        dense[number_of[block[entries.row[inside]]], place[entries.row[inside]], place[entries.col[inside]]] = entries.data[
            inside
        ]
        own[number_of[block[here]], place[here]] = here
        made, kept = make(dense)
        b, k = np.nonzero(kept)
        rows.append(own[b].ravel())
        values.append(made[b, :, k].ravel())
        columns.append(np.repeat(number + np.arange(len(b)), s))
        number += len(b)
    at = np.concatenate([*rows, np.zeros(0, int)]), np.concatenate([*columns, np.zeros(0, int)])
    return csc_matrix((np.concatenate([*values, np.zeros(0)]), at), shape=(H.shape[0], number))
