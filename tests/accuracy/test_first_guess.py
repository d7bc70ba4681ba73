"""Displacements of a mesh on the next one: exact for what cells hold, right on curved cells, body by body, and fewer iterations.

Read first: ``test_fewer_iterations``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import refused, slow
from seal_scenes import Seal

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.accuracy.adapt import carry_over
from uem_dolfinx.errors import ConvergenceError

COMM = MPI.COMM_WORLD


def blocks(n, dim=2, quads=0, degree=1, order=1, friction=0.0):
    """Two unit blocks whose surfaces lie on each other, on their own meshes."""
    parameters = {"dim": dim, "n_1": n, "n_2": n + 1, "quads": quads, "order": order}
    mesh, tags = uem.read_gmsh(uem.example_mesh("blocks"), COMM, gdim=dim, parameters=parameters)
    V = uem.function_space(mesh, degree, (dim,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="3d" if dim == 3 else "plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["bottom_1"]), uem.dirichlet(V, tags["top_2"], dim - 1, -0.01)]
    contact = uem.Contact(tags["bottom_2"], tags["top_1"], friction=friction)
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])


@pytest.mark.long
@pytest.mark.parametrize(
    "dim, quads, degree, order", [(2, 0, 1, 1), slow(2, 1, 2, 1), slow(2, 1, 2, 2), (3, 0, 2, 2), slow(3, 1, 1, 1)]
)
def test_polynomials(dim, quads, degree, order):
    """Polynomials of the displacement's degree that differ from body to body arrive exactly, also where the bodies touch."""
    before, after = (blocks(n, dim, quads, degree, order) for n in (3, 5))

    def displacement(x, body):
        return np.stack([(0.1 + 0.2 * body) * x[0] ** degree - 0.3 * x[dim - 1], *((1 + body) * x[1:dim])])

    for problem in (before, after):
        u, config = problem.u, problem.config
        cells = np.arange(config.mesh.topology.index_map(dim).size_local, dtype=np.int32)
        middle = config.mesh.geometry.x[compat.geometry_dofs(config.mesh)[cells]].mean(axis=1)[:, dim - 1]
        for body in (0, 1):
            u.interpolate(lambda x, body=body: displacement(x, body), cells[(middle > 1) == body])
        u.x.scatter_forward()
    expected = after.u.x.array.copy()
    after.u.x.array[:] = 0.0
    carry_over(before, after)
    assert np.allclose(after.u.x.array, expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_fewer_iterations(coupling):
    """A seal at large strain: the same force and meshes as by two load steps from zero, by at most half as many iterations."""
    found = [Seal(coupling).adapt(tolerance=1e-3, solve_again=again) for again in (None, lambda problem: problem.solve())]
    cold, warm = ([mesh.iterations for mesh in one.meshes] for one in found)
    assert len(cold) == len(warm) > 1 and cold[0] == warm[0]
    assert sum(warm[1:]) <= 0.5 * sum(cold[1:])
    assert np.isclose(found[0].estimate.value, found[1].estimate.value, rtol=1e-6)


@pytest.mark.slow
def test_a_guess_that_leads_nowhere():
    """Where solve_again does not converge, solve solves the problem from its beginning."""

    def fails(problem):
        raise ConvergenceError("no solution")

    found = [Seal().adapt(tolerance=0.01, solve_again=again) for again in (None, fails)]
    assert [mesh.iterations for mesh in found[0].meshes] == [mesh.iterations for mesh in found[1].meshes]
    assert np.isclose(found[0].estimate.value, found[1].estimate.value, rtol=1e-6)


def test_paths():
    """Solutions that depend on the path take no first guess."""
    again = lambda problem: problem.solve()  # noqa: E731
    refused(uem.InputError, "friction", lambda: uem.adapt(lambda size: blocks(2, friction=0.3), tolerance=0.1, solve_again=again))
    refused(uem.InputTypeError, "solve_again", lambda: uem.adapt(lambda size: blocks(2), tolerance=0.1, solve_again=3))
