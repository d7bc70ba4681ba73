"""What the demos share: their arguments, and a table with its JSON file."""

from __future__ import annotations

import argparse
import ast
import gc
import json
import logging
import os
import sys
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

import uem_dolfinx as uem

MESHES = Path(__file__).resolve().parent.parent / "meshes"
comm = MPI.COMM_WORLD
#: What options mean in most demos that have them; the docstring of a demo explains all others.
WORDS = {
    "dim": "space dimension, 2 or 3",
    "h": "size of the cells in the contact zone",
    "ratio": "size of the target's cells relative to the contactor's",
    "layers": "cells through the wall",
    "quads": "1: quadrilaterals or hexahedra instead of triangles or tetrahedra",
    "degree": "polynomial degree of the elements",
    "refinements": "number of meshes, each twice as fine as the one before",
    "E": "Young's modulus",
    "nu": "Poisson's ratio",
    "mu": "coefficient of friction",
    "friction": "coefficient of friction",
    "coupling": "contact conditions at nodes, or in integrals over both surfaces",
    "normals": "normals of the target's facets, or averaged at its nodes",
    "steps": "load steps",
    "dt": "time step",
    "end": "time at which the run ends",
    "cfl": "Courant number: time step times wave speed over the length of a cell",
    "runs": "timed runs, of which the quickest counts",
}


def ratio(text: str) -> float:
    """Number, or ratio as in 1:3 and 1/3."""
    return float(Fraction(text.replace(":", "/")))


def explanations(docstring: str | None) -> dict[str, str]:
    """Meaning of each option: the shared words, and those of a docstring that ends in "Options:" and lines ``name: meaning``."""
    own = (docstring or "").partition("\nOptions:\n")[2]
    return WORDS | dict(line.strip().split(": ", 1) for line in own.splitlines() if line.strip())


def arguments(docstring: str | None, **options: Any) -> argparse.Namespace:
    """Parse the command line.

    Args:
        docstring: of the demo; ``--help`` shows its first line and its notes on the options.
        options: the demo's own options, by name: the default, or a tuple of choices whose first is the default; False makes a flag.
    """
    parser = argparse.ArgumentParser(description=(docstring or "").partition("\n")[0])
    parser.add_argument("--json", metavar="FILE", help="write the figures measured")
    parser.add_argument("--plot", metavar="FILE.png", help="draw a picture")
    parser.add_argument("--setup", metavar="FILE.png", help="draw what the problem declares, and end")
    parser.add_argument("--output", metavar="DIR", help="write fields for ParaView and a CSV history")
    parser.add_argument("--verbose", action="store_true", help="show every Newton iteration, and where time went")
    words = explanations(docstring)
    for name, value in options.items():
        default = value[0] if isinstance(value, tuple) else value
        if isinstance(value, tuple):
            kind: Any = {"choices": value}
        elif value is False:
            kind = {"action": "store_true"}
        else:
            kind = {"type": ratio if isinstance(value, float) else type(value)}
        shown = "none" if default == "" else f"{default:g}" if isinstance(default, float) else default
        text = f"{words.get(name, '')} (default: {shown})".strip()
        parser.add_argument("--" + name.replace("_", "-"), default=default, help=text.replace("%", "%%"), **kind)
    logging.basicConfig(format="%(message)s")
    # in a notebook the command line is that of the kernel
    args = parser.parse_args([] if "ipykernel" in sys.modules else None)
    if args.setup:
        draw_setup(args.setup, **of_sketch(Path(sys.argv[0]).stem))
    return args


def of_sketch(name: str) -> dict[str, Any]:
    """What ``sketches.txt`` says of the sketch of a demo; nothing if it says nothing."""
    lines = (Path(__file__).parent / "sketches.txt").read_text(encoding="utf-8").splitlines()
    lines_of = dict(line.split(": ", 1) for line in lines if not line.startswith("#"))
    how = ast.literal_eval(lines_of.get(name, "{}")) or {}
    return {key: value for key, value in how.items() if key != "small"}


def draw_setup(path: str, problem: int = 1, **how: Any) -> None:
    """Let the script end by a picture of what a problem declares as soon as it has made it.

    Args:
        path: name of the picture.
        problem: which of the problems that it makes, counted from 1.
        how: arguments of ``uem.plot_setup``.
    """
    made = []

    class Drawn(uem.UnitedProblem):
        def __init__(self, *args: Any, **options: Any):
            super().__init__(*args, **options)
            made.append(self)
            if len(made) == problem:
                uem.plot_setup(self, path, **({"dpi": 110} | how))
                raise SystemExit

    uem.UnitedProblem = Drawn


def cg(amg: str = "", rtol: float | None = None) -> dict[str, Any]:
    """PETSc options of CG with algebraic multigrid, hypre where PETSc has it; without ``rtol`` as accurate as Newton's method can use."""
    return {"ksp_type": "cg"} | uem.multigrid_options(amg) | ({} if rtol is None else {"ksp_rtol": rtol})


def direct() -> dict[str, Any]:
    """PETSc options of a factorisation, MUMPS where PETSc has it: it leaves no more than rounding."""
    mumps = {"pc_factor_mat_solver_type": "mumps"} if PETSc.Sys.hasExternalPackage("mumps") else {}
    return {"ksp_type": "preonly", "pc_type": "lu"} | mumps


def numbers(text: str, mark: str = ",") -> list[int]:
    """Whole numbers of a list, parted by a mark."""
    return [int(float(word)) for word in text.split(mark) if word]


def outside_mpi() -> dict[str, str]:
    """Environment of a process that takes no part in the MPI of this one."""
    own = ("OMPI_", "PMI", "HYD", "MPI_")
    kept = ("OMPI_ALLOW", "OMPI_MCA_ess_singleton")
    return {k: v for k, v in os.environ.items() if not k.startswith(own) or k.startswith(kept)}


def free_memory() -> None:
    """Free objects that Python and PETSc no longer use (collective)."""
    gc.collect()
    PETSc.garbage_cleanup(comm)


def order(step: uem.LoadStep, rounding: float = 1e-12) -> float:
    """Order of convergence observed on a step's last three residuals above rounding: 2 is quadratic."""
    residuals = [iteration.residual for iteration in step.iterations]
    r = [value for value in residuals if value > rounding][-3:]
    return float(np.log(r[2] / r[1]) / np.log(r[1] / r[0])) if len(r) == 3 else float("nan")


def draws_3d() -> bool:
    """Whether 3D scenes can be drawn here; said where not."""
    found = find_spec("pyvista") is not None
    if not found and comm.rank == 0:
        print("no picture in 3D: pip install pyvista")
    return found


def report(args: argparse.Namespace, results: dict[str, Any]) -> None:
    """Print the figures measured, lists of dictionaries as tables, and write the JSON file, on rank 0; if verbose, where time went."""
    if comm.rank != 0:
        return
    for key, value in results.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            table = [[key, *value[0]]] + [["", *map(show, row.values())] for row in value]
            widths = [max(map(len, column)) + 2 for column in zip(*table)]
            print("\n".join("".join(f"{text:>{w}}" for text, w in zip(line, widths)) for line in table))
        elif isinstance(value, dict):
            print(f"{key}: " + ", ".join(f"{k} {show(v)}" for k, v in value.items()))
        else:
            print(f"{key:>20}: {show(value)}")
    if getattr(args, "verbose", False):
        print(uem.timings())
    if args.json:
        Path(args.json).parent.mkdir(parents=True, exist_ok=True)
        Path(args.json).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def show(value: object) -> str:
    """Short text of a number, or of several."""
    if isinstance(value, list):
        return ", ".join(map(show, value))
    return f"{value:.5g}" if isinstance(value, float) else str(value)
