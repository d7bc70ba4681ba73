"""What friction takes from the bodies: with the normal forces' work it is all of the contact forces', in corners of the target as well."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, highest, linear, modulus, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
MU = 0.3


def bowl(g, across):
    """Bend a slab into a trough, or also across it, whose facets form concave edges and vertices."""

    def pose(x):
        y = x.copy()
        rise = 0.15 * x[:, 0] ** 2 + (across * x[:, 1] ** 2 if g == 3 else 0.0)
        y[:, -1] += np.where(x[:, -1] < 1e-9, rise, 0.0)
        return y

    return pose


def dragged(cell, across=0.0, coupling="node_to_surface"):
    """A small block whose lid is led over a bent slab that stands still: ``(problem, contact)``."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    low = box(cell, [-3.0, *[-1.0] * (g - 2), -1.0], [3.0, *[1.0] * (g - 2), 0.0], [6, *[2] * (g - 2), 1])
    high = box(cell, [-1.7, *[-0.12] * (g - 2), 0.42], [-1.3, *[0.17] * (g - 2), 0.82], [1] * g)
    s = scene(COMM, cell, [low, high], pose=bowl(g, across))
    V = compat.function_space(s.mesh, 1, (g,))
    u, place = fem.Function(V), fem.Function(V)
    lid, top = s.tag("lid", 1, at(g - 1, 0.82)), s.tag("top", 0, at(g - 1, 0.0))
    bcs = [
        *clamp(V, s.tag("base", 0, at(g - 1, -1.0))),
        *clamp(V, top),
        fem.dirichletbc(place, fem.locate_dofs_topological(V, g - 1, lid.entities)),
    ]
    contact = uem.Contact(s.tag("high", 1, at(g - 1, 0.42)), top, friction=MU, coupling=coupling, max_penetration=0.1)

    def load(factor):
        # down, then along the slab at the same depth
        x, z = 2.8 * max(factor - 0.05, 0.0), -0.1 * min(factor / 0.05, 1.0)
        place.x.array.reshape(-1, g)[:] = [x, *[0.1 * x] * (g - 2), z + 0.15 * (x - 1.5) ** 2 - 0.15 * 1.5**2]

    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0)), u, bcs=bcs, contacts=[contact], rtol=1e-12, load=load)
    return problem, contact


def pushed(contact, before):
    """Normal forces at contactors ``(n, gdim)``: what is left of the force without friction, which leans against the way.

    In a corner they are those of two facets, of which ``before`` names the one that a contactor came over. Friction at its limit on
    both, directed into the corner on the first and out of it on the second, makes up the force, or the first bears it alone.
    """
    pair = contact.pair
    t, g = pair.trial, pair.config.gdim
    out, c = t.lam[:, None] * pair.kinematics.projection.normal, pair.kinematics.corners
    for k, i in [] if c is None else enumerate(c.which):
        assert c.count[k] == 2
        n = c.normals[k, :2] if t.facet[i] == before[i] or t.held[i, 0] != before[i] else c.normals[k, 1::-1]
        edge = np.cross(*n) if g == 3 else np.zeros(2)
        force = t.force[i] - (t.force[i] @ edge) * edge / max(edge @ edge, 1e-300)
        back, out_of = (other - (other @ one) * one for one, other in (n, n[::-1]))
        rays = [n[0] + MU * back / np.linalg.norm(back), n[1] - MU * out_of / np.linalg.norm(out_of)]
        shares = np.linalg.lstsq(np.transpose(rays), force, rcond=None)[0]
        out[i] = shares @ n if shares[1] > 0 else (force @ n[0]) * n[0]
    return out


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "across"),
    [("triangle", 0.0), *(pytest.param("tetrahedron", across, marks=pytest.mark.slow) for across in (0.0, 0.05))],
)
def test_friction_and_normal_forces_do_all_the_work(cell, across):
    """In every step what friction takes and the work of the normal forces is the work of all; friction's is mu times force times way."""
    problem, contact = dragged(cell, across)
    pair = contact.pair
    facet, points, force, normal = pair.trial.facet, pair.points, pair.trial.force, pushed(contact, pair.trial.facet)
    work, largest, held, slid = pair.trial.friction.work, 0.0, 0, np.zeros(2)
    for _ in uem.load_steps(problem, 60):
        way, taken, before, before_normal = pair.points - points, -work, force, normal
        points, force, normal = pair.points, pair.trial.force, pushed(contact, facet)
        facet, work = pair.trial.facet, pair.trial.friction.work
        taken = taken + work
        of_all, of_normal = (-0.5 * np.einsum("ng,ng->n", f, way) for f in (before + force, before_normal + normal))
        largest = max(largest, highest(COMM, np.abs(of_all)))
        assert highest(COMM, np.abs(taken + of_normal - of_all)) <= 1e-10 * largest
        held += COMM.allreduce(int(pair.trial.in_corner.sum()))
        # those that were in contact all the time and have slid
        size = 0.5 * MU / np.hypot(1, MU) * (np.linalg.norm(before, axis=1) + np.linalg.norm(force, axis=1))
        which = before.any(axis=1) & force.any(axis=1) & (pair.friction.slipping(pair.trial) | pair.trial.in_corner)
        slid += COMM.allreduce(np.array([taken[which].sum(), (size * np.linalg.norm(way, axis=1))[which].sum()]))
    assert held >= 4
    assert slid[0] == pytest.approx(slid[1], rel=2e-3)
