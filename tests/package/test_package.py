"""What is shipped: wheel and sdist hold every module, and run a demo in an empty environment away from the repository."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers import outside_mpi, serial

REPO = Path(__file__).resolve().parents[2]
MODULES = sorted(p.relative_to(REPO).with_suffix("").parts for p in (REPO / "uem_dolfinx").rglob("*.py"))
NAMES = [".".join(parts).removesuffix(".__init__") for parts in MODULES]

#: Runs a demo, imports every module, and prints what was not loaded from the folder given.
RUN = """
import importlib, runpy, sys
from pathlib import Path
demo, folder, *names = sys.argv[1:]
sys.argv[1:] = ["--n", "2", "--json", "figures.json"]
runpy.run_path(demo, run_name="__main__")
for name in names:
    if not Path(importlib.import_module(name).__file__).is_relative_to(folder):
        print(name, "came from", importlib.import_module(name).__file__)
"""


def test_version_to_cite():
    version = re.search(r'^version = "(.*)"', (REPO / "pyproject.toml").read_text(encoding="utf-8"), re.M)[1]
    assert f"version = {{{version}}}" in (REPO / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Folder with the wheel and the sdist of what git would ship of the repository."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPO / name, source)
    for name in ("uem_dolfinx", "tests", "demos", "meshes"):
        shutil.copytree(REPO / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "results"))
    ask = "import sys; from setuptools import build_meta as b; to = sys.argv[1]; b.build_sdist(to); b.build_wheel(to)"
    done = subprocess.run([sys.executable, "-c", ask, built], cwd=source, env=outside_mpi(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return built


@serial
@pytest.mark.slow
def test_archives(built):
    """The licence by its name, links that hold away from the repository, and no part of the tests without the rest."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    (name,) = (n for n in zipfile.ZipFile(wheel).namelist() if n.endswith("/METADATA"))
    metadata = zipfile.ZipFile(wheel).read(name).decode()
    assert re.search(r"^License(-Expression)?: MIT$", metadata, re.M) and "\nLicense-File: LICENSE\n" in metadata
    assert "PᵀKP" in metadata and not re.search(r"\]\((?!https?:)", metadata)
    with tarfile.open(sdist) as archive:
        names = [Path(*Path(n).parts[1:]) for n in archive.getnames()]
    assert Path("README.md") in names and Path("uem_dolfinx/meshes/flange.geo") in names
    # newer setuptools pack tests/test*.py by themselves, without what these import
    assert not [n for n in names if n.parts[:1] == ("tests",)] and not list(REPO.glob("tests/test*.py"))


@serial
@pytest.mark.slow
@pytest.mark.skipif(find_spec("dolfinx").origin.startswith(sys.prefix), reason="DOLFINx is not the system's")
@pytest.mark.parametrize("kind", ["whl", "tar.gz"])
def test_installed_elsewhere(kind, built, tmp_path):
    (archive,) = built.glob(f"*.{kind}")
    how = dict(cwd=tmp_path, capture_output=True, text=True)
    environment = {k: v for k, v in outside_mpi().items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([sys._base_executable, "-m", "venv", "--without-pip", "--system-site-packages", "empty"], check=True, **how)
    (site,) = (tmp_path / "empty").glob("lib/python*/site-packages")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "install", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([*pip, "--target", site, archive], env=environment, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (site / "uem_dolfinx" / "py.typed").exists() and not (site / "tests").exists()
    (tmp_path / "demos").mkdir()
    for name in ("common.py", "stack.py"):
        shutil.copy(REPO / "demos" / name, tmp_path / "demos")
    shutil.copytree(REPO / "meshes", tmp_path / "meshes")
    (script,) = re.findall(r"```python\n(from mpi4py.*?)```", (REPO / "README.md").read_text(encoding="utf-8"), re.S)
    (tmp_path / "script.py").write_text(script.replace('"h": 0.01', '"h": 0.04'), encoding="utf-8")
    (tmp_path / "away").mkdir()
    alone = subprocess.run(
        [tmp_path / "empty" / "bin" / "python", "../script.py"], env=environment, **(how | {"cwd": tmp_path / "away"})
    )
    assert alone.returncode == 0 and "largest pressure" in alone.stdout, alone.stdout + alone.stderr
    run = [tmp_path / "empty" / "bin" / "python", "-c", RUN, "demos/stack.py", site, *NAMES]
    done = subprocess.run(run, env=environment | {"PYTHONPATH": "demos"}, **how)
    assert done.returncode == 0 and "came from" not in done.stdout, done.stdout + done.stderr
    assert json.loads((tmp_path / "figures.json").read_text(encoding="utf-8"))
    assert "uem_dolfinx.geometry.tags" in NAMES and len(NAMES) == len(set(NAMES)) > 40
