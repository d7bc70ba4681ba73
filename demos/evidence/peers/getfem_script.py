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
x, cells, disc = scene["x"], scene["cells"], scene["disc"]
nu, rtol = float(scene["nu"]), float(scene["rtol"])
# in units of E
lam, mu = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
CONTACT = 1


def body(which, surface):
    """Mesh of a body with its contact surface as a region; places that two bodies share must not become one point."""
    chosen = np.flatnonzero(which)
    mesh = gf.Mesh("empty", 2)
    mesh.add_convex(gf.GeoTrans("GT_PK(2,1)"), np.ascontiguousarray(x[cells[chosen]].transpose(2, 1, 0)))
    cell, side = scene[f"sides_{surface}"].T
    # a face has the number of the node that faces it
    mesh.set_region(CONTACT, np.stack([np.searchsorted(chosen, cell), (side + 2) % 3]).astype(np.int32))
    return mesh


def solve(bodies):
    """Model and solution: seconds, model, iterations and convergence, nodes of the arc."""
    start = time.perf_counter()
    model, spaces, rules = gf.Model("real"), {}, {}
    model.add_initialized_data("lam", [lam])
    model.add_initialized_data("mu", [mu])
    model.add_initialized_data("r", [100.0])
    for name, mesh in bodies.items():
        spaces[name] = gf.MeshFem(mesh, 2)
        spaces[name].set_fem(gf.Fem("FEM_PK(2,1)"))
        rules[name] = gf.MeshIm(mesh, gf.Integ("IM_TRIANGLE(1)"))
        model.add_fem_variable(name, spaces[name])
        model.add_isotropic_linearized_elasticity_brick(rules[name], name, "lam", "mu")

    def support(name, line, component, value=0.0):
        """Prescribe a component on a line that is parallel to an axis."""
        ends = x[scene[line].ravel()]
        axis = int(np.argmin(np.ptp(ends, axis=0)))
        places = spaces[name].basic_dof_nodes()
        dofs = np.flatnonzero(np.abs(places[axis] - ends[0, axis]) < 1e-9 * np.ptp(x[:, 0]))
        dofs = dofs[dofs % 2 == component]
        rows = gf.Spmat("empty", len(dofs), spaces[name].nbdof())
        for row, dof in enumerate(dofs):
            rows.add(row, int(dof), 1.0)
        model.add_variable(f"{name}_{line}", len(dofs))
        model.add_constraint_with_multipliers(name, f"{name}_{line}", rows, np.full(len(dofs), value))

    for name in bodies:
        support(name, "symmetry", 0)
    support("block", "block_bottom", 1)
    support("disc", "disc_top", 1, -float(scene["push"]))
    model.add_nodal_contact_between_nonmatching_meshes_brick(
        rules["disc"], rules["block"], "disc", "block", "forces", "r", CONTACT, CONTACT, 1, 0, 1
    )
    told = model.solve("max_res", rtol, "max_iter", 100, "lsolver", "mumps")
    seconds = time.perf_counter() - start
    arc = spaces["disc"].basic_dof_on_region(CONTACT)[::2]
    return seconds, model, told, spaces["disc"].basic_dof_nodes()[0][arc]


bodies = {"disc": body(disc, "disc_arc"), "block": body(~disc, "block_top")}
seconds = []
while not seconds or (len(seconds) <= int(scene["runs"]) and sum(seconds) < float(scene["enough"])):
    latest, model, (iterations, converged), places = solve(bodies)
    seconds.append(latest)
answer = {
    "seconds": seconds,
    "iterations": int(iterations),
    "converged": bool(converged),
    "P": abs(float(model.variable("block_block_bottom").sum())),
    "forces": [-float(force) for force in model.variable("forces")],
    "x": [float(place) for place in places],
}
with open(sys.argv[2], "w", encoding="utf-8") as out:
    json.dump(answer, out)
