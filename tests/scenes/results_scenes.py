"""Files of results as tests read them, disks that are full, and scenes whose results are written."""

from __future__ import annotations

import csv
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mpi4py import MPI

import helpers
import numpy as np
import ufl

import uem_dolfinx as uem


def pressed(comm: MPI.Comm, cell: str, degree: int = 1, **how: Any) -> uem.UnitedProblem:
    """Two blocks that are to be pushed together by 0.1."""
    b = helpers.blocks(comm, cell, degree=degree, **how)
    contact = uem.Contact(b.high, b.low, name="pair")
    return uem.UnitedProblem(helpers.st_venant(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact], rtol=1e-10)


def strains(problem: uem.UnitedProblem) -> dict[str, Any]:
    """Fields of every rank of tensors, one value per cell."""
    strain = ufl.sym(ufl.grad(problem.u))
    return {"strain": strain, "trace": ufl.tr(strain), "slope": ufl.grad(problem.u[0])}


def item(element: ElementTree.Element, folder: Path) -> np.ndarray:
    """Numbers that a DataItem of an XDMF file names."""
    found = element.find("DataItem")
    assert found is not None and found.text is not None and found.get("Format") == "Binary"
    shape = tuple(map(int, found.get("Dimensions", "").split()))
    kind = {"Int": np.int64, "Float": np.float64}[found.get("NumberType", "")]
    with (folder / found.text).open("rb") as file:
        file.seek(int(found.get("Seek", "")))
        values = np.fromfile(file, kind, int(np.prod(shape)))
    assert len(values) == np.prod(shape), "the file of numbers is too short"
    return values.reshape(shape)


def series(path: Path) -> list[tuple[float, dict[str, np.ndarray]]]:
    """Steps of an XDMF file: the time, and the mesh and the fields by name."""
    steps = []
    for grid in ElementTree.parse(path).findall(".//Grid[@GridType='Collection']/Grid"):
        time, topology, geometry = (grid.find(name) for name in ("Time", "Topology", "Geometry"))
        assert time is not None and topology is not None and geometry is not None
        fields = {"topology": item(topology, path.parent), "geometry": item(geometry, path.parent)}
        fields |= {a.get("Name", ""): item(a, path.parent) for a in grid.findall("Attribute")}
        steps.append((float(time.get("Value", "")), fields))
    return steps


def same_series(one: Path, other: Path, bound: float = 1e-9) -> None:
    """The same times, meshes and fields, these relative to the largest value."""
    a, b = series(one), series(other)
    assert [t for t, _ in a] == [t for t, _ in b]
    for (_, x), (_, y) in zip(a, b):
        assert list(x) == list(y)
        for name in x:
            np.testing.assert_allclose(x[name], y[name], rtol=0, atol=bound * max(1e-3, np.abs(x[name]).max()))


def rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file, each as long as its head."""
    with path.open(newline="") as file:
        found = list(csv.DictReader(file))
    assert all(None not in row.values() for row in found)
    return found


@contextmanager
def small_disk(comm: MPI.Comm, folder: Path, size: int) -> Iterator[bool]:
    """A disk of so many bytes mounted at a folder; yields whether the system has permitted it (collective)."""
    done = 1
    if comm.rank == 0:
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True).returncode if os.geteuid() == 0 else 1
    permitted = comm.bcast(done) == 0
    try:
        yield permitted
    finally:
        comm.barrier()
        if permitted and comm.rank == 0:
            # lazily: a writer that has failed and is not closed still has its files
            subprocess.run(["umount", "-l", str(folder)], check=True)
