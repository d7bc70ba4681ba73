"""Massless nodes of the contact surfaces: the contactors, and target nodes if the rest of their body can take the mass.

A contactor and the target nodes below it move together. Mass on either side and the cells of both surfaces would form an oscillator with
the highest frequency of the meshes. Impact excites it, nothing damps it, and the trapezoidal rule adds energy whenever the contact opens.
Without mass on both sides the contact force is the static reaction of the gap.

The initial acceleration of bodies under forces is that of the constrained nodes with mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.seam.placement import Discretisation
from uem_dolfinx.dynamics.mass import Mass
from uem_dolfinx.errors import LinearSolveError
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import followed_nodes, surface_nodes, tributary_areas
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import reduced


def contactor_nodes(contacts: Sequence[Contact]) -> Indices:
    """Owned nodes that are contactors of any contact and not tied ``(n,)``."""
    loose = (contact.pair.nodes[~contact.pair.tied] for contact in contacts)
    return np.unique(np.concatenate([np.zeros(0, np.int32), *loose]))


def without_surfaces(mass: Mass, contacts: Sequence[Contact]) -> Mass:
    """The same bodies with massless contactors, and massless targets in bodies whose other nodes can take the mass (collective).

    Raises:
        MassError: if the other nodes of a body cannot take the mass of its contactors; it names the part that could be massless.
    """
    config, contacts = mass.config, [c for c in contacts if c.tied is not True and not c.is_further_part]
    of_all = [contact for contact in contacts if contact.of_all_surfaces]
    named = [contact for contact in contacts if not contact.of_all_surfaces]
    contactors, spare = contactor_nodes(named), np.zeros(config.n_owned, bool)
    for contact in contacts:
        spare |= followed_by(config, contact.pair.discretisation)[: config.n_owned]
    spare[contactor_nodes(of_all)] = True
    bare = mass.without(contactors, where_possible=np.flatnonzero(spare), distance=lambda: _distances(contactors, named))
    if of_all:
        _warn_of_mass(bare, of_all[0].name, contactor_nodes(of_all))
    return bare


def _warn_of_mass(mass: Mass, name: str, nodes: Indices) -> None:
    """Warn, once, of bodies whose contactors keep their mass because other nodes cannot take it (collective)."""
    body, count = find_bodies(mass.config)
    kept = np.zeros(count, bool)
    kept[body[nodes[mass.of_nodes[nodes].any(axis=1)]]] = True
    number = int(reduced(mass.config.comm, kept, op=MPI.LOR).sum())
    if number:
        logger.warning(
            "%s: %d bodies are too thin, or their meshes too coarse, for massless surfaces: impact will excite vibrations of the surfaces; "
            "refine the bodies to seven layers of cells of degree 1 from one side to the other, six with a lumped mass",
            name, number,
        )  # fmt: skip


def warn_of_soft_targets(mass: Mass, contacts: Sequence[Contact], stiffness: Callable[[], Array]) -> None:
    """Warn of contactors that are stiffer than a target with mass (collective).

    The mass of such a target vibrates on the surface cells of both sides, more strongly for stiffer cells of the contactor.

    Args:
        mass: of the bodies, with massless contactors.
        contacts: all of them.
        stiffness: returns the diagonal of K at the owned nodes ``(n_owned, gdim)``, without inertia (collective).
    """
    config, K = mass.config, None
    massy: Bools = np.asarray(mass.of_nodes.any(axis=1))
    for contact in (c for c in contacts if c.tied is not True and not c.is_further_part):
        kept = followed_by(config, contact.pair.discretisation)[: config.n_owned] & massy
        bare = not massy[contact.pair.nodes].any()
        if not reduced(config.comm, int(kept.any())) or not reduced(config.comm, int(bare), op=MPI.MIN):
            continue
        K = stiffness() if K is None else K
        sides = [_stiffness_per_area(config, tag, K) for tag in (contact.contactor, contact.target)]
        if sides[0] > sides[1] > 0.0:
            logger.warning(
                "%s: the target's body is too thin, or its mesh too coarse, for a massless surface, and the contactor's surface is stiffer "
                "(diagonal of K per area %.3g against %.3g): impact will excite vibrations of the target; swap contactor and target, or "
                "refine the mesh behind the target",
                contact.name, *sides,
            )  # fmt: skip


def followed_by(config: Configuration, discretisation: Discretisation) -> Bools:
    """Local nodes of a contact's target ``(n_local,)`` (collective)."""
    return followed_nodes(config, discretisation.followed)


def _distances(contactors: Indices, contacts: Sequence[Contact]) -> Array:
    """Distance of each of the ``contactors (n,)`` from the nearest target that it may touch ``(n,)`` (collective)."""
    found = np.full(len(contactors), np.inf)
    for whole in {id(contact.pair.whole): contact.pair.whole for contact in contacts}.values():
        whole.project()
    for contact in contacts:
        pair = contact.pair
        # the closest point on a rigid surface is the contactor itself
        away = np.maximum(
            np.linalg.norm(pair.points - pair.kinematics.projection.foot, axis=1), np.abs(pair.kinematics.projection.gap)
        )
        np.minimum.at(found, np.searchsorted(contactors, pair.nodes), away)
    return found


def _stiffness_per_area(config: Configuration, part: object, K: Array) -> float:
    """Mean diagonal of K at the nodes of a surface over their areas; 0 for points and for unknown K (collective)."""
    if not isinstance(part, Tag):
        return 0.0
    nodes = surface_nodes(config, part)
    total, area = reduced(config.comm, np.array([K[nodes].sum(), tributary_areas(config, part)[nodes].sum()]))
    return float(total / area) if area > 0.0 and np.isfinite(total) else 0.0


#: Components with less mass than this part of the largest have no acceleration at the start.
#: [convention; diagonal of P'MP; test_thresholds_motion.py::test_components_without_mass]
MASSLESS = 1e-12
#: Relative tolerance of the residual of the first acceleration. [bound; forces; -]
ACCELERATED = 1e-13


def united_accelerations(
    mass: PETSc.Mat, restriction: Restriction, forces: PETSc.Vec, added: PETSc.Mat | None = None, test: Restriction | None = None
) -> PETSc.Vec:
    """``P a`` with ``Q'MP a = Q' forces``, zero in components without mass (collective).

    Args:
        mass: M, with the rows and columns of the constrained system.
        restriction: P.
        forces: on all unknowns.
        added: masses at points, in addition to M.
        test: Q; by default P.

    Raises:
        LinearSolveError: if masses are negative.
    """
    test = test or restriction

    def united(A: PETSc.Mat) -> PETSc.Mat:
        return A.PtAP(restriction.P) if test is restriction else test.P.transposeMatMult(A.matMult(restriction.P))

    M = mass.copy() if restriction.alone else united(mass)
    if restriction.alone:
        restriction.cross_out(M)
    if added is not None:
        M.axpy(1.0, united(added), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    rhs = test.transpose(forces)
    with timed("first acceleration"):
        q, reason = forms.solve_mass(M, rhs, MASSLESS, ACCELERATED, test is restriction)
    if reason < 0:
        raise LinearSolveError(f"the first acceleration was not found (KSP reason {reason}): check that no mass is negative")
    return restriction.expand(q)
