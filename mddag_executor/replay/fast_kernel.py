# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The compiled replay: what ``follower``, ``judge``, ``chains``, ``waits`` and ``usage`` do, on rows.

Theory of operation
-------------------
``advance`` goes through the rows of events (see ``trace.columns``) and feeds the compiled core,
whose rules stand in ``mddag_executor.core`` alone.  It comes back where Python is needed: for an
event that is no row of numbers, where an array is full, and where something is not as it should
be or too large for 64 bits.  In that last case the replay is begun anew in Python, which has the
words for it.  So there is nothing in here about what is wrong with a trace.

It is compiled and never called as it stands here (see ``fast_compile``).
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core import jobs, rules
from mddag_executor.core.state import (
    add_slot,
    fill_state,
    IDLE,
    JOB_END,
    SINK_DONE,
)
from mddag_executor.core.tables import NEVER
from mddag_executor.replay.fast_paths import (
    count_row,
    mark_steps,
    path_flows,
    path_published,
    path_published_outside,
    path_ran,
    path_started,
)
from mddag_executor.replay.fast_tables import find, insert, rehash, remove
from mddag_executor.replay.fast_work import (
    ABORT,
    ALL_DONE,
    B_COMPLETED,
    B_EXECUTING,
    B_GROUP,
    B_LAG,
    B_SUSPENDED,
    B_TRANSPORT,
    B_UNKNOWN,
    B_WAITING,
    BEGIN,
    C_DAG,
    C_GROUP,
    C_ORDER,
    C_RAN,
    C_VERTEX,
    CALLBACKS,
    COMPARE,
    COMPLETE,
    CONTRADICTIONS,
    COUNTED,
    DEADLINE,
    DECLINED,
    DEEPEST,
    DISPATCH,
    END,
    EXPIRE,
    FINISH,
    FIRST,
    FOR_PYTHON,
    FULL,
    HAS_PATHS,
    JOBS,
    K_BUSY,
    K_END,
    K_GROUP,
    K_KNOWN,
    K_LEG,
    K_READY,
    K_START,
    KEEP_BUSY,
    KEEP_RECENT,
    KEEP_WAITED,
    KEYED,
    LAST,
    LIMIT,
    MOST_WORKERS,
    N_CHAIN,
    N_MISSES,
    N_PIECES,
    N_RECENT,
    N_RECORDED,
    N_STEPS,
    N_WAITED,
    NEXT_ID,
    O_BUSY,
    O_END,
    O_START,
    O_WAITED,
    OPEN,
    OTHER,
    P_NODE,
    P_TOPIC,
    PAIRS,
    PROCESS_ID,
    PUBLISH,
    RCL_PUBLISH,
    RECENT,
    RELEASE,
    S_SLOT,
    SHUT_DOWN,
    SLOTS,
    START,
    STARTING,
    STATUS,
    T_CALLBACK,
    T_DAG,
    T_DEPTH,
    T_JOB,
    T_LAST,
    T_LAST_BUSY,
    T_LAST_DAG,
    T_LAST_END,
    T_LAST_ID,
    T_LAST_JOB,
    T_LAST_READY,
    T_LAST_START,
    T_LAST_VERTEX,
    T_READY,
    T_RUNNING,
    T_STACK,
    T_START,
    T_VERTEX,
    T_WORKER,
    TAKE_AWAY,
    THREADS,
    TOO_FULL,
    U_BUSY,
    U_GROUP,
    U_LONGEST,
    U_LONGEST_WAIT,
    U_RAN,
    U_WAITING,
    W_COMPLETED,
    W_JOB,
    W_PARTS,
    W_RELEASE,
    W_STEPS,
    WATCHED,
)
from mddag_executor.simulate.kernel import free_state
from mddag_executor.simulate.structures import as_state, as_tables, key_of_policy
from mddag_executor.trace.columns_kernel import scan_records


def advance(tables: int, state: int, w: Any, rows: Any, i: int, pieces: Any) -> int:
    """
    Go through the rows from number ``i`` on; return which one is the next.

    ``scalars[STATUS]`` says why it is, ``pieces`` has start and end of all that ran, and the
    state's decisions are those since it was called.
    """
    t = as_tables(tables)
    s = as_state(state)
    s.decisions.clear()
    w.scalars[N_MISSES] = 0
    w.scalars[N_PIECES] = 0
    w.scalars[STATUS] = ALL_DONE
    while i < len(rows):
        status = _room(t, s, w)
        if status == ALL_DONE:
            status = _event(t, s, w, rows, i, pieces)
        if status != ALL_DONE:
            w.scalars[STATUS] = status
            return i
        i += 1
    return i


def _room(t: Any, s: Any, w: Any) -> int:
    """Tell whether there is room for what an event may bring, whatever it is."""
    if w.scalars[FULL] != 0 or len(s.x_slot) + t.n_vertices * 2 + len(w.legs) + 8 > len(w.chain):
        return TOO_FULL
    if w.scalars[HAS_PATHS] != 0 and w.scalars[N_STEPS] + 4 * len(w.place_done) + 4 > len(
            w.step_time):
        return TOO_FULL
    if w.scalars[N_MISSES] + t.n_vertices + 2 > len(w.misses):
        return TAKE_AWAY
    return ALL_DONE


def _event(t: Any, s: Any, w: Any, rows: Any, i: int, pieces: Any) -> int:
    now, kind, thread = rows[i, 0], rows[i, 1], rows[i, 2]
    if kind == OTHER:
        return FOR_PYTHON
    if now < 0 or now >= NEVER or rows[i, 3] != w.scalars[PROCESS_ID]:
        return DECLINED
    if now > w.scalars[LAST]:
        w.scalars[LAST] = now
    fine = True
    if kind == START:
        fine = _start(w, now, thread, rows[i, 4])
    elif kind == END:
        fine = _end(w, now, thread, rows[i, 4], pieces)
    elif kind == DISPATCH:
        fine = _dispatch(t, s, w, now, thread, rows, i)
    elif kind == COMPLETE:
        _advance(w, now)
        fine = _complete(t, s, w, now, thread, rows, i)
    elif kind == RELEASE:
        _advance(w, now)
        fine = _release(t, s, w, now, rows[i, 4], rows[i, 5], rows[i, 6])
    elif kind == PUBLISH or kind == RCL_PUBLISH:
        _publish(w, now, thread, rows[i, 4], kind)
    elif kind == DEADLINE:
        _advance(w, now)
        _deadline(w, rows[i, 4], rows[i, 5], rows[i, 6], rows[i, 7], rows[i, 8])
    elif kind == EXPIRE or kind == ABORT:
        _advance(w, now)
        fine = _ended(t, s, w, now, rows[i, 4], rows[i, 5], kind == ABORT)
    return ALL_DONE if fine else DECLINED


def _advance(w: Any, now: int) -> None:
    if now > w.scalars[FINISH] and w.scalars[SHUT_DOWN] == 0:
        w.scalars[FINISH] = now


def _thread(w: Any, thread: int) -> int:
    row = find(w.threads, thread, 0, 0, 0)
    if row < 0:
        row = insert(w.threads, thread, 0, 0, 0)
        count_row(w, THREADS, len(w.threads))
    return row


def _callback(w: Any, callback: int) -> int:
    row = find(w.callbacks, callback, 0, 0, 0)
    if row < 0:
        row = insert(w.callbacks, callback, 0, 0, 0)
        count_row(w, CALLBACKS, len(w.callbacks))
    return row


def _vertex(w: Any, dag: int, vertex: int) -> int:
    """Return the place of a recorded vertex in the mapping, -1 for none."""
    if dag < 0 or dag + 1 >= len(w.map_first) or vertex < 0:
        return -1
    place = w.map_first[dag] + vertex
    return place if place < w.map_first[dag + 1] else -1


# --- what a thread runs --------------------------------------------------------------------------

def _dispatch(t: Any, s: Any, w: Any, now: int, thread: int, rows: Any, i: int) -> bool:
    callback, dag, vertex, job = rows[i, 4], rows[i, 5], rows[i, 6], rows[i, 7]
    worker, ready = rows[i, 8], rows[i, 9]
    place = _vertex(w, dag, vertex)
    row = _callback(w, callback)
    w.callbacks[row, C_RAN] += 1
    if place >= 0:
        if w.callbacks[row, C_DAG] == 0:
            w.scalars[KEYED] += 1
            w.callbacks[row, C_ORDER] = w.scalars[KEYED]
        w.callbacks[row, C_DAG] = dag + 1
        w.callbacks[row, C_VERTEX] = vertex + 1
    if w.scalars[FIRST] < 0:
        w.scalars[FIRST] = now
    if not 0 <= ready <= now:
        return False
    if place >= 0 and w.map_vertex[place] >= 0 and w.map_legs[place] < w.map_legs[place + 1]:
        dag, vertex = w.map_dag[dag], w.map_vertex[place]
    else:
        dag = vertex = -1
    row = _thread(w, thread)
    w.threads[row, T_RUNNING] = 1
    w.threads[row, T_CALLBACK] = callback
    w.threads[row, T_DAG] = dag
    w.threads[row, T_VERTEX] = vertex
    w.threads[row, T_JOB] = job
    w.threads[row, T_WORKER] = worker
    w.threads[row, T_READY] = ready
    w.threads[row, T_START] = now
    w.scalars[STARTING] = callback
    if dag < 0:
        return True
    found = find(w.slots, dag, job, 0, 0)
    if found >= 0:
        x = s.job_base[w.slots[found, S_SLOT]] + t.region_offset[vertex]
        if w.chain[x, K_KNOWN] == 0 or w.chain[x, K_READY] != ready:
            _keep(w, x, -1, ready, now, NEVER, NEVER, 0)
    if w.scalars[HAS_PATHS] != 0:
        return path_started(w, dag, vertex, job, ready, now)
    return True


def _keep(
    w: Any, x: int, leg: int, ready: int, start: int, end: int, busy: int, group: int
) -> None:
    """Keep a step of a chain."""
    w.chain[x, K_KNOWN] = 1
    w.chain[x, K_LEG] = leg
    w.chain[x, K_READY] = ready
    w.chain[x, K_START] = start
    w.chain[x, K_END] = end
    w.chain[x, K_BUSY] = busy
    w.chain[x, K_GROUP] = group


def _start(w: Any, now: int, thread: int, callback: int) -> bool:
    row = _thread(w, thread)
    depth = w.threads[row, T_DEPTH]
    if depth == DEEPEST:
        return False
    w.threads[row, T_STACK + depth] = callback
    w.threads[row, T_DEPTH] = depth + 1
    if w.threads[row, T_RUNNING] != 0 and w.threads[row, T_CALLBACK] == callback:
        w.threads[row, T_START] = now
    return True


def _end(w: Any, now: int, thread: int, callback: int, pieces: Any) -> bool:
    row = _thread(w, thread)
    while w.threads[row, T_DEPTH] > 0:
        w.threads[row, T_DEPTH] -= 1
        if w.threads[row, T_STACK + w.threads[row, T_DEPTH]] == callback:
            break
    running = w.threads[row, T_RUNNING]
    w.threads[row, T_RUNNING] = 0
    w.threads[row, T_LAST] = 0
    if running == 0 or w.threads[row, T_CALLBACK] != callback:
        return True
    ready, start = w.threads[row, T_READY], w.threads[row, T_START]
    if w.scalars[BEGIN] < 0 or ready < w.scalars[BEGIN]:
        w.scalars[BEGIN] = ready
    if now - start >= LIMIT or start - ready >= LIMIT:
        return False
    dag, vertex, job = w.threads[row, T_DAG], w.threads[row, T_VERTEX], w.threads[row, T_JOB]
    execution = -1
    if dag >= 0:
        execution = find(w.open, dag, vertex, job, ready)
        first = execution < 0
        if first:
            execution = insert(w.open, dag, vertex, job, ready)
            count_row(w, OPEN, len(w.open))
            w.open[execution, O_START] = start
        w.open[execution, O_END] = now
        w.open[execution, O_BUSY] += now - start
        if w.open[execution, O_BUSY] >= LIMIT:
            return False
        _keep_last(w, row, execution, dag, vertex, job, ready)
    else:
        first = _is_new(w, callback, ready)
    waited = _waited_for_group(w, callback, ready, start, now, first)
    if dag >= 0 and waited != 0:
        if w.open[execution, O_WAITED] == 0:
            w.scalars[N_WAITED] += 1
        w.open[execution, O_WAITED] = waited
        if w.scalars[N_WAITED] > KEEP_WAITED:
            return False
    n = w.scalars[N_PIECES]
    pieces[n, 0] = start
    pieces[n, 1] = now
    w.scalars[N_PIECES] = n + 1
    if not _use(w, vertex, w.threads[row, T_WORKER], ready, start, now, first, waited):
        return False
    if dag >= 0 and w.scalars[HAS_PATHS] != 0:
        path_ran(w, dag, vertex, job, ready, now)
    return True


def _keep_last(
    w: Any, row: int, execution: int, dag: int, vertex: int, job: int, ready: int
) -> None:
    w.threads[row, T_LAST] = 1
    w.threads[row, T_LAST_DAG] = dag
    w.threads[row, T_LAST_VERTEX] = vertex
    w.threads[row, T_LAST_JOB] = job
    w.threads[row, T_LAST_READY] = ready
    w.threads[row, T_LAST_START] = w.open[execution, O_START]
    w.threads[row, T_LAST_END] = w.open[execution, O_END]
    w.threads[row, T_LAST_BUSY] = w.open[execution, O_BUSY]
    w.scalars[NEXT_ID] += 1
    w.threads[row, T_LAST_ID] = w.scalars[NEXT_ID]


def _is_new(w: Any, callback: int, ready: int) -> bool:
    """Tell whether an undeclared callback's piece is the first of its execution."""
    if find(w.recent, callback, ready, 0, 0) >= 0:
        return False
    n = w.scalars[N_RECENT]
    place = n % KEEP_RECENT
    if n >= KEEP_RECENT:
        remove(w.recent, find(w.recent, w.recent_ring[place, 0], w.recent_ring[place, 1], 0, 0))
        w.counts[RECENT] -= 1
    insert(w.recent, callback, ready, 0, 0)
    count_row(w, RECENT, len(w.recent))
    w.recent_ring[place, 0] = callback
    w.recent_ring[place, 1] = ready
    w.scalars[N_RECENT] = n + 1
    return True


def _waited_for_group(
    w: Any, callback: int, ready: int, start: int, end: int, first: bool
) -> int:
    """Return how long the callback's group was busy while it waited."""
    group = w.callbacks[_callback(w, callback), C_GROUP] - 1
    if group < 0:
        return 0
    waited = 0
    n = w.group_count[group]
    if first:
        k = n - 1
        while k >= 0 and k >= n - KEEP_BUSY:
            busy_start = w.group_busy[group, k % KEEP_BUSY, 0]
            busy_end = w.group_busy[group, k % KEEP_BUSY, 1]
            if busy_end <= ready:
                break
            waited += max(0, min(busy_end, start) - max(busy_start, ready))
            k -= 1
    w.group_busy[group, n % KEEP_BUSY, 0] = start
    w.group_busy[group, n % KEEP_BUSY, 1] = end
    w.group_count[group] = n + 1
    return waited


def _use(
    w: Any, vertex: int, worker: int, ready: int, start: int, end: int, first: bool, waited: int
) -> bool:
    took = end - start
    if worker < -1 or worker >= MOST_WORKERS:
        return False
    w.workers[worker + 1, 0] += took
    w.workers[worker + 1, 1] = 1
    use = len(w.use) - 1
    if vertex >= 0:
        use = w.use_of[vertex]
    else:
        w.use[use, U_RAN] += 1 if first else 0
        w.use[use, U_LONGEST] = max(w.use[use, U_LONGEST], took)
    w.use[use, U_BUSY] += took
    if first:
        w.use[use, U_WAITING] += start - ready
        w.use[use, U_GROUP] += waited
        w.use[use, U_LONGEST_WAIT] = max(w.use[use, U_LONGEST_WAIT], start - ready)
    return True


# --- what the executor's core saw ----------------------------------------------------------------

def _release(t: Any, s: Any, w: Any, now: int, dag: int, job: int, release: int) -> bool:
    if not 0 <= dag < len(w.map_dag):
        return False
    w.releases[dag, 1] = release if w.releases[dag, 0] == 0 else min(w.releases[dag, 1], release)
    w.releases[dag, 2] = max(w.releases[dag, 2], release)
    w.releases[dag, 0] += 1
    if w.scalars[FIRST] < 0:
        w.scalars[FIRST] = now
    if not 0 <= release <= now or job <= w.newest[dag]:
        return False
    w.newest[dag] = job
    w.scalars[JOBS] += 1
    if w.scalars[BEGIN] < 0 or release < w.scalars[BEGIN]:
        w.scalars[BEGIN] = release
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
        count_row(w, SLOTS, len(w.slots))
    w.slots[row, S_SLOT] = slot
    w.released[dag] += 1
    base = s.job_base[slot]
    for x in range(base, base + t.n_region[dag]):
        w.chain[x, K_KNOWN] = 0
    return True


def _complete(t: Any, s: Any, w: Any, now: int, thread: int, rows: Any, i: int) -> bool:
    dag, vertex, job, end, leg = rows[i, 5], rows[i, 6], rows[i, 7], rows[i, 9], rows[i, 10]
    place = _vertex(w, dag, vertex)
    if place < 0 or not 0 <= end <= now:
        return False
    vertex = w.map_vertex[place]
    if vertex < 0 or leg < 0 or w.map_legs[place] + leg >= w.map_legs[place + 1]:
        return True
    dag = w.map_dag[dag]
    leg = w.legs[w.map_legs[place] + leg]
    row = find(w.threads, thread, 0, 0, 0)
    known = (row >= 0 and w.threads[row, T_LAST] != 0 and w.threads[row, T_LAST_DAG] == dag
             and w.threads[row, T_LAST_VERTEX] == vertex and w.threads[row, T_LAST_JOB] == job)
    waited = 0
    if known:
        execution = find(w.open, dag, vertex, job, w.threads[row, T_LAST_READY])
        if execution >= 0:
            waited = w.open[execution, O_WAITED]
            w.scalars[N_WAITED] -= 1 if waited != 0 else 0
            remove(w.open, execution)
            w.counts[OPEN] -= 1
        if w.threads[row, T_LAST_ID] != w.scalars[COUNTED]:
            w.scalars[COUNTED] = w.threads[row, T_LAST_ID]
            use = w.use_of[vertex]
            w.use[use, U_RAN] += 1
            w.use[use, U_LONGEST] = max(w.use[use, U_LONGEST], w.threads[row, T_LAST_BUSY])
    found = find(w.slots, dag, job, 0, 0)
    if found < 0:
        if job > w.judge_newest[dag]:
            w.scalars[CONTRADICTIONS] += 1
        return True
    slot = w.slots[found, S_SLOT]
    x = s.job_base[slot] + t.region_offset[vertex] + leg
    if s.x_state[x] != IDLE:
        w.scalars[CONTRADICTIONS] += 1
        return True
    seen = len(s.decisions)
    rules.admit(s, x, end)
    if rules.complete(t, s, key_of_policy, x, end) and known:
        _keep(w, s.job_base[slot] + t.region_offset[vertex], leg, w.threads[row, T_LAST_READY],
              w.threads[row, T_LAST_START], w.threads[row, T_LAST_END],
              w.threads[row, T_LAST_BUSY], waited)
    return _decided(t, s, w, slot, seen)


def _ended(t: Any, s: Any, w: Any, now: int, dag: int, job: int, aborted: bool) -> bool:
    if not 0 <= dag < len(w.map_dag):
        return False
    dag = w.map_dag[dag]
    if dag < 0:
        return True
    found = find(w.slots, dag, job, 0, 0)
    if found < 0:
        w.scalars[CONTRADICTIONS] += w.scalars[COMPARE]
        return True
    slot = w.slots[found, S_SLOT]
    seen = len(s.decisions)
    if aborted:
        jobs.abort_job(t, s, slot, now)
    else:
        jobs.expire_job(t, s, slot, now)
    return _decided(t, s, w, slot, seen)


def _deadline(w: Any, dag: int, vertex: int, job: int, deadline: int, completed: int) -> None:
    if w.scalars[COMPARE] == 0:
        return
    place = _vertex(w, dag, vertex)
    if place >= 0 and w.map_vertex[place] >= 0 and w.map_legs[place] < w.map_legs[place + 1]:
        dag, vertex = w.map_dag[dag], w.map_vertex[place]
    else:
        dag = vertex = -1
    w.scalars[N_RECORDED] += 1
    _miss(w, -1, dag, vertex, job, deadline, completed)


def _miss(
    w: Any, side: int, dag: int, vertex: int, job: int, deadline: int, completed: int
) -> None:
    n = w.scalars[N_MISSES]
    w.misses[n, 0] = side
    w.misses[n, 1] = dag
    w.misses[n, 2] = vertex
    w.misses[n, 3] = job
    w.misses[n, 4] = deadline
    w.misses[n, 5] = completed
    w.scalars[N_MISSES] = n + 1


def _decided(t: Any, s: Any, w: Any, slot: int, seen: int) -> bool:
    """Take in what the core has decided (about the job in a slot, except at the end)."""
    for k in range(seen, len(s.decisions)):
        decision = s.decisions[k]
        kind, dag, vertex, job, deadline, time = decision
        if kind == JOB_END:
            remove(w.slots, find(w.slots, dag, job, 0, 0))
            w.counts[SLOTS] -= 1
            continue
        if kind == SINK_DONE and not _sink(t, s, w, slot, vertex, job, time):
            return False
        if w.scalars[COMPARE] != 0 and (kind != SINK_DONE or time > deadline):
            _miss(w, 1, dag, vertex, job, deadline, time)
    return True


# --- chains --------------------------------------------------------------------------------------

def _sink(t: Any, s: Any, w: Any, slot: int, vertex: int, job: int, completed: int) -> bool:
    """Take in that a sink has completed: where the time of its chain went."""
    release = s.job_release[slot]
    base = s.job_base[slot]
    n = _walk(t, w, base, vertex)
    lag = waiting = executing = suspended = transport = group = 0
    unknown = completed - release
    if n > 0:
        first = w.walk[n - 1]
        before = w.chain[base + t.region_offset[first], K_READY] - release
        unknown = before
        if w.before_legs[first] == w.before_legs[first + 1]:
            lag, unknown = before, 0
    for k in range(n - 1, -1, -1):
        x = base + t.region_offset[w.walk[k]]
        ready, start, end = w.chain[x, K_READY], w.chain[x, K_START], w.chain[x, K_END]
        waiting += start - ready
        published = completed
        if k > 0:
            after = w.chain[base + t.region_offset[w.walk[k - 1]], K_READY]
            published = min(end, after)
            transport += after - published
        pause = 0
        if w.chain[x, K_LEG] >= 0:
            pause = max(0, min(end - start - w.chain[x, K_BUSY], published - start))
        suspended += pause
        executing += published - start - pause
        group += w.chain[x, K_GROUP]
    parts = (lag, waiting, executing, suspended, transport, unknown, group)
    for part in parts:
        if abs(part) >= LIMIT:
            return False
    w.sinks[vertex, B_LAG] += lag
    w.sinks[vertex, B_WAITING] += waiting
    w.sinks[vertex, B_EXECUTING] += executing
    w.sinks[vertex, B_SUSPENDED] += suspended
    w.sinks[vertex, B_TRANSPORT] += transport
    w.sinks[vertex, B_UNKNOWN] += unknown
    w.sinks[vertex, B_GROUP] += group
    w.sinks[vertex, B_COMPLETED] += 1
    if (w.sinks[vertex, B_COMPLETED] == 1 or completed - release
            > w.sinks[vertex, W_COMPLETED] - w.sinks[vertex, W_RELEASE]):
        w.sinks[vertex, W_JOB] = job
        w.sinks[vertex, W_RELEASE] = release
        w.sinks[vertex, W_COMPLETED] = completed
        w.sinks[vertex, W_STEPS] = n
        for k in range(6):
            w.sinks[vertex, W_PARTS + k] = parts[k]
        for k in range(n):
            v = w.walk[n - 1 - k]
            w.worst[vertex, k, 0] = v
            for column in range(1, N_CHAIN):
                w.worst[vertex, k, column] = w.chain[base + t.region_offset[v], column]
    return True


def _walk(t: Any, w: Any, base: int, vertex: int) -> int:
    """Write the vertices of a chain from its end to its begin; return how many there are."""
    n = 0
    if w.chain[base + t.region_offset[vertex], K_KNOWN] == 0:
        return 0
    while vertex >= 0:
        w.walk[n] = vertex
        n += 1
        x = base + t.region_offset[vertex]
        ready, leg = w.chain[x, K_READY], w.chain[x, K_LEG]
        first, last = w.before_legs[vertex], w.before_legs[vertex + 1]
        if leg >= 0 and first < last:
            first, last = first + leg, first + leg + 1
        best = -1
        best_end = 0
        if first < last:
            for k in range(w.before_first[first], w.before_first[last]):
                v = w.before[k]
                before = base + t.region_offset[v]
                if (w.chain[before, K_KNOWN] != 0 and w.chain[before, K_START] <= ready
                        and (best < 0 or w.chain[before, K_END] > best_end)):
                    best = v
                    best_end = w.chain[before, K_END]
        vertex = best
    return n


def _publish(w: Any, now: int, thread: int, publisher: int, kind: int) -> None:
    row = find(w.threads, thread, 0, 0, 0)
    if w.scalars[WATCHED] != 0 and row >= 0 and w.threads[row, T_DEPTH] > 0:
        callback = w.threads[row, T_STACK + w.threads[row, T_DEPTH] - 1]
        if find(w.pairs, callback, publisher, 0, 0) < 0:
            insert(w.pairs, callback, publisher, 0, 0)
            count_row(w, PAIRS, len(w.pairs))
    if kind != PUBLISH or w.scalars[HAS_PATHS] == 0:
        return
    known = find(w.publishers, publisher, 0, 0, 0)
    if known < 0:
        return
    topic = w.publishers[known, P_TOPIC] - 1
    if topic < 0:
        return
    if row < 0 or w.threads[row, T_RUNNING] == 0 or w.threads[row, T_VERTEX] < 0:
        path_published_outside(w, w.publishers[known, P_NODE] - 1, topic, now)
    else:
        path_published(
            w, w.threads[row, T_DAG], w.threads[row, T_VERTEX], w.threads[row, T_JOB],
            w.threads[row, T_READY], topic, now)


# --- further entry points ------------------------------------------------------------------------

def begin_run(tables: int, state: int) -> None:
    """Make the core's state as ``judge`` has it."""
    fill_state(as_tables(tables), as_state(state), 1, 0, 0, 0, 0, 0)


def finish_run(tables: int, state: int, w: Any, now: int) -> bool:
    """Judge what is open at the end; False where that is for Python."""
    t = as_tables(tables)
    s = as_state(state)
    s.decisions.clear()
    w.scalars[N_MISSES] = 0
    w.scalars[N_PIECES] = 0
    jobs.finish(t, s, now)
    for k in range(len(s.decisions)):
        if w.scalars[COMPARE] != 0:
            decision = s.decisions[k]
            if w.scalars[N_MISSES] == len(w.misses):
                return False
            _miss(w, 1, decision[1], decision[2], decision[3], decision[4], decision[5])
    return True


def copy_table(table: Any, larger: Any) -> None:
    """Copy a hash table to a larger one."""
    rehash(table, larger)


def set_callback(w: Any, callback: int, column: int, value: int) -> None:
    """Set what is known of a callback."""
    w.callbacks[_callback(w, callback), column] = value


def flows_of(w: Any, first: int, last: int, marks: Any, flows: Any) -> int:
    """Mark the ends of flows (where marks are empty), or write those of a path (``path_flows``)."""
    n = w.scalars[N_STEPS]
    if first < 0:
        mark_steps(w, n, marks)
        return 0
    return path_flows(w, first, last, n, marks, flows)


def scan(
    data: int, end: int, classes: Any, layouts: Any, rows: Any, others: Any, result: Any
) -> None:
    """Walk over the records of a chunk; see ``columns_kernel.scan_records``."""
    scan_records(data, end, classes, layouts, rows, others, result)


def free_run(state: int) -> None:
    """Free the memory of the core's state."""
    free_state(state)
