"""Declarations of a problem in the reference configuration, gathered to rank 0 for a sketch: bodies, contacts, conditions, loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.places import is_point, nodes_at
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.geometry.rigid import Motion, RigidSurface
from uem_dolfinx.geometry.tags import Part, as_tag, name_of
from uem_dolfinx.output.acting import Acting, Actions, Outside, loaded, loads_of
from uem_dolfinx.output.frames import Shape, vertex_cells
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


@dataclass(frozen=True)
class Surface:
    """One side of a contact, tie or other declaration of surfaces, on rank 0."""

    name: str  # label in the legend
    side: str  # ``"contactor"``, also for other following surfaces; or ``"target"``, also for other followed surfaces
    pair: int  # number of the declaration, the same for both sides
    corners: Array  # vertices around each facet ``(m, k, gdim)``
    normals: Array  # outward unit normals of the facets ``(m, gdim)``
    points: Array  # nodes, for parts without facets ``(n, gdim)``
    layer: int  # number of earlier surfaces on the same part of the mesh


@dataclass(frozen=True)
class Rigid:
    """A rigid target, on rank 0."""

    name: str  # label in the legend
    pair: int  # as in ``Surface``
    shape: Shape  # with its position
    at: Array  # its point nearest to the contactors' middle ``(gdim,)``
    way: Array  # displacement of this point by the loads ``(gdim,)``


@dataclass(frozen=True)
class Declared:
    """All declarations, on rank 0.

    Attributes:
        surfaces, rigid, acting: declarations of surfaces, rigid targets and points.
    """

    cells: Array  # vertices around each cell in 2D, or around each surface facet in 3D ``(n, k, gdim)``
    body: Ints  # of each of these ``(n,)``, counted in the order of the mesh's input
    outside: Array  # surface facets ``(m, k, gdim)``
    #: facets that are held in all components ``(m, k, gdim)``, and their outward normals ``(m, gdim)``.
    clamped: tuple[Array, Array]
    surfaces: list[Surface]
    rigid: list[Rigid]
    acting: list[Acting]
    axis: bool  # whether x = 0 is an axis of revolution


class Declarations:
    """Collects the declarations of a problem, in the reference configuration (the constructor is collective).

    Args:
        at: load factor or time of the loads; None for the present loads.
        loads: whether loads that are terms of the residual are included.
    """

    def __init__(self, problem: UnitedProblem, at: float | None, loads: bool):
        self.problem, self.config, self.comm = problem, problem.config, problem.comm
        self.mesh, self.gdim = problem.config.mesh, problem.config.gdim
        self._outside = outside = Outside(problem)
        self._acting = Actions(problem, outside)
        self._pairs = 0
        self._surfaces: list[Surface] = []
        before = self._places_of_rigid()
        with loaded(problem, at):
            clamped = self._acting.conditions()
            if self.config.moves:
                self._acting.points()
                self._acting.bodies(loads_of(problem, loads))
            self._acting.couplings()
            after = self._places_of_rigid()
        self._declare_surfaces()
        self._equations()
        rigid = self._rigid(before, after)
        body, number = outside.body_of_cells()
        polygons, cells = outside.faces, outside.cells
        if self.gdim == 2:
            polygons = vertex_cells(self.mesh)[1][:, :-1]
            cells = np.arange(len(polygons), dtype=np.int32)
        polygon, clamps = (
            outside.gather(outside.X[polygons], body[cells], number[cells]),
            outside.gather(*outside.facets(clamped)),
        )
        skin = outside.gather(outside.X[outside.faces])
        self.found: Declared | None = None  # on rank 0, None elsewhere
        if polygon is not None and clamps is not None and skin is not None:
            _, labels = np.unique(polygon[1], return_inverse=True)
            first = np.full(labels.max() + 1, np.iinfo(np.int64).max)
            np.minimum.at(first, labels, polygon[2])
            place = np.argsort(np.argsort(first))
            axis = self.config.moves and self.config.axisymmetric
            self.found = Declared(
                polygon[0], place[labels], skin[0], (clamps[0], clamps[1]), self._surfaces, rigid, self._acting.found, axis
            )

    def _declare_surfaces(self) -> None:
        """Collect both sides of contacts and ties (collective)."""
        for one in [*self.problem.declared, *self.problem.ties]:
            if isinstance(one, GeneralContact):
                self._add(f"{one.name}: all surfaces", "contactor", one.all_surfaces)
            else:
                preload, words = isinstance(one, Preload), _words(one)
                self._add(self._called(one, one.contactor, words[0]), "contactor", one.contactor)
                if not hasattr(one.target, "project"):
                    self._add(self._called(one, one.target, words[1]), "target", one.target)
                for surface in self._surfaces[-2:] if preload else ():
                    # both parts are pulled towards each other
                    n = surface.normals.mean(axis=0, keepdims=True)
                    self._acting.found.append(Acting("load", "preload", surface.corners.mean(axis=(0, 1))[None], n, -n))
            self._pairs += 1

    def _called(self, contact: Contact, part: Part, word: str) -> str:
        """Name of one side of a contact: the name of its tag, with the name of the contact if other contacts use the same tag."""
        name = name_of(part)
        if name == "by index" or name.startswith("tagged "):
            return f"{contact.name}: {word}"
        several = [
            one for one in self.problem.declared if isinstance(one, Contact) and name in (name_of(one.contactor), _target(one))
        ]
        return f"{name}: {word}" + (f" ({contact.name})" if len(several) > 1 else "")

    def _equations(self) -> None:
        """Collect periodic surfaces, and nodes of linear equations (collective)."""
        for k, one in enumerate(self.problem.equations):
            follower, *leaders = one.places
            sides = [
                None if is_point(where) else as_tag(where, self.mesh, range(self.config.tdim, -1, -1), "a place")
                for where in one.places
            ]
            if len(sides) == 2 and all(tag is not None and tag.dim == self.config.tdim - 1 for tag in sides):
                self._add(f"{name_of(follower)}: follows", "contactor", follower)
                self._add(f"{name_of(leaders[0])}: is followed", "target", leaders[0])
                self._pairs += 1
                continue
            for where in one.places:
                at = self.config.X[nodes_at(self.config, where, f"a place of equations[{k}]")]
                self._acting.act("equation", "linear equation", at, np.zeros_like(at))

    def _add(self, name: str, side: str, part: Part) -> None:
        """Collect a surface, or points (collective)."""
        tag = as_tag(part, self.mesh, (self.config.tdim - 1, 0), name)
        if tag.dim == self.config.tdim - 1:
            found = self._outside.gather(*self._outside.facets(part=tag), np.zeros((0, self.gdim)))
        else:
            at = self.config.X[nodes_at(self.config, tag, name)]
            found = self._outside.gather(np.zeros((0, 2, self.gdim)), at[:0], at)
        if found is not None:
            same = [
                one for one in self._surfaces if np.array_equal(one.corners, found[0]) and np.array_equal(one.points, found[2])
            ]
            self._surfaces.append(Surface(name, side, self._pairs, found[0], found[1], found[2], len(same)))

    def _places_of_rigid(self) -> list[Motion | None]:
        return [target.motion for _, target, _ in self._rigid_targets()]

    def _rigid_targets(self) -> list[tuple[int, RigidSurface, Contact]]:
        """Distinct rigid surfaces, each with the number of its declaration and one of its contacts."""
        found: dict[int, tuple[int, RigidSurface, Contact]] = {}
        for k, one in enumerate(self.problem.declared):
            for contact in one.parts if isinstance(one, GeneralContact) else [one]:
                if isinstance(contact.target, RigidSurface):
                    found.setdefault(id(contact.target), (k, contact.target, contact))
        return list(found.values())

    def _rigid(self, before: Sequence[Motion | None], after: Sequence[Motion | None]) -> list[Rigid]:
        """Rigid targets and their displacements (collective)."""
        found, still = [], Motion.none(self.gdim)
        for (k, target, contact), first, last in zip(self._rigid_targets(), before, after):
            nodes = contact.pair.nodes
            middle = reduced(self.comm, self.config.X[nodes].sum(axis=0)) / reduced(self.comm, len(nodes))
            p = target.project(middle[None])
            foot = middle - p.height[0] * p.normal[0]
            first, last = first or still, last or still
            way = last.carry(first.back(foot[None]))[0] - foot
            several = len({id(one.target) for one in self.problem.contacts if getattr(one.target, "name", "") == target.name}) > 1
            of = f" ({contact.name})" if several and isinstance(self.problem.declared[k], Contact) else ""
            found.append(Rigid(f"{target.name}: target{of}", k, Shape(target, target.motion), foot, way))
        return found


def _words(contact: Contact) -> tuple[str, str]:
    """Labels of the sides of a contact in the legend."""
    if isinstance(contact, Preload):
        return "preloaded", "preloaded"
    return ("tied", "tied to") if contact.tied is True else ("contactor", "target")


def _target(contact: Contact) -> str:
    """Name of the part of a mesh that is a contact's target; empty for a rigid target."""
    return "" if hasattr(contact.target, "project") else name_of(contact.target)
