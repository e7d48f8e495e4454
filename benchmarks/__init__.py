# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmarks behind the figures of the docs; run from a checkout, not installed.

    .venv/bin/python -m benchmarks live|core|replay|evaluate …

``live`` measures executors of rclpy nodes side by side, this one and those of rclpy; ``core`` the
scheduler core; ``replay`` the replayer; ``evaluate`` the batch evaluation.  How ``live`` works:

Theory of operation
-------------------
One measurement is a ``Spec``.  ``campaign`` runs each in a process of its own
(``python -m benchmarks.child``), one after the other, so that none has another's threads, caches
or nodes beside it; the yardstick is the same for all of them.

There are two families of loads.  *Declared* loads (``autoware``, ``reference-system``) are the
synthetic nodes of a declaration, with the same draw of execution times for every executor; they
ask who keeps deadlines.  *Message* loads (``topics``, ``entities``) are subscriptions with empty
callbacks, whose publishers run in another process so that their cost is not counted; they ask what
a callback costs and how long a message waits.

``dispatch latency`` is the time from a message's source timestamp, which the middleware sets when
it is published, to the first statement of its callback; for a timer, from its nominal due time.
"""
