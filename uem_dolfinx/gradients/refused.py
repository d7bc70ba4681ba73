"""Ties, preloads, equations and couplings without derivatives, refused by name before any work."""

from __future__ import annotations

from typing import Any

from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx.conditions.equation import Equation, Periodic
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.mortar.placement import MortarKinematics
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.overlaps import SLIVER
from uem_dolfinx.gradients.parameters import ContactParameter
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


def refuse_assembly(problem: UnitedProblem, recorded: bool) -> None:
    """Refuse features through which there are no derivatives, by one step or, if ``recorded``, by all steps (to be agreed on).

    Raises:
        InputError: names the feature.
    """
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
    """Refuse a soft contact whose areas change where it presses: nodes at sharp edges, mortar's facets covered in part (collective)."""
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
        if contact.coupling != "node_to_surface" or not contact.pair.target.n_nodes:
            raise InputError(
                f"contact '{contact.name}': there is no gradient by the shape with ties by mortar or to rigid surfaces: expected a tie of "
                "two bodies with coupling='node_to_surface'"
            )
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
    if m.contact.tied and m.parameter not in ("force", "shortening"):
        raise InputError(
            f"{what} is the {m.parameter} of contact '{m.contact.name}', which is tied: expected a contact that is not, or the force or "
            "shortening of a Preload"
        )
