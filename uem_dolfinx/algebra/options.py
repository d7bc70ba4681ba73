"""Options of PETSc for the linear solves: defaults by size, and checks of users' options."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import given
from uem_dolfinx.algebra.mumps import FACTORISATIONS, MINIMUM_FILL
from uem_dolfinx.errors import InputError, MissingBackendError
from uem_dolfinx.log import logger

#: Direct factorisation pays up to about this many unknowns, by dimension (one core, OpenBLAS).
#: [convention; unknowns; test_options.py::test_direct_solvers_up_to]
DIRECT_UP_TO = {2: 300_000, 3: 30_000}
#: CG with hypre takes less time from so many unknowns on, where it takes few iterations; GAMG does not.
#: [convention; unknowns; test_options.py::test_direct_solvers_up_to]
HYPRE_FROM = {2: 300_000, 3: 4_000}
#: CG that takes more iterations leaves a matrix to a factorisation that pays.
#: [convention; iterations; test_linear_solver.py::test_cg_gives_way]
FEW_ITERATIONS = 200
#: A matrix that CG or GMRES does not solve is factorised up to so many unknowns, by dimension: its LU factors take some 8 GiB.
#: [bound; unknowns; test_options.py::test_factorised_at_need]
FACTORISED_UP_TO = {2: 3_000_000, 3: 200_000}
#: GMRES stagnates where many contactors slip if it restarts too early. It restarts after so many vectors, which take no more memory
#: than a matrix in 3D, or leaves the matrix to a factorisation if that is cheaper.
#: [bound; iterations; test_linear_solver.py::test_gmres_gives_way]
GMRES_RESTART = 100
#: Error codes of PETSc for an unknown type or factorisation.
NO_SUCH_TYPE = (86, 92)
#: Frequent options, suggested for misspelt ones.
OFTEN_USED = (
    "ksp_type", "ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_norm_type", "ksp_gmres_restart", "ksp_monitor", "ksp_view", "pc_type",
    "pc_factor_mat_solver_type", "pc_hypre_type", "pc_gamg_threshold", "mg_levels_ksp_type", "mg_levels_pc_type", "sub_pc_type",
)  # fmt: skip


def has_hypre() -> bool:
    """Whether PETSc was built with hypre (the PyPI wheel is not)."""
    return bool(PETSc.Sys.hasExternalPackage("hypre"))


def has_mumps() -> bool:
    """Whether PETSc was built with MUMPS."""
    return bool(PETSc.Sys.hasExternalPackage("mumps"))


def default_options(size: int, gdim: int, mixed: bool = False) -> tuple[dict[str, Any], dict[str, Any]]:
    """PETSc options for a constrained system with ``size`` unknowns, and options to use if CG fails, which may be empty.

    MUMPS if it is cheap, otherwise CG with AMG. MUMPS also pivots in LDL'; PETSc's own Cholesky does not. In 2D it orders by approximate
    minimum fill: PORD and METIS take four times as long, half of a factorisation's time or more, for factorisations that are 10 to 20 %
    cheaper. A ``mixed`` problem may be a saddle point problem, for which CG and AMG are unsuitable: MUMPS at any size.
    """
    direct: dict[str, Any] = {"ksp_type": "preonly", "pc_type": "lu"}
    if has_mumps():
        direct |= {"pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"} | (MINIMUM_FILL if gdim == 2 else {})
    if mixed:
        return direct, {}
    if size > DIRECT_UP_TO[gdim]:
        return {"ksp_type": "cg", "ksp_max_it": 2000, "ksp_gmres_restart": GMRES_RESTART} | multigrid_options(), {}
    if size > HYPRE_FROM[gdim] and has_hypre():
        return {"ksp_type": "cg", "ksp_max_it": FEW_ITERATIONS} | multigrid_options("hypre"), direct
    return direct, {}


def options_in_turn(options: Mapping[str, Any] | None, prefix: str, size: int, gdim: int, mixed: bool) -> list[dict[str, Any]]:
    """PETSc options used first, options used if these fail or do not fit the matrix, and options used if they fail.

    A factorisation without a package is made by MUMPS. Without ``options``, here or for this ``prefix`` in PETSc's database, these are
    ``default_options``, and, if they are iterative and fail, MUMPS up to ``FACTORISED_UP_TO`` unknowns.
    """
    if options or (options is not None and PETSc.Options(prefix).getAll()):
        return [dict(options) | _factorised_by(options, prefix), {}, {}]
    chosen, instead = default_options(size, gdim, mixed)
    need = has_mumps() and not mixed and size <= FACTORISED_UP_TO[gdim] and chosen["ksp_type"] != "preonly"
    return [chosen, instead, instead or (default_options(0, gdim)[0] if need else {})]


def _factorised_by(options: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The option of MUMPS for a factorisation without a package: PETSc's own takes ten times as long."""
    package = "pc_factor_mat_solver_type"
    kind, named = options.get("pc_type"), package in options or PETSc.Options(prefix).hasName(package)
    if kind not in FACTORISATIONS or named or not has_mumps():
        return {}
    logger.info("petsc_options name pc_type = %s without %s: MUMPS is used; 'petsc' is PETSc's own", kind, package)
    return {package: "mumps"}


def multigrid_options(amg: str = "") -> dict[str, Any]:
    """PETSc options of algebraic multigrid for elasticity: ``"hypre"``, ``"gamg"``, or by default hypre if PETSc has it.

    Chebyshev smoothing is the same on any number of ranks, and takes half the time of Gauss-Seidel smoothing.

    Raises:
        InputError, InputTypeError: for another word.
    """
    given.word("amg", amg, ("hypre", "gamg", ""))
    amg = amg or ("hypre" if has_hypre() else "gamg")
    if amg == "gamg":
        # the smoother's bounds from CG, which finds the few large eigenvalues due to stiff contactors
        gamg = {"esteig_ksp_type": "cg", "esteig_ksp_max_it": 20, "threshold": 0.02}
        smoother = {"mg_levels_ksp_type": "chebyshev", "mg_levels_pc_type": "jacobi"}
        return {"pc_type": "gamg"} | smoother | {f"pc_gamg_{k}": v for k, v in gamg.items()}
    boomeramg = {
        "strong_threshold": 0.15, "coarsen_type": "HMIS", "interp_type": "ext+i", "P_max": 4, "relax_type_all": "Chebyshev",
    }  # fmt: skip
    return {"pc_type": "hypre", "pc_hypre_type": "boomeramg"} | {f"pc_hypre_boomeramg_{k}": v for k, v in boomeramg.items()}


def saddle_options(field: int = 1, amg: str = "") -> dict[str, Any]:
    """PETSc options of GMRES for a displacement and a pressure: multigrid on the displacement's part of the constrained matrix.

    The pressure's Schur complement is approximated by its diagonal, computed with the diagonal of the displacement's part. It has the
    size of the pressure's mass over the shear modulus, also for variable moduli.

    Args:
        field: number of the pressure's part of the mixed space.
        amg: as in ``multigrid_options``.

    Raises:
        InputError, InputTypeError: for an invalid number of a part, or another word.
    """
    field = given.part_number("field", field, "the pressure")
    schur = {"type": "schur", "schur_fact_type": "lower", "schur_precondition": "selfp"}
    parts = {"u_ksp_type": "preonly", f"{field}_ksp_type": "preonly", f"{field}_pc_type": "jacobi"}
    parts |= {f"u_{key}": value for key, value in multigrid_options(amg).items()}
    outer = {"ksp_type": "gmres", "ksp_gmres_restart": 200, "ksp_max_it": 1000, "ksp_pc_side": "right", "pc_type": "fieldsplit"}
    return outer | {f"pc_fieldsplit_{k}": v for k, v in schur.items()} | {f"fieldsplit_{k}": v for k, v in parts.items()}


def check_options(options: Any, prefix: Any) -> None:
    """Refuse options and a prefix that PETSc could not read, and types of KSP and PC that it does not know.

    Raises:
        InputTypeError, InputError: names the option.
        MissingBackendError: if an option needs a library that PETSc was built without.
    """
    given.kind("petsc_options_prefix", prefix, isinstance(prefix, str), "a text, as 'uem_'")
    if not re.fullmatch(r"(?!-)\S*", prefix):
        raise InputError(given.sentence("petsc_options_prefix", prefix, "a text without blanks, and no hyphen before it"))
    example = "options by name without prefix, as {'ksp_type': 'cg', 'pc_type': 'gamg'}, or None"
    given.kind("petsc_options", options, isinstance(options, Mapping), example)
    for key, value in options.items():
        if not isinstance(key, str) or not re.fullmatch(r"[A-Za-z]\S*", key):
            raise InputError(given.sentence("a name in petsc_options", key, "an option's name without blanks, hyphen and prefix"))
        plain = value is None or isinstance(value, (str, bool, int, float, list, tuple, np.generic))
        given.kind(f"petsc_options[{key!r}]", value, plain, "a text or a number")
        for name, there in (("hypre", has_hypre), ("mumps", has_mumps)):
            if str(value).lower() == name and not there():
                raise MissingBackendError(
                    f"petsc_options ask for {key} = {value}, but this PETSc was built without {name}: "
                    + ("use pc_type gamg" if name == "hypre" else "use another factorisation, or pc_type gamg")
                )
    for key, of, example in (("ksp_type", PETSc.KSP, "'cg' or 'gmres'"), ("pc_type", PETSc.PC, "'gamg' or 'lu'")):
        if key in options and not _knows(of, value := options[key]):
            remedy = given.did_you_mean(value, _type_names(of))
            raise InputError(given.sentence(f"petsc_options[{key!r}]", value, f"a type that PETSc knows, as {example}", remedy))


def check_fields(options: Any, names: Sequence[str]) -> None:
    """Refuse options of field split for fields that do not exist.

    Args:
        options: of users, or None.
        names: of the fields in PETSc's options; only one for a displacement without other fields.

    Raises:
        InputError: names the option.
    """
    known = ", ".join(repr(name) for name in names)
    for key, value in (options or {}).items():
        if len(names) == 1 and key == "pc_type" and value == "fieldsplit":
            remedy = "take uem.multigrid_options(), or give the problem a mixed space"
            raise InputError(
                given.sentence(f"petsc_options[{key!r}]", value, "one for a displacement without other fields", remedy)
            )
        part = re.match(r"fieldsplit_([^_]+)_", key)
        if part and part[1] not in names:
            remedy = "as of uem.saddle_options(field=...), the number of the pressure's part"
            raise InputError(
                given.sentence(f"petsc_options[{key!r}]", value, f"an option of a field of the problem, {known}", remedy)
            )


def _type_names(of: Any) -> list[str]:
    """Types of KSP or PC that petsc4py knows by name."""
    return [name for name in vars(of.Type).values() if isinstance(name, str)]


def _knows(of: Any, name: Any) -> bool:
    """Whether a type of KSP or PC of this name exists, built in or registered."""
    if name in _type_names(of):
        return True
    try:
        of().create(PETSc.COMM_SELF).setType(name)
    except (PETSc.Error, TypeError):
        return False
    return True


def tell_unused(names: Iterable[str], options: Mapping[str, Any], types: str) -> None:
    """Warn of options that PETSc has not used with these types of KSP and PC."""
    for key in sorted(names):
        remedy = given.did_you_mean(key, OFTEN_USED, "check its spelling, or leave it out")
        logger.warning(
            "petsc_options[%r] = %s was not used by PETSc with %s: %s",
            key, given.shown(options[key]), types, remedy,
        )  # fmt: skip


def last_words(error: PETSc.Error) -> str:
    """The message of a PETSc error, without the position in PETSc's sources."""
    return str(error).splitlines()[-1].partition("] ")[2] or str(error)
