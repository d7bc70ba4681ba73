"""Nodes at pointed edges of a target that are contactors of the contactor's facets: forces, drag, and where they change nothing.

Worth reading first: ``test_forces_of_a_punch`` and ``test_no_drag_without_friction``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from helpers import at, blocks, box, clamp, linear, modulus, rotation, run, slow
from pointed_scenes import COMM, ironed, neo_hooke, pressed, punch, slot, tooth, wedge

import uem_dolfinx as uem
from uem_dolfinx.geometry import pointed
from uem_dolfinx.geometry.facets import facets_of

#: Force of ``punch()`` by extrapolation: its contactors on 128 cells give 0.02878 with the corners and 0.02874 without.
OF_PUNCH = 0.0287


def force_of(made, steps=2):
    """Force of a scene in the direction that it is pressed, and its contact."""
    (problem, contact, _), _ = made
    run(problem, steps)
    return abs(contact.resultant().force[-1]), contact


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("w", [0.47, 0.495])
def test_forces_of_a_punch(n, closed, w):
    """On meshes whose nodes straddle the corners the force is nearer to that of fine ones: within 9 % where 9 to 24 % were lacking.

    Nodes next to a corner are held there without it where the target ends at the corner.
    """
    without, with_corners = (force_of(punch(w=w, n=n, closed=closed, corners=corners))[0] for corners in (False, True))
    reference = OF_PUNCH * (1.0 if w == 0.47 else 1.03)
    assert 0.93 * reference < with_corners < 1.1 * reference
    if w == 0.495 and not closed:
        assert without == pytest.approx(with_corners, rel=1e-3)
    else:
        assert without < 0.93 * reference and abs(with_corners - reference) < 0.6 * abs(without - reference)


@pytest.mark.parametrize(
    "make, how",
    [
        (wedge, {"n": 16}),
        (wedge, {"n": 6, "g": 3}),
        (wedge, {"n": 8, "degree": 2}),
        (slot, {"n": 8}),
        (tooth, {"n": 16, "law": neo_hooke}),
        (punch, {"n": 8, "friction": 0.3}),
        (punch, {"n": 8, "sliding": "small"}),
        (punch, {"n": 8, "size": 1e3}),
    ],
)
def test_as_if_the_body_with_corners_were_the_contactor(make, how):
    """Corners enter no facet, and forces on both sides balance: the force is within 4 % of the one with the sides swapped."""
    force, contact = force_of(make(corners=True, **how))
    swapped, _ = force_of(make(swap=True, **how))
    assert abs(force - swapped) < (0.04 if make is not tooth else 0.1) * swapped
    assert contact.further[0].n_active == 0 < COMM.allreduce(int(contact.further[0].pair.trial.active.sum()))
    balance = contact.balance()
    assert balance.force < 1e-12 and balance.moment < 1e-9
    deepest = COMM.allreduce(float(np.min(contact.further[0].pair.kinematics.projection.gap, initial=np.inf)), op=MPI.MIN)
    out = contact.further[0].pair.off
    assert deepest > -1e-9 * contact.config.size or COMM.allreduce(int(out.sum()))


def integrals(n, steps, pitches=1, **how):
    """Of the last pitch of a die that is dragged: work and gain of energy, and drag times way, over the force times the way."""
    x, F, energies = ironed(n, drag=pitches / (3.0 * n), steps=pitches * steps, **how)
    x, F, energies = (values[-steps - 1 :] for values in (x, F, energies))
    work, force = 0.5 * (np.diff(x) @ (F[1:] + F[:-1])) * (1.0, -1.0)
    return work / force, (energies[-1] - energies[0]) / force


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, slow(2)])
def test_a_drag_without_friction_loses_no_energy(n):
    """What the drag does over a pitch of the slab is stored; without corners jumps lose 4 % of force times way at n = 1."""
    work, gained = integrals(n, 8, corners=True)
    assert abs(work - gained) < 1.5e-3 and abs(work) < 0.015
    if n == 1:
        work, gained = integrals(n, 8, corners=False)
        assert work - gained > 0.04


@pytest.mark.slow
@pytest.mark.parametrize("n, pitches", [(1, 3), (2, 4)])
def test_drag_with_friction(n, pitches):
    """With a coefficient of 0.3 it is 0.30 of the force in the mean of a pitch, once all of the die slips: all of it is dissipated."""
    work, gained = integrals(n, 8, pitches, friction=0.3, corners=True)
    assert 0.295 < work < 0.31 and abs(gained) < 2e-3


def test_results_are_of_both_parts():
    """Force on either side, resultants, the integral of the pressure, and the sums of all contacts of the problem."""
    (problem, contact, _), _ = punch(n=8, friction=0.2, corners=True)
    run(problem, 2)
    g, n = 2, problem.config.n_owned
    on, back = (contact.force_on(side).x.array[: g * n].reshape(-1, g).sum(axis=0) for side in ("contactor", "target"))
    on, back = COMM.allreduce(on), COMM.allreduce(back)
    whole = contact.resultant()
    assert np.allclose(on, whole.force, rtol=0, atol=1e-12) and np.allclose(on, -back, rtol=0, atol=1e-12)
    assert np.allclose(contact.resultant(on="target").force, -whole.force, rtol=0, atol=1e-12)
    moments = [contact.resultant((0.1, 0.2), on=side).moment for side in ("contactor", "target")]
    assert np.allclose(moments[0], -moments[1], rtol=0, atol=1e-10)
    # the corners carry a good part, which pressures contain
    own = COMM.allreduce(float(contact.pair.trial.lam.sum()))
    total = COMM.allreduce(float(contact.pressing()[0].sum()))
    assert total == pytest.approx(whole.normal, rel=1e-12) and own < 0.7 * total
    forces = sum(c.force.x.array for c in problem.contacts)
    assert np.array_equal(forces, contact.force.x.array) and sum(c.n_active for c in problem.contacts) == contact.n_active
    # equilibrium with the force of the supports
    led = COMM.allreduce(float(problem.bodies.residual.array_r[1 : 2 * n : 2][problem.config.x[:n, 1] > 0.5].sum()))
    assert abs(led) == pytest.approx(abs(whole.force[1]), rel=1e-6)


@pytest.mark.parametrize("how", [{"n": 8}, {"n": 6, "friction": 0.2}])
def test_any_pose(how):
    """A scene that is turned by 30 degrees has the same force, turned."""
    found = []
    for angle in (0.0, np.pi / 6):
        R = rotation(2, angle)
        (problem, contact, _), _ = punch(turn=R, corners=True, **how)
        run(problem, 2)
        found.append(R.T @ contact.resultant().force)
    assert np.allclose(*found, rtol=0, atol=1e-7 * np.linalg.norm(found[0]))


def test_quadratic_convergence():
    """Rows and their curvature are derivatives of each other: residuals fall quadratically at the end of a step with corners in touch."""
    (problem, _, _), _ = wedge(n=8, law=neo_hooke, corners=True)
    steps = run(problem, 4)
    residuals = [iteration.residual for iteration in steps[-1].iterations]
    assert residuals[-1] < 1e-8 and residuals[-1] < 100 * residuals[-2] ** 1.7


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron", "tetrahedron"])
@pytest.mark.parametrize("n, overhang", [((3, 4), 0.0), ((4, 3), 0.0), ((3, 3), 0.0), ((3, 4), 0.5)])
def test_edges_that_lie_on_edges_follow_as_before(cell, n, overhang):
    """Blocks of one width, with and without the same nodes, and one on a wider one: corners of the target change nothing."""
    found = []
    for corners in (False, True):
        b = blocks(COMM, cell, *n, overhang=overhang)
        contact = uem.Contact(b.high, b.low, corners=corners)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[*[0.0] * (b.gdim - 1), -0.02])]
        run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], rtol=1e-11))
        own = b.u.x.array[: b.gdim * b.V.dofmap.index_map.size_local].reshape(-1, b.gdim)
        # meshes are parted anew
        found.append((COMM.allreduce((own**2).sum(axis=0)), contact.resultant().force, contact.n_active))
    (u, force, n_active), (v, other, as_many) = found
    assert n_active == as_many and np.allclose(u, v, rtol=1e-9, atol=1e-12) and np.allclose(force, other, rtol=0, atol=1e-10)


@pytest.mark.parametrize("how", [{"coupling": "mortar"}, {"tied": True}, {"adjust": True}, {"wear": 1e-3}])
def test_contacts_that_cannot_have_a_second_part(how):
    with pytest.raises(uem.InputError, match="corners = True goes with hard"):
        punch(corners=True, **how)
    (problem, contact, _), _ = punch(**how)
    assert not contact.further and problem.contacts == [contact]


def test_round_targets_have_none():
    """A disc of 24 facets, and a rigid surface."""

    def bend(x):
        a = np.pi * (1 + x[:, 1])
        return np.column_stack([x[:, 0] * np.cos(a), 1 + x[:, 0] * np.sin(a)])

    low, disc = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [9, 4]), box("quadrilateral", [0.3, 0.0], [1.0, 1.0], [3, 12])
    round_ = (1, lambda x: (np.abs(np.hypot(x[:, 0], x[:, 1] - 1) - 1) < 1e-9) & (x[:, 1] < 0.9))
    problem, contact, _ = pressed(
        [low, disc.mapped(bend)], ([(0, at(1, 0.0))], [round_]), (1, at(1, 1.0), [0.0, -0.02]), (1.0, 1.0), corners=True
    )
    assert not contact.further
    assert uem.Contact(contact.contactor, uem.RigidPlane((0.0, 1.0), (0.0, -1.0))).further == ()


@pytest.mark.parametrize("slope, expected", [(0.3, 1), (0.2, 0)])
def test_which_edges_are_pointed(slope, expected):
    """A ridge whose flanks turn by 33 degrees is, one of 23 degrees is not: a polygon of 12 sides and more is round."""
    (problem, contact, _), (tip,) = wedge(slope=slope, corners=True)
    X = problem.config.X[contact.further[0].nodes]
    assert COMM.allreduce(int((np.abs(X[:, 0] - tip) < 1e-9).sum())) == expected


@pytest.mark.parametrize("part, expected", [(0.02, 1), (0.2, 0)])
def test_edges_without_corner_contact(part, expected):
    """A contactor near a corner, at a part of its facet, is left to the equation of the corner; one farther away has its own."""
    n = 8
    h = 1.0 / n
    (_, contact, _), _ = punch(w=4 * h + part * h, n=n, corners=True)
    contact.pair.project()
    out = contact.pair.kinematics.ends.out
    assert COMM.allreduce(int(out.sum())) == 2 * expected
    assert expected or part > pointed.AT_CORNER


def test_friction_and_offset_between_steps():
    """Both parts have what is set; a part is switched off and on with its contact."""
    (problem, contact, _), _ = punch(n=8, friction=0.3, corners=True)
    problem.solve()
    contact.friction, contact.offset = 0.1, 1e-3
    part = contact.further[0]
    assert part.friction == 0.1 and (part.friction_values() == 0.1).all() and part.offset == 1e-3
    before = abs(contact.resultant().force[1])
    problem.solve()
    assert abs(contact.resultant().force[1]) > 1.02 * before
    (problem, contact, _), _ = punch(n=8, corners=True)
    list(uem.load_steps(problem, [uem.Step("press", 1), uem.Step("release", 1, contacts={contact: False})]))
    assert contact.n_active == 0 and not contact.on and not contact.further[0].on
    assert abs(contact.resultant().force).max() == 0.0


def test_a_run_continues(folder):
    """From a checkpoint in touch, as one that was not interrupted."""
    scenes = [punch(n=8, friction=0.2, corners=True) for _ in range(2)]
    (whole, one, move), (again, other, again_move) = (s for s, _ in scenes)
    run(whole, 2)
    uem.write_checkpoint(folder / "corners", whole.state())
    uem.read_checkpoint(folder / "corners", again.state())
    for problem, value in ((whole, move), (again, again_move)):
        value.value[:] = (0.01, -0.03)
        problem.solve()
    assert np.allclose(whole.u.x.array, again.u.x.array, rtol=0, atol=1e-11)
    assert np.allclose(one.resultant().force, other.resultant().force, rtol=1e-8)


def test_target_is_of_one_body_with_its_facets():
    """The corners are found on the outside of the body where the target ends at them."""
    (problem, contact, _), _ = punch(closed=False, corners=True)
    facets = facets_of(problem.config, contact.target)
    assert COMM.allreduce(int(pointed.pointed_sides(facets).sum())) == 2 == COMM.allreduce(len(contact.further[0].nodes))
