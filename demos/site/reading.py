"""How the demos become pages: their cells, without the module's docstring, and with their pictures."""

from __future__ import annotations

import jupytext
import latex2mathml.converter
from docutils import nodes
from nbformat import NotebookNode


def demo(text: str) -> NotebookNode:
    """The notebook of a demo; its docstring comes after the title, as the line that runs it."""
    notebook = jupytext.reads(text, fmt="py:percent")
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata["language_info"] = {"name": "python"}
    if notebook.cells[0].cell_type == "code" and notebook.cells[0].source.startswith('"""'):
        docstring = notebook.cells.pop(0).source
        run = next((line for line in docstring.splitlines() if line.startswith("python3 ")), "")
        title, _, rest = notebook.cells[0].source.partition("\n")
        notebook.cells[0].source = f"{title}\n\n```sh\n{run}\n```\n{rest}" if run else notebook.cells[0].source
    return notebook


def formula(writer, node: nodes.math | nodes.math_block) -> None:
    """Write a formula of a page as MathML."""
    block = isinstance(node, nodes.math_block)
    writer.body.append(latex2mathml.converter.convert(node.astext(), display="block" if block else "inline"))
    raise nodes.SkipNode
