"""Every method by its name, as a problem with the arguments, steps and results of ``UnitedProblem``."""

from __future__ import annotations

import importlib.util
from functools import partial
from typing import TYPE_CHECKING, Any

import uem_dolfinx as uem
from benchmarks import eigenvalues
from benchmarks.rivals.lagrange import LagrangeSystem
from benchmarks.rivals.penalty import NodePoints, PenaltySystem, SurfacePoints

if TYPE_CHECKING:
    from collections.abc import Iterable

    import ufl
    from dolfinx import fem

#: Every method, the package itself first.
METHODS = ("united", "mortar", "penalty", "penalty_surface", "lagrange", "augmented", "barrier")
#: With those that are for statics without friction alone, which extreme cases leave out.
ALL = (*METHODS, "proximal")
#: The package's own, by what unites: nodes on facets, or integrals over both surfaces.
OWN = ("united", "mortar")
#: Those that need a number.
NEED_PARAMETER = ("penalty", "penalty_surface", "augmented", "barrier", "proximal")
#: Those that know friction.
RUB = ("united", "mortar", "penalty", "augmented")
#: Overlap at which Uzawa's multipliers are good enough, as part of the model's size.
UZAWA_OVERLAP = 1e-9
#: Linear solves of a step: every update of the multipliers takes one or more.
MOST_UZAWA_ITERATIONS = 100
MOST_BARRIER_ITERATIONS = 100


def available(method: str) -> bool:
    """Whether what the method needs is installed."""
    return method != "barrier" or importlib.util.find_spec("ipctk") is not None


def create(
    method: str, F: ufl.Form, u: fem.Function, *, parameter: float | None = None, scale: float | None = None, **options: Any
) -> uem.UnitedProblem:
    """A problem that reaches contact by ``method``.

    Args:
        method: one of ``ALL``.
        F: as for ``UnitedProblem``.
        u: likewise.
        parameter: stiffness of the springs, a pressure per length (penalty, penalty_surface, augmented; of the first proximal step,
            proximal); distance at which the
            barrier begins, a length (barrier).
        scale: stiffness of the bodies at the surface, a pressure per length (proximal).
        options: as for ``UnitedProblem``.
    """
    if method not in ALL:
        raise ValueError(f"'{method}' is not known here: expected one of {', '.join(ALL)}")
    if (method in NEED_PARAMETER) != (parameter is not None):
        raise ValueError(f"{method} {'needs a parameter' if parameter is None else 'has no parameter'}")
    if method == "mortar":
        # scenes make their contacts for all methods alike
        for contact in options.get("contacts", ()):
            contact.coupling = "mortar"
    if method in OWN:
        return uem.UnitedProblem(F, u, **options)
    if method == "lagrange":
        return uem.UnitedProblem(F, u, method=LagrangeSystem, **options)
    tags = [contact.contactor for contact in options.get("contacts", ())]
    if method == "barrier":
        from benchmarks.rivals.barrier import BarrierSystem

        options.setdefault("max_iterations", MOST_BARRIER_ITERATIONS)
        method_of = partial(BarrierSystem, contacts=options.get("contacts", ()), distance=parameter)
        return uem.UnitedProblem(F, u, method=method_of, **options)
    if method == "proximal":
        from benchmarks.rivals.proximal import ProximalSystem

        options.setdefault("max_iterations", MOST_UZAWA_ITERATIONS)
        proximal = partial(ProximalSystem, tags=tags, stiffness=parameter, scale=scale or parameter)
        return uem.UnitedProblem(F, u, method=proximal, **options)
    frictional = [contact.friction for contact in options.get("contacts", ())]
    for contact in options.get("contacts", ()):
        # springs have friction of their own
        contact.friction = 0.0
    system = partial(
        PenaltySystem, tags=tags, stiffness=parameter, friction=frictional,
        points=SurfacePoints if method == "penalty_surface" else NodePoints,
    )  # fmt: skip
    if method == "augmented":
        options.setdefault("max_iterations", MOST_UZAWA_ITERATIONS)
        system = partial(system, overlap=UZAWA_OVERLAP)
    return uem.UnitedProblem(F, u, method=system, **options)


def counts(steps: Iterable[uem.LoadStep]) -> tuple[int, int]:
    """Newton iterations and linear iterations of load steps."""
    histories = [step.iterations for step in steps]
    return sum(len(h) - 1 for h in histories), sum(i.linear_iterations for h in histories for i in h)


def condition_number(problem: uem.UnitedProblem) -> float:
    """Largest over smallest magnitude of the eigenvalues of the last linear system (serial).

    The equations of a saddle point are scaled by the mean diagonal of K.
    """
    system = problem.system
    return eigenvalues.condition_number(system.saddle if isinstance(system, LagrangeSystem) else system.solver.A)
