"""Solves the scene of ``by_getfem.py`` with GetFEM in a process of its own: ``scene.npz answer.json``.

Runs in any Python that has GetFEM and NumPy, and needs nothing else.
"""

import json
import sys
import time

import getfem as gf
import numpy as np

gf.util("trace level", 0)
scene = np.load(sys.argv[1])
x, cells, upper = scene["x"], scene["cells"], scene["upper"]
g, supports = x.shape[1], json.loads(str(scene["supports"]))
nu, rtol = float(scene["nu"]), float(scene["rtol"])
# in units of E
lam, mu = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
CONTACT = 1


def body(which, surface):
    """Mesh of a body with its contact surface as a region; places that two bodies share must not become one point."""
    chosen = np.flatnonzero(which)
    mesh = gf.Mesh("empty", g)
    mesh.add_convex(gf.GeoTrans(f"GT_PK({g},1)"), np.ascontiguousarray(x[cells[chosen]].transpose(2, 1, 0)))
    cell, node = scene[f"sides_{surface}"].T
    # a face has the number of the node that faces it
    mesh.set_region(CONTACT, np.stack([np.searchsorted(chosen, cell), node]).astype(np.int32))
    return mesh


def solve(bodies):
    """Model and solution: seconds, model, iterations and convergence, places of the contactors."""
    start = time.process_time()
    model, spaces, rules = gf.Model("real"), {}, {}
    model.add_initialized_data("lam", [lam])
    model.add_initialized_data("mu", [mu])
    model.add_initialized_data("r", [100.0])
    for name, mesh in bodies.items():
        spaces[name] = gf.MeshFem(mesh, g)
        spaces[name].set_fem(gf.Fem(f"FEM_PK({g},1)"))
        rules[name] = gf.MeshIm(mesh, gf.Integ("IM_TRIANGLE(1)" if g == 2 else "IM_TETRAHEDRON(1)"))
        model.add_fem_variable(name, spaces[name])
        model.add_isotropic_linearized_elasticity_brick(rules[name], name, "lam", "mu")

    for name, places in ((name, spaces[name].basic_dof_nodes()) for name in bodies):
        for surface, component, value in supports:
            # the surface is a plane across an axis
            own = x[scene[surface]]
            axis = int(np.argmin(np.ptp(own, axis=0)))
            dofs = np.flatnonzero(np.abs(places[axis] - own[0, axis]) < 1e-9 * np.ptp(x[:, 0]))
            dofs = dofs[dofs % g == component]
            if not len(dofs):
                continue
            rows = gf.Spmat("empty", len(dofs), spaces[name].nbdof())
            for row, dof in enumerate(dofs):
                rows.add(row, int(dof), 1.0)
            model.add_variable(f"{name}_{surface}_{component}", len(dofs))
            model.add_constraint_with_multipliers(name, f"{name}_{surface}_{component}", rows, np.full(len(dofs), value))
    model.add_nodal_contact_between_nonmatching_meshes_brick(
        rules["upper"], rules["block"], "upper", "block", "forces", "r", CONTACT, CONTACT, 1, 0, 1
    )
    count = model.solve("max_res", rtol, "max_iter", 100, "lsolver", "mumps")
    seconds = time.process_time() - start
    own = spaces["upper"].basic_dof_on_region(CONTACT)[::g]
    return seconds, model, count, spaces["upper"].basic_dof_nodes()[:, own].T


bodies = {"upper": body(upper, "contactor"), "block": body(~upper, "target")}
seconds = []
while not seconds or (len(seconds) <= int(scene["runs"]) and sum(seconds) < float(scene["enough"])):
    latest, model, (iterations, converged), places = solve(bodies)
    seconds.append(latest)
answer = {
    "seconds": seconds,
    "iterations": int(iterations),
    "converged": bool(converged),
    "P": abs(float(model.variable(f"block_block_bottom_{g - 1}").sum())),
    "forces": [-float(force) for force in model.variable("forces")],
    "x": places.tolist(),
}
with open(sys.argv[2], "w", encoding="utf-8") as out:
    json.dump(answer, out)
