"""Contents of a checkpoint of a ``UnitedProblem``, and their restoration."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.restart.state import State
from uem_dolfinx.solve.loading import from_checkpoint, to_checkpoint


def state_of(problem: Any) -> State:
    """Functions and numbers of a problem, from which its run continues as if uninterrupted (collective)."""
    stiffness, own, config = fem.Function(problem.config.V), problem.config.functions(), problem.config
    starts = {name: fem.Function(f.function_space) for name, f in own.items()}
    of_equations = fem.Function(config.V)
    functions = own | {"stiffness": stiffness}
    carried = {name: fem.Function(f.function_space) for name, f in own.items()}
    for i, pair in enumerate(problem.pairs, 1):
        if pair.tie is not None:
            functions[f"displacement it was tied at of contact {i}"] = pair.tie.at
    ramped = problem.dynamics is None
    if problem.dynamics is None:
        for what, fields in (("load start", starts), ("released", carried)):
            functions |= {what + name.removeprefix("displacement"): f for name, f in fields.items()}
    else:
        d = problem.dynamics
        functions |= {"velocity": d.velocity, "acceleration": d.acceleration, "inertia forces": d.forces}
        functions["mean velocity"] = d.mean_velocity
        if d.damping is not None:
            functions["velocity in damping"] = d.past
        if is_explicit(d):
            functions["displacement at the critical step"] = problem.step_control.known_at
    for i, material in enumerate(problem.materials, 1):
        functions |= {f"{name} {i}": f for name, f in material.history.items()}
    if problem.linear is not None:
        functions["multipliers of equations"] = of_equations
    settings = problem.settings.describe(problem.comm)
    by_default = problem.settings.by_default(settings)
    state = State(problem.config.mesh, functions, problem.contacts, settings=settings, by_default=by_default)

    def collect() -> None:
        config.functions()
        known = problem.bodies.to_checkpoint(stiffness)
        # the multigrid hierarchy is rebuilt, as in a run restarted from the file
        problem.system.forget()
        problem.solver.commit()
        state.numbers |= {"largest forces": np.asarray(problem.largest_forces).tolist(), "stiffness known": known}
        state.numbers |= problem.progress.to_checkpoint(ramped)
        if ramped:
            state.numbers["shares of Dirichlet values"] = to_checkpoint(problem)
        if ramped and problem.progress.ramp:
            config.fill(starts, problem.progress.start)
            released = problem.progress.carried
            config.fill(carried, np.zeros(len(problem.bodies.held)) if released is None else released)
        if problem.linear is not None:
            eq, nodal = problem.linear.equations, np.zeros((config.n_owned, config.gdim))
            np.add.at(nodal, eq.node, problem.linear.multipliers[:, None] * eq.direction)
            of_equations.x.array[: nodal.size] = nodal.ravel()
            of_equations.x.scatter_forward()
        if problem.dynamics is not None:
            state.numbers |= problem.dynamics.to_checkpoint() | problem.step_control.to_checkpoint()
        if problem.linear is not None and problem.linear.turns:
            state.numbers["turns of couplings"] = problem.linear.turns

    def restore() -> None:
        if config.unknowns.mixed:
            problem.u.x.array[:] = config.values_of(own)
            for pair in problem.interfaces:
                # they were projected at the previous positions of the bodies
                pair.remember(pair.committed)
                pair.project()
        problem.committed, problem.motions = np.array(problem.u.x.array), problem.rigid_motions()
        problem.largest_forces = np.asarray(state.numbers["largest forces"])[()]
        problem.bodies.from_checkpoint(stiffness if state.numbers["stiffness known"] else None)
        at_start = (config.values_of(starts), config.values_of(carried)) if ramped else (None, None)
        problem.progress.from_checkpoint(state.numbers, *at_start)
        if ramped:
            problem.progress.take_shares(*from_checkpoint(problem, state.numbers["shares of Dirichlet values"]))
        if problem.dynamics is not None:
            problem.dynamics.from_checkpoint(state.numbers)
            problem.step_control.from_checkpoint(state.numbers)
        at = problem.progress.factor if problem.dynamics is None else problem.dynamics.time
        for contact in problem.contacts:
            contact.take_load(at, known=True)
        if problem.linear is not None:
            problem.linear.turns = state.numbers.get("turns of couplings", [])
            problem.linear.take_load(at)
            problem.progress.of_equations = np.array(of_equations.x.array).reshape(-1, config.gdim)
            take_multipliers(problem)

    state.collect.append(collect)

    def back() -> None:
        for pair, motion in zip(problem.interfaces, problem.motions):
            pair.target.motion = motion
        problem.restore()
        for control in (problem.step_control, problem.progress.control):
            control.give_up()

    state.restore.append(restore)
    state.back.append(back)
    return state


def take_multipliers(problem: Any) -> None:
    """Set the multipliers of users' equations from a checkpoint, by their eliminated components."""
    eq = problem.linear.equations
    problem.linear.multipliers = np.einsum("mg,mg->m", eq.direction, problem.progress.of_equations[eq.node])
    problem.linear.commit()
