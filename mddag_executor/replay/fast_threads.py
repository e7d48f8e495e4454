# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What threads run, in compiled code: ``follower``'s half of that, ``waits`` and ``usage``, on rows.

It is compiled and never called as it stands here (see ``fast_compile``).
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core.tables import NEVER
from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.fast_paths import (
    count_row,
    path_published,
    path_published_outside,
    path_ran,
    path_started,
)
from mddag_executor.replay.fast_tables import find, insert, remove


def note_time(w: Any, now: int) -> None:
    """Move the run's end on."""
    if now > w.scalars[fw.FINISH] and w.scalars[fw.SHUT_DOWN] == 0:
        w.scalars[fw.FINISH] = now


def thread_row(w: Any, thread: int) -> int:
    """Return the row of a thread."""
    row = find(w.threads, thread, 0, 0, 0)
    if row < 0:
        row = insert(w.threads, thread, 0, 0, 0)
        count_row(w, fw.THREADS, len(w.threads))
    return row


def callback_row(w: Any, callback: int) -> int:
    """Return the row of a callback."""
    row = find(w.callbacks, callback, 0, 0, 0)
    if row < 0:
        row = insert(w.callbacks, callback, 0, 0, 0)
        count_row(w, fw.CALLBACKS, len(w.callbacks))
    return row


def mapped(w: Any, dag: int, vertex: int) -> int:
    """Return the place of a recorded vertex in the mapping, -1 for none."""
    if dag < 0 or dag + 1 >= len(w.map_first) or vertex < 0:
        return -1
    place = w.map_first[dag] + vertex
    return place if place < w.map_first[dag + 1] else -1


def on_dispatch(t: Any, s: Any, w: Any, now: int, thread: int, i: int) -> bool:
    """Take in a dispatch; False where it is for Python."""
    callback, dag, vertex, job = w.rows[i, 4], w.rows[i, 5], w.rows[i, 6], w.rows[i, 7]
    worker, ready = w.rows[i, 8], w.rows[i, 9]
    place = mapped(w, dag, vertex)
    row = callback_row(w, callback)
    w.callbacks[row, fw.C_RAN] += 1
    if place >= 0:
        if w.callbacks[row, fw.C_DAG] == 0:
            w.scalars[fw.KEYED] += 1
            w.callbacks[row, fw.C_ORDER] = w.scalars[fw.KEYED]
        w.callbacks[row, fw.C_DAG] = dag + 1
        w.callbacks[row, fw.C_VERTEX] = vertex + 1
    if w.scalars[fw.FIRST] < 0:
        w.scalars[fw.FIRST] = now
    if not 0 <= ready <= now or now - ready >= fw.LIMIT:
        return False
    if place >= 0 and w.map_vertex[place] >= 0 and w.map_legs[place] < w.map_legs[place + 1]:
        dag, vertex = w.map_dag[dag], w.map_vertex[place]
    else:
        dag = vertex = -1
    row = thread_row(w, thread)
    w.threads[row, fw.T_RUNNING] = 1
    w.threads[row, fw.T_CALLBACK] = callback
    w.threads[row, fw.T_DAG] = dag
    w.threads[row, fw.T_VERTEX] = vertex
    w.threads[row, fw.T_JOB] = job
    w.threads[row, fw.T_WORKER] = worker
    w.threads[row, fw.T_READY] = ready
    w.threads[row, fw.T_START] = now
    w.scalars[fw.STARTING] = callback
    if dag < 0:
        return True
    found = find(w.slots, dag, job, 0, 0)
    if found >= 0:
        x = s.job_base[w.slots[found, fw.S_SLOT]] + t.region_offset[vertex]
        if w.chain[x, fw.K_KNOWN] == 0 or w.chain[x, fw.K_READY] != ready:
            keep_step(w, x, -1, ready, now, NEVER, NEVER, 0)
    if w.scalars[fw.HAS_PATHS] != 0:
        return path_started(w, dag, vertex, job, ready, now)
    return True


def keep_step(
    w: Any, x: int, leg: int, ready: int, start: int, end: int, busy: int, group: int
) -> None:
    """Keep a step of a chain."""
    w.chain[x, fw.K_KNOWN] = 1
    w.chain[x, fw.K_LEG] = leg
    w.chain[x, fw.K_READY] = ready
    w.chain[x, fw.K_START] = start
    w.chain[x, fw.K_END] = end
    w.chain[x, fw.K_BUSY] = busy
    w.chain[x, fw.K_GROUP] = group


def on_start(w: Any, now: int, thread: int, callback: int) -> bool:
    """Take in that a callback starts; False where it is for Python."""
    row = thread_row(w, thread)
    depth = w.threads[row, fw.T_DEPTH]
    if depth == fw.DEEPEST:
        return False
    w.threads[row, fw.T_STACK + depth] = callback
    w.threads[row, fw.T_DEPTH] = depth + 1
    if w.threads[row, fw.T_RUNNING] != 0 and w.threads[row, fw.T_CALLBACK] == callback:
        w.threads[row, fw.T_START] = now
    return True


def on_end(w: Any, now: int, thread: int, callback: int) -> bool:
    """Take in that a callback has ended; False where it is for Python."""
    row = thread_row(w, thread)
    while w.threads[row, fw.T_DEPTH] > 0:
        w.threads[row, fw.T_DEPTH] -= 1
        if w.threads[row, fw.T_STACK + w.threads[row, fw.T_DEPTH]] == callback:
            break
    running = w.threads[row, fw.T_RUNNING]
    w.threads[row, fw.T_RUNNING] = 0
    w.threads[row, fw.T_LAST] = 0
    if running == 0 or w.threads[row, fw.T_CALLBACK] != callback:
        return True
    ready, start = w.threads[row, fw.T_READY], w.threads[row, fw.T_START]
    if w.scalars[fw.BEGIN] < 0 or ready < w.scalars[fw.BEGIN]:
        w.scalars[fw.BEGIN] = ready
    if now - start >= fw.LIMIT or start - ready >= fw.LIMIT:
        return False
    dag, vertex = w.threads[row, fw.T_DAG], w.threads[row, fw.T_VERTEX]
    job = w.threads[row, fw.T_JOB]
    execution = -1
    if dag >= 0:
        execution = find(w.ongoing, dag, vertex, job, ready)
        first = execution < 0
        if first:
            execution = insert(w.ongoing, dag, vertex, job, ready)
            count_row(w, fw.OPEN, len(w.ongoing))
            w.ongoing[execution, fw.O_START] = start
        w.ongoing[execution, fw.O_END] = now
        w.ongoing[execution, fw.O_BUSY] += now - start
        if w.ongoing[execution, fw.O_BUSY] >= fw.LIMIT:
            return False
        keep_last(w, row, execution, dag, vertex, job, ready)
    else:
        first = is_new_piece(w, callback, ready)
    waited = group_wait(w, callback, ready, start, now, first)
    if dag >= 0 and waited != 0:
        if w.ongoing[execution, fw.O_WAITED] == 0:
            w.scalars[fw.N_WAITED] += 1
        w.ongoing[execution, fw.O_WAITED] = waited
        if w.scalars[fw.N_WAITED] > fw.KEEP_WAITED:
            return False
    n = w.scalars[fw.N_PIECES]
    w.pieces[n, fw.R_START] = start
    w.pieces[n, fw.R_END] = now
    w.pieces[n, fw.R_READY] = ready
    w.pieces[n, fw.R_VERTEX] = vertex if dag >= 0 else -1
    w.pieces[n, fw.R_JOB] = job
    w.pieces[n, fw.R_WORKER] = w.threads[row, fw.T_WORKER]
    w.pieces[n, fw.R_CALLBACK] = callback
    w.scalars[fw.N_PIECES] = n + 1
    if not count_use(w, vertex, w.threads[row, fw.T_WORKER], ready, start, now, first, waited):
        return False
    if dag >= 0 and w.scalars[fw.HAS_PATHS] != 0:
        path_ran(w, dag, vertex, job, ready, now)
    return True


def keep_last(
    w: Any, row: int, execution: int, dag: int, vertex: int, job: int, ready: int
) -> None:
    """Keep the execution whose piece ended last in a thread."""
    w.threads[row, fw.T_LAST] = 1
    w.threads[row, fw.T_LAST_DAG] = dag
    w.threads[row, fw.T_LAST_VERTEX] = vertex
    w.threads[row, fw.T_LAST_JOB] = job
    w.threads[row, fw.T_LAST_READY] = ready
    w.threads[row, fw.T_LAST_START] = w.ongoing[execution, fw.O_START]
    w.threads[row, fw.T_LAST_END] = w.ongoing[execution, fw.O_END]
    w.threads[row, fw.T_LAST_BUSY] = w.ongoing[execution, fw.O_BUSY]
    w.scalars[fw.NEXT_ID] += 1
    w.threads[row, fw.T_LAST_ID] = w.scalars[fw.NEXT_ID]


def is_new_piece(w: Any, callback: int, ready: int) -> bool:
    """Tell whether an undeclared callback's piece is the first of its execution."""
    if find(w.recent, callback, ready, 0, 0) >= 0:
        return False
    n = w.scalars[fw.N_RECENT]
    place = n % fw.KEEP_RECENT
    if n >= fw.KEEP_RECENT:
        remove(w.recent, find(w.recent, w.recent_ring[place, 0], w.recent_ring[place, 1], 0, 0))
        w.counts[fw.RECENT] -= 1
    insert(w.recent, callback, ready, 0, 0)
    count_row(w, fw.RECENT, len(w.recent))
    w.recent_ring[place, 0] = callback
    w.recent_ring[place, 1] = ready
    w.scalars[fw.N_RECENT] = n + 1
    return True


def group_wait(
    w: Any, callback: int, ready: int, start: int, end: int, first: bool
) -> int:
    """Return how long the callback's group was busy while it waited."""
    group = w.callbacks[callback_row(w, callback), fw.C_GROUP] - 1
    if group < 0:
        return 0
    waited = 0
    n = w.group_count[group]
    if first:
        k = n - 1
        while k >= 0 and k >= n - fw.KEEP_BUSY:
            busy_start = w.group_busy[group * fw.KEEP_BUSY + k % fw.KEEP_BUSY, 0]
            busy_end = w.group_busy[group * fw.KEEP_BUSY + k % fw.KEEP_BUSY, 1]
            if busy_end <= ready:
                break
            waited += max(0, min(busy_end, start) - max(busy_start, ready))
            k -= 1
    w.group_busy[group * fw.KEEP_BUSY + n % fw.KEEP_BUSY, 0] = start
    w.group_busy[group * fw.KEEP_BUSY + n % fw.KEEP_BUSY, 1] = end
    w.group_count[group] = n + 1
    return waited


def count_use(
    w: Any, vertex: int, worker: int, ready: int, start: int, end: int, first: bool, waited: int
) -> bool:
    """Count what ran; False where it is for Python."""
    took = end - start
    if worker < -1 or worker >= fw.MOST_WORKERS:
        return False
    w.workers[worker + 1, 0] += took
    w.workers[worker + 1, 1] = 1
    use = len(w.use) - 1
    if vertex >= 0:
        use = w.use_of[vertex]
    else:
        w.use[use, fw.U_RAN] += 1 if first else 0
        w.use[use, fw.U_LONGEST] = max(w.use[use, fw.U_LONGEST], took)
    w.use[use, fw.U_BUSY] += took
    if first:
        w.use[use, fw.U_WAITING] += start - ready
        w.use[use, fw.U_GROUP] += waited
        w.use[use, fw.U_LONGEST_WAIT] = max(w.use[use, fw.U_LONGEST_WAIT], start - ready)
    return True


def on_publish(w: Any, now: int, thread: int, publisher: int, kind: int) -> None:
    """Take in that something is published."""
    row = find(w.threads, thread, 0, 0, 0)
    if w.scalars[fw.WATCHED] != 0 and row >= 0 and w.threads[row, fw.T_DEPTH] > 0:
        callback = w.threads[row, fw.T_STACK + w.threads[row, fw.T_DEPTH] - 1]
        if find(w.pairs, callback, publisher, 0, 0) < 0:
            insert(w.pairs, callback, publisher, 0, 0)
            count_row(w, fw.PAIRS, len(w.pairs))
    if kind != fw.PUBLISH or w.scalars[fw.HAS_PATHS] == 0:
        return
    known = find(w.publishers, publisher, 0, 0, 0)
    if known < 0:
        return
    topic = w.publishers[known, fw.P_TOPIC] - 1
    if topic < 0:
        return
    if row < 0 or w.threads[row, fw.T_RUNNING] == 0 or w.threads[row, fw.T_VERTEX] < 0:
        path_published_outside(w, w.publishers[known, fw.P_NODE] - 1, topic, now)
    else:
        path_published(
            w, w.threads[row, fw.T_DAG], w.threads[row, fw.T_VERTEX], w.threads[row, fw.T_JOB],
            w.threads[row, fw.T_READY], topic, now)
