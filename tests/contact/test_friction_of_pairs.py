"""Friction of a general contact by pairs of bodies: as declared pair by pair, where contactors go from one body to another, resumed.

The test to read first is ``test_over_a_joint``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import Bodies, close, surface_of
from helpers import box, clamp, refused, run

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
ROUGH = 0.3, 0.1


def base_and_blocks(kind):
    """Two blocks that are pressed on a base and dragged along it, each with its own friction: displacement, and forces of friction."""
    base = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [9, 4])
    high = [box("quadrilateral", [x, 0.0], [x + 0.5, 0.5], [5, 5]) for x in (-0.8, 0.3)]
    b = Bodies("quadrilateral", [base, *high])
    bcs = clamp(b.V, b.side(0, 1, -1.0))
    bcs += [bc for k in (1, 2) for bc in clamp(b.V, b.side(k, 1, 0.5), value=[0.02, -0.001 * k])]
    low, *surfaces = (surface_of(b.s, k) for k in range(3))
    if kind == "by hand":
        contacts = [uem.Contact(one, low, friction=mu) for one, mu in zip(surfaces, ROUGH)]
    else:
        keys = [("first", "base"), (low, surfaces[1])] if kind == "names and parts" else [(one, low) for one in surfaces]
        pairs = dict(zip(keys, ROUGH))
        bodies = {"base": low, "first": surfaces[0], "second": surfaces[1]}
        contacts = [uem.GeneralContact(order=surfaces, bodies=bodies, friction=pairs | {None: 5.0})]
    run(b.problem(contacts, bcs, rtol=1e-12), 3)
    if kind == "by hand":
        return b.u, [c.resultant().force for c in contacts]
    return b.u, [contacts[0].between(name, "base").force for name in ("first", "second")]


def test_as_declared_by_hand():
    """Names of bodies, parts, in any order; each block slips, with its own coefficient."""
    u, there = base_and_blocks("by hand")
    for kind in ("names and parts", "parts"):
        v, found = base_and_blocks(kind)
        close(u, v)
        assert np.abs(np.array(found) - there).max() < 1e-12
    for (along, across), mu in zip(there, ROUGH):
        # surfaces lean by less than a hundredth
        assert along == pytest.approx(-mu * across, rel=1e-2) and across > 1e-4


def dragged(checkpoint=None, left_after=None, reverse=False):
    """A block that slides from one part of a surface to the next: places and forces of its nodes at every step, and the displacement."""
    base = box("quadrilateral", [-1.0, -0.5], [1.0, 0.0], [12, 3])
    b = Bodies("quadrilateral", [base, box("quadrilateral", [-0.65, 0.0], [-0.15, 0.25], [5, 2])])
    block = surface_of(b.s, 1)
    left, right = (b.s.tag(name, 0, half_of_top(side)) for name, side in (("left", -1), ("right", 1)))
    pairs = dict(list(zip([(left, "block"), ("block", right)], ROUGH))[:: -1 if reverse else 1])
    contact = uem.GeneralContact(bodies={"block": block}, order=[block], friction=pairs)
    bcs = [*clamp(b.V, b.side(0, 1, -0.5)), *clamp(b.V, b.side(1, 1, 0.25), value=[0.8, -4e-3])]
    found, problem = [], b.problem([contact], bcs)
    for step in uem.load_steps(problem, 8, checkpoint=checkpoint):
        pair = contact.parts[0].pair
        force = pair.trial.force[pair.trial.active]
        found.append(COMM.allreduce(list(zip(pair.points[pair.trial.active, 0], force[:, 0], force[:, 1]))))
        if step.number == left_after:
            break
    return found, b.u


def half_of_top(side):
    """Whether facets lie on the top of the base, left or right."""
    return lambda x: (np.abs(x[:, 1]) < 1e-9) & (side * x[:, 0] > -1e-9)


@pytest.mark.slow
def test_over_a_joint(folder):
    """Every node has the friction of what it is on, while both parts carry the block as well; a run continued is the same."""
    found, u = dragged()
    sides = set()
    for nodes in found:
        x, along, across = np.array(nodes).T
        mu, loaded = np.where(x < 0, *ROUGH), across > 1e-2 * across.max()
        # surfaces lean by some hundredths
        assert np.abs(along + mu * across)[loaded].max() < 3e-2 * across.max()
        sides.add((bool((x < 0).any()), bool((x > 0).any())))
    assert sides == {(True, False), (True, True), (False, True)}
    parts = [dragged(uem.Checkpoint(folder / "joint", every=1), left_after)[0] for left_after in (5, None)]
    again, there = (np.array(sorted(nodes)) for nodes in (parts[1][-1], found[-1]))
    # on several ranks sums are not always made in the same order
    assert len(parts[1]) < len(found) and np.abs(again - there).max() <= (0.0 if COMM.size == 1 else 1e-12)
    _, v = dragged(reverse=True)
    close(u, v)


def test_against_rigid_surfaces():
    """Two blocks on two planes: each pair has its own."""
    b = Bodies("quadrilateral", [box("quadrilateral", [x, 0.0], [x + 1.0, 0.5], [4, 2]) for x in (0.0, 1.5)])
    floor, wall = uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), uem.RigidPlane((3.0, 0.0), (-1.0, 0.0))
    bodies = {"one": surface_of(b.s, 0), "other": surface_of(b.s, 1)}
    for others in (0.0, 0.4):
        friction = {("one", floor): 0.1, (floor, bodies["other"]): 0.2, None: others}
        contact = uem.GeneralContact(rigid=[floor, wall], bodies=bodies, friction=friction)
        bcs = [bc for k in (0, 1) for bc in clamp(b.V, b.side(k, 1, 0.5), value=[0.1, -0.01])]
        run(b.problem([contact], bcs), 2)
        for name, mu in (("one", 0.1), ("other", 0.2)):
            along, across = contact.between(name).force
            assert along == pytest.approx(-mu * across, rel=1e-10) and across > 0
        *_, on_floor, on_wall = contact.parts
        assert on_floor.pair.friction is not None and (on_wall.pair.friction is not None) == (others > 0)


def test_set_anew():
    """One of its contacts takes one coefficient for all its contactors, as before."""
    b = Bodies("quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 0.5], [4, 2])])
    floor = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    contact = uem.GeneralContact(rigid=floor, bodies={"one": surface_of(b.s, 0)}, friction={("one", floor): 0.1})
    problem = b.problem([contact], clamp(b.V, b.side(0, 1, 0.5), value=[0.1, -0.01]))
    for _ in uem.load_steps(problem, 2):
        for part in contact.parts:
            part.friction = 0.3
    along, across = contact.between("one").force
    assert along == pytest.approx(-0.3 * across, rel=1e-10)


FLOOR = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
REFUSED = [
    ({"a": 0.1}, uem.InputError, ("a key of friction = 'a'", "a pair (one, other)")),
    ({("a", "b"): -0.1}, uem.InputError, ("friction = -0.1",)),
    ({("a", "b"): 0.1, ("a", "c"): uem.Tresca(0.1)}, uem.InputTypeError, ("friction by pairs", "one law")),
    ({(FLOOR, FLOOR): 0.1}, uem.InputError, ("a key of friction",)),
    ({("a", FLOOR): 0.1}, uem.InputError, ("a rigid surface in friction", "one of those in rigid")),
]


@pytest.mark.parametrize("friction,error,words", REFUSED)
def test_what_it_refuses(friction, error, words):
    refused(error, words, lambda: uem.GeneralContact(friction=friction))


def test_a_name_of_no_body():
    b = Bodies("triangle", [box("triangle", [x, 0.0], [x + 1.0, 1.0], [2, 2]) for x in (0.0, 2.0)])
    contact = uem.GeneralContact(bodies={"one": surface_of(b.s, 0)}, friction={("one", "tow"): 0.1})
    refused(
        uem.InputError, ("the name of a body in friction = 'tow'",), lambda: b.problem([contact], clamp(b.V, b.side(0, 0, 0.0)))
    )
