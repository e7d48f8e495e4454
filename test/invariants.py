# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Invariants of the core's state and of the engine, between two calls.

``MDDAG_DEBUG`` names this file while tests run: see ``mddag_executor.executor.debugging``.
"""

from __future__ import annotations

from collections.abc import Iterator

from mddag_executor.core.jobs import next_deadline
from mddag_executor.core.queues import first_of, has_place
from mddag_executor.core.state import (
    ALONE,
    DEFERRED,
    FREE,
    N_HOLDING,
    N_IDLE,
    OPEN,
    OUTER,
    PLACED,
    QueueEntry,
    READY,
    RETURNS,
    RUNNING,
    State,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import NEVER, Tables

ACTIVE = (WAITING, ALONE, RUNNING, SUSPENDED)


def broken_invariants(engine):
    """Yield a sentence for each invariant of an engine, and of its core, that does not hold."""
    yield from broken_in_core(engine.tables, engine.scheduler.state)
    yield from broken_deadlines(engine.deadlines)
    yield from _executions(engine)


# --- the core ------------------------------------------------------------------------------------

def broken_in_core(t: Tables, s: State) -> Iterator[str]:
    """Yield a sentence for each invariant of the core's state that does not hold."""
    yield from _heaps(s)
    yield from _queues(t, s)
    yield from _inheriting(t, s)
    yield from _workers(s)
    yield from _groups(t, s)
    yield from _outer_groups(s)
    yield from _slots(t, s)
    yield from _open_jobs(t, s)


def _all_heaps(s: State) -> Iterator[tuple[str, int, list[QueueEntry]]]:
    yield 'the ready heap', READY, s.ready
    yield 'the heap of deferred entries', DEFERRED, s.deferred
    for group, heap in enumerate(s.group_heap):
        yield f'the heap of group {group}', group, heap
    for outer, heap in enumerate(s.outer_heap):
        yield f'the heap of outer group {outer}', OUTER - outer, heap


def _heaps(s: State) -> Iterator[str]:
    """Check that each entry is the one of its queue or execution, where that says."""
    found: set[int] = set()
    for name, at, heap in _all_heaps(s):
        for place, entry in enumerate(heap):
            what = entry[4]
            if place > 0 and heap[(place - 1) // 2] > entry:
                yield f'{name} is not a heap at its place {place}'
            if what in found:
                yield f'{name} has a second entry of {what}'
            found.add(what)
            if what < 0 and (s.x_state[~what] != ALONE or s.x_key[~what] != entry):
                yield f'{name} has {entry} of execution {~what}: its state is {s.x_state[~what]}'
            elif what >= 0 and (entry != s.queue_key[what] or s.queue_place[what] != at):
                yield f'{name} has {entry} of queue {what}, which says {s.queue_key[what]} and ' \
                      f'place {s.queue_place[what]}'
    lost = [x for x, state in enumerate(s.x_state) if state == ALONE and ~x not in found]
    if lost:
        yield f'the executions {lost} wait alone, and are in no heap'
    full = {queue for queue, first in enumerate(s.queue_first) if first >= 0}
    if {what for what in found if what >= 0} != full:
        yield f'the queues {sorted(full)} are not empty, those in a heap are ' \
              f'{sorted(what for what in found if what >= 0)}'


def _queues(t: Tables, s: State) -> Iterator[str]:
    """Check the order in each queue, and that its key is the smallest unless it is late."""
    found: set[int] = set()
    for queue, first in enumerate(s.queue_first):
        waiting = _chain(s.x_next, first, len(s.x_state))
        back = _chain(s.x_previous, s.queue_last[queue], len(s.x_state))
        if waiting != back[::-1] or len({*waiting}) != len(waiting):
            yield f'queue {queue} is {waiting}, backwards {back}'
        for before, after in zip(waiting, waiting[1:]):
            if s.x_key[before] > s.x_key[after]:
                yield f'execution {before} is before {after} in queue {queue}'
        for x in waiting:
            if s.x_state[x] != WAITING or s.x_queue[x] != queue or s.x_started[x] >= 0:
                yield f'execution {x} in queue {queue} has state {s.x_state[x]}'
        found.update(waiting)
        if waiting and s.queue_demoted[queue] < 0 and (
                s.queue_key[queue] > _last_place(t, s, first)):
            yield f'queue {queue} is not late, and comes after its first execution'
        if not waiting and (s.queue_demoted[queue] >= 0 or s.queue_place[queue] != READY):
            yield f'queue {queue} is empty, and is late or set aside'
    if len(found) != s.x_state.count(WAITING):
        lost = [x for x, state in enumerate(s.x_state) if state == WAITING and x not in found]
        yield f'the waiting executions {lost} are in no queue'


def _last_place(t: Tables, s: State, first: int) -> QueueEntry:
    """Return the largest key of a queue that is not late, given its first execution."""
    key = s.x_key[first]
    if s.start_by[s.x_vertex[first]] == NEVER:
        return key
    if s.x_vertex[first] < t.n_vertices:
        return (NEVER, *key[1:])
    # less urgent than its key if what it has inherited is over
    return (max(key[0], s.job_release[s.x_slot[first]] + t.rad_offset[t.n_vertices]), *key[1:])


def _inheriting(t: Tables, s: State) -> Iterator[str]:
    """Check that only undeclared executions inherit."""
    for x, like in enumerate(s.x_like):
        vertex = s.x_vertex[x]
        if vertex < t.n_vertices:
            if like != vertex:
                yield f'execution {x} of vertex {vertex} is like {like}'
            continue
        if not -1 <= like < t.n_vertices:
            yield f'execution {x} inherits from vertex {like}'


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
    coming = {s.x_group[first_of(s, entry)] for entry in (
        *s.ready, *s.deferred, *(entry for heap in s.outer_heap for entry in heap))}
    for group, heap in enumerate(s.group_heap):
        waiting = [first_of(s, entry) for entry in heap]
        if waiting and s.group_owner[group] < 0 and group not in coming:
            yield f'group {group} is free, and nothing brings its executions {waiting} forward'
        for x in waiting:
            if s.x_group[x] != group:
                yield f'execution {x} of group {s.x_group[x]} waits for group {group}'


def _outer_groups(s: State) -> Iterator[str]:
    coming = {s.x_outer[first_of(s, entry)] for entry in (*s.ready, *s.deferred)}
    for x, place in enumerate(s.x_place):
        if place == RETURNS and s.x_outer[x] < 0:
            yield f'execution {x} asks for a place of an outer group, and has none'
    for outer, heap in enumerate(s.outer_heap):
        placed = [x for x, place in enumerate(s.x_place)
                  if place == PLACED and s.x_outer[x] == outer]
        if len(placed) != s.outer_running[outer]:
            yield (f'executions {placed} have places of outer group {outer}, counted are '
                   f'{s.outer_running[outer]}')
        waiting = [first_of(s, entry) for entry in heap]
        if waiting and outer not in coming and has_place(s, waiting[0]):
            yield f'outer group {outer} has places, and nothing brings {waiting} forward'
        for x in waiting:
            if s.x_outer[x] != outer:
                yield f'execution {x} of outer group {s.x_outer[x]} waits for {outer}'
        for x in placed:
            if s.x_state[x] not in (RUNNING, ALONE):
                yield f'execution {x} has a place and state {s.x_state[x]}'


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
            if state in (RUNNING, SUSPENDED) and group >= 0 and s.group_owner[group] != x:
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


def broken_deadlines(deadlines):
    """Yield a sentence for each invariant of the deadlines of open jobs that does not hold."""
    t, s = deadlines._rule
    for slot, judged in deadlines._judged.items():
        if s.job_state[slot] == OPEN and slot not in deadlines._new:
            time = next_deadline(t, s, slot, judged)
            if deadlines._entry.get(slot, NEVER) > time:
                yield f'no timer is set for the deadline {time} of the job in slot {slot}'


# --- the engine ----------------------------------------------------------------------------------

def _executions(engine):
    """Check the executions that the engine knows."""
    state = engine.scheduler.state
    if state.decisions:
        yield f'the decisions {state.decisions} were not carried out'
    for x, work in engine._work.items():
        if work.x != x or state.x_state[x] not in (WAITING, ALONE, SUSPENDED):
            yield f'execution {x} has state {state.x_state[x]}, its work is of {work.x}'
        elif (x in work.entity.waiting) != (state.x_started[x] < 0):
            yield f'execution {x}, started at {state.x_started[x]}, is counted wrongly'
    bypass = engine._bypass
    if (bypass.is_open or bypass.queue or bypass.running) and not (
            bypass.is_open and engine._is_core_empty()):
        yield 'executions bypass the core, which has others'
    known = {**engine._work, **bypass.queue}
    for entity in {work.entity for work in known.values()}:
        if any(x not in known or known[x].entity is not entity for x in entity.waiting):
            yield f'{[*entity.waiting]} are not all executions of one entity that wait'
        if not entity.keeps_oldest and 0 < entity.depth < len(entity.waiting):
            yield f'{len(entity.waiting)} executions wait in a queue of depth {entity.depth}'
    if len(engine._work) != sum(map(state.x_state.count, (WAITING, ALONE, SUSPENDED))):
        yield f'of what waits or is suspended, work is known of {sorted(engine._work)} only'
    holders = engine.interpreter.holders
    holding = sorted(x for x in state.worker_x if x >= 0 and state.x_holds[x])
    if sorted(work.x for work in holders) != holding:
        yield f'executions {holding} hold the GIL, noted are {[w.x for w in holders]}'
        return
    keys = [state.x_key[work.x][0] for work in holders]
    if any(after > before for before, after in zip(keys, keys[1:])):
        yield f'the GIL was overtaken by something that is not more urgent: {keys}'
