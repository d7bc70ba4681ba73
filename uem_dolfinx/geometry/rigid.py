"""Rigid targets: surfaces given by a signed distance and its gradient, which may move between load steps.

Any object with ``project(points) -> Projection`` is a target; rigid targets need no mesh and no communication.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.rigid_functions import OfPoints
from uem_dolfinx.parallel import ask


@dataclass(frozen=True)
class Motion:
    """Rigid motion from the reference to the current position: ``x = about + Q (X - about) + translation``."""

    translation: Array  # (gdim,)
    Q: Array  # (gdim, gdim)
    about: Array  # (gdim,), a point of the drawing

    def carry(self, X: Array) -> Array:
        """Current positions of reference points ``X (n, gdim)``."""
        return (X - self.about) @ self.Q.T + self.about + self.translation

    def back(self, x: Array) -> Array:
        """Reference positions of points that are now at ``x (n, gdim)``."""
        return (x - self.about - self.translation) @ self.Q + self.about

    def turn(self, v: Array) -> Array:
        """Vectors of the reference position, turned ``(n, gdim)``."""
        return v @ self.Q.T

    def since(self, before: Motion, part: float) -> Motion:
        """The last ``part`` of the motion since ``before``: of the displacement of ``about`` and of the rotation."""
        there = before.carry(self.about[None])[0]
        turn = part * rotation_vector(self.Q @ before.Q.T)
        at = there + (1.0 - part) * (self.about + self.translation - there)
        return Motion(self.about + self.translation - at, rotation_matrix(turn), at)

    @classmethod
    def none(cls, gdim: int) -> Motion:
        """No motion: the reference position."""
        return cls(np.zeros(gdim), np.eye(gdim), np.zeros(gdim))


@dataclass(frozen=True)
class RigidProjection:
    """Projection onto a rigid surface; fields as in ``projection.Projection``, without nodes."""

    gap: Array
    normal: Array
    nodes: Ints
    weights: Array
    facet: Ints
    beyond: Array
    points: Array  # projected points ``(n, gdim)``
    shape_operator: Array  # derivative of the normal in the tangent plane ``(n, gdim, gdim)``
    motion: Motion | None = None  # of the surface at the projection; None at its reference position
    offset: Array | None = None

    @property
    def height(self) -> Array:
        """Signed distance ``(n,)``."""
        return self.gap if self.offset is None else self.gap + self.offset

    @property
    def foot(self) -> Array:
        """Point of action of forces: the contactor, since a rigid surface has no nodes ``(n, gdim)``."""
        return self.points

    @property
    def facet_size(self) -> Array:
        """Infinite, since there are no facets."""
        return np.full(len(self.gap), np.inf)

    @property
    def way_beyond(self) -> Array:
        """Zero, since there is no open end."""
        return np.zeros(len(self.gap))

    @property
    def from_end(self) -> Array:
        """Infinite, since there is no open end."""
        return np.full(len(self.gap), np.inf)

    def hessians(self, which: Ints) -> Array:
        """Second derivative of the gap ``(k, gdim, gdim)``."""
        return self.shape_operator[which]

    def turnings(self, which: Ints, s: Array) -> Array:
        """Derivative of tangents ``s (k, gdim)``, which rotate with the normal ``(k, gdim, gdim)``."""
        return -np.einsum("kg,kh,khi->kgi", self.normal[which], s, self.shape_operator[which])

    def normal_slopes(self, which: Ints) -> Array:
        """Derivative of the normal ``(k, gdim, gdim)``."""
        return self.shape_operator[which]


class RigidSurface(given.Sealed):
    """Rigid target of any shape, fixed or moved as a rigid body.

    The gap is ``distance / |gradient|``, which vanishes on the surface and is the signed distance to first order; with a gradient
    of constant direction it is the distance along this direction. All functions refer to the reference position, also after the
    surface has been moved.

    Functions are called with points x of shape ``(3, n)``, as in DOLFINx, with z = 0 in 2D. Alternatively, all functions of a
    surface take points ``(n, gdim)`` and return one row per point; the shape returned by ``distance`` for five or more points
    decides.

    Args:
        distance: at points ``(3, n)``, positive outside ``(n,)``, a length.
        gradient: its gradient, pointing out of the target ``(gdim, n)``.
        hessian: its second derivative ``(gdim, gdim, n)``; None: differences of the gradient.
        name: for messages.
        reference: point about which it rotates and its moment is taken ``(gdim,)``; None is the origin.
        stride: largest motion of a contactor in a time step that cannot pass through it, a length; infinite for a solid without back.

    On each rank, the functions are called with the contactors of this rank, and not called without contactors.

    Raises:
        InputError, InputTypeError: with the argument that is no function, no finite point or no positive length.
    """

    n_nodes = 0
    averaged = faceted = False
    measures = False  #: Whether gaps are distances everywhere, not only on the surface.
    of_user = True  #: Whether functions are the user's, which may raise or return other shapes than required.
    dofs: Indices = np.zeros((0, 0), np.int32)
    keys: Ints = np.zeros(0, np.int64)

    def __init_subclass__(cls, **how: Any) -> None:
        super().__init_subclass__(**how)
        cls.of_user = cls.__module__ != __name__

    def __init__(
        self,
        distance: Callable[[Array], Array],
        gradient: Callable[[Array], Array],
        hessian: Callable[[Array], Array] | None = None,
        name: str = "rigid surface",
        reference: npt.ArrayLike | None = None,
        stride: float = np.inf,
    ):
        self.name = given.kind("name", name, isinstance(name, str), "a text")
        self.stride = given.number(f"{name}: stride", stride, given.POSITIVE_OR_INFINITE)
        for what, f in (("distance", distance), ("gradient", gradient), ("hessian", hessian)):
            optional = f is None and what == "hessian"
            given.kind(f"{name}: {what}", f, optional or given.function(f), "a function of places (3, n)")
        # functions of points (n, gdim) from here on
        of_points = OfPoints(distance).of if self.of_user else lambda f: f
        self.distance, self.gradient = of_points(distance), of_points(gradient)
        self.hessian = None if hessian is None else of_points(hessian)
        self.motion: Motion | None = None
        self._reference = None if reference is None else given.vector(f"{name}: reference", reference)
        #: Dimension of the arguments, None if only the functions determine it.
        self.gdim = None if self._reference is None else len(self._reference)

    def __repr__(self) -> str:
        """Its class, and the current position of its reference point."""
        if self.motion is None and self._reference is None:
            return f"{type(self).__name__}({self.name!r})"
        at = self.reference(self.gdim or 0)
        return f"{type(self).__name__}({self.name!r} at ({', '.join(f'{x:.6g}' for x in at)}))"

    def move(
        self, translation: npt.ArrayLike, rotation: npt.ArrayLike | None = None, about: npt.ArrayLike | None = None
    ) -> RigidSurface:
        """Set the motion of the surface from its reference position; replaces any earlier motion.

        Call it between load steps, usually from the function ``load`` of the problem: as a function of the load factor alone, the
        motion is then also correct in steps that are cut. Call it with the same values on all ranks.

        Args:
            translation: of the point ``about`` ``(gdim,)``.
            rotation: angle in 2D, counter-clockwise; rotation vector ``(3,)`` in 3D; None: no rotation.
            about: centre of rotation in the reference position ``(gdim,)``; None is the surface's reference point: point, centre or
                apex of the predefined surfaces.

        Returns:
            The surface itself.

        Raises:
            InputError, InputTypeError: with the argument that is not finite, or not of the surface's dimension.
        """
        t = given.vector(f"{self.name}: translation", translation, self.gdim)
        g = len(t)
        centre = self._reference if about is None else given.vector(f"{self.name}: about", about, g)
        centre = np.zeros(g) if centre is None else centre
        turn = np.zeros(1 if g == 2 else 3)
        if rotation is not None:
            of = "an angle in 2D" if g == 2 else "a rotation vector in 3D"
            turn = given.vector(f"{self.name}: rotation ({of})", rotation, len(turn))
        self.motion = Motion(t, rotation_matrix(turn), centre)
        return self

    def reference(self, gdim: int) -> Array:
        """Current position of the reference point, about which the surface rotates and its moment is taken ``(gdim,)``."""
        if self.motion is not None:
            return self.motion.about + self.motion.translation
        return np.zeros(gdim) if self._reference is None else self._reference

    def distance_of(self, points: Array) -> Array:
        """Values of ``distance`` at current positions ``(n, gdim)``: ``(n,)``."""
        return self.distance(points if self.motion is None else self.motion.back(points))

    def project(self, points: Array) -> RigidProjection:
        """Gap and normal at ``points (n, gdim)``.

        Raises:
            InputError: if the points are not of the dimension in which the surface was moved, or a function returns another shape.
            UserFunctionError: if a function raises.
        """
        n, g = points.shape
        motion = self.motion
        if motion is not None and len(motion.translation) != g:
            raise InputError(f"{self.name} was moved in {len(motion.translation)}D but is met by points in {g}D: move it in {g}D")
        X = points if motion is None else motion.back(points)
        slope = self._evaluated("gradient", self.gradient, X, (n, g))
        length = np.linalg.norm(slope, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            normal = slope / length[:, None]
            gap = self._evaluated("distance", self.distance, X, (n,)) / length
        shape_operator = self._shape_operator(X, normal, length)
        if motion is not None:
            normal, shape_operator = normal @ motion.Q.T, motion.Q @ shape_operator @ motion.Q.T
        return RigidProjection(
            gap, normal, np.zeros((n, 0), np.int64), np.zeros((n, 0)), np.zeros(n, np.int64), np.zeros((n, g)), points.copy(),
            shape_operator, motion,
        )  # fmt: skip

    def follow(self, points: Array, old: RigidProjection) -> RigidProjection:
        """Gaps in the tangent planes of an earlier projection, which move with the surface."""
        touched, normal, shape_operator = old.points, old.normal, old.shape_operator
        if self.motion is not old.motion:
            g = points.shape[1]
            still = Motion.none(g)
            then, now = old.motion or still, self.motion or still
            Q = now.Q @ then.Q.T
            touched, normal, shape_operator = now.carry(then.back(touched)), normal @ Q.T, Q @ shape_operator @ Q.T
        gap = old.height + np.einsum("ng,ng->n", normal, points - touched)
        return replace(
            old, gap=gap, offset=None, normal=normal, points=points.copy(), shape_operator=shape_operator, motion=self.motion
        )

    def continued(self, projection: RigidProjection, which: Ints, places: Array) -> RigidProjection:
        """Unchanged, since the surface has no end."""
        return projection

    def chords(self, projection: RigidProjection) -> Array:
        """The surface has no nodes ``(n, 0)``."""
        return projection.weights

    def keys_of(self, facet: Ints) -> Ints:
        """The surface has no facets to number."""
        return facet

    def facets_of(self, keys: Ints) -> Ints:
        """The surface has no facets to number."""
        return keys

    def _shape_operator(self, points: Array, normal: Array, length: Array) -> Array:
        """``t . grad^2 phi . t / |grad phi|`` in the tangent plane."""
        n, g = points.shape
        if self.hessian is not None:
            H = self._evaluated("hessian", self.hessian, points, (n, g, g))
        else:
            extent = np.abs(points).max(initial=0.0)
            h = np.cbrt(np.finfo(float).eps) * (extent if extent > 0 else 1.0)
            ahead, behind = (
                [self._evaluated("gradient", self.gradient, points + side * h * e, (n, g)) for e in np.eye(g)] for side in (1, -1)
            )
            H = (np.stack(ahead, axis=2) - np.stack(behind, axis=2)) / (2 * h)
            H = 0.5 * (H + H.transpose(0, 2, 1))
        T = np.eye(g) - normal[:, :, None] * normal[:, None, :]
        return T @ H @ T / length[:, None, None]

    def _evaluated(self, what: str, f: Callable[[Array], Array], points: Array, shape: tuple[int, ...]) -> Array:
        """Values of a function at ``points (n, gdim)``, which must have this shape; it is not called without points."""
        if not len(points):
            return np.zeros(shape)
        if not self.of_user:
            return f(points)
        values = ask(f"{self.name}: {what}", lambda x: np.asarray(f(x), dtype=float), points)
        if values.shape != shape:
            raise InputError(
                f"{self.name}: {what} returned the shape {values.shape} for points of the shape {points.shape}: expected {shape}, "
                "one row for each point, or for places of the shape (3, n) one column"
            )
        return values


class RigidPlane(RigidSurface):
    """Half-space behind a plane.

    Args:
        point: on the plane ``(gdim,)``.
        normal: out of the target ``(gdim,)``, of any length.
        name: for messages, files and ``GeneralContact.between``.
    """

    measures = True

    def __init__(self, point: npt.ArrayLike, normal: npt.ArrayLike, *, name: str = "rigid plane"):
        p = given.vector("rigid plane: point", point)
        n = given.direction("rigid plane: normal", normal, len(p))
        super().__init__(lambda x: (x - p) @ n, lambda x: n[None].repeat(len(x), axis=0), name=name, reference=p)

    def _shape_operator(self, points: Array, normal: Array, length: Array) -> Array:
        """A plane is not curved."""
        return np.zeros((len(points), points.shape[1], points.shape[1]))


class RigidSphere(RigidSurface):
    """Ball (a disc in 2D), or the space around it.

    Args:
        center: ``(gdim,)``.
        radius: a length.
        inside: the target is the space around the ball, and bodies touch it from inside.
        name: as of a ``RigidPlane``.
    """

    measures = True

    def __init__(self, center: npt.ArrayLike, radius: float, inside: bool = False, *, name: str = "rigid sphere"):
        c, radius = given.vector("rigid sphere: center", center), given.length("rigid sphere: radius", radius)
        side = -1.0 if given.flag("rigid sphere: inside", inside) else 1.0

        def arm(x: Array) -> tuple[Array, Array]:
            r = np.linalg.norm(x - c, axis=1)
            return r, np.where(r[:, None] > 0, (x - c) / np.where(r > 0, r, 1.0)[:, None], np.eye(len(c))[0])

        def hessian(x: Array) -> Array:
            r, e = arm(x)
            return side * (np.eye(len(c)) - e[:, :, None] * e[:, None, :]) / np.where(r > 0, r, np.inf)[:, None, None]

        super().__init__(
            lambda x: side * (arm(x)[0] - radius), lambda x: side * arm(x)[1], hessian,
            name=name, reference=c, stride=radius,
        )  # fmt: skip


class RigidCylinder(RigidSurface):
    """Infinite circular cylinder in 3D, or the space around it.

    Args:
        point: a point on the axis ``(3,)``.
        axis: its direction ``(3,)``, of any length.
        radius: a length.
        inside: the target is the space around the cylinder, and bodies touch it from inside.
        name: as of a ``RigidPlane``.
    """

    measures = True

    def __init__(
        self, point: npt.ArrayLike, axis: npt.ArrayLike, radius: float, inside: bool = False, *, name: str = "rigid cylinder"
    ):
        a, p = given.direction("rigid cylinder: axis", axis, 3), given.vector("rigid cylinder: point", point, 3)
        radius, inside = given.length("rigid cylinder: radius", radius), given.flag("rigid cylinder: inside", inside)
        across = np.eye(3) - np.outer(a, a)
        # a sphere in the plane perpendicular to the axis
        ball = RigidSphere(np.zeros(3), radius, inside)

        def hessian(x: Array) -> Array:
            assert ball.hessian is not None
            return across @ ball.hessian((x - p) @ across) @ across

        super().__init__(
            lambda x: ball.distance((x - p) @ across), lambda x: ball.gradient((x - p) @ across), hessian,
            name=name, reference=p, stride=radius,
        )  # fmt: skip


class RigidParaboloid(RigidSurface):
    """Paraboloid of revolution ``z = r^2 / (2 radius)`` above its apex (a parabola in 2D), solid inside.

    Args:
        apex: ``(gdim,)``.
        axis: from the apex into the solid ``(gdim,)``, of any length.
        radius: radius of curvature at the apex, a length.
        name: as of a ``RigidPlane``.
    """

    def __init__(self, apex: npt.ArrayLike, axis: npt.ArrayLike, radius: float, *, name: str = "rigid paraboloid"):
        o, radius = given.vector("rigid paraboloid: apex", apex), given.length("rigid paraboloid: radius", radius)
        a = given.direction("rigid paraboloid: axis", axis, len(o))
        across = np.eye(len(o)) - np.outer(a, a)

        def distance(x: Array) -> Array:
            r = (x - o) @ across
            return np.einsum("ng,ng->n", r, r) / (2 * radius) - (x - o) @ a

        super().__init__(
            distance, lambda x: (x - o) @ across / radius - a, lambda x: np.tile(across / radius, (len(x), 1, 1)),
            name=name, reference=o,
        )  # fmt: skip


def rotation_matrix(turn: Array) -> Array:
    """Rotation by an angle ``(1,)`` in 2D, counter-clockwise, or by a rotation vector ``(3,)``: ``(gdim, gdim)``."""
    if len(turn) == 3:
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_rotvec(turn).as_matrix())
    c, s = np.cos(turn[0]), np.sin(turn[0])
    return np.array([[c, -s], [s, c]])


def rotation_vector(Q: Array) -> Array:
    """Inverse of ``rotation_matrix``: angle ``(1,)`` or rotation vector ``(3,)`` of at most half a turn, from ``Q (gdim, gdim)``."""
    if len(Q) == 3:
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_matrix(Q).as_rotvec())
    return np.array([np.arctan2(Q[1, 0], Q[0, 0])])
