# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Invariants of the state between two calls of the rules; for debugging.

The rules themselves are in ``rules``, the queues in ``queues``, and jobs in ``jobs``.
"""

from __future__ import annotations

from collections.abc import Iterator

from mddag_executor.core.queues import is_stale
from mddag_executor.core.state import (
    FREE,
    N_HOLDING,
    N_IDLE,
    N_STALE,
    OPEN,
    QueueEntry,
    RUNNING,
    State,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import Tables

ACTIVE = (WAITING, RUNNING, SUSPENDED)


def broken_invariants(t: Tables, s: State) -> Iterator[str]:
    """Yield a sentence for each invariant that does not hold."""
    yield from _queues(s)
    yield from _workers(s)
    yield from _groups(t, s)
    yield from _slots(t, s)
    yield from _open_jobs(t, s)


def _all_queues(s: State) -> Iterator[tuple[str, list[QueueEntry]]]:
    yield 'the ready queue', s.ready
    yield 'what is held back', s.held_back
    for group, heap in enumerate(s.group_heap):
        if heap:
            yield f'the heap of group {group}', heap
    for entity, queue in enumerate(s.entity_queue):
        if queue:
            yield f'the queue of entity {entity}', queue


def _queues(s: State) -> Iterator[str]:
    stale = 0
    found: set[int] = set()
    for name, queue in _all_queues(s):
        for place, entry in enumerate(queue):
            if place > 0 and queue[(place - 1) // 2] > entry:
                yield f'{name} is not a heap at its place {place}'
            x = entry[4]
            if is_stale(s, entry) or x in found:  # of two equal entries, one is stale
                stale += 1
            else:
                found.add(x)
    for number, rest in enumerate(s.queue_rest):
        first = s.queue_first[number]
        for order, _, _, _, x in rest:
            if s.x_queue[x] != number or s.x_key[x][3] != order or first < 0:
                yield f'execution {x} waits in queue {number}, the first of which is {first}'
            found.add(x)
    if stale != s.scalars[N_STALE]:
        yield f'{stale} entries of queues are stale, counted are {s.scalars[N_STALE]}'
    if len(found) != s.x_state.count(WAITING):
        lost = [x for x, state in enumerate(s.x_state) if state == WAITING and x not in found]
        yield f'the waiting executions {lost} are in no queue'
    to_poll = [entity for entity, queue in enumerate(s.entity_queue) if queue]
    if sorted(s.unpolled) != to_poll:
        yield f'the entities {to_poll} wait for a poll, noted are {sorted(s.unpolled)}'


def _workers(s: State) -> Iterator[str]:
    idle = s.worker_x.count(-1)
    if idle != s.scalars[N_IDLE]:
        yield f'{idle} workers are idle, counted are {s.scalars[N_IDLE]}'
    holding = 0
    for worker, x in enumerate(s.worker_x):
        if x < 0:
            continue
        holding += s.x_holds[x] != 0
        if s.x_state[x] != RUNNING or s.x_worker[x] != worker:
            yield (f'worker {worker} runs execution {x}, which has state {s.x_state[x]} and '
                   f'worker {s.x_worker[x]}')
    if len(s.x_worker) - s.x_worker.count(-1) != len(s.worker_x) - idle:
        yield 'an execution has a worker that does not run it'
    if holding != s.scalars[N_HOLDING]:
        yield f'{holding} executions hold the interpreter, counted are {s.scalars[N_HOLDING]}'


def _groups(t: Tables, s: State) -> Iterator[str]:
    for group, owner in enumerate(s.group_owner):
        if owner >= 0 and (s.x_group[owner] != group or s.x_state[owner] not in ACTIVE):
            yield (f'group {group} is owned by execution {owner}, which has group '
                   f'{s.x_group[owner]} and state {s.x_state[owner]}')
    coming = {s.x_group[entry[4]] for entry in (*s.ready, *s.held_back)
              if not is_stale(s, entry)}
    for group, heap in enumerate(s.group_heap):
        waiting = [entry[4] for entry in heap if not is_stale(s, entry)]
        if waiting and s.group_owner[group] < 0 and group not in coming:
            yield f'group {group} is free, and nothing brings its executions {waiting} forward'
        for x in waiting:
            if s.x_group[x] != group:
                yield f'execution {x} of group {s.x_group[x]} waits for group {group}'


def _slots(t: Tables, s: State) -> Iterator[str]:
    active_slots = 0
    for slot, dag in enumerate(s.job_dag):
        if dag == t.n_dags:
            active_slots += s.x_state[s.job_base[slot]] in ACTIVE
            continue
        if s.job_state[slot] == FREE:
            if s.job_active[slot] != 0:
                yield f'slot {slot} is free, and {s.job_active[slot]} executions are active'
            continue
        base = s.job_base[slot]
        active = 0
        for x in range(base, base + t.n_region[dag]):
            state = s.x_state[x]
            if state not in ACTIVE:
                continue
            active += 1
            group = s.x_group[x]
            if state != WAITING and group >= 0 and s.group_owner[group] != x:
                yield (f'execution {x} runs or is suspended, and its group {group} is owned by '
                       f'{s.group_owner[group]}')
        if active != s.job_active[slot]:
            yield (f'{active} executions of slot {slot} are active, counted are '
                   f'{s.job_active[slot]}')
        if active == 0 and s.job_state[slot] != OPEN:
            yield f'nothing of the ended job in slot {slot} is active, and it is not free'
        active_slots += active
    if active_slots != sum(map(s.x_state.count, ACTIVE)):
        yield 'executions of free slots are active'
    unused = sorted(s.job_base[slot] for slot, dag in enumerate(s.job_dag)
                    if dag == t.n_dags and s.x_state[s.job_base[slot]] not in ACTIVE)
    if sorted(s.undeclared) != unused:
        yield f'the undeclared executions {unused} are unused, noted are {sorted(s.undeclared)}'


def _open_jobs(t: Tables, s: State) -> Iterator[str]:
    of_dag: dict[tuple[int, int], set[int]] = {}
    for slot, dag in enumerate(s.job_dag):
        of_dag.setdefault((dag, s.job_state[slot]), set()).add(slot)
    for dag in range(t.n_dags):
        free = _chain(s.job_next, s.free_slot[dag], len(s.job_dag))
        if len(free) != len({*free}) or {*free} != of_dag.get((dag, FREE), set()):
            yield f'the list of free slots of DAG {dag} is {free}'
        jobs = _chain(s.job_next, s.oldest[dag], len(s.job_dag))
        back = _chain(s.job_previous, s.newest[dag], len(s.job_dag))
        if jobs != back[::-1] or {*jobs} != of_dag.get((dag, OPEN), set()):
            yield f'the list of open jobs of DAG {dag} is {jobs}, backwards {back}'
        if len(jobs) != s.n_open[dag]:
            yield f'{len(jobs)} jobs of DAG {dag} are open, counted are {s.n_open[dag]}'


def _chain(links: list[int], first: int, most: int) -> list[int]:
    """Return a linked list, but not much more of it than there can be."""
    found: list[int] = []
    while first >= 0 and len(found) <= most:
        found.append(first)
        first = links[first]
    return found
