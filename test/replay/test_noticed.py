# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What noticing took in a recording."""

from __future__ import annotations

from mddag_executor.replay.alone import Recorded
from mddag_executor.replay.noticed import Noticed
from mddag_executor.simulate.intakes import Costs
from mddag_executor.simulate.machine import SWITCH_NS
import numpy as np

MS = 1_000_000
TIMER, MESSAGE = 200_000, 400_000


def recorded(count: int) -> tuple[Recorded, Noticed]:
    """
    Return executions of 5 ms of CPU time, one each 20 ms, and what was noticed.

    In turn: a timer while one computes, a message, nothing; a timer and a message where nothing
    computes.
    """
    could, took, due, ready, timer = [], [], [], [], []
    for turn in range(count):
        begin = 20 * MS * turn
        what = turn % 3
        could.append(begin)
        took.append(5 * MS + (TIMER, MESSAGE, 0)[what])
        if what < 2:
            due.append(begin + MS)
            ready.append(begin + MS + SWITCH_NS + 150_000)
            timer.append(what == 0)
        due += [begin + 10 * MS, begin + 15 * MS]
        ready += [begin + 10 * MS + 120_000, begin + 15 * MS + 180_000]
        timer += [True, False]
    one = np.ones(count, dtype=np.int64)
    return Recorded(
        np.array(could), np.array(took), 5 * MS * one, one > 0, one, one, one > 0), Noticed(
        np.array(due), np.array(ready), np.ones(len(due), dtype=np.int64), np.array(timer))


def test_who_computes_and_what_is_ready_show_what_noticing_took() -> None:
    ran, noticed = recorded(60)
    costs = noticed.costs(ran)
    assert costs == Costs(TIMER, 120_000, MESSAGE, 150_000, Costs().send_ns)


def test_of_a_few_nothing_is_known() -> None:
    ran, noticed = recorded(3)
    assert noticed.costs(ran) == Costs()


def test_where_executions_overlap_nobody_knows_who_stood_still_for_what() -> None:
    ran, noticed = recorded(60)
    both = ran.beside(ran._replace(could=ran.could + MS))
    costs = noticed.costs(both)
    assert (costs.timer_ns, costs.message_ns) == (Costs().timer_ns, Costs().message_ns)


def test_what_an_intake_did_ends_when_it_had_done_all() -> None:
    ran, noticed = recorded(60)
    costs = noticed.costs(ran)
    did = noticed.executions(costs)
    rest = np.where(noticed.timer, costs.timer_rest, costs.message_rest)
    assert (did.could + did.took == noticed.ready + rest).all()
    assert (did.could <= noticed.due).all() and did.locks.all()
    assert (did.took >= did.cpu).all()
