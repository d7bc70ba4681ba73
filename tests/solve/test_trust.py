"""What must never go wrong in silence: contact beyond an end, convergence that is none, other histories on other ranks.

Read first: ``test_no_contact_beside_the_target`` and ``test_the_same_history_on_every_number_of_ranks``.
"""

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.cases_scales import springs
from dolfinx import fem
from helpers import CELLS, at, blocks, box, clamp, complementary, linear, modulus, oedometric, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.rings import DependentRingError
from uem_dolfinx.solve.united import rows

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(
    ("cell", "sliding", "rollers"), [*product(("quadrilateral", "tetrahedron"), ("finite", "small"), (True, False))]
)
def test_no_contact_beside_the_target(cell, sliding, rollers):
    """A long block whose far end is held touches a short stiff punch only below it, whatever conditions its contactors have."""
    g = 2 if cell == "quadrilateral" else 3
    lower = box(cell, [0.0] * (g - 1) + [-1.0], [8.0] + [1.0] * (g - 2) + [0.0], [16] + [2] * (g - 1))
    s = scene(COMM, cell, [lower, box(cell, [0.0] * g, [1.0] * g, [2] * g)])
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    top, far = s.tag("top", 1, lambda x: x[:, -1] > 1 - 1e-9), s.tag("far", 0, lambda x: x[:, 0] > 8 - 1e-9)
    bcs = clamp(V, s.tag("bottom", 0, lambda x: x[:, -1] < -1 + 1e-9))
    bcs += [*clamp(V, far, *([0] if rollers else [])), *clamp(V, top, value=[0.0] * (g - 1) + [-0.02])]
    contact = uem.Contact(s.tag("low", 0, on_the_plane), s.tag("high", 1, on_the_plane), sliding=sliding)
    uem.UnitedProblem(linear(u, modulus(s, 1.0, 1e3)), u, bcs=bcs, contacts=[contact]).solve()
    total, x = np.abs(contact.resultant().force).max(), contact.pair.points[:, 0]
    outside = COMM.allreduce(np.abs(contact.pair.trial.force[x > 1.3]).sum())
    assert total > 1e-3 and outside == 0.0


def on_the_plane(x):
    """Where both bodies begin."""
    return np.abs(x[:, -1]) < 1e-9


@pytest.mark.parametrize(("ratio", "contactor"), [*product((1e6, 1e9, 1e10, 1e12, 1e13, 1e15), (0, 1))])
def test_converged_means_converged(ratio, contactor):
    """A stiff block carried far over a soft one: its forces drown in rounding, and then that is said; else they are right."""
    s = springs(([4 * (2 - contactor)] * 2, [4 * (1 + contactor)] * 2), (1.0, ratio))
    s.unite(s.side(contactor, 1, 1 - contactor), s.side(1 - contactor, 1, contactor))
    problem = uem.UnitedProblem(s.F, s.u, bcs=s.bcs, contacts=s.contacts)
    force = 0.01 * oedometric() / (1 + 1 / ratio)
    if ratio > 1e10:
        with pytest.raises(uem.PrecisionError, match="rounding hides the equilibrium"):
            problem.solve()
        return
    problem.solve()
    for tag, sign in ((s.side(0, 1, 0), 1.0), (s.side(1, 1, 1), -1.0)):
        # rounding of the stiffer block's forces is some 1e-5 of them at 1e10, and as much as 1e-4 is taken for rounding
        assert s.reaction(tag)[1] == pytest.approx(sign * force, rel=1e-5 if ratio < 1e10 else 1e-4)


def history(comm, cell, degree, law):
    """Active contactors and exchanges of every iteration, and the last force, of a round block on a flat one, symmetric to the bit."""
    b = blocks(comm, cell, 2, 3, degree=degree, gap=0.05, overhang=0.5, pose=rounded)
    g = b.gdim
    # moments of quadratic contactors in corners balance to the second order of their gaps only
    contact = uem.Contact(b.high, b.low, sliding="finite" if degree == 1 or g == 2 else "fixed")
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (g - 1) + [-0.3])]
    problem = uem.UnitedProblem(law(b.u, modulus(b.scene, 1.0, 3.0)), b.u, bcs=bcs, contacts=[contact], rtol=1e-10)
    steps = run(problem, 2)
    complementary(contact, 1e-12, 1e-9)
    return [(i.active, i.exchanges, i.changed) for s in steps for i in s.iterations], contact.resultant().force


def rounded(x):
    """The upper block bulges downwards."""
    y = x.copy()
    up = np.where(x[:, -1] > 0.02, 1.05 - x[:, -1], 0.0)
    y[:, -1] += 0.3 * up * ((x[:, :-1] - 0.5) ** 2).sum(axis=1)
    return y


@pytest.mark.parametrize(("cell", "degree"), [*product(CELLS, (1,)), ("triangle", 2), ("tetrahedron", 2)])
def test_the_same_history_on_every_number_of_ranks(cell, degree):
    """Every rank on its own, and all of them together, take the same contactors in the same iterations, to the same forces."""
    law = st_venant if degree == 1 else linear
    alone, force = history(MPI.COMM_SELF, cell, degree, law)
    together, of_all = history(COMM, cell, degree, law)
    assert together == alone
    assert np.abs(of_all - force).max() <= 1e-9 * np.abs(force).max()
    # some exchanges there were
    assert sum(i[1] for i in alone) > 0


@pytest.mark.parametrize("weight", [1e-3, 1e-13, 1e-14])
def test_a_load_near_the_rounding_of_positions_is_not_taken_for_none(weight):
    """Ten units of length from the origin, a strip of modulus 1 on a floor sinks by ``w (y - y^2 / 2)``, however light it is."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [10.0, 1.0], [40, 4])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    F = uem.LinearElastic(E=1.0, nu=0.0, kind="plane_strain").residual_form(u, ufl.TestFunction(V))
    F += fem.Constant(s.mesh, weight) * ufl.TestFunction(V)[1] * ufl.dx
    floor = uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
    uem.UnitedProblem(F, u, bcs=clamp(V, s.tag("side", 0, at(0, 0.0)), 0), contacts=[floor]).solve()
    y = V.tabulate_dof_coordinates()[:, 1]
    assert np.abs(u.x.array.reshape(-1, 2)[:, 1] + weight * (y - y**2 / 2)).max() <= max(1e-15, 1e-10 * weight)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_displacement_that_leaves_no_facets(coupling):
    """Bodies that have flown so far that rounding brings the nodes of a facet together are refused before anything is projected."""
    b = blocks(COMM, "triangle", 2, 3)
    b.u.x.array[:] = 1e17
    contact = uem.Contact(b.high, b.low, coupling=coupling)
    with pytest.raises(uem.NotFiniteError, match=r"displaced by 1e\+17, whose rounding is more than the facets"):
        uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])


def test_rotated_rows_that_depend_on_each_other(monkeypatch):
    """Where rotated equations of slipping contactors depend on each other in a ring, friction is said to wedge, and steps are cut."""
    b, made = blocks(COMM, "triangle", 2, 2), rows.Restriction

    def restriction(space, equations, *rest, like=None):
        if like is None:
            return made(space, equations, *rest)
        error = DependentRingError("a ring")
        error.rows = np.arange(len(equations)) == 0
        raise error

    monkeypatch.setattr(rows, "Restriction", restriction)
    bcs = clamp(b.V, b.bottom) + clamp(b.V, b.top, value=[0.1, -0.01])
    contact = uem.Contact(b.high, b.low, friction=0.1, name="faces")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
    with pytest.raises(
        uem.FrictionError, match=r"faces: friction leaves more than one answer about the contactor at \(.*no better"
    ):
        for _ in uem.load_steps(problem, 1):
            pass
