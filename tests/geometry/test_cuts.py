"""Meshes that are cut along a section: nodes are doubled, surfaces and sets follow their cells."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import refused

import uem_dolfinx as uem
from uem_dolfinx.geometry.cuts import Group, RawMesh, cut
from uem_dolfinx.geometry.gmsh import distributed

COMM = MPI.COMM_WORLD
KINDS = [("quadrilateral", 1), ("triangle", 1), ("triangle", 2), ("hexahedron", 1), ("tetrahedron", 2)]


def block(cell, degree, n=4):
    """A unit square or cube in Gmsh, of n layers, with its middle layer's lower face as group ``section`` and its ends."""
    gmsh = pytest.importorskip("gmsh")
    if COMM.rank:
        return None
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        g, hexes = (2 if cell in ("triangle", "quadrilateral") else 3), cell in ("quadrilateral", "hexahedron")
        model, occ = gmsh.model, gmsh.model.geo
        line = occ.extrude([(0, occ.addPoint(0, 0, 0))], 1, 0, 0, [3], recombine=hexes)
        base = [line[1]] if g == 2 else [occ.extrude([line[1]], 0, 1, 0, [2], recombine=hexes)[1]]
        along = (0, 1, 0) if g == 2 else (0, 0, 1)
        layers = []
        for _ in range(2):
            out = occ.extrude(base, *(0.5 * a for a in along), [n // 2], recombine=hexes)
            layers.append((base[0], out[1]))
            base = [out[0]]
        occ.synchronize()
        model.setPhysicalName(g, model.addPhysicalGroup(g, [body[1] for _, body in layers]), "body")
        for name, entity in (("foot", layers[0][0]), ("section", layers[1][0]), ("head", base[0])):
            model.setPhysicalName(g - 1, model.addPhysicalGroup(g - 1, [entity[1]]), name)
        ends = (layers[0][0], layers[1][0], base[0])
        sides = [one[1] for one in model.getBoundary([body for _, body in layers], oriented=False) if one not in ends]
        model.setPhysicalName(g - 1, model.addPhysicalGroup(g - 1, sides), "sides")
        model.mesh.generate(g)
        model.mesh.setOrder(degree)
        from uem_dolfinx.geometry.gmsh import _read

        return _read(model, g, {})
    finally:
        gmsh.finalize()


def measure(mesh, dx):
    return uem.integrate(fem.Constant(mesh, 1.0) * dx)


@pytest.mark.long
@pytest.mark.parametrize(("cell", "degree"), KINDS)
def test_a_block_in_two(cell, degree):
    """Both faces have the section's area and are exterior; volume, ends and sides stay; one half moves without the other."""
    raw = block(cell, degree)
    mesh, tags = distributed(COMM, lambda: cut(raw, "section"), "a block")
    assert measure(mesh, ufl.dx(domain=mesh)) == pytest.approx(1.0)
    g = mesh.geometry.dim
    for name in ("section", "section back", "foot", "head"):
        assert measure(mesh, uem.ds(tags[name])) == pytest.approx(1.0), name
    assert measure(mesh, uem.ds(tags["sides"])) == pytest.approx(2.0 if g == 2 else 4.0)
    assert measure(mesh, ufl.ds(domain=mesh)) == pytest.approx(6.0 if g == 2 else 8.0)
    # the bodies are apart: displaced by the faces, the upper one by 1
    V = uem.function_space(mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.0, kind="plane_strain" if g == 2 else "3d").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["foot"]), *(uem.dirichlet(V, tags["head"], c, float(c == g - 1)) for c in range(g))]
    uem.UnitedProblem(F, u, bcs=bcs).solve()
    assert uem.integrate(u[g - 1] * uem.ds(tags["section"])) == pytest.approx(0.0, abs=1e-12)
    assert uem.integrate(u[g - 1] * uem.ds(tags["section back"])) == pytest.approx(1.0)


def test_sets_of_nodes_keep_both_copies():
    """Points on the section are doubled, others are not."""
    raw = block("quadrilateral", 1)
    if raw is not None:
        on = np.flatnonzero(np.abs(raw.points[:, 1] - 0.5) < 1e-9)[:2]
        off = np.flatnonzero(raw.points[:, 1] > 0.9)[:1]
        raw.groups.append(Group("some", 99, 0, np.sort(np.append(on, off))[:, None]))
        made = cut(raw, "section")
        rows = next(one for one in made.groups if one.name == "some").rows.ravel()
        assert len(rows) == 5 and np.allclose(np.sort(made.points[rows][:, 1]), [0.5, 0.5, 0.5, 0.5, 1.0])


def test_how_plane_a_section_must_be():
    """Nodes off the plane by a millionth of its size are taken for rounding, by twice as much not."""
    raw = block("quadrilateral", 1)
    if raw is not None:
        one = np.flatnonzero(np.abs(raw.points[:, 1] - 0.5) < 1e-9)[1]
        for off, fine in ((0.5e-6, True), (4e-6, False)):
            x = raw.points.copy()
            x[one, 1] += off
            bent = replace(raw, points=x)
            if fine:
                cut(bent, "section")
            else:
                with pytest.raises(uem.MeshError, match="not plane"):
                    cut(bent, "section")


def test_what_is_refused():
    """Names that there are not, sections of the surface, sections that end inside."""
    raw = block("quadrilateral", 1)

    def made(name, change=lambda raw: raw):
        return lambda: distributed(COMM, lambda: cut(change(raw), name), "a block")

    def shorter(raw: RawMesh):
        groups = [replace(one, rows=one.rows[:-1]) if one.name == "section" else one for one in raw.groups]
        return replace(raw, groups=groups)

    refused(uem.MeshError, ("'none'", "section"), made("none"))
    refused(uem.MeshError, ("'head'", "between two cells"), made("head"))
    refused(uem.MeshError, "ends inside", made("section", shorter))
