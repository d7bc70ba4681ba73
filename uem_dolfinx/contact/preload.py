"""Preload: the opening of a bolt's section is an unknown with a given force, which is later locked, or it is given itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from mpi4py import MPI

import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.kinds import PartsOfPair
from uem_dolfinx.contact.seam.placement import Discretisation
from uem_dolfinx.contact.ties.preloaded import Preloaded
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.axisymmetry import is_axisymmetric
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Part, communicator_of
from uem_dolfinx.parallel import agreed, ask_together


class Preload(Contact):
    """A section of a bolt, between two facing surfaces of its parts, with a given force or a locked opening.

    The surfaces are tied in all components except for an opening along the axis, which is uniform over the section. While the force
    is prescribed, the opening is an unknown: the parts approach, and may overlap, until the section carries the force to rounding.
    ``lock`` keeps the opening from then on, so that the bolt is an ordinary elastic part.

    It is a ``Contact`` with ``tied=True`` and has its results: ``force`` is the field of nodal forces on both faces, and
    ``carried`` the force across the section.

    Args:
        contactor: one face of the section, see ``Contact``.
        target: the other face, on a mesh; the two need not match.
        axis: direction of the bolt ``(gdim,)``, of any length and either sign; None is the section's mean normal. It does not
            rotate with the bodies.
        force: force in the section, positive in tension, of the modelled part: half of it for half a bolt, the full circle for
            axisymmetry. A number acts in full from the first step on; a function is called with the load factor, in time steps with
            the time.
        shortening: instead of a force, the decrease of the bolt's length, as by turning its nut; a number or such a function.
        coupling: see ``Contact``.
        measure: see ``Contact``.
        heat: see ``Contact``; ``uem.Conductance(np.inf, field=1)`` for a bolt in one piece whose mesh was cut; by default nothing is
            conducted.
        name: see ``Contact``.

    Raises:
        InputError, InputTypeError: for an invalid axis or force, neither or both of force and shortening, or a rigid target.
    """

    def __init__(
        self,
        contactor: Part,
        target: Part,
        axis: npt.ArrayLike | None = None,
        *,
        force: float | Callable[[float], float] | None = None,
        shortening: float | Callable[[float], float] | None = None,
        coupling: Literal["node_to_surface", "mortar"] | Callable[..., Discretisation] = "node_to_surface",
        measure: Literal["reference", "current"] = "reference",
        heat: Any = None,
        name: str | None = None,
    ):
        with agreed(communicator_of(contactor) or communicator_of(target) or MPI.COMM_SELF):
            meshed = not hasattr(target, "project")
            given.kind(
                "target",
                target,
                meshed,
                "the other face of the section",
                "hold a part of the bolt by Dirichlet conditions instead",
            )
            self._axis = None if axis is None else given.direction("axis", axis)
            if (force is None) == (shortening is None):
                raise InputError(f"force = {given.shown(force)}, shortening = {given.shown(shortening)}: expected one of them")
            self._force = None if force is None else _given("force", force)
            self._shortening = None if shortening is None else _given("shortening", shortening)
        super().__init__(contactor, target, coupling=coupling, tied=True, measure=measure, heat=heat, name=name)

    def __repr__(self) -> str:
        """Name, axis, force and coupling."""
        axis = "" if self._axis is None else f", axis={self._axis.tolist()}"
        led = f"force={given.shown(self._force)}" if self._shortening is None else f"shortening={given.shown(self._shortening)}"
        return f"Preload({self.name!r}{axis}, {led}, coupling={self.coupling!r})"

    # -- for users -------------------------------------------------------------------------------------------------------

    def tighten(self, force: float | Callable[[float], float]) -> None:
        """Prescribe another force, from the next step on; a locked section is unlocked (collective).

        Raises:
            InputError, InputTypeError: for an invalid force.
        """
        section = self._section
        with agreed(self.config.comm):
            force = _given("force", force)
        given.alike(self.config.comm, self._words, force=force)
        self._force, self._shortening = force, None
        self._take_lead()
        section.release()

    def lock(self) -> None:
        """Keep the present opening from the next step on; nothing else changes, and a locked section stays as it is (collective)."""
        if not self._section.locked:
            self._section.lock()

    @property
    def locked(self) -> bool:
        """Whether the opening is kept."""
        return self._section.locked

    @property
    def kept(self) -> bool:
        """Whether the opening is the one at which the section was locked, rather than a given one."""
        return self._section.locked and not self._section.shortened

    @property
    def has_axis(self) -> bool:
        """Whether its axis was given, rather than taken from the section's normal."""
        return self._axis is not None

    @property
    def opening(self) -> float:
        """Change of the distance between the faces along the axis, a length; negative if the bolt is shortened (collective)."""
        return self._section.find_opening()

    @property
    def carried(self) -> float:
        """Force in the section in the last step, positive in tension, locked or not (collective)."""
        return self._section.carried(self.pair.committed)

    # -- in a problem ----------------------------------------------------------------------------------------------------

    @property
    def _section(self) -> Preloaded:
        assert isinstance(self.pair.tie, Preloaded)
        return self.pair.tie

    @property
    def _words(self) -> str:
        return f"preload '{self.name}'"

    def words(self) -> dict[str, str]:
        """See ``Contact``; with the axis."""
        axis = "normal" if self._axis is None else " ".join(f"{a:.6g}" for a in self._axis)
        return super().words() | {"axis": axis}

    def switch(self, on: bool) -> None:
        """Raise InputError: a section cannot be switched off, only its force can be zero."""
        raise InputError(
            f"preload '{self.name}' cannot be switched: it carries no force with Step(..., preload={{preload: 0.0}})"
        )

    def attach(self, config: Configuration, free: Bools, **clock: Any) -> PartsOfPair:
        """See ``Contact``; in addition (collective).

        Raises:
            InputError: if the axis has another dimension, differs from the axis of symmetry, or lies in the section.
        """
        with agreed(config.comm):
            if self._axis is not None:
                given.direction(f"{self._words}: axis", self._axis, config.gdim)
                if is_axisymmetric(config.mesh) and self._axis[0] != 0.0:
                    raise InputError(given.sentence(f"{self._words}: axis", self._axis, "the axis of symmetry, (0, 1)"))
        given.alike(config.comm, self._words, force=self._force, shortening=self._shortening, axis=self._axis)
        self._free = free
        return super().attach(config, free, **clock)

    def take_pair(self, pair: Interface) -> None:
        """See ``Contact``; also sets the force, or the shortening (collective)."""
        super().take_pair(pair)
        self._take_lead()

    def _tie(self, nodes: Indices, discretisation: Discretisation, means: Mortar | None, **of: Any) -> Preloaded:
        return Preloaded(
            self.config, nodes, discretisation, axis=self._axis, free=self._free[nodes], means=means, reach=None, **of
        )

    @property
    def sees_corners(self) -> bool:
        """False, since faces that overlap initially are inside the other part."""
        return False

    def take_load(self, at: float, known: bool = False) -> None:
        """See ``Contact``; also updates the force, or the shortening (collective)."""
        super().take_load(at, known)
        if callable(self._force) or callable(self._shortening):
            self._take_lead()

    def _take_lead(self) -> None:
        """Set the force, or the shortening, of the present load factor or time in the pair (collective)."""
        if self._shortening is not None:
            self._section.shorten(self._now("shortening", self._shortening))
        elif self._force is not None:
            self._section.pull(self._now("force", self._force))

    def ramp_force(self, force: Callable[[float], float] | None, known: bool) -> None:
        """Take a force that depends on the load factor from 0 on, or lock with None; ``known`` as in ``take_load`` (collective)."""
        if force is None and not known:
            self.lock()
        elif force is not None:
            self._at = 0.0
            if known:
                self._force, self._shortening = force, None
            else:
                self.tighten(force)

    def keep_force(self, at: float) -> None:
        """Keep the force of a load factor, at the end of a ramp."""
        self._force = self._force(at) if callable(self._force) else self._force

    def _now(self, what: str, of_load: Any) -> float:
        """A number, or the present value of a function of the load factor (collective)."""
        if not callable(of_load):
            return float(of_load)
        words = f"{self._words}: {what}({self._at:.6g})"
        value = ask_together(self.config.comm, words, of_load, self._at)
        with agreed(self.config.comm):
            return float(given.number(words, value))


def _given(what: str, value: Any) -> Any:
    """A number or a function of the load factor; refuse all else."""
    return value if given.function(value) else given.number(what, value)
