"""What is shipped: a wheel holds every module, and works away from the repository."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import outside_mpi, serial

REPO = Path(__file__).resolve().parent.parent
MODULES = sorted(p.relative_to(REPO).with_suffix("").parts for p in (REPO / "uem_dolfinx").rglob("*.py"))
NAMES = [".".join(parts).removesuffix(".__init__") for parts in MODULES]

#: Imports every module from the folder given, and prints what was loaded from elsewhere.
IMPORT = """
import importlib, sys
from pathlib import Path
folder, *names = sys.argv[1:]
sys.path[:0] = [folder]
for name in names:
    if not Path(importlib.import_module(name).__file__).is_relative_to(folder):
        print(name, "came from", importlib.import_module(name).__file__)
"""


@serial
@pytest.mark.slow
def test_wheel_elsewhere(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPO / name, source)
    shutil.copytree(REPO / "uem_dolfinx", source / "uem_dolfinx", ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    how = dict(cwd=tmp_path, env=outside_mpi(), capture_output=True, text=True)
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", ".", str(source)]
    done = subprocess.run(build, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    done = subprocess.run([*pip, "install", "--no-deps", "--target", "elsewhere", wheel.name], **how)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "elsewhere" / "uem_dolfinx" / "py.typed").exists()
    done = subprocess.run([sys.executable, "-c", IMPORT, str(tmp_path / "elsewhere"), *NAMES], **how)
    assert done.returncode == 0 and done.stdout == "", done.stdout + done.stderr
    assert "uem_dolfinx.geometry.tags" in NAMES and len(NAMES) == len(set(NAMES)) > 40
