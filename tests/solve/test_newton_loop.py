"""The Newton loop on a system of one unknown: what its line search accepts, and when it gives up; no mesh."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx.solve.newton import solve_united


def vector(value):
    v = PETSc.Vec().createSeq(1, comm=MPI.COMM_SELF)
    v.array[:] = value
    return v


class OneUnknown:
    """``F(u) = 0`` whose first full step leaves a given part of the residual, all later ones none; see ``UnitedSystem``."""

    linear = tolerant = in_contact = frictional = inexact = convex = False

    def __init__(self, left):
        self.left, self.u, self.solves = left, 0.0, 0
        self.lengths = []

    def F(self):
        if self.solves < 2:
            # straight down to the part that is left, no less however short the step
            return 1.0 - (1.0 - self.left) * self.u if self.left < 1.0 else 1.0 + 2.0 * self.u**2 - 0.5 * self.u
        return 0.0

    def place(self, returning):
        pass

    def assemble_residual(self):
        return True

    def unite(self, settled):
        R = vector(self.F())
        return SimpleNamespace(
            residual=R, norm=R.norm(), scale=1.0, rounding=0.0, strain_rounding=0.0, gap=0.0, active=0, changed=False, right=True,
            closed=True,
        )  # fmt: skip

    def forces_above_rounding(self):
        return 0.0

    def differentiate(self, first):
        pass

    def exchange(self, state, du, driving, accuracy):
        return None

    def linearise(self, state):
        self.solves += 1
        return vector(-self.F())

    def solve(self, rhs, accuracy, near):
        return vector(1.0), 1

    def complete(self, dq):
        return dq

    def move(self, state, dq):
        return dq

    def displacement(self):
        return self.u

    def displace(self, start, du, length):
        self.u = start + length * du.array_r[0]
        self.lengths.append(length)

    def inverted(self):
        return None

    def reduced_residual(self, state):
        return vector(self.F())


@pytest.mark.parametrize(("left", "length"), [(0.3, 1.0), (0.85, 1.0), (0.95, 1.0 / 64)])
def test_what_the_line_search_accepts(left, length):
    """A step that leaves 0.85 of the residual is taken whole, one that leaves 0.95 is shortened until nothing is left to shorten."""
    system = OneUnknown(left)
    history = solve_united(system, rtol=1e-8, max_iterations=10, line_search=True, verbose=False)
    assert history[1].step_length == length


@pytest.mark.parametrize("convex", [False, True])
def test_steps_go_on_downhill(convex):
    """Past a limit point forces grow at first: with a convex tangent steps go on as long as these drive the body that way."""

    class Hill(OneUnknown):
        """Its energy, ``cos u``, falls until u = pi; the tangent has no more than the step's sign."""

        def F(self):
            return -np.sin(0.05 + self.u)

        def linearise(self, state):
            self.solves += 1
            return vector(-self.F())

        def solve(self, rhs, accuracy, near):
            return vector(0.1 * np.sign(rhs.array_r[0])), 1

    system = Hill(1.0)
    system.convex = convex
    with pytest.raises(uem.ConvergenceError) as caught:
        solve_united(system, rtol=1e-8, max_iterations=1, line_search=True, verbose=False)
    # 0.05 + 0.1 * 16 < pi < 0.05 + 0.1 * 32
    assert caught.value.history[-1].step_length == (16.0 if convex else 1.0 / 64)


def test_no_convergence_is_an_error_with_its_history():
    """Never a silent end of the loop."""
    system = OneUnknown(0.5)
    system.linearise = lambda state: vector(-1.0)
    system.F = lambda: 1.0
    with pytest.raises(uem.ConvergenceError, match="no convergence in 4 iterations") as found:
        solve_united(system, rtol=1e-8, max_iterations=4, line_search=False, verbose=False)
    assert [i.residual for i in found.value.history] == [1.0] * 5


def test_exchanges_are_settled_by_loose_solves():
    """Who is wrong is asked of solutions to 1e-3, each begun where the last one ended; the last is as accurate as convergence asks for."""
    system, asked = OneUnknown(0.5), []
    system.inexact = system.in_contact = system.linear = True
    system.F = lambda: 1.0 if system.solves < 3 else 0.0

    def solve(rhs, accuracy, near):
        asked.append((accuracy, None if near is None else near.array_r[0]))
        return vector(float(len(asked))), 1

    def unite(settled):
        state = OneUnknown.unite(system, settled)
        state.trial = SimpleNamespace(reduce=lambda du: vector(10.0 * du.array_r[0]))
        return state

    def exchange(state, du, driving, accuracy):
        return unite(None) if len(asked) == 1 else None

    def linearise(state):
        system.solves += 1
        return vector(-1.0)

    system.linearise, system.solve, system.unite, system.exchange = linearise, solve, unite, exchange
    history = solve_united(system, rtol=1e-8, max_iterations=10, line_search=False, verbose=False)
    # the first may not be the last: contact has yet to be met
    assert asked[:3] == [(1e-3, None), (1e-3, 10.0), (1e-4, 2.0)]
    assert asked[3] == (1e-3, None) and asked[4] == (pytest.approx(1e-9), 4.0)
    assert [(i.exchanges, i.linear_iterations) for i in history] == [(1, 3), (0, 2), (0, 0)]
