"""Contact: what the user declares about two surfaces, and what can be read from it after a step."""

from __future__ import annotations

import re
from functools import cached_property

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.bernstein import Bernstein
from uem_dolfinx.contact.node_to_surface import NodeToSurface
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.contact.results import Balance, Resultant, imbalance, sum_up
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.rigid import finite_point
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.surfaces import check_distinct, surface_nodes, tributary_areas
from uem_dolfinx.geometry.tags import Part, as_tag, name_of

#: Default bound on the initial penetration, as part of the model's size.
#: [convention; the model's size; test_pair.py::test_default_bound_on_the_initial_penetration]
MAX_PENETRATION = 0.05


class Contact:
    """A contactor surface that may touch a target.

    Args:
        contactor: facets whose nodes are the contactors, or points, which have forces but no pressures: a tag, a list of tags,
            ``(meshtags, value)``, or facet indices.
        target: facets of the other body, named alike, or a rigid surface.
        sliding: ``"finite"`` projects in every iteration, ``"small"`` once per step, ``"fixed"`` once for all.
        normals: ``"facet"``, the paper's, or ``"averaged"`` at the target's nodes and interpolated.
        max_penetration: bound on the initial penetration, a length; None is 5 % of the model's size.
        thickness: of the body behind a meshed target, a length: a contactor that has slid off the target's end and is deeper
            than this lies behind the body, not in it. None takes the body to have no back.
        chords: build P with the straight pieces between a curved target's nodes [UEM, 4.5]; gaps, normal return and forces keep
            the true facet, so that the answer is the same, after more iterations.
        name: for messages and files; None takes the names of the tags.

    Raises:
        ValueError: for an unknown word, or a thickness that is not positive.
    """

    def __init__(
        self,
        contactor: Part,
        target: Part | Target,
        *,
        sliding: str = "finite",
        normals: str = "facet",
        max_penetration: float | None = None,
        thickness: float | None = None,
        chords: bool = False,
        name: str | None = None,
    ):
        for value, known in ((sliding, ("finite", "small", "fixed")), (normals, ("facet", "averaged"))):
            if value not in known:
                raise ValueError(f"'{value}' is not known here: expected one of {', '.join(known)}")
        if thickness is not None and not thickness > 0.0:
            raise ValueError(f"thickness = {thickness}: expected a positive length, or None")
        self.contactor, self.target, self.sliding, self.normals = contactor, target, sliding, normals
        self.max_penetration, self.thickness, self.chords = max_penetration, thickness, chords
        rigid = hasattr(target, "project")
        self.name = (
            name or f"{name_of(contactor)} on {getattr(target, 'name', type(target).__name__) if rigid else name_of(target)}"
        )
        self._pair: ContactPair | None = None
        self._fields: dict[str, fem.Function] = {}

    def attach(self, config: Configuration, free: Bools) -> ContactPair:
        """Build the pair of this contact in a problem (collective).

        Args:
            config: configuration of the displacement.
            free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.

        Raises:
            TagError: if a tag is empty or of the wrong dimension.
            SpaceError: if a tag belongs to another mesh.
            SurfaceError: if contactor and target share nodes.
            OrientationError: if a target facet lies inside a body.
        """
        self.config, facets = config, config.tdim - 1
        self.contactor = as_tag(self.contactor, config.mesh, (facets, 0), "contactor")
        nodes = surface_nodes(config, self.contactor)
        target: Target
        if hasattr(self.target, "project"):
            target = self.target
        else:
            self.target = as_tag(self.target, config.mesh, (facets,), "target")
            surface = TargetFacets(config, self.target)
            check_distinct(config, nodes, surface, (name_of(self.contactor), name_of(self.target)))
            target = MeshTarget(surface, averaged=self.normals == "averaged")
        thickness = np.inf if self.thickness is None else self.thickness
        coupling = (Bernstein if config.degree == 2 else NodeToSurface)(
            config, nodes, target, free=free, sliding=self.sliding, thickness=thickness, chords=self.chords and config.degree == 2
        )
        self._pair = ContactPair(
            config,
            nodes,
            coupling,
            name=self.name,
            sliding=self.sliding,
            max_penetration=MAX_PENETRATION * config.size if self.max_penetration is None else self.max_penetration,
            thickness=thickness,
        )
        return self._pair

    @property
    def pair(self) -> ContactPair:
        """The pair behind this contact."""
        if self._pair is None:
            raise SurfaceError(f"contact '{self.name}' belongs to no problem yet: hand it to a UnitedProblem first")
        return self._pair

    # -- results -------------------------------------------------------------------------------------------------------

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks (collective)."""
        return self.pair.n_active

    @property
    def initial_overlap(self) -> float:
        """How deep contactors were inside the target before the first step, a length; 0 if none was."""
        return self.pair.initial_overlap

    def max_gap(self) -> float:
        """Largest gap of an active contactor, a length (collective)."""
        return self.pair.largest_gap()

    @cached_property
    def _areas(self) -> Array:
        """Integral of the shape function of each contactor over the reference surface ``(n_contactors,)`` (collective)."""
        return tributary_areas(self.config, self.contactor)[self.pair.nodes]

    @property
    def pressures(self) -> Array:
        """Normal contact force over tributary reference area at this rank's contactors ``(n_contactors,)`` (collective)."""
        areas = self.pair.coupling.areas(self.pair.placement, self._areas)
        return np.where(areas > 0, self.pair.trial.lam / np.where(areas > 0, areas, 1.0), 0.0)

    def max_pressure(self) -> float:
        """Largest contact pressure, a force per area (collective)."""
        return float(self.config.comm.allreduce(float(self.pressures.max(initial=0.0)), op=MPI.MAX))

    @property
    def pressure(self) -> fem.Function:
        """Contact pressure as a scalar field, zero off the contactor (collective)."""
        return self._field("pressure", self.pressures)

    @property
    def gap(self) -> fem.Function:
        """Gap as a scalar field, a length; zero off the contactor (collective)."""
        return self._field("gap", self.pair.projection.gap)

    @property
    def active(self) -> fem.Function:
        """1 at active contactors, 0 elsewhere (collective)."""
        return self._field("active", self.pair.trial.active)

    @property
    def force(self) -> fem.Function:
        """Nodal contact forces as a vector field: on the contactors, and opposite on the nodes of a meshed target (collective)."""
        if "force" not in self._fields:
            self._fields["force"] = fem.Function(self.config.V, name=_identifier(f"contact_force_{self.name}"))
        f, g, pair = self._fields["force"], self.config.gdim, self.pair
        f.x.array[:] = 0.0
        total = compat.petsc_vector(f)
        nodes, forces = pair.coupling.nodal_forces(pair.placement, pair.trial)
        rows = (nodes[:, None] * g + np.arange(g)).ravel().astype(PETSc.IntType)
        total.setValues(rows, forces.ravel(), addv=PETSc.InsertMode.ADD)
        total.assemble()
        f.x.scatter_forward()
        return f

    def resultant(self, about: npt.ArrayLike | None = None, *, on: str = "contactor") -> Resultant:
        """Force and moment that the contact exerts on one of the bodies (collective).

        Args:
            about: point that the moment is taken about ``(gdim,)``. None is the origin, but for the force on a rigid surface
                the surface's reference point where it is now: a tool's moment is about the point it turns about.
            on: ``"contactor"``, or ``"target"``: a meshed one receives its forces at the feet of the contactors, a rigid one,
                which has no nodes, where the contactors are.

        Raises:
            ValueError: for an unknown body, or a point that is not finite.
        """
        if on not in ("contactor", "target"):
            raise ValueError(f"'{on}' is not known here: expected one of contactor, target")
        target, p, g = self.pair.target, self.pair.projection, self.config.gdim
        centre = np.zeros(g) if about is None else finite_point(about, "about", g)
        x, f = self.pair.points, self.pair.trial.force
        if on == "target":
            x, f = p.foot, -f
            centre = target.reference(g) if about is None else centre
        return sum_up(self.config.comm, x - centre, f)

    def balance(self) -> Balance | None:
        """Force and moment of the pair summed over both bodies; zero is action = reaction (collective).

        The contactors' forces come from the residual, the target's from handing them on to its nodes.

        Returns:
            Imbalances relative to the sums of absolute nodal forces and moments; None for a rigid target, which has no nodes.
        """
        if self.pair.target.n_nodes == 0:
            return None
        n, g = self.config.n_owned, self.config.gdim
        return imbalance(self.config.comm, self.config.x[:n], self.force.x.array.reshape(-1, g)[:n])

    def _field(self, what: str, values: npt.ArrayLike) -> fem.Function:
        if what not in self._fields:
            S = compat.function_space(self.config.mesh, self.config.degree)
            self._fields[what] = fem.Function(S, name=_identifier(f"contact_{what}_{self.name}"))
        f = self._fields[what]
        f.x.array[:] = 0.0
        f.x.array[self.pair.nodes] = values
        f.x.scatter_forward()
        return f


def _identifier(text: str) -> str:
    """Name of a Function that the form compiler can use in code."""
    return re.sub(r"\W+", "_", text)
