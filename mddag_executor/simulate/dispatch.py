# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How simulated workers get executions: one by one, with preemption, by polling, or in processes.

Theory of operation
-------------------
The core chooses what runs next on an idle worker, live and here.  Only simulation has the rest:

* **The worker.**  A fresh execution goes to the idle worker with the lowest number.
* **Preemption.**  If no worker is idle, the running execution with the largest priority (ties: the
  highest worker number) is put back, if its priority is strictly larger than the smallest waiting
  one.  Migration is free; overheads are added to the remaining execution time.
* **Polling**: see ``polling``.
* **Several processes** (``pool.divide``).  One state represents all processes of a run.  Each has
  its own workers and interpreter: an execution without an idle worker in its process is deferred,
  and others overtake it.  There is no preemption and no polling then.
"""

from __future__ import annotations

from heapq import heapify

from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.queues import come_forward, defer, first_of, may_start, wait_alone
from mddag_executor.core.rules import lend, let_group, peek, take
from mddag_executor.core.state import N_IDLE, ORDER, State, WAITING
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.polling import take_polled
from mddag_executor.simulate.pool import (
    DISPATCH_OVERHEAD,
    idle_worker,
    POLLING,
    Pool,
    PREEMPTIVE,
    SWITCH_OVERHEAD,
)


def dispatch(t: Tables, s: State, p: Pool, key: KeyFunction, now: int) -> int:
    """
    Dispatch one execution and return it, or -1 when there is none to dispatch.

    The engine calls this until it returns -1.
    """
    if p.scalars[POLLING] != 0:
        x = take_polled(t, s, p, now)
    elif len(p.process) > 0:
        x = _take_of_several(t, s, p, now)
    elif s.scalars[N_IDLE] > 0:
        x = take(t, s, idle_worker(s, p, 1), now)
    else:
        x = peek(t, s, now)
        if x >= 0:
            x = _preempt(t, s, p, key, x, now) if p.scalars[PREEMPTIVE] != 0 else -1
    if x >= 0:
        s.x_left[x] += p.scalars[DISPATCH_OVERHEAD]
    return x


def _preempt(t: Tables, s: State, p: Pool, key: KeyFunction, x: int, now: int) -> int:
    """Dispatch what comes first on the worker of a less urgent execution, if there is one."""
    worker = 0
    largest = s.x_key[s.worker_x[0]][0]
    for w in range(1, len(s.worker_x)):
        priority = s.x_key[s.worker_x[w]][0]
        if priority >= largest:
            worker, largest = w, priority
    key_of_first = s.queue_key[s.x_queue[x]] if s.x_state[x] == WAITING else s.x_key[x]
    if largest <= key_of_first[0]:
        return -1
    victim = s.worker_x[worker]
    lend(s, victim)
    x = take(t, s, worker, now)
    _put_back(t, s, p, key, victim, now)
    return x


def _put_back(t: Tables, s: State, p: Pool, key: KeyFunction, x: int, now: int) -> None:
    """Put a preempted execution back into the ready queue with its remaining time."""
    s.x_left[x] += p.scalars[SWITCH_OVERHEAD] - (now - s.x_started[x])
    s.scalars[ORDER] += 1
    slot = s.x_slot[x]
    s.x_key[x] = key(
        t, s.x_vertex[x], s.job_release[slot], s.job_index[slot], s.scalars[ORDER]) + (~x,)
    wait_alone(s, x)


def _take_of_several(t: Tables, s: State, p: Pool, now: int) -> int:
    """Dispatch what comes first among the executions of processes that have an idle worker."""
    _bring_forward(s, p)
    x = peek(t, s, now)
    worker = -1
    while x >= 0:
        worker = idle_worker(s, p, s.process[s.x_vertex[x]])
        if worker >= 0:
            break
        defer(s, s.ready, p.aside)
        let_group(s, x)
        x = peek(t, s, now)
    if x >= 0:
        x = take(t, s, worker, now)
    for i in range(len(p.aside)):
        s.deferred.append(p.aside[i])
    p.aside.clear()
    heapify(s.deferred)
    return x


def _bring_forward(s: State, p: Pool) -> None:
    """Move the deferred executions that may start now into the ready heap."""
    kept = 0
    for i in range(len(s.deferred)):
        entry = s.deferred[i]
        process = s.process[s.x_vertex[first_of(s, entry)]]
        if may_start(s, entry) and idle_worker(s, p, process) >= 0:
            come_forward(s, entry)
        else:
            s.deferred[kept] = entry
            kept += 1
    del s.deferred[kept:]
    # the core does not look at these: it knows of the interpreter only
    for i in range(kept):
        p.aside.append(s.deferred[i])
    s.deferred.clear()
