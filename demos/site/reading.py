"""How the demos and the gallery become pages: the scene and its picture first, code that fits the column, what is not the scene folded."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import jupytext
import latex2mathml.converter
from docutils import nodes
from nbformat import NotebookNode
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
import common

DEMOS = Path(__file__).parents[1]
#: Of a demo's page: the notebook and the script.
DOWNLOADS = """<p>Download: <a href="{name}.ipynb" download>notebook</a>, <a href="{name}.py" download>script</a>.
Both run in the folder <code>demos</code> of a clone, with <code>common.py</code>, which reads the options and writes the files.
In a script of your own write numbers in place of <code>args</code>, and the path of the mesh in place of <code>common.MESHES</code>.</p>

"""


def options(text: str) -> str:
    """A table of a demo's own options, which is what to vary, what they mean and their defaults; nothing without any."""
    tree, rows = ast.parse(text), []
    explained = common.explanations(ast.get_docstring(tree))
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "common.arguments":
            for option in call.keywords:
                choices = isinstance(option.value, ast.Tuple)
                values = " or ".join(f"`{ast.unparse(v)}`" for v in (option.value.elts if choices else [option.value]))
                rows.append(f"| `--{option.arg.replace('_', '-')}` | {explained.get(option.arg, '')} | {values} |")
    head = "**Options**, in addition to `--plot FILE.png`, `--setup FILE.png`, `--json FILE` and `--output DIR`:\n\n"
    head += "| option | meaning | default, the first of several choices |\n|---|---|---|\n"
    return head + "\n".join(rows) + "\n" if rows else ""


@dataclass(frozen=True)
class Entry:
    """A demo in the gallery.

    Attributes:
        name: of its file.
        pictures: lines of Markdown that show them.
        text: what it is.
        measured: what was measured, with the text's last sentence before it.
    """

    name: str
    pictures: list[str]
    text: str
    measured: str

    @property
    def title(self) -> str:
        """The heading of the demo's page."""
        return re.search(r"^# # (.*)$", (DEMOS / f"{self.name}.py").read_text(encoding="utf-8"), re.MULTILINE)[1]

    @property
    def sketch(self) -> list[str]:
        """The line of Markdown that shows what the demo declares, if there is a picture of that."""
        picture = f"pictures/{self.name}_setup.png"
        words = "The scene: bodies, supports, loads, and what meets what"
        return [f":::{{figure}} {picture}\n:alt: {words}\n:class: sketch\n:::"] if (DEMOS / picture).exists() else []

    def card(self) -> str:
        """A card with the title, the first picture and the text without its links."""
        picture = re.match(r"!\[(.*)\]\((.*)\)", self.pictures[0]) if self.pictures else None
        image = f":img-top: {picture[2]}\n:img-alt: {picture[1]}\n" if picture else ""
        text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", self.text)
        return f":::{{grid-item-card}} {self.title}\n:link: {self.name}\n:link-type: doc\n{image}\n{text}\n:::\n"


def gallery() -> tuple[str, dict[str, tuple[str, list[Entry]]]]:
    """The gallery's first lines, and of each group its own first lines and its demos."""
    start, *groups = re.split(r"^## ", (DEMOS / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = {}
    for group in groups:
        head, *demos = re.split(r"^### ", group, flags=re.MULTILINE)
        title, _, about = head.partition("\n")
        entries = []
        for one in demos:
            lines = [line for line in one.splitlines()[1:] if line]
            text, _, measured = " ".join(line for line in lines if not line.startswith("![")).partition("*Measured:*")
            name = re.match(r"\[(\w+)\.py\]", one)[1]
            entries.append(Entry(name, [line for line in lines if line.startswith("![")], text.strip(), measured.strip()))
        found[title.strip()] = (about.strip(), entries)
    return start, found


def entries_of_gallery() -> list[Entry]:
    """All demos of the gallery."""
    return [entry for _, entries in gallery()[1].values() for entry in entries]


def cards() -> str:
    """The page of the gallery: for each group of demos a grid of cards."""
    start, groups = gallery()
    parts = [start]
    for title, (about, entries) in groups.items():
        inside = "\n".join(entry.card() for entry in entries)
        pages = "\n".join(entry.name for entry in entries)
        parts.append(f"## {title}\n\n{about}\n\n::::{{grid}} 1 1 2 2\n:gutter: 3\n\n{inside}::::\n")
        parts.append(f"```{{toctree}}\n:hidden:\n\n{pages}\n```\n")
    return "\n".join(parts)


def first_panel(picture: Path, folder: Path) -> str:
    """Write the first panel of a picture, which ``uem.figure`` has noted in it, into a folder; its path in there."""
    image = Image.open(picture)
    if panels := image.info.get("Panels", "").split():
        left, top, right, bottom = (int(number) for number in panels[0].split(","))
        image = image.crop((max(0, left - 8), max(0, top - 8), min(image.width, right + 8), min(image.height, bottom + 8)))
    image.thumbnail((640, 640))
    path = f"_images/cards/{picture.name}"
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    image.save(folder / path, optimize=True)
    return path


def is_wide(picture: Path) -> bool:
    """Whether a picture has several panels side by side, whose letters are too small on a narrow window."""
    if picture.suffix != ".png" or not picture.exists():
        return False
    width, height = Image.open(picture).size
    return width > max(1000, 1.5 * height)


def chapters(text: str) -> str:
    """The pages to which the first column of a table leads, for the sidebar."""
    pages = re.findall(r"^\| \[[^]]*\]\((\w+)\.md\)", text, re.MULTILINE)
    return "\n```{toctree}\n:hidden:\n\n" + "\n".join(pages) + "\n```\n"


def in_groups(navigation: str) -> str:
    """The sidebar with the names of the gallery's groups before the first demo of each."""
    for title, (_, entries) in gallery()[1].items():
        link = rf'<a [^>]*href="(?:(?:[^"]*/)?{entries[0].name}\.html|#)"[^>]*>{re.escape(entries[0].title)}<'
        label = f'<li class="toctree-l2 group">{title}</li>'
        navigation = re.sub(
            rf'<li class="toctree-l2[^"]*">{link}', lambda found, label=label: label + found[0], navigation, count=1
        )
    return navigation


def front(text: str) -> str:
    """The site's first page with the script of the README and the table of couplings of their page."""
    readme = (DEMOS.parent / "README.md").read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```\n", readme, re.DOTALL)[1]
    couplings = (DEMOS / "site" / "howto" / "sides_and_coupling.md").read_text(encoding="utf-8")
    table = re.search(r"^\| \| node_to_surface \|.*?\n\n", couplings, re.DOTALL | re.MULTILINE)[0]
    return text.replace("<!-- script -->", f"```python\n{fitting(script)}```").replace("<!-- couplings -->", table)


def fitting(text: str) -> str:
    """Code of a demo with lines of 88 characters."""
    text = re.sub(r"  # fmt: skip$", "", text, flags=re.MULTILINE)
    command = ["ruff", "format", "--isolated", "--line-length", "88", "-"]
    return subprocess.run(command, input=text, check=True, capture_output=True, text=True).stdout


def machinery(source: str) -> bool:
    """Whether a cell is none of the scene: imports and options, tables, files, pictures, what is asserted."""
    if re.match("(import|from) ", source):
        return True
    parts = r"^(if args\.(plot|output)|( {4})?assert |common\.report\(|results = )"
    return bool(re.search(parts, source, re.MULTILINE)) and not re.search("^(def|class) ", source, re.MULTILINE)


def demo(text: str) -> NotebookNode:
    """The notebook of a demo: title, sketch, picture, what was measured, the line that runs it and its options; then its cells."""
    notebook = jupytext.reads(fitting(text), fmt="py:percent")
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata["language_info"] = {"name": "python"}
    if notebook.cells[0].cell_type == "code" and notebook.cells[0].source.startswith('"""'):
        docstring = notebook.cells.pop(0).source
        run = next((line for line in docstring.splitlines() if line.startswith(("python3 ", "mpirun "))), "")
        title, _, rest = notebook.cells[0].source.partition("\n")
        shown = f"```sh\n{run}\n```\n" if run else ""
        entry = next((e for e in entries_of_gallery() if f"# {e.title}" == title), None)
        shown += DOWNLOADS.format(name=entry.name) if entry else ""
        pictures = "\n\n".join([*entry.sketch, *entry.pictures]) if entry else ""
        measured = f"**Measured:** {entry.measured}\n" if entry and entry.measured else ""
        notebook.cells[0].source = f"{title}\n{rest}\n\n{pictures}\n\n{measured}\n{shown}\n{options(text)}"
    for cell in notebook.cells:
        if cell.cell_type == "code" and machinery(cell.source):
            cell.metadata["tags"] = ["hide-input"]
    return notebook


def write_notebooks(folder: Path) -> None:
    """The demos of the gallery as notebooks, which run in the folder ``demos`` of a clone, and as the scripts that they are."""
    for entry in entries_of_gallery():
        script = DEMOS / f"{entry.name}.py"
        notebook = jupytext.reads(script.read_text(encoding="utf-8"), fmt="py:percent")
        first = notebook.cells[0]
        if first.cell_type == "code" and first.source.startswith('"""'):
            first.source = f"__doc__ = {first.source}"
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        jupytext.write(notebook, folder / f"{entry.name}.ipynb")
        shutil.copy(script, folder)


def description(doctree: nodes.document) -> str:
    """The beginning of a page's first paragraph that is more than a few words, up to 160 characters."""
    texts = (" ".join(found.astext().split()) for found in doctree.findall(nodes.paragraph))
    text = next((text for text in texts if len(text) > 40), "")
    return text if len(text) <= 160 else text[:157].rsplit(" ", 1)[0].rstrip(",;:") + " ..."


def formula(writer, node: nodes.math | nodes.math_block) -> None:
    """Write a formula of a page as MathML."""
    block = isinstance(node, nodes.math_block)
    writer.body.append(latex2mathml.converter.convert(node.astext(), display="block" if block else "inline"))
    raise nodes.SkipNode
