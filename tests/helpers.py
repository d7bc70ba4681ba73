"""What tests assert in common, and the scenes of boxes and blocks that most do it on."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from benchmarks.scenes import CELLS, NU, Array, Body, Ints, Scene, at, box, clamp, oedometric, rotation, scene
from block_scenes import Blocks, arch, blocks, linear, modulus, run, st_venant
from common import outside_mpi
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.solve.bodies.tangent import curvature_of

MESHES = Path(__file__).resolve().parents[1] / "meshes"
#: Oedometric modulus over Young's modulus.
M = oedometric()
serial = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes without this one's MPI")


def slow(*values: object) -> Any:
    """Values of a test that is among the slow ones."""
    return pytest.param(*values, marks=pytest.mark.slow)


def raised(error: type[Exception], match: str, call: Callable[[], object]) -> Exception:
    """The same error on all ranks, of this class and of no other of the package's, with a message that matches (collective)."""
    with pytest.raises(error, match=match or None) as caught:
        call()
    assert caught.type is error or not issubclass(error, uem.UEMError)
    assert len(set(MPI.COMM_WORLD.allgather(f"{type(caught.value).__name__}: {caught.value}"))) == 1
    return caught.value


def refused(error: type[Exception], words: str | Iterable[str], call: Callable[[], object]) -> Exception:
    """Likewise, a UEMError with all these words in its message (collective)."""
    found = raised(error, "", call)
    assert isinstance(found, uem.UEMError)
    for text in (words,) if isinstance(words, str) else words:
        assert text in str(found)
    return found


def gathered_matrix(A: PETSc.Mat) -> Array:
    """A distributed matrix as a dense one on every rank (collective)."""
    indptr, columns, values = A.getValuesCSR()
    first, _ = A.getOwnershipRange()
    rows = first + np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    dense = np.zeros(A.getSize())
    for r, c, v in A.comm.tompi4py().allgather((rows, columns, values)):
        np.add.at(dense, (r, c), v)
    return dense


def gathered_vector(x: PETSc.Vec) -> Array:
    """A distributed vector on every rank (collective)."""
    return np.concatenate(x.comm.tompi4py().allgather(np.array(x.array_r)))


def scattered(values: Array, like: PETSc.Vec) -> PETSc.Vec:
    """The distributed vector with these global values."""
    x = like.duplicate()
    x.array[:] = values[slice(*x.getOwnershipRange())]
    return x


def complementary(contact: uem.Contact, length: float, force: float) -> None:
    """Assert ``lambda >= 0, gap >= 0, lambda gap = 0`` at every contactor (collective, alike on all ranks).

    Args:
        contact: after a converged step.
        length: gaps below it are rounding.
        force: nodal forces below it are rounding.
    """
    pair, comm = contact.pair, contact.config.comm
    lam, gap, active = pair.trial.lam, pair.kinematics.gap, pair.trial.active
    assert lowest(comm, lam) >= -force
    assert lowest(comm, gap[~pair.off]) >= -length
    assert highest(comm, np.abs(lam[~active])) <= 0.0
    assert highest(comm, np.abs(gap[active])) <= length


def coulomb(pair: Interface, length: float, force: float) -> None:
    """Assert Coulomb's law: friction in its cone, no motion where contactors stick, friction against it where they slip (collective).

    Args:
        pair: after a converged step that is not yet committed.
        length: relative motions below it are rounding.
        force: nodal forces below it are rounding.
    """
    comm, trial, friction = pair.config.comm, pair.trial, pair.trial.friction
    assert friction is not None and pair.friction is not None
    along = pair.friction
    tau, slip, s = along.frame.tangential(friction.tau), along.frame.slip, along.directions(trial)
    bound, slipping = along.bound(trial), along.slipping(trial)
    stuck = along.active(trial) & friction.stick
    assert highest(comm, (np.linalg.norm(tau, axis=1) - bound)[~trial.in_corner]) <= force
    assert highest(comm, np.linalg.norm(slip[stuck], axis=1)) <= length
    assert highest(comm, np.linalg.norm(tau + bound[:, None] * s, axis=1)[slipping]) <= force
    # one without a direction would slip without friction
    assert highest(comm, (bound - np.linalg.norm(tau, axis=1))[slipping & ~trial.in_corner]) <= force
    forward = np.einsum("ng,ng->n", slip, s)
    assert lowest(comm, forward[slipping]) >= -length
    sideways = np.linalg.norm(slip - forward[:, None] * s, axis=1)
    # a direction that comes from forces is as good as they are
    assert highest(comm, sideways[slipping]) <= 1e-6 * highest(comm, np.abs(forward[slipping])) + 1e3 * length


def lawful(contact: uem.Contact, size: float = 1.0, force: float = 1.0) -> None:
    """Assert complementarity, pressures that do not pull, and action = reaction in force and moment (collective).

    Args:
        contact: after a converged step.
        size: length of the scene.
        force: of the order of the nodal forces.
    """
    comm, trial = contact.config.comm, contact.pair.trial
    complementary(contact, 1e-12 * size, 1e-10 * force)
    assert lowest(comm, contact.pressures) >= -1e-10 * force
    # control forces of degree 2 add up to the nodal ones; forces of the facets of a corner to more than along their mean normal
    control, nodal = (float(comm.allreduce(values[~trial.in_corner].sum())) for values in (trial.lam, trial.nodal))
    assert control == pytest.approx(nodal, rel=1e-9, abs=1e-12 * force)
    assert highest(comm, (trial.nodal - trial.lam)[trial.in_corner]) <= 1e-10 * force
    balance = contact.balance()
    if balance is not None:
        assert balance.force <= 1e-12
        there, back = contact.resultant(), contact.resultant(on="target")
        largest = force + np.abs(there.force).max()
        assert np.abs(there.force + back.force).max() <= 1e-14 * largest
        # where the foot stays behind, the forces of a pair lie on two lines
        if contact.sliding == "finite":
            assert balance.moment <= 1e-11
            assert np.abs(there.moment + back.moment).max() <= 1e-11 * largest * size


def factors(history: Iterable[Any]) -> list[float]:
    """``r1 / r0^2`` of all neighbours among the residuals with one and the same active set: bounded when Newton is quadratic."""
    steps = list(history)
    r, steady = [i.residual for i in steps], [not i.changed for i in steps]
    pairs = [(a, b) for a, b, s in zip(r[:-1], r[1:], steady[1:]) if s and a < 0.1 and b > 1e-9]
    return [b / a**2 for a, b in pairs]


def lowest(comm: MPI.Comm, values: npt.ArrayLike) -> float:
    """Smallest value over all ranks (collective); an assertion must not fail on one rank only."""
    return float(min(comm.allgather(np.min(np.asarray(values, dtype=float), initial=np.inf))))


def highest(comm: MPI.Comm, values: npt.ArrayLike) -> float:
    """Largest value over all ranks; NaN anywhere makes it NaN, -inf stands for no value (collective)."""
    return float(np.max(comm.allgather(np.max(np.asarray(values, dtype=float), initial=-np.inf))))


def tangent_by_differences(problem: uem.UnitedProblem, contact: uem.Contact) -> tuple[PETSc.Vec, PETSc.Vec, PETSc.Vec]:
    """Change of ``F - sum lambda grad g`` along a smooth direction, all contactors active and contact forces held (collective).

    Returns:
        By differences, by ``K - sum lambda grad^2 g``, and by K alone.
    """
    system, pair, g, comm = problem.system, contact.pair, problem.config.gdim, problem.comm
    x = problem.config.X
    smooth = np.stack([0.05 * np.sin(2 * x[:, i] + i) * np.cos(x[:, (i + 1) % g]) for i in range(g)], axis=1)
    direction = np.stack([np.cos(3 * x[:, i] + 2 * i) + 0.3 * x[:, (i + 1) % g] for i in range(g)], axis=1)
    lam = 0.3 + 0.2 * np.sin(5 * x[pair.nodes].sum(axis=1))
    pair.trial = replace(pair.trial, active=np.ones(len(lam), bool), lam=lam, nodal=lam)

    def residual(u: Array) -> PETSc.Vec:
        problem.u.x.array[:] = u.ravel()
        system.place()
        problem.bodies.assemble()
        pair.trial = replace(pair.trial, force=lam[:, None] * pair.kinematics.projection.normal)
        r = problem.bodies.residual
        r.axpy(-1.0, compat.petsc_vector(contact.force))
        return r

    residual(smooth)
    facets = pair.kinematics.projection.facet.copy()
    A = problem.bodies.update_tangent().copy()
    apart = system._petrov_galerkin or pair.target.averaged
    curvature = curvature_of(system.pairs, system.config.vector(), apart, False)
    assert curvature is not None
    du = A.createVecRight()
    du.array[:] = direction[: problem.config.n_owned].ravel()
    plain = A * du
    full = plain + curvature * du
    h = 1e-5
    ahead = residual(smooth + h * direction)
    assert highest(comm, np.abs(pair.kinematics.projection.facet - facets)) == 0
    difference = ahead - residual(smooth - h * direction)
    difference.scale(0.5 / h)
    return difference, full, plain


def environment(**more: str) -> dict[str, str]:
    """For a process without this one's MPI, with this checkout of the package, its demos and its tests."""
    kept, here = outside_mpi(), Path(__file__).resolve().parents[1]
    paths = [here, here / "demos", here / "tests", here / "tests" / "scenes", *filter(None, [kept.get("PYTHONPATH")])]
    return kept | {"PYTHONPATH": os.pathsep.join(map(str, paths))} | more


def start_process(script: str) -> subprocess.Popen[str]:
    """A Python process of its own that runs a script, without this one's MPI."""
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=environment())
