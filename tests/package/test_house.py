"""What the code as a whole keeps to: imports that point one way, short files, versions in one place, documented and tested thresholds.

The test to read first is ``test_thresholds_are_explained``.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import common
import pytest
import thresholds

REPOSITORY = thresholds.REPOSITORY
#: Rooms from the ground up; files import only from their own room and from those before it.
ROOMS = [
    ("arrays", "errors", "compiled", "compat", "log", "parallel", "given", "files", "forms", "form_checks"), ("geometry",), ("algebra",),
    ("conditions",), ("contact",), ("materials", "dynamics"), ("restart",), ("solve",), ("gradients",), ("accuracy",), ("output",),
    ("scripting",),
    ("decks",),
]  # fmt: skip
#: Folders within contact/ from the ground up, and files of its own among them; ``""`` is all its other files.
FLOORS = {
    "uem_dolfinx.contact": [
        "laws", "seam", "nodes", "mortar", "edges", "friction", "ties", "thermal", "pair", "offsets", "heat_results", "results",
        "both_sides", "warnings", "", "further", "joining", "general",
    ],
    "uem_dolfinx.solve": ["bodies", "rigid", "slots", "united", "", "steps"],
}  # fmt: skip
LONGEST = 450
#: Names of modules whose versions differ.
THIRD = {"dolfinx", "fem", "mesh", "io", "gmshio", "geometry", "ufl", "basix", "np", "numpy", "PETSc", "gmsh", "la", "cpp"}


def modules(top):
    """Files of a folder by the name they are imported with."""
    names = {".".join(p.relative_to(top.parent).with_suffix("").parts).removesuffix(".__init__"): p for p in top.rglob("*.py")}
    return names


def imports(files):
    """Which of these modules each imports, also within functions and under TYPE_CHECKING."""
    edges = {}
    for name, path in files.items():
        edges[name] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{path}: relative import"
                found = [f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in files else node.module for a in node.names]
            edges[name] |= {f for f in found if f in files and f != name}
    return edges


def reached(start, edges):
    """Nodes that edges lead to from this one."""
    seen, todo = set(), [start]
    while todo:
        new = edges.get(todo.pop(), set()) - seen
        seen |= new
        todo += new
    return seen


def circles(edges):
    """Sets of nodes that reach each other."""
    far = {node: reached(node, edges) for node in edges}
    return sorted({tuple(sorted(m for m in far[n] if n in far.get(m, ()))) for n in edges if n in far[n]})


def python_files(*tops):
    return [p for top in tops for p in sorted((REPOSITORY / top).rglob("*.py"))]


@cache
def package():
    """Imports among the modules of the package; its front door collects them all."""
    edges = imports(modules(thresholds.PACKAGE))
    del edges["uem_dolfinx"]
    return {name: {to for to in found if to != "uem_dolfinx"} for name, found in edges.items()}


def room(module):
    """Folder of a module, or the module itself where it is in none."""
    return module.split(".")[1]


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [("a", "b", "c")]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_no_circle_of_imports_between_files():
    assert circles(package()) == []
    assert circles(imports(modules(REPOSITORY / "demos" / "benchmarks"))) == []


def test_no_circle_of_imports_between_rooms():
    rooms = {}
    for name, found in package().items():
        rooms.setdefault(room(name), set()).update(room(to) for to in found if room(to) != room(name))
    assert circles(rooms) == []


def test_imports_point_one_way():
    """A room knows only those before it."""
    floor = {name: k for k, names in enumerate(ROOMS) for name in names}
    edges = package()
    assert {room(name) for name in edges} == set(floor)
    assert [(a, b) for a, found in edges.items() for b in found if floor[room(b)] > floor[room(a)]] == []


#: What may not grow: a commit that needs more raises the number, and gives the reason and what it removed.
BUDGETS = {
    "members of the seam": 26, "members of Interface": 49, "heuristics": 12, "arrows within contact": 70, "arrows within solve": 35,
    "lines of the package": 60158,
}  # fmt: skip


def members(module, *names):
    """Methods, properties and declared attributes of classes, all their ``self.`` attributes among them."""
    found = set()
    for node in ast.parse((thresholds.PACKAGE / module).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name in names:
            found |= {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
            found |= {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
            stored = (n for n in ast.walk(node) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store))
            found |= {n.attr for n in stored if isinstance(n.value, ast.Name) and n.value.id == "self"}
    return found - {name for name in found if name.startswith("__")}


def arrows(top):
    """Pairs of folders, or of files, within a room of which one imports from the other."""
    first = {name: name.removeprefix(f"{top}.").split(".")[0] for name in package() if name.startswith(f"{top}.")}
    return {
        (first[a], first[b]) for a, found in package().items() if a in first for b in found & first.keys() if first[a] != first[b]
    }


def counts():
    """What the budgets count."""
    return {
        "members of the seam": sum(len(members("contact/seam/placement.py", name)) for name in ("Kinematics", "Discretisation")),
        "members of Interface": len(members("contact/pair/interface.py", "Interface")),
        "heuristics": sum(row.kind == "heuristic" for row in thresholds.thresholds()),
        "arrows within contact": len(arrows("uem_dolfinx.contact")),
        "arrows within solve": len(arrows("uem_dolfinx.solve")),
        "lines of the package": sum(p.read_text(encoding="utf-8").count("\n") for p in python_files("uem_dolfinx")),
    }


def test_budgets():
    """Members of the seam and of an interface, heuristics, imports between folders and lines: none grows, and what shrinks lowers them."""
    found = counts()
    assert found.keys() == BUDGETS.keys()
    assert {name: n for name, n in found.items() if n > BUDGETS[name]} == {}
    assert {name: n for name, n in found.items() if n < 0.95 * BUDGETS[name]} == {}, "lower the budget"


@pytest.mark.parametrize("top", FLOORS)
def test_imports_within_a_room_point_one_way(top):
    """A folder knows only those before it."""

    def floor(name):
        first = name.removeprefix(f"{top}.").split(".")[0]
        return FLOORS[top].index(first if first in FLOORS[top] else "")

    edges = {a: {b for b in found if b.startswith(f"{top}.")} for a, found in package().items() if a.startswith(f"{top}.")}
    assert len(edges) > 20
    assert [(a, b) for a, found in edges.items() for b in found if floor(b) > floor(a)] == []


def test_nothing_imports_gradients():
    """They read everything; what only gives them their types is no import."""
    wing = {a: {b for b in found if room(b) == "gradients"} for a, found in package().items() if room(a) != "gradients"}
    assert {a: found for a, found in wing.items() if found} == {}


def test_demos_stand_on_their_own():
    """They import nothing from the tests, and the package nothing from either; only studies import rival methods."""
    tests, demos = ({path.stem for path in python_files(top)} for top in ("tests", "demos"))
    for path in python_files("uem_dolfinx", "demos"):
        roots = set(re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(encoding="utf-8"), re.M))
        assert not roots & (tests if "demos" in path.parts else tests | demos | {"benchmarks"}), path
    scripts = {path.stem: path for path in (REPOSITORY / "demos").glob("*.py")}
    edges = imports(modules(REPOSITORY / "demos" / "benchmarks") | scripts)
    with_rivals = {name for name in scripts if any(to.startswith("benchmarks.rivals") for to in reached(name, edges))}
    assert with_rivals == {"cost", "peers", "stability", "work_precision"}


def test_options_of_demos_are_explained():
    """Each by the docstring of its demo or by a word shared by two demos at least; nothing is explained that is no option."""
    shared = Counter()
    for path in set((REPOSITORY / "demos").glob("*.py")) - {Path(common.__file__)}:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        assert not any(ast.unparse(call.func).endswith("add_argument") for call in calls), path
        (call,) = (call for call in calls if ast.unparse(call.func) == "common.arguments")
        assert [ast.unparse(argument) for argument in call.args] == ["__doc__"], path
        options = {keyword.arg for keyword in call.keywords}
        reported = common.explanations(ast.get_docstring(tree))
        own = {name for name, words in reported.items() if words != common.WORDS.get(name)}
        assert options <= reported.keys(), (
            f"{path}: {options - reported.keys()} are not explained under Options: in the docstring"
        )
        assert own <= options and all(reported.values()), f"{path}: {own - options} are no options"
        shared.update(options - own)
    assert {name for name in common.WORDS if shared[name] < 2} == set()


def test_help_shows_meaning_and_default(monkeypatch, capsys):
    options = {"n": 8, "h": 1 / 60, "plain": 3, "files": "", "kind": ("a", "b"), "quick": False}
    docstring = "A demo.\n\nOptions:\n    n: cells: 5 % of them\n    files: to read\n"
    monkeypatch.setattr("sys.argv", ["demo.py", "--help"])
    with pytest.raises(SystemExit):
        common.arguments(docstring, **options)
    text = " ".join(capsys.readouterr().out.split())
    for reported in (
        "--n N cells: 5 % of them (default: 8)",
        f"--h H {common.WORDS['h']} (default: 0.0166667)",
        "--plain PLAIN (default: 3)",
        "to read (default: none)",
        "--kind {a,b} (default: a)",
    ):
        assert reported in text, text
    monkeypatch.setattr("sys.argv", ["demo.py", "--h", "1/30", "--quick"])
    found = vars(common.arguments(docstring, **options))
    assert {name: found[name] for name in options} == options | {"h": 1 / 30, "kind": "a", "quick": True}


def test_tests_do_not_import_from_each_other():
    for path in python_files("tests"):
        assert not re.search(r"^\s*(from|import) test_", path.read_text(encoding="utf-8"), re.M), path


def test_names_of_test_files_are_unique():
    names = Counter(path.name for path in python_files("tests"))
    assert max(names.values()) == 1, names.most_common(3)


@pytest.mark.parametrize("top", ["uem_dolfinx", "demos", "tests"])
def test_files_are_short(top):
    lengths = {
        path.relative_to(REPOSITORY).as_posix(): path.read_text(encoding="utf-8").count("\n") for path in python_files(top)
    }
    assert {path: n for path, n in lengths.items() if n > LONGEST} == {}


def asks_for_a_version(node):
    """Whether a piece of code depends on the version of another package or of Python."""
    if isinstance(node, ast.Attribute):
        return node.attr in ("__version__", "version_info") or node.attr == "DOLFINX_VERSION"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("hasattr", "getattr"):
        return isinstance(node.args[0], ast.Name) and node.args[0].id in THIRD
    if isinstance(node, ast.ExceptHandler):
        return isinstance(node.type, ast.Name) and node.type.id == "AttributeError"
    return isinstance(node, ast.alias) and node.name == "DOLFINX_VERSION"


def test_versions_are_known_to_compat_alone():
    """Nowhere else in the package, the demos and the tests; ``demos/benchmarks/measure.py`` says what was measured where."""
    asking = set()
    for path in python_files("uem_dolfinx", "demos", "tests"):
        text = path.read_text(encoding="utf-8")
        # most files have none of these words, and need no tree
        if re.search("version|VERSION|hasattr|getattr|AttributeError", text) and any(
            map(asks_for_a_version, ast.walk(ast.parse(text)))
        ):
            asking.add(path.relative_to(REPOSITORY).as_posix())
    assert asking - {"demos/benchmarks/measure.py"} == {"uem_dolfinx/compat.py"}


def test_the_developer_guide_is_of_this_code():
    """Its map names every module, and every file that it names is there."""
    text = thresholds.README.read_text(encoding="utf-8").partition(thresholds.BEGIN)[0]
    named = set(re.findall(r"`([\w/.]+)`", text.partition("## The map of rooms")[2].partition("## Glossary")[0]))
    files = [path.relative_to(REPOSITORY).as_posix() for path in python_files("uem_dolfinx", "demos", "tests")]
    assert {path for path in files if path.startswith("uem_dolfinx") and Path(path).stem not in named | {"__init__"}} == set()
    reported = {name.removeprefix("../") for name in re.findall(r"`([\w/.]+\.py)`", text)}
    assert {name for name in reported if not any(f"/{path}".endswith(f"/{name}") for path in files)} == set()


# -- thresholds ------------------------------------------------------------------------------------------------------------

ALL = list(thresholds.thresholds())


def test_numbers_are_seen():
    """What counts as a number, and that the constants of the code are found."""
    for text in (
        "1e-9",
        "-3",
        "4.0 * np.finfo(float).eps",
        "1 / 1024",
        "{2: 300_000, 3: 30_000}",
        "2**30",
        "128 + signal.SIGTERM",
    ):
        assert thresholds.is_number(ast.parse(text, mode="eval").body), text
    for text in ("'a'", "True", "('a', 1)", "{'a': 1}", "np.array([1.0])", "TypeVar('T')", "{1: 2, 2: 3}"):
        assert not thresholds.is_number(ast.parse(text, mode="eval").body), text
    assert len(ALL) > 30


@pytest.mark.parametrize("threshold", ALL, ids=lambda t: f"{t.module}-{t.name}")
def test_thresholds_are_explained(threshold):
    """Each says what it does, of which kind it is and on which scale; what is derived or a convention has a test that brackets it."""
    where = f"{threshold.module}: {threshold.name}"
    assert threshold.kind in thresholds.KINDS, f"{where}: expected the comment to end in [KIND; SCALE; TEST]"
    assert threshold.what and threshold.scale, where
    if threshold.test == "-":
        assert threshold.kind not in thresholds.TESTED, f"{where}: expected a test that brackets it"
        return
    file, _, name = threshold.test.partition("::")
    found = [path for path in python_files("tests") if path.name == Path(file).name]
    assert found, f"{where}: no file {file} in tests"
    assert re.search(rf"^def {re.escape(name)}\(", found[0].read_text(encoding="utf-8"), re.M), (
        f"{where}: no test {threshold.test}"
    )


def test_names_of_thresholds_are_unique():
    names = Counter(t.name for t in ALL)
    assert [name for name, n in names.items() if n > 1] == []


def test_table_in_the_readme_is_that_of_the_code():
    """After a change of a threshold: ``python3 tests/thresholds.py``."""
    text = thresholds.README.read_text(encoding="utf-8")
    assert text == thresholds.with_table(text)
