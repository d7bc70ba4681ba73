"""What objects tell of themselves, what scripts find by names and words, and what logging does.

Read ``test_every_object_has_a_repr`` first.
"""

from __future__ import annotations

import inspect
import subprocess
import sys

from mpi4py import MPI

import numpy as np
import pytest
from helpers import at, blocks, box, linear, outside_mpi, refused, scene, serial

import uem_dolfinx as uem
from uem_dolfinx import compat

from dolfinx import fem  # isort: skip

COMM = MPI.COMM_WORLD


def test_every_object_has_a_repr():
    """Every public class but errors has one of its own, without addresses."""
    for name in uem.__all__:
        one = getattr(uem, name)
        if inspect.isclass(one) and not issubclass(one, Exception):
            assert one.__repr__ is not object.__repr__, name


def test_what_they_tell(folder):
    """Arguments as they were given, as far as they are not the defaults."""
    b = blocks(COMM, "triangle", 2, 2)
    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), gravity=(0.0, -9.81), contactors="massy")
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact], dynamics=dynamics)
    law = uem.VonMises(b.u, 1000.0, 0.3, 5.0, kind="plane_strain")
    with uem.HistoryWriter(folder / "run.csv", problem) as writer:
        for one, words in (
            (uem.Conductance(2.0, field=1), "Conductance(h=2.0, field=1)"),
            (uem.OfTemperature(lambda x, t, T: T, field=1), "OfTemperature(f=a function, field=1)"),
            (uem.PointLoad((0.0, 1.0), (1, 2)), "PointLoad(at=(0.0, 1.0), force=(1, 2))"),
            (uem.PointSpring((0.0, 1.0), 3.0), "PointSpring(at=(0.0, 1.0), stiffness=3.0)"),
            (uem.RigidCoupling((0.0, 0.0), (1.0, 2.0), motion=(0, None, 1.0)), "point=[1.0, 2.0], motion=(0, None, 1.0))"),
            (uem.Equation([((0.0, 0.0), (1, 0))], b=2), ", b=2)"),
            (uem.Checkpoint("out/run.uem", every=3), "Checkpoint(path='out/run.uem', every=3)"),
            (dynamics, "gravity=(0.0, -9.81)"),
            (law, "VonMises(u=a Function, E=1000.0, nu=0.3, yield_stress=5.0, kind='plane_strain')"),
            (writer, "problem=a UnitedProblem)"),
            (uem.RigidPlane((0, 0), (0, 1), name="floor"), "RigidPlane('floor' at (0, 0))"),
        ):
            assert words in repr(one) and " at 0x" not in repr(one)


def test_names():
    """Errors are in a module of their own, and have their old names."""
    assert set(dir(uem)) >= {*uem.__all__, "errors"}
    for name in uem.__all__:
        if inspect.isclass(getattr(uem, name)) and issubclass(getattr(uem, name), Exception):
            assert getattr(uem.errors, name) is getattr(uem, name)


WORDS = {
    uem.Contact: {"coupling": "mortar", "sliding": "small", "normals": "averaged", "measure": "current", "tied": "after"},
    uem.GeneralContact: {"coupling": "mortar", "normals": "averaged", "measure": "current"},
    uem.LinearElastic: {"kind": "plane_strain"},
    uem.VonMises: {"kind": "axisymmetric", "strain": "green_lagrange"},
    uem.RigidCoupling: {"rotations": "small"},
    uem.Dynamics: {"contactors": "massy"},
    uem.Newton: {"method": "modified"},
}


@pytest.mark.parametrize("kind", WORDS, ids=lambda kind: kind.__name__)
def test_words_are_literals(kind):
    """Editors and type checkers know the words that arguments take."""
    for name, word in WORDS[kind].items():
        annotation = str(inspect.signature(kind).parameters[name].annotation)
        assert repr(word) in annotation or annotation == "Kind", (name, annotation)


def test_forces_of_named_surfaces():
    """A block in the corner of two named planes: each has its own force."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [3, 3])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, (top, right) = fem.Function(V), (s.tag("top", 0, at(1, 1.0)), s.tag("right", 0, at(0, 1.0)))
    planes = [uem.RigidPlane((0.0, 0.0), (0.0, 1.0), name="floor"), uem.RigidPlane((0.0, 0.0), (1.0, 0.0), name="wall")]
    contact = uem.GeneralContact(rigid=planes)
    bcs = [uem.dirichlet(V, top, 1, -0.02), uem.dirichlet(V, right, 0, -0.01)]
    problem = uem.UnitedProblem(linear(u, 1.0, nu=0.0), u, bcs=bcs, contacts=[contact])
    problem.solve()
    for name, force in (("floor", (0.0, -0.02)), ("wall", (-0.01, 0.0)), ("wall 2", (-0.01, 0.0))):
        np.testing.assert_allclose(contact.between(name).force, force, atol=1e-12)
    refused(uem.InputError, "first = 'flor'", lambda: contact.between("flor"))


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_forces_of_one_side(coupling):
    """They sum up to the resultant on their body, and together are the force field."""
    b = blocks(COMM, "triangle", 2, 3)
    contact = uem.Contact(b.high, b.low, coupling=coupling)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact])
    problem.solve()
    own = slice(2 * problem.config.n_owned)
    for side in ("contactor", "target"):
        total = COMM.allreduce(contact.force_on(side).x.array[own].reshape(-1, 2).sum(axis=0))
        np.testing.assert_allclose(total, contact.resultant(on=side).force, rtol=1e-12, atol=1e-14)
    both = contact.force_on("contactor").x.array + contact.force_on("target").x.array
    np.testing.assert_allclose(both, contact.force.x.array, atol=1e-15)
    refused(uem.InputError, "side = 'both'", lambda: contact.force_on("both"))


LOGGING = """
from mpi4py import MPI
from dolfinx import fem
import uem_dolfinx as uem
import logging
logging.basicConfig(level="INFO", format="<%(name)s> %(message)s")
logging.getLogger("uem_dolfinx").info("seen")
logging.getLogger("uem_dolfinx").debug("not seen")
"""
BEFORE = "import logging\nlogging.basicConfig(level='INFO', format='<%(name)s> %(message)s')\n"


def said(script):
    """Lines of a script on its standard error, without those of MPI's library about the machine."""
    done = subprocess.run([sys.executable, "-c", script], env=outside_mpi(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stderr.splitlines() if not line.startswith("hwloc")]


@pytest.mark.slow
@serial
def test_basic_config_of_logging():
    """It has an effect after the import, too, which FFCx 0.5 had prevented; a set-up of the script's own before it is kept."""
    for script in (LOGGING, BEFORE + LOGGING.replace("logging.basicConfig", "# ")):
        assert said(script) == ["<uem_dolfinx> seen"]
    script = LOGGING.partition("logging.basicConfig")[0] + "logging.getLogger('uem_dolfinx').warning('seen')"
    (line,) = said(script)
    assert line.endswith("seen")
