"""Mass of the bodies, and redistribution to massless contactors, so that impact itself loses no energy [UEM, 5].

The mass matrix, from a density or nodal masses, has the layout of K.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import MassError, SpaceError
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.bodies import body_sums, find_bodies, rigid_velocities
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR
from uem_dolfinx.geometry.configuration import Configuration, configuration_of
from uem_dolfinx.log import timed, timed_as
from uem_dolfinx.parallel import agree, agreed, ask_together, reduced


def as_density(config: Configuration, rho: Any) -> Any:
    """The density as a UFL expression that forms can contain."""
    if isinstance(rho, (Real, ufl.constantvalue.ConstantValue)) and not given.truth(rho):
        # UFL drops terms with a literal zero
        return fem.Constant(config.mesh, float(rho))
    if not isinstance(rho, ufl.core.expr.Expr):
        raise MassError(f"the density {rho!r} is neither a number nor a Function nor a UFL expression: give one of them")
    if rho.ufl_shape != ():
        raise MassError(f"the density {rho} has shape {rho.ufl_shape}: give a scalar")
    if ufl.algorithms.extract_arguments(rho):
        raise MassError(f"the density {rho} contains a test or trial function: give a known field")
    if any(domain != config.mesh.ufl_domain() for domain in ufl.domain.extract_domains(rho)):
        raise SpaceError("the density is on another mesh than the displacement: make both on one mesh")
    return rho


def cell_masses(config: Configuration, density: Any) -> Array:
    """Masses of the owned cells ``(n_cells,)``; MassError if one is negative or not finite (collective)."""
    S = compat.function_space(config.mesh, ("DG", 0))
    n_cells = config.mesh.topology.index_map(config.tdim).size_local
    of_dofs = forms.assemble_array(S, forms.form(revolved(density * ufl.TestFunction(S) * ufl.dx)))
    masses = of_dofs[compat.cell_dofs(S)[:n_cells, 0]]
    wrong, error = np.flatnonzero(~((masses >= 0) & np.isfinite(masses))), None
    if len(wrong):
        where = ", ".join(f"{c:.6g}" for c in config.X[compat.cell_dofs(config.V)[wrong[0]]].mean(axis=0))
        error = MassError(f"the cell at ({where}) has the mass {masses[wrong[0]]:.6g}: give a finite density of at least 0")
    agree(config.comm, error)
    return masses


#: Row sums are the nodal masses of a body if no sum is less than this part of the mass by diagonal scaling.
#: [convention; nodal mass; test_thresholds_motion.py::test_small_row_sums]
LEAST_ROW_SUM = 0.1
#: Largest part of its mass that a node loses when the contactors of its body become massless.
#: [convention; nodal mass; test_massless_contactors.py::test_refused_only_where_impossible]
LARGEST_LOSS = 0.5
#: Newton's method for the masses of the other nodes ends when the errors of the body's moments of mass are below this part.
#: [bound; moments of mass; -]
MOMENTS_MET = 1e-14
#: Largest accepted error of a body's moments of mass.
#: [convention; moments of mass; test_thresholds_motion.py::test_moments_of_a_thin_body]
MOMENTS_KEPT = 1e-10
#: Smallest spread of a body in any direction that is used to scale coordinates.
#: [convention; largest spread; test_thresholds_motion.py::test_moments_of_a_thin_body]
THIN = 1e-4
#: Largest number of steps of Newton's method for the masses. [bound; steps; -]
MOST_ITERATIONS = 60
#: Largest number of halvings of such a step. [bound; halvings; -]
MOST_HALVINGS = 20


@dataclass(frozen=True, eq=False)
class Mass(given.Copied):
    """Mass matrix of a displacement; its components are not coupled.

    Attributes:
        M: with the layout and the block size of K.
        config: nodes and bodies; the displacement in it is not used.
        diagonal: whether M is diagonal.
        density: density of M, a UFL expression; None for masses given at nodes.
    """

    M: PETSc.Mat
    config: Configuration
    diagonal: bool
    density: Any = None

    @cached_property
    def of_nodes(self) -> Array:
        """Diagonal of M at the owned nodes ``(n_owned, gdim)``: zero at massless nodes, otherwise positive (collective)."""
        diagonal = self.M.getDiagonal()
        values = np.array(diagonal.array_r).reshape(-1, self.config.gdim)
        diagonal.destroy()
        return values

    @cached_property
    def _row_sums(self) -> Array:
        """Share of each owned node in the total ``(n_owned, gdim)`` (collective)."""
        return self.times(np.ones((self.config.n_owned, self.config.gdim)))

    @property
    def total(self) -> Array:
        """Mass that moves along each coordinate ``(gdim,)`` (collective)."""
        return np.asarray(reduced(self.config.comm, self._row_sums.sum(axis=0)))

    @property
    def centre(self) -> Array:
        """Centre of the mass of all components in the reference configuration ``(gdim,)``; NaN without mass (collective)."""
        m = self._row_sums.sum(axis=1)
        sums = reduced(self.config.comm, np.append(m @ self._X, m.sum()))
        return self.config.of_circles(sums[:-1] / (sums[-1] if sums[-1] > 0 else np.nan))

    def rigid(self) -> Array:
        """Mass matrix of each body's rigid motions ``(n_bodies, n_rigid, n_rigid)`` (collective).

        Motions as in ``surfaces.rigid_velocities``: translations, then rotations about the mean of the body's nodes; the first
        block holds masses, the last one moments of inertia.
        """
        body, count = self._bodies
        sums = body_sums(self.config.comm, np.column_stack([np.ones(len(body)), self._X]), body, count)
        modes = rigid_velocities(self._X - (sums[:, 1:] / sums[:, :1])[body]).transpose(0, 2, 1)
        return self._moments(modes, np.ones(modes.shape[:2]))[0].sum(axis=1)

    def without(
        self, nodes: npt.ArrayLike, *, where_possible: npt.ArrayLike = (), distance: Callable[[], Array] | None = None
    ) -> Mass:
        """The same bodies with some nodes massless, whose mass is moved to the other nodes of their body (collective).

        With M0, which is M with zero rows and columns at these nodes, the new mass is ``S M0 S``. S is diagonal and scales component c
        of node i by ``max(1 + p_c(X_i), sqrt(1 - b))``. The polynomials p_c, of degree 2 in each body, preserve mass, first and second
        moments ``x_a' M x_b`` of each component. This preserves momentum and energy of motions with a velocity linear in X, including
        rigid motions. Nodes lose at most the part b of their own mass, and the eigenvalues of ``S M0 S`` are bounded from below by
        those of ``(1 - b) M0``. For diagonal M this redistributes nodal masses, after Khenous,
        Laborde and Renard, "Mass redistribution method for finite element contact problems in elastodynamics", Eur. J. Mech.
        A/Solids 27 (2008) 918-932.

        Args:
            nodes: owned local nodes ``(n,)`` of this rank, e.g. the contactors.
            where_possible: owned local nodes ``(m,)`` that become massless as well, in bodies whose other nodes can take the mass.
            distance: returns the distance of ``nodes`` from the surfaces that they may touch ``(n,)``, a length; an error then names
                the part of the nodes that could be massless (collective).

        Returns:
            The new mass; this object itself if the nodes are massless already.

        Raises:
            MassError: if the other nodes of a body cannot take over the mass of ``nodes``, or a node is not owned.
        """
        config = self.config
        named, more = (np.asarray(a, dtype=np.int64).ravel() for a in (nodes, where_possible))
        wrong, error = (all_named := np.append(named, more))[(all_named < 0) | (all_named >= config.n_owned)], None
        if len(wrong):
            error = MassError(
                f"node {wrong[0]} is none of the {config.n_owned} nodes that rank {config.comm.rank} owns: "
                "name nodes by their local block number, each on the rank that owns it"
            )
        agree(config.comm, error)
        needed = np.zeros(config.n_owned, dtype=bool)
        needed[named] = True
        bare = needed.copy()
        bare[more] = True
        if not reduced(config.comm, int(self.of_nodes[bare].any())):
            return self
        with timed("redistribute mass"):
            body, _ = self._bodies
            s, unable = self._scaling(~bare)
            if unable.any() and reduced(config.comm, len(more)):
                bare &= needed | ~unable[body]
                s, unable = self._scaling(~bare)
            if unable.any():
                here = body == np.flatnonzero(unable)[0]
                far = np.zeros(config.n_owned)
                far[named] = 0.0 if distance is None else distance()
                raise self._unable(here, needed, None if distance is None else far)
            M = self.M.copy()
            left, right = M.createVecs()
            left.array[:] = right.array[:] = (s * ~bare[:, None]).ravel()
            M.diagonalScale(left, right)
            left.destroy()
            right.destroy()
        return Mass(M, config, self.diagonal, self.density)

    def _scaling(self, kept: Bools) -> tuple[Array, Bools]:
        """Factors of the nodes with mass that preserve the moments of each body, and bodies without such factors (collective).

        Newton's method for the coefficients of the polynomials, for every component of every body at once.

        Args:
            kept: mask of nodes that keep mass ``(n_owned,)``.

        Returns:
            Factors ``(n_owned, gdim)``, and the mask of bodies whose moments are not preserved ``(n_bodies,)``.
        """
        g, xi = self.config.gdim, self._coordinates(kept)
        a, b = np.triu_indices(g + 1)
        phi = xi[..., a] * xi[..., b]
        wanted = self._moments(xi, np.ones(xi.shape[:2]))[0][..., a, b]
        scale = np.maximum(np.abs(wanted), wanted[..., :1])
        scale = np.where(scale > 0, scale, 1.0)
        body, count = self._bodies
        xi = xi * kept[:, None, None]

        def evaluate(alpha: Array) -> tuple[Array, Array, Array]:
            """Factors, relative errors of the moments, and products whose sums are the derivatives."""
            s = np.maximum(1.0 + np.einsum("nck,nck->nc", phi, alpha[body]), np.sqrt(1.0 - LARGEST_LOSS))
            moments, momenta = self._moments(xi, s)
            slopes = (xi[..., a] * momenta[..., b] + momenta[..., a] * xi[..., b]) * (s > np.sqrt(1.0 - LARGEST_LOSS))[..., None]
            return s, (wanted - moments[..., a, b]) / scale, slopes

        alpha, stuck = np.zeros((count, g, len(a))), np.zeros((count, g), dtype=bool)
        s, missing, slopes = evaluate(alpha)
        for _ in range(MOST_ITERATIONS):
            size = np.abs(missing).max(axis=2)
            done = stuck | (size <= MOMENTS_MET)
            if done.all():
                break
            J = self._products(slopes, phi) / scale[..., None]
            step = np.einsum("bcij,bcj->bci", np.linalg.pinv(J, rcond=MOMENTS_KEPT), missing)
            step[done] = 0.0
            for _ in range(MOST_HALVINGS):
                s, new, slopes = evaluate(alpha + step)
                stuck = np.abs(new).max(axis=2) >= size
                if done[stuck].all():
                    break
                step[stuck] *= 0.5
            alpha, missing = alpha + step, new
        return s, np.asarray((np.abs(missing) > MOMENTS_KEPT).any(axis=(1, 2)))

    def _coordinates(self, kept: Bools) -> Array:
        """1 and coordinates of the order of 1 at the nodes, for every component ``(n_owned, gdim, gdim + 1)`` (collective).

        In every body they are measured from the centre of the kept mass along its principal axes, in units of its spread, so that
        polynomials in them are well conditioned.
        """
        g, body = self.config.gdim, self._bodies[0]
        X = np.repeat(self._X[:, None], g, axis=1)
        one = np.ones((*X.shape[:2], 1))
        w = (self.of_nodes * kept[:, None])[..., None]
        total = self._products(w, one)
        total = np.where(total > 0, total, 1.0)
        arm = X - (self._products(w, X) / total)[body, :, 0]
        squares, axes = np.linalg.eigh(self._products(w * arm, arm) / total)
        spread = np.sqrt(np.maximum(squares, THIN**2 * squares[..., -1:]))
        spread = np.where(spread > 0, spread, self.config.size)
        xi = np.einsum("ncg,ncgk->nck", arm, axes[body]) / spread[body]
        return np.concatenate([one, xi], axis=2)

    def _moments(self, xi: Array, s: Array) -> tuple[Array, Array]:
        """``(s xi_a)' M (s xi_b)``, by bodies ``(n_bodies, gdim, k, k)``, and ``M (s xi_b) (n_owned, gdim, k)`` (collective).

        ``xi (n_owned, gdim, k)`` are functions at the nodes, ``s (n_owned, gdim)`` factors.
        """
        fields = s[..., None] * xi
        momenta = np.stack([self.times(fields[..., k]) for k in range(xi.shape[2])], axis=2)
        return self._products(fields, momenta), momenta

    def _unable(self, here: Bools, needed: Bools, distance: Array | None) -> MassError:
        """Error for a body, its mask ``here``, whose other nodes cannot take the mass of ``needed`` ones (collective)."""
        heavy = self.of_nodes.any(axis=1) & here
        sums = [here.sum(), (heavy & needed).sum(), (heavy & ~needed).sum(), *self._X[here].sum(axis=0)]
        n, contactors, others, *x = reduced(self.config.comm, np.array(sums, dtype=float))
        where = ", ".join(f"{c:.4g}" for c in np.array(x) / n)
        part = "" if distance is None else self._possible_part(heavy & needed, here, distance)
        return MassError(
            f"the body with its middle at ({where}) cannot keep its mass, centre and inertia without the mass of "
            f"{contactors:.0f} contactors: its other {others:.0f} nodes with mass are too few, or too close to each other; "
            f"{part}refine the mesh behind its contact surface, to five layers of cells of degree 1, or between two contactor surfaces to "
            "seven (six with a lumped mass), declare fewer facets as contactors, or keep their mass by Dynamics(..., contactors='massy'), "
            "whose energy an impact then takes"
        )

    def _possible_part(self, needed: Bools, here: Bools, distance: Array) -> str:
        """Words for the body's nodes that could be massless: those nearest to the surfaces that they may touch (collective)."""
        comm, body = self.config.comm, self._bodies[0]
        number = reduced(comm, int(body[here].max(initial=-1)), op=MPI.MAX)
        # equally near nodes are treated together
        unit = EQUALLY_NEAR * self.config.size
        level = np.rint(distance / unit)
        levels = np.unique(np.concatenate(comm.allgather(level[needed])))
        low, high = -1, len(levels) - 1
        while high - low > 1:
            middle = (low + high) // 2
            able = not self._scaling(~(needed & (level <= levels[middle])))[1][number]
            low, high = (middle, high) if able else (low, middle)
        if low < 0:
            return ""
        count = reduced(comm, int((needed & (level <= levels[low])).sum()))
        return (
            f"the {count} contactors within {levels[low] * unit:.4g} of the surfaces that they may touch could be massless: make that part "
            "of the surface the contactor, or "
        )

    @property
    def _X(self) -> Array:
        """Owned nodes in the reference configuration ``(n_owned, gdim)``."""
        return self.config.X[: self.config.n_owned]

    @property
    def _bodies(self) -> tuple[Ints, int]:
        """Body of each owned node ``(n_owned,)``, and their number (collective)."""
        body, count = find_bodies(self.config)
        return body[: self.config.n_owned], count

    @cached_property
    def _nodes_of_bodies(self) -> list[Ints]:
        """Owned nodes of every body (collective)."""
        body, count = self._bodies
        return np.split(np.argsort(body, kind="stable"), np.cumsum(np.bincount(body, minlength=count))[:-1])

    def _products(self, left: Array, right: Array) -> Array:
        """Sums of ``left (n_owned, g, k)`` times ``right (n_owned, g, l)`` over bodies: ``(n_bodies, g, k, l)`` (collective)."""
        sums = [left[here].transpose(1, 2, 0) @ right[here].transpose(1, 0, 2) for here in self._nodes_of_bodies]
        return np.asarray(reduced(self.config.comm, np.array(sums)))

    def times(self, field: Array) -> Array:
        """M times a field at the owned nodes, of any shape ``(n_owned, gdim)`` or ``(n_owned * gdim,)`` (collective)."""
        if self.diagonal:
            return np.asarray(self.of_nodes.reshape(field.shape) * field)
        x, y = self.M.createVecs()
        x.array[:] = field.ravel()
        self.M.mult(x, y)
        out = np.array(y.array_r).reshape(field.shape)
        x.destroy()
        y.destroy()
        return out


def consistent_mass(V: fem.FunctionSpace, rho: Any) -> Mass:
    """``rho inner(u, v)`` integrated over the reference configuration (collective).

    Args:
        V: space of the displacement.
        rho: mass per reference volume: a number, a Function, e.g. of DG0, or any scalar UFL expression; zero where bodies are
            massless.

    Raises:
        SpaceError: if V is no space of displacements, or rho is on another mesh.
        MassError: if rho is not scalar, not finite, or negative.
    """
    config = configuration_of(V)
    with timed("assemble mass"):
        density = as_density(config, rho)
        cell_masses(config, density)
        a = forms.form(revolved(density * ufl.inner(ufl.TrialFunction(V), ufl.TestFunction(V)) * ufl.dx))
        M = forms.create_matrix(a)
        forms.assemble_matrix(M, a)
    return Mass(M, config, diagonal=False, density=density)


def lumped_mass(V: fem.FunctionSpace, rho: Any) -> Mass:
    """Diagonal mass with the total of ``consistent_mass`` (collective).

    Nodal masses are the row sums of the consistent mass. In bodies where these are not all positive, e.g. with quadratic triangles
    and tetrahedra, every cell's mass is distributed to its nodes in proportion to the diagonal of its consistent mass (Hinton, Rock and
    Zienkiewicz, Earthquake Engng. Struct. Dyn. 4 (1976) 245-249), taken on the reference cell.

    Args:
        V: space of the displacement.
        rho: mass per reference volume, as in ``consistent_mass``.

    Raises:
        SpaceError, MassError: as ``consistent_mass``.
    """
    config = configuration_of(V)
    with timed("assemble mass"):
        density = as_density(config, rho)
        rows = forms.assemble_array(V, forms.form(revolved(density * ufl.TestFunction(V)[0] * ufl.dx)))[:: config.gdim]
        of_cells = cell_masses(config, density)
        cell = compat.cell_name(config.mesh)
        points, weights = forms.quadrature_rule(cell, 2 * config.degree)
        N = forms.create_lagrange_element(cell, config.degree).tabulate(0, points)[0, :, :, 0]
        shares = np.diag(N.T @ (weights[:, None] * N))
        cells = compat.cell_dofs(V)[: len(of_cells)]
        scaled = config.to_owners(cells.ravel(), np.outer(of_cells, shares / shares.sum()).ravel())[: config.n_owned]
        body, count = find_bodies(config)
        body = body[: config.n_owned]
        refused = body_sums(config.comm, (rows < LEAST_ROW_SUM * scaled).astype(float), body, count) > 0
        m = np.where(refused[body], scaled, rows)
    return Mass(_diagonal(config, np.repeat(m, config.gdim)), config, diagonal=True, density=density)


@timed_as("assemble mass")
def nodal_mass(V: fem.FunctionSpace, values: npt.ArrayLike | Callable[[Array], npt.ArrayLike]) -> Mass:
    """Masses given at the nodes (collective).

    Args:
        V: space of the displacement.
        values: masses per node ``(n_owned,)``, or per node and component ``(n_owned, gdim)``, at this rank's owned nodes; or a
            function of reference positions ``(n, gdim)`` that returns them, ``(n,)`` or ``(n, gdim)``.

    Raises:
        SpaceError: if V is no space of displacements.
        UserFunctionError: if the function raises.
        MassError: with the value of wrong shape, or the node whose mass is negative or not finite.
    """
    config = configuration_of(V)
    n, g = config.n_owned, config.gdim
    m, error = np.zeros(0), None
    if given.function(values):
        values = ask_together(config.comm, "the function of nodal masses", values, config.X[:n])
    with agreed(config.comm):
        try:
            m = given.numbers(values)
        except (TypeError, ValueError):
            raise MassError(given.sentence("nodal masses", values, "numbers, or a function of positions")) from None
    if m.shape not in ((n,), (n, g)):
        error = MassError(f"nodal masses have shape {m.shape}: expected ({n},) or ({n}, {g}) for the {n} nodes of this rank")
    else:
        m = np.broadcast_to(m if m.ndim == 2 else m[:, None], (n, g))
        wrong = np.flatnonzero(~((m >= 0) & np.isfinite(m)).all(axis=1))
        if len(wrong):
            where = config.describe(wrong[0])
            error = MassError(f"the mass {m[wrong[0]]} of the node at {where} is negative or not finite: give 0 or more")
    agree(config.comm, error)
    return Mass(_diagonal(config, m.ravel()), config, diagonal=True)


def _diagonal(config: Configuration, values: Array) -> PETSc.Mat:
    """Diagonal matrix from the owned entries ``(n_owned * gdim,)`` (collective)."""
    sizes = (len(values), config.index_map.size_global * config.gdim)
    M = PETSc.Mat().create(config.comm)
    M.setSizes((sizes, sizes))
    M.setBlockSize(config.gdim)
    M.setType(PETSc.Mat.Type.AIJ)
    M.setPreallocationNNZ((1, 0))
    first = M.getOwnershipRange()[0]
    rows = np.arange(first, first + len(values) + 1, dtype=PETSc.IntType)
    M.setValuesCSR(rows - first, rows[:-1], values)
    M.assemble()
    return M
