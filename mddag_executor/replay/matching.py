# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which declared callbacks those of an imported recording are (CARET, ros2_tracing).

Theory of operation
-------------------
Nothing in such a recording says which callback is which of a graph.  A callback of the graph is
found by its node's name and by what starts it:

* a timer by its period (``binding.is_period``); where a node's periods differ from the declared
  ones, but there are as many timers, by order, and that is said,
* a subscription, and each leg of a sync callback, by its topic,
* a service by its name.

Several that look the same are distinguished by order: in the file, and in which they were made.  A
node that was started more than once, or in several processes, is matched each time.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

from mddag_executor.replay.entities import Callback, Entities, Node
from mddag_executor.replay.mapping import asked, first_meant
from mddag_executor.replay.recording import ReplayError
from mddag_executor.text import counted, listed
from msg_graph import Callback as Declared
from msg_graph import format_duration, TaskSet
from msg_graph.binding import is_period

NO_TASK_SET = TaskSet((), (), (), (), None, '', '')
"""The declaration of those who gave none."""


class Target(NamedTuple):
    """A declared callback that a recorded one stands for, and the leg of it that it is."""

    callback: Declared
    leg: int
    topic: str


class Matching:
    """
    Which declared callbacks those of a recording are.

    :param entities: who is who in it.
    :param threads: the processes and threads that ran callbacks.
    :param judge: the declaration that judges; None: there is none.
    """

    def __init__(
        self, name: str, entities: Entities, threads: Set[tuple[int, int]], judge: TaskSet | None
    ) -> None:
        self.task_set = NO_TASK_SET if judge is None else judge
        self.warnings: list[str] = []
        #: By number of a recorded callback.
        self.target: dict[int, Target] = {}
        self._other_periods: list[str] = []
        if judge is None:
            return
        instances: dict[str, dict[Node, list[Callback]]] = {}
        for callback in entities.every:
            if callback.node is not None:
                nodes = instances.setdefault(callback.node.name, {})
                nodes.setdefault(callback.node, []).append(callback)
        found: set[str] = set()
        for node in dict.fromkeys(c.node for c in judge.callbacks):
            declared = [c for c in judge.callbacks if c.node == node]
            for callbacks in instances.get(node, {}).values():
                found |= self._match(declared, sorted(callbacks, key=lambda c: (c.made, c.number)))
        self._report(name, entities, threads, judge, found)

    def _match(self, declared: list[Declared], recorded: list[Callback]) -> set[str]:
        """Match a node's callbacks; return the keys of those found."""
        free: dict[tuple[str, str], list[Callback]] = {}
        for callback in recorded:
            what = str(callback.period) if callback.kind == 'timer' else callback.start
            free.setdefault((callback.kind, what), []).append(callback)
        found: set[str] = set()
        timers: list[Declared] = []
        for one in declared:
            if one.kind == 'timer':
                period = one.timer_period_ns or 0
                near = [int(what) for (kind, what), some in free.items()
                        if kind == 'timer' and some and is_period(int(what), period)]
                wanted = [('timer', str(min(near, key=lambda p: abs(p - period), default='')))]
            elif one.kind == 'service':
                wanted = [('service', one.service or '')]
            else:
                wanted = [('subscription', topic) for topic in one.topics]
            for leg, key in enumerate(wanted):
                if free.get(key):
                    self.target[free[key].pop(0).number] = Target(
                        one, leg, key[1] if key[0] == 'subscription' else '')
                    found.add(one.key)
                elif one.kind == 'timer':
                    timers.append(one)
        left = [c for c in recorded if c.kind == 'timer' and c.number not in self.target]
        if timers and len(timers) == len(left):
            for one, callback in zip(timers, left):
                self.target[callback.number] = Target(one, 0, '')
                found.add(one.key)
                self._other_periods.append(
                    f'{one.key} ({format_duration(callback.period)} instead of '
                    f'{format_duration(one.timer_period_ns or 0)})')
        return found

    def _report(
        self, name: str, entities: Entities, threads: Set[tuple[int, int]], judge: TaskSet,
        found: set[str],
    ) -> None:
        absent = [c for c in judge.callbacks if c.key not in found]
        missing = [c.key for c in absent]
        others = [c.entity for c in entities.every
                  if c.entity is not None and c.number not in self.target]
        if len(missing) == len(judge.callbacks):
            known = [c.label for c in entities.every if c.kind != 'service']
            has = f'it has {listed(known)}' if known else 'it does not say what its callbacks are'
            raise ReplayError(
                name, f'none of the callbacks of {judge.file} is in it: {has}',
                first_meant(absent, others) or
                'give the graph of the nodes that were recorded, or none')
        if missing:
            self.warnings.append(
                f'{name}: not in it: {len(missing)} of the {len(judge.callbacks)} '
                f'callbacks of {judge.file}, which count as never completed: {listed(missing)}'
                + asked(absent, others))
        if self._other_periods:
            self.warnings.append(
                f'{name}: {counted(len(self._other_periods), "timer")} with another '
                f'period than declared: {listed(self._other_periods)}')
        processes = len({pid for pid, _ in threads})
        if processes > 1:
            self.warnings.append(
                f'{name}: {processes} processes ran callbacks, each with workers of its own: '
                f'{counted(len(threads), "thread")} are taken together')
