"""Other codes on the scene of ``hertz_cylinder.py``: they are given the whole mesh, and come to the same force.

The test worth reading is ``test_same_force``; the codes that are not installed are skipped there.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

from mpi4py import MPI

import common
import numpy as np
import pytest
import ufl
from benchmarks import peers
from benchmarks.peers import by_calculix, by_getfem, by_kratos
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
SCRIPT = Path(__file__).parents[2] / "demos" / "peers.py"
NUMBERS = {"h": 1 / 30, "E": 1e6, "nu": 0.3, "R": 3.0}
SUPPORTS = [("symmetry", 0, 0.0), ("block_bottom", 1, 0.0), ("disc_top", 1, -0.006)]
KEYS = {"code", "nodes", "seconds", "newton_iterations", "P", "p_max_ratio", "error"}


@pytest.fixture(scope="module")
def bodies():
    """A coarse mesh with its tags, and its arrays (rank 0 only)."""
    geo = common.MESHES / "hertz_cylinder.geo"
    mesh, tags = uem.read_gmsh(geo, COMM, gdim=2, parameters={"h": NUMBERS["h"]})
    return mesh, tags, peers.gathered(mesh, tags, "disc", contactor="disc_arc", supports=SUPPORTS, parts=2, **NUMBERS)


@pytest.fixture(scope="module")
def united(bodies):
    """Force and largest pressure of the united elements, with feet that are found once."""
    mesh, tags, _ = bodies
    V = compat.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(NUMBERS["E"], NUMBERS["nu"], kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags[name], *what) for name, *what in SUPPORTS]
    contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"], sliding="fixed")
    list(uem.load_steps(uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact]), 1))
    return 2 * contact.resultant().force[1], contact.max_pressure()


def first(comm, work, *arguments):
    """What rank 0 finds, or what it raises, on all ranks (collective)."""
    found = failure = None
    if comm.rank == 0:
        try:
            found = work(*arguments)
        except Exception as error:
            failure = error
    found, failure = comm.bcast((found, failure))
    if failure is not None:
        raise failure
    return found


def areas(x, cells):
    """Signed areas of triangles."""
    (a, b), (c, d) = ((x[cells[:, i]] - x[cells[:, 0]]).T for i in (1, 2))
    return (a * d - b * c) / 2


def test_arrays_hold_the_whole_mesh(comm, bodies):
    """Every node, cell and edge is there once, and bodies and lines are where the drawing has them."""
    mesh, _, scene = bodies
    sizes = [mesh.topology.index_map(dim).size_global for dim in (0, 2)]

    def reported():
        area, x = areas(scene.x, scene.cells), scene.x
        middle = x[scene.cells].mean(axis=1)
        return {
            "sizes": [len(x), len(scene.cells)],
            "all used": len(np.unique(scene.cells)) == len(x),
            "least area": area.min(),
            "block": area[~scene.upper].sum(),
            "disc": area[scene.upper].sum(),
            "disc above": (middle[scene.upper][:, 1].min(), middle[~scene.upper][:, 1].max()),
            "arc": np.abs(np.hypot(*(x[scene.nodes("disc_arc")] - [0, 3]).T) - 3).max(),
            "lengths": [scene.sizes(name).sum() for name in ("disc_arc", "block_top", "block_bottom", "disc_top", "symmetry")],
            "sides": all(len(scene.sides(name)) == len(edges) for name, edges in scene.facets.items()),
        }

    t = first(comm, reported)
    assert t["sizes"] == sizes and t["all used"] and t["sides"] and t["least area"] > 0
    assert t["block"] == pytest.approx(36.0) and t["disc"] == pytest.approx(np.pi * 9 / 4, rel=5e-3)
    assert t["disc above"][0] > 0 > t["disc above"][1] and t["arc"] < 1e-9
    assert t["lengths"] == pytest.approx([np.pi * 1.5, 6.0, 6.0, 3.0, 9.0], rel=5e-3)


def blocks_of(path):
    """Keyword lines of a CalculiX input with the lines of data below each."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("*"):
            found.append((line.replace(" ", ""), []))
        else:
            found[-1][1].append([field for field in line.split(",") if field.strip()])
    return found


def test_calculix_input_keeps_everything(comm, bodies, folder):
    """Read back: all nodes to 12 digits, all cells, counterclockwise, and the sides of both contact surfaces."""
    _, _, scene = bodies

    def reported():
        by_calculix.write(folder / "hertz.inp", scene, 1e8, 1e-8)
        data = dict(blocks_of(folder / "hertz.inp"))
        nodes = np.array(data["*NODE,NSET=all"], dtype=float)
        cells = np.array(data["*ELEMENT,TYPE=CPE3,ELSET=bodies"], dtype=int)
        on = {}
        for name in ("disc_arc", "block_top"):
            ends = [(int(cell), int(side[1])) for cell, side in data[f"*SURFACE,NAME={name},TYPE=ELEMENT"]]
            on[name] = {frozenset((cells[c - 1, s], cells[c - 1, s % 3 + 1])) for c, s in ends}
            on[name] = on[name] == {frozenset(edge) for edge in (scene.facets[name] + 1).tolist()}
        return {
            "numbers": [np.array_equal(rows[:, 0], np.arange(1, len(rows) + 1)) for rows in (nodes, cells)],
            "nodes": np.abs(nodes[:, 1:3] - scene.x).max(),
            "cells": np.array_equal(cells[:, 1:] - 1, scene.cells),
            "least area": areas(nodes[:, 1:3], cells[:, 1:] - 1).min(),
            "surfaces": on,
            "held": {int(field[0]) for field in data["*NSET,NSET=symmetry"]} == set((scene.nodes("symmetry") + 1).tolist()),
            "widest": max(len(field) for _, rows in data.items() for row in rows for field in row),
        }

    t = first(comm, reported)
    assert t["numbers"] == [True, True] and t["nodes"] < 1e-11 and t["cells"] and t["least area"] > 0
    assert t["surfaces"] == {"disc_arc": True, "block_top": True} and t["held"]
    # the width of CalculiX's fields
    assert t["widest"] <= 20


@pytest.mark.parametrize("peer", [by_calculix, by_getfem], ids=["calculix", "getfem"])
def test_same_force(comm, bodies, united, peer):
    """GetFEM solves the same discrete problem as the united elements; CalculiX's springs give way a little."""
    if not first(comm, peer.available):
        pytest.skip(f"not installed: {peer.INSTALL}")
    answer = first(comm, peer.solve, bodies[2], 1, 60.0, 1e-8)
    force, p_max = united
    close, about = (1e-9, 1e-9) if peer is by_getfem else (0.01, 0.03)
    assert abs(answer.P / force - 1) < close
    assert answer.p_max == pytest.approx(p_max, rel=about)
    assert answer.newton_iterations > 1 and answer.seconds > 0


def test_triangles_of_a_surface_seen_from_outside():
    """Of a tetrahedron of positive volume, each side's nodes go around a normal that leads away from the fourth."""
    x, cells = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])
    for opposite in range(4):
        own = np.delete(np.arange(4), opposite)[None]
        body = peers.Hertz(x, cells, np.array([True]), {"side": own}, "side", [], 1, 1.0, 1.0, 0.3, 1.0)
        (a, b, c) = x[by_kratos.outward(body, "side")[0]]
        assert np.cross(b - a, c - a) @ (x[opposite] - a) < 0


def test_what_fails_says_why(comm, folder):
    """A program that takes too long, ends with an error, or is not there."""
    python = [sys.executable, "-I", "-c"]
    for command, why in (
        ([*python, "import time; time.sleep(20)"], "stopped after 0.5 s"),
        ([*python, "raise SystemExit('no room')"], "ended with 1: no room"),
        (["./no_such_program"], "could not be started"),
    ):
        with pytest.raises(peers.PeerError, match=why):
            first(comm, peers.run, command, folder, 0.5 if "sleep" in command[-1] else 60.0)


def test_peers_know_nothing_of_this_mpi(comm, folder, monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "7")
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    look = "import os; print(os.environ.get('OMPI_COMM_WORLD_SIZE'), os.environ['OMP_NUM_THREADS'])"
    assert first(comm, peers.run, [sys.executable, "-I", "-c", look], folder, 60.0).split() == ["None", "1"]


def test_times_are_medians_of_warm_runs():
    """The first run counts only if it took too long to be repeated."""
    quick, slow = iter([9.0, 1.0, 3.0, 2.0]), iter([40.0])
    assert peers.timed(lambda: next(quick), 3, 300.0) == 2.0
    assert peers.timed(lambda: next(slow), 3, 300.0) == 40.0


def script(folder, monkeypatch, *options):
    """Figures that the demo writes (collective)."""
    file = folder / "peers.json"
    options = ("--sizes", "300", "--runs", "1", "--reference", "1/30", *options)
    monkeypatch.setattr(sys, "argv", ["peers.py", "--json", str(file), *options])
    runpy.run_path(str(SCRIPT))
    COMM.barrier()
    return json.loads(file.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_script_names_absent_codes_and_failures(folder, monkeypatch):
    """Codes that are not there are named with the way to install them, those that fail with the reason, and the rest runs."""

    def fail(*arguments):
        raise peers.PeerError("did not converge")

    monkeypatch.setattr(by_calculix, "available", lambda: False)
    monkeypatch.setattr(by_getfem, "available", lambda: True)
    monkeypatch.setattr(by_getfem, "solve", fail)
    results = script(folder, monkeypatch, "--plot", str(folder / "peers.png"))
    assert [run["code"] for run in results["runs"]] == ["uem", "uem_finite", "uem_mortar"]
    assert all(run.keys() >= KEYS for run in results["runs"])
    assert all(isinstance(run[key], (int, float)) for run in results["runs"] for key in KEYS - {"code"})
    assert results["absent"].keys() == {"calculix"} and "calculix-ccx" in results["absent"]["calculix"]
    (failed,) = results["failed"]
    assert failed["code"] == "getfem" and failed["nodes"] == results["runs"][0]["nodes"] and "converge" in failed["reason"]
    assert (folder / "peers.png").stat().st_size > 10_000


@pytest.mark.slow
def test_script_compares_what_is_there(folder, monkeypatch):
    """All codes that are installed, side by side on one mesh."""
    results = script(folder, monkeypatch)
    codes = [run["code"] for run in results["runs"]]
    assert results["failed"] == [] and {*codes, *results["absent"]} == {"uem", "uem_finite", "uem_mortar", "calculix", "getfem"}
    assert len({run["nodes"] for run in results["runs"]}) == 1
    for run in results["runs"]:
        assert run["error"] < 0.05 and run["p_max_ratio"] == pytest.approx(1.0, abs=0.06)
    (row,) = results["times_of_the_first"]
    assert row[row["first"]] == 1.0 and min(row[code] for code in codes) == 1.0


@pytest.mark.slow
def test_same_force_under_a_sphere(folder, monkeypatch):
    """Tetrahedra: GetFEM solves the same discrete problem, the others another one of nearly the same answer."""
    results = script(folder, monkeypatch, "--dim", "3", "--sizes", "400")
    assert results["failed"] == []
    apart = {"uem": 0.0, "uem_finite": 1e-4, "uem_mortar": 0.02, "calculix": 0.01, "getfem": 1e-9, "kratos": 0.02}
    for run in results["runs"]:
        assert abs(run["difference"]) <= apart[run["code"]], run


@pytest.mark.slow
def test_same_friction(folder, monkeypatch):
    """The same force along the surface, where part of the contact slips: under Mindlin's limit, and near that of the finer mesh."""
    results = script(folder, monkeypatch, "--friction", "0.3", "--sizes", "800")
    assert results["failed"] == [] and len(results["runs"]) == 4 - len(results["absent"])
    for run in results["runs"]:
        assert 0.5 < run["Q/(mu P)"] < 1 and run["error_Q"] < 0.01, run


def test_script_refuses_codes_it_does_not_know(folder, monkeypatch):
    with pytest.raises(ValueError, match="abaqus"):
        script(folder, monkeypatch, "--codes", "uem,abaqus")
