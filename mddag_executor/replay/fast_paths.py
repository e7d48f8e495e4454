# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Paths in compiled code: what ``own_paths`` and ``paths`` do, on arrays.

A *place* is a position in a path; places of one path follow one another, so the place before p is
p - 1.  Of each of the last jobs there is a row with what it has run and published, in steps; a
step is a row of four columns, of the last place's executions two (the second tells the end).
It is compiled and never called as it stands here (see ``fast_compile``).
"""

from __future__ import annotations

from typing import Any

from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.fast_tables import find, insert, remove
from mddag_executor.replay.fast_types import columns_of


def count_row(w: Any, table: int, length: int) -> None:
    """Count one more row of a table, and tell when it should be larger."""
    w.counts[table] += 1
    if 2 * w.counts[table] >= length:
        w.scalars[fw.FULL] = 1


def path_job(w: Any, dag: int, job: int) -> int:
    """Return the row of what a job has run and published."""
    i = find(w.path_jobs, dag, job, 0, 0)
    if i >= 0:
        return w.path_jobs[i, fw.J_PLACE]
    n = w.scalars[fw.N_JOBS]
    place = n % fw.KEEP_JOBS
    if n >= fw.KEEP_JOBS:
        old = find(w.path_jobs, w.job_ring[place, 0], w.job_ring[place, 1], 0, 0)
        remove(w.path_jobs, old)
        w.counts[fw.PATH_JOBS] -= 1
    i = insert(w.path_jobs, dag, job, 0, 0)
    count_row(w, fw.PATH_JOBS, len(w.path_jobs))
    w.path_jobs[i, fw.J_PLACE] = place
    w.job_ring[place, 0] = dag
    w.job_ring[place, 1] = job
    w.scalars[fw.N_JOBS] = n + 1
    for k in range(columns_of(w.jobs)):
        w.jobs[place, k] = -1
    return place


def find_run(w: Any, row: int, vertex: int, ready: int) -> int:
    """Return where the steps of a run stand, or -1."""
    at = w.v_runs[vertex]
    width = 1 + w.v_places[vertex + 1] - w.v_places[vertex]
    for k in range(w.jobs[row, at] + 1):
        if w.jobs[row, at + 1 + k * width] == ready:
            return at + 2 + k * width
    return -1


def add_step(w: Any, place: int, parent: int, kind: int, time: int) -> int:
    """Add a step and return its number."""
    n = w.scalars[fw.N_STEPS]
    w.steps[n, fw.X_TIME] = time
    w.steps[n, fw.X_WHAT] = (parent + 1) << fw.X_PARENT | place << fw.X_PLACE | kind
    w.scalars[fw.N_STEPS] = n + 1
    if kind == 1 and w.place_last[place] != 0:
        w.steps[n + 1, fw.X_TIME] = -1
        w.steps[n + 1, fw.X_WHAT] = place << fw.X_PLACE | fw.RUN_END
        w.scalars[fw.N_STEPS] = n + 2
    return n


def path_started(w: Any, dag: int, vertex: int, job: int, ready: int, start: int) -> bool:
    """Take in an execution that has begun; False where there is no room for it."""
    first, last = w.v_places[vertex], w.v_places[vertex + 1]
    if first == last:
        return True
    row = path_job(w, dag, job)
    if find_run(w, row, vertex, ready) >= 0:
        return True
    topic = -1
    if w.v_topics[vertex] < w.v_topics[vertex + 1]:
        i = find(w.callbacks, w.scalars[fw.STARTING], 0, 0, 0)
        if i >= 0:
            topic = w.callbacks[i, fw.C_TOPIC] - 1
    at = w.v_runs[vertex]
    k = w.jobs[row, at] + 1
    if k >= w.v_most[vertex]:
        return False
    w.jobs[row, at] = k
    at += 1 + k * (1 + last - first)
    w.jobs[row, at] = ready
    for j in range(first, last):
        at += 1
        w.jobs[row, at] = -1
        p = w.v_place[j]
        parent = -1
        if w.place_position[p] > 0:
            hop = w.place_hop[p]
            if hop == fw.TRIGGER:
                if topic >= 0 and w.hop_topics[p, topic] == 0:
                    continue
                parent = message_step(w, row, vertex, p - 1, topic)
            elif hop == fw.VARIABLE:
                parent = w.place_done[p - 1]
            else:
                parent = w.place_published[p - 1]
            if parent == -1:
                w.place_started[p] = -1
                continue
        step = add_step(w, p, parent, 1, start)
        w.jobs[row, at] = step
        w.place_started[p] = step
    return True


def message_step(w: Any, row: int, vertex: int, place: int, topic: int) -> int:
    """Return the step of a place in the message that started a vertex, or -1."""
    step = -1
    for b in range(w.v_befores[vertex], w.v_befores[vertex + 1]):
        before = w.v_before[b]
        for j in range(w.v_places[before], w.v_places[before + 1]):
            if w.v_place[j] != place:
                continue
            if topic >= 0:
                step = latest_step(w, row, w.message_at[j, topic], step)
            else:
                for k in range(w.v_topics[vertex], w.v_topics[vertex + 1]):
                    step = latest_step(w, row, w.message_at[j, w.v_topic[k]], step)
    return step


def latest_step(w: Any, row: int, at: int, step: int) -> int:
    """Return the step that stands in a job's row, or else the one that is known."""
    if at >= 0 and w.jobs[row, at] >= 0:
        return w.jobs[row, at]
    return step


def path_published(
    w: Any, dag: int, vertex: int, job: int, ready: int, topic: int, time: int
) -> None:
    """Take in what an execution publishes."""
    first, last = w.v_places[vertex], w.v_places[vertex + 1]
    if first == last:
        return
    row = path_job(w, dag, job)
    run = find_run(w, row, vertex, ready)
    for j in range(first, last):
        p = w.v_place[j]
        if w.publish_topics[p, topic] == 0:
            continue
        parent = -1
        if run >= 0:
            parent = w.jobs[row, run + j - first]
        if parent == -1 and w.place_sync[p] != 0:
            parent = w.place_started[p]
        if parent == -1 and w.place_position[p] > 0:
            w.place_published[p] = -1
            continue
        step = add_step(w, p, parent, 0, time)
        w.jobs[row, w.message_at[j, topic]] = step
        w.place_published[p] = step


def path_published_outside(w: Any, node: int, topic: int, time: int) -> None:
    """Take in what a node publishes outside of executions."""
    if node < 0:
        return
    for j in range(w.node_places[node], w.node_places[node + 1]):
        p = w.node_place[j]
        if w.publish_topics[p, topic] == 0:
            continue
        parent = w.place_started[p]
        if parent == -1 and w.place_position[p] > 0:
            w.place_published[p] = -1
            continue
        w.place_published[p] = add_step(w, p, parent, 0, time)


def path_ran(w: Any, dag: int, vertex: int, job: int, ready: int, end: int) -> None:
    """Take in that an execution (or a piece of it) has ended."""
    first, last = w.v_places[vertex], w.v_places[vertex + 1]
    if first == last:
        return
    row = path_job(w, dag, job)
    if w.scalars[fw.ANY_PUBLISHED] == 0:
        for k in range(w.v_publishes[vertex], w.v_publishes[vertex + 1]):
            path_published(w, dag, vertex, job, ready, w.v_publish[k], end)
    run = find_run(w, row, vertex, ready)
    for j in range(first, last):
        p = w.v_place[j]
        step = -1
        if run >= 0:
            step = w.jobs[row, run + j - first]
        if step != -1:
            if w.place_last[p] != 0:
                w.steps[step + 1, fw.X_TIME] = end
            w.place_done[p] = step
        elif w.place_sync[p] == 0:
            w.place_done[p] = -1
