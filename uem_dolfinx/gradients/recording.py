"""Recording of steps for gradients through their history, of problems whose steps have derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from uem_dolfinx import given
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import as_law, follows_load
from uem_dolfinx.contact.mortar.placement import MortarKinematics
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.errors import InputError
from uem_dolfinx.gradients.gradient import AnyControl, check_controls, check_problem
from uem_dolfinx.gradients.history import History
from uem_dolfinx.gradients.parameters import keeps_distance
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.problem import UnitedProblem


@contextmanager
def recording(
    problem: UnitedProblem, *, scratch: str | Path | None = None, controls: Sequence[AnyControl] | AnyControl = ()
) -> Iterator[History]:
    """Record all steps of a problem in a ``with`` block, for gradients through their history (collective).

    Example::

        mu = uem.ContactParameter(contact, "friction")
        with uem.recording(problem, controls=[E, mu]) as history:
            for step in uem.load_steps(problem, 10):
                ...
        by_E, by_mu = history.gradient(J, [E, mu])

    A record contains the displacement, the history of contactors, laws and inertia, and the changed values of Constants and Functions in
    the residual.

    Args:
        problem: in statics or in time; supported are Coulomb friction with sliding='finite', at degree 2 in 2D and with mortar only, and
            ``VonMises`` or ``FinitePlasticity`` as law with history.
        scratch: folder for a file of each rank with the steps, which is deleted with the history; None keeps them in memory.
        controls: of later derivatives, if known: controls without derivatives are refused before the first step.

    Yields: The history, which may be used in the block and after it.

    Raises:
        InputError, InputTypeError: for a problem without such derivatives: with other laws with history or of friction, wear, ties,
            adjust and with nodes offsets of contacts with friction, or in time sliding='small'; or if the folder does not exist.
    """
    check_problem(problem)
    with agreed(problem.comm):
        given.kind("scratch", scratch, scratch is None or isinstance(scratch, (str, Path)), "a folder, or None")
        if problem.history is not None:
            raise InputError("the problem is being recorded: expected one history at a time")
        if is_explicit(problem.dynamics):
            raise InputError("steps of CentralDifferences have no derivatives: take an implicit scheme, as uem.newmark()")
        if problem.impacts is not None:
            raise InputError(
                "steps of contactors='massy', whose contact acts for whole steps, have no derivatives: take contactors='massless', or "
                "differences of runs"
            )
        for contact in problem.contacts:
            if contact.pair.friction is not None:
                _check_first(problem, f"those of contact '{contact.name}' with friction")
                _check_friction(problem, contact)
            if problem.dynamics is not None and contact.sliding == "small":
                raise InputError(
                    f"contact '{contact.name}': a step in time has no derivative by where contactors of sliding='small' were projected: "
                    "expected 'finite' or 'fixed'"
                )
        if problem.dynamics is not None:
            _check_first(problem, "steps in time")
        for material in problem.materials:
            _check_first(problem, "those of a law with history")
            if not hasattr(material, "slopes"):
                raise InputError(
                    f"a history has no derivatives through what {type(material).__name__} remembers: expected VonMises "
                    "or FinitePlasticity; else take differences of runs"
                )
        try:
            history = History(problem, None if scratch is None else Path(scratch))
        except OSError as error:
            raise InputError(f"scratch = {scratch!r}: cannot write there ({error}); expected a folder on every rank") from error
    wanted = [controls] if isinstance(controls, AnyControl) else controls
    if not isinstance(wanted, tuple) or wanted:
        history.check_controls(check_controls(problem, "controls", wanted, later=True))
    problem.history = history
    try:
        yield history
    finally:
        problem.history = None


def _check_first(problem: UnitedProblem, what: str) -> None:
    """Refuse a problem whose steps depend on earlier steps that were not recorded."""
    if problem.progress.steps:
        raise InputError(
            f"the problem has taken {problem.progress.steps} step(s), on which {what} depend: expected a problem that is recorded from its "
            "first step on"
        )


def _check_friction(problem: UnitedProblem, contact: Any) -> None:
    """Refuse contacts with friction whose history has no derivatives."""
    pair, law, config = contact.pair, as_law(contact.friction), problem.config
    means = pair.whole.kinematics
    mortar = isinstance(means, MortarKinematics)
    for wrong, expected in (
        (
            not (mortar or pair.discretisation.traits.pointwise) or (mortar and means.of.elimination.seam.any),
            "coupling='node_to_surface', and 'mortar' without periodic surfaces, where contactors have one displacement",
        ),
        (config.degree > 1 and not (mortar and config.gdim == 2), "cells of degree 1, and in 2D degree 2 with coupling='mortar'"),
        (contact.sliding != "finite", "sliding='finite'"),
        (contact.normals != "facet", "normals='facet'"),
        (type(law) is not Coulomb or law.per_area or law.per_point or follows_load(law), "Coulomb's law, without limit or load"),
        (pair.friction.wear is not None, "no wear"),
        (
            contact.adjust or (not mortar and pair.discretisation.setting.offset is not None),
            "no offset with nodes, and no adjust,",
        ),
        (not keeps_distance(contact), "a rigid plane, sphere or cylinder"),
    ):
        if wrong:
            raise InputError(
                f"contact '{contact.name}': a history with friction has derivatives for {expected} alone; else take differences of runs"
            )
