# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmarks behind the figures of the docs; run from a checkout, not installed.

.venv/bin/python -m benchmarks live|core|replay|evaluate …

``live`` compares this executor with those of rclpy; ``core`` measures the scheduler core;
``replay`` the replayer; ``evaluate`` the batch evaluation.  How ``live`` works:

Theory of operation
-------------------
One measurement is a ``Spec``.  ``campaign`` runs each in a separate process, one after
the other, so no measurement shares threads, caches or nodes with another.

There are two families of loads.  *Declared* loads (``autoware``, ``reference-system``) are the
synthetic nodes of a declaration, with the same draw of execution times for every executor; they
measure missed deadlines.  *Message* loads (``topics``, ``entities``) are subscriptions with empty
callbacks; they measure the cost of a callback and the latency of a message.  Their publishers run
in another process, so their cost is not counted.

``dispatch latency`` is the time from a message's source timestamp, which the middleware sets when
it is published, to the first statement of its callback; for a timer, from its nominal due time.
"""
