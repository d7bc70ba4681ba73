"""Whatever a user hands over is looked at: the same named error on all ranks, with the thing, its value, and what was expected.

Worth reading first: ``test_what_a_problem_refuses`` and ``test_functions_of_rigid_surfaces``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import blocks, clamp, linear, modulus, refused, run
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms, given

COMM = MPI.COMM_WORLD
LAST = COMM.rank == COMM.size - 1
several = pytest.mark.skipif(COMM.size == 1, reason="one rank")
nan, inf = np.nan, np.inf


def scene(**how):
    return blocks(COMM, "triangle", 2, 2, **how)


def constant(b, value):
    return fem.Constant(b.scene.mesh, PETSc.ScalarType(value))


def pressed(b, **options):
    """Block on block, the upper one pressed down."""
    F = linear(b.u, modulus(b.scene, 1.0, 1.0))
    options = {"F": F, "u": b.u, "bcs": b.oedometer(0.01), "contacts": [uem.Contact(b.high, b.low)]} | options
    return uem.UnitedProblem(options.pop("F"), options.pop("u"), **options)


# -- a problem ---------------------------------------------------------------------------------------------------------


def energy(b):
    return ufl.inner(ufl.grad(b.u), ufl.grad(b.u)) * ufl.dx


def bilinear(b):
    return ufl.inner(ufl.TrialFunction(b.V), ufl.TestFunction(b.V)) * ufl.dx


@pytest.mark.parametrize(
    "option, value, error, words",
    [
        ("F", energy, uem.InputError, ("F is a functional, without test function", "ufl.derivative")),
        ("F", lambda b: linear(b.u, 1.0).integrals()[0].integrand(), uem.InputTypeError, ("F = ", "a UFL form", "multiply it by ufl.dx")),
        ("F", lambda b: None, uem.InputTypeError, ("F = None", "a UFL form")),
        ("F", lambda b: linear(b.u, 1.0) - b.u[0] * ufl.dx, uem.InputError, ("F is not linear", "every term")),
        ("F", lambda b: ufl.sin(ufl.TestFunction(b.V)[0]) * ufl.dx + linear(b.u, 1.0), uem.InputError, ("F is not linear", "once")),
        ("F", bilinear, uem.InputError, ("2 arguments", "TrialFunction")),
        ("F", lambda b: linear(fem.Function(scene().V), 1.0), uem.SpaceError, ("F is integrated over another mesh",)),
        ("F", lambda b: linear(b.u, nan), uem.InputError, ("F holds the number nan", "finite")),
        ("u", lambda b: ufl.TrialFunction(b.V), uem.InputTypeError, ("u = an Argument", "a Function")),
        ("bcs", lambda b: b.oedometer(0.0)[0], uem.InputTypeError, ("bcs = ", "a list", "bcs=[...]")),
        ("bcs", lambda b: [*b.oedometer(0.0), None], uem.InputTypeError, ("] = None", "a Dirichlet condition")),
        ("bcs", lambda b: "bottom", uem.InputTypeError, ("bcs = 'bottom'", "a list")),
        ("contacts", lambda b: uem.Contact(b.high, b.low), uem.InputTypeError, ("contacts = a Contact", "a list", "contacts=[...]")),
        ("contacts", lambda b: [(b.high, b.low)], uem.InputTypeError, ("contacts[0] = ", "a Contact")),
        ("contacts", lambda b: [uem.Contact(b.high, b.low)] * 2, uem.SpaceError, ("'high on low' is contacts[1]", "new Contact")),
        ("materials", lambda b: [uem.LinearElastic(1.0, 0.3)], uem.InputTypeError, ("materials[0] = a LinearElastic", "with history")),
        ("dynamics", lambda b: 1.0, uem.InputTypeError, ("dynamics = 1.0", "Dynamics")),
        ("load", lambda b: constant(b, (1.0, 0.0)), uem.InputError, ("load is a Constant of the shape (2,)", "a scalar Constant")),
        ("load", lambda b: b.u, uem.InputTypeError, ("load = a Function", "a scalar Constant")),
        ("load", lambda b: 2.0, uem.InputTypeError, ("load = 2.0", "a scalar Constant")),
        ("newton", lambda b: "quasi", uem.InputError, ("newton = 'quasi'", "'full' or 'modified'")),
        ("newton", lambda b: None, uem.InputTypeError, ("newton = None", "'full' or 'modified'")),
        ("line_search", lambda b: "no", uem.InputTypeError, ("line_search = 'no'", "True or False")),
        *(("rtol", lambda b, x=x: x, uem.InputError, (f"rtol = {x}", "between 0 and 1")) for x in (10, 0, nan, -1, 1.0, inf)),
        ("rtol", lambda b: "small", uem.InputTypeError, ("rtol = 'small'", "between 0 and 1")),
        *(("max_iterations", lambda b, x=x: x, uem.InputError, (f"max_iterations = {x}", "whole number")) for x in (0, 2.5, -1, nan, inf)),
        ("petsc_options_prefix", lambda b: None, uem.InputTypeError, ("petsc_options_prefix = None", "a text")),
        ("petsc_options_prefix", lambda b: "my solver", uem.InputError, ("petsc_options_prefix = 'my solver'", "without blanks")),
        ("petsc_options_prefix", lambda b: "-uem_", uem.InputError, ("petsc_options_prefix = '-uem_'", "no hyphen")),
        ("petsc_options", lambda b: "-ksp_type cg", uem.InputTypeError, ("petsc_options = '-ksp_type cg'", "{'ksp_type': 'cg'")),
        ("petsc_options", lambda b: {"-ksp_type": "cg"}, uem.InputError, ("'-ksp_type'", "without blanks, hyphen")),
        ("petsc_options", lambda b: {"ksp_type": b}, uem.InputTypeError, ("petsc_options['ksp_type'] = a Blocks", "a text or a number")),
        ("petsc_options", lambda b: {"ksp_type": "cgg"}, uem.InputError, ("petsc_options['ksp_type'] = 'cgg'", "'gmres'", "'cg'?")),
        ("petsc_options", lambda b: {"pc_type": "gamgg"}, uem.InputError, ("petsc_options['pc_type'] = 'gamgg'", "did you mean 'gamg'?")),
        ("petsc_options", lambda b: {"ksp_rtol": "small"}, uem.InputError, ("petsc_options = {'ksp_rtol': 'small'}", "small")),
    ],
)  # fmt: skip
def test_what_a_problem_refuses(option, value, error, words):
    b = scene()
    refused(error, words, lambda: pressed(b, **{option: value(b)}))


def test_a_solver_that_petsc_does_not_have():
    """Known in its set-up only."""
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumpz"}
    problem = pressed(scene(), petsc_options=options)
    refused(uem.InputError, ("petsc_options", "mumpz", "choose others"), problem.solve)


@pytest.mark.parametrize("options, near", [({"ksp_rtoll": 1e-9}, "'ksp_rtol'?"), ({"frobnicate": 3}, "check its spelling")])
def test_options_that_petsc_has_no_use_for(options, near, caplog):
    problem = pressed(
        scene(), petsc_options={"ksp_type": "cg", "pc_type": "jacobi", "ksp_atol": 1e-30, "ksp_max_it": 500} | options
    )
    run(problem, 2)
    reported = [r.getMessage() for r in caplog.records if "was not used" in r.getMessage()]
    (key,) = options
    if COMM.rank == 0:
        assert len(reported) == 1 and repr(key) in reported[0] and near in reported[0]


@pytest.mark.parametrize("where", ["scalar", "collapsed", "second", "mesh", "mixed"])
@pytest.mark.parametrize("degree", [1, 2])
def test_dirichlet_conditions_of_other_spaces(where, degree):
    b, other = scene(degree=degree), scene(degree=degree)
    mesh = b.scene.mesh
    W = {
        "scalar": lambda: compat.function_space(mesh, degree),
        "collapsed": lambda: b.V.sub(0).collapse()[0],
        "second": lambda: compat.function_space(mesh, degree, (2,)).sub(0),
        "mesh": lambda: other.V.sub(0),
        "mixed": lambda: compat.function_space(mesh, 1, (3,)).sub(2),
    }[where]()
    tag = other.bottom if where == "mesh" else b.bottom
    wrong = fem.dirichletbc(PETSc.ScalarType(0.0), fem.locate_dofs_topological(W, tag.dim, tag.entities), W)
    words = ("bcs[1]", "another mesh" if where == "mesh" else "another function space", "u.function_space")
    refused(uem.SpaceError, words, lambda: pressed(b, bcs=[b.oedometer(0.0)[0], wrong]))


def test_dirichlet_conditions_of_the_space_and_its_parts():
    b = scene()
    V = b.V
    S, _ = V.sub(1).collapse()
    down = fem.Function(S)
    down.x.array[:] = -0.01
    dofs = fem.locate_dofs_topological((V.sub(1), S), b.top.dim, b.top.entities)
    bcs = (*clamp(V, b.bottom), fem.dirichletbc(down, dofs, V.sub(1)), uem.dirichlet(V, b.top, 0))
    assert len(run(pressed(b, bcs=bcs))) == 1


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("where", ["everywhere", "one rank"])
@pytest.mark.parametrize("contact", [True, False])
def test_dirichlet_values_that_are_not_finite(value, where, contact):
    b = scene()
    push = constant(b, -0.01)
    on_top = fem.dirichletbc(push, fem.locate_dofs_topological(b.V.sub(1), 1, b.top.entities), b.V.sub(1))
    problem = pressed(b, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0), on_top], **({} if contact else {"contacts": []}))
    # on one rank that has nodes of the top
    having = COMM.allgather(len(compat.bc_dofs(on_top)[0]) > 0).index(True)
    push.value = value if where == "everywhere" or COMM.rank == having else -0.01
    refused(uem.NotFiniteError, ("bcs[3]", f"prescribes {value} in y at (", "expected finite values"), problem.solve)
    assert not b.u.x.array.any()
    push.value = -0.01
    if contact:
        problem.solve()


@pytest.mark.parametrize("value", [nan, -inf])
@pytest.mark.parametrize("field", ["displacement", "degree 2", "scalar"])
def test_a_node_that_is_nowhere(value, field):
    """Named by its number in the mesh's input, wherever it is, before anything is computed of it."""
    b = scene(degree=2 if field == "degree 2" else 1)
    own = np.flatnonzero(b.scene.input_nodes == 7)
    b.scene.mesh.geometry.x[own, 1] = value
    T = fem.Function(compat.function_space(b.scene.mesh, 1))
    warm = ufl.inner(ufl.grad(T), ufl.grad(ufl.TestFunction(T.function_space))) * ufl.dx
    words = ("node 7 of the mesh's input", f", {value})", "expected finite coordinates", "correct the mesh")
    refused(uem.MeshError, words, lambda: uem.UnitedProblem(warm, T) if field == "scalar" else pressed(b))


def test_one_contact_for_two_problems():
    b = scene()
    contact = uem.Contact(b.high, b.low)
    pressed(b, contacts=[contact])
    refused(uem.SpaceError, ("'high on low' belongs to another problem", "new Contact"), lambda: pressed(b, contacts=[contact]))


def test_contact_of_a_problem_that_could_not_be_made():
    """Given again after the mistake was mended."""
    b = blocks(COMM, "triangle", 2, 4, gap=-0.02, overhang=0.25)
    contact = uem.Contact(b.high, b.low, max_penetration=0.01)
    with pytest.raises(uem.PenetrationError):
        pressed(b, contacts=[contact])
    contact.max_penetration = 0.03
    pressed(b, contacts=[contact])
    assert contact.initial_overlap == pytest.approx(0.02)


# -- a contact ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", ["contactor", "target"])
@pytest.mark.parametrize(
    "part, error, words",
    [
        (None, uem.TagError, ("= None", "expected a tag")),
        ("high", uem.TagError, ("= 'high'", "expected a tag", "tags['high']")),
        (np.zeros((2, 2), int), uem.TagError, ("= array", "expected a tag")),
        (np.linspace(0, 1, 3), uem.TagError, ("= array", "expected a tag")),
        (3.5, uem.TagError, ("= 3.5", "expected a tag")),
        ({"high"}, uem.TagError, ("= {'high'}", "expected a tag")),
        ([10**7], uem.TagError, ("indices", "expected local ones")),
    ],
    ids=lambda x: None if isinstance(x, (type, tuple)) else str(x)[:9],
)
def test_what_is_no_surface(role, part, error, words):
    b = scene()
    pair = (part, b.low) if role == "contactor" else (b.high, part)
    refused(error, (role, *words), lambda: pressed(b, contacts=[uem.Contact(*pair)]))


def test_surface_of_an_unknown_tag():
    b = scene()
    tags = forms.mesh_tags(b.scene.mesh, 1, b.high.entities, 5)
    refused(
        uem.TagError, ("contactor 'tagged 99' holds no facets",), lambda: pressed(b, contacts=[uem.Contact((tags, 99), b.low)])
    )


@pytest.mark.parametrize(
    "option, value, error, words",
    [
        ("sliding", "infinite", uem.InputError, ("sliding = 'infinite'", "'finite', 'small' or 'fixed'", "you mean 'finite'?")),
        ("sliding", True, uem.InputTypeError, ("sliding = True", "'finite'")),
        ("normals", "smooth", uem.InputError, ("normals = 'smooth'", "'facet' or 'averaged'")),
        ("max_penetration", nan, uem.InputError, ("max_penetration = nan", "0 or a positive length")),
        ("max_penetration", -1, uem.InputError, ("max_penetration = -1", "0 or a positive length")),
        ("max_penetration", "a", uem.InputTypeError, ("max_penetration = 'a'", "0 or a positive length")),
        ("max_penetration", (1, 2), uem.InputTypeError, ("max_penetration = (1, 2)", "0 or a positive length")),
        ("thickness", 0.0, uem.InputError, ("thickness = 0.0", "a positive length")),
        ("thickness", nan, uem.InputError, ("thickness = nan", "a positive length")),
        ("chords", 1, uem.InputTypeError, ("chords = 1", "True or False")),
        ("name", 7, uem.InputTypeError, ("name = 7", "a text")),
    ],
)
def test_what_a_contact_refuses(option, value, error, words):
    b = scene()
    refused(error, words, lambda: uem.Contact(b.high, b.low, **{option: value}))
    # on one rank alone
    refused(error, words, lambda: uem.Contact(b.high, b.low, **({option: value} if LAST else {})))


def test_rigid_contactor():
    b = scene()
    refused(uem.InputTypeError, ("contactor = a RigidPlane", "swap"), lambda: uem.Contact(uem.RigidPlane((0, 0), (0, 1)), b.low))


@several
@pytest.mark.parametrize(
    "options",
    [{"rtol": 1e-7 if LAST else 1e-8}, {"max_iterations": 20 + LAST}, {"newton": "modified" if LAST else "full"}],
    ids=str,
)
def test_what_differs_from_rank_to_rank(options):
    (option,) = options
    refused(
        uem.InputError, (f"{option} = ", f"on rank {COMM.size - 1}", "the same on all ranks"), lambda: pressed(scene(), **options)
    )
    ball = uem.RigidSphere((0.5, -1.0), 1.0 + 0.1 * LAST)
    b = scene()
    refused(uem.InputError, ("rigid sphere", "on rank 0"), lambda: pressed(b, contacts=[uem.Contact(b.high, ball)]))


@several
@pytest.mark.parametrize("what", ["exclude", "order", "self_contact", "bodies", "rigid", "friction"])
def test_a_general_contact_that_differs(what):
    b = scene()
    one = {
        "bodies": {"top": b.high},
        "rigid": [uem.RigidPlane((0, -5), (0, 1))],
        "friction": {("body 1", "body 2"): 0.3, None: 0.1},
    }
    contact = uem.GeneralContact(**({what: one.get(what, [b.high])} if LAST else {}))
    refused(uem.InputError, (f"{what} = ", "the same on all ranks"), lambda: pressed(b, contacts=[contact]))


@several
@pytest.mark.parametrize("what", ["load", "checkpoint", "estimate", "every"])
def test_steps_that_differ(what):
    """Loads, checkpoints and estimates that one rank alone has, when the problem is made or later."""
    b, words = scene(), (f"{what} = ", "the same on all ranks")
    one = {"load": {constant(b, 0.0): 1.0}, "checkpoint": uem.Checkpoint("never.uem"), "estimate": lambda problem: None}
    how = {what: one.get(what)} if LAST else {}
    if what == "load":
        refused(uem.InputError, words, lambda: pressed(b, **how))
        problem = pressed(b)
        problem.load = (lambda s: None) if LAST else None
        refused(uem.InputError, words, lambda: uem.load_steps(problem))
    elif what == "every":
        kept = uem.Checkpoint("never.uem", every=1 + LAST)
        refused(uem.InputError, words, lambda: uem.load_steps(pressed(b), checkpoint=kept))
        refused(uem.InputError, words, lambda: uem.animate("never.gif", pressed(b), [], every=1 + LAST))
    else:
        refused(uem.InputError, words, lambda: uem.load_steps(pressed(b), **how))


# -- rigid surfaces ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0, -1, nan, inf, "a", None])
@pytest.mark.parametrize(
    "surface, make",
    [
        ("rigid sphere", lambda r: uem.RigidSphere((0.0, 0.0), r)),
        ("rigid cylinder", lambda r: uem.RigidCylinder((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), r)),
        ("rigid paraboloid", lambda r: uem.RigidParaboloid((0.0, 0.0), (0.0, 1.0), r)),
    ],
)
def test_radii(surface, make, radius):
    error = uem.InputTypeError if radius in ("a", None) else uem.InputError
    refused(error, (f"{surface}: radius = {radius!r}", "a positive length"), lambda: make(radius))


@pytest.mark.parametrize(
    "make, error, words",
    [
        (lambda: uem.RigidPlane((0.0, 0.0), (0.0, 0.0)), uem.InputError, ("rigid plane: normal = (0.0, 0.0)", "non-zero")),
        (lambda: uem.RigidPlane((0.0, 0.0), (0.0, 0.0, 1.0)), uem.InputError, ("rigid plane: normal", "2 finite numbers")),
        (lambda: uem.RigidPlane((0.0, nan), (0.0, 1.0)), uem.InputError, ("rigid plane: point", "is not finite")),
        (lambda: uem.RigidPlane(None, (0.0, 1.0)), uem.InputTypeError, ("rigid plane: point = None", "finite numbers")),
        (lambda: uem.RigidSphere(1.0, 1.0), uem.InputError, ("rigid sphere: center = 1.0", "2 or 3 finite numbers")),
        (
            lambda: uem.RigidSphere((0.0, 0.0), 1.0, inside="yes"),
            uem.InputTypeError,
            ("rigid sphere: inside = 'yes'", "True or False"),
        ),
        (lambda: uem.RigidCylinder((0.0, 0.0), (0.0, 1.0), 1.0), uem.InputError, ("rigid cylinder: axis", "3 finite numbers")),
        (lambda: uem.RigidParaboloid((0.0, 0.0), (0.0, inf), 1.0), uem.InputError, ("rigid paraboloid: axis", "not finite")),
        (lambda: uem.RigidSurface(1.0, lambda x: x), uem.InputTypeError, ("rigid surface: distance = 1.0", "a function")),
        (lambda: uem.RigidSurface(lambda x: x, None), uem.InputTypeError, ("rigid surface: gradient = None", "a function")),
        (
            lambda: uem.RigidSurface(lambda x: x, lambda x: x, stride=0.0),
            uem.InputError,
            ("rigid surface: stride = 0.0", "positive"),
        ),
    ],
)
def test_what_rigid_surfaces_refuse(make, error, words):
    refused(error, words, make)


@pytest.mark.parametrize("surface", [uem.RigidPlane((0, 0, 0), (0, 0, 1)), uem.RigidSphere((0, 0, 0), 1.0)], ids=lambda s: s.name)
def test_rigid_surface_of_another_dimension(surface):
    b = scene()
    words = (f"{surface.name} is given in 3D", "displacement in 2D", "2 numbers")
    refused(uem.SurfaceError, words, lambda: pressed(b, contacts=[uem.Contact(b.high, surface)]))


def broken(x):
    raise KeyError("no such profile")


@pytest.mark.parametrize("everywhere", [True, False])
@pytest.mark.parametrize(
    "what, wrong, error, words",
    [
        ("distance", broken, uem.UserFunctionError, ("raised KeyError: 'no such profile'", "test_inputs.py, line")),
        ("gradient", broken, uem.UserFunctionError, ("raised KeyError: 'no such profile'", "mend the function")),
        ("hessian", broken, uem.UserFunctionError, ("raised KeyError: 'no such profile'",)),
        ("distance", lambda x: x, uem.InputError, ("returned the shape", "one row for each point")),
        ("distance", lambda x: 1.0, uem.InputError, ("returned the shape ()", "one row for each point")),
        ("gradient", lambda x: np.array([0.0, 1.0]), uem.InputError, ("returned the shape (2,)",)),
        ("gradient", lambda x: np.zeros((2, len(x))), uem.InputError, ("returned the shape (2, ",)),
        ("hessian", lambda x: np.zeros((len(x), 2)), uem.InputError, ("returned the shape (", ", 2)")),
        ("distance", lambda x: None, uem.InputError, ("returned the shape ()",)),
        ("distance", lambda x: "far", uem.UserFunctionError, ("raised ValueError",)),
    ],
)
def test_functions_of_rigid_surfaces(what, wrong, error, words, everywhere):
    """Also where they fail on one rank alone, at the start and later."""
    bad, now = [everywhere], [False]
    right = {
        "distance": lambda x: x[:, 1],
        "gradient": lambda x: np.tile([0.0, 1.0], (len(x), 1)),
        "hessian": lambda x: np.zeros((len(x), 2, 2)),
    }

    def drawn():
        """Blocks, of which the first rank that owns contactors is at fault; partitions differ from run to run."""
        b = blocks(COMM, "triangle", 2, 8)
        owned = fem.locate_dofs_topological(b.V, 1, b.high.entities) < b.V.dofmap.index_map.size_local
        bad[0] = everywhere or COMM.rank == COMM.allgather(bool(owned.any())).index(True)
        return b

    def requested(x):
        return (wrong if bad[0] and now[0] else right[what])(x)

    b = drawn()

    tool = uem.RigidSurface(**(right | {what: requested}), name="anvil")
    problem = pressed(
        b, contacts=[uem.Contact(b.high, tool)], bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, -0.01))]
    )
    now[0] = True
    refused(error, (f"anvil: {what}", *words), problem.solve)
    other = drawn()
    refused(error, (f"anvil: {what}", *words), lambda: pressed(other, contacts=[uem.Contact(other.high, tool)]))


def test_functions_of_rigid_surfaces_are_not_called_without_points():
    """On ranks without contactors a function that cannot do without points is left alone."""

    def distance(x):
        return x[:, 1] + 0.0 * x.max()

    b = scene()
    ground = uem.RigidSurface(distance, lambda x: np.tile([0.0, 1.0], (len(x), 1)))
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, -0.01))]
    assert len(run(pressed(b, contacts=[uem.Contact(b.high, ground)], bcs=bcs))) == 1


def test_load_of_the_wrong_number_of_arguments():
    problem = pressed(scene(), load=lambda: None)
    refused(uem.UserFunctionError, ("load(1) raised TypeError", "positional argument"), lambda: run(problem))


# -- steps -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [-3, 0, nan, 2.5, inf, "a", None, True, (1, 2)])
def test_numbers_of_load_steps(steps):
    error = uem.InputError if isinstance(steps, (int, float)) and steps is not True else uem.InputTypeError
    problem = pressed(scene())
    words = ("steps[0] = 1", "a Step") if isinstance(steps, tuple) else (f"steps = {steps!r}", "a whole number, 1 or more")
    refused(error, words, lambda: next(uem.load_steps(problem, steps)))
    assert not problem.u.x.array.any()


def test_whole_numbers_of_any_type():
    assert [given.count("steps", n) for n in (3, 3.0, np.int64(3), np.float32(3))] == [3] * 4


@pytest.mark.parametrize(
    "how, words",
    [({"dt": x}, (f"dt = {x!r}", "a positive number")) for x in (0, -0.1, nan, inf, "a", None)]
    + [({"end": x}, (f"end = {x!r}", "a time that is not before the start")) for x in (-1.0, nan, inf, "a", None)]
    + [({"event_tolerance": x}, (f"event_tolerance = {x!r}", "between 0 and 1")) for x in (0.0, 1.0, nan, "a")]
    + [({"checkpoint": "run.uem"}, ("checkpoint = 'run.uem'", "a Checkpoint"))],
    ids=str,
)  # fmt: skip
def test_time_steps(how, words):
    problem = Bar(4).problem
    error = uem.InputTypeError if isinstance(next(iter(how.values())), (str, type(None))) else uem.InputError
    refused(error, words, lambda: uem.time_steps(problem, **({"dt": 0.1, "end": 1.0} | how)))
