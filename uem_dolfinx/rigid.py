"""Rigid targets: surfaces given by a signed distance and its gradient.

Anything with ``project(points) -> Projection`` is a target; these need no mesh and no communication.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Callable

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class RigidProjection:
    """Projection onto a rigid surface; fields as in ``search.Projection``, without nodes.

    Attributes:
        points: where it was taken ``(n, gdim)``.
        bend: derivative of the normal in the tangent plane ``(n, gdim, gdim)``.
    """

    gap: Array
    normal: Array
    nodes: Ints
    weights: Array
    facet: Ints
    beyond: Array
    points: Array
    bend: Array

    def with_gap(self, gap: Array) -> RigidProjection:
        """The same projection of points that have moved along the normal."""
        return replace(self, gap=gap)

    def hessians(self, which: Ints) -> Array:
        """Second derivative of the gap ``(k, gdim, gdim)``."""
        return self.bend[which]


class RigidSurface:
    """Rigid target of any shape.

    The gap is ``distance / |gradient|``, which is the signed distance wherever it is zero; a gradient of constant direction
    measures the gap along that direction.

    Args:
        distance: of points ``(n, gdim)``, positive outside ``(n,)``, a length.
        gradient: its gradient, pointing out of the target ``(n, gdim)``.
        hessian: its second derivative ``(n, gdim, gdim)``; None takes differences of the gradient.
        name: for messages.
    """

    n_nodes = 0

    def __init__(
        self,
        distance: Callable[[Array], Array],
        gradient: Callable[[Array], Array],
        hessian: Callable[[Array], Array] | None = None,
        name: str = "rigid surface",
    ):
        self.distance, self.gradient, self.hessian, self.name = distance, gradient, hessian, name

    def project(self, points: Array) -> RigidProjection:
        """Gap and normal at ``points (n, gdim)``."""
        n, g = points.shape
        slope = np.asarray(self.gradient(points), dtype=float).reshape(n, g)
        length = np.linalg.norm(slope, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            normal = slope / length[:, None]
            gap = np.asarray(self.distance(points), dtype=float).reshape(n) / length
        return RigidProjection(
            gap, normal, np.zeros((n, 0), np.int64), np.zeros((n, 0)), np.zeros(n, np.int64), np.zeros((n, g)), points.copy(),
            self._bend(points, normal, length),
        )  # fmt: skip

    def follow(self, points: Array, old: RigidProjection) -> RigidProjection:
        """Gaps in the tangent planes of an earlier projection."""
        gap = old.gap + np.einsum("ng,ng->n", old.normal, points - old.points)
        return RigidProjection(gap, old.normal, old.nodes, old.weights, old.facet, old.beyond, points.copy(), old.bend)

    def _bend(self, points: Array, normal: Array, length: Array) -> Array:
        """``t . grad^2 phi . t / |grad phi|`` in the tangent plane."""
        n, g = points.shape
        if self.hessian is not None:
            H = np.asarray(self.hessian(points), dtype=float).reshape(n, g, g)
        else:
            extent = np.abs(points).max(initial=0.0)
            h = np.cbrt(np.finfo(float).eps) * (extent if extent > 0 else 1.0)
            H = np.stack([(self.gradient(points + h * e) - self.gradient(points - h * e)) / (2 * h) for e in np.eye(g)], axis=2)
            H = 0.5 * (H + H.transpose(0, 2, 1))
        T = np.eye(g) - normal[:, :, None] * normal[:, None, :]
        return T @ H @ T / length[:, None, None]


class RigidPlane(RigidSurface):
    """Half-space behind a plane.

    Args:
        point: on the plane ``(gdim,)``.
        normal: out of the target ``(gdim,)``, of any length.
    """

    def __init__(self, point: npt.ArrayLike, normal: npt.ArrayLike):
        p, n = np.asarray(point, dtype=float), _unit(normal)
        super().__init__(
            lambda x: (x - p) @ n,
            lambda x: np.tile(n, (len(x), 1)),
            lambda x: np.zeros((len(x), len(n), len(n))),
            name="rigid plane",
        )


class RigidSphere(RigidSurface):
    """Ball (a disc in 2D), or the space around it.

    Args:
        center: ``(gdim,)``.
        radius: a length.
        inside: the target is the space around the ball, and bodies touch it from inside.
    """

    def __init__(self, center: npt.ArrayLike, radius: float, inside: bool = False):
        c, side = np.asarray(center, dtype=float), -1.0 if inside else 1.0

        def arm(x: Array) -> tuple[Array, Array]:
            r = np.linalg.norm(x - c, axis=1)
            e = np.where(r[:, None] > 0, (x - c) / np.where(r > 0, r, 1.0)[:, None], np.eye(len(c))[0])
            return r, e

        def hessian(x: Array) -> Array:
            r, e = arm(x)
            return side * (np.eye(len(c)) - e[:, :, None] * e[:, None, :]) / np.where(r > 0, r, np.inf)[:, None, None]

        super().__init__(lambda x: side * (arm(x)[0] - radius), lambda x: side * arm(x)[1], hessian, name="rigid sphere")


class RigidCylinder(RigidSurface):
    """Endless round cylinder in 3D, or the space around it.

    Args:
        point: on the axis ``(3,)``.
        axis: its direction ``(3,)``, of any length.
        radius: a length.
        inside: the target is the space around the cylinder, and bodies touch it from inside.
    """

    def __init__(self, point: npt.ArrayLike, axis: npt.ArrayLike, radius: float, inside: bool = False):
        a, p = _unit(axis), np.asarray(point, dtype=float)
        across = np.eye(3) - np.outer(a, a)
        # in the plane across the axis it is a sphere
        ball = RigidSphere(np.zeros(3), radius, inside)

        def hessian(x: Array) -> Array:
            assert ball.hessian is not None
            return across @ ball.hessian((x - p) @ across) @ across

        super().__init__(
            lambda x: ball.distance((x - p) @ across),
            lambda x: ball.gradient((x - p) @ across),
            hessian,
            name="rigid cylinder",
        )


class RigidParaboloid(RigidSurface):
    """Paraboloid of revolution ``z = r^2 / (2 radius)`` above its apex (a parabola in 2D), solid inside.

    Args:
        apex: ``(gdim,)``.
        axis: from the apex into the solid ``(gdim,)``, of any length.
        radius: radius of curvature at the apex, a length.
    """

    def __init__(self, apex: npt.ArrayLike, axis: npt.ArrayLike, radius: float):
        o, a = np.asarray(apex, dtype=float), _unit(axis)
        across = np.eye(len(o)) - np.outer(a, a)

        def distance(x: Array) -> Array:
            r = (x - o) @ across
            return np.einsum("ng,ng->n", r, r) / (2 * radius) - (x - o) @ a

        super().__init__(
            distance,
            lambda x: (x - o) @ across / radius - a,
            lambda x: np.tile(across / radius, (len(x), 1, 1)),
            name="rigid paraboloid",
        )


def _unit(v: npt.ArrayLike) -> Array:
    a = np.asarray(v, dtype=float)
    length = np.linalg.norm(a)
    if not length > 0:
        raise ValueError(f"direction {a} has no length: give a non-zero vector")
    return a / length
