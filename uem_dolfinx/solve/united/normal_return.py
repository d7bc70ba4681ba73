"""Normal return [UEM, 4.2]: active contactors go back onto targets that have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.united.rows import in_turns

#: Contactors this part of the model's size from where they belong are there.
#: [derived; the model's size; test_system.py::test_the_normal_return]
POSITION_ROUNDING = 4.0 * np.finfo(float).eps


def move_back(bodies: Bodies, pairs: Sequence[Interface], shared: bool, bound: float) -> bool:
    """Move active contactors back onto their targets, and update the bodies' displacement; whether any has moved (collective).

    Args:
        bodies: that are moved, with their stiffness.
        pairs: with contactors near their targets.
        shared: whether a node is a contactor of several pairs.
        bound: nothing moves if it would take a larger force.
    """
    assert bodies.stiffness is not None
    ways = [_ways(pair) for pair in pairs]
    made = [bodies.stiffness[pair.nodes] * way for pair, way in zip(pairs, ways)]
    disturbance = np.sqrt(reduced(bodies.comm, float(sum((forces**2).sum() for forces in made))))
    if not 0.0 < disturbance <= bound:
        return False
    for k, (pair, way) in enumerate(zip(pairs, ways)):
        for j, rows in enumerate(in_turns(pair) if shared else [np.arange(len(way))]):
            if shared and j + k > 0:
                # nodes may have been returned by another pair already
                pair.project()
                way = _ways(pair)
            bodies.config.shift(pair.nodes[rows], way[rows])
    bodies.u.x.scatter_forward()
    return True


def _ways(pair: Interface) -> Array:
    """Displacements of the normal return, zero where active contactors are on the target to rounding ``(n, gdim)``."""
    ways, s = np.zeros((len(pair.nodes), pair.config.gdim)), pair.discretisation.setting
    if pair.discretisation.traits.at_feet:
        ways = pair.kinematics.gap_rows.normal_return(pair.trial.active)
    if pair.friction is not None:
        ways = ways + pair.friction.return_vectors(pair.trial)
    # surfaces that follow each other would both close the same gap
    ways[(np.linalg.norm(ways, axis=1) <= POSITION_ROUNDING * pair.config.size) | s.mutual[s.label]] = 0.0
    return ways
