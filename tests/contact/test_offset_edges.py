"""Convex edges of targets that an offset rounds: which offsets do, and the second derivative of the distance from them."""

import numpy as np
import pytest

from uem_dolfinx.geometry import projection
from uem_dolfinx.geometry.projection import FacetProjection


def nearest(point, x, at_vertex):
    """Foot of a point on the side y = 0 of a triangle, or on a line's first node: its distance, weights and foot."""
    if x.shape[1] == 2 or at_vertex:
        w = np.eye(len(x))[0]
    else:
        edge = x[1] - x[0]
        xi = (point - x[0]) @ edge / (edge @ edge)
        w = np.array([1.0 - xi, xi, 0.0])
    foot = w @ x
    return np.linalg.norm(point - foot), w, foot


def projected(point, x, at_vertex, normal):
    """The projection of one point, with the facet's own normal."""
    gdim = x.shape[1]
    fdim = gdim - 1
    g, w, foot = nearest(point, x, at_vertex)
    dN = np.concatenate([-np.ones((1, fdim)), np.eye(fdim)])
    zeros = np.zeros((1, gdim))
    return FacetProjection(
        gap=np.array([(point - foot) @ normal]), normal=normal[None], nodes=np.arange(gdim)[None], weights=w[None], facet=np.array([0]),
        beyond=zeros, from_end=np.array([np.inf]), xi=np.zeros((1, fdim)), foot=foot[None], averaged=zeros, x=x[None], dN=dN[None],
        ddN=np.zeros((1, gdim, fdim, fdim)), shape_operator=np.zeros((1, fdim, gdim)),
    )  # fmt: skip


SCENES = {
    "2D": (np.array([[0.0, 0.0], [1.0, 0.1]]), np.array([-0.05, 0.09]), True),
    "3D edge": (np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 1.0, 0.1]]), np.array([0.4, -0.03, 0.09]), False),
    "3D vertex": (np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 1.0, 0.1]]), np.array([-0.03, -0.04, 0.09]), True),
}


def normal_of(x):
    """Upward normal of a facet."""
    n = np.array([-x[1, 1], x[1, 0]]) if x.shape[1] == 2 else np.cross(x[1] - x[0], x[2] - x[0])
    return n / np.linalg.norm(n)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e3])
@pytest.mark.parametrize("scene", SCENES)
def test_hessian_of_the_way_from_an_edge(scene, scale):
    """It is what central differences of the distance say, at scales from nm to km."""
    x, point, at_vertex = SCENES[scene]
    x, point = scale * x, scale * point
    p = projected(point, x, at_vertex, normal_of(x)).across_edges(point[None], np.array([0.1 * scale]))
    assert p.gap[0] == pytest.approx(nearest(point, x, at_vertex)[0])
    q, h = np.concatenate([point, x.ravel()]), 1e-4 * scale

    def distance(q):
        return nearest(q[: len(point)], q[len(point) :].reshape(x.shape), at_vertex)[0]

    e = h * np.eye(len(q))
    H = [
        [(distance(q + a + b) - distance(q + a - b) - distance(q - a + b) + distance(q - a - b)) / (4 * h**2) for a in e]
        for b in e
    ]
    assert np.allclose(scale * p.hessians(np.array([0]))[0], scale * np.array(H), atol=1e-4)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e3])
@pytest.mark.parametrize(
    "offset, rounds", [(1e-15, False), (1e-10, False), (1e-4, False), (0.1, True), (-0.1, False), (0.01, False)]
)
def test_what_rounds_an_edge(scale, offset, rounds):
    """Offsets of the size of the distance do; much smaller ones, and wear on a point that is in front, do not."""
    x, point, _ = SCENES["2D"]
    x, point = scale * x, scale * point
    p = projected(point, x, True, normal_of(x))
    there = p.across_edges(point[None], np.array([offset * scale]))
    assert (there.normal != p.normal).any() == rounds


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e3])
@pytest.mark.parametrize(("away", "rounds"), [(1e-17, False), (1e-15, False), (1e-9, True)])
def test_points_on_their_feet(away, rounds, scale):
    """A point that is where its foot is, to rounding, keeps the facet's normal whatever its offset."""
    x, _, _ = SCENES["2D"]
    x, point = scale * x, scale * away * np.array([-0.8, 0.6])
    p = projected(point, x, True, normal_of(x))
    there = p.across_edges(point[None], np.array([0.1 * scale]))
    assert (there.normal != p.normal).any() == rounds


def test_small_arcs_round_when_the_bound_moves(monkeypatch):
    """The bound decides: an offset of 0.1 facets rounds no edge where the bound is 0.2."""
    x, point, _ = SCENES["2D"]
    monkeypatch.setattr(projection, "ROUNDS_AN_EDGE", 0.2)
    p = projected(point, x, True, normal_of(x))
    assert (p.across_edges(point[None], np.array([0.1])).normal == p.normal).all()
