"""Every threshold moved by a factor of ten, up and down, and the test that its comment names run: one of them has to fail.

.ci/with python tests/move_thresholds.py [--half] [NAME...]        all of them, or those named

With ``--half`` those that are derived or a convention are moved in one direction each, some up and the others down.
Thresholds that are derived or a convention are noticed in both directions, heuristics in one at least. Bounds end what ends anyway, where
they do not matter, and formats are no thresholds: they are not moved. Every run is a fork of one process that has imported all but this
package; the module is read with its value changed, so that whatever is made of it changes as well.
"""

from __future__ import annotations

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import os
import signal
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType

import dolfinx.fem.petsc  # noqa: F401
import dolfinx.io  # noqa: F401
import hypothesis.extra.numpy  # noqa: F401
import pytest
import scipy.optimize
import scipy.sparse.linalg
import scipy.spatial  # noqa: F401
import thresholds
from thresholds import Threshold

TESTS = thresholds.REPOSITORY / "tests"
#: Seconds that a run may take; a test that continues for ever has noticed nothing.
LONGEST = 240
#: Thresholds that no test notices yet: a list that may only become shorter.
UNNOTICED = {"FAR", "KEPT"}


@dataclass(frozen=True)
class Run:
    """Tests, and what is moved meanwhile: nothing where ``moved`` is None."""

    tests: tuple[str, ...]
    moved: Threshold | None = None
    up: bool = False


def changed(value: ast.expr, up: bool) -> ast.expr:
    """A number ten times as large, or as small; what counts goes from some to one, and from one to none."""
    if isinstance(value, ast.Dict):
        return ast.Dict(value.keys, [changed(v, up) for v in value.values])
    text = ast.unparse(value)
    return (
        ast.parse(f"(lambda v: 10 * v if {up} else v / 10 if isinstance(v, float) else max(v // 10, int(v > 1)))({text})")
        .body[0]
        .value
    )


class Moved(importlib.machinery.SourceFileLoader):
    """Reads a module with one of its constants moved."""

    def __init__(self, name: str, path: str, moved: Threshold, up: bool):
        super().__init__(name, path)
        self.moved, self.up = moved, up

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(self.get_data(self.path))
        for node in tree.body:
            if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    names = [getattr(t, "id", "") for t in target.elts]
                    if self.moved.name in names:
                        k = names.index(self.moved.name)
                        node.value.elts[k] = changed(node.value.elts[k], self.up)
                elif getattr(target, "id", "") == self.moved.name:
                    node.value = changed(node.value, self.up)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


class Finder(importlib.abc.MetaPathFinder):
    """Finds the module of the threshold that is moved."""

    def __init__(self, moved: Threshold, up: bool):
        self.moved, self.up = moved, up
        self.name = "uem_dolfinx." + moved.module.removesuffix(".py").replace("/", ".")

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self.name:
            return None
        file = str(thresholds.PACKAGE / self.moved.module)
        return importlib.util.spec_from_file_location(name, file, loader=Moved(name, file, self.moved, self.up))


def start(run: Run, log: Path) -> int:
    """The process that runs some tests; its status is pytest's."""
    if process := os.fork():
        return process
    status = 99
    try:
        os.setsid()
        signal.alarm(LONGEST)
        out = os.open(log, os.O_WRONLY | os.O_CREAT)
        os.dup2(out, 1)
        os.dup2(out, 2)
        if run.moved is not None:
            sys.meta_path.insert(0, Finder(run.moved, run.up))
        first = [] if run.moved is None else ["-x"]
        status = int(pytest.main(["-n0", "-m", "", "-p", "no:cacheprovider", "--tb=line", *first, *run.tests]))
    finally:
        sys.stdout.flush()
        os._exit(status)


def results(runs: Iterable[Run]) -> Iterator[tuple[Run, int, str, float]]:
    """Runs as they end, side by side on all cores: pytest's status, negative where a signal has ended it, what it said, and seconds."""
    todo, running = list(reversed(list(runs))), {}
    with tempfile.TemporaryDirectory() as folder:
        while todo or running:
            while todo and len(running) < len(os.sched_getaffinity(0)):
                run, log = todo.pop(), Path(folder, str(len(todo)))
                running[start(run, log)] = (run, log, time.monotonic())
            process, status = os.wait()
            run, log, since = running.pop(process)
            yield (
                run,
                os.waitstatus_to_exitcode(status),
                log.read_text(encoding="utf-8", errors="replace"),
                time.monotonic() - since,
            )


def where(test: str) -> str:
    """A test's name with its folder."""
    file, _, name = test.partition("::")
    return f"{next(TESTS.rglob(Path(file).name))}::{name}"


def directions(threshold: Threshold, half: bool) -> tuple[bool, ...]:
    """In which directions it is moved: True for up."""
    if not half or threshold.kind == "heuristic" or threshold.name in UNNOTICED:
        return True, False
    return (bool(zlib.crc32(threshold.name.encode()) % 2),)


def main(names: Sequence[str], half: bool = False) -> int:
    """Move, run, tell; the number of complaints."""
    rows = [t for t in thresholds.thresholds() if not names or t.name in names]
    moved = [t for t in rows if t.kind not in ("bound", "format")]
    tested = [t for t in moved if t.test != "-"]
    complaints = [f"{t.name}: a {t.kind} without a test" for t in moved if t.test == "-" and t.name not in UNNOTICED]
    complaints += [f"{name}: there is no such threshold any more" for name in UNNOTICED - {t.name for t in moved} if not names]
    since, seconds = time.monotonic(), Counter[str]()

    # nothing is noticed by a test that fails anyway
    files: dict[str, list[str]] = {}
    for test in dict.fromkeys(where(t.test) for t in tested):
        files.setdefault(test.partition("::")[0], []).append(test)
    for run, status, said, _ in results(Run(tuple(tests)) for tests in files.values()):
        if status:
            complaints.append(f"with nothing moved: status {status} of {Path(run.tests[0]).name}\n{said}")
    print(f"{len(files)} files pass with nothing moved, {time.monotonic() - since:.0f} s", flush=True)

    noticed: dict[str, dict[bool, bool]] = {t.name: {} for t in tested}
    for run, status, said, took in results(Run((where(t.test),), t, up) for t in tested for up in directions(t, half)):
        assert run.moved is not None
        name = run.moved.name
        if status not in (0, 1):
            complaints.append(f"{name} {'x' if run.up else '/'} 10: status {status} of {run.moved.test}\n{said}")
        noticed[name][run.up] = status == 1
        seconds[run.moved.test] += took
    for t in tested:
        unseen = [f"{'x' if up else '/'} 10" for up, seen in noticed[t.name].items() if not seen]
        enough = len(unseen) < 2 if t.kind == "heuristic" else not unseen
        if t.name in UNNOTICED:
            complaints += [f"{t.name} is noticed"] if enough else []
        elif not enough:
            complaints.append(f"{t.name} = {t.value} ({t.kind}, {t.module}): {t.test} does not notice {' nor '.join(unseen)}")

    print(f"{sum(map(len, noticed.values()))} moves, {time.monotonic() - since:.0f} s; the longest tests, of all moves together:")
    print(*(f"    {took:4.0f} s  {test}" for test, took in seconds.most_common(8)), sep="\n")
    for kind in thresholds.KINDS:
        of = [t for t in rows if t.kind == kind]
        print(
            f"{len(of):4d} {kind:10s}, {sum(t in tested for t in of)} moved, {sum(t.name in UNNOTICED for t in of)} not noticed yet"
        )
    print(*complaints, f"{len(complaints)} complaints", sep="\n")
    return len(complaints)


if __name__ == "__main__":
    sys.exit(min(main([name for name in sys.argv[1:] if name != "--half"], "--half" in sys.argv), 1))
