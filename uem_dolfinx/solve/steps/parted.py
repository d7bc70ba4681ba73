"""Separation of joined contacts, for operations on single contacts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from uem_dolfinx.contact.joining import part
from uem_dolfinx.contact.pair.joined import JoinedInterface
from uem_dolfinx.geometry.joined_rigid import motions_of_each


def part_contacts(problem: Any) -> None:
    """Treat all contacts of a problem one by one, between two steps (collective)."""
    if all(len(pair.members) == 1 for pair in problem.interfaces):
        return
    system, before = problem.system, problem.interfaces
    on = {id(pair) for pair in system.pairs}
    known = {id(pair): (motion, id(pair) in on) for pair, motion in zip(before, problem.motions)}
    memory = problem._before
    kept = {id(pair): own for pair, own in zip(before, zip(memory.pairs, memory.motions))}
    for whole, pairs in part(problem.contacts):
        assert isinstance(whole, JoinedInterface)
        for k, pair in enumerate(pairs):
            known[id(pair)] = motions_of_each(known[id(whole)][0], len(pairs))[k], known[id(whole)][1]
            kept[id(pair)] = whole.state_of(k, kept[id(whole)][0]), motions_of_each(kept[id(whole)][1], len(pairs))[k]
    after = problem.interfaces
    problem.motions = [known[id(pair)][0] for pair in after]
    remembered, motions = ([kept[id(pair)][i] for pair in after] for i in range(2))
    problem._before = replace(memory, pairs=remembered, motions=motions)
    problem.watch.begin()
    system.regroup([pair for pair in after if known[id(pair)][1]])
    system.floating.take(system.pairs, system.far_apart)
