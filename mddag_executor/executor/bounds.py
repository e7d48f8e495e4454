# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The times and numbers that the executor is tuned with.

Each has its reason and, if it was measured, the figure.  What has to do with the GIL only is in
``gil`` and ``core.queues``.
"""

from __future__ import annotations

BRIEF_NS = 300_000
"""
While a callback runs that usually takes no longer than this, no other thread is woken.

Waking a thread costs 60 to 140 us next to a callback that computes.
"""

GUARD_NS = 2_000_000
"""
The longest that something ready waits because a callback was expected to end.

Each time it is set costs 9 us, and about 25 us when it has come, whatever was found then.
"""

STOP_NS = 5_000_000
"""A wake-up that is late by this, while the process computes nothing, is a stop of the machine."""

AGAIN_NS = 5_000_000
"""
How often something is checked that is not announced.

A callback group that has refused an execution, and the end of a context.
"""

YIELD_STEP_NS, MOST_YIELD_NS = 1_000, 2_000_000
"""
A coroutine that yields continues in the next turn, each time in a row this much later, up to 2 ms.

So one that yields a few times loses nothing, and one that polls does not compute all the time.
"""

END_S = 1.0
"""How long the end waits for a thread that was asked to end; it usually takes less than 1 ms."""

MOST = 64
"""
The bound of what is usually less than ten.

Messages taken from one entity before others have their turn, messages of a profile that keeps all
that wait in Python, publications of a topic, callbacks that wait in ``Client.call``.
"""

REMEMBERED = 4096
"""So many past items of a kind are remembered: aborted jobs, stamps of jobs, undeclared names."""

LOG_EVERY_S = 10.0
"""How often the same kind of warning is logged at most."""
