"""Checkpoints: whatever is written on some ranks is read on others to the last bit, and a run continues as if it had never stopped.

Two tests to read first: ``test_any_ranks_to_any_ranks`` (random values of every kind of Function, by their places alone) and
``test_going_on_is_not_having_stopped`` (bit for bit in serial).
"""

from __future__ import annotations

import functools
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, blocks, box, clamp, highest, modulus, scene, st_venant
from restart_scenes import COMM, bits, lead, slider

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.restart import numbering

# -- fields ----------------------------------------------------------------------------------------------------------------


@functools.cache
def spaces(mesh):
    """Every kind of space that a checkpoint holds, with the reference points of a cell's nodes; None for Lagrange."""
    g = mesh.geometry.dim
    middle = np.full((1, g), 0.5 if compat.cell_name(mesh) in ("quadrilateral", "hexahedron") else 1 / (g + 1))
    found = {f"P{k}{shape}": (compat.function_space(mesh, k, shape), None) for k, shape in product((1, 2), ((), (g,), (g, g)))}
    found |= {f"DG0{shape}": (compat.function_space(mesh, ("DG", 0), shape), middle) for shape in ((), (g,))}
    for k, shape in ((2, ()), (3, (4,))):
        found[f"Q{k}{shape}"] = compat.quadrature_space(mesh, k, shape), forms.quadrature_rule(compat.cell_name(mesh), k)[0]
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
    # a name of more than 256 bytes
    long = folder / ("a" * 150) / ("b" * 150) / "all"
    uem.write_checkpoint(long, uem.State(here, fields_on(here, 1), numbers=dict(numbers)))
    # the same bytes, on all ranks
    assert (folder / "one").read_bytes() == long.read_bytes()
    for file, mesh in product(("one", long), (here, alone)):
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


def facets_of(target):
    """Middles of all facets of a target by their number, on every rank."""
    facets = target.facets
    return np.concatenate(facets.config.comm.allgather(facets.config.X[facets.dofs].mean(axis=1)))


def random_state(pair, seed):
    """A state that depends on the contactors' places alone, with facets by theirs."""
    g, middles = pair.config.gdim, facets_of(pair.target)
    r = noise(pair.config.X[pair.nodes], 5 + 2 * g, seed)
    by_place = np.append(np.lexsort(np.round(middles, 6).T), -1)
    facets = by_place[np.floor(0.499 * (1 + r[:, :g]) * len(by_place)).astype(int)]
    counts = np.floor(9 * np.abs(r[:, g : g + 2])).astype(int)
    return PairState(
        r[:, g + 2] > 0,
        r[:, 2] > 0,
        r[:, g + 2] > 0,
        r[:, g + 3],
        r[:, g + 4],
        r[:, g + 5 :],
        facets[:, 0],
        facets[:, 1:],
        counts[:, 0],
        r[:, 0] > 0,
        r[:, 1] > 0,
        r[:, 0] + r[:, 1] > 0,
        counts.sum(axis=1),
    )


def same_states(a, b):
    kept, others = (state.to_checkpoint(lambda facets: facets) for state in (a, b))
    return kept.keys() == others.keys() and all(np.array_equal(bits(kept[name]), bits(others[name])) for name in kept)


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
            c.pair.committed = random_state(c.pair, i)
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
            c.pair.committed = c.pair.trial = nothing
        uem.read_checkpoint(folder / file, uem.State(mesh, contacts=contacts))
        for i, c in enumerate(contacts):
            wanted = random_state(c.pair, i)
            good = same_states(c.pair.committed, wanted) and same_states(c.pair.trial, wanted)
            assert all(COMM.allgather(good))


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "normals"),
    [
        ("quadrilateral", "facet"),
        pytest.param("triangle", "averaged", marks=pytest.mark.slow),
        pytest.param("tetrahedron", "facet", marks=pytest.mark.slow),
        pytest.param("triangle", "facet", marks=pytest.mark.slow),
        pytest.param("quadrilateral", "averaged", marks=pytest.mark.slow),
        pytest.param("tetrahedron", "averaged", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_going_on_is_not_having_stopped(cell, normals, folder):
    """Ten steps over the facets, and the last six of them from a file: the same bits in serial, the same to 1e-9 on more ranks."""
    s, contact, whole = slider(COMM, cell, normals=normals)
    iterations = lead(whole, range(1, 5))
    facets = contact.pair.kinematics.projection.facet.copy()
    iterations += lead(whole, range(5, 11))
    moved = contact.pair.trial.active & (contact.pair.kinematics.projection.facet != facets)
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
        for name in ("committed", "largest_forces"):
            assert np.array_equal(getattr(first, name), getattr(second, name))
        assert np.array_equal(first.bodies.stiffness, second.bodies.stiffness)
    assert lead(second, range(5, 11)) == iterations[4:]
    u, v = s.gather(whole.u), t.gather(second.u)
    assert np.abs(u - v).max() <= 1e-9 * np.abs(u).max()
    # each mesh is shared out among the ranks in its own way
    field, other_field = s.gather(contact.pressure), t.gather(other.pressure)
    assert np.abs(field - other_field).max() <= 1e-9 * contact.max_pressure()
    if COMM.size == 1:
        assert np.array_equal(bits(whole.u.x.array), bits(second.u.x.array))
        assert whole.largest_forces == second.largest_forces
        assert same_states(contact.pair.committed, other.pair.committed)
        # writing has not changed the run either
        lead(first, range(5, 11))
        assert np.array_equal(bits(whole.u.x.array), bits(first.u.x.array))


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
def test_moving_rigid_surface(sliding, coupling, folder):
    """The tool is where it was, before the script has moved it again, and the steps after are the same."""

    def pressed():
        s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [4, 4])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, ball = fem.Function(V), uem.RigidSphere((0.5, 1.5), 0.5)
        contact = uem.Contact(s.tag("top", 0, at(1, 1.0)), ball, sliding=sliding, coupling=coupling)
        bcs = clamp(V, s.tag("base", 0, at(1, 0.0)))
        problem = uem.UnitedProblem(
            st_venant(u, 1.0), u, bcs=bcs, contacts=[contact], rtol=1e-11,
            load=lambda k: ball.move((0.01 * k, -0.02 * k), 0.1 * k),
        )  # fmt: skip
        return s, ball, contact, problem

    s, _, _, whole = pressed()
    lead(whole, range(1, 4))
    uem.write_checkpoint(folder / "run", whole.state())
    gap = whole.pairs[0].kinematics.gap.copy()
    lead(whole, range(4, 7))
    t, ball, contact, other = pressed()
    uem.read_checkpoint(folder / "run", other.state())
    assert ball.reference(2) == pytest.approx([0.53, 1.44], abs=0.0, rel=1e-15)
    assert highest(COMM, np.abs(contact.pair.kinematics.gap - gap)) <= (0.0 if COMM.size == 1 else 1e-14)
    lead(other, range(4, 7))
    u, v = s.gather(whole.u), t.gather(other.u)
    assert np.abs(u).max() > 0.01 and np.abs(u - v).max() <= (0.0 if COMM.size == 1 else 1e-9 * np.abs(u).max())


def test_multigrid_continues_too(folder):
    """What a preconditioner has learnt is no part of the state: a run that writes and one that reads continue from the same."""

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


@pytest.mark.long
def test_falling_body_continues(folder):
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
