"""Sharp corners that are pressed into a softer body: wedges, teeth, slots, punches, and a die that is dragged."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, rotation, run, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def neo_hooke(u, E):
    """Neo-Hooke's law (plane strain in 2D)."""
    kind = "plane_strain" if len(u) == 2 else "3d"
    return uem.NeoHooke(E, 0.3, kind=kind).residual(u, ufl.TestFunction(u.function_space)) * ufl.dx


def pressed(bodies, surfaces, led, E, *, swap=False, law=linear, load=None, degree=1, size=1.0, turn=None, corners=False, **how):
    """A scene of bodies, of which the last is led by its nodes in the drawing: the problem, its contact and what is prescribed.

    Args:
        bodies: two or more.
        surfaces: of contactor and target, a list of bodies and predicates of the drawing each.
        led: body, predicate and displacement of what is led.
        E: modulus of each.
        swap: contactor and target.
        law: of the bodies.
        load: of the problem.
        degree: of the displacement.
        size: of the whole scene.
        turn: rotation matrix of the whole scene.
        corners: whether nodes at corners of the target are contactors, too.
        how: of the contact.
    """
    g = bodies[0].x.shape[1]
    cell = {4: "quadrilateral", 8: "hexahedron"}[bodies[0].cells.shape[1]]
    turn = np.eye(g) if turn is None else turn
    s = scene(COMM, cell, bodies, pose=lambda x: size * x @ turn.T)
    V = compat.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)

    def surface(name, parts):
        facets = np.concatenate([s.tag(name, *part).entities for part in parts])
        return uem.Tag(name, 1, g - 1, s.mesh, np.unique(facets).astype(np.int32))

    contactor, target = (surface(name, parts) for name, parts in zip(("contactor", "target"), surfaces))
    held = [s.tag("held", b, at(g - 1, body.x[:, g - 1].min())) for b, body in enumerate(bodies) if b != led[0]]
    bcs = [bc for tag in held for bc in clamp(V, tag)]
    top = s.tag("led", led[0], led[1])
    prescribed = fem.Constant(s.mesh, size * turn @ np.asarray(led[2]))
    bcs.append(fem.dirichletbc(prescribed, fem.locate_dofs_topological(V, g - 1, top.entities), V))
    contact = uem.Contact(
        *((target, contactor) if swap else (contactor, target)), name="pair", max_penetration=1.0, corners=corners, **how
    )
    problem = uem.UnitedProblem(law(u, modulus(s, *E)), u, bcs=bcs, contacts=[contact], load=load)
    return problem, contact, prescribed


def wedge(slope=0.5, off=0.25, n=8, push=0.1, g=2, **how):
    """A soft block that comes down on a stiff wedge, whose tip is this part of a facet from a contactor."""
    cross, m = ([0.0], [2]) if g == 3 else ([], [])
    wide = [c + 1.0 for c in cross]
    tip, deep = off * 2.0 / n, max(1.0, 1.5 * slope)
    low = box(("quadrilateral", "hexahedron")[g - 2], [-0.8, *cross, -deep], [0.8, *wide, 0.0], [8, *m, 3])

    def bend(x):
        y = x.copy()
        y[:, -1] -= slope * np.abs(x[:, 0]) * (x[:, -1] / deep + 1)
        y[:, 0] += tip
        return y

    high = box(("quadrilateral", "hexahedron")[g - 2], [-1.0, *cross, 0.0], [1.0, *wide, 1.0], [n, *m, n // 2])

    def top(x):
        return np.abs(x[:, -1] + slope * np.abs(x[:, 0] - tip)) < 1e-9

    led = (1, at(g - 1, 1.0), [*[0.0] * (g - 1), -push])
    return pressed([low.mapped(bend), high], ([(1, at(g - 1, 0.0))], [(0, top)]), led, (100.0, 1.0), **how), [tip]


def tooth(angle=0.6, n=8, push=0.1, x0=0.03, **how):
    """The corner of a stiff block, turned by an angle, that is pressed askew into the face of a soft one."""
    low = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [2 * n, n])
    R = rotation(2, angle)
    high = box("quadrilateral", [0.0, 0.0], [0.6, 0.6], [4, 4]).mapped(lambda x: x @ R.T + [x0, 0.0])

    def side(*axes):
        return lambda x: (np.abs(((x - [x0, 0.0]) @ R)[:, list(axes)]) < 1e-9).any(axis=1)

    led = (1, lambda x: np.abs(((x - [x0, 0.0]) @ R)[:, 1] - 0.6) < 1e-9, [0.3 * push, -push])
    return pressed([low, high], ([(0, at(1, 0.0))], [(1, side(0, 1))]), led, (1.0, 100.0), **how), [x0]


def slot(n=7, width=0.23, push=0.06, R=0.5, **how):
    """Half a ring that is pressed onto the edges of a slot."""
    up = R * np.cos(np.arcsin(0.5 * width / R))

    def bend(x):
        a, r = np.pi * (1 + x[:, 1]), R * (0.7 + 0.3 * x[:, 0])
        return np.column_stack([r * np.cos(a), r * np.sin(a) + up])

    ring = box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, n]).mapped(bend)
    sides = [(-1.0, -0.5 * width), (0.5 * width, 1.0)]
    low = [box("quadrilateral", [a, -0.6], [b, 0.0], [6, 4]) for a, b in sides]

    def edge(x):
        return (np.abs(x[:, 1]) < 1e-9) | (np.abs(np.abs(x[:, 0]) - 0.5 * width) < 1e-9)

    outer = (2, lambda x: np.abs(np.hypot(x[:, 0], x[:, 1] - up) - R) < 1e-9)
    led = (2, at(1, up), [0.0, -push])
    return pressed([*low, ring], ([outer], [(0, edge), (1, edge)]), led, (10.0, 10.0, 1.0), **how), [-0.5 * width, 0.5 * width]


def punch(w=0.47, n=8, push=0.02, closed=True, **how):
    """A block that is pressed into a wider one, whose nodes are the contactors; its sides belong to the target if closed."""
    low = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [2 * n, n])
    high = box("quadrilateral", [-w, 0.0], [w, 0.6], [6, 4])

    def face(x):
        return (np.abs(x[:, 1]) < 1e-9) | (closed & (np.abs(np.abs(x[:, 0]) - w) < 1e-9))

    led = (1, at(1, 0.6), [0.0, -push])
    return pressed([low, high], ([(0, at(1, 0.0))], [(1, face)]), led, (1.0, 10.0), **how), [-w, w]


def ironed(n, friction=0.0, press=0.1, drag=0.5, steps=6, **how):
    """A stiff die with slanting sides, pressed into a slab whose nodes are the contactors and dragged.

    Returns:
        Ways of the die and forces on the slab ``(steps + 1,)``, ``(steps + 1, 2)``, and stored energies ``(steps + 1,)``.
    """
    w, x0 = 0.5, 1.013

    def slant(x):
        return np.column_stack([x[:, 0] * (1 + 2.7 * x[:, 1]) + x0, x[:, 1]])

    slab = box("quadrilateral", [0.0, -1.0], [4.0, 0.0], [12 * n, 3 * n])
    die = box("quadrilateral", [-w, 0.0], [w, 0.5], [4 * n, 2 * n]).mapped(slant)

    def face(x):
        return (np.abs(x[:, 1]) < 1e-9) | (np.abs(np.abs(x[:, 0] - x0) - w * (1 + 2.7 * x[:, 1])) < 1e-9)

    led, energy = (1, at(1, 0.5), [0.0, -press]), []

    def law(u, E):
        energy.append(uem.NeoHooke(E, 0.3, kind="plane_strain").energy(u) * ufl.dx)
        return neo_hooke(u, E)

    problem, contact, prescribed = pressed(
        [slab, die], ([(0, at(1, 0.0))], [(1, face)]), led, (1.0, 10.0), law=law, friction=friction, **how
    )
    run(problem)

    def state():
        return contact.resultant().force, uem.integrate(energy[0])

    found = [state()]
    prescribed.value[:] = (drag, -press)
    found += [state() for _ in uem.load_steps(problem, steps)]
    forces, energies = (np.array(values) for values in zip(*found))
    return np.linspace(0.0, drag, steps + 1), forces, energies


def ironing(*args, **how):
    """Drag over force in every step of ``ironed``."""
    forces = ironed(*args, **how)[1][1:]
    return forces[:, 0] / forces[:, 1]
