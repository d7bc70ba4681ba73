"""Contactors of degree 2: control gaps and control forces instead of nodal ones.

Two tests to read first: ``test_nonnegative_control_gaps_leave_no_overlap`` (the reason for them) and ``test_rim_of_a_contact_zone``
(where nodal forces of a positive pressure have the wrong sign).
"""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import (
    CELLS,
    M,
    arch,
    at,
    blocks,
    box,
    clamp,
    factors,
    highest,
    lawful,
    linear,
    lowest,
    modulus,
    rotation,
    run,
    scene,
    st_venant,
    tangent_by_differences,
)  # fmt: skip
from hypothesis import given, settings
from hypothesis import strategies as st
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.surfaces import tributary_areas

COMM = MPI.COMM_WORLD


# -- closed forms ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("finer", ["upper", "lower"])
@pytest.mark.parametrize("cell", CELLS)
def test_patch(cell, finer):
    """Nested meshes, the finer side the contactor: uniform pressure, every displacement the closed form's, all forces press."""
    d, ratio = 0.01, 3.0
    n_low, n_high = (1, 2) if finer == "upper" else (2, 1)
    b = blocks(COMM, cell, n_low, n_high, degree=2)
    contact = uem.Contact(*((b.high, b.low) if finer == "upper" else (b.low, b.high)))
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=b.oedometer(d), contacts=[contact])
    run(problem)
    low, high = d * ratio / (1 + ratio), d / (1 + ratio)
    force, side = M * low, 1.0 if finer == "upper" else -1.0
    assert contact.resultant().force[-1] == pytest.approx(side * force, rel=1e-10)
    assert highest(COMM, np.abs(contact.pressures / force - 1)) < 1e-8
    x, u = problem.config.X, problem.config.displacement
    z = x[:, -1]
    exact = np.where(z > 0, -low - high * z, -low * (z + 1))
    assert highest(COMM, np.abs(u[:, -1] - exact)) < 1e-12 * max(1.0, d)
    assert highest(COMM, np.abs(u[:, :-1])) < 1e-12
    # every node of the finer side, in the middle of facets, too, where cells have nodes there
    assert contact.n_active == 5 ** (b.gdim - 1)
    assert lowest(COMM, contact.pair.trial.lam) > 0
    assert np.sum(COMM.allgather(contact.pair.trial.lam.sum())) == pytest.approx(force, rel=1e-10)
    lawful(contact, force=force)


@pytest.mark.long
@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_floating_block_of_degree_two(cell, tilt):
    """It falls on a rigid plane, lies down on it if need be, and carries its load uniformly."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    n, R = (3 if g == 2 else 2), rotation(g, tilt)
    s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], pose=lambda x: x @ R.T + 0.1 * np.eye(g)[-1])
    V = compat.function_space(s.mesh, 2, (g,))
    u = fem.Function(V)
    top = forms.surface_measure(s.mesh, s.tag("top", 0, at(g - 1, 1.0)).entities)
    F = st_venant(u, fem.Constant(s.mesh, PETSc.ScalarType(1.0)), 0.0) + 0.02 * ufl.TestFunction(V)[g - 1] * top
    contact = uem.Contact(s.tag("bottom", 0, at(g - 1, 0.0)), uem.RigidPlane([0.0] * g, np.eye(g)[-1]))
    uem.UnitedProblem(F, u, contacts=[contact], rtol=1e-10).solve()
    lawful(contact)
    assert contact.n_active == (2 * n + 1) ** (g - 1)
    assert contact.resultant().force[-1] == pytest.approx(0.02, rel=1e-9)
    assert highest(COMM, np.abs(contact.pressures / 0.02 - 1)) < 1e-8


class Top:
    """Top of a box over a rigid plane far below its base, with any gap: the pair of a contact of degree 2."""

    def __init__(self, cell, comm=COMM):
        g = self.g = 2 if cell in ("triangle", "quadrilateral") else 3
        s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)])
        V = compat.function_space(s.mesh, 2, (g,))
        self.u = fem.Function(V)
        self.tag = s.tag("top", 0, at(g - 1, 1.0))
        plane = uem.RigidPlane([0.0] * (g - 1) + [1.0], -np.eye(g)[-1])
        self.contact = uem.Contact(self.tag, plane, max_penetration=9.0)
        F = linear(self.u, fem.Constant(s.mesh, PETSc.ScalarType(1.0)))
        base = clamp(V, s.tag("base", 0, at(g - 1, 0.0)))
        self.problem = uem.UnitedProblem(F, self.u, bcs=base, contacts=[self.contact])
        self.config, self.pair = self.problem.config, self.contact.pair
        self.facets = [fem.locate_dofs_topological(V, g - 1, np.array([f], np.int32), False) for f in self.tag.entities]
        self.X = self.config.X[:, :-1]
        # a pressure that is zero on a part of the surface
        self.S = compat.function_space(s.mesh, 2)
        self.wave = fem.Constant(s.mesh, np.zeros(7))
        x, c = ufl.SpatialCoordinate(s.mesh), self.wave
        wave = sum(c[i] * ufl.sin(c[2 + i] * x[i] + c[4 + i]) for i in range(g - 1)) + c[6]
        measure = forms.surface_measure(s.mesh, self.tag.entities, {"quadrature_degree": 6})
        self.push = forms.form(ufl.conditional(ufl.gt(wave, 0.0), wave, 0.0) * ufl.TestFunction(self.S) * measure)

    def open(self, gap, active=False):
        """Give the local nodes these gaps ``(n_local,)`` and project."""
        self.config.displacement[:, -1] = -gap
        self.u.x.scatter_forward()
        self.pair.trial = replace(self.pair.trial, active=np.full(len(self.pair.nodes), active))
        self.pair.project()

    def powers(self, x):
        """Monomials of the facets' polynomials ``(n, k)``."""
        if self.g == 2:
            return np.column_stack([x[:, 0] ** i for i in range(3)])
        quads = len(self.facets[0]) == 9 if self.facets else False
        return np.column_stack([x[:, 0] ** i * x[:, 1] ** j for i in range(3) for j in range(3) if quads or i + j <= 2])

    def sampled(self, values, seed):
        """Smallest value of the polynomials through nodal values on each of this rank's facets, at random places."""
        rng, smallest = np.random.default_rng(seed), np.inf
        for nodes in self.facets:
            # centred, so that monomials can tell nodes apart
            x = self.X[nodes] - self.X[nodes].mean(axis=0)
            c = np.linalg.solve(self.powers(x), values[nodes])
            if len(nodes) == 9:
                at_ = x.min(axis=0) + rng.random((300, 2)) * np.ptp(x, axis=0)
            else:
                # corners are the nodes that are in the middle of no others
                i = [
                    k
                    for k in range(len(x))
                    if not any(np.allclose(2 * x[k], x[a] + x[b]) for a in range(len(x)) for b in range(a))
                ]
                at_ = rng.dirichlet(np.ones(len(i)), 300) @ x[i]
            smallest = min(smallest, (self.powers(at_) @ c).min())
        return smallest


@pytest.fixture(scope="module", params=CELLS)
def top(request):
    return Top(request.param)


def place_hash(X, seed):
    """Random numbers in [0, 1) that belong to places, alike on all ranks."""
    return np.modf(np.abs(np.sin(X @ np.array([12.9898, 78.233, 37.719])[: X.shape[1]] + seed) * 43758.5453))[0]


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), zeros=st.floats(0.0, 0.9))
def test_nonnegative_control_gaps_leave_no_overlap(top, seed, zeros):
    """Where no control gap is negative no point of the surface is inside the target; nodal gaps cannot promise that."""
    config, family = top.config, top.pair.discretisation.family
    wanted = place_hash(np.round(config.X, 6), seed)
    wanted = 0.01 * np.where(wanted < zeros, 0.0, wanted)
    # nodal gaps from control gaps, ancestors first: vertices, edges, facets
    nodal = np.array(wanted)
    middle_of_facet = np.isin(family.child, family.child[family.of_facet])
    for k in (~middle_of_facet, middle_of_facet):
        more = np.zeros(config.n_local)
        np.add.at(more, top.pair.nodes[family.child[k]], family.weight[k] * nodal[family.parent[k]])
        nodal += more
        # ghosts take their owners' values
        top.u.x.array.reshape(-1, top.g)[:, -1] = nodal
        top.u.x.scatter_forward()
        nodal = np.array(top.u.x.array.reshape(-1, top.g)[:, -1])
    top.open(nodal)
    assert COMM.allreduce(int((~top.pair.kinematics.control.shared).sum())) == 0
    assert highest(COMM, np.abs(top.pair.kinematics.gap - wanted[top.pair.nodes])) < 1e-15
    assert lowest(COMM, [top.sampled(nodal, seed)]) >= -1e-15


@pytest.mark.long
@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), share=st.floats(0.05, 1.0))
def test_control_forces_of_a_pressure_press(top, seed, share):
    """Any pressure >= 0, even one that acts on a part of a facet, has control forces >= 0 that add up to it."""
    config = top.config
    top.open(np.zeros(config.n_local), active=True)
    rng = np.random.default_rng(seed)
    top.wave.value[:] = np.concatenate([rng.normal(size=2), rng.uniform(1, 7, 2), rng.uniform(0, 6, 2), [share]])
    b = compat.create_vector(top.S)
    forms.assemble_vector(b, top.push)
    f = np.array(b.array_r)[top.pair.nodes]
    control = top.pair.kinematics.control
    lam, nodal = control.forces(control.basis.of(f) / control.basis.scale, np.ones(len(f), bool))
    total = float(COMM.allreduce(f.sum()))
    assert lowest(COMM, lam) >= -1e-15 * max(total, 1e-300)
    assert COMM.allreduce(lam.sum()) == pytest.approx(total, rel=1e-12, abs=1e-300)
    # control forces are equivalent to the nodal forces that they come from
    assert highest(COMM, np.abs(nodal - f)) <= 1e-15 * max(total, 1e-300)


def test_areas(top):
    """Positive, and together the surface's, where those of the shape functions are zero or negative at vertices."""
    top.open(np.zeros(top.config.n_local), active=True)
    plain = tributary_areas(top.config, top.tag)[top.pair.nodes]
    areas = top.pair.kinematics.pressure_map(False).areas(plain)
    assert lowest(COMM, areas) > 0.01
    assert COMM.allreduce(areas.sum()) == pytest.approx(1.0, rel=1e-12)
    if top.g == 3 and len(np.unique(COMM.allreduce([len(f) for f in top.facets]))) == 1:
        corner = np.linalg.norm(np.abs(top.X[top.pair.nodes] - 0.5) - 0.5, axis=1) < 1e-9
        assert highest(COMM, plain[corner]) < highest(COMM, areas[corner])


def on_an_arch(cell, comm=COMM, **options):
    """A block pressed askew onto an arch of degree 2."""
    # no contactor stands above a vertex
    b = blocks(comm, cell, 5 if cell in ("triangle", "quadrilateral") else 3, 2, degree=2, gap=0.1, overhang=0.5, pose=arch(0.3))
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.1, *[0.0] * (b.gdim - 2), -0.2])]
    contact = uem.Contact(b.high, b.low, max_penetration=1.0)
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], **options)
    return b, contact, problem


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_united_tangent_is_the_derivative_of_the_residual(cell):
    """``K - sum lambda grad^2 g`` against differences of ``F - sum lambda grad g``, on facets curved by the displacement."""
    _, contact, problem = on_an_arch(cell)
    difference, full, plain = tangent_by_differences(problem, contact)
    assert (difference - full).norm() < 1e-8 * plain.norm()
    assert (difference - plain).norm() > 1e-3 * plain.norm()


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_pressed_on_an_arch(cell):
    """Every step is lawful, Newton ends quadratically, and each rank alone finds the same answer in as many iterations."""
    answers = []
    for comm in (COMM, MPI.COMM_SELF):
        b, contact, problem = on_an_arch(cell, comm, rtol=1e-11)
        seen, counts = [], []
        for step in uem.load_steps(problem, 2):
            lawful(contact)
            seen += factors(step.iterations)
            counts.append(step.newton_iterations)
        assert len(seen) >= 2 and max(seen) < 20
        answers.append((contact.resultant().force, contact.n_active, counts))
    (force, active, counts), (alone, active_alone, counts_alone) = answers
    assert np.abs(force - alone).max() < 1e-9 * np.abs(alone).max()
    assert active == active_alone > 1 and counts == counts_alone


# -- the rim -----------------------------------------------------------------------------------------------------------------


def indented(cell, n, d=0.02, comm=COMM, kind="paraboloid", **options):
    """Quarter (half) of a block of degree 2 under a rigid indenter of radius 1/2, with symmetry planes and a fixed base."""
    g = len(n)
    body = box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], n)
    s = scene(comm, cell, [body], pose=lambda x: np.sign(x) * np.abs(x) ** 2)
    V = compat.function_space(s.mesh, 2, (g,))
    u = fem.Function(V)
    bcs = clamp(V, s.tag("base", 0, at(g - 1, -1.0)))
    for c in range(g - 1):
        bcs += clamp(V, s.tag("symmetry", 0, at(c, 0.0)), c)
    up = np.eye(g)[-1]
    target = uem.RigidParaboloid(-d * up, up, 0.5) if kind == "paraboloid" else uem.RigidSphere((0.5 - d) * up, 0.5)
    contact = uem.Contact(s.tag("top", 0, at(g - 1, 0.0)), target, max_penetration=1.0)
    law = options.pop("law", linear)
    problem = uem.UnitedProblem(law(u, fem.Constant(s.mesh, PETSc.ScalarType(10.0))), u, bcs=bcs, contacts=[contact], **options)
    return s, contact, problem


@pytest.mark.parametrize("kind", ["paraboloid", "sphere"])
@pytest.mark.parametrize(
    "cell,n", [("triangle", (9, 6)), ("quadrilateral", (8, 6)), ("tetrahedron", (4, 4, 3)), ("hexahedron", (3, 3, 2))]
)
def test_rim_of_a_contact_zone(cell, n, kind):
    """Pressures >= 0 up to the rim, which moves over the mesh with the depth; the force grows with it, and nothing cycles."""
    forces = []
    for d in (0.007, 0.013, 0.02, 0.03):
        _, contact, problem = indented(cell, n, d, kind=kind, rtol=1e-10)
        for step in uem.load_steps(problem):
            assert step.cuts == 0 and step.newton_iterations <= 20
        lawful(contact, force=10.0)
        assert contact.n_active >= 1
        forces.append(-contact.resultant().force[-1])
    assert (np.diff(forces) > 0).all()


@pytest.mark.parametrize("cell,n", [("triangle", (9, 6)), ("tetrahedron", (4, 4, 3))])
def test_rim_is_the_same_on_any_number_of_ranks(cell, n):
    """Force, pressures and active contactors, against the same scene on one rank."""
    answers = []
    for comm in (COMM, MPI.COMM_SELF):
        _, contact, problem = indented(cell, n, comm=comm, law=st_venant, rtol=1e-11)
        history = [i for step in run(problem) for i in step.iterations]
        lawful(contact, force=10.0)
        assert max(factors(history), default=0.0) < 20
        pair = contact.pair
        rows = np.column_stack([problem.config.X[pair.nodes], pair.trial.active, contact.pressures, pair.kinematics.gap])
        rows = np.concatenate(comm.allgather(rows))
        answers.append((rows[np.lexsort(np.round(rows[:, : len(n) - 1], 9).T)], len(history)))
    (rows, count), (alone, count_alone) = answers
    assert np.abs(rows - alone).max() < 1e-8 and count == count_alone
