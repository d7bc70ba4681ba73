"""Look at the pages that Sphinx has made: no broken link or picture, and what a browser shows of some of them, if there is one.

python3 demos/site/look.py FOLDER [PICTURES]
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import matplotlib.image
import numpy as np

#: Pages that are looked at.
SHOWN = ("site/index", "site/tutorial", "README", "site/reference/contact", "site/explanation/elimination", "hertz_cylinder")
#: A page that shows less than this part of its pixels in other colours than the ground is empty.
INK = 0.01


class Page(HTMLParser):
    """Links, pictures and anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.path, self.links, self.anchors = path, [], set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors |= {found.get("id"), found.get("name")}
        self.links += [found[key] for key in ("href", "src") if found.get(key)]


def broken(folder: Path) -> list[str]:
    """Links within the site that lead nowhere."""
    pages = {path.resolve(): Page(path) for path in folder.rglob("*.html") if "_static" not in path.parts}
    found = []
    for page in pages.values():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            there = (page.path.parent / unquote(parts.path)).resolve() if parts.path else page.path.resolve()
            lost = parts.fragment and there in pages and unquote(parts.fragment) not in pages[there].anchors
            if not there.exists() or lost:
                found.append(f"{page.path.relative_to(folder)}: {link}")
    return found


def show(browser: str, page: Path, picture: Path) -> float:
    """Photograph a page; the part of it that is not ground."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1200,1600"]
    options += ["--virtual-time-budget=5000", f"--screenshot={picture}", page.resolve().as_uri()]
    subprocess.run([browser, *options], check=True, capture_output=True, timeout=120)
    pixels = matplotlib.image.imread(picture)[..., :3]
    ground = np.median(pixels.reshape(-1, 3), axis=0)
    return float((np.abs(pixels - ground).max(axis=2) > 0.1).mean())


folder = Path(sys.argv[1])
lost = broken(folder)
print(f"{len(list(folder.rglob('*.html')))} pages", *lost, sep="\n")
browser = shutil.which("chromium") or shutil.which("google-chrome")
with tempfile.TemporaryDirectory() as passing:
    pictures = Path(sys.argv[2] if len(sys.argv) > 2 else passing)
    pictures.mkdir(parents=True, exist_ok=True)
    ink = {name: show(browser, folder / f"{name}.html", pictures / f"{Path(name).name}.png") for name in SHOWN} if browser else {}
print(*(f"{name}: {part:.1%} shown" for name, part in ink.items()), sep="\n")
sys.exit(bool(lost) or any(part < INK for part in ink.values()))
