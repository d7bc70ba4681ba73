"""Recipe of the conda package, container file, citation and pyproject.toml agree, and name all that the package imports."""

from __future__ import annotations

import ast
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
#: Modules that the package imports at its start: package of conda-forge, of Debian.
SOURCES = {
    "dolfinx": ("fenics-dolfinx", "python3-dolfinx-real"), "ufl": ("fenics-ufl", "python3-dolfinx-real"),
    "basix": ("fenics-basix", "python3-dolfinx-real"), "petsc4py": ("petsc4py", "python3-dolfinx-real"),
    "mpi4py": ("mpi4py", "python3-dolfinx-real"), "numpy": ("numpy", "python3-dolfinx-real"), "scipy": ("scipy", "python3-scipy"),
}  # fmt: skip
#: Modules that some functions import, without which the scripts of the pages and the demos do not run.
IN_SCRIPTS = {"gmsh": ("python-gmsh", "python3-gmsh")}
#: What the container has for running scripts, by its reason.
TOOLS = {"python3-venv", "openmpi-bin", "gcc", "libc6-dev", "libopenblas0-pthread", "python3-matplotlib", "python3-tqdm"}


def imported():
    """Modules from elsewhere that are imported at the start of the package's modules."""
    found = set()
    for path in (REPO / "uem_dolfinx").rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {"uem_dolfinx"}


@pytest.fixture(scope="module")
def recipe():
    """The conda recipe with its variables inserted."""
    yaml = pytest.importorskip("yaml")
    text = (REPO / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    context = yaml.safe_load(text)["context"]
    return yaml.safe_load(re.sub(r"\$\{\{ (\w+) \}\}", lambda found: context[found[1]], text))


@pytest.fixture(scope="module")
def stages():
    """Instructions of each stage of the container file, as pairs of a word and the rest."""
    text = (REPO / ".ci" / "container" / "Containerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", text, flags=re.M)).splitlines()
    pairs = [(word, rest) for word, _, rest in (line.partition(" ") for line in lines if line)]
    assert {word for word, _ in pairs} <= {"FROM", "RUN", "COPY", "ENV", "USER", "WORKDIR", "CMD"}
    starts = [k for k, (word, _) in enumerate(pairs) if word == "FROM"]
    return [pairs[a:b] for a, b in zip(starts, [*starts[1:], len(pairs)])]


def names(requirements):
    """Names of packages without their versions."""
    return {re.split(r"[ <>=!~\[;]", entry)[0] for entry in requirements}


def test_imports_are_known():
    assert imported() == set(SOURCES)


def test_requirements_by_pip():
    """What pip installs with the package is imported, and all else that is imported comes with DOLFINx."""
    assert names(PROJECT["dependencies"]) == {"numpy", "scipy"} < imported()


def test_recipe_is_of_this_project(recipe):
    assert (recipe["package"]["name"], recipe["package"]["version"]) == (PROJECT["name"], PROJECT["version"])
    assert recipe["about"]["summary"] == PROJECT["description"]
    assert recipe["about"]["license"] == PROJECT["license"]
    assert (REPO / recipe["about"]["license_file"]).read_text(encoding="utf-8").startswith("MIT License")
    assert (REPO / ".ci" / "conda" / recipe["source"]["path"] / "pyproject.toml").resolve() == REPO / "pyproject.toml"


def test_recipe_builds_as_pip_does(recipe):
    assert recipe["build"]["noarch"] == "python"
    host = recipe["requirements"]["host"]
    assert set(PYPROJECT["build-system"]["requires"]) <= {entry.replace(" ", "") for entry in host}
    least = PROJECT["requires-python"].removeprefix(">=")
    assert f"python {least}.*" in host and f"python >={least}" in recipe["requirements"]["run"]


def test_recipe_requires_what_is_imported(recipe):
    wanted = {conda for conda, _ in (SOURCES | IN_SCRIPTS).values()}
    assert names(recipe["requirements"]["run"]) == wanted | {"python", "petsc"}


def test_recipe_tests_what_exists(recipe):
    (files,) = (test["files"]["source"] for test in recipe["tests"] if "files" in test)
    (script,) = (line for test in recipe["tests"] for line in test.get("script", ()))
    assert all((REPO / name).exists() for name in files) and shlex.split(script)[1] in files


def test_container_has_what_is_imported(stages):
    """The packages of Debian are those that .ci/with installs, without the ones that only tests need."""
    (line,) = (rest for word, rest in stages[-1] if word == "RUN" and "apt-get" in rest)
    packages = set(re.search(r"install -y --no-install-recommends ([\w\s.+-]*?) *(&&|$)", line)[1].split())
    assert packages == {debian for _, debian in (SOURCES | IN_SCRIPTS).values()} | TOOLS
    text = (REPO / ".ci" / "with").read_text(encoding="utf-8")
    assert packages <= set(re.search(r"packages=\((.*?)\)", text, re.S)[1].split())


def test_container_installs_the_wheel(stages):
    build, last = stages
    assert {rest.split()[0] for word, rest in build + last if word == "FROM"} == {"debian:trixie-slim"}
    name = f"{PROJECT['name'].replace('-', '_')}-{PROJECT['version']}-py3-none-any.whl"
    assert any(f"pip install --no-cache-dir --no-index --no-deps /wheel/{name}" in rest for word, rest in last if word == "RUN")
    copied = [part for word, rest in build if word == "COPY" for part in rest.split()[:-1]]
    (packed,) = PYPROJECT["build-system"]["backend-path"]
    assert {"pyproject.toml", "README.md", "LICENSE", "meshes", "uem_dolfinx", packed} == set(copied)


def test_container_starts_among_the_demos(stages):
    settings = dict(stages[-1])
    where = settings["WORKDIR"]
    targets = {rest.split()[-1]: rest.split()[-2] for word, rest in stages[-1] if word == "COPY"}
    assert targets[where] == "demos" and targets[str(Path(where).parent / "meshes")] == "meshes"
    assert settings["USER"] != "root" and settings["CMD"] == '["bash"]'
    assert all((REPO / name).exists() for name in ("demos", "meshes"))


def test_citation():
    """CITATION.cff has the version, licence, authors and subjects of pyproject.toml."""
    yaml = pytest.importorskip("yaml")
    cited = yaml.safe_load((REPO / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["version"], cited["license"]) == (PROJECT["version"], PROJECT["license"])
    assert [author["name"] for author in cited["authors"]] == [author["name"] for author in PROJECT["authors"]]
    assert cited["keywords"] == PROJECT["keywords"]


def test_classifiers():
    """They leave the licence to its own entry, and name every Python that DOLFINx is tested with from the oldest that is allowed."""
    found = PROJECT["classifiers"]
    assert len(found) == len(set(found)) and not any(one.startswith("License") for one in found)
    versions = [name.rpartition(" ")[2] for name in found if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", name)]
    assert versions == sorted(versions, key=lambda v: int(v.split(".")[1])) and f">={versions[0]}" == PROJECT["requires-python"]
