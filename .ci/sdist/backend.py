"""Build backend: setuptools, with the manifest of the source distribution in this folder.

Setuptools below 77, as in Debian 12, takes the licence as a table only.
"""

from pathlib import Path

import setuptools
from setuptools.build_meta import *  # noqa: F403
from setuptools.command.egg_info import manifest_maker
from setuptools.config import pyprojecttoml

manifest_maker.template = str(Path(__file__).with_name("MANIFEST.in"))

if int(setuptools.__version__.split(".")[0]) < 77:
    read = pyprojecttoml.load_file

    def with_table(path: str) -> dict:
        """The settings of ``pyproject.toml``, with the licence in a table."""
        settings = read(path)
        settings["project"]["license"] = {"text": settings["project"]["license"]}
        del settings["project"]["license-files"]
        return settings

    pyprojecttoml.load_file = with_table
