"""Load steps of given arc length, and several loads: an arch that snaps through under dead load and comes down on a floor.

The test to read first is ``test_arch_snaps_through``.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from helpers import raised
from restart_scenes import continues_alike
from resting_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx.solve.steps import arc_length
from uem_dolfinx.solve.steps.arc_length import ArcLength

L, RISE, E = 200.0, 2.0, 1000.0
k = 2 * np.pi / L


def shallow(a):
    """Load of a shallow clamped arch of thickness 1 whose middle is at a."""
    return E * k**4 * ((RISE - a) / 24 + a * (RISE**2 - a**2) / 32)


#: Of the cubic's maximum.
LIMIT = np.sqrt((RISE**2 / 32 - 1 / 24) * 32 / 3)


class Arch:
    """Half a clamped arch above a floor; ``more`` are arguments of the problem."""

    def __init__(self, load=None, full=2 * shallow(LIMIT), top=0.0, n=10, heated=False, **more):
        domain = mesh.create_rectangle(COMM, [(0.0, -0.5), (L / 2, 0.5)], [n, 1], mesh.CellType.quadrilateral)
        x = domain.geometry.x
        x[:, 1] += RISE / 2 * (1 + np.cos(k * x[:, 0]))
        V = uem.function_space(domain, [("Lagrange", 2, (2,)), 1] if heated else 2, () if heated else (2,))
        self.w, v = fem.Function(V), ufl.TestFunction(V)
        self.u = self.w
        if heated:
            (self.u, T), (v, r), V, more = ufl.split(self.w), ufl.split(v), V.sub(0), more | {"displacement": 0}
        self.q, self.p = fem.Constant(domain, 0.0), fem.Constant(domain, np.zeros(2))
        law, self.dx = uem.StVenantKirchhoff(E, 0.0, kind="plane_stress"), ufl.dx(metadata={"quadrature_degree": 6})
        shape = ufl.cos(k * ufl.SpatialCoordinate(domain)[0])
        F = law.residual(self.u, v) * self.dx + self.q * shape * v[1] * self.dx + ufl.inner(self.p, v) * shape * self.dx
        facets = [mesh.locate_entities_boundary(domain, 1, on) for on in (self.at(L / 2), self.at(0.0), self.below)]
        self.value = fem.Constant(domain, top)
        if heated:
            # it is 1e6 times as far from its beginning as the displacement, and is no part of the arc
            F += (ufl.inner(ufl.grad(T), ufl.grad(r)) - 1e3 * self.q * r + T * r) * ufl.dx
        bcs = [uem.dirichlet(V, facets[0], 1, self.value), uem.dirichlet(V, facets[0], 0), uem.dirichlet(V, facets[1], 0)]
        self.middle = uem.ds(facets[1], domain)
        self.floor = uem.Contact(facets[2], uem.RigidPlane((0.0, -2.0), (0.0, 1.0)))
        load = {self.q: full} if load is None else load(self)
        self.problem = uem.UnitedProblem(F, self.w, bcs=bcs, contacts=[self.floor], load=load, **more)

    @staticmethod
    def at(x):
        return lambda points: np.isclose(points[0], x)

    @staticmethod
    def below(x):
        return x[1] < RISE / 2 * (1 + np.cos(k * x[0])) - 0.4

    def height(self):
        return RISE + uem.integrate(self.u[1] * self.middle)

    def path(self, steps=10, **more):
        """Height, load and number of active contactors after each step."""
        return np.array(
            [
                (self.height(), float(self.q.value), self.floor.n_active)
                for _ in uem.load_steps(self.problem, steps, arc_length=True, **more)
            ]
        )


@pytest.mark.long
def test_a_step_that_fails_after_an_unstable_equilibrium_says_so():
    """The united matrix has a negative eigenvalue between the limit points, where the load falls, and at no stable equilibrium."""
    arch, h, reported = Arch(n=20), 1e-3, []

    def path():
        for _ in uem.load_steps(arch.problem, 20, arc_length=True):
            slope = (shallow(arch.height() - h) - shallow(arch.height() + h)) / (2 * h)
            if arch.floor.n_active == 0 and abs(slope) > 0.1 * shallow(LIMIT) / RISE:
                reported.append(arch.problem.solver.indefinite)
                assert reported[-1] == (slope < 0.0)
                if reported[-1]:
                    arch.problem.max_iterations = 1

    raised(uem.ConvergenceError, r"at the load factor 0\.\d+ the equilibrium was unstable.*take time steps", path)
    assert False in reported and True in reported


@pytest.mark.long
def test_arch_snaps_through():
    """Its load goes up to the limit, down, up again, and by the floor to its end: every state is in equilibrium under its load."""
    arch = Arch(rtol=1e-10, n=20)
    path, residuals = [], []
    for step in uem.load_steps(arch.problem, 10, arc_length=True):
        arch.problem.bodies.assemble()
        F = arch.problem.system.restriction().transpose(arch.problem.bodies.residual).norm()
        residuals.append(F / arch.problem.bodies.residual.norm())
        path.append((arch.height(), float(arch.q.value), arch.floor.n_active, step.factor))
    a, q, active, factor = np.array(path).T
    free = active == 0
    peak = int(q[free].argmax())
    valley = peak + int(q[free][peak:].argmin())
    assert 0 < peak < valley < free.sum() - 1 and active[-1] > 0
    assert np.abs(q - shallow(a))[free].max() < 0.012 * shallow(LIMIT)
    assert max(residuals) < 1e-9
    assert factor[-1] == 1.0 and q[-1] == 2 * shallow(LIMIT)
    np.testing.assert_allclose(factor, q / q[-1], rtol=1e-14)


def test_length_of_the_arc():
    """Every step except the first and the last is as long as the one before, along it; a state is closed only there."""
    arch, ends = Arch(), []
    for _ in uem.load_steps(arch.problem, 10, arc_length=True):
        ends.append(arch.problem.bodies.displacement())
        if len(ends) == 6:
            break
    ways = [b - a for a, b in zip(ends, ends[1:])]
    lengths = [after.dot(before) / before.norm() for before, after in zip(ways, ways[1:])]
    np.testing.assert_allclose(lengths, ends[0].norm(), rtol=1e-7)
    led = ArcLength(arch.problem)
    direction = ways[-1].array_r / ways[-1].norm()
    for part, closed in ((1 - 3e-9, True), (1 - 3e-8, False)):
        led.begin(0.5, direction, 1.0)
        bodies = arch.problem.bodies
        bodies.displace(bodies.displacement(), arch.problem.config.vector(part * direction), 1.0)
        assert (abs(led._missing) <= arc_length.ON_THE_PLANE) == closed


def test_same_answer_as_by_load():
    """Where there is no limit point, arc lengths end where load steps do."""
    one, other = Arch(full=0.8 * shallow(LIMIT)), Arch(full=0.8 * shallow(LIMIT))
    one.path(4)
    list(uem.load_steps(other.problem, 4))
    np.testing.assert_allclose(one.u.x.array, other.u.x.array, rtol=0, atol=1e-8 * np.abs(other.u.x.array).max())


@pytest.mark.slow
def test_other_fields_have_no_part_in_the_arc():
    """A field in large numbers, which the load drives as well, changes no step of the path, past the limit point and onto the floor."""
    paths = [Arch(heated=heated).path(5) for heated in (False, True)]
    np.testing.assert_allclose(*paths, rtol=1e-6, atol=1e-9)
    assert len(paths[0]) > 10 and paths[0][-1, 2] > 0


@pytest.mark.slow
def test_loads_that_are_not_proportional():
    """The derivative with respect to the factor is by differences, and the path that of the proportional load."""

    def squared(arch):
        return {arch.q: lambda s: shallow(LIMIT) * s**2}

    arch = Arch(squared)
    led = ArcLength(arch.problem)
    led.begin(0.5, np.zeros(arch.problem.bodies.displacement().local_size), 1.0)
    led.begin_step()
    arch.problem.bodies.assemble()
    led._differentiate()
    slope = arch.problem.bodies.residual.copy()
    led._set(0.0)
    arch.problem.bodies.assemble()
    # dF/ds = 2 s f, and F(0.5) - F(0) = f / 4
    slope = 4 * (slope - arch.problem.bodies.residual)
    error = (led._slope - slope).norm() / slope.norm()
    assert 2e-5 < error < 2e-4
    path = Arch(lambda arch: {arch.q: lambda s: 2 * shallow(LIMIT) * s**2}).path(4)
    free = path[:, 2] == 0
    # ten straight cells keep to the closed form of the curved one up to h^2
    assert np.abs(path[:, 1] - shallow(path[:, 0]))[free].max() < 0.05 * shallow(LIMIT)
    assert path[-1, 1] == 2 * shallow(LIMIT)


@pytest.mark.slow
def test_resumed_on_the_way(tmp_path_factory):
    """A run that is ended past the limit point continues from its checkpoint to the same last state."""
    folder = COMM.bcast(tmp_path_factory.mktemp("arc") if COMM.rank == 0 else None)
    whole, first, second = Arch(), Arch(), Arch()
    path = whole.path(5)
    stop = int(path[:, 1].argmax() if path[-1, 2] == 0 else path[path[:, 2] == 0, 1].argmax()) + 3
    steps = uem.load_steps(first.problem, 5, arc_length=True, checkpoint=uem.Checkpoint(folder / "arc.h5", every=1))
    for number, _ in enumerate(steps):
        if number == stop:
            steps.close()
            break
    rest = second.path(5, checkpoint=uem.Checkpoint(folder / "arc.h5", every=1))
    assert 0 < len(rest) <= len(path) - stop
    continues_alike(rest, path[len(path) - len(rest) :])
    continues_alike(second.u.x.array, whole.u.x.array)


def test_path_without_end(monkeypatch):
    """A path that does not lead to the full load is given up, by name."""
    monkeypatch.setattr(arc_length, "MOST_STEPS", 2)
    arch = Arch()
    raised(uem.ConvergenceError, "after 20 steps of the arc, and has not come to 1", lambda: arch.path(10))
    assert arch.problem.progress.control.number == 20


def test_what_cannot_be_led():
    """Dirichlet values that change, a load that does nothing, and a step that is no flag are refused by name."""
    raised(uem.InputError, "the Dirichlet values of y at .* are not those of the committed state", lambda: Arch(top=0.1).path())
    raised(uem.InputError, "needs a load that moves the bodies", lambda: Arch(lambda arch: lambda s: None).path())
    moved = Arch(lambda arch: lambda s: setattr(arch.value, "value", -0.1 * s))
    raised(uem.InputError, "expected values that do not change with the load factor", moved.path)
    raised(uem.InputTypeError, "arc_length = 1", lambda: next(uem.load_steps(Arch().problem, 2, arc_length=1)))


def test_several_loads():
    """Each Constant follows its own rule: in proportion, or as its function says."""
    seen = []
    arch = Arch(lambda a: {a.q: lambda s: 0.3 * shallow(LIMIT) * min(2 * s, 1.0), a.p: (0.0, 0.2 * shallow(LIMIT))})
    for _ in uem.load_steps(arch.problem, 4):
        seen.append((float(arch.q.value), *arch.p.value))
    wanted = [(0.3 * min(2 * s, 1.0) * shallow(LIMIT), 0.0, 0.2 * s * shallow(LIMIT)) for s in (0.25, 0.5, 0.75, 1.0)]
    np.testing.assert_allclose(seen, wanted, rtol=1e-14)
    together = Arch(full=0.5 * shallow(LIMIT))
    list(uem.load_steps(together.problem, 4))
    np.testing.assert_allclose(arch.u.x.array, together.u.x.array, rtol=0, atol=1e-7 * np.abs(together.u.x.array).max())


@pytest.mark.parametrize(
    "load, error, words",
    [
        (lambda a: {}, uem.InputTypeError, "load = {}"),
        (lambda a: {a.u: 1.0}, uem.InputTypeError, "a name in load"),
        (
            lambda a: {a.q: (1.0, 2.0)},
            uem.InputError,
            r"the value of a Constant in load = \(1.0, 2.0\): expected a finite number",
        ),
        (lambda a: {a.p: np.nan}, uem.InputError, r"finite numbers of the shape \(2,\)"),
        (lambda a: {a.q: "much"}, uem.InputTypeError, "the value of a Constant in load = 'much'"),
    ],
)
def test_loads_refused(load, error, words):
    raised(error, words, lambda: Arch(load))


def test_functions_of_loads_refused():
    arch = Arch(lambda a: {a.q: lambda s: [s, s]})
    raised(uem.InputError, "the value of a Constant in load", lambda: next(uem.load_steps(arch.problem)))
    arch = Arch(lambda a: {a.q: lambda s: 1 / 0})
    raised(
        uem.UserFunctionError, "the load of a Constant at 1 raised ZeroDivisionError", lambda: next(uem.load_steps(arch.problem))
    )


def test_steps_of_an_arc():
    """Past the limit point too: the load of the step, the branch of the step."""
    arch = Arch()
    for step in uem.load_steps(arch.problem, 6, arc_length=True):
        before, q = np.array(arch.u.x.array), float(arch.q.value)
        for _ in range(2):
            arch.problem.solve()
        assert float(arch.q.value) == q
        assert np.abs(arch.u.x.array - before).max(initial=0.0) <= 1e-5 * RISE
        if step.number == 8:
            break
