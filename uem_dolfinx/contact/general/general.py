"""General contact: one declaration for contact between all bodies, and with rigid surfaces.

Of two bodies, the nodes of one follow the facets of the other. An order of all bodies decides which one follows, so that there are
no cycles. A node may touch as many bodies at once as others meet it in a corner of a grid of blocks, each by a contact of its own.
With mortar there is one contact for each target body.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.contact import BOUND, COUPLINGS, MAX_PENETRATION, Contact
from uem_dolfinx.contact.general.parts import AmongContact, MortarContact, RigidContact
from uem_dolfinx.contact.general.surface import as_part, is_pair, touching_surface, where, with_border, words_of
from uem_dolfinx.contact.laws.conductance import Conductance, conductances_of, one_of_fields
from uem_dolfinx.contact.laws.law import Field, FrictionLaw, as_law, given_friction, given_normal, parameters
from uem_dolfinx.contact.results import ManyContacts, Resultant, not_attached, sum_up
from uem_dolfinx.errors import InputError, SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.surfaces import surface_nodes
from uem_dolfinx.geometry.tags import Part, Tag, communicator_of
from uem_dolfinx.parallel import agreed

if TYPE_CHECKING:
    from uem_dolfinx.contact.general.pair_friction import FrictionOfPairs, ValuesOfPairs
    from uem_dolfinx.contact.general.touching import Pair, Touch
    from uem_dolfinx.contact.laws.soft import SoftContact
    from uem_dolfinx.geometry.skin import Apart


class GeneralContact(ManyContacts, given.Sealed):
    """Contact of every surface with every other, and with rigid surfaces, by one declaration.

    Facets far from other surfaces cost almost nothing. Bodies are the connected components of the mesh. Between two bodies the
    nodes of the one with smaller facets are contactors, between two parts of one body the nodes of one part.

    Args:
        surfaces: parts that may touch, named as for ``Contact``; None is all exterior facets.
        rigid: rigid surfaces that all of them may touch: one, or a list.
        exclude: parts without contact, and pairs of parts ``(one, other)`` without contact between them, of facets or of cells.
            Surfaces paired by another ``Contact`` of the problem are left to it; its tied nodes have no contact next to the tie.
        order: parts, of facets or of cells, whose bodies' nodes are contactors to all later ones. Other bodies come after
            these: the finer first, of equally fine ones the smaller, and last bodies that couplings or Dirichlet conditions make rigid.
        self_contact: parts, of facets or of cells, whose bodies may touch themselves; True is all, False none.
        bodies: names of bodies, ``{name: part}`` with parts of facets or of cells; others are ``"body 1"``, ``"body 2"``, ... in the
            order of the mesh's input.
        friction: see ``Contact``, for all; or by pairs, ``{(one, other): value, ..., None: value of all others}``, with names of
            bodies, or parts of facets or of cells, or one of the rigid surfaces, and values of one law. The first matching pair is
            used; pairs that are not listed are frictionless unless the key ``None`` gives a default.
        coupling: ``"node_to_surface"``, or ``"mortar"``, for a few bodies with non-matching meshes: each body is then a separate
            target, compared with all others. There is no self-contact.
        normals: ``"facet"`` or ``"averaged"``, see ``Contact``; at sharp edges they are the facets' own.
        max_penetration: bound on the initial penetration, a length; None is 5 % of the smallest body's size.
        measure: see ``Contact``.
        name: for messages and files.
        normal: see ``Contact``; its pressure must be 0 from a gap of half a facet on. Only nearest facets press.
        heat: see ``Contact``; heat flows only where surfaces touch, with a ``temperature`` also into rigid surfaces. Or a list.
        edges: whether sharp edges of different bodies that cross in 3D are in contact, by one equation at each crossing; None:
            if supported, without ``normal``, ``heat`` and laws of friction by area. With mortar, where edges are ridges.
        others: further arguments of ``Contact``, such as ``cohesion`` and ``leak``, at their defaults only.

    Raises:
        InputError, InputTypeError: for an unknown word, numbers out of their range, or arguments for single contacts only.
    """

    def __init__(
        self,
        surfaces: Part | None = None,
        *,
        rigid: Any = (),
        exclude: Sequence[Any] = (),
        order: Sequence[Part] = (),
        self_contact: bool | Sequence[Part] = False,
        bodies: dict[str, Part] | None = None,
        friction: Field | FrictionLaw | dict[Any, Field | FrictionLaw] = 0.0,
        coupling: Literal["node_to_surface", "mortar"] = "node_to_surface",
        normals: Literal["facet", "averaged"] = "facet",
        max_penetration: float | None = None,
        measure: Literal["reference", "current"] = "reference",
        name: str = "general contact",
        normal: SoftContact | None = None,
        heat: Conductance | Sequence[Conductance] | None = None,
        edges: bool | None = None,
        **others: Any,
    ):
        from uem_dolfinx.contact.general.pair_friction import given_edges, refuse_words_of_contact

        with agreed((None if surfaces is None else communicator_of(surfaces)) or MPI.COMM_SELF):
            refuse_words_of_contact(others)
            rigid = [rigid] if hasattr(rigid, "project") else rigid
            self.rigid = given.items("rigid", rigid, lambda one: hasattr(one, "project"), "a rigid surface")
            self.exclude = given.items("exclude", exclude, lambda one: one is not None, "a part, or a pair of parts")
            self.order = given.items("order", order, lambda one: one is not None, "a part of a mesh")
            if not isinstance(self_contact, bool):
                self_contact = given.items("self_contact", self_contact, lambda one: one is not None, "a part of a mesh")
            named = isinstance(bodies, dict) and all(isinstance(key, str) for key in bodies)
            given.kind("bodies", bodies, bodies is None or named, "names and parts, {name: part}, or None")
            self._pairs = self._friction_of_pairs(friction)
            self.coupling = given.word("coupling", coupling, COUPLINGS)
            self.normals = given.word("normals", normals, ("facet", "averaged"))
            for word, handed, usual in (("normals", normals, "facet"), ("self_contact", self_contact, False)):
                if coupling == "mortar" and handed != usual:
                    raise InputError(f"{word} = {given.shown(handed)} does not go with coupling = 'mortar': leave it out")
            self.measure = given.word("measure", measure, ("reference", "current"))
            if max_penetration is not None:
                max_penetration = given.number("max_penetration", max_penetration, BOUND)
            given.kind("name", name, isinstance(name, str) and bool(name), "a text")
            self.heats = conductances_of(heat)
            self.normal = given_normal(normal, friction, 0.0, self.heats, False)
            law = as_law(friction if self._pairs is None else self._pairs.law)
            self.edges = given_edges(edges, self.normal, self.heats, law)
            if any(law.temperature is not None for law in self.heats) and not self.rigid:
                raise InputError("heat: temperature is of rigid surfaces, and there are none: leave it out, or give rigid=...")
        self.surfaces, self.bodies, self.friction, self.heat = surfaces, dict(bodies or {}), friction, heat
        self.max_penetration, self.name, self.self_contact = max_penetration, name, self_contact
        self.taken = False  # whether a problem has been made of it
        self._parts, self._fields = list[Contact](), dict[str, fem.Function]()

    def _friction_of_pairs(self, friction: Any) -> FrictionOfPairs | None:
        """Friction by pairs of bodies; None if all surfaces have the same."""
        if not isinstance(friction, dict):
            given_friction(friction)
            return None
        from uem_dolfinx.contact.general.pair_friction import FrictionOfPairs

        pairs = FrictionOfPairs(friction)
        for _, other, _ in pairs.pairs:
            if hasattr(other, "project") and not any(other is one for one in self.rigid):
                raise InputError(given.sentence("a rigid surface in friction", other, "one of those in rigid"))
        return pairs

    def __repr__(self) -> str:
        """Name and number of rigid surfaces."""
        return f"GeneralContact({self.name!r}, rigid surfaces: {len(self.rigid)})"

    def make_parts(self, config: Configuration, others: Sequence[Contact], rigid: Bools) -> list[Contact]:
        """Make the single contacts of the general contact, in a problem with these ``others`` and ``rigid (n_owned,)`` nodes (collective).

        Raises:
            TagError, SpaceError, OrientationError: for parts of another kind or mesh, or facets inside a body.
            SurfaceError: if no surfaces are left that may touch, if a body has two names, or if two bodies have the same name.
        """
        from uem_dolfinx.geometry.skin import Skin, names_of_bodies

        self.taken, self._attached = True, config
        given.alike(
            config.comm, self.name, surfaces=words_of(self.surfaces), exclude=list(map(words_of, self.exclude)),
            order=list(map(words_of, self.order)), bodies=[(name, words_of(part)) for name, part in self.bodies.items()],
            self_contact=self.self_contact if isinstance(self.self_contact, bool) else list(map(words_of, self.self_contact)),
            rigid=[type(one).__name__ for one in self.rigid], coupling=self.coupling,
            friction=None if self._pairs is None else [(*map(words_of, pair), parameters(law)) for *pair, law in self._pairs.pairs],
        )  # fmt: skip
        alone = [one for one in self.exclude if not is_pair(one)]
        pairs = [one for one in self.exclude if is_pair(one)]
        others = [c for c in others if not hasattr(c.target, "project")]
        pairs += [(c.contactor, c.target) for c in others]
        surface = touching_surface(config, self.surfaces, [as_part(config, part, "exclude") for part in alone])
        self._skin = skin = Skin(config, surface)
        place = skin.order([as_part(config, part, "order") for part in self.order], rigid)
        named = {name: skin.bodies_of(as_part(config, part, "bodies")) for name, part in self.bodies.items()}
        self._names = names_of_bodies(named, skin.n_bodies)
        nodes = surface_nodes(config, surface)
        bound = MAX_PENETRATION * float(skin.extent.min()) if self.max_penetration is None else self.max_penetration
        friction = self.friction if self._pairs is None else self._pairs.law
        options: dict[str, Any] = {"friction": friction, "max_penetration": bound, "measure": self.measure, "normal": self.normal}
        options |= {"skin": skin, "by_pairs": None if self._pairs is None else self._values_of_pairs}
        with_facets, itself = place[skin.size > 0], np.full(skin.n_bodies, self.self_contact is True)
        for part in () if isinstance(self.self_contact, bool) else self.self_contact:
            itself |= skin.bodies_of(as_part(config, part, "self_contact"))
        if len(with_facets) < 2 and not itself.any() and not self.rigid:
            raise SurfaceError(
                f"{self.name}: there is one body and no rigid surface: give rigid=..., or self_contact=True for a body that touches "
                "itself"
            )
        from uem_dolfinx.contact.general.pair_friction import refuse_distant_pressures, refuse_open_conductance

        refuse_open_conductance(config, self.name, self.heats, bound)
        refuse_distant_pressures(config, self.name, self.normal, skin)
        parts: list[Contact] = []
        if len(with_facets) > 1 or itself.any():
            apart: list[Apart] = [(*where(skin, one, "exclude"), *where(skin, other, "exclude")) for one, other in pairs]
            if self.coupling != "mortar":
                # nodes at the border of a tied surface are tied: they touch no neighbouring facets
                tied = [False] * (len(pairs) - len(others)) + [c.tied is True for c in others]
                apart = [with_border(skin, sets) if of_tie else sets for sets, of_tie in zip(apart, tied)]
            among = self._mortar if self.coupling == "mortar" else self._nodes
            heat = [law.without_temperature() for law in self.heats]
            parts += among(nodes, place, itself, apart, bound, options | {"heat": heat})
        options["heat"] = [law for law in self.heats if law.temperature is not None]
        for i, target in enumerate(self.rigid):
            name = getattr(target, "name", type(target).__name__)
            name += f" {i + 1}" if len(self.rigid) > 1 else ""
            parts.append(RigidContact(surface, target, coupling=self.coupling, name=f"{self.name} on {name}", **options))
        self._parts = parts
        return parts

    def _nodes(
        self, nodes: Indices, place: Ints, itself: Bools, apart: Sequence[Apart], bound: float, options: dict[str, Any]
    ) -> list[Contact]:
        """Contacts of nodes with bodies (collective); arguments as for ``Neighbours``, but ``nodes`` are all nodes of the surfaces."""
        from uem_dolfinx.geometry.neighbours import Neighbours

        skin = self._skin
        body = skin.body_of_node[nodes]
        own = nodes[(place[body] < place[skin.size > 0].max()) | itself[body] | skin.corners[nodes]]
        # as many bodies as meet another one at a corner in a grid of blocks
        n_lists = 2**self._config.gdim - 1
        neighbours = Neighbours(skin, own, place, apart, bound, n_lists, itself)
        crossings = None
        if self.edges:
            from uem_dolfinx.contact.general.edges import crossings_of, edge_contacts

            crossings = crossings_of(neighbours, bound)
        together: list[AmongContact] = []
        for k in range(n_lists):
            name = self._name(k)
            together.append(AmongContact(neighbours, k, together, crossings, name=name, normals=self.normals, **options))
        return [*together, *(() if crossings is None else edge_contacts(neighbours, crossings, self.name, options))]

    def _mortar(
        self, nodes: Indices, place: Ints, itself: Bools, apart: Sequence[Apart], bound: float, options: dict[str, Any]
    ) -> list[Contact]:
        """Mortar contacts with each target body (collective); arguments as for ``_nodes``."""
        from uem_dolfinx.contact.general.edges import crossings_of, edge_contacts
        from uem_dolfinx.contact.general.mortar import Body
        from uem_dolfinx.geometry.neighbours import Neighbours
        from uem_dolfinx.geometry.skin import classes_of_facets, facets_by_class, surface_of

        skin, found, order = self._skin, list[Contact](), np.argsort(place)
        # which bodies may touch; nodes are searched by each body
        neighbours = Neighbours(skin, nodes[:0], place, apart, bound, 0, itself)
        crossings = crossings_of(neighbours, bound, ridges=True) if self.edges else None
        classes = classes_of_facets(skin)
        for body in order[skin.size[order] > 0].tolist():
            tag = surface_of(skin, skin.body == body)
            target = Body(skin, TargetFacets(self._config, tag), body, apart, bound)
            for contactor in facets_by_class(skin, *classes, place[skin.body] < place[body]):
                name = self._name(len(found))
                found.append(MortarContact(contactor, tag, target, crossings, neighbours.number, name=name, **options))
        return [*found, *([] if crossings is None else edge_contacts(neighbours, crossings, self.name, options))]

    def _name(self, k: int) -> str:
        """Name of the k-th contact between bodies."""
        return f"{self.name} {k + 1}" if k else self.name

    def _values_of_pairs(self, target: Any, name: str) -> ValuesOfPairs:
        """Friction of pairs in one of the contacts, with a rigid ``target`` or None (collective)."""
        from uem_dolfinx.contact.general.pair_friction import ValuesOfPairs

        assert self._pairs is not None
        return ValuesOfPairs(self._skin, self._pairs, self._place_of, target, name)

    def _place_of(self, one: Any) -> tuple[Bools, Bools]:
        """Local nodes ``(n_local,)`` and this rank's facets ``(m,)`` of a part, or of a body by its name (collective)."""
        if not isinstance(one, str):
            return where(self._skin, one, "friction")
        body = self._names.index(given.word("the name of a body in friction", one, self._names))
        return self._skin.body_of_node == body, self._skin.body == body

    @property
    def all_surfaces(self) -> Tag:
        """Facets that may touch others, once a problem has been made."""
        return self._skin.tag

    # -- results ---------------------------------------------------------------------------------------------------------

    @property
    def parts(self) -> list[Contact]:
        """The single contacts: between bodies, one for each body that a node may touch at once, and with each rigid surface."""
        if not self._parts:
            raise not_attached(self.name)
        return self._parts

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks; a node counts once for each body that it touches (collective)."""
        return sum(part.n_active for part in self.parts)

    @property
    def dissipation(self) -> float:
        """Energy dissipated by friction and by damping in all committed steps (collective)."""
        return sum(part.dissipation for part in self.parts)

    def max_gap(self) -> float:
        """Largest gap of an active contactor, a length (collective)."""
        return max(part.max_gap() for part in self.parts)

    def max_pressure(self) -> float:
        """Largest contact pressure, a force per area (collective)."""
        return max(part.max_pressure() for part in self.parts)

    @property
    def pressure(self) -> fem.Function:
        """Contact pressure as a scalar field on contactors, summed over all touched bodies (collective)."""
        return self._of_all("pressure")

    def pressure_to_integrate(self) -> fem.Function:
        """Normal forces per reference area; the integral over surfaces in contact is their sum; see ``Contact`` (collective).

        Contactors are the nodes of one surface, and nodes at sharp edges of both: integrate over the facets of both that face each
        other.
        """
        return self._together("pressure_to_integrate", [part.pressure_to_integrate() for part in self.parts], np.add)

    @property
    def force(self) -> fem.Function:
        """Nodal contact forces as a vector field, on both bodies (collective)."""
        return self._of_all("force")

    @property
    def traction(self) -> fem.Function:
        """Tangential force per area, as a vector field on contactors, summed over all touched bodies (collective)."""
        return self._of_all("traction")

    @property
    def slip(self) -> fem.Function:
        """Accumulated slip as a vector field on contactors, summed over all touched bodies, a length (collective)."""
        return self._of_all("slip")

    @property
    def status(self) -> fem.Function:
        """0 at open contactors, 1 if they stick to all that they touch, 2 if they slip; see ``Contact.status`` (collective)."""
        return self._of_all("status", np.maximum)

    @property
    def active(self) -> fem.Function:
        """The number of bodies and rigid surfaces that contactors touch, as a scalar field (collective)."""
        return self._of_all("active")

    @property
    def heat_flux(self) -> fem.Function:
        """Power per area from contactors to touched surfaces, as a scalar field; 0 without ``heat`` (collective).

        With several conductances, it belongs to the field of the first one.
        """
        return self.heat_flux_of(self.heats[0].field) if self.heats else self._of_all("heat_flux")

    def heat_flux_of(self, field: int) -> fem.Function:
        """The heat flux of a given field; see ``Contact.heat_flux_of`` (collective)."""
        field = one_of_fields(self.name, self.heats, field)
        what = "heat_flux" if field == self.heats[0].field else f"heat_flux_of_field_{field}"
        return self._together(what, [part.flux_of_part(field) for part in self.parts], np.add)

    def heat_balance(self) -> float:
        """Sum of nodal heat over the sum of its absolute values, the largest of all contacts between bodies (collective)."""
        return max([part.heat_balance() for part in self.parts if part.pair.target.n_nodes], default=0.0)

    @property
    def gap(self) -> fem.Function:
        """The least gap as a scalar field, a length; the model's size if no surface is near, zero off the surfaces (collective)."""
        return self._of_all("gap", np.minimum)

    def resultant(self, about: npt.ArrayLike | None = None) -> Resultant:
        """Force and moment of rigid surfaces on the bodies; forces between bodies cancel (collective).

        Args:
            about: point that the moment is taken about ``(gdim,)``; None is the origin.
        """
        g = self._config.gdim
        centre = np.zeros(g) if about is None else given.vector("about", about, g)
        rigid = [part.resultant(centre) for part in self.parts if not part.pair.target.n_nodes]
        nothing = sum_up(self._config.comm, np.zeros((0, g)), np.zeros((0, g)))
        total = sum((r.force for r in rigid), nothing.force), sum((r.moment for r in rigid), nothing.moment)
        return Resultant(*total, sum(r.normal for r in rigid))

    def _of_all(self, what: str, together: np.ufunc = np.add) -> fem.Function:
        """A field combined over all parts (collective)."""
        return self._together(what, [getattr(part, what) for part in self.parts], together)

    def _together(self, what: str, fields: list[fem.Function], together: np.ufunc) -> fem.Function:
        if what not in self._fields:
            self._fields[what] = fem.Function(fields[0].function_space, name=f"contact_{what}_of_all")
        self._fields[what].x.array[:] = together.reduce([field.x.array for field in fields])
        return self._fields[what]

    def touching(self) -> list[Touch]:
        """Bodies that touch now, and rigid surfaces with them, sorted by their numbers in the mesh's input (collective)."""
        return [touch for touch, _ in self.forces_of_pairs()]

    def forces_of_pairs(self, about: npt.ArrayLike | None = None) -> list[tuple[Touch, Array]]:
        """The pairs of ``touching``, each with the moment on the first body, ``(3,)`` or in 2D ``(1,)`` (collective).

        Args:
            about: point that moments are taken about ``(gdim,)``; None is the origin.
        """
        sums = self._sums_of_pairs(about)
        return [(one.touch, one.moment) for one in sums if one.touch.n_active or one.touch.force.any()]

    def _sums_of_pairs(self, about: npt.ArrayLike | None = None, field: int | None = None) -> list[Pair]:
        from uem_dolfinx.contact.general.touching import sums_of_pairs

        g, rigid = self._config.gdim, [self._rigid_name(part) for part in self.parts]
        centre = np.zeros(g) if about is None else given.vector("about", about, g)
        field = self.heats[0].field if self.heats and field is None else field
        return sums_of_pairs(self.parts, self._skin, self._names, rigid, centre, field)

    def between(self, first: str, second: str | None = None, about: Any = None) -> Resultant:
        """Force and moment on a body from another one or from a rigid surface (collective).

        Args:
            first: name of the body.
            second: name of the other body, or of a rigid surface as in ``touching``; None sums over all bodies and surfaces in contact.
            about: point that the moment is taken about ``(gdim,)``; None is the origin.

        Raises:
            InputError: for an unknown name.
        """
        return self._between(first, second, about)[0]

    def heat_power(self, first: str, second: str | None = None, field: int | None = None) -> float:
        """Power that flows from a body to another one or to a rigid surface, without frictional heat (collective).

        Args:
            first: see ``between``.
            second: see ``between``.
            field: number of the field, summed over its conductances; None is the field of the first conductance.

        Raises:
            InputError: for an unknown name, or if no conductance belongs to that field.
        """
        of = None if field is None else one_of_fields(self.name, self.heats, field)
        return self._between(first, second, None, of)[1]

    def _between(self, first: str, second: str | None, about: Any, field: int | None = None) -> tuple[Resultant, float]:
        from uem_dolfinx.contact.general.touching import between

        names = (*self._names, *(self._rigid_name(part) for part in self.parts if isinstance(part, RigidContact)))
        none = np.zeros((0, self._config.gdim))
        return between(self._sums_of_pairs(about, field), names, first, second, sum_up(self._config.comm, none, none))

    def _rigid_name(self, part: Contact) -> str:
        """Name of a contact's rigid surface in ``touching``."""
        return part.name.removeprefix(f"{self.name} on ")
