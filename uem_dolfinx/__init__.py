"""Contact for FEniCSx by the United Elements Method: exact constraints by elimination, no multipliers, no penalty.

    mesh, tags = uem.read_gmsh("meshes/hertz_cylinder.geo", MPI.COMM_WORLD, gdim=2)
    V = uem.function_space(mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1e6, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["block_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["disc_top"], 1, -0.006)]
    contact = uem.Contact(contactor=tags["disc_arc"], target=tags["block_top"])
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    for step in uem.load_steps(problem, 5):
        print(step, contact.resultant().force)

``help(uem.Contact)`` and ``help(uem.UnitedProblem)`` describe the model, ``help(uem.load_steps)`` and ``help(uem.time_steps)`` its
solution, ``help(uem.ResultsWriter)`` and ``help(uem.plot_scene)`` the output.

    du = P dq + c,    P'KP dq = P'(r - K c)

The steps of [UEM, 4], repeated until equilibrium and contact conditions hold, and their modules:

1. Unite: the normal displacement of each active contactor follows the target: ``contact.nodes.node_to_surface`` and
   ``contact.nodes.bernstein``, or ``contact.mortar.placement``, write the equations, ``algebra.restriction`` builds P and c from them.
2. Solve the constrained system (``algebra.linear_solver``); once forces are in equilibrium, return each contactor along the normal onto
   the moved target (``contact.pair.interface``, with projections from ``geometry``).
3. Transfer the contactor's normal force to the target: ``P'r`` in ``solve.united.system``.
4. Activate penetrating contactors, release contactors in tension (``contact.seam.active_set``), iterate (``solve.united.newton``).

[UEM]: K. Farahani, M. Mofid, A. Vafai: United elements method for general contact-impact problems. Computer Methods in Applied
Mechanics and Engineering 191 (2001) 843-860.
"""

from __future__ import annotations

from typing import TYPE_CHECKING as _TYPE_CHECKING

__version__ = "0.2.0"

__all__ = [
    "Adaptation", "Adhesion", "Balance", "Ball", "BenzeggaghKenane", "CentralDifferences", "Checkpoint", "CheckpointError", "Cohesive",
    "Conductance", "ConflictError", "Contact", "ContactParameter", "ConvergenceError", "Coulomb", "Deck", "Dissipation", "Dynamics",
    "Elastic", "Energies", "EnergyBook", "EnergyGivenError", "Equation", "ErrorEstimate", "ErrorLimit", "Exponential", "FinitePlasticity",
    "FloatingBodyError", "FrictionError", "GeneralContact", "GoalError", "Hinge", "History", "HistoryWriter", "InputError",
    "InputTypeError", "InvertedElementError", "Leak", "LinearElastic", "LinearSolveError", "LoadStep", "Mass", "MassError", "MeanMotion",
    "MeshError", "MissingBackendError", "MissingFileError", "NeoHooke", "Newton", "NotFiniteError", "OfTemperature", "OrientationError",
    "OutputError", "OverdeterminedError", "PenetrationError", "PointLoad", "PointSpring", "Power", "PowerLaw", "PrecisionError", "Preload",
    "Resultant", "Results", "ResultsWriter", "RigidCoupling", "RigidCylinder", "RigidParaboloid", "RigidPlane", "RigidSphere",
    "RigidSurface", "Scheme", "Slider", "SoftContact", "SpaceError", "Spring", "StVenantKirchhoff", "State", "Step", "StepAccuracyError",
    "Stribeck", "SurfaceError", "SurfaceWriter", "Tag", "TagError", "Tags", "Thirion", "ThrownBodyError", "TimeStep", "Tresca",
    "TunnellingError", "UEMError", "UnitedProblem", "UserFunctionError", "Vibrations", "ViscousFriction", "Voce", "VonMises", "adapt",
    "animate", "assemble_matrix", "assemble_vector", "axisymmetric", "consistent_mass", "dirichlet", "displacement_gradient", "ds", "dx",
    "error_estimate", "errors", "example_mesh", "figure", "form", "function_space", "generalised_alpha", "goal_error", "gradient",
    "integrate", "interpolate", "load_steps", "lumped_mass", "modes", "multigrid_options", "newmark", "nodal_mass", "outline", "periodic",
    "plot_energies", "plot_history", "plot_pressure", "plot_scene", "plot_setup", "read_checkpoint", "read_deck", "read_gmsh", "read_mesh",
    "read_results", "recording", "saddle_options", "tangent", "taylor_test", "time_steps", "timing", "timings", "write_checkpoint",
]  # fmt: skip

try:
    from mpi4py import MPI as _MPI  # noqa: F401  first: in the PyPI wheel it loads the MPI library that DOLFINx and petsc4py need

    # Ctrl-C to one rank ends all while the rest is imported
    import uem_dolfinx.parallel as _parallel  # noqa: F401  # isort: skip
    import dolfinx as _dolfinx  # noqa: F401
except ImportError as _error:
    from uem_dolfinx.errors import MissingBackendError

    raise MissingBackendError(
        f"uem_dolfinx needs mpi4py and DOLFINx ({_error}): python3-dolfinx-real for Debian's /usr/bin/python3, or 'uem_dolfinx[wheel]'"
    ) from _error

from uem_dolfinx import errors
from uem_dolfinx.algebra.options import multigrid_options, saddle_options
from uem_dolfinx.compat import function_space
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.coulomb import Coulomb, Tresca
from uem_dolfinx.contact.results import Balance, Resultant
from uem_dolfinx.errors import (
    CheckpointError,
    ConflictError,
    ConvergenceError,
    EnergyGivenError,
    FloatingBodyError,
    FrictionError,
    InputError,
    InputTypeError,
    InvertedElementError,
    LinearSolveError,
    MassError,
    MeshError,
    MissingBackendError,
    MissingFileError,
    NotFiniteError,
    OrientationError,
    OutputError,
    OverdeterminedError,
    PenetrationError,
    PrecisionError,
    SpaceError,
    StepAccuracyError,
    SurfaceError,
    TagError,
    ThrownBodyError,
    TunnellingError,
    UEMError,
    UserFunctionError,
)
from uem_dolfinx.geometry.axisymmetry import axisymmetric, displacement_gradient
from uem_dolfinx.geometry.rigid import RigidCylinder, RigidParaboloid, RigidPlane, RigidSphere, RigidSurface
from uem_dolfinx.geometry.tags import Tag, Tags
from uem_dolfinx.log import timing, timings
from uem_dolfinx.materials.elastic import Elastic, LinearElastic, NeoHooke, StVenantKirchhoff
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep
from uem_dolfinx.solve.steps.load_steps import load_steps

if _TYPE_CHECKING:
    from uem_dolfinx.accuracy.adapt import Adaptation, adapt
    from uem_dolfinx.accuracy.estimate import ErrorEstimate, ErrorLimit, error_estimate
    from uem_dolfinx.accuracy.goal import GoalError, goal_error
    from uem_dolfinx.conditions.at_points import PointLoad, PointSpring
    from uem_dolfinx.conditions.equation import Equation, MeanMotion, periodic
    from uem_dolfinx.conditions.joints import Ball, Hinge, Slider, Spring
    from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
    from uem_dolfinx.contact.general.general import GeneralContact
    from uem_dolfinx.contact.laws.cohesive import BenzeggaghKenane, Cohesive, Power
    from uem_dolfinx.contact.laws.conductance import Conductance
    from uem_dolfinx.contact.laws.law import OfTemperature
    from uem_dolfinx.contact.laws.leak import Leak
    from uem_dolfinx.contact.laws.soft import Adhesion, Exponential, PowerLaw, SoftContact
    from uem_dolfinx.contact.laws.stribeck import Stribeck, Thirion, ViscousFriction
    from uem_dolfinx.contact.preload import Preload
    from uem_dolfinx.decks.deck import Deck
    from uem_dolfinx.decks.reading import read_deck
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.dynamics.mass import Mass, consistent_mass, lumped_mass, nodal_mass
    from uem_dolfinx.dynamics.scheme import CentralDifferences, Scheme, generalised_alpha, newmark
    from uem_dolfinx.geometry.gmsh import example_mesh, read_gmsh
    from uem_dolfinx.geometry.mesh_files import read_mesh
    from uem_dolfinx.gradients.gradient import gradient, tangent, taylor_test
    from uem_dolfinx.gradients.history import History
    from uem_dolfinx.gradients.parameters import ContactParameter
    from uem_dolfinx.gradients.recording import recording
    from uem_dolfinx.materials.finite_plasticity import FinitePlasticity
    from uem_dolfinx.materials.hardening import Voce
    from uem_dolfinx.materials.von_mises import VonMises
    from uem_dolfinx.output.curves import plot_energies, plot_history
    from uem_dolfinx.output.energy import Energies, EnergyBook
    from uem_dolfinx.output.films import animate
    from uem_dolfinx.output.frames import outline
    from uem_dolfinx.output.pictures import figure, plot_pressure, plot_scene, plot_setup
    from uem_dolfinx.output.reading import Results, read_results
    from uem_dolfinx.output.results import HistoryWriter, ResultsWriter
    from uem_dolfinx.output.surfaces import SurfaceWriter
    from uem_dolfinx.restart.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
    from uem_dolfinx.restart.state import State
    from uem_dolfinx.scripting import assemble_matrix, assemble_vector, dirichlet, ds, dx, form, integrate, interpolate
    from uem_dolfinx.solve.modes import Vibrations, modes
    from uem_dolfinx.solve.settings import Newton
    from uem_dolfinx.solve.stepping import TimeStep
    from uem_dolfinx.solve.steps.dissipation import Dissipation
    from uem_dolfinx.solve.steps.stages import Step
    from uem_dolfinx.solve.steps.time_steps import time_steps

#: Names whose modules are imported on first use of one of them.
_LATER = {
    name: module
    for module, names in {
        "accuracy.adapt": "Adaptation adapt", "accuracy.estimate": "ErrorEstimate error_estimate ErrorLimit",
        "accuracy.goal": "GoalError goal_error", "conditions.at_points": "PointLoad PointSpring",
        "conditions.equation": "Equation periodic MeanMotion", "conditions.joints": "Ball Hinge Slider Spring",
        "conditions.rigid_coupling": "RigidCoupling", "contact.general.general": "GeneralContact",
        "contact.laws.cohesive": "Cohesive BenzeggaghKenane Power", "contact.laws.conductance": "Conductance",
        "contact.laws.law": "OfTemperature", "contact.laws.leak": "Leak",
        "contact.laws.soft": "SoftContact Exponential PowerLaw Adhesion", "contact.laws.stribeck": "Stribeck Thirion ViscousFriction",
        "contact.preload": "Preload", "decks.deck": "Deck", "decks.reading": "read_deck", "dynamics.inertia": "Dynamics",
        "dynamics.mass": "Mass consistent_mass lumped_mass nodal_mass",
        "dynamics.scheme": "CentralDifferences Scheme generalised_alpha newmark", "geometry.gmsh": "example_mesh read_gmsh",
        "geometry.mesh_files": "read_mesh", "gradients.gradient": "gradient tangent taylor_test", "gradients.history": "History",
        "gradients.parameters": "ContactParameter", "gradients.recording": "recording", "materials.finite_plasticity": "FinitePlasticity",
        "materials.hardening": "Voce", "materials.von_mises": "VonMises", "output.curves": "plot_energies plot_history",
        "output.energy": "Energies EnergyBook", "output.films": "animate", "output.frames": "outline",
        "output.pictures": "figure plot_pressure plot_scene plot_setup", "output.reading": "Results read_results",
        "output.results": "HistoryWriter ResultsWriter", "output.surfaces": "SurfaceWriter",
        "restart.checkpoint": "Checkpoint read_checkpoint write_checkpoint", "restart.state": "State",
        "scripting": "assemble_matrix assemble_vector form dirichlet ds dx integrate interpolate", "solve.modes": "Vibrations modes",
        "solve.settings": "Newton", "solve.stepping": "TimeStep", "solve.steps.dissipation": "Dissipation",
        "solve.steps.stages": "Step", "solve.steps.time_steps": "time_steps",
    }.items()
    for name in names.split()
}  # fmt: skip


def __dir__() -> list[str]:
    """The public names, whether their modules have been imported or not."""
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])


def __getattr__(name: str) -> object:
    """A public name of a module that has not been imported yet."""
    if name not in _LATER:
        raise AttributeError(f"module 'uem_dolfinx' has no attribute '{name}'")
    from importlib import import_module

    found = globals()[name] = getattr(import_module(f"uem_dolfinx.{_LATER[name]}"), name)
    return found
