"""Code that FFCx has made in this process is found by its signature: DOLFINx lists the whole folder of its cache for each form.

That takes as long as many forms were ever compiled: with the ten thousand files of a long development some 10 ms for each form.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import ufl
from dolfinx import jit

#: What was compiled, by signature and options; no more than are unlike each other.
_known: dict[tuple[str, str], Any] = {}


@contextmanager
def _meshes_kept(what: Any) -> Iterator[None]:
    """Leave the meshes of a form as they are.

    FFCx 0.5 gives them another coordinate element where it compiles anew, which changes the hash of all that is made of them later.
    """
    domains = [(domain, domain.ufl_coordinate_element()) for domain in (what.ufl_domains() if isinstance(what, ufl.Form) else ())]
    try:
        yield
    finally:
        for domain, element in domains:
            if domain.ufl_coordinate_element() is not element:
                domain._ufl_coordinate_element = element


@contextmanager
def kept() -> Iterator[None]:
    """Within this block DOLFINx compiles, or looks up in its cache, only what this process has not compiled before.

    Whether it has is agreed on by all ranks, which compile together.
    """
    compile_anew = jit.ffcx_jit

    def ffcx_jit(comm: MPI.Comm, what: Any, *args: Any, **options: Any) -> Any:
        if isinstance(what, tuple):
            # an expression at points
            return compile_anew(comm, what, *args, **options)
        signature = what.signature() if isinstance(what, ufl.Form) else repr(what)
        key = signature, repr((args, sorted(options.items())))
        if not comm.allreduce(key in _known, op=MPI.LAND):
            with _meshes_kept(what):
                compiled, module, _ = compile_anew(comm, what, *args, **options)
            # as DOLFINx finds it in its cache, without the source
            _known[key] = compiled, module, (None, None)
        return _known[key]

    jit.ffcx_jit = ffcx_jit
    try:
        yield
    finally:
        jit.ffcx_jit = compile_anew
