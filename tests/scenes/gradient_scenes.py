"""A scene whose state depends on everything that there are derivatives by, and Taylor's test of functionals of it."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import ufl
from block_scenes import blocks, clamp, run
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
SCENES = [
    ("triangle", 1, "node_to_surface", False, "neo"),
    ("triangle", 1, "mortar", False, "neo"),
    ("triangle", 1, "node_to_surface", True, "neo"),
    ("quadrilateral", 1, "mortar", True, "neo"),
    ("triangle", 2, "node_to_surface", False, "neo"),
    ("quadrilateral", 2, "mortar", False, "linear"),
    ("tetrahedron", 1, "mortar", False, "linear"),
    ("hexahedron", 1, "node_to_surface", False, "neo"),
]


def wave(V, size=1.0):
    """A smooth Function, the same on any partition."""
    f = fem.Function(V)
    g = f.ufl_shape[0] if f.ufl_shape else 1
    f.interpolate(lambda x: np.squeeze(np.stack([size * np.sin(3 * x[0] + 2 * x[1] + i + x[2]) for i in range(g)])))
    f.x.scatter_forward()
    return f


def dot(a, b):
    """Product of the entries of two Functions (collective)."""
    V = a.function_space
    n = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    return V.mesh.comm.allreduce(float(a.x.array[:n] @ b.x.array[:n]))


def pressed(
    cell,
    degree=1,
    coupling="node_to_surface",
    rigid=False,
    law="neo",
    measure="reference",
    comm=COMM,
    overhang=0.25,
    normal=None,
    sliding="finite",
    **options,
):
    """A block with a bulging face, loaded and pressed onto another or onto a rigid ball, and all that its solution may depend on.

    ``normal``: a function of the mesh that returns a soft contact.
    """
    bulge = 0.1 if degree == 1 else 0.0
    b = blocks(
        comm, cell, *((4, 6) if cell in ("triangle", "quadrilateral") else (2, 3)), overhang=overhang, degree=degree,
        pose=lambda x: x + np.where(x[:, -1:] > 0, bulge * (x[:, :1] - 0.5) ** 2, 0.0) * np.eye(x.shape[1])[-1],
    )  # fmt: skip
    mesh, g = b.scene.mesh, b.gdim
    u, v = b.u, ufl.TestFunction(b.V)
    E, load, top = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.full(g, 0.01)), fem.Constant(mesh, np.zeros(g))
    field = fem.Function(compat.function_space(mesh, ("DG", 0)))
    field.interpolate(lambda x: 1.0 + 0.2 * np.sin(5 * x[0] + x[1]))
    top.value[:] = [0.02, *[0.0] * (g - 2), -0.05]
    kind = "plane_strain" if g == 2 else "3d"
    material = uem.NeoHooke(E, 0.3, kind=kind) if law == "neo" else uem.LinearElastic(E, 0.3, kind=kind)
    F = field * material.residual(u, v) * ufl.dx - ufl.inner(load, v) * ufl.dx
    sides = fem.Function(b.V)
    sides.x.array[:] = wave(b.V, 1e-3).x.array
    bcs = [uem.dirichlet(b.V, b.bottom, value=sides)]
    bcs.append(fem.dirichletbc(top, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V))
    target = uem.RigidSphere([0.4] * (g - 1) + [-3.0], 3.0) if rigid else b.low
    if rigid == "paraboloid":
        target = uem.RigidParaboloid([0.4] * (g - 1) + [0.0], -np.eye(g)[-1], 3.0)
    elif rigid == "plane":
        target = uem.RigidPlane([0.4] * (g - 1) + [0.0], np.eye(g)[-1] + 0.02 * np.eye(g)[0])
    values = {"offset": 0.0, "place": np.zeros(g), "turn": np.zeros(() if g == 2 else 3)}
    soft = None if normal is None else normal(mesh)

    def solve():
        u.x.array[:] = 0.0
        if rigid:
            target.move(values["place"], values["turn"])
        contact = uem.Contact(
            b.high, target, coupling=coupling, measure=measure, offset=values["offset"], sliding=sliding, normal=soft
        )
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], rtol=1e-13, **options)
        run(problem)
        return problem

    def of_pressures(problem):
        """A functional of the pressure of its contact, places and displacement."""
        p = problem.contacts[0].pressure
        return (50 * p**3 + (1 + X[0]) * p**2 + p * u[g - 1]) * uem.ds(b.high) + 0.1 * E * p * ufl.ds + u[0] ** 2 * ufl.dx

    X = ufl.SpatialCoordinate(mesh)
    J = ufl.inner(u, u) * ufl.dx + E * field * u[g - 1] * ufl.dx
    return SimpleNamespace(
        b=b,
        F=F,
        J=J,
        of_pressures=of_pressures,
        E=E,
        load=load,
        top=top,
        field=field,
        sides=sides,
        X=X,
        solve=solve,
        u=u,
        v=v,
        values=values,
        soft=soft,
    )


def along(by, changes):
    """The derivative along changes of the controls that it is by (collective)."""
    return sum(dot(b, d) if isinstance(b, fem.Function) else float(np.sum(b * d)) for b, d in zip(by, changes))


def move(s, change, h):
    """Move the nodes of a scene by a Function of vectors at these."""
    at = np.zeros(len(s.b.scene.mesh.geometry.x), dtype=np.int64)
    at[compat.geometry_dofs(s.b.scene.mesh).ravel()] = compat.cell_dofs(change.function_space).ravel()
    s.b.scene.mesh.geometry.x[:, : s.b.gdim] += h * change.x.array.reshape(-1, s.b.gdim)[at]


def orders(s, functional, *names):
    """Taylor's test of a functional of the problem by the controls of a scene, all or those named: the order for each, by name."""
    g = s.b.gdim
    changes = {"E": 1.0, "load": np.eye(g)[-1], "top": np.linspace(1.0, -1.0, g), "field": wave(s.field.function_space)}
    changes |= {"sides": wave(s.b.V, 0.1), "X": wave(compat.function_space(s.b.scene.mesh, 1, (g,)), 0.05)}
    changes = {name: change for name, change in changes.items() if name in (names or changes)}
    controls = [getattr(s, name) for name in changes]
    problem = s.solve()
    found, reported = uem.gradient(problem, functional(problem), controls), {}
    for (name, change), control, by in zip(changes.items(), controls, found):
        if name == "X":
            values, slope = s.b.scene.mesh.geometry.x, dot(by, change)
        elif isinstance(control, fem.Function):
            values, slope = control.x.array, dot(by, change)
        else:
            values, slope = control.value, float(np.sum(by * change))
        before = np.array(values)

        def at(h, name=name, change=change, control=control, values=values, before=before):
            if name == "X":
                values[:] = before
                move(s, change, h)
            else:
                values[...] = before + h * (change.x.array if isinstance(change, fem.Function) else change)
            return uem.integrate(functional(s.solve()))

        reported[name] = uem.taylor_test(at, slope, 1e-3, 2)
        values[...] = before
    return reported


_BY_NODES = [
    ("triangle", None, "neo", ("friction", "X")),
    ("triangle", "plane", "linear", ("top", "full", "place")),
    ("tetrahedron", None, "linear", ("E", "friction")),
    ("hexahedron", "sphere", "linear", ("X", "place")),
]

_BY_MORTAR = [
    ("triangle", None, "neo", ("friction", "X", "E", "top", "full")),
    ("quadrilateral", None, "linear", ("friction", "X", "E", "top", "full")),
    ("triangle", "plane", "linear", ("friction", "top", "full", "place")),
    ("triangle", "sphere", "neo", ("friction", "X", "top", "full", "place")),
    ("tetrahedron", None, "linear", ("E", "friction", "top")),
    ("tetrahedron", "plane", "linear", ("friction", "X", "place", "top")),
]

#: How blocks are dragged: cells, rigid target, law, controls, and all else.
DRAGGED = [(*scene, {}) for scene in _BY_NODES] + [(*scene, {"coupling": "mortar"}) for scene in _BY_MORTAR]
DRAGGED += [
    ("triangle", None, "neo", ("friction", "E", "top"), {"ring": True}),
    ("triangle", None, "neo", ("friction", "E", "top"), {"coupling": "mortar", "ring": True}),
    ("triangle", "sphere", "neo", ("friction", "X", "place"), {"coupling": "mortar", "degree": 2}),
    ("triangle", None, "neo", ("friction", "X", "E", "top", "full"), {"coupling": "mortar", "degree": 2}),
    ("triangle", None, "neo", ("friction", "X", "E", "top"), {"coupling": "mortar", "offset": 0.01}),
]


def dragged(
    cell, rigid=None, law="neo", steps=2, mu=0.3, comm=COMM, coupling="node_to_surface", degree=1, ring=False, offset=0.0
):
    """A block that is pressed onto another, or onto a rigid surface, and dragged over it in some steps: some contactors stick, others slip.

    ``mu``: the coefficient of friction, or a function of a scalar space that returns a Function. ``ring``: of revolution, about an axis.

    ``solve()`` takes the steps anew with the present values of all that the solution depends on; ``values`` are those of the contact.
    """
    b = blocks(comm, cell, *((3, 4) if cell in ("triangle", "quadrilateral") else (2, 3)), overhang=0.25, degree=degree)
    mesh, g, u, v = b.scene.mesh, b.gdim, b.u, ufl.TestFunction(b.V)
    if ring:
        mesh.geometry.x[:, 0] += 1.0
        uem.axisymmetric(mesh)
    E, top, full = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.zeros(g)), fem.Constant(mesh, np.zeros(g))
    top.value[0], top.value[-1] = 0.03, -0.05
    kind = "axisymmetric" if ring else "plane_strain" if g == 2 else "3d"
    material = uem.NeoHooke(E, 0.3, kind=kind) if law == "neo" else uem.LinearElastic(E, 0.3, kind=kind)
    F = material.residual(u, v) * ufl.dx - ufl.inner(full, v) * ufl.dx
    push = fem.dirichletbc(top, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)
    if callable(mu):
        mu = mu(compat.function_space(mesh, ("Lagrange", 1)))
    values = {
        "full": np.full(g, 0.002),
        "friction": mu,
        "offset": offset,
        "place": np.zeros(g),
        "turn": np.zeros(() if g == 2 else 3),
    }

    def solve():
        u.x.array[:] = 0.0
        target = b.low
        if rigid is not None:
            middle, up = [0.5] * (g - 1), np.eye(g)[-1] + 0.05 * np.eye(g)[0]
            target = uem.RigidPlane([*middle, 0.0], up) if rigid == "plane" else uem.RigidSphere([*middle, -3.0], 3.0)
            target.move(values["place"], values["turn"])
        contact = uem.Contact(b.high, target, friction=values["friction"], coupling=coupling, offset=float(values["offset"]))
        bcs, load = [*clamp(b.V, b.bottom), push], {full: values["full"]}
        problem, states = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load=load, rtol=1e-13), []
        with uem.recording(problem) as history:
            for _ in uem.load_steps(problem, steps):
                now = contact.pair.trial
                reported = np.array([now.active.sum(), (now.active & now.friction.stick).sum()])
                states.append(comm.allreduce(reported).tolist())
        return SimpleNamespace(problem=problem, history=history, contact=contact, states=states)

    w = fem.Function(b.V)
    compat.set_bc_values(w.x.array, [uem.dirichlet(b.V, b.top, 0, 1.0)])
    w.x.scatter_forward()
    J = ufl.inner(u, u) * ufl.dx + ufl.replace(F, {v: w})
    return SimpleNamespace(b=b, u=u, E=E, full=full, top=top, X=ufl.SpatialCoordinate(mesh), J=J, solve=solve, values=values)


def control_of(s, contact, name):
    """The control of a dragged scene with a name."""
    return uem.ContactParameter(contact, name) if name in ("friction", "offset", "place", "turn") else getattr(s, name)


def changed(s, name):
    """A change of a control of a dragged scene."""
    g = s.b.gdim
    changes = {"E": 1.0, "full": np.eye(g)[-1], "top": np.linspace(1.0, -1.0, g), "friction": 1.0}
    changes["X"] = wave(compat.function_space(s.b.scene.mesh, 1, (g,)), 0.05)
    return (changes | {"place": np.linspace(0.5, 1.0, g), "turn": 1.0 if g == 2 else np.linspace(0.5, 1.0, 3)})[name]


def drag_anew(s, name, change, h):
    """All steps with a control changed by h, which is then put back; and the functional."""
    values = s.b.scene.mesh.geometry.x if name == "X" else s.values[name] if name in s.values else getattr(s, name).value
    before = np.array(values)
    if name == "X":
        move(s, change, h)
    elif name in s.values:
        s.values[name] = before + h * change
    else:
        values[...] = before + h * change
    found, J = s.solve(), uem.integrate(s.J)
    if name in s.values:
        s.values[name] = before
    else:
        values[...] = before
    return found, J
