"""Changes of contacts between steps: switching, and ramps of parameters."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import Field, FrictionLaw, OfTemperature, as_law, follows_load
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.state import FrictionState, PairState
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.warnings.checks import check_initial
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agree, agreed, reduced


def switch_off(pair: Interface) -> None:
    """Open a pair permanently; accumulated slip, wear and dissipation are kept (collective)."""
    if pair.tie is not None:
        pair.tie.untie()
    n, g, f = len(pair.nodes), pair.config.gdim, pair.committed.friction
    state = PairState.initial(n, g)
    if f is not None:
        fresh = FrictionState.initial(n, g)
        state = replace(state, friction=replace(fresh, slipped=f.slipped, work=f.work, worn=f.worn))
    state = replace(state, damping=pair.committed.damping)
    for name in ("bond", "heat"):
        if getattr(pair.committed, name) is not None:
            state = replace(state, **{name: np.zeros_like(getattr(pair.committed, name))})
    settle(pair, state)


def mark(contact: Contact, on: bool) -> None:
    """Mark a contact as switched on or off, also among others in its interface (collective)."""
    contact.note_on(on)
    whole = contact.pair.whole
    if len(whole.members) > 1:
        every = whole.discretisation.setting.on.copy()
        every[whole.members.index(contact.pair)] = on
        whole.discretisation.set(on=every)


def switch_on(contact: Contact) -> None:
    """Start a contact in the current configuration, as at the start of a problem (collective).

    Raises PenetrationError if a contactor is deeper inside than ``max_penetration``.
    """
    pair = contact.pair
    settle(pair)
    pair.whole.discretisation.begin_step()
    pair.project()
    contact.note_overlap(check_initial(pair))
    pair.activate_touching()


def hold(pair: Interface, free: Bools, changed: Bools | None) -> None:
    """Set other Dirichlet conditions (collective).

    Args:
        pair: interface.
        free: components of the owned nodes without condition ``(n_owned, gdim)``.
        changed: local nodes whose conditions have changed since the last step ``(n_local,)``; None if the last step had the same.

    Raises:
        InputError: if its discretisation cannot change conditions, or they change at nodes of a tie that depends on them.
    """
    config, own, tie = pair.config, pair.discretisation, pair.tie
    tied = tie is not None and bool(reduced(config.comm, int(tie.tied.sum())))
    with agreed(config.comm):
        if not hasattr(own, "set"):
            raise InputError(
                f"{pair.name}: its discretisation {type(own).__name__} has no method set, and takes no other conditions: give it one, or "
                "keep the conditions of all steps"
            )
    if tie is not None and tie.knows_conditions and tied and changed is not None:
        _refuse_at_ties(tie, changed)
    if tie is not None and tie.means is not None:
        tie.means.set(free=free)
    own.set(free=free)
    if tied and changed is None:
        # its rows were made with the conditions at the beginning of the script
        pair.from_checkpoint(pair.to_checkpoint())
    settle(pair)


def _refuse_at_ties(tie: Tie, changed: Bools) -> None:
    """Raise if conditions have changed at local nodes ``(n_local,)`` that are tied, or followed by tied nodes (collective)."""
    config = tie.config
    followed = tie.followed_by_ties()
    here = changed[: config.n_owned, None].astype(float)
    X = config.ask_owners(followed, np.column_stack([here, config.X[: config.n_owned]]))
    at = np.concatenate([config.X[tie.nodes[tie.tied & changed[tie.nodes]]], X[X[:, 0] > 0, 1:]])
    error = None
    if len(at):
        place = ", ".join(f"{x:.6g}" for x in at[0])
        error = InputError(
            f"{tie.name}: the node at ({place}) is tied, and a step changes its conditions: mortar and preloads expect the same in "
            "all steps that it is tied in; keep them, or tie by coupling='node_to_surface'"
        )
    agree(config.comm, error)


def settle(pair: Interface, state: PairState | None = None) -> None:
    """Place the committed state, or another, with the present conditions and offsets (collective)."""
    pair.remember(state or pair.committed)
    pair.project()


def blended_friction(contact: Contact, to: Field | FrictionLaw, share: Callable[[float], float]) -> Field | FrictionLaw:
    """Friction ramped from its present to another value, as a function of position and load factor.

    Args:
        contact: whose friction it is.
        to: friction at the end; a function of position and load factor is used without a ramp.
        share: function of the load factor that increases from 0 to 1.

    Raises:
        InputError: if it depends on temperature now, and ``to`` does not.
    """
    refuse_ramp(f"friction of contact '{contact.name}'", as_law(contact.friction).field, as_law(to).field)
    if follows_load(as_law(to)):
        return to
    if isinstance(as_law(contact.friction).field, OfTemperature):
        expected = "friction that follows a temperature as well, OfTemperature, which is not ramped"
        raise InputError(given.sentence(f"friction of contact '{contact.name}'", to, expected))
    before, after = _frozen(as_law(contact.friction), contact._at), as_law(to).field

    def at(x: Array, s: float) -> Any:
        return value_at(between(before, after, share(s)), x)

    return _with_field(to, at)


def refuse_ramp(what: str, *fields: Field) -> None:
    """Refuse Functions at the ends of a ramp, which every step reads anew, by an InputError that names it."""
    if any(isinstance(f, fem.Function) for f in fields):
        raise InputError(
            f"{what} is a Function, which a Step does not ramp: expected numbers or functions of position; or change its values between "
            "steps"
        )


def between(a: Field, b: Field, share: float) -> Field:
    """Linear interpolation between a and b, numbers or functions of position."""
    if not (callable(a) or callable(b)):
        return (1.0 - share) * a + share * b
    return lambda x: (1.0 - share) * value_at(a, x) + share * value_at(b, x)


def value_at(field: Field, x: Array) -> Any:
    """A number, or the values of a function of position at ``x (3, n)``."""
    return np.asarray(field(x), dtype=float) if callable(field) else field


def frozen_friction(contact: Contact, to: Field | FrictionLaw, at: float) -> Field | FrictionLaw:
    """Friction that was ramped to ``to``, with its value for a load factor."""
    there = at == 1.0 and not follows_load(as_law(to))
    return to if there else _with_field(contact.friction, _frozen(as_law(contact.friction), at))


def _frozen(law: FrictionLaw, at: float) -> Field:
    """The law's parameter at a load factor."""
    f = law.field
    if isinstance(f, OfTemperature):
        return f.at(at)
    return (lambda x: np.broadcast_to(f(x, at), x.shape[1:])) if follows_load(law) and callable(f) else f


def _with_field(friction: Any, parameter: Field) -> Any:
    """The same law with another parameter."""
    if not hasattr(friction, "limit"):
        return parameter
    if "field" not in vars(friction):
        raise InputError(given.sentence("friction", friction, "a law with an attribute field of its own, to be ramped in a step"))
    other = copy(friction)
    object.__setattr__(other, "field", parameter)
    return other
