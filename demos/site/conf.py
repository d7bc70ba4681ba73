"""Settings of the documentation: Sphinx with MyST; the demos are read as the notebooks that they are.

.ci/site builds it. Pages lie here, in the demos and in the package; what is generated goes to the folder that is asked for.
"""

import sys
import tomllib
from pathlib import Path


sys.path.insert(0, str(Path(__file__).parent))
import reading

project = "uem_dolfinx"
author = "uem_dolfinx contributors"
copyright = f"2025-2026, {author}"
version = release = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx_design"]
root_doc = "site/index"
# the demos are written as scripts with cells; pages show them, and do not run them
nb_custom_formats = {".py": "reading.demo"}
nb_execution_mode = "off"
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["common.py", "benchmarks/**.py", "site/*.py", "**/__pycache__/**", "**/results/**"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
add_module_names = False

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "uem_dolfinx"
html_copy_source = False
html_show_sphinx = False


def with_pages(app, name: str, source: list[str]) -> None:
    """Let the pages of the demos follow the gallery."""
    if name == "README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"


def setup(app):
    """Formulas as MathML, which browsers draw themselves."""
    app.connect("source-read", with_pages)
    app.add_html_math_renderer("mathml", (reading.formula, None), (reading.formula, None))
