"""Functions of users get copies: what they write into their arguments changes neither their next call nor the answer."""

from __future__ import annotations

from functools import wraps

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import blocks, clamp, highest, linear, modulus, raised, run
from restart_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx import compat

pytestmark = pytest.mark.every_case


def writes(f):
    """The function, which then spoils all arrays that it has got."""

    # with the number of its arguments
    @wraps(f)
    def spoiling(*arrays):
        found = np.array(f(*arrays))
        for array in arrays:
            if isinstance(array, np.ndarray):
                array[...] = -1.0
        return found

    return spoiling


def pressed(f, **contact):
    b = blocks(COMM, "triangle", 2, 3)
    value = (0.02, -0.01)
    F = linear(b.u, modulus(b.scene, 1.0, 2.0))
    own = uem.Contact(b.high, b.low, **contact)
    problem = uem.UnitedProblem(F, b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=value)], contacts=[own])
    run(problem, 2)
    return b.u.x.array


def soft(f, slope=None):
    return pressed(f, normal=uem.SoftContact(f(lambda g: 20.0 * np.maximum(-g, 0.0)), slope and f(slope)))


def soft_with_slope(f):
    return soft(f, lambda g: np.where(g < 0.0, -20.0, 0.0))


def friction(f):
    return pressed(f, friction=f(lambda x, t: 0.1 + 0.2 * t * x[0]))


def offset(f):
    return pressed(f, offset=f(lambda x: 1e-3 * x[0]))


def driven(f):
    b = blocks(COMM, "triangle", 2, 2)
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, None, f(lambda x, s: -0.01 * s * x[:2]))]
    run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)]), 2)
    return b.u.x.array


def periodic(f):
    b = blocks(COMM, "quadrilateral", 2, 2)
    tie = uem.periodic(b.high, b.low, map=f(lambda x: x * 1.0))
    run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.01), equations=[tie]))
    return b.u.x.array


def masses(f):
    b = blocks(COMM, "triangle", 2, 2)
    uem.nodal_mass(b.V, f(lambda x: 1.0 + x[:, 0]))
    return uem.nodal_mass(b.V, lambda x: 1.0 + x[:, 0]).diagonal


def heat(f):
    b = blocks(COMM, "triangle", 2, 2)
    W = compat.function_space(b.scene.mesh, [("Lagrange", 1, (2,)), ("Lagrange", 1)])
    w = fem.Function(W)
    (u, T), (v, q) = ufl.split(w), ufl.TestFunctions(W)
    F = (ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) + ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
    bcs = [uem.dirichlet(W.sub(0), b.bottom), uem.dirichlet(W.sub(0), b.top, None, (0.0, -0.01))]
    bcs += [uem.dirichlet(W.sub(1), b.bottom), uem.dirichlet(W.sub(1), b.top, value=1.0)]
    law = uem.Conductance(f(lambda p, g, T, t: 50.0 * p + 0.1 * (T + t)), field=1)
    run(uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=[uem.Contact(b.high, b.low, heat=law)]))
    return w.x.array


@pytest.mark.parametrize(
    "make", [soft, soft_with_slope, friction, offset, driven, periodic, masses, heat], ids=lambda f: f.__name__
)
def test_what_they_write_is_lost(make):
    """A law p(g) that wrote into its gaps never came to an end."""
    plain, spoilt = make(lambda f: f), make(writes)
    assert highest(COMM, np.abs(plain)) > 0.0
    assert highest(COMM, np.abs(spoilt - plain)) == 0.0


def words(*arrays):
    return ["a"] * np.shape(arrays[0])[-1]


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: soft(lambda f: words), r"normal, p\(g\) = "),
        (
            lambda: soft_with_slope(lambda f: f if f(np.ones(1))[0] == 0.0 and f(-np.ones(1))[0] > 0.0 else words),
            r"slope\(g\) = ",
        ),
        (lambda: heat(lambda f: lambda p, g, T, t: words(p)), r"heat, h\(p, g, T, T_target\) = "),
        (lambda: periodic(lambda f: words), r"the map of equations\[0\] = "),
    ],
    ids=["p", "slope", "h", "map"],
)
def test_words_in_place_of_numbers(make, named):
    raised(uem.InputTypeError, named, make)


@pytest.mark.parametrize("at", ["a", np.nan, None])
def test_a_load_factor_that_is_no_number(at):
    raised(uem.InputError if at is np.nan else uem.InputTypeError, "factor or time = ", lambda: Bar(4).problem.set_load(at))
