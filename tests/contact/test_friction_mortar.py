"""Friction with mortar: flat and round bodies of both degrees that slide far over bodies that bend, and what its forces depend on.

The tests to read first are ``test_a_flat_block_slides_at_mu_times_its_load`` and ``test_friction_of_mortar_by_differences``.
"""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import cylinder, driven, fields, loose
from helpers import slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra import kept_factor
from uem_dolfinx.contact.seam.placement import Along
from uem_dolfinx.solve.bodies.tangent import contact_curvature

COMM = MPI.COMM_WORLD
MORTAR = {"coupling": "mortar"}


def friction_at_nodes(contact):
    """Nodal forces of friction on both bodies, of the state last found ``(n_owned, gdim)`` (collective)."""
    pair = contact.pair
    nodes, forces = pair.nodal_forces(replace(pair.trial, lam=0.0 * pair.trial.lam))
    return pair.config.add_at_owners(nodes, forces)


def of_friction(pair, along, du):
    """The product of the derivative of friction forces with an increment."""
    kinematics, state = pair.kinematics, pair.trial
    both, alone = kinematics.curvature(state, along), kinematics.curvature(state)
    return contact_curvature([(nodes, -blocks) for nodes, blocks in both[len(alone) :]], du) * du


@pytest.mark.parametrize(
    ("cell", "degree", "n"),
    [
        ("quadrilateral", 1, (3, 4)),
        ("quadrilateral", 2, (3, 2)),
        ("triangle", 2, (2, 3)),
        slow("tetrahedron", 2, (3, 2)),
        slow("hexahedron", 2, (3, 2)),
    ],
)
def test_a_flat_block_slides_at_mu_times_its_load(cell, degree, n):
    """Over facets of another body's flat surface, one after the other, all of the block slips: along it mu times the force on it."""
    scene = driven(cell, 0.3, degree=degree, n=n, flat=True, walls=cell in ("tetrahedron", "hexahedron"), how=MORTAR)
    side = [0.0] * (scene.problem.config.gdim - 2)
    scene.to(0.0, *side, -0.01)
    for x in (0.05, 0.1, 0.3, 0.45):
        scene.to(x, *side, -0.01)
    assert scene.states[0] == 0 and scene.states[1] > 3
    f, balance = scene.contact.resultant().force, scene.contact.balance()
    assert abs(-f[0] / (0.3 * f[-1]) - 1) <= 1e-10
    assert balance.force <= 1e-12 and balance.moment <= 1e-12


@pytest.mark.long
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", slow("tetrahedron"), slow("hexahedron")])
def test_friction_holds_a_block_of_degree_2(cell):
    """Pushed with less than mu times its weight it stays where it is; weight, push and friction balance."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    scene = loose(cell, 0.3, n=(2, 3) if g == 2 else (2, 1), degree=2, coupling="mortar", rtol=1e-12)
    for push in (0.0, 0.15, 0.27, -0.2):
        load = np.zeros(g)
        load[0], load[-1] = push, -1.0
        scene.under(*load)
        assert np.abs(scene.contact.resultant().force + load).max() <= 1e-12
        balance = scene.contact.balance()
        assert balance.force <= 1e-12 and balance.moment <= 1e-7


@pytest.mark.long
@pytest.mark.parametrize("cell", ["tetrahedron", slow("hexahedron")])
@pytest.mark.parametrize("degree", [1, slow(2)])
def test_a_target_that_ends_over_facets_that_stick(cell, degree):
    """Equations of contactors there follow each other in circles, by small parts."""
    scene = driven(cell, 0.3, degree=degree, n=(3, 3) if degree == 1 else (2, 2), swap=True, how=MORTAR)
    circular = []
    for x in (0.0, 0.01, 0.06):
        scene.to(x, 0.3 * x, -0.01)
        circular.append(scene.problem.system.restriction().fades)
    assert any(circular) and scene.states[0] == 0
    f = scene.contact.resultant().force
    assert np.linalg.norm(f[:2]) == pytest.approx(-0.3 * f[2], rel=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, slow(2)])
def test_a_cylinder_slides_far(comm, degree):
    """Pressed and driven past its own contact it finds the same on any number of ranks, and loses what its friction takes."""
    found = []
    for where in (MPI.COMM_SELF, comm):
        scene, row = cylinder(0.3, n=12 // degree, degree=degree, coupling="mortar", comm=where), []
        config, contact, n = scene.problem.config, scene.contact, scene.problem.config.n_owned
        before = None
        for place in ((0.0, -0.02), (0.005, -0.02), (0.1, -0.02), (0.4, -0.02), (0.3, -0.02)):
            scene.to(*place)
            now = config.displacement[:n].copy(), friction_at_nodes(contact), contact.dissipation
            if before is not None:
                lost = -0.5 * where.allreduce(float(((before[1] + now[1]) * (now[0] - before[0])).sum()))
                assert now[2] - before[2] == pytest.approx(lost, rel=1e-10)
            before = now
            balance = contact.balance()
            assert balance.force <= 1e-12 and balance.moment <= 1e-7
            row.append(
                [*contact.resultant().force, contact.dissipation, compat.petsc_vector(scene.problem.u).norm(), *scene.states]
            )
        found.append(np.array(row))
    alone, row = found
    assert alone[1, 4] > 0 and alone[2, 4] == 0
    assert (np.abs(alone - row).max(axis=0) <= 1e-9 * np.abs(alone).max(axis=0)).all()


@pytest.mark.parametrize(
    ("cell", "target"),
    [
        ("quadrilateral", "wider"),
        ("tetrahedron", "wider"),
        ("tetrahedron", "plane"),
        ("quadrilateral", "ends"),
        ("tetrahedron", "ends"),
    ],
)
@pytest.mark.parametrize("slips", [True, False])
def test_friction_of_mortar_by_differences(cell, target, slips):
    """Derivatives of the forces of friction of weighted gaps, over bodies that bend, all contactors slipping, or all held.

    Of contactors that slip the multipliers of the weighted gaps stay; of those that are held those of the rows along the target.
    """
    mu, h = 0.4, 1e-6
    scene = driven(
        cell, mu, rigid=target == "plane", n=(3, 4) if cell == "quadrilateral" else (2, 3), how=MORTAR, swap=target == "ends"
    )
    problem, pair = scene.problem, scene.contact.pair
    g, n = problem.config.gdim, len(pair.nodes)
    smooth, way, pressure = fields(problem, pair)
    held = np.where(pair.kinematics.rows.covered, pressure, 0.0)

    def friction(u, direction):
        """Nodal forces of friction."""
        state = replace(pair.trial.friction, stick=np.zeros(n, bool), direction=direction)
        pair.trial = replace(pair.trial, active=np.ones(n, bool), friction=state)
        problem.u.x.array[:] = u.ravel()
        problem.system.place()
        lam = pressure * pair.kinematics.rows.area
        pair.trial = replace(pair.trial, lam=lam)
        size = mu * (lam if slips else held * pair.kinematics.ties.share)
        forces = []
        for tau in (-size[:, None] * pair.friction.directions(pair.trial), np.zeros((n, g))):
            pair.trial = replace(pair.trial, friction=replace(state, tau=tau))
            forces.append(problem.config.vector(scene.contact.force.x.array.reshape(-1, g)[: problem.config.n_owned].copy()))
        return forces[0] - forces[1]

    friction(smooth, np.tile([1.0, *[0.5] * (g - 1)], (n, 1)))
    s = pair.friction.directions(pair.trial)
    friction(smooth, s)
    du = problem.config.vector(way[: problem.config.n_owned])
    size = mu * (pair.trial.lam / pair.kinematics.ties.share if slips else held)
    tau = -size[:, None] * pair.friction.directions(pair.trial)
    made = of_friction(pair, Along(np.arange(n), tau, np.full(n, not slips)), du)
    difference = friction(smooth + h * way, s) - friction(smooth - h * way, s)
    difference.scale(0.5 / h)
    assert (difference - made).norm() <= 1e-8 * difference.norm()


@pytest.mark.parametrize("cell", ["quadrilateral", slow("tetrahedron")])
def test_contactors_that_stick_converge_quadratically(cell, monkeypatch):
    """Over a body that bends under a large shear, with so much friction that most stick: the tangent has all of their rows."""
    # an earlier factorisation would leave a part of the right-hand side
    monkeypatch.setattr(kept_factor, "OF_CHANGES", np.nan)
    side = [0.0] * (1 if cell == "tetrahedron" else 0)
    scene = driven(cell, 3.0, law=st_venant, n=(2, 3) if side else (3, 4), how=MORTAR)
    for place in ((0.0, *side, -0.1), (0.1, *side, -0.1)):
        scene.to(*place)
    left = np.array([iteration.residual for iteration in scene.to(0.2, *side, -0.1)])
    assert scene.states[0] >= 4
    late = np.flatnonzero(left[:-1] < 1e-3)
    assert len(late) >= 2 and (left[late + 1] <= np.maximum(10 * left[late] ** 2, 1e-12)).all()


@pytest.mark.parametrize(
    ("cell", "where", "bound"),
    [
        ("quadrilateral", "plane", 1e-9),
        ("tetrahedron", "plane", 1e-9),
        slow("hexahedron", "plane", 1e-9),
        ("quadrilateral", "ball", 1e-3),
        ("tetrahedron", "ball", 1e-3),
        ("quadrilateral", "mesh", 2e-3),
        slow("hexahedron", "mesh", 3e-3),
    ],
)
def test_friction_of_degree_2_by_differences(cell, where, bound):
    """Derivatives of the forces of friction in equilibrium, where weighted gaps are closed: exact on a plane.

    Elsewhere what is left is in proportion to gaps that the weighted ones do not tell.
    """
    g, mu, h = (2 if cell == "quadrilateral" else 3), 0.4, 1e-6
    ball = uem.RigidSphere([0.5] * (g - 1) + [-1.5], 1.5) if where == "ball" else None
    scene = driven(
        cell, mu, rigid=where == "plane", target=ball, degree=2, n=(2, 3) if g == 2 else (2, 2), law=st_venant, how=MORTAR,
        comm=MPI.COMM_SELF,
    )  # fmt: skip
    for x in (0.0, 0.1):
        scene.to(x, *[0.3 * x] * (g - 2), -0.05)
    problem, pair = scene.problem, scene.contact.pair
    n, touching, friction = len(pair.nodes), pair.trial.active.copy(), pair.trial.friction
    start = problem.config.displacement[: problem.config.n_local].copy()
    _, way, pressure = fields(problem, pair)
    assert touching.sum() >= 4

    def force(u, direction):
        """Nodal forces of friction at constant multipliers of the weighted gaps; those of the gaps are left out."""
        problem.u.x.array[:] = u.ravel()
        state = replace(friction, stick=np.zeros(n, bool), direction=direction)
        pair.trial = replace(pair.trial, active=touching, friction=state)
        problem.system.place()
        lam = np.where(touching, pressure * pair.kinematics.rows.area, 0.0)
        pair.trial = replace(
            pair.trial, lam=lam, friction=replace(state, tau=-mu * lam[:, None] * pair.friction.directions(pair.trial))
        )
        return problem.config.vector(friction_at_nodes(scene.contact))

    force(start, np.tile([1.0, *[0.3] * (g - 1)], (n, 1)))
    s = pair.friction.directions(pair.trial)
    force(start, s)
    which = np.flatnonzero(touching)
    tau = -mu * (pair.trial.lam / pair.kinematics.ties.share)[which, None] * s[which]
    du = problem.config.vector(way[: problem.config.n_owned])
    made = of_friction(pair, Along(which, tau, np.zeros(len(which), bool)), du)
    difference = force(start + h * way, s) - force(start - h * way, s)
    difference.scale(0.5 / h)
    assert (difference - made).norm() <= bound * difference.norm()
