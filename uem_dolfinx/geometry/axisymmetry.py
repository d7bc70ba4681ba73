"""Bodies of revolution: a mesh of half of a plane through the axis, whose coordinates are the radius r = x and the height z = y.

Integrals run over the whole bodies and their surfaces: integrands are multiplied by ``2 pi r``. Nodes represent circles, and nodal forces
and masses belong to whole circles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakValueDictionary

from mpi4py import MPI

import numpy as np
import ufl
from ufl.core.expr import Expr

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError, MeshError
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR
from uem_dolfinx.parallel import agree, reduced

#: UFL domains of the meshes that have been declared, by their numbers: their hashes may change.
_DECLARED: WeakValueDictionary[int, Any] = WeakValueDictionary()
#: Those of plane meshes that masses or problems have been made of.
_PLANE: WeakValueDictionary[int, Any] = WeakValueDictionary()


def axisymmetric(mesh: Any) -> Any:
    """Declare that a mesh is half of a plane through the axis of bodies of revolution: x is the radius, y the height (collective).

    Call it before the mesh is used. Laws on the mesh have ``kind="axisymmetric"``. Forms are written as in the plane, per volume and per
    area; the package multiplies them by ``2 pi r``, both forms of its laws and forms of users.

    Args:
        mesh: 2D, with no node at a negative x. The axis is no surface: prescribe a radial displacement of 0 on it.

    Returns:
        The mesh.

    Raises:
        InputTypeError: for other objects.
        MeshError: if the mesh is not plane, has nodes beyond the axis, or has a mass or a problem already.
    """
    given.kind("mesh", mesh, _is_mesh(mesh), "a mesh, as read_gmsh returns it")
    gdim, tdim = mesh.geometry.dim, mesh.topology.dim
    if mesh.ufl_domain().ufl_id() in _PLANE:
        raise MeshError(
            "a mesh of which a plane mass or problem has been made is to be axisymmetric: expected uem.axisymmetric(mesh) before; call it "
            "right after the mesh is made, or make another mesh"
        )
    if (gdim, tdim) != (2, 2):
        raise MeshError(f"an axisymmetric mesh of dimension {tdim} in {gdim}D: expected a plane one, whose x is the radius")
    x = mesh.geometry.x[:, :2]
    beyond, error = np.flatnonzero(x[:, 0] < -EQUALLY_NEAR * _extent(mesh)), None
    if len(beyond):
        at = x[beyond[0]]
        error = MeshError(
            f"an axisymmetric mesh has a node at ({at[0]:.6g}, {at[1]:.6g}), beyond the axis: expected x >= 0, since x is the radius; "
            "mesh one half of the plane"
        )
    agree(mesh.comm, error)
    domain = mesh.ufl_domain()
    _DECLARED[domain.ufl_id()] = domain
    return mesh


def is_axisymmetric(part: Any) -> bool:
    """Whether a mesh, or the one of a UFL expression or form, has been declared axisymmetric."""
    if not _DECLARED:
        return False
    domains = [part.ufl_domain()] if _is_mesh(part) else ufl.domain.extract_domains(part)
    return any(domain.ufl_id() in _DECLARED for domain in domains)


def taken_as_axisymmetric(mesh: Any) -> bool:
    """As ``is_axisymmetric``, for a mass or a problem: a mesh that is plane then stays so."""
    found, domain = is_axisymmetric(mesh), mesh.ufl_domain()
    if not found:
        _PLANE[domain.ufl_id()] = domain
    return found


def revolved(form: ufl.Form) -> ufl.Form:
    """A form integrated over bodies of revolution: times ``2 pi r`` if its mesh is axisymmetric, else itself."""
    if not _DECLARED:
        return form
    integrals = []
    for one in form.integrals():
        if one.ufl_domain().ufl_id() in _DECLARED:
            one = one.reconstruct(integrand=circumference(one.ufl_domain()) * one.integrand())
        integrals.append(one)
    return ufl.Form(integrals)


def circumference(domain: Any, u: Any = None) -> Any:
    """``2 pi r`` in UFL, with the reference radius, or the current radius for a displacement."""
    r = ufl.SpatialCoordinate(domain)[0]
    return 2 * np.pi * (r if u is None else r + u[0])


def displacement_gradient(u: Any) -> Any:
    """Gradient of a displacement or its variation: ``grad(u)``, or ``(3, 3)`` with the hoop strain ``u_r / r`` last in axisymmetry.

    ``I + displacement_gradient(u)`` is the deformation gradient F, with ``F_33 = 1 + u_r / r``. On the axis, which contains nodes but no
    quadrature points, the hoop strain equals the radial strain.

    Raises:
        InputTypeError: if ``u`` is no UFL expression of a mesh.
        InputError: if ``u`` is no vector with a component for each dimension of the mesh.
    """
    expected, domains = "a displacement or its variation, as a Function or a TestFunction", []
    if isinstance(u, Expr):
        domains = list(ufl.domain.extract_domains(u))
    given.kind("u", u, bool(domains), expected)
    if u.ufl_shape != (shape := ufl.SpatialCoordinate(domains[0]).ufl_shape):
        raise InputError(
            f"u has the shape {u.ufl_shape}: expected {expected}, of {shape}; among other fields take its part of ufl.split(u)"
        )
    G = ufl.grad(u)
    if not is_axisymmetric(u):
        return G
    r = ufl.SpatialCoordinate(domains[0])[0]
    hoop = ufl.conditional(ufl.gt(r, 0.0), u[0] / r, G[0, 0])
    return ufl.as_tensor([[G[0, 0], G[0, 1], 0], [G[1, 0], G[1, 1], 0], [0, 0, hoop]])


def centre_of_mass(domain: Any) -> Any:
    """Vector ``(2,)`` in UFL from the middle of quadrilaterals to the position where linear functions equal their means over circles."""
    J = ufl.Jacobian(domain)
    return ufl.dot(J, J.T)[0, :] / (12 * ufl.SpatialCoordinate(domain)[0])


def on_axis(mesh: Any) -> Callable[[Array], Bools]:
    """Which of the points ``(gdim, n)`` of an axisymmetric mesh lie on the axis ``(n,)``, as a function (collective)."""
    rounding = EQUALLY_NEAR * _extent(mesh)
    return lambda x: np.abs(x[0]) <= rounding


def _is_mesh(part: Any) -> bool:
    return hasattr(part, "geometry") and hasattr(part, "topology")


def _extent(mesh: Any) -> float:
    """Largest coordinate of a mesh."""
    return float(reduced(mesh.comm, float(np.abs(mesh.geometry.x).max(initial=0.0)), op=MPI.MAX))
