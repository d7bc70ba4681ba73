"""Warnings of rigid contactors that are finer than their deformable target, and advice where their equations depend on each other.

A rigid body has three motions in 2D and six in 3D. If its contactors outnumber these and the target's nodes opposite, their equations
depend on each other, the distribution of forces among them is not unique, and the active set may cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.conditions.seams import seams_of
from uem_dolfinx.contact.both_sides import OfBothSides
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.warnings.checks import SLIPPED
from uem_dolfinx.errors import ConvergenceError, OverdeterminedError, UEMError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.surfaces import surface_nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced

#: Sides of facets whose mean lengths differ by less than this part are equally long.
#: [convention; length of a side; test_rigid_sides.py::test_equal_facets]
EQUALLY_LONG = 1e-3


class RigidSides:
    """Nodes that couplings or Dirichlet conditions make ``rigid (n_owned,)``, and contacts with such contactors (collective)."""

    def __init__(self, contacts: Sequence[Any], rigid: Bools):
        self._contacts: list[OfBothSides] = list(contacts)
        self._rigid = rigid
        for contact in contacts:
            self._warn(contact.config, contact)

    def _warn(self, config: Configuration, contact: Any) -> None:
        """Warn of a rigid contactor with shorter facets than a deformable target (collective)."""
        meshed = isinstance(contact.target, Tag) and isinstance(contact.contactor, Tag) and contact.contactor.dim > 0
        if (
            not meshed
            or contact.tied is True
            or not self._whole(config, contact.whole_side())
            or self._whole(config, surface_nodes(config, contact.target))
        ):
            return
        own, theirs = (_side(config, tag) for tag in (contact.contactor, contact.target))
        if own < (1.0 - EQUALLY_LONG) * theirs:
            logger.warning(
                "%s: the contactor is rigid and finer than its target (facets of %.3g on %.3g), so that equations of contactors depend on "
                "each other and the active set may cycle: make the rigid surface the target and the deformable one the contactor",
                contact.name, own, theirs,
            )  # fmt: skip

    def _whole(self, config: Configuration, nodes: Indices) -> bool:
        """Whether there are ``nodes (k,)``, all of them rigid (collective)."""
        rigid = self._rigid[nodes]
        some, free = reduced(config.comm, np.array([len(rigid), (~rigid).sum()]))
        return bool(some) and not free

    def advise(self, error: UEMError) -> None:
        """Add advice to an error of an active set if equations of rigid contactors depend on others in the present state (collective)."""
        if not isinstance(error, ConvergenceError | OverdeterminedError):
            return
        for contact in self._contacts:
            pair = contact.pair
            if reduced(pair.config.comm, int((pair.trial.active & pair.trial.redundant & self._rigid[pair.nodes]).sum())):
                error.amend(
                    f"{contact.name}: equations of contactors on a rigid body depend on each other: make the rigid surface the target, "
                    "in general contact by order=[...] with the deformable body first",
                    instead=True,
                )
                return


def _side(config: Configuration, tag: Tag) -> float:
    """Mean length of the sides of a surface's facets (collective)."""
    facets = facets_of(config, tag)
    x, ends = config.X[facets.dofs], np.array(facets.shape.topology[1])
    sides = np.linalg.norm(x[:, ends[:, 1]] - x[:, ends[:, 0]], axis=2)
    total, number = reduced(config.comm, np.array([sides.sum(), sides.size]))
    return float(total / max(number, 1.0))


def warn_past_seams(contacts: Sequence[Any]) -> None:
    """Warn of contactors that start past the end of a target that continues at its seam, on the other side of the body (collective).

    There are no images of a target: contact is missing there, and contactors next to it bear that force.
    """
    for contact in contacts:
        pair, config, seams = contact.pair, contact.config, seams_of(contact.config)
        if seams is None or not isinstance(contact.target, Tag) or contact.contactor.dim == 0:
            continue
        theirs = surface_nodes(config, contact.target)
        joined = np.zeros((config.n_owned, 1))
        joined[theirs[np.isin(config.to_global(theirs), seams.groups(config, theirs)[0])]] = 1.0
        p, share = pair.kinematics.nearest, pair.kinematics.ends.share
        bare = pair.off if share is None else pair.off | ((share >= 0.0) & (share < 1.0 - SLIPPED))
        at_seam = (config.ask_owners(p.nodes.ravel(), joined).reshape(p.nodes.shape) > 0).any(axis=1)
        count = reduced(config.comm, int((bare & at_seam & (np.abs(p.gap) < p.facet_size)).sum()))
        if count:
            logger.warning(
                "%s: the target ends at the seam of a periodic body, and %d contactors start past this end: contact is missing there, "
                "and pressures next to it are too large; cut both bodies at the same place",
                contact.name, count,
            )  # fmt: skip


def warn_of_seams(pairs: Sequence[Interface]) -> None:
    """Warn of equations between contactors of one mortar contact that do not give them one displacement (collective).

    Each of these contactors has the equation of the segments on its own side, although they move together. The sum of their forces is
    correct up to the angle between the normals of the two sides, but acts on one of them.
    """
    for pair in pairs:
        config, seams = pair.config, seams_of(pair.config)
        if seams is None:
            continue
        from uem_dolfinx.contact.mortar.placement import Contactors

        if not isinstance(pair.discretisation, Contactors):
            continue
        is_contactor = np.zeros((config.n_owned, 1))
        is_contactor[pair.nodes] = 1.0
        places = []
        for row, node in seams.others(*seams.groups(config, pair.nodes)):
            there = config.ask_owners(node, is_contactor)[:, 0] > 0
            several = np.bincount(row[there]) > 1
            places.append(config.ask_owners(node[there][several[row[there]]], config.X[: config.n_owned]))
        at = np.concatenate(places)
        if not reduced(config.comm, len(at)):
            continue
        low = [reduced(config.comm, float(x.min(initial=np.inf)), op=MPI.MIN) for x in at.T]
        high = [reduced(config.comm, float(x.max(initial=-np.inf)), op=MPI.MAX) for x in at.T]
        ends = (", ".join(f"{round(x / config.size, 9) * config.size + 0.0:.6g}" for x in end) for end in (low, high))
        logger.warning(
            "%s: equations tie contactors between (%s) and (%s) to each other, but do not give them one displacement, and "
            "coupling='mortar' gives each the equation of its own side: in contact, the pressure of one is too large by up to the force of "
            "the other, and degree 2 may not converge; take coupling='node_to_surface', or put the seam where there is no contact",
            pair.name, *ends,
        )  # fmt: skip
