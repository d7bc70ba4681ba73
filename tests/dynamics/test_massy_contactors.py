"""Implicit steps with contactors that keep their mass: contact acts for whole steps, and never gives energy.

The test to read first is ``test_bars_never_gain_energy``: impedances of two bars in a ratio from 1e-3 to 1e3, and steps of any length.
"""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from body_scenes import Bodies
from dolfinx import fem
from helpers import at, box, highest, linear, modulus, refused, scene, slow
from restart_scenes import continues_alike

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.united.system import BodySystem

COMM = MPI.COMM_WORLD
SPEED, WIDTH = 1e-2, 0.3


class Bars:
    """A bar that comes down on another one, both free, of length 1; the lower one has E = density = 1, and a linear material without nu.

    Args:
        mass, stiffness: of the upper bar over that of the lower one.
        along: speed of the upper bar along the contact over that towards it.
        narrow: by how much the upper bar is narrower on either side, so that the lower one's facets turn.
        n: cells along each bar.
        parted: whether the upper bar consists of two halves that are tied, by equations at their nodes or as a contact.
        rigid: whether the upper bar moves as a rigid part, with this mass at its middle.
        how: of the contact.
    """

    def __init__(
        self, mass=1.0, stiffness=1.0, *, along=0.0, narrow=0.0, n=(6, 6), cfl=0.5, cell="quadrilateral", scheme=None, parted=None,
        rigid=None, masses=uem.lumped_mass, comm=COMM, unit=1.0, contactors="massy", general=False, **how,
    ):  # fmt: skip
        g, across = (2 if cell in ("quadrilateral", "triangle") else 3), (1, 2 if narrow else 1)
        self.dt = cfl * unit * min(1.0 / n[0], 1.0 / n[1] / np.sqrt(stiffness / mass))
        self.gap, self.n, self.cfl, self.unit, self.comm = 0.3 * SPEED * self.dt, n, cfl, unit, comm
        low, high = ([0.0] * (g - 1), [WIDTH] * (g - 1)), ([narrow] * (g - 1), [WIDTH - narrow] * (g - 1))
        tops, gap = [0.0, 1.0] if parted is None else [0.0, 0.5, 1.0], self.gap / unit
        bodies = [box(cell, [*low[0], -1.0], [*low[1], 0.0], [*[across[1]] * (g - 1), n[0]])]
        bodies += [
            box(cell, [*high[0], gap + a], [*high[1], gap + b], [*[across[0]] * (g - 1), round(n[1] * (b - a))])
            for a, b in zip(tops, tops[1:])
        ]
        self.s = s = scene(comm, cell, bodies)
        sides = [s.tag("high", 1, at(g - 1, gap, 1e-3 * gap)), s.tag("low", 0, at(g - 1, 0.0))]
        joint = None if parted is None else [s.tag(f"joint {k}", k, at(g - 1, gap + 0.5)) for k in (1, 2)]
        whole = s.tag("upper", 1, lambda x: x[:, -1] > 0.0)
        s.mesh.geometry.x[:] *= unit
        V = compat.function_space(s.mesh, 1, (g,))
        self.V, self.u, v, velocity = V, fem.Function(V), ufl.TestFunction(V), fem.Function(V)
        upper = np.unique(compat.cell_dofs(V)[s.body > 0])
        velocity.x.array.reshape(-1, g)[upper, -1] = -SPEED
        velocity.x.array.reshape(-1, g)[upper, 0] = along * SPEED
        law = uem.LinearElastic(modulus(s, 1.0, *[stiffness] * (len(bodies) - 1)), 0.0, kind="plane_stress" if g == 2 else "3d")
        self.contact = uem.GeneralContact(**how) if general else uem.Contact(*sides, **how)
        contacts, more = [self.contact], {}
        if parted == "tied":
            contacts.append(uem.Contact(*joint[::-1], tied=True))
        if parted == "equations":
            more["equations"] = [uem.periodic(joint[1], joint[0])]
        if rigid is not None:
            middle = np.append(np.full(g - 1, WIDTH / 2), gap + 0.5) * unit
            self.part = uem.RigidCoupling(whole, middle, rotations="large", mass=rigid, inertia=rigid)
            more["couplings"] = [self.part]
        self.dynamics = uem.Dynamics(
            masses(V, modulus(s, 1.0, *[mass] * (len(bodies) - 1))), velocity=velocity, contactors=contactors, scheme=scheme
        )
        self.problem = uem.UnitedProblem(
            law.residual(self.u, v) * ufl.dx, self.u, contacts=contacts, dynamics=self.dynamics, rtol=1e-12, **more
        )
        self.book = uem.EnergyBook(self.problem, law.energy(self.u) * ufl.dx)
        self.upper = upper[upper < self.problem.config.n_owned]
        #: Time until a wave of the slower bar is back at the contact, and force of the first wave.
        c, z = np.array([1.0, np.sqrt(stiffness / mass)]), np.array([WIDTH, WIDTH - 2 * narrow]) ** (g - 1)
        z[1] *= np.sqrt(mass * stiffness)
        self.echo, self.first = 2.0 * unit / c, SPEED * z.prod() / z.sum()

    def of_part(self, nodes):
        """Momentum of owned nodes ``(gdim,)``."""
        d = self.dynamics
        p = forms.product(d.mass.M, d.mass.config.vector(d.velocity.x.array[: d.massy.size])).array_r.reshape(d.massy.shape)
        return reduced(self.comm, p[nodes].sum(axis=0))

    def of_upper(self):
        """Momentum of the upper bar ``(gdim,)``."""
        return self.of_part(self.upper) + sum(one.momentum for one in self.dynamics.added)

    def run(self, end, **how):
        """Arrays over time: energy, momentum, momentum of the upper bar, contact force and impulse on it, dissipation by friction."""
        rows = []
        for step in uem.time_steps(self.problem, self.dt, end, **how):
            row = self.book.write(step)
            rows.append(
                (row.kinetic + row.stored, self.book.momenta[-1], self.of_upper(), self.contact.resultant().force,
                 self.book.impulses[-1][0], row.friction, row.contact, row.defect, step.time, step.dt)
            )  # fmt: skip
        names = "energy", "momentum", "upper", "force", "impulse", "friction", "contact", "defect", "time", "dt"
        first = self.book.rows[0]
        return SimpleNamespace(start=first.kinetic + first.stored, **dict(zip(names, map(np.array, zip(*rows)))))


def harmless(bars, end, given=1e-11):
    """Assert that no step gives energy beyond a part of it, and that momenta and contact forces balance to rounding; returns the run."""
    before = bars.of_upper()
    run = bars.run(end)
    size = np.abs(before).max()
    energy = np.append(run.start, run.energy)
    assert np.diff(energy).max() <= given * run.start and run.energy[-1] < run.start >= energy.max() * (1 - 1e-11)
    assert np.abs(run.momentum - before).max() <= 1e-11 * size
    # the force is the mean over the step
    assert np.abs(run.upper - before - np.cumsum(run.dt[:, None] * run.force, axis=0)).max() <= 1e-10 * size
    assert np.abs(run.upper - before - run.impulse).max() <= 1e-10 * size
    assert run.force[:, -1].max() > 0.0 and run.force[:, -1].min() >= 0.0
    return run


RATIOS = [(1.0, 1.0), (1e-3, 1.0), (1.0, 1e-3), (1e3, 1.0), (1.0, 1e3), (1.5, 1.5)]


@pytest.mark.parametrize(
    ("ratio", "cfl", "how"),
    [
        (RATIOS[0], 0.5, {}),
        (RATIOS[4], 3.0, {"coupling": "mortar"}),
        *(slow(ratio, cfl, {}) for ratio in RATIOS for cfl in (0.2, 1.0)),
        *(slow(ratio, 0.5, {"masses": uem.consistent_mass}) for ratio in RATIOS),
        *(slow(ratio, 0.5, {"coupling": "mortar"}) for ratio in RATIOS[:3]),
        *(slow(RATIOS[5], 0.5, {"cell": cell, "n": (4, 4)}) for cell in ("triangle", "hexahedron", "tetrahedron")),
    ],
)  # fmt: skip
def test_bars_never_gain_energy(ratio, cfl, how):
    """Contact takes energy or none in every step, and its work is what energy lacks, for any impedance, step, mass matrix and coupling."""
    bars = Bars(*ratio, cfl=cfl, **how)
    # facets of simplices turn
    run = harmless(bars, 1.6 * min(bars.echo), 2e-5 if how.get("cell") in ("triangle", "tetrahedron") else 1e-11)
    assert np.abs(run.defect).max() <= 1e-9 * run.start
    assert np.abs(run.energy - run.start - run.contact).max() <= 1e-9 * run.start


@pytest.mark.long
@pytest.mark.parametrize("rho_inf", [0.8, slow(0.0)])
def test_damped_steps_lose_more(rho_inf):
    """With the generalised-alpha method momentum balances by the same forces."""
    bars = Bars(1.0, 10.0, scheme=uem.generalised_alpha(rho_inf))
    run = harmless(bars, 3.0 * min(bars.echo), 1e-2)
    assert run.energy[-1] < run.start + run.contact[-1]


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [(1.0, 1.0), (0.5, 4.0)])
def test_force_and_impulse_of_bars(ratio):
    """The mean force until the echo is that of the first waves, as far as the mesh goes, and the lost energy halves with the cells."""
    lost = []
    for n in (8, 16):
        bars = Bars(*ratio, n=(n, n), cfl=0.5)
        run = bars.run(min(bars.echo))
        k = np.searchsorted(run.time, 0.9 * min(bars.echo))
        assert abs(run.impulse[k, -1] / run.time[k] / bars.first - 1.0) < 0.25 / n
        lost.append(1.0 - run.energy[k] / run.start)
    assert lost[0] / lost[1] == pytest.approx(2.0, rel=0.02) and lost[0] < 0.4 / 8


@pytest.mark.long
def test_general_contact():
    """One declaration for both bars: its forces between them are the means over the steps."""
    bars = Bars(1.0, 1.0, general=True)
    before, impulse, energy = bars.of_upper(), np.zeros(2), [np.inf]
    for step in uem.time_steps(bars.problem, bars.dt, bars.echo.min()):
        row = bars.book.write(step)
        energy.append(row.kinetic + row.stored)
        impulse += step.dt * bars.contact.between("body 2", "body 1").force
        assert np.abs(bars.of_upper() - before - impulse).max() <= 1e-10 * np.abs(before).max()
    assert np.diff(energy).max() <= 1e-11 * energy[1] and impulse[1] > 0.5 * np.abs(before).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [{}, slow({"coupling": "mortar"}), slow({"cell": "hexahedron", "n": (3, 3)}), slow({"parted": "tied"})]
)
def test_friction_never_gives_energy(how):
    """A bar that strikes at a slant slides and sticks: friction dissipates in every step, and takes what normal contact does not."""
    bars = Bars(1.0, 2.0, along=0.6, narrow=0.1, friction=0.3, **how)
    # facets turn
    run = harmless(bars, 2.0 * min(bars.echo), 1e-5)
    dissipated = np.diff(np.append(0.0, run.friction))
    # under mortar weights of sticking contactors change within the step
    least = 1e-5 * run.friction[-1] if how.get("coupling") else 1e-14 * run.start
    assert dissipated.min() >= -least and run.friction[-1] > 1e-3 * run.start
    # normals lean by no more than strains
    assert (np.abs(run.force[:, 0]) <= (0.3 + SPEED) * run.force[:, -1]).all()
    assert -run.contact[-1] >= run.friction[-1] * (1 - 1e-9)
    assert np.abs(run.defect).max() <= 1e-9 * run.start


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"parted": "tied"}, {"parted": "equations"}, {"rigid": 0.5}])
def test_ties_equations_and_rigid_parts(how):
    """They hold the bodies against contact for whole steps as well, with masses at points."""
    bars = Bars(1.0, 1.0, **how)
    run = harmless(bars, 2.0 * min(bars.echo))
    assert np.abs(run.defect).max() <= 1e-9 * run.start


@pytest.mark.slow
def test_units():
    """The same in millimetres and in kilometres."""
    found = []
    for unit in (1.0, 1e-3, 1e3):
        bars = Bars(1.0, 2.0, along=0.6, narrow=0.1, friction=0.3, unit=unit)
        run = bars.run(bars.echo.min())
        found.append(np.column_stack([run.energy / unit**2, run.force / unit]))
    assert np.abs(found[1] - found[0]).max() <= 1e-9 * np.abs(found[0]).max()
    assert np.abs(found[2] - found[0]).max() <= 1e-9 * np.abs(found[0]).max()


@pytest.mark.long
def test_the_same_on_any_ranks():
    runs = [
        (bars := Bars(1.0, 2.0, along=0.6, narrow=0.1, friction=0.3, comm=comm)).run(bars.echo.min())
        for comm in (COMM, MPI.COMM_SELF)
    ]
    assert np.abs(runs[0].force - runs[1].force).max() <= 1e-9 * np.abs(runs[1].force).max()
    assert np.abs(runs[0].energy - runs[1].energy).max() <= 1e-11 * runs[1].start


@pytest.mark.long
def test_a_run_continues(folder):
    """A run that is interrupted in contact continues alike."""
    path, ends = folder / "run.h5", []
    for stop, checkpoint in ((99, None), (8, path), (99, path)):
        bars = Bars(1.0, 2.0, along=0.6, narrow=0.1, friction=0.3)
        for step in uem.time_steps(
            bars.problem, bars.dt, bars.echo.min(), checkpoint=None if checkpoint is None else uem.Checkpoint(checkpoint, every=4)
        ):
            if step.number == stop:
                break
        ends.append(np.concatenate([bars.u.x.array, bars.dynamics.velocity.x.array, bars.contact.force.x.array]))
    continues_alike(ends[2], ends[0])


def test_a_step_is_taken_again():
    """A step that is repeated has the same end."""
    bars = Bars(1.0, 2.0, along=0.6, narrow=0.1, friction=0.3)
    for step in uem.time_steps(bars.problem, bars.dt, 6 * bars.dt):
        before = np.concatenate([bars.u.x.array, bars.dynamics.acceleration.x.array, bars.contact.force.x.array])
        if step.number > 3:
            bars.problem.solve()
            after = np.concatenate([bars.u.x.array, bars.dynamics.acceleration.x.array, bars.contact.force.x.array])
            assert highest(COMM, np.abs(after - before)) <= 1e-10 * highest(COMM, np.abs(before))


def test_what_is_refused():
    """Forces that are not proportional to those along the normal, their histories, and nodes without mass."""
    for how, words in (
        ({"friction": uem.Tresca(1.0)}, "limit per area"),
        ({"friction": 0.3, "wear": 1e-6}, "wear"),
        ({"tied": "after"}, "tie"),
    ):
        refused(uem.InputError, (words, "massy"), lambda how=how: Bars(**how))
    bare = partial(uem.nodal_mass, values=lambda X: np.where(np.abs(X[:, 1]) < 0.1, 0.0, 1.0))
    refused(uem.MassError, ("no mass", "massy"), lambda: Bars(masses=lambda V, _: bare(V)))
    bars = Bars()
    next(iter(uem.time_steps(bars.problem, bars.dt, 2 * bars.dt)))
    refused(uem.InputError, ("after time steps", "massy"), bars.problem.solve)
    bars = Bars()
    with pytest.raises(uem.InputError, match="massy"), uem.recording(bars.problem):
        pass


def test_methods_that_give_energy_are_warned_of(caplog):
    """Systems other than elimination pass contact forces on to the next step, unless contactors have no mass."""

    class Other(BodySystem):
        """A system of a user."""

    for contactors, warned in (("massy", True), ("massless", False)):
        caplog.clear()
        b = Bodies("quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [4, 6])])
        dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), contactors=contactors)
        contact = uem.Contact(b.side(0, 1, 0.0), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
        uem.UnitedProblem(linear(b.u, 1.0), b.u, contacts=[contact], dynamics=dynamics, method=Other)
        assert COMM.rank != 0 or ("every touch adds energy" in caplog.text) == warned


@pytest.mark.parametrize(("n", "cfl"), [(20, 1.0), slow(20, 0.3), slow(40, 2.0)])
def test_a_bar_on_a_wall(n, cfl):
    """The wall takes the energy of half a cell, in steps of any length, and bears the force of the wave in every step."""
    bar = Bar(n, contactors="massy")
    force = bar.run(cfl / (3 * n), 1.3)
    rows = bar.book.rows
    energy = np.array([row.kinetic + row.stored for row in rows])
    assert np.diff(energy).max() <= 1e-11 * energy[0] and energy[-1] / energy[0] == pytest.approx(1.0 - 0.5 / n, rel=1e-9)
    assert max(abs(row.defect) for row in rows) <= 1e-9 * energy[0]
    impulse = (force[:, 1] * [step.dt for step in bar.steps]).sum()
    assert impulse == pytest.approx(bar.book.momenta[-1][1] - bar.book.momenta[0][1], rel=1e-9)
    assert 194.0 < impulse < 200.0
    # rho c v, between the first oscillations and the echo
    assert np.abs(force[(force[:, 0] > 0.65) & (force[:, 0] < 1.0), 1] - 300.0).max() < 0.05 * 300.0


@pytest.mark.parametrize("scheme", [None, slow(uem.generalised_alpha(0.8))])
def test_a_bar_at_rest(scheme):
    """The floor bears the weight in every step, and nothing moves."""
    bar = Bar(10, gap=0.0, v=0.0, contactors="massy", gravity=(0.0, -3.0), scheme=scheme)
    bar.problem.solve()
    force = bar.run(0.05, 0.5)
    assert np.abs(force[:, 1] - 30.0).max() <= 1e-9 * 30.0
    assert highest(COMM, np.abs(bar.dynamics.velocity.x.array)) <= 1e-9 * 3.0 * 0.05


@pytest.mark.long
@pytest.mark.parametrize("masses", [uem.lumped_mass, slow(uem.consistent_mass)])
def test_a_block_on_a_belt(masses):
    """A block falls onto a belt: friction is mu times the force in every step that it slips, and in the end it moves with the belt."""
    b, belt = (
        Bodies("quadrilateral", [box("quadrilateral", [0.0, 0.01], [2.0, 1.01], [4, 3])]),
        uem.RigidPlane((0.0, 0.0), (0.0, 1.0)),
    )
    contact = uem.Contact(b.side(0, 1, 0.01), belt, friction=0.3)
    dynamics = uem.Dynamics(masses(b.V, 1.0), gravity=(0.0, -1.0), contactors="massy")
    law = uem.LinearElastic(1e4, 0.0, kind="plane_strain")
    problem = uem.UnitedProblem(
        law.residual(b.u, ufl.TestFunction(b.V)) * ufl.dx, b.u, contacts=[contact], dynamics=dynamics, rtol=1e-11,
        load=lambda t: belt.move((0.4 * t, 0.0)),
    )  # fmt: skip
    book, at_rest = uem.EnergyBook(problem, law.energy(b.u) * ufl.dx), []
    for step in uem.time_steps(problem, 0.04, 2.0):
        row, force = book.write(step), contact.resultant().force
        if step.time < 1.0:
            assert force[0] == pytest.approx(0.3 * force[1], rel=1e-9, abs=1e-12)
        at_rest.append(book.momenta[-1][0] / 2.0 - 0.4)
        assert abs(row.defect) <= 1e-9 * 0.5 * 2.0 * 0.4**2
    assert book.momenta[-1] == pytest.approx(book.impulses[-1][0] + [0.0, -2.0 * 2.0], abs=1e-9)
    assert abs(np.mean(at_rest[-10:])) < 0.01 * 0.4


def test_force_of_a_tie():
    """What a tie passes on is the momentum of the part behind it, also by a mass matrix that joins it to the contact."""
    bars = Bars(1.0, 1.0, parted="tied", masses=uem.consistent_mass, n=(4, 2))
    tie, impulse, last = bars.problem.contacts[1], 0.0, 0.0
    behind = np.unique(compat.cell_dofs(bars.V)[bars.s.body == 2])
    behind = behind[behind < bars.problem.config.n_owned]
    start = bars.of_part(behind)
    for step in uem.time_steps(bars.problem, bars.dt, 30 * bars.dt):
        force = tie.resultant().force[-1]
        impulse, last = impulse + 0.5 * step.dt * (force + last), force
    assert not bars.contact.n_active
    assert bars.of_part(behind)[-1] - start[-1] == pytest.approx(impulse, rel=1e-9)
