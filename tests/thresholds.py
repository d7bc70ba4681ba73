"""The thresholds of the package, read from its code: every numeric module constant with its kind, its scale and its test.

python3 tests/thresholds.py        writes their table into uem_dolfinx/README.md
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "uem_dolfinx"
README = PACKAGE / "README.md"
BEGIN, END = "<!-- thresholds -->", "<!-- /thresholds -->"
KINDS = ("derived", "convention", "bound", "heuristic", "format")
#: Kinds that a test must bracket.
TESTED = ("derived", "convention")
BRACKET = re.compile(r"\[([^;\]]+); ([^;\]]+); ([^;\]]+)\]")


@dataclass(frozen=True)
class Threshold:
    """A numeric module constant.

    Attributes:
        module: its file, relative to the package.
        name: of the constant.
        value: as it is written.
        what: its comment, in one line.
        kind: one of ``KINDS``, empty if the comment has no bracket.
        scale: what it is measured in.
        test: ``file.py::test``, or ``-``.
    """

    module: str
    name: str
    value: str
    what: str
    kind: str
    scale: str
    test: str


def is_number(node: ast.expr) -> bool:
    """Whether an expression is a number, or a number for each dimension ``{2: ..., 3: ...}``."""
    if isinstance(node, ast.Dict):
        return [getattr(k, "value", None) for k in node.keys] == [2, 3] and all(map(is_number, node.values))
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) or is_number(node.right)
    # np.finfo(float).eps, np.pi
    return isinstance(node, ast.Attribute) and node.attr in ("eps", "tiny", "max", "pi", "inf")


def thresholds() -> Iterator[Threshold]:
    """All of them, in the order of modules and lines."""
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        lines = source.split("\n")
        for node in ast.parse(source).body:
            if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
                continue
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            pairs = [(t, node.value) for t in targets]
            if isinstance(targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(targets[0].elts, node.value.elts))
            first = node.lineno - 1
            while lines[first - 1].startswith("#:"):
                first -= 1
            comment = " ".join(line.removeprefix("#:").strip() for line in lines[first : node.lineno - 1])
            found = BRACKET.search(comment)
            kind, scale, test = found.groups() if found else ("", "", "")
            for target, value in pairs:
                if isinstance(target, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", target.id) and is_number(value):
                    yield Threshold(
                        path.relative_to(PACKAGE).as_posix(), target.id, ast.get_source_segment(source, value) or "",
                        BRACKET.sub("", comment).strip(), kind, scale, test,
                    )  # fmt: skip


def table() -> str:
    """The table in Markdown, with the number of each kind."""
    rows = list(thresholds())
    count = ", ".join(f"{sum(row.kind == kind for row in rows)} {kind}" for kind in KINDS)
    lines = [
        f"{len(rows)} thresholds: {count}.",
        "",
        "| constant | value | kind | scale | what it does | test |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        test = "-" if row.test in ("", "-") else f"`{row.test}`"
        what = row.what.replace("|", "\\|")
        lines.append(f"| `{row.module}` `{row.name}` | `{row.value}` | {row.kind} | {row.scale} | {what} | {test} |")
    return "\n".join(lines)


def with_table(text: str) -> str:
    """A text whose part between the marks is the table."""
    head, _, rest = text.partition(BEGIN)
    return f"{head}{BEGIN}\n{table()}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    README.write_text(with_table(README.read_text(encoding="utf-8")), encoding="utf-8")
