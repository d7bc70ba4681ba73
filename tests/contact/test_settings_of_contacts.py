"""What may be set of a contact once a problem has been made of it: friction between steps, and nothing else.

The test to read first is ``test_friction_that_changes_between_steps``.
"""

from __future__ import annotations

from inspect import signature

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import driven, history
from helpers import blocks, highest, refused

import uem_dolfinx as uem


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_friction_that_changes_between_steps(cell, coupling):
    """A block that slips is driven on with other coefficients: the next step has mu times the load, with 0 none at all."""
    scene = driven(cell, 0.3, rigid=True, n=(2, 3), walls=cell == "tetrahedron", how={"coupling": coupling})
    contact, side = scene.contact, [0.0] * (scene.problem.config.gdim - 2)
    x = 0.0
    scene.to(x, *side, -0.01)
    for mu in (0.3, 0.1, lambda x: np.full(x.shape[1], 0.2), 0.0, 0.4):
        contact.friction = mu
        assert contact.friction is mu or contact.friction == mu
        x += 0.1
        scene.to(x, *side, -0.01)
        f, value = contact.resultant().force, 0.2 if callable(mu) else mu
        assert -f[0] == pytest.approx(value * f[-1], rel=1e-6, abs=1e-9 * f[-1])
        assert scene.states[0] == 0


def test_friction_taken_away_is_the_contact_without():
    """What stuck springs back to where it would be without friction, and sticks where it then is when it gets some again."""
    places = [(0.0, -0.01), (0.002, -0.01)]
    smooth = history(driven("quadrilateral", None), *places)[-1]
    scene = driven("quadrilateral", 10.0)
    held = history(scene, *places)[-1]
    assert np.abs(held - smooth).max() > 1e-4
    scene.contact.friction = 0.0
    free = history(scene, places[-1])[-1]
    assert np.abs(free - smooth).max() <= 1e-7 * np.abs(smooth).max()
    assert scene.states[0] == 0 and highest(scene.problem.comm, scene.contact.status.x.array) == 2.0
    scene.contact.friction = 10.0
    again = history(scene, places[-1])[-1]
    assert np.abs(again - smooth).max() <= 1e-7 * np.abs(smooth).max() and scene.states[1] == 0


def test_friction_that_comes_too_late():
    """A contact made without friction cannot get it; what is no coefficient is none later either, and the old one is kept."""
    for mu, kept in ((None, 0.0), (0.0, 0.0), (0.2, 0.2)):
        contact = driven("quadrilateral", mu).contact
        for wrong in (-0.1, np.nan):
            refused(uem.InputError, "friction", lambda: setattr(contact, "friction", wrong))
        if not mu:
            refused(uem.InputError, "made without", lambda: setattr(contact, "friction", 0.1))
            contact.friction = 0.0
        assert contact.friction == kept


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sliding", "small"), ("coupling", "mortar"), ("normals", "averaged"), ("thickness", 0.1), ("max_penetration", 0.1),
        ("chords", True), ("name", "another"), ("target", None),
    ],
)  # fmt: skip
def test_what_is_settled(name, value):
    """Before a problem is made everything may be set; afterwards it is refused by name."""
    contact = uem.Contact(driven("quadrilateral", None).contact.contactor, uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
    setattr(contact, name, value)
    contact = driven("quadrilateral", None).contact
    before = getattr(contact, name)
    refused(uem.InputError, f"{name} = {value!r} comes too late", lambda: setattr(contact, name, value))
    assert getattr(contact, name) is before


def test_what_a_contact_has_not():
    """A misspelt attribute is reported, before and after the problem is made."""
    contact = driven("quadrilateral", 0.1).contact
    new = uem.Contact(contact.contactor, uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
    for one in (contact, new):
        for name in ("mu", "offsets", "frictions"):
            refused(uem.InputError, f"no '{name}'", lambda: setattr(one, name, 0.1))


LAWS_WITHOUT_FRICTION = {"normal": uem.SoftContact(lambda g: 0.0 * g), "cohesion": uem.Adhesion(1.0, 1.0), "tied": True}


@pytest.mark.parametrize("word", LAWS_WITHOUT_FRICTION)
def test_friction_set_later_is_refused_as_at_once(word):
    """Friction that does not go with a law is refused when it is set before the problem is made, too, and leaves nothing behind."""
    b = blocks(MPI.COMM_WORLD, "quadrilateral", 2, 3)
    how = {word: LAWS_WITHOUT_FRICTION[word]}
    for value in (0.3, uem.Coulomb(0.3), lambda x: 0.0 * x[0]):
        refused(uem.InputError, "friction", lambda v=value: uem.Contact(b.high, b.low, friction=v, **how))
        contact = uem.Contact(b.high, b.low, **how)
        refused(uem.InputError, "friction", lambda c=contact, v=value: setattr(c, "friction", v))
        assert contact.friction == 0.0
    if word == "tied":
        refused(uem.InputError, "offset", lambda: setattr(contact, "offset", 0.1))


#: Values other than the defaults of the arguments for single contacts; ``leak`` is not looked at.
FOR_SINGLE_CONTACTS = {
    "sliding": "small", "thickness": 0.1, "tied": True, "offset": 0.1, "adjust": True, "chords": True, "wear": 1e-3,
    "cohesion": uem.Adhesion(1.0, 1.0), "leak": lambda t: t, "corners": True,
}  # fmt: skip


def test_arguments_for_single_contacts():
    """A general contact refuses by name what only single contacts have, takes their defaults, and does not know other words."""
    single, general = (signature(kind).parameters for kind in (uem.Contact, uem.GeneralContact))
    assert FOR_SINGLE_CONTACTS.keys() == single.keys() - general.keys() - {"contactor", "target"}
    for word, value in FOR_SINGLE_CONTACTS.items():
        refused(uem.InputTypeError, (f"{word} = ", "declare a Contact"), lambda w=word, v=value: uem.GeneralContact(**{w: v}))
        uem.GeneralContact(**{word: single[word].default})
    with pytest.raises(TypeError, match="unexpected keyword argument 'glue'"):
        uem.GeneralContact(glue=1)
