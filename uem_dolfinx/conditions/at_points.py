"""Forces and springs at nodes, for which UFL forms have no measure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import given
from uem_dolfinx.arrays import AnyArray, Array
from uem_dolfinx.conditions.places import is_point, nodes_at
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agreed, reduced


class PointLoad(given.Sealed):
    """A force at a node, or at each of several.

        uem.PointLoad(tags["tip"], (0.0, -3.0))
        P = fem.Constant(mesh, (0.0, 0.0)); uem.PointLoad((2.0, 1.0), P)      # with load={P: (0.0, -3.0)}

    Args:
        at: tag of points, e.g. a physical point of a ``.geo`` file, ``(meshtags, value)``, a list of these, or reference coordinates of
            a node ``(gdim,)``.
        force: numbers, or a ``fem.Constant``, which may change between steps and be set by the load ``(gdim,)``; in axisymmetry the
            total force on the whole circle.

    Raises:
        InputError, InputTypeError: for a force of another form. When the problem is made also for a place without a node, and a
            TagError for a tag of other entities than points.
    """

    SETTABLE: ClassVar = {"force": None}

    def __init__(self, at: Any, force: npt.ArrayLike | fem.Constant):
        self.at, self.force = at, force
        given.vector("force", self._values)

    @property
    def _values(self) -> Any:
        return self.force.value if isinstance(self.force, fem.Constant) else self.force

    def given_values(self) -> dict[str, Any]:
        """Its present values, by name."""
        return {"the place": self.at if is_point(self.at) else None, "the force": self._values}

    def force_and_stiffness(self, gdim: int) -> tuple[Array, Array | None]:
        """Present force ``(gdim,)``, and stiffness ``(gdim, gdim)`` or None."""
        return given.vector("the force of a PointLoad", self._values, gdim), None


class PointSpring(given.Sealed):
    """A linear spring between a node, or each of several, and its reference position: the force on the node is ``-k u``.

        uem.PointSpring(tags["foot"], 1e4)              # the same in all directions
        uem.PointSpring(tags["foot"], (0.0, 1e4))       # along y

    Args:
        at: as in ``PointLoad``.
        stiffness: a number for all directions, numbers for each axis ``(gdim,)``, or a symmetric matrix without negative eigenvalues
            ``(gdim, gdim)``.

    Raises:
        InputError, InputTypeError, TagError: as in ``PointLoad``.
    """

    def __init__(self, at: Any, stiffness: npt.ArrayLike):
        self.at = at
        words = "numbers that are not negative, one, one for each axis, or a symmetric matrix"
        try:
            self._stiffness = given.numbers(stiffness)
        except (TypeError, ValueError):
            raise InputTypeError(given.sentence("stiffness", stiffness, words)) from None
        k = self._stiffness * np.eye(2) if self._stiffness.ndim == 0 else self._stiffness
        k = np.diag(k) if k.ndim == 1 else k
        square = k.shape in ((2, 2), (3, 3)) and bool(np.isfinite(k).all())
        if not square or not np.array_equal(k, k.T) or np.linalg.eigvalsh(k)[0] < -np.finfo(float).eps * np.abs(k).max():
            raise InputError(given.sentence("stiffness", stiffness, words))

    def given_values(self) -> dict[str, Any]:
        """See ``PointLoad``."""
        return {"the place": self.at if is_point(self.at) else None, "the stiffness": self._stiffness}

    def force_and_stiffness(self, gdim: int) -> tuple[Array, Array | None]:
        """See ``PointLoad``."""
        k = self._stiffness
        k = k * np.eye(gdim) if k.ndim == 0 else np.diag(k) if k.ndim == 1 else k
        if k.shape != (gdim, gdim):
            raise InputError(
                given.sentence("the stiffness of a PointSpring", self._stiffness, f"a number, or {gdim} for each axis")
            )
        return np.zeros(gdim), k


class AtPoints:
    """All loads and springs at nodes of a problem; those of couplings act at nodes, too (collective)."""

    def __init__(
        self, config: Configuration, declared: Sequence[PointLoad | PointSpring], couplings: Sequence[RigidCoupling] = ()
    ):
        self._config, self._couplings = config, list(couplings)
        #: Declared loads and springs, each with its distinct owned nodes.
        self.parts = [(one, nodes_at(config, one.at, f"the place of points[{i}]", (0,))) for i, one in enumerate(declared)]
        with agreed(config.comm):
            for one, _ in self.parts:
                one.force_and_stiffness(config.gdim)
        #: Unknowns of the components of the nodes ``(n_local, gdim)``.
        self._unknowns = config.of(np.arange(len(config.whole.x.array)))

    def add_forces(self, b: AnyArray) -> None:
        """Add forces of loads and springs to a residual, internal minus external forces, at the owned unknowns ``(n,)`` (collective)."""
        config = self._config
        for one, nodes in self.parts:
            force, k = one.force_and_stiffness(config.gdim)
            b[self._unknowns[nodes]] -= force if k is None else -config.displacement[nodes] @ k
        for coupling in self._couplings:
            b[self._unknowns[coupling.nodes.nodes]] -= coupling.nodal_forces()

    def loads(self) -> Array:
        """Forces except spring forces, at the owned nodes ``(n_owned, gdim)`` (collective)."""
        found = np.zeros((self._config.n_owned, self._config.gdim))
        for one, nodes in self.parts:
            found[nodes] += one.force_and_stiffness(self._config.gdim)[0]
        for coupling in self._couplings:
            found[coupling.nodes.nodes] += coupling.nodal_forces(springs=False)
        return found

    def energy(self) -> float:
        """Energy stored in the springs (collective)."""
        u, own = self._config.displacement, 0.0
        for one, nodes in self.parts:
            k = one.force_and_stiffness(self._config.gdim)[1]
            own += 0.0 if k is None else 0.5 * float(np.einsum("ng,gh,nh->", u[nodes], k, u[nodes]))
        links = {id(link): link for coupling in self._couplings for link in coupling.links}
        return float(reduced(self._config.comm, own)) + sum(link.energy for link in links.values())

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """Add the springs to an assembled tangent (collective)."""
        config, g = self._config, self._config.gdim
        for one, nodes in self.parts:
            _, k = one.force_and_stiffness(g)
            for node in config.to_global(nodes) if k is not None else ():
                rows = (node * g + np.arange(g)).astype(PETSc.IntType)
                K.setValues(rows, rows, k, addv=PETSc.InsertMode.ADD)
        K.assemble()
