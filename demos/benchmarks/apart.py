"""Runs a study's script anew on a number of ranks, more than there are cores too, and reads the figures that it writes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import collectives
from common import outside_mpi


def run_on(ranks: int, script: str, *, counting: bool = False, verbose: bool = False, **options: object) -> Any:
    """Figures of a script that is called with ``--where here`` in processes of its own.

    Args:
        ranks: number of processes.
        script: its file.
        counting: whether calls of MPI are counted, see ``collectives``.
        verbose: show what it prints.
        options: of the script.
    """
    mpiexec = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")
    if mpiexec is None:
        raise RuntimeError(
            f"no mpiexec in the folder of {sys.executable} or on the PATH: install one, or call this script with --where here"
        )
    environment = outside_mpi()
    # Open MPI 4 and 5: more ranks than cores, none of them bound to the cores of another run
    environment |= {"OMPI_MCA_rmaps_base_oversubscribe": "1", "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
    environment |= {"OMPI_MCA_hwloc_base_binding_policy": "none", "PRTE_MCA_hwloc_default_binding_policy": "none"}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "figures.json"
        if counting:
            environment |= collectives.environment(mpiexec, Path(folder))
        options = {"where": "here", "json": file} | options
        words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
        command = [mpiexec, "-n", str(ranks), sys.executable, str(Path(script).resolve()), *words]
        done = subprocess.run(command, env=environment | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
        if verbose:
            print(done.stdout, flush=True)
        return json.loads(file.read_text(encoding="utf-8"))
