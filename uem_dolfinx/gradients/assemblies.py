"""Derivatives by parameters of equations, couplings, forces at nodes, preloads and soft laws; and the values of these in recorded steps.

Right-hand sides of equations and prescribed motions change gaps of users' equations; forces at nodes and in sections change the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from dolfinx import fem

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.ties.preloaded import Preloaded
from uem_dolfinx.errors import InputError
from uem_dolfinx.solve.problem import UnitedProblem


def constants_of(problem: UnitedProblem) -> list[fem.Constant]:
    """Constants in equations, couplings, forces at nodes and laws of soft contacts, each once."""
    values = [getattr(one, name, None) for one in (*problem.equations, *problem.points) for name in ("b", "force")]
    values += [value for one in _rigid(problem.couplings) for value in one.values_given()]
    values += [value for contact in problem.contacts for value in constants_of_law(contact)]
    return list({id(one): one for one in values if isinstance(one, fem.Constant)}.values())


def constants_of_law(contact: Contact) -> list[fem.Constant]:
    """Constants in the law of a soft contact."""
    return [] if contact.normal is None else contact.normal.constants


def section_of(pair: Interface) -> Preloaded | None:
    """The tie of a preloaded section; None for other contacts."""
    return pair.tie if isinstance(pair.tie, Preloaded) else None


class Users:
    """Derivatives by Constants through equations, couplings, forces at nodes and laws of soft contacts, at fixed displacement.

    Args:
        problem: in the state of the derivatives.
        share: of values that are ramped with the Dirichlet values, NaN if it is not known.
    """

    def __init__(self, problem: UnitedProblem, share: float):
        self._problem, self._share = problem, share
        self._known = constants_of(problem)

    def have(self, m: Any) -> bool:
        """Whether a control is one of their Constants."""
        return any(m is one for one in self._known)

    def changes(self, m: fem.Constant, change: Array) -> tuple[Array, Array]:
        """Changes of the gaps of users' equations ``(k,)`` and of the residual ``(n_owned, gdim)`` (collective).

        InputError for a value that is ramped from a displacement that depends on earlier steps.
        """
        problem, pushed = self._problem, np.zeros((self._problem.config.n_owned, self._problem.config.gdim))
        if problem.bodies.tangent.points is not None:
            pushed = -_difference(m, change, problem.bodies.tangent.points.loads)
        for contact in problem.contacts:
            if any(m is one for one in constants_of_law(contact)):
                pushed = pushed + float(change) * contact.pair.pushed_by(m)  # type: ignore[attr-defined]
        parts = [] if problem.linear is None else problem.linear.parts
        gaps = [one.opened(_difference(m, change, one.values), self._share) for one in parts]
        found = np.concatenate([np.zeros(0), *gaps])
        if np.isnan(found).any():
            raise InputError(
                "the value of an equation, or of the motion of a coupling, is on its way from a displacement whose derivatives are not "
                "known: expected the end of this ramp, load factor 1"
            )
        return found, pushed


def _difference(m: fem.Constant, change: Array, values: Callable[[], Array]) -> Array:
    """Change of values that are affine in a Constant (collective)."""
    before, found = np.array(m.value), []
    try:
        for now in (np.asarray(change, dtype=float), 0.0 * before):
            m.value[...] = now
            found.append(values())
    finally:
        m.value[...] = before
    return found[0] - found[1]


def by_section(section: Preloaded, parameter: str, n: int) -> tuple[Array, Array]:
    """Derivatives of its ``n`` gaps and of the residual ``(n_owned, gdim)`` by its force or shortening (collective).

    They vanish in steps that prescribe the other of both.
    """
    gaps, pushed = np.zeros(n), np.zeros((section.config.n_owned, section.config.gdim))
    if parameter == "shortening":
        gaps[:] = section.along[:n] if section.locked and section.shortened else 0.0
    elif (unit := section.applied_forces(1.0)) is not None:
        pushed = -section.config.add_at_owners(*unit)
    return gaps, pushed


class Prescribed(NamedTuple):
    """What equations, couplings and preloads of a problem prescribe in a step."""

    equations: list[Any]  # values and ramps of users' equations
    couplings: list[dict[str, Any]]  # values of functions of the load factor, by coupling
    #: force of each preload, whether its opening is locked or prescribed, and the opening.
    sections: list[tuple[float, bool, bool, float]]

    @classmethod
    def of(cls, problem: UnitedProblem) -> Prescribed:
        """The present ones."""
        return cls(
            [] if problem.linear is None else [one.led for one in problem.linear.parts],
            [dict(one.evaluated) for one in _rigid(problem.couplings)],
            [(one.force, one.locked, one.shortened, one.opening) for one in _sections(problem)],
        )

    def put_back(self, problem: UnitedProblem) -> None:
        """Prescribe it again."""
        for one, led in zip([] if problem.linear is None else problem.linear.parts, self.equations):
            one.led = led
        for coupling, values in zip(_rigid(problem.couplings), self.couplings):
            coupling.evaluated = dict(values)
        for section, kept in zip(_sections(problem), self.sections):
            section.put(*kept)


def _rigid(couplings: Sequence[Any]) -> list[Any]:
    return [one for one in couplings if hasattr(one, "evaluated")]


def _sections(problem: UnitedProblem) -> list[Preloaded]:
    return [section for section in map(section_of, problem.interfaces) if section is not None]
