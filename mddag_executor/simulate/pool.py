# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated workers: which process each worker belongs to, and how it gets executions."""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.core.queues import first_of
from mddag_executor.core.state import add_process, QueueEntry, State
from mddag_executor.core.tables import NEVER, Tables

# Columns of ``Pool.scalars``: whether a more urgent execution preempts a running one; whether the
# workers poll (see ``polling``); what is added to the execution time at each dispatch and at each
# preemption, ns; the order number of the last execution that was ready at the last poll.
PREEMPTIVE, POLLING, DISPATCH_OVERHEAD, SWITCH_OVERHEAD, POLLED_UNTIL = range(5)


# Kinds of log entries.  JOB_ENDED: a job ended early, but not because an execution failed.
START, END, PREEMPT, RELEASE, JOB_ENDED = range(5)

LogEntry = tuple[int, int, int, int, int, int]
"""
An entry of the log: time, kind, worker (or -1), DAG, vertex, job.

``RELEASE`` has the release of the job instead of a vertex, ``JOB_ENDED`` how the job ended.
"""


class Pool(NamedTuple):
    """Everything that changes about the workers during a run; filled by ``fill_pool``."""

    scalars: list[int]
    # by worker: when its execution ends; since when it runs it; how long it has run any; the
    # execution that it was dispatched last, if that has not ended
    finish_at: list[int]
    since: list[int]
    busy: list[int]
    running: list[int]
    # if wanted, the log: what happened, in the order in which the engine processed it; and how
    # many decisions it contains already
    log: list[LogEntry]
    logged: list[int]
    # if there are several processes: the process of each worker, from 1
    process: list[int]
    # under a policy that polls, by queue: the order number of its entry in the present round
    polled: list[int]
    # during a poll, by entity: the order number of its first entry
    first_order: list[int]
    # during a dispatch: entries that are set aside
    aside: list[QueueEntry]


def fill_pool(
    t: Tables, s: State, p: Pool, preemptive: int, polling: int, dispatch_overhead: int,
    switch_overhead: int,
) -> None:
    """
    Fill the columns of an empty pool of one process.

    :param preemptive: 1: an execution with a smaller key takes the worker of one with a larger.
    :param polling: 1: the workers poll; never together with preemption.
    """
    for value in (preemptive, polling, dispatch_overhead, switch_overhead, 0):
        p.scalars.append(value)
    for _ in range(len(s.worker_x)):
        p.finish_at.append(NEVER)
        p.since.append(-1)
        p.busy.append(0)
        p.running.append(-1)
    p.logged.append(0)
    if polling != 0:
        for _ in range(len(s.queue_first)):
            p.polled.append(-1)
        for _ in range(t.n_entities):
            p.first_order.append(NEVER)


def divide(t: Tables, s: State, p: Pool, workers: list[int]) -> None:
    """Divide the workers among several processes with an interpreter and a pool each."""
    for i in range(len(workers)):
        process = i + 1
        if process > 1:
            add_process(s, workers[i])
        s.n_workers[process] = workers[i]
        for _ in range(workers[i]):
            p.process.append(process)
    for vertex in range(t.n_vertices + 1):
        s.process[vertex] = t.process[vertex]


def idle_worker(s: State, p: Pool, process: int) -> int:
    """Return the first idle worker, of a process if there are several; -1: there is none."""
    for worker in range(len(s.worker_x)):
        if s.worker_x[worker] < 0 and (len(p.process) == 0 or p.process[worker] == process):
            return worker
    return -1


def in_round(p: Pool, entry: QueueEntry) -> bool:
    """Return whether what waits with an entry was found by the last poll; without polling all."""
    if p.scalars[POLLING] == 0:
        return True
    if entry[4] < 0:
        return entry[1] <= p.scalars[POLLED_UNTIL]
    return p.polled[entry[4]] == entry[1]


def first_to_run(s: State, p: Pool, process: int) -> int:
    """
    Return the first waiting execution that the workers know of; -1: there is none.

    :param process: 0: of any process.
    """
    first = -1
    smallest = (NEVER, 0, 0, 0, 0)
    several = len(p.process) > 0 or p.scalars[POLLING] != 0
    for heap in (s.ready, s.deferred):
        for i in range(len(heap) if several else min(1, len(heap))):
            if heap[i] < smallest and in_round(p, heap[i]):
                x = first_of(s, heap[i])
                if process == 0 or s.process[s.x_vertex[x]] == process:
                    first = x
                    smallest = heap[i]
    return first
