# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Statistics of an executor: a snapshot in plain dictionaries (``results.runs``)."""

from __future__ import annotations

from typing import cast

from mddag_executor.core.tally import counts, never_due
from mddag_executor.executor.misses import MissNotifier
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.registry import Registry
from mddag_executor.executor.unfinished import unfinished
from mddag_executor.executor.workers import WorkerPool
from mddag_executor.results.runs import CallbackCounts, Statistics
from mddag_executor.results.sinks import UnfinishedRun


def statistics(
    pool: WorkerPool, registry: Registry, recorder: Recorder | None, process: str | None = None,
    notifier: MissNotifier | None = None,
) -> Statistics:
    """Return the counts of a run; see ``results.runs`` for their meaning."""
    engine = pool.engine
    with pool.lock:
        result = engine.verdicts.tally.result()
        stops = engine.verdicts.stops.result()
        waiting = engine.queue_length
        idle = engine.idle_workers
        undeclared = engine.undeclared
        now = pool.clock.now()
        requirements = engine.requirements(now)
        running: list[UnfinishedRun] = [
            {'callback': each.work.entity.name, 'since_ns': each.since,
             'for_ns': max(0, now - each.since), 'where': each.where} for each in unfinished(pool)]
        elsewhere = set() if engine.other_processes is None else engine.other_processes.elsewhere()
    elsewhere |= registry.bindings.elsewhere(process)
    callbacks = cast('dict[str, CallbackCounts]', registry.counts())
    begun = {each['callback'] for each in running}
    never_ran = [c.key for c in registry.bindings.declared
                 if c.key not in elsewhere and c.key not in begun
                 and (c.key not in callbacks or not callbacks[c.key]['ran'])]
    for dag in result['dags'].values():  # their sinks are judged in their own processes
        dag['sinks'] = {name: sink for name, sink in dag['sinks'].items()
                        if name.partition('@')[0] not in elsewhere or counts(sink).due}
    return {
        'policy': engine.scheduler.policy.name, 'on_late': engine.on_late,
        'workers': engine.n_workers,
        'deadline_missed': result['deadline_missed'], 'first_miss': result['first_miss'],
        'never_due': never_due(result['dags']), 'dags': result['dags'],
        'requirements': requirements, 'stops': stops,
        'callbacks': callbacks, 'undeclared': undeclared,
        'dropped': {n: c['dropped'] for n, c in callbacks.items() if c['dropped']},
        'unfinished': running,
        'clock_steps': [{'at_ns': at, 'step_ns': step} for at, step in engine.clock_steps],
        'queue': waiting, 'idle_workers': idle, 'lent': pool.lending.n_lent,
        'unattributed': {
            'unknown': engine.attribution.unknown,
            'doubtful': engine.attribution.doubtful},
        'never_ran': never_ran,
        'not_found': {key: question for key, question in registry.bindings.not_found().items()
                      if key in never_ran},
        'unreported_misses': 0 if notifier is None else notifier.unreported,
        'trace': None if recorder is None else {
            'path': recorder.path, 'lost': recorder.writer.dropped,
            'error': None if recorder.writer.error is None else str(recorder.writer.error)},
    }
