"""The answer does not depend on where a scene stands, in which units it is measured, how it is numbered, or on how many ranks.

Two tests to read first: ``test_units`` (nanometres to kilometres, soft to stiff: the same iterations) and ``test_ranks``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import arch, blocks, clamp, linear, modulus, run, st_venant
from hypothesis import example, given, settings
from hypothesis import strategies as st

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def turn_of(g, angle, other=0.0):
    R = np.eye(g)
    c, s = np.cos(angle), np.sin(angle)
    R[:2, :2] = [[c, -s], [s, c]]
    if g == 3:
        c, s = np.cos(other), np.sin(other)
        R = R @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return R


def press(
    cell, *, comm=COMM, turn=None, shift=0.0, length=1.0, stress=1.0, shuffle=None, law=st_venant, normals="facet", steps=2
):
    """Press a block sideways onto an arch; displacements, forces and counts in the drawing's frame and units."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    R = np.eye(g) if turn is None else turn
    n = (6, 4) if g == 2 else (3, 2)
    b = blocks(comm, cell, *n, gap=0.1, overhang=0.5, pose=lambda x: length * (arch(0.3, 0.45)(x) @ R.T + shift), shuffle=shuffle)
    slide = np.array([0.08, *[0.0] * (g - 2), -0.2]) @ R.T * length
    contact = uem.Contact(b.high, b.low, normals=normals, max_penetration=0.2 * length)
    problem = uem.UnitedProblem(
        law(b.u, modulus(b.scene, stress, 2 * stress)),
        b.u,
        bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=slide)],
        contacts=[contact],
        rtol=1e-10,
    )
    done = run(problem, steps)
    active = contact.active
    return {
        "u": b.scene.gather(b.u) @ R / length,
        "force": contact.resultant().force @ R / (stress * length ** (g - 1)),
        "pressure": b.scene.gather(contact.pressure) / stress,
        "gap": b.scene.gather(contact.gap) / length,
        "active": b.scene.gather(active),
        "iterations": [s.newton_iterations for s in done],
        "nodes": b.scene.drawing,
    }


def same(a, b, tol):
    """Two answers agree, whatever the order in which their scenes were drawn."""
    i, j = (np.lexsort(np.round(r["nodes"], 9).T) for r in (a, b))
    # coincident nodes of the two bodies do not exist in this scene, so places identify nodes
    assert np.allclose(a["nodes"][i], b["nodes"][j], atol=1e-12)
    assert np.array_equal(a["active"][i], b["active"][j])
    assert np.abs(a["u"][i] - b["u"][j]).max() < tol
    assert np.abs(a["force"] - b["force"]).max() < tol
    assert np.abs(a["pressure"][i] - b["pressure"][j]).max() < 10 * tol
    assert np.abs(a["gap"][i] - b["gap"][j]).max() < tol


CASES = [("triangle", "facet"), ("quadrilateral", "averaged"), ("tetrahedron", "facet"), ("hexahedron", "facet")]


@pytest.fixture(scope="module")
def reference():
    """Answers in the drawing's own pose, by cell and normals."""
    answers = {case: press(case[0], normals=case[1]) for case in CASES}
    for r in answers.values():
        assert r["active"].sum() > 1 and r["force"][-1] > 1e-3
    return answers


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_translation(reference, case):
    same(press(case[0], normals=case[1], shift=-1000.0), reference[case], 1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("angle", [0.3, np.pi / 2, -2.0])
def test_rotation(reference, case, angle):
    turned = press(
        case[0], normals=case[1], turn=turn_of(2 if case[0] in ("triangle", "quadrilateral") else 3, angle, 0.7 * angle)
    )
    same(turned, reference[case], 1e-9)
    # on the way to the contact the block has no strain, and its residual is rounding that the pose decides
    assert turned["iterations"][-1] == reference[case]["iterations"][-1]


@pytest.mark.long
@settings(max_examples=6, deadline=None, derandomize=True)
@given(st.floats(-3.1, 3.1), st.floats(-5, 5), st.integers(0, 1000))
@example(0.2680489901632064, 0.0, 8)
def test_any_pose_and_numbering(reference, angle, shift, seed):
    """The last one finds another equilibrium where the first solve leaves a thousandth of its right-hand side."""
    same(press("triangle", turn=turn_of(2, angle), shift=shift, shuffle=seed), reference["triangle", "facet"], 1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("length,stress", [(1e-9, 2.1e11), (1e3, 1e-3), (1e-3, 1e6), (1e6, 1.0)])
def test_units(reference, case, length, stress):
    scaled = press(case[0], normals=case[1], length=length, stress=stress)
    same(scaled, reference[case], 1e-9)
    assert scaled["iterations"] == reference[case]["iterations"]


@pytest.mark.parametrize("case", CASES)
def test_numbering(reference, case):
    for seed in (1, 2):
        same(press(case[0], normals=case[1], shuffle=seed), reference[case], 1e-9)


@pytest.mark.parametrize("case", CASES)
def test_ranks(reference, case):
    """Every rank solves the scene alone, and finds what all of them found together."""
    alone = press(case[0], comm=MPI.COMM_SELF, normals=case[1])
    same(alone, reference[case], 1e-9)
    assert alone["iterations"] == reference[case]["iterations"]


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_rigid_motion_after_contact_leaves_the_forces(cell):
    """A pressed pair that is carried away and turned as a whole keeps its pressure: finite strain is objective."""
    g = 2 if cell == "triangle" else 3
    b = blocks(COMM, cell, 5 if g == 2 else 3, 4 if g == 2 else 2, gap=0.1, overhang=0.5, pose=arch(0.3, 0.45))
    bottom, top = fem.Function(b.V), fem.Function(b.V)
    x = b.V.tabulate_dof_coordinates()[: len(bottom.x.array) // g, :g]
    contact = uem.Contact(b.high, b.low, max_penetration=0.2)
    pressures, forces = [], []

    def load(factor):
        R = turn_of(g, max(0.0, factor - 0.5) * 1.2)
        shift = max(0.0, factor - 0.5) * np.arange(1, g + 1)
        press_down = np.eye(g)[-1] * -0.2 * min(1.0, 2 * factor)
        bottom.x.array[:] = (x @ R.T - x + shift).ravel()
        top.x.array[:] = ((x + press_down) @ R.T - x + shift).ravel()

    bcs = [
        fem.dirichletbc(f, fem.locate_dofs_topological(b.V, g - 1, tag.entities)) for f, tag in ((bottom, b.bottom), (top, b.top))
    ]
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], load=load, rtol=1e-11
    )
    for step in uem.load_steps(problem, 8):
        if step.factor >= 0.5:
            pressures.append(b.scene.gather(contact.pressure))
            forces.append(turn_of(g, (step.factor - 0.5) * 1.2).T @ contact.resultant().force)
    assert len(pressures) >= 5 and pressures[0].max() > 1e-3
    for p, f in zip(pressures[1:], forces[1:]):
        assert np.abs(p - pressures[0]).max() < 1e-8
        assert np.abs(f - forces[0]).max() < 1e-9


def test_linear_scene_scales_with_its_load():
    """Signorini's problem is positively homogeneous: doubling load, gap and overlap doubles everything."""
    answers = []
    for scale in (1.0, 1e-6):
        b = blocks(COMM, "triangle", 4, 4, gap=0.01 * scale)
        contact = uem.Contact(b.high, b.low, sliding="fixed")
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.05 * scale])]
        run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], rtol=1e-11))
        answers.append((b.scene.gather(b.u) / scale, contact.resultant().force / scale))
    assert np.abs(answers[0][0] - answers[1][0]).max() < 1e-9 * 0.05
    assert np.abs(answers[0][1] - answers[1][1]).max() < 1e-8 * np.abs(answers[0][1]).max()


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_contact_that_is_declared_twice(coupling):
    """Two frictionless contacts of the same surfaces share the force; the displacement is that with one of them."""
    ends, forces = [], []
    for n in (1, 2):
        b = blocks(COMM, "triangle", 2, 3)
        contacts = [uem.Contact(b.high, b.low, coupling=coupling) for _ in range(n)]
        run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=contacts))
        ends.append(np.array(b.u.x.array))
        forces.append(sum(np.array(one.resultant().force) for one in contacts))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-14)
    # differences of reactions of stiffness 1 at displacements of 0.01
    np.testing.assert_allclose(forces[1], forces[0], rtol=0, atol=1e-12)
