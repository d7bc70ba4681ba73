"""Places of nodes that users name, and what is said where there are none; refusals of equations by their form."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, linear, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.conditions.places import nodes_at, partners
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def square():
    """A unit square of four by two triangles, its space and its configuration."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 4])])
    V = compat.function_space(s.mesh, 1, (2,))
    return s, V, Configuration(fem.Function(V))


def test_how_near_a_node_must_be(square):
    """One node of one rank, if it is a thousandth of the distance to the next one away, at most; partners likewise tell both."""
    _, _, config = square
    for part, found in ((2e-4, True), (5e-3, False)):
        place = (0.5, 0.5 + part * 0.25)
        if found:
            nodes = nodes_at(config, place, "the place")
            assert COMM.allreduce(len(nodes)) == 1 and np.allclose(config.X[nodes], (0.5, 0.5))
        else:
            refused(uem.InputError, ("no node is there", "(0.5, 0.5)"), lambda place=place: nodes_at(config, place, "the place"))
    b = blocks(COMM, "triangle", 1, 1)
    refused(uem.InputError, "several nodes are there", lambda: nodes_at(Configuration(b.u), (1.0, 0.0), "the place"))
    left, right = ([b.scene.tag("side", body, at(0, end)) for body in (0, 1)] for end in (0.0, 1.0))
    both = uem.periodic(right, left)
    refused(uem.SurfaceError, "several partners", lambda: both.rows(Configuration(b.u), "equations[0]"))
    own = np.flatnonzero(np.isclose(config.X[: config.n_owned, 0], 1.0)).astype(np.int32)
    numbers, distance, following = partners(config, config.X[own] + [0.0, 1e-3], own)
    assert np.array_equal(numbers, config.to_global(own))
    assert np.allclose(distance, 1e-3) and np.abs(following - 0.25).max(initial=0.0) <= 1.1e-3


def test_refused_by_their_form():
    u = (0.0, 1.0), (0, 1)
    for error, words, call in (
        (uem.InputTypeError, "terms", lambda: uem.Equation(3)),
        (uem.InputTypeError, "terms[0] = 'a'", lambda: uem.Equation(["a"])),
        (uem.InputError, "the vector of terms[0]", lambda: uem.Equation([((0.0, 1.0), (1, 2, 3, 4))])),
        (uem.InputError, "b = [0.0, 1.0]", lambda: uem.Equation([u], b=[0.0, 1.0])),
        (uem.InputTypeError, "b = 'one'", lambda: uem.Equation([u], b="one")),
        (uem.InputError, "turn", lambda: uem.periodic([], [], turn=[[1, 2], [3, 4]])),
        (uem.InputTypeError, "map", lambda: uem.periodic([], [], map=3)),
        (uem.InputError, "jump", lambda: uem.periodic([], [], jump=np.nan)),
    ):
        refused(error, words, call)


def test_refused_in_a_problem(square):
    s, V, _ = square
    left, right, top = s.tag("left", 0, at(0, 0.0)), s.tag("right", 0, at(0, 1.0)), s.tag("top", 0, at(1, 1.0))
    u, bcs = fem.Function(V), clamp(V, left)

    def problem(*equations):
        return lambda: uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, equations=list(equations))

    lift = uem.Equation([((1.0, 1.0), (0, 1)), ((0.5, 1.0), (0, -1))])
    for error, words, call in (
        (uem.InputTypeError, "equations[0] = 3", problem(3)),
        (uem.InputError, ("terms[0] of equations[0]", "no node is there"), problem(uem.Equation([((0.4, 0.3), (0, 1))]))),
        (uem.InputError, "the vector of terms[0]", problem(uem.Equation([((1.0, 1.0), (0, 1, 0))]))),
        (uem.InputError, "several nodes each", problem(uem.Equation([(right, (0, 1)), (top, (0, 1))]))),
        (uem.TagError, "expected a tag", problem(uem.Equation([("top", (0, 1))]))),
        (uem.ConflictError, ("equations[0]", ", 1)", "prescribed"), problem(uem.Equation([((0.0, 1.0), (0, 1))]))),
        (uem.ConflictError, "cancel", problem(uem.Equation([((1.0, 1.0), (0, 1)), ((1.0, 1.0), (0, -1))]))),
        (
            uem.ConflictError,
            ("equations[1]", "follows"),
            problem(lift, uem.Equation([((1.0, 1.0), (0, 2)), ((0.5, 1.0), (0, -2))])),
        ),
        (uem.SurfaceError, ("'top' has 3 nodes", "'right' 5"), problem(uem.periodic(top, right))),
        (uem.SurfaceError, "no partner", problem(uem.periodic(right, left, map=lambda x: x * [0.0, 0.9]))),
        (uem.SurfaceError, ("is its own image on 'top'", "two surfaces"), problem(uem.periodic(top, top))),
        (
            uem.SurfaceError,
            (", 0.5)", "its own image on 'right'", "with a jump"),
            problem(uem.periodic(right, right, map=lambda x: x * [1.0, -1.0] + [0.0, 1.0], jump=lambda s: (0.01 * s, 0.0))),
        ),
        (uem.InputError, "the map of equations[0]", problem(uem.periodic(right, left, map=lambda x: x[:1]))),
        (uem.UserFunctionError, "the value of equations[0]", problem(uem.Equation([((1.0, 1.0), (0, 1))], b=lambda s: 1 / 0))),
    ):
        refused(error, words, call)
