"""Derivatives of assemblies that are refused, by name and before any work."""

from __future__ import annotations

import pytest
from assembly_scenes import AXIS, assembly, coupling, mean, preload, relation, tie
from helpers import refused

import uem_dolfinx as uem


def after(s, **how):
    return {"contacts": [uem.Contact(s.b.high, s.b.low, tied="after")]}


def held(s, **how):
    return {"contacts": [*tie(s)["contacts"], uem.Contact(s.b.bottom, uem.RigidPlane((0.5, -1.0), (0.0, 1.0)), tied=True)]}


#: What is refused: feature, options, control, words of the refusal, and whether it is one of a history.
REFUSED = {
    "ties made later": (after, {}, "E", "tied between steps", True),
    "the shape, ties to rigid surfaces": (held, {}, "X", "ties to rigid surfaces", False),
    "the shape, ties of hexahedra": (tie, {"cell": "hexahedron", "sizes": (2, 3)}, "X", "ties of hexahedra", False),
    "the shape, a section without axis": (preload, {}, "X", "expected an axis", False),
    "the shape, mean motions": (mean, {}, "X", "with a MeanMotion", False),
    "the shape, equations of rigid parts": (relation, {}, "X", "by the shape with couplings", False),
    "the offset of a tie": (tie, {}, "offset", "which is tied", False),
    "a locked preload without its history": (preload, AXIS | {"locked": True}, "E", "depends on earlier steps", False),
    "the shape, a locked preload": (preload, AXIS | {"locked": True}, "X", "an opening that changes with the shape", True),
    "a load distributed at large rotations": (coupling, {"distribute": True}, "E", "expected rotations='small'", False),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what, monkeypatch):
    """By name, and before anything is solved."""
    feature, how, name, words, recorded = REFUSED[what]
    s = assembly(feature=feature, top=feature not in (coupling, relation), **how)
    if feature is after:
        refused(uem.InputError, words, lambda: s.solve(1, True))
        return
    s.solve(1, recorded)
    control = uem.ContactParameter(s.problem.contacts[0], name) if name == "offset" else getattr(s, name)
    monkeypatch.setattr("uem_dolfinx.gradients.linearised.Linearised.__enter__", None)
    refused(
        uem.InputError,
        words,
        lambda: (s.history.gradient if recorded else lambda J, m: uem.gradient(s.problem, J, m))(s.J, control),
    )


#: What is refused before the first step of a history, by the derivatives that are announced.
ANNOUNCED = {
    "the shape, ties of hexahedra": (tie, {"cell": "hexahedron"}, False, lambda s: {"controls": s.X}, "ties of hexahedra"),
    "the shape, equations of rigid parts": (relation, {}, False, lambda s: {"controls": [s.E, s.X]}, "with couplings"),
    "the shape in time": (tie, {}, True, lambda s: {"controls": [s.X]}, "no derivatives by it in time"),
    "the displacement": (tie, {}, False, lambda s: {"controls": [s.u]}, "which the problem solves for"),
}


@pytest.mark.parametrize("what", ANNOUNCED)
def test_refused_before_the_first_step(what):
    """Controls that are announced before the first step."""
    feature, how, dynamics, wanted, words = ANNOUNCED[what]
    s = assembly(feature=feature, top=feature is not relation, **how)
    refused(uem.InputError, words, lambda: s.solve(1, True, dynamics, **wanted(s)))
    assert s.problem.progress.steps == 0 and s.problem.history is None


@pytest.mark.long
def test_announced_and_taken():
    """Controls that have derivatives change nothing."""
    s = assembly(feature=tie)
    s.solve(2, True, controls=[s.E, s.X])
    assert len(s.history.gradient(s.J, [s.E, s.X])) == len(s.history.tangent([(s.E, 1.0)])) == 2


def test_facets_covered_in_part():
    """Means over facets that the target covers in part have no derivatives by the shape; others have."""
    s = assembly(feature=tie, coupling="mortar", overhang=-0.13)
    s.solve()
    refused(uem.InputError, "facets of the contactor in part", lambda: uem.gradient(s.problem, s.J, s.X))
    assert len(uem.gradient(s.problem, s.J, [s.E])) == 1
