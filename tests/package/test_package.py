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
#: What the source distribution has in addition to the package and what pyproject.toml names.
PAPERS = ("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md")
#: Endings of files that git ignores.
PASSING = {".pyc", ".msh", ".xdmf", ".h5", ".bin"}
FOLDERS = (".ci", "demos", "meshes", "tests")
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
    for name in ("pyproject.toml", "README.md", "LICENSE", *PAPERS):
        shutil.copy(REPO / name, source)
    for name in ("uem_dolfinx", *FOLDERS):
        shutil.copytree(REPO / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "results"))
    ask = (
        "import sys; to = sys.argv[1]; sys.path.insert(0, '.ci/sdist'); import backend as b; b.build_sdist(to); b.build_wheel(to)"
    )
    done = subprocess.run([sys.executable, "-c", ask, built], cwd=source, env=outside_mpi(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return built


@serial
@pytest.mark.slow
def test_archives(built):
    """The licence by its name, links that hold away from the repository; all of it in the sdist, the package alone in the wheel."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    (name,) = (n for n in zipfile.ZipFile(wheel).namelist() if n.endswith("/METADATA"))
    metadata = zipfile.ZipFile(wheel).read(name).decode()
    assert re.search(r"^License(-Expression)?: MIT$", metadata, re.M) and "\nLicense-File: LICENSE\n" in metadata
    assert "PᵀKP" in metadata and not re.search(r"\]\((?!https?:)", metadata)
    with tarfile.open(sdist) as archive:
        packed = {Path(*Path(n).parts[1:]) for n in archive.getnames()}
    kept = {path.relative_to(REPO) for name in FOLDERS for path in (REPO / name).rglob("*") if path.is_file()}
    kept = {path for path in kept if not {"__pycache__", "results"} & set(path.parts) and path.suffix not in PASSING}
    assert kept | {Path(name) for name in ("README.md", "LICENSE", "uem_dolfinx/meshes/flange.geo", *PAPERS)} <= packed
    assert not [path for path in packed if "__pycache__" in path.parts or path.suffix in PASSING]
    installed = [Path(name) for name in zipfile.ZipFile(wheel).namelist() if ".dist-info" not in name]
    assert {path.parts[0] for path in installed} == {"uem_dolfinx"} and {path.suffix for path in installed} == {
        ".py",
        ".typed",
        ".geo",
    }


@serial
@pytest.mark.slow
@pytest.mark.skipif(find_spec("dolfinx").origin.startswith(sys.prefix), reason="DOLFINx is not the system's")
def test_tests_of_the_sdist(built, tmp_path):
    """Unpacked, and with the package installed from it, the sdist passes tests; it is built again to the same wheel."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path)
    (unpacked,) = (path for path in tmp_path.iterdir() if path.is_dir())
    site, environment = install(sdist, tmp_path)
    tests = [
        "tests/contact/test_patch.py",
        "tests/package/test_recipes.py",
        "tests/package/test_house.py",
        "-k",
        "not thresholds",
    ]
    run = [tmp_path / "empty" / "bin" / "python", "-P", "-m", "pytest", "-n", "0", "--most", "1", *tests]
    done = subprocess.run(run, cwd=unpacked, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and re.search(r"[1-9]\d* passed", done.stdout), done.stdout + done.stderr
    again = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "wheel", "--no-deps", "--no-build-isolation"]
    subprocess.run([*again, "--wheel-dir", tmp_path / "again", sdist], check=True, env=environment, capture_output=True)
    (other,) = (tmp_path / "again").glob("*.whl")
    assert sorted(zipfile.ZipFile(other).namelist()) == sorted(zipfile.ZipFile(wheel).namelist())


def install(archive, folder):
    """Install a wheel or sdist in an environment that has the system's DOLFINx only; its site-packages, and the variables to use it."""
    how = dict(cwd=folder, capture_output=True, text=True)
    environment = {k: v for k, v in outside_mpi().items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([sys._base_executable, "-m", "venv", "--without-pip", "--system-site-packages", "empty"], check=True, **how)
    (site,) = (folder / "empty").glob("lib/python*/site-packages")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "install", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([*pip, "--target", site, archive], env=environment, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    return site, environment


@serial
@pytest.mark.slow
@pytest.mark.skipif(find_spec("dolfinx").origin.startswith(sys.prefix), reason="DOLFINx is not the system's")
@pytest.mark.parametrize("kind", ["whl", "tar.gz"])
def test_installed_elsewhere(kind, built, tmp_path):
    (archive,) = built.glob(f"*.{kind}")
    how = dict(cwd=tmp_path, capture_output=True, text=True)
    site, environment = install(archive, tmp_path)
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
