"""Derivatives of contact pressures by contact forces, displacement and shape, at the present state; and their transpose.

A pressure is a force over an area, ``p = lam / A``. With lam from the multipliers of the equations, and A from the facets around the
contactor,

    p' = lam' / A - p A' / A + p s'

where A' is the change of integrals of shape functions, and s' the relative change by :class:`Stretch`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import reduced


class PressureWeights(NamedTuple):
    """Derivative of ``sum w_i p_i``.

    Attributes:
        multipliers: by the multipliers of the equations ``(m,)``.
        areas: functional whose derivatives by displacement and shape are the derivatives through the areas; None for points.
        now: by the present positions of the owned nodes ``(n_owned, gdim)``, at fixed forces and ``areas``.
        drawn: by the reference positions of the owned nodes ``(n_owned, gdim)``, at fixed present positions.
    """

    multipliers: Array
    areas: ufl.Form | None
    now: Array
    drawn: Array


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
        """Changes of the pressures of this rank's contactors ``(n,)`` (collective).

        Args:
            multipliers: changes of the multipliers of the equations ``(m,)``.
            du: change of the displacement, and of all other fields.
            shape: change of the reference positions of the nodes, in the displacement's space.
        """
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
