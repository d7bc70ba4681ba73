"""Scripts of the how-to pages run as they stand there, and give the answers that the pages name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

SITE = Path(__file__).resolve().parents[2] / "demos" / "site" / "howto"


def script(page, which):
    """A script of a page, counted from 0 among those that begin with imports."""
    found = re.findall(r"```python\n(from mpi4py.*?)```", (SITE / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    return compile(found[which], f"{page}.md", "exec")


def run(page, which=0):
    """Names that a script has in the end."""
    known = {}
    exec(script(page, which), known)
    return known


def test_transient_temperature(folder, monkeypatch):
    """Once the start has faded, a plate that is heated steadily has the flux of the closed form, but for the length of a step."""
    monkeypatch.chdir(folder)
    known = run("scalar_fields")
    k, c, rate, end, n = (known[name] for name in ("k", "c", "rate", "end", "n"))
    wanted = k * rate * (end - c / (6 * k))
    assert known["fluxes"][-1] == pytest.approx(wanted, rel=0.03)
    # the slope is exact but for what has not faded
    assert (known["fluxes"][-1] - known["fluxes"][-2]) * n / end == pytest.approx(k * rate, rel=1e-6)


def test_phase_field():
    known = run("staggered", 1)
    E, Gc, size = (known[name] for name in ("E", "Gc", "size"))
    for eps, force in known["forces"]:
        d = E * size * eps**2 / (Gc + E * size * eps**2)
        assert force == pytest.approx((1 - d) ** 2 * E * eps, rel=1e-7)
    assert np.argmax([force for _, force in known["forces"]]) == 5
