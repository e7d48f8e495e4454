# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random graphs with one source and a given number of sinks.

Theory of operation
-------------------
Callbacks are numbered in a topological order: 0 is the source, the last ones are the sinks.  Each
pair whose first callback is not a sink has an edge with the given probability (Erdos and Renyi).
Then each callback without a predecessor gets one, and each callback that is not a sink and has no
successor gets one, drawn from the callbacks that are allowed.

A callback with several predecessors joins their messages (AND), or runs once for each (OR).  As OR
multiplies what comes after it, a callback that would run more than ``MOST_COPIES`` times for each
job joins instead.
"""

from __future__ import annotations

from dataclasses import dataclass

from mddag_executor.laboratory.shares import Dice

MOST_COPIES = 16


@dataclass(frozen=True)
class Shape:
    """
    A graph of callbacks.

    :ivar predecessors: of each callback, ascending.
    :ivar is_or: whether a callback runs once for each message of its several predecessors.
    :ivar copies: how often a callback runs for each job: as many vertices the DAG has of it.
    :ivar first_sink: the callbacks from this one on are the sinks.
    """

    predecessors: tuple[tuple[int, ...], ...]
    is_or: tuple[bool, ...]
    copies: tuple[int, ...]
    first_sink: int

    @property
    def count(self) -> int:
        """Count the callbacks."""
        return len(self.predecessors)


def draw_shape(
    dice: Dice, count: int, sinks: int, edge_probability: float, or_share: float
) -> Shape:
    """Return a random graph; there are fewer sinks than callbacks, unless there is one of each."""
    inner = count - sinks if count > 1 else 1
    before: list[set[int]] = [set() for _ in range(count)]
    for after in range(1, count):
        for earlier in range(min(after, inner)):
            if dice.chance(edge_probability):
                before[after].add(earlier)
    for after in range(1, count):
        if not before[after]:
            before[after].add(dice.whole(0, min(after, inner) - 1))
    leads_on = set().union(*before)
    for place in range(inner if count > 1 else 0):
        if place not in leads_on:
            before[dice.whole(place + 1, count - 1)].add(place)
    copies: list[int] = []
    is_or: list[bool] = []
    for after in range(count):
        runs = sum(copies[p] for p in before[after])
        several = len(before[after]) > 1
        is_or.append(several and dice.chance(or_share) and runs <= MOST_COPIES)
        copies.append(1 if after == 0 or (several and not is_or[-1]) else runs)
    return Shape(
        tuple(tuple(sorted(each)) for each in before), tuple(is_or), tuple(copies),
        inner if count > 1 else 0)
