"""Every law with both couplings, degrees, ways to declare it and to slide, in statics and in time: resumed, written, on any ranks.

Two blocks are pressed and sheared by a lid, which is led, or on a spring, a hinge or a slider. Each case is right by the balance of its
forces, or refused by name.
"""

from __future__ import annotations

from functools import partial
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields
from helpers import at, blocks, clamp, linear, refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
#: Stiffness of the spring at a lid, and how far a lid goes, or what force it has.
SPRING, ALONG, DOWN = 0.2, 0.04, 0.03
#: Middle of the lid, and the axis along which it slides.
MIDDLE, LEANING = (0.5, 1.0), (0.3, -1.0)
#: How a law is given to a contact.
LAWS = {
    "hard": {"friction": 0.3},
    "soft": {"normal": uem.SoftContact(uem.Exponential(2e-3, 2e-3))},
    "damping": {"normal": uem.SoftContact(20.0, damping=2.0)},
    "cohesion": {"cohesion": uem.Cohesive(0.05, 1e-4, stiffness=50.0), "friction": 0.3},
    "adhesion": {"cohesion": uem.Adhesion(1e-3, 0.1)},
    "film": {"friction": uem.ViscousFriction(0.1, mu=0.3)},
    "heat": {"heat": uem.Conductance(lambda p, g: 50.0 * p, field=1), "friction": 0.3},
    "soft heat": {"heat": uem.Conductance(lambda p, g: 50.0 * p, field=1), "normal": uem.SoftContact(20.0)},
    "current": {
        "heat": [uem.Conductance(lambda p, g: 50.0 * p, field=1, joule=2), uem.Conductance(lambda p, g: 20.0 * p, field=2)]
    },
    "leak": {"leak": 0.01},
    "wear": {"wear": 0.05, "friction": 0.3},
    "corners": {"corners": True, "friction": 0.3},
}


def fault(law, coupling, degree, declared, sliding, timed, lid):
    """Class and words of the error that a case is refused with; None if it works."""
    if declared != "contact" and law in ("cohesion", "adhesion", "leak", "wear", "corners"):
        return uem.InputTypeError, "is for single contacts"
    if declared == "self" and coupling == "mortar":
        return uem.InputError, "self_contact = True does not go with coupling = 'mortar'"
    if law in ("damping", "film") and not timed:
        return uem.InputError, "statics has none"
    if law == "corners" and coupling == "mortar":
        return uem.InputError, "corners"
    return None


class Sheared:
    """A block that a lid presses onto a wider one and drags over it, with what else its law needs."""

    def __init__(self, law, coupling, degree, declared, sliding, timed, lid, comm=COMM):
        b, self.timed, how = blocks(comm, "quadrilateral", 3, 4, degree=degree, overhang=0.25), timed, dict(LAWS[law])
        self.b, mesh = b, b.scene.mesh
        self.w, space, F, bcs, more = b.u, b.V, linear(b.u, 1.0), [], {}
        if "heat" in how:
            f = fields(b, degree, *[degree] * len(np.atleast_1d(how["heat"])))
            self.w, space, W = f.w, f.space, f.w.function_space
            (u, *others), (v, *tests) = f.split(f.w), f.split(ufl.TestFunction(W))
            eps = ufl.sym(ufl.grad(u))
            F = ufl.inner(eps + 0.5 * ufl.tr(eps) * ufl.Identity(2), ufl.sym(ufl.grad(v))) * ufl.dx
            F += sum(0.5 * ufl.inner(ufl.grad(T), ufl.grad(q)) for T, q in zip(others, tests)) * ufl.dx
            for i in range(1, 1 + len(others)):
                bcs += [uem.dirichlet(W.sub(i), tag, value=value) for tag, value in ((b.bottom, 1.0), (b.top, 3.0))]
            more["displacement"] = 0
        if law == "leak":
            how["leak"] = uem.Leak(how["leak"], b.scene.tag("inlet", 1, at(0, 0.0)))
        along, self.down = fem.Constant(mesh, 0.0), fem.Constant(mesh, (0.0, 0.0))

        def move(s):
            # pressed in the first half, dragged in the second
            part = s / 0.4 if timed else s
            along.value = ALONG * max(2 * part - 1.0, 0.0)
            self.down.value[1] = -DOWN * min(2 * part, 1.0)

        bcs += clamp(space, b.bottom)
        self.lid = self.joint = None
        if lid == "led":
            bcs += [uem.dirichlet(space, b.top, 0, along), uem.dirichlet(space, b.top, 1, self.down[1])]
        elif lid == "sprung":
            self.lid = uem.RigidCoupling(b.top, MIDDLE, motion=(along, None, 0.0), force=self.down)
            more["couplings"] = [self.lid, uem.Spring(None, self.lid, SPRING, points=(MIDDLE, MIDDLE), free_length=0.0)]
        else:
            self.lid = uem.RigidCoupling(b.top, MIDDLE, force=self.down)
            hinge = partial(uem.Hinge, point=(0.0, 1.0), stiffness=SPRING)
            joint = hinge if lid == "hinged" else partial(uem.Slider, point=MIDDLE, axis=LEANING)
            self.joint = joint(None, self.lid)
            more["couplings"] = [self.lid, self.joint]
        if declared == "contact":
            self.contact = uem.Contact(b.high, b.low, coupling=coupling, sliding=sliding, **how)
        else:
            self.contact = uem.GeneralContact(coupling=coupling, self_contact=declared == "self", **how)
        if timed:
            more["dynamics"] = uem.Dynamics(uem.lumped_mass(b.V, 1e-3))
        self.problem = uem.UnitedProblem(F, self.w, bcs=bcs, contacts=[self.contact], load=move, rtol=1e-11, **more)

    def steps(self, **how):
        """All steps, four of them."""
        return uem.time_steps(self.problem, 0.1, 0.4, **how) if self.timed else uem.load_steps(self.problem, 4, **how)

    @property
    def ground(self):
        """Force of the ground ``(2,)`` (collective)."""
        return self.problem.reaction(self.b.bottom)

    @property
    def above(self):
        """Force of all above: of the lid, and of its spring ``(2,)`` (collective)."""
        if self.lid is None:
            return self.problem.reaction(self.b.top)
        if self.joint is not None:
            return self.joint.force + self.down.value
        return self.lid.reaction[0] + self.down.value - SPRING * self.lid.displacement


WAYS = list(product(("contact", "general", "self"), ("finite", "small"), (False, True)))
CASES = [
    (law, coupling, degree, *WAYS[(5 * i + 7 * j + k) % len(WAYS)], ("led", "sprung")[(i + j + k // 6) % 2])
    for i, law in enumerate(LAWS)
    for j, (coupling, degree) in enumerate(product(("node_to_surface", "mortar"), (1, 2)))
    for k in (0, 6)
]
#: Soft contact on a hinge at the lid's end, and on a slider that leans.
CASES += [("soft", "node_to_surface", degree, "contact", "finite", False, ("hinged", "slid")[degree - 1]) for degree in (1, 2)]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_works_or_is_refused(case, folder):
    """Forces balance in every step; results, a run that continues, and one on a single rank have the same numbers."""
    wrong = fault(*case)
    if wrong is not None:
        refused(*wrong, lambda: Sheared(*case))
        return
    whole, found = Sheared(*case), []
    writer = uem.ResultsWriter(folder / "run", whole.problem)
    for step in whole.steps():
        writer.write(step)
        found.append(whole.ground)
        assert step.newton_iterations <= 15
        if not whole.timed:
            assert np.abs(whole.ground + whole.above).max() <= 1e-8 * np.abs(whole.ground).max()
    writer.close()
    assert np.abs(found[-1]).max() > 1e-3
    results = uem.read_results(folder / "run")
    u, other = results.function(whole.problem.config.name), ufl.split(whole.w)[0] if whole.w is not whole.b.u else whole.w
    # files have the values at vertices
    size = {1: 1e-6, 2: 0.03}[case[2]]
    assert uem.integrate(ufl.inner(u, u) * ufl.dx) == pytest.approx(uem.integrate(ufl.inner(other, other) * ufl.dx), rel=size)
    first, kept = Sheared(*case), folder / "kept.npz"
    for step in first.steps(checkpoint=uem.Checkpoint(kept)):
        if step.number == 2:
            break
    rest = Sheared(*case)
    assert np.allclose([rest.ground for _ in rest.steps(checkpoint=uem.Checkpoint(kept))], found[2:], rtol=1e-9, atol=1e-12)
    if COMM.size > 1:
        alone = Sheared(*case, comm=MPI.COMM_SELF)
        assert np.allclose([alone.ground for _ in alone.steps()], found, rtol=1e-7, atol=1e-9)
