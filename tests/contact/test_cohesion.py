"""Contacts with cohesion: bonds that open and separate, in both couplings, at degrees 1 and 2, in statics and in time.

The tests to read first are ``test_a_bond_is_pulled_apart`` and ``test_end_notched_flexure``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, highest, linear, refused, scene, slow, st_venant
from ramp_scenes import cracking

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.pair.cohesive import growth_of
from uem_dolfinx.solve.bodies.tangent import contact_curvature

COMM = MPI.COMM_WORLD
BOND = uem.Cohesive(1.0, 0.01)
MIXED = uem.Cohesive(1.0, 0.01, shear_strength=2.0, shear_energy=0.03, mixed=uem.BenzeggaghKenane(2.0))
E = 1e3


def pulled(b, way, contacts, body=linear, **how):
    """Two blocks without lateral strain, the lower one held, the top of the upper one moved by ``way(load factor)``."""
    up = fem.Function(b.V)

    def move(s):
        up.x.array[:] = np.tile(way(s), len(up.x.array) // b.gdim)

    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=up)]
    F = linear(b.u, E, 0.0) if body is linear else body(b.u, E)
    return uem.UnitedProblem(F, b.u, bcs=bcs, contacts=contacts, load=move, petsc_options_prefix="cohesion_", **how)


def direction(gdim, share):
    """Unit vector with a share of shear."""
    d = np.zeros(gdim)
    d[0], d[-1] = np.sqrt(share), np.sqrt(1.0 - share)
    return d


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("cell", ["quadrilateral", *map(slow, ["triangle", "hexahedron", "tetrahedron"])])
@pytest.mark.parametrize("law", ["bilinear", "exponential"])
def test_a_bond_is_pulled_apart(cell, coupling, degree, law):
    """Blocks of constant stress, on any mesh: the law of the bond in series with two springs, and nothing left at the end."""
    b = blocks(COMM, cell, 2, 3 if coupling == "mortar" else 4, degree=degree)
    bond = uem.Cohesive(1.0, 0.01, law=law)
    contact = uem.Contact(b.high, b.low, cohesion=bond, coupling=coupling)
    end = 0.026 if law == "bilinear" else 0.3
    for step in uem.load_steps(pulled(b, lambda s: direction(b.gdim, 0.0) * s * end, [contact]), 6):
        opening = COMM.allreduce(contact.gap.x.array.max(), op=MPI.MAX)
        traction = -COMM.allreduce(contact.pressures.min(initial=0.0), op=MPI.MIN)
        w = opening + traction * 0.0
        onset, last = 1.0 / bond.stiffness, 0.02
        curve = np.exp(-(w - onset) / (0.01 - onset / 2)) if law == "exponential" else max((last - w) / (last - onset), 0.0)
        assert traction == pytest.approx(curve, rel=1e-7, abs=1e-9)
        assert opening + 2 * traction / E == pytest.approx(step.factor * end, rel=1e-7)
        assert contact.resultant().force[-1] == pytest.approx(-traction, abs=1e-9)
        assert contact.balance().force < 1e-13
        assert step.newton_iterations < 10
    assert highest(COMM, contact.damage.x.array) > 1.0 - 1e-9 and traction < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_work_of_a_separation(coupling, share):
    """The work of the load over a full separation is the energy of the mode, to what steps leave."""
    b = blocks(COMM, "quadrilateral", 1, 1)
    contact = uem.Contact(b.high, b.low, cohesion=MIXED, coupling=coupling)
    d, end = direction(2, share), 0.05
    problem, work, last = pulled(b, lambda s: d * s * end, [contact]), 0.0, (0.0, 0.0)
    for step in uem.load_steps(problem, 80):
        here = step.factor * end, float(problem.reaction(b.top) @ d)
        work, last = work + 0.5 * (here[1] + last[1]) * (here[0] - last[0]), here
    assert abs(last[1]) < 1e-12
    if share != 0.5:
        # between the modes the share of the bond is not that of the blocks' tops
        assert work == pytest.approx(0.03 if share else 0.01, rel=5e-3)
    else:
        assert 0.0115 < work < 0.0225


def test_down_again_presses_and_up_again():
    """After damage the blocks are pressed together: hard contact, no gap; pulled again, the bond is as weak as it was."""
    for unloading in ("origin", "plastic"):
        b = blocks(COMM, "quadrilateral", 2, 4)
        law = uem.Cohesive(1.0, 0.01, unloading=unloading)
        contact = uem.Contact(b.high, b.low, cohesion=law, sliding="small")
        ways = [0.0, 0.008, -0.004, 0.008]
        problem = pulled(b, lambda s: np.array([0.0, np.interp(3 * s, range(4), ways)]), [contact])
        steps = list(zip(uem.load_steps(problem, 3), range(3)))
        del steps
        assert highest(COMM, contact.damage.x.array) > (0.5 if unloading == "origin" else 0.3)
        up = float(problem.reaction(b.top)[1])
        assert up > 0.5
        b = blocks(COMM, "quadrilateral", 2, 4)
        contact = uem.Contact(b.high, b.low, cohesion=law, sliding="small")
        problem = pulled(b, lambda s: np.array([0.0, np.interp(2 * s, range(3), ways[:3])]), [contact])
        for _ in uem.load_steps(problem, 2):
            pass
        assert contact.resultant().force[1] == pytest.approx(0.004 * E / 2, rel=1e-6)
        assert highest(COMM, np.abs(contact.gap.x.array)) < 1e-10


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("cell", ["triangle", slow("tetrahedron")])
def test_the_stiffness_is_the_derivative(cell, coupling):
    """``sum_i A_i r_i (dt/dw) r_i'`` is the derivative of the bonds' forces by the displacement."""
    b = blocks(COMM, cell, 2, 3)
    contact = uem.Contact(b.high, b.low, cohesion=MIXED, coupling=coupling)
    problem = pulled(b, lambda s: 0.0 * direction(b.gdim, 0.0), [contact])
    config, pair, system = problem.config, contact.pair, problem.system
    x, upper = config.X, config.X[:, -1:] > 1e-9
    upper = upper | (np.abs(x[:, -1:]) < 1e-9) & np.isin(np.arange(len(x)), pair.nodes)[:, None]
    smooth = np.where(upper, 0.004 + 0.002 * np.stack([np.sin(2 * x[:, i] + i) for i in range(b.gdim)], axis=1), 0.0)
    way = np.stack([np.cos(3 * x[:, i] + 2 * i) for i in range(b.gdim)], axis=1)

    def forces(u):
        config.u.x.array[:] = u.ravel()
        config.u.x.scatter_forward()
        system.place()
        return config.add_at_owners(*pair.applied_forces()).ravel()

    forces(smooth)
    assert highest(COMM, pair.trial.cohesion[:, 0]) > 0.1
    nodes, K, _ = pair.slip_terms()
    A, du, h = contact_curvature([(nodes, K)], config.vector()), config.vector(), 1e-8
    du.array[:] = way[: config.n_owned].ravel()
    found = config.vector()
    found.array[:] = -(forces(smooth + h * way) - forces(smooth - h * way)) / (2 * h)
    assert (found - A * du).norm() < 1e-5 * (A * du).norm()


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_rotation(coupling):
    """Bonded blocks that turn together by a right angle carry nothing, and a bond that is open turns with them."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    contact = uem.Contact(b.high, b.low, cohesion=BOND, coupling=coupling)
    up = fem.Function(b.V)

    def move(s):
        a, lift = 0.5 * np.pi * max(2 * s - 1, 0.0), 0.01 * min(2 * s, 1.0)
        R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        up.interpolate(lambda x: R @ (x[:2] + np.stack([0 * x[1], lift * (x[1] > 0.5)])) - x[:2])

    bcs = [uem.dirichlet(b.V, tag, value=up) for tag in (b.bottom, b.top)]
    problem = uem.UnitedProblem(st_venant(b.u, E), b.u, bcs=bcs, contacts=[contact], load=move, petsc_options_prefix="cohesion_")
    pulls = [np.linalg.norm(contact.resultant().force) for _ in uem.load_steps(problem, 20)]
    assert pulls[9] > 0.3 and pulls[-1] == pytest.approx(pulls[9], rel=1e-3)
    assert contact.resultant().force[0] == pytest.approx(pulls[-1], rel=1e-3)


@pytest.mark.long
def test_friction_on_the_damaged_part():
    """Pressed and sheared until the bond is gone: in the end the shear is mu N, and before the cohesion adds what is left of it."""
    mu, press = 0.5, 0.002
    b = blocks(COMM, "quadrilateral", 2, 4, overhang=0.25)
    contact = uem.Contact(b.high, b.low, cohesion=BOND, friction=mu, sliding="small")
    problem = pulled(b, lambda s: np.array([0.03 * s, -press]), [contact])
    for step in uem.load_steps(problem, 30):
        state = contact.pair.trial
        rubs, bond = np.linalg.norm(state.friction.tau, axis=1), np.abs(state.bond[:, 0])
        if step.factor < 0.2:
            # intact: what is sheared is the bond alone
            assert highest(COMM, rubs) == 0.0 and highest(COMM, bond) > 0.0
    assert highest(COMM, -contact.pair.trial.cohesion[:, 0]) == -1.0 and highest(COMM, bond) == 0.0
    assert highest(COMM, np.abs(rubs - mu * state.lam)) < 1e-12 and highest(COMM, state.lam) > 0.1
    assert contact.resultant().force[0] == pytest.approx(-mu * contact.resultant().force[1], rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("load", ["shear", "one arm"])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_split_beam(coupling, load):
    """A clamped split beam, bent at both arms (pure shear, end-notched flexure's half) or at one (shear 3 to 4 in energy).

    Force and displacement give the length of the crack by the compliance ``(k a^3 + L^3) / (2 E' h^3) + 3 L / (5 G h)`` of beam
    theory, k = 3 or 7. The energy release rate is then ``P^2 / 2 dC/da``: that of the bond while it grows.
    """
    L, h, E, nu, both = 100.0, 5.0, 70e3, 0.3, load == "shear"
    strength, G, G2 = (24.0, 0.333, 1.0) if both else (20.0, 1.0, 3.0)
    sizes = {"crack": 64, "size": 1.25} if both else {"crack": 50, "size": 2.0}
    mesh, tags = uem.read_gmsh(uem.example_mesh("delamination"), COMM, gdim=2, parameters=sizes)
    V = uem.function_space(mesh, 2, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law = uem.Cohesive(strength, G, shear_energy=G2, mixed=uem.BenzeggaghKenane(2.0))
    bond = uem.Contact(tags["upper_bond"], tags["lower_bond"], cohesion=law, coupling=coupling, sliding="small")
    ends = [tags["upper_left"], tags["lower_left"]][: 2 if both else 1]
    far = 4.0 if both else 5.0
    bcs = [uem.dirichlet(V, tags["upper_right"]), uem.dirichlet(V, tags["lower_right"])]
    bcs += [uem.dirichlet(V, end, 1, value=far) for end in ends]
    F = uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[bond], petsc_options_prefix="cohesion_")
    stiff, gamma, k = E / (1 - nu**2), 2.36 * (1 + nu), 3 if both else 7
    rates = []
    for step in uem.load_steps(problem, 8):
        P = sum(problem.reaction(end)[1] for end in ends)
        C = far * step.factor / P - 3 * L / (5 * E / (2 * (1 + nu)) * h)
        a = ((2 * stiff * h**3 * C - L**3) / k) ** (1 / 3)
        if sizes["crack"] + 8 < a < 95:
            chi = np.sqrt(2 * (1 + nu) / 11 * (3 - 2 * (gamma / (1 + gamma)) ** 2))
            opening = 0.0 if both else 3.0 * ((a + chi * h) / (a + 0.42 * chi * h)) ** 2
            share = 2.25 / (2.25 + opening)
            rates.append(0.75 * k * P**2 * a**2 / (stiff * h**3) / (G + (G2 - G) * share**2))
    assert len(rates) > 1 and np.abs(np.array(rates) - 1.0).max() < 0.02


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_fibre_is_pulled_out(coupling):
    """A fibre that shrinkage presses into a matrix: bond and friction resist, in the end friction alone, mu times the normal force."""
    mu, length, E = 0.3, 4.0, 1e3
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, length], [2, 12]),
                                      box("quadrilateral", [1.0, 0.0], [3.0, length], [3, 8])])  # fmt: skip
    uem.axisymmetric(s.mesh)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law = uem.Cohesive(1.0, 0.005, stiffness=2e4)
    contact = uem.Contact(
        s.tag("fibre", 0, at(0, 1.0)), s.tag("matrix", 1, at(0, 1.0)), cohesion=law, friction=mu, offset=2e-3, coupling=coupling,
        sliding="small",
    )  # fmt: skip
    top = s.tag("top", 0, at(1, length))
    bcs = [*clamp(V, s.tag("axis", 0, at(0, 0.0)), 0), *clamp(V, s.tag("held", 1, at(1, 0.0)), 1)]
    bcs += clamp(V, top, 1, value=0.06)
    F = uem.LinearElastic(E, 0.0, kind="axisymmetric").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], petsc_options_prefix="cohesion_")
    forces = []
    for _ in uem.load_steps(problem, 12):
        forces.append((problem.reaction(top)[1], contact.resultant().normal))
    pull, press = forces[-1]
    assert press > 5.0 and pull == pytest.approx(mu * press, rel=1e-2)
    # before, the bond adds to it, up to its strength on the surface of the fibre
    most = max(force for force, _ in forces)
    assert pull + 0.3 * 2 * np.pi * length < most < pull * 1.1 + 2 * np.pi * length


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("unloading", ["origin", "plastic"])
def test_a_run_that_continues(folder, unloading, friction):
    """From a checkpoint a run continues as if it had not ended, with its damage; another law is named."""
    law = uem.Cohesive(1.0, 0.01, unloading=unloading)

    def begun(law=law):
        b = blocks(COMM, "quadrilateral", 2, 3)
        contact = uem.Contact(b.high, b.low, cohesion=law, friction=friction, sliding="small")
        way = [0.0, 0.01, 0.006, 0.012]
        return b, contact, pulled(b, lambda s: np.array([0.7, 1.0]) * np.interp(3 * s, range(4), way), [contact])

    def forces(b, problem, stop=99, file=None):
        found = []
        for step in uem.load_steps(problem, 6, checkpoint=file and uem.Checkpoint(folder / "run.npz")):
            found.append(tuple(problem.reaction(b.top)))
            if step.number == stop:
                break
        return found

    b, contact, problem = begun()
    whole, damage = forces(b, problem), highest(COMM, contact.damage.x.array)
    b, _, problem = begun()
    forces(b, problem, 3, True)
    b, contact, problem = begun()
    rest = forces(b, problem, file=True)
    assert np.allclose(rest, whole[3:], rtol=1e-8, atol=1e-10) and highest(COMM, contact.damage.x.array) == pytest.approx(damage)
    b, contact, problem = begun(uem.Cohesive(1.0, 0.02))
    refused(uem.CheckpointError, "cohesion", lambda: forces(b, problem, file=True))


@pytest.mark.slow
def test_a_mass_on_a_bond():
    """A stiff mass on an intact bond swings with the period 2 pi sqrt(m / (K A)), and loses no energy; a fast one breaks it."""
    K, m = 400.0, 1.0
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 2])])

    def swing(speed):
        V = compat.function_space(s.mesh, 1, (2,))
        u = fem.Function(V, name="u")
        contact = uem.Contact(
            s.tag("bottom", 0, at(1, 0.0)), uem.RigidPlane((0, 0), (0, 1)), cohesion=uem.Cohesive(4.0, 1.0, stiffness=K)
        )
        bcs = [bc for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", 0, at(0, end)), 0)]
        dynamics = uem.Dynamics(uem.consistent_mass(V, m), contactors="massy", velocity=(0.0, speed))
        problem = uem.UnitedProblem(linear(u, 1e6, 0.0), u, bcs=bcs, contacts=[contact], dynamics=dynamics,
                                    petsc_options_prefix="cohesion_")  # fmt: skip
        period = 2 * np.pi * np.sqrt(m / K)
        length = (0.45 if speed < 1 else 1.5) * period
        tops = [highest(COMM, u.x.array[1::2]) for _ in uem.time_steps(problem, period / 200, length)]
        energy = 0.5 * m * speed**2
        return tops, contact, energy

    tops, contact, _ = swing(0.1)
    assert max(tops) == pytest.approx(0.1 * np.sqrt(m / K), rel=1e-3) and highest(COMM, contact.damage.x.array) == 0.0
    tops, contact, energy = swing(2.0)
    left = (tops[-1] - tops[-2]) / (2 * np.pi * np.sqrt(m / K) / 200)
    assert highest(COMM, contact.damage.x.array) == 1.0
    assert 0.5 * m * left**2 == pytest.approx(energy - 1.0, rel=5e-3)


def test_what_is_refused():
    """What does not go with cohesion is named."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    for what, how in (
        ("normal", {"normal": uem.SoftContact(1.0)}),
        ("wear", {"wear": 1e-3}),
        ("heat", {"heat": uem.Conductance(1.0, field=1)}),
        ("tied", {"tied": True}),
    ):
        refused(
            uem.InputError, f"{what} does not go with cohesion", lambda how=how: uem.Contact(b.high, b.low, cohesion=BOND, **how)
        )
    refused(uem.InputTypeError, "a Cohesive", lambda: uem.Contact(b.high, b.low, cohesion=1.0))
    plastic = uem.Cohesive(1.0, 1.0, unloading="plastic")
    refused(uem.InputError, "sliding = 'finite'", lambda: uem.Contact(b.high, b.low, cohesion=plastic))
    two = [uem.Contact(b.high, b.low, cohesion=BOND) for _ in range(2)]
    refused(uem.ConflictError, "share the pressure", lambda: pulled(b, lambda s: np.zeros(2), two))


def test_damage_in_result_files(folder):
    """Result files have the damage, the shear and tensile pressures of a bond, as the contact has them."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    contact = uem.Contact(b.high, b.low, cohesion=BOND)
    problem = pulled(b, lambda s: np.array([0.002, 0.01]) * s, [contact])
    writer = uem.ResultsWriter(folder / "run", problem)
    for step in uem.load_steps(problem, 2):
        writer.write(step)
    writer.close()
    results = uem.read_results(folder / "run")
    for name, field in (("damage", contact.damage), ("contact_pressure", contact.pressure), ("traction", contact.traction)):
        assert highest(COMM, np.abs(results.function(name).x.array)) == pytest.approx(
            highest(COMM, np.abs(field.x.array)), rel=1e-6
        )


@pytest.mark.slow
def test_flexure_that_snaps_back():
    """End-notched flexure under dead load: both load and displacement fall while the crack grows at its energy release rate, to 1 %."""
    L, h, E, nu, G, crack = 100.0, 5.0, 70e3, 0.3, 1.0, 50.0
    sizes = {"length": 2 * L, "crack": crack, "middle": L, "size": 1.25, "n": 2}
    mesh, tags = uem.read_gmsh(uem.example_mesh("delamination"), COMM, gdim=2, parameters=sizes)
    V = uem.function_space(mesh, 2, (2,))
    u, v, P = fem.Function(V), ufl.TestFunction(V), fem.Constant(mesh, (0.0, 0.0))
    law = uem.Cohesive(40.0, 0.5, shear_energy=G, mixed=uem.BenzeggaghKenane(2.0))
    bond = uem.Contact(tags["upper_bond"], tags["lower_bond"], cohesion=law, sliding="small")
    free = uem.Contact(tags["upper_crack"], tags["lower_crack"], sliding="small")
    bcs = [uem.dirichlet(V, tags["lower_left_corner"], 1), uem.dirichlet(V, tags["lower_right_corner"])]
    problem = uem.UnitedProblem(
        uem.LinearElastic(E, nu, kind="plane_strain").residual(u, v) * ufl.dx, u, bcs=bcs, contacts=[bond, free],
        points=[uem.PointLoad(tags["upper_middle"], P)], load={P: (0.0, -160.0)}, petsc_options_prefix="cohesion_",
    )  # fmt: skip
    node = fem.locate_dofs_topological(V, 0, tags["upper_middle"].entities)
    owned, stiff, rows = node[node < V.dofmap.index_map.size_local], E / (1 - nu**2), []
    for step in uem.load_steps(problem, 15, arc_length=uem.Dissipation(2.5)):
        force, d = 160.0 * step.factor, -COMM.allreduce(u.x.array[2 * owned + 1].sum())
        shears = 0.3 * L / (E / (2 * (1 + nu)) * h)
        a = (((d / force - shears) * 8 * stiff * h**3 - 2 * L**3) / 3) ** (1 / 3)
        rows.append((force, d, 9 * force**2 * a**2 / (16 * stiff * h**3) / G, step.newton_iterations))
        if len(rows) == 14:
            break
    forces, d, rates, iterations = np.array(rows).T
    peak = int(d.argmax())
    assert peak < 11 and (np.diff(forces[peak:]) < 0.0).all() and (np.diff(d[peak:]) < 0.0).all()
    assert np.abs(rates[peak + 1 :] - 1.0).max() < 0.01 and iterations.max() < 10


@pytest.mark.long
@pytest.mark.parametrize(("n", "energy"), [(5, 0.01), (8, 0.004), (10, 0.006)])
@pytest.mark.parametrize(
    ("cell", "coupling"), [("quadrilateral", "node_to_surface"), ("triangle", "mortar"), ("quadrilateral", "mortar")]
)
def test_path_beyond_the_last_bond(cell, coupling, n, energy):
    """The crack has the energy of its area; when it has run through, the load rises along the elastic path of the parted bodies."""
    r = cracking(COMM, cell=cell, coupling=coupling)
    (bond,), u, spent, rows = r.problem.contacts, r.problem.u, 0.0, [(0.0, 0.0, 0.0)]
    (P,) = r.problem.load
    x = ufl.SpatialCoordinate(r.scene.mesh)
    along = fem.form((1.5 - x[0]) * u[1] * uem.ds(r.scene.tag("top", 1, at(1, 1.0)), r.scene.mesh))
    for step in uem.load_steps(r.problem, n, arc_length=uem.Dissipation(energy)):
        way = COMM.allreduce(fem.assemble_scalar(along))
        last, before, _ = rows[-1]
        spent += 0.5 * (last * way - float(P.value) * before)
        owned = bond.damage.function_space.dofmap.index_map.size_local
        rows.append((float(P.value), way, COMM.allreduce(bond.damage.x.array[:owned].sum()) / 5))
    forces, _, damage = np.array(rows).T
    through = int(np.argmax(damage >= 1.0 - 1e-12))
    assert 0 < through < len(rows) - 1 and (np.diff(forces[through:]) > 0.0).all() and (np.diff(forces[:through]) < 0.0).any()
    assert spent == pytest.approx(0.05, rel=0.15)
    assert highest(COMM, u.x.array) == pytest.approx(1.5 * 3.0 / 5.0, rel=1e-8) and step.factor == 1.0


def test_what_can_grow_on():
    """Damage that has grown and is not 1; damage that rests, and separated bonds, do not count."""
    rest, whole = np.zeros(2), np.ones(2)
    states = {(False, False): (0.5, 0.0), (True, True): (0.5, 1.0), (True, False): (1.0, 1.0)}
    for expected, (damage, grew) in states.items():
        state = np.column_stack([damage * whole, damage * whole, rest, grew * whole])
        assert growth_of(state) == expected
    assert growth_of(np.zeros((0, 4))) == (False, False)


def test_dissipation_refuses_other_laws():
    """Laws whose dissipation load and displacement do not measure are named."""
    for words, more in (("viscosity", {"viscosity": 0.1}), ("unloading", {"unloading": "plastic"})):
        b = blocks(COMM, "quadrilateral", 2, 3)
        contact = uem.Contact(b.high, b.low, cohesion=uem.Cohesive(1.0, 0.01, **more), sliding="small", name="bond")
        problem = pulled(b, lambda s: 0.0 * direction(2, 0.0), [contact])
        refused(uem.InputError, words, lambda problem=problem: next(uem.load_steps(problem, 2, arc_length=uem.Dissipation(1.0))))
    refused(uem.InputError, "energy", lambda: uem.Dissipation(0.0))
    b = blocks(COMM, "quadrilateral", 2, 3)
    law, v = uem.VonMises(b.u, 1.0, 0.3, 0.1, kind="plane_strain"), ufl.TestFunction(b.V)
    P, contact = fem.Constant(b.scene.mesh, 0.0), uem.Contact(b.high, b.low, cohesion=uem.Cohesive(1.0, 0.01), sliding="small")
    F = law.residual(v) - P * v[1] * uem.ds(b.top, b.scene.mesh)
    bcs = uem.dirichlet(b.V, b.bottom)
    problem = uem.UnitedProblem(F, b.u, bcs=[bcs], contacts=[contact], materials=[law], load={P: 0.1})
    refused(uem.InputError, "VonMises", lambda: next(uem.load_steps(problem, 2, arc_length=uem.Dissipation(1.0))))


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_an_energy_of_several_contactors(coupling):
    """A step that is to separate the whole bond several times over ends in an error that names the energy of a contactor."""
    problem = cracking(COMM, coupling=coupling).problem
    with pytest.raises(uem.ConvergenceError, match=r"Dissipation\(0.3\) separates several .* each takes at most 0.0125"):
        list(uem.load_steps(problem, 1, arc_length=uem.Dissipation(0.3)))
