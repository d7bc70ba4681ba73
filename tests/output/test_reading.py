"""Results that are read back: fields as Functions, histories as arrays, on the mesh of the run or on one made from the files.

Read ``test_fields_come_back`` first.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import helpers
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from helpers import at, blocks, box, highest, linear, outside_mpi, refused, scene, serial

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def written(folder, cell, degree=1):
    """Two blocks pressed onto each other in two steps, written with stresses; the problem, and its states by step."""
    b = blocks(COMM, cell, degree=degree)
    contact = uem.Contact(b.high, b.low, friction=0.2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact])
    strain = ufl.sym(ufl.grad(b.u))
    fields = {"strain": strain, "of_direction": strain[0, :], "volume": ufl.tr(strain)}
    kept = []
    with uem.ResultsWriter(folder / "run", problem, fields=fields, reaction=b.bottom) as results:
        for step in uem.load_steps(problem, 2):
            results.write(step)
            kept.append((np.array(b.u.x.array), np.array(contact.pressure.x.array), uem.integrate(strain[0, 0] ** 2 * ufl.dx)))
    return b, problem, kept


@pytest.mark.long
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("cell", helpers.CELLS)
def test_fields_come_back(folder, cell, own):
    """To the last bit on the mesh of the run; integrals are the same on one made from the files."""
    b, problem, kept = written(folder, cell)
    results = uem.read_results(folder / "run", mesh=b.scene.mesh if own else None)
    assert results.times.tolist() == [0.5, 1.0] and results.steps.tolist() == [1, 2]
    assert {"displacement", "contact_pressure", "strain", "volume"} <= set(results.names)
    for k, (u, pressure, energy) in enumerate(kept):
        found = {name: results.function(name, k) for name in results.names}
        assert found["strain"].ufl_shape == (b.gdim, b.gdim) and found["of_direction"].ufl_shape == (b.gdim,)
        if own:
            np.testing.assert_array_equal(found["displacement"].x.array, u)
            np.testing.assert_array_equal(found["contact_pressure"].x.array, pressure)
        grad = ufl.sym(ufl.grad(found["displacement"]))
        assert uem.integrate(grad[0, 0] ** 2 * ufl.dx) == pytest.approx(energy, rel=1e-12)
        x = ufl.SpatialCoordinate(results.mesh)
        for w in (1.0, *(x[i] for i in range(b.gdim))):
            volume = uem.integrate(w * ufl.inner(grad - found["strain"], found["strain"]) * ufl.dx)
            assert volume == pytest.approx(0.0, abs=1e-12) or cell in ("quadrilateral", "hexahedron")
            assert uem.integrate(w * (found["volume"] - ufl.tr(found["strain"])) * ufl.dx) == pytest.approx(0.0, abs=1e-13)
    assert np.array_equal(results.function("displacement").x.array, results.function("displacement", 1).x.array)
    assert results.history["step"].tolist() == [1, 2]
    assert results.history["reaction_" + "xyz"[b.gdim - 1]][-1] == pytest.approx(problem.reaction(b.bottom)[-1], rel=1e-14)


def test_a_curved_mesh_comes_back(folder):
    """Nodes of curved cells, and fields of the second degree at them."""
    b = blocks(COMM, "triangle")
    # a square of two triangles with bent sides, in Gmsh's order of nodes
    x = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, -0.1], [1.1, 0.5], [0.52, 0.5], [0.5, 1.1], [-0.1, 0.5]], dtype=float)
    cells = np.array([[0, 1, 2, 4, 5, 6], [0, 2, 3, 6, 7, 8]])
    first = COMM.rank == 0
    curved = compat.create_mesh(COMM, cells if first else cells[:0], x if first else x[:0], "triangle", 2)
    V = uem.function_space(curved, 2, (2,))
    u, outside = fem.Function(V), mesh.locate_entities_boundary(curved, 1, lambda x: np.full(x.shape[1], True))
    bcs = [uem.dirichlet(V, outside, None, lambda x: [0.01 * x[0] ** 2, 0.02 * x[0] * x[1]])]
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs)
    with uem.ResultsWriter(folder / "curved", problem) as results:
        problem.solve()
        results.write(1.0)
    energy, area = (uem.integrate(form) for form in (ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx, 1.0 * ufl.dx(curved)))
    found = uem.read_results(folder / "curved")
    w = found.function("displacement")
    assert compat.lagrange_degree(w.function_space) == 2
    assert uem.integrate(1.0 * ufl.dx(found.mesh)) == pytest.approx(area, rel=1e-13)
    assert uem.integrate(ufl.inner(ufl.grad(w), ufl.grad(w)) * ufl.dx) == pytest.approx(energy, rel=1e-12)
    refused(uem.SpaceError, "another mesh", lambda: uem.read_results(folder / "curved", mesh=b.scene.mesh))


@serial
def test_a_mesh_made_of_another(folder):
    """Also where a mesh does not know the numbering of its input; DOLFINx 0.5 makes none on ranks."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [2.0, 1.0], [4, 3])])
    cells = mesh.locate_entities(s.mesh, 2, lambda x: x[0] <= 1.01)
    part = mesh.create_submesh(s.mesh, 2, cells)[0]
    V = uem.function_space(part, 1)
    f = fem.Function(V)
    F = (f - ufl.SpatialCoordinate(part)[0]) * ufl.TestFunction(V) * ufl.dx
    problem = uem.UnitedProblem(F, f)
    with uem.ResultsWriter(folder / "part", problem, vtx=False) as results:
        problem.solve()
        results.write(1.0)
    found = uem.read_results(folder / "part")
    x = ufl.SpatialCoordinate(found.mesh)
    assert uem.integrate((found.function("field") - x[0]) ** 2 * ufl.dx) == pytest.approx(0.0, abs=1e-14)


SCRIPT = """
from mpi4py import MPI
import sys, ufl, uem_dolfinx as uem
results = uem.read_results(sys.argv[1])
u = results.function("displacement")
values = uem.integrate(ufl.inner(u, u) * ufl.dx), results.history["force_y"][-1], len(results.times), MPI.COMM_WORLD.size
if MPI.COMM_WORLD.rank == 0:
    print(*map(repr, map(float, values)))
"""


@serial
@pytest.mark.slow
def test_other_numbers_of_ranks(folder):
    """What one rank has written one and two read."""
    b, _, _ = written(folder, "triangle")
    mpiexec = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")
    (folder / "script.py").write_text(SCRIPT)
    for ranks in (1, 2):
        command = [mpiexec, "-n", str(ranks), sys.executable, str(folder / "script.py"), str(folder / "run")]
        done = subprocess.run(command, env=outside_mpi() | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        square, force, n, size = map(float, done.stdout.split())
        assert square == pytest.approx(uem.integrate(ufl.inner(b.u, b.u) * ufl.dx), rel=1e-13) and (n, size) == (2, ranks)
        assert force == uem.read_results(folder / "run").history["force_y"][-1]


@pytest.mark.long
def test_shapes(folder):
    """Hoop strains are kept, as the third component of tensors, and shapes are as given."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    V = uem.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    hoop = ufl.as_matrix([[1, 2, 0], [0, 0, 0], [0, 0, 7]]) * fem.Constant(s.mesh, 1.0)
    bcs = [uem.dirichlet(V, s.tag("left", 0, at(0, 0.0)))]
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs)
    with uem.ResultsWriter(folder / "run", problem, fields={"hoop": hoop}) as results:
        problem.solve()
        results.write(1.0)
    found = uem.read_results(folder / "run.xdmf")
    assert found.function("hoop").ufl_shape == (3, 3) and found.function("hoop", shape=(2, 2)).ufl_shape == (2, 2)
    assert uem.integrate(found.function("hoop")[2, 2] * ufl.dx) == pytest.approx(7.0, rel=1e-14)
    assert uem.integrate(found.function("hoop", shape=(2, 2))[0, 1] * ufl.dx) == pytest.approx(2.0, rel=1e-14)
    assert highest(COMM, np.abs(found.function("displacement", shape=(3,)).x.array)) == 0.0
    for error, words, call in (
        (uem.InputError, ("name = 'displacment'", "did you mean 'displacement'"), lambda: found.function("displacment")),
        (uem.InputError, "step = 1: expected one of 1 steps", lambda: found.function("hoop", 1)),
        (uem.InputTypeError, "step = 0.5", lambda: found.function("hoop", 0.5)),
        (uem.InputError, "shape = (2,)", lambda: found.function("hoop", shape=(2,))),
        (uem.MissingFileError, "there are no results", lambda: uem.read_results(folder / "other")),
        (uem.InputTypeError, "mesh = 3", lambda: uem.read_results(folder / "run", mesh=3)),
        (uem.InputTypeError, "comm = 3", lambda: uem.read_results(folder / "run", 3)),
    ):
        refused(error, words, call)
    COMM.barrier()
    if COMM.rank == 0:
        (folder / "run.bin").rename(folder / "other.bin")
    COMM.barrier()
    refused(uem.MissingFileError, "run.bin", lambda: uem.read_results(folder / "run"))


def _cut(path, n):
    path.write_bytes(path.read_bytes()[:n])


DAMAGE = {
    "numbers": (".bin", lambda path: _cut(path, 100), "run.bin ends before"),
    "places": (".xdmf", lambda path: path.write_text(path.read_text().replace('Seek="', 'Seek="9999999')), "run.bin ends before"),
    "half": (".xdmf", lambda path: _cut(path, 300), "run.xdmf cannot be read (ParseError"),
    "widths": (".xdmf", lambda path: path.write_text(path.read_text().replace(' 3"', ' 4"')), "cannot be read (ValueError"),
    "cells": (".xdmf", lambda path: path.write_text(path.read_text().replace("Triangle", "Rhombus")), "cells of type 'Rhombus'"),
    "columns": (".csv", lambda path: path.write_text("time,step\n0.5,1\n1.0\n"), "line 3 of"),
    "names": (".csv", lambda path: path.write_text("time,time\n0.5,1\n"), "two columns 'time'"),
    "letters": (".csv", lambda path: path.write_bytes(b"\xff\xfe\x00"), "run.csv cannot be read (UnicodeDecodeError"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_damaged_files(folder, what):
    """Files that were cut off or changed are named with what is wrong, on all ranks."""
    written(folder, "triangle")
    ending, damage, words = DAMAGE[what]
    if COMM.rank == 0:
        damage(folder / f"run{ending}")
    COMM.barrier()
    refused(uem.OutputError, words, lambda: uem.read_results(folder / "run").function("displacement"))


def test_a_history_alone(folder):
    b = blocks(COMM, "triangle", 2, 2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[uem.GeneralContact()])
    with uem.HistoryWriter(folder / "run.csv", problem, columns={"twice": lambda: 2.0}) as history:
        for step in uem.load_steps(problem, 2):
            history.write(step)
        history.write(1.0)
    found = uem.read_results(folder / "run.csv")
    assert found.times.tolist() == [0.5, 1.0, 1.0] and found.history["twice"].tolist() == [2.0] * 3 and found.names == ()
    assert np.isnan(found.history["newton_iterations"][-1])
    text = {name for name, column in found.pairs.items() if column.dtype.kind == "U"}
    assert text and len(found.pairs["step"]) >= 2 and "step" not in text
    assert repr(found).endswith("3 steps, fields: none)")
    refused(uem.InputError, "has no step", lambda: found.function("displacement"))


@pytest.mark.parametrize("general", [False, True])
def test_fields_of_friction(folder, general):
    """Status, traction and slip are in the files where there is friction, at the nodes, and are those of the contact."""
    b = blocks(COMM, "triangle")
    contact = uem.GeneralContact(friction=0.1) if general else uem.Contact(b.high, b.low, friction=0.1)
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, 1, -0.05), uem.dirichlet(b.V, b.top, 0, 0.2)]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
    with uem.ResultsWriter(folder / "run", problem) as results:
        for step in uem.load_steps(problem, 4):
            results.write(step)
    found = uem.read_results(folder / "run", mesh=b.scene.mesh)
    for name in ("status", "traction", "slip"):
        np.testing.assert_array_equal(found.function(name).x.array, getattr(contact, name).x.array)
    traction, pressure = found.function("traction").x.array.reshape(-1, 2), found.function("contact_pressure").x.array
    slips = found.function("status").x.array == 2.0
    assert COMM.allreduce(int(slips.sum())) > 0
    np.testing.assert_allclose(np.linalg.norm(traction, axis=1)[slips], 0.1 * pressure[slips], rtol=1e-8)
    assert highest(COMM, np.abs(found.function("slip").x.array)) > 0.1
