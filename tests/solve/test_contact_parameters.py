"""Gradients by parameters of contacts, the offset, the place and the turn of a rigid target: differences, forward against adjoint."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from gradient_scenes import pressed
from helpers import refused, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
SIZES = {"offset": 5e-4, "place": 5e-4, "turn": 4e-3}
SCENES = [
    ("triangle", 1, "mortar", "plane"),
    ("triangle", 1, "node_to_surface", "paraboloid"),
    ("triangle", 1, "mortar", False),
    ("triangle", 2, "node_to_surface", False),
    ("hexahedron", 1, "node_to_surface", "paraboloid"),
]


@pytest.mark.parametrize("cell, degree, coupling, rigid", [SCENES[0], *(slow(*scene) for scene in SCENES[1:])])
def test_of_second_order(cell, degree, coupling, rigid):
    """``J(h) - J(0) - h J'`` vanishes with h^2, also where there is an offset, and the derivative of u, put into J, is that of J."""
    s = pressed(cell, degree, coupling, rigid)
    names = [*(["offset"] if rigid != "paraboloid" else []), *(["place", "turn"] if rigid else [])]
    s.values["offset"] = 0.003 if "offset" in names else 0.0
    problem = s.solve()
    controls = [uem.ContactParameter(problem.contacts[0], name) for name in names]
    found = uem.gradient(problem, s.J, controls)
    changes = [np.linspace(1.0, 0.5, max(by.size, 1)).reshape(by.shape) for by in found]
    du = uem.tangent(problem, list(zip(controls, changes)))
    both = sum(float((by * change).sum()) for by, change in zip(found, changes))
    assert uem.integrate(ufl.derivative(s.J, s.u, du)) == pytest.approx(both, rel=1e-11)
    for name, by, change in zip(names, found, changes):
        before = s.values[name]

        def functional(h, name=name, change=change, before=before):
            s.values[name] = before + h * change
            s.solve()
            s.values[name] = before
            return uem.integrate(s.J)

        assert uem.taylor_test(functional, float((by * change).sum()), SIZES[name], 1) >= 1.95, name


def test_a_turned_sphere_is_the_same():
    """The turn of a ball about its centre changes nothing, nor does a shift of a plane in itself."""
    s = pressed("triangle", rigid=True)
    problem = s.solve()
    (by,) = uem.gradient(problem, s.J, [uem.ContactParameter(problem.contacts[0], "turn")])
    assert abs(float(by)) <= 1e-12


def test_what_is_refused():
    """What is no contact of the problem, no parameter, of no rigid target, or of a contact without friction."""
    s = pressed("triangle")
    problem = s.solve()
    contact = problem.contacts[0]
    refused(uem.InputTypeError, "contact = 1", lambda: uem.ContactParameter(1, "offset"))
    refused(uem.InputError, "parameter = 'size'", lambda: uem.ContactParameter(contact, "size"))
    refused(uem.InputError, "is one of rigid targets", lambda: uem.ContactParameter(contact, "place"))
    none = uem.ContactParameter(contact, "friction")
    refused(uem.InputError, "which has none: expected a contact with friction", lambda: uem.gradient(problem, s.J, none))
    other = uem.ContactParameter(uem.Contact(s.b.high, s.b.low), "offset")
    refused(uem.InputTypeError, "controls[0] =", lambda: uem.gradient(problem, s.J, other))
    offset = uem.ContactParameter(contact, "offset")
    words = "the change in direction[0] = (1.0, 2.0): expected finite numbers of shape ()"
    refused(uem.InputError, words, lambda: uem.tangent(problem, [(offset, (1.0, 2.0))]))
