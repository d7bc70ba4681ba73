"""Run scenes of the set, all or those named, and compare their figures with the references.

python3 demos/benchmarks/reference/compare.py "press fit" belt
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SCENES: list[dict[str, Any]] = json.loads((HERE / "scenes.json").read_text(encoding="utf-8"))


def figures(demo: str, options: str) -> Any:
    """What a demo writes to its JSON file, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        script = HERE.parent.parent / f"{demo}.py"
        subprocess.run([sys.executable, script, *options.split(), "--json", path], check=True, stdout=subprocess.DEVNULL)
        return json.loads(path.read_text(encoding="utf-8"))


def at(found: Any, path: list[Any]) -> float:
    """The figure at a path of keys and places in lists, the largest of several."""
    for key in path:
        found = found[key]
    return float(max(found.values()) if isinstance(found, dict) else found)


def main(names: list[str]) -> None:
    """Print a line for each quantity."""
    unknown = set(names) - {scene["name"] for scene in SCENES}
    if unknown:
        sys.exit(f"no scene {', '.join(sorted(unknown))}: known are {', '.join(scene['name'] for scene in SCENES)}")
    for scene in SCENES:
        if names and scene["name"] not in names:
            continue
        found = figures(scene["demo"], scene["options"])
        for quantity in scene["quantities"]:
            value = at(found, quantity["path"])
            print(f"| {scene['name']} | {quantity['what']} | {quantity['reference']:.6g} | {value:.6g} |", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(sys.argv[1:])
