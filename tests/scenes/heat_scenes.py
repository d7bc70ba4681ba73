"""Bars in series that conduct heat, and electric current, through their contact."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from benchmarks.scenes import NU
from block_scenes import blocks, modulus
from dolfinx import fem
from field_scenes import fields, strain, stress

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
COLD, HOT, K = 100.0, 300.0, 2.0


class Bars:
    """Guided blocks, cold at the bottom and hot at the top, whose upper one is pressed down: one-dimensional in height.

    Args:
        h: conductance, or a rigid surface's.
        n: divisions of the upper block.
        press: displacement of the top, downwards.
        gap: between the blocks.
        alpha: expansion.
        above: by how much the upper block conducts better.
        rigid: surface that the upper block faces instead of the other one, as cold.
        how: of the contact.
    """

    def __init__(
        self,
        h,
        *,
        cell="triangle",
        degree=1,
        of_heat=1,
        n=3,
        press=0.01,
        gap=0.0,
        alpha=0.0,
        above=1.0,
        pose=None,
        rigid=None,
        **how,
    ):
        b = self.b = blocks(COMM, cell, 3, n, degree=degree, gap=gap, **({} if pose is None else {"pose": pose}))
        f = self.f = fields(b, degree, of_heat)
        (u, T), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
        self.E, self.nu = 1e3, 0.3
        thermal = stress(u, self.E, self.nu) - alpha * self.E / (1 - 2 * self.nu) * T * ufl.Identity(b.gdim)
        self.F = ufl.inner(thermal, strain(v)) * ufl.dx
        self.F += modulus(b.scene, K, above * K) * ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx
        self.hot = fem.Constant(b.scene.mesh, HOT)
        ends = [uem.dirichlet(f.other, b.bottom, value=COLD), uem.dirichlet(f.other, b.top, value=self.hot)]
        self.bcs = [*f.confined(), uem.dirichlet(f.space, b.top, b.gdim - 1, -press), *ends]
        heat = uem.Conductance(h, field=1, temperature=None if rigid is None else COLD)
        self.contact = uem.Contact(b.high, rigid or b.low, heat=heat, name="bars", **how)
        self.problem = uem.UnitedProblem(self.F, f.w, displacement=0, bcs=self.bcs, contacts=[self.contact])

    @property
    def flux(self):
        """At this rank's contactors ``(n,)``, from hot to cold."""
        return self.contact.heat_flux.x.array[self.contact.nodes]

    @property
    def temperature(self):
        return self.problem.config.functions()["field_1"]

    def ends(self):
        """Heat that enters at the bottom and at the top, by the residual (collective)."""
        p = self.problem
        p.bodies.assemble()
        n = self.f.w.function_space.dofmap.index_map.size_local
        out = []
        for bc in self.bcs[-2:]:
            dofs = uem.compat.bc_dofs(bc)[0]
            out.append(COMM.allreduce(p.bodies._b.array_r[dofs[dofs < n]].sum()))
        return np.array(out)


class Joint:
    """The same bars with an electric potential, cold at both ends, whose contact a current heats.

    Args:
        h: conductance of heat.
        s: conductance of the current.
        volt: potential of the top; the bottom has none.
        sigma: conductivity of the bars, whose own heat is left out.
        of_field: see ``Conductance``, of the current.
        share: of the heat that enters the upper bar.
        press, n, alpha, pose: as for ``Bars``.
        how: of the contact.
    """

    def __init__(
        self,
        h,
        s,
        *,
        cell="triangle",
        degree=1,
        n=3,
        volt=10.0,
        sigma=0.5,
        of_field=None,
        share=0.5,
        press=0.01,
        alpha=0.0,
        pose=None,
        **how,
    ):
        b = self.b = blocks(COMM, cell, 3, n, degree=degree, **({} if pose is None else {"pose": pose}))
        f = self.f = fields(b, degree, degree, degree)
        (u, T, phi), (v, q, w) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
        thermal = stress(u, 1e3) - alpha * 1e3 / (1 - 2 * NU) * T * ufl.Identity(b.gdim)
        self.F = ufl.inner(thermal, strain(v)) * ufl.dx
        self.F += (K * ufl.inner(ufl.grad(T), ufl.grad(q)) + sigma * ufl.inner(ufl.grad(phi), ufl.grad(w))) * ufl.dx
        W = f.w.function_space
        self.volt = fem.Constant(b.scene.mesh, volt)
        ends = [uem.dirichlet(W.sub(1), tag, value=COLD) for tag in (b.bottom, b.top)]
        ends += [uem.dirichlet(W.sub(2), b.bottom), uem.dirichlet(W.sub(2), b.top, value=self.volt)]
        bcs = [*f.confined(), uem.dirichlet(f.space, b.top, b.gdim - 1, -press), *ends]
        thermal = uem.Conductance(h, field=1, joule=2, joule_share=share)
        heat = [thermal, uem.Conductance(s, field=2, of_field=of_field)]
        self.contact = uem.Contact(b.high, b.low, heat=heat, name="joint", **how)
        self.problem = uem.UnitedProblem(self.F, f.w, displacement=0, bcs=bcs, contacts=[self.contact])

    def sides(self, part):
        """Means of a field on the upper and on the lower surface of the joint (collective)."""
        T = self.problem.config.functions()[f"field_{part}"]
        return tuple(uem.integrate(T * uem.ds(tag)) / uem.integrate(1.0 * uem.ds(tag)) for tag in (self.b.high, self.b.low))
