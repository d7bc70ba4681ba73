"""Targets that are no meshes, as problems have them: what fails on one rank fails on all."""

from __future__ import annotations

from typing import Any, cast

from mpi4py import MPI

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.projection import Projection, Target
from uem_dolfinx.parallel import ask_together


class SharedTarget:
    """A target of the user's in a problem: what its functions raise on one rank is raised on all; else it is that target."""

    def __init__(self, target: Target, comm: MPI.Comm):
        self._target, self._comm = target, comm
        self._words = f"the target '{getattr(target, 'name', type(target).__name__)}'"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    @property
    def motion(self) -> Any:
        """The target's own, which a checkpoint sets."""
        return self._target.motion

    @motion.setter
    def motion(self, motion: Any) -> None:
        self._target.motion = motion

    def project(self, points: Array) -> Projection:
        """Projection of points onto it (collective)."""
        return ask_together(self._comm, self._words, self._target.project, points)

    def follow(self, points: Array, old: Any) -> Projection:
        """Gaps with the feet, normals and weights of an earlier projection (collective)."""
        return ask_together(self._comm, self._words, self._target.follow, points, old)


def shared_target(target: Target, comm: MPI.Comm, gdim: int) -> Target:
    """A target of the user's for a problem in ``gdim`` dimensions (collective).

    Raises SurfaceError if it is given in another dimension, and InputError if it is not the same on all ranks.
    """
    own, name = getattr(target, "gdim", None), getattr(target, "name", type(target).__name__)
    if own not in (None, gdim):
        remedy = f"give it points and directions of {gdim} numbers"
        raise SurfaceError(f"{name} is given in {own}D, but the displacement in {gdim}D: {remedy}")
    given.alike(comm, name, stride=target.stride, place=getattr(target, "_reference", None))
    return cast(Target, SharedTarget(target, comm)) if getattr(target, "of_user", True) else target
