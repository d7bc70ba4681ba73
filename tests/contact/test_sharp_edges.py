"""Pressures, friction and heat at sharp edges of contactors: they are those of the side that touches.

Read first: ``test_pressures``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import dimension, surface_of
from dolfinx import fem
from field_scenes import fields, strain, stress
from helpers import blocks, clamp, highest, linear, run, slow

import uem_dolfinx as uem
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import Areas

COMM = MPI.COMM_WORLD
PRESS = 0.01
CELLS = [
    ("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 1), slow("hexahedron", 1), slow("triangle", 2), slow("tetrahedron", 2),
]  # fmt: skip


def declared(b, how, **options):
    """The contact of two blocks: of all surfaces, or of the whole surface of the upper block with the lower one's top."""
    return uem.GeneralContact(**options) if how == "general" else uem.Contact(surface_of(b.scene, 1), b.low, **options)


def parts_of(contact):
    """Of a general contact; a contact of two surfaces is its own."""
    return getattr(contact, "parts", [contact])


@pytest.mark.parametrize("turn", [0.0, 0.4])
@pytest.mark.parametrize("cell,degree", CELLS)
def test_areas_that_face(cell, degree, turn):
    """Of a block's surface towards a plane below: those of its base up to the edges, however it is turned; off edges all of them."""
    g = dimension(cell)
    b = blocks(COMM, cell, 2, 3, degree=degree)
    config, skin = Configuration(b.u), surface_of(b.scene, 1)
    R = np.eye(g)
    R[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    down = R @ np.eye(g)[-1]
    b.u.x.array.reshape(-1, g)[:] = config.X @ (R - np.eye(g)).T
    nodes = np.flatnonzero(np.isin(np.arange(config.n_owned), fem.locate_dofs_topological(b.V, g - 1, b.high.entities)))
    base = Areas(config, b.high).reference[nodes]
    for current in (False, True):
        found = Areas(config, skin).facing(nodes, np.tile(down, (len(nodes), 1)), current)
        assert highest(COMM, np.abs(found - base)) < 1e-12
        # sideways only the nodes at an edge have what faces
        side = Areas(config, skin).facing(nodes, np.tile(R @ np.eye(g)[0], (len(nodes), 1)), current)
        edge = Areas(config, skin).at_sharp_edges(nodes)
        assert highest(COMM, np.abs(side - base)[~edge]) < 1e-12
    assert COMM.allreduce(int(edge.sum())) == (2 if g == 2 else 12 * degree)


@pytest.mark.parametrize("cell,degree", CELLS)
@pytest.mark.parametrize("measure", ["reference", "current"])
@pytest.mark.parametrize("how", ["general", "pair"])
def test_pressures(cell, degree, measure, how):
    """A block between a block and a wall has one pressure up to its edges, whose nodes belong to sides that touch nothing as well."""
    g = dimension(cell)
    b = blocks(COMM, cell, 3, 3, degree=degree)
    wall = uem.RigidPlane([0.0] * (g - 1) + [1.0 - PRESS], [0.0] * (g - 1) + [-1.0])
    options = {"measure": measure, "max_penetration": 0.1}
    if how == "general":
        contacts = [uem.GeneralContact(rigid=wall, **options)]
    else:
        contacts = [declared(b, how, **options), uem.Contact(surface_of(b.scene, 1), wall, **options)]
    bcs = [*clamp(b.V, b.bottom), *(uem.dirichlet(b.V, b.high, c) for c in range(g - 1))]
    run(uem.UnitedProblem(linear(b.u, 1.0, 0.0), b.u, bcs=bcs, contacts=contacts, rtol=1e-12))
    exact = 0.5 * PRESS
    for contact in contacts:
        assert contact.max_pressure() == pytest.approx(exact, rel=1e-9)
        for part in parts_of(contact):
            assert highest(COMM, np.abs(part.pressures[part.pair.trial.active] / exact - 1.0)) < 1e-9


@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_coulomb(cell):
    """Where a block slips, edges included, the traction is mu times the pressure; in 3D nodes that share a force have other normals."""
    g, mu = dimension(cell), 0.2
    b = blocks(COMM, cell, 2, 3)
    contact = declared(b, "general", friction=mu)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.1] + [0.0] * (g - 2) + [-0.02])]
    run(uem.UnitedProblem(linear(b.u, 1.0, 0.0), b.u, bcs=bcs, contacts=[contact]), 2)
    for part in contact.parts:
        on = part.pair.trial.active
        traction = np.linalg.norm(part.traction.x.array.reshape(-1, g)[part.nodes[on]], axis=1)
        most = mu * part.pressures[on]
        assert highest(COMM, np.abs(traction - most) - (0.0 if g == 2 else 0.01) * most) < 1e-9


@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_tresca(cell):
    """A block that slides bears the limit times its base, not more for the sides that its edges belong to."""
    g, limit = dimension(cell), 1e-4
    b = blocks(COMM, cell, 3, 3, overhang=0.5)
    contact = declared(b, "pair", friction=uem.Tresca(limit))
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.05] + [0.0] * (g - 2) + [-0.02])]
    run(uem.UnitedProblem(linear(b.u, 1.0, 0.0), b.u, bcs=bcs, contacts=[contact]), 2)
    assert contact.n_active == COMM.allreduce(contact.pair.nodes.size) - off_base(b, contact)
    on = contact.pair.trial.active
    traction = np.linalg.norm(contact.traction.x.array.reshape(-1, g)[contact.nodes[on]], axis=1)
    assert highest(COMM, np.abs(traction / limit - 1.0)) < 1e-9
    # the base is 1 by 1, and edges turn a little on what they indent
    forces = COMM.allreduce(np.linalg.norm(contact.pair.trial.friction.tau, axis=1).sum())
    assert forces == pytest.approx(limit, rel=0.02)


def off_base(b, contact):
    """Number of contactors that are not on the upper block's base (collective)."""
    X = contact.config.X[contact.nodes]
    return COMM.allreduce(int((X[:, -1] > COMM.allreduce(X[:, -1].min(initial=9.0), op=MPI.MIN) + 1e-9).sum()))


@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_heat(cell):
    """The flux is that of three resistances in series up to the edges."""
    b = blocks(COMM, cell, 3, 3)
    f = fields(b, 1, 1)
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    F = (ufl.inner(stress(u, 1e3, 0.3), strain(v)) + 2.0 * ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
    bcs = [*f.confined(), uem.dirichlet(f.space, b.top, b.gdim - 1, -PRESS)]
    bcs += [uem.dirichlet(f.other, b.bottom, value=100.0), uem.dirichlet(f.other, b.top, value=300.0)]
    contact = declared(b, "pair", heat=uem.Conductance(5.0, field=1))
    run(uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[contact]))
    flux = contact.heat_flux.x.array[contact.nodes[contact.pair.trial.active]]
    assert highest(COMM, np.abs(flux / (200.0 / (2 / 2.0 + 1 / 5.0)) - 1.0)) < 1e-11
