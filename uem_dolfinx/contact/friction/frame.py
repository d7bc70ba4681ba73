"""Tangential directions at frictional contactors, and their relative motions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.friction import stick_slip
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.contact.seam.relative_motion import Ties


@dataclass(frozen=True)
class Frame:
    """Data of one placement for friction; immutable.

    Attributes:
        ties: weights by which contactors follow other nodes and transmit friction to them.
        way: weights of ``away``.
        away: vectors from the anchors to the contactors, or relative motions since the last step ``(n, gdim)``.
        tangents: tangential directions ``(n, gdim - 1, gdim)``.
        free_tangents: tangential directions in which the relative motion is not prescribed ``(n, gdim - 1, gdim)``.
        other_normals: normals of other rigid surfaces that hold the contactors, or zero ``(n, k, gdim)``; k is 0 if none holds any.
        prescribed: whether any contactor has a Dirichlet condition.
        cornered: contactors held in a corner, with friction only along its edge ``(n,)``.
    """

    ties: Ties
    way: Ties
    away: Array
    tangents: Array
    free_tangents: Array
    other_normals: Array
    prescribed: bool
    cornered: Bools

    @classmethod
    def of(cls, kinematics: Kinematics, away: Array, way: Ties | None, other_normals: Array, prescribed: bool) -> Frame:
        """The frame for relative motions ``away (n, gdim)``; ``way`` is None for the present ``ties``; arguments as the attributes."""
        normals, ties, c = kinematics.normal[:, None], kinematics.ties, kinematics.corners
        n, g = away.shape
        cornered = np.zeros(n, dtype=bool)
        if c is not None:
            normals = np.concatenate([normals, c.axes_of(n)], axis=1)
            cornered[c.which] = True
        free = np.ones((n, g), dtype=bool)
        every = told = stick_slip.tangents(normals, free)
        if prescribed or other_normals.shape[1]:
            moves = ties.moves if prescribed else free
            told = stick_slip.tangents(np.concatenate([normals, other_normals], axis=1), moves)
        return cls(ties, way or ties, away, every, told, other_normals, prescribed, cornered)

    def along(self, way: Array) -> Array:
        """Tangential parts of relative motions ``(n, gdim)``; prescribed components contribute only their own motion."""
        if not self.prescribed:
            return stick_slip.along(self.tangents, way)
        told = stick_slip.along(self.free_tangents, way) + stick_slip.along(self.tangents, np.where(self.ties.moves, 0.0, way))
        return np.where(np.abs(self.other_normals).sum(axis=(1, 2))[:, None] > 0, stick_slip.along(self.tangents, way), told)

    @cached_property
    def slip(self) -> Array:
        """Tangential motion since the last step; for a sticking contactor, its offset from the anchor ``(n, gdim)``."""
        return self.along(self.away)

    def directions(self, vectors: Array) -> Array:
        """Tangential unit vectors of ``vectors (n, gdim)``, zero for zero."""
        s = self.along(vectors)
        size = np.linalg.norm(s, axis=1, keepdims=True)
        return s / np.where(size > 0, size, 1.0)

    def tangential(self, force: Array) -> Array:
        """Tangential parts of forces ``(n, gdim)``."""
        return stick_slip.along(self.tangents, force)

    def forced(self, away: Array, left_out: Bools) -> Array:
        """Length of the slip prescribed by conditions and other surfaces ``(n,)``.

        Args:
            away: relative motions ``(n, gdim)``.
            left_out: tangents with redundant equations, where more conditions meet than the target can follow ``(n, gdim - 1)``.
        """
        if not (self.prescribed or self.other_normals.shape[1]):
            return np.zeros(len(away))
        along = stick_slip.along(self.tangents, away) - stick_slip.along(self.free_tangents, away)
        told = np.where(self.other_normals.any(axis=(1, 2)), np.linalg.norm(along, axis=1), 0.0)
        if not self.prescribed:
            return told
        lost = np.where(left_out[:, :, None], self.free_tangents, 0.0)
        parts = (self.tangents, np.where(self.ties.moves, 0.0, away)), (lost, away)
        return told + sum(np.linalg.norm(stick_slip.along(T, way), axis=1) for T, way in parts)
