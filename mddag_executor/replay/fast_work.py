# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the compiled replay works on: the columns of its arrays, and their rows.

``fast`` makes the arrays and reads the results from them; ``fast_kernel`` and ``fast_paths`` are
compiled and change them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

# Kinds of rows (0: an event that is not decoded, see ``trace.columns``).
(OTHER, START, END, RELEASE, DISPATCH, COMPLETE, DEADLINE, EXPIRE, ABORT, PUBLISH,
 RCL_PUBLISH, FAIL) = range(12)
KINDS = {
    'ros2:callback_start': START, 'ros2:callback_end': END, 'mddag:job_release': RELEASE,
    'mddag:dispatch': DISPATCH, 'mddag:complete': COMPLETE, 'mddag:deadline': DEADLINE,
    'mddag:expire': EXPIRE, 'mddag:abort': ABORT, 'ros2:rclcpp_publish': PUBLISH,
    'ros2:rcl_publish': RCL_PUBLISH, 'mddag:fail': FAIL}

# Why the compiled code came back: all is done, an event for Python, something is full, the output
# is to be taken away, or this is nothing for it.
ALL_DONE, FOR_PYTHON, TOO_FULL, TAKE_AWAY, DECLINED = range(5)

# Places in ``scalars``.
(STATUS, BEGIN, FINISH, SHUT_DOWN, JOBS, STARTING, PROCESS_ID, FIRST, LAST, FULL, N_MISSES,
 N_PIECES, N_RECORDED, COMPARE, CONTRADICTIONS, NEXT_ID, COUNTED, N_WAITED, N_RECENT, KEYED,
 ANY_PUBLISHED, N_STEPS, N_JOBS, HAS_PATHS, WATCHED, REGION,
 N_SCALARS) = range(27)

# Hash tables, in the order of ``counts``.
(THREADS, OPEN, SLOTS, RECENT, CALLBACKS, PAIRS, PATH_JOBS, PUBLISHERS, N_TABLES) = range(9)

# A thread: what it runs; the execution whose piece ended last; callbacks that it is within.
(T_RUNNING, T_CALLBACK, T_DAG, T_VERTEX, T_JOB, T_WORKER, T_READY, T_START,
 T_LAST, T_LAST_DAG, T_LAST_VERTEX, T_LAST_JOB, T_LAST_READY, T_LAST_START, T_LAST_END,
 T_LAST_BUSY, T_LAST_ID, T_DEPTH, T_STACK) = range(5, 24)
DEEPEST = 16
# An execution that is not complete.
O_START, O_END, O_BUSY, O_WAITED = range(5, 9)
S_SLOT = 5
# A callback: group, topic, DAG and vertex are kept plus one, 0 for none.
C_GROUP, C_TOPIC, C_RAN, C_DAG, C_VERTEX, C_ORDER = range(5, 11)
J_PLACE = 5
# A publisher: its topic and node, plus one.
P_TOPIC, P_NODE = 5, 6
WIDTHS = (T_STACK + DEEPEST, 9, 6, 5, 11, 5, 6, 7)

# What ran: first the columns of ``batches``; then at which row it ended, and how many decisions
# there were by then.
(R_START, R_END, R_READY, R_VERTEX, R_JOB, R_WORKER, R_CALLBACK, R_AT, R_DECIDED,
 N_PIECE) = range(10)
# What callbacks used.
U_RAN, U_BUSY, U_LONGEST, U_WAITING, U_LONGEST_WAIT, U_GROUP, N_USE = range(7)
# A step of a chain.
K_KNOWN, K_LEG, K_READY, K_START, K_END, K_BUSY, K_GROUP, N_CHAIN = range(8)
# What became of a sink: parts of the response time; the worst job.
(B_LAG, B_WAITING, B_EXECUTING, B_SUSPENDED, B_TRANSPORT, B_UNKNOWN, B_GROUP, B_COMPLETED,
 W_JOB, W_RELEASE, W_COMPLETED, W_STEPS, W_PARTS) = range(13)
N_SINK = W_PARTS + 7

KEEP_RECENT = 4096
KEEP_WAITED = 4096
KEEP_JOBS = 4096
KEEP_BUSY = 256
MOST_WORKERS = 4096
LIMIT = 1 << 38
"""Longer times (ns) are left to Python, whose sums have no limit."""

# Kinds of hops to a place of a path.
TRIGGER, TOPIC, VARIABLE = range(3)
RUN_END = 2     # kind of a step's second row, which has its end
# A step: its time; its parent plus one, its place and its kind in one number.
X_TIME, X_WHAT, N_STEP = range(3)
X_PARENT, X_PLACE = 24, 8       # bits to shift by


Vector = Any
Matrix = Any
"""Arrays of int64 with one and with two dimensions."""


class Work(NamedTuple):
    """All arrays."""

    scalars: Vector
    counts: Vector
    threads: Matrix
    ongoing: Matrix
    slots: Matrix
    recent: Matrix
    callbacks: Matrix
    pairs: Matrix
    path_jobs: Matrix
    publishers: Matrix
    recent_ring: Matrix
    # the mapping: by recorded DAG, vertex (from map_first on) and leg (from map_legs on)
    map_dag: Vector
    map_first: Vector
    map_vertex: Vector
    map_legs: Vector
    legs: Vector
    newest: Vector
    releases: Matrix
    # by DAG of the declaration that judges
    judge_newest: Vector
    released: Vector
    use_of: Vector
    use: Matrix
    workers: Matrix
    group_busy: Matrix
    group_count: Vector
    # by vertex and leg: the vertex whose message it is
    before_legs: Vector
    before: Vector
    chain: Matrix
    walk: Vector
    sinks: Matrix
    worst: Matrix
    misses: Matrix
    # paths: by vertex its places, its topics, what it publishes
    v_places: Vector
    v_place: Vector
    v_topics: Vector
    v_topic: Vector
    v_publishes: Vector
    v_publish: Vector
    # vertices before each vertex
    v_befores: Vector
    v_before: Vector
    # by vertex: where its runs stand in a job, and how many fit
    v_runs: Vector
    v_most: Vector
    # by vertex's place and topic: where its message stands in a job, -1 for none
    message_at: Matrix
    # by place: position, kind of the hop to it, whether it is of a sync, whether it is the last
    place_position: Vector
    place_hop: Vector
    place_sync: Vector
    place_last: Vector
    hop_topics: Matrix
    publish_topics: Matrix
    node_places: Vector
    node_place: Vector
    place_started: Vector
    place_done: Vector
    place_published: Vector
    jobs: Matrix           # what is kept of each of the last jobs
    job_ring: Matrix
    steps: Matrix
    # what is handed over: events, and what ran
    rows: Matrix
    pieces: Matrix
