"""Friction where facets of the target meet at an angle: it is mu times what all of them push with, in grooves and on roofs.

The test to read first is ``test_a_keel_slides_along_its_groove``.
"""

from __future__ import annotations

import numpy as np
import pytest
from friction_scenes import keel
from helpers import highest

COUPLINGS = ["node_to_surface", "mortar"]
MU = 0.3


@pytest.mark.parametrize(
    ("coupling", "angles"),
    [
        ("node_to_surface", (50.0, 50.0)),
        ("node_to_surface", (60.0, 80.0)),
        ("mortar", (20.0, 20.0)),
        ("mortar", (45.0, 45.0)),
        ("mortar", (70.0, 70.0)),
    ],
)
def test_an_edge_slides_along_a_groove(coupling, angles):
    """A keel that touches with its edge alone: mu (N1 + N2), for one load mu W / sin(angle); dissipated is that times the way."""
    scene = keel(angles, coupling, sharp=1.3)
    for x in (0.0, 0.02, 0.1):
        scene.to(x, 0.0, -0.02)
    pair, before, force = scene.contact.pair, scene.contact.dissipation, scene.contact.resultant().force
    assert scene.states[0] == 0
    way = 0.02
    scene.to(0.1 + way, 0.0, -0.02)
    f = scene.contact.resultant().force
    pushed = scene.normal_forces
    assert (pushed > 0).all() and -f[0] == pytest.approx(MU * pushed.sum(), rel=1e-3)
    if angles[0] == angles[1]:
        assert -f[0] == pytest.approx(MU * f[2] / np.sin(scene.angles[0]), rel=1e-6)
        # nothing but the top moves on
        lost = scene.contact.dissipation - before
        assert lost == pytest.approx(-0.5 * (f[0] + force[0]) * way, rel=1e-3)
    assert scene.contact.balance().force <= 1e-13
    along = scene.contact.traction.x.array.reshape(-1, 3)[pair.nodes, 0]
    assert highest(scene.problem.comm, np.abs(along + MU * scene.contact.pressures)) <= 1e-9


@pytest.mark.long
@pytest.mark.parametrize(
    ("coupling", "angle", "roof"),
    [("mortar", 30.0, False), ("mortar", 35.0, True), ("node_to_surface", 55.0, False), ("node_to_surface", 45.0, True)],
)
def test_a_keel_slides_along_its_groove(coupling, angle, roof):
    """Flank on flank, or astride of a roof, it is mu W / sin(angle) as soon as what moves across has settled."""
    scene = keel((angle, angle), coupling, roof=roof)
    for x in (0.0, 0.02, 0.1, 0.3):
        scene.to(x, 0.0, -0.02)
    f = scene.contact.resultant().force
    assert scene.states[0] == 0 and -f[0] == pytest.approx(MU * f[2] / np.sin(scene.angles[0]), rel=2e-3)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_an_edge_sticks_up_to_the_cones_of_both_flanks(coupling):
    """Held by more than mu times the force along the mean normal, and by no more than mu (N1 + N2)."""
    scene = keel((50.0, 50.0), coupling, sharp=1.3)
    scene.to(0.0, 0.0, -0.02)
    most = 0.0
    for x in (0.002, 0.004, 0.006, 0.008):
        scene.to(x, 0.0, -0.02)
        pair = scene.contact.pair
        f, stick = pair.trial.force, pair.trial.active & pair.trial.friction.stick
        along, limit = np.abs(f[:, 0]), MU * f[:, 2] / np.sin(scene.angles[0])
        assert highest(scene.problem.comm, (along - limit)[pair.trial.active]) <= 1e-9
        most = max(most, highest(scene.problem.comm, (along[stick] / np.maximum(f[stick, 2], 1e-12))))
    assert most > 1.05 * MU
