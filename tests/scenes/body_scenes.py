"""Many bodies, their surfaces as one skin, and what may touch what, found by loops over all nodes and facets."""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from helpers import Body, at, box, clamp, highest, linear, modulus, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.skin import Skin

COMM = MPI.COMM_WORLD


def dimension(cell):
    return 2 if cell in ("triangle", "quadrilateral") else 3


def ball(cell, middle, radius, n):
    """Disc or ball whose surface has n facets, or n x n, on each of the sides of a box."""
    g = dimension(cell)

    def rounded(x):
        side, y = np.abs(x).max(axis=1, keepdims=True), np.tan(0.25 * np.pi * x)
        length = np.linalg.norm(y, axis=1, keepdims=True)
        return np.asarray(middle) + radius * side * y / np.where(length > 0, length, 1.0)

    return box(cell, [-1.0] * g, [1.0] * g, [n] * g).mapped(rounded)


def turned(body, angle):
    """A body turned about its middle, in the plane of the first two axes."""
    R = np.eye(body.x.shape[1])
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    middle = 0.5 * (body.x.min(axis=0) + body.x.max(axis=0))
    return body.mapped(lambda x: middle + (x - middle) @ R.T)


def without(body: Body, hole) -> Body:
    """A body without the cells whose middles ``hole`` selects, and without nodes that no cell has."""
    cells = body.cells[~hole(body.x[body.cells].mean(axis=1))]
    used = np.unique(cells)
    place = np.full(len(body.x), -1)
    place[used] = np.arange(len(used))
    return Body(body.x[used], place[cells])


def fork(cell, n=1, more=0.0):
    """A fork of two prongs of thickness 0.4 that are 0.1 apart, the lower one longer by ``more``."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    whole = box(cell, [-0.4, -0.45, 0.0][:g], [2.4, 0.45, 0.4][:g], [28 * n, 18 * n, 2][:g])

    def hole(x):
        return (x[:, 0] > 0) & (np.abs(x[:, 1]) < 0.05) | (x[:, 0] > 2) & (x[:, 1] > 0) | (x[:, 0] > 2 + more) & (x[:, 1] < 0)

    return without(whole, hole)


def all_facets(mesh, name="all"):
    """The exterior facets of a mesh."""
    mesh.topology.create_connectivity(mesh.topology.dim - 1, mesh.topology.dim)
    facets = np.asarray(exterior_facet_indices(mesh.topology), dtype=np.int32)
    facets = compat.shared_by_ranks(mesh.topology.index_map(mesh.topology.dim - 1), facets)
    return uem.Tag(name, 0, mesh.topology.dim - 1, mesh, facets)


def skin_of(cell, bodies, degree=1, comm=COMM, tag=None, **how):
    """Scene of bodies and the skin of all of them, or of what ``tag`` makes of the scene."""
    s = scene(comm, cell, bodies, **how)
    config = Configuration(fem.Function(compat.function_space(s.mesh, degree, (dimension(cell),))))
    return s, Skin(config, all_facets(s.mesh) if tag is None else tag(s))


def surface_of(s, body):
    """All exterior facets of a body of a scene, as a tag."""
    every = all_facets(s.mesh).entities
    cells = s.mesh.topology.connectivity(s.mesh.topology.dim - 1, s.mesh.topology.dim)
    facets = np.array([f for f in every if s.body[cells.links(f)[0]] == body], dtype=np.int32)
    return uem.Tag(f"surface {body}", body + 1, s.mesh.topology.dim - 1, s.mesh, facets)


class Bodies:
    """Some bodies in one mesh, by default of one modulus, and their displacement."""

    def __init__(self, cell, bodies, degree=1, E=None, comm=COMM, law=linear, nu=0.3, **how):
        self.s = scene(comm, cell, bodies, **how)
        self.g = self.s.mesh.geometry.dim
        self.V = compat.function_space(self.s.mesh, degree, (self.g,))
        self.u = fem.Function(self.V, name="u")
        self.F = law(self.u, modulus(self.s, *(E or [1.0] * len(bodies))), nu)
        self.parts = bodies

    def push(self, tag, traction):
        """Dead traction on facets."""
        t = fem.Constant(self.s.mesh, np.array(traction, dtype=float))
        self.F -= ufl.inner(t, ufl.TestFunction(self.V)) * forms.surface_measure(self.s.mesh, tag.entities)

    def side(self, body, axis, value):
        """A flat side of a body as a tag."""
        return self.s.tag(f"side {axis} of {body}", body, at(axis, value))

    def problem(self, contacts, bcs, **how):
        return uem.UnitedProblem(self.F, self.u, bcs=bcs, contacts=contacts, **({"rtol": 1e-11} | how))


def bodies_of(problem, s):
    """The body in a scene of every local node."""
    cells, body = compat.cell_dofs(problem.config.V), np.zeros(problem.config.n_local, int)
    body[cells] = s.body[: len(cells), None]
    return body


def close(a, b, length=1.0):
    """Displacements of two Functions on one mesh agree to rounding (collective)."""
    assert highest(COMM, np.abs(a.x.array - b.x.array)) <= 1e-12 * length


class Discs:
    """Discs that fall onto each other, onto a floor and against a wall; hand-declared pairs in the order of the general contact."""

    def __init__(self, rows, columns, n=3, mu=0.2, degree=1):
        d = 0.975
        middles = [[d * j, 0.49 + d * i] for i in range(rows) for j in range(columns)]
        self.b = b = Bodies("quadrilateral", [ball("quadrilateral", m, 0.5, n) for m in middles], degree)
        self.walls = lambda: [uem.RigidPlane((0, 0.0), (0, 1)), uem.RigidPlane((-0.49, 0), (1, 0))]
        self.mu, self.surfaces = mu, [surface_of(b.s, k) for k in range(len(middles))]

    def contacts(self, general, coupling="node_to_surface"):
        how = {"friction": self.mu, "coupling": coupling}
        if general:
            return [uem.GeneralContact(rigid=self.walls(), **how)]
        s, every = self.surfaces, all_facets(self.b.s.mesh)
        pairs = [uem.Contact(a, b, **how) for k, a in enumerate(s) for b in s[k + 1 :]]
        return pairs + [uem.Contact(every, wall, name=f"wall {k}", **how) for k, wall in enumerate(self.walls())]

    def move_alike(self, end, coupling="node_to_surface"):
        """Every step, contactor and displacement of one declaration is that of pairs declared by hand, and iterations but for rounding."""
        found = []
        for general in (True, False):
            problem = self.problem(self.contacts(general, coupling))
            steps = [
                (s.time, s.newton_iterations, sum(c.n_active for c in problem.contacts))
                for s in uem.time_steps(problem, 0.01, end)
            ]
            found.append((problem.u, steps))
        (u, one), (v, other) = found
        assert [(time, active) for time, _, active in one] == [(time, active) for time, _, active in other]
        assert all(abs(a - b) <= 1 for (_, a, _), (_, b, _) in zip(one, other)) and max(n for _, _, n in one) >= 2
        # as accurate as steps of rtol 1e-11 are, since either solves for other contactors on arrays
        close(u, v, 10.0)

    def problem(self, contacts):
        V, u = self.b.V, fem.Function(self.b.V)
        F = st_venant(u, modulus(self.b.s, *[1e4] * len(self.surfaces)))
        moves = uem.Dynamics(uem.lumped_mass(V, 1.0), gravity=(-0.5, -2.0), contactors="massy")
        return uem.UnitedProblem(F, u, contacts=contacts, dynamics=moves, rtol=1e-11)


def grid(cell, n, counts, **how):
    """Unit boxes in a grid, with ``n`` divisions in turn: side by side, one above the other, in 3D one behind the other as well."""
    g = dimension(cell)
    places = list(product(*map(range, counts)))
    bodies = [box(cell, np.array(p, float), np.array(p) + 1.0, [n[k % len(n)]] * g) for k, p in enumerate(places)]
    return Bodies(cell, bodies, **how), places


def oedometer(b, places, counts, settlement):
    """Rollers at all outer sides, the top pushed down."""
    bcs = []
    for k, place in enumerate(places):
        for axis in range(b.g):
            if place[axis] == 0:
                bcs += clamp(b.V, b.side(k, axis, 0.0), axis)
            if place[axis] == counts[axis] - 1:
                end = b.side(k, axis, float(counts[axis]))
                bcs += clamp(b.V, end, axis, value=-settlement if axis == b.g - 1 else 0.0)
    return bcs


def of_quarters(comm, part, n):
    """Scene of ``part`` quarters of a ring of radii 1 and 1.3, with ``n`` cells around each; tags are in polar coordinates."""
    body = box("quadrilateral", [1.0, 0.0], [1.3, 0.5 * np.pi * part], [2, n := n * part])
    if part == 4:
        # the last nodes are the first ones again
        number = np.arange(len(body.x))
        number[number % (n + 1) == n] -= n
        used, cells = np.unique(number[body.cells], return_inverse=True)
        body = Body(body.x[used], cells.reshape(body.cells.shape))
    return scene(comm, "quadrilateral", [body], pose=lambda x: x[:, :1] * np.column_stack([np.cos(x[:, 1]), np.sin(x[:, 1])]))
