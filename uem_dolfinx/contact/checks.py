"""What is refused about a contact pair: deep overlaps at the start, contactors that are stuck inside the target.

Every check speaks on all ranks or on none.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.contact.active_set import TOUCHING
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.errors import ConflictError, PenetrationError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree

#: A contactor whose equation depends on others may be left inside the target by this part of the model's size.
#: [heuristic; the model's size; -]
LEFT_OUT = 1e-6


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
