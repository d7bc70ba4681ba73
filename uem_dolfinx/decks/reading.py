"""Reading of decks from their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.decks.deck import Deck
from uem_dolfinx.decks.model import model_of
from uem_dolfinx.errors import MissingFileError
from uem_dolfinx.geometry.cuts import RawMesh, cut
from uem_dolfinx.geometry.decks import found_of, read_numbers
from uem_dolfinx.geometry.gmsh import distributed
from uem_dolfinx.geometry.mesh_files import raw_of
from uem_dolfinx.log import logger


def read_deck(path: str | Path, comm: MPI.Comm, *, soft: bool = False) -> Deck:
    """Read a deck of Abaqus or CalculiX with its materials, conditions, contacts, steps and loads as a problem (collective).

    Read are linear elastic materials with expansion, conduction and heat capacity, in small or, with ``NLGEOM``, large displacements.
    So are ``*BOUNDARY``, ``*CLOAD``, pressures, ``GRAV`` and ``CENTRIF`` by ``*DLOAD`` and ``*DSLOAD``, ``*TEMPERATURE`` and
    ``*EQUATION``; ``*CONTACT PAIR``, ``*TIE``, ``*FRICTION``, ``*GAP CONDUCTANCE``, ``*CHANGE FRICTION``, which is ramped, ``*MODEL
    CHANGE`` of contact pairs, ``*RIGID BODY`` and ``*PRE-TENSION SECTION``, whose surface is cut. Values may follow an ``*AMPLITUDE``, or
    be in the directions of a ``*TRANSFORM``. Steps are ``*STATIC``, ``*HEAT TRANSFER``, ``*COUPLED TEMPERATURE-DISPLACEMENT``,
    ``*FREQUENCY`` and ``*DYNAMIC``, which is implicit with increments of one length, ``*DAMPING`` and initial velocities. Cells of several
    kinds, prisms and pyramids are divided into simplices.
    All else is in ``left_out`` and in the log.

    Args:
        path: of the input file.
        comm: communicator of the mesh; rank 0 reads the file.
        soft: False takes surfaces as hard, since most decks mean the slopes of ``PRESSURE-OVERCLOSURE`` as penalties; True takes these
            laws as they stand, as ``SoftContact``, but for contacts with friction.

    Raises:
        InputError, InputTypeError: for an argument of another type, or a keyword that cannot be read.
        MissingFileError, MeshError, TagError: without the file, for a mesh that cannot be read, or a set without nodes of a body.
    """
    given.kind("path", path, isinstance(path, str | Path), "the path of an input file")
    given.kind("comm", comm, isinstance(comm, MPI.Comm), "an MPI communicator", "as MPI.COMM_WORLD")
    given.flag("soft", soft)
    file, kept = Path(path).expanduser().absolute(), dict[str, Any]()

    def read() -> RawMesh:
        if not file.is_file():
            raise MissingFileError(f"input file {path} does not exist")
        numbers = read_numbers(file)
        kept["model"] = model_of(numbers)
        found = found_of(numbers, file)
        # sections and ties may join kinds of cells, of which a mesh has one
        kinds = {block.base for block in found.bodies}
        several = len(kinds) != 1 or kinds <= {"wedge", "pyramid"}
        if several:
            kept["model"].left_out.append(f"{', '.join(sorted(kinds))}: divided into triangles or tetrahedra")
        raw = raw_of(found, file, simplices=several)
        for surface, *_ in kept["model"].pretension:
            raw = cut(raw, surface)
        nodes = np.array(sorted(numbers.nodes), dtype=np.int64)
        assert raw.of_file is not None
        # nodes in the middle of cells that were made complete have no number
        kept["numbers"] = np.where(raw.of_file < len(nodes), nodes[np.minimum(raw.of_file, len(nodes) - 1)], -1)
        return raw

    mesh, tags = distributed(comm, read, path)
    deck = Deck(mesh, tags, comm.bcast(kept.get("model"), root=0), kept.get("numbers"), soft)
    if deck.left_out and comm.rank == 0:
        logger.warning("%s: without counterpart, or taken otherwise: %s", path, "; ".join(deck.left_out))
    return deck
