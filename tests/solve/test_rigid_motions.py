"""Rigid motions of bodies: which are open, which are loaded, against motions and forces of known size."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import box, linear, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.solve.rigid.rigid_motions import RigidMotions

COMM = MPI.COMM_WORLD


@pytest.fixture(params=[1e-9, 1.0, 1e3])
def body(request):
    """A square that nothing holds, in several units: its motions and its problem."""
    size = request.param
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [size, size], [3, 3])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    problem = uem.UnitedProblem(linear(u, 1.0), u)
    return RigidMotions(problem.config, problem.bodies.free[: problem.config.n_owned], False), problem.config


def corner_equation(config, direction):
    """An equation at one corner, on the rank that owns it."""
    size = config.size / 2**0.5
    here = np.flatnonzero((np.abs(config.X[: config.n_owned]) < 1e-6 * size).all(axis=1)).astype(np.int32)
    k = len(here)
    none = np.zeros((k, 0))
    return UnitingEquations.along(here, np.tile(direction, (k, 1)), none.astype(np.int64), none, np.zeros(k), np.ones(k, bool))


def test_what_counts_as_open(body):
    """A square has three motions; an equation that resists one by 3e-6 of its size leaves it open, by 3e-5 it does not."""
    motions, config = body
    assert motions.open_motions(None).shape[1] == 3
    for resistance, left in ((3e-6, 3), (3e-5, 2)):
        # a corner moves by 1.2 of a motion's size at most
        equations = corner_equation(config, np.array([0.0, resistance]))
        assert motions.open_motions(motions.rates(equations)).shape[1] == left


def test_what_counts_as_held_by_springs():
    """A spring of 3e-13 of the diagonal of K along x leaves a square open, one of 3e-12 holds it, in all units of force and length."""
    for size, E in ((1.0, 1.0), (1e-6, 2e11)):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [size, size], [3, 3])])
        u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
        free = uem.UnitedProblem(linear(u, E), u)
        diagonal = COMM.allreduce(free.bodies.initial_stiffness()[:, 0].sum())
        for part, left in ((0.0, 3), (3e-13, 3), (3e-12, 2)):
            spring = uem.PointSpring((size, size / 3), (part * diagonal, 0.0))
            problem = uem.UnitedProblem(linear(u, E), u, points=[spring])
            motions = RigidMotions(problem.config, problem.bodies.free[: problem.config.n_owned], False)
            motions.ask_stiffness(problem.bodies.update_tangent())
            assert motions.open_motions(None).shape[1] == left


def test_what_counts_as_loaded(body):
    """Of forces that cancel but for a part: 3e-7 of them drives nothing, 3e-6 moves the body along the rest."""
    motions, config = body
    X = config.X[: config.n_owned]
    n = config.index_map.size_global
    for part, driven in ((3e-7, False), (3e-6, True)):
        # pairs of opposite forces on lines through the middle, and a small one in common
        F = np.sign(X - 0.5 * config.size / 2**0.5)
        total = COMM.allreduce(np.abs(F).sum())
        F[:, 0] -= part * total / n
        motion = motions.load(motions.open_motions(None), F)
        assert motion.any() == driven
        if driven:
            assert np.argmax(np.abs(motion)) == 0 and motion[0] > 0
        assert motions.share == pytest.approx(part, rel=0.05)


def test_rates_of_bodies_that_have_moved():
    """A square that turns finitely about the middle where it is now, not where it was before: its own middle rests."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [2.0, 2.0], [2, 2])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    config = uem.UnitedProblem(linear(u, 1.0), u).config
    motions = RigidMotions(config, np.ones((config.n_owned, 2), dtype=bool), True)
    motions.open_motions(None)
    config.shift(slice(None), np.array([3.0, -5.0]))
    node = np.flatnonzero((np.abs(config.X[: config.n_owned] - 1.0) < 1e-9).all(axis=1)).astype(np.int32)
    k, none = len(node), np.zeros((len(node), 0))
    equations = UnitingEquations.along(
        node, np.tile([0.6, 0.8], (k, 1)), none.astype(np.int64), none, np.zeros(k), np.ones(k, bool)
    )
    rates = motions.rates(equations).toarray()
    assert COMM.allreduce(k) == 1 and np.allclose(rates, np.tile([0.6, 0.8, 0.0], (k, 1)), atol=1e-12)


def test_supports_are_the_same_on_every_number_of_ranks():
    """The corners of a square hold it equally well: which of them do is settled by their places, not by ranks or rounding."""

    def supports(comm, seed):
        s = scene(comm, "quadrilateral", [box("quadrilateral", [-0.5, -0.5], [0.5, 0.5], [4, 4])])
        u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
        problem = uem.UnitedProblem(linear(u, 1.0), u)
        config = problem.config
        # last bits that another partition would have
        config.X[:] += 4e-16 * np.random.default_rng(seed).integers(-1, 2, config.X.shape)
        motions = RigidMotions(config, problem.bodies.free[: config.n_owned], False)
        i, c = np.nonzero(motions.supports(motions.open_motions(None), UnitingEquations.join([], 2)))
        return sorted(sum(comm.allgather([(*np.round(config.X[k], 6), d) for k, d in zip(i, c)]), []))

    wanted = supports(MPI.COMM_SELF, 0)
    assert len(wanted) == 3
    for seed in range(1, 6):
        assert supports(COMM, seed + COMM.rank) == wanted


def test_bodies_follow_their_conditions(body):
    """A side that is moved and turned takes the square with it; one that gives way to the right only takes it there, and no more."""
    _, config = body
    x, size = config.X[: config.n_owned], config.size / 2**0.5
    left = np.abs(x[:, 0]) < 1e-6 * size
    turned = 1e-3 * np.column_stack([2 * size - x[:, 1], x[:, 0] + size])
    for free, way in (
        (np.column_stack([~left, ~left]), turned),
        (np.column_stack([~left, np.ones_like(left)]), np.full_like(x, 1e-3 * size) * [1, 0]),
    ):
        motions = RigidMotions(config, free, False)
        found = motions.field(motions.following(np.where(free, 7.0, way)))
        assert np.abs(found - way).max(initial=0.0) < 1e-10 * size
