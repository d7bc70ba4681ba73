"""General contact by mortar: exact on meshes that do not match, as pairs by hand, the same on any ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import Discs, grid, oedometer, surface_of
from dolfinx import fem
from helpers import M, at, box, clamp, highest, linear, modulus, run, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
GRIDS = [
    ("quadrilateral", (2, 2), (2, 3, 3, 2)), ("hexahedron", (1, 2, 2), (2, 3, 1, 2)), ("triangle", (1, 4), (3, 4)),
    ("hexahedron", (2, 2, 2), (1,)),
]  # fmt: skip


@pytest.mark.parametrize("cell,counts,n", GRIDS, ids=str)
@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_uniform_strain_on_meshes_that_do_not_match(cell, counts, n, mu):
    """Blocks side by side and one on another: one strain in all of them, through sides, edges and points where they meet."""
    (b, places), strain = grid(cell, n, counts), 0.01
    contact = uem.GeneralContact(coupling="mortar", friction=mu)
    problem = b.problem([contact], oedometer(b, places, counts, strain * counts[-1]), rtol=1e-12)
    run(problem)
    exact = np.zeros_like(problem.config.X)
    exact[:, -1] = -strain * problem.config.X[:, -1]
    assert highest(COMM, np.abs(problem.config.displacement - exact)) < 1e-12
    forces = [contact.between(f"body {k + 1}").force for k in range(len(places))]
    assert np.abs(sum(forces)).max() < 1e-13 and max(np.abs(f).max() for f in forces) > 0.9 * M * strain


@pytest.mark.slow
@pytest.mark.parametrize("rows,columns,end,mu", [(2, 1, 0.12, 0.2), slow(3, 2, 0.3, 0.0)])
def test_discs_as_declared_by_hand(rows, columns, end, mu):
    """Every step, iteration and displacement is that of pairs declared by hand."""
    Discs(rows, columns, mu=mu).move_alike(end, "mortar")


def test_what_it_does_not_go_with():
    """Self contact and averaged normals are refused by name."""
    for how in ({"self_contact": True}, {"normals": "averaged"}):
        with pytest.raises(uem.InputError, match=f"{next(iter(how))} = .*mortar"):
            uem.GeneralContact(coupling="mortar", **how)


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_a_rigid_punch_finer_than_the_block_below(length):
    """It is the target whatever its mesh, and sinks in a few iterations as deep as one that is the target by hand."""

    def pressed(general):
        cell = "quadrilateral"
        parts = [box(cell, [-1, 0], [1, 1], [20, 8]), box(cell, [-0.4, 1], [0.4, 1.5], [16, 3])]
        s = scene(COMM, cell, parts, pose=lambda x: length * x)
        u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
        base, top, foot = s.tag("base", 0, at(1, 0.0)), s.tag("top", 0, at(1, 1.0)), s.tag("foot", 1, at(1, 1.0))
        punch = uem.RigidCoupling(surface_of(s, 1), (0.0, 1.5 * length), force=(0.0, -0.05 * length))
        contact = uem.GeneralContact(coupling="mortar") if general else uem.Contact(top, foot, coupling="mortar")
        bcs = clamp(u.function_space, base)
        problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], couplings=[punch])
        (step,) = run(problem)
        return len(step.iterations) - 1, punch.displacement[1] / length

    iterations, depth = pressed(True)
    assert iterations <= 4 and depth < 0.0
    assert depth == pytest.approx(pressed(False)[1], rel=1e-7)


def test_excluded_parts_do_not_touch():
    """Two blocks that are pushed through each other where their parts are excluded, or left to a contact of their own."""
    (b, places), strain = grid("quadrilateral", (2, 3), (1, 2)), 0.01
    low, high = b.side(0, 1, 1.0), b.side(1, 1, 1.0)
    contact = uem.GeneralContact(coupling="mortar", exclude=[(low, high)])
    problem = b.problem([contact], oedometer(b, places, (1, 2), 2 * strain), rtol=1e-12)
    run(problem)
    assert contact.n_active == 0 and highest(COMM, np.abs(problem.u.x.array)) == pytest.approx(2 * strain, rel=1e-9)


@pytest.mark.parametrize("first", [0, 1])
def test_forces_of_pairs_count_contactors_that_are_not_active(first):
    """A narrow stiff block on a wide soft one, of degree 2: rows contain other contactors too, which bear forces as well."""
    cell = "quadrilateral"
    s = scene(COMM, cell, [box(cell, [-1, 0], [1, 1], [9, 5]), box(cell, [-0.4, 1], [0.4, 1.5], [5, 3])])
    u = fem.Function(compat.function_space(s.mesh, 2, (2,)))
    base, lid = s.tag("base", 0, at(1, 0.0)), s.tag("lid", 1, at(1, 1.5))
    bcs = [*clamp(u.function_space, base), uem.dirichlet(u.function_space, lid, value=0.0, component=0)]
    v = ufl.TestFunction(u.function_space)
    F = linear(u, modulus(s, 1.0, 1000.0)) + 0.0625 * v[1] * uem.ds(lid)
    contact = uem.GeneralContact(coupling="mortar", order=[[base, lid][first]])
    run(uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], rtol=1e-11))
    on = contact.between("body 2")
    # the soft surface turns under the block's corners, and its normals with it
    assert on.force == pytest.approx([0.0, 0.05], abs=1e-12) and on.normal == pytest.approx(0.05, rel=2e-3)
    (touch,) = contact.touching()
    assert touch.n_active == contact.n_active and np.abs(touch.force) == pytest.approx([0.0, 0.05], abs=1e-12)
