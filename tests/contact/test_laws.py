"""Laws of friction: Tresca's against closed forms, and a law of the user's own from outside the package.

Read first: ``test_a_block_slides_at_the_stress_times_its_area``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import blocks, clamp, linear, modulus, raised, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface

COMM = MPI.COMM_WORLD
STRESS = 2e-3


def dragged(cell, law, *, way=0.02, press=0.01, coupling="node_to_surface", n=(3, 4), degree=1, rigid=False, to=None):
    """A block pressed onto another, held below, or onto a plane, and dragged along it by its top: the contact."""
    b = blocks(COMM, cell, *n, degree=degree, overhang=0.25)
    g = b.gdim
    plane = uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0])
    contact = uem.Contact(b.high, plane if rigid else b.low, coupling=coupling, friction=law)
    place = fem.Constant(b.scene.mesh, np.zeros(g))
    top = fem.dirichletbc(place, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 1e4, 1.0)), b.u, bcs=[*clamp(b.V, b.bottom), top], contacts=[contact]
    )
    place.value[:] = [0.0] * (g - 1) + [-press]
    run(problem)
    place.value[:] = to if to is not None else [way, *[0.3 * way] * (g - 2), -press]
    return contact, run(problem, 2)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize(
    ("cell", "degree", "rigid"), [("triangle", 1, False), ("quadrilateral", 2, False), ("hexahedron", 1, True)]
)
def test_a_block_slides_at_the_stress_times_its_area(cell, degree, rigid, coupling):
    """Friction of the whole face, against the way, however hard it is pressed, over few iterations."""
    for press in (0.01, 0.02):
        contact, steps = dragged(cell, uem.Tresca(STRESS), press=press, coupling=coupling, degree=degree, rigid=rigid)
        force = np.array(contact.resultant().force)
        g = len(force)
        way = np.array([1.0, *[0.3] * (g - 2)])
        assert np.abs(force[:-1] + STRESS * way / np.linalg.norm(way)).max() <= 0.02 * STRESS
        assert np.linalg.norm(force[:-1]) == pytest.approx(STRESS, rel=2e-3)
        assert max(step.newton_iterations for step in steps) <= 6
        balance = contact.balance()
        assert balance is None or balance.force <= 1e-12


def test_what_sticks_under_tresca_bears_less():
    """Pushed by less than the stress times the area the block sticks; the force is that of a bonded one."""
    held, _ = dragged("quadrilateral", uem.Tresca(10.0), way=1e-3)
    frictional, _ = dragged("quadrilateral", 10.0, way=1e-3)
    both = [np.array(contact.resultant().force) for contact in (held, frictional)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)
    assert held.dissipation <= 1e-15 * 1e-3 * abs(both[0][0])


def test_tresca_keeps_the_matrix_symmetric():
    """Q is P where all of it slips."""
    contact, _ = dragged("quadrilateral", uem.Tresca(STRESS))
    rows = contact.pair.equations()
    assert rows.Q is rows.rows
    assert COMM.allreduce(int(contact.pair.friction.slipping(contact.pair.trial).sum())) > 0
    contact, _ = dragged("quadrilateral", 0.3)
    rows = contact.pair.equations()
    assert rows.Q is not rows.rows


@dataclass(frozen=True)
class Limited:
    """Coulomb's law up to a stress: a law in one file, of the user's own."""

    field: float
    stress: float
    per_area = True

    def limit(self, value, lam, area):
        """The less of both, and its derivative."""
        coulomb, most = value * lam, self.stress * area
        return np.minimum(coulomb, most), np.where(coulomb < most, value, 0.0)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize(
    ("cell", "degree", "rigid"),
    [("quadrilateral", 1, False), *(slow(*one) for one in (("triangle", 2, False), ("hexahedron", 1, True)))],
)
def test_coulomb_with_a_limit(cell, degree, rigid, coupling):
    """It is Coulomb's where little presses and Tresca's where much does."""
    for press, law in ((0.002, 0.3), (0.04, uem.Tresca(STRESS))):
        limited, other = (
            np.array(dragged(cell, one, press=press, degree=degree, rigid=rigid, coupling=coupling)[0].resultant().force)
            for one in (uem.Coulomb(0.3, limit=STRESS), law)
        )
        np.testing.assert_allclose(limited, other, rtol=1e-6, atol=1e-9)


@pytest.mark.long
def test_a_law_from_outside():
    """What the package's own law says, a law of the user's says as well, where some contactors are below the limit and others at it."""
    for press in (0.006, 0.01, 0.014):
        own, other = (
            dragged("quadrilateral", one, press=press)[0] for one in (Limited(0.3, STRESS), uem.Coulomb(0.3, limit=STRESS))
        )
        np.testing.assert_allclose(np.array(own.resultant().force), np.array(other.resultant().force), rtol=1e-12)
        pair = other.pair
        bound = np.minimum(0.3 * pair.trial.lam, STRESS * pair.friction.limits.area)
        borne = np.linalg.norm(pair.trial.friction.tau, axis=1)
        assert (borne <= bound * (1 + 1e-8)).all()


FAULTS = [
    (uem.UserFunctionError, "raised ZeroDivisionError", lambda value, lam: 1 / 0),
    (uem.InputError, "is nan at (", lambda value, lam: (value * lam * np.nan, value)),
    (uem.InputError, "[0] is -", lambda value, lam: (-1.0 - value * lam, value)),
    (uem.InputError, "[1] is inf at (", lambda value, lam: (value * lam, value + np.inf)),
    (uem.InputError, "has shape", lambda value, lam: (np.zeros(len(lam) + 1), value)),
    (uem.InputTypeError, "= 'ab'", lambda value, lam: "ab"),
    (uem.InputTypeError, "= 3: expected 2 arrays", lambda value, lam: 3),
]


@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_laws_that_return_anything_else(coupling, sliding):
    """A law that is wrong on one rank is named on all, and leaves nothing behind: mended, it is Coulomb's; what it writes is its own."""
    wrong = []

    class Law:
        field, per_area, timed = 0.3, False, False

        def limit(self, value, lam, area):
            found = wrong[0](value, lam) if wrong and COMM.rank == wrong[1] else (value * lam, value)
            lam[:] = np.nan
            return found

    if sliding:
        Law.sliding = lambda self, value, lam, area, speed: (*self.limit(value, lam, area), 0.0)
    ends = []
    for law in (0.3, Law()):
        b = blocks(COMM, "triangle", 2, 3)
        contact = uem.Contact(b.high, b.low, friction=law, coupling=coupling)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.02, -0.01))]
        problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=bcs, contacts=[contact])
        for error, words, fault in FAULTS if law != 0.3 else ():
            wrong[:] = [fault, COMM.allreduce(COMM.rank if len(contact.pair.nodes) else -1, op=MPI.MAX)]
            refused(error, [words, f"contact '{contact.name}': friction, Law."], problem.solve)
        wrong.clear()
        problem.solve()
        ends.append(np.array(b.u.x.array))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-13)


def test_laws_without_what_they_need():
    """A law without the attributes of one is refused by their names."""

    class Law:
        limit = sliding = None

    b = blocks(COMM, "triangle", 1, 1)
    for name, value in (("field", 0.3), ("per_area", False), ("timed", False)):
        refused(uem.InputTypeError, f"attribute {name}", lambda: uem.Contact(b.high, b.low, friction=Law()))
        setattr(Law, name, value)


def test_a_proportional_limit_has_no_rest():
    """Rounding of a law that multiplies otherwise makes no forces that are known."""

    @dataclass(frozen=True)
    class Rounded:
        field: float
        per_area = False

        def limit(self, value, lam, area):
            return (value / 3.0) * lam * 3.0, value

    plain, _ = dragged("quadrilateral", 0.3)
    contact, _ = dragged("quadrilateral", Rounded(0.3))
    assert not contact.pair.friction.has_known_forces(contact.pair.trial)
    np.testing.assert_allclose(np.array(contact.resultant().force), np.array(plain.resultant().force), rtol=1e-9)


def test_laws_that_are_set_anew():
    """The same law takes another value between steps; another law is refused."""
    contact, _ = dragged("quadrilateral", uem.Tresca(STRESS))
    contact.friction = uem.Tresca(2 * STRESS)
    assert (contact.pair.friction.value == 2 * STRESS).all()
    # all that it was made with
    contact, _ = dragged("quadrilateral", uem.Coulomb(0.3, limit=10.0), press=0.04)
    contact.friction = uem.Coulomb(0.3, limit=STRESS)
    assert contact.pair.friction.limits.law.most == STRESS
    raised(uem.InputTypeError, "limit", lambda: uem.Coulomb(0.3, limit="soft"))
    raised(uem.InputError, "limit = -1.0: expected a positive number", lambda: uem.Coulomb(0.3, limit=-1.0))
    contact, _ = dragged("quadrilateral", uem.Tresca(STRESS))
    raised(uem.InputTypeError, "friction = 0.3", lambda: setattr(contact, "friction", 0.3))
    raised(uem.InputError, "friction", lambda: uem.Contact(0, uem.RigidPlane([0, 0], [0, 1]), friction=uem.Tresca(-1.0)))


class Coated(NodeToSurface):
    """Nodes that touch a coating of the target: a discretisation in one file, of the user's own."""

    thickness_of_coating = 0.01

    def place(self, points, state):
        """Gaps from the coating's surface."""
        k = super().place(points, state)
        p = replace(k.projection, gap=k.projection.gap - self.thickness_of_coating)
        return replace(k, projection=p, gap=p.gap)


def test_a_discretisation_from_outside():
    """Blocks with a coating between them press as blocks do that are moved together by its thickness more."""
    plain, _ = dragged("quadrilateral", 0.0, press=0.02, way=0.0)
    coated, _ = dragged("quadrilateral", 0.0, press=0.01, way=0.0, coupling=Coated)
    forces = [np.array(contact.resultant().force) for contact in (plain, coated)]
    np.testing.assert_allclose(forces[1][1], forces[0][1], rtol=0.02)
    p = coated.pair.kinematics.projection
    true = np.einsum("ng,ng->n", p.normal, coated.pair.points - p.foot)
    assert np.abs(true - Coated.thickness_of_coating)[coated.pair.trial.active].max(initial=0.0) <= 1e-12
