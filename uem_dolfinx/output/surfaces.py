"""Time series of deformed contact surfaces with their fields: VTK's unstructured grids, for ParaView and meshio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError, MissingBackendError, OutputError
from uem_dolfinx.files import given_path, keep_aside, on_rank_0
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import timed
from uem_dolfinx.output.results import clock, contact_fields, contact_suffixes, refuse_others
from uem_dolfinx.output.tables import Closing
from uem_dolfinx.parallel import agree, agreed
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep, TimeStep

#: VTK's numbers of facets by their cell and degree.
VTK_TYPES = {
    ("interval", 1): 3, ("interval", 2): 21, ("triangle", 1): 5, ("triangle", 2): 22, ("quadrilateral", 1): 9, ("quadrilateral", 2): 28,
}  # fmt: skip


class SurfaceWriter(Closing, given.Sealed):
    """Time series of the contactors' surfaces only, so that pressures are visible from all sides.

    Writes ``PATH.pvd``, complete after every step, which lists the files ``PATH_surfaces/STEP_CONTACT_RANK.vtu`` that every rank writes of
    its own facets, if it has any: displacement, and the fields of the contact as in ``ResultsWriter``, at the
    deformed nodes.
    Existing files are moved to a folder as in ``ResultsWriter``::

        with uem.SurfaceWriter("out/run", problem) as writer:
            for step in uem.load_steps(problem, 20):
                writer.write(step)

    Args:
        path: name of the files without ending; its folder is made.
        problem: problem whose contacts are written.

    Raises:
        InputError, InputTypeError: for an invalid path or problem, or a problem without contacts.
        MissingBackendError: without PyVista.
        OutputError: if the files cannot be written.
    """

    def __init__(self, path: str | Path, problem: UnitedProblem):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        self.problem, comm = problem, problem.comm
        self.path = self._stem = given_path("path", path, comm)
        with agreed(comm):
            _require()
            if not problem.declared:
                raise InputError("the problem has no contacts: expected some, whose surfaces are written")
        self._folder, self._index = (self._stem.with_name(self._stem.name + end) for end in ("_surfaces", ".pvd"))

        def begin() -> None:
            self._stem.parent.mkdir(parents=True, exist_ok=True)
            keep_aside(self._stem, [self._index, self._folder])
            self._folder.mkdir(exist_ok=True)

        on_rank_0(comm, f"the surfaces {self._stem} cannot be written", begin)
        self._facets: list[tuple[Any, str, list[TargetFacets]]] = []  # facets of each contact, by its name in files
        for contact, suffix in zip(problem.declared, contact_suffixes(problem.declared)):
            tags: dict[int, Tag] = {id(part.contactor): part.contactor for part in getattr(contact, "parts", [contact])}
            found = [TargetFacets(problem.config, tag, "contactor") for tag in tags.values() if tag.dim > 0]
            self._facets.append((contact, suffix.strip("_") or "contact", found))
        self._lines: list[str] = []
        self._steps, self._closed = 0, False

    def write(self, step: LoadStep | TimeStep | float) -> None:
        """Append the present state (collective).

        Args:
            step: a converged step, or a load factor or time.

        Raises:
            InputError, InputTypeError: if ``step`` has no time.
            OutputError: if it cannot be written.
            ValueError: after ``close``.
        """
        comm = self.problem.comm
        if self._closed:
            raise InputError(f"{self._index} is closed: expected rows before close()")
        with agreed(comm):
            refuse_others(step, self.problem)
            time = given.number("the time", clock(step))
        with timed("write surfaces"):
            self._steps += 1
            for contact, name, facets in self._facets:
                fields = self._fields(contact)
                for i, surface in enumerate(facets):
                    own = f"{self._steps:05d}_{name}_{i}" if len(facets) > 1 else f"{self._steps:05d}_{name}"
                    self._write(self._folder / f"{own}_{comm.rank}.vtu", surface, fields)
                    for rank in np.flatnonzero(np.diff(surface.first)):
                        self._lines.append(
                            f'<DataSet timestep="{time!r}" part="{rank}" name="{name}" file="{self._folder.name}/{own}_{rank}.vtu"/>'
                        )
            on_rank_0(comm, f"{self._index} cannot be written", self._write_index)

    def _fields(self, contact: Any) -> dict[str, Array]:
        """Values at local nodes by name (collective)."""
        config = self.problem.config
        fields = contact_fields(contact)
        found = {name: u.x.array.reshape(-1, *u.ufl_shape) for name, u in fields.items()}
        return found | {"displacement": config.displacement}

    def _write(self, path: Path, surface: TargetFacets, fields: dict[str, Array]) -> None:
        """This rank's facets of one surface, if there are any (collective)."""
        import pyvista

        config = self.problem.config
        shape = surface.shape
        nodes, cells = np.unique(surface.dofs, return_inverse=True)
        points = np.zeros((len(nodes), 3))
        points[:, : config.gdim] = config.x[nodes]
        error = None
        if len(nodes):
            cells = compat.vtk_nodes(shape.cell, cells.reshape(surface.dofs.shape))
            grid = pyvista.UnstructuredGrid({VTK_TYPES[shape.cell, shape.degree]: cells}, points)
            for name, values in fields.items():
                own = values[nodes]
                grid.point_data[name] = np.pad(own, ((0, 0), (0, 3 - config.gdim))) if own.ndim > 1 else own
            try:
                grid.save(path)
            except OSError as refused:
                error = OutputError(f"{path} cannot be written: {refused}")
        agree(config.comm, error)

    def _write_index(self) -> None:
        head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        part = self._index.with_name(self._index.name + ".part")
        part.write_text(head + "\n".join(self._lines) + "\n</Collection>\n</VTKFile>\n", encoding="utf-8")
        part.replace(self._index)

    def close(self) -> None:
        """Stop writing."""
        self._closed = True


def _require() -> None:
    try:
        import pyvista  # noqa: F401
    except ImportError as missing:
        raise MissingBackendError(f"SurfaceWriter needs PyVista ({missing}): pip install pyvista") from missing
