"""Gradients through motions with impact: against differences and closed forms, on any ranks, and where they are refused.

Read first: ``test_of_second_order``, Taylor's test of a block that is thrown at a plane and comes off it.
"""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import dot, wave
from helpers import refused, slow
from history_scenes import COMM, alone, slope_alone, taylor, thrown

import uem_dolfinx as uem
from uem_dolfinx.gradients.records import Records

SCENES = [
    {"scheme": uem.generalised_alpha(0.7)},
    slow({"law": uem.NeoHooke, "friction": 0.2, "damped": False}),
    slow({"law": uem.NeoHooke, "scheme": uem.generalised_alpha(0.7), "shaken": True, "end": 0.3}),
]


def changes(s, damped=True, shaken=False, **_):
    """All controls of a scene, each with a change."""
    two = np.ones(2)
    some = [(s.E, s.E, 90.0), (s.rho, s.rho, 0.1), (s.force, s.force, two), (s.push, s.grows, two)]
    some += [(s.velocity, s.velocity, wave(s.V, 0.2))]
    some += [(s.viscosity, s.viscosity, 1e-3)] if damped else []
    return some + ([(s.hand, s.way, wave(s.V, 0.1))] if shaken else [])


@pytest.mark.long
@pytest.mark.parametrize("how", SCENES)
def test_of_second_order(how):
    """``J(h) - J(0) - h J'`` vanishes with h^2 where the same contactors touch in the same steps, and two ranks tell the same slope."""
    s = thrown(**how)
    order, slope = taylor(s, changes(s, **how))
    assert order >= 1.95, order
    if COMM.size > 1:
        one = thrown(comm=alone(), **how)
        assert slope_alone(one, changes(one, **how)) == pytest.approx(slope, rel=1e-10)


def test_free_flight():
    """Without contact every node flies as a point does, ``u = v t + (f / rho + g) t^2 / 2``, and so do its derivatives."""
    s = thrown(wall=False, end=0.1, damped=False)
    s.velocity.x.array.reshape(-1, 2)[:] = [0.1, -1.0]
    found, t = s.solve(), 0.1
    by_v, by_rho, by_f, by_push = found.history.gradient(s.u[1] * ufl.dx, [s.velocity, s.rho, s.force, s.push])
    up = fem.Function(s.V)
    up.x.array.reshape(-1, 2)[:, 1] = 1.0
    assert dot(by_v, up) == pytest.approx(t, rel=1e-10)
    # the push has grown with time, and the trapezoidal rule integrates a cubic in steps of 0.02
    grown = sum(0.02**2 * (0.25 * (k * 0.02 + (k + 1) * 0.02) + 0.5 * (4 - k) * (2 * k + 1) * 0.02) for k in range(5))
    assert by_f[1] == pytest.approx(t**2 / 2, rel=1e-10) and abs(by_f[0]) <= 1e-12
    assert by_push[1] == pytest.approx(grown, rel=1e-10)
    assert float(by_rho) == pytest.approx(5.0 * t**2 / 2 - 0.5 * grown, rel=1e-10)


def test_steps_in_a_file(tmp_path):
    """Steps that are kept in files are those in memory, and take no memory; the files are gone by themselves."""
    s = thrown(end=0.04, damped=False)
    one, other = s.solve(), s.solve(scratch=tmp_path)
    (by_E, by_v), (again_E, again_v) = (found.history.gradient(found.J, [s.E, s.velocity]) for found in (one, other))
    assert float(again_E) == pytest.approx(float(by_E), rel=1e-10)
    assert again_v.x.array == pytest.approx(by_v.x.array, rel=1e-8, abs=1e-12 * np.abs(by_v.x.array).max())
    assert not list(tmp_path.iterdir())
    record, records = one.history._records[0], Records(tmp_path)
    tracemalloc.start()
    for _ in range(20):
        records.add(replace(record, displacement=np.ones(10_000), values=[np.ones(10_000), np.array(len(records))]))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held <= 3 * 80_000 and [int(own.values[1]) for own in records] == list(range(20))
    records.cut(5)
    assert len(records) == 5 and int(records[-1].values[1]) == 4
    refused(uem.InputError, "expected a folder on every rank", lambda: s.solve(scratch=tmp_path / "no"))
    refused(uem.InputTypeError, "scratch = 3: expected a folder", lambda: s.solve(scratch=3))


def test_what_is_refused():
    """What masses depend on otherwise than as a density, fields that follow otherwise, and motions that have begun."""
    s = thrown(wall=False, end=0.02, damped=False)
    problem = s.solve().problem
    refused(uem.InputError, "expected a problem that is recorded from its first step on", uem.recording(problem).__enter__)
    refused(uem.InputError, "take the steps within uem.recording(problem)", lambda: uem.gradient(problem, s.u[0] * ufl.dx, []))
    history = s.solve().history
    ask, w, mesh = history.gradient, history.problem.dynamics.mean_velocity, s.V.mesh
    refused(uem.InputError, "the shape, on which masses depend", lambda: ask(s.u[0] * ufl.dx, ufl.SpatialCoordinate(mesh)))
    refused(uem.InputError, "holds 'mean_velocity'", lambda: ask(w[0] * ufl.dx, []))
    field = fem.Function(uem.function_space(mesh, ("DG", 0)))
    field.x.array[:] = 1.0
    with uem.recording(uem.UnitedProblem(s.F, s.u, dynamics=uem.Dynamics(uem.lumped_mass(s.V, field)))) as history:
        list(uem.time_steps(history.problem, 0.02, 0.02))
    refused(uem.InputError, "is a part of the density", lambda: history.gradient(s.u[0] * ufl.dx, field))
