"""Contact surfaces in files of their own: their size, place and pressures, as PyVista and meshio read them."""

from __future__ import annotations

import re

from mpi4py import MPI

import helpers
import numpy as np
import pytest

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def pressed(cell: str, degree: int) -> uem.UnitedProblem:
    """Block on block, pushed together by 0.1."""
    b = helpers.blocks(COMM, cell, degree=degree)
    contact = uem.Contact(b.high, b.low)
    return uem.UnitedProblem(helpers.linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact])


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 1), ("tetrahedron", 2), ("hexahedron", 2), ("hexahedron", 1)])
def test_surfaces_where_they_are(folder, cell, degree):
    """The files of the last step have all facets once, where the surface has moved to, and pressures that add up to the force."""
    pyvista = pytest.importorskip("pyvista")
    problem = pressed(cell, degree)
    with uem.SurfaceWriter(folder / "new" / "run", problem) as writer:
        for step in uem.load_steps(problem, 2):
            writer.write(step)
    g, force = problem.config.gdim, float(np.abs(problem.contacts[0].resultant().force[-1]))
    last = helpers.highest(COMM, np.abs(problem.config.displacement[problem.contacts[0].pair.nodes, -1]))
    if COMM.rank == 0:
        index = (folder / "new" / "run.pvd").read_text()
        named = re.findall(r'timestep="([^"]+)" part="(\d+)" name="contact" file="([^"]+)"', index)
        assert sorted({float(t) for t, _, _ in named}) == [0.5, 1.0] and (COMM.size > 1 or len(named) == 2)
        assert all((folder / "new" / name).is_file() for _, _, name in named)
        grids = [pyvista.read(folder / "new" / name) for t, _, name in named if float(t) == 1.0]
        sizes = [grid.compute_cell_sizes()["Length" if g == 2 else "Area"].sum() for grid in grids]
        assert sum(sizes) == pytest.approx(1.0, rel=1e-12)
        for grid in grids:
            assert grid.points[:, g - 1] == pytest.approx(-last, rel=1e-9)
            assert grid.point_data["pressure"] == pytest.approx(force, rel=1e-9) and grid.point_data["active"].min() == 1.0
            assert grid.point_data["displacement"].shape[1] == 3


def test_meshio_reads_surfaces(folder):
    """Quadratic facets come as such."""
    pytest.importorskip("pyvista")
    meshio = pytest.importorskip("meshio")
    problem = pressed("tetrahedron", 2)
    problem.solve()
    with uem.SurfaceWriter(folder / "run", problem) as writer:
        writer.write(1.0)
    if COMM.rank == 0:
        found = [meshio.read(name) for name in sorted((folder / "run_surfaces").iterdir())]
        kinds = {block.type for mesh in found for block in mesh.cells}
        assert kinds == {"triangle6"} and {"pressure", "force"} <= set(found[0].point_data)


def test_surfaces_that_cannot_be_written(folder):
    """Earlier files are kept aside; a problem without contact, a step without time and a closed writer are refused."""
    pytest.importorskip("pyvista")
    problem = pressed("triangle", 1)
    for _ in range(2):
        writer = uem.SurfaceWriter(folder / "run", problem)
        writer.write(0.0)
    COMM.barrier()
    assert (folder / "run.1" / "run.pvd").is_file() and (folder / "run.1" / "run_surfaces").is_dir()
    helpers.refused(uem.InputTypeError, "step", lambda: writer.write("end"))
    writer.close()
    with pytest.raises(ValueError, match="is closed"):
        writer.write(1.0)
    b = helpers.blocks(COMM, "triangle")
    alone = uem.UnitedProblem(helpers.linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1))
    helpers.refused(uem.InputError, "no contacts", lambda: uem.SurfaceWriter(folder / "run", alone))


def test_fields_of_friction(folder):
    """Status, traction and slip at the nodes of the surface."""
    pyvista = pytest.importorskip("pyvista")
    b = helpers.blocks(COMM, "triangle")
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, 1, -0.05), uem.dirichlet(b.V, b.top, 0, 0.2)]
    contact = uem.Contact(b.high, b.low, friction=0.1)
    problem = uem.UnitedProblem(helpers.linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact])
    with uem.SurfaceWriter(folder / "run", problem) as writer:
        for step in uem.load_steps(problem, 4):
            writer.write(step)
    if COMM.rank == 0:
        grids = [pyvista.read(name) for name in sorted((folder / "run_surfaces").glob("00004_*.vtu"))]
        assert grids
        for grid in grids:
            found = grid.point_data
            slips = found["status"] == 2.0
            assert slips.any() and found["slip"].shape[1] == found["traction"].shape[1] == 3
            size = np.linalg.norm(found["traction"], axis=1)[slips]
            np.testing.assert_allclose(size, 0.1 * found["pressure"][slips], rtol=1e-8)
