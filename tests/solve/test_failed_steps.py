"""What goes on where something went wrong or came in an odd order: failed remainders, loads that raise, tables made too early, rest.

Two tests to read first: ``test_body_with_mass_comes_to_rest`` and ``test_table_made_before_the_checkpoint_is_read``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, gathered_matrix, gathered_vector, highest, linear, scene
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.solve.tangent import contact_curvature

COMM = MPI.COMM_WORLD
LENGTH, E, DENSITY = 10.0, 900.0, 2.0


class Bar:
    """A bar ``[0, 1] x [gap, gap + LENGTH]`` without any support above a rigid floor."""

    def __init__(self, gravity, *, gap=0.0, finite=False, contactors="massless", load=None):
        self.s = s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, gap], [1.0, gap + LENGTH], [2, 12])])
        self.V = compat.function_space(s.mesh, 1, (2,))
        self.u = fem.Function(self.V)
        law = (uem.StVenantKirchhoff if finite else uem.LinearElastic)(E, 0.0, kind="plane_stress")
        self.floor = uem.Contact(s.tag("foot", 0, at(1, gap)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
        self.dynamics = uem.Dynamics(uem.lumped_mass(self.V, DENSITY), gravity=gravity, contactors=contactors)
        self.problem = uem.UnitedProblem(
            law.residual(self.u, ufl.TestFunction(self.V)) * ufl.dx,
            self.u,
            contacts=[self.floor],
            dynamics=self.dynamics,
            load=load,
        )


def pressed_blocks(load=None):
    """Linear block on block, the top pushed down by a twentieth."""
    b = blocks(COMM, "triangle", 2, 4)
    contact = uem.Contact(b.high, b.low)
    return uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact], load=load)


# ---------------------------------------------------------------------------------------------- statics of what has mass


@pytest.mark.parametrize("finite", [False, True])
@pytest.mark.parametrize("contactors", ["massless", "massy"])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_body_with_mass_comes_to_rest(gap, contactors, finite):
    """It falls onto the floor if it must; the floor bears its weight, it shortens as in the closed form, and in time it stays so."""
    g = 3.0
    bar = Bar((0.0, -g), gap=gap, contactors=contactors, finite=finite)
    bar.problem.solve()
    weight = DENSITY * LENGTH * g
    force = bar.floor.resultant().force
    assert np.allclose(force, [0.0, weight], rtol=1e-7, atol=1e-7 * weight)
    if not finite and contactors == "massy":
        top = bar.s.gather(bar.u)[bar.s.drawing[:, 1] == gap + LENGTH]
        assert np.allclose(top[:, 1] + gap, -DENSITY * g * LENGTH**2 / (2 * E), rtol=1e-7)
    steps = list(uem.time_steps(bar.problem, 0.01, 0.05))
    assert len(steps) == 5
    assert highest(COMM, np.abs(bar.dynamics.velocity.x.array)) < 1e-5 * g * 0.05
    assert np.allclose(bar.floor.resultant().force, [0.0, weight], rtol=1e-5, atol=1e-5 * weight)


def test_what_is_held_at_rest_starts_freely():
    """On a floor without friction the first acceleration along it is that of free fall at every node with mass."""
    bar = Bar((0.5, -3.0))
    bar.problem.system.accelerate()
    a = bar.s.gather(bar.dynamics.acceleration)
    assert np.allclose(a[bar.s.drawing[:, 1] > 0.0, 0], 0.5, rtol=1e-10)
    bar = Bar((0.5, -3.0))
    with pytest.raises(uem.FloatingBodyError, match="moves along"):
        bar.problem.solve()


# ---------------------------------------------------------------------------------------------- load steps


def test_failed_remainder_is_halved(monkeypatch):
    """What is left to the full load is tried once as a whole, then by halves, whatever the length of steps was to be."""
    problem, tried = pressed_blocks(), []
    solve = problem.solve

    def fails_on_long_ways(*, start, fraction, ratio):
        tried.append(fraction)
        if len(tried) in (1, 3):
            raise uem.ConvergenceError("too long")
        return solve(start=start, fraction=fraction, ratio=ratio)

    monkeypatch.setattr(problem, "solve", fails_on_long_ways)
    done = [step.factor for step in uem.load_steps(problem, 1)]
    assert tried == [1.0, 0.5, 1.0, 0.75, 1.0] and done == [0.5, 0.75, 1.0]


@pytest.mark.parametrize("sendable", [True, False])
@pytest.mark.parametrize("in_time", [False, True])
def test_load_that_raises_on_one_rank(in_time, sendable):
    """All ranks leave the run with its words, and the last step stays."""

    class LocalError(Exception):
        """Of a class that other ranks cannot look up."""

    def load(at):
        if at > 0.03 and COMM.rank == COMM.size - 1:
            raise (ValueError if sendable else LocalError)("no tide table")

    problem = Bar((0.0, -3.0), load=load).problem if in_time else pressed_blocks(load)
    steps = uem.time_steps(problem, 0.02, 0.06) if in_time else uem.load_steps(problem, 50)
    with pytest.raises(Exception, match="no tide table") as found:
        for _ in steps:
            before = problem.u.x.array.copy()
    assert np.array_equal(problem.u.x.array, before)
    kinds = COMM.allgather(found.value.__class__.__name__)
    assert set(kinds) == {"ValueError" if sendable else "LocalError" if COMM.size == 1 else "RuntimeError"}


# ---------------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize("kind", ["energy", "history"])
def test_table_made_before_the_checkpoint_is_read(kind, folder):
    """It refuses the first row and leaves the file alone; made after the checkpoint was read it goes on."""

    def run(end, early):
        bar, checkpoint = Bar((0.0, -3.0)), uem.Checkpoint(folder / "run", every=2)
        if not early:
            checkpoint.begin(bar.problem.state())
        path = folder / "table.csv"
        if kind == "energy":
            table = uem.EnergyBook(bar.problem, path=path, resume=True)
        else:
            table = uem.HistoryWriter(path, bar.problem, resume=True)
        with table:
            for step in uem.time_steps(bar.problem, 0.01, end, checkpoint=checkpoint):
                table.write(step)
        COMM.barrier()

    def text():
        COMM.barrier()
        return (folder / "table.csv").read_text().splitlines()

    run(0.04, early=True)
    before = text()
    assert len(before) == 5 + (kind == "energy")
    with pytest.raises(uem.CheckpointError, match="table.csv was made to go on with before the checkpoint was read"):
        run(0.06, early=True)
    assert text() == before
    run(0.06, early=False)
    after = text()
    assert after[: len(before)] == before and len(after) == len(before) + 2


# ---------------------------------------------------------------------------------------------- curvature of the contact


def test_curvature_is_the_sum_of_its_blocks():
    """Blocks of several pairs, over rows of other ranks, with nodes left out and a rank without any, against a loop."""
    n, g = 5, 2
    rng = np.random.default_rng(COMM.rank)
    du = PETSc.Vec().createMPI((n * g, PETSc.DETERMINE), bsize=g, comm=COMM)
    parts = []
    for m in (3, 4, 1):
        k = 0 if COMM.size > 1 and COMM.rank == COMM.size - 1 else 6
        nodes = rng.permuted(np.tile(np.arange(n * COMM.size), (k, 1)), axis=1)[:, :m]
        nodes[rng.random(nodes.shape) < 0.2] = -1
        parts.append((nodes, rng.normal(size=(k, m * g, m * g))))
    expected = np.zeros((n * COMM.size, g, n * COMM.size, g))
    for nodes, blocks_of in (part for ranks in COMM.allgather(parts) for part in ranks):
        for row, block in zip(nodes, blocks_of):
            for i, r in enumerate(row):
                for j, c in enumerate(row):
                    if r >= 0 and c >= 0:
                        expected[r, :, c] += block[i * g : (i + 1) * g, j * g : (j + 1) * g]
    expected = expected.reshape(n * g * COMM.size, -1)
    found = gathered_matrix(contact_curvature(parts, du))
    assert np.abs(found - expected).max() < 1e-14 * np.abs(expected).max()


@pytest.mark.parametrize("again", [False, True])
def test_curvature_without_equations(again):
    """Forces may outlive the last equation by an iteration; the united matrix then holds their curvature all the same."""
    b = blocks(COMM, "triangle", 2, 3)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[uem.Contact(b.high, b.low)])
    config = problem.config
    free = problem.forces.free[: config.n_owned]
    none = Restriction(config, UnitingEquations.join([], config.gdim), free, np.zeros(free.shape))
    K, pair = problem.forces.update_tangent(), problem.contacts[0].pair
    nodes = np.column_stack([config.to_global(pair.nodes), pair.projection.nodes])
    size = nodes.shape[1] * config.gdim
    blocks_of = np.random.default_rng(COMM.rank).normal(size=(len(nodes), size, size))
    G = contact_curvature([(nodes, blocks_of + blocks_of.transpose(0, 2, 1))], K.createVecRight())
    if again:
        problem.system.solver.set_operator(none, K, None)
    problem.system.solver.set_operator(none, K, G)
    used = gathered_vector(none.reduce(none._vector(np.ones(free.shape))))
    expected = used[:, None] * (gathered_matrix(K) + gathered_matrix(G)) * used
    expected += np.diag((1 - used) * np.diag(gathered_matrix(K)))
    found = gathered_matrix(problem.system.solver.A)
    assert np.abs(found - expected).max() < 1e-14 * np.abs(expected).max()
    # and without it the next matrix is as before
    problem.system.solver.set_operator(none, K, None)
    plain = used[:, None] * gathered_matrix(K) * used + np.diag((1 - used) * np.diag(gathered_matrix(K)))
    assert np.abs(gathered_matrix(problem.system.solver.A) - plain).max() < 1e-14 * np.abs(plain).max()
