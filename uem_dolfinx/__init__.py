"""Contact for FEniCSx by the United Elements Method: exact constraints, no multipliers, no penalty.

du = P dq + c,    P'KP dq = P'(r - K c)
"""

from __future__ import annotations

from uem_dolfinx import compat as _compat
from uem_dolfinx.contact.contact import Balance, Contact, Resultant
from uem_dolfinx.dynamics.inertia import Dynamics
from uem_dolfinx.dynamics.mass import Mass, consistent_mass, lumped_mass, nodal_mass
from uem_dolfinx.dynamics.scheme import Scheme, generalised_alpha, newmark
from uem_dolfinx.errors import (
    CheckpointError,
    ConflictError,
    ConvergenceError,
    FloatingBodyError,
    InvertedElementError,
    LinearSolveError,
    MassError,
    MeshError,
    MissingBackendError,
    MissingFileError,
    NotFiniteError,
    OrientationError,
    PenetrationError,
    SpaceError,
    SurfaceError,
    TagError,
    TunnellingError,
    UEMError,
)
from uem_dolfinx.geometry.gmsh import read_gmsh
from uem_dolfinx.geometry.rigid import RigidCylinder, RigidParaboloid, RigidPlane, RigidSphere, RigidSurface
from uem_dolfinx.geometry.tags import Tag, Tags
from uem_dolfinx.materials.elastic import LinearElastic, NeoHooke, StVenantKirchhoff
from uem_dolfinx.materials.von_mises import VonMises
from uem_dolfinx.output.energy import Energies, EnergyBook
from uem_dolfinx.output.pictures import figure, outline, plot_pressure, plot_scene
from uem_dolfinx.output.results import HistoryWriter, ResultsWriter
from uem_dolfinx.restart.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from uem_dolfinx.restart.state import State
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps import LoadStep, TimeStep, load_steps, time_steps
