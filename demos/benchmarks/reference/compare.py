"""Run scenes of the set, all or those named, and compare their figures with the references.

python3 demos/benchmarks/reference/compare.py "press fit" belt
python3 demos/benchmarks/reference/compare.py --decks FOLDER

Iterations are those of all steps of a scene; of decks also those of CalculiX, where it is installed.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SCENES: list[dict[str, Any]] = json.loads((HERE / "scenes.json").read_text(encoding="utf-8"))


def figures(scene: dict[str, Any], decks: Path | None = None) -> Any:
    """What a scene's script writes to its JSON file, in a process of its own, and its iterations.

    None of a deck that is not in the folder ``decks``.
    """
    script, options = HERE.parent.parent / f"{scene.get('demo')}.py", scene.get("options", "").split()
    if "closed_form" in scene:
        script, options = HERE / "closed_forms.py", ["--scene", scene["closed_form"]]
    if "deck" in scene:
        if decks is None or not (decks / scene["deck"]).is_file():
            return None
        script, options = HERE / "decks.py", ["--deck", decks / scene["deck"]]
    with tempfile.TemporaryDirectory() as folder:
        path, count = Path(folder) / "figures.json", Path(folder) / "iterations.json"
        command = [sys.executable, HERE / "iterations.py", count, script, *options, "--json", path]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return tuple(json.loads(file.read_text(encoding="utf-8")) for file in (path, count))


def of_calculix(deck: Path) -> int | None:
    """Iterations that ``ccx`` takes with a deck, 1 where it is linear; None where no ccx is installed or it does not take the deck."""
    ccx = shutil.which("ccx")
    if ccx is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(deck, folder)
        done = subprocess.run([ccx, deck.stem], cwd=folder, capture_output=True, text=True)
    if done.returncode or "*ERROR" in done.stdout:
        return None
    return max(len(re.findall(r"^\s*iteration\s+\d+\s*$", done.stdout, re.MULTILINE)), 1)


def at(found: Any, path: list[Any]) -> float:
    """The figure at a path of keys and places in lists, the largest of several."""
    for key in path:
        found = found[key]
    return float(max(found.values()) if isinstance(found, dict) else found)


def main(names: list[str], decks: Path | None = None) -> None:
    """Print a line for each quantity; decks of other programs are run where they are in a folder."""
    unknown = set(names) - {scene["name"] for scene in SCENES}
    if unknown:
        sys.exit(f"no scene {', '.join(sorted(unknown))}: known are {', '.join(scene['name'] for scene in SCENES)}")
    for scene in SCENES:
        if names and scene["name"] not in names:
            continue
        found = figures(scene, decks)
        if found is None:
            if names:
                sys.exit(f"{scene['name']} needs the file {scene['deck']} of {scene['source']}: give its folder by --decks")
            continue
        values, ours = found
        theirs = of_calculix(decks / scene["deck"]) if decks is not None and "deck" in scene else None
        counts = [str(n) if n is not None else "–" for n in (ours or None, theirs)]
        for quantity in scene["quantities"]:
            value = at(values, quantity["path"])
            print(
                f"| {scene['name']} | {quantity['what']} | {quantity['reference']:.6g} | {value:.6g} | {' | '.join(counts)} |",
                flush=True,
            )
            counts = ["", ""]


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", help="scenes; without any, all")
    parser.add_argument("--decks", metavar="FOLDER", type=Path, help="where the files of other programs' decks are")
    args = parser.parse_args()
    main(args.names, args.decks)
