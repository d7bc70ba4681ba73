"""A block that is pressed onto another and driven to and fro, with every kind of contact."""

from __future__ import annotations

from friction_scenes import driven
from helpers import clamp, linear, modulus, st_venant

import uem_dolfinx as uem

#: Where the block's top goes, in steps.
WAY = [(0.0, -0.03), (0.07, -0.05), (0.16, -0.05), (0.21, -0.04)]
MORTAR = {"coupling": "mortar"}


def general(**how):
    """The driven block, with all surfaces declared at once."""

    def make():
        scene = driven(mu=None, law=st_venant, n=(3, 5))
        b = scene.blocks
        contact = uem.GeneralContact(**how)
        top = scene.top
        held = [*clamp(b.V, b.bottom), *scene.problem.bodies.bcs[-1:]]
        problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=held, contacts=[contact])
        return problem, top

    return make


def hand(mu=0.3, cell="quadrilateral", rigid=False, degree=1, law=st_venant, **how):
    """The driven block, with one contact."""

    def make():
        n = (3, 5) if cell in ("triangle", "quadrilateral") else (2, 3)
        scene = driven(cell, mu, law=law, n=n, rigid=rigid, degree=degree, how=how)
        return scene.problem, scene.top

    return make


SCENES = {
    "without friction": hand(None),
    "friction": hand(),
    "degree 2": hand(degree=2),
    "Tresca": hand(uem.Tresca(0.02)),
    "averaged normals": hand(normals="averaged"),
    "small sliding": hand(sliding="small"),
    "mortar": hand(None, **MORTAR),
    "mortar with friction": hand(**MORTAR),
    "mortar, small sliding": hand(None, sliding="small", **MORTAR),
    "rigid target": hand(rigid=True),
    "wear": hand(wear=0.02),
    "offset": hand(offset=0.004),
    "tetrahedra": hand(cell="tetrahedron"),
    "linear bodies": hand(law=linear),
    "linear bodies in space": hand(law=linear, cell="hexahedron"),
    "linear bodies, mortar": hand(law=linear, **MORTAR),
    "linear bodies, rigid target": hand(law=linear, rigid=True),
    "general": general(friction=0.2),
    "general, mortar": general(friction=0.2, **MORTAR),
    "general, itself": general(self_contact=True),
}
#: Those that are always tested.
QUICK = {"friction", "linear bodies", "linear bodies in space", "mortar with friction", "wear", "general"}
