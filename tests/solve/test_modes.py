"""Natural frequencies against closed forms of linear elements, and of bodies in contact against one piece."""

from __future__ import annotations

import sys

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from body_scenes import of_quarters
from dolfinx import fem, mesh
from helpers import at, blocks, box, clamp, linear, modulus, refused, run, scene
from restart_scenes import continues_alike

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.fields import ConfigurationAmongFields

pytest.importorskip("slepc4py")
COMM = MPI.COMM_WORLD
E, RHO = 3.0, 0.5


def discrete(kh, h):
    """Frequencies of waves of wave number k in linear elements of length h with consistent mass."""
    return np.sqrt(6.0 * E / RHO * (1.0 - np.cos(kh)) / (2.0 + np.cos(kh))) / h / (2 * np.pi)


def column(n):
    """A column of 2n cells, so narrow that its lowest modes move along y alone: scene, space, displacement and conditions."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, -1.0], [0.1, 1.0], [1, 2 * n])])
    V = compat.function_space(s.mesh, 1, (2,))
    bcs = [bc for x in (0.0, 0.1) for bc in clamp(V, s.tag("side", 0, at(0, x)), 0)]
    return s, V, fem.Function(V, name="u"), bcs


def test_a_bar():
    """One end held: the closed form of the mesh; modes have the mass one, and vibrate apart from each other."""
    s, V, u, bcs = column(4)
    problem = uem.UnitedProblem(linear(u, E, 0.0), u, bcs=[*bcs, *clamp(V, s.tag("foot", 0, at(1, -1.0)), 1)])
    mass = uem.consistent_mass(V, RHO)
    found = uem.modes(problem, 3, mass=mass)
    k = (np.arange(3) + 0.5) * np.pi / 2.0
    assert np.allclose(found.frequencies, discrete(k / 4, 0.25), rtol=1e-9)
    assert np.allclose(found.frequencies, np.sqrt(found.eigenvalues) / (2 * np.pi), rtol=1e-14)
    vectors = [problem.config.vector(f.x.array[: mass.M.getLocalSize()[0]]) for f in found.functions]
    gram = np.array([[a.dot(mass.M * b) for b in vectors] for a in vectors])
    assert np.abs(gram - np.eye(3)).max() <= 1e-8


@pytest.mark.long
def test_a_bar_with_a_pressure_of_its_own():
    """Constant in cells it changes no frequency, touching a wall; a temperature that strains the bar is refused."""
    s, V, _, _ = column(4)
    for field, strains in ((("DG", 0), False), (1, True)):
        W = uem.function_space(s.mesh, [field, ("Lagrange", 1, (2,))])
        w, (q, v), lam = fem.Function(W), ufl.TestFunctions(W), E / 3
        p, u = ufl.split(w)
        F = (2 * lam * ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) - p * ufl.div(v)) * ufl.dx
        F -= ((0.1 if strains else 1.0) * ufl.div(u) * q + p / lam * q) * ufl.dx
        bcs = [bc for x in (0.0, 0.1) for bc in clamp(W.sub(1), s.tag("side", 0, at(0, x)), 0)]
        bcs += [*clamp(W.sub(1), s.tag("foot", 0, at(1, -1.0)), 1)]
        contact = uem.Contact(s.tag("head", 0, at(1, 1.0)), uem.RigidPlane((0.0, 0.99), (0.0, -1.0)), max_penetration=np.inf)
        problem = uem.UnitedProblem(F, w, displacement=1, bcs=bcs, contacts=[contact])
        run(problem)
        mass = uem.consistent_mass(V, RHO)
        if strains:
            refused(uem.InputError, "symmetric tangent", lambda problem=problem, mass=mass: uem.modes(problem, 1, mass=mass))
            continue
        found = uem.modes(problem, 3, mass=mass)
        assert contact.n_active == 2
        assert np.allclose(found.frequencies, discrete(np.arange(1, 4) * np.pi / 2.0 / 4, 0.25), rtol=1e-9)
        # in each the pressure is that of its strain
        pressure = [
            uem.integrate((p + lam * ufl.div(u)) ** 2 * ufl.dx) / uem.integrate(p**2 * ufl.dx)
            for p, u in map(ufl.split, found.functions)
        ]
        assert max(pressure) < 1e-12


def test_a_mass_that_is_numbered_otherwise():
    """That of a collapsed part of the mixed space would be at other nodes."""
    W = uem.function_space(mesh.create_unit_square(COMM, 3, 3), [("Lagrange", 2, (2,)), 1])
    config, own = ConfigurationAmongFields(fem.Function(W), 0), uem.function_space(W.mesh, 2, (2,))
    uem.Dynamics(uem.lumped_mass(own, RHO)).attach(config)
    other = uem.Dynamics(uem.lumped_mass(W.sub(0).collapse()[0], RHO))
    refused(uem.SpaceError, "another numbering", lambda: other.attach(config))


def test_a_periodic_column():
    """Nothing holds it: it floats, and waves run both ways with the same frequency."""
    s, V, u, bcs = column(4)
    ends = s.tag("head", 0, at(1, 1.0)), s.tag("foot", 0, at(1, -1.0))
    problem = uem.UnitedProblem(linear(u, E, 0.0), u, bcs=bcs, equations=[uem.periodic(*ends)])
    found = uem.modes(problem, 5, mass=uem.consistent_mass(V, RHO)).frequencies
    k = np.array([1, 1, 2, 2]) * np.pi
    assert abs(found[0]) <= 1e-5 * found[1]
    assert np.allclose(found[1:], discrete(k / 4, 0.25), rtol=1e-8)


@pytest.mark.parametrize("how", [{"friction": 10.0, "sliding": "fixed"}, {"tied": True, "coupling": "mortar"}])
def test_pieces_that_stick(how):
    """Two blocks that are pressed together and stick, or are tied, have the frequencies of one piece."""
    b = blocks(COMM, "quadrilateral", 3, 3)
    contact = uem.Contact(b.high, b.low, **how)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0), *clamp(b.V, b.top, 1, value=-0.01)]
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, E, E)), b.u, bcs=bcs, contacts=[contact])
    mass = uem.consistent_mass(b.V, RHO)
    run(problem)
    assert contact.n_active == 4
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, -1.0], [1.0, 1.0], [3, 6])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    held = [*clamp(V, s.tag("bottom", 0, at(1, -1.0))), *clamp(V, s.tag("top", 0, at(1, 1.0)))]
    whole = uem.modes(uem.UnitedProblem(linear(u, E), u, bcs=held), 4, mass=uem.consistent_mass(V, RHO))
    assert np.allclose(uem.modes(problem, 4, mass=mass).frequencies, whole.frequencies, rtol=1e-9)


def test_in_dynamics():
    """Frequencies are those of statics, whatever step was taken, and the next step is what it would have been."""
    ends = []
    for ask in (True, False):
        s, V, u, bcs = column(2)
        dynamics = uem.Dynamics(
            uem.consistent_mass(V, RHO),
            velocity=(0.0, 0.01),
            damping=lambda v, V=V: 0.1 * ufl.dot(v, ufl.TestFunction(V)) * ufl.dx,
        )
        foot = clamp(V, s.tag("foot", 0, at(1, -1.0)), 1)
        problem = uem.UnitedProblem(linear(u, E, 0.0), u, bcs=[*bcs, *foot], dynamics=dynamics)
        for _ in uem.time_steps(problem, 0.05, 0.1):
            if ask:
                assert uem.modes(problem, 1).frequencies[0] == pytest.approx(discrete(np.pi / 8, 0.5), rel=1e-9)
        ends.append(np.array(u.x.array))
    continues_alike(*ends)


def test_refused(monkeypatch):
    s, V, u, bcs = column(2)
    problem = uem.UnitedProblem(linear(u, E, 0.0), u, bcs=bcs)
    mass = uem.consistent_mass(V, RHO)
    for error, words, call in (
        (uem.InputTypeError, "problem", lambda: uem.modes(u)),
        (uem.InputError, "give mass", lambda: uem.modes(problem)),
        (uem.InputTypeError, "mass = 3", lambda: uem.modes(problem, mass=3)),
        (uem.InputError, "n = 0", lambda: uem.modes(problem, 0, mass=mass)),
        (uem.InputError, "no more than 10 modes", lambda: uem.modes(problem, 11, mass=mass)),
    ):
        refused(error, words, call)
    monkeypatch.setitem(sys.modules, "slepc4py", None)
    refused(uem.MissingBackendError, "install python3-slepc4py-real", lambda: uem.modes(problem, mass=mass))


def of_ring(part, where=None):
    """All, or a quarter, of a ring in 12 or 3 cells around, of which a part may be shrunk onto a rigid disc, and its mass."""
    s = of_quarters(COMM, part, 3)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    # stiffer where each sector has its first cells
    x = ufl.SpatialCoordinate(s.mesh)
    stiff = E * (1.0 + 0.5 * (x[0] ** 2 - x[1] ** 2) ** 2 / ufl.dot(x, x) ** 2)
    F, equations = uem.LinearElastic(stiff, 0.3, kind="plane_strain").residual(u, v) * ufl.dx, []
    if part == 1:
        equations = [
            uem.periodic(s.tag("second", 0, at(1, 0.5 * np.pi)), s.tag("first", 0, at(1, 0.0)), turn=[[0.0, -1.0], [1.0, 0.0]])
        ]
    disc = uem.RigidSphere((0.0, 0.0), 1.01)
    contacts = [] if where is None else [uem.Contact(s.tag("inner", 0, where), disc)]
    problem = uem.UnitedProblem(F, u, equations=equations, contacts=contacts)
    return problem, uem.consistent_mass(V, RHO)


def middles(x):
    """The inner side of the second cell of each quarter."""
    angle = np.mod(x[:, 1], 0.5 * np.pi) * 6 / np.pi
    return np.isclose(x[:, 0], 1.0) & (angle > 0.9) & (angle < 2.1)


@pytest.mark.parametrize("where", [None, middles])
def test_nodal_diameters_are_the_modes_of_the_ring(where):
    """Frequencies of the whole ring, with contact too, are those of its sector for 0, 1 and 2 diameters, of which 1 has each twice."""
    problem, mass = of_ring(4, where)
    if where is not None:
        run(problem)
        assert problem.contacts[0].n_active == 8
    whole = uem.modes(problem, 16, mass=mass)
    sector, own = of_ring(1, where)
    if where is not None:
        run(sector)
    found = {k: uem.modes(sector, 8, mass=own, diameter=k) for k in (0, 1, 2)}
    pairs = found[1].eigenvalues
    size = whole.eigenvalues[-1]
    assert pairs[::2] == pytest.approx(pairs[1::2], abs=1e-8 * size)
    each = np.sort(np.concatenate([one.eigenvalues for one in found.values()]))
    assert each[:16] == pytest.approx(whole.eigenvalues, abs=1e-8 * size)


def test_what_has_no_nodal_diameters():
    """Rings without a cut, more diameters than half of the sectors, and contacts at the cut."""
    (problem, mass), (sector, own) = of_ring(4), of_ring(1)
    refused(uem.InputError, "expected 0 to 2", lambda: uem.modes(sector, 2, mass=own, diameter=3))
    refused(uem.InputError, "a sector of a ring", lambda: uem.modes(problem, 2, mass=mass, diameter=1))
    refused(uem.InputError, "diameter = -1", lambda: uem.modes(sector, 2, mass=own, diameter=-1))
    pressed, own = of_ring(1, at(0, 1.0))
    run(pressed)
    refused(uem.InputError, "contacts act at nodes of the cut", lambda: uem.modes(pressed, 2, mass=own, diameter=1))
