"""Contact tractions on both sides of a contact."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import slow

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.accuracy.enriched import contact_tractions

COMM = MPI.COMM_WORLD


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
@pytest.mark.parametrize("degree", [1, 2])
def test_tractions_carry_the_nodal_forces(degree, coupling):
    """``∫ t . v`` are the nodal contact forces on the contactor and the target, so that forces and moments balance."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("hertz_cylinder"), COMM, gdim=2, parameters={"h": 1 / 20, "ratio": 1.4})
    V = uem.function_space(mesh, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1e6, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.05)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"], coupling=coupling)
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    problem.solve()
    t, ds = contact_tractions(problem)
    work = forms.assemble_array(V, forms.form(ufl.inner(t, v) * ds))
    force = contact.force.x.array[: len(work)]
    assert COMM.allreduce(np.abs(work - force).sum()) < 1e-8 * COMM.allreduce(np.abs(force).sum())
    both = [forms.assemble_scalar(forms.form(t[i] * ds), COMM) for i in range(2)]
    assert np.abs(both).max() < 1e-8 * abs(contact.resultant().force[1])


def test_no_contact_no_tractions():
    """A problem without contacts has none."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), COMM, gdim=2)
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags[name]) for name in ("lower_bottom", "upper_top")]
    assert contact_tractions(uem.UnitedProblem(F, u, bcs=bcs)) is None
