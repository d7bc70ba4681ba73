"""Writes the tables of the pages here from the JSON files in its folder, between the marks that name them.

python3 demos/benchmarks/report/tables.py

Every JSON file is what a demo wrote with --json; a table is a list of rows in it, as in `<!-- table work_precision glance -->`.
Columns may be chosen and named: `<!-- table stability cells: case, method -->`; rows of several files follow each other where their names
are joined by +.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
MARK = re.compile(r"(<!-- table ([\w+]+) ([\w ]+?)(?:: ([^>]*?))? -->\n).*?(<!-- end -->)", re.DOTALL)


def show(value: Any) -> str:
    """Text of a cell."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}"
    return str(value).replace("|", "\\|")


def table(rows: list[dict[str, Any]], columns: list[str]) -> str:
    """Rows as Markdown; what is the same as in the row above stays empty in the first column."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    above = ""
    for row in rows:
        first, *others = (show(row.get(column)) for column in columns)
        lines.append("| " + " | ".join(["" if first == above else first, *others]) + " |")
        above = first
    return "\n".join(lines) + "\n"


def fill(match: re.Match[str]) -> str:
    """A table with its marks."""
    start, names, key, chosen, end = match.groups()
    rows: list[dict[str, Any]] = []
    for name in names.split("+"):
        found = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))[key]
        rows += found if isinstance(found, list) else [{"what": k, "value": v} for k, v in found.items()]
    columns = [c.strip() for c in chosen.split(",")] if chosen else list(rows[0])
    return start + table(rows, columns) + end


if __name__ == "__main__":
    for page in HERE.glob("*.md"):
        page.write_text(MARK.sub(fill, page.read_text(encoding="utf-8")), encoding="utf-8")
