"""Results of a contact after a step: forces, pressures and gaps as arrays, fields and sums, and the imbalance of forces."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Array, Bools, Indices, cross_products
from uem_dolfinx.contact.heat_results import HeatResults
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.errors import InputError, SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import Areas
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.conditions.seams import Seam
    from uem_dolfinx.contact.laws.conductance import Conductance


#: Smaller areas, over those of nodes around, are zero to rounding.
#: [bound; area; test_conforming_rings.py::test_pressures_at_vertices_without_area]
NO_AREA = 1e-10


@dataclass(frozen=True)
class Resultant:
    """Force ``(gdim,)`` and moment about a point, ``(1,)`` in 2D and ``(3,)`` in 3D; for axisymmetric bodies the axial force.

    ``normal`` is the sum of the normal forces, positive in compression. In axisymmetry it is integrated over full circles: for a
    press fit it is pressure times ``2 pi r`` times length.
    """

    force: Array
    moment: Array
    normal: float = 0.0


@dataclass(frozen=True)
class Balance:
    """Relative imbalance of the forces and of the moments of a pair."""

    force: float
    moment: float


def moments(x: Array, f: Array) -> Array:
    """Moments about the origin of forces ``f (n, gdim)`` at ``x``, ``(n, 1)`` in 2D and ``(n, 3)`` in 3D."""
    if x.shape[1] == 2:
        return (x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0])[:, None]
    return cross_products(x, f)


def sum_up(comm: MPI.Comm, x: Array, f: Array) -> Resultant:
    """Resultant about the origin of the forces ``f (n, gdim)`` at ``x (n, gdim)`` of all ranks (collective)."""
    parts = comm.allgather((f.sum(axis=0), moments(x, f).sum(axis=0)))
    return Resultant(np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0))


def imbalance(comm: MPI.Comm, x: Array, f: Array) -> Balance:
    """Resultants of forces ``f (n, gdim)`` at ``x (n, gdim)`` relative to the sums of absolute forces and moments (collective)."""
    size = np.linalg.norm(f, axis=1)
    whole = sum_up(comm, x, f)
    all_f, all_m = (sum(part) for part in zip(*comm.allgather((size.sum(), (size * np.linalg.norm(x, axis=1)).sum()))))
    return Balance(
        float(np.linalg.norm(whole.force) / all_f) if all_f > 0 else 0.0,
        float(np.linalg.norm(whole.moment) / all_m) if all_m > 0 else 0.0,
    )


def not_attached(name: str) -> SurfaceError:
    """The error for results of a contact that belongs to no problem yet."""
    return SurfaceError(f"contact '{name}' belongs to no problem yet: hand it to a UnitedProblem first")


class ManyContacts:
    """Base of declarations of several contacts at once, as ``GeneralContact``; results exist only in a problem."""

    name: str
    _attached: Configuration | None = None

    @property
    def _config(self) -> Configuration:
        """Configuration of the problem's displacement; SurfaceError without a problem."""
        if self._attached is None:
            raise not_attached(self.name)
        return self._attached


class ContactResults(HeatResults):
    """Results of a contact after a step.

    Attributes:
        name: for messages and files.
        contactor: facets whose nodes are the contactors, or points.
        coupling: name of the discretisation, or a user-defined class.
        measure: area for pressures and tractions: ``"reference"`` or ``"current"``.
        heats: conductances.
        config: configuration of the displacement, once the contact belongs to a problem.
        taken: whether it belongs to a problem.
    """

    name: str
    contactor: Part
    coupling: Any
    measure: str
    heats: tuple[Conductance, ...]
    config: Configuration
    taken: bool
    _pair: Interface | None
    _fields: dict[str, fem.Function]

    @property
    def pair(self) -> Interface:
        """The pair behind this contact."""
        if self._pair is None and self.taken:
            raise SurfaceError(
                f"contact '{self.name}' ties a scalar field, and has no contact forces: what passes through it is the "
                "reaction of the conditions on either side"
            )
        if self._pair is None:
            raise not_attached(self.name)
        return self._pair

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks (collective)."""
        return int(reduced(self.pair.config.comm, int(self.pair.united.sum())))

    def max_gap(self) -> float:
        """Largest gap of an active contactor, a length (collective)."""
        return float(reduced(self.pair.config.comm, self.pair.largest_gap_here(), op=MPI.MAX))

    @cached_property
    def surface(self) -> Areas:
        """Integrals of the shape functions over the contactor."""
        return Areas(self.config, self.contactor)

    @property
    def _areas(self) -> Array:
        """Integral of the shape function of each contactor over the reference surface ``(n_contactors,)`` (first time: collective)."""
        return self.surface.reference[self.pair.nodes]

    def measured_areas(self) -> Array:
        """Areas for pressures and tractions at contactors ``(n_contactors,)``, zero where there is no area (collective)."""
        return self._measured(self._facing())

    def _facing(self) -> Array:
        """Integrals of the shape functions at the contactors, see ``areas_facing`` (collective)."""
        return self.areas_facing(self.nodes, self.pair.kinematics.projection.normal, self.measure == "current")

    def _measured(self, facing: Array) -> Array:
        """The measured areas, from integrals of the shape functions ``(n_contactors,)`` (collective)."""
        found, tie = self.pair.kinematics.pressure_map(self.measure == "current").areas(facing), self.pair.tie
        # quadratic functions of a triangle's vertices have no integral
        found = np.where(found > NO_AREA * self.pair.discretisation.spread(facing), found, 0.0)
        return self._seam.evenly(self.nodes, found if tie is None else tie.areas(facing, self._areas, found))

    def _per_area(self, forces: Array) -> Array:
        """Forces over areas ``(n_contactors,)``; without an area of its own, a contactor has those of nodes around (collective)."""
        facing, spread = self._facing(), self.pair.discretisation.spread
        areas, whole = self._measured(facing), spread(facing)
        none = (areas <= 0) & (whole > 0)
        areas, forces = np.where(none, whole, areas), np.where(none, spread(forces), forces)
        return np.asarray(np.where(areas > 0, forces / np.where(areas > 0, areas, 1.0), 0.0))

    @cached_property
    def _seam(self) -> Seam:
        """Contactors that equations of users give one displacement (first time: collective)."""
        from uem_dolfinx.conditions.seams import Seam, seams_of

        return Seam(self.config, self.nodes, seams_of(self.config))

    def areas_facing(self, nodes: Indices, normal: Array | None, current: bool) -> Array:
        """Integrals of the shape functions at contactors ``(n,)``, at sharp edges over facets that face the target (collective).

        ``normal (n, gdim)`` are normals of the target. Integrals extend over the whole surface with mortar, whose segments account
        for the covered part, and before any placement.
        """
        if self.coupling == "mortar" or normal is None:
            return (self.surface.current if current else self.surface.reference)[nodes]
        return self.surface.facing(nodes, normal, current)

    def pressing(self) -> tuple[Array, Array]:
        """Normal ``(n_contactors,)`` and tangential forces ``(n_contactors, gdim)`` that are divided by ``measured_areas`` (collective)."""
        return self._with_further(*self.pair.pressing())

    def _with_further(self, across: Array, along: Array) -> tuple[Array, Array]:
        """The forces, with those of further parts of the contact (collective)."""
        return across, along

    def acting_at(self) -> Array:
        """Points of the contactors' bodies where the contact forces act ``(n_contactors, gdim)``."""
        return self.pair.points

    def leads(self) -> Bools:
        """Contactors that conduct heat when they touch; only one of two that follow each other ``(n_contactors,)`` (collective)."""
        return np.ones(len(self.nodes), bool)

    def whole_side(self) -> Indices:
        """Owned nodes that are all rigid if the contactors' side is rigid: the contactors (collective)."""
        return self.nodes

    @property
    def nodes(self) -> Indices:
        """Owned contactor nodes of this rank, block indices of the displacement's space ``(n_contactors,)``."""
        return self.pair.nodes

    @property
    def points(self) -> Array:
        """Current positions of this rank's contactors ``(n_contactors, gdim)``, a length."""
        return self.pair.points

    @property
    def pressures(self) -> Array:
        """Contact pressure at this rank's contactors ``(n_contactors,)`` (collective).

        The normal force over the node's tributary area; at a seam both are means of its sides. With ``coupling="mortar"`` only the
        covered part of this area counts, otherwise at sharp edges only facets that face the target. ``measure`` selects the reference
        or the current surface.
        Pressure is negative where tied surfaces are in tension.
        """
        return self._per_area(self.pressing()[0])

    def max_pressure(self) -> float:
        """Largest contact pressure, a force per area (collective)."""
        return float(reduced(self.pair.config.comm, float(self.pressures.max(initial=0.0)), op=MPI.MAX))

    @property
    def pressure(self) -> fem.Function:
        """Contact pressure as a scalar field, zero off the contactor (collective)."""
        return self._field("pressure", self.pressures)

    def pressure_to_integrate(self) -> fem.Function:
        """Normal forces per reference area as a scalar field whose integral over the contactor is their sum (collective).

        It differs from :attr:`pressure` at degree 2, and with mortar where the contactor overhangs the target. At sharp edges of
        the contactor, integrate over the facets that face the target. It is zero for contactors given as points.
        """
        from uem_dolfinx.contact.mortar.duals import basis_of
        from uem_dolfinx.contact.mortar.rows import density

        f = self._field("pressure_to_integrate", 0.0)
        if self.contactor.dim > 0:
            normal = None if self.coupling == "mortar" else self.pair.kinematics.projection.normal
            areas = self._seam.evenly(self.nodes, self.surface.of_functions(self.nodes, normal, lambda shape: basis_of(shape).T))
            pressed, _ = self._with_further(*self.pair.pressing())
            f.x.array[: self.config.n_owned] = density(self.config, self.contactor, self.nodes, pressed, areas)
            f.x.scatter_forward()
        return f

    @property
    def gap(self) -> fem.Function:
        """Gap as a scalar field, a length; zero off the contactor (collective)."""
        if self.pair.far:
            self.pair.search()
            self.pair.project()
        return self._field("gap", self.pair.kinematics.projection.gap)

    @property
    def active(self) -> fem.Function:
        """1 at active and tied contactors, 0 elsewhere (collective)."""
        return self._field("active", self.pair.united)

    @property
    def status(self) -> fem.Function:
        """0 at open contactors, 1 if they stick or are tied, 2 if they slip; without friction all closed ones slip (collective).

        With friction, a contactor held in a 2D corner of the target sticks.
        """
        state = self.pair.trial
        cornered = state.in_corner & (self.config.gdim == 2)
        sticks = np.zeros(len(cornered), bool) if state.friction is None else state.friction.stick | cornered
        return self._field("status", np.where(self.pair.united, np.where(sticks | self.pair.tied, 1.0, 2.0), 0.0))

    @property
    def traction(self) -> fem.Function:
        """Tangential force of friction or of a tie, per area as for ``pressure``, as a vector field (collective)."""
        return self._field("traction", np.column_stack([self._per_area(along) for along in self.pressing()[1].T]), vector=True)

    @property
    def slip(self) -> fem.Function:
        """Accumulated slip over all committed steps, as a vector field on the contactor, a length.

        It is zero without friction (collective).
        """
        state = self.pair.trial
        return self._field("slip", 0.0 if state.friction is None else state.friction.slipped, vector=True)

    @property
    def dissipation(self) -> float:
        """Energy dissipated in all committed steps: slip times the mean friction of each step, and by damping (collective)."""
        friction, damping = self.pair.committed.friction, self.pair.committed.damping
        own = 0.0 if friction is None else float(friction.work.sum())
        return float(reduced(self.config.comm, own if damping is None else own + float(damping[:, 1].sum())))

    @property
    def wear(self) -> fem.Function:
        """Wear depth of the contactor after all committed steps, as a scalar field, a length (collective)."""
        friction = self.pair.committed.friction
        return self._field("wear", 0.0 if friction is None else friction.worn)

    @property
    def wet(self) -> fem.Function:
        """1 where the fluid of ``leak`` reaches the contactor, else 0, as a scalar field (collective)."""
        state = self.pair.trial.wet
        return self._field("wet", np.zeros(len(self.nodes)) if state is None else state.astype(float))

    @property
    def damage(self) -> fem.Function:
        """Damage of the cohesion that acts, 0 where it is intact, 1 where surfaces are separated, as a scalar field (collective)."""
        state = self.pair.trial.cohesion
        return self._field("damage", 0.0 if state is None else state[:, 1])

    @property
    def worn_volume(self) -> float:
        """Worn volume of the contactor after all committed steps: integral of ``wear`` over the reference surface (collective)."""
        wear = None if self.pair.friction is None else self.pair.friction.wear
        return 0.0 if wear is None else wear.volume(self.pair.committed)

    def opposite(self, f: fem.Function) -> fem.Function:
        """Values of a field on the target opposite to the contactors, as a scalar field on the contactor (collective).

        With ``coupling="node_to_surface"``, values are taken at the closest points of the nodes, with ``"mortar"`` as means over
        the facets around them.

        Args:
            f: scalar Function on the mesh, such as a temperature.

        Raises:
            InputError, InputTypeError: for another Function, or a rigid target.
        """
        meshed = self.pair.target.n_nodes > 0
        given.kind("f", f, isinstance(f, fem.Function), "a scalar Function")
        if f.ufl_shape != () or not compat.is_on(f.function_space, self.config.mesh) or not meshed:
            raise InputError(f"contact '{self.name}': opposite needs a scalar Function on the mesh, and a target that is meshed")
        from uem_dolfinx.contact.thermal.sides import sides_of

        values = fem.Function(compat.function_space(self.config.mesh, self.config.degree))
        values.interpolate(f)
        at = sides_of(self.pair)
        return self._field("opposite", at.means(at.theirs, values.x.array[: self.config.n_owned]))

    @property
    def force(self) -> fem.Function:
        """Nodal contact forces as a vector field: on the contactors, and opposite on the nodes of a meshed target (collective)."""
        if "force" not in self._fields:
            self._fields["force"] = fem.Function(self.config.V, name=_identifier(f"contact_force_{self.name}"))
        f, pair = self._fields["force"], self.pair
        total = self.config.add_at_owners(*pair.nodal_forces(pair.trial))
        f.x.array[: total.size] = total.ravel()
        f.x.scatter_forward()
        return f

    def force_on(self, side: Literal["contactor", "target"]) -> fem.Function:
        """Nodal contact forces on one of the bodies, as a vector field; zero on a rigid target, which has no nodes (collective).

        Args:
            side: ``"contactor"`` or ``"target"``; the sum of both fields is :attr:`force`.
        """
        given.word("side", side, ("contactor", "target"))
        f = self._field(f"force_on_{side}", self.pair.trial.force, vector=True)
        if side == "target":
            f.x.array[:] = self.force.x.array - f.x.array
        return f

    def resultant(self, about: npt.ArrayLike | None = None, *, on: Literal["contactor", "target"] = "contactor") -> Resultant:
        """Force and moment that the contact exerts on one of the bodies (collective).

        In axisymmetry it is the resultant on the whole body: radial forces cancel, and ``normal`` is the sum of the normal forces
        over full circles.

        Args:
            about: point that the moment is taken about ``(gdim,)``. None is the origin; for the force on a rigid surface it is the
                current reference point of the surface, about which a tool rotates.
            on: ``"contactor"`` or ``"target"``. Forces on a meshed target act at the closest points of the contactors, forces on a
                rigid target at the contactors.

        Raises:
            InputError, InputTypeError: for an unknown body, or a point that is not finite.
        """
        given.word("on", on, ("contactor", "target"))
        target, p, g = self.pair.target, self.pair.kinematics.projection, self.config.gdim
        centre = np.zeros(g) if about is None else given.vector("about", about, g)
        x, f = self.acting_at(), self.pair.trial.force
        if on == "target":
            # a gap kept by a tie moves with the target
            x, f = np.where(self.pair.tied[:, None], x, p.foot), -f
            centre = target.reference(g) if about is None else centre
        normal = float(reduced(self.config.comm, float(self.pair.pressing()[0].sum())))
        return replace(sum_up(self.config.comm, self.config.of_circles(x) - centre, self.config.of_circles(f)), normal=normal)

    def balance(self) -> Balance | None:
        """Imbalance of force and moment, summed over both bodies; zero is action = reaction (collective).

        Contactor forces come from the residual, target forces from their distribution to the target's nodes. In axisymmetry only
        axial forces count.

        Returns:
            Imbalances relative to the sums of absolute nodal forces and moments; None for a rigid target, which has no nodes.
        """
        if self.pair.target.n_nodes == 0:
            return None
        n, g = self.config.n_owned, self.config.gdim
        force = self.force.x.array.reshape(-1, g)[:n]
        return imbalance(self.config.comm, self.config.of_circles(self.config.x[:n]), self.config.of_circles(force))

    def _field(self, what: str, values: npt.ArrayLike, vector: bool = False) -> fem.Function:
        config = self.config
        if what not in self._fields:
            space = config.V if vector else compat.function_space(config.mesh, config.degree)
            self._fields[what] = fem.Function(space, name=_identifier(f"contact_{what}_{self.name}"))
        f = self._fields[what]
        f.x.array[:] = 0.0
        table = f.x.array.reshape(-1, config.gdim) if vector else f.x.array
        table[self.pair.nodes] = values
        f.x.scatter_forward()
        return f


def _identifier(text: str) -> str:
    """Name of a Function as an identifier for the form compiler."""
    return re.sub(r"\W+", "_", text)
