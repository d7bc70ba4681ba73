"""Errors that the package raises on purpose, by name."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


class UEMError(Exception):
    """Root of every error this package raises on purpose."""

    def amend(self, more: str, instead: bool = False) -> None:
        """Append to the message, or replace all advice (``instead``), and remove the advice of smaller steps, which do not help."""
        smaller = "take smaller (load )?steps"
        if instead:
            self.args = (re.sub("[:;] (take|raise) [^;]*", "", str(self)),)
        text = re.sub(f"[:;,] (or )?{smaller}$", "", str(self))
        text = re.sub(f"{smaller},? or (?=raise |give )", "", text)
        self.args = (f"{re.sub(f'{smaller},? or ', 'take ', text)}; {more}",)


class InputError(UEMError, ValueError):
    """An argument is out of range or inconsistent."""


class InputTypeError(InputError, TypeError):
    """An argument has another type than expected."""


class UserFunctionError(UEMError, RuntimeError):
    """A function of the user has raised an error, which is the ``__cause__`` of this one on the rank where it happened."""


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
    """A contact surface is unsuitable for its use."""


class OrientationError(SurfaceError):
    """The outward normal of a target is not defined."""


class PenetrationError(SurfaceError):
    """The initial penetration is larger than the stated bound."""


class ConflictError(UEMError, ValueError):
    """A Dirichlet condition and a uniting equation, or two uniting equations, require different displacements of one node."""


class OverdeterminedError(ConflictError):
    """Contacts have more conditions at a node than can be satisfied: an equation was left out, and is violated at the end."""


class FloatingBodyError(UEMError, RuntimeError):
    """A body has an unrestrained rigid-body motion: neither conditions nor contacts can restrain it."""


class ThrownBodyError(FloatingBodyError):
    """A body held by contact has lost contact within a step and moved far, so that its position of rest is undetermined."""


class StepAccuracyError(UEMError, RuntimeError):
    """The error of a time step or load step exceeds the tolerance."""


class MassError(UEMError, ValueError):
    """A mass is unsuitable for its use."""


class NotFiniteError(UEMError, ArithmeticError):
    """The residual, the tangent or the increment holds NaN or infinity."""


class PrecisionError(UEMError, ArithmeticError):
    """Rounding errors of the stiffest parts exceed the tolerance of the residual."""


class InvertedElementError(UEMError, ArithmeticError):
    """The displacement inverts a cell."""


class EnergyGivenError(UEMError, ArithmeticError):
    """Contacts add energy to the bodies even in the shortest time step."""


class TunnellingError(UEMError, ArithmeticError):
    """A contactor passes through a target within a step: between two instants, or, in statics, two equilibria."""


class MissingBackendError(UEMError, ImportError):
    """An optional library (gmsh, matplotlib, hypre, MUMPS, ...) is required and not installed."""


class LinearSolveError(UEMError, RuntimeError):
    """PETSc reports that the linear solver failed."""


class CheckpointError(UEMError, OSError):
    """A checkpoint cannot be written, or is missing, damaged, or of another run."""

    __str__ = Exception.__str__


class OutputError(UEMError, OSError):
    """Results cannot be written, or cannot be read."""

    __str__ = Exception.__str__


class ConvergenceError(UEMError, RuntimeError):
    """The united Newton loop did not converge; the committed state has been restored.

    Attributes:
        history: the iterations made, in order (see ``uem_dolfinx.solve.united.newton.Iteration``).
    """

    def __init__(self, message: str, history: Sequence[object] = ()):
        super().__init__(message)
        self.history = list(history)


class FrictionError(ConvergenceError):
    """With friction there is no solution, or more than one: stick and slip do not converge, or slip reverses its direction."""
