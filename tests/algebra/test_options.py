"""Which solver is taken at which size."""

from __future__ import annotations

import pytest

from uem_dolfinx.algebra import options
from uem_dolfinx.algebra.options import default_options


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
