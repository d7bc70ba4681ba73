"""Parameters of contacts as controls of gradients, derivatives of gaps and contact forces by them, and assemblies without derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.conditions.equation import Equation, Periodic
from uem_dolfinx.conditions.rigid_set import turned
from uem_dolfinx.conditions.united_rows import forces_of
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.friction.sliding import Sliding
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.mortar.placement import MortarKinematics
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.overlaps import SLIVER
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: Offsets that differ by this part of a facet's side leave the same terms in rows of weighted gaps, which are linear in them.
#: [bound; side of a facet; -]
THICKER = 1e-3
PARAMETERS = ("force", "friction", "offset", "place", "shortening", "turn")


@dataclass(frozen=True, eq=False)
class ContactParameter:
    """A parameter of a contact, as a control of gradients.

    Args:
        contact: of the problem.
        parameter: ``"offset"``, a uniform increment of the contact's ``offset``, a length; ``"place"``, the translation of a
            rigid target ``(gdim,)``, a length; ``"turn"``, its rotation about its present reference point, an angle
            in 2D, a rotation vector ``(3,)`` in 3D; ``"friction"``, a uniform increment of the coefficient of Coulomb's law, for
            histories; of a ``Preload`` its ``"force"`` or ``"shortening"``, the same increment in all steps that prescribe it.

    Raises:
        InputError, InputTypeError: for an argument that is no contact, an unknown word, or a target that is not rigid.
    """

    contact: Contact
    parameter: str

    def __post_init__(self) -> None:
        given.kind("contact", self.contact, isinstance(self.contact, Contact), "a Contact")
        given.word("parameter", self.parameter, PARAMETERS)
        if self.parameter in ("force", "shortening") and not isinstance(self.contact, Preload):
            raise InputError(f"contact '{self.contact.name}': parameter = '{self.parameter}' is one of a Preload")
        if self.parameter in ("place", "turn") and not hasattr(self.contact.target, "project"):
            raise InputError(
                f"contact '{self.contact.name}': parameter = '{self.parameter}' is one of rigid targets: move nodes instead"
            )

    def shape(self, gdim: int) -> tuple[int, ...]:
        """Shape of its derivative."""
        return {"place": (gdim,), "turn": () if gdim == 2 else (3,)}.get(self.parameter, ())


def keeps_distance(contact: Contact) -> bool:
    """Whether the gaps of a contact are distances from its target for all positions, as for any mesh."""
    return not hasattr(contact.target, "project") or getattr(contact.target, "measures", False)


def led_for(m: object) -> object:
    """The object that steps ramp for a control: the contact for its offset, otherwise the control itself."""
    return m.contact if isinstance(m, ContactParameter) and m.parameter == "offset" else m


def motion_of(m: ContactParameter, x: Array, entry: tuple[int, ...]) -> Array:
    """Velocities ``(n, gdim)`` of points ``x (n, gdim)`` of a rigid target for a unit rate of an entry of its place or turn."""
    if m.parameter == "place":
        return np.tile(np.eye(x.shape[1])[entry[0]], (len(x), 1))
    target = m.contact.pair.target
    return turned_by(entry, x - target.reference(x.shape[1]))


def turned_by(entry: tuple[int, ...], v: Array) -> Array:
    """Derivatives of vectors ``(n, gdim)`` by a rotation angle."""
    return turned(np.eye(3)[entry[0]] if entry else np.ones(1), v)


def acting(problem: UnitedProblem, contact: Contact | None) -> list[tuple[Interface, PairState]]:
    """Interfaces near their targets, with the forces of a contact, or of all."""
    if contact is None:
        return [(pair, pair.trial) for pair in in_question(problem.interfaces)]
    whole, rows = table_of(contact.pair)
    own, t = np.zeros(len(whole.nodes), dtype=bool), whole.trial
    own[rows] = True
    force = np.where(own[:, None], t.force, 0.0)
    state = replace(t, active=t.active & own, lam=t.lam * own, nodal=t.nodal * own, force=force)
    return [(pair, state) for pair in in_question([whole])]


def contactors_of(rows: ContactRows, pair: Interface) -> Bools:
    """Which rows of the interface in use are of a contact's contactors ``(m,)``."""
    _, own = table_of(pair)
    return np.asarray((rows.contactor >= own.start) & (rows.contactor < own.stop))


def thickened(pair: Interface, own: ContactRows, multipliers: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Derivatives of gaps ``(m,)`` and residual ``(n_owned, gdim)`` by a contact's offset, in which both are linear (collective).

    Args:
        pair: of the contact.
        own: equations of the interface in use.
        multipliers: of these ``(m,)``.
        along: displacements of the owned nodes ``(n_owned, gdim)``, for the work of the residual of each equation instead ``(m,)``.
    """
    more = THICKER * float(reduced(pair.config.comm, _least_side(pair), op=MPI.MIN))
    before, length = pair.discretisation.setting.offset, pair.whole.kinematics.gap_rows.scale
    try:
        gap, forces = _gaps_and_forces(pair, own, multipliers, length, along)
        pair.set_offset(np.full(len(pair.nodes), more) + (0.0 if before is None else before))
        pair.project()
        other_gap, other_forces = _gaps_and_forces(pair, None, multipliers, length, along)
    finally:
        pair.set_offset(before)
        pair.project()
    return np.where(contactors_of(own, pair), other_gap - gap, 0.0) / more, (forces - other_forces) / more


def _least_side(pair: Interface) -> float:
    """Shortest side of this rank's contactor facets, a length; the model's size if rows do not depend on the offset."""
    if not isinstance(pair.discretisation, Mortar):
        return pair.config.size
    x = pair.discretisation.surface.x
    return float(np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).min(initial=pair.config.size))


def _gaps_and_forces(
    pair: Interface, own: ContactRows | None, multipliers: Array, length: Array, along: Array | None
) -> tuple[Array, Array]:
    """Gaps of equations ``(m,)`` and contact forces, or their work, see ``thickened``, scaled to another ``length (n,)`` (collective).

    ``own``: the equations, if they are known at the present offset.
    """
    whole, config = pair.whole, pair.config
    rows = whole.kinematics.gap_rows
    if isinstance(pair.discretisation, Mortar) and isinstance(whole.kinematics, MortarKinematics):
        rows = pair.discretisation.with_variation(whole.kinematics).gap_rows
        own = rows.select(np.flatnonzero(whole.trial.reserved), whole.trial.active)
    elif own is None:
        own = whole.equations()
    multipliers = np.where(contactors_of(own, pair), multipliers, 0.0)
    longer = (rows.scale / length)[own.contactor]
    if along is None:
        return own.P.gap * longer, forces_of(config, own.Q, multipliers * longer)
    forces, there = own.Q.forces(multipliers * longer), config.ask_owners(own.Q.followed, along)
    work = np.einsum("mg,mg->m", forces[: len(own)], along[own.Q.node])
    work += np.bincount(own.Q.row, np.einsum("kg,kg->k", forces[len(own) :], there), len(own))
    return own.P.gap * longer, work


def rubbed(pair: Interface, change: Array | None = None) -> Array:
    """Derivative of the residual by the coefficient of friction, or along its ``change (n,)``: ``(n_owned, gdim)`` (collective)."""
    (whole, rows), found = table_of(pair), _rubbed(pair)
    found[rows] *= 1.0 if change is None else change[:, None]
    return pair.config.add_at_owners(*_sliding(whole).frame.ties.handed_on(found))


def rubbed_along(pair: Interface, a: Array) -> Array:
    """Work of the residual's derivative by the coefficient at each contactor along ``a (n_owned, gdim)``: ``(n,)`` (collective)."""
    whole, rows = table_of(pair)
    return np.einsum("ng,ng->n", _rubbed(pair), _sliding(whole).frame.ties.relative(a))[rows]


def _rubbed(pair: Interface) -> Array:
    """Derivatives of tangential multipliers of the interface in use by a contact's coefficient ``(n, gdim)`` (collective)."""
    whole, rows = table_of(pair)
    sliding, state, found = _sliding(whole), whole.trial, np.zeros(whole.points.shape)
    if reduced(pair.config.comm, bool((sliding.value[rows] == 0.0).any()), op=MPI.LOR):
        raise InputError(
            f"{pair.name}: some contactors have no friction in a step, where the coefficient has a one-sided derivative: expected a "
            "positive coefficient everywhere"
        )
    share = sliding.slipping(state) * state.lam / whole.kinematics.ties.share
    found[rows] = (share[:, None] * sliding.directions(state))[rows]
    return found


def _sliding(pair: Interface) -> Sliding:
    assert pair.friction is not None
    return pair.friction


def refuse_assembly(problem: UnitedProblem, recorded: bool) -> None:
    """InputError for features without derivatives, by one step or, if ``recorded``, by all steps (to be agreed on)."""
    for contact in problem.contacts:
        section = contact if isinstance(contact, Preload) else None
        if contact.tied == "after" and (recorded or contact.pair.tie is None or contact.pair.tie.rows is not None):
            raise InputError(
                f"contact '{contact.name}' is tied between steps, where its surfaces were then, of which there is no derivative: expected "
                "tied=True, or False"
            )
        if section is not None and section.kept and not recorded:
            raise InputError(
                f"preload '{section.name}' is locked, at an opening that depends on earlier steps: take the steps within "
                "uem.recording(problem), and use its history"
            )
    for coupling in problem.couplings:
        if getattr(coupling, "distribute", False) and coupling.nodes.large:
            raise InputError(
                f"gradients do not support the RigidCoupling of '{coupling.name}', with distribute=True and large rotations, whose nodal "
                "forces turn with the part: expected rotations='small', or distribute=False"
            )
    if recorded and any(isinstance(v, Expr) and not isinstance(v, fem.Constant) for v in motions_of(problem)):
        raise InputError("histories do not support a motion of a coupling by an expression: expected a Constant, or a number")
    if problem.dynamics is not None and problem.couplings:
        raise InputError(
            "gradients do not support couplings in time, whose parts have velocities and masses of their own: expected statics, or a "
            "stiff part in place of the coupling"
        )


def motions_of(problem: UnitedProblem) -> list[Any]:
    """Values of prescribed motions of couplings as declared."""
    return [value for one in problem.couplings for value in getattr(one, "prescribed", {}).values()]


def refuse_soft(contact: Contact) -> None:
    """Refuse soft contacts whose forces depend on changes of areas or on speeds, of which there are no derivatives (to be agreed on)."""
    if contact.normal is None:
        return
    for there, what, expected in (
        (contact.normal.damping, "damping", "no damping"),
        (
            contact.normals == "averaged" and contact.sliding == "finite",
            "normals='averaged', sliding='finite'",
            "normals='facet'",
        ),
        (contact.measure == "current", "measure='current', whose areas change", "measure='reference'"),
        (
            contact.coupling == "mortar" and contact.sliding == "finite" and contact.config.degree == 2,
            "coupling='mortar', sliding='finite' and degree 2, whose areas change",
            "degree 1, sliding='small' or 'fixed', or coupling='node_to_surface'",
        ),
        (
            contact.coupling == "mortar" and contact.sliding != "finite" and hasattr(contact.target, "project"),
            f"coupling='mortar', sliding='{contact.sliding}' and a rigid target",
            "sliding='finite', or coupling='node_to_surface'",
        ),
    ):
        if there:
            raise InputError(f"contact '{contact.name}': gradients do not support soft contact with {what}: expected {expected}")


def refuse_sharp(contact: Contact) -> None:
    """Refuse soft contact whose areas change where it presses, at sharp edges or facets covered in part, and in corners (collective)."""
    if contact.normal is None:
        return
    pressing = contact.pair.trial.lam > 0.0
    if contact.coupling == "mortar":
        assert isinstance(contact.pair.kinematics, MortarKinematics)
        partly = pressing & (contact.pair.kinematics.rows.ratio < 1.0 - SLIVER)
        if contact.sliding == "finite" and reduced(contact.config.comm, int(partly.sum())):
            raise InputError(
                f"contact '{contact.name}': facets that press are covered in part, where areas of soft contact have no derivatives: "
                "make the contactor the smaller surface, or take sliding='small'"
            )
        return
    if reduced(contact.config.comm, int((pressing & contact.pair.trial.in_corner).sum())):
        raise InputError(
            f"contact '{contact.name}': corners of the target hold contactors of soft contact, whose axes turn with the bodies, of which "
            "there are no derivatives: take normals='averaged' or coupling='mortar'"
        )
    pressing &= contact.surface.at_sharp_edges(contact.nodes)
    if reduced(contact.config.comm, int(pressing.sum())):
        raise InputError(
            f"contact '{contact.name}': nodes at sharp edges of the contactor press, and areas of soft contact there have no derivatives: "
            "leave the facets next to the edge out of the contactor, or take coupling='mortar' and sliding='small'"
        )


def refuse_shape(problem: UnitedProblem) -> None:
    """Refuse ties, preloads, equations and couplings without derivatives by the shape (to be agreed on)."""
    spread = any(getattr(one, "distribute", False) for one in problem.couplings)
    if spread or (problem.linear is not None and any(one.n_relations for one in problem.linear.each)):
        raise InputError(
            "there is no gradient by the shape with couplings that distribute a load or whose nodes equations hold, which depend on the "
            "positions of these nodes: expected couplings without, or other controls"
        )
    for one in problem.equations:
        if not isinstance(one, Equation | Periodic):
            raise InputError(
                f"there is no gradient by the shape with a {type(one).__name__}, whose coefficients change with it: expected Equation or "
                "periodic"
            )
    for contact in problem.contacts:
        if contact.normal is not None:
            raise InputError(
                f"contact '{contact.name}': there is no gradient by the shape with soft contact, whose areas change with it: expected "
                "other controls"
            )
        if not contact.tied:
            continue
        means = contact.coupling != "node_to_surface"
        for wrong, what, expected in (
            (not contact.pair.target.n_nodes, "ties to rigid surfaces", "a tie of two bodies"),
            (means and problem.config.degree > 1, "ties by mortar of degree 2", "degree 1, or coupling='node_to_surface'"),
            (means and problem.config.axisymmetric, "ties by mortar in axisymmetry", "coupling='node_to_surface'"),
        ):
            if wrong:
                raise InputError(f"contact '{contact.name}': there is no gradient by the shape with {what}: expected {expected}")
        if problem.config.gdim == 3 and problem.config.mesh.topology.cell_name() == "hexahedron":
            raise InputError(
                f"contact '{contact.name}': there is no gradient by the shape with ties of hexahedra, whose facets warp: expected "
                "tetrahedra"
            )
        if isinstance(contact, Preload):
            if not contact.has_axis:
                raise InputError(
                    f"preload '{contact.name}': there is no gradient by the shape with the section's normal as axis: it changes with it; "
                    "expected an axis"
                )
            if contact.kept:
                raise InputError(
                    f"preload '{contact.name}' is locked, at an opening that changes with the shape, of which there is no derivative"
                )


def refuse_parameter(m: ContactParameter, what: str) -> None:
    """Refuse parameters that tied surfaces do not have, and those by which soft contacts have no derivatives."""
    if m.contact.normal is not None and m.parameter == "offset":
        raise InputError(
            f"{what} is the offset of contact '{m.contact.name}', which is soft: expected a Constant of its law, or place or turn"
        )
    if m.parameter == "offset" and m.contact.pair.friction is not None and m.contact.coupling == "mortar":
        raise InputError(
            f"{what} is the offset of contact '{m.contact.name}', with friction and coupling='mortar', whose tangential forces have no "
            "derivative by it: expected another control, or differences of runs"
        )
    if m.contact.tied and m.parameter not in ("force", "shortening"):
        raise InputError(
            f"{what} is the {m.parameter} of contact '{m.contact.name}', which is tied: expected a contact that is not, or the force or "
            "shortening of a Preload"
        )
