"""What a load drives is the same in all kinds of steps: terms of F, conditions, equations, couplings, points, preloads.

The test to read first is ``test_steps_reach_what_was_written``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, linear, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
KINDS = ("term", "condition", "equation", "motion", "force", "point")
#: Kinds whose value is a displacement.
PRESCRIBED = ("condition", "equation", "motion")
SIZE = 0.01


class Block:
    """A block on rollers whose top is pulled or moved along y by the value of a Constant, or of a function of the load factor."""

    def __init__(self, kind, value=None, **how):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 2])])
        self.V, self.kind = compat.function_space(s.mesh, 1, (2,)), kind
        self.u, v = fem.Function(self.V, name="u"), ufl.TestFunction(self.V)
        self.bottom, self.top = s.tag("bottom", 0, at(1, 0.0)), s.tag("top", 0, at(1, 1.0))
        vector = kind in ("force", "point")
        self.y = y = fem.Constant(s.mesh, np.zeros(2) if vector else 0.0)
        self.value = value = y if value is None else value
        F, bcs = linear(self.u, 1.0), [uem.dirichlet(self.V, self.bottom)]
        if kind == "term":
            F -= y * v[1] * uem.ds(self.top)
        elif kind == "condition":
            bcs.append(uem.dirichlet(self.V, self.top, 1, value))
        elif kind == "equation":
            how["equations"] = [uem.Equation([(self.top, (0.0, 1.0))], value)]
        elif kind == "motion":
            how["couplings"] = [uem.RigidCoupling(self.top, (0.5, 1.0), motion=(0.0, value, 0.0))]
        elif kind == "force":
            how["couplings"] = [uem.RigidCoupling(self.top, (0.5, 1.0), force=value)]
        else:
            how["points"] = [uem.PointLoad((1.0, 1.0), value)]
        self.bcs, self.full = bcs, np.array([0.0, SIZE]) if vector else SIZE
        self.problem = uem.UnitedProblem(F, self.u, bcs=bcs, **{name: f(self) if callable(f) else f for name, f in how.items()})

    def found(self):
        """The value that acts on the block, of its size (collective)."""
        if self.kind in PRESCRIBED:
            return uem.integrate(self.u[1] * uem.ds(self.top)) / SIZE
        return -self.problem.reaction(self.bottom)[1] / SIZE


def to_and_fro(s):
    """A way of a load, of its size."""
    return np.sin(2.3 * s) + s**2


def led(block, how):
    """A load of a block that is led to its full value or by a function."""
    return {block.y: block.full if how == "number" else lambda s: block.full * to_and_fro(s)}


def way(how):
    """The part of a load's size at a factor."""
    return (lambda s: s) if how == "number" else to_and_fro


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["number", "function"])
def test_steps_reach_what_was_written(kind, how):
    """Each value is f(s), in ``load`` and in a Step, in one call of load_steps and the next; solve takes f(1)."""
    f = way(how)
    for driver in ("load", "Step"):
        block = Block(kind, **({"load": lambda b: led(b, how)} if driver == "load" else {}))
        for _ in range(2 if driver == "load" or how == "function" else 1):
            steps = 2 if driver == "load" else [uem.Step("go", 2, loads=led(block, how))]
            found = [(s.factor, block.found()) for s in uem.load_steps(block.problem, steps)]
            assert np.allclose([value for _, value in found], [f(s) for s, _ in found], rtol=0, atol=1e-9)
    block = Block(kind, load=lambda b: led(b, how))
    block.problem.solve()
    assert abs(block.found() - f(1.0)) <= 1e-9
    for _ in uem.load_steps(block.problem, 2):
        break
    block.problem.solve()
    assert abs(block.found() - f(1.0)) <= 1e-9


@pytest.mark.parametrize("kind", ["equation", "motion", "force"])
def test_functions_of_the_factor(kind):
    """Functions that equations and couplings have been given are those of the factor in load_steps, and of 1 in solve."""
    size = np.array([0.0, SIZE]) if kind == "force" else SIZE
    block = Block(kind, lambda s: size * to_and_fro(s))
    block.problem.solve()
    assert abs(block.found() - to_and_fro(1.0)) <= 1e-9
    for step in uem.load_steps(block.problem, 3):
        assert abs(block.found() - to_and_fro(step.factor)) <= 1e-9


@pytest.mark.parametrize("kind", PRESCRIBED)
def test_values_beside_the_load_are_ramped(kind):
    """Constants and numbers that no load sets grow from where the ramp began; solve takes them in full."""
    for value in (None, SIZE):
        block = Block(kind, value)
        block.y.value = SIZE
        found = [block.found() - step.factor for step in uem.load_steps(block.problem, 2)]
        assert np.abs(found).max() <= 1e-9
        block.y.value = 2 * SIZE
        block.problem.solve()
        assert abs(block.found() - (2.0 if value is None else 1.0)) <= 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_a_function_as_load(kind):
    """A function sets all values itself, none of which is ramped; solve calls it with 1, unless it has been called for the step."""

    def make():
        block = Block(kind, load=lambda b: lambda s: b.y.value.__setitem__(..., b.full * to_and_fro(s)))
        return block, block.problem

    block, problem = make()
    for step in uem.load_steps(problem, 2):
        assert abs(block.found() - to_and_fro(step.factor)) <= 1e-9
    problem.load(0.3)
    problem.solve()
    assert abs(block.found() - to_and_fro(0.3)) <= 1e-9
    problem.solve()
    assert abs(block.found() - to_and_fro(1.0)) <= 1e-9


def test_a_step_that_fails_leaves_its_loads():
    """After a solve that failed, loads are those of the state that is left."""
    block = Block("term", load=lambda b: {b.y: lambda s: np.nan if s == 1.0 else SIZE * s})
    for _ in uem.load_steps(block.problem, 2):
        break
    refused(uem.InputError, "the value of a Constant in load", block.problem.solve)
    assert abs(float(block.y.value) - 0.5 * SIZE) <= 1e-15


@pytest.mark.parametrize("value", [0.5, np.zeros(2)])
def test_a_function_that_returns_its_value(value):
    """One function for all loads sets them itself: what it returns would be lost."""
    block = Block("term", load=lambda b: lambda s: value)
    refused(uem.InputError, ("the result of load(0)", "returns none", "{constant: function}"), block.problem.solve)


def test_a_constant_that_nothing_follows():
    """It is refused by name; what a form, condition, equation, coupling, point, contact or function holds is not."""
    free = fem.Constant(Block("term").u.function_space.mesh, 0.0)
    words = ("item 2 of load", "a Constant that is 0.0 now", "nothing follows it")
    for kind in KINDS:
        refused(uem.InputError, words, lambda kind=kind: Block(kind, load=lambda b: {b.y: b.full, free: 3.0}))
        refused(
            uem.InputError,
            ("the loads of step 1, 'go'", "nothing follows it"),
            lambda kind=kind: uem.load_steps(Block(kind).problem, [uem.Step("go", loads={free: 3.0})]),
        )
    # functions that read it follow it
    holder = {"c": free}
    for f in (lambda s: float(free.value), lambda s: float(holder["c"].value)):
        block = Block("equation", f, load=lambda b: {free: SIZE})
        block.problem.solve()
        assert abs(block.found() - 1.0) <= 1e-9
        refused(
            uem.InputError, "item 2 of load", lambda f=f: Block("term", load=lambda b: {b.y: 1.0, fem.Constant(b.V.mesh, 0.0): f})
        )


def test_a_condition_of_a_later_step_follows():
    """A Constant that a step sets may be the value of a condition that another step has."""
    block = Block("term")
    y = fem.Constant(block.V.mesh, 0.0)
    held = [*block.bcs, uem.dirichlet(block.V, block.top, 1, y)]
    steps = [uem.Step("first", loads={y: SIZE}), uem.Step("then", 2, bcs=held)]
    for _ in uem.load_steps(block.problem, steps):
        pass
    assert abs(uem.integrate(block.u[1] * uem.ds(block.top)) - SIZE) <= 1e-9 * SIZE
