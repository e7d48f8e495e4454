# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The policy ``ros2``: the workers poll, as in the executors of rclcpp and rclpy.

Theory of operation
-------------------
1.  An *entity* is what a wait set contains: a timer, or a subscription with its waiting messages.
    Vertices of one callback are one entity; executions of undeclared callbacks are an entity each.
2.  When an idle worker finds nothing to run in the present *round*, it polls: the first waiting
    execution of each entity forms the next round.  So each entity runs at most once in a round.
    Executions that become ready later wait for the next poll.
3.  An execution whose callback group is busy when its turn comes leaves the round, and waits for
    the next poll.  A poll that finds only such executions is the last one at this instant.
4.  There is no preemption, and one process only.

All waiting executions are in the core's queues, as under any other policy; ``Pool.polled`` says
which of them are in the round.  The core gets to see only the one that comes first.
"""

from __future__ import annotations

from heapq import heappush

from mddag_executor.core.policies import Key
from mddag_executor.core.queues import first_of, may_start
from mddag_executor.core.rules import take
from mddag_executor.core.state import N_IDLE, ORDER, State
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.simulate.pool import idle_worker, in_round, POLLED_UNTIL, Pool


def key_ros2(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """
    Return the key of rclcpp's executor within a polling round: the index in the wait set.

    Timers come first, then subscriptions, services and clients, each in order of registration,
    which is that of the declaration (rclpy visits them node by node).  Source: D. Casini et al.,
    "Response-Time Analysis of ROS 2 Processing Chains Under Reservation-Based Scheduling", ECRTS
    2019; for several workers X. Jiang et al., "Real-Time Scheduling and Analysis of Processing
    Chains on Multi-Threaded Executor in ROS 2", RTSS 2022; and rclcpp of Jazzy, which checks also
    timers only when it polls.
    """
    return (t.entity[v], order, 0, 0)


def take_polled(t: Tables, s: State, p: Pool, now: int) -> int:
    """Dispatch the next execution of the round, or of a new one, and return it, or -1."""
    if s.scalars[N_IDLE] == 0:
        return -1
    place = _next_place(s, p)
    if place < 0 and _poll(s, p):
        place = _next_place(s, p)
    if place < 0:
        return -1
    for i in range(len(s.ready)):
        if i != place:
            p.aside.append(s.ready[i])
    entry = s.ready[place]
    s.ready.clear()
    s.ready.append(entry)
    x = take(t, s, idle_worker(s, p, 1), now)
    for i in range(len(p.aside)):
        heappush(s.ready, p.aside[i])
    p.aside.clear()
    return x


def _next_place(s: State, p: Pool) -> int:
    """Return the place in the ready heap of the first execution of the round that may start."""
    last = (-1, 0, 0, 0, 0)
    while True:
        place = -1
        first = (NEVER, 0, 0, 0, 0)
        for i in range(len(s.ready)):
            entry = s.ready[i]
            if last < entry and entry < first and in_round(p, entry):
                place = i
                first = entry
        if place < 0:
            return -1
        group = s.x_group[first_of(s, first)]
        if group >= 0 and s.group_owner[group] != -1:
            p.polled[first[4]] = -1
        elif may_start(s, first):
            return place
        last = first


def _poll(s: State, p: Pool) -> bool:
    """Begin a round; return whether anything waited for it."""
    found = False
    for i in range(len(s.ready)):
        entry = s.ready[i]
        if not in_round(p, entry):
            found = True
            if entry[4] >= 0:
                p.first_order[entry[0]] = min(p.first_order[entry[0]], entry[1])
    for i in range(len(s.ready)):
        entry = s.ready[i]
        if entry[4] >= 0 and p.first_order[entry[0]] == entry[1]:
            p.polled[entry[4]] = entry[1]
            p.first_order[entry[0]] = NEVER
    p.scalars[POLLED_UNTIL] = s.scalars[ORDER]
    return found
