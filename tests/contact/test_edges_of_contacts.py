"""Edges of a contact of two surfaces that cross: a further part of it, with the forces of general contact.

Read first: ``test_one_force_wherever_the_nodes_are``.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.scenes import box
from block_scenes import st_venant
from body_scenes import fork, skin_of
from edge_scenes import COMM, continues_from_checkpoints, crossed, folded, rods, roofs, turned
from helpers import at, coulomb, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx.contact.general.edges import crossings_of
from uem_dolfinx.geometry.neighbours import Neighbours

#: All of the outside of both bodies, or the faces that meet.
OUTSIDE = [lambda x: x[:, 0] > -1e9] * 2
FACES = [at(2, 0.0)] * 2
OBLIQUE = {"length": 12.0, "angle": 1.0, "along": (0.7, 1.3), "way": (0.1, 0.2, -0.3), "law": st_venant}


def side(force):
    """Force across z over the force along it."""
    return np.hypot(*force[:2]) / abs(force[2])


def boxes(n, angle=0.25 * np.pi, **how):
    """A box on another one, turned by an angle, with n cells along a side (collective)."""
    held = [at(2, -1.0), at(2, 1.0)]
    low, high = (box("hexahedron", (-1.0, -1.0, k - 1.0), (1.0, 1.0, k), (n, n, n // 2)) for k in (0.0, 1.0))
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    r = crossed("hexahedron", [low, high.mapped(lambda x: x @ turn)], held, (0.0, 0.0, -0.02), edges=True, **how)
    run(r.problem)
    return r


@pytest.mark.parametrize("on_edge", [True, slow(False)])
def test_one_force_wherever_the_nodes_are(on_edge):
    """Two rods across each other: with nodes at the crossing and between nodes, on either rod, one force, along z alone."""
    forces = []
    for n in ((24, 24), (25, 25), (24, 25)):
        r = rods(n, length=12.0, on_edge=on_edge, surfaces=OUTSIDE, edges=True, corners=True)
        run(r.problem)
        assert r.n_crossings == (1 if on_edge else 4)
        assert side(r.force) < 1e-3
        forces.append(r.force[2])
    assert np.ptp(forces) < 0.01 * abs(forces[0])


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"R": turned(1)}, {"first": 0}, {"size": 1e-9}, {"size": 1e3}])
@pytest.mark.parametrize("friction", [0.3, 0.0])
def test_in_any_pose_size_and_order(friction, how):
    """The force of general contact, turned with the scene, in nanometres and kilometres, and whichever body has the contactors."""
    r, general = (
        rods((11, 12), friction=friction, surfaces=OUTSIDE, edges=True, **OBLIQUE, **how),
        rods((11, 12), friction=friction, **OBLIQUE),
    )
    steps = run(r.problem, 2)
    run(general.problem, 2)
    assert r.n_crossings == 1 and max(len(step.iterations) for step in steps) <= 6
    force = r.force / how.get("size", 1.0) ** 2
    assert np.abs(force - general.force).max() < 1e-6 * np.abs(general.force).max()


@pytest.mark.long
@pytest.mark.parametrize("general", [True, slow(False)])
@pytest.mark.parametrize("friction", [0.0, slow(0.3)])
def test_ridges_by_mortar(friction, general):
    """Facets near a crossing of ridges do not touch: integrals add nothing to the forces that nodes have, with nodes there or not."""
    how = {"surfaces": None if general else OUTSIDE, "edges": True, "friction": friction}
    for shift in ((0.0, 0.0), (0.1, 0.15)):
        found = []
        for coupling in ("mortar", "node_to_surface"):
            r = roofs(shift=shift, coupling=coupling, **how)
            run(r.problem)
            assert r.n_crossings == 1
            found.append(r.force)
        assert found[0] == pytest.approx(found[1], rel=1e-7, abs=1e-7 * abs(found[1][2]))


@pytest.mark.slow
def test_a_box_on_a_box_by_mortar():
    """Turned by 45 degrees, with nodes at the crossings and without, facets touch up to them: the force of nodes to 1 %, none sideways."""
    for n in (6, 7):
        for surfaces in (FACES, None):
            r = boxes(n, coupling="mortar", surfaces=surfaces)
            assert r.n_crossings == 0 and side(r.force) < 1e-12
            assert r.force[2] == pytest.approx(boxes(n, surfaces=FACES, corners=True).force[2], rel=0.01)


@pytest.mark.parametrize("shift", [(0.0, 0.0), slow((0.25, 0.25)), slow((0.1, 0.15))])
def test_roofs(shift):
    """Ridge over ridge: nodes alone have a force sideways of 43 % where both ridges have a node."""
    r = roofs(shift=shift, surfaces=OUTSIDE, edges=True)
    run(r.problem)
    assert r.n_crossings == 1 and r.force[2] < 0.0 and side(r.force) < (0.03 if shift[0] == 0.1 else 4e-3)


@pytest.mark.slow
def test_a_box_on_a_box():
    """Turned by 45 degrees: of the faces that meet alone, with edges at which these end; forces by meshes within 1 %, none sideways."""
    forces = []
    for n in (7, 8):
        r = boxes(n, surfaces=FACES, corners=True)
        assert r.n_crossings == 8 and side(r.force) < 1e-9
        forces.append(r.force[2])
    assert np.ptp(forces) < 0.01 * abs(forces[0])


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, slow(0.2)])
def test_results_are_of_all_parts(friction):
    """Forces on either side, their moments, the sum of normal forces, slip's work, and the force of the supports."""
    how = OBLIQUE | {"way": (0.8, 0.3, -0.3)}
    r = rods((11, 12), on_edge=False, friction=friction, surfaces=OUTSIDE, edges=True, corners=True, **how)
    run(r.problem, 2)
    contact, config = r.contact, r.problem.config
    n, whole = config.n_owned, contact.resultant((0.1, 0.2, 0.3))
    back = contact.resultant((0.1, 0.2, 0.3), on="target")
    assert np.abs(whole.force + back.force).max() < 1e-12 and np.abs(whole.moment + back.moment).max() < 1e-11
    for which, found in (("contactor", whole), ("target", back)):
        f = contact.force_on(which).x.array[: 3 * n].reshape(-1, 3)
        assert np.abs(COMM.allreduce(f.sum(axis=0)) - found.force).max() < 1e-12
        turning = COMM.allreduce(np.cross(config.x[:n] - (0.1, 0.2, 0.3), f).sum(axis=0))
        assert np.abs(turning - found.moment).max() < 1e-10
    balance = contact.balance()
    assert balance.force < 1e-12 and balance.moment < 1e-11
    assert COMM.allreduce(float(contact.pressing()[0].sum())) == pytest.approx(whole.normal, rel=1e-12)
    assert contact.n_active == sum(part.n_active for part in r.problem.contacts) >= r.n_crossings >= 3
    assert (contact.dissipation > 0.0) == (friction > 0.0)
    dofs, owned = r.problem.bodies.bcs[0].dof_indices()
    held = np.bincount(dofs[:owned] % 3, weights=r.problem.bodies.residual.array_r[dofs[:owned]], minlength=3)
    assert np.abs(COMM.allreduce(held) + back.force).max() < 1e-6 * np.abs(back.force).max()
    for part in r.edges if friction else ():
        coulomb(part.pair, 1e-11, 1e-7)


@pytest.mark.slow
def test_thickness():
    """Rods apart by what both are thicker have the force of rods that touch."""
    forces = []
    for offset in (0.0, 0.01):
        r = rods((11, 12), length=12.0, way=(0.0, 0.0, offset - 0.1), surfaces=OUTSIDE, edges=True, offset=offset)
        run(r.problem)
        forces.append(r.force)
    assert np.abs(forces[1] - forces[0]).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.2, 0.0])
def test_checkpoints(friction, folder):
    """A run that continues from a checkpoint ends like one that was left alone."""

    def begun():
        return rods((11, 12), on_edge=False, friction=friction, surfaces=OUTSIDE, edges=True, corners=True, **OBLIQUE)

    continues_from_checkpoints(begun, folder)


@pytest.mark.parametrize("how", [{"sliding": "small"}, {"tied": True}, {"friction": uem.Tresca(1.0)}])
def test_refused(how):
    """Where crossings have no equations, by name; and without edges there is no further part."""
    refused(uem.InputError, ["edges = True goes with"], lambda: rods((5, 4), length=4.0, surfaces=OUTSIDE, edges=True, **how))
    refused(uem.InputTypeError, ["edges", "True or False"], lambda: uem.Contact([0], [1], edges="yes"))
    assert not rods((5, 4), length=4.0, surfaces=OUTSIDE).contact.further


def of_folded(shift, **how):
    """Force on the lower rod of a body that is folded, or of two, and the scene (collective)."""
    r = folded(shift, **how)
    run(r.problem, 2 if how.get("friction") else 1)
    n = r.problem.config.n_owned
    low = (r.problem.config.X[:n] @ r.R)[:, 2] < 0.01
    return COMM.allreduce(r.contact.force.x.array.reshape(-1, 3)[:n][low].sum(axis=0)) @ r.R, r


@pytest.mark.long
@pytest.mark.parametrize("how", [{}, slow({"friction": 0.3, "way": (0.1, 0.05, -0.1), "law": st_venant})])
def test_edges_of_one_body(how):
    """A body that is folded onto itself has the forces of two bodies, in any pose, with nodes at its crossings and without."""
    forces = []
    for shift in (0.0, 0.2):
        own, r = of_folded(shift, self_contact=True, **how)
        assert r.n_crossings == 4 and r.contact.parts[-2].balance().moment < 1e-11
        if shift:
            both, two = of_folded(shift, link=False, **how)
            posed, _ = of_folded(shift, self_contact=True, R=turned(1), **how)
            assert two.n_crossings == 4
            assert np.abs(own - both).max() < 1e-8 * abs(own[2]) and np.abs(posed - own).max() < 1e-4 * abs(own[2])
        forces.append(own[2])
        assert side(own) == pytest.approx(how.get("friction", 0.0), abs=0.01)
    assert np.ptp(forces) < 0.01 * abs(forces[0])


def test_a_body_at_rest_has_no_crossings():
    """Of a block, a plate and a fork no edges are opposite to each other, though they meet at corners."""
    for body in (
        box("hexahedron", [0.0] * 3, [1.0] * 3, [3] * 3),
        box("hexahedron", [0.0] * 3, [1.0, 0.1, 1.0], [4, 1, 4]),
        fork("hexahedron"),
    ):
        _, skin = skin_of("hexahedron", [body])
        nodes = np.unique(skin.dofs[skin.dofs < skin.config.n_owned]).astype(np.int32)
        crossings = crossings_of(Neighbours(skin, nodes, np.arange(1), [], 0.0, 1, np.ones(1, bool)), 1.0)
        crossings.update()
        assert COMM.allreduce(sum(len(which) for which, _ in crossings.lists)) == 0
