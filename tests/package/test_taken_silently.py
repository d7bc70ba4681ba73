"""Wrong inputs that were once taken without a word: each is named, on all ranks."""

from __future__ import annotations

import ast
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, linear, raised

import uem_dolfinx as uem
from uem_dolfinx.log import STAGES

pytestmark = pytest.mark.every_case

COMM = MPI.COMM_WORLD
PACKAGE = Path(uem.__file__).parent


def solved(**options):
    """A solved problem of linear bodies, its blocks, and a functional of it."""
    b = blocks(COMM, "triangle", 2, 2)
    b.E = fem.Constant(b.scene.mesh, 1.0)
    problem = uem.UnitedProblem(linear(b.u, b.E), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)], **options)
    problem.solve()
    return b, problem, ufl.inner(b.u, b.u) * ufl.dx


def by(control, change=None):
    """A gradient by what ``control`` makes of blocks, or a tangent along it."""
    b, problem, J = solved()
    m = control(b)
    return uem.gradient(problem, J, m) if change is None else uem.tangent(problem, [(m, change)])


def of(functional):
    """A gradient of what ``functional`` makes of blocks."""
    b, problem, _ = solved()
    return uem.gradient(problem, functional(b), b.E)


def in_history(control):
    b = blocks(COMM, "triangle", 2, 2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    with uem.recording(problem) as history:
        problem.solve()
    return history.gradient(ufl.inner(b.u, b.u) * ufl.dx, control(b))


def in_two_problems(law):
    b = blocks(COMM, "triangle", 2, 2)
    steel = law(b.u)
    for _ in range(2):
        uem.UnitedProblem(steel.residual(ufl.TestFunction(b.V)), b.u, bcs=b.oedometer(0.01), materials=[steel])


def other(b):
    """A displacement like that of the problem."""
    return fem.Function(b.V, name="u")


def soft(u):
    return uem.VonMises(u, 1.0, 0.3, 0.01, kind="plane_strain")


def finite(u):
    return uem.FinitePlasticity(u, 1.0, 0.3, 0.01, 1.0, kind="plane_strain")


def constant(b):
    return fem.Constant(b.scene.mesh, 1.0)


NOWHERE, SPLIT = "is in no form, Dirichlet condition or law", {"pc_type": "fieldsplit"}
CASES = {
    "a part below none": (uem.InputError, "field = -1: .*counted from 0", lambda: uem.Conductance(1.0, field=-1)),
    "a part of halves": (uem.InputTypeError, "field = 0.5", lambda: uem.Conductance(1.0, field=0.5)),
    "a pressure below none": (uem.InputError, "field = -1: .* the pressure", lambda: uem.saddle_options(-1)),
    "a pressure that is true": (uem.InputTypeError, "field = True", lambda: uem.saddle_options(True)),
    "multigrid of another kind": (uem.InputError, "amg = 'amgx'.* 'gamg'", lambda: uem.multigrid_options("amgx")),
    "multigrid by number": (uem.InputTypeError, "amg = 3", lambda: uem.multigrid_options(3)),
    "a saddle's multigrid": (uem.InputError, "amg = 'hyper'.*did you mean 'hypre'", lambda: uem.saddle_options(1, "hyper")),
    "fields of a displacement": (uem.InputError, "'fieldsplit'.* without other fields", lambda: solved(petsc_options=uem.saddle_options())),
    "a field that there is not": (
        uem.InputError, "fieldsplit_1_pc_type.* a field of the problem, 'u'",
        lambda: solved(petsc_options={"pc_type": "lu", "fieldsplit_1_pc_type": "jacobi"}),
    ),
    "an unknown stage": (uem.InputError, "stage = 'serch'.*did you mean 'search'", lambda: uem.timing("serch")),
    "a stage by number": (uem.InputTypeError, "stage = 3", lambda: uem.timing(3)),
    "a Constant that is nowhere": (uem.InputError, f"controls.0., a Constant, {NOWHERE}", lambda: by(constant)),
    "a Function that is nowhere": (uem.InputError, f"controls.0., a Function, {NOWHERE}", lambda: by(other)),
    "a direction that is nowhere": (uem.InputError, f"direction.0., a Constant, {NOWHERE}", lambda: by(constant, 1.0)),
    "a history by what is nowhere": (uem.InputError, f"controls.0., a Constant, {NOWHERE}", lambda: in_history(constant)),
    "a Constant of another mesh": (
        uem.SpaceError, "controls.0. holds a Constant of another mesh", lambda: by(lambda b: constant(blocks(COMM, "triangle"))),
    ),
    "a functional of another problem": (
        uem.InputError, "J holds nothing that the problem solves for", lambda: of(lambda b: other(b)[0] * b.E * ufl.dx),
    ),
    "a law in two problems": (uem.SpaceError, "a VonMises, belongs to another problem", lambda: in_two_problems(soft)),
    "a finite law in two problems": (uem.SpaceError, "a FinitePlasticity, belongs to", lambda: in_two_problems(finite)),
    "a negative change": (uem.InputError, "size = -0.1: expected a positive", lambda: uem.taylor_test(lambda h: h * h, 0.0, -0.1)),
    "no change": (uem.InputError, "size = 0.0: expected a positive", lambda: uem.taylor_test(lambda h: h * h, 0.0, 0.0)),
}  # fmt: skip


def in_time(steps):
    """Load steps of a problem with inertia."""
    b = blocks(COMM, "triangle", 2, 2)
    how = {"bcs": b.oedometer(0.01), "dynamics": uem.Dynamics(uem.lumped_mass(b.V, 1.0), contactors="massy")}
    uem.load_steps(uem.UnitedProblem(linear(b.u, 1.0), b.u, contacts=[uem.Contact(b.high, b.low)], **how), steps)


CASES |= {f"load steps in time, {n}": (uem.InputError, "load_steps are for statics", lambda n=n: in_time(n)) for n in (2, [])}


@pytest.mark.parametrize("what", CASES)
def test_named(what):
    error, words, call = CASES[what]
    raised(error, words, call)


def test_what_is_meant_is_taken():
    """Controls of J alone, of conditions and of laws; parts that are; stages that have not come yet."""
    b, problem, J = solved()
    c = constant(b)
    assert float(uem.gradient(problem, J + c**2 * ufl.dx(domain=b.scene.mesh), c)[0]) == pytest.approx(4.0, rel=1e-12)
    assert "fieldsplit_0_pc_type" in " ".join(uem.saddle_options(0)) and uem.multigrid_options("gamg")["pc_type"] == "gamg"
    assert uem.timing("eigenvalues")[0] >= 0 and np.isfinite(uem.timing("eigenvalues")[1])


def test_stages_are_all_there():
    """The list of names that ``timing`` knows is that of the code."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("timed", "timed_as"):
                found |= {
                    one.value for one in ast.walk(node.args[0]) if isinstance(one, ast.Constant) and isinstance(one.value, str)
                }
    assert found == set(STAGES)
