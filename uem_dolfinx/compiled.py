"""Cache of compiled forms in memory, by signature: DOLFINx lists the whole folder of its disk cache for each form.

The time for this grows with the number of files: about 10 ms for each form with ten thousand files after long development.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import ufl
from dolfinx import jit

#: Compiled forms by signature and options, each once.
_known: dict[tuple[str, str], Any] = {}


@contextmanager
def _meshes_kept(what: Any) -> Iterator[None]:
    """Restore the coordinate elements of a form's meshes.

    FFCx 0.5 replaces them when it compiles a form, which would change the hash of all later forms on these meshes.
    """
    domains = [(domain, domain.ufl_coordinate_element()) for domain in (what.ufl_domains() if isinstance(what, ufl.Form) else ())]
    try:
        yield
    finally:
        for domain, element in domains:
            if domain.ufl_coordinate_element() is not element:
                domain._ufl_coordinate_element = element


def forget_logging_of_ffcx() -> None:
    """Remove the handler that FFCx 0.5 gives the root logger, with which ``logging.basicConfig`` of a script has no effect."""
    root = logging.getLogger()
    usual = [
        h for h in root.handlers if type(h) is logging.StreamHandler and getattr(h.formatter, "_fmt", "") == logging.BASIC_FORMAT
    ]
    if usual and usual == root.handlers and root.level == logging.WARNING:
        root.handlers.clear()
        # still the handler of scripts that configure nothing
        logging.lastResort = usual[0]  # type: ignore[assignment]


#: Options of users for the compiler.
_chosen: dict[str, Any] = {}


@contextmanager
def with_options(options: Mapping[str, Any]) -> Iterator[None]:
    """Within this block forms are compiled with these options of DOLFINx's compiler calls."""
    before = dict(_chosen)
    _chosen.update(options)
    try:
        yield
    finally:
        _chosen.clear()
        _chosen.update(before)


@contextmanager
def kept() -> Iterator[None]:
    """Within this block DOLFINx compiles, or searches its disk cache for, only forms that are new in this process.

    A form is new for all ranks, which compile together, if it is new for any rank.
    """
    compile_anew = jit.ffcx_jit

    def ffcx_jit(comm: MPI.Comm, what: Any, *args: Any, **options: Any) -> Any:
        if isinstance(what, tuple):
            # an expression at points
            return compile_anew(comm, what, *args, **options)
        if _chosen:
            # named so in DOLFINx 0.5, and in newer versions
            name = next(one for one in ("jit_params", "jit_options") if one in options)
            options[name] = {**(options[name] or {}), **_chosen}
        signature = what.signature() if isinstance(what, ufl.Form) else repr(what)
        key = signature, repr((args, sorted(options.items())))
        if not comm.allreduce(key in _known, op=MPI.LAND):
            with _meshes_kept(what):
                compiled, module, _ = compile_anew(comm, what, *args, **options)
            # the format of DOLFINx for forms from its cache, without the source
            _known[key] = compiled, module, (None, None)
        return _known[key]

    jit.ffcx_jit = ffcx_jit
    try:
        yield
    finally:
        jit.ffcx_jit = compile_anew
