# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Executions of a simulated run."""

from mddag_executor.simulate import END, PREEMPT, START


def executions(log):
    """Yield the start of each stretch in which a callback ran, and the entry of its end."""
    since = {}
    for entry in log:
        time, kind, worker, *_ = entry
        if kind == START:
            since[worker] = time
        elif kind in (END, PREEMPT):
            yield since.pop(worker), entry
