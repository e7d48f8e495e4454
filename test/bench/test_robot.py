# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from mddag_executor.executor.bench.loads import judge
from msg_graph import loads

GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: step, timer: 20ms, deadline: 5ms}
"""
MS = 1_000_000


def judged(*log: tuple[float, float], begin: float = 100, end: float = 205) -> dict[str, int]:
    """Return the verdicts about a log of (stamp, done), in ms."""
    found = judge(loads(GRAPH), {'/n:step': [(int(s * MS), int(d * MS)) for s, d in log]},
                  int(begin * MS), int(end * MS))['/n:step']
    return {name: found[name] for name in ('due', 'on_time', 'late', 'missing')}


def test_what_is_due_in_the_window_is_judged_by_its_stamp() -> None:
    log = [(81, 82), (101, 102), (121, 126), (141, 146.1), (181, 182), (201, 203)]
    assert judged(*log) == {'due': 5, 'on_time': 3, 'late': 1, 'missing': 1}


def test_whoever_does_nothing_misses_all() -> None:
    assert judged() == {'due': 6, 'on_time': 0, 'late': 0, 'missing': 6}
