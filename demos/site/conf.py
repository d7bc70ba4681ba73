"""Settings of the documentation: Sphinx with MyST; the demos are read as the notebooks that they are.

.ci/site builds it. Pages lie here, in the demos and in the package; what is generated goes to the folder that is asked for.
"""

import sys
from pathlib import Path

import uem_dolfinx

project = "uem_dolfinx"
author = "uem_dolfinx contributors"
copyright = f"2025-2026, {author}"
version = release = "0.2.0"
sys.path.insert(0, str(Path(__file__).parent))

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode", "sphinx_design"]
root_doc = "site/index"
# the demos are written as scripts with cells; pages show them, and do not run them
nb_custom_formats = {".py": "reading.demo"}
nb_execution_mode = "off"
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["common.py", "README.md", "evidence/**", "report/tables.py", "site/*.py", "**/__pycache__/**", "**/results/**"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
add_module_names = False

html_theme = "furo"
html_title = "uem_dolfinx"
html_copy_source = False
html_show_sphinx = False
