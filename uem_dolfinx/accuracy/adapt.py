"""adapt: solve on meshes that follow the estimated error; the displacement of one mesh is the first guess on the next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from uem_dolfinx import compat, forms, given
from uem_dolfinx.accuracy.enriched import narrow_contacts
from uem_dolfinx.accuracy.estimate import FEWEST, UNRESOLVED, WAYS, By, ErrorEstimate, estimated
from uem_dolfinx.accuracy.goal import GoalError, goal_error
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import ConvergenceError, InputError, MeshError
from uem_dolfinx.geometry.bodies import bodies_in_order
from uem_dolfinx.geometry.candidates import RankBoxes
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.mesh_sizes import MeshSizes
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import Exchange, agreed, reduced
from uem_dolfinx.solve.checks import depends_on_path
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.load_steps import load_steps
from uem_dolfinx.solve.united.newton import Iteration

#: Cells around a point, by their centres, of which the one is taken that the point is in or next to.
#: [bound; cells; test_first_guess.py::test_polynomials]
CANDIDATES = 16
#: Steps of Newton's method for the position of a point in a curved cell. [bound; iterations; -]
INVERTED_IN = 5


def carry_over(before: UnitedProblem, after: UnitedProblem) -> None:
    """Set the displacement of ``after`` to that of ``before``, interpolated in the cells of the same body (collective)."""
    old, new = before.config, after.config
    comm, g = new.comm, new.gdim
    n = old.mesh.topology.index_map(old.tdim).size_local
    cells = _Cells(old, n)
    body, count = bodies_in_order(old)
    of_cells = body[compat.cell_dofs(old.V)[:n, 0]]
    body, new_count = bodies_in_order(new)
    with agreed(comm):
        if count != new_count:
            raise InputError(f"solve_again: expected the same bodies on all meshes, found {count} and then {new_count}")
    points, of_points = new.X[: new.n_owned], body[: new.n_owned]
    # a point in a cell is nearer to its centre than the cell is wide
    within = np.full(len(points), reduced(comm, cells.width, op=MPI.MAX))
    boxes = RankBoxes(comm, cells.centres, kind=of_cells, n_kinds=count)
    exchange = Exchange(comm, boxes.near(points, within, kind=of_points))
    received, kind = exchange.send(points, of_points)
    distance, values = np.full(len(received), np.inf), np.zeros((len(received), g))
    for k in range(count):
        rows, here = np.flatnonzero(kind == k), np.flatnonzero(of_cells == k)
        if len(rows) and len(here):
            distance[rows], values[rows] = cells.at(received[rows], here)
    distance, values = exchange.back(distance, values)
    order = np.lexsort((distance, exchange.rows))
    row, first = np.unique(exchange.rows[order], return_index=True)
    new.u.x.array.reshape(-1, g)[row] = values[order[first]]
    new.u.x.scatter_forward()


class _Cells:
    """This rank's cells of a mesh with a displacement: ``centres`` of their vertices, and at most the distance ``width`` of a node."""

    def __init__(self, config: Configuration, n: int):
        self._cell, nodes = compat.cell_name(config.mesh), compat.geometry_dofs(config.mesh)[:n]
        self._X = config.mesh.geometry.x[nodes][:, :, : config.gdim]
        self._u = config.u.x.array.reshape(-1, config.gdim)[compat.cell_dofs(config.V)[:n]]
        self._vertices = len(forms.reference_topology(self._cell)[0])
        # degree of the cells, by the number of their nodes
        linear = nodes.shape[1] == self._vertices
        self._of_geometry = forms.create_lagrange_element(self._cell, 1 if linear else 2)
        self._of_displacement = forms.create_lagrange_element(self._cell, config.degree)
        self.centres = self._X[:, : self._vertices].mean(axis=1)
        self.width = float(np.ptp(self._X, axis=1).max(initial=0.0)) * np.sqrt(config.gdim)

    def at(self, points: Array, cells: Ints) -> tuple[Array, Array]:
        """Distances of points from the nearest of some cells ``(k,)``, and displacements at their closest points ``(k, gdim)``."""
        from scipy.spatial import cKDTree

        count = min(CANDIDATES, len(cells))
        near = cells[cKDTree(self.centres[cells]).query(points, count)[1].reshape(-1, count)]
        x, X = np.repeat(points, count, axis=0), self._X[near.ravel()]
        xi = self._inside(np.full(x.shape, 1.0 / self._vertices if self._simplex else 0.5))
        for _ in range(INVERTED_IN):
            table = self._of_geometry.tabulate(1, xi)[:, :, :, 0]
            away = x - np.einsum("km,kmg->kg", table[0], X)
            xi = self._inside(xi + np.linalg.solve(np.einsum("dkm,kmg->kgd", table[1:], X), away[:, :, None])[:, :, 0])
        N = self._of_geometry.tabulate(0, xi)[0, :, :, 0]
        distance = np.linalg.norm(x - np.einsum("km,kmg->kg", N, X), axis=1).reshape(near.shape)
        best = distance.argmin(axis=1)
        picked = np.arange(len(points)) * count + best
        N = self._of_displacement.tabulate(0, xi[picked])[0, :, :, 0]
        return distance.ravel()[picked], np.einsum("kn,kng->kg", N, self._u[near.ravel()[picked]])

    @property
    def _simplex(self) -> bool:
        return self._cell in ("triangle", "tetrahedron")

    def _inside(self, xi: Array) -> Array:
        """Points of the reference cell near others ``(k, tdim)``."""
        xi = np.clip(xi, 0.0, 1.0)
        return xi / np.maximum(xi.sum(axis=1, keepdims=True), 1.0) if self._simplex else xi


#: A mesh is made for this part of the tolerance, since Gmsh keeps sizes only nearly, and for no less than the square of it after one that
#: improves nothing: while a contact is narrower than the cells, finer ones elsewhere do not help.
#: [convention; tolerance; test_adapt.py::test_a_contact_narrower_than_the_cells]
AIM = 0.85
#: Cells grow or shrink by at most this factor from one mesh to the next, since an estimate on coarse cells sees little.
#: [convention; size of a cell; test_adapt.py::test_sizes_change_by_a_bounded_factor]
MOST_CHANGE = 4.0
#: A number of cells is kept if it is met to this part; then a mesh ends the search whose estimate falls by less than this part. Under a
#: tolerance such a mesh lets the next ones aim lower. [convention; cells, or estimate; test_adapt.py::test_a_number_of_cells]
SAME_NUMBER = 0.15
#: A goal's estimate is trusted if the parts of its cells, without their signs, sum up to at most this multiple of the tolerance. Where they
#: cancel little, they sum up to 0.6 to 3 times the estimate. [convention; tolerance; test_goal.py::test_errors_that_cancel]
MOST_CANCELLED = 2.0


@dataclass(frozen=True)
class AdaptedMesh:
    """One mesh of an adaptation."""

    cells: int  # number of cells
    unknowns: int  # number of components of displacements
    estimate: float  # estimated error over the displacement, in the energy norm, or of a goal over its value
    parts: float  # of a goal, the sum of the cells' parts over the value, which cannot cancel; else the same as ``estimate``
    iterations: int  # of Newton, in all steps; 0 if ``solve`` returns none
    seconds: float  # for the mesh, the solution and the estimate
    narrow: bool = False  # whether a contact has fewer than ``FEWEST`` facets along a direction

    @property
    def known(self) -> float:
        """The estimate, or more where it is small because its parts cancel."""
        return max(self.estimate, self.parts / MOST_CANCELLED)

    @property
    def at_most(self) -> float:
        """What a tolerance bounds: ``known``, or ``UNRESOLVED`` times as much where a contact is narrower than a few facets."""
        return self.known * (UNRESOLVED if self.narrow else 1.0)


@dataclass(frozen=True)
class Adaptation:
    """Result of ``adapt``.

    Attributes:
        problem: of the last mesh, solved.
        estimate: of its error, in the energy norm or of the goal.
        meshes: all meshes, in order.
        reached: whether the last mesh satisfies the tolerance or the number of cells.
    """

    problem: UnitedProblem
    estimate: ErrorEstimate | GoalError
    meshes: list[AdaptedMesh] = field(default_factory=list)
    reached: bool = True

    def __str__(self) -> str:
        """A table of the meshes."""
        lines = [f"{'cells':>9} {'unknowns':>9} {'estimate':>9} {'parts':>9} {'iterations':>10} {'seconds':>8}"]
        for m in self.meshes:
            shown = f"{100 * m.estimate:7.3g} % {100 * m.parts:7.3g} %"
            lines.append(f"{m.cells:9d} {m.unknowns:9d} {shown} {m.iterations:10d} {m.seconds:8.2f}")
        return "\n".join(lines)


def adapt(
    make: Callable[[MeshSizes | None], UnitedProblem],
    *,
    tolerance: float | None = None,
    cells: int | None = None,
    goal: Callable[[UnitedProblem], ufl.Form] | None = None,
    by: By = "residual",
    solve: Callable[[UnitedProblem], Any] | None = None,
    solve_again: Callable[[UnitedProblem], Any] | None = None,
    meshes: int = 10,
) -> Adaptation:
    """Solve a problem on meshes that follow its estimated error, finer and coarser, until it is small enough (collective).

    All cells get the same share of the squared error. Gmsh meshes the user's own geometry again with these sizes, so that curved
    boundaries stay curved. Histories run again on every mesh.

    Args:
        make: returns the problem, made from the size of cells: ``size`` is for ``read_gmsh(..., size=size)``, None on the first mesh.
            Curves and surfaces that the ``.geo`` file makes transfinite keep their cells.
        tolerance: bound on the estimated error over the displacement, in the energy norm; 0.05 is 5 %.
        cells: or the number of cells, whose sizes then follow the error.
        goal: returns a functional of a problem's displacement, of which the error over its value is estimated instead, see ``goal_error``.
            The sum of its parts of all cells, without their signs, is at most ``MOST_CANCELLED`` times the tolerance on the last mesh.
        by: method that estimates the error in the energy norm, see ``error_estimate``.
        solve: solves a problem, e.g. ``lambda problem: list(uem.load_steps(problem, 10))``; by default in one load step.
        solve_again: solves the problem of every mesh after the first, which begins with the displacement of the mesh before,
            e.g. ``lambda problem: problem.solve()``, at the full load at once. The solution must not depend on the path; where it
            is not found, ``solve`` solves the problem from its beginning.
        meshes: largest number of meshes.

    Returns:
        The last problem, its estimate, and a line for each mesh.

    Raises:
        InputError, InputTypeError: for wrong arguments, neither or both of ``tolerance`` and ``cells``, problems that ``error_estimate``
            refuses, or ``solve_again`` with laws that have a history, friction or cohesion.
        InputError: if the goal is zero on a mesh, e.g. the force on a surface without contact, so that it has no relative error.
        MeshError: if the cells do not follow the sizes, since the geometry fixes them.

    Example:
        ::

            def make(size):
                mesh, tags = uem.read_gmsh("punch.geo", MPI.COMM_WORLD, gdim=2, size=size)
                ...
                return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])

            print(uem.adapt(make, tolerance=0.02))
    """
    given.kind("make", make, given.function(make), "a function of the size of cells that returns a UnitedProblem")
    given.kind("goal", goal, goal is None or given.function(goal), "a function of the problem that returns a UFL form, or None")
    for name, one in (("solve", solve), ("solve_again", solve_again)):
        given.kind(name, one, one is None or given.function(one), "a function of the problem, or None")
    if (tolerance is None) == (cells is None):
        raise InputError("adapt: expected either a tolerance or a number of cells")
    if given.word("by", by, WAYS) != "residual" and goal is not None:
        raise InputError(f"adapt: errors of a goal are estimated by the residual; by = '{by}' expects no goal")
    tolerance = None if tolerance is None else given.number("tolerance", tolerance, given.between(0.0, 1.0))
    cells = None if cells is None else given.count("cells", cells)
    meshes = given.count("meshes", meshes)
    size: MeshSizes | None = None
    # Gmsh makes fewer cells in space, and more where they have to grow slowly
    expected, scale, whole, aim = 0.0, 1.0, 0.0, AIM
    found: list[AdaptedMesh] = []
    problem: UnitedProblem | None = None
    while True:
        start = perf_counter()
        problem, steps = _solved(make, size, solve, problem, solve_again)
        estimate = estimated(problem, by) if goal is None else goal_error(problem, goal(problem))
        if np.isnan(estimate.relative):
            raise InputError(
                f"adapt: the {'displacement' if goal is None else 'goal'} is zero on mesh {len(found) + 1}, to rounding, and its error is "
                "bounded over its value: expected a load that changes it, and a first mesh on which it does"
            )
        found.append(_measured(problem, estimate, steps, start))
        logger.info("mesh %d: %d cells, estimated error %.3g %%", len(found), found[-1].cells, 100 * found[-1].estimate)
        reached = enough(found, tolerance, cells)
        if reached or len(found) == meshes:
            if not reached:
                logger.warning(
                    "%d meshes do not reach the tolerance or the number of cells: allow more meshes, or a larger error", meshes
                )
            return Adaptation(problem, estimate, found, reached)
        mesh = problem.config.mesh
        # shares of a goal's error fall like squared errors in the energy norm
        wanted, power = None, 2 if goal is None else 1
        if tolerance is not None:
            # sizes that Gmsh keeps less well, or errors that fall more slowly: aim lower
            if len(found) > 1 and found[-1].known > (1 - SAME_NUMBER) * found[-2].known:
                aim *= max(tolerance / found[-1].at_most, AIM**2)
            most = min(tolerance, found[-1].known)
            wanted = reduced(mesh.comm, float(estimate.shares.sum())) * (aim * most / found[-1].known) ** power
        if size is not None:
            scale *= float(np.clip(found[-1].cells / expected, 0.5, 2.0)) ** (1.0 / mesh.topology.dim)
            scale = scale if tolerance is None else min(scale, 1.0)
        factors = size_factors(estimate.shares, problem.config.degree, mesh.topology.dim, mesh.comm, wanted, cells)
        lengths = cell_sizes(mesh)
        before, whole = whole, reduced(mesh.comm, float(lengths.sum()))
        if before == whole and reduced(mesh.comm, float(np.abs(np.log(factors)).max(initial=0.0)), op=MPI.MAX) > np.log(2.0):
            raise MeshError(
                f"the mesh has the same {found[-1].cells} cells again, whatever the sizes: leave Transfinite out of the .geo file where "
                "cells are to follow the error, and pass size on to read_gmsh"
            )
        expected = reduced(mesh.comm, float((factors**-mesh.topology.dim).sum()))
        size = MeshSizes(mesh, lengths * factors * scale)


def enough(found: list[AdaptedMesh], tolerance: float | None, cells: int | None) -> bool:
    """Whether the last mesh has what was wanted."""
    last = found[-1]
    if tolerance is not None:
        return last.at_most <= tolerance
    assert cells is not None
    if abs(last.cells / cells - 1) > SAME_NUMBER or len(found) < 2:
        return False
    return abs(found[-2].cells / cells - 1) <= SAME_NUMBER and last.estimate > (1 - SAME_NUMBER) * found[-2].estimate


def size_factors(shares: Array, degree: int, dim: int, comm: MPI.Comm, wanted: float | None, cells: int | None) -> Array:
    """By how much to multiply the sizes of cells, so that all new cells have the same share of the squared error (collective).

    A cell's squared error falls with the power ``2 p + d`` of its size where the solution is smooth.

    Args:
        shares: shares of this rank's cells in the squared error ``(n,)``.
        degree: p, of the displacement.
        dim: d, of the cells.
        comm: communicator of the mesh.
        wanted: their sum on the new mesh, or None.
        cells: or its number of cells.

    Returns:
        Factors ``(n,)`` between 1 / ``MOST_CHANGE`` and ``MOST_CHANGE``.
    """
    order = 2 * degree + dim
    total = reduced(comm, float((shares ** (dim / order)).sum()))
    if wanted is not None:
        # cells * share = wanted, and cells = total / share^(dim / order)
        share = (wanted / total) ** (order / (2 * degree)) if total else 1.0
    else:
        assert cells is not None
        share = (total / cells) ** (order / dim)
    least = share * MOST_CHANGE**-order
    return np.asarray(np.maximum((share / np.maximum(shares, least)) ** (1 / order), 1 / MOST_CHANGE))


def cell_sizes(mesh: Any) -> Array:
    """Mean length of the edges of this rank's cells ``(n,)``."""
    cell, n = compat.cell_name(mesh), mesh.topology.index_map(mesh.topology.dim).size_local
    edges = np.array(forms.reference_topology(cell)[1])
    x = mesh.geometry.x[compat.geometry_dofs(mesh)[:n]]
    return np.asarray(np.linalg.norm(x[:, edges[:, 1]] - x[:, edges[:, 0]], axis=2).mean(axis=1))


def _solved(
    make: Callable[[MeshSizes | None], UnitedProblem],
    size: MeshSizes | None,
    solve: Callable[[UnitedProblem], Any] | None,
    before: UnitedProblem | None,
    solve_again: Callable[[UnitedProblem], Any] | None,
) -> tuple[UnitedProblem, Any]:
    """The problem of a mesh, solved, and the steps of it; ``before``: the problem of the mesh before (collective)."""
    problem = make(size)
    given.kind("what make returns", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    if solve_again is not None:
        with agreed(problem.comm):
            if what := depends_on_path(problem):
                where = "so that its solution depends on the path: leave solve_again out"
                raise InputError(f"solve_again: the problem has {what}, {where}")
        if before is not None:
            carry_over(before, problem)
            try:
                return problem, solve_again(problem)
            except (ConvergenceError, ArithmeticError) as error:
                logger.info("no solution from the displacement of the mesh before, so solve starts over: %s", error)
            problem = make(size)
    return problem, list(load_steps(problem, 1)) if solve is None else solve(problem)


def _measured(problem: UnitedProblem, estimate: ErrorEstimate | GoalError, steps: Any, start: float) -> AdaptedMesh:
    """The figures of a mesh."""
    config = problem.config
    V, cells = config.u.function_space, config.mesh.topology.index_map(config.tdim).size_global
    iterations = len(steps) - 1 if steps and isinstance(steps[0], Iteration) else 0
    if isinstance(steps, list):
        iterations += sum(getattr(step, "newton_iterations", 0) for step in steps)
    unknowns = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
    parts = estimate.parts / abs(estimate.value) if isinstance(estimate, GoalError) else estimate.relative
    narrow = narrow_contacts(problem, FEWEST) if isinstance(estimate, GoalError) else estimate.narrow
    return AdaptedMesh(int(cells), int(unknowns), estimate.relative, parts, iterations, perf_counter() - start, bool(narrow))
