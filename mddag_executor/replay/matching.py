# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which declared callbacks those of a recording are, by node and by what starts them.

Theory of operation
-------------------
``msg_graph.binding`` has the rules.  A node that was started more than once, or in several
processes, is matched each time; of several callbacks that look the same the first one declared is
the first one made.

Nothing in a recording of CARET or ros2_tracing says more.  There, where a node's timers have other
periods than declared, but there are as many of them, they are matched by order, and that is said.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

from mddag_executor.replay.entities import Callback, Entities, Node
from mddag_executor.replay.mapping import report_missing
from mddag_executor.text import counted, listed
from msg_graph import Callback as Declared
from msg_graph import format_duration, TaskSet
from msg_graph.binding import Binder

NO_TASK_SET = TaskSet((), (), (), (), None, '', '')
"""The declaration of those who gave none."""


class Target(NamedTuple):
    """A declared callback that a recorded one stands for, and the leg of it that it is."""

    callback: Declared
    leg: int
    topic: str


def nodes_of(who: Entities) -> list[list[Callback]]:
    """Return the timers, subscriptions and services of each node, as they were made."""
    found: dict[Node, list[Callback]] = {}
    for each in sorted(who.made, key=lambda c: (c.made, c.number)):
        if each.node is not None:
            found.setdefault(each.node, []).append(each)
    return list(found.values())


def match(callbacks: list[Callback], declared: TaskSet) -> dict[int, Target]:
    """Return by number which declared callbacks those of a node are."""
    binder = Binder(declared)
    found: dict[int, Target] = {}
    for each in callbacks:
        bound = None if each.entity is None or not each.number else binder.bind(each.entity)
        if bound is not None:
            leg = bound.topics.index(each.start) if each.start in bound.topics else 0
            found[each.number] = Target(bound, leg, each.start if bound.topics else '')
    return found


def declared_keys(who: Entities, declared: TaskSet) -> dict[int, str]:
    """Return by callback's number the key of the declared one that it is."""
    return {number: target.callback.key for callbacks in nodes_of(who)
            for number, target in match(callbacks, declared).items()}


class Matching:
    """
    Which declared callbacks those of an imported recording are.

    :param who: is who in it.
    :param threads: the processes and threads that ran callbacks.
    :param judge: the declaration that judges; None: there is none.
    """

    def __init__(
        self, name: str, who: Entities, threads: Set[tuple[int, int]], judge: TaskSet | None
    ) -> None:
        self.task_set = NO_TASK_SET if judge is None else judge
        self.warnings: list[str] = []
        #: By number of a recorded callback.
        self.target: dict[int, Target] = {}
        self._other_periods: list[str] = []
        if judge is None:
            return
        for callbacks in nodes_of(who):
            self.target.update(self._match(callbacks, judge))
        found = {target.callback.key for target in self.target.values()}
        self.warnings += report_missing(
            name, judge, found, [c.label for c in who.every if c.kind != 'service'],
            [c.entity for c in who.every if c.entity is not None and c.number not in self.target])
        if self._other_periods:
            self.warnings.append(
                f'{name}: {counted(len(self._other_periods), "timer")} with another '
                f'period than declared: {listed(self._other_periods)}')
        processes = len({pid for pid, _ in threads})
        if processes > 1:
            self.warnings.append(
                f'{name}: {processes} processes ran callbacks, each with workers of its own: '
                f'{counted(len(threads), "thread")} are taken together')

    def _match(self, callbacks: list[Callback], judge: TaskSet) -> dict[int, Target]:
        found = match(callbacks, judge)
        node, known = callbacks[0].node_name, {t.callback.key for t in found.values()}
        timers = [c for c in judge.callbacks
                  if c.node == node and c.kind == 'timer' and c.key not in known]
        left = [c for c in callbacks
                if c.kind == 'timer' and c.number and c.number not in found]
        for one, callback in zip(timers, left) if len(timers) == len(left) else ():
            found[callback.number] = Target(one, 0, '')
            self._other_periods.append(
                f'{one.key} ({format_duration(callback.period)} instead of '
                f'{format_duration(one.timer_period_ns or 0)})')
        return found
