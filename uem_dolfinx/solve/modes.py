"""Natural frequencies of bodies with the present contact: ``P'KP q = omega^2 P'MP q``, by SLEPc.

Harmonics of cyclic parts: vibrations of a whole ring, of a nodal diameter k, by one of its N sectors.

The displacement ``u = a + i b`` of a sector is mapped to that of the next one by the rotation R and the phase ``t = 2 pi k / N``, so
that nodes of the cut that follows have ``u = e^(it) R u(leader)`` instead of ``R u(leader)``. With P for the phase 0, and its rows D P of
these nodes,

    Z = (1 - D) P + e^(it) D P        Z*KZ = A + i B        [[A, -B], [B, A]] for (a, b)

in real numbers, where every eigenvalue is found twice, as in the ring: its modes may be turned.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import given
from uem_dolfinx.algebra.blocks import is_symmetric
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.conditions.equation import Periodic
from uem_dolfinx.contact.pair.interface import in_question
from uem_dolfinx.dynamics.mass import Mass
from uem_dolfinx.errors import InputError, LinearSolveError, MissingBackendError, SpaceError
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.bodies.tangent import added_mass, contact_curvature, curvature_of, slip_terms, together
from uem_dolfinx.solve.checks import refuse_other_fields
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.rows import Rows, make_rows
from uem_dolfinx.solve.united.system import BodySystem


class Harmonic:
    """One harmonic of a sector (collective).

    Args:
        P: restriction for the phase 0.
        follower: owned nodes of the cut that follows, which no other equations contain ``(n_owned,)``.
        diameter: k.
        n: N.

    Attributes:
        used: unknowns in use, of both copies where there are two.
    """

    def __init__(self, P: Restriction, follower: Bools, diameter: int, n: int):
        self._P = P
        self._own = P.space.vector(np.repeat(follower, P.space.block).astype(float))
        phase = 2.0 * np.pi * diameter / n
        self._c, self._s = float(np.cos(phase)), float(np.sin(phase)) if 0 < 2 * diameter < n else 0.0
        one = P.used.ravel()
        self.used: Bools = np.concatenate([one, one]) if self._s else one

    def united(self, K: PETSc.Mat) -> tuple[PETSc.Mat, PETSc.Mat]:
        """The real matrix of both copies, and its symmetric block A (collective)."""
        inner, follower = self._P.P.copy(), self._P.P.copy()
        follower.diagonalScale(self._own)
        inner.axpy(-1.0, follower, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        if not self._s:
            inner.axpy(self._c, follower, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
            A = K.PtAP(inner)
            return A, A
        across = inner.transposeMatMult(K.matMult(follower))
        back = across.transpose(PETSc.Mat())
        A = K.PtAP(inner) + K.PtAP(follower) + self._c * (across + back)
        B = self._s * (across - back)
        whole = PETSc.Mat().createNest([[A, -1.0 * B], [B, A]], comm=A.comm)
        whole.assemble()
        return whole.convert("aij"), A

    def expand(self, q: Array) -> PETSc.Vec:
        """The real part of the displacement (collective)."""
        n = len(q) // 2 if self._s else len(q)
        a, b = (self._P.expand(self._P.space.vector(part)) for part in (q[:n], q[-n:]))
        shift = (self._c - 1.0) * a - self._s * b
        shift.pointwiseMult(shift, self._own)
        return a + shift


#: Relative error of the eigenvalues. [bound; the eigenvalue; -]
EIGENVALUE = 1e-10


@dataclass(frozen=True)
class Vibrations:
    """Natural vibrations about an equilibrium.

    Attributes:
        frequencies: in cycles per unit of time, ascending ``(n,)``; negative for growing motions of an unstable equilibrium.
        eigenvalues: squares of the circular frequencies ``(n,)``.
        functions: displacements of the modes, with ``v'Mv = 1``, and the corresponding other fields; their signs are arbitrary.
    """

    frequencies: Array
    eigenvalues: Array
    functions: list[fem.Function]


def modes(problem: UnitedProblem, n: int = 6, *, mass: Mass | None = None, diameter: int | None = None) -> Vibrations:
    """The lowest natural frequencies of small vibrations about the present equilibrium, with the present contact (collective).

    Active contactors follow their targets: sticking ones in all directions, slipping ones along the normal only, without friction. Other
    contactors are free. Geometric stiffness of contact and bodies is included as in Newton's tangent; damping is neglected. Other fields
    have no inertia, and follow the displacement by their equations.

        frequencies = uem.modes(problem, 4, mass=uem.consistent_mass(V, rho)).frequencies

    Args:
        problem: in equilibrium.
        n: number of modes.
        mass: of the bodies, in addition to masses at points of rigid couplings; None takes the mass of the problem's dynamics.
        diameter: for a sector of a ring, held by ``uem.periodic(cut, other, turn=R)``: the number of nodal diameters of the modes, from 0
            to half the number of sectors. Modes of the whole ring are those of all of them; between the ends each frequency is there
            twice. Functions are those of this sector. Contacts may act apart from the cut that follows. None as 0.

    Raises:
        MissingBackendError: without slepc4py.
        InputError, InputTypeError, SpaceError: if the mass is missing or of another space, if the tangent is not symmetric, or if n
            exceeds the number of components with mass.
        LinearSolveError: if SLEPc does not converge.
    """
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    config, bodies, system = problem.config, problem.bodies, problem.system
    with agreed(problem.comm):
        n = given.count("n", n)
        diameter = given.count("diameter", diameter) if diameter else None
        if not config.moves:
            refuse_other_fields(config, "natural frequencies", "take eigenvalues of your own")
        if mass is None and problem.dynamics is None:
            raise InputError("modes need a mass, and the problem has no dynamics: give mass=uem.consistent_mass(V, density)")
        mass = problem.dynamics.mass if mass is None and problem.dynamics is not None else mass
        given.kind("mass", mass, isinstance(mass, Mass), "a Mass, as consistent_mass returns it")
        assert mass is not None
        if not config.numbers_as(mass.config.V):
            raise SpaceError(
                "the mass is of another space than the displacement, or of one that is numbered otherwise, as a collapsed part of a mixed "
                "one: make it with uem.function_space(mesh, degree, (gdim,))"
            )
        if not isinstance(system, BodySystem):
            raise InputError("modes need contact by elimination: the default method")
    given.alike(problem.comm, "modes", n=n, diameter=diameter)
    slepc = _slepc()
    with nullcontext() if problem.dynamics is None else problem.dynamics.without_inertia():
        bodies.assemble()
        bodies.tangent.update()
        # no supports: floating bodies are free
        pairs = in_question(system.pairs)
        rows = make_rows(system.over_constraints, pairs, lambda *_: bodies.free_rows, 0.0 * bodies.prescribed, system.linear)
        like, M = config.unknowns.vector(), config.in_rows(mass.M)
        curvature = curvature_of(pairs, like, False, False) if system.consistent_tangent else None
        P = rows.frictionless
        with timed("united matrix"):
            added = added_mass(system.linear, like)
            # stiffness of soft contacts and of springs
            gaps, _ = slip_terms([pair for pair in pairs if pair.trial.has_law], like)
            springs = [] if system.linear is None else system.linear.stiffness()
            gaps = together(gaps, contact_curvature(springs, like) if springs else None)
            stiffness = together(bodies.tangent.K, together(curvature, gaps))
            if diameter:
                harmonic = _harmonic(problem, rows, diameter)
                A, block = harmonic.united(stiffness)
                B, _ = harmonic.united(together(M, added))
                used, expand = harmonic.used, harmonic.expand
            else:
                A, B = _united(P, stiffness), _united(P, together(M, added))
                block, used, expand = A, P.used.ravel(), lambda q: P.expand(P.space.vector(q))
    _move_idle(A, used)
    if block is not A:
        _move_idle(block, P.used.ravel())
    if not is_symmetric(block, config.unknowns):
        raise InputError(
            "modes need a symmetric tangent, and that of this problem is not, as with a temperature that strains bodies: leave such fields "
            "to a problem of their own"
        )
    return _solve(slepc, problem, used, expand, A, B, n)


def _harmonic(problem: UnitedProblem, rows: Rows, diameter: int) -> Harmonic:
    """A nodal diameter of a sector with these equations; InputError if they are no sector's, or contacts act at the cut (collective)."""
    config, P = problem.config, rows.frictionless
    with agreed(problem.comm):
        turned = [one for one in problem.equations if isinstance(one, Periodic) and one.turn is not None]
        if len(turned) != 1 or len(problem.equations) != 1 or problem.couplings:
            raise InputError(
                "diameter is for a sector of a ring: expected the equation uem.periodic(cut, other cut, turn=R) alone, and no couplings"
            )
        angle = np.arccos(np.clip(0.5 * (np.trace(turned[0].turn) - (config.gdim - 2)), -1.0, 1.0))  # type: ignore[arg-type]
        n = round(2.0 * np.pi / angle) if angle > 0.0 else 0
        if diameter > n // 2:
            raise InputError(f"diameter = {diameter}: expected 0 to {n // 2}, the nodal diameters of a ring of {n} sectors")
    follower, own = turned[0].followers(config), np.zeros(config.n_owned, dtype=bool)
    own[follower[follower < config.n_owned]] = True
    there = config.ask_owners(rows.whole.P.followed, own[:, None].astype(float)).ravel() > 0.0
    of_contacts = sum(len(equations) for equations in rows.equations)
    touched = own[rows.whole.P.node[:of_contacts]].any() or there[rows.whole.P.row < of_contacts].any()
    if reduced(problem.comm, int(touched or P.used[: config.n_owned][own].any())):
        raise InputError(
            "contacts act at nodes of the cut that follows, or nodes of it lie on the axis: nodal diameters need a cut apart from both"
        )
    return Harmonic(P, own, diameter, n)


def _slepc() -> Any:
    try:
        from slepc4py import SLEPc
    except ImportError as error:
        raise MissingBackendError(
            f"modes need slepc4py ({error}): install python3-slepc4py-real on Debian, or pip install slepc4py"
        ) from error
    return SLEPc


def _united(P: Restriction, A: PETSc.Mat) -> PETSc.Mat:
    """``P'AP``, with zeros in idle columns (collective)."""
    if not P.alone:
        return A.PtAP(P.P)
    A = A.copy()
    P.cross_out(A)
    return A


def _move_idle(A: PETSc.Mat, used: Bools) -> None:
    """Give components that are not ``used`` a stiffness, for infinite frequencies (collective)."""
    diagonal = A.getDiagonal()
    diagonal.array[~used] = diagonal.max()[1]
    A.setDiagonal(diagonal)


def _solve(
    slepc: Any, problem: UnitedProblem, used: Bools, expand: Callable[[Array], PETSc.Vec], A: PETSc.Mat, B: PETSc.Mat, n: int
) -> Vibrations:
    """Eigenvectors of the n lowest eigenvalues, as displacements, which ``expand`` makes of owned unknowns (collective)."""
    comm, V = problem.comm, problem.u.function_space
    stiffness, inertia = A.getDiagonal(), B.getDiagonal()
    moving = int(reduced(comm, int((used & (inertia.array_r > 0.0)).sum())))
    if moving < n:
        raise InputError(f"n = {n}: expected no more than {moving} modes, the number of free components with mass")
    # in the displacement's rows, which come first
    largest = problem.config.vector(stiffness.array_r[: problem.config.n_owned * problem.config.gdim]).norm() / inertia.norm()
    eps = slepc.EPS().create(comm)
    eps.setOperators(A, B)
    eps.setProblemType(slepc.EPS.ProblemType.GHEP)
    eps.setDimensions(n)
    eps.setTolerances(EIGENVALUE)
    eps.setWhichEigenpairs(slepc.EPS.Which.TARGET_MAGNITUDE)
    # below zero, so that the shifted matrix of floating bodies is regular: halfway, in digits, between rounding and the largest eigenvalue
    eps.setTarget(-np.sqrt(np.finfo(float).eps) * largest)
    transform = eps.getST()
    transform.setType("sinvert")
    ksp = transform.getKSP()
    ksp.setType("preonly")
    ksp.getPC().setType("cholesky")
    ksp.getPC().setFactorSolverType("mumps")
    with timed("eigenvalues"):
        eps.solve()
    if eps.getConverged() < n:
        raise LinearSolveError(
            f"SLEPc found {eps.getConverged()} of {n} modes (reason {eps.getConvergedReason()}): compute fewer, or check that the mass "
            "is not negative and the stiffness symmetric"
        )
    found = []
    for i in range(n):
        q = A.createVecRight()
        value = eps.getEigenpair(i, q).real
        found.append((value, expand(q.array_r)))
    found.sort(key=lambda pair: pair[0])
    values = np.array([value for value, _ in found])
    eps.destroy()
    functions = []
    for i, (_, v) in enumerate(found):
        function, own = fem.Function(V, name=f"mode_{i + 1}"), problem.config.from_rows(v.array_r)
        function.x.array[: len(own)] = own
        function.x.scatter_forward()
        functions.append(function)
    return Vibrations(np.sign(values) * np.sqrt(np.abs(values)) / (2.0 * np.pi), values, functions)
