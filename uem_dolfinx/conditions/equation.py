"""Declarations of linear equations between displacements of nodes: single equations, families, periodic surfaces.

They return ``GivenRows``, from which ``united_rows`` makes constraint equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.conditions.places import COINCIDENT, NEAR, described, global_nodes, middle_of, nodes_at, partners
from uem_dolfinx.errors import InputError, InputTypeError, SurfaceError
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Part, as_tag, name_of
from uem_dolfinx.parallel import agree, agreed, ask_together, gathered, reduced

Value: TypeAlias = "npt.ArrayLike | fem.Constant | Callable[[float], Any]"


@dataclass(frozen=True)
class GivenRows:
    """Equations ``sum_k c_k . u_k = b`` of this rank, each with its terms."""

    value: Ints  # number of the value b among the values of the declaration ``(m,)``
    row: Ints  # the equation that each term belongs to ``(k,)``
    node: Ints  # global node of each term ``(k,)``; the first node of an equation is its position in messages
    coefficients: Array  # c of each term ``(k, gdim)``

    def __len__(self) -> int:
        return len(self.value)

    @staticmethod
    def join(parts: Sequence[GivenRows]) -> GivenRows:
        """The equations of several lists, in this order; numbers of values are unchanged."""
        first = np.cumsum([0, *(len(p) for p in parts)])
        rows = [p.row + f for p, f in zip(parts, first)]
        others = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(GivenRows) if f.name != "row"}
        return GivenRows(row=np.concatenate(rows), **others)

    def select(self, which: npt.NDArray[np.bool_]) -> GivenRows:
        """The equations in a mask ``(m,)``, in the same order."""
        place, terms = np.cumsum(which) - 1, which[self.row]
        return GivenRows(self.value[which], place[self.row[terms]], self.node[terms], self.coefficients[terms])


class LinearEquations(Protocol):
    """Declaration of linear equations of a displacement.

    Attributes:
        b: right-hand side, which users may change between steps.
        firm: whether it is an error if an equation follows from earlier ones.
    """

    b: Any
    firm: bool

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """The equations (collective)."""

    def n_values(self, block: int) -> int:
        """Number of different right-hand sides."""


def rows_of(config: Configuration, equations: Sequence[LinearEquations]) -> list[GivenRows]:
    """This rank's rows of declared equations, one list for each (collective)."""
    return [one.rows(config, f"equations[{i}]") for i, one in enumerate(equations)]


class Equation(given.Sealed):
    """A linear equation between displacements of nodes: ``sum_k inner(c_k, u(place_k)) = b``.

        uem.Equation([(tags["tip"], (0, 1)), ((0.0, 1.0), (0, -2))])                       # u_y of the tip is twice that at (0, 1)
        uem.Equation([(tags["top"], (0, 1)), (tags["corner"], (0, -1))], b=0.0)            # the top stays level

    Pass equations to ``UnitedProblem(..., equations=[...])``; each eliminates one component of a node, without multipliers.

    Args:
        terms: pairs of a place and a vector ``c (gdim,)``. A place is a tag of a point, or of any part with one node, or the reference
            coordinates of a node. One place may have many nodes, e.g. a surface: then there is one equation for each of its nodes,
            except nodes of other terms.
        b: a number, a ``fem.Constant`` or a function of the load factor or time. A number, or a Constant that ``load`` does not set, is
            ramped with the Dirichlet values.

    Raises:
        InputError, InputTypeError: for terms or values of another form. When the problem is made also a TagError for invalid places,
            and a ConflictError for equations without a component to eliminate, or that follow from others or contradict them.
    """

    firm = True

    def __init__(self, terms: Sequence[tuple[Any, npt.ArrayLike]], b: Value = 0.0):
        expected = "a list of pairs, each of a place and a vector, as [(tags['tip'], (0, 1)), ((0.0, 1.0), (0, -1))]"
        given.kind("terms", terms, isinstance(terms, Sequence) and not isinstance(terms, str) and len(terms) > 0, expected)
        for i, term in enumerate(terms):
            given.kind(f"terms[{i}]", term, isinstance(term, Sequence) and len(term) == 2, "a pair of a place and a vector")
        self._terms = [(where, given.vector(f"the vector of terms[{i}]", c)) for i, (where, c) in enumerate(terms)]
        self.b = checked_value("b", b, 1)

    @property
    def places(self) -> list[Any]:
        """The places of its terms."""
        return [where for where, _ in self._terms]

    def n_values(self, block: int) -> int:
        """See ``LinearEquations``."""
        return 1

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """See ``LinearEquations``."""
        found, many = [], []
        for i, (where, c) in enumerate(self._terms):
            with agreed(config.comm):
                given.vector(f"the vector of terms[{i}] of {role}", c, config.block)
            nodes = nodes_at(config, where, f"the place of terms[{i}] of {role}")
            found.append(nodes)
            if reduced(config.comm, len(nodes)) > 1:
                many.append(i)
        if len(many) > 1:
            names = " and ".join(described(self._terms[i][0]) for i in many[:2])
            raise InputError(f"{role}: the places {names} have several nodes each: expected one such place at most; see periodic")
        family = many[0] if many else 0
        single = {i: global_nodes(config, nodes) for i, nodes in enumerate(found) if i != family}
        own = config.to_global(found[family])
        own = own[~np.isin(own, np.concatenate([np.zeros(0, np.int64), *single.values()]))] if many else own
        order = [family, *single]
        node = np.column_stack([own, *(np.full(len(own), single[i][0]) for i in single)])
        c = np.broadcast_to([self._terms[i][1] for i in order], (len(own), len(order), config.block))
        return _of_terms(np.zeros(len(own), dtype=np.int64), node, c)


class Periodic(given.Sealed):
    """Nodes of a surface that move like their images, as returned by ``periodic``."""

    firm = False

    def __init__(
        self, follower: Part, leader: Part, map: Callable[[Array], Array] | None, turn: npt.ArrayLike | None, jump: Value
    ):
        self._follower, self._leader = follower, leader
        self.places = [follower, leader]
        self._map = given.kind("map", map, map is None or given.function(map), "a function of places (n, gdim), or None")
        self.turn = None if turn is None else _rotation(turn)  # rotation of the components, or None
        self.b = checked_value("jump", jump, None)

    def followers(self, config: Configuration) -> Indices:
        """Owned nodes that follow (collective)."""
        return nodes_at(config, self._follower, "the follower of a periodic surface")

    def n_values(self, block: int) -> int:
        """See ``LinearEquations``."""
        return block

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """See ``LinearEquations``."""
        g, turn = config.block, self.turn
        with agreed(config.comm):
            if turn is not None and len(turn) != config.gdim:
                raise InputError(f"{role}: turn has the shape {turn.shape}: expected ({config.gdim}, {config.gdim})")
        # components of vectors rotate together with positions
        R = np.eye(g) if turn is None or not config.moves else turn
        follower = nodes_at(config, self._follower, f"the follower of {role}")
        leader = nodes_at(config, self._leader, f"the leader of {role}")
        x = config.X[follower]
        images = self._images(config, x, middle_of(config, leader) - middle_of(config, follower), role)
        self._check_sizes(config, len(follower), len(leader), role)
        there, distance, second = partners(config, images, leader)
        error, bad, double = None, distance > NEAR * second, second <= COINCIDENT * config.size
        if double.any():
            error = SurfaceError(
                f"{role}: the node at {config.describe(int(follower[np.argmax(double)]))} has several partners, as "
                f"'{name_of(self._leader)}' has several nodes at one place: give the surfaces of each body by themselves"
            )
        elif bad.any():
            i = int(np.argmax(np.where(bad, distance, -1.0)))
            place = ", ".join(f"{v:.6g}" for v in images[i])
            error = SurfaceError(
                f"{role}: the node at {config.describe(int(follower[i]))} has no partner: its image ({place}) is {distance[i]:.3g} away "
                f"from the nearest node of '{name_of(self._leader)}'. Expected matching meshes, as by gmsh's Periodic, and a map from the "
                "follower onto the leader; meshes that do not match are tied by Contact(..., tied=True)"
            )
        agree(config.comm, error)
        # a node on the axis is its own image
        node = np.column_stack([config.to_global(follower), there])
        n, distinct = len(node), node[:, 0] != node[:, 1]
        self._refuse_own_images(config, follower[~distinct], bool(distinct.any()), role)
        c = np.empty((n, g, 2, g))
        c[:, :, 0], c[:, :, 1] = np.eye(g), -R
        node = np.broadcast_to(node[:, None], (n, g, 2))
        value = np.broadcast_to(np.arange(g), (n, g))
        if self.turn is None:
            # without a rotation the equations of such a node are trivial
            c, node, value = c[distinct], node[distinct], value[distinct]
        return _of_terms(value.ravel(), node.reshape(-1, 2), c.reshape(-1, 2, g))

    def _images(self, config: Configuration, x: Array, shift: Array, role: str) -> Array:
        """Positions of the partners of followers at ``x (n, gdim)`` (collective)."""
        if self._map is not None:
            images = ask_together(config.comm, f"the map of {role}", self._map, x)
            with agreed(config.comm):
                images = given.returned(f"the map of {role}", images, f"finite positions of the shape {x.shape}")
                if images.shape != x.shape or not np.isfinite(images).all():
                    raise InputError(
                        f"the map of {role} returned an array of shape {images.shape}: expected finite ones of {x.shape}"
                    )
            return images
        return x @ self.turn if self.turn is not None else x + shift

    def _refuse_own_images(self, config: Configuration, own: Indices, others: bool, role: str) -> None:
        """Refuse followers that follow themselves, ``own (k,)``, if all do, or if they jump; without a rotation (collective)."""
        if self.turn is not None:
            return
        jumps = given.function(self.b) or bool(values_of("jump", self.b, None).any())
        lone, error = not reduced(config.comm, others, op=MPI.LOR), None
        if len(own) and (lone or jumps):
            error = SurfaceError(
                f"{role}: the node at {config.describe(int(own[0]))} of '{name_of(self._follower)}' is its own image on "
                f"'{name_of(self._leader)}', and would follow itself{'' if lone else ' with a jump'}: expected two surfaces, or a map "
                "from one onto the other"
            )
        agree(config.comm, error)

    def _check_sizes(self, config: Configuration, n_follower: int, n_leader: int, role: str) -> None:
        n = gathered(config.comm, np.array([n_follower, n_leader])).sum(axis=0)
        if n[0] != n[1]:
            raise SurfaceError(
                f"{role}: '{name_of(self._follower)}' has {n[0]} nodes, '{name_of(self._leader)}' {n[1]}: expected matching meshes, as by "
                "gmsh's Periodic; meshes that do not match are tied by Contact(..., tied=True)"
            )


def periodic(
    follower: Part,
    leader: Part,
    *,
    map: Callable[[Array], Array] | None = None,
    turn: npt.ArrayLike | None = None,
    jump: Value = 0.0,
) -> Periodic:
    """Equations ``u(x) = R u(map(x)) + jump`` for all nodes of a surface whose mesh matches the mesh of another surface.

        uem.periodic(tags["right"], tags["left"], jump=strain @ (L, 0.0))        # a periodic cell under a mean strain
        uem.periodic(tags["cut_2"], tags["cut_1"], turn=R)                        # a sector of a ring, R turns cut_1 into cut_2

    With periodicity in several directions, redundant equations at edges are dropped.

    Args:
        follower: surface whose nodes are eliminated.
        leader: surface that they follow, with the same number of nodes.
        map: maps positions ``(n, gdim)`` on the follower to positions on the leader. None: a translation by the distance of the
            surfaces, or, with a ``turn``, the inverse rotation about the origin.
        turn: rotation ``R (gdim, gdim)`` of the components; None for the identity.
        jump: a vector ``(gdim,)``, one number for a scalar field; numbers, a ``fem.Constant`` or a function of the load factor or time
            that returns them. Ramped as ``b`` of ``Equation``.

    Returns:
        An entry of ``UnitedProblem(..., equations=[...])``.

    Raises:
        InputError, InputTypeError: as in ``Equation``; SurfaceError, when the problem is made, for surfaces that do not match.
    """
    return Periodic(follower, leader, map, turn, jump)


def _of_terms(value: Ints, node: Ints, c: Array) -> GivenRows:
    """Rows of values ``(m,)`` with nodes ``(m, t)`` and vectors ``(m, t, gdim)``; terms at the same node are summed."""
    (m, t), g = node.shape, c.shape[-1]
    row = np.repeat(np.arange(m), t)
    # all terms of a node are added to its first term
    first = (node[:, :, None] == node[:, None, :]).argmax(axis=2)
    sums = np.zeros((m, t, g))
    np.add.at(sums, (row, first.ravel()), c.reshape(-1, g))
    kept = (first == np.arange(t)).ravel()
    return GivenRows(value, row[kept], node.ravel()[kept], sums.reshape(-1, g)[kept])


def _rotation(turn: npt.ArrayLike) -> Array:
    try:
        R = given.numbers(turn)
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence("turn", turn, "a rotation matrix")) from None
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not np.abs(R @ R.T - np.eye(len(R))).max() < NEAR:
        raise InputError(given.sentence("turn", turn, "a rotation matrix (gdim, gdim)"))
    return R


def checked_value(name: str, value: Any, size: int | None) -> Any:
    """An unchanged right-hand side, after a check: ``size`` numbers, None for 1, 2 or 3."""
    if not given.function(value):
        values_of(name, value, size)
    return value


def values_of(name: str, value: Any, size: int | None) -> Array:
    """Numbers ``(size,)`` of a right-hand side, 0 for zeros; InputTypeError or InputError if not finite or of another number."""
    words = "a finite number" if size == 1 else f"{size or '2 or 3'} finite numbers, one for each component"
    held = isinstance(value, fem.Constant)
    try:
        array = np.atleast_1d(given.numbers(value.value if held else value))
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence(name, value, f"{words}, a Constant, or a function of the load factor")) from None
    zero = not held and len(array) == 1 and not array.any()
    if array.ndim != 1 or not (len(array) in ((size,) if size else (1, 2, 3)) or zero) or not np.isfinite(array).all():
        remedy = "a single number has no direction" if array.shape == (1,) and np.isfinite(array[0]) else ""
        raise InputError(given.sentence(name, value.value if held else value, words, remedy))
    return np.zeros(size) if zero and size else array


class MeanMotion(given.Sealed):
    """The mean of a displacement component over a part: ``integral of inner(c, u) / integral of 1 = b``.

        uem.MeanMotion(tags["top"], (0, 1), b=-0.01)                    # the top is lowered by 0.01 in the mean, and stays free to bend

    Pass it to ``UnitedProblem(..., equations=[...])``, which eliminates one component of one node. The part carries the force evenly, as
    under a uniform traction along c. Several means of one part, as of its components, are several equations.

    Args:
        part: facets or cells, over which the mean is an integral, or points, over which it is a sum.
        c: direction of the component, a vector ``(gdim,)`` of any length.
        b: a number, a ``fem.Constant`` or a function of the load factor or time, ramped as ``b`` of ``Equation``.

    Raises:
        InputError, InputTypeError: for a vector or values of another form. When the problem is made also a TagError for an invalid part,
            and a ConflictError if conditions prescribe all of its nodes.
    """

    firm = True

    def __init__(self, part: Part, c: npt.ArrayLike, b: Value = 0.0):
        self._part, self._c = part, given.vector("c", c)
        self.b = checked_value("b", b, 1)

    @property
    def places(self) -> list[Any]:
        """Its part."""
        return [self._part]

    def n_values(self, block: int) -> int:
        """See ``LinearEquations``."""
        return 1

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """See ``LinearEquations``; all terms are on the first rank, which has one row (collective)."""
        with agreed(config.comm):
            c = given.vector(f"c of {role}", self._c, config.block)
        nodes = nodes_at(config, self._part, f"the part of {role}")
        weights = self._weights(config, role)[nodes]
        own = np.flatnonzero(weights != 0.0)
        every = config.comm.gather((config.to_global(nodes[own]), weights[own]), root=0)
        none = np.zeros(0, dtype=np.int64)
        node, weight = (np.concatenate(parts) for parts in zip(*every)) if every else (none, np.zeros(0))
        # the node of the largest weight is named in messages, and is eliminated if it is free
        order = np.argsort(-np.abs(weight), kind="stable")
        coefficients = (weight[order] / (weight.sum() or 1.0))[:, None] * c
        return GivenRows(np.zeros(min(len(node), 1), np.int64), np.zeros(len(node), np.int64), node[order], coefficients)

    def _weights(self, config: Configuration, role: str) -> Array:
        """Weights of all owned nodes in the mean, not divided by their sum ``(n_owned,)`` (collective)."""
        tdim = config.tdim
        tag = as_tag(self._part, config.mesh, (tdim - 1, *range(tdim + 1)), f"the part of {role}")
        if tag.dim < tdim - 1:
            return np.ones(config.n_owned)
        measure = (forms.surface_measure if tag.dim == tdim - 1 else forms.cell_measure)(config.mesh, tag.entities, {})
        V = compat.function_space(config.mesh, config.degree)
        found = forms.assemble_array(V, forms.form(revolved(ufl.TestFunction(V) * measure)))
        return np.asarray(found[: config.n_owned])
