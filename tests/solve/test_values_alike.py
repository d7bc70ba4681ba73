"""Values that differ from rank to rank by mistake: refused on all, by name, before a step begins with them.

The test to read first is ``test_values_of_one_rank``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from helpers import highest, linear, refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


class Square:
    """A block on a support, and conditions of each kind on its top, with a value that may be a rank's own."""

    def __init__(self):
        self.mesh = mesh.create_unit_square(COMM, 4, 4)
        self.V = uem.function_space(self.mesh, ("Lagrange", 1, (2,)))
        self.u, self.v = fem.Function(self.V), ufl.TestFunction(self.V)
        self.top, self.bottom = (
            mesh.locate_entities_boundary(self.mesh, 1, lambda x, y=y: np.isclose(x[1], y)) for y in (1.0, 0.0)
        )
        self.F, self.q = linear(self.u, 1.0), fem.Constant(self.mesh, 0.0)
        self.hold = [uem.dirichlet(self.V, self.bottom)]

    def coupling(self, point=(0.5, 1.0), **how):
        return {"couplings": [uem.RigidCoupling(self.top, point, **how)]}

    def top_at(self, value):
        return {"bcs": [*self.hold, uem.dirichlet(self.V, self.top, 1, value)]}

    def run(self, F=None, **how):
        list(uem.load_steps(uem.UnitedProblem(self.F if F is None else F, self.u, **{"bcs": self.hold} | how), 1))


#: What may differ, and a word of the refusal.
KINDS = {
    "the force of the RigidCoupling": lambda s, own: s.run(**s.coupling(force=(0.0, 0.1 * own))),
    "the moment of the RigidCoupling": lambda s, own: s.run(**s.coupling(moment=0.1 * own)),
    "the point of the RigidCoupling": lambda s, own: s.run(**s.coupling((0.5, own), force=(0.1, 0.1))),
    "the mass of the RigidCoupling": lambda s, own: s.run(**s.coupling(force=(0.1, 0.1), mass=own)),
    "motion[1] of the RigidCoupling": lambda s, own: s.run(**s.coupling(motion=(0.0, lambda at: -0.01 * own * at, 0.0))),
    "motion[0] of the RigidCoupling": lambda s, own: s.run(**s.coupling(motion=(0.01 * own, 0.0, 0.0))),
    "the force of points[0]": lambda s, own: s.run(points=[uem.PointLoad((1.0, 1.0), (0.1 * own, 0.0))]),
    "the stiffness of points[0]": lambda s, own: s.run(points=[uem.PointSpring((1.0, 1.0), own)]),
    "the value of equations[0]": lambda s, own: s.run(equations=[uem.Equation([((1.0, 1.0), (0.0, 1.0))], b=0.01 * own)]),
    "the value of bcs[1]": lambda s, own: s.run(**s.top_at(0.01 * own)),
    "the value of bcs[1] = 0.01 on": lambda s, own: s.run(**s.top_at(fem.Constant(s.mesh, 0.01 * own))),
    "Constant 1 of F": lambda s, own: s.run(s.F - s.q * s.v[1] * ufl.ds, load={s.q: 0.1 * own}),
    "F, its expressions and numbers": lambda s, own: s.run(s.F - own * 0.125 * s.v[1] * ufl.ds),
}  # fmt: skip


@pytest.mark.skipif(COMM.size == 1, reason="needs several ranks")
@pytest.mark.parametrize("what", KINDS)
def test_values_of_one_rank(what):
    """Another on the last rank is refused on all."""
    own = 1.0 + (COMM.rank == COMM.size - 1)
    refused(uem.InputError, (what, "on rank 0", "expected the same on all ranks"), lambda: KINDS[what](Square(), own))


@pytest.mark.parametrize("what", KINDS)
def test_values_of_all_ranks(what):
    """The same on all is what was meant."""
    KINDS[what](Square(), 1.0)


def alike(one, other):
    """Assert that two solutions are the same to rounding, which may hang on where arrays lie in memory and on what comes first."""
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * highest(COMM, np.abs(other)))


@pytest.mark.parametrize("size", [1.0, 1e-9, 1e3])
def test_functions_whose_ghosts_differ(size):
    """Values in Functions are those of the nodes' owners, whatever other ranks have at their copies; so are ramps, steps and gradients."""
    s = Square()
    s.mesh.geometry.x[:] *= size
    ends = []
    for spoilt in (False, True):
        s.u.x.array[:] = 0.0
        g = fem.Function(s.V)
        g.x.array[:] = -0.01 * size
        own = s.V.dofmap.index_map.size_local * 2
        if spoilt:
            g.x.array[own:] = 7.0 * size
        E = fem.Constant(s.mesh, 1.0)
        F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(s.u, s.v) * ufl.dx
        bcs = [*s.hold, fem.dirichletbc(g, fem.locate_dofs_topological(s.V, 1, s.top))]
        problem = uem.UnitedProblem(F, s.u, bcs=bcs)
        steps = [(step.factor, step.newton_iterations) for step in uem.load_steps(problem, 2)]
        J = ufl.inner(s.u, s.u) * ufl.dx
        (by,) = uem.gradient(problem, J, g)
        sums = [COMM.allreduce(float(f.x.array[:own].sum())) for f in (s.u, by)]
        ends.append([np.array(s.u.x.array), np.array(by.x.array), sums, steps])
    assert ends[0].pop() == ends[1].pop()
    for one, other in zip(*ends):
        alike(one, other)


def test_conditions_that_their_owner_lacks():
    """A condition that no rank but one with a copy of its nodes has is refused on all; one that copies lack is taken."""
    s = Square()
    n = s.V.dofmap.index_map.size_local
    top = fem.locate_dofs_topological(s.V, 1, s.top)
    own = [fem.dirichletbc(np.array([0.0, -0.01]), top[top < n], s.V)]
    ends = []
    for more in (own, [fem.dirichletbc(np.array([0.0, -0.01]), top, s.V)]):
        s.u.x.array[:] = 0.0
        s.run(bcs=[*s.hold, *more])
        ends.append(np.array(s.u.x.array))
    alike(*ends)
    copies = [fem.dirichletbc(np.array([0.0, -0.01]), np.arange(n, len(s.u.x.array) // 2, dtype=np.int32), s.V)]
    if COMM.size > 1:
        refused(uem.InputError, ("a Dirichlet condition holds", "owns the node"), lambda: s.run(bcs=[*s.hold, *copies]))
