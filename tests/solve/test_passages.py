"""Steps that would lead contactors through a body: thin plates, rigid slabs and spheres, still or moving; and those that only seem to.

Two tests to read first: ``test_a_plate_is_not_passed`` and ``test_ways_that_lead_through_nothing``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, highest, linear, modulus, rotation, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.passages import refuse_passages

COMM = MPI.COMM_WORLD


def boundary(s, body, part, name="plate"):
    """The whole boundary of a box as a tag."""
    sides = [
        s.tag("side", body, at(axis, value)).entities
        for axis in range(part.x.shape[1])
        for value in (part.x[:, axis].min(), part.x[:, axis].max())
    ]
    return uem.Tag(name, 1, s.mesh.topology.dim - 1, s.mesh, np.unique(np.concatenate(sides)).astype(np.int32))


def plate_and_block(
    cell="quadrilateral",
    thick=0.1,
    gap=0.05,
    push=(0.0, -0.7),
    lift=0.0,
    layers=1,
    degree=1,
    fine=1,
    contactor="block",
    comm=COMM,
):
    """A block above a plate that is clamped at its ends; the whole boundary of one is the target: the problem and its contact.

    Args:
        cell: kind of cells.
        thick: thickness of the plate.
        gap: between both.
        push: displacement of the block's top, along the plate and across it.
        lift: displacement of the plate's ends across it.
        layers: of cells in the plate.
        degree: of the displacement.
        fine: how many times finer both meshes are in 2D.
        contactor: whose side that faces the other body touches its whole boundary.
        comm: communicator.
    """
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    wide, n = [0.3] * (g - 2), [2] * (g - 2)
    plate = box(cell, [-1.0, *(-w for w in wide), -thick], [1.0, *wide, 0.0], [20 * fine if g == 2 else 10, *n, layers * fine])
    cells = [5 * fine, 3 * fine] if g == 2 else [3, 2, 2]
    block = box(cell, [-0.2, *(-0.5 * w for w in wide), gap], [0.2, *(0.5 * w for w in wide), gap + 0.3], cells)
    s = scene(comm, cell, [plate, block])
    V = compat.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)
    if contactor == "block":
        contact = uem.Contact(s.tag("block", 1, at(g - 1, gap)), boundary(s, 0, plate))
    else:
        contact = uem.Contact(s.tag("plate", 0, at(g - 1, 0.0)), boundary(s, 1, block, "block"))
    ends = [s.tag("end", 0, at(0, x)) for x in (-1.0, 1.0)]
    bcs = clamp(V, s.tag("top", 1, at(g - 1, gap + 0.3)), value=[push[0], *[0.0] * (g - 2), push[1]])
    for end in ends:
        bcs += clamp(V, end, value=[0.0] * (g - 1) + [lift])
    return uem.UnitedProblem(linear(u, modulus(s, 1.0, 10.0)), u, bcs=bcs, contacts=[contact], rtol=1e-11), contact


PLATES = [
    {"cell": "triangle", "thick": 0.02},
    {"cell": "triangle", "thick": 0.2, "lift": 0.1, "push": (0.0, -0.5)},
    {"cell": "triangle", "thick": 0.1, "degree": 2, "push": (0.0, -0.5)},
    {"thick": 0.1, "push": (0.3, -0.7)},
    {"thick": 0.1, "push": (-0.3, -0.7), "layers": 2},
    {"thick": 0.02, "lift": 0.2},
    {"cell": "tetrahedron", "thick": 0.05, "push": (0.1, -0.4)},
    {"cell": "hexahedron", "thick": 0.1, "lift": 0.1, "push": (0.0, -0.4)},
]


@pytest.mark.parametrize("how", PLATES, ids=str)
def test_a_plate_is_not_passed(how):
    """One load step of several times the thickness, cut where it must be, gives the force that many steps give."""
    forces = []
    for steps in (1, 10):
        problem, contact = plate_and_block(**how)
        run(problem, steps)
        forces.append(contact.resultant().force)
    assert forces[1][-1] > 1e-5
    assert forces[0] == pytest.approx(forces[1], rel=1e-6, abs=1e-7 * forces[1][-1])


WRAPPED = [
    {"thick": 0.2, "fine": 2},
    {"thick": 0.1, "fine": 2, "push": (0.0, -1.0)},
    {"thick": 0.05, "push": (0.3, -0.7)},
    {"thick": 0.2, "degree": 2},
    {"cell": "triangle", "thick": 0.2, "fine": 2},
    {"cell": "triangle", "thick": 0.1, "degree": 2, "push": (0.0, -1.0)},
]


@pytest.mark.parametrize("how", [*WRAPPED[:4], *(pytest.param(how, marks=pytest.mark.slow) for how in WRAPPED[4:])], ids=str)
def test_a_plate_wraps_the_right_faces(how):
    """Nodes of the plate that come from the side of the block's edge end on the faces that small steps bring them to."""
    forces = []
    for steps in (1, 20):
        problem, contact = plate_and_block(contactor="plate", **how)
        taken = run(problem, steps)
        forces.append(contact.resultant().force)
    assert steps == len(taken) and abs(forces[1][-1]) > 1e-5
    assert forces[0] == pytest.approx(forces[1], rel=1e-5, abs=1e-5 * np.abs(forces[1]).max())


def test_a_single_solve_names_the_edge():
    problem, _ = plate_and_block(contactor="plate", thick=0.2, fine=2)
    with pytest.raises(
        uem.TunnellingError,
        match=r"plate on block: the contactor at \(.*\) comes to a face next to an edge of the target within a step",
    ):
        problem.solve()


@pytest.mark.parametrize("gap", [0.05, 0.2])
def test_a_single_solve_says_so_and_restores(gap):
    """``solve`` cannot cut its step: it names contact and contactor, and leaves the state that it found."""
    problem, contact = plate_and_block(gap=gap, push=(0.45, -gap - 0.4))
    before = problem.pairs[0].committed
    with pytest.raises(
        uem.TunnellingError, match=r"block on plate: the contactor at \(.*\) passes through the target within a step"
    ):
        problem.solve()
    assert highest(COMM, np.abs(problem.u.x.array)) == 0.0
    assert problem.pairs[0].trial is before


def test_ranks_cut_alike():
    """All ranks together take the steps that one takes alone."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        problem, contact = plate_and_block(comm=comm, push=(0.2, -0.6))
        steps = run(problem)
        found.append(([step.factor for step in steps], contact.resultant().force))
    assert found[0][0] == found[1][0] and len(found[0][0]) > 1
    assert np.allclose(found[0][1], found[1][1], rtol=1e-9, atol=1e-12)


# -- rigid targets -------------------------------------------------------------------------------------------------------


def slab(half):
    """Rigid slab ``|y| < half``."""
    return uem.RigidSurface(
        lambda x: np.abs(x[:, -1]) - half,
        lambda x: np.where(x[:, [-1]] < 0, -1.0, 1.0) * np.eye(x.shape[1])[-1],
        name="slab",
        stride=half,
    )


def above(target, top, way, moves=None):
    """A soft block 0.02 above a rigid target, whose far side is led by ``way``; the target moves along ``moves`` and turns."""
    block = box("quadrilateral", [-0.2, top + 0.02], [0.2, top + 0.62], [6, 6])
    s = scene(COMM, "quadrilateral", [block])
    V = compat.function_space(s.mesh, 1, (2,))
    u, led = fem.Function(V), fem.Function(V)
    contact = uem.Contact(s.tag("tip", 0, at(1, top + 0.02)), target)
    far = s.tag("far", 0, at(1, top + 0.62))

    def load(factor):
        led.x.array.reshape(-1, 2)[:] = factor * np.array(way)
        if moves is not None:
            target.move(*(factor * np.array(m) for m in moves))

    bcs = [fem.dirichletbc(led, fem.locate_dofs_topological(V, 1, far.entities))]
    return uem.UnitedProblem(st_venant(u, modulus(s, 1.0)), u, bcs=bcs, contacts=[contact], load=load, rtol=1e-11), contact


@pytest.mark.parametrize(
    ("target", "top", "way", "moves"),
    [
        (lambda: slab(0.02), 0.02, [0.0, -0.12], None),
        (lambda: slab(0.02), 0.02, [0.1, -0.12], None),
        pytest.param(lambda: slab(0.02), 0.02, [0.0, 0.0], ([0.0, 0.12],), marks=pytest.mark.slow),
        (lambda: slab(0.02), 0.02, [0.0, -0.05], ([0.3, 0.07],)),
        (lambda: slab(0.02), 0.02, [0.0, -0.02], ([0.0, 0.1], [0.1])),
    ],
    ids=["still", "askew", "moving", "both", "turning"],
)
def test_rigid_targets_are_not_passed(target, top, way, moves):
    forces = []
    for steps in (1, 8):
        problem, contact = above(target(), top, way, moves)
        run(problem, steps)
        forces.append(contact.resultant().force)
    assert forces[1][1] > 1e-3
    assert forces[0] == pytest.approx(forces[1], rel=1e-6, abs=1e-8)


def test_a_moving_target_is_refused_in_a_single_solve():
    target = slab(0.02)
    problem, _ = above(target, 0.02, [0.0, 0.0])
    target.move([0.0, 0.12])
    with pytest.raises(uem.TunnellingError, match="tip on slab"):
        problem.solve()


@pytest.mark.parametrize(("height", "passes"), [(0.45, True), (0.6, False)])
def test_what_looks_away(height, passes):
    """A straight way past the middle of a circle of radius 1 leads through it, one near its crown only cuts this short."""
    start = [-1.9, height]
    s = scene(COMM, "quadrilateral", [box("quadrilateral", start, np.array(start) + 1e-3, [1, 1])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("tip", 0, at(1, height)), uem.RigidSphere([0.0, 0.0], 1.0), max_penetration=1.0)
    whole = s.tag("whole", 0, lambda x: np.full(len(x), True))
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(V, whole, value=[3.8, 0.0]), contacts=[contact], line_search=False)
    if passes:
        with pytest.raises(uem.TunnellingError):
            problem.solve()
    else:
        problem.solve()


# -- no false alarms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", [(1.3, 0.0), (2.5, -0.4), (40.0, -30.0), (-0.9, 0.9)])
def test_ways_that_lead_through_nothing(way):
    """A block slides along, past and off the end of a low block whose whole boundary is the target, in one step."""
    low = box("quadrilateral", [0.0, -1.0], [2.0, 0.0], [10, 5])
    high = box("quadrilateral", [1.0, 0.0], [1.4, 0.4], [3, 3])
    s = scene(COMM, "quadrilateral", [low, high])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    contact = uem.Contact(s.tag("high", 1, at(1, 0.0)), boundary(s, 0, low))
    bcs = [*clamp(V, s.tag("base", 0, at(1, -1.0))), *clamp(V, s.tag("top", 1, at(1, 0.4)), value=way)]
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 10.0)), u, bcs=bcs, contacts=[contact])
    steps = run(problem)
    assert len(steps) == 1 and steps[0].cuts == 0


@pytest.mark.parametrize("angle", [0.5, 1.5, 2.8])
def test_bodies_that_turn_together(angle):
    """Two blocks in contact are turned as one body by up to 160 degrees in a step: nothing passes."""
    b = blocks(COMM, "quadrilateral", 3, 4)
    contact = uem.Contact(b.high, boundary(b.scene, 0, box("quadrilateral", [0.0, -1.0], [1.0, 0.0], [3, 3])))
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    x = problem.config.X
    problem.config.displacement[:] = x @ rotation(2, angle).T - x
    problem.system.place()
    assert contact.n_active > 0
    refuse_passages(problem.config, problem.pairs, problem.committed, [None])


def across(slope, n, coupling):
    """A small block that is led from flank to flank of a concave edge (slope > 0) or a ridge (slope < 0), in front of both all along."""
    deep = 1.0 + abs(slope)

    def bend(x):
        return np.column_stack([x[:, 0], x[:, 1] + slope * np.abs(x[:, 0]) * (x[:, 1] + deep) / deep])

    low = box("quadrilateral", [-1.0, -deep], [1.0, 0.0], [2 * n, 3]).mapped(bend)
    flank, size = 0.45 * slope, 0.1
    start = [-0.5, flank + 0.05 if slope > 0 else 0.6 * abs(slope)]
    high = box("quadrilateral", start, np.array(start) + size, [1, 1])
    s = scene(COMM, "quadrilateral", [low, high])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    faces = s.tag("faces", 0, lambda x: np.abs(x[:, 1] - slope * np.abs(x[:, 0])) < 1e-9)
    contact = uem.Contact(s.tag("tip", 1, at(1, start[1])), faces, coupling=coupling)
    # the lower corner of the block's base ends a little inside of the other flank
    x = 0.4 if slope > 0 else 0.5
    end = [x, slope * (x + (size if slope > 0 else 0.0)) - 0.01]
    way = np.array(end) - start
    bcs = [*clamp(V, s.tag("base", 0, at(1, -deep))), *clamp(V, s.tag("top", 1, at(1, start[1] + size)), value=way)]
    problem = uem.UnitedProblem(linear(u, modulus(s, 10.0, 1.0)), u, bcs=bcs, contacts=[contact])
    return problem, contact


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("slope", [0.4, 0.6])
@pytest.mark.parametrize("n", [2, 5])
def test_faces_that_look_at_each_other(slope, n, coupling):
    """From flank to flank of a concave edge a contactor meets nothing, however long its way; on a ridge it may have met the other."""
    problem, contact = across(slope, n, coupling)
    problem.solve()
    assert contact.n_active > 0
    problem, _ = across(-slope, n, coupling)
    with pytest.raises(uem.TunnellingError, match="comes to a face next to an edge of the target"):
        problem.solve()


def test_small_ways_are_not_looked_at(monkeypatch):
    """Where nothing moves by half a facet no way is searched for crossings."""
    from uem_dolfinx.geometry import crossings

    monkeypatch.setattr(crossings, "cross_target", None)
    problem, contact = plate_and_block(gap=0.0, push=(0.0, -0.08))
    run(problem, 4)
    assert contact.n_active > 0
