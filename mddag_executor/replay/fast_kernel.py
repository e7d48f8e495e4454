# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
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

from mddag_executor.core import jobs
from mddag_executor.core.state import fill_state, SKIP
from mddag_executor.core.tables import NEVER
from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.fast_core import (
    note_miss,
    on_complete,
    on_deadline,
    on_fail,
    on_job_end,
    on_release,
)
from mddag_executor.replay.fast_paths import count_row
from mddag_executor.replay.fast_tables import find, insert, rehash
from mddag_executor.replay.fast_threads import (
    callback_row,
    note_time,
    on_dispatch,
    on_end,
    on_publish,
    on_start,
)
from mddag_executor.replay.fast_types import as_matrix, as_work
from mddag_executor.simulate.kernel import free_state
from mddag_executor.simulate.structures import as_state, as_tables
from mddag_executor.trace.columns_kernel import scan_records


def advance(tables: int, state: int, work: int, i: int) -> int:
    """
    Go through the rows from number ``i`` on; return which one is the next.

    ``scalars[fw.STATUS]`` says why it is, ``pieces`` has all that ran, and the
    state's decisions are those since it was called.
    """
    t = as_tables(tables)
    s = as_state(state)
    w = as_work(work)
    s.decisions.clear()
    w.scalars[fw.N_MISSES] = 0
    w.scalars[fw.N_PIECES] = 0
    w.scalars[fw.STATUS] = fw.ALL_DONE
    while i < len(w.rows):
        status = has_room(t, s, w)
        if status == fw.ALL_DONE:
            n = w.scalars[fw.N_PIECES]
            status = on_event(t, s, w, i)
            if w.scalars[fw.N_PIECES] > n:
                w.pieces[n, fw.R_AT] = i
                w.pieces[n, fw.R_DECIDED] = len(s.decisions)
        if status != fw.ALL_DONE:
            w.scalars[fw.STATUS] = status
            return i
        i += 1
    return i


def has_room(t: Any, s: Any, w: Any) -> int:
    """Tell whether there is room for what an event may bring, whatever it is."""
    executions = len(s.x_slot) + w.scalars[fw.REGION]
    if w.scalars[fw.FULL] != 0 or executions > len(w.chain):
        return fw.TOO_FULL
    steps = w.scalars[fw.N_STEPS] + 4 * len(w.place_done) + 4
    if w.scalars[fw.HAS_PATHS] != 0 and steps > len(w.steps):
        return fw.TOO_FULL
    if w.scalars[fw.N_MISSES] + t.n_vertices + 2 > len(w.misses):
        return fw.TAKE_AWAY
    return fw.ALL_DONE


def on_event(t: Any, s: Any, w: Any, i: int) -> int:
    """Take in one event; return why it is not done, or that all is."""
    now, kind, thread = w.rows[i, 0], w.rows[i, 1], w.rows[i, 2]
    if kind == fw.OTHER:
        return fw.FOR_PYTHON
    if now < 0 or now >= NEVER or w.rows[i, 3] != w.scalars[fw.PROCESS_ID]:
        return fw.DECLINED
    if now > w.scalars[fw.LAST]:
        w.scalars[fw.LAST] = now
    fine = True
    if kind == fw.START:
        fine = on_start(w, now, thread, w.rows[i, 4])
    elif kind == fw.END:
        fine = on_end(w, now, thread, w.rows[i, 4])
    elif kind == fw.DISPATCH:
        fine = on_dispatch(t, s, w, now, thread, i)
    elif kind == fw.COMPLETE:
        note_time(w, now)
        fine = on_complete(t, s, w, now, thread, i)
    elif kind == fw.RELEASE:
        note_time(w, now)
        fine = on_release(t, s, w, now, w.rows[i, 4], w.rows[i, 5], w.rows[i, 6])
    elif kind == fw.PUBLISH or kind == fw.RCL_PUBLISH:
        on_publish(w, now, thread, w.rows[i, 4], kind)
    elif kind == fw.DEADLINE:
        note_time(w, now)
        on_deadline(w, w.rows[i, 4], w.rows[i, 5], w.rows[i, 6], w.rows[i, 7], w.rows[i, 8])
    elif kind == fw.FAIL:
        note_time(w, now)
        fine = on_fail(t, s, w, now, w.rows[i, 4], w.rows[i, 5], w.rows[i, 6])
    elif kind == fw.EXPIRE or kind == fw.ABORT:
        note_time(w, now)
        fine = on_job_end(t, s, w, now, w.rows[i, 4], w.rows[i, 5], kind == fw.ABORT)
    return fw.ALL_DONE if fine else fw.DECLINED


def begin_run(tables: int, state: int, skip: int) -> None:
    """Make the core's state as ``judge`` has it."""
    s = as_state(state)
    fill_state(as_tables(tables), s, 1, 0, 0, 0, 0, 0)
    s.scalars[SKIP] = skip


def finish_run(tables: int, state: int, work: int, now: int) -> bool:
    """Judge what is open at the end; False where that is for Python."""
    t = as_tables(tables)
    s = as_state(state)
    w = as_work(work)
    s.decisions.clear()
    w.scalars[fw.N_MISSES] = 0
    w.scalars[fw.N_PIECES] = 0
    jobs.finish(t, s, now)
    for k in range(len(s.decisions)):
        if w.scalars[fw.COMPARE] != 0:
            decision = s.decisions[k]
            if w.scalars[fw.N_MISSES] == len(w.misses):
                return False
            note_miss(w, 1, decision[1], decision[2], decision[3], decision[4], decision[5])
    return True


def copy_table(table: int, larger: int) -> None:
    """Copy a hash table to a larger one; both are addresses of matrices."""
    rehash(as_matrix(table), as_matrix(larger))


def set_callback(work: int, callback: int, column: int, value: int) -> None:
    """Set what is known of a callback."""
    w = as_work(work)
    w.callbacks[callback_row(w, callback), column] = value


def set_publisher(work: int, publisher: int, topic: int, node: int) -> None:
    """Set the topic and the node of a publisher, each plus one."""
    w = as_work(work)
    row = find(w.publishers, publisher, 0, 0, 0)
    if row < 0:
        row = insert(w.publishers, publisher, 0, 0, 0)
        count_row(w, fw.PUBLISHERS, len(w.publishers))
    w.publishers[row, fw.P_TOPIC] = topic
    w.publishers[row, fw.P_NODE] = node


def scan(
    data: int, end: int, classes: Any, layouts: Any, rows: Any, others: Any, result: Any
) -> None:
    """Walk over the records of a chunk; see ``columns_kernel.scan_records``."""
    scan_records(data, end, classes, layouts, rows, others, result)


def free_core(state: int) -> None:
    """Free the memory of the core's state."""
    free_state(state)
