"""What errors say of load steps beyond the largest load that bodies bear: the limit point, and not the mesh."""

from __future__ import annotations

from mpi4py import MPI

import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, clamp, raised, st_venant

import uem_dolfinx as uem
from uem_dolfinx.errors import ConvergenceError, FrictionError

COMM = MPI.COMM_WORLD
#: The largest pressure that a bar of St Venant-Kirchhoff's law bears over its modulus without Poisson's ratio, at the stretch 1/sqrt(3).
LIMIT = 1 / (3 * 3**0.5)


def pressed(load, size):
    """A block of unit modulus pressed onto another by a dead load: load factors of the steps, and the error's words."""
    b = blocks(COMM, "quadrilateral", 1, 2)
    b.V.mesh.geometry.x[:] *= size
    v, p = ufl.TestFunction(b.V), fem.Constant(b.V.mesh, 0.0)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0)]
    law = uem.StVenantKirchhoff(1.0, 0.0, kind="plane_strain")
    F = law.residual(b.u, v) * ufl.dx + p * v[1] * uem.ds(b.top, b.V.mesh)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load={p: load}, max_iterations=8)
    factors = []
    error = raised(uem.ConvergenceError, "", lambda: factors.extend(step.factor for step in uem.load_steps(problem, 2)))
    return factors, str(error)


@pytest.mark.parametrize("size", [1e-9, 1e3])
@pytest.mark.slow
def test_beyond_the_largest_load(size):
    """Steps end at the limit load, and the error names it and the ways on, whatever the unit of length."""
    factors, words = pressed(2.0 * LIMIT, size)
    assert 0.4 < factors[-1] <= 0.5
    assert "no convergence in 8 iterations" in words and "negative eigenvalues" in words and "arc_length=True" in words
    assert "max_iterations" not in words and "no static path" not in words


@pytest.mark.parametrize("kind", [ConvergenceError, FrictionError])
def test_an_answer_takes_the_place_of_advice(kind):
    """What happened and where stays; finer facets and more iterations, which do not help there, go."""
    words = "the active set cycles: contactors touch and separate in turn: high on low at (0, 1), and 2 more"
    error = kind(f"{words}; take smaller load steps, or a target of finer facets there, or less friction")
    error.amend("shorter steps, down to 0.001, are no better")
    assert "finer facets" in str(error)
    error.amend("lead the bodies", instead=True)
    assert str(error) == f"{words}; shorter steps, down to 0.001, are no better; lead the bodies"
    error = kind("no convergence in 50 iterations: gap 0, 3 active contactors; take smaller load steps, or raise max_iterations")
    error.amend("lead the bodies", instead=True)
    assert str(error) == "no convergence in 50 iterations: gap 0, 3 active contactors; lead the bodies"


@pytest.mark.slow
@pytest.mark.parametrize("guided", [False, True])
def test_what_may_slide_almost_freely(guided):
    """A block that its contact alone holds: where that does not converge, the error says what may hold it, but not of a guided one."""
    b = blocks(COMM, "quadrilateral", 3, 2, degree=1)
    force = fem.Constant(b.V.mesh, 0.0)
    F = st_venant(b.u, 1.0) + force * ufl.TestFunction(b.V)[1] * uem.ds(b.top, b.V.mesh)
    bcs = [*clamp(b.V, b.bottom), *(clamp(b.V, b.scene.tag("side", 1, at(0, 0.0)), 0) if guided else [])]
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(20.0))
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load={force: 0.05}, max_iterations=1)
    error = raised(uem.ConvergenceError, "no convergence in 1 iterations", lambda: list(uem.load_steps(problem)))
    assert ("may slide or roll there almost freely: hold it" in str(error)) == (not guided)
