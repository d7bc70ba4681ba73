"""The stability table: its format, its judgement, and that the package is right in cases of every kind."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks import methods
from benchmarks.cases import COLUMNS, FORCE, Case, Check, judge
from benchmarks.cases_laws import check_laws
from benchmarks.cases_scales import springs
from benchmarks.every_case import CASES as EVERY

COMM = MPI.COMM_WORLD
CASES = {case.name: case for case in EVERY}
UNITED, MORTAR = COLUMNS[:2]


def test_names_differ_on_the_command_line():
    assert len(CASES) == len(EVERY)
    assert not any("," in name for name in CASES)
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    assert {column.method for column in COLUMNS} == set(methods.METHODS)


@pytest.mark.parametrize(
    "name",
    [
        "E ratio 1e-09",
        "mesh 50:1",
        "overlap 1e-12",
        "vertex flat",
        "tangent",
        "two-pass 3:4",
        "corner on edge",
        "beside 2D finite",
    ]
    + ["cylinder averaged", "cylinder falls", "explicit half the wave speed", "massy explicit E and mass 1 : 1e6"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("explicit layer 0.01", "massy explicit layer 0.01")],
)
def test_correct(name):
    cell = judge(CASES[name], UNITED)
    assert cell["verdict"] == "correct", cell
    assert cell["case"] == name and cell["method"] == "united" and abs(cell["figure"]) <= cell["tolerance"]
    assert cell["iterations"] > 0 and cell["what"]


@pytest.mark.parametrize(
    "name",
    [
        *("E ratio 1e-09", "edge 3D", "beside 2D finite", "two-pass 3:4", "chain", "mirrored hexahedron 2"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("vertex ridge", "vertex flat", "sharp corner", "off the end")),
    ],
)
def test_correct_with_mortar(name):
    """Forces along the facets' own normals, gaps closed in the mean."""
    cell = judge(CASES[name], MORTAR)
    assert cell["verdict"] == "correct" and cell["method"] == "mortar", cell


@pytest.mark.parametrize(
    "name,error", [("contactor fought", "ConflictError"), ("lifted", "FloatingBodyError"), ("E ratio 1e+12", "PrecisionError")]
)
def test_named_error(name, error):
    """What contradicts itself is said so."""
    cell = judge(CASES[name], UNITED)
    assert cell["verdict"] == "named error" and cell["figure"] == error and cell["tolerance"] is None, cell


def test_all_ranks_agree():
    for name in ("E ratio 1e-09", "lifted"):
        assert len({str(cell) for cell in COMM.allgather(judge(CASES[name], UNITED))}) == 1


# -- the judgement can fail --------------------------------------------------------------------------------------------------


def verdict(run):
    return judge(Case("case", "", run), UNITED)


def test_wrong_is_wrong():
    """Too large a figure, one that is no number, and an exception without a name."""
    assert verdict(lambda trial: trial.check("force", 2 * FORCE, FORCE))["verdict"] == "wrong"
    cell = verdict(lambda trial: (trial.check("force", np.nan, FORCE), trial.check("overlap", 0.5, 1.0)))
    assert cell["verdict"] == "wrong" and cell["figure"] == "nan" and cell["what"] == "force"
    cell = verdict(lambda trial: 1 / 0)
    assert cell["verdict"] == "wrong" and cell["figure"] == "ZeroDivisionError"
    assert verdict(lambda trial: trial.check("force", 0.5 * FORCE, FORCE))["verdict"] == "correct"
    assert Check("force", -2.0, 1.0).severity == 2.0


@pytest.mark.parametrize(
    "spoil,found",
    [
        (lambda y, upper: -0.01 * upper, "overlap"),
        (lambda y, upper: 0.01 * upper, "force times gap"),
        (lambda y, upper: 0.02 * y**2, "equilibrium"),
    ],
)
def test_unlawful_states_are_found(spoil, found):
    """Displacements that are no solution: bodies in each other, apart under force, or out of balance."""

    trials = []

    def run(trial):
        trials.append(trial)
        scene = springs(([4, 4], [8, 8]))
        scene.unite(scene.side(1, 1, 0), scene.side(0, 1, 1))
        scene.solve(trial, 1 / 8)
        check_laws(trial, scene, 1 / 8)
        assert max(check.severity for check in trial.checks) < 1
        trial.checks.clear()
        u = scene.u.x.array.reshape(-1, 2)
        y = scene.V.tabulate_dof_coordinates()[: len(u), 1]
        upper = np.zeros(len(u))
        upper[scene.nodes_of(1)] = 1.0
        u[:, 1] += spoil(y, upper)
        scene.u.x.scatter_forward()
        check_laws(trial, scene, 1 / 8)

    assert verdict(run)["verdict"] == "wrong"
    assert found in {check.what for check in trials[0].checks if check.severity > 1}
