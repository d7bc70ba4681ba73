"""How the demos become pages: their cells, without the module's docstring, and with their pictures."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import jupytext
import latex2mathml.converter
from docutils import nodes
from nbformat import NotebookNode

sys.path.insert(0, str(Path(__file__).parents[1]))
import common


def options(text: str) -> str:
    """A folded table of a demo's own options, what they mean and their defaults; nothing without any."""
    tree, rows = ast.parse(text), []
    explained = common.explanations(ast.get_docstring(tree))
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "common.arguments":
            for option in call.keywords:
                choices = isinstance(option.value, ast.Tuple)
                values = " or ".join(f"`{ast.unparse(v)}`" for v in (option.value.elts if choices else [option.value]))
                rows.append(f"| `--{option.arg.replace('_', '-')}` | {explained.get(option.arg, '')} | {values} |")
    head = ":::{dropdown} Options\n| option | meaning | default, the first of several choices |\n|---|---|---|\n"
    return head + "\n".join(rows) + "\n:::\n" if rows else ""


def demo(text: str) -> NotebookNode:
    """The notebook of a demo; its docstring comes after the title, as the line that runs it and the options."""
    notebook = jupytext.reads(text, fmt="py:percent")
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata["language_info"] = {"name": "python"}
    if notebook.cells[0].cell_type == "code" and notebook.cells[0].source.startswith('"""'):
        docstring = notebook.cells.pop(0).source
        run = next((line for line in docstring.splitlines() if line.startswith(("python3 ", "mpirun "))), "")
        title, _, rest = notebook.cells[0].source.partition("\n")
        shown = f"```sh\n{run}\n```\n" if run else ""
        notebook.cells[0].source = f"{title}\n\n{shown}\n{options(text)}\n{rest}"
    return notebook


def formula(writer, node: nodes.math | nodes.math_block) -> None:
    """Write a formula of a page as MathML."""
    block = isinstance(node, nodes.math_block)
    writer.body.append(latex2mathml.converter.convert(node.astext(), display="block" if block else "inline"))
    raise nodes.SkipNode
