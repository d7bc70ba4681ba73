"""Files that are no checkpoint, are damaged, or belong to another run: refused on all ranks alike, and nothing is changed.

The test to read first is ``test_damaged_files``.
"""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, raised
from restart_scenes import COMM, slider, small

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.files import OwnFile


def untouched(state):
    return all(COMM.allgather(bool((state.functions["u"].x.array == -1.0).all()))) and state.numbers["time"] == 1.5


@pytest.mark.parametrize(
    "content, match",
    [
        (None, "there is no file .*run.*check the name"),
        (b"", "damaged: expected at least 128 bytes, found 0"),
        (b"uem_dolfinx check", "damaged: expected at least 128 bytes, found 17"),
        (b"<?xml version='1.0'?>" * 20, "is not a checkpoint: expected a file that begins with 'uem_dolfinx checkpoint', found"),
        (b"\0" * 5000, "is not a checkpoint"),
    ],
)
def test_files_that_are_none(content, match, folder):
    state = small()
    if content is not None and COMM.rank == 0:
        (folder / "run").write_bytes(content)
    COMM.barrier()
    raised(uem.CheckpointError, match, lambda: uem.read_checkpoint(folder / "run", state))
    assert untouched(state)


def test_damaged_files(folder):
    """Cut at any length, or with any byte changed, a file is refused and the state stays as it is."""
    uem.write_checkpoint(folder / "run", small(seed=1))
    whole, state = (folder / "run").read_bytes(), small()
    assert len(whole) > 800
    cuts = [whole[:n] for n in (1, 21, 22, 60, 127, 128, 200, len(whole) // 2, len(whole) - 1)] + [whole + b"\0"]
    rng = np.random.default_rng(1)
    where = [*range(0, 128, 3), *range(128, len(whole), max(1, len(whole) // 60)), len(whole) - 1]
    flips = [whole[:i] + bytes([whole[i] ^ (1 << int(rng.integers(8)))]) + whole[i + 1 :] for i in where]
    for content in cuts + flips:
        if COMM.rank == 0:
            (folder / "run").write_bytes(content)
        COMM.barrier()
        raised(uem.CheckpointError, "damaged|not a checkpoint|has format", lambda: uem.read_checkpoint(folder / "run", state))
        assert untouched(state)
    if COMM.rank == 0:
        (folder / "run").write_bytes(whole)
    COMM.barrier()
    uem.read_checkpoint(folder / "run", state)
    assert all(COMM.allgather(bool((state.functions["u"].x.array == 3.0).all())))


def test_another_format(folder):
    """Files of an older layout are refused, not misread."""
    uem.write_checkpoint(folder / "run", small())
    if COMM.rank == 0:
        (folder / "run").write_bytes((folder / "run").read_bytes().replace(b"format 8", b"format 7", 1))
    COMM.barrier()
    raised(
        uem.CheckpointError,
        "run has format 7: expected format 8; read it with",
        lambda: uem.read_checkpoint(folder / "run", small()),
    )


@pytest.mark.parametrize(
    "other, match",
    [
        ({"shuffle": 3}, "for mesh expected 40 triangle cells in 2D, fingerprint"),
        ({"n_low": 3}, "for mesh expected 50 triangle cells .*, found 40 triangle cells"),
        ({"pose": lambda x: x * (1 + 2**-52)}, "for mesh expected 40 triangle cells"),
        (
            {"degree": 2},
            "for function 'u' expected Lagrange 2, 2 components at 106 nodes, found Lagrange 1, 2 components at 34 nodes",
        ),
        ({"name": "v"}, "for function 'v' expected Lagrange 1.*, found nothing"),
        ({"numbers": ("time", "step")}, "for number 'step' expected a value, found nothing"),
        ({"numbers": ()}, "for number 'time' expected nothing, found a value"),
    ],
)
def test_checkpoints_of_other_runs(other, match, folder):
    uem.write_checkpoint(folder / "run", small(seed=1))
    state = small(**other)
    raised(
        uem.CheckpointError,
        "belongs to another run: " + match + ".*continue with the script",
        lambda: uem.read_checkpoint(folder / "run", state),
    )
    assert all(COMM.allgather(all(bool((u.x.array == -1.0).all()) for u in state.functions.values())))


@pytest.mark.parametrize(
    "other, match",
    [
        ({"name": "wheel on rail"}, "for contact 1 'wheel on rail' expected 3 contactors.*, found nothing"),
        ({"target": lambda x: at(1, 0.0)(x) & (x[:, 0] < 2.6)}, "for contact 1 'high on low' expected 3 contactors, surfaces"),
    ],
)
def test_other_contacts(other, match, folder):
    uem.write_checkpoint(folder / "run", slider()[2].state())
    _, contact, problem = slider(**other)
    before = contact.pair.committed
    raised(uem.CheckpointError, match, lambda: uem.read_checkpoint(folder / "run", problem.state()))
    assert contact.pair.committed is before


def test_quadrature_of_another_degree(folder):
    """Rules of degrees 3 and 4 have as many points on a triangle, at other places."""
    mesh = blocks(COMM, "triangle").scene.mesh
    stress = {k: fem.Function(compat.quadrature_space(mesh, k, (4,))) for k in (3, 4)}
    assert len(stress[3].x.array) == len(stress[4].x.array)
    uem.write_checkpoint(folder / "run", uem.State(mesh, {"stress": stress[3]}))
    raised(
        uem.CheckpointError,
        "expected Quadrature 4.* found Quadrature 3",
        lambda: uem.read_checkpoint(folder / "run", uem.State(mesh, {"stress": stress[4]})),
    )


def test_states_that_no_checkpoint_holds(folder):
    """Refused before the disk is touched: elements whose order depends on the partition, and numbers that JSON does not know."""
    mesh = blocks(COMM, "triangle").scene.mesh
    cubic = uem.State(mesh, {"u": fem.Function(compat.function_space(mesh, 3))})
    raised(
        uem.CheckpointError,
        "cannot hold a Function of .*: expected Lagrange of degree 1 or 2",
        lambda: uem.write_checkpoint(folder / "run", cubic),
    )
    numbers = uem.State(mesh, numbers={"place": fem.Constant(mesh, 1.0)})
    raised(
        uem.CheckpointError,
        "number 'place' cannot be kept .* keep fields as Functions",
        lambda: uem.write_checkpoint(folder / "run", numbers),
    )
    COMM.barrier()
    assert list(folder.iterdir()) == []


def test_folder_that_cannot_be_made(folder):
    """A file stands where the folder should be: the error names the checkpoint, on all ranks."""
    if COMM.rank == 0:
        (folder / "out").write_text("in the way")
    COMM.barrier()
    raised(
        uem.CheckpointError,
        "out/run cannot be written .*: check the folder",
        lambda: uem.write_checkpoint(folder / "out" / "run", small()),
    )


def test_writing_that_fails_leaves_the_last_file(folder, monkeypatch):
    """On one rank the disk is full: all ranks raise, the file before is whole, and nothing else is left."""
    uem.write_checkpoint(folder / "run", small(seed=1))
    before = (folder / "run").read_bytes()

    def full(self, offset, array):
        raise OSError("no space left on device")

    if COMM.rank == COMM.size - 1:
        monkeypatch.setattr(OwnFile, "write_at", full)
    raised(
        uem.CheckpointError, "cannot be written .no space left on device.", lambda: uem.write_checkpoint(folder / "run", small())
    )
    COMM.barrier()
    assert [f.name for f in folder.iterdir()] == ["run"] and (folder / "run").read_bytes() == before
