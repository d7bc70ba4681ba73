"""Derivatives by Functions that are the friction or the offset of contacts, each with one value at a contactor.

Derivatives of contact pressures by contact forces, displacement and shape, at the present state; and their transpose.

A pressure is a force over an area, ``p = lam / A``. With lam from the multipliers of the equations, and A from the facets around the
contactor,

    p' = lam' / A - p A' / A + p s'

where A' is the change of integrals of shape functions, and s' the relative change by :class:`Stretch`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import as_law
from uem_dolfinx.contact.nodes.bernstein import Bernstein
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.errors import InputError
from uem_dolfinx.gradients.parameters import contactors_of, keeps_distance, rubbed, rubbed_along, thickened
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


def fields_of(problem: UnitedProblem) -> list[Any]:
    """Functions that are the friction or the offset of contacts."""
    return [f for c in problem.contacts for f in (as_law(c.friction).field, c.offset) if isinstance(f, fem.Function)]


def check_field(problem: UnitedProblem, what: str, m: fem.Function) -> None:
    """InputError for a Function of contacts by which there are no derivatives (to be agreed on)."""
    for contact in problem.contacts:
        called, pair = f"{what}, '{m.name}', of contact '{contact.name}'", contact.pair
        rubs, thickens = as_law(contact.friction).field is m, contact.offset is m
        if (rubs or thickens) and contact.further_parts_touch():
            raise InputError(f"{called}: its target's corners or edges touch: expected corners=False, edges=False")
        if thickens and (not pair.discretisation.traits.pointwise or isinstance(pair.discretisation, Bernstein)):
            raise InputError(
                f"{called}, is an offset: there is no derivative by its values with mortar or degree 2, whose gaps are of several nodes: "
                "expected coupling='node_to_surface' and degree 1, or ContactParameter(contact, 'offset')"
            )
        if thickens and not keeps_distance(contact):
            raise InputError(f"{called}, is an offset from a rigid surface: expected a plane, a sphere or a cylinder, or a mesh")


def by_contacts(at: Any, m: fem.Function, by_gaps: Array, a: Array) -> tuple[Ints, Array]:
    """Derivatives of a functional by the values of a Function through contacts (collective).

    Args:
        at: the linearised problem, a ``Linearised``.
        m: a Function.
        by_gaps: derivative of the functional by the gaps of all equations ``(m,)``.
        a: adjoint displacement of the owned nodes ``(n_owned, gdim)``.

    Returns:
        Local degrees of freedom of m, and their derivatives, both ``(k,)``.
    """
    entries, found = [np.zeros(0, np.int64)], [np.zeros(0)]
    for contact in at.problem.contacts:
        for own, values in _slopes(at, contact, m, by_gaps, a):
            entries.append(_entries(at, m, contact)[own])
            found.append(values)
    return np.concatenate(entries), np.concatenate(found)


def _slopes(at: Any, contact: Contact, m: fem.Function, by_gaps: Array, a: Array) -> list[tuple[Ints, Array]]:
    """Contactors of one contact, and derivatives by their values."""
    found: list[tuple[Ints, Array]] = []
    if as_law(contact.friction).field is m and contact.pair.friction is not None:
        found.append((np.arange(len(contact.pair.nodes)), -rubbed_along(contact.pair, a)))
    if contact.offset is m:
        own, which = at.equations_of(contact, "its offset")
        opened, worked = thickened(contact.pair, own, at.multipliers[which], a)
        mine, (_, rows) = contactors_of(own, contact.pair), table_of(contact.pair)
        found.append((own.contactor[mine] - rows.start, (by_gaps[which] * opened - worked)[mine]))
    return found


def along_field(at: Any, m: fem.Function, change: Array) -> tuple[Array, Array]:
    """Changes of gaps ``(m,)`` and residual ``(n_owned, gdim)`` along changes of a Function's local values (collective)."""
    gaps, pushed = np.zeros_like(at.multipliers), np.zeros((at.config.n_owned, at.config.gdim))
    for contact in at.problem.contacts:
        if as_law(contact.friction).field is m and contact.pair.friction is not None:
            pushed = pushed + rubbed(contact.pair, change[_entries(at, m, contact)])
        if contact.offset is m:
            own, which = at.equations_of(contact, "its offset")
            whole, rows = table_of(contact.pair)
            more = np.zeros(len(whole.nodes))
            more[rows] = change[_entries(at, m, contact)]
            more = more[own.contactor]
            opened, forces = thickened(contact.pair, own, at.multipliers[which] * more)
            gaps[which] += opened * more
            pushed = pushed + forces
    return gaps, pushed


def _entries(at: Any, m: fem.Function, contact: Contact) -> Ints:
    """Local degrees of freedom of m at the contactors ``(n,)``."""
    entries = at.config.entries_in(m.function_space)
    assert entries is not None
    return np.asarray(entries[contact.pair.nodes], dtype=np.int64)


class PressureWeights(NamedTuple):
    """Derivative of ``sum w_i p_i``."""

    multipliers: Array  # by the multipliers of the equations ``(m,)``
    #: functional whose derivatives by displacement and shape are the derivatives through the areas; None for points.
    areas: ufl.Form | None
    now: Array  # by the present positions of the owned nodes ``(n_owned, gdim)``, at fixed forces and ``areas``
    drawn: Array  # by the reference positions of the owned nodes ``(n_owned, gdim)``, at fixed present positions


class PressureSlopes:
    """Derivatives of the pressures of a contact without friction (collective).

    Args:
        contact: of a problem.
        equations: of its interface in use, in the present state.

    Raises:
        InputError: if further parts touch, or a concave corner holds contactors, whose pressures come from several facets with
            rotating normals; also at sharp edges of contactors, without mortar.
    """

    def __init__(self, contact: Contact, equations: ContactRows):
        self.contact, self._pair, self._equations = contact, contact.pair, equations
        self._whole, self._rows = table_of(contact.pair)
        self._config, self._current = contact.config, contact.measure == "current"
        if contact.further_parts_touch():
            raise InputError(
                f"contact '{contact.name}': corners or edges touch, and pressures with their forces have no derivatives here; take "
                "corners=False, edges=False, or forces"
            )
        held = self._pair.trial.active & self._pair.trial.in_corner
        if reduced(self._config.comm, int(held.sum())):
            raise InputError(
                f"contact '{contact.name}': a concave corner of the target holds contactors, whose pressures have no derivatives here; "
                "take forces: the residual with a Function in place of its test function"
            )
        sharp = contact.coupling != "mortar" and self._pair.trial.active & contact.surface.at_sharp_edges(contact.nodes)
        if reduced(self._config.comm, int(np.sum(sharp))):
            raise InputError(
                f"contact '{contact.name}': nodes at sharp edges of the contactor touch, and their areas towards the target have no "
                "derivatives here: leave the facets next to the edge out of the contactor, or take forces"
            )
        areas, self._pressures = contact.measured_areas(), contact.pressures
        self._over = np.where(areas > 0, 1.0 / np.where(areas > 0, areas, 1.0), 0.0)
        self._map = self._pair.kinematics.pressure_map(self._current)

    def back(self, weights: Array) -> PressureWeights:
        """The derivative of ``sum w_i p_i`` for weights of this rank's contactors ``(n,)`` (collective)."""
        config, nodes, own, eq = self._config, self._pair.nodes, weights * self._over * self._map.force, self._equations
        now, drawn = np.zeros((2, config.n_owned, config.gdim))
        if self._map.stretch is not None:
            now, drawn = self._map.stretch.back(weights * self._pressures)
        by_areas = self._map.back(-weights * self._pressures * self._over)
        areas = None
        if self.contact.contactor.dim > 0:
            q = fem.Function(compat.function_space(config.mesh, config.degree))
            q.x.array[nodes] = by_areas
            q.x.scatter_forward()
            areas = self.contact.surface.integral(q, self._current)
        every = np.zeros(len(self._whole.nodes))
        every[self._rows] = own
        return PressureWeights(np.where(eq.normal, every[eq.contactor], 0.0), areas, now, drawn)

    def along(self, multipliers: Array, du: fem.Function, shape: fem.Function) -> Array:
        """Changes of the pressures of this rank's contactors ``(n,)`` with multipliers ``(m,)``, all fields and the shape (collective)."""
        config, nodes, p = self._config, self._pair.nodes, self._pressures
        lam, areas = self._whole.forces(self._equations, multipliers).lam[self._rows], np.zeros(len(nodes))
        if self.contact.contactor.dim > 0:
            V = compat.function_space(config.mesh, config.degree)
            area = self.contact.surface.integral(ufl.TestFunction(V), self._current)
            along_u = forms.expanded(ufl.derivative(area, config.whole, du))
            for form in (along_u, forms.by_places(area, config.mesh, shape)):
                if form is not None:
                    areas += forms.assemble_array(V, forms.form(form))[nodes]
        slopes = self._over * (lam - p * self._map.along(areas))
        if self._map.stretch is not None:
            drawn = shape.x.array.reshape(-1, config.gdim)
            slopes += p * self._map.stretch.along(config.of(du.x.array) + drawn, drawn)
        return slopes
