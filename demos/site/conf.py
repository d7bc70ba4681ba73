"""Settings of the documentation: Sphinx with MyST; the demos are read as the notebooks that they are, see ``reading``.

.ci/site builds it. Pages lie here, in the demos and in the package; generated files are written to the given folder.
"""

import sys
import tomllib
from html import escape
from pathlib import Path

from docutils import nodes

sys.path.insert(0, str(Path(__file__).parent))
import reading
from sphinx.ext.napoleon import GoogleDocstring
from sphinx.util.inspect import TypeAliasForwardRef

project = "uem_dolfinx"
author = "uem_dolfinx contributors"
copyright = f"2025-2026, {author}"
about = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
version = release = about["version"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_design",
]
root_doc = "site/index"
# the demos are written as scripts with cells; pages show them, and do not run them
nb_custom_formats = {".py": "reading.demo"}
nb_execution_mode = "off"
nb_code_prompt_show = "Show the code"
nb_code_prompt_hide = "Hide the code"
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["common.py", "benchmarks/**.py", "site/*.py", "**/__pycache__/**", "**/results/**"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
# types by the names that they have in the code
autodoc_type_aliases = {name: name for name in ("Field", "Part", "Value", "Array", "Indices", "OfPressureAndGap")}
autodoc_type_aliases |= {"npt.ArrayLike": "ArrayLike", "FrictionLaw": "FrictionLaw"}
autosummary_generate = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
add_module_names = False

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "uem_dolfinx"
pygments_dark_style = "github-dark"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_favicon = "favicon.svg"
html_copy_source = False
html_show_sphinx = False


def whole(docstring: GoogleDocstring) -> tuple[str, list[str]]:
    """The docstring of a property, whose first line may have a colon; it has no type of its own."""
    lines = docstring._dedent(docstring._consume_to_end())
    return "", GoogleDocstring(lines, docstring._config).lines()


GoogleDocstring._consume_inline_attribute = whole
TypeAliasForwardRef.__repr__ = lambda self: self.name


def with_pages(app, name: str, source: list[str]) -> None:
    """The gallery as cards, what the front page has from the README, and the chapters of the report."""
    if name == "README":
        source[0] = reading.cards()
    if name == "benchmarks/report/README":
        source[0] += reading.chapters(source[0])
    if name == "site/index":
        source[0] = reading.front(source[0]).replace("<!-- version -->", version)


def without_internals(app, what, name, obj, options, lines: list[str]) -> None:
    """Leave out of a class what its page excludes of the attributes that the docstring lists."""
    hidden, kept, left_out = options.exclude_members or (), [], False
    for line in lines:
        if line.startswith(".. attribute:: "):
            left_out = line.split()[2] in hidden
        elif line and not line.startswith(" "):
            left_out = False
        if not left_out:
            kept.append(line)
    lines[:] = kept


def with_groups(app, page, template, context, doctree) -> None:
    """The groups of the gallery in the sidebar."""
    if "furo_navigation_tree" in context:
        context["furo_navigation_tree"] = reading.in_groups(context["furo_navigation_tree"])


def with_description(app, page, template, context, doctree) -> None:
    """What search engines show of a page: its first sentences."""
    text = reading.description(doctree) if doctree else about["description"]
    context["metatags"] = (
        context.get("metatags", "") + f'<meta name="description" content="{escape(text or about["description"])}">'
    )


def with_first_panels(app, doctree, page: str) -> None:
    """A card of the gallery shows the first panel of its picture."""
    for image in doctree.findall(nodes.image) if page == "README" else ():
        if "sd-card-img-top" in image["classes"]:
            image["uri"] = reading.first_panel(Path(app.srcdir) / image["uri"], Path(app.outdir))


def with_late_pictures(app, doctree, page: str) -> None:
    """A browser loads the pictures of a page, except the first one, when the reader comes near them; wide ones scroll on narrow windows."""
    images = list(doctree.findall(nodes.image))
    for image in images[1:]:
        image["loading"] = "lazy"
    for image in images:
        if reading.is_wide(Path(app.srcdir) / image["uri"]):
            image["classes"].append("wide")


def with_notebooks(app, error) -> None:
    """A notebook and the script in the folder of each demo's page."""
    if not error and app.builder.format == "html":
        reading.write_notebooks(Path(app.outdir))


def setup(app):
    """Formulas as MathML, which browsers draw themselves."""
    app.connect("html-page-context", with_description)
    app.connect("doctree-resolved", with_first_panels)
    app.connect("doctree-resolved", with_late_pictures)
    app.connect("build-finished", with_notebooks)
    app.connect("source-read", with_pages)
    app.connect("html-page-context", with_groups, priority=900)
    app.connect("autodoc-process-docstring", without_internals, priority=900)
    app.add_html_math_renderer("mathml", (reading.formula, None), (reading.formula, None))
