"""Soft contact on bends of a faceted target: contactors there are pressed by both facets, whose gaps are equal.

Read first: ``test_a_bowl``. Moments are checked after every test, see ``conftest.across_gaps``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from corner_scenes import groove, pit
from dolfinx import fem
from helpers import at, box, clamp, refused, scene, slow, st_venant

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def bowl(cell="quadrilateral", degree=1, k=100.0, n=(4, 3), steps=2, comm=COMM):
    """A block that presses into a bowl of plane facets, symmetric to x = 0.5, with weak springs at its lid; k = 0: hard contact."""
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    layer = 1 if g == 3 else 0

    def bend(x):
        lift = 0.3 * (x[:, 0] - 0.5) ** 2
        return x + np.outer(lift, np.eye(g)[-1])

    parts = [([-0.5], [1.5], -1.0, 0.0, n[0]), ([0.0], [1.0], 0.0, 1.0, n[1])]
    bodies = [
        box(cell, [*a, *[0.0] * layer, z], [*b, *[0.5] * layer, top], [m, *[layer] * layer, 2]).mapped(bend)
        for a, b, z, top, m in parts
    ]

    def height(h):
        return lambda x: np.abs(x[:, -1] - 0.3 * (x[:, 0] - 0.5) ** 2 - h) < 1e-9

    s = scene(comm, cell, bodies)
    V = uem.function_space(s.mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    lid, E = s.tag("lid", 1, height(1.0)), fem.Constant(s.mesh, 1.0)
    down = fem.Constant(s.mesh, 0.0)
    F = st_venant(u, E) + down * v[g - 1] * uem.ds(lid) + 1e-3 * ufl.inner(u, v) * uem.ds(lid)
    foot, top = s.tag("foot", 1, height(0.0)), s.tag("top", 0, height(0.0))
    contact = uem.Contact(foot, top, normal=uem.SoftContact(k) if k else None, max_penetration=0.5)
    bcs = clamp(V, s.tag("base", 0, height(-1.0)))
    if g == 3:
        bcs += [bc for end in (0.0, 0.5) for j in (0, 1) for bc in clamp(V, s.tag(f"side {j}", j, at(1, end)), 1)]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load={down: 0.02}, rtol=1e-11)
    return problem, contact, u, lid, E, steps


def settled(made, **how):
    """Iterations, and the mean displacement of the lid."""
    problem, contact, u, lid, E, steps = made
    iterations = [step.newton_iterations for step in uem.load_steps(problem, steps, **how)]
    area = uem.integrate(fem.Constant(u.function_space.mesh, 1.0) * uem.ds(lid))
    return iterations, np.array([uem.integrate(part / area * uem.ds(lid)) for part in ufl.split(u)])


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "degree", "n", "k"),
    [
        ("quadrilateral", 1, (4, 3), 100.0),
        slow("quadrilateral", 1, (4, 3), 1e4),
        slow("quadrilateral", 2, (8, 6), 100.0),
        slow("quadrilateral", 2, (8, 6), 1e4),
        slow("triangle", 2, (8, 6), 100.0),
        slow("hexahedron", 1, (4, 3), 1e4),
    ],
)
def test_a_bowl(cell, degree, n, k):
    """A contactor in a corner keeps the block in the middle; stiff laws have the state of hard contact, and forces balance.

    Moments are off by the gap times the force that one facet has more than the other, where triangles are not symmetric.
    """
    hard = settled(bowl(cell, degree, 0.0, n=n))[1]
    iterations, lid = settled(made := bowl(cell, degree, k, n=n))
    contact, even = made[1], cell != "triangle"
    assert (
        max(iterations) <= (10 if degree == 1 else 30)
        and np.abs(lid - hard).max() <= 0.05 / k
        and (abs(lid[0]) <= 1e-9 or not even)
    )
    assert contact.balance().force <= 1e-12 and contact.balance().moment <= (1e-12 if even else 1e-5 / k)
    changes, corners = contact.pair.trial.changes, contact.pair.trial.in_corner
    assert COMM.allreduce(int(corners.sum())) > 0 == COMM.allreduce(int((changes >= 8).sum()))


def in_groove(cell, degree, **how):
    """A wedge pressed aslant into a right-angled groove."""
    return groove(cell, 90.0, 45.0, 22.5, (0.01, 0.02), (0.0, -0.07), degree=degree, **how)


@pytest.mark.parametrize(
    ("make", "args"),
    [
        (in_groove, ("triangle", 1)),
        slow(in_groove, ("quadrilateral", 2)),
        slow(in_groove, ("tetrahedron", 1)),
        slow(pit, ("hexahedron", 1.0, (0.01, -0.02, 0.1), (0.0, 0.01, -0.15))),
        slow(pit, ("tetrahedron", 0.5, (0.0, 0.0, 0.0), (0.03, 0.01, -0.05))),
    ],
)
def test_sharp_corners(make, args):
    """The edge of a wedge and a tip in a pit of three facets have the force of hard contact but for the gap: steps are not cut."""
    forces = []
    for k in (0.0, 1e2, 1e4):
        made = make(*args, **({"normal": uem.SoftContact(k)} if k else {}))
        (step,) = uem.load_steps(made.problem, 1)
        forces.append(made.contact.resultant().force)
        assert step.cuts == 0 and step.newton_iterations <= 14
        assert COMM.allreduce(int(made.contact.pair.trial.in_corner.sum())) > 0
        assert np.linalg.norm(forces[-1] - forces[0]) <= (6.0 / k if k else 0.0) * np.linalg.norm(forces[0])


@pytest.mark.slow
def test_runs_and_ranks_agree(folder):
    """A run that goes on from a checkpoint with contactors in corners has the same numbers, and so has a single rank."""
    _, lid = settled(bowl(degree=2, n=(8, 6)))
    first = bowl(degree=2, n=(8, 6))
    for step in uem.load_steps(first[0], 2, checkpoint=uem.Checkpoint(folder / "kept")):
        if step.number == 1:
            break
    rest = bowl(degree=2, n=(8, 6))
    _, again = settled(rest, checkpoint=uem.Checkpoint(folder / "kept"))
    _, alone = settled(bowl(degree=2, n=(8, 6), comm=MPI.COMM_SELF))
    assert np.allclose([again, alone], lid, rtol=0.0, atol=1e-9)


def test_gradients_are_refused():
    """Axes of corners turn with the bodies, which derivatives would leave out."""
    problem, *_, u, lid, E, _ = made = bowl(steps=1)
    settled(made)
    refused(uem.errors.InputError, "corners of the target hold", lambda: uem.gradient(problem, u[1] * uem.ds(lid), [E]))
