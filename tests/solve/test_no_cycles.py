"""A problem that is let go of is gone at once: some MPI libraries have communicators for a few hundred meshes only."""

import gc
import weakref

from mpi4py import MPI

import pytest
from helpers import arch, blocks, clamp, modulus, run, st_venant

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(
    ("degree", "how"),
    [(1, {}), (2, {}), (1, {"normal": uem.SoftContact(1e3)}), (1, {"cohesion": uem.Cohesive(1.0, 0.1)})],
    ids=["1", "2", "soft", "cohesive"],
)
def test_no_references_in_circles(degree, how):
    b = blocks(COMM, "triangle", 4, 3, gap=0.1, overhang=0.5, degree=degree, pose=arch(0.3, 0.45))
    contact = uem.Contact(b.high, b.low, max_penetration=0.2, **how)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.15])]
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])
    run(problem, 2)
    known = [weakref.ref(o) for o in (problem.system, problem.bodies, contact.pair, problem.config)]
    gc.disable()
    try:
        problem.__dict__.clear()
        del problem, contact
        assert [k() for k in known] == [None] * len(known)
    finally:
        gc.enable()
