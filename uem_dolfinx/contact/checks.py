"""What is refused about a contact pair: deep overlaps at the start, contactors that are stuck inside the target; what is warned of.

Every check speaks on all ranks or on none.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.active_set import TOUCHING
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.errors import ConflictError, FrictionError, PenetrationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree

#: A contactor whose equation depends on others may be left inside the target by this part of the model's size.
#: [heuristic; the model's size; -]
LEFT_OUT = 1e-6
#: A contactor is driven over the target if its prescribed components move by more than this part of the model's size in a step.
#: [convention; the model's size; test_friction_prescribed.py::test_contactors_that_are_driven]
DRIVEN = 1e-9
#: Facets whose normals turn by more than this from their nodes' meet at a corner; they are not straight pieces of a curve.
#: [convention; slope; test_warnings.py::test_corners_are_no_curves]
CORNER = 0.5
#: Surfaces that come nearer than their facets sag on more facets than this, in every direction, conform.
#: [convention; facets; test_warnings.py::test_surfaces_that_conform]
CONFORMING = 4
#: Contactors that have slid off the target's end are told of if they have more than this part of the surface in contact.
#: [convention; area; test_warnings.py::test_contactors_that_slip_off]
SLIPPED = 0.05


def check_initial(pair: ContactPair) -> None:
    """Refuse an initial penetration beyond the bound, and tell about any other (collective).

    Raises:
        PenetrationError: naming the deepest node of the first rank that has one.
    """
    gap = np.where(pair.off, np.inf, pair.projection.gap)
    error = None
    if len(gap) and gap.min() < -pair.max_penetration:
        i = int(gap.argmin())
        error = PenetrationError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i]))} starts {-gap[i]:.4g} inside the target, "
            f"more than max_penetration = {pair.max_penetration:.4g}: move the bodies apart, restrict the surfaces to the parts "
            "that can touch, or raise max_penetration if this interference is meant"
        )
    agree(pair.config.comm, error)
    inside = gap < -TOUCHING * pair.config.size
    depth = pair.config.comm.allreduce(float(-gap.min(initial=0.0)), op=MPI.MAX)
    count = pair.config.comm.allreduce(int(inside.sum()))
    if count:
        pair.initial_overlap = depth
        logger.warning(
            "%s: %d contactors start up to %.4g inside the target; the first step presses the bodies apart by this interference",
            pair.name, count, pair.initial_overlap,
        )  # fmt: skip


def check_prescribed(pair: ContactPair) -> None:
    """Refuse an equilibrium in which a contactor is held inside the target by Dirichlet conditions or other contacts (collective).

    Raises:
        ConflictError: naming the deepest such node of the first rank that has one.
    """
    left_out = pair.trial.active & pair.redundant
    depth = -pair.projection.gap / pair.config.size
    inside = ~pair.off & ((~pair.movable & (depth > TOUCHING)) | (left_out & (depth > LEFT_OUT)))
    error = None
    if inside.any():
        i = int(np.argmin(np.where(inside, pair.projection.gap, np.inf)))
        error = ConflictError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i]))} is prescribed to be "
            f"{-pair.projection.gap[i]:.4g} inside the target, where a Dirichlet condition or another contact fights the uniting "
            "equation and neither body can give way: release the condition along the normal, or drop one of the contacts"
        )
    agree(pair.config.comm, error)


def check_driven(pair: ContactPair, way: Array, pressed: Bools) -> None:
    """Refuse contactors that are driven over the target by Dirichlet conditions, which friction cannot act on (collective).

    Args:
        pair: with friction.
        way: of prescribed components along the target in this step ``(n, gdim)``.
        pressed: contactors that friction would act on ``(n,)``.

    Raises:
        FrictionError: naming the first such contactor of the first rank that has one.
    """
    driven = np.linalg.norm(way, axis=1) > DRIVEN * pair.config.size
    i = np.flatnonzero(driven & pressed)
    error = None
    if len(i):
        error = FrictionError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i[0]]))} is driven over the target by a Dirichlet "
            "condition, and friction cannot act on a prescribed component: drive other nodes of the body, or make the other surface "
            "the contactor"
        )
    agree(pair.config.comm, error)


def warn_of_straight_facets(config: Configuration, name: str, tags: list[Tag]) -> None:
    """Tell that a displacement of degree 1 makes straight facets of surfaces that the mesh has curved (collective).

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
    on = np.concatenate([fem.locate_dofs_topological(V, tag.dim, tag.entities) for tag in tags]).astype(np.int64)
    off = np.linalg.norm(curved[on] - straight.x.array.reshape(-1, g)[on], axis=1).max(initial=0.0)
    off = config.comm.allreduce(float(off), op=MPI.MAX)
    if off > TOUCHING * config.size:
        logger.warning(
            "%s: a displacement of degree 1 makes straight facets of the curved ones of this mesh, up to %.3g off them: take one of "
            "degree 2, uem.function_space(mesh, 2, (%d,))",
            name, off, g,
        )  # fmt: skip


def facet_curvatures(target: MeshTarget) -> Array:
    """How the normal of the surface behind each of this rank's facets changes along it, and the facet's does not ``(m, gdim, gdim)``.

    Positive where the target is convex; zero at corners and on facets that are curved themselves (collective).
    """
    data = target.facets.current()
    arms, turns = data.x - data.x.mean(axis=1, keepdims=True), data.nodal_normals - target.facets.normals()
    turns[np.linalg.norm(turns, axis=2) > CORNER] = 0.0
    # turn = B arm in the mean
    squares = np.einsum("mag,mah->mgh", arms, arms)
    return np.einsum("mag,mah->mgh", turns, arms) @ np.linalg.pinv(squares, rcond=1e-10, hermitian=True)


def warn_of_sagging_facets(pair: ContactPair) -> None:
    """Tell that surfaces conform more closely than the straight facets of the target follow its curve (collective)."""
    target, p = pair.target, pair.projection
    if not isinstance(target, MeshTarget) or not isinstance(p, FacetProjection):
        return
    arms = p.x - p.foot[:, None]
    sag = 0.5 * np.einsum("na,nag,ngh,nah->n", p.weights, arms, target.of_facets(p.facet, facet_curvatures(target)), arms)
    clearance, rounding = np.abs(p.gap - sag), TOUCHING * pair.config.size
    close = (clearance < np.abs(sag)) & (np.abs(sag) > rounding) & (np.abs(p.beyond).max(axis=1) < rounding)
    comm = pair.config.comm
    facets = len(set().union(*comm.allgather(set(p.facet[close].tolist()))))
    if facets > CONFORMING ** (pair.config.gdim - 1):
        worst = comm.allgather((float(np.abs(sag[close]).max(initial=0.0)), float(clearance[close].max(initial=0.0))))
        logger.warning(
            "%s: the surfaces conform, but %d straight facets of the target sag by up to %.3g, more than the clearance of %.3g there: who "
            "touches is up to the facets; refine the target, give both surfaces the same nodes, or take mesh and displacement of degree 2",
            pair.name, facets, *np.max(worst, axis=0),
        )  # fmt: skip


def warn_of_slipped(pair: ContactPair, before: Bools, areas: Array) -> bool:
    """Tell that contactors have slid off the end of the target, and their share of the surface with them (collective).

    Args:
        pair: in equilibrium.
        before: contactors that were past an end at the start ``(n,)``.
        areas: tributary areas ``(n,)``.

    Returns:
        Whether there was something to tell.
    """
    p = pair.projection
    near = np.linalg.norm(p.beyond, axis=1) < 0.5 * p.facet_size
    slipped = pair.off & ~before & near & (p.gap < 0.0)
    lost, held, count = pair.config.comm.allreduce(
        np.array([areas[slipped].sum(), areas[pair.trial.active].sum(), float(slipped.sum())])
    )
    if lost <= SLIPPED * (lost + held):
        return False
    logger.warning(
        "%s: %d contactors have slid off the end of the target, and with them %.0f %% of the surface in contact carry no force: let the "
        "target reach farther, swap contactor and target, or refine the surfaces at the end",
        pair.name, int(count), 100.0 * lost / (lost + held),
    )  # fmt: skip
    return True
