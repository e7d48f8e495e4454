# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rule that tells a stop of the process from a busy one."""

from __future__ import annotations

import time
from typing import Any

from mddag_executor.live.stop_watch import SHORT_NS, SLICE_NS, StopWatch
import pytest

from .conftest import Spinning, wait_for

MS = 1_000_000


class Machine:
    """A virtual clock, and a bell whose waits end late as they are told to: (wall, CPU)."""

    def __init__(self, *late: tuple[int, int], set_after: int = 0) -> None:
        self.now, self.cpu = 1000 * MS, 5 * MS
        self.late = list(late)
        self.set_after = set_after
        self.waits: list[int] = []

    def wait(self, seconds: float) -> bool:
        late, cpu = self.late.pop(0) if self.late else (0, 0)
        self.waits.append(round(seconds * 1e9))
        self.now += self.waits[-1] + late
        self.cpu += cpu
        return len(self.waits) == self.set_after

    def stops(self, seconds: float) -> list[tuple[int, int]]:
        """Return the stops while it waited, from its begin."""
        found: list[tuple[int, int]] = []
        begin = self.now
        bell: Any = self
        StopWatch(bell, lambda *stop: found.append(stop), lambda: self.now,
                  lambda: self.cpu).wait(seconds)
        return [(first - begin, last - begin) for first, last in found]


def test_it_waits_in_slices_to_the_end() -> None:
    machine = Machine()
    assert machine.stops(0.05) == []
    assert machine.waits == [SLICE_NS, SLICE_NS, 50 * MS - 2 * SLICE_NS]
    machine = Machine()
    machine.stops(0.0)
    assert machine.waits == []


def test_a_stop_beyond_the_end_is_one_stop() -> None:
    machine = Machine((300 * MS, 0))
    assert machine.stops(0.1) == [(20 * MS, 320 * MS)]
    assert machine.waits == [SLICE_NS]


def test_a_stop_between_two_waits_is_one() -> None:
    found: list[tuple[int, int]] = []
    machine = Machine()
    bell: Any = machine
    watch = StopWatch(bell, lambda *stop: found.append(stop), lambda: machine.now,
                      lambda: machine.cpu)
    machine.now += 500 * MS
    watch.start()  # what was before does not count
    machine.now += 300 * MS
    machine.cpu += 10 * MS
    watch.wait(0.05)
    assert found == [(1500 * MS, 1500 * MS), (1520 * MS + 10 * MS, 1820 * MS)]


def test_it_waits_no_longer_than_until_it_rings() -> None:
    machine = Machine(set_after=2)
    machine.stops(0.1)
    assert machine.waits == [SLICE_NS, SLICE_NS]


@pytest.mark.parametrize(('late', 'cpu', 'stop'), [
    (300 * MS, 0, True), (300 * MS, 200 * MS, True), (300 * MS, 300 * MS - SHORT_NS, True),
    (300 * MS, 300 * MS - SHORT_NS + 1, False), (300 * MS, 600 * MS, False),
    (SHORT_NS, 0, True), (SHORT_NS - 1, 0, False)])
def test_a_stop_is_long_and_takes_no_cpu_time(late: int, cpu: int, stop: bool) -> None:
    expected = [(SLICE_NS + cpu, SLICE_NS + late)] if stop else []
    assert Machine((late, cpu)).stops(0.02) == expected
    assert Machine((late, cpu), set_after=1).stops(0.1) == expected


def test_only_the_cpu_time_of_the_slice_counts() -> None:
    machine = Machine((0, 500 * MS), (100 * MS, 0), (30 * MS, 30 * MS), (50 * MS, 0))
    assert machine.stops(1.0) == [(40 * MS, 140 * MS), (210 * MS, 260 * MS)]


def test_a_callback_that_keeps_the_interpreter_busy_is_no_stop(make_executor, make_node) -> None:
    """It holds the interpreter's lock for a long time; CPU time tells that from a stop."""
    runs: list[int] = []
    node = make_node('busy')
    # each run is one step of the interpreter
    node.create_timer(0.01, lambda: runs.append(sum(range(10_000_000))))
    executor = make_executor()
    executor.add_node(node)
    wall, cpu = time.monotonic_ns(), time.process_time_ns()
    with Spinning(executor):
        assert wait_for(lambda: len(runs) >= 8, 60.0)
    wall, cpu = time.monotonic_ns() - wall, time.process_time_ns() - cpu
    # A loaded machine takes the CPU away, and that is a stop; other threads compute, too.
    assert executor.statistics()['stops']['total_ns'] <= wall / 4 + 1.5 * max(0, wall - cpu)
