"""A displacement among other fields: which unknowns it has, what contact makes of it, and what other fields have no part in."""

import re
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields, neo_hooke_with_pressure, strain, stress, with_pressure
from helpers import blocks, gathered_matrix, highest, linear, modulus, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.geometry.fields import ConfigurationAmongFields

COMM = MPI.COMM_WORLD


def conducting(f, E, alpha=0.0, k=1.0):
    """Hooke's law with thermal strains, and conduction of heat."""
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    g = f.b.gdim
    thermal = stress(u, E) - alpha * E / (1 - 2 * 0.3) * T * ufl.Identity(g)
    return ufl.inner(thermal, strain(v)) * ufl.dx + k * ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx


@pytest.mark.parametrize("displacement", [0, 1])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_rows_of_the_displacement_and_of_other_fields(cell, displacement):
    """Nodes come first, where they are those of a space of the displacement; K is DOLFINx's matrix in another order."""
    b = blocks(COMM, cell, 2, 3, gap=0.5)
    g = b.gdim
    f = fields(b, 2, 1, displacement=displacement)
    config = ConfigurationAmongFields(f.w, displacement)
    rows, n = config.unknowns, f.w.function_space.dofmap.index_map.size_local
    # x, and what the other field is, at their unknowns
    known = fem.Function(uem.function_space(b.scene.mesh, 2, (g,)))
    known.interpolate(lambda x: x[:g])
    f.w.sub(displacement).interpolate(lambda x: x[:g])
    f.w.sub(1 - displacement).interpolate(lambda x: 7.0 + x[0])
    f.w.x.scatter_forward()
    assert np.abs(config.displacement - config.X).max(initial=0.0) == 0.0
    assert np.abs(known.x.array.reshape(-1, g) - config.X).max(initial=0.0) < 1e-15
    assert (config.dofs[: config.n_owned] < n).all() and (config.dofs[config.n_owned :] >= n).all()
    values = f.w.x.array[:n]
    assert (config.from_rows(config.rows(values).ravel()) == values).all()
    others = config.rows(values)[config.n_owned :].ravel()
    assert (others[rows.field[g * config.n_owned :] == 1] >= 7.0).all() and (
        others[rows.field[g * config.n_owned :] == -1] == 0.0
    ).all()
    # to owners and back by numbers of rows
    there = config.to_global(np.arange(config.n_local))
    own = np.column_stack([config.X[: config.n_owned]])
    assert (config.ask_owners(there, own) == config.X).all()
    a = forms.form(ufl.derivative(conducting(f, 1.0, 0.1), f.w))
    K, A = rows.create_matrix(a), forms.create_matrix(a)
    forms.assemble_matrix(K, a)
    forms.assemble_matrix(A, a)
    order = np.concatenate(COMM.allgather(rows.numbers[:n]))
    assert np.abs(gathered_matrix(K)[np.ix_(order, order)] - gathered_matrix(A)).max() < 1e-15
    # all components of a node have the same columns
    starts, columns, _ = K.getValuesCSR()
    assert (np.diff(starts).reshape(-1, g) == np.diff(starts)[::g, None]).all() and (np.diff(starts) % g == 0).all()
    assert (columns.reshape(-1, g) // g == columns[::g, None] // g).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("coupling", "more", "degree"),
    [
        ("node_to_surface", {}, 1), ("node_to_surface", {"friction": 0.3}, 2), ("mortar", {}, 2), ("mortar", {"friction": 0.3}, 1),
        slow("node_to_surface", {}, 2), slow("node_to_surface", {"friction": 0.3}, 1), slow("mortar", {}, 1),
        slow("mortar", {"friction": 0.3}, 2), ("node_to_surface", {"tied": True}, 1), ("mortar", {"tied": True}, 1),
        ("node_to_surface", {"offset": 0.01, "wear": 1.0, "friction": 0.3}, 1),
    ],
)  # fmt: skip
def test_a_field_that_is_not_coupled_changes_nothing(coupling, more, degree):
    """Displacement, forces and iterations are those of the displacement alone, the other field of other units before or behind it."""
    b = blocks(COMM, "triangle", 3, 4, overhang=0.5, degree=degree)
    E = modulus(b.scene, 1.0, 3.0)

    def contact():
        return uem.Contact(b.high, b.low, coupling=coupling, sliding="finite" if degree == 2 else "small", **more)

    def pressed(V):
        return [
            uem.dirichlet(V, tag, c, value)
            for tag, way in ((b.bottom, (0, 0)), (b.top, (0.02, -0.05)))
            for c, value in enumerate(way)
        ]

    alone = contact()
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=pressed(b.V), contacts=[alone])
    steps = [s.newton_iterations for s in run(problem, 2)]
    for displacement in (0, 1):
        f, among = fields(b, degree, 1, displacement=displacement), contact()
        bcs = [*pressed(f.space), uem.dirichlet(f.other, b.bottom, value=300.0), uem.dirichlet(f.other, b.top, value=320.0)]
        F = conducting(f, E, k=1e7)
        other = uem.UnitedProblem(F, f.w, displacement=displacement, bcs=bcs, contacts=[among])
        assert [s.newton_iterations for s in run(other, 2)] == steps
        assert highest(COMM, np.abs(other.config.displacement - problem.config.displacement)) < 1e-12 * 0.05
        there, here = alone.resultant().force, among.resultant().force
        assert np.abs(there - here).max() < 1e-12 * np.abs(there).max()
        assert highest(COMM, np.abs(alone.pressures - among.pressures)) < 1e-12 * highest(COMM, alone.pressures)
        assert np.abs(problem.reaction(b.top) - other.reaction(b.top)).max() < 1e-12 * np.abs(there).max()


@pytest.mark.parametrize(
    ("cell", "n_high"), [("triangle", 3), ("triangle", 4), ("quadrilateral", 4), slow("tetrahedron", 3), slow("hexahedron", 3)]
)
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("nu", [slow(0.49999), 0.5])
def test_blocks_that_keep_their_volume(cell, n_high, coupling, nu):
    """Pressed with free sides, in plane strain or in space: the contact bears the load, the pressure is its part of it, exactly."""
    if coupling == "node_to_surface" and n_high == 4:
        pytest.skip("nodes pass the patch test on surfaces whose nodes meet")
    b = blocks(COMM, cell, 3 if cell != "hexahedron" else 2, n_high if cell != "hexahedron" else 2, degree=2)
    g, E, load = b.gdim, 2e6, 1e5
    f, c = fields(b, 2, 1), uem.Contact(b.high, b.low, coupling=coupling)
    t = fem.Constant(b.scene.mesh, 0.0)
    v = f.split(ufl.TestFunction(f.w.function_space))[0]
    F = with_pressure(f, E, nu) + t * v[g - 1] * uem.ds(b.top)
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=f.rollers(), contacts=[c], load={t: load})
    (step,) = run(problem)
    assert step.newton_iterations == 1
    assert highest(COMM, np.abs(c.pressures / load - 1.0)) < 1e-9
    # sigma_zz = nu sigma_yy in plane strain; the pressure that the form has is -lambda div u
    trace, lam = load * ((1 + nu) if g == 2 else 1.0), 3 * nu / (1 + nu)
    pressure = problem.config.functions()["field_1"].x.array
    assert highest(COMM, np.abs(pressure / (trace * lam / 3) - 1.0)) < 1e-9
    settlement = load / E * ((1 - nu**2) if g == 2 else 1.0)
    x, u = problem.config.X, problem.config.displacement
    assert highest(COMM, np.abs(u[:, -1] + settlement * (x[:, -1] + 1.0))) < 1e-9 * settlement
    # the matrix of a saddle has a negative eigenvalue for every pressure, and no more
    assert not problem.solver.indefinite and problem.solver.pc.getType() == "cholesky"


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_pressure_as_a_field_of_its_own(coupling):
    """At nu = 0.49 a clamped block presses as it does in displacements alone, but for the error of the mesh."""
    b = blocks(COMM, "triangle", 8, 6, degree=2, overhang=0.5)
    E, nu, found = 1.0, 0.49, []
    f = fields(b, 2, 1)
    for V, F, u, how in ((b.V, linear(b.u, E, nu), b.u, {}), (f.space, with_pressure(f, E, nu), f.w, {"displacement": 0})):
        bcs = [
            uem.dirichlet(V, tag, c, value)
            for tag, way in ((b.bottom, (0, 0)), (b.top, (0.0, -0.02)))
            for c, value in enumerate(way)
        ]
        c = uem.Contact(b.high, b.low, coupling=coupling)
        run(uem.UnitedProblem(F, u, bcs=bcs, contacts=[c], **how))
        found.append((c.resultant().force[1], c.pressures))
    (plain, pressures), (mixed, others) = found
    assert abs(mixed / plain - 1.0) < 0.01
    apart, size = (COMM.allreduce((p**2).sum()) for p in (pressures - others, pressures))
    assert np.sqrt(apart / size) < 0.05


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_heat_closes_a_gap(coupling, unit):
    """Confined blocks grow by ``alpha (1 + nu) / (1 - nu)`` of the mean temperature: the gap closes, and the rest is pressure."""
    b, gap = blocks(COMM, "triangle", 3, 3 if coupling == "node_to_surface" else 4, gap=0.02), 0.02
    E, nu, alpha = 2e5 / unit, 0.3, 1e-4 * unit
    f, c = fields(b, 2, 1), uem.Contact(b.high, b.low, coupling=coupling)
    heat = [
        uem.dirichlet(f.other, tag, value=value / unit)
        for tag, value in ((b.bottom, 200.0), (b.low, 120.0), (b.high, 120.0), (b.top, 40.0))
    ]
    bcs = [*f.confined(), uem.dirichlet(f.space, b.top, 1), *heat]
    problem = uem.UnitedProblem(conducting(f, E, alpha), f.w, displacement=0, bcs=bcs, contacts=[c])
    M, beta = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)), alpha * E / (1 - 2 * nu)
    mean = 120.0 / unit
    closing, pressed = gap / (2 * mean * beta / M), []
    for step in uem.load_steps(problem, 4):
        pressure = max(0.0, beta * mean * step.factor - M * gap / 2)
        assert highest(COMM, np.abs(c.pressures - pressure)) < 1e-10 * beta * mean
        pressed.append(pressure > 0.0)
        assert pressed[-1] == (step.factor > closing)
    assert not pressed[0] and pressed[-1]


@pytest.mark.long
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e6])
def test_a_field_that_changes_in_equilibrium(unit):
    """Free expansion at large displacements in steps of time: forces vanish in every step, and Newton's steps are full."""
    b = blocks(COMM, "quadrilateral", 2, 2)
    f = fields(b, 1, 1)
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    old, law, alpha = fem.Function(f.w.function_space), uem.StVenantKirchhoff(unit, 0.3, kind="plane_strain"), 1e-4
    F = (law.residual(u, v) - law.thermal_residual(u, v, alpha * T)) * ufl.dx
    F += ((T - f.split(old)[1]) / 0.1 * q + ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
    ends = [uem.dirichlet(f.other, b.top, value=800.0)]
    tie = uem.Contact(b.high, b.low, tied=True)
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=[*f.rollers(), *ends], contacts=[tie])
    for _ in range(4):
        history = problem.solve()
        assert len(history) <= 7 and min(one.step_length for one in history) == 1.0
        old.x.array[:] = f.w.x.array


def test_every_field_is_solved_beside_the_largest_forces():
    """Heat that depends on its temperature is in balance to the required accuracy, with forces 1e12 times as large."""
    b = blocks(COMM, "triangle", 3, 3)
    f = fields(b, 1, 1)
    (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    conduction = 1e-6 * (1.0 + T) ** 2
    F = ufl.inner(stress(u, 1e6), strain(v)) * ufl.dx + conduction * ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx
    heat = [
        uem.dirichlet(f.other, tag, value=value) for tag, value in ((b.bottom, 1.0), (b.low, 0.0), (b.high, 0.5), (b.top, 2.0))
    ]
    bcs = [*f.confined(), uem.dirichlet(f.space, b.top, 1, -0.1), *heat]
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=[uem.Contact(b.high, b.low)])
    run(problem)
    problem.bodies.assemble()
    rows, R = problem.bodies.unknowns, problem.bodies.residual
    every = rows.norms(R)
    R.array[:] *= problem.bodies.free_rows.ravel()
    assert every[0] > 1e9 * every[1] > 0.0
    assert rows.norms(R)[1] < 1e-8 * every[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "E", "contact"),
    [(neo_hooke_with_pressure, 2e11, True), (with_pressure, 1.0, True), (neo_hooke_with_pressure, 1.0, False)],
)
def test_unloaded_to_nothing(law, E, contact):
    """Without any force left, what remains in each field is rounding of what there has been in it, which ends the step."""
    b = blocks(COMM, "triangle", 2, 3)
    f, load = fields(b, 2, 1), fem.Constant(b.scene.mesh, 0.0)
    v = f.split(ufl.TestFunction(f.w.function_space))[0]
    F = law(f, E, 0.4999) + load * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    bcs = f.rollers() + ([] if contact else [uem.dirichlet(f.space, b.high, 1)])
    contacts = [uem.Contact(b.high, b.low)] if contact else []
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, contacts=contacts)
    for part in (0.5, 1.0, 0.0, 0.0):
        load.value = 0.02 * E * part
        iterations = problem.solve()
        if part == 1.0:
            pressed = [highest(COMM, np.abs(g.x.array)) for g in problem.config.functions().values()]
    assert len(iterations) <= 8
    left = [highest(COMM, np.abs(g.x.array)) for g in problem.config.functions().values()]
    assert pressed[0] > 0.01 and pressed[1] > 5e-3 * E
    assert left[0] <= 1e-14 and left[1] <= 1e-14 * E


@pytest.mark.long
def test_other_fields_do_not_hide_that_there_is_no_stiffness():
    """A body of negative modulus makes negative eigenvalues beyond those of its pressures."""
    b = blocks(COMM, "triangle", 2, 2, gap=0.5)
    for E, unstable in ((1.0, False), (-1.0, True)):
        f = fields(b, 2, 1)
        bcs = [uem.dirichlet(f.space, tag, c) for tag in (b.bottom, b.low, b.high, b.top) for c in (0, 1)]
        u, v = (f.split(part)[0] for part in (f.w, ufl.TestFunction(f.w.function_space)))
        F = with_pressure(f, abs(E), 0.5) + ((E - abs(E)) * ufl.inner(strain(u), strain(v)) + v[0]) * ufl.dx(domain=b.scene.mesh)
        problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs, check_inversion=False)
        problem.solve()
        assert problem.solver.indefinite == unstable


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_block_that_contact_alone_holds(coupling):
    """It falls, and comes to rest with its weight on the other, both of them with a pressure, a temperature and a vector in addition."""
    b = blocks(COMM, "triangle", 3, 3, gap=0.1)
    f = fields(b, 2, 1, 1, ("Lagrange", 1, (2,)), displacement=1)
    parts, tests = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    (u, p, T, m), (v, q, r, n) = parts, tests
    weight = fem.Constant(b.scene.mesh, 0.0)
    F = (ufl.inner(strain(u), strain(v)) - p * ufl.div(v) - q * (ufl.div(u) + 0.1 * p) + weight * v[1]) * ufl.dx
    F += (ufl.inner(T - 3.0, r) + ufl.inner(ufl.grad(m), ufl.grad(n)) + ufl.inner(m - ufl.as_vector((1.0, 2.0)), n)) * ufl.dx
    side = b.scene.tag("side", 1, lambda x: np.abs(x[:, 0]) < 1e-9)
    bcs = [*(uem.dirichlet(f.space, b.bottom, c) for c in (0, 1)), uem.dirichlet(f.space, side, 0)]
    c = uem.Contact(b.high, b.low, coupling=coupling)
    problem = uem.UnitedProblem(F, f.w, displacement=1, bcs=bcs, contacts=[c], load={weight: 1e-3})
    run(problem)
    assert c.resultant().force[1] == pytest.approx(1e-3, rel=1e-9)
    assert problem.reaction(b.bottom)[1] == pytest.approx(2e-3, rel=1e-9)
    found = problem.config.functions()
    assert list(found) == ["displacement", "field_0", "field_2", "field_3"]
    assert highest(COMM, np.abs(found["field_2"].x.array - 3.0)) < 1e-9
    assert highest(COMM, np.abs(found["field_3"].x.array.reshape(-1, 2) - [1.0, 2.0])) < 1e-9


def test_which_part_is_the_displacement():
    """What is none is refused, with the part that is one where there is one."""
    b = blocks(COMM, "triangle", 2, 2)
    f = fields(b, 1, 1)
    F = conducting(f, 1.0)
    for displacement, error, words in (
        (1, uem.SpaceError, ("displacement = 1", "1 component(s)", "displacement=0")),
        (2, uem.InputError, ("displacement = 2", "one of 0 to 1")),
        (-1, uem.InputError, ("displacement = -1", "one of 0 to 1")),
        ("u", uem.InputTypeError, ("displacement", "one of 0 to 1")),
        (True, uem.InputTypeError, ("displacement", "one of 0 to 1")),
        (None, uem.SpaceError, ("1 component(s)", "displacement=0")),
    ):
        refused(error, words, lambda d=displacement: uem.UnitedProblem(F, f.w, displacement=d))
    refused(uem.SpaceError, "leave displacement out", lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, displacement=0))
    cubic = fem.Function(uem.function_space(b.scene.mesh, [("Lagrange", 3, (2,)), 1]))
    refused(uem.SpaceError, "degree 3", lambda: uem.UnitedProblem(F, cubic, displacement=0))
    elsewhere = uem.dirichlet(b.V, b.bottom, 0)
    refused(uem.SpaceError, "bcs[0]", lambda: uem.UnitedProblem(F, f.w, displacement=0, bcs=[elsewhere]))
    value = fem.Constant(b.scene.mesh, 0.0)
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=[uem.dirichlet(f.other, b.bottom, value=value)])
    value.value = np.inf
    refused(uem.NotFiniteError, ("bcs[0]", "inf", "part 1 of the mixed space"), problem.solve)


def test_what_is_not_there_among_other_fields():
    """Each with what to do instead."""
    b = blocks(COMM, "triangle", 2, 2)
    f = fields(b, 1, 1)
    F = conducting(f, 1.0)
    bcs = [*f.confined(), uem.dirichlet(f.other, b.bottom), uem.dirichlet(f.other, b.top)]
    problem = uem.UnitedProblem(F, f.w, displacement=0, bcs=bcs)
    run(problem)

    def record():
        with uem.recording(problem):
            pass

    refused(uem.InputError, ("gradients of histories", "differences"), record)


def heated(mu=0.3):
    """A block that is pressed onto another, slides over it, and is heated, with a pressure of its own: problem and contact."""
    b = blocks(COMM, "triangle", 3, 3, overhang=0.5)
    f = fields(b, 2, 1, 1, displacement=1)
    (u, p, T), (v, q, r) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    F = (2.0 * ufl.inner(strain(u), strain(v)) - p * ufl.div(v) - q * (ufl.div(u) + 0.2 * p - 1e-2 * T)) * ufl.dx
    F += (ufl.inner((1.0 + T) * ufl.grad(T), ufl.grad(r)) - 0.5 * r) * ufl.dx
    ways = ((b.bottom, (0.0, 0.0)), (b.top, (0.03, -0.04)))
    bcs = [uem.dirichlet(f.space, tag, c, value) for tag, way in ways for c, value in enumerate(way)]
    bcs += [uem.dirichlet(f.w.function_space.sub(2), tag) for tag in (b.bottom, b.top)]
    c = uem.Contact(b.high, b.low, friction=mu, coupling="mortar")
    return uem.UnitedProblem(F, f.w, displacement=1, bcs=bcs, contacts=[c]), c


@pytest.mark.long
def test_going_on_from_a_checkpoint(folder):
    """The rest of the steps is what it would have been: to the last bit on one rank, but for MUMPS' order of messages on several."""
    problem, contact = heated()
    for step in uem.load_steps(problem, 3):
        if step.number == 1:
            uem.write_checkpoint(folder / "run.uem", problem.state())
    other, again = heated()
    uem.read_checkpoint(folder / "run.uem", other.state())
    assert len(list(uem.load_steps(other, 3))) == 2
    bits = 0.0 if COMM.size == 1 else 1e-12
    assert highest(COMM, np.abs(other.u.x.array - problem.u.x.array)) <= bits
    assert np.abs(contact.resultant().force - again.resultant().force).max() <= bits
    assert abs(again.dissipation - contact.dissipation) <= bits < contact.dissipation


@pytest.mark.long
def test_a_step_taken_again():
    """It comes to the same state, from that which the step began with."""
    problem, contact = heated()
    for _ in uem.load_steps(problem, 2):
        before, work = np.array(problem.u.x.array), contact.dissipation
        problem.solve()
        assert highest(COMM, np.abs(problem.u.x.array - before)) < 1e-12
        assert contact.dissipation == pytest.approx(work, rel=1e-9) and work > 0.0


def test_fields_in_results(folder):
    """Displacement and other fields are written at the nodes of the mesh, each under its own name."""
    problem, _ = heated()
    (step,) = uem.load_steps(problem, 1)
    with uem.ResultsWriter(folder / "run", problem) as writer:
        writer.write(step)
    text = (folder / "run.xdmf").read_text()
    for name in ("displacement", "field_0", "field_2", "contact_pressure"):
        assert f'Name="{name}"' in text
    for name, part in (("field_0", 0), ("field_2", 2)):
        there = problem.config.functions()[name]
        split = problem.u.sub(part).collapse()
        assert highest(COMM, np.abs(there.x.array - split.x.array)) == 0.0


def test_page_on_several_fields():
    """Its example has the pressures that it says."""
    page = (Path(__file__).parents[2] / "demos" / "site" / "howto" / "several_fields.md").read_text(encoding="utf-8")
    known = {}
    exec(compile(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[1], "several_fields.md", "exec"), known)
    reported = known["pressures"]
    assert len(reported) == 4 and reported[0][0] == 0.0 < reported[-1][0]
    for wanted, pressures in reported:
        assert highest(COMM, np.abs(pressures - wanted)) < 1e-9 * reported[-1][0]
