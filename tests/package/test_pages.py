"""Scripts of the how-to pages run as they stand there, and give the answers that the pages name; lists of pages are whole."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import common
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


def read(name):
    return (SITE.parent / f"{name}.md").read_text(encoding="utf-8")


def test_each_feature_has_a_page():
    """Each entry of the features links to a page of its own, under a heading."""
    groups = re.split(r"^## .*$", read("features"), flags=re.MULTILINE)[1:]
    entries = [entry for group in groups for entry in re.split(r"^- ", group, flags=re.MULTILINE)[1:]]
    assert len(groups) > 5 and len(entries) > 30 and len(entries) == len(re.findall(r"^- ", read("features"), re.MULTILINE))
    assert [entry[:60] for entry in entries if not re.search(r"\]\(\w+/\w+\.md", entry)] == []


@pytest.mark.parametrize("name", ["explanation/limits", "howto/index"])
def test_long_lists_have_groups(name):
    groups = re.split(r"^## .*$", read(name), flags=re.MULTILINE)
    assert len(groups) > 5 and not re.search(r"^- ", groups[0], re.MULTILINE)
    assert max(len(re.findall(r"^- |^\w+$", group, re.MULTILINE)) for group in groups) <= 10


def test_index_of_how_to_has_each_page_once():
    listed = re.findall(r"^\w+$", read("howto/index"), re.MULTILINE)
    assert sorted(listed) == sorted(path.stem for path in SITE.glob("*.md") if path.stem != "index")


def test_report_lists_its_chapters():
    report = SITE.parents[1] / "benchmarks" / "report"
    listed = re.findall(r"^\| \[.*?\]\((\w+)\.md\)", (report / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(path.stem for path in report.glob("*.md") if path.stem != "README")


def test_demo_in_a_notebook(monkeypatch):
    """In a notebook a demo has its defaults; the command line there is the kernel's."""
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    monkeypatch.setattr(sys, "argv", ["ipykernel_launcher.py", "-f", "kernel.json"])
    assert common.arguments("A demo.", n=3).n == 3
