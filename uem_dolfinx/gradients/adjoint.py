"""The adjoint problem of a functional at a linearised equilibrium, and its derivatives by controls; see ``linearised``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.form_checks import Control
from uem_dolfinx.gradients.contact_fields import by_contacts, fields_of
from uem_dolfinx.gradients.linearised import Linearised
from uem_dolfinx.gradients.parameters import ContactParameter
from uem_dolfinx.parallel import reduced


class Adjoint:
    """The adjoint problem of one functional (collective).

    Args:
        at: the problem, linearised.
        J: the functional.
        pressing: contacts whose pressures it contains.
        handed: derivative by the positions of the owned nodes through the history of later steps ``(n_owned, gdim)``.

    Attributes:
        a: adjoint displacement, the derivative of J by forces, minus the lift w, a Function of the problem's space.
        left: residual of the adjoint problem: the derivative by a change of the displacement with everything else fixed.
        terms: J with its areas, and the work of the residual along a, with their signs.
        by_values: derivative of J by the prescribed value of every component of vectors, zero where free ``(n_rows, gdim)``.
    """

    def __init__(self, at: Linearised, J: ufl.Form | None, pressing: Sequence[Contact] = (), handed: npt.ArrayLike | float = 0.0):
        self.at, self.config = at, at.config
        config, functionals, weights = at.config, [] if J is None else [J], {}
        now, drawn = at.vector(), at.vector()
        for contact in pressing:
            p = contact.pressure
            of_p = at.derivatives.by_values(functionals[0], p)
            found = at.pressures(contact).back(np.zeros(len(contact.nodes)) if of_p is None else of_p[contact.nodes])
            weights[contact] = found.multipliers
            functionals += [] if found.areas is None else [found.areas]
            now.axpy(1.0, at.vector(found.now))
            drawn.axpy(1.0, at.vector(found.drawn))
        of_u = at.vector()
        for functional in functionals:
            if (part := at.derivatives.by_values(functional, at.problem.u, at.derivatives.test)) is not None:
                of_u.array[:] += config.rows(part).ravel()
        of_u = at.held(of_u)
        lift = at.lift(weights)
        drive = of_u + at.stiffness_back(lift) + now + at.vector(handed)
        whole, self.left = at.adjoint(drive)
        left = whole - lift
        self.a = at.derivatives.a
        self.terms = *((functional, 1.0) for functional in functionals), (at.derivatives.work, -1.0)
        at.derivatives.along(config.from_rows(left.array_r))
        self.by_values = np.where(at.problem.bodies.free_rows, 0.0, at.P.carried_back(self.left))
        #: Derivative by the positions of the nodes, without the shape derivatives of the integrals in J and F ``(n_owned * gdim,)``.
        by_places = (at.body_stiffness_back(left) - of_u + drawn).array_r + self.by_values.ravel()
        self._by_places = by_places[: config.n_owned * config.gdim]

    @cached_property
    def by_gaps(self) -> Array:
        """Derivative by the gaps of all equations ``(m,)`` (first time: collective)."""
        return self.at.by_gaps(self.left)

    @property
    def _at_nodes(self) -> Array:
        """``a`` at the owned nodes of the displacement ``(n_owned, gdim)``."""
        return self.config.of(self.a.x.array)[: self.config.n_owned]

    def by(self, m: Control | ContactParameter) -> Array | fem.Function:
        """Derivative by a control, of the type that ``gradient`` returns."""
        if isinstance(m, ContactParameter):
            return self._by_contact(m)
        if isinstance(m, fem.Constant):
            return self._by_constant(m)
        return self._by_function(m) if isinstance(m, fem.Function) else self._by_shape(m)

    def _by_contact(self, m: ContactParameter) -> Array:
        """An array of its shape."""
        found, a = np.zeros(m.shape(self.config.gdim)), self._at_nodes
        for entry in np.ndindex(found.shape):
            opened, pushed = self.at.changes(m, entry)
            found[entry] = self.at.share(m) * (self.by_gaps @ opened - (a * pushed).sum())
        return np.asarray(reduced(self.config.comm, found))

    def _by_constant(self, m: fem.Constant) -> Array:
        """An array of its shape."""
        found = np.asarray(self.at.derivatives.by_constant(self.terms, m))
        for entry in np.ndindex(found.shape):
            unit = np.zeros(found.shape)
            unit[entry] = 1.0
            work = float((self.by_values * self.at.ramp * self.at.prescribed_by(m, unit)).sum())
            if self.at.users.have(m):
                opened, pushed = self.at.changes_of_users(m, unit)
                work += float(self.by_gaps @ opened - (self._at_nodes * pushed).sum())
            found[entry] += float(reduced(self.config.comm, work))
        return np.asarray(self.at.share(m) * found)

    def _by_function(self, m: fem.Function) -> fem.Function:
        """A Function of its space."""
        found, added = self.at.derivatives.by_function(self.terms, m), fem.Function(m.function_space)
        # Dirichlet values for the entries 1, 2, ... identify the entry that each of them takes
        which = self.at.prescribed_by(m, np.arange(1.0, len(m.x.array) + 1))
        own = which > 0.5
        np.add.at(added.x.array, np.rint(which[own]).astype(np.int64) - 1, (self.at.ramp * self.by_values)[own])
        if any(m is one for one in fields_of(self.at.problem)):
            entries, values = by_contacts(self.at, m, self.by_gaps, self._at_nodes)
            np.add.at(added.x.array, entries, values)
        forms.sum_ghosts(added)
        found.x.array[:] += added.x.array
        return found

    def _by_shape(self, X: ufl.SpatialCoordinate) -> fem.Function:
        """A Function of the space of the mesh's nodes."""
        found, n = self.at.derivatives.by_places(self.terms, X), len(self._by_places)
        found.x.array[:n] += self._by_places
        for which, slopes in self.at.shape_slopes:
            found.x.array[:n] += slopes.back(self.by_gaps[which], -self._at_nodes).ravel()
        found.x.scatter_forward()
        return self.at.places.back(found)
