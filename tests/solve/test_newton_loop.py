"""The Newton loop on a system of one unknown: what its line search accepts, and when it gives up; no mesh."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx.solve.bodies.bodies import MOST_PAST
from uem_dolfinx.solve.united.equilibrium import IterationState
from uem_dolfinx.solve.united.newton import FORCING, Increment, LinearisedProblem, solve_united


def vector(value):
    v = PETSc.Vec().createSeq(1, comm=MPI.COMM_SELF)
    v.array[:] = value
    return v


class OneUnknown:
    """``F(u) = 0`` whose first full step leaves a given part of the residual, all later ones none: bodies and ``ContactMethod`` in one."""

    exact, iterative, passing, fits, convex, in_contact = True, False, False, False, False, False
    unknowns = SimpleNamespace(norms=PETSc.Vec.norm, work=PETSc.Vec.dot, mixed=False)
    most_past = np.inf

    def __init__(self, left):
        self.left, self.u, self.solves = left, 0.0, 0
        self.lengths, self.active_sets = [], 0

    def F(self):
        if self.solves < 2:
            # straight down to the part that is left, no less however short the step
            return 1.0 - (1.0 - self.left) * self.u if self.left < 1.0 else 1.0 + 2.0 * self.u**2 - 0.5 * self.u
        return 0.0

    def assemble(self):
        return True

    def displacement(self):
        return self.u

    def displace(self, start, du, length):
        self.u = start + length * du.array_r[0]
        self.lengths.append(length)

    def inverted(self):
        return None

    def above_rounding(self, in_contact):
        return 0.0

    def strain_rounding(self):
        return 0.0

    def place(self):
        pass

    def return_to_targets(self, bound):
        return False

    def assemble_constraints(self, in_equilibrium):
        R, rows = vector(self.F()), SimpleNamespace(unknowns=lambda du: vector(10.0 * du.array_r[0]))
        return IterationState(rows, rows, R, R.norm(), 1.0, 0.0, 0.0, 0, False, True, True, self.in_contact)

    def linearise(self, state, iteration):
        self.solves += 1
        return LinearisedProblem(state, vector(-self.F()), self.exact, self.iterative, self.passing, self.fits, self.convex)

    def solve(self, problem, accuracy, near):
        dq = vector(self.answer(problem.rhs, accuracy, near))
        return Increment(dq, dq, problem.rhs, 1, accuracy)

    def answer(self, rhs, accuracy, near):
        return 1.0

    def exchange(self, problem, step):
        if self.active_sets == 0:
            return None
        self.active_sets -= 1
        return self.assemble_constraints(None)

    def complete(self, problem, step):
        return step

    def reduced_residual(self, state):
        return vector(self.F())

    def loop(self, max_iterations=10, line_search=True):
        """The history of the Newton loop."""
        return solve_united(self, self, rtol=1e-8, max_iterations=max_iterations, line_search=line_search, verbose=False)


@pytest.mark.parametrize(
    ("left", "yields", "length"),
    [
        (0.3, False, 1.0), (0.85, False, 1.0), (0.95, False, 1.0 / 64), (-0.85, False, 1.0), (-0.95, False, 0.5),
        (0.85, True, 1.0), (-0.45, True, 1.0), (-0.55, True, 0.5),
    ],
)  # fmt: skip
def test_what_the_line_search_accepts(left, yields, length):
    """A step that leaves 0.85 of the residual, or 0.45 past its zero where bodies yield, is taken whole; others are shortened."""
    system = OneUnknown(left)
    system.most_past = MOST_PAST if yields else np.inf
    assert system.loop()[1].step_length == length


@pytest.mark.parametrize("convex", [False, True])
def test_steps_go_on_downhill(convex):
    """Past a limit point forces grow at first: with a convex tangent steps continue as long as these drive the body that way."""

    class Hill(OneUnknown):
        """Its energy, ``cos u``, falls until u = pi; the tangent has no more than the step's sign."""

        def F(self):
            return -np.sin(0.05 + self.u)

        def answer(self, rhs, accuracy, near):
            return 0.1 * np.sign(rhs.array_r[0])

    system = Hill(1.0)
    system.convex = convex
    with pytest.raises(uem.ConvergenceError) as caught:
        system.loop(max_iterations=1)
    # 0.05 + 0.1 * 16 < pi < 0.05 + 0.1 * 32
    assert caught.value.history[-1].step_length == (16.0 if convex else 1.0 / 64)


def test_no_convergence_is_an_error_with_its_history():
    """Never a silent end of the loop."""
    system = OneUnknown(0.5)
    system.F = lambda: 1.0
    with pytest.raises(uem.ConvergenceError, match="no convergence in 4 iterations") as found:
        system.loop(max_iterations=4, line_search=False)
    assert [i.residual for i in found.value.history] == [1.0] * 5


@pytest.mark.parametrize("largest", [1e2, 1e8])
def test_a_residual_that_comes_back_is_waited_for(largest):
    """One blow, however large, that Newton's method takes back in many iterations."""
    system = OneUnknown(0.5)
    system.F = lambda: 1.0 if system.solves == 0 else largest * 0.2**system.solves
    assert system.loop(max_iterations=40, line_search=False)[-1].residual <= 1e-8


def test_exchanges_are_settled_by_loose_solves():
    """Contactors in a wrong state are found by loose solves, each from the last solution; the last solve is as accurate as required."""
    system, requested = OneUnknown(0.5), []
    system.exact, system.iterative, system.in_contact, system.active_sets = False, True, True, 1
    system.F = lambda: 1.0 if len(requested) < 4 else 0.0

    def answer(rhs, accuracy, near):
        requested.append((accuracy, None if near is None else near.array_r[0]))
        return float(len(requested))

    system.answer = answer
    history = system.loop(line_search=False)
    # the first may not be the last: contact has yet to be met
    assert requested[:2] == [(FORCING, None), (FORCING, 10.0)]
    assert requested[2] == (FORCING, None) and requested[3] == (pytest.approx(1e-9), 3.0)
    assert [(i.exchanges, i.linear_iterations) for i in history] == [(1, 2), (0, 2), (0, 0)]


def test_solves_on_the_way_leave_the_more_the_less_is_known():
    """Where tangents change a solve leaves a part of the right-hand side that falls with the residual, and no less than is required."""
    system, requested = OneUnknown(0.5), []
    system.exact, system.passing = False, True
    system.F = lambda: (1.0, 1e-2, 1e-5, 1e-9)[len(requested)]
    system.answer = lambda rhs, accuracy, near: requested.append(accuracy) or 1.0
    system.loop(line_search=False)
    assert requested == pytest.approx([FORCING, 1e-2 * FORCING, 0.1 * 1e-8 / 1e-5])
