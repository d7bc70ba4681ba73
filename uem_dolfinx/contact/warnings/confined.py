"""Warnings of confined bodies that give way into the room between surfaces which nodes alone hold.

Supports that move by u take the volume ``-int u . n`` over their surfaces from bodies that are confined on all sides. Where gaps are
closed, the bodies lose as much, ``-int tr grad u``, less the volume of initial gaps, of which offsets take a part. On meshes that do
not match, contact by nodes leaves room between the nodes: bodies that hardly change their volume give way into it, and resist by less.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.geometry.axisymmetry import displacement_gradient, revolved
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.surfaces import exterior_facets, surface_nodes, tributary_areas
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import compiling, logger
from uem_dolfinx.parallel import reduced

#: A warning is given if so much of the volume that confined bodies should lose is room between their surfaces.
#: [convention; volume to be lost; test_confined.py::test_bodies_that_give_way]
ROOM = 3e-3
#: Surfaces whose areas differ by less than this part cover each other. [bound; area of the target; -]
COVERED = 0.02
#: A support does not move along a normal of which no more than this part, squared, is along free components.
#: [bound; a unit vector; -]
HELD = 1e-6


class Confined:
    """Bodies that Dirichlet conditions and placed contacts may confine on all sides (collective)."""

    def __init__(self, contacts: Sequence[Any]):
        self._contacts, self._config = contacts, contacts[0].config
        self._outside = exterior_facets(self._config)
        #: Facets of all contacts' surfaces.
        self._sides = np.concatenate(
            [side.entities for c in contacts for side in (c.contactor, c.target) if isinstance(side, Tag)]
        )
        #: Heights of each contact's contactors at the start, gaps without offsets ``(n,)``.
        self._heights = [np.array(c.pair.kinematics.heights()) for c in contacts]
        #: Components without Dirichlet condition for which ``_confined`` is known.
        self._free: Any = None
        self._confined = self._warned = False

    def _area(self, side: Any) -> float:
        """Area of a surface (collective)."""
        nodes = surface_nodes(self._config, side)
        return float(reduced(self._config.comm, float(tributary_areas(self._config, side)[nodes].sum())))

    def look(self) -> None:
        """Warn, once, if bodies give way into the room between surfaces (collective)."""
        free = self._contacts[0].pair.discretisation.setting.free
        if self._free is not free:
            self._free, self._confined = free, self._is_confined(free)
        if self._warned or not self._confined:
            return
        closed = all(c.on and bool(c.pair.united.all()) for c in self._contacts)
        if not reduced(self._config.comm, closed, op=MPI.LAND):
            return
        areas, of_volumes = self._volumes
        offsets = (c.pair.discretisation.setting.offset for c in self._contacts)
        gaps = sum(
            float((area * (height - (0.0 if offset is None else offset))).sum())
            for area, height, offset in zip(areas, self._heights, offsets)
        )
        gaps = float(reduced(self._config.comm, gaps))
        taken, *lost, size = (forms.assemble_scalar(form, self._config.comm) for form in of_volumes)
        # small strains neglect products of gradients, finite strains do not
        room, size = min(abs(taken - gaps - one) for one in lost), max(abs(taken - gaps), size)
        if room > ROOM * size:
            self._warned = True
            logger.warning(
                "%s: confined bodies give way into room between surfaces that nodes alone hold, %.2g %% of the volume that they should "
                "lose: forces are too small by that part or several times as much; take coupling = 'mortar', or meshes that match",
                ", ".join(c.name for c in self._contacts), 100.0 * room / size,
            )  # fmt: skip

    def _is_confined(self, free: Bools) -> bool:
        """Whether all surfaces are held, or are covering sides of contacts, for components ``free (n_owned, gdim)`` (collective)."""
        config, comm = self._config, self._config.comm
        loose = np.zeros(config.n_owned, dtype=bool)
        loose[surface_nodes(config, self._outside)] = True
        loose &= free.all(axis=1)
        for contact in self._contacts:
            for side in (contact.contactor, contact.target):
                if isinstance(side, Tag):
                    loose[surface_nodes(config, side)] = False
        if reduced(comm, int(loose.any())):
            return False
        outside = facets_of(config, self._outside, "outside")
        along = config.ask_owners(outside.nodes.ravel(), free.astype(float)).reshape(*outside.nodes.shape, -1)
        moves = ((outside.normals(drawn=True) ** 2 * along).sum(axis=2) > HELD).any(axis=1)
        if reduced(comm, int((moves & ~np.isin(outside.entities, self._sides)).any())):
            return False
        return all(self._covers(contact) for contact in self._contacts)

    def _covers(self, contact: Any) -> bool:
        """Whether both sides of a contact have the same area (collective)."""
        if not isinstance(contact.target, Tag):
            return True
        own, theirs = self._area(contact.contactor), self._area(contact.target)
        return abs(own - theirs) <= COVERED * theirs

    @cached_property
    def _volumes(self) -> tuple[list[Array], list[Any]]:
        """Areas of each contact's contactors ``(n,)``, and four forms (first time: collective).

        Of the volume that supports take, of that which bodies lose in small and in finite strains, and of its size everywhere.
        """
        areas = [tributary_areas(self._config, c.contactor)[c.pair.nodes] for c in self._contacts]
        mesh, u = self._config.mesh, self._config.u
        G = displacement_gradient(u)
        held = np.setdiff1d(self._outside.entities, self._sides)
        taken = -ufl.inner(u, ufl.FacetNormal(mesh)) * forms.surface_measure(mesh, held)
        dx = ufl.dx(domain=mesh)
        lost = -ufl.tr(G) * dx, (1.0 - ufl.det(ufl.Identity(G.ufl_shape[0]) + G)) * dx, abs(ufl.tr(G)) * dx
        with compiling("volumes of confined bodies"):
            return areas, [forms.form(revolved(form)) for form in (taken, *lost)]
