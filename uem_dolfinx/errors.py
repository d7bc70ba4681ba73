"""Errors that the package raises on purpose, by name."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


class UEMError(Exception):
    """Root of every error this package raises on purpose."""

    def amend(self, more: str, instead: bool = False) -> None:
        """Say more at the end of the message, ``instead`` of all advice, and no longer advise smaller steps, which do not help."""
        smaller = "take smaller (load )?steps"
        if instead:
            self.args = (re.sub("[:;] (take|raise) [^;]*", "", str(self)),)
        text = re.sub(f"[:;,] (or )?{smaller}$", "", str(self))
        text = re.sub(f"{smaller},? or (?=raise |give )", "", text)
        self.args = (f"{re.sub(f'{smaller},? or ', 'take ', text)}; {more}",)


class InputError(UEMError, ValueError):
    """Something handed over is out of its range, or not what it is handed over as."""


class InputTypeError(InputError, TypeError):
    """Something handed over is of another type than was expected."""


class UserFunctionError(UEMError, RuntimeError):
    """A function of the user's has raised an error, which is the cause of this one on the rank where it happened."""


class TagError(UEMError, KeyError):
    """A physical group is unknown, empty or of the wrong dimension."""

    __str__ = Exception.__str__


class MeshError(UEMError, ValueError):
    """A mesh cannot be read or made."""


class MissingFileError(MeshError, FileNotFoundError):
    """A file to be read does not exist."""

    __str__ = Exception.__str__


class SpaceError(UEMError, ValueError):
    """The function space, the mesh and the tags do not belong together."""


class SurfaceError(UEMError, ValueError):
    """A contact surface cannot be what it is asked to be."""


class OrientationError(SurfaceError):
    """The outward normal of a target is not defined."""


class PenetrationError(SurfaceError):
    """The initial penetration is larger than the stated bound."""


class ConflictError(UEMError, ValueError):
    """A Dirichlet condition and a uniting equation, or two uniting equations, ask different things of one node."""


class OverdeterminedError(ConflictError):
    """Contacts ask more of some nodes than these and their targets can give: an equation was left out, and is missed at the end."""


class FloatingBodyError(UEMError, RuntimeError):
    """A body moves as a rigid body under its loads, and neither conditions nor contacts can hold it."""


class ThrownBodyError(FloatingBodyError):
    """A body that contact held has left it within a step and gone far, and nothing tells where it would come to rest."""


class MassError(UEMError, ValueError):
    """A mass cannot be what it is asked to be."""


class NotFiniteError(UEMError, ArithmeticError):
    """The residual, the tangent or the increment holds NaN or infinity."""


class PrecisionError(UEMError, ArithmeticError):
    """Rounding of the stiffest parts hides whether the forces are in equilibrium."""


class InvertedElementError(UEMError, ArithmeticError):
    """The displacement turns a cell inside out."""


class EnergyGivenError(UEMError, ArithmeticError):
    """Contacts would give the bodies energy within a time step, however short it is."""


class TunnellingError(UEMError, ArithmeticError):
    """A contactor passes through a target within a step, where no step ends: between two instants, or, in statics, two equilibria."""


class MissingBackendError(UEMError, ImportError):
    """An optional library (gmsh, matplotlib, hypre, MUMPS, ...) was asked for and is not here."""


class LinearSolveError(UEMError, RuntimeError):
    """PETSc reports that the linear solver failed."""


class CheckpointError(UEMError, OSError):
    """A checkpoint cannot be written, or is missing, damaged, or of another run."""

    __str__ = Exception.__str__


class OutputError(UEMError, OSError):
    """Results cannot be written."""

    __str__ = Exception.__str__


class ConvergenceError(UEMError, RuntimeError):
    """The united Newton loop did not converge; the committed state has been restored.

    Attributes:
        history: the iterations made, in order (see ``uem_dolfinx.solve.newton.Iteration``).
    """

    def __init__(self, message: str, history: Sequence[object] = ()):
        super().__init__(message)
        self.history = list(history)


class FrictionError(ConvergenceError):
    """Friction leaves no answer, or more than one: stick and slip do not settle, or a slip runs against its own direction."""
