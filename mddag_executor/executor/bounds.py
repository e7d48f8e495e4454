# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Tuning constants of the executor, each with its reason and the measured figure, if any.

Those about the GIL only are in ``gil``, ``gil_check`` and ``core.queues``.
"""

from __future__ import annotations

SHORT_CALLBACK_NS = 300_000
"""
While a callback runs that usually takes no longer than this, no other thread is woken.

Waking a thread costs 60 to 140 us while a callback computes.
"""

PATIENCE_NS = 4_000_000
"""
The longest that a ready callback waits because another one was expected to end.

It is less if the ready one is urgent: its relative deadline by ``PATIENCE_PART``, but not less
than ``LEAST_PATIENCE_NS``.  A callback that holds the interpreter is checked after half of it, and
once more after a quarter (``gil_check.CHECK_PART``).  So an execution with a relative deadline of
20 ms starts 0.45 ms and two wake-ups after it became ready, if the callback before it was expected
to end, but waits: 0.75 ms were measured.
"""

PATIENCE_PART = 33

LEAST_PATIENCE_NS = 2 * SHORT_CALLBACK_NS

NET_NS = 20_000_000
"""While a short callback runs longer than expected, arrivals stay unnoticed for this at most."""

REPORT_NS = 100_000
"""
The thread of a callback that has ended reports that within this, if it gets the lock and the GIL.

The end of a result may be in time when it is reported after the deadline.  So its job is judged
again after this.
"""

QUIET_NS = 5_000_000
"""
If the last rest of a thread was longer ago, the next look is set by the next timer.

The look comes ``NET_NS`` after the next timer or other appointment, for which a thread wakes up
anyway, or at the latest time at which the one after that must be noticed.  So the callback of the
timer need not set the look.  In a process with many callbacks, of which no timer is due soon, the
look is put off by up to ``NET_NS`` instead, for the same reason, unless it would not come within
``NET_NS`` less this.
"""

AFTER_NS = 2_000_000
"""
A look that was set for this time after the next timer, or for later, is not put off.

The callbacks that begin with the timer have usually ended by then.
"""

LOOK_PART = 4
"""
While callbacks compute, a timer or message may stay unnoticed for this part of its deadline.

Each look costs 60 to 140 us.
"""

SOON_NS = 1_000_000
"""
A thread that computes lets another one go on after this (``gil.SWITCH_INTERVAL_S``).

So nothing is looked for sooner, unless it is known when it comes.  A look that is set to a
later time stays as it is.
"""

STOP_NS = 5_000_000
"""A wake-up that is late by this, in a process that computes nothing, is a stop of the machine."""

AGAIN_NS = 5_000_000
"""
How often unannounced changes are checked.

These are a callback group that has refused an execution and, every 20th time, the end of a
context.
"""

MOST_YIELD_NS = 2_000_000
"""
A coroutine that yields continues in the next turn: each time in a row 1 us later, up to this.

So a coroutine that yields a few times loses nothing, and one that polls does not compute all the
time.
"""

ALONE_NS = 5_000_000_000
"""
How long it waits at most for another callback of its program, which is not to overlap with it.

If that one waits for the first one (which may own a lock), the two overlap after this time.
"""

REJOIN_NS = 50_000_000
"""
How often a callback that waits for its worker after ``Client.call`` checks what keeps it.

If all running callbacks wait for something, and none has ended, since the last check, it goes on
without one.
"""

END_S = 1.0
"""How long the end waits for a thread that was asked to end; it usually takes less than 1 ms."""

MOST = 64
"""
One bound for several quantities that are usually below ten.

They are: messages taken from one entity before the next entity, waiting messages of a keep-all
profile, remembered publications of a topic, callbacks that wait in ``Client.call``, and ready
executions that are checked for one that may start.
"""

REMEMBERED = 4096
"""How many past items of a kind are remembered: stamps of jobs, undeclared names."""

HISTORY = 40
"""How many of the last changes of threads an ``InvariantError`` lists."""

LOG_EVERY_S = 10.0
"""The minimum time between two logged warnings of the same kind."""
