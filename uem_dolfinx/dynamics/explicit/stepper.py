"""One explicit step: nodes with mass move by central differences, then the surface without mass comes into equilibrium in contact.

The surface's problem is that of a static step of the same united system, in which the nodes with mass have prescribed motion.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from copy import copy
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import AnyArray, Array, Bools
from uem_dolfinx.dynamics.explicit.part_solver import Prediction, SurfaceSolver
from uem_dolfinx.errors import InvertedElementError, MassError, StepAccuracyError
from uem_dolfinx.parallel import gathered, reduced

#: Products with the stiffness of one estimate: Ritz values and the size of their residuals then bound the highest frequency to a few per
#: cent, less than the safety of steps takes off. [bound; products; -]
PRODUCTS = 20


def highest_eigenvalue(apply: Callable[[Array], Array], mass: Array, start: Array, comm: MPI.Comm) -> float:
    """Estimate from above of the largest eigenvalue of ``M^-1/2 K M^-1/2`` (collective).

    Args:
        apply: K times a field ``(n,)`` (collective).
        mass: diagonal of M, zero at components that do not move ``(n,)``.
        start: of the Krylov space ``(n,)``, the same for every partition of the mesh.
        comm: of the fields.
    """
    root = np.where(mass > 0.0, 1.0 / np.sqrt(np.where(mass > 0.0, mass, 1.0)), 0.0)

    def dot(x: Array, y: Array) -> float:
        return float(reduced(comm, float(x @ y)))

    q = start * (mass > 0.0)
    q, before, beta = q / np.sqrt(dot(q, q)), np.zeros_like(q), 0.0
    alphas, betas = [], []
    for _ in range(PRODUCTS):
        r = root * apply(root * q)
        alphas.append(dot(q, r))
        r -= alphas[-1] * q + beta * before
        beta = np.sqrt(dot(r, r))
        betas.append(beta)
        if beta <= np.finfo(float).eps * max(map(abs, alphas)):
            break
        before, q = q, r / beta
    k = len(alphas)
    T = np.diag(alphas) + np.diag(betas[: k - 1], 1) + np.diag(betas[: k - 1], -1)
    values, vectors = np.linalg.eigh(T)
    return float(values[-1] + betas[-1] * abs(vectors[-1, -1]))


#: A surface at rest makes the square of the highest frequency much larger if by more than this factor: contacts then change the step.
#: [convention; square of the highest frequency; test_explicit.py::test_stiff_contactors_do_not_shorten_steps]
STIFF_SURFACE = 1.25
#: Contacts that change the critical step bounce on a surface that is stiffer than the bodies. From their first touch on, steps are at
#: most this part of the critical one with closed contacts, so that they resolve the bounce.
#: [convention; critical step; test_explicit.py::test_a_thin_layer_at_the_wall]
RESOLVED = 0.25
#: How fast cells are strained is found anew after so many steps at most.
#: [convention; steps; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_EVERY = 50
#: The critical step is found anew before a cell is strained by more than this, and where a step does that.
#: [convention; strain; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_STRAIN = 0.1
#: A step strains no cell of a vibration by more than this: stiffnesses that change within a step make or take energy.
#: [convention; strain; test_explicit_materials.py::test_rubber_at_the_speed_of_its_waves]
STEADY_STRAIN = 0.1
#: A run ends where the least height of all cells falls below this part of the mesh's least one: cells collapse, and steps with them.
#: [convention; the least height; test_explicit_materials.py::test_cells_that_collapse]
COLLAPSED = 1e-3
#: Cells whose strains are found at once, in arrays that caches hold. [bound; cells; -]
CELLS_AT_ONCE = 16384
#: Wave numbers along the axes, times the model's size, of the field that frequencies are sought from. [format; wave numbers; -]
IRRATIONAL = 1e3 * np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])


class ExplicitStepper:
    """Explicit steps of a problem (collective).

    Args:
        problem: a ``UnitedProblem`` with central differences.

    Raises:
        MassError: if nothing has mass.
    """

    def __init__(self, problem: Any):
        self.problem, self.dynamics, bodies = problem, problem.dynamics, problem.bodies
        self._n = problem.config.n_owned * problem.config.gdim
        m = self.dynamics.mass.of_nodes.ravel()
        heavy = np.zeros(len(bodies.held), dtype=bool)
        heavy[: self._n] = m > 0.0
        #: Unknowns whose motion the masses determine, ghosts included, and of them those of this rank without conditions.
        self.interior: Bools = bodies.of_owners(heavy)
        self.moving: Bools = heavy[: self._n] & ~self.dynamics.held
        if not problem.comm.allreduce(int(heavy.sum())):
            raise MassError("central differences need nodes with mass, and there are none: check the density")
        self._mass = m
        self.system, self.prediction = self._parts()  # united system that a step solves, and how its solution is predicted
        self.limit = np.inf  # length that the last refused step might have had
        self.part = 1.0  # part of the critical step that resolves closed contacts
        config = problem.config
        cell = compat.cell_name(config.mesh)
        #: Vertices of cells ``(n_vertices, n_cells)``.
        self._vertices = compat.cell_dofs(config.V)[:, : len(forms.reference_topology(cell)[0])].T.astype(np.intp, order="C")
        # slopes are constant in simplices; other cells collapse first at the outermost points that forces are integrated at
        degrees = [forms.DEGREES_ENOUGH, *(one.metadata().get("quadrature_degree", 0) for one in bodies.F.integrals())]
        points, _ = forms.quadrature_rule(cell, 1 if cell in ("triangle", "tetrahedron") else max(degrees))
        if cell in ("quadrilateral", "hexahedron"):
            points = points[np.isin(points, (points.min(), points.max())).all(axis=1)]
        #: Derivatives of the shape functions of vertices by reference coordinates ``(tdim * n_points, n_vertices)``.
        self._derivatives = np.concatenate(forms.create_lagrange_element(cell, 1).tabulate(1, points)[1:, :, :, 0])
        #: Least height of the cells, and the times until one is strained as far as it may, as it is and without strain, as last looked at.
        self.shortest, self.left, self.whole = np.inf, np.inf, np.inf
        #: Cells that are treated at once, and their slopes where strains count from, in short numbers: strains need no more.
        self._blocks = [slice(k, k + CELLS_AT_ONCE) for k in range(0, self._vertices.shape[1], CELLS_AT_ONCE)]
        of_mesh = [self._slopes(np.array(config.X.T), cells) for cells in self._blocks]
        steepest = max((_steepest(_inverse(of)) for of in of_mesh), default=0.0)
        self._since = [of.astype(np.float32) for of in of_mesh]
        self._least = COLLAPSED / float(reduced(problem.comm, steepest, op=MPI.MAX))
        self.sudden = False  # whether accelerations may have strained cells much in the last step
        self._inverse = np.where(self.moving, 1.0 / np.where(m > 0.0, m, 1.0), 0.0)

    def _parts(self) -> tuple[Any, Any]:
        """Make ``system`` and ``prediction`` (collective)."""
        # of the same bodies and contacts, with a solver of its own
        system = copy(self.problem.system)
        system.solver = SurfaceSolver(self.problem.config.unknowns, "uem_surface_")
        return system, Prediction(self.problem, system, self.interior)

    def forget(self) -> None:
        """Begin the next step as after a restart."""
        self.prediction.kept = False

    def begin(self) -> None:
        """Bring the surface into equilibrium at the start, and find the first accelerations (collective)."""
        problem, dynamics = self.problem, self.dynamics
        # no time passes, so that any length serves
        dynamics.begin(1.0)
        with problem.bodies.holding(self.interior):
            problem.attempt(start=problem.committed, system=self.system)
            a = self._accelerations()
        dynamics.restore()
        problem.keep()
        dynamics.change_rates(np.array(dynamics.velocity.x.array[: self._n]), a)
        dynamics.accelerated = True

    def step(self, dt: float) -> Any:
        """Take a step of length ``dt`` and commit it; returns the history of iterations for the surface (collective)."""
        problem, dynamics, n = self.problem, self.dynamics, self._n
        # the surface, without acceleration, starts with its last velocity
        half = dynamics.velocity.x.array[:n] + 0.5 * dt * dynamics.acceleration.x.array[:n]
        start, before = np.array(problem.committed), self.pattern()
        start[:n] += dt * half
        dynamics.begin(dt)
        with problem.bodies.holding(self.interior):
            self.prediction.predict(start)
            history = problem.attempt(start=start, system=self.system)
            a = self._accelerations()
        self._refuse_cells(dt, a, before)
        self._refuse_given_energy(dt)
        self.prediction.learn(history)
        dynamics.end_with(half + 0.5 * dt * a, a)
        problem.commit()
        return history

    def _accelerations(self) -> Array:
        """Accelerations of the moving components under the forces of bodies and contacts, zero elsewhere ``(n,)`` (collective)."""
        system = self.system
        return -self._inverse * system.rows.test.pass_on(system.residual()).array_r

    def pattern(self) -> tuple[int, ...]:
        """Fingerprint of the active contactors, if they change the critical step (collective)."""
        if not self.problem.step_control.of_contact:
            return ()
        own = zlib.crc32(b"".join(pair.united.tobytes() for pair in self.problem.interfaces))
        return tuple(gathered(self.problem.comm, np.array(own)))

    # -- critical step ---------------------------------------------------------------------------------------------------

    def critical_step(self) -> float:
        """Longest stable step in the present state, infinite without stiffness (collective).

        With the largest eigenvalues k and c of stiffness and damping over mass it is ``2 / r`` of ``r^2 = k + r c``. Damping
        forces are those of the velocity in the middle of the step before.
        """
        # matrices and factors of the last one
        forms.free_petsc_garbage(self.problem.comm)
        # committed stresses are on the yield surface, from where the tangent is elastic, as it is in unloading
        self.problem.bodies.restore()
        with self.dynamics.without_inertia():
            k = self._highest_square()
        if k <= 0.0:
            return np.inf
        c = 0.0
        if self.dynamics.damping is not None:
            with self.dynamics.without_inertia(np.sqrt(k)):
                c = max(self._highest_square() - k, 0.0) / np.sqrt(k)
        return float(4.0 / (c + np.sqrt(c**2 + 4.0 * k)))

    def _refuse_cells(self, dt: float, a: Array, before: tuple[int, ...]) -> None:
        """InvertedElementError for a cell turned inside out, StepAccuracyError for a step beyond the new critical one (collective)."""
        problem, bodies, config, changed = self.problem, self.problem.bodies, self.problem.config, False
        if bodies.linear:
            # forces by a product do not show inverted cells
            if (where := bodies.inverted()) is not None:
                raise InvertedElementError(f"the cell at {where} is turned inside out: take a finer mesh there")
        else:
            largest = float(reduced(problem.comm, float(np.abs(a).max(initial=0.0)), op=MPI.MAX))
            self.sudden = 2.0 * largest * dt**2 > CHECKED_STRAIN * self.shortest
            if self.sudden:
                now, then = np.array(config.x.T), np.array((config.X + config.of(problem.committed)).T)
                strain = float(_strains(_inverse(self._slopes(now)), self._slopes(then)).max(initial=0.0))
                changed = reduced(problem.comm, strain, op=MPI.MAX) > CHECKED_STRAIN
        if not changed and self.pattern() == before:
            return
        critical = self.critical_step()
        if dt > self.part * critical:
            self.limit = self.part * critical
            raise StepAccuracyError(
                f"a step of {dt:.4g} is too long for the critical step {critical:.4g} of the contact and the cells at its end"
            )

    def _refuse_given_energy(self, dt: float) -> None:
        """EnergyGivenError if contacts that open do more work on the bodies, with half of their last force, than the limit (collective)."""
        problem, control, given = self.problem, self.problem.step_control, 0.0
        for pair in problem.system.pairs:
            opened = pair.committed.active & ~pair.trial.active
            given += (
                0.5 * float((pair.committed.lam * np.maximum(pair.kinematics.gap, 0.0))[opened].sum()) if opened.any() else 0.0
            )
        words = control.too_much(reduced(problem.comm, given), dt, self.dynamics.kinetic_energy)
        if words is not None:
            control.refuse_energy(words, dt)

    def _highest_square(self) -> float:
        """Square of the highest frequency by the present tangent (collective).

        The surface follows the masses in equilibrium: its stiffness alone does not count. If a surface at rest would hardly make the
        frequency higher, that bound is taken, which no contact exceeds; otherwise ``of_contact`` is set, as contacts change the step.
        """
        problem, control = self.problem, self.problem.step_control
        problem.bodies.update_tangent()
        fixed = self._highest(self._stiffness_if_fixed)
        with problem.bodies.holding(self.interior):
            # inertia holds the bodies, not supports
            self.system.floating.begin_motion()
            system, self._P = self.system, self.system.restriction()
            system.solver.set_operator(self._P, problem.bodies.tangent.K, None, self._P)
            condensed = self._highest(self._stiffness)
        stiff = fixed > STIFF_SURFACE * condensed
        # closed contacts leave nothing of the surface that could be at rest
        closed = control.of_contact and reduced(problem.comm, int(any(pair.united.any() for pair in problem.interfaces))) > 0
        control.depend(stiff or closed)
        self.part = RESOLVED if closed else 1.0
        return condensed if stiff else fixed

    def _nodal(self, of: Any) -> Array:
        """Values of a field at nodes ``(gdim, n_local)``."""
        return np.array(of.x.array.reshape(-1, self.problem.config.gdim).T)

    def _slopes(self, of: Array, cells: slice = slice(None)) -> Array:
        """Derivatives of nodal values ``(k, n_local)`` by reference coordinates, at the points of cells ``(tdim, k, n)``."""
        found = self._derivatives @ of.take(self._vertices[:, cells], axis=1)
        return np.asarray(found.reshape(len(of), self.problem.config.tdim, -1).transpose(1, 0, 2))

    def count_from(self, displacement: Array) -> None:
        """Let strains count from this displacement on, ghosts included ``(n,)``: the critical step is known there."""
        self.problem.step_control.know(displacement)
        config = self.problem.config
        x = (config.X + config.of(displacement)).T
        self._since = [self._slopes(x, cells).astype(np.float32) for cells in self._blocks]

    def look(self) -> None:
        """Find when the velocities will have strained a cell as far as it may since ``count_from``, and the least height (collective).

        InvertedElementError if the height is a small part of the least one of the mesh.
        """
        # rates per step are far from the ends of the range of short numbers, in any units
        dt, g, worst = self.problem.step_control.nominal, self.problem.config.gdim, np.zeros(3)
        both = np.concatenate([self.problem.config.x.T, dt * self._nodal(self.dynamics.velocity)])
        for cells, since in zip(self._blocks, self._since):
            slopes = self._slopes(both, cells)
            inverse, rates = _inverse(slopes[:, :g]), slopes[:, g:].astype(np.float32)
            steepest, inverse = _steepest(inverse), inverse.astype(np.float32)
            fast, strain = _rates(inverse, rates), _strains(inverse, since)
            # infinite where the strain is reached
            over = np.divide(fast, CHECKED_STRAIN - strain, out=np.full_like(fast, np.inf), where=strain < CHECKED_STRAIN)
            worst = np.maximum(worst, (fast.max(initial=0.0), steepest, over.max(initial=0.0)))
        fastest, steepest, soonest = map(float, reduced(self.problem.comm, worst, op=MPI.MAX))
        self.shortest = 1.0 / steepest
        self.whole, self.left = (dt / one if one > 0.0 else np.inf for one in (fastest / CHECKED_STRAIN, soonest))
        if self.shortest < self._least:
            raise InvertedElementError(
                f"cells collapse: their least height, {self._least / COLLAPSED:.3g} at the start, is {self.shortest:.3g}; "
                "take a finer mesh, or lower speeds"
            )

    def steps_to_look(self, dt: float, anew: bool = False) -> int:
        """Number of steps of length ``dt`` until a cell is strained as far as it may, or that with strains counted ``anew``; 0 for none."""
        return int(min((self.whole if anew else self.left) / dt, CHECKED_EVERY))

    def steady_step(self, critical: float) -> float:
        """Longest step in which no cell is strained further than it may, so that stiffnesses hardly change (collective).

        A cell of the highest frequency, ``2 / critical``, vibrates with rates up to ``sqrt(v^2 + (a critical / 2)^2)``, in any phase.
        """
        dynamics = self.dynamics
        if self.problem.bodies.linear or not np.isfinite(critical):
            return np.inf
        inverse = _inverse(self._slopes(np.array(self.problem.config.x.T)))
        v, a = (_rates(inverse, self._slopes(of)) for of in (self._nodal(dynamics.velocity), self._nodal(dynamics.acceleration)))
        rates = np.hypot(v, 0.5 * critical * a)
        fastest = float(reduced(self.problem.comm, float(rates.max(initial=0.0)), op=MPI.MAX))
        return STEADY_STRAIN / fastest if fastest > 0.0 else np.inf

    def _highest(self, apply: Callable[[Array], Array]) -> float:
        config, mass = self.problem.config, self._mass * self.moving
        along = config.X[: config.n_owned] @ IRRATIONAL[: config.gdim] / config.size
        start = np.sin(along[:, None] + np.arange(config.gdim)).ravel()
        return highest_eigenvalue(apply, mass, start, self.problem.comm)

    def _times_K(self, field: PETSc.Vec) -> PETSc.Vec:
        return forms.product(self.problem.bodies.tangent.K, field)

    def _stiffness_if_fixed(self, field: Array) -> Array:
        """K times a field of the moving components, with all others at rest ``(n,)`` (collective)."""
        return np.array(self._times_K(self.problem.config.unknowns.vector(field)).array_r) * self.moving

    def _stiffness(self, field: Array) -> Array:
        """``K_II - K_IS K_SS^-1 K_SI`` times a field, with the constraints of contact on the surface ``(n,)`` (collective)."""
        P, solver = self._P, self.system.solver
        du = P.carried(field.reshape(-1, self.problem.config.gdim))
        dq, _ = solver.solve(-P.transpose(self._times_K(du)), 0.0)
        du.axpy(1.0, P.expand(solver.complete(dq)))
        return np.array(P.pass_on(self._times_K(du)).array_r) * self.moving


def _steepest(inverse: AnyArray) -> float:
    """One over the least height of cells, from the inverse ``_slopes`` of positions."""
    return float(np.sqrt(np.square(inverse).sum(axis=0).max(initial=0.0)))


def _strains(inverse: AnyArray, since: AnyArray) -> AnyArray:
    """Almansi's strains ``(n,)``, from the inverse ``_slopes`` of positions and the earlier ``_slopes``."""
    back = np.einsum("itn,tjn->ijn", inverse, since)
    E = 0.5 * (np.eye(len(back), dtype=back.dtype)[:, :, None] - np.einsum("ikn,jkn->ijn", back, back))
    return np.sqrt(np.einsum("ijn,ijn->n", E, E))


def _rates(inverse: AnyArray, of: AnyArray) -> AnyArray:
    """Rates of strain ``(n,)`` from the inverse ``_slopes`` of positions and the ``_slopes`` of nodal rates."""
    L = np.einsum("itn,tjn->ijn", inverse, of)
    # turning does not strain
    D = 0.5 * (L + L.transpose(1, 0, 2))
    return np.sqrt(np.einsum("ijn,ijn->n", D, D))


def _inverse(A: Array) -> Array:
    """Inverses of matrices ``(g, g, n)``, by cofactors: a library's loop over small matrices takes ten times as long."""
    g, minors = len(A), np.empty(A.shape)
    for i, j in np.ndindex(g, g):
        # of rows and columns that follow each other in turn, without signs
        a, b, k, m = A[i - g + 1], A[i - g + 2], j - g + 1, j - g + 2
        minors[j, i] = a[k] * b[m] - a[m] * b[k] if g == 3 else (-1.0) ** (i + j) * a[k]
    return np.asarray(minors / np.einsum("jn,jn->n", A[0], minors[:, 0]))
