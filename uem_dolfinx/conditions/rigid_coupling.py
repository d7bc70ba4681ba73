"""Declarations of a surface or body that moves rigidly with a point, or of a load at a point that is distributed over a surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.constantvalue import ConstantValue
from ufl.core.expr import Expr
from ufl.core.multiindex import MultiIndex
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx import given
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.conditions.equation import Value, checked_value, values_of
from uem_dolfinx.conditions.places import is_point, nodes_at
from uem_dolfinx.conditions.rigid_set import RigidSet, moments
from uem_dolfinx.errors import InputError, InputTypeError, SpaceError, SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Part, name_of
from uem_dolfinx.parallel import agreed, ask_together, reduced


class RigidCoupling(given.Sealed):
    """Nodes of a surface or body that move with a point as one rigid body, or over which a load at the point is distributed.

        uem.RigidCoupling(tags["end"], (10.0, 0.5), force=(0.0, -3.0), moment=12.0)
        uem.RigidCoupling(tags["wheel"], (0.0, 0.0), motion=(0.0, 0.0, None))               # on a bearing, free to turn
        uem.RigidCoupling(tags["pad"], (0.0, 0.0, 2.0), force=(0.0, 0.0, -5.0), distribute=True)
        uem.RigidCoupling(tags["flange"], (3.0, 0.0), mass=2.0, inertia=0.5)                # a motor, in dynamics

    Pass it to ``UnitedProblem(..., couplings=[...])``. The 3 unknowns in 2D and 6 in 3D are components of nodes of the part; all its
    other components are eliminated, without multipliers.

    Args:
        where: tag of facets, of cells or of any entities with nodes that are not on one line.
        point: reference position ``(gdim,)``; a node there is not needed.
        force: at the point, a vector ``(gdim,)``; numbers, a ``fem.Constant`` or a function of the load factor or time.
        moment: about the point, a number in 2D, a vector ``(3,)`` in 3D; numbers, a ``fem.Constant`` or a function, as ``force``.
        motion: displacement of the point and its rotation, each a number, a ``fem.Constant``, a function of the load factor or time, or
            None if free: ``(u_x, u_y, angle)`` in 2D, ``(u_x, u_y, u_z, r_x, r_y, r_z)`` in 3D, with r the rotation vector in radians.
            Numbers are ramped with the Dirichlet values. None leaves all components free. A value may also be a UFL expression of
            Constants and of the place, which is the point.
        mass: of a rigid body that is fixed to the part and has its centre at the point, in addition to the mass of the meshed part.
            It counts in dynamics, with gravity, and in ``modes``; statics ignores it.
        inertia: of that body about the point: a number in 2D, a number for all axes or a symmetric matrix ``(3, 3)`` in 3D, in the
            axes of the reference configuration; it rotates with the part.
        distribute: distribute force and moment over the nodes without stiffening the part; the point has the mean motion of the nodes.
        rotations: ``"large"``, ``"small"``, or None for small rotations if the residual is linear in the displacement.

    Attributes:
        name: name of the part.
        point: as given ``(gdim,)``.

    Raises:
        InputError, InputTypeError: for values of another form, an impossible inertia, or a motion or a mass with
            ``distribute=True``. When the problem is made also a TagError for invalid parts, and a SurfaceError for nodes on
            one line.
    """

    def __init__(
        self,
        where: Part,
        point: npt.ArrayLike,
        *,
        force: Value = 0.0,
        moment: Value = 0.0,
        motion: Sequence[Value | None] | None = None,
        mass: float = 0.0,
        inertia: npt.ArrayLike = 0.0,
        distribute: bool = False,
        rotations: Literal["large", "small"] | None = None,
    ):
        self.where, self.name = where, "a point" if is_point(where) else name_of(where)
        self.point = given.vector("point", point)
        g = len(self.point)
        self._sizes = g, 1 if g == 2 else 3
        loads = {"force": checked_value("force", force, g), "moment": checked_value("moment", moment, self._sizes[1])}
        self.distribute = given.flag("distribute", distribute)
        self._rotations = rotations if rotations is None else given.word("rotations", rotations, ("large", "small"))
        n, words = sum(self._sizes), "None where it is free and a value elsewhere"
        motion = [None] * n if motion is None else motion
        is_list = isinstance(motion, Sequence) and not isinstance(motion, str)
        given.kind("motion", motion, is_list, f"a list of {n} items, {words}")
        if len(motion) != n:
            raise InputError(given.sentence("motion", motion, f"{n} items, {words}"))
        self._shown = {"motion": motion if any(one is not None for one in motion) else None, "inertia": inertia}
        #: Values of the prescribed components by their number.
        self.prescribed = {i: _checked_motion(f"motion[{i}]", v) for i, v in enumerate(motion) if v is not None}
        #: Force, moment and prescribed motion as declared, by name.
        self._declared: dict[str, Any] = loads | {f"motion[{i}]": v for i, v in self.prescribed.items()}
        if self.distribute and self.prescribed:
            raise InputError(
                "motion of a RigidCoupling with distribute=True: the mean motion of a part that deforms cannot be prescribed; leave "
                "distribute out, or prescribe displacements"
            )
        self.mass = given.number("mass", mass, given.NOT_NEGATIVE)
        #: About the point, in the reference configuration ``(n_turns, n_turns)``.
        self.inertia = checked_inertia(inertia, self._sizes[1])
        if self.distribute and (self.mass or self.inertia.any()):
            raise InputError(
                "mass or inertia of a RigidCoupling with distribute=True: only a part that moves rigidly carries them; leave distribute "
                "out, or give the part more density"
            )
        self.added: Any = None  #: The ``dynamics.added_mass.AddedMass`` of mass and inertia in a problem, or None.
        #: Last known rotation, which determines the number of full turns ``(n_turns,)``.
        self.turns: Array = np.zeros(self._sizes[1])
        #: Force and moment of the prescribed motion, as last computed.
        self.reactions: tuple[Array, Array] = np.zeros(self._sizes[0]), np.zeros(self._sizes[1])
        #: Joints and springs that it takes part in.
        self.links: list[Any] = []
        self._set: RigidSet | None = None
        self.evaluated: dict[str, Any] = {}  #: Last values of functions of the load factor or time, by name.

    # -- in a problem ------------------------------------------------------------------------------------------------------

    def attach(self, config: Configuration, finite: bool) -> RigidSet:
        """Find the nodes in a problem, whose residual is nonlinear if ``finite`` (collective)."""
        if self._set is not None:
            raise SpaceError(f"the RigidCoupling of '{self.name}' belongs to another problem: make a new one for every problem")
        with agreed(config.comm):
            given.vector("the point of a RigidCoupling", self.point, config.gdim)
            if config.axisymmetric:
                raise InputError(f"the RigidCoupling of '{self.name}': there are none on axisymmetric meshes; use Equation")
        nodes = nodes_at(config, self.where, f"the part of the RigidCoupling of '{self.name}'")
        large = finite if self._rotations is None else self._rotations == "large"
        self._set = RigidSet(config, nodes, self.point, large)
        arms = self._set.X - self._set.middle
        spread = reduced(config.comm, arms.T @ arms)
        sizes = np.linalg.eigvalsh(spread)
        if not sizes[-1] > 0 or (config.gdim == 3 and np.sqrt(max(sizes[-2], 0.0) / sizes[-1]) < MOSTLY_PRESCRIBED):
            raise SurfaceError(
                f"the RigidCoupling of '{self.name}': its {self._set.count} nodes lie on a line or at one point, so that its "
                "rotation is undetermined: expected at least two nodes in the plane, three that are not on a line in space"
            )
        return self._set

    @property
    def nodes(self) -> RigidSet:
        """The nodes in its problem; SpaceError if it belongs to no problem."""
        if self._set is None:
            raise SpaceError(
                f"the RigidCoupling of '{self.name}' is in no problem yet: pass it to UnitedProblem(..., couplings=[...])"
            )
        return self._set

    def belongs_to(self, config: Configuration) -> bool:
        """Whether it is in the problem of a configuration."""
        return self._set is not None and self._set.config is config

    def take_load(self, at: float) -> None:
        """Evaluate functions at a load factor or time; UserFunctionError if a function raises (collective)."""
        comm = self.nodes.config.comm
        for name, value in self._declared.items():
            if given.function(value):
                words = f"the {name} of the RigidCoupling of '{self.name}' at {at:.6g}"
                self.evaluated[name] = ask_together(comm, words, value, at)

    def values_given(self) -> list[Any]:
        """Force, moment and prescribed motion as declared."""
        return list(self._declared.values())

    def given_values(self) -> dict[str, Any]:
        """Its present values by name; functions are replaced by their last values."""
        values = self._declared | self.evaluated
        now = {f"the {name}": _number(value, self.point) for name, value in values.items()}
        return {"the point": self.point, "the mass": self.mass, "the inertia": self.inertia, **now}

    def _values(self, name: str, size: int) -> Array:
        """Present numbers ``(size,)`` of the force, the moment or a component of the motion."""
        value = _number(self.evaluated.get(name, self._declared[name]), self.point)
        return values_of(f"{name} of the RigidCoupling of '{self.name}'", value, size)

    def loads(self) -> tuple[Array, Array]:
        """Present force ``(gdim,)`` and moment ``(n_turns,)`` at the point (collective)."""
        with agreed(self.nodes.config.comm):
            return self._values("force", self._sizes[0]), self._values("moment", self._sizes[1])

    def linked_load(self) -> tuple[Array, Array]:
        """Force and moment of springs at the point (collective)."""
        found = [link.load_on(self) for link in self.links if link.stiffness]
        return sum((f for f, _ in found), np.zeros(self._sizes[0])), sum((m for _, m in found), np.zeros(self._sizes[1]))

    def nodal_forces(self, springs: bool = True) -> Array:
        """Nodal forces of ``loads`` and of springs at the owned nodes of the part ``(n, gdim)`` (collective)."""
        config, (force, moment) = self.nodes.config, self.loads()
        if springs and self.links:
            more = self.linked_load()
            force, moment = force + more[0], moment + more[1]
        return self.nodes.spread(config.displacement[: config.n_owned], force, moment)

    def wanted(self) -> Array:
        """Present values of the prescribed components ``(k,)``, in the order of ``prescribed`` (collective)."""
        with agreed(self.nodes.config.comm):
            return np.array([self._values(f"motion[{i}]", 1)[0] for i in self.prescribed], dtype=float)

    def motion_of(self, u: Array, near: Array | None = None) -> Array:
        """Displacement of the point and rotation ``(gdim + n_turns,)``, from a displacement ``(n_owned, gdim)`` (collective).

        ``near (n_turns,)`` is a rotation that determines the number of full turns; None for the last known rotation.
        """
        at = self.nodes.placement(u)
        shift = at.displacement(self.point[None])[0]
        return np.append(shift, at.turn if at.small is not None else nearest_turn(at.turn, self.turns if near is None else near))

    def mark(self, config: Configuration, rigid: Bools) -> None:
        """Mark the owned nodes ``(n_owned,)`` of a problem that move as one rigid body (collective)."""
        if not self.distribute:
            rigid[nodes_at(config, self.where, f"the part of the RigidCoupling of '{self.name}'")] = True

    # -- results -----------------------------------------------------------------------------------------------------------

    @property
    def _motion(self) -> Array:
        config = self.nodes.config
        return self.motion_of(config.displacement[: config.n_owned])

    @property
    def displacement(self) -> Array:
        """Displacement of the point ``(gdim,)`` (collective)."""
        return self._motion[: self._sizes[0]]

    @property
    def rotation(self) -> Any:
        """Angle in 2D, rotation vector ``(3,)`` in 3D, in radians, including full turns (collective)."""
        turn = self._motion[self._sizes[0] :]
        return float(turn[0]) if len(turn) == 1 else turn

    @property
    def reaction(self) -> tuple[Array, Any]:
        """Force ``(gdim,)`` and moment about the point of the prescribed motion on the part; zero for free components."""
        # raises without a problem
        _, (force, moment) = self.nodes, self.reactions
        return force, float(moment[0]) if len(moment) == 1 else moment

    def read_reactions(self, forces: Array, *of_joints: Array) -> None:
        """Compute the reactions of the prescribed motion (collective).

        Args:
            forces: of the coupling's equations at the owned nodes ``(n_owned, gdim)``.
            of_joints: force ``(gdim,)`` and moment ``(n_turns,)`` of joints among them, at the point.
        """
        config, own = self.nodes.config, forces[self.nodes.nodes]
        at = self.nodes.placement(config.displacement[: config.n_owned])
        if self.nodes.large:
            arms = self.nodes.X + config.displacement[self.nodes.nodes] - self.point - at.displacement(self.point[None])
        else:
            arms = self.nodes.X - self.point
        sums = reduced(config.comm, np.append(own.sum(axis=0), moments(arms, own).sum(axis=0)))
        held = np.isin(np.arange(len(sums)), list(self.prescribed))
        sums = np.where(held, sums - np.concatenate(of_joints), 0.0)
        self.reactions = sums[: self._sizes[0]], sums[self._sizes[0] :]


def _composed(value: Any) -> bool:
    """Whether a value is an expression of UFL, and more than a Constant."""
    return isinstance(value, Expr) and not isinstance(value, fem.Constant)


def _checked_motion(name: str, value: Any) -> Any:
    """A component of a motion, unchanged; an expression contains Constants and the place alone."""
    if not _composed(value):
        return checked_value(name, value, 1)
    parts = (one for one in traverse_unique_terminals(value) if not isinstance(one, (ConstantValue, MultiIndex)))
    if value.ufl_shape or any(not isinstance(one, (fem.Constant, ufl.SpatialCoordinate)) for one in parts):
        raise InputTypeError(given.sentence(name, value, "a scalar expression of Constants and of the place alone"))
    return value


def _number(value: Any, point: Array) -> Any:
    """The value of an expression at a point, and other values as they are."""
    if not _composed(value):
        return value
    constants = (one for one in traverse_unique_terminals(value) if isinstance(one, fem.Constant))
    return float(value(tuple(point), {one: one.value.item() if one.value.ndim == 0 else one.value for one in constants}))


def checked_inertia(value: npt.ArrayLike, n_turns: int) -> Array:
    """Inertia ``(n_turns, n_turns)``; InputError or InputTypeError if a principal moment is negative or exceeds the sum of the others."""
    if given.symbolic(value) or np.ndim(value) == 0:
        return np.eye(n_turns) * given.number("inertia", value, given.NOT_NEGATIVE)
    words = "a number" if n_turns == 1 else "a number, or a symmetric matrix of 3 rows"
    try:
        found = given.numbers(value)
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence("inertia", value, words)) from None
    if n_turns == 1 or found.shape != (3, 3) or not np.isfinite(found).all():
        raise InputError(given.sentence("inertia", value, words))
    rounding = found.size * np.finfo(float).eps * np.abs(found).max()
    if (np.abs(found - found.T) > rounding).any():
        raise InputError(given.sentence("inertia", value, "a symmetric matrix"))
    found = 0.5 * (found + found.T)
    moments = np.linalg.eigvalsh(found)
    if moments[0] < -rounding or 0.5 * moments.sum() - moments[-1] < -rounding:
        expected = f"principal moments {moments} that are not negative, and none more than the sum of the others"
        raise InputError(given.sentence("inertia", value, expected, "no body has such an inertia"))
    return np.asarray(found)


def nearest_turn(turn: Array, known: Array) -> Array:
    """The rotation by ``turn (n_turns,)`` plus full turns that is nearest to a known rotation."""
    angle = float(np.linalg.norm(turn)) if len(turn) == 3 else float(turn[0])
    if len(turn) == 1:
        return turn + 2.0 * np.pi * np.round((known[0] - angle) / (2.0 * np.pi))
    if angle == 0.0:
        axis = known / size if (size := np.linalg.norm(known)) > 0 else known
        return np.asarray(axis * 2.0 * np.pi * np.round(known @ axis / (2.0 * np.pi)))
    axis = turn / angle
    return np.asarray(axis * (angle + 2.0 * np.pi * np.round((known @ axis - angle) / (2.0 * np.pi))))
