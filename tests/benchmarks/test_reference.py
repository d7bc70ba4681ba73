"""The set of reference problems: every scene has its script, its source, and a figure where it is said to be."""

from __future__ import annotations

import json
from pathlib import Path

from mpi4py import MPI

import pytest
from benchmarks.reference import compare

DEMOS = Path(compare.HERE).parent.parent


def test_every_scene_is_said_on_the_page():
    page = (compare.HERE / "README.md").read_text(encoding="utf-8")
    assert len(compare.SCENES) == 12
    for scene in compare.SCENES:
        source = (DEMOS / f"{scene['demo']}.py").read_text(encoding="utf-8")
        assert f"[{scene['name']}](../../{scene['demo']}.py)" in page and scene["source"]
        for quantity in scene["quantities"]:
            assert f"| {scene['name']} | {quantity['what']} |" in page
            key = next(k for k in reversed(quantity["path"]) if isinstance(k, str))
            assert f'"{key}"' in source


def test_figures_are_found_where_they_are():
    assert compare.at({"a": [{"b": 1}, {"b": 2.5}]}, ["a", 1, "b"]) == 2.5
    assert compare.at({"a": {"x": 1e-3, "y": 2e-3}}, ["a"]) == 2e-3
    with pytest.raises(SystemExit, match="no scene Herz: known are patch test"):
        compare.main(["Herz"])


@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="it starts a process of its own")
def test_a_scene_against_its_reference(monkeypatch, capsys):
    scene = json.loads(json.dumps(next(s for s in compare.SCENES if s["name"] == "press fit")))
    scene["options"] = "--h 0.1 --refinements 1"
    monkeypatch.setattr(compare, "SCENES", [scene])
    compare.main([])
    *_, reference, found, _ = (word.strip() for word in capsys.readouterr().out.split("|"))
    assert float(found) == pytest.approx(float(reference), rel=2e-3)
