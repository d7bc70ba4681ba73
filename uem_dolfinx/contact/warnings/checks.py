"""Checks of a contact pair: errors for deep initial penetration and contactors held inside the target, and warnings.

Every check raises or warns on all ranks or on none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import name_at
from uem_dolfinx.contact.seam.active_set import TOUCHING
from uem_dolfinx.errors import ConflictError, ConvergenceError, OverdeterminedError, PenetrationError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.sharp import SHARP_EDGE, to_mean
from uem_dolfinx.geometry.tags import Tag, locate_dofs
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree, reduced

#: Largest penetration of contactors whose equations depend on other equations.
#: [convention; the model's size; test_warnings.py::test_contactors_that_are_left_inside]
LEFT_OUT = 1e-6
#: A force of the wrong sign is a pull if it is above this part of the largest contact force; rounding of positions makes smaller ones.
#: [convention; the largest contact force; test_warnings.py::test_contactors_that_pull]
PULLS = 1e-8
#: Surfaces conform if their clearance is below the sag of the facets on more facets than this, in every direction.
#: [convention; facets; test_warnings.py::test_surfaces_that_conform]
CONFORMING = 4
#: One equation of mortar at a node is sufficient if the sum of the areas of its facets, over the length of the sum of their area vectors,
#: is smaller. The facets of a tip of 39 degrees have this ratio. [convention; areas; test_warnings.py::test_slim_tips]
SLIM = 3.0
#: A warning is given if more than this part of the surface in contact has slid off the end of the target.
#: [convention; area; test_warnings.py::test_contactors_that_slip_off]
SLIPPED = 0.05


def check_initial(pair: Interface) -> dict[int, float]:
    """Refuse an initial penetration beyond the bound, and warn of any other (collective).

    Returns:
        Depth of the deepest contactor of each contact with contactors inside, a length, by ``id`` of its interface.

    Raises:
        PenetrationError: naming the deepest node of the first rank with such a node.
    """
    gap = np.where(pair.off & ~pair.kinematics.ends.drawn(pair.trial), np.inf, pair.kinematics.projection.gap)
    error = None
    if len(pair.members) > 1:
        some = reduced(pair.config.comm, bool((gap < -TOUCHING * pair.config.size).any()), op=MPI.LOR)
        return {key: depth for one in (pair.members if some else ()) for key, depth in check_initial(one).items()}
    if len(gap) and gap.min() < -pair.max_penetration:
        i = int(gap.argmin())
        error = PenetrationError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i]))} starts {-gap[i]:.4g} inside the target, "
            f"more than max_penetration = {pair.max_penetration:.4g}: move the bodies apart, restrict the surfaces to the parts "
            "that can touch, or raise max_penetration if this interference is meant"
        )
    agree(pair.config.comm, error)
    inside = gap < -TOUCHING * pair.config.size
    depth = reduced(pair.config.comm, float(-gap.min(initial=0.0)), op=MPI.MAX)
    count = reduced(pair.config.comm, int(inside.sum()))
    if not count:
        return {}
    words = "%s: %d contactors start up to %.4g inside the target; the first step presses the bodies apart by this interference"
    logger.warning(words, pair.name, count, depth)
    return {id(pair): depth}


def check_prescribed(pair: Interface) -> None:
    """Refuse an equilibrium in which Dirichlet conditions or other contacts hold a contactor inside the target (collective).

    The same applies to a tied contactor that they hold away from its tied position.

    Raises:
        ConflictError: naming the deepest or farthest node of the first rank with such a node.
        OverdeterminedError: likewise, if the node or its target can move and only other contacts contradict its equation.
    """
    left_out = pair.trial.active & pair.trial.redundant
    depth = -pair.kinematics.projection.gap / pair.config.size
    # prescribed contactors of soft contact press as others do
    fixed = ~pair.kinematics.movable & (pair.trial.law_gap is None)
    inside = ~pair.off & ((fixed & (depth > TOUCHING)) | (left_out & (depth > LEFT_OUT)))
    error = None
    if inside.any():
        i = int(np.argmin(np.where(inside, pair.kinematics.projection.gap, np.inf)))
        where = f"{name_at(pair, i)}: the contactor at {pair.config.describe(int(pair.nodes[i]))}"
        by = f"{-pair.kinematics.projection.gap[i]:.4g} inside the target"
        error = (
            OverdeterminedError(
                f"{where} ends {by}: other contacts and conditions of these nodes leave no freedom for its equation; take shorter "
                "steps or finer surfaces there, release a Dirichlet condition, or drop one of several contacts"
            )
            if pair.kinematics.movable[i]
            else ConflictError(
                f"{where} is prescribed to be {by}: a Dirichlet condition or another contact contradicts this one, and neither body can "
                "move there; release the condition along the normal, or drop one of the contacts"
            )
        )
    misfit = np.zeros(len(pair.nodes)) if pair.tie is None else pair.tie.torn()
    if misfit.max(initial=0.0) > LEFT_OUT * pair.config.size:
        i = int(misfit.argmax())
        error = ConflictError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i]))} is held {misfit[i]:.4g} away from its tied position "
            "by Dirichlet conditions or other contacts on both sides of the tie, and neither side can move: release one of them"
        )
    agree(pair.config.comm, error)


def check_signs(pairs: Sequence[Interface], rounding: Sequence[Array]) -> None:
    """Refuse an equilibrium with a hard contactor that pulls, by whatever way it was found (collective).

    Equations that depend on each other, and corners whose facets share a force, leave the sign of single forces to other rules.

    Args:
        pairs: of all contacts.
        rounding: smaller forces are zero, of each pair ``(n,)``.

    Raises:
        ConvergenceError: names the contactor that pulls the most, on the first rank with one.
    """
    hard = [(pair, least, pair.trial) for pair, least in zip(pairs, rounding) if not pair.trial.has_law]
    if not hard:
        return
    comm, error = hard[0][0].config.comm, None
    largest = reduced(comm, max(float(t.lam.max(initial=0.0)) for _, _, t in hard), op=MPI.MAX)
    for pair, least, t in hard:
        pull = np.where(t.active & ~pair.tied, -t.lam, 0.0)
        if (pull > np.maximum(least, PULLS * largest)).any():
            i = int(np.argmax(np.where(pull > least, pull, 0.0)))
            error = ConvergenceError(
                f"{name_at(pair, i)}: the contactor at {pair.config.describe(int(pair.nodes[i]))} pulls with {pull[i]:.3g}, where the "
                f"largest contact force is {largest:.3g}: no active set with forces of one sign was found; take smaller load steps, "
                "or exchange the two surfaces"
            )
            break
    agree(comm, error)


def warn_of_straight_facets(config: Configuration, name: str, tags: list[Tag]) -> None:
    """Warn that a displacement of degree 1 has straight facets on curved surfaces of the mesh (collective).

    Args:
        config: configuration of the displacement.
        name: of the contact.
        tags: its meshed surfaces.
    """
    mesh, g = config.mesh, config.gdim
    n_vertices = len(forms.reference_topology(compat.cell_name(mesh))[0])
    curved_cells = compat.geometry_dofs(mesh).shape[1] > n_vertices
    if config.degree > 1 or not curved_cells:
        return
    V = compat.function_space(mesh, 2, (g,))
    straight, X = fem.Function(V), fem.Function(config.V)
    X.x.array[:] = config.X.ravel()
    straight.interpolate(X)
    curved = V.tabulate_dof_coordinates()[:, :g]
    on = np.concatenate([locate_dofs(V, tag) for tag in tags]).astype(np.int64)
    off = np.linalg.norm(curved[on] - straight.x.array.reshape(-1, g)[on], axis=1).max(initial=0.0)
    off = reduced(config.comm, float(off), op=MPI.MAX)
    if off > TOUCHING * config.size:
        logger.warning(
            "%s: a displacement of degree 1 replaces the curved facets of this mesh by straight ones, up to %.3g away: use degree 2, "
            "uem.function_space(mesh, 2, (%d,))",
            name, off, g,
        )  # fmt: skip


def facet_curvatures(target: MeshTarget) -> Array:
    """Curvature of the surface that each of this rank's facets approximates, minus the curvature of the facet ``(m, gdim, gdim)``.

    Positive for a convex target; zero at corners and on curved facets (collective).
    """
    data = target.facets.current()
    normals = target.facets.normals()
    arms, turns = data.x - data.x.mean(axis=1, keepdims=True), data.nodal_normals - normals
    # facets at a sharp edge do not approximate a curved surface
    turns[np.einsum("mag,mag->ma", data.nodal_normals, normals) < to_mean(SHARP_EDGE)] = 0.0
    # least-squares fit of turn = B arm
    squares = np.einsum("mag,mah->mgh", arms, arms)
    return np.einsum("mag,mah->mgh", turns, arms) @ np.linalg.pinv(squares, rcond=1e-10, hermitian=True)


def sagging(pair: Interface) -> tuple[Bools, Array, Array]:
    """Contactors with clearance below the sag of the target's straight facets, the sags, and the clearances (collective).

    ``(n,)`` each; all False for a rigid target.
    """
    target, p = pair.target, pair.kinematics.projection
    if not isinstance(target, MeshTarget) or not isinstance(p, FacetProjection):
        none = np.zeros(len(pair.nodes))
        return none > 0.0, none, none
    arms = p.x - p.foot[:, None]
    sag = 0.5 * np.einsum("na,nag,ngh,nah->n", p.weights, arms, target.of_facets(p.facet, facet_curvatures(target)), arms)
    clearance, rounding = np.abs(p.gap - sag), TOUCHING * pair.config.size
    close = (clearance < np.abs(sag)) & (np.abs(sag) > rounding) & (np.abs(p.beyond).max(axis=1) < rounding)
    return close, sag, clearance


def warn_of_sagging_facets(pair: Interface) -> None:
    """Warn of conforming surfaces whose clearance is below the sag of the target's straight facets (collective)."""
    if not isinstance(pair.target, MeshTarget):
        return
    (close, sag, clearance), p = sagging(pair), pair.kinematics.projection
    assert isinstance(p, FacetProjection)
    comm = pair.config.comm
    facets = len(set().union(*comm.allgather(set(p.facet[close].tolist()))))
    if facets > CONFORMING ** (pair.config.gdim - 1):
        worst = comm.allgather((float(np.abs(sag[close]).max(initial=0.0)), float(clearance[close].max(initial=0.0))))
        logger.warning(
            "%s: the surfaces conform, but %d straight facets of the target sag by up to %.3g, more than the clearance of %.3g there: "
            "the contact zone depends on the facets; refine the target, give both surfaces the same nodes, or take mesh and displacement "
            "of degree 2",
            pair.name, facets, *np.max(worst, axis=0),
        )  # fmt: skip


def warn_of_slim_tips(config: Configuration, name: str, surface: TargetFacets) -> None:
    """Warn that mortar has a single equation for both sides of a slim tip (collective).

    Args:
        config: configuration of the displacement.
        name: of the contact.
        surface: of the contactor.
    """
    comm, spread = config.comm, surface.spread()
    slim = surface.dofs[spread > SLIM]
    slim = slim[slim < config.n_owned]
    place = next((p for p in comm.allgather(config.describe(int(slim.min())) if len(slim) else None) if p), None)
    if place is not None:
        logger.warning(
            "%s: the contactor's facets at %s meet at less than 40 degrees, and mortar has one equation for all of them, along their mean "
            "normal: such a tip may pass into a target on one of its sides; take coupling = 'node_to_surface'",
            name, place,
        )  # fmt: skip


def warn_of_slipped(pair: Interface, before: Bools, areas: Array) -> bool:
    """Warn of contactors that have slid off the end of the target, and of their part of the surface (collective).

    Args:
        pair: in equilibrium.
        before: contactors that were past an end at the start ``(n,)``.
        areas: tributary areas ``(n,)``.

    Returns:
        Whether a warning was given.
    """
    p = pair.kinematics.projection
    near = p.way_beyond < 0.5 * p.facet_size
    slipped = pair.off & ~before & near & (p.gap < 0.0)
    if pair.kinematics.ends.out is not None:
        slipped &= ~pair.kinematics.ends.out
    sums = np.array([areas[slipped].sum(), areas[pair.trial.active].sum(), float(slipped.sum())])
    lost, held, count = reduced(pair.config.comm, sums)
    if lost <= SLIPPED * (lost + held):
        return False
    logger.warning(
        "%s: %d contactors have slid off the end of the target, and with them %.0f %% of the surface in contact carry no force: let the "
        "target reach farther, swap contactor and target, or refine the surfaces at the end",
        pair.name, int(count), 100.0 * lost / (lost + held),
    )  # fmt: skip
    return True


def check_new(contacts: Sequence[Any]) -> None:
    """Refuse contacts that already belong to a problem, or occur twice in the list, by a SpaceError that names the first one."""
    for i, contact in enumerate(contacts):
        if contact.taken or any(contact is other for other in contacts[:i]):
            where = "belongs to another problem" if contact.taken else f"is contacts[{i}] and occurs earlier in the list"
            raise SpaceError(f"contact '{contact.name}' {where}: expected new ones; make a new Contact for every problem")


def check_moved(pair: Interface) -> None:
    """Raise InputError for a rigid target with different positions on different ranks (collective)."""
    if pair.target.n_nodes or pair.config.comm.size == 1:
        return
    if len(pair.members) > 1:
        for one in pair.members:
            check_moved(one)
        return
    m = pair.target.motion
    where = "not moved" if m is None else " ".join(f"{x:.9g}" for x in np.concatenate([m.translation, m.Q.ravel(), m.about]))
    given.alike(
        pair.config.comm, f"contact '{pair.name}', move() of its rigid target", **{"translation, rotation and point": where}
    )
