# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the executor's core saw, in compiled code: what ``judge`` and ``chains`` do, on rows.

It is compiled and never called as it stands here (see ``fast_compile``).
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core import jobs, rules
from mddag_executor.core.state import add_slot, IDLE, JOB_END, SINK_IN_TIME, SINK_LATE
from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.fast_paths import count_row
from mddag_executor.replay.fast_tables import find, insert, remove
from mddag_executor.replay.fast_threads import keep_step, mapped
from mddag_executor.simulate.structures import key_of_policy
from mddag_executor.trace.times import FAR_NS


def on_release(t: Any, s: Any, w: Any, now: int, dag: int, job: int, release: int) -> bool:
    """Take in the release of a job; False where it is for Python."""
    if not 0 <= dag < len(w.map_dag):
        return False
    w.releases[dag, 1] = release if w.releases[dag, 0] == 0 else min(w.releases[dag, 1], release)
    w.releases[dag, 2] = max(w.releases[dag, 2], release)
    w.releases[dag, 0] += 1
    if w.scalars[fw.FIRST] < 0:
        w.scalars[fw.FIRST] = now
    if not 0 <= release <= now or now - release >= FAR_NS or job <= w.newest[dag]:
        return False
    w.newest[dag] = job
    w.scalars[fw.JOBS] += 1
    if w.scalars[fw.BEGIN] < 0 or release < w.scalars[fw.BEGIN]:
        w.scalars[fw.BEGIN] = release
    dag = w.map_dag[dag]
    if dag < 0:
        return True
    w.judge_newest[dag] = job
    slot = jobs.release_job(t, s, dag, job, release, now)
    if slot < 0:
        add_slot(t, s, dag)
        slot = jobs.release_job(t, s, dag, job, release, now)
    row = find(w.slots, dag, job, 0, 0)
    if row < 0:
        row = insert(w.slots, dag, job, 0, 0)
        count_row(w, fw.SLOTS, len(w.slots))
    w.slots[row, fw.S_SLOT] = slot
    if jobs.is_judged(s, slot):
        w.released[dag] += 1
    base = s.job_base[slot]
    for x in range(base, base + t.n_region[dag]):
        w.chain[x, fw.K_KNOWN] = 0
    return True


def on_complete(t: Any, s: Any, w: Any, now: int, thread: int, i: int) -> bool:
    """Take in a completion; False where it is for Python."""
    dag, vertex, job = w.rows[i, 5], w.rows[i, 6], w.rows[i, 7]
    end, leg = w.rows[i, 9], w.rows[i, 10]
    place = mapped(w, dag, vertex)
    if place < 0 or not 0 <= end <= now:
        return False
    vertex = w.map_vertex[place]
    if vertex < 0 or leg < 0 or w.map_legs[place] + leg >= w.map_legs[place + 1]:
        return True
    dag = w.map_dag[dag]
    leg = w.legs[w.map_legs[place] + leg]
    row = find(w.threads, thread, 0, 0, 0)
    known = (row >= 0 and w.threads[row, fw.T_LAST] != 0
             and w.threads[row, fw.T_LAST_DAG] == dag
             and w.threads[row, fw.T_LAST_VERTEX] == vertex
             and w.threads[row, fw.T_LAST_JOB] == job)
    waited = 0
    if known:
        execution = find(w.ongoing, dag, vertex, job, w.threads[row, fw.T_LAST_READY])
        if execution >= 0:
            waited = w.ongoing[execution, fw.O_WAITED]
            w.scalars[fw.N_WAITED] -= 1 if waited != 0 else 0
            remove(w.ongoing, execution)
            w.counts[fw.OPEN] -= 1
        if w.threads[row, fw.T_LAST_ID] != w.scalars[fw.COUNTED]:
            w.scalars[fw.COUNTED] = w.threads[row, fw.T_LAST_ID]
            use = w.use_of[vertex]
            w.use[use, fw.U_RAN] += 1
            w.use[use, fw.U_LONGEST] = max(
                w.use[use, fw.U_LONGEST], w.threads[row, fw.T_LAST_BUSY])
    found = find(w.slots, dag, job, 0, 0)
    if found < 0:
        if job > w.judge_newest[dag]:
            w.scalars[fw.CONTRADICTIONS] += 1
        return True
    slot = w.slots[found, fw.S_SLOT]
    x = s.job_base[slot] + t.region_offset[vertex] + leg
    if s.x_state[x] != IDLE:
        w.scalars[fw.CONTRADICTIONS] += 1
        return True
    seen = len(s.decisions)
    rules.admit(s, x, end)
    if rules.complete(t, s, key_of_policy, x, end) and known:
        keep_step(
            w, s.job_base[slot] + t.region_offset[vertex], leg, w.threads[row, fw.T_LAST_READY],
            w.threads[row, fw.T_LAST_START], w.threads[row, fw.T_LAST_END],
            w.threads[row, fw.T_LAST_BUSY], waited)
    return take_decisions(t, s, w, slot, seen)


def on_job_end(t: Any, s: Any, w: Any, now: int, dag: int, job: int, aborted: bool) -> bool:
    """Take in the expiry or abort of a job; False where it is for Python."""
    if not 0 <= dag < len(w.map_dag):
        return False
    dag = w.map_dag[dag]
    if dag < 0:
        return True
    found = find(w.slots, dag, job, 0, 0)
    if found < 0:
        w.scalars[fw.CONTRADICTIONS] += w.scalars[fw.COMPARE]
        return True
    slot = w.slots[found, fw.S_SLOT]
    seen = len(s.decisions)
    if aborted:
        jobs.abort_job(t, s, slot, now)
    else:
        jobs.expire_job(t, s, slot, now)
    return take_decisions(t, s, w, slot, seen)


def on_fail(t: Any, s: Any, w: Any, now: int, dag: int, vertex: int, job: int) -> bool:
    """Take in that an execution failed; False where it is for Python."""
    place = mapped(w, dag, vertex)
    if place < 0:
        return False
    if w.map_vertex[place] < 0:
        return True
    found = find(w.slots, w.map_dag[dag], job, 0, 0)
    if found < 0:
        return True
    slot = w.slots[found, fw.S_SLOT]
    seen = len(s.decisions)
    jobs.fail_job(t, s, slot, now)
    return take_decisions(t, s, w, slot, seen)


def on_deadline(w: Any, dag: int, vertex: int, job: int, deadline: int, completed: int) -> None:
    """Take in a recorded miss."""
    if w.scalars[fw.COMPARE] == 0:
        return
    place = mapped(w, dag, vertex)
    if place >= 0 and w.map_vertex[place] >= 0 and w.map_legs[place] < w.map_legs[place + 1]:
        dag, vertex = w.map_dag[dag], w.map_vertex[place]
    else:
        dag = vertex = -1
    w.scalars[fw.N_RECORDED] += 1
    note_miss(w, -1, dag, vertex, job, deadline, completed)


def note_miss(
    w: Any, side: int, dag: int, vertex: int, job: int, deadline: int, completed: int
) -> None:
    """Hand over a miss that was found here (side 1) or recorded (-1)."""
    n = w.scalars[fw.N_MISSES]
    w.misses[n, 0] = side
    w.misses[n, 1] = dag
    w.misses[n, 2] = vertex
    w.misses[n, 3] = job
    w.misses[n, 4] = deadline
    w.misses[n, 5] = completed
    w.scalars[fw.N_MISSES] = n + 1


def take_decisions(t: Any, s: Any, w: Any, slot: int, seen: int) -> bool:
    """Take in what the core has decided (about the job in a slot, except at the end)."""
    for k in range(seen, len(s.decisions)):
        decision = s.decisions[k]
        kind, dag, vertex, job, deadline, time = decision
        if kind == JOB_END:
            remove(w.slots, find(w.slots, dag, job, 0, 0))
            w.counts[fw.SLOTS] -= 1
            continue
        if kind <= SINK_LATE and not sink_done(t, s, w, slot, vertex, job, time):
            return False
        if w.scalars[fw.COMPARE] != 0 and kind != SINK_IN_TIME:
            note_miss(w, 1, dag, vertex, job, deadline, time)
    return True


# --- chains --------------------------------------------------------------------------------------

def sink_done(t: Any, s: Any, w: Any, slot: int, vertex: int, job: int, completed: int) -> bool:
    """Take in that a sink has completed: where the time of its chain went."""
    release = s.job_release[slot]
    base = s.job_base[slot]
    n = walk_chain(t, w, base, vertex)
    lag = waiting = executing = suspended = transport = group = 0
    unknown = completed - release
    if n > 0:
        first = w.walk[n - 1]
        before = w.chain[base + t.region_offset[first], fw.K_READY] - release
        unknown = before
        if w.before_legs[first] == w.before_legs[first + 1]:
            lag, unknown = before, 0
    for k in range(n - 1, -1, -1):
        x = base + t.region_offset[w.walk[k]]
        ready, start, end = w.chain[x, fw.K_READY], w.chain[x, fw.K_START], w.chain[x, fw.K_END]
        waiting += start - ready
        published = completed
        if k > 0:
            after = w.chain[base + t.region_offset[w.walk[k - 1]], fw.K_READY]
            published = min(end, after)
            transport += after - published
        if max(abs(ready - release), abs(start - release), abs(published - release)) >= fw.LIMIT:
            return False
        pause = 0
        if w.chain[x, fw.K_LEG] >= 0:
            pause = max(0, min(end - start - w.chain[x, fw.K_BUSY], published - start))
        suspended += pause
        executing += published - start - pause
        group += w.chain[x, fw.K_GROUP]
    parts = (lag, waiting, executing, suspended, transport, unknown, group)
    for part in parts:
        if abs(part) >= fw.LIMIT:
            return False
    w.sinks[vertex, fw.B_LAG] += lag
    w.sinks[vertex, fw.B_WAITING] += waiting
    w.sinks[vertex, fw.B_EXECUTING] += executing
    w.sinks[vertex, fw.B_SUSPENDED] += suspended
    w.sinks[vertex, fw.B_TRANSPORT] += transport
    w.sinks[vertex, fw.B_UNKNOWN] += unknown
    w.sinks[vertex, fw.B_GROUP] += group
    w.sinks[vertex, fw.B_COMPLETED] += 1
    if (w.sinks[vertex, fw.B_COMPLETED] == 1 or completed - release
            > w.sinks[vertex, fw.W_COMPLETED] - w.sinks[vertex, fw.W_RELEASE]):
        w.sinks[vertex, fw.W_JOB] = job
        w.sinks[vertex, fw.W_RELEASE] = release
        w.sinks[vertex, fw.W_COMPLETED] = completed
        w.sinks[vertex, fw.W_STEPS] = n
        for k in range(6):
            w.sinks[vertex, fw.W_PARTS + k] = parts[k]
        for k in range(n):
            v = w.walk[n - 1 - k]
            w.worst[vertex * len(w.walk) + k, 0] = v
            x = base + t.region_offset[v]
            for column in range(1, fw.N_CHAIN):
                w.worst[vertex * len(w.walk) + k, column] = w.chain[x, column]
    return True


def walk_chain(t: Any, w: Any, base: int, vertex: int) -> int:
    """Write the vertices of a chain from its end to its begin; return how many there are."""
    n = 0
    if w.chain[base + t.region_offset[vertex], fw.K_KNOWN] == 0:
        return 0
    while vertex >= 0:
        w.walk[n] = vertex
        n += 1
        x = base + t.region_offset[vertex]
        ready, leg = w.chain[x, fw.K_READY], w.chain[x, fw.K_LEG]
        first, last = w.before_legs[vertex], w.before_legs[vertex + 1]
        if leg >= 0 and first < last:
            first, last = first + leg, first + leg + 1
        best = -1
        best_end = 0
        if first < last:
            for k in range(first, last):
                v = w.before[k]
                before = base + t.region_offset[v]
                if (w.chain[before, fw.K_KNOWN] != 0 and w.chain[before, fw.K_START] <= ready
                        and (best < 0 or w.chain[before, fw.K_END] > best_end)):
                    best = v
                    best_end = w.chain[before, fw.K_END]
        vertex = best
    return n
