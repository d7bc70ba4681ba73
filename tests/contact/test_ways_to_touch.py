"""Two bodies meet in any way: turned, finer or coarser, overlapping, node on vertex to the last bit; always lawful, never in a cycle.

Two tests to read first: ``test_overlap_is_an_approach`` (an interference is the same as pushing the bodies together by it) and
``test_contactor_next_to_a_vertex`` (nothing happens when a node crosses a vertex of the target).
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import M, arch, at, blocks, box, clamp, gathered_matrix, highest, lawful, linear, modulus, rotation, scene, st_venant
from hypothesis import example, given, settings
from hypothesis import strategies as st

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD
LAWS = {"linear": linear, "finite": st_venant}
#: Newton iterations of all steps together that no scene here may exceed.
PATIENCE = 40

few = settings(max_examples=8, deadline=None, derandomize=True)


@dataclass
class Meeting:
    """A solved scene.

    Attributes:
        u: displacements in the drawing's order.
        force: on the contactors.
        active: number of active contactors.
        energy: half of the work of the prescribed displacements, which is the strain energy of linear bodies.
        iterations: of all steps.
        contact: the contact.
    """

    u: np.ndarray
    force: np.ndarray
    active: int
    energy: float
    iterations: int
    contact: uem.Contact


def in_equilibrium(problem, contact, history, size, stress):
    """Conditions of contact, and equilibrium read from the residual itself."""
    g = problem.config.gdim
    lawful(contact, 0.2 * problem.config.size, stress * size ** (g - 1))
    force = np.linalg.norm(contact.resultant().force)
    # places are rounded, and so are the forces that follow from them
    rounding = 1e-14 * stress * size ** (g - 1)
    assert not history[-1].changed and history[-1].residual * force <= problem.rtol * force + rounding
    problem.bodies.assemble()
    n = problem.config.n_owned
    r = problem.bodies.residual.array_r.reshape(-1, g) - contact.force.x.array.reshape(-1, g)[:n]
    free = problem.bodies.free[:n]
    assert highest(COMM, np.abs(r[free])) <= 1e-9 * force + rounding


def meet(
    cell="triangle", n=(3, 4), *, law="linear", gap=0.0, d=0.02, slide=0.0, overhang=0.5, pose=None, turn=None, length=1.0,
    stress=1.0, E=(1.0, 2.0), shuffle=None, held=False, steps=1, **how,
):  # fmt: skip
    """A block led by its top onto a wider one.

    Args:
        gap: between them, an overlap when negative.
        d: way of the top downwards, sideways ``slide``.
        pose: bends the drawing before it is turned and scaled.
        turn: rotation matrix.
        held: between rollers instead, as in an oedometer.
        how: see ``Contact``.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    R = np.eye(g) if turn is None else turn
    bend = pose or (lambda x: x)
    b = blocks(COMM, cell, *n, gap=gap, overhang=overhang, pose=lambda x: length * bend(x) @ R.T, shuffle=shuffle)
    way = np.array([slide, *[0.0] * (g - 2), -d])
    bcs = b.oedometer(d) if held else [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=length * R @ way)]
    contact = uem.Contact(b.high, b.low, max_penetration=0.5 * length, **how)
    F = LAWS[law](b.u, modulus(b.scene, stress * E[0], stress * E[1]))
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], rtol=1e-10)
    iterations = 0
    for step in uem.load_steps(problem, steps):
        in_equilibrium(problem, contact, step.iterations, length, stress)
        assert step.cuts == 0
        iterations += step.newton_iterations
    assert iterations <= PATIENCE
    problem.bodies.assemble()
    work = problem.bodies.residual.array_r @ problem.config.displacement[: problem.config.n_owned].ravel()
    energy = 0.5 * float(COMM.allreduce(work)) / (stress * length**g)
    force = contact.resultant().force @ R / (stress * length ** (g - 1))
    return Meeting(b.scene.gather(b.u) @ R / length, force, contact.n_active, energy, iterations, contact)


# -- poses, units, numbering -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("height", "law"),
    [
        (0.0, "linear"),
        *(
            pytest.param(*how, marks=pytest.mark.slow)
            for how in ((-0.2, "finite"), (0.0, "finite"), (0.3, "linear"), (0.3, "finite"), (-0.2, "linear"))
        ),
    ],
)  # fmt: skip
@few
@given(angle=st.floats(-3.2, 3.2), size=st.floats(-9, 6), stiff=st.floats(-3, 11), seed=st.integers(0, 99))
def test_force_turns_with_the_scene(law, height, angle, size, stiff, seed):
    """In any pose, unit and numbering the scene is the same scene."""
    how = dict(law=law, gap=0.05, d=0.12, slide=0.03, pose=arch(height, 0.45))
    there = meet(**how, turn=rotation(2, angle), length=10.0**size, stress=10.0**stiff)
    here = meet(**how)
    assert there.active == here.active > 0
    assert np.abs(there.force - here.force).max() < 1e-8
    assert np.abs(there.u - here.u).max() < 1e-8
    other = meet(**how, shuffle=seed)
    assert np.abs(other.force - here.force).max() < 1e-9 and other.active == here.active


@settings(max_examples=3, deadline=None, derandomize=True)
@given(angle=st.floats(-3.2, 3.2), cell=st.sampled_from(["tetrahedron", "hexahedron"]))
def test_force_turns_with_the_scene_in_3d(angle, cell):
    how = dict(cell=cell, n=(3, 2), gap=0.05, d=0.12, slide=0.03, pose=arch(0.3, 0.45))
    here, there = meet(**how), meet(**how, turn=rotation(3, angle))
    assert there.active == here.active > 0
    assert np.abs(there.force - here.force).max() < 1e-9 and np.abs(there.u - here.u).max() < 1e-9


# -- meshes --------------------------------------------------------------------------------------------------------------------


def saddle_point(cell, n_low, n_high, ratio, d):
    """Force between two blocks in an oedometer by dense multipliers, the contactors that pull left out one after the other."""
    b = blocks(MPI.COMM_SELF, cell, n_low, n_high)
    compiled = forms.form(ufl.derivative(linear(b.u, modulus(b.scene, 1.0, ratio)), b.u))
    A = forms.create_matrix(compiled)
    forms.assemble_matrix(A, compiled)
    number = b.scene.numbering(b.V)
    x, high = b.scene.drawing[number], number >= len(number) - b.n_high_nodes
    value = np.full((len(x), 2), np.nan)
    value[np.abs(x[:, 0] - 0.5) > 0.5 - 1e-9, 0] = 0.0
    value[x[:, 1] < -1 + 1e-9, 1], value[x[:, 1] > 1 - 1e-9, 1] = 0.0, -d
    u, free, K = np.nan_to_num(value).ravel(), np.isnan(value).ravel(), gathered_matrix(A)
    contactors, target = (np.flatnonzero(side & (np.abs(x[:, 1]) < 1e-9)) for side in (high, ~high))
    target = target[np.argsort(x[target, 0])]
    G = np.zeros((len(contactors), len(u)))
    for row, i in enumerate(contactors):
        G[row, 2 * i + 1] = 1.0
        G[row, 2 * target + 1] = [-np.interp(x[i, 0], x[target, 0], hat) for hat in np.eye(len(target))]
    active = np.ones(len(G), bool)
    while True:
        C = G[active][:, free]
        saddle = np.block([[K[np.ix_(free, free)], C.T], [C, np.zeros((len(C), len(C)))]])
        lam = -np.linalg.solve(saddle, [*-(K @ u)[free], *np.zeros(len(C))])[free.sum() :]
        if lam.min() >= -1e-12:
            return lam.sum()
        active[np.flatnonzero(active)[lam.argmin()]] = False


@pytest.mark.long
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@few
@given(n_low=st.integers(1, 5), n_high=st.integers(1, 5), ratio=st.sampled_from([0.1, 1.0, 10.0]))
def test_any_two_meshes(cell, n_low, n_high, ratio):
    """Force and energy of uniform compression: exact for nested meshes, else within the error of a single pass."""
    d = 0.01
    exact, how = M * d * ratio / (1 + ratio), {"E": (1.0, ratio), "d": d, "overhang": 0.0, "held": True}
    force = saddle_point(cell, n_low, n_high, ratio, d)
    m = meet(cell, (n_low, n_high), sliding="fixed", **how)
    assert m.force[1] == pytest.approx(force, rel=1e-9) and m.energy == pytest.approx(force * d / 2, rel=1e-9)
    if n_high % n_low == 0:
        assert force == pytest.approx(exact, rel=1e-10)
    # small strains, but contactors that follow facets which have turned and slid by strains
    m = meet(cell, (n_low, n_high), **how)
    assert m.active >= 1 and m.force[1] == pytest.approx(force, rel=d)
    assert m.energy == pytest.approx(m.force[1] * d / 2, rel=d**2)


def test_energy_falls_to_its_limit():
    """Finer contactors and targets together: the energy of a block pressed on a wider one converges."""
    energies = [meet("quadrilateral", (2 * n, n), d=0.02).energy for n in (2, 4, 8, 16)]
    assert (np.diff(energies) < 0).all()
    steps = -np.diff(energies)
    assert (steps[1:] < 0.75 * steps[:-1]).all()


# -- overlaps ------------------------------------------------------------------------------------------------------------------


def overlapping(cell, n, overlap):
    """The same interference as a drawing and as a way of the top."""
    drawn = meet(cell, n, gap=-overlap, d=0.0)
    pushed = meet(cell, n, gap=0.0, d=overlap)
    high = np.arange(len(drawn.u)) >= len(drawn.u) - (n[1] + 1) ** drawn.u.shape[1]
    u = drawn.u.copy()
    u[high, -1] -= overlap
    # rounding of places, 1e-13 of the scene
    tol = 1e-8 * overlap + 1e-12
    assert np.abs(u - pushed.u).max() < tol
    assert np.abs(drawn.force - pushed.force).max() < 10 * tol
    assert drawn.force[-1] > 0.3 * overlap


@pytest.mark.long
@pytest.mark.parametrize(
    "cell,n",
    [
        ("triangle", (3, 4)),
        *(pytest.param(*more, marks=pytest.mark.slow) for more in (("quadrilateral", (4, 4)), ("triangle", (5, 2)))),
    ],
)
@few
@given(exponent=st.floats(-12, np.log10(0.125)))
@example(exponent=np.log10(0.125))
@example(exponent=-12.0)
def test_overlap_is_an_approach(cell, n, exponent):
    """Bodies that are drawn into each other press each other apart as if they had been pushed together by as much."""
    overlapping(cell, n, 10.0**exponent)


@pytest.mark.parametrize("overlap", [0.25, 1e-5, 1e-11])
def test_overlap_is_an_approach_in_3d(overlap):
    overlapping("hexahedron", (2, 2), overlap)


@pytest.mark.parametrize("shuffle", [1, 7, 11])
def test_contactor_led_past_the_end_of_a_concave_edge(shuffle):
    """One that has changed facets too often to be followed lets go of an edge it has left, whatever order the facets come in."""
    m = meet("hexahedron", (2, 2), d=0.25, shuffle=shuffle)
    assert m.active == 9
    assert np.abs(m.force[:2]).max() < 1e-10 * m.force[2]


# -- to the last bit -------------------------------------------------------------------------------------------------------------

#: Shifts of a contactor from a vertex, as parts of an element; the smallest is the last bit of its place.
NUDGES = [4 * np.spacing(0.5), -4 * np.spacing(0.5), 1e-12, -1e-12, 1e-9, -1e-9, 1e-6, -1e-6]


def nudged(nudge, *, height=0.0, cell="triangle", normals="facet", law="finite", gap=0.0, fitted=False):
    """Meshes that match but for the nudge: every contactor above a vertex of the target, or on it when ``fitted``.

    Returns:
        Force, displacements, iterations.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    m = 4 if g == 2 else 2
    low = box(cell, [-0.5] * (g - 1) + [-1.0], [1.5] * (g - 1) + [0.0], [2 * m] * (g - 1) + [m])
    high = box(cell, [0.0] * (g - 1) + [gap], [1.0] * (g - 1) + [1.0 + gap], [m] * g)

    def pose(x):
        y = arch(height, 0.45)(x)
        if not fitted:
            y[len(low.x) :] = x[len(low.x) :]
        y[len(low.x) :, 0] += nudge / m
        return y

    s = scene(COMM, cell, [low, high], pose=pose)
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("high", 1, at(g - 1, gap)), s.tag("low", 0, at(g - 1, 0.0)), normals=normals, max_penetration=0.5)
    bcs = clamp(V, s.tag("bottom", 0, at(g - 1, -1.0)))
    bcs += clamp(V, s.tag("top", 1, at(g - 1, 1.0 + gap)), value=[0.0] * (g - 1) + [-0.03 - gap])
    problem = uem.UnitedProblem(LAWS[law](u, modulus(s, 1.0, 2.0)), u, bcs=bcs, contacts=[contact], rtol=1e-10)
    count = 0
    for step in uem.load_steps(problem, 2):
        in_equilibrium(problem, contact, step.iterations, 1.0, 1.0)
        assert step.cuts == 0
        count += step.newton_iterations
    assert count <= PATIENCE
    return contact.resultant().force, s.gather(u), count


@pytest.mark.long
@pytest.mark.parametrize(
    "cell,normals,height,law",
    [
        ("triangle", "facet", 0.0, "linear"), ("triangle", "averaged", 0.0, "finite"),
        pytest.param("triangle", "facet", -0.2, "finite", marks=pytest.mark.slow),
        pytest.param("triangle", "averaged", 0.3, "finite", marks=pytest.mark.slow),
        pytest.param("hexahedron", "facet", 0.0, "linear", marks=pytest.mark.slow),
        pytest.param("quadrilateral", "facet", 0.0, "finite", marks=pytest.mark.slow),
        pytest.param("quadrilateral", "averaged", -0.2, "linear", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_contactor_next_to_a_vertex(cell, normals, height, law):
    """On it, a bit to the left, a bit to the right: the answer changes by as little as the scene does."""
    how = dict(cell=cell, normals=normals, height=height, law=law, gap=0.06 if height < 0 else 0.0)
    force, u, count = nudged(0.0, **how)
    assert force[-1] > 0.01
    for nudge in NUDGES if cell != "hexahedron" else NUDGES[1:3]:
        there = nudged(nudge, **how)
        assert np.abs(there[0] - force).max() <= 0.2 * abs(nudge) + 1e-9
        assert np.abs(there[1] - u).max() <= 1.0 * abs(nudge) + 1e-9
        # neither in circles nor by another way
        assert abs(there[2] - count) <= 5


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_contactor_next_to_a_ridge(law):
    """On a convex polygon facet normals jump, and which side of a ridge a contactor comes to rest on is no matter of much force."""
    force, _, _ = nudged(0.0, height=0.3, law=law, fitted=True)
    for nudge in NUDGES:
        there = nudged(nudge, height=0.3, law=law, fitted=True)
        assert there[0][1] == pytest.approx(force[1], rel=0.02)
        # sideways by no more than the slopes of the two sides about it
        assert np.abs(there[0][0] - force[0]) <= 0.3 * 0.25 * force[1]


# -- hardly touching -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell,n", [("triangle", 4), ("quadrilateral", 3), ("tetrahedron", 2), ("hexahedron", 2)])
def test_coincident_nodes(cell, n, law):
    """Meshes that match node for node: all contactors touch from the start, and a uniform pressure passes."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    m = meet(cell, (n, n), law=law, overhang=0.0, held=True, d=0.02, E=(1.0, 1.0))
    assert m.active == (n + 1) ** (g - 1)
    e = 0.01
    force = M * e if law == "linear" else M * e * (1 - e) * (2 - e) / 2
    assert m.force[-1] == pytest.approx(force, rel=1e-9)
    assert highest(COMM, np.abs(m.contact.pressures / force - 1)) < 1e-8
    # one matching interface is none: the field is that of one block
    assert m.iterations <= 5


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell,n", [("triangle", (4, 4)), ("quadrilateral", (2, 5)), ("hexahedron", (1, 2))])
def test_touching_without_force(cell, n, law):
    """Nothing pushes: it is done at once, nothing has moved and no force is there."""
    m = meet(cell, n, law=law, d=0.0, steps=2)
    assert m.iterations == 0
    assert np.abs(m.u).max() == 0.0 and np.abs(m.force).max() == 0.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("gap", [0.25, 0.1, 1 / 3])
@pytest.mark.parametrize("more", [-1e-6, 0.0, 1e-6])
def test_coming_down_to_touch(gap, law, more):
    """Brought to the target and no further, a little less far and a little further: no force, or as little as it takes."""
    m = meet("triangle", (3, 4), law=law, gap=gap, d=gap + more)
    if more <= 0.0:
        assert np.abs(m.force).max() < 1e-12 and np.abs(m.u[:, 0]).max() < 1e-12
    else:
        assert 0.3 * more < m.force[1] < 2 * more
