"""Build backend: setuptools, with the manifest of the source distribution in this folder."""

from pathlib import Path

from setuptools.build_meta import *  # noqa: F403
from setuptools.command.egg_info import manifest_maker

manifest_maker.template = str(Path(__file__).with_name("MANIFEST.in"))
