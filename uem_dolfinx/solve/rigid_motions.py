"""Rigid motions of bodies: which of them conditions and contacts leave open, which are loaded, what holds the neutral ones."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_rows
from uem_dolfinx.errors import FloatingBodyError
from uem_dolfinx.geometry.bodies import find_bodies, rigid_velocities
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.rigid import rotation_matrix

#: A motion is open if conditions and contacts resist it with less than this part of its size.
#: [convention; size of the motion; test_rigid_motions.py::test_what_counts_as_open]
OPEN = 1e-5
#: Coordinates that differ by less are the same: nodes are put in order by their places on any number of ranks.
#: [bound; the model's size; -]
SAME_PLACE = 1e-9
#: A motion is loaded if the forces along it exceed this part of all forces; supports may be left with less.
#: [convention; sum of all forces; test_rigid_motions.py::test_what_counts_as_loaded]
LOADED = 1e-6


class RigidMotions:
    """Rigid motions of the bodies of a scene that its Dirichlet conditions do not hold.

    A motion is a vector with as many entries per body as it has rigid-body modes: translations, then rotations about the body's
    middle in units of its radius, so that all entries are lengths.

    Args:
        config: configuration of the displacement.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        finite: whether bodies turn by finite rotations, not by linearised ones.

    Attributes:
        share: part that the largest force along an open motion was of all forces when ``load`` was last asked.
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
        self._supports: tuple[Array, Bools] | None = None
        self.share = 0.0

    # -- motions ---------------------------------------------------------------------------------------------------------

    @property
    def _places(self) -> Array:
        """Where the owned nodes are that a motion takes along ``(n_owned, gdim)``."""
        return (self.config.x if self.finite else self.config.X)[: self.config.n_owned]

    def _middles(self) -> Array:
        """Means of the bodies' nodes ``(count, gdim)`` (collective)."""
        own = self._body[: self.config.n_owned]
        sums = self.comm.allreduce(sums_of_rows(own, np.column_stack([np.ones(len(own)), self._places]), self.count))
        return np.asarray(sums[:, 1:] / sums[:, :1])

    def _modes(self, x: Array, body: Ints) -> Array:
        """Velocities of points ``x (n, gdim)`` of bodies ``(n,)`` in each of their own modes ``(n, n_modes, gdim)``."""
        return rigid_velocities((x - self.middle[body]) / self.radius[body][:, None])

    @property
    def n_modes(self) -> int:
        """Rigid-body modes of one body."""
        return 3 if self.config.gdim == 2 else 6

    @property
    def every_motion(self) -> Array:
        """All motions of all bodies ``(n_motions, n_motions)``."""
        return np.eye(self.count * self.n_modes)

    def _spread(self, values: Array, body: Ints) -> Array:
        """Rows in all motions from rows in the modes of one body each ``(n, count * n_modes)``."""
        rows = np.zeros((len(values), self.count, self.n_modes))
        rows[np.arange(len(values)), body] = values
        return rows.reshape(len(values), self.count * self.n_modes)

    def rates(self, equations: UnitingEquations) -> Array:
        """How fast each motion opens the gap of each equation ``(m, n_motions)`` (collective)."""
        config, g = self.config, self.config.gdim
        own = self._body[: config.n_owned]
        x = self._places
        known = config.ask_owners(equations.followed, np.column_stack([own, x]))
        modes = self._modes(x[equations.node], own[equations.node])
        rows = self._spread(np.einsum("nmg,ng->nm", modes, equations.direction), own[equations.node])
        body = known[:, 0].astype(np.int64)
        terms = np.einsum("nmg,ng->nm", self._modes(known[:, 1 : 1 + g], body), equations.coefficients)
        return rows - sums_of_rows(equations.row * self.count + body, terms, len(rows) * self.count).reshape(rows.shape)

    def open_motions(self, equations: UnitingEquations | None, resistance: float = OPEN) -> Array:
        """Orthonormal motions that neither conditions nor active equations resist ``(n_motions, k)`` (collective).

        Args:
            equations: of all contactors, or None.
            resistance: what counts as none, as part of the motion's size.
        """
        if self.finite:
            self.middle = self._middles()
        held = self._held()
        resisted = held.T @ held
        if equations is not None:
            rows = self.rates(equations.select(equations.active))
            resisted = resisted + rows.T @ rows
        values, vectors = np.linalg.eigh(self.comm.allreduce(resisted))
        return vectors[:, values < resistance**2]

    def any_open(self) -> bool:
        """Whether the conditions leave any motion open (collective)."""
        return bool(self.open_motions(None).shape[1])

    def _held(self) -> Array:
        """How each motion moves the components with a Dirichlet condition ``(n, n_motions)``."""
        i, c = np.nonzero(~self.free)
        body = self._body[i]
        return self._spread(self._modes(self._places[i], body)[np.arange(len(i)), :, c], body)

    def following(self, prescribed: Array) -> Array:
        """The motion that follows the Dirichlet conditions by least squares; what they leave open rests (collective).

        Args:
            prescribed: increments of the owned nodes, those of free components aside ``(n_owned, gdim)``.
        """
        if self.finite:
            self.middle = self._middles()
        held = self._held()
        gram, along = self.comm.allreduce(held.T @ held), self.comm.allreduce(held.T @ prescribed[~self.free])
        return np.asarray(np.linalg.pinv(gram, OPEN**2, hermitian=True) @ along)

    def load(self, motions: Array, residual: Array, among: Array | None = None) -> Array:
        """Force along the loaded ones of some motions, as a motion; zero if none is loaded (collective).

        Args:
            motions: ``(n_motions, k)``.
            residual: ``F`` at the owned nodes ``(n_owned, gdim)``.
            among: forces beside which they count ``(n_owned, gdim)``; None takes the residual itself.
        """
        own = self._body[: self.config.n_owned]
        work = -np.einsum("nmg,ng->nm", self._modes(self._places, own), residual)
        force = sums_of_rows(own, work, self.count)
        total, scale = (
            sum(part) for part in zip(*self.comm.allgather((force.ravel(), np.abs(residual if among is None else among).sum())))
        )
        along = motions.T @ total
        self.share = float(np.abs(along).max(initial=0.0) / scale) if scale > 0 else 0.0
        force = motions @ np.where(np.abs(along) > LOADED * scale, along, 0.0)
        # bodies that are held stay where they are, to the last bit
        return np.where(np.abs(force) > OPEN**2 * np.abs(force).max(initial=0.0), force, 0.0)

    def field(self, motion: Array) -> Array:
        """The velocities of the owned nodes in a motion ``(n_owned, gdim)``."""
        own = self._body[: self.config.n_owned]
        parts = motion.reshape(self.count, self.n_modes)
        return np.asarray(np.einsum("nmg,nm->ng", self._modes(self._places, own), parts[own]))

    def part(self, motions: Array, du: Array) -> Array:
        """What an increment ``(n_owned, gdim)`` holds of some motions ``(n_motions, k)``, of the same shape (collective).

        Without it the increment does not depend on the supports: bodies stay where they are along neutral motions.
        """
        own = self._body[: self.config.n_owned]
        modes = self._modes(self._places, own)
        parts = motions.reshape(self.count, self.n_modes, motions.shape[1])
        fields = np.einsum("nmg,nmk->ngk", modes, parts[own]).reshape(du.size, -1)
        gram, along = (sum(a) for a in zip(*self.comm.allgather((fields.T @ fields, fields.T @ du.ravel()))))
        return (fields @ np.linalg.solve(gram, along)).reshape(du.shape) if motions.shape[1] else np.zeros_like(du)

    def move(self, motion: Array) -> None:
        """Move the bodies, ghosts included."""
        config, g = self.config, self.config.gdim
        u = config.displacement
        parts = motion.reshape(self.count, self.n_modes)
        body = self._body
        if not self.finite:
            u += np.einsum("nmg,nm->ng", self._modes(config.X, body), parts[body])
            return
        x = config.x
        for b in np.flatnonzero(np.abs(parts).max(axis=1) > 0):
            turn = rotation_matrix(_turn(parts[b, g:] / self.radius[b]))
            here = body == b
            u[here] += (x[here] - self.middle[b]) @ (turn - np.eye(g)).T + parts[b, :g]

    # -- what keeps the system regular -------------------------------------------------------------------------------------

    def supports(self, motions: Array, equations: UnitingEquations) -> Bools:
        """Components of owned nodes that hold neutral motions without any reaction ``(n_owned, gdim)`` (collective).

        One component per motion, each where what the earlier ones leave open moves it most; contactors are spared.
        """
        if self._supports is not None:
            before, pins = self._supports
            same = before.shape == motions.shape and np.abs(before @ (before.T @ motions) - motions).max(initial=0.0) < OPEN
            if same:
                return pins
        config, g = self.config, self.config.gdim
        pins = np.zeros((config.n_owned, g), dtype=bool)
        own = self._body[: config.n_owned]
        allowed = np.array(self.free)
        allowed[equations.node] = False
        i, c = np.nonzero(allowed)
        # last bits of places differ from partition to partition
        places = np.round(config.X[: config.n_owned] / (SAME_PLACE * config.size))
        rows = self._spread(self._modes(self._places, own)[i, :, c], own[i]) @ motions
        for _ in range(motions.shape[1]):
            size = np.linalg.norm(rows, axis=1)
            largest = self.comm.allreduce(float(size.max(initial=0.0)), op=MPI.MAX)
            # of equally good ones the first by its place in the drawing, whichever rank has it
            good = np.flatnonzero(size >= (1.0 - OPEN) * largest)
            keys = [(*places[i[k]], c[k]) for k in good]
            best, offers = int(good[keys.index(min(keys))]) if keys else -1, self.comm.allgather(min(keys, default=None))
            winner = offers.index(min(offer for offer in offers if offer is not None))
            if winner == self.comm.rank:
                pins[i[best], c[best]] = True
            direction = self.comm.bcast(rows[best] / size[best] if winner == self.comm.rank else None, root=winner)
            rows -= np.outer(rows @ direction, direction)
        self._supports = motions, pins
        return pins

    def forget_supports(self) -> None:
        """Let the supports be chosen anew: a step must not depend on how those before it were found."""
        self._supports = None

    def error(self, motion: Array) -> FloatingBodyError:
        """What to tell about a loaded motion that nothing stops: which body moves most, and how."""
        g = self.config.gdim
        parts = motion.reshape(self.count, self.n_modes)
        b = int(np.abs(parts).max(axis=1).argmax())
        size = np.abs(parts[b]).max()
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
            "hold it by a Dirichlet condition, or give its surface a contact with what it is to come to rest on"
        )


def _turn(angles: Array) -> Array:
    """Angle ``(1,)`` or rotation vector ``(3,)`` from rotations in the planes that ``rigid_velocities`` lists."""
    return angles if len(angles) == 1 else np.array([angles[2], -angles[1], angles[0]])
