"""Dirichlet conditions of scripts: parts, components and values of any kind, and what cannot be."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, clamp, highest, linear, raised, refused, run
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def values(V, bcs):
    """What conditions prescribe: the drawing's nodes that they hold, with values; NaN at free components ``(n, size)``."""
    f = fem.Function(V)
    f.x.array[:] = np.nan
    compat.set_bc_values(f.x.array, bcs)
    return f


def held(b, bc, tag):
    """Values of a condition at all nodes, and which nodes are on the tag (collective)."""
    f = values(b.V, [bc])
    on = values(b.V, clamp(b.V, tag))
    return b.scene.gather(f), np.isfinite(b.scene.gather(on))


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_dirichlet(cell):
    b = blocks(COMM, cell)
    g, V, mesh = b.gdim, b.V, b.scene.mesh
    up = np.arange(1.0, g + 1)
    for component, value, expected in (
        (None, 0.0, np.zeros(g)), (None, 2.0, np.full(g, 2.0)), (None, up, up), (None, tuple(up), up),
        (0, 0.5, None), (g - 1, -1, None), (None, fem.Constant(mesh, up), up), (1, fem.Constant(mesh, PETSc.ScalarType(0.25)), None),
    ):  # fmt: skip
        found, on = held(b, uem.dirichlet(V, b.top, component, value), b.top)
        if component is None:
            expected = np.where(on, expected, np.nan)
        else:
            number = float(value.value) if isinstance(value, fem.Constant) else value
            expected = np.where(on & (np.arange(g) == component), number, np.nan)
        np.testing.assert_array_equal(found, expected)


def test_dirichlet_values_that_change():
    b = blocks(COMM, "triangle")
    place, field, scalar = (
        fem.Constant(b.scene.mesh, np.zeros(2)),
        fem.Function(b.V),
        fem.Function(uem.function_space(b.scene.mesh, 1)),
    )
    bcs = [uem.dirichlet(b.V, b.top, value=place), uem.dirichlet(b.V, b.top, value=field), uem.dirichlet(b.V, b.top, 1, scalar)]
    place.value[:] = (1.0, 2.0)
    field.interpolate(lambda x: x[:2])
    scalar.interpolate(lambda x: 3 * x[0])
    x = b.scene.drawing
    for bc, components, wanted in zip(bcs, ([0, 1], [0, 1], [1]), (np.tile((1.0, 2.0), (len(x), 1)), x, 3 * x[:, [0, 0]])):
        found, on = held(b, bc, b.top)
        on[:, np.setdiff1d([0, 1], components)] = False
        np.testing.assert_allclose(found, np.where(on, wanted, np.nan), atol=1e-15)


def test_dirichlet_of_a_scalar_space_and_of_degree_2():
    b = blocks(COMM, "triangle", degree=2)
    S = uem.function_space(b.scene.mesh, 1)
    for component in (None, 0):
        f = values(S, [uem.dirichlet(S, b.top, component, 4.0)])
        assert highest(COMM, np.nansum(f.x.array == 4.0)) > 0 and set(f.x.array[np.isfinite(f.x.array)]) <= {4.0}
    dofs, n = compat.bc_dofs(uem.dirichlet(b.V, b.top, 1))
    assert COMM.allreduce(n) == 9 and (dofs % 2 == 1).all()


def test_dirichlet_of_what_cannot_be():
    b, other = blocks(COMM, "triangle"), blocks(COMM, "triangle")
    last = COMM.rank == COMM.size - 1
    V, top = b.V, b.top
    scalar, constant = (fem.Function(uem.function_space(b.scene.mesh, one)) for one in (1, ("DG", 0)))
    for error, match, given in (
        (ValueError, "component = 2: expected one of 0 to 1", (V, top, 2)),
        (ValueError, "component = -1", (V, top, -1)),
        (ValueError, "component = 'x'", (V, top, "x")),
        (ValueError, "expected finite numbers", (V, top, 0, np.nan if last else 0.0)),
        (ValueError, "expected finite numbers", (V, top, None, (0.0, np.inf))),
        (ValueError, "expected finite numbers", (V, top, 0, fem.Constant(b.scene.mesh, PETSc.ScalarType(np.nan)))),
        (ValueError, "2 components.*shape \\(3,\\)", (V, top, None, (1.0, 2.0, 3.0))),
        (ValueError, "1 components.*shape \\(2,\\)", (V, top, 0, (1.0, 2.0))),
        (ValueError, "2 components.*shape \\(\\)", (V, top, None, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0)))),
        (uem.SpaceError, "is no Function of", (V, top, None, fem.Function(other.V))),
        (uem.SpaceError, "is no Function of", (V, top, None, scalar)),
        (uem.SpaceError, "is no Function of a scalar Lagrange space of degree 1", (V, top, 0, constant)),
        (uem.SpaceError, "no Lagrange space", (uem.function_space(b.scene.mesh, ("DG", 0), (2,)), top)),
        (uem.SpaceError, "another mesh", (V, other.top)),
        (uem.TagError, "holds no facets", (V, uem.Tag("none", 1, 1, b.scene.mesh, np.zeros(0, np.int32)))),
        (uem.TagError, "expected a tag", (V, "top")),
    ):  # fmt: skip
        raised(error, match, lambda given=given: uem.dirichlet(*given))


@pytest.mark.parametrize(("off", "warned"), [(0.5, 1), (3e-9, 1), (3e-10, 0), (0.0, 0)])
@pytest.mark.parametrize("size", [1e-9, 1e3])
def test_two_conditions_at_a_node(caplog, size, off, warned):
    """The last one counts, which is said where their values differ; not where they are equal, as at a common corner."""
    b = blocks(COMM, "quadrilateral", pose=lambda x: size * x)
    down = 0.01 * size
    first, last = (uem.dirichlet(b.V, b.top, 1, -value) for value in (down, (1.0 + off) * down))
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, 0), first, last]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)])
    run(problem, 2)
    assert highest(COMM, -b.u.x.array) == pytest.approx((1.0 + off) * down, rel=1e-12)
    assert COMM.bcast(sum("bcs[3]" in r.getMessage() and "counts" in r.getMessage() for r in caplog.records)) == warned


@pytest.mark.parametrize("measure", ["dx", "ds", "dS"])
def test_parts_without_tags(measure):
    """A number alone names no part of the mesh; a measure with tags does."""
    b = blocks(COMM, "quadrilateral")
    v, whole = ufl.TestFunction(b.V), ufl.Measure(measure, domain=b.scene.mesh)
    load = (ufl.avg(v[1]) if measure == "dS" else v[1]) * whole(3)
    words = [f"{measure}(3)", "tags", f"ufl.Measure('{measure}'"]
    refused(uem.InputError, words, lambda: uem.UnitedProblem(linear(b.u, 1.0) + load, b.u, bcs=clamp(b.V, b.bottom)))
