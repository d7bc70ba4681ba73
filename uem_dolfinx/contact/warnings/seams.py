"""Warnings of equations of users between contactors of one mortar contact."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from uem_dolfinx.conditions.seams import seams_of
from uem_dolfinx.contact.mortar.placement import Contactors
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced


def warn_of_seams(pairs: Sequence[Interface]) -> None:
    """Warn of equations between contactors of one mortar contact that do not give them one displacement (collective).

    Each of these contactors has the equation of the segments on its own side, although they move together. The sum of their forces is
    correct up to the angle between the normals of the two sides, but acts on one of them.

    Args:
        pairs: of all contacts.
    """
    for pair in pairs:
        config, seams = pair.config, seams_of(pair.config)
        if seams is None or not isinstance(pair.discretisation, Contactors):
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
