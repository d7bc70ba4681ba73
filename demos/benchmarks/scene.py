"""A scene: what a comparison needs to solve one problem by one method after the other, and to measure how wrong each is.

The scenes are in `signorini.py` and `problems.py`, what is done with them in `measure.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import ufl
from common import comm
from dolfinx import fem

import uem_dolfinx as uem

#: All methods solve a 2D scene by the same symmetric factorisation.
DIRECT = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}


@dataclass
class Scene:
    """One mesh of one problem.

    Attributes:
        problem: its name in the table.
        degree: of the displacement.
        F: residual without contact.
        u: displacement; every run starts from zero.
        bcs: Dirichlet conditions.
        contact: makes the contact, anew for each run.
        errors: what a run is measured by, from the problem, its contact and its steps: ``error_energy``, ``error_l2``,
            ``error_pressure``, ``error_force``, ``overlap``, each relative, and None where the problem has no such figure.
        stiffness: a pressure per length that penalties are multiples of: Young's modulus of the softer body over h.
        h: size of the contactor's cells, a length.
        options: makes further arguments of the problem for a method, anew for each run.
        run: leads the problem to the state that is measured; yields its steps.
        facts: what else the row of a point in the table contains.
    """

    problem: str
    degree: int
    F: ufl.Form
    u: fem.Function
    bcs: list[Any]
    contact: Callable[[], uem.Contact]
    errors: Callable[[uem.UnitedProblem, uem.Contact, list[Any]], dict[str, float | None]]
    stiffness: float
    h: float
    options: Callable[[str], dict[str, Any]] = lambda method: {"petsc_options": DIRECT}
    run: Callable[[uem.UnitedProblem], Iterable[Any]] = uem.load_steps
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def dofs(self) -> int:
        """Number of displacements."""
        V = self.u.function_space
        return int(V.dofmap.index_map.size_global * V.dofmap.index_map_bs)


def overlap(contact: uem.Contact) -> float:
    """How deep the deepest contactor is inside the target, a length (collective)."""
    return float(max(comm.allgather(-contact.pair.kinematics.projection.gap.min(initial=0.0))))
