"""Contact for FEniCSx by the United Elements Method: exact constraints, no multipliers, no penalty.

du = P dq + c,    P'KP dq = P'(r - K c)
"""

from __future__ import annotations

from uem_dolfinx import compat as _compat
from uem_dolfinx.contact import Balance, Contact, Resultant
from uem_dolfinx.errors import (
    ConflictError,
    ConvergenceError,
    FloatingBodyError,
    InvertedElementError,
    LinearSolveError,
    MeshError,
    MissingBackendError,
    MissingFileError,
    NotFiniteError,
    OrientationError,
    PenetrationError,
    SpaceError,
    SurfaceError,
    TagError,
    UEMError,
)
from uem_dolfinx.materials import LinearElastic, NeoHooke, StVenantKirchhoff
from uem_dolfinx.mesh import Tag, read_gmsh
from uem_dolfinx.problem import LoadStep, UnitedProblem, load_steps
from uem_dolfinx.results import HistoryWriter, ResultsWriter, figure, plot_pressure, plot_scene
from uem_dolfinx.rigid import RigidCylinder, RigidParaboloid, RigidPlane, RigidSphere, RigidSurface
