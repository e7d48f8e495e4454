# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What requests inherit from the executions that send them: rule 15 of the scheduling rules.

Theory of operation
-------------------
An undeclared execution has a priority of its own: its ready time plus the default deadline.  If it
*inherits* (``State.x_like`` is not -1), it has the priority of the execution that has sent the
request, and that may wait for the response.  Its slot then counts as released one default deadline
before that priority, so that the check of late work (``overload``) comes when the priority is
over.  ``State.job_ready`` keeps the time at which the execution became ready.

Executions of a queue keep their order.  If one of them inherits, those before it have its priority
as well, because it waits for them.  ``State.job_inherited`` keeps what each one inherits itself.

Like ``rules`` this module contains only integer arithmetic, list indexing and ``heapq``.
"""

from __future__ import annotations

from heapq import heappush

from mddag_executor.core.queues import change_key, remove
from mddag_executor.core.state import ALONE, OTHER_KEYS, State, URGENCY
from mddag_executor.core.tables import NEVER, Tables


def inherit(t: Tables, s: State, x: int, priority: int, like: int) -> None:
    """
    Let a waiting undeclared execution inherit a priority, if that is smaller than its own one.

    :param like: the vertex of the execution that has sent the request, of which the priority is.
    """
    if s.scalars[URGENCY] == OTHER_KEYS or priority >= s.x_key[x][0]:
        return
    if s.x_state[x] == ALONE:
        remove(s.ready, ~x)
        _lend(t, s, x, priority, like)
        heappush(s.ready, s.x_key[x])
    else:
        queue = s.x_queue[x]
        each = x
        while each >= 0 and s.x_key[each][0] > priority:
            _lend(t, s, each, priority, like)
            each = s.x_previous[each]
        entry = s.queue_key[queue]
        if priority < entry[0]:
            _lend(t, s, s.queue_first[queue], priority, like)  # the queue may be late
            change_key(s, queue, (priority, entry[1], entry[2], entry[3], queue))
    s.job_inherited[s.x_slot[x]] = priority
    s.job_heir[s.x_slot[x]] = like


def heritage(s: State, x: int) -> tuple[int, int] | None:
    """
    Return what requests of a running execution inherit: see ``inherit``; None: nothing.

    This only reads, so a driver may call it at any time while the execution runs.
    """
    like = s.x_like[x]
    return None if like < 0 else (s.x_key[x][0], like)


def _lend(t: Tables, s: State, x: int, priority: int, like: int) -> None:
    """Let an execution have a priority that it, or one behind it in its queue, inherits."""
    slot = s.x_slot[x]
    if s.x_like[x] < 0:
        s.job_ready[slot] = s.job_release[slot]
        s.job_inherited[slot] = NEVER
    s.x_like[x] = like
    s.job_release[slot] = priority - t.rad_offset[t.n_vertices]
    key = s.x_key[x]
    if priority < key[0]:
        s.x_key[x] = (priority, key[1], key[2], key[3], key[4])


def undeclared_priority(t: Tables, s: State, x: int, now: int) -> int:
    """
    Return the priority of an undeclared execution that comes first, when the one it had is over.

    It is the least that an execution in its queue inherits and that is not over, else its own.
    NEVER: it is late.
    """
    found = -1
    priority = NEVER
    each = x
    while each >= 0:
        inherited = s.job_inherited[s.x_slot[each]]
        if s.x_like[each] >= 0 and now <= inherited and inherited < priority:
            found = each
            priority = inherited
        each = s.x_next[each]
    if found >= 0:
        _lend(t, s, x, priority, s.job_heir[s.x_slot[found]])
        return priority
    if s.x_like[x] < 0:
        return NEVER
    slot = s.x_slot[x]
    s.x_like[x] = -1
    s.job_release[slot] = s.job_ready[slot]
    own = s.job_ready[slot] + t.rad_offset[t.n_vertices]
    if s.x_state[x] == ALONE:
        if s.x_started[x] >= 0:
            return own  # it goes on, and is never late
    elif s.queue_demoted[s.x_queue[x]] >= 0:
        return NEVER
    return own if now <= own else NEVER
