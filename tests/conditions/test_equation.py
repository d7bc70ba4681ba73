"""Linear equations between displacements of nodes, alone and among contacts.

Two tests to read first: ``test_a_sector_is_the_whole_ring``, where nodes of a contact follow each other over a turn, and
``test_as_scipy_eliminates``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import of_quarters
from dolfinx import fem
from helpers import (
    M,
    at,
    blocks,
    box,
    clamp,
    gathered_matrix,
    gathered_vector,
    highest,
    linear,
    modulus,
    refused,
    rotation,
    run,
    scene,
    st_venant,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from restart_scenes import continues_alike

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.conditions.independent_rows import _gauss_jordan

COMM = MPI.COMM_WORLD


class Cell:
    """A rectangle of 2 by 1, its sides and a displacement."""

    def __init__(self, cell="triangle", n=(3, 2), degree=1):
        self.scene = scene(COMM, cell, [box(cell, [0.0, 0.0], [2.0, 1.0], n)])
        self.V = compat.function_space(self.scene.mesh, degree, (2,))
        self.u = fem.Function(self.V, name="u")
        places = {"left": (0, 0.0), "right": (0, 2.0), "bottom": (1, 0.0), "top": (1, 1.0)}
        self.left, self.right, self.bottom, self.top = (self.scene.tag(name, 0, at(*where)) for name, where in places.items())

    def problem(self, *equations, bcs=(), law=linear, **how):
        return uem.UnitedProblem(law(self.u, 1.0), self.u, bcs=list(bcs), equations=list(equations), **how)

    def value(self, x, y, component):
        """A component of the displacement at a node (collective)."""
        X = self.u.function_space.tabulate_dof_coordinates()
        near = np.hypot(X[:, 0] - x, X[:, 1] - y) < 1e-9
        return highest(COMM, self.u.x.array.reshape(-1, 2)[: len(X)][near, component])


# -- alone -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree", "law"), [("triangle", 2, linear), ("quadrilateral", 1, st_venant)])
def test_a_periodic_cell_under_a_mean_strain(cell, degree, law):
    """Strain is the mean one everywhere, though nothing else holds the cell, and its shape grows along with the load steps."""
    c, H = Cell(cell, degree=degree), np.array([[0.02, 0.03], [-0.01, 0.01]])
    problem = c.problem(
        uem.periodic(c.right, c.left, jump=H @ (2.0, 0.0)), uem.periodic(c.top, c.bottom, jump=H @ (0.0, 1.0)), law=law
    )
    for step in uem.load_steps(problem, 2):
        x, u = problem.config.X[: problem.config.n_owned], problem.config.displacement[: problem.config.n_owned]
        left = u - step.factor * x @ H.T
        middle = COMM.allreduce(left.sum(axis=0)) / COMM.allreduce(len(left))
        assert highest(COMM, np.abs(left - middle)) <= 1e-14


def test_as_scipy_eliminates():
    """Displacements, reactions and P'KP of any equations, in chains, with given values and on conditions."""
    from scipy.linalg import null_space

    c = Cell("triangle", (4, 3))
    terms = [
        [((2.0, 1.0), (1, 0)), ((2.0, 0.0), (-0.5, 0.3)), ((0.0, 1.0), (0.0, 2.0))],
        [((2.0, 0.0), (0.2, 1)), ((1.0, 0.0), (0, -1)), ((0.0, 0.0), (1, 1))],
        [((1.0, 0.0), (3, 4))],
        [((0.5, 1.0), (1, 1)), ((2.0, 1.0), (1, -1)), ((1.0, 0.0), (0, 0.5))],
    ]
    b = np.array([0.01, -0.02, 0.03, 0.0])
    bcs = clamp(c.V, c.left, value=0.004)
    problem = c.problem(*(uem.Equation(t, value) for t, value in zip(terms, b)), bcs=bcs)
    problem.solve()
    config, n = problem.config, problem.config.n_owned
    X = np.concatenate(COMM.allgather(config.X[:n]))
    K, u = gathered_matrix(problem.bodies.tangent.K), gathered_vector(config.vector(config.displacement[:n]))
    A = np.zeros((4, len(X), 2))
    for i, own in enumerate(terms):
        for place, vector in own:
            A[i, np.linalg.norm(X - place, axis=1).argmin()] += vector
    held = np.repeat(np.isclose(X[:, 0], 0.0), 2)
    C = np.vstack([A.reshape(4, -1), np.eye(2 * len(X))[held]])
    h = np.append(b, np.full(held.sum(), 0.004))
    N, u0 = null_space(C), np.linalg.lstsq(C, h, rcond=None)[0]
    expected = u0 + N @ np.linalg.solve(N.T @ K @ N, -N.T @ K @ u0)
    assert np.abs(u - expected).max() <= 1e-13 * np.abs(u).max() + 1e-15
    P = gathered_matrix(problem.system.restriction().P)
    used = np.abs(P).max(axis=0) > 0
    assert used.sum() == N.shape[1] and np.abs(C @ P).max() <= 1e-14
    united = gathered_matrix(problem.bodies.tangent.K.PtAP(problem.system.restriction().P))[np.ix_(used, used)]
    assert np.abs(united - (P.T @ K @ P)[np.ix_(used, used)]).max() <= 1e-14 * np.abs(K).max()
    lam = np.linalg.lstsq(C.T, K @ u, rcond=None)[0]
    on_left = (np.eye(2 * len(X))[held].T @ lam[4:]).reshape(-1, 2).sum(axis=0)
    assert np.abs(problem.reaction(c.left) - on_left).max() <= 1e-13 * np.abs(lam).max()


def test_values_between_steps():
    """A number is ramped, a Constant as well unless the load sets it, and a function is evaluated at each load factor."""
    c = Cell()
    clamped = clamp(c.V, c.left)
    ramped, loaded = fem.Constant(c.scene.mesh, 0.02), fem.Constant(c.scene.mesh, 0.0)
    end = [((2.0, 0.0), (0, 1))], [((2.0, 0.5), (0, 1))], [((2.0, 1.0), (0, 1))], [((2.0, 0.0), (1, 0))]
    values = 0.01, ramped, loaded, lambda factor: 0.04 * factor**2
    problem = c.problem(*map(uem.Equation, end, values), bcs=clamped, load={loaded: 0.03})
    for step in uem.load_steps(problem, 2):
        s = step.factor
        found = c.value(2, 0, 1), c.value(2, 0.5, 1), c.value(2, 1, 1), c.value(2, 0, 0)
        assert np.allclose(found, (0.01 * s, 0.02 * s, 0.03 * s, 0.04 * s**2), rtol=1e-13)
    ramped.value = -0.02
    (first, _) = uem.load_steps(problem, 2)
    problem.solve()
    assert c.value(2, 0.5, 1) == pytest.approx(-0.02, rel=1e-13) and first.factor == 0.5


def test_continues_from_a_checkpoint(folder):
    """Load steps that continue from a file end where those of one run do, to the last bit; without the equations they are refused."""
    ends = []
    for stop in (3, 1, 3):
        c = Cell()
        equations = [uem.Equation([((2.0, 1.0), (0, 1))], b=0.01), uem.Equation([(c.right, (1, 0)), ((2.0, 0.0), (-1, 0))])]
        problem = c.problem(*equations, bcs=clamp(c.V, c.left), law=st_venant)
        checkpoint = uem.Checkpoint(folder / "run", every=1) if ends else None
        for step in uem.load_steps(problem, 3, checkpoint=checkpoint):
            if step.number == stop + 1 and stop < 3:
                break
        ends.append(np.array(c.u.x.array))
    continues_alike(ends[2], ends[0])
    assert not np.array_equal(ends[1], ends[0])
    c = Cell()
    problem = c.problem(bcs=clamp(c.V, c.left), law=st_venant)
    refused(uem.CheckpointError, "equations", lambda: next(uem.load_steps(problem, 3, checkpoint=uem.Checkpoint(folder / "run"))))


def test_a_level_top():
    """One equation for each node of a surface: it stays level under a load at its side, and all of the load goes to the support."""
    c = Cell("quadrilateral")
    level = uem.Equation([(c.top, (0, 1)), ((2.0, 1.0), (0, -1))])
    load = 1e-3 * ufl.TestFunction(c.V)[1] * uem.ds(c.right)
    problem = uem.UnitedProblem(linear(c.u, 1.0) - load, c.u, bcs=clamp(c.V, c.bottom), equations=[level])
    problem.solve()
    first = c.value(0, 1, 1)
    assert c.value(2, 1, 1) == pytest.approx(first, rel=1e-12) and c.value(4 / 3, 1, 1) == pytest.approx(first, rel=1e-12)
    assert c.value(2, 0.5, 1) > 1.1 * first
    assert problem.reaction(c.bottom)[1] == pytest.approx(-1e-3, rel=1e-10)


def test_pieces_move_as_one_in_time():
    """Two blocks whose common nodes are equal are one piece: its motion, and its first acceleration."""
    b = blocks(COMM, "triangle", 3, 3)
    s = scene(COMM, "triangle", [box("triangle", [0.0, -1.0], [1.0, 1.0], [3, 6])])
    V = compat.function_space(s.mesh, 1, (2,))
    found = []
    for u, bottom, equations, own in (
        (b.u, b.bottom, [uem.periodic(b.high, b.low)], b.scene),
        (fem.Function(V), s.tag("bottom", 0, at(1, -1.0)), [], s),
    ):
        space = u.function_space
        dynamics = uem.Dynamics(uem.consistent_mass(space, 1.0), gravity=(0.3, -1.0), scheme=uem.newmark())
        problem = uem.UnitedProblem(st_venant(u, 30.0), u, bcs=clamp(space, bottom), equations=equations, dynamics=dynamics)
        for _ in uem.time_steps(problem, 0.05, 0.2):
            pass
        x, values = own.drawing, own.gather(u)
        places, first = np.unique(np.round(x, 9), axis=0, return_index=True)
        found.append((places, values[first], dynamics.momentum()))
    (places, u, momentum), (of_one, v, p) = found
    assert np.array_equal(places, of_one)
    assert np.abs(u - v).max() <= 1e-11 * np.abs(v).max() and np.abs(momentum - p).max() <= 1e-10 * np.abs(p).max()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_rows_that_follow_are_found(seed):
    """``R = T A`` spans the rows that do not follow, each with a column of its own, and spared columns last."""
    rng = np.random.default_rng(seed)
    A = rng.integers(-2, 3, (4, 7)).astype(float)
    A[:, 6] = 1.0
    A = np.insert(A, 2, A[0] - 2 * A[1], axis=0)
    free, spare = np.arange(7) < 6, np.arange(7) == 0
    R, T, pivot = _gauss_jordan(A, free, spare)
    kept = pivot >= 0
    rank = np.linalg.matrix_rank(A[:, :6])
    assert kept.sum() == rank and np.abs(R - T @ A).max() <= 1e-12
    assert np.array_equal(np.round(R[np.ix_(kept, pivot[kept])], 12), np.eye(rank))
    first = [np.linalg.matrix_rank(A[: i + 1, :6]) > np.linalg.matrix_rank(A[:i, :6]) if i else A[0, :6].any() for i in range(5)]
    assert np.array_equal(kept, first)
    assert 0 not in pivot or np.linalg.matrix_rank(A[:, 1:6]) < rank


# -- among contacts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("coupling", "friction"), [("node_to_surface", 0.0), ("mortar", 0.3)])
def test_contactors_that_are_periodic(coupling, friction):
    """The corners of both bodies follow their images and each other; the column is compressed evenly."""
    b = blocks(COMM, "triangle", 2, 3 if coupling == "mortar" else 4)
    sides = {(body, end): b.scene.tag("side", body, at(0, end)) for body in (0, 1) for end in (0.0, 1.0)}
    contact = uem.Contact(b.high, b.low, coupling=coupling, friction=friction)
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, contacts=[contact],
        bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0), *clamp(b.V, b.top, 1, value=-0.02)],
        equations=[uem.periodic(sides[body, 1.0], sides[body, 0.0]) for body in (0, 1)],
    )  # fmt: skip
    run(problem, 2)
    x, u = problem.config.X, problem.config.displacement
    assert highest(COMM, np.abs(u - np.outer(x[:, 1] + 1, [0.0, -0.01]))) <= 1e-15
    assert contact.resultant().force[1] == pytest.approx(0.01 * M, rel=1e-12)
    assert problem.reaction(b.bottom)[1] == pytest.approx(0.01 * M, rel=1e-12)


@pytest.mark.parametrize("lift", [0.0, 2e-3])
def test_contactors_that_an_equation_holds(lift):
    """Level corners touch both, and one equation of three is left out; where one is to be higher, it does not touch."""
    c = Cell("quadrilateral", (2, 1))
    contact = uem.Contact(c.bottom, uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    corners = uem.Equation([((2.0, 0.0), (0, 1)), ((0.0, 0.0), (0, -1))], b=lift)
    bcs = [*clamp(c.V, c.top, 0), *clamp(c.V, c.top, 1, value=-0.01)]
    problem = c.problem(corners, bcs=bcs, contacts=[contact])
    run(problem, 2)
    assert c.value(2, 0, 1) == pytest.approx(lift, abs=1e-15) and c.value(0, 0, 1) == pytest.approx(0.0, abs=1e-15)
    assert problem.reaction(c.top)[1] == pytest.approx(-contact.resultant().force[1], rel=1e-12)
    assert contact.n_active == (3 if lift == 0.0 else 2)
    here = problem.linear.multipliers
    # without a lift the plane carries all
    assert (highest(COMM, np.abs(here)) > 1e-4) == (lift > 0.0)


def ring(part, law=st_venant):
    """A quarter, or all, of a ring that shrinks onto a rigid cylinder under a pressure that changes four times around."""
    s = of_quarters(COMM, part, 12)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v, x = fem.Function(V, name="u"), ufl.TestFunction(V), ufl.SpatialCoordinate(s.mesh)
    inner, outer = s.tag("inner", 0, at(0, 1.0)), s.tag("outer", 0, at(0, 1.3))
    c, d = x[0] ** 2 - x[1] ** 2, 2 * x[0] * x[1]
    pressure = 0.02 * (1 + 0.8 * (c**2 - d**2) / (c**2 + d**2))
    F = law(u, 1.0) + pressure * ufl.dot(ufl.FacetNormal(s.mesh), v) * uem.ds(outer)
    equations = []
    if part == 1:
        cuts = s.tag("first", 0, at(1, 0.0)), s.tag("second", 0, at(1, 0.5 * np.pi))
        equations = [uem.periodic(cuts[1], cuts[0], turn=rotation(2, 0.5 * np.pi))]
    contact = uem.Contact(inner, uem.RigidSphere((0.0, 0.0), 0.99))
    problem = uem.UnitedProblem(F, u, contacts=[contact], equations=equations)
    return problem, contact, s


def test_a_sector_is_the_whole_ring():
    """Displacements and pressures of a sector are those of the ring, with contactors on both cuts."""
    found = []
    for part in (4, 1):
        problem, contact, s = ring(part)
        run(problem, 2)
        x, u, p = s.drawing, s.gather(problem.u), s.gather(contact.pressure)
        inside = x[:, 1] <= 0.5 * np.pi + 1e-9
        order = np.lexsort(np.round(x[inside], 9).T)
        found.append((u[inside][order], p[inside][order]))
        assert contact.n_active == 12 * part + (part == 1)
    (u, p), (of_sector, pressure) = found
    assert np.abs(of_sector - u).max() <= 1e-11 * np.abs(u).max()
    assert np.abs(pressure - p).max() <= 1e-11 * np.abs(p).max()


# -- refusals --------------------------------------------------------------------------------------------------------------


def test_what_contradicts():
    """Equations that follow from others are left out as long as their values agree with these and with the conditions."""
    for miss, fine in ((5e-9, True), (1e-7, False)):
        c = Cell()
        jump = np.array([0.01, 0.0])
        problem = c.problem(
            uem.periodic(c.right, c.left, jump=jump), uem.periodic(c.top, c.bottom),
            bcs=[*clamp(c.V, c.left, 0), *clamp(c.V, c.right, 0, value=0.01 * (1 + miss)), *clamp(c.V, c.bottom, 1)],
        )  # fmt: skip
        if fine:
            problem.solve()
        else:
            refused(uem.ConflictError, ("contradicts", "missed by 1e-09"), problem.solve)
