# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Federated scheduling, after Li, Chen, Agrawal, Lu, Gill and Saifullah (ECRTS 2014).

Theory of operation
-------------------
Workers are given away: to a *heavy* DAG, which one worker alone could not do in time, so many for
itself as Graham's bound asks for; the *light* DAGs share what is left, each of them whole on one
worker, under RAD with preemption.

1. A job is to be done before the next one comes, so the deadline of a sink is min(D_v, T) here.
2. Heavy: vol > the least of these. n workers are enough if for each sink len_v + (vol - len_v) / n
   is at most its deadline.
3. Light: if the sum of vol / least deadline (density) of the DAGs on one worker is at most 1, EDF
   would have each whole job done by its least deadline. RAD is EDF for the vertices, whose RADs
   are no earlier, and never puts one before its predecessors; so it keeps the RADs, and with them
   all deadlines. The DAGs are put on the first worker that has room, the densest first.

The paper has one deadline for each DAG, equal to the period; rules 1 to 3 are the same for others.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from mddag_executor.analysis.model import Task


class Federation(NamedTuple):
    """Workers for each heavy DAG (by name), and the light DAGs on each shared worker."""

    own: dict[str, int]
    shared: tuple[tuple[str, ...], ...]

    @property
    def workers(self) -> int:
        """Return how many workers it takes."""
        return sum(self.own.values()) + len(self.shared)


def federation(tasks: Sequence[Task]) -> Federation | str:
    """Return a federation that keeps all deadlines, or the name of a DAG that no number helps."""
    own: dict[str, int] = {}
    light: list[tuple[Fraction, str]] = []
    for task in tasks:
        least = min(min(deadline, task.period) for _, deadline, _ in task.sinks)
        if task.volume <= least:
            light.append((Fraction(task.volume, least), task.dag.name))
            continue
        need = 1
        for _, deadline, length in task.sinks:
            spare = min(deadline, task.period) - length
            rest = task.volume - length
            if spare < 0 or (spare == 0 and rest > 0):
                return task.dag.name
            if rest:
                need = max(need, -(-rest // spare))
        own[task.dag.name] = need
    shared: list[tuple[Fraction, list[str]]] = []
    for density, name in sorted(light, key=lambda each: -each[0]):
        for place, (taken, names) in enumerate(shared):
            if taken + density <= 1:
                shared[place] = (taken + density, [*names, name])
                break
        else:
            shared.append((density, [name]))
    return Federation(own, tuple(tuple(names) for _, names in shared))
