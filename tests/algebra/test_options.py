"""Which solver is taken at which size."""

from __future__ import annotations

from mpi4py import MPI

import pytest
from petsc4py import PETSc

from uem_dolfinx.algebra import options
from uem_dolfinx.algebra.options import GMRES_RESTART, default_options, options_in_turn


@pytest.mark.parametrize("hypre", [True, False])
@pytest.mark.parametrize(
    "size, gdim, first", [(100_000, 2, "preonly"), (900_000, 2, "cg"), (2_000, 3, "preonly"), (90_000, 3, "cg")]
)
def test_direct_solvers_up_to(size, gdim, first, hypre, monkeypatch):
    """CG takes over early in 3D where there is hypre, and leaves what it cannot do to a factorisation there."""
    monkeypatch.setattr(options, "has_hypre", lambda: hypre)
    assert default_options(size, gdim)[0]["ksp_type"] == first and not default_options(size, gdim)[1]
    between, instead = default_options(10_000, 3)
    assert between["ksp_type"] == ("cg" if hypre else "preonly") and bool(instead) == hypre


@pytest.mark.skipif(not options.has_mumps(), reason="needs MUMPS")
@pytest.mark.parametrize(
    "size, gdim, at_need", [(40_000, 3, True), (900_000, 3, False), (900_000, 2, True), (9_000_000, 2, False)]
)
def test_factorised_at_need(size, gdim, at_need):
    """Where default options fail a factorisation takes over, as long as there is memory for it, and only there."""
    first, instead, need = options_in_turn(None, "at_need_", size, gdim, False)
    assert first["ksp_type"] == "cg" and first["ksp_gmres_restart"] == GMRES_RESTART and not instead
    assert (need.get("ksp_type") == "preonly") == at_need and not options_in_turn(
        {"ksp_type": "cg"}, "at_need_", size, gdim, False
    )[2]


def test_no_options_are_the_default_ones():
    """Empty options mean the same as None, except where PETSc's database has some for the prefix."""
    assert options_in_turn({}, "empty_", 40_000, 3, False) == options_in_turn(None, "empty_", 40_000, 3, False)
    PETSc.Options()["empty_ksp_type"] = "gmres"
    try:
        assert options_in_turn({}, "empty_", 40_000, 3, False) == [{}, {}, {}]
    finally:
        del PETSc.Options()["empty_ksp_type"]


@pytest.mark.skipif(not options.has_mumps(), reason="needs MUMPS")
@pytest.mark.parametrize("kind", ["lu", "cholesky"])
def test_a_factorisation_without_a_package_is_made_by_mumps(kind, caplog):
    """Said once, and not where a package is named, here or in PETSc's database, or where it is no factorisation."""
    package, requested = "pc_factor_mat_solver_type", {"ksp_type": "preonly", "pc_type": kind}
    with caplog.at_level("INFO"):
        assert options_in_turn(requested, "package_", 100, 3, False)[0] == requested | {package: "mumps"}
    # messages are those of one rank
    assert ("MUMPS" in caplog.text) == (MPI.COMM_WORLD.rank == 0)
    caplog.clear()
    own = requested | {package: "petsc"}
    assert options_in_turn(own, "package_", 100, 3, False)[0] == own
    PETSc.Options()[f"package_{package}"] = "petsc"
    try:
        assert options_in_turn(requested, "package_", 100, 3, False)[0] == requested
    finally:
        del PETSc.Options()[f"package_{package}"]
    assert package not in options_in_turn({"pc_type": "gamg"}, "package_", 100, 3, False)[0] and not caplog.text
