"""Runs that are interrupted and continued: scenes for the tests of checkpoints and for the processes that these start."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, modulus, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD
DT, END, TOLERANCE, SIZE = 0.02, 0.2, 1e-2, 2.0


def bits(a):
    """An array as integers, in which -0.0 is not 0.0."""
    return np.ascontiguousarray(a).view(np.uint8)


def continues_alike(own, whole):
    """Assert that two runs end alike: to the last bit, on several ranks to rounding, where MUMPS adds what comes in the order it comes in.

    Args:
        own: values of the run that went on, on this rank.
        whole: of the one that was left alone.
    """
    if COMM.size == 1:
        assert np.array_equal(bits(own), bits(whole))
    scale = COMM.allreduce(np.abs(whole).max(initial=0.0), MPI.MAX)
    assert COMM.allreduce(np.abs(own - whole).max(initial=0.0), MPI.MAX) <= 1e-11 * scale


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
        found.append(len(problem.solve()))
    return found


def small(comm=COMM, *, degree=1, name="u", numbers=("time",), seed=None, **how):
    """A Function, a number, nothing else."""
    b = blocks(comm, "triangle", gap=0.1, **how)
    u = fem.Function(compat.function_space(b.scene.mesh, degree, (2,)))
    u.x.array[:] = -1.0 if seed is None else 3.0
    return uem.State(b.scene.mesh, {name: u}, numbers=dict.fromkeys(numbers, 1.5))


class Killed(uem.Checkpoint):
    """Of a run that is left as one that is killed: nothing more is written."""

    def leave(self, *what):
        """Write nothing."""


class Impact:
    """A plastic block that flies aslant onto a plastic one, which a moving foot and a growing load drive against it."""

    def __init__(
        self, comm=COMM, *, scheme=None, kind="plane_strain", plastic=True, moving=True, dynamic=True, max_iterations=4, time=0.0
    ):
        cell = "quadrilateral"
        low = box(cell, [0.0, 0.0], [2.0, 1.0], [6, 3])
        high = box(cell, [0.43, 1.05], [1.27, 1.9], [4, 5])
        self.s = s = scene(comm, cell, [low, high], shuffle=6)
        self.V = V = compat.function_space(s.mesh, 1, (2,))
        self.u, w, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
        X = V.tabulate_dof_coordinates()[: len(self.u.x.array) // 2]
        velocity.x.array.reshape(-1, 2)[X[:, 1] > 1.02] = [0.3, -0.5]
        self.foot, self.push = fem.Function(V), fem.Constant(s.mesh, 0.0)
        base = fem.locate_dofs_topological(V, 1, s.tag("base", 0, at(1, 0.0)).entities)
        self.bcs = [fem.dirichletbc(self.foot, base)] if moving else clamp(V, s.tag("base", 0, at(1, 0.0)))
        self.law = uem.VonMises(self.u, 100.0, 0.3, 3.0 if plastic else np.inf, 5.0, kind=kind, strain="green_lagrange")
        top = forms.surface_measure(s.mesh, s.tag("top", 1, at(1, 1.9)).entities)
        self.external = -self.push * w[1] * top
        self.contact = uem.Contact(s.tag("tip", 1, at(1, 1.05)), s.tag("face", 0, at(1, 1.0)), name="impact")
        moves = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=scheme, velocity=velocity, gravity=(0.0, -1.0), time=time)
        self.problem = uem.UnitedProblem(
            self.law.residual(w) - self.external, self.u, bcs=self.bcs, contacts=[self.contact], materials=[self.law],
            dynamics=moves if dynamic else None,
            load=self.load, rtol=1e-10, max_iterations=max_iterations,
        )  # fmt: skip

    def load(self, t):
        """The foot moves smoothly from rest, the push grows with time."""
        self.foot.x.array.reshape(-1, 2)[:] = [0.0, 0.5 * t**2]
        self.push.value = 0.2 + t

    def run(self, folder, *, every=10**6, stop=None, end=END, tolerance=TOLERANCE, dt=DT):
        """Step with tables ``energy.csv`` and ``history.csv`` and the checkpoint ``run`` in a folder; returns the steps."""
        checkpoint, steps = Killed(folder / "run", every=every), []
        checkpoint.begin(self.problem.state())
        with (
            uem.EnergyBook(self.problem, external=self.external, path=folder / "energy.csv", resume=True) as book,
            uem.HistoryWriter(folder / "history.csv", self.problem, resume=True) as history,
        ):
            for step in uem.time_steps(self.problem, dt, end, event_tolerance=tolerance, checkpoint=checkpoint):
                steps.append(step)
                book.write(step)
                history.write(step)
                if step.number == stop:
                    break
        self.book = book
        return steps
