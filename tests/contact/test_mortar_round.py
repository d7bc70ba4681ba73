"""Mortar on round bodies of coarse meshes, whose facets meet at large angles and end over each other.

The test to read first is ``test_a_ball_on_three``.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, complementary, factors, highest, run, scene, st_venant
from mortar_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.restriction import Restriction


class Balls:
    """A ball that comes down between three others, all of radius 1 and of cubes with ``n`` divisions, turned at random.

    Args:
        n: divisions of the cubes.
        down: how far the upper one's upper side is led.
        seed: of the turns.
        how: arguments of the contact.
    """

    def __init__(self, n, down, seed, comm=COMM, **how):
        angles = 0.1 + 2 * np.pi / 3 * np.arange(3)
        away, cube = 2.04 / np.sqrt(3), box("tetrahedron", [-1.0] * 3, [1.0] * 3, [n] * 3)
        self.centres = [away * np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
        self.centres.append(np.array([0.0, 0.0, np.sqrt(4 - away**2) + 0.02]))
        turns = [np.linalg.qr(np.random.default_rng(seed + k).standard_normal((3, 3)))[0] for k in range(4)]
        self.turns = [Q * np.linalg.det(Q) for Q in turns]
        drawn = [replace(cube) for _ in range(4)]
        self.scene = scene(comm, "tetrahedron", [replace(cube, x=self.mapped(cube.x, k)) for k in range(4)])
        self.scene.drawing = scene(comm, "tetrahedron", drawn).drawing
        self.V = compat.function_space(self.scene.mesh, 1, (3,))
        self.u = fem.Function(self.V)
        target = np.concatenate([self.part(k, lambda z: z > -0.3).entities for k in range(3)])
        self.contact = uem.Contact(self.part(3, lambda z: z < 0.35), self.tag(target), coupling="mortar", **how)
        bcs = sum((clamp(self.V, self.part(k, lambda z: z < -0.2)) for k in range(3)), [])
        bcs += clamp(self.V, self.part(3, lambda z: z > 0.2), value=[0.0, 0.0, -down])
        law = st_venant(self.u, 1.0)
        self.problem = uem.UnitedProblem(law, self.u, bcs=bcs, contacts=[self.contact], rtol=1e-10)

    def mapped(self, x, k):
        y = np.tan(np.pi / 4 * x)
        length = np.linalg.norm(y, axis=1, keepdims=True)
        y = y * np.abs(y).max(axis=1, keepdims=True) / np.where(length > 0, length, 1.0)
        return y @ self.turns[k].T + self.centres[k]

    def tag(self, facets):
        return uem.Tag("part", 1, 2, self.scene.mesh, np.unique(facets).astype(np.int32))

    def part(self, k, where):
        """Facets of a ball whose corners' heights above its middle are all as given."""

        def on(side):
            return lambda x: side(x) & where((self.mapped(x, k) - self.centres[k])[:, 2])

        tags = [self.scene.tag("face", k, on(at(c, end))) for c, end in product(range(3), (-1.0, 1.0))]
        return self.tag(np.concatenate([tag.entities for tag in tags]))


@pytest.mark.long
@pytest.mark.parametrize(("n", "seed"), [(3, 0), (4, 0), (4, 20)])
def test_a_ball_on_three(n, seed):
    """Facets at 30 to 60 degrees, none of them covered altogether: Newton is quadratic, and forces balance."""
    b = Balls(n, 0.2, seed)
    for step in uem.load_steps(b.problem, 2):
        assert step.cuts == 0 and step.newton_iterations <= 7
        assert all(f < 50 for f in factors(step.iterations))
        complementary(b.contact, 1e-12, 1e-12)
        balance = b.contact.balance()
        assert balance.force < 1e-13 and balance.moment < 1e-13
    assert b.contact.n_active >= 4


@pytest.mark.slow
def test_rows_do_not_depend_on_the_active_set():
    """Rows and gaps do not depend on the active set, and what P and c allow closes the gaps of all active contactors to first order."""
    b = Balls(4, 0.2, 0)
    run(b.problem)
    pair, system = b.contact.pair, b.problem.system
    covered = pair.kinematics.rows.covered
    pair.trial = start = replace(pair.trial, reserved=covered)
    first = pair.equations().P
    for k in range(8):
        # alike on any number of ranks
        some = np.sin(997 * (k + 1) * pair.config.X[pair.nodes].sum(axis=1)) > (k - 4) / 4
        pair.trial = replace(start, active=covered & some)
        eq = pair.equations().P
        for name in ("direction", "gap", "row", "followed", "coefficients"):
            assert np.array_equal(getattr(eq, name), getattr(first, name))
        rows = system.restriction()
        assert isinstance(rows, Restriction)
        q = pair.config.vector(np.cos(3 * pair.config.X[: pair.config.n_owned]))
        du = rows.expand(q)
        du.axpy(1.0, rows.c)
        gap = pair.kinematics.gap_rows.gaps(du.array_r.reshape(-1, 3))
        assert highest(COMM, np.abs(gap[pair.trial.active])) < 1e-13
        assert COMM.allreduce(int(pair.trial.active.sum())) > 0
    pair.trial = start


@pytest.mark.long
def test_ranks_do_as_one_on_a_ball():
    """Histories and forces are those of one rank."""

    def solve(comm):
        b = Balls(3, 0.2, 0, comm)
        steps = run(b.problem, 2)
        return [(i.active, i.exchanges) for step in steps for i in step.iterations], b.contact.resultant().force

    mine, alone = solve(COMM), solve(MPI.COMM_SELF)
    assert mine[0] == alone[0]
    assert mine[1] == pytest.approx(alone[1], rel=1e-8, abs=1e-12)
