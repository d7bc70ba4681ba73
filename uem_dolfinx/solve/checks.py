"""Checks of the arguments of a problem: residual, Dirichlet conditions and their values, laws with history.

Most checks concern this rank only; the caller makes the ranks agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
import ufl
from dolfinx import fem
from ufl.constantvalue import ScalarValue
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError, NotFiniteError, SpaceError
from uem_dolfinx.form_checks import check_linear, check_parts
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.log import logger
from uem_dolfinx.materials.elastic import HistoryMaterial, is_history_material, material_of
from uem_dolfinx.parallel import agreed

if TYPE_CHECKING:
    from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
    from uem_dolfinx.dynamics.inertia import Dynamics

#: Values of two Dirichlet conditions of one component are equal if they differ by less than this part of the larger.
#: [convention; values; test_dirichlet.py::test_two_conditions_at_a_node]
SAME_VALUE = 1e-9
#: Laws with history that belong to problems, by their ids.
_taken: WeakValueDictionary[int, Any] = WeakValueDictionary()


def check_residual(F: Any, u: fem.Function, what: str = "F") -> None:
    """Refuse a residual that is no form, an energy, of another space or mesh, or not linear in its test function.

    Args:
        F: a UFL form.
        u: displacement.
        what: name of F in messages.

    Raises:
        InputTypeError, InputError, SpaceError: each with a remedy.
    """
    check_linear(what, F, u.function_space)
    check_parts(what, F, u)
    for part in chain.from_iterable(traverse_unique_terminals(integral.integrand()) for integral in F.integrals()):
        if isinstance(part, ScalarValue) and not np.isfinite(complex(part)):
            raise InputError(f"{what} holds the number {part}: expected finite ones; check parameters and loads")


def check_damping(form: Any, u: fem.Function, dynamics: Any) -> None:
    """Refuse a damping form as a residual, see ``check_residual``, and by an InputError if it does not depend on the velocity."""
    check_residual(form, u, "the damping form")
    if dynamics.past not in form.coefficients():
        raise InputError(
            "damping(v) does not depend on the velocity: expected a form of it, as eta * ufl.inner(rate, v) * ufl.dx; put other forces "
            "into F"
        )


def check_dynamics(dynamics: Any, contacts: Sequence[Any], others: Mapping[str, Any], usual: bool) -> Dynamics | None:
    """The dynamics of a problem, or None.

    Args:
        dynamics: of the problem.
        contacts: as declared.
        others: further arguments by name, with which explicit schemes do not go unless they are empty.
        usual: whether u is a displacement alone, and contact imposed by elimination.

    Raises:
        InputTypeError: for anything else.
        InputError: for what does not go with an explicit scheme.
    """
    if dynamics is None:
        return None
    from uem_dolfinx.dynamics.explicit.refused import refuse_unsupported
    from uem_dolfinx.dynamics.inertia import Dynamics

    given.kind("dynamics", dynamics, isinstance(dynamics, Dynamics), "Dynamics, or None")
    refuse_unsupported(dynamics, contacts, {**others} | ({} if usual else {"displacement or method": True}))
    return dynamics


def check_couplings(couplings: Any) -> tuple[list[RigidCoupling], list[Any]]:
    """The couplings of a list of couplings, joints and springs, and all of them, couplings first; InputTypeError for other objects."""
    found = given.items(
        "couplings",
        couplings,
        lambda one: hasattr(one, "nodal_forces") or hasattr(one, "ends"),
        "a RigidCoupling, a joint or a Spring",
    )
    rigid = [one for one in found if not hasattr(one, "ends")]
    return rigid, rigid + [one for one in found if hasattr(one, "ends")]


def rigid_nodes(config: Configuration, free: Bools, couplings: Sequence[RigidCoupling]) -> Bools:
    """Owned nodes ``(n_owned,)`` that couplings, or conditions of all components, ``~free (n_owned, gdim)``, move (collective)."""
    rigid = np.asarray(~free.any(axis=1))
    for coupling in couplings:
        coupling.mark(config, rigid)
    return rigid


def check_checkpoint(checkpoint: Any) -> None:
    """Refuse anything but a Checkpoint or None by an InputTypeError."""
    if checkpoint is not None:
        from uem_dolfinx.restart.checkpoint import Checkpoint

        given.kind("checkpoint", checkpoint, isinstance(checkpoint, Checkpoint), "a Checkpoint, or None")


def check_materials(materials: Any, F: ufl.Form, u: fem.Function, displacement: int | None = None) -> list[HistoryMaterial]:
    """The laws with history as a list: all laws in F, each once, of this displacement or this part of u.

    Raises:
        InputTypeError: if they are no list of laws with history.
        InputError: if a law is listed twice or not used in F, or if F contains fields of a law that is not listed.
        SpaceError: if a law is of another displacement, or belongs to another problem.
    """
    found: list[HistoryMaterial] = given.items(
        "materials", materials, is_history_material, "a material with history, as VonMises"
    )
    for i, material in enumerate(found):
        name = f"materials[{i}], {given.described(material)},"
        if any(material is other for other in found[:i]):
            raise InputError(f"{name} occurs earlier in the list: expected each law once; make a law of its own for every body")
        if _taken.get(id(material)) is material:
            raise SpaceError(
                f"{name} belongs to another problem, whose steps it remembers: expected a law of this problem's own; make new ones for "
                "every problem"
            )
        if getattr(material, "u", u) is not u:
            raise SpaceError(f"{name} is of another displacement: expected the problem's u; make it with that")
        if (part := getattr(material, "displacement", None)) != displacement:
            raise SpaceError(f"{name} is of displacement={part}: expected the problem's part of u; make it with {displacement=}")
    fields = {id(law): f for f in F.coefficients() if (law := material_of(f)) is not None}
    for i, material in enumerate(found):
        identified = any(material_of(f) is material for f in material.history.values())
        if fields.pop(id(material), None) is None and identified:
            raise InputError(
                f"F is not made of materials[{i}], {given.described(material)}: expected a term material.residual(v) in F"
            )
    for f in fields.values():
        raise InputError(
            f"F holds '{f.name}' of a law with history that is not in materials, and would stay as it is: expected all such laws; give "
            "materials=[material], or F a copy of the field where that is meant"
        )
    return found


def take_materials(materials: Sequence[HistoryMaterial]) -> None:
    """Mark laws with history as belonging to a problem."""
    _taken.update({id(material): material for material in materials})


def refuse_other_fields(config: Configuration, what: str, remedy: str) -> None:
    """Raise an InputError, with a remedy, unless the problem is of a displacement only."""
    if not config.moves:
        raise InputError(f"{what} are of a displacement, and u is a scalar field: expected a vector Lagrange space")
    if config.unknowns.mixed:
        raise InputError(
            f"{what} are not there for a displacement among other fields: expected a problem of a displacement; {remedy}"
        )


def depends_on_path(problem: Any) -> str:
    """What makes a solution depend on the path to it; empty if nothing does."""
    for present, what in (
        (bool(problem.materials), "a law with history"),
        (any(pair.friction is not None for pair in problem.pairs), "friction"),
        (any(contact.cohesion is not None for contact in problem.contacts), "cohesion"),
    ):
        if present:
            return what
    return ""


def check_hold(problem: Any) -> None:
    """Raise an InputError unless the conditions of a problem can be replaced between time steps."""
    if problem.dynamics is None:
        raise InputError("hold() is for time steps: in statics take load_steps(problem, [Step(bcs=...)])")
    from uem_dolfinx.dynamics.scheme import is_explicit

    if is_explicit(problem.dynamics):
        raise InputError("hold() does not go with CentralDifferences: take an implicit scheme, as uem.newmark()")
    if problem.history is not None:
        raise InputError("hold() while the problem is being recorded: record steps with the same conditions")


def check_conditions(config: Configuration, bcs: Any) -> list[Any]:
    """The Dirichlet conditions as a list; InputTypeError for other objects, SpaceError for conditions of another space."""
    bcs = given.items("bcs", bcs, compat.is_dirichlet, "a Dirichlet condition")
    for i, bc in enumerate(bcs):
        if not compat.is_condition_of(bc, config.whole.function_space):
            where = "another function space" if compat.is_on(bc.function_space, config.mesh) else "another mesh"
            raise SpaceError(
                f"the Dirichlet condition bcs[{i}] belongs to {where}: expected the displacement's space V or a component V.sub(i), not "
                "a collapsed, scalar or second one; make it with V = u.function_space, as by uem.dirichlet(V, tag, component, value)"
            )
    return bcs


def check_values(problem: Any, wanted: Array) -> None:
    """Refuse invalid values at the beginning of a step (collective).

    Args:
        problem: with conditions and loads set for the step.
        wanted: all unknowns with their Dirichlet values, ghosts included ``(n,)``.

    Raises:
        NotFiniteError: for an unknown or a Dirichlet value that is not finite, with its condition, value and position.
        InputError: if nodes of the mesh have moved; if Constants and numbers in the residual, Dirichlet conditions, points, couplings or
            equations differ between ranks, with the first of them and two ranks.
    """
    with agreed(problem.comm):
        problem.config.refuse_moved()
        _check_finite(problem.config, problem.bodies.bcs, wanted)
    if problem.progress.steps == 0:
        _warn_of_two_values(problem.config, problem.bodies.bcs, wanted)
    if problem.comm.size == 1:
        return
    points = [] if problem.bodies.tangent.points is None else [one for one, _ in problem.bodies.tangent.points.parts]
    forms = {name: form for name, form in problem.settings.forms.items() if isinstance(form, ufl.Form)}
    values = {f"Constant {i} of {name}": c.value for name, form in forms.items() for i, c in enumerate(form.constants(), 1)}
    values |= {
        f"the value of bcs[{i}]": getattr(getattr(bc, "g", None), "value", None) for i, bc in enumerate(problem.bodies.bcs)
    }
    values |= {f"{what} of points[{i}]": v for i, one in enumerate(points) for what, v in one.given_values().items()}
    for one in problem.couplings:
        values |= {f"{what} of the RigidCoupling of '{one.name}'": v for what, v in one.given_values().items()}
    values |= {} if problem.linear is None else problem.linear.given_values()
    given.alike(problem.comm, "the values that a step begins with", **{what: given.plain(v) for what, v in values.items()})


def _check_finite(config: Configuration, bcs: Sequence[Any], wanted: Array) -> None:
    for i, bc in enumerate(bcs):
        dofs = compat.bc_dofs(bc)[0]
        bad = dofs[~np.isfinite(wanted[dofs])]
        if len(bad):
            raise NotFiniteError(
                f"the Dirichlet condition bcs[{i}] prescribes {wanted[bad[0]]} in {config.place_of(int(bad[0]))}: "
                "expected finite values; check its value and what the load sets"
            )
    u = config.whole.x.array
    if not np.isfinite(u).all():
        first = int(np.flatnonzero(~np.isfinite(u))[0])
        raise NotFiniteError(
            f"'{config.whole.name}' is {u[first]} in {config.place_of(first)} before the step: "
            "expected finite values; set what the step begins with, as u.x.array[:] = 0.0"
        )


def _warn_of_two_values(config: Configuration, bcs: Sequence[Any], wanted: Array) -> None:
    """Warn of the first component of a node that two Dirichlet conditions give different values, of which the last counts (collective)."""
    own, found = np.empty_like(wanted), None
    for i, bc in enumerate(bcs):
        dofs = compat.bc_dofs(bc)[0]
        compat.set_bc_values(own, [bc])
        other = np.abs(own[dofs] - wanted[dofs]) > SAME_VALUE * np.maximum(np.abs(own[dofs]), np.abs(wanted[dofs]))
        if other.any():
            k = int(dofs[np.argmax(other)])
            found = i, float(own[k]), float(wanted[k]), config.place_of(k)
            break
    every = [one for one in config.comm.allgather(found) if one is not None]
    if every:
        i, first, last, where = min(every)
        logger.warning(
            "the Dirichlet condition bcs[%d] prescribes %.6g in %s, where a later condition prescribes %.6g, which counts: leave one of "
            "them out at this node", i, first, where, last,
        )  # fmt: skip


#: Checks of the settings of Newton's method that may be changed between steps, by name.
NEWTON: dict[str, Callable[[Any], Any]] = {
    "rtol": partial(given.number, "rtol", within=given.between(0.0, 1.0)), "max_iterations": partial(given.count, "max_iterations"),
    "line_search": partial(given.flag, "line_search"), "verbose": partial(given.flag, "verbose"),
}  # fmt: skip
