"""Contact: the user's declaration of two surfaces, and the interface made from it in a problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools, Indices
from uem_dolfinx.contact.laws.conductance import Conductance, conductances_of
from uem_dolfinx.contact.laws.law import (
    Field,
    FrictionLaw,
    OfTemperature,
    as_law,
    given_field,
    given_friction,
    given_joint,
    given_normal,
    given_together,
    is_read_again,
    of_rate,
    parameters,
    values_at,
)
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.kinds import PartsOfPair, heats_of_kind, kind_of_interface, tie_of, wear_of
from uem_dolfinx.contact.seam.placement import Discretisation, Kinematics
from uem_dolfinx.contact.warnings.checks import warn_of_slim_tips, warn_of_straight_facets
from uem_dolfinx.contact.warnings.watch import WatchedContact
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, facets_of
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.surfaces import check_distinct, surface_nodes
from uem_dolfinx.geometry.tags import Part, Tag, as_tag, communicator_of, name_of
from uem_dolfinx.parallel import agreed, reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.laws.cohesive import Cohesive
    from uem_dolfinx.contact.laws.leak import Leak
    from uem_dolfinx.contact.laws.soft import Adhesion, SoftContact
    from uem_dolfinx.contact.mortar.discretisation import Mortar
    from uem_dolfinx.contact.offsets import Offsets

#: Default bound on the initial penetration, as part of the model's size.
#: [convention; the model's size; test_pair.py::test_default_bound_on_the_initial_penetration]
MAX_PENETRATION = 0.05
COUPLINGS: tuple[Literal["node_to_surface", "mortar"], ...] = ("node_to_surface", "mortar")
AFTER: tuple[Literal["after"]] = ("after",)
BOUND = given.Range("0 or a positive length, or None for 5 % of the model's size", lambda x: x >= 0)
OF_ADJUST = given.Range("True, False or a positive length", given.POSITIVE.holds)
THICKNESS = given.Range("a positive length, or None for a body without back", lambda x: x > 0)


class Contact(WatchedContact, given.Sealed):
    """A contactor surface that may touch a target.

    Args:
        contactor: facets whose nodes are the contactors, or points, which have forces but no pressures: a tag, a list of tags,
            ``(meshtags, value)``, or facet indices.
        target: facets of the other body, specified in the same way, or a rigid surface.
        coupling: ``"node_to_surface"``, the paper's, or ``"mortar"``, from integrals over both surfaces: exact on any pair of meshes;
            a contactor of points keeps nodal equations. Or a class of ``contact.seam.placement.Discretisation``, as ``NodeToSurface`` is.
        sliding: ``"finite"`` projects in every iteration, ``"small"`` once per step, ``"fixed"`` once for all.
        normals: ``"facet"``, the paper's, or ``"averaged"`` at the target's nodes and interpolated.
        max_penetration: bound on the initial penetration, a length; None is 5 % of the model's size.
        thickness: of the body behind a meshed target, a length: a contactor that has slid off the target's end and is deeper than
            this lies behind the body, not in it. None: the body is treated as infinitely thick.
        friction: Coulomb's coefficient: a number, or a function of reference positions ``(3, n)`` that returns ``(n,)``, with a
            second argument also of the load factor or time at the end of the step. Or a scalar Function of the displacement's
            nodes, which every step reads, or an ``OfTemperature``. Or a law with any of these as parameter: ``Coulomb`` with a
            limit, ``Tresca``, ``Thirion``, ``Stribeck``. With 0 it is frictionless. If the contact was made with friction, it may be
            changed between steps, by the same law; of other settings only ``offset`` may, once a problem has been made.
        wear: Archard's coefficient over the hardness, one over a pressure, a number or a function of position as for ``friction``.
            After every step the worn volume of the contactor is ``wear N s`` for the force N that slips by s, with friction or
            without, and gaps are larger by the worn depth: see :attr:`wear` and :attr:`worn_volume`. The target does not wear.
        heat: a ``Conductance``: heat conduction through the contact, if one of the other fields of a mixed space is a temperature.
            Or a list, for instance of heat and electric current; each of them gets the whole pressure.
        measure: area of pressures and tractions: ``"reference"``, of the undeformed surface, the only one in small strains, or
            ``"current"``, of the deformed surface, on which the true pressure acts. For both couplings.
        tied: True ties contactors within reach to the target permanently, in all components: they never open and never slip, and
            gaps are kept and rotate with the target. Contactors out of reach remain in contact. ``"after"`` is contact until
            :meth:`tie` is called.
        offset: additional thickness of both surfaces together, a length, or a function of position or a Function as for ``friction``:
            gaps are smaller by it. If surfaces coincide, a positive offset is an interference, a negative one a clearance. It may be
            changed between steps, or by a function of the load factor, ``load`` of the problem.
        adjust: a length, or True for a side of a target's facet (on a rigid surface ``max_penetration``). Contactors with an
            initial gap or penetration of at most this length are initially in contact, free of stress. No node is moved: the
            initial gap of each contactor becomes part of its offset; :attr:`adjusted` is the largest. Tied contactors keep their
            gap, and ``adjust`` is the reach of the tie, by default True.
        normal: None is hard contact; a ``SoftContact`` makes the pressure a function of the gap, without friction, wear, heat and tie.
        cohesion: a ``Cohesive`` bonds the contactors that ``adjust`` reaches, as a tie, until they separate. Its results are
            :attr:`damage`, and :attr:`pressure` and :attr:`traction` with the bonds. Friction acts on the damaged part. An
            ``Adhesion`` attracts all facing surfaces.
        leak: a ``Leak`` lets a fluid enter between the surfaces from one side, which presses on both.
        corners: True makes nodes at pointed convex edges of a meshed target contactors of the contactor's facets, too, with
            ``"node_to_surface"`` and hard contact without wear, ``adjust`` and heat. False: they may penetrate between contactors.
        edges: True includes contact of sharp convex edges of both bodies that cross in 3D, by one equation at each crossing. It has
            the restrictions of ``corners``, but supports mortar, and needs ``"finite"`` sliding.
        chords: build P with the straight pieces between a curved target's nodes [UEM, 4.5]; gaps, normal return and forces keep
            the true facet, so that the answer is the same, after more iterations.
        name: for messages and files; None takes the names of the tags.

    Raises:
        InputError, InputTypeError: for an unknown word, a bound or thickness out of its range, a rigid contactor; on all ranks if a
            tag determines the communicator. Also if an attribute is set that does not exist, or that cannot be changed any more.
    """

    SETTABLE = dict.fromkeys(("friction", "offset"))
    cohesion: Cohesive | Adhesion | None = None
    leak: Leak | None = None
    of_all_surfaces = False  #: Whether it is part of a general contact.

    def __init__(
        self,
        contactor: Part,
        target: Part | Target,
        *,
        coupling: Literal["node_to_surface", "mortar"] | Callable[..., Discretisation] = "node_to_surface",
        sliding: Literal["finite", "small", "fixed"] = "finite",
        normals: Literal["facet", "averaged"] = "facet",
        max_penetration: float | None = None,
        thickness: float | None = None,
        tied: bool | Literal["after"] = False,
        offset: Field = 0.0,
        adjust: float | bool = False,
        chords: bool = False,
        friction: Field | FrictionLaw = 0.0,
        wear: Field = 0.0,
        heat: Conductance | Sequence[Conductance] | None = None,
        normal: SoftContact | None = None,
        cohesion: Cohesive | Adhesion | None = None,
        leak: Leak | None = None,
        corners: bool = False,
        edges: bool = False,
        measure: Literal["reference", "current"] = "reference",
        name: str | None = None,
    ):
        with agreed(communicator_of(contactor) or communicator_of(target) or MPI.COMM_SELF):
            rigid = hasattr(given.kind("target", target, True, "a part of a mesh, or a rigid surface"), "project")
            swap = "a rigid surface can only be the target: swap the two"
            given.kind("contactor", contactor, not hasattr(contactor, "project"), "a part of a mesh", swap)
            if not given.function(coupling):
                coupling = given.word("coupling", coupling, COUPLINGS)
            sliding = given.word("sliding", sliding, ("finite", "small", "fixed"))
            normals = given.word("normals", normals, ("facet", "averaged"))
            max_penetration = None if max_penetration is None else given.number("max_penetration", max_penetration, BOUND)
            thickness = None if thickness is None else given.number("thickness", thickness, THICKNESS)
            self.corners, self.edges = given.flag("corners", corners), given.flag("edges", edges)
            chords = given.flag("chords", chords)
            self._friction, self._wear = given_friction(friction), given_field("wear", wear, given.NOT_NEGATIVE)
            self.heats = conductances_of(heat)
            self.normal = given_normal(normal, friction, wear, self.heats, tied)
            measure = given.word("measure", measure, ("reference", "current"))
            tied = given.word("tied", tied, AFTER) if isinstance(tied, str) else given.flag("tied", tied)
            adjust = adjust if isinstance(adjust, (bool, np.bool_)) else given.number("adjust", adjust, OF_ADJUST)
            self._offset = given_field("offset", offset)
            self.cohesion, self.leak = given_joint(cohesion, leak, sliding, normal, friction, wear, self.heats, tied, offset)
            if coupling == "mortar" and (chords or normals != "facet"):
                what = "chords = True" if chords else f"normals = '{normals}'"
                raise InputError(
                    f"{what} does not go with coupling = 'mortar', whose facets have normals of their own: leave it out"
                )
            given.kind("name", name, name is None or isinstance(name, str), "a text, or None for the names of the tags")
        self.contactor, self.target, self.sliding, self.normals = contactor, target, sliding, normals
        self.coupling, self.measure, self.tied, self.adjust = coupling, measure, tied, adjust
        self.max_penetration, self.thickness, self.chords, self.heat = max_penetration, thickness, chords, heat
        self.name = (
            name or f"{name_of(contactor)} on {getattr(target, 'name', type(target).__name__) if rigid else name_of(target)}"
        )
        self.taken = False
        self._pair: Interface | None = None
        self._offsets: Offsets | None = None
        self._fields: dict[str, fem.Function] = {}

    @property
    def _called(self) -> str:
        return f"contact '{self.name}'"

    @property
    def _is_open(self) -> bool:
        return not self.taken

    def _too_late(self) -> str:
        return (
            "comes too late, its problem has been made: make a new Contact, and a new problem of it; only friction and offset may be "
            "set between steps"
        )

    def __repr__(self) -> str:
        """Name, coupling and sliding, with friction and tie if present."""
        law, coupling = as_law(self._friction), self.coupling if isinstance(self.coupling, str) else self.coupling.__name__
        friction = "" if law.field == 0.0 else f", friction={type(law).__name__}({', '.join(map(given.shown, parameters(law)))})"
        tied = f", tied={self.tied!r}" if self.tied else ""
        return f"Contact({self.name!r}, coupling={coupling!r}, sliding={self.sliding!r}{friction}{tied})"

    @property
    def friction(self) -> Field | FrictionLaw:
        """Coulomb's coefficient, or a law; a change between steps is valid from the next step on (collective)."""
        return self._friction

    @friction.setter
    def friction(self, value: Field | FrictionLaw) -> None:
        if not self.taken:
            self._friction = given_together(self, given_friction(value), self._offset)[0]
            return
        before = as_law(self._friction)
        with agreed(self.config.comm):
            law = as_law(value := given_friction(value))
            given.kind("friction", value, type(law) is type(before), f"a value for the law {type(before).__name__}")
        given.alike(self.config.comm, f"contact '{self.name}'", friction=parameters(law))
        mu = self._friction_at(law, self.pair.nodes, self._at)
        if mu is not None and self.pair.friction is None:
            raise InputError(
                f"contact '{self.name}': friction = {given.shown(value)} comes too late, the contact has been made without: make it with "
                "the friction that it is to have, and set friction = 0 until then"
            )
        self._take_friction(law, mu)
        self._friction = value

    def _take_friction(self, law: FrictionLaw, mu: Array | None) -> None:
        """Set a friction law with these values at the contactors ``(n,)``, None for zeros (collective)."""
        if self.pair.friction is not None:
            self.pair.set_friction(law, np.zeros(len(self.pair.nodes)) if mu is None else mu)
        for part in self.further:
            part._take_friction(law, self._friction_at(law, part.nodes, self._at))

    def take_load(self, at: float, known: bool = False) -> None:
        """Update friction to a load factor or a time, if it depends on these, and values of Functions (collective).

        Args:
            at: load factor, in dynamics the time.
            known: whether the committed state belongs to it; otherwise it applies from the next step on.
        """
        self._at = at
        if isinstance(self._offset, fem.Function) and self._offsets_of_pair().read_again(self._offset):
            self._set_offset()
            self.pair.project()
        if isinstance(self._friction, float) or not is_read_again(law := as_law(self._friction)):
            return
        value, friction = self._friction_at(law, self.pair.nodes, at), self.pair.friction
        assert value is not None and friction is not None
        if known or reduced(self.config.comm, not np.array_equal(value, friction.value), op=MPI.LOR):
            self.pair.set_friction(law, value, known)

    def ramp_friction(self, law: Field | FrictionLaw, known: bool, at: float = 0.0) -> None:
        """Take friction that depends on the load factor, which is ``at``; ``known`` as in ``take_load`` (collective)."""
        self._at = at
        if known:
            self._friction = law
        else:
            self.friction = law

    def friction_values(self) -> Array:
        """Friction parameters at this rank's contactors; empty without friction."""
        return np.zeros(0) if self.pair.friction is None else self.pair.friction.value

    def _friction_at(self, law: FrictionLaw, nodes: Indices, at: float) -> Array | None:
        """Values of a law's parameter at contactors ``(n,)`` after a placement; None without friction (collective)."""
        T = None
        if isinstance(law.field, OfTemperature):
            from uem_dolfinx.contact.thermal.sides import mean_temperatures

            T = mean_temperatures(self.config, nodes, law.field.field, self.name, self._pair, self.heats)
        return values_at(law, self.config, nodes, self.name, self.contactor.dim > 0, at, T)

    def _friction_now(self, kinematics: Kinematics) -> Array | None:
        """Values at contactors after a placement ``(n,)``; None if they do not depend on it (collective)."""
        if isinstance(self._friction, float) or not isinstance((law := as_law(self._friction)).field, OfTemperature):
            return None
        return self._friction_at(law, self.pair.nodes, self._at)

    @property
    def offset(self) -> Field:
        """Additional thickness of both surfaces together; a change is valid from the next step on (collective)."""
        return self._offset

    @offset.setter
    def offset(self, value: Field) -> None:
        if not self.taken:
            self._offset = given_together(self, self._friction, given_field("offset", value))[1]
            return
        with agreed(self.config.comm):
            value = given_field("offset", value)
            if self.tied is True and value != 0.0:
                raise InputError(
                    f"contact '{self.name}': offset = {given.shown(value)} does not go with tied = True: leave it out"
                )
        given.alike(self.config.comm, f"contact '{self.name}'", offset=value)
        self._offset = value
        self._set_offset()
        self.pair.project()

    def _set_offset(self) -> None:
        """Set the present offset in the pair, if an offset is or was in use (collective)."""
        if self._offsets is not None or callable(self._offset) or self._offset != 0.0:
            self._offsets_of_pair().set(self._offset)
        for part in self.further:
            part._set_offset()
            part.pair.project()

    def _offsets_of_pair(self) -> Offsets:
        """Offsets of the pair's gaps, made at the first call."""
        if self._offsets is None:
            from uem_dolfinx.contact.offsets import Offsets

            self._offsets = Offsets(self.pair, self.name)
        return self._offsets

    def words(self) -> dict[str, str]:
        """Settings of tie and normal contact, which must be equal when a checkpoint is resumed."""
        words = {"tied and adjust": f"{self.tied}, {self.adjust}"} if self.tied or self.adjust else {}
        laws = {"normal": self.normal, "cohesion": self.cohesion, "leak": self.leak}
        return words | {name: repr(law) for name, law in laws.items() if law is not None}

    def attach(
        self, config: Configuration, free: Bools, *, at: float = 0.0, duration: Callable[[], float] | None = None
    ) -> PartsOfPair:
        """Find what the pair of this contact is made of in a problem, see ``take_pair`` (collective).

        Args:
            config: configuration of the displacement.
            free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
            at: load factor, in dynamics the time.
            duration: length of the present step, a time; None in statics.

        Raises:
            InputError: if friction depends on the speed of slip, and steps have no duration.
            TagError, SpaceError: if a tag is empty, of the wrong dimension, or of another mesh.
            SurfaceError: if contactor and target share nodes, or a rigid target is of another dimension.
            UserFunctionError: from the functions of a rigid target.
            OrientationError: if a target facet lies inside a body.
        """
        self.config, self._at, facets = config, at, config.tdim - 1
        # reset data of a problem that failed during set-up
        self._pair, self._fields, _ = None, {}, self.__dict__.pop("surface", None)
        given.alike(
            config.comm, f"contact '{self.name}'", sliding=self.sliding, normals=self.normals, thickness=self.thickness,
            max_penetration=self.max_penetration, chords=self.chords, target=type(self.target).__name__,
            coupling=self.coupling if isinstance(self.coupling, str) else type(self.coupling).__name__,
            friction=parameters(as_law(self.friction)), measure=self.measure, tied=self.tied, adjust=self.adjust, offset=self.offset,
            wear=self._wear, corners=self.corners, edges=self.edges, normal=repr(self.normal), cohesion=repr(self.cohesion),
            leak=repr(self.leak), heat=[given.described(p) for one in self.heats for p in one.parameters.values()],
        )  # fmt: skip
        self.contactor = as_tag(self.contactor, config.mesh, (facets, 0), "contactor")
        nodes, target = self._sides(config)
        thickness = np.inf if self.thickness is None else self.thickness
        of: dict[str, Any] = {"name": self.name}
        of["max_penetration"] = MAX_PENETRATION * config.size if self.max_penetration is None else self.max_penetration
        discretisation, means = self._discretised(nodes, target, free=free, sliding=self.sliding, thickness=thickness)
        friction = self._sliding_of(nodes, discretisation, duration)
        tie = self._tie(nodes, discretisation, means, **of)
        warn_of_straight_facets(config, self.name, [tag for tag in (self.contactor, self.target) if isinstance(tag, Tag)])
        kind, heats = kind_of_interface(self, duration), partial(heats_of_kind, self) if self.heats else None
        alone = partial(kind, config, nodes, discretisation, friction, tie, heats=heats, **of)
        return PartsOfPair(alone, discretisation, friction, **of)

    def take_pair(self, pair: Interface) -> None:
        """Take the pair that has been made of its parts; tie it, and set its offsets (collective)."""
        self._pair, self._offsets = pair, None
        if pair.tie is not None and self.tied != "after":
            pair.project()
            pair.unite()
        if self.adjust and self.tied is not True:
            self._offsets_of_pair().adjust(self.adjust)
        self._set_offset()

    def _discretised(self, nodes: Indices, target: Target, **how: Any) -> tuple[Discretisation, Mortar | None]:
        """The discretisation, and the means for a tie, see ``Tie`` (collective)."""
        config = self.config
        # points have no facets to integrate over
        if self.coupling == "mortar" and self.contactor.dim > 0:
            from uem_dolfinx.contact.mortar.discretisation import Mortar

            surface = TargetFacets(config, self.contactor, "contactor")
            warn_of_slim_tips(config, self.name, surface)
            tied = (self.tied or getattr(self.cohesion, "bonds", False)) and target.n_nodes
            means = Mortar(config, nodes, target, surface=surface, **(how | {"sliding": "finite"})) if tied else None
            law = self.normal is not None or (self.cohesion is not None and not self.cohesion.bonds)
            return Mortar(config, nodes, target, surface=surface, of_gaps=law, **how), means
        from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface

        own: Any = self.coupling if callable(self.coupling) else NodeToSurface
        if config.degree == 2 and not callable(self.coupling):
            from uem_dolfinx.contact.nodes.bernstein import Bernstein

            own = Bernstein
        return own(config, nodes, target, chords=self.chords and config.degree == 2, contactor=self.contactor, **how), None

    @property
    def wears(self) -> bool:
        """Whether the contactor wears."""
        return callable(self._wear) or self._wear > 0.0

    def _sliding_of(self, nodes: Indices, discretisation: Discretisation, duration: Callable[[], float] | None) -> Sliding | None:
        """Friction of the interface, or None; with wear also for frictionless contact, to accumulate slip (collective)."""
        law = as_law(self.friction)
        value = self._friction_at(law, nodes, self._at)
        if value is None and not self.wears:
            return None
        from uem_dolfinx.contact.friction.limits import Limits
        from uem_dolfinx.contact.friction.sliding import Sliding

        if of_rate(law) and duration is None:
            raise InputError(
                f"contact '{self.name}': {type(law).__name__} needs the speed of slip, and statics has none: give the problem dynamics "
                "and take time steps, or take a law without speed"
            )
        return Sliding(
            self.config, nodes, discretisation, law=law, value=np.zeros(len(nodes)) if value is None else value,
            limits=Limits(lambda at: self.areas_facing(nodes, at, False), duration, self.name, self.config.X[nodes]),
            keeps_feet=self.sliding != "finite", value_now=self._friction_now, wear=wear_of(self, nodes) if self.wears else None,
        )  # fmt: skip

    _tie = tie_of  # permanent tie or bonds

    def tie(self, reach: float = 0.0) -> None:
        """Tie contactors permanently at their present position, from the next step on; others remain in contact.

        For contacts that were made with ``tied="after"``, between two steps: active contactors, and those across gaps up to ``reach``, a
        length (collective). InputError for any other contact, SurfaceError if there are none.
        """
        if self.tied != "after":
            raise InputError(f"contact '{self.name}': tie() is for contacts that are made with tied='after'")
        near = self.pair.kinematics.projection.gap <= given.number("reach", reach, given.NOT_NEGATIVE)
        self.pair.unite(self.pair.committed.active | (near & ~self.pair.off & (reach > 0.0)))
        self.pair.project()

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        """Owned contactor nodes and their target (collective)."""
        nodes = surface_nodes(config, self.contactor)
        if hasattr(self.target, "project"):
            from uem_dolfinx.geometry.shared_target import shared_target

            return nodes, shared_target(self.target, config.comm, config.gdim)
        self.target = as_tag(self.target, config.mesh, (config.tdim - 1,), "target")
        surface = facets_of(config, self.target)
        check_distinct(config, nodes, surface, (name_of(self.contactor), name_of(self.target)))
        return nodes, MeshTarget(surface, averaged=self.normals == "averaged")
