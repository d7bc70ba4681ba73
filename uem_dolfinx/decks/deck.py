"""Decks of Abaqus and CalculiX as problems: their bodies, conditions, contacts and steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices

from uem_dolfinx import compat, given
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.at_points import PointLoad
from uem_dolfinx.conditions.equation import Equation
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.contact.laws.conductance import Conductance
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.decks.parts import SAME_LENGTH, TEMPERATURE, Course, Interaction, Linear, Material, Model, Pair, Step
from uem_dolfinx.dynamics.inertia import Dynamics
from uem_dolfinx.dynamics.mass import consistent_mass
from uem_dolfinx.dynamics.scheme import Scheme
from uem_dolfinx.errors import InputError, SpaceError, TagError
from uem_dolfinx.geometry.axisymmetry import axisymmetric
from uem_dolfinx.geometry.cuts import BACK
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.materials.elastic import LinearElastic, StVenantKirchhoff
from uem_dolfinx.output.xdmf import geometry_degree
from uem_dolfinx.parallel import reduced
from uem_dolfinx.scripting import dirichlet, ds, dx
from uem_dolfinx.solve.modes import Vibrations, modes
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep, TimeStep
from uem_dolfinx.solve.steps.load_steps import load_steps
from uem_dolfinx.solve.steps.stages import Step as OfUsers
from uem_dolfinx.solve.steps.time_steps import time_steps

#: Kinds of strains by the first letters of element types.
STRAINS_OF_TYPES = {"C3D": "3d", "CPE": "plane_strain", "CPS": "plane_stress", "CAX": "axisymmetric"}
#: Gaps up to this part of the model's size conduct heat: conductances of decks act before surfaces press.
#: [convention; size of the model; test_deck_runs.py::test_gaps_that_conduct]
CONDUCTS = 1e-4


class Deck(given.Sealed):
    """A model read by ``read_deck``.

    Attributes:
        mesh: the mesh.
        tags: its sets and surfaces; nodes with conditions are among them, as ``"node 14"``.
        u: displacement, or the Function of displacement and temperature.
        problem: the problem.
        contacts: by the names of their surfaces, ``"slave on master"``.
        sections: preloaded sections of bolts by the names of their surfaces.
        steps: data of the steps.
        left_out: keywords and options without counterpart, or that are read differently from their definition.
    """

    def __init__(self, mesh: Any, tags: Any, model: Model, numbers: Ints | None, soft: bool):
        self.mesh, self.tags, self.steps, self.left_out = mesh, tags, model.steps, model.left_out
        self._model, self._numbers, self._soft = model, numbers, soft
        self._by_name = {str(tag.name).upper(): tag for tag in map(tags.__getitem__, tags) if tag.name}
        kinds = {STRAINS_OF_TYPES.get(name[:3], "") for name in model.types}
        if len(kinds) != 1 or "" in kinds:
            raise InputError(
                f"elements are of the types {sorted(model.types)}: expected one family of {', '.join(STRAINS_OF_TYPES)}"
            )
        (self._kind,) = kinds
        if self._kind == "axisymmetric":
            axisymmetric(mesh)
        #: Values that steps change, at the start, and at the ends of all steps.
        self._driven: list[tuple[Array, Array, list[Any]]] = []
        self._dt = fem.Constant(mesh, 1.0)
        g, degree = mesh.geometry.dim, geometry_degree(mesh)
        V = (
            compat.function_space(mesh, [("Lagrange", degree, (g,)), degree])
            if model.thermal
            else compat.function_space(mesh, degree, (g,))
        )
        self.u = fem.Function(V, name="u")
        self._old = fem.Function(V)
        self.contacts = {f"{pair.slave} on {pair.master}": self._contact(pair) for pair in model.pairs}
        self.sections = {name: self._section(name, node, axis) for name, node, axis in model.pretension}
        held = dict.fromkeys(where for step in model.steps for where in step.held if isinstance(where[0], str))
        self._bcs = {where: self._condition(where) for where in held}
        dynamics = self._dynamics(V)
        self.problem = UnitedProblem(
            self._residual(),
            self.u,
            displacement=0 if model.thermal else None,
            bcs=self._held(model.steps[0]),
            contacts=[*self.contacts.values(), *self.sections.values()],
            equations=[self._equation(one) for one in model.equations],
            points=self._point_loads(),
            couplings=[self._rigid(*one) for one in model.rigid],
            dynamics=dynamics,
            load=None if dynamics is None else self._load_at,
        )

    def __repr__(self) -> str:
        """Its steps and contacts."""
        kinds = ", ".join(step.kind.lower() for step in self.steps)
        return f"Deck(steps: {kinds}; contacts: {', '.join(self.contacts) or 'none'}; {len(self.left_out)} keywords left out)"

    # -- for users -------------------------------------------------------------------------------------------------------

    def run(self) -> Iterator[LoadStep | TimeStep]:
        """Take all steps, one converged load step or step of time after the other (collective); errors as in ``load_steps``."""
        for k, step in enumerate(self.steps if self.problem.dynamics is not None else ()):
            yield from time_steps(self.problem, step.first, float(self._ends[k]))
        if self.problem.dynamics is not None:
            return
        yield from load_steps(self.problem, [one for k, step in enumerate(self.steps) for one in self._stages(k, step)])

    def modes(self) -> Vibrations:
        """The modes that ``*FREQUENCY`` requests, about the present state; InputError without it, or densities (collective)."""
        if not self._model.modes:
            raise InputError("modes: the deck has no step *FREQUENCY")
        mass = consistent_mass(self.problem.config.V, self._density("vibrations need"))
        return modes(self.problem, self._model.modes, mass=mass)

    def displacement(self, node: int) -> Array:
        """Displacement of a node of the file by its number ``(gdim,)`` (collective); InputError if no body has this node."""
        return self._at(node)[: self.mesh.geometry.dim]

    def temperature(self, node: int) -> float:
        """Unknown temperature of a node of the file by its number (collective); InputError without such a node, or temperatures."""
        if not self._model.thermal:
            raise InputError("temperature: the deck has no unknown temperatures: expected a step of heat")
        return float(self._at(node)[-1])

    def _at(self, node: int) -> Array:
        """Displacement, and temperature if it is unknown, of a node (collective)."""
        comm, mesh, config = self.mesh.comm, self.mesh, self.problem.config
        place = comm.bcast(None if self._numbers is None else np.flatnonzero(self._numbers == node), root=0)
        if not len(place):
            raise InputError(f"node = {node}: no body of the deck has this node")
        at = np.argwhere(np.isin(mesh.geometry.input_global_indices, place[:1])[compat.geometry_dofs(mesh)])
        found = None
        if len(at):
            cell, i = at[0]
            found = config.displacement[compat.cell_dofs(config.V)[cell, i]]
            if self._model.thermal:
                found = np.append(found, self.u.x.array[compat.part_dofs(self.u.function_space, 1)[cell, i]])
        return np.asarray(next(one for one in comm.allgather(found) if one is not None))

    # -- steps -----------------------------------------------------------------------------------------------------------

    def _stages(self, k: int, step: Step) -> Iterator[OfUsers]:
        """A step in static load steps, or in steps of time."""
        bcs, changed = self._held(step), dict[Contact | GeneralContact, bool]()
        for pair, contact in zip(self._model.pairs, self.contacts.values()):
            if (key := (pair.slave.upper(), pair.master.upper())) in step.contacts:
                changed[contact] = step.contacts[key]
        friction = self._friction_of(k, step)
        if step.kind == "STATIC" or step.steady:
            n = int(np.ceil(step.duration / step.first - SAME_LENGTH))
            begin = self._pass(np.inf)
            loads = self._loads(k, 0.0, 0.0, step.duration)
            yield OfUsers(f"step {k + 1}", n, bcs=bcs, contacts=changed, friction=friction, loads=loads, begin=begin)
            return
        for time, end in step.times():
            # conditions of heat act in full from the beginning
            begin, loads = self._pass(end - time), self._loads(k, 1.0, time, end)
            yield OfUsers(f"step {k + 1}", bcs=bcs, contacts=changed, friction=friction, loads=loads, begin=begin)
            changed, friction = {}, {}

    def _friction_of(self, k: int, step: Step) -> dict[Contact, Any]:
        """Coefficients of friction that a step changes; at first, of contacts that have friction in later steps only, 0."""
        found: dict[Contact, Any] = {}
        for pair, contact in zip(self._model.pairs, self.contacts.values()):
            if pair.interaction in step.friction:
                found[contact] = step.friction[pair.interaction]
            elif k == 0 and not pair.tied and not self._interaction(pair).friction and contact.friction:
                # functions of position and load factor are not ramped
                found[contact] = lambda x, s: np.zeros(x.shape[1])
        return found

    def _pass(self, dt: float) -> Callable[[], None]:
        """What begins a step of time."""

        def begin() -> None:
            self._dt.value = dt
            self._old.x.array[:] = self.u.x.array

        return begin

    def _loads(self, k: int, start: float, since: float, until: float) -> Callable[[float], None]:
        """Loads of step k from a part of its changes on, and from a time in it until another."""
        began = sum(step.duration for step in self.steps[:k])

        def loads(s: float) -> None:
            share, time = start + s * (1.0 - start), since + s * (until - since)
            for driven, first, values in self._driven:
                now = values[k]
                if isinstance(now, Course):
                    driven[...] = now.at(time, began + time)
                    continue
                before = values[k - 1] if k else first
                if isinstance(before, Course):
                    before = before.at(self.steps[k - 1].duration, began)
                driven[...] = before + share * (now - before)

        return loads

    @property
    def _ends(self) -> Array:
        """Times at the ends of the steps."""
        return np.cumsum([step.duration for step in self.steps])

    def _load_at(self, time: float) -> None:
        """Set the loads of a time of a motion, in full from the beginning of their step."""
        k = int(np.searchsorted(self._ends[:-1] * (1.0 + SAME_LENGTH), time))
        since = time - (self._ends[k] - self.steps[k].duration)
        self._loads(k, 1.0, since, since)(0.0)

    def _dynamics(self, V: fem.FunctionSpace) -> Dynamics | None:
        """Mass, damping and velocities of ``*DYNAMIC``; InputError for other steps, or for what changes between these (collective)."""
        first = self.steps[0]
        if all(step.kind != "DYNAMIC" for step in self.steps):
            return None
        same = [(step.kind, step.alpha, set(step.held), step.contacts, step.friction) for step in self.steps]
        if any(one != ("DYNAMIC", first.alpha, set(first.held), {}, {}) for one in same):
            raise InputError(
                "*DYNAMIC among steps of other kinds, with another ALPHA, or with conditions, contacts or friction that change: expected "
                "*DYNAMIC steps alone, whose loads and values may change"
            )
        rho, velocity, test = self._density("a motion needs"), fem.Function(V), ufl.TestFunction(V)
        for (name, dof), value in self._model.velocities.items():
            compat.set_bc_values(velocity.x.array, [dirichlet(V, self._tag(name), dof - 1, value)])
        velocity.x.scatter_forward()
        damps = any(any(one.damping) for one in self._model.materials.values())

        def damping(rate: Any) -> ufl.Form:
            F = 0
            for material, cells in self._bodies():
                alpha, beta = material.damping
                F += alpha * rho * ufl.inner(rate, test) * cells if alpha else 0
                assert material.elastic is not None
                stiff = LinearElastic(*material.elastic, kind=self._kind)  # type: ignore[arg-type]
                F += beta * stiff.residual(rate, test) * cells if beta else 0
            return F

        a = first.alpha
        scheme = Scheme((1.0 - a) ** 2 / 4, 0.5 - a, 0.0, -a)
        return Dynamics(consistent_mass(V, rho), scheme=scheme, velocity=velocity, damping=damping if damps else None)

    def _drive(self, driven: Array, values: list[Any]) -> None:
        """Let an array follow values at the ends of the steps."""
        self._driven.append((driven, np.array(driven), values))

    def _driven_by(self, what: str, where: Any) -> fem.Constant:
        """A Constant that follows a value of the steps, which is 0 where a step has none."""
        constant = fem.Constant(self.mesh, 0.0)
        self._drive(constant.value, [getattr(step, what).get(where, 0.0) for step in self.steps])
        return constant

    # -- parts of the model ----------------------------------------------------------------------------------------------

    def _tag(self, name: str) -> Tag:
        if name.upper() not in self._by_name:
            raise TagError(f"the deck mentions '{name}', which has no node or side of a body: {self.tags!r}")
        return self._by_name[name.upper()]

    def _condition(self, where: tuple[str, int]) -> fem.DirichletBC:
        (name, dof), V = where, self.u.function_space
        if dof == TEMPERATURE:
            return dirichlet(V.sub(1), self._tag(name), None, self._driven_by("held", where))
        return dirichlet(V.sub(0) if self._model.thermal else V, self._tag(name), dof - 1, self._driven_by("held", where))

    def _held(self, step: Step) -> list[fem.DirichletBC]:
        return [self._bcs[where] for where in step.held if where in self._bcs]

    def _equation(self, one: Linear) -> Equation:
        terms = [(self._tag(name), vector[: self.mesh.geometry.dim]) for name, vector in one.terms]
        if not one.values:
            return Equation(terms)
        b = fem.Constant(self.mesh, 0.0)
        self._drive(b.value, one.values)
        return Equation(terms, b=b)

    def _point_loads(self) -> list[PointLoad]:
        g, found = self.mesh.geometry.dim, []
        for name in dict.fromkeys(name for step in self.steps for name, _ in step.forces if isinstance(name, str)):
            force = fem.Constant(self.mesh, np.zeros(g))
            for c in range(g):
                self._drive(force.value[c : c + 1], [step.forces.get((name, c + 1), 0.0) for step in self.steps])
            found.append(PointLoad(self._tag(name), force))
        return found

    def _rigid(self, name: str, place: list[float], node: int, turning: int) -> RigidCoupling:
        """A rigid body, led and loaded at its reference nodes; InputError if not all steps hold the same of these."""
        g = self.mesh.geometry.dim
        turns, motion = ((1, 2, 3) if g == 3 else (3,)), list[fem.Constant | None]()
        force, moment = fem.Constant(self.mesh, np.zeros(g)), fem.Constant(self.mesh, np.zeros(3) if g == 3 else 0.0)
        # rotations of a node of translations and rotations, or those of a node of their own
        places = [(node, c) for c in range(1, g + 1)] + [(turning, c) if turning else (node, 3 + c) for c in turns]
        for driven, at in zip([*force.value[:, None], *np.reshape(moment.value, (-1, 1))], places):
            self._drive(driven, [step.forces.get(at, 0.0) for step in self.steps])
            held = [step.held.get(at) for step in self.steps]
            if (fixed := [value for value in held if value is not None]) and len(fixed) < len(held):
                raise InputError(f"*BOUNDARY of node {at[0]}, of a *RIGID BODY: expected it in all steps, or in none")
            motion.append(fem.Constant(self.mesh, 0.0) if fixed else None)
            if (constant := motion[-1]) is not None:
                self._drive(constant.value, fixed)
        led = motion if any(one is not None for one in motion) else None
        return RigidCoupling(self._tag(name), place[:g], force=force, moment=moment, motion=led)

    def _section(self, name: str, node: int, axis: list[float]) -> Preload:
        g, now = self.mesh.geometry.dim, np.zeros(1)
        pulled = any((node, 1) in step.forces for step in self.steps)
        self._drive(now, [(step.forces if pulled else step.held).get((node, 1), 0.0) for step in self.steps])
        led: dict[str, Any] = {"force" if pulled else "shortening": lambda s: float(now[0])}
        direction = axis[:g] if any(axis[:g]) else None
        self.left_out += [f"heat through the section '{name}': none passes its cut"] if self._model.thermal else []
        return Preload(self._tag(name), self._tag(BACK.format(name)), direction, coupling="mortar", name=name, **led)

    def _interaction(self, pair: Pair) -> Interaction:
        return self._model.interactions.get(pair.interaction, Interaction())

    def _contact(self, pair: Pair) -> Contact:
        law, name = self._interaction(pair), f"{pair.slave} on {pair.master}"
        slave, master = self._tag(pair.slave), self._tag(pair.master)
        how: dict[str, Any] = {"coupling": "mortar" if pair.surfaces and slave.dim else "node_to_surface", "name": name}
        how |= {} if pair.adjust is None else {"adjust": pair.adjust or False}
        if pair.tied or law.overclosure == "TIED":
            return Contact(slave, master, tied=True, **how)
        how |= {"sliding": "small"} if pair.small else {}
        # a contact has friction from the start if it has some in any step
        friction = law.friction or max([step.friction.get(pair.interaction, 0.0) for step in self.steps], default=0.0)
        how |= {"friction": friction} if friction else {}
        if self._soft and law.numbers and not friction:
            how["normal"] = law.soft()
        elif law.overclosure != "HARD":
            hard = ", as friction does not go with soft contact" if self._soft and friction else ""
            self.left_out.append(f"PRESSURE-OVERCLOSURE={law.overclosure} of '{name}': contact is hard{hard}")
        if law.conductance and self._model.thermal:
            how["heat"] = Conductance(
                lambda p, g: np.where(g <= CONDUCTS * self.problem.config.size, law.conductance, 0.0), field=1
            )
        return Contact(slave, master, **how)

    # -- the form --------------------------------------------------------------------------------------------------------

    def _bodies(self) -> Iterator[tuple[Material, ufl.Measure]]:
        """Materials, each with its cells."""
        for elements, name in self._model.sections:
            yield self._model.materials[name], dx(self._tag(elements)) if len(self._model.sections) > 1 else ufl.dx

    def _residual(self) -> ufl.Form:
        """Internal minus external virtual work of all sections, with their heat."""
        thermal, test = self._model.thermal, ufl.TestFunction(self.u.function_space)
        w, T = ufl.split(self.u) if thermal else (self.u, None)
        v, q = ufl.split(test) if thermal else (test, None)
        law_of = StVenantKirchhoff if any(step.nlgeom for step in self.steps) else LinearElastic
        F, heating = 0, self._heating(T)
        for material, cells in self._bodies():
            if material.elastic is None:
                raise InputError(f"material '{material.name}' has no *ELASTIC: expected E and nu of an isotropic material")
            law = law_of(*material.elastic, kind=self._kind)  # type: ignore[arg-type]
            F += law.residual(w, v) * cells
            if material.expansion and heating is not None:
                F -= law.thermal_residual(w, v, material.expansion * heating) * cells
            if thermal:
                stored = material.density * material.heat_capacity * (T - ufl.split(self._old)[1]) / self._dt
                F += ((material.conductivity or 0.0) * ufl.inner(ufl.grad(T), ufl.grad(q)) + stored * q) * cells
        for where in dict.fromkeys(where for step in self.steps for where in step.pressures):
            pressed = self._driven_by("pressures", where) * ufl.dot(ufl.FacetNormal(self.mesh), v)
            F += pressed * ds(self._outside(self._tag(where[0])))
        for where in dict.fromkeys(where for step in self.steps for where in step.bodies):
            tag, x = self._tag(where[0]), ufl.SpatialCoordinate(self.mesh)
            # bodies that turn move out
            x = x + w if law_of is StVenantKirchhoff else x
            work = self._density("a load acts on", tag) * ufl.inner(where[1].acceleration(x), v) * dx(tag)
            F -= self._driven_by("bodies", where) * work
        return F

    def _density(self, what: str, tag: Tag | None = None) -> fem.Function:
        """The density in cells; InputError for materials without, of cells of a tag or of any, with what needs it (collective)."""
        rho = fem.Function(compat.function_space(self.mesh, ("DG", 0)))
        dofs = compat.cell_dofs(rho.function_space)[:, 0]
        for elements, name in self._model.sections:
            cells = self._tag(elements).entities
            rho.x.array[dofs[cells]] = density = self._model.materials[name].density
            if reduced(self.mesh.comm, not density and (tag is None or bool(np.isin(cells, tag.entities).any())), op=MPI.LOR):
                raise InputError(f"material '{name}' has no *DENSITY, and {what} the mass of {tag or 'all bodies'}")
        return rho

    def _outside(self, tag: Tag) -> Tag:
        """A surface that is pressed; InputError if it has sides between two elements."""
        own = tag.entities[tag.entities < self.mesh.topology.index_map(tag.dim).size_local]
        outer = np.asarray(exterior_facet_indices(self.mesh.topology)) if tag.dim == self.mesh.topology.dim - 1 else own
        if reduced(self.mesh.comm, not np.isin(own, outer).all(), op=MPI.LOR):
            raise InputError(
                f"a pressure acts on sides between two elements, among those of {tag}: expected sides of one element each"
            )
        return tag

    def _heating(self, T: Any) -> Any:
        """Temperatures above those at the start; None if they play no part.

        Prescribed ones are linear in cells, but for quadrilaterals and hexahedra of degree 1, which have the mean of their vertices.
        """
        if self._model.thermal and all(step.kind == "HEAT TRANSFER" for step in self.steps):
            return None
        V = compat.function_space(self.mesh, 1)
        start = fem.Function(V)
        self._warm(start, self._model.initial)
        if self._model.thermal:
            self.u.sub(1).interpolate(start)
            return T - start
        if not any(step.temperatures for step in self.steps):
            return None
        means = geometry_degree(self.mesh) == 1 and compat.cell_name(self.mesh) in ("quadrilateral", "hexahedron")
        warmer, values = fem.Function(compat.function_space(self.mesh, ("DG", 0)) if means else V), []
        for step in self.steps:
            there = fem.Function(V)
            there.x.array[:] = start.x.array
            self._warm(there, step.temperatures)
            there.x.array[:] -= start.x.array
            warmer.interpolate(there)
            values.append(np.array(warmer.x.array))
        warmer.x.array[:] = 0.0
        self._drive(warmer.x.array, values)
        return warmer

    def _warm(self, field: fem.Function, temperatures: dict[str, float]) -> None:
        """Set temperatures at the nodes of sets (collective)."""
        for name, value in temperatures.items():
            # nodes in the middle of edges play no part
            with suppress(SpaceError):
                field.x.array[compat.bc_dofs(dirichlet(field.function_space, self._tag(name)))[0]] = value
        field.x.scatter_forward()
