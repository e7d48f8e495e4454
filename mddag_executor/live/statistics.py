# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A snapshot of what an executor has done: plain dictionaries, as ``--json`` has them."""

from __future__ import annotations

from typing import Any

from mddag_executor.core.tally import counts, never_due
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry
from mddag_executor.live.why import CAUSES


def statistics(
    pool: Pool, registry: Registry, recorder: Recorder | None, process: str | None = None
) -> dict[str, Any]:
    """
    Return the counts of a run.

    ``dags``, ``deadline_missed`` and ``first_miss`` are as in ``replay --json``.  ``callbacks``
    has for each entity what became ready, ran, failed (raised), waits, was dropped (QoS depth,
    destroyed, aborted) or skipped (timers), its busy time in ns, whether it holds the interpreter
    while it runs, and for which part of its time it needs that (None: not known yet).
    ``unattributed`` counts messages of declared callbacks whose publication was not found; they
    ran as undeclared ones.  ``stops`` has how often and for how long no thread of the process ran
    while it spun, how many misses fell into these stops, and the times of the last ones (ns since
    the epoch).  ``causes`` has how many misses of which cause there are, as far as the executor
    knows it at once.  ``preemption`` (None unless asked for) has why it is off, or None, and how
    often a callback was to pause.
    """
    engine = pool.engine
    with pool.lock:
        result = engine.verdicts.tally.result()
        stops = engine.verdicts.stops.result()
        causes = {cause: sum(of[cause] for of in engine.verdicts.causes) for cause in CAUSES}
        waiting = engine.scheduler.queue_length
        idle = engine.scheduler.idle_workers
        undeclared = engine.undeclared
        elsewhere = set() if engine.other_processes is None else engine.other_processes.elsewhere()
    elsewhere |= registry.elsewhere(process)
    callbacks = registry.counts()
    never_ran = [c.key for c in registry.declared
                 if c.key not in elsewhere
                 and (c.key not in callbacks or not callbacks[c.key]['ran'])]
    for dag in result['dags'].values():  # their sinks are judged where they are
        dag['sinks'] = {name: sink for name, sink in dag['sinks'].items()
                        if name.partition('@')[0] not in elsewhere or counts(sink).due}
    result['never_due'] = never_due(result['dags'])
    return {
        'policy': engine.scheduler.policy.name, 'workers': engine.n_workers,
        **result, 'stops': stops, 'causes': causes, 'callbacks': callbacks,
        'undeclared': undeclared,
        'dropped': {n: c['dropped'] for n, c in callbacks.items() if c['dropped']},
        'preemption': None if pool.preemption is None else {
            'reason_off': pool.preemption.reason or None, 'pauses': pool.preemption.count},
        'queue': waiting, 'idle_workers': idle, 'lent': pool.lent,
        'unattributed': {
            'unknown': engine.jobs.unknown,
            'doubtful': engine.jobs.doubtful},
        'never_ran': never_ran,
        'trace': None if recorder is None else {
            'path': recorder.path, 'lost': recorder.writer.dropped,
            'error': None if recorder.writer.error is None else str(recorder.writer.error)},
    }
