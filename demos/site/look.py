"""Look at the pages that Sphinx has made: no broken link or picture, and what a browser shows of some of them, if there is one.

A notebook that a page offers runs, every page has a description, and the search finds pages by the words of a question.

python3 demos/site/look.py FOLDER [PICTURES]
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlencode, urlsplit

import matplotlib.image
import nbclient
import nbformat
import numpy as np

DEMOS = Path(__file__).resolve().parents[1]
#: Pages that are looked at.
SHOWN = ("site/index", "site/tutorial", "README", "site/reference/contact", "site/explanation/elimination", "hertz_cylinder")
#: A notebook that is run, in the folder of the demos.
RUN = "two_blocks"
#: Questions, and a page that the search is to find for each.
QUESTIONS = {
    "thermal expansion": "site/howto/several_fields",
    "friction coefficient": "site/howto/friction",
    "bolt preload": "site/howto/bolts",
    "sharp edges": "site/explanation/limits",
    "rigid couplings": "site/howto/rigid",
}
#: A page that shows less than this part of its pixels in other colours than the ground is empty.
INK = 0.01


class Page(HTMLParser):
    """Links, pictures and anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.path, self.links, self.anchors, self.described = path, [], set(), False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.described |= found.get("name") == "description" and bool(found.get("content"))
        self.anchors |= {found.get("id"), found.get("name")}
        self.links += [found[key] for key in ("href", "src") if found.get(key)]


def broken(folder: Path) -> list[str]:
    """Links within the site that lead nowhere, and pages without a description."""
    pages = {path.resolve(): Page(path) for path in folder.rglob("*.html") if "_static" not in path.parts}
    found = [f"{page.path.relative_to(folder)}: no description" for page in pages.values() if page.links and not page.described]
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


def run_notebook(path: Path) -> None:
    """Run a notebook among the demos, as a reader would after saving it there."""
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": DEMOS}}).execute()


def found_by_search(browser: str, folder: Path, question: str) -> list[str]:
    """Pages that the page of the search lists for a question, best first."""
    page = (folder / "search.html").resolve().as_uri() + "?" + urlencode({"q": question})
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=10000", "--dump-dom"]
    shown = subprocess.run([browser, *options, page], check=True, capture_output=True, timeout=120, text=True).stdout
    links = re.findall(r'<li class="kind-[^"]*"><a href="([^"#?]*)', shown) or re.findall(
        r'<li[^>]*><a href="([^"#?]*)\?highlight', shown
    )
    return list(dict.fromkeys(link.removesuffix(".html") for link in links))


def show(browser: str, page: Path, picture: Path) -> float:
    """Photograph a page; the part of it that is not ground."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1200,1600"]
    options += ["--virtual-time-budget=5000", f"--screenshot={picture}", page.resolve().as_uri()]
    subprocess.run([browser, *options], check=True, capture_output=True, timeout=120)
    pixels = matplotlib.image.imread(picture)[..., :3]
    ground = np.median(pixels.reshape(-1, 3), axis=0)
    return float((np.abs(pixels - ground).max(axis=2) > 0.1).mean())


folder = Path(sys.argv[1])
faults = broken(folder)
run_notebook(folder / f"{RUN}.ipynb")
print(f"{len(list(folder.rglob('*.html')))} pages")
browser = shutil.which("chromium") or shutil.which("google-chrome")
if browser:
    with tempfile.TemporaryDirectory() as passing:
        pictures = Path(sys.argv[2] if len(sys.argv) > 2 else passing)
        pictures.mkdir(parents=True, exist_ok=True)
        for name in SHOWN:
            ink = show(browser, folder / f"{name}.html", pictures / f"{Path(name).name}.png")
            print(f"{name}: {ink:.1%} shown")
            faults += [f"{name} is empty"] * (ink < INK)
    for question, page in QUESTIONS.items():
        listed = found_by_search(browser, folder, question)
        print(f"{question}: {', '.join(listed[:4])}")
        faults += [f"the search for {question!r} does not list {page}"] * (page not in listed)
print(*faults, sep="\n")
sys.exit(bool(faults))
