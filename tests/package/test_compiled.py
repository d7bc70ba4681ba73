"""Code of forms is compiled, or looked up in DOLFINx's cache, once in a process, whatever meshes and problems it is for."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem, jit
from helpers import blocks, linear, run
from ufl.algorithms.check_arities import ArityMismatch

import uem_dolfinx as uem
from uem_dolfinx import compat, compiled, forms


@pytest.fixture
def looked_up(monkeypatch):
    """What DOLFINx compiles or finds in its cache, in a process that has compiled nothing yet."""
    requested, compile_anew = [], jit.ffcx_jit

    def ffcx_jit(comm, what, *args, **options):
        requested.append(what)
        return compile_anew(comm, what, *args, **options)

    monkeypatch.setattr(jit, "ffcx_jit", ffcx_jit)
    monkeypatch.setattr(compiled, "_known", {})
    return requested


@pytest.mark.parametrize("cell, finer", [("triangle", 3), ("hexahedron", 2)])
def test_a_second_problem_compiles_nothing(comm, cell, finer, looked_up):
    """Residual and tangent on other meshes, with other constants; what is found serves these, and gives what the first one gave."""
    forces = []
    for n, E in ((2, 1000.0), (finer, 2000.0), (2, 1000.0)):
        b = blocks(comm, cell, n, n)
        contact = uem.Contact(b.high, b.low)
        problem = uem.UnitedProblem(linear(b.u, fem.Constant(b.scene.mesh, E)), b.u, bcs=b.oedometer(0.05), contacts=[contact])
        run(problem)
        forces.append(contact.resultant().force)
        assert (len(looked_up) > 0) == (len(forces) == 1)
        looked_up.clear()
    assert np.allclose(forces[1], 2.0 * forces[0], rtol=1e-9, atol=1e-9 * np.abs(forces[0]).max())
    assert np.array_equal(forces[2], forces[0]) or comm.size > 1


def test_what_is_unlike_is_compiled(comm, looked_up):
    """Forms that differ in a number, a degree of quadrature or a factor are others."""
    domain = blocks(comm, "triangle").scene.mesh
    x = ufl.SpatialCoordinate(domain)[0]
    looked_up.clear()
    wanted = ((1.0, None, 1.0), (2.0, None, 2.0), (1.0, 1, 1.0), (x, 2, 2 / 3))
    for times, degree, integral in wanted:
        for count in (1, 0):
            found = forms.assemble_scalar(forms.form(times * x * ufl.dx(domain, degree=degree)), comm)
            assert found == pytest.approx(integral, rel=1e-14)
            assert len(looked_up) == count
            looked_up.clear()


def test_ranks_compile_together(comm, looked_up):
    """What one rank has not compiled is looked up by all; none waits for the others for ever."""
    domain = blocks(comm, "triangle").scene.mesh
    looked_up.clear()
    for _ in range(2):
        assert forms.assemble_scalar(forms.form(ufl.as_ufl(1.0) * ufl.dx(domain)), comm) == pytest.approx(2.0, rel=1e-14)
        assert len(looked_up) == 1
        looked_up.clear()
        if comm.rank == comm.size - 1:
            compiled._known.clear()


def test_what_fails_leaves_dolfinx_as_it_was(comm, looked_up):
    """DOLFINx's own calls compile by its own function again, also after a form that cannot be compiled."""
    own, domain = jit.ffcx_jit, blocks(comm, "triangle").scene.mesh
    v = ufl.TestFunction(compat.function_space(domain, 1))
    known = dict(compiled._known)
    # of which class depends on the version of UFL
    with pytest.raises((Exception, ArityMismatch)):
        forms.form(v**2 * ufl.dx)
    assert jit.ffcx_jit is own and compiled._known == known
