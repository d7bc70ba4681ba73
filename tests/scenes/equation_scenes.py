"""Cases of uniting equations between the nodes of two blocks, without any contact: flat, in corners, at symmetry planes, in chains."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import blocks, linear
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD


class Case:
    """Two blocks, and uniting equations between nodes given by their places in the drawing.

    Args:
        cell: kind of cells.
        equations: node, direction, nodes followed, weights, gap.
        reserved: equations of the same kind that do not hold, but keep their places in P.
        held: Dirichlet components as ``(node, component, increment)``.
    """

    def __init__(self, cell, equations, held=(), reserved=()):
        self.blocks = b = blocks(COMM, cell, 2, 2, gap=0.5)
        self.config = Configuration(b.u)
        g = self.g = b.gdim
        n, first = self.config.n_owned, self.config.index_map.local_range[0]
        numbering = b.scene.numbering(b.V)[:n]
        parts = COMM.allgather((numbering, first + np.arange(n)))
        where = np.empty(len(b.scene.drawing), dtype=np.int64)
        for drawn, number in parts:
            where[drawn] = number
        #: global block number of each node of the drawing
        self.where = where
        every = [
            (where[i], np.array(d) / np.linalg.norm(d), where[np.array(a, dtype=int)], np.array(w, dtype=float), gap)
            for i, d, a, w, gap in [*equations, *reserved]
        ]
        #: the equations that hold
        self.rows = every[: len(equations)]
        width = max((len(r[2]) for r in every), default=0)
        #: places in ``rows`` of this rank's equations
        self.mine = [k for k, r in enumerate(every) if first <= r[0] < first + n]
        mine = [every[k] for k in self.mine]
        targets, weights = np.full((len(mine), width), -1, np.int64), np.zeros((len(mine), width))
        for k, r in enumerate(mine):
            targets[k, : len(r[2])], weights[k, : len(r[2])] = r[2], r[3]
        self.equations = UnitingEquations.along(
            np.array([r[0] - first for r in mine], np.int32),
            np.array([r[1] for r in mine]).reshape(-1, g),
            targets,
            weights,
            np.array([r[4] for r in mine], dtype=float),
            np.array([k < len(equations) for k in self.mine], dtype=bool),
        )
        self.free, self.prescribed = np.ones((n, g), bool), np.zeros((n, g))
        self.held = [(int(where[i]) * g + c, value) for i, c, value in held]
        for dof, value in self.held:
            if first * g <= dof < (first + n) * g:
                self.free.flat[dof - first * g] = False
                self.prescribed.flat[dof - first * g] = value
        self.size = g * self.config.index_map.size_global

    def restriction(self):
        return Restriction(self.config, self.equations, self.free, self.prescribed)

    def constraints(self):
        """Dense ``C du = h``: uniting equations, then Dirichlet components."""
        C, h = np.zeros((len(self.rows) + len(self.held), self.size)), np.zeros(len(self.rows) + len(self.held))
        g = self.g
        for k, (node, direction, targets, weights, gap) in enumerate(self.rows):
            C[k, node * g : node * g + g] += direction
            for a, w in zip(targets, weights):
                C[k, a * g : a * g + g] -= w * direction
            h[k] = -gap
        for k, (dof, value) in enumerate(self.held, len(self.rows)):
            C[k, dof], h[k] = 1.0, value
        return C, h

    def stiffness(self):
        """Elastic stiffness plus a mass, so that nothing is singular, and its form."""
        u, v = ufl.TrialFunction(self.blocks.V), ufl.TestFunction(self.blocks.V)
        one = fem.Constant(self.blocks.scene.mesh, PETSc.ScalarType(1.0))
        a = ufl.derivative(linear(self.blocks.u, one), self.blocks.u) + 0.1 * ufl.inner(u, v) * ufl.dx
        form = forms.form(a)
        K = forms.create_matrix(form)
        forms.assemble_matrix(K, form)
        return K


def turned(case, angle, active=None, followed=None, like=None):
    """P of equations of a case in directions turned in the plane of x and y, some active, some with others to follow; like another P."""
    e, turn = case.equations, np.eye(case.g)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    changed = replace(e, direction=e.direction @ turn.T, coefficients=e.coefficients @ turn.T)
    changed = replace(
        changed, active=e.active if active is None else active, followed=e.followed if followed is None else followed
    )
    return Restriction(case.config, changed, case.free, case.prescribed, like=like)


def nodes_at(cell, *places):
    """Numbers in the drawing of the nodes at some places."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    return [int(np.linalg.norm(x - p, axis=1).argmin()) for p in places]


def flat_case(cell):
    """One equation per contactor, oblique directions, some Dirichlet components at targets."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)
    rng = np.random.default_rng(3)
    rows = []
    for i in upper:
        followed = rng.choice(lower, 2 ** (g - 1), replace=False)
        w = rng.random(len(followed))
        rows.append((i, rng.normal(size=g), followed, w / w.sum(), 0.1 * rng.normal()))
    held = [(i, c, 0.02 * (c + 1)) for i in np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9) for c in range(g)]
    held += [(lower[0], 0, -0.03), (lower[1], g - 1, 0.04)]
    return Case(cell, rows[1:], held, reserved=rows[:1])


def corner_case(cell):
    """Two equations at some contactors (a corner), one at others."""
    g = 2 if cell == "triangle" else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    a, b = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    rng = np.random.default_rng(4)
    rows = [(i, rng.normal(size=g), [a, b], [0.3, 0.7], 0.05) for i in upper]
    rows += [(i, rng.normal(size=g), [a, b], [0.6, 0.4], -0.02) for i in upper[::2]]
    return Case(cell, rows, [(int(np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9)[0]), 0, 0.1)])


def symmetry_case(cell):
    """Contactors whose own tangential component is prescribed (a symmetry plane), with an oblique direction."""
    g = 2 if cell == "triangle" else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    plane = np.flatnonzero((np.abs(x[:, -1] - 0.5) < 1e-9) & (np.abs(x[:, 0]) < 1e-9))
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)
    direction = np.array([0.3, 0.2, 0.9])[-g:] if g == 3 else np.array([0.4, 0.9])
    rows = [(i, direction, lower[:2], [0.5, 0.5], 0.01) for i in plane]
    return Case(cell, rows, [(i, 0, 0.07) for i in plane] + [(i, 0, 0.05) for i in lower])


def chain_case(cell):
    """Stacked bodies: what a contactor follows is itself a contactor, three deep, and two roads meet in one node."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    g = x.shape[1]
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)[:3]
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    top, base = np.flatnonzero(np.abs(x[:, -1] - 1.5) < 1e-9)[0], np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9)[:2]
    rng = np.random.default_rng(5)
    rows = [(top, rng.normal(size=g), [upper[0], lower[0]], [0.25, 0.75], 0.02)]
    rows += [(i, rng.normal(size=g), lower, [0.5, 0.5], 0.03) for i in upper]
    rows += [(i, rng.normal(size=g), base, [0.1, 0.9], -0.01) for i in lower]
    return Case(cell, rows, [(base[0], 0, 0.04)])


def rigid_chain_case(cell):
    """A contactor that follows nodes which are themselves held by an oblique rigid surface."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    g = x.shape[1]
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    oblique = np.array([0.6, 0.1, 0.8])[-g:] if g == 3 else np.array([0.6, 0.8])
    rows = [(i, [0.0] * (g - 1) + [1.0], lower, [0.4, 0.6], 0.02) for i in upper]
    rows += [(i, oblique, [], [], 0.01) for i in lower]
    return Case(cell, rows)


def circle_case(cell):
    """Contactors that follow each other in circles, by small parts, and their targets by large ones; one has two equations."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    g = x.shape[1]
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)[:3]
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    rng = np.random.default_rng(6)
    rows = [(i, rng.normal(size=g), [*upper[upper != i], *lower], [0.02, -0.01, 0.3, 0.69], 0.02) for i in upper]
    rows.append((upper[1], rng.normal(size=g), [upper[0], lower[1]], [0.03, 0.97], -0.01))
    return Case(cell, rows, [(lower[0], 0, 0.04)])


CASES = {
    "triangles": lambda: flat_case("triangle"),
    "quadrilaterals": lambda: flat_case("quadrilateral"),
    "tetrahedra": lambda: flat_case("tetrahedron"),
    "hexahedra": lambda: flat_case("hexahedron"),
    "corner 2D": lambda: corner_case("triangle"),
    "corner 3D": lambda: corner_case("tetrahedron"),
    "symmetry 2D": lambda: symmetry_case("triangle"),
    "symmetry 3D": lambda: symmetry_case("tetrahedron"),
    "chain 2D": lambda: chain_case("triangle"),
    "chain 3D": lambda: chain_case("hexahedron"),
    "chain to a rigid surface 2D": lambda: rigid_chain_case("quadrilateral"),
    "chain to a rigid surface 3D": lambda: rigid_chain_case("tetrahedron"),
    "chain in a circle 2D": lambda: circle_case("triangle"),
    "chain in a circle 3D": lambda: circle_case("hexahedron"),
    "no equation": lambda: Case("triangle", [], [(0, 0, 0.1), (0, 1, 0.0), (3, 1, -0.2)]),
}


def triangles(n, away=0.0):
    """Configuration of so many bodies of one triangle with legs of length 1, far away on the x axis, on this rank alone."""
    x = np.concatenate([np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) + [away, 2.0 * i] for i in range(n)])
    mesh = compat.create_mesh(MPI.COMM_SELF, np.arange(3 * n).reshape(n, 3), x, "triangle", 1)
    return Configuration(fem.Function(compat.function_space(mesh, 1, (2,))))


def united(config, rows, fixed=(), coefficient=1.0):
    """Restriction of equations ``(node, direction, node followed)`` of global nodes, with ``fixed`` local components."""
    first, g = config.index_map.local_range[0], config.gdim
    mine = [row for row in rows if first <= row[0] < first + config.n_owned]
    d = np.array([row[1] for row in mine], dtype=float).reshape(-1, g)
    equations = UnitingEquations(
        np.array([row[0] - first for row in mine], np.int32), d, np.zeros(len(mine)), np.ones(len(mine), bool),
        np.arange(len(mine)), np.array([row[2] for row in mine], np.int64), coefficient * d,
    )  # fmt: skip
    free = np.ones((config.n_owned, g), bool)
    for node, component in fixed:
        free[node, component] = False
    return Restriction(config, equations, free, np.zeros(free.shape))
