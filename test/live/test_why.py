# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The cause of a miss, as far as the executor knows it at once: by hand, in virtual time."""

from __future__ import annotations

from mddag_executor.core import Scheduler, Tables
from mddag_executor.core.state import Decision
from mddag_executor.live.verdicts import Verdicts
from msg_graph import loads
import pytest

MS = 1_000_000
GRAPH = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: tick, timer: 100ms, publishes: [/x]}]
  - node: /b
    callbacks: [{name: use, subscription: /x, deadline: 10ms}]
"""


class Driven:
    """A core whose job 0 is driven by hand; times in ms after its release."""

    def __init__(self) -> None:
        task_set = loads(GRAPH)
        tables = Tables.build(task_set, legs=True)
        self.core = Scheduler(tables, 1, propagate=False)
        self.verdicts = Verdicts(task_set, tables, None, None)
        self.slot = self.core.release(0, 0, 0, 0)

    def run(self, vertex: int, ready: int, start: int, end: int) -> None:
        x = self.core.execution(self.slot, vertex, 0)
        self.core.ready(x, ready * MS)
        assert self.core.schedule(start * MS) == x
        self.core.complete(x, end * MS)
        self.take(end)

    def take(self, now: int) -> None:
        decisions: list[Decision] = self.core.decisions()
        self.verdicts.add(decisions, now * MS, self.core.state)

    def causes(self) -> dict[str, int]:
        return {cause: n for cause, n in self.verdicts.causes[0].items() if n}


@pytest.mark.parametrize(('cause', 'tick', 'use'), [
    ('waited', (0, 1, 2), (3, 12, 13)), ('waited', (0, 8, 9), (9, 10, 12)),
    ('ran long', (0, 1, 9), (9, 10, 20)), ('ran long', (0, 0, 1), (1, 1, 11)),
    ('released late', (9, 9, 10), (10, 10, 12)), ('released late', (5, 7, 8), (8, 9, 11))])
def test_late(cause: str, tick: tuple[int, int, int], use: tuple[int, int, int]) -> None:
    driven = Driven()
    driven.run(0, *tick)
    driven.run(1, *use)
    assert driven.causes() == {cause: 1}


def test_never_completed() -> None:
    lost = Driven()
    lost.run(0, 0, 0, 1)
    lost.core.expire(lost.slot, 50 * MS)
    lost.take(50)
    assert lost.causes() == {'lost': 1}
    for noticed, cause in ((50, 'released late'), (1, 'waited')):
        skipped = Driven()
        skipped.core.expire(skipped.slot, noticed * MS)
        skipped.take(noticed)
        assert skipped.causes() == {cause: 1}
    failed = Driven()
    failed.run(0, 0, 0, 1)
    failed.core.fail_open(failed.slot, 2 * MS)
    failed.take(2)
    assert failed.causes() == {'failed': 1}


def test_a_stop_that_is_known_later_was_the_cause() -> None:
    driven = Driven()
    driven.run(0, 0, 1, 2)
    driven.run(1, 3, 12, 13)
    assert driven.causes() == {'waited': 1}
    driven.verdicts.stopped(4 * MS, 12 * MS)      # too short for a stop
    assert driven.causes() == {'waited': 1}
    driven.verdicts.stopped(-10 * MS, 12 * MS)
    assert driven.causes() == {'machine': 1}
    assert driven.verdicts.stops.result()['misses'] == 1
