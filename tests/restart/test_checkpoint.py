"""Checkpoints: whatever is written on some ranks is read on others to the last bit, and a run goes on as if it had never stopped.

Two tests to read first: ``test_any_ranks_to_any_ranks`` (random values of every kind of Function, told by their places alone) and
``test_going_on_is_not_having_stopped`` (bit for bit in serial).
"""

from __future__ import annotations

import functools
import os
import signal
import threading
import time
from dataclasses import fields
from itertools import product
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, blocks, box, clamp, highest, modulus, scene, st_venant, start_process

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.restart import numbering

COMM = MPI.COMM_WORLD
serial = pytest.mark.skipif(COMM.size > 1, reason="starts processes of its own")


def alike(match, call):
    """The same CheckpointError on every rank."""
    with pytest.raises(uem.CheckpointError, match=match) as caught:
        call()
    assert len(set(COMM.allgather(str(caught.value)))) == 1


def bits(a):
    """An array as integers, in which -0.0 is not 0.0."""
    return np.ascontiguousarray(a).view(np.uint8)


# -- fields ----------------------------------------------------------------------------------------------------------------


@functools.cache
def spaces(mesh):
    """Every kind of space that a checkpoint holds, with the reference points of a cell's nodes; None for Lagrange."""
    g = mesh.geometry.dim
    middle = np.full((1, g), 0.5 if compat.cell_name(mesh) in ("quadrilateral", "hexahedron") else 1 / (g + 1))
    found = {f"P{k}{shape}": (compat.function_space(mesh, k, shape), None) for k, shape in product((1, 2), ((), (g,), (g, g)))}
    found |= {f"DG0{shape}": (compat.dg0_space(mesh, shape), middle) for shape in ((), (g,))}
    for k, shape in ((2, ()), (3, (4,))):
        found[f"Q{k}{shape}"] = compat.quadrature_space(mesh, k, shape), forms.quadrature_rule(mesh, k)[0]
    return found


def places(V, points):
    """Where the owned nodes of a space are ``(n_owned, gdim)``, from the geometry of the cells if ``points`` are given."""
    g, n = V.mesh.geometry.dim, V.dofmap.index_map.size_local
    if points is None:
        return V.tabulate_dof_coordinates()[:n, :g]
    N = forms.create_lagrange_element(compat.cell_name(V.mesh), 1).tabulate(0, points)[0, :, :, 0]
    x = np.empty((n + V.dofmap.index_map.num_ghosts, g))
    x[compat.cell_dofs(V)] = np.einsum("pa,cag->cpg", N, V.mesh.geometry.x[compat.geometry_dofs(V.mesh)][:, :, :g])
    return x[:n]


def noise(x, n, seed):
    """Numbers between -1 and 1 that depend on the place alone ``(len(x), n)``."""
    place = np.round(x * 2**20) @ np.array([1.0, 1e3, 1e6])[: x.shape[1]] + seed
    return np.sin(place[:, None] * np.arange(1, n + 1))


def values_at(x, n, seed):
    """Doubles of every size that depend on the place alone ``(len(x), n)``, among them zeros of both signs and infinity."""
    out = noise(x, n, seed)
    kind = np.floor(1000 * np.abs(out[:, 0])).astype(int)
    out *= 10.0 ** (kind[:, None] % 600 - 300)
    for k, special in enumerate((0.0, -0.0, np.inf, -np.inf, 5e-324)):
        out[kind % 13 == k, 0] = special
    return out


def fields_on(mesh, seed=None):
    """A Function in every space; without seed it holds -1."""
    found = {}
    for name, (V, points) in spaces(mesh).items():
        u = found[name] = fem.Function(V)
        u.x.array[:] = -1.0
        if seed is not None:
            x = places(V, points)
            u.x.array[: len(x) * V.dofmap.index_map_bs] = values_at(x, V.dofmap.index_map_bs, seed).ravel()
    return found


def right(functions, seed):
    """Whether every Function has the values of its places, ghosts those of their owners."""
    good = True
    for name, u in functions.items():
        V = u.function_space
        x, bs = places(V, spaces(V.mesh)[name][1]), V.dofmap.index_map_bs
        owned = u.x.array[: len(x) * bs]
        good &= np.array_equal(bits(owned), bits(values_at(x, bs, seed).ravel()))
        before = u.x.array.copy()
        u.x.scatter_forward()
        good &= np.array_equal(bits(before), bits(u.x.array))
    return good


@pytest.mark.parametrize("chunk", [5, numbering.CHUNK])
@pytest.mark.parametrize("cell", CELLS)
def test_any_ranks_to_any_ranks(cell, chunk, folder, monkeypatch):
    """One rank to all ranks, all ranks to one and to all; chunks that many ranks share and ones that are larger than the mesh."""
    monkeypatch.setattr(numbering, "CHUNK", chunk)
    here = blocks(COMM, cell, 1, 2, gap=0.1, shuffle=5).scene.mesh
    alone = blocks(MPI.COMM_SELF, cell, 1, 2, gap=0.1, shuffle=5).scene.mesh
    numbers = {"time": 0.1 + 0.2, "step": 7, "name": "run", "list": [1e-320, -0.0, float("inf")], "array": np.float64(1 / 3)}
    if COMM.rank == 0:
        uem.write_checkpoint(folder / "one", uem.State(alone, fields_on(alone, 1), numbers=numbers))
    COMM.barrier()
    uem.write_checkpoint(folder / "all", uem.State(here, fields_on(here, 1), numbers=dict(numbers)))
    # the same bytes, whoever writes them
    assert (folder / "one").read_bytes() == (folder / "all").read_bytes()
    for file, mesh in product(("one", "all"), (here, alone)):
        state = uem.State(mesh, fields_on(mesh), numbers=dict.fromkeys(numbers))
        uem.read_checkpoint(folder / file, state)
        assert all(COMM.allgather(right(state.functions, 1)))
        assert repr(state.numbers) == repr({**numbers, "array": 1 / 3})
    assert not right(fields_on(here), 1)


@pytest.mark.parametrize("cell", CELLS)
def test_cells_keep_the_order_of_their_vertices(cell):
    """What the order of the file rests on: nodes of a cell in the order of the input, in every partition."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    body = box(cell, [0.0] * g, [1.0] * g, [3] * g)
    order = np.random.default_rng(3).permutation(len(body.x))
    cells, given = np.argsort(order)[body.cells], slice(None) if COMM.rank == 0 else slice(0)
    mesh = compat.create_mesh(COMM, cells[given], body.x[order][given], cell, 1)
    # Gmsh goes round a quadrilateral, DOLFINx row by row
    rows = {"quadrilateral": [0, 1, 3, 2], "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6]}.get(cell, slice(None))
    nodes = np.asarray(mesh.geometry.input_global_indices)[compat.geometry_dofs(mesh)]
    assert all(COMM.allgather(np.array_equal(nodes, cells[forms.original_cells(mesh)][:, rows])))


def test_fingerprint():
    """The same on any ranks; another for a coordinate that differs in its last bit, and for another order of nodes or cells."""

    def mesh(comm, shift=0.0, shuffle=2):
        def pose(x):
            y = x.copy()
            y[3, 1] += shift * np.spacing(abs(y[3, 1]))
            return y

        return blocks(comm, "triangle", pose=pose, shuffle=shuffle, gap=0.1).scene.mesh

    mine = numbering.mesh_fingerprint(mesh(COMM))
    assert set(COMM.allgather(numbering.mesh_fingerprint(mesh(MPI.COMM_SELF)))) == {mine}
    others = [numbering.mesh_fingerprint(m) for m in (mesh(COMM, shift=1.0), mesh(COMM, shuffle=4), mesh(COMM, shuffle=None))]
    assert len({mine, *others}) == 4


# -- contacts --------------------------------------------------------------------------------------------------------------


def slider(comm=COMM, cell="quadrilateral", *, normals="facet", degree=1, name=None, target=None):
    """A block led along a wave of a slab, up and down its facets; ``problem.load(k)`` is for step k of 10."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3

    def waved(x):
        y, low = x.copy(), x[:, -1] <= 1e-9
        y[low, -1] += 0.05 * np.sin(2 * np.pi * x[low, 0] / 1.5) * (1 + x[low, -1] / 0.75)
        return y

    low = box(cell, [0.0, *[-0.2] * (g - 2), -0.75], [3.0, *[0.6] * (g - 2), 0.0], [12, *[2] * (g - 2), 3])
    high = box(cell, [0.4, *[0.0] * (g - 2), 0.05], [0.8, *[0.4] * (g - 2), 0.45], [2, *[1] * (g - 2), 2])
    s = scene(comm, cell, [low, high], pose=waved, shuffle=8)
    V = compat.function_space(s.mesh, degree, (g,))
    u, place = fem.Function(V, name="u"), fem.Function(V)
    lid = fem.locate_dofs_topological(V, g - 1, s.tag("lid", 1, at(g - 1, 0.45)).entities)
    bcs = [*clamp(V, s.tag("base", 0, at(g - 1, -0.75))), fem.dirichletbc(place, lid)]
    contact = uem.Contact(
        s.tag("high", 1, at(g - 1, 0.05)),
        s.tag("low", 0, target or at(g - 1, 0.0)),
        normals=normals,
        max_penetration=0.1,
        name=name,
    )

    def load(k):
        way = 0.12 * k
        sink = 0.05 * np.sin(2 * np.pi * (way + 0.6) / 1.5) - 0.05 - 0.05 * min(1.0, k)
        place.x.array.reshape(-1, g)[:] = [way, *[0.0] * (g - 2), sink]

    problem = uem.UnitedProblem(st_venant(u, modulus(s, 1.0, 2.0)), u, bcs=bcs, contacts=[contact], rtol=1e-10, load=load)
    return s, contact, problem


def lead(problem, steps):
    """Solve some steps; the number of iterations of each."""
    found = []
    for k in steps:
        problem.load(k)
        found.append(len(problem.solve(ratio=float(k > 1))))
    return found


def facets_told(target):
    """Middles of all facets of a target by their number, on every rank."""
    facets = target.facets
    return np.concatenate(facets.config.comm.allgather(facets.config.X[facets.dofs].mean(axis=1)))


def random_state(pair, seed):
    """A state that depends on the contactors' places alone, with facets told by theirs."""
    g, middles = pair.config.gdim, facets_told(pair.target)
    r = noise(pair.config.X[pair.nodes], 5 + 2 * g, seed)
    by_place = np.append(np.lexsort(np.round(middles, 6).T), -1)
    facets = by_place[np.floor(0.499 * (1 + r[:, :g]) * len(by_place)).astype(int)]
    counts = np.floor(9 * np.abs(r[:, g : g + 2])).astype(int)
    return PairState(
        r[:, g + 2] > 0,
        r[:, g + 3],
        r[:, g + 4],
        r[:, g + 5 :],
        facets[:, 0],
        facets[:, 1:],
        counts[:, 0],
        counts[:, 1],
        r[:, 0] > 0,
    )


def same_states(a, b):
    return all(np.array_equal(bits(getattr(a, f.name)), bits(getattr(b, f.name))) for f in fields(PairState))


@pytest.mark.parametrize("chunk", [3, numbering.CHUNK])
@pytest.mark.parametrize("cell", CELLS)
def test_states_of_contacts_find_their_facets(cell, chunk, folder, monkeypatch):
    """Random states of all contactors, between one rank and all; facets are where they were, whatever their number is now."""
    monkeypatch.setattr(numbering, "CHUNK", chunk)
    scenes = {}
    for name, comm in (("one", MPI.COMM_SELF), ("all", COMM)):
        b = blocks(comm, cell, gap=0.1, overhang=0.3, shuffle=5, n_low=4)
        # averaged normals take any state, while corners hold lawful ones only
        contacts = [uem.Contact(b.high, b.low, normals="averaged"), uem.Contact(b.low, b.high, normals="averaged")]
        problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom) + clamp(b.V, b.top), contacts=contacts)
        scenes[name] = b.scene.mesh, contacts, problem

    def write(name):
        mesh, contacts, _ = scenes[name]
        for i, c in enumerate(contacts):
            c.pair.committed, c.pair.last_commit = random_state(c.pair, i), random_state(c.pair, i + 10)
            c.pair._reserved = c.pair.committed.active.copy()
        uem.write_checkpoint(folder / name, uem.State(mesh, contacts=contacts))

    if COMM.rank == 0:
        write("one")
    COMM.barrier()
    write("all")
    assert (folder / "one").read_bytes() == (folder / "all").read_bytes()
    for file, name in product(("one", "all"), scenes):
        mesh, contacts, _ = scenes[name]
        for c in contacts:
            nothing = random_state(c.pair, 99)
            c.pair.committed = c.pair.last_commit = c.pair.trial = nothing
            c.pair._reserved = np.zeros(len(c.pair.nodes), bool)
        uem.read_checkpoint(folder / file, uem.State(mesh, contacts=contacts))
        for i, c in enumerate(contacts):
            wanted = random_state(c.pair, i)
            good = same_states(c.pair.committed, wanted) and same_states(c.pair.trial, wanted)
            good &= same_states(c.pair.last_commit, random_state(c.pair, i + 10))
            assert all(COMM.allgather(good and np.array_equal(c.pair._reserved, wanted.active)))


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_going_on_is_not_having_stopped(cell, normals, folder):
    """Ten steps over the facets, and the last six of them from a file: the same bits in serial, the same to 1e-9 on more ranks."""
    s, contact, whole = slider(COMM, cell, normals=normals)
    iterations = lead(whole, range(1, 5))
    facets = contact.pair.projection.facet.copy()
    iterations += lead(whole, range(5, 11))
    moved = contact.pair.trial.active & (contact.pair.projection.facet != facets)
    assert contact.n_active > 0 and COMM.allreduce(int(moved.sum())) > 0
    # written by one rank, read by all
    if COMM.rank == 0:
        _, _, first = slider(MPI.COMM_SELF, cell, normals=normals)
        lead(first, range(1, 5))
        uem.write_checkpoint(folder / "run", first.state())
    COMM.barrier()
    t, other, second = slider(COMM, cell, normals=normals)
    uem.read_checkpoint(folder / "run", second.state())
    if COMM.size == 1:
        for name in ("committed", "_last", "_largest_forces"):
            assert np.array_equal(getattr(first, name), getattr(second, name))
        assert np.array_equal(first.system._stiffness.array_r, second.system._stiffness.array_r)
    assert lead(second, range(5, 11)) == iterations[4:]
    u, v = s.gather(whole.u), t.gather(second.u)
    assert np.abs(u - v).max() <= 1e-9 * np.abs(u).max()
    # each mesh is shared out among the ranks in its own way
    field, other_field = s.gather(contact.pressure), t.gather(other.pressure)
    assert np.abs(field - other_field).max() <= 1e-9 * contact.max_pressure()
    if COMM.size == 1:
        assert np.array_equal(bits(whole.u.x.array), bits(second.u.x.array))
        assert np.array_equal(bits(whole._last), bits(second._last)) and whole._largest_forces == second._largest_forces
        for a, b in ((contact.pair.committed, other.pair.committed), (contact.pair.last_commit, other.pair.last_commit)):
            assert same_states(a, b)
        assert np.array_equal(contact.pair._reserved, other.pair._reserved)
        # writing has not changed the run either
        lead(first, range(5, 11))
        assert np.array_equal(bits(whole.u.x.array), bits(first.u.x.array))


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
def test_moving_rigid_surface(sliding, folder):
    """The tool is where it was, before the script has moved it again, and the steps after are the same."""

    def pressed():
        s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [4, 4])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, ball = fem.Function(V), uem.RigidSphere((0.5, 1.5), 0.5)
        contact = uem.Contact(s.tag("top", 0, at(1, 1.0)), ball, sliding=sliding)
        bcs = clamp(V, s.tag("base", 0, at(1, 0.0)))
        problem = uem.UnitedProblem(
            st_venant(u, 1.0), u, bcs=bcs, contacts=[contact], rtol=1e-11,
            load=lambda k: ball.move((0.01 * k, -0.02 * k), 0.1 * k),
        )  # fmt: skip
        return s, ball, contact, problem

    s, _, _, whole = pressed()
    lead(whole, range(1, 4))
    uem.write_checkpoint(folder / "run", whole.state())
    gap = whole.system.pairs[0].gap.copy()
    lead(whole, range(4, 7))
    t, ball, contact, other = pressed()
    uem.read_checkpoint(folder / "run", other.state())
    assert ball.reference(2) == pytest.approx([0.53, 1.44], abs=0.0, rel=1e-15)
    assert highest(COMM, np.abs(contact.pair.gap - gap)) <= (0.0 if COMM.size == 1 else 1e-14)
    lead(other, range(4, 7))
    u, v = s.gather(whole.u), t.gather(other.u)
    assert np.abs(u).max() > 0.01 and np.abs(u - v).max() <= (0.0 if COMM.size == 1 else 1e-9 * np.abs(u).max())


def test_multigrid_goes_on_too(folder):
    """What a preconditioner has learnt is no part of the state: a run that writes and one that reads go on from the same."""

    def make():
        b = blocks(COMM, "quadrilateral", 8, 8)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.05])]
        options = {"ksp_type": "cg", "ksp_rtol": 1e-10, "pc_type": "gamg"}
        how = {"contacts": [uem.Contact(b.high, b.low)], "petsc_options": options, "rtol": 1e-8}
        return b, uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, **how)

    def press(b, problem, factors):
        start = np.zeros_like(b.u.x.array)
        for f in factors:
            problem.solve(start=start, fraction=f)

    b, whole = make()
    press(b, whole, (0.3, 0.5))
    uem.write_checkpoint(folder / "run", whole.state())
    press(b, whole, (0.7, 0.9))
    c, other = make()
    uem.read_checkpoint(folder / "run", other.state())
    press(c, other, (0.7, 0.9))
    u, v = b.scene.gather(b.u), c.scene.gather(c.u)
    assert np.abs(u - v).max() <= (0.0 if COMM.size == 1 else 1e-8 * np.abs(u).max())


def test_falling_body_goes_on(folder):
    """A body that only contact holds: where it is supported against neutral motions does not depend on earlier steps."""

    def make():
        b = blocks(COMM, "hexahedron", 2, 4, gap=0.25)
        weight = fem.Constant(b.scene.mesh, np.zeros(3))
        F = st_venant(b.u, modulus(b.scene, 1.0, 2.0), 0.0)
        F -= ufl.inner(weight, ufl.TestFunction(b.V)) * forms.surface_measure(b.scene.mesh, b.top.entities)

        def load(k):
            weight.value[:] = [0.0, 0.0, -0.0025 * k]

        contact = uem.Contact(b.high, b.low)
        return b, uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-12, load=load)

    b, whole = make()
    lead(whole, [1])
    uem.write_checkpoint(folder / "run", whole.state())
    lead(whole, (2, 3, 4))
    c, other = make()
    uem.read_checkpoint(folder / "run", other.state())
    lead(other, (2, 3, 4))
    u, v = b.scene.gather(b.u), c.scene.gather(c.u)
    assert whole.contacts[0].n_active > 0
    assert np.abs(u - v).max() <= (0.0 if COMM.size == 1 else 1e-9 * np.abs(u).max())


# -- refusals --------------------------------------------------------------------------------------------------------------


def small(comm=COMM, *, degree=1, name="u", numbers=("time",), seed=None, **how):
    """A Function, a number, nothing else."""
    b = blocks(comm, "triangle", gap=0.1, **how)
    u = fem.Function(compat.function_space(b.scene.mesh, degree, (2,)))
    u.x.array[:] = -1.0 if seed is None else 3.0
    return uem.State(b.scene.mesh, {name: u}, numbers=dict.fromkeys(numbers, 1.5))


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
    alike(match, lambda: uem.read_checkpoint(folder / "run", state))
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
        alike("damaged|not a checkpoint|has format", lambda: uem.read_checkpoint(folder / "run", state))
        assert untouched(state)
    if COMM.rank == 0:
        (folder / "run").write_bytes(whole)
    COMM.barrier()
    uem.read_checkpoint(folder / "run", state)
    assert all(COMM.allgather(bool((state.functions["u"].x.array == 3.0).all())))


def test_another_format(folder):
    uem.write_checkpoint(folder / "run", small())
    if COMM.rank == 0:
        (folder / "run").write_bytes((folder / "run").read_bytes().replace(b"format 1", b"format 9", 1))
    COMM.barrier()
    alike("run has format 9: expected format 1; read it with", lambda: uem.read_checkpoint(folder / "run", small()))


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
    alike("belongs to another run: " + match + ".*go on with the script", lambda: uem.read_checkpoint(folder / "run", state))
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
    alike(match, lambda: uem.read_checkpoint(folder / "run", problem.state()))
    assert contact.pair.committed is before


def test_quadrature_of_another_degree(folder):
    """Rules of degrees 3 and 4 have as many points on a triangle, at other places."""
    mesh = blocks(COMM, "triangle").scene.mesh
    stress = {k: fem.Function(compat.quadrature_space(mesh, k, (4,))) for k in (3, 4)}
    assert len(stress[3].x.array) == len(stress[4].x.array)
    uem.write_checkpoint(folder / "run", uem.State(mesh, {"stress": stress[3]}))
    alike(
        "expected Quadrature 4.* found Quadrature 3",
        lambda: uem.read_checkpoint(folder / "run", uem.State(mesh, {"stress": stress[4]})),
    )


def test_states_that_no_checkpoint_holds(folder):
    """Refused before the disk is touched: elements whose order depends on the partition, and numbers that JSON does not know."""
    mesh = blocks(COMM, "triangle").scene.mesh
    cubic = uem.State(mesh, {"u": fem.Function(compat.function_space(mesh, 3))})
    alike("cannot hold a Function of .*: expected Lagrange of degree 1 or 2", lambda: uem.write_checkpoint(folder / "run", cubic))
    numbers = uem.State(mesh, numbers={"place": fem.Constant(mesh, 1.0)})
    alike("number 'place' cannot be kept .* keep fields as Functions", lambda: uem.write_checkpoint(folder / "run", numbers))
    COMM.barrier()
    assert list(folder.iterdir()) == []


def test_folder_that_cannot_be_made(folder):
    """A file stands where the folder should be: the error names the checkpoint, on all ranks."""
    if COMM.rank == 0:
        (folder / "out").write_text("in the way")
    COMM.barrier()
    alike("out/run cannot be written .*: check the folder", lambda: uem.write_checkpoint(folder / "out" / "run", small()))


def test_writing_that_fails_leaves_the_last_file(folder, monkeypatch):
    """On one rank the disk is full: all ranks raise, the file before is whole, and nothing else is left."""
    from uem_dolfinx.restart import checkpoint

    uem.write_checkpoint(folder / "run", small(seed=1))
    before = (folder / "run").read_bytes()

    def full(file, offset, array):
        raise OSError("no space left on device")

    if COMM.rank == COMM.size - 1:
        monkeypatch.setattr(checkpoint, "_write", full)
    alike("cannot be written .no space left on device.", lambda: uem.write_checkpoint(folder / "run", small()))
    COMM.barrier()
    assert [f.name for f in folder.iterdir()] == ["run"] and (folder / "run").read_bytes() == before


# -- runs ------------------------------------------------------------------------------------------------------------------


def counted(path, steps, every=3, stop=None):
    """A run that counts its steps; stops by an exception after some of them."""
    state = small(numbers=("time", "step"))
    state.numbers["step"] = 0
    with uem.Checkpoint(path, every=every) as checkpoint:
        begun = checkpoint.begin(state)
        for k in range(state.numbers["step"] + 1, steps + 1):
            state.numbers["step"] = k
            state.functions["u"].x.array[:] = k
            checkpoint.step()
            if k == stop:
                raise KeyboardInterrupt
        checkpoint.finish()
    return begun, state


def step_in(path):
    state = small(numbers=("time", "step"))
    uem.read_checkpoint(path, state)
    assert (state.functions["u"].x.array == state.numbers["step"]).all()
    return state.numbers["step"]


def test_interval_and_end(folder, caplog):
    """Written every three steps and at the end; what was stopped loses no more than an interval and goes on, with a word about it."""
    path = folder / "deeper" / "run"
    with pytest.raises(KeyboardInterrupt):
        counted(path, 20, stop=2)
    assert not path.exists()
    COMM.barrier()
    with pytest.raises(KeyboardInterrupt):
        counted(path, 20, stop=8)
    assert step_in(path) == 6
    begun, state = counted(path, 10)
    assert begun and state.numbers["step"] == 10 and step_in(path) == 10
    begun, state = counted(path, 10)
    assert begun and state.numbers["step"] == 10
    assert COMM.rank > 0 or any("going on from the checkpoint" in r.message for r in caplog.records)
    COMM.barrier()
    assert [f.name for f in path.parent.iterdir()] == ["run"]
    with pytest.raises(ValueError, match="every = 0: expected a number of steps"):
        uem.Checkpoint(path, every=0)


def test_leftovers_are_removed(folder):
    """Half a file of a writing that was killed is no checkpoint, and goes when the run begins anew."""
    if COMM.rank == 0:
        (folder / "run.part").write_bytes(b"uem_dolfinx checkpoint, half of it")
    COMM.barrier()
    begun, _ = counted(folder / "run", 2)
    assert not begun and step_in(folder / "run") == 2
    COMM.barrier()
    assert [f.name for f in folder.iterdir()] == ["run"]


def test_one_number_between_steps(folder, monkeypatch):
    """A step that does not write sends one number around, and touches neither state nor disk."""
    state, calls = small(), []

    class Counting:
        def __init__(self, comm):
            self.comm = comm

        def __getattr__(self, name):
            calls.append(name)
            return getattr(self.comm, name)

    checkpoint = uem.Checkpoint(folder / "run", every=100)
    checkpoint.begin(state)
    monkeypatch.setattr(uem.State, "comm", property(lambda self: Counting(self.mesh.comm)))
    state.collect.append(lambda: calls.append("collect"))
    for _ in range(99):
        checkpoint.step()
    assert calls == ["allreduce"] * 99
    monkeypatch.undo()
    checkpoint.step()
    assert calls[99:] == ["collect"] and (folder / "run").exists()


def test_sigterm_on_one_rank_ends_all(folder):
    """One rank is told to end: all write the step they are at and leave with 143; afterwards the signal is whose it was."""
    before, heard = signal.getsignal(signal.SIGTERM), []
    signal.signal(signal.SIGTERM, lambda *what: heard.append(what))
    try:
        own = signal.getsignal(signal.SIGTERM)
        state = small(numbers=("time", "step"))
        state.numbers["step"] = 1
        state.functions["u"].x.array[:] = 1
        with pytest.raises(SystemExit) as end, uem.Checkpoint(folder / "run", every=100) as checkpoint:
            checkpoint.begin(state)
            checkpoint.step()
            assert not (folder / "run").exists()
            COMM.barrier()
            if COMM.rank == COMM.size - 1:
                os.kill(os.getpid(), signal.SIGTERM)
            state.numbers["step"] = 2
            state.functions["u"].x.array[:] = 2
            checkpoint.step()
        assert end.value.code == 143 and step_in(folder / "run") == 2
        assert signal.getsignal(signal.SIGTERM) is own and heard == []
        # a signal that no step has seen is handed on, and without ``with`` nothing is caught
        with uem.Checkpoint(folder / "run") as checkpoint:
            os.kill(os.getpid(), signal.SIGTERM)
            assert heard == []
        assert len(heard) == 1
        uem.Checkpoint(folder / "run").begin(state)
        assert signal.getsignal(signal.SIGTERM) is own
    finally:
        signal.signal(signal.SIGTERM, before)


def test_no_handler_outside_the_main_thread(folder):
    """Python allows handlers in the main thread only; elsewhere a Checkpoint works without."""
    found = []

    def run():
        with uem.Checkpoint(folder / "run"):
            found.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [before]


RUN = """
import sys
sys.path[:0] = {paths!r}
from test_checkpoint import lead, slider
import uem_dolfinx as uem

_, _, problem = slider()
state = problem.state()
state.numbers["step"] = 0
with uem.Checkpoint({path!r}, every={every}) as checkpoint:
    checkpoint.begin(state)
    while True:
        k = state.numbers["step"] + 1
        lead(problem, [1 + k % 10] if k > 9 else [k])
        state.numbers["step"] = k
        checkpoint.step()
        print(k, flush=True)
"""


def start(path, every):
    """A process that runs until it is done or killed."""
    return start_process(RUN.format(paths=[str(folder) for folder in Path(__file__).parents[:2]], path=str(path), every=every))


@serial
def test_killed_without_warning(folder):
    """kill -9 at any instant, four times over: the file is whole, at most one interval old, and the run goes on from it."""
    last = 0
    for wait in (0.0, 0.003, 0.011, 0.02):
        process = start(folder / "run", 2)
        lines = []
        while len(lines) < 5:
            lines.append(int(process.stdout.readline()))
        time.sleep(wait)
        process.kill()
        lines += [int(line) for line in process.stdout.read().split()]
        process.wait()
        assert lines[0] == last + 1
        _, _, problem = slider()
        state = problem.state()
        state.numbers["step"] = None
        uem.read_checkpoint(folder / "run", state)
        last = state.numbers["step"]
        assert lines[-1] - 2 < last <= lines[-1] + 1
    # it is a state of the run, not just a readable one
    _, _, whole = slider()
    lead(whole, [k if k <= 9 else 1 + k % 10 for k in range(1, last + 1)])
    assert np.array_equal(bits(whole.u.x.array), bits(problem.u.x.array))


@serial
def test_terminated(folder):
    """SIGTERM ends a run with 143 after its step is written, far from the end of the interval."""
    process = start(folder / "run", 10**6)
    for _ in range(3):
        process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    lines = process.stdout.read().split()
    assert process.wait() == 143
    _, _, problem = slider()
    state = problem.state()
    state.numbers["step"] = None
    uem.read_checkpoint(folder / "run", state)
    # the step that was written was not printed any more
    assert state.numbers["step"] == int(lines[-1] if lines else 3) + 1
