"""When a residual is an equilibrium, on numbers alone."""

from types import SimpleNamespace

import pytest

from uem_dolfinx.solve.united.equilibrium import LARGEST_ROUNDING, STALLED, Equilibrium

RTOL = 1e-8


def bodies(real=1.0, strain=0.0):
    return SimpleNamespace(above_rounding=lambda in_contact: real, strain_rounding=lambda: strain)


def state(norm, scale=1.0, rounding=0.0, **changes):
    return SimpleNamespace(
        **{
            "norm": norm,
            "scale": scale,
            "rounding": rounding,
            "right": True,
            "changed": False,
            "closed": True,
            "in_contact": True,
            **changes,
        }
    )


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_small_relative_to_forces(size):
    """Whatever the units of forces."""
    equilibrium = Equilibrium(bodies(size), RTOL, 0.0)
    assert not equilibrium.judge(state(size, size)).ends
    assert not equilibrium.judge(state(2.0 * RTOL * size, size)).converged
    assert equilibrium.judge(state(0.5 * RTOL * size, size)).converged


@pytest.mark.parametrize("change", [{"right": False}, {"changed": True}, {"closed": False}])
def test_no_equilibrium_while_contact_changes(change):
    equilibrium = Equilibrium(bodies(), RTOL, 0.0)
    equilibrium.judge(state(1.0))
    assert not equilibrium.judge(state(0.0, **change)).ends


def test_rounding_is_excused_only_far_below_real_forces():
    for part, converged in (0.5, True), (2.0, False):
        equilibrium = Equilibrium(bodies(), RTOL, 0.0)
        equilibrium.judge(state(1.0, rounding=1.0))
        assert equilibrium.judge(state(part * LARGEST_ROUNDING, rounding=1e-3)).converged == converged


def test_a_residual_that_stalls_below_its_rounding_is_hidden():
    """Two iterations that leave more than a half of it, not one."""
    equilibrium, norm = Equilibrium(bodies(), RTOL, 0.0), 1e-2
    equilibrium.judge(state(1.0, rounding=1.0))
    ends = [equilibrium.judge(state(norm * f, rounding=0.1)) for f in (1.0, 0.9, 0.8)]
    assert [v.hidden for v in ends] == [False, False, True]
    assert 0.4 < STALLED < 0.6


def test_a_field_without_support_flies():
    """Its rounding grows beyond all forces, while its residual stays."""
    equilibrium = Equilibrium(bodies(strain=1e-30), RTOL, 0.0)
    equilibrium.judge(state(1.0, rounding=1e-12))
    verdicts = [equilibrium.judge(state(1.0, rounding=r, right=False)) for r in (1.0, 1e3, 1e6)]
    assert [bool(v.flown.any()) for v in verdicts] == [False, True, True]
    assert not any(v.converged or v.hidden for v in verdicts)
