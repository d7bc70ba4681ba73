"""Refusal of steps within which a contactor would pass through a target."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.errors import TunnellingError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agree

#: A contactor passes through a target when it is deeper inside on its way than this part of the target's stride.
#: [convention; the target's stride; test_thresholds_motion.py::test_depth_of_a_passage]
PASSAGE_DEPTH = 0.1
#: A step that would have to be examined at more places than this is too long.
#: [bound; places; test_thresholds_motion.py::test_too_many_places]
MOST_PLACES = 256


def check_tunnelling(config: Configuration, pairs: list[ContactPair], start: npt.NDArray[np.float64]) -> None:
    """Refuse a step within which a contactor went through a target (collective).

    One that touches at the end must have come from in front of the facet it touches. Of one that does not, the straight way is
    examined in pieces no longer than the target's stride; most steps are shorter than that and are not examined.

    Args:
        config: configuration of the displacement at the end of the step.
        pairs: of all contacts.
        start: displacement at its beginning ``(n_local incl. ghosts,)``.

    Raises:
        TunnellingError: naming the deepest such contactor of the first rank that has one.
    """
    u = config.u.x.array
    end = np.array(u)
    way = np.linalg.norm((end - start).reshape(-1, config.gdim), axis=1)
    for pair in pairs:
        target, stride = pair.target, pair.target.stride
        moves = [way[pair.nodes].max(initial=0.0), way[target.dofs].max(initial=0.0)]
        new = pair.trial.active & ~pair.committed.active
        *moves, touches = np.max(config.comm.allgather([*moves, float(new.any())]), axis=0)
        places = np.ceil(sum(moves) / stride)
        error = None
        if places > MOST_PLACES:
            error = TunnellingError(
                f"{pair.name}: the surfaces move by {sum(moves):.4g} within a step, {places:.3g} times what a contactor may pass without "
                "being noticed: take smaller steps"
            )
        agree(config.comm, error)
        if touches:
            u[:] = start
            outside = target.project(pair.points).gap >= 0.0
            before = target.follow(pair.points, pair.projection).gap
            u[:] = end
            _refuse_passage(
                pair, new & outside & (before < -PASSAGE_DEPTH * stride), before, "touches the target from behind after"
            )
        for k in range(1, int(places)):
            u[:] = start + k / places * (end - start)
            p = target.project(pair.points)
            u[:] = end
            inside = ~pair.trial.active & (p.gap < -PASSAGE_DEPTH * stride) & ~(p.beyond != 0).any(axis=1)
            _refuse_passage(pair, inside, p.gap, "passes through the target within")


def _refuse_passage(pair: ContactPair, passed: npt.NDArray[np.bool_], gap: npt.NDArray[np.float64], how: str) -> None:
    """Raise if a contactor passed (collective)."""
    error = None
    if passed.any():
        i = int(np.argmin(np.where(passed, gap, np.inf)))
        error = TunnellingError(
            f"{pair.name}: the contactor at {pair.config.describe(int(pair.nodes[i]))} {how} a step, {-gap[i]:.4g} inside on its way: "
            "take smaller steps"
        )
    agree(pair.config.comm, error)
