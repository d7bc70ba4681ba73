"""Arguments of materials, dynamics, writers and helpers of scripts are checked as ``test_inputs`` does for problems."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import blocks, clamp, linear, refused

import uem_dolfinx as uem
from uem_dolfinx.parallel import agreed

COMM = MPI.COMM_WORLD
nan, inf = np.nan, np.inf


def steel(b, **parameters):
    given = {"E": 1.0, "nu": 0.3, "yield_stress": 0.01, "hardening": 0.0, "kind": "plane_strain"} | parameters
    return uem.VonMises(given.pop("u", b.u), **given)


@pytest.mark.parametrize(
    "parameters, error, words",
    [
        *(({"E": x}, uem.InputError, (f"E = {x}", "a positive number")) for x in (0, -1, inf, nan)),
        *(({"nu": x}, uem.InputError, (f"nu = {x}", "between -1 and 0.5", "0.4999")) for x in (0.5, 0.7, -1, nan)),
        ({"nu": 1.0, "kind": "plane_stress"}, uem.InputError, ("nu = 1.0", "between -1 and 1")),
        *(({"yield_stress": x}, uem.InputError, (f"yield_stress = {x}", "a positive number, or infinity")) for x in (0, -1, nan)),
        *(({"hardening": x}, uem.InputError, (f"hardening = {x}", "0 or a positive number")) for x in (-1, inf, nan)),
        ({"E": "steel"}, uem.InputTypeError, ("E = 'steel'", "a positive number")),
        ({"u": None}, uem.InputTypeError, ("u = None", "a Function")),
        ({"strain": "large"}, uem.InputError, ("strain = 'large'", "'small' or 'green_lagrange'")),
        ({"kind": "3d"}, uem.InputError, ("kind = '3d'", "2 components", "'plane_strain', 'plane_stress' or 'axisymmetric'")),
        ({"quadrature_degree": 2.5}, uem.InputError, ("quadrature_degree = 2.5", "a whole number")),
    ],
)
def test_plasticity(parameters, error, words):
    b = blocks(COMM, "triangle", 2, 2)
    refused(error, words, lambda: steel(b, **parameters))


@pytest.mark.parametrize(
    "options, error, words",
    [
        ({"mass": 1.0}, uem.InputTypeError, ("mass = 1.0", "a Mass", "uem.lumped_mass")),
        ({"scheme": "newmark"}, uem.InputTypeError, ("scheme = 'newmark'", "a Scheme")),
        ({"damping": 0.1}, uem.InputTypeError, ("damping = 0.1", "a function of the velocity")),
        ({"damping": ufl.Form([])}, uem.InputTypeError, ("damping = ", "a function of the velocity", "as lambda rate")),
        ({"contactors": "light"}, uem.InputError, ("contactors = 'light'", "'massless' or 'massy'")),
        ({"time": nan}, uem.InputError, ("time = nan", "a finite number")),
        ({"time": "now"}, uem.InputTypeError, ("time = 'now'", "a finite number")),
        ({"gravity": 9.81}, uem.InputError, ("gravity = 9.81", "2 finite numbers")),
        ({"gravity": (0.0, nan)}, uem.InputError, ("gravity = (0.0, nan)", "2 finite numbers")),
        ({"velocity": 1.0}, uem.InputTypeError, ("velocity = 1.0", "2 numbers")),
        ({"damping": lambda v: broken()}, uem.UserFunctionError, ("damping raised KeyError", "mend the function")),
        ({"damping": lambda v: v}, uem.InputTypeError, ("the damping form = ", "a UFL form", "ufl.dx")),
    ],
)
def test_dynamics(options, error, words):
    b = blocks(COMM, "triangle", 2, 2)

    def make():
        dynamics = uem.Dynamics(**({"mass": uem.lumped_mass(b.V, 1.0)} | options))
        uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), dynamics=dynamics)

    refused(error, words, make)


def test_damping_without_velocity():
    """A damping that does not depend on the velocity is a load, or nothing."""
    b = blocks(COMM, "triangle", 2, 2)
    v = ufl.TestFunction(b.V)
    for form in (v[0] * ufl.dx, ufl.inner(b.u, v) * ufl.dx):
        dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), damping=lambda rate, form=form: form)
        words = ("damping(v) does not depend on the velocity", "other forces into F")
        refused(uem.InputError, words, lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, dynamics=dynamics))  # noqa: B023


def broken():
    raise KeyError("no damping")


@pytest.mark.parametrize("rho", [-0.1, 1.1, nan, "high"])
def test_schemes(rho):
    error = uem.InputTypeError if rho == "high" else uem.InputError
    refused(error, (f"rho_inf = {rho!r}", "from 0 to 1"), lambda: uem.generalised_alpha(rho))
    refused(uem.InputError, ("beta = nan", "a finite number"), lambda: uem.newmark(nan))


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda p: uem.ResultsWriter(None, p), uem.InputTypeError, ("path = None", "the path of a file")),
        (lambda p: uem.ResultsWriter("", p), uem.InputError, ("path = ''", "the path of a file")),
        (lambda p: uem.ResultsWriter("out", None), uem.InputTypeError, ("problem = None", "a UnitedProblem")),
        (lambda p: uem.ResultsWriter("out", p, fields=p.u), uem.InputTypeError, ("fields = a Function", "by name")),
        (lambda p: uem.ResultsWriter("out", p, fields={"s": 1.0}), uem.InputTypeError, ("fields['s'] = 1.0", "a UFL expression")),
        (lambda p: uem.ResultsWriter("out", p, fields={"a b": p.u}), uem.InputError, ("'a b'", "without blanks")),
        (lambda p: uem.HistoryWriter(3, p), uem.InputTypeError, ("path = 3", "the path of a file")),
        (lambda p: uem.HistoryWriter("out", p, resume="no"), uem.InputTypeError, ("resume = 'no'", "True or False")),
        (lambda p: uem.ResultsWriter("out", p, resume=1), uem.InputTypeError, ("resume = 1", "True or False")),
        (lambda p: uem.EnergyBook(p, resume=None), uem.InputTypeError, ("resume = None", "True or False")),
        (lambda p: uem.EnergyBook(None), uem.InputTypeError, ("problem = None", "a UnitedProblem")),
        (lambda p: uem.EnergyBook(p, p.u[0]), uem.InputTypeError, ("stored = ", "a UFL form", "ufl.dx")),
        (lambda p: uem.EnergyBook(p, linear(p.u, 1.0)), uem.InputError, ("stored has 1 argument(s)", "without test function")),
        (lambda p: uem.EnergyBook(p, external=p.u[0] * ufl.dx), uem.InputError, ("external is a functional", "linear in one")),
        (lambda p: uem.Checkpoint("run.uem", every=0), uem.InputError, ("every = 0", "a whole number")),
        (lambda p: uem.integrate(p.u[0]), uem.InputTypeError, ("integrals = ", "ufl.dx")),
        (lambda p: uem.integrate(linear(p.u, 1.0)), uem.InputError, ("1 argument(s)", "a functional")),
        (lambda p: uem.dirichlet(p.u, None), uem.InputTypeError, ("V = a Function", "u.function_space")),
        (lambda p: uem.dirichlet(p.config.V, [0], "x"), uem.InputError, ("component = 'x'", "one of 0 to 1")),
        (lambda p: uem.dirichlet(p.config.V, [0], 0, "fast"), uem.InputTypeError, ("= 'fast'", "a number")),
        (lambda p: uem.dirichlet(p.config.V, [0], 0, inf), uem.InputError, ("= inf", "finite numbers")),
        (lambda p: p.contacts[0].resultant(on="tool"), uem.InputError, ("on = 'tool'", "'contactor' or 'target'")),
        (lambda p: p.contacts[0].resultant(about=0.0), uem.InputError, ("about = 0.0", "2 finite numbers")),
    ],
)  # fmt: skip
def test_writers_and_scripts(call, error, words):
    problem = Bar(4).problem
    refused(error, words, lambda: call(problem))


def moving(**options):
    """A problem in time with these options of its dynamics."""
    b = blocks(COMM, "triangle", 2, 2)
    return uem.UnitedProblem(linear(b.u, 1.0), b.u, dynamics=uem.Dynamics(uem.lumped_mass(b.V, 1.0), **options))


def fails(x):
    """A function of the user's that is wrong on the last rank alone."""
    if COMM.rank == COMM.size - 1:
        raise KeyError("no such place")
    return np.ones(len(x))


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda p: uem.lumped_mass(p.u, 1), uem.InputTypeError, ("V = a Function", "a function space", "u.function_space")),
        (lambda p: uem.consistent_mass(None, 1), uem.InputTypeError, ("V = None", "a function space")),
        (lambda p: uem.lumped_mass(p.config.V.sub(0), 1), uem.SpaceError, ("V is a part", "a whole one")),
        (lambda p: uem.lumped_mass(p.config.V, ufl.TestFunction(p.config.V)[0]), uem.MassError, ("a test or trial function",)),
        (lambda p: uem.nodal_mass(p.config.V, "a"), uem.MassError, ("nodal masses = 'a'", "numbers")),
        (lambda p: uem.nodal_mass(p.config.V, fails), uem.UserFunctionError, ("function of nodal masses raised KeyError",)),
        (lambda p: moving(velocity=("a", "b")), uem.InputTypeError, ("velocity = ('a', 'b')", "2 finite numbers")),
        (lambda p: moving(velocity=(0.0, nan)), uem.InputError, ("velocity = (0.0, nan)", "2 finite numbers")),
        (lambda p: moving(velocity=lambda x: x), uem.InputTypeError, ("velocity = a function", "2 numbers", "interpolate")),
        (lambda p: moving(gravity="down"), uem.InputTypeError, ("gravity = 'down'", "2 finite numbers")),
        (lambda p: moving(damping=lambda v: fails([])), uem.UEMError, ("damping",)),
        (lambda p: uem.Scheme(0.25, 0.5, alpha_f=1), uem.InputError, ("alpha_f = 1", "alpha_m <= alpha_f <= 1/2")),
        (lambda p: uem.Scheme(0.25, 0.5, alpha_m=1), uem.InputError, ("alpha_m = 1", "alpha_m <= alpha_f <= 1/2")),
        (lambda p: uem.time_steps(p, 1e-300, 1e-299), uem.InputError, ("dt = 1e-300", "other units")),
        (lambda p: uem.time_steps(p, 1e-300, 1.0), uem.InputError, ("dt = 1e-300",)),
        (lambda p: uem.time_steps(p, 1e200, 1e201), uem.InputError, ("dt = 1e+200", "other units")),
        (lambda p: uem.time_steps(None, 0.1, 1.0), uem.InputTypeError, ("problem = None", "a UnitedProblem")),
        (lambda p: uem.load_steps(p.u), uem.InputTypeError, ("problem = a Function", "a UnitedProblem")),
        (lambda p: uem.load_steps(p, checkpoint="run"), uem.InputTypeError, ("checkpoint = 'run'", "a Checkpoint")),
        (lambda p: uem.write_checkpoint(3, p.state()), uem.InputTypeError, ("path = 3", "the path of a file")),
        (lambda p: uem.write_checkpoint("", p.state()), uem.InputError, ("path = ''", "the path of a file")),
        (lambda p: uem.read_checkpoint(None, p.state()), uem.InputTypeError, ("path = None", "the path of a file")),
        (lambda p: uem.write_checkpoint("run", p), uem.InputTypeError, ("UnitedProblem: expected a State", "problem.state()")),
        (lambda p: uem.Checkpoint("run").begin(p), uem.InputTypeError, ("UnitedProblem: expected a State", "problem.state()")),
        (lambda p: uem.Checkpoint(3), uem.InputTypeError, ("path = 3", "the path of a file")),
        (lambda p: uem.interpolate(p.u, 3), uem.InputError, ("the shape ()", "expected (2,)")),
        (lambda p: uem.interpolate(p.u, p.u[0]), uem.InputError, ("the shape ()", "expected (2,)")),
        (lambda p: uem.interpolate(p.u, lambda x: x), uem.InputTypeError, ("expression = a function", "u.interpolate")),
        (lambda p: uem.interpolate(3, p.u), uem.InputTypeError, ("u = 3", "a Function")),
        (lambda p: uem.interpolate(p.u, ufl.TestFunction(p.config.V)), uem.InputError, ("a test or trial function",)),
        (lambda p: uem.read_gmsh("a.geo", None), uem.InputTypeError, ("comm = None", "MPI.COMM_WORLD")),
        (lambda p: uem.read_gmsh("a.geo", COMM, parameters={"h": "a"}), uem.InputTypeError, ("parameters['h'] = 'a'", "a finite")),
        (lambda p: uem.read_gmsh("a.geo", COMM, parameters=[1]), uem.InputTypeError, ("parameters = [1]", "by name")),
        (lambda p: uem.dirichlet(p.config.V.sub(0), [0]), uem.SpaceError, ("whole Lagrange space", "a component")),
        (lambda p: uem.ds([0], 3), uem.InputTypeError, ("mesh = 3", "a mesh")),
        (lambda p: uem.function_space(None, 1), uem.InputError, ("domain = None", "a mesh")),
        (lambda p: uem.function_space(p.config.mesh, ("Foo", 1)), uem.InputError, ("element = ('Foo', 1)", "a family and a degree")),
        (lambda p: uem.function_space(p.config.mesh, 1, 2), uem.InputError, ("shape = 2", "(2,)")),
        (lambda p: p.solve(start="a"), uem.InputTypeError, ("start = 'a'", "finite numbers")),
        (lambda p: p.solve(start=np.zeros(1)), uem.InputError, ("start = ", "shape (1,)")),
        (lambda p: p.solve(fraction="a"), uem.InputTypeError, ("fraction = 'a'", "a number from 0 to 1")),
        (lambda p: p.solve(fraction=1.1), uem.InputError, ("fraction = 1.1", "a number from 0 to 1")),
        (lambda p: p.solve(fraction=-1), uem.InputError, ("fraction = -1", "a number from 0 to 1")),
        (lambda p: uem.LinearElastic(p.u, 0.3), uem.InputTypeError, ("E = a Function", "a scalar")),
        (lambda p: uem.LinearElastic(1.0, 0.3, "plane_strain").energy(3), uem.InputTypeError, ("u = 3", "a displacement")),
    ],
)  # fmt: skip
def test_near_by(call, error, words):
    problem = Bar(4).problem
    if error is uem.UEMError:
        error = uem.UserFunctionError
    refused(error, words, lambda: call(problem))


def mixed_space(mesh):
    """A displacement and a scalar of degree 1."""
    try:
        from basix.ufl import element, mixed_element
    except ImportError:
        parts = ufl.VectorElement("Lagrange", mesh.ufl_cell(), 1), ufl.FiniteElement("Lagrange", mesh.ufl_cell(), 1)
        return fem.FunctionSpace(mesh, ufl.MixedElement(*parts))
    return fem.functionspace(mesh, mixed_element([element("Lagrange", "triangle", 1, shape=shape) for shape in ((2,), ())]))


def test_a_part_of_a_mixed_space():
    b = blocks(COMM, "triangle", 2, 2)
    W = mixed_space(b.scene.mesh)
    refused(uem.SpaceError, ("no Lagrange space", "mixed"), lambda: uem.dirichlet(W, b.bottom))
    refused(uem.InputError, "a value of the shape (3,)", lambda: uem.dirichlet(W.sub(0), b.bottom, None, np.ones(3)))
    refused(uem.InputError, "one of 0 to 0", lambda: uem.dirichlet(W.sub(0).sub(1), b.bottom, 1))
    other = fem.Function(uem.function_space(b.scene.mesh, ("Lagrange", 2, (2,))))
    refused(uem.SpaceError, "a vector Lagrange space of degree 1", lambda: uem.dirichlet(W.sub(0), b.bottom, None, other))
    refused(uem.SpaceError, ("V is a part",), lambda: uem.lumped_mass(W.sub(0), 1.0))


@pytest.mark.parametrize("name", ["my u", "Δ u/2", "a-b"])
def test_functions_of_any_name(name):
    """Form compilers take names over into their code, where a blank is an error of the C compiler."""
    b = blocks(COMM, "triangle", 2, 2)
    b.u.name = name
    E = fem.Function(uem.function_space(b.scene.mesh, ("DG", 0)), name=f"{name} of steel")
    E.x.array[:] = 1.0 + len(name)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    problem.solve()
    assert (b.u.name, E.name) == (name, f"{name} of steel") and contact.n_active == 3
    uem.interpolate(E, b.u[0] * len(name))


def test_agreed_blocks():
    """The error of the first rank that has one, with its class, or its words where it cannot be sent."""

    class LocalError(Exception):
        pass

    with agreed(COMM):
        pass
    for kind in (uem.InputError, LocalError, SystemExit, KeyboardInterrupt):
        with pytest.raises(BaseException, match=f"from rank {COMM.size // 2}") as caught, agreed(COMM):
            if COMM.rank >= COMM.size // 2:
                raise kind(f"from rank {COMM.rank}")
        assert len(set(COMM.allgather(type(caught.value).__name__))) == 1


@pytest.mark.parametrize("make", ["constant", "product", "in a list"])
def test_expressions_in_place_of_numbers(make):
    """Constants and expressions of UFL where numbers or functions are expected are refused: their conversion never ends."""
    b = blocks(COMM, "triangle", 2, 2)
    mesh, (x, y), plane = b.scene.mesh, (0.0, 1.0), uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    c = fem.Constant(mesh, 0.5)
    one = {"constant": c, "product": 2.0 * c, "in a list": c}[make]
    scalars = [
        lambda: uem.Contact(b.high, plane, offset=one),
        lambda: uem.Contact(b.high, plane, friction=one),
        lambda: uem.Contact(b.high, plane, friction=0.1, wear=one),
        lambda: uem.Preload(b.high, b.low, force=one),
        lambda: uem.PointSpring((x, y), one),
        lambda: uem.RigidCoupling(b.top, (x, y), inertia=one),
        lambda: uem.RigidCoupling(b.top, (x, y), mass=one),
        lambda: uem.Step("a", loads={fem.Constant(mesh, 0.0): one}),
        lambda: uem.Newton(rtol=one),
        lambda: uem.ViscousFriction(one),
        *(
            lambda law=law: uem.Contact(b.high, plane, friction=law)
            for law in (uem.Coulomb(one), uem.Tresca(one), uem.Thirion(one, 1.0), uem.Stribeck(one, 0.1))
        ),
        lambda: uem.Step("a", friction={uem.Contact(b.high, plane, friction=0.1): uem.Tresca(one)}),
        lambda: uem.OfTemperature(one, field=0),
        lambda: uem.Contact(b.high, plane, coupling=one),
        lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, method=one),
        lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), load={fem.Constant(mesh, 0.0): one}),
    ]
    # Constants may be values of these
    if make == "product":
        scalars += [
            lambda: uem.Equation([((x, y), (0, 1))], b=one),
            lambda: uem.RigidCoupling(b.top, (x, y), moment=one),
            lambda: uem.SoftContact(one),
        ]
    vectors = [
        lambda: uem.RigidPlane((one, 0.0), (0.0, 1.0)),
        lambda: plane.move((0.0, one)),
        lambda: uem.PointLoad((x, y), (one, 0.0)),
        lambda: uem.Equation([((x, y), (0, one))]),
        lambda: uem.RigidCoupling(b.top, (x, y), force=(one, 0.0)),
        lambda: uem.periodic(b.high, b.low, jump=(one, 0.0)),
    ]
    for call in vectors if make == "in a list" else scalars:
        refused(uem.InputTypeError, "expected", call)


SYMBOLS = {
    "a factor": lambda x, c: c * x[0],
    "a factor behind": lambda x, c: x[0] * c,
    "in a sum": lambda x, c: np.sin(x[0]) + c,
    "an argument": lambda x, c: np.where(x[0] > 0.5, c, 0.0),
    "in a list": lambda x, c: np.stack([x[0], [c] * x.shape[1]])[1],
    "in place": lambda x, c: x[0].__imul__(c),
}


@pytest.mark.parametrize("how", SYMBOLS)
def test_functions_that_mix_arrays_and_expressions(how):
    """A Constant times an array never ended, within NumPy: an error with the line of the script."""
    b = blocks(COMM, "triangle", 2, 2)
    f, c = SYMBOLS[how], fem.Constant(b.scene.mesh, 0.5)

    def solve(value, **more):
        bcs = [*clamp(b.V, b.bottom), *([] if value is None else [uem.dirichlet(b.V, b.top, 1, value)])]
        uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, **more).solve()

    line = ("Constant", "test_inputs_beside.py, line")
    refused(uem.UserFunctionError, line, lambda: solve(lambda x: f(x, c)))
    refused(uem.UserFunctionError, line, lambda: solve(lambda x, s: s * f(x, c)))
    plane = uem.RigidPlane((0.0, 2.0), (0.0, -1.0))
    refused(uem.UserFunctionError, line, lambda: solve(None, contacts=[uem.Contact(b.top, plane, friction=lambda x: f(x, c))]))
    # numbers in its place, and in-place work on the places, change nothing
    solve(lambda x: f(x, float(c.value)))


def test_a_list_of_expressions_as_value():
    """Components of a Dirichlet value may be numbers and expressions."""
    b = blocks(COMM, "triangle", 2, 2)
    c = fem.Constant(b.scene.mesh, 0.01)
    bcs = [
        *clamp(b.V, b.bottom),
        uem.dirichlet(b.V, b.top, None, (2.0 * c, -0.01)),
        uem.dirichlet(b.V, b.high, None, (c, c * 0.0)),
    ]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*bcs, uem.dirichlet(b.V, b.low, None, (c, 0.0))])
    problem.solve()
    for tag, value in ((b.top, (0.02, -0.01)), (b.high, (0.01, 0.0))):
        w = fem.Function(b.V)
        w.interpolate(lambda p: np.outer(value, np.ones(p.shape[1])))
        assert uem.integrate(ufl.inner(b.u - w, b.u - w) * uem.ds(tag)) <= 1e-25
