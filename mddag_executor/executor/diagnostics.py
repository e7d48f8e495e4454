# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An executor's reports on ``/diagnostics``, the topic of ROS's own tools.

Theory of operation
-------------------
Once a period a separate thread reads the executor's counters and publishes one
``DiagnosticArray``: a status for each DAG that has a callback in this process, and one for the
pool.  The thread does not take the engine's lock.  It reads counters while they change; a change
that it misses shows one period later.

A DAG's status is about the recent results of its sinks in this process, and has values for each
of them, with the sink's name in the key.  Its level is that of the worst sink.  STALE: no job has
been released for a while, and the DAG is neither sporadic nor released only once.  ERROR, WARN:
see ``Thresholds``.  The pool's status is WARN when data was lost: messages beyond a queue's depth,
releases of timers, messages whose job was not found, events of the trace, misses for which
``on_deadline_miss`` was too slow.  It is also WARN while an execution has run for ``LONG_NS``.

By the conventions of diagnostics names are ``NAME: DAG`` and ``NAME: workers``, the hardware_id is
the host's name and the process, and values are texts with the unit in their keys.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Sequence
from contextlib import suppress
import os
import socket
import threading
import time
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.core import quantile
from mddag_executor.core.requirements import Requirements
from mddag_executor.core.tally import Counts, counts, Tally
from mddag_executor.executor.bounds import END_S
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.executor.settings import Thresholds
from mddag_executor.executor.shutdown import is_over, join, stop_at_exit
from mddag_executor.executor.unfinished import LONG_NS, unfinished
from mddag_executor.text import counted
from rclpy.logging import get_logger
from rclpy.type_support import check_for_type_support

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray
    from mddag_executor.executor.misses import MissNotifier
    from mddag_executor.executor.recorder import Recorder
    from mddag_executor.executor.registry import Registry
    from mddag_executor.executor.workers import WorkerPool
    from msg_graph import Dag, TaskSet

TOPIC = '/diagnostics'
WORKERS = 'workers'
NODE_NAME = '_mddag_diagnostics'
OK, WARN, ERROR, STALE = range(4)
MOST_HANGING = 3
"""Of more executions that have not ended, the longest ones are named."""
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')


class Status(NamedTuple):
    """One status: name, level (OK, WARN, ERROR, STALE), message, values by key."""

    name: str
    level: int
    message: str
    values: dict[str, str]


class _Seen(NamedTuple):
    """The counters of a DAG at one time; ``results`` and ``completed`` by sink."""

    results: dict[str, Counts]
    jobs: int
    completed: dict[str, int]
    in_stops: int


_REASONS = ('late', 'expired', 'failed', 'dropped', 'demoted')


class DagWatch:
    """
    Judges the state of one DAG, period by period.

    :param every_ns: the period of the diagnostics.
    :param in_stops: by DAG, the number of misses explained by stops of the machine.
    """

    def __init__(
        self, tally: Tally, dag: Dag, thresholds: Thresholds, every_ns: int,
        in_stops: Sequence[int],
    ) -> None:
        self._tally = tally
        self._dag = dag
        self._thresholds = thresholds
        self._in_stops = in_stops
        self._sinks = {tally.vertex_name(v): sink for v, sink in tally.sinks_of(dag).items()}
        self._keys = {dag.vertices[i].name: dag.vertices[i].callback.key for i in dag.sinks}
        # whether silence is normal
        self._is_quiet = dag.once or dag.sporadic
        self._stale_after = max(thresholds.stale_periods * dag.period_ns, every_ns)
        # the counters at the end of each period of the window, and before it
        self._seen = deque([self._read()], maxlen=thresholds.window + 1)
        # by sink, the response times of each period of the window
        self._responses: deque[dict[str, list[int]]] = deque(maxlen=thresholds.window)
        self._released_at: int | None = None

    def _read(self) -> _Seen:
        return _Seen(
            {name: counts(sink.verdicts()) for name, sink in self._sinks.items()},
            self._tally.jobs[self._dag.index],
            {name: sink.completed for name, sink in self._sinks.items()},
            self._in_stops[self._dag.index])

    def status(self, now: int, hosted: Container[Any]) -> Status:
        """
        Return the status; called once a period.

        :param now: monotonic ns.
        :param hosted: the keys of the callbacks in this process.
        """
        last, seen = self._seen[-1], self._read()
        self._seen.append(seen)
        self._responses.append(self._new_responses(last, seen))
        if seen.jobs != last.jobs:
            self._released_at = now
        before = self._seen[0]
        windows = {name: seen.results[name].minus(before.results[name]) for name in self._sinks}
        results, window = (Counts.total(each.values()) for each in (seen.results, windows))
        in_stops = seen.in_stops - before.in_stops
        silence = self._silence(now)
        levels = {name: STALE if silence else _level(
            self._thresholds, seen.results[name].minus(last.results[name]), windows[name])
            for name in self._sinks}
        ratio = window.missed / window.due if window.due else 0.0
        values = {
            'period_ms': _ms(self._dag.period_ns), 'jobs': str(seen.jobs),
            'results': str(results.due), 'missed': str(results.missed),
            **{key: str(getattr(results, key)) for key in _REASONS},
            **self._tolerated(),
            'window_results': str(window.due), 'window_missed': str(window.missed),
            'window_missed_ratio': f'{ratio:.4f}', 'window_in_stops': str(in_stops),
            **self._response_times()}
        for name in self._sinks:
            if self._keys[name] not in hosted and not seen.results[name].due:
                continue    # another process judges it
            values.update({f'{key} {name}': value for key, value in self._sink_values(
                name, levels[name], windows[name], silence).items()})
        return Status(
            f'{self._thresholds.name}: {self._dag.name}',
            STALE if silence else max(levels.values(), default=OK),
            silence or _message(window, in_stops), values)

    def _tolerated(self) -> dict[str, str]:
        """Return the worst window of the sink that is nearest to its tolerance, if any has one."""
        sinks = [(vertex, window) for vertex, window in self._tally.windows.items()
                 if self._tally.vertex_name(vertex) in self._sinks]
        if not sinks:
            return {}
        tolerated = {v: self._tally.tolerated(v) for v, _ in sinks}
        vertex, window = max(sinks, key=lambda item: item[1].worst / tolerated[item[0]])
        return {'worst_window': f'{window.worst} of {window.of}, {tolerated[vertex]} tolerated'}

    def _silence(self, now: int) -> str:
        """Return the message of a DAG that releases nothing; empty: it does, or need not."""
        if self._is_quiet:
            return ''
        if self._released_at is None:
            return 'nothing has been released yet'
        silent = now - self._released_at
        return (f'nothing has been released for {silent / 1e9:.1f} s'
                if silent >= self._stale_after else '')

    def _new_responses(self, last: _Seen, seen: _Seen) -> dict[str, list[int]]:
        """Return the response times of the last period, by sink."""
        found = {}
        for name, sink in self._sinks.items():
            # a copy made while others are added may contain one of them twice
            kept = sink.responses
            new = min(seen.completed[name] - last.completed[name], len(kept))
            found[name] = [kept[-i] for i in range(1, new + 1)]
        return found

    def _response_times(self) -> dict[str, str]:
        """Return the response times of the last period, in parts of their deadlines and in ms."""
        found = {name: times for name, times in self._responses[-1].items() if times}
        if not found:
            return {}
        times = sorted(time for each in found.values() for time in each)
        deadlines = {name: self._sinks[name].relative_deadline_ns for name in found}
        used = max(max(each) / deadlines[name] for name, each in found.items())
        margin = min(deadlines[name] - max(each) for name, each in found.items())
        return {
            'response_p50_ms': _ms(quantile(times, 0.5)),
            'response_p99_ms': _ms(quantile(times, 0.99)), 'response_max_ms': _ms(times[-1]),
            'deadline_used_max': f'{used:.2f}', 'margin_min_ms': _ms(margin)}

    def _sink_values(self, name: str, level: int, window: Counts, silence: str) -> dict[str, str]:
        """Return the values of one sink over the window."""
        deadline_ns = self._sinks[name].relative_deadline_ns
        times = sorted(time for period in self._responses for time in period[name])
        return {
            'level': LEVELS[level], 'window_results': str(window.due),
            'in_time_ratio': f'{window.in_time / window.due:.4f}' if window.due else '',
            'deadline_ms': _ms(deadline_ns),
            **({'response_p99_ms': _ms(quantile(times, 0.99)),
                'margin_ms': _ms(deadline_ns - times[-1])} if times else {}),
            'wrong': silence or _wrong(window)}


def _level(limits: Thresholds, step: Counts, window: Counts) -> int:
    """Return the level of a sink by its results of the last period and of the window."""
    if not window.missed:
        return OK
    if window.missed >= max(limits.warn_burst, limits.error_ratio * window.due):
        return ERROR
    if step.missed >= limits.warn_burst or window.missed >= limits.warn_ratio * window.due:
        return WARN
    return OK


def _message(window: Counts, in_stops: int) -> str:
    if not window.missed:
        return f'{counted(window.due, "result")} in time'
    message = f'{window.missed} of {window.due} results missed their deadlines'
    return message + f', {in_stops} as the machine stood still' if in_stops else message


def _wrong(window: Counts) -> str:
    """Return how results of a sink missed their deadlines, the most frequent reason first."""
    if not window.missed:
        return ''
    found = {reason: getattr(window, reason) for reason in _REASONS}
    return ', '.join(f'{n} {reason}' for reason, n in sorted(
        found.items(), key=lambda item: -item[1]) if n)


def _ms(nanoseconds: int) -> str:
    return f'{nanoseconds / 1e6:.3f}'


class RequirementWatch:
    """Judges what is required of paths, period by period; response times are of the whole run."""

    def __init__(self, thresholds: Thresholds) -> None:
        self._thresholds = thresholds
        self._seen: deque[dict[tuple[str, str], Counts]] = deque(
            [{}], maxlen=thresholds.window + 1)

    def statuses(self, requirements: Requirements) -> list[Status]:
        """Return a status for each path; called once a period."""
        now = {(path, what): counts(each) for path, every in requirements.items()
               for what, each in every.items()}
        nothing = Counts.total([])
        last, before = self._seen[-1], self._seen[0]
        self._seen.append(now)
        found = []
        for path, every in requirements.items():
            windows = {what: now[path, what].minus(before.get((path, what), nothing))
                       for what in every}
            levels = {what: _level(
                self._thresholds, now[path, what].minus(last.get((path, what), nothing)),
                windows[what]) for what in every}
            window = Counts.total(windows.values())
            values = {'window_results': str(window.due), 'window_missed': str(window.missed),
                      'window_missed_ratio': f'{window.missed / max(1, window.due):.4f}'}
            for what, each in every.items():
                response, due = each['response_ns'], windows[what].due
                values.update({f'{key} {path}:{what}': value for key, value in {
                    'level': LEVELS[levels[what]], 'window_results': str(due),
                    'in_time_ratio': f'{windows[what].in_time / due:.4f}' if due else '',
                    'deadline_ms': _ms(each['relative_deadline_ns']),
                    **({'response_p99_ms': _ms(response['p99']), 'margin_ms': _ms(
                        each['relative_deadline_ns'] - response['max'])} if response else {}),
                    'wrong': _wrong(windows[what])}.items()})
            found.append(Status(
                f'{self._thresholds.name}: path {path}', max(levels.values()),
                _message(window, 0), values))
        return found


class PoolWatch:
    """Judges the state of the workers and of shared resources, period by period."""

    def __init__(
        self, pool: WorkerPool, registry: Registry, recorder: Recorder | None,
        thresholds: Thresholds, notifier: MissNotifier | None = None,
    ) -> None:
        self._engine = pool.engine
        self._notifier = notifier
        self._pool = pool
        self._registry = registry
        self._recorder = recorder
        self._thresholds = thresholds
        self._last = self._read()
        self._at = time.monotonic_ns(), time.process_time_ns()

    def _read(self) -> dict[str, int]:
        jobs = self._engine.attribution
        return {
            **self._registry.totals(), 'doubtful': jobs.doubtful,
            'trace_lost': 0 if self._recorder is None else self._recorder.writer.dropped,
            'unreported_misses': 0 if self._notifier is None else self._notifier.unreported}

    def status(self, now: int) -> Status:
        """Return the status; called once a period (``now``: monotonic ns)."""
        counts = self._read()
        step = {key: max(0, n - self._last[key]) for key, n in counts.items()}
        cpu = time.process_time_ns()
        passed, cpu_used = max(1, now - self._at[0]), cpu - self._at[1]
        self._last, self._at = counts, (now, cpu)
        workers = self._engine.n_workers
        lost = [f'{step[key]} {what}' for key, what in (
            ('dropped', 'dropped'), ('lost', 'messages lost by the middleware'),
            ('skipped', 'timer releases skipped'),
            ('unattributed', 'messages without a job'), ('trace_lost', 'trace events lost'),
            ('unreported_misses', 'misses not reported to on_deadline_miss'),
        ) if step[key]]
        until = self._pool.clock.now()
        hanging = sorted(unfinished(self._pool, until - LONG_NS), key=lambda each: each.since)
        lost += [f'{each.work.entity.name} has run for {(until - each.since) / 1e9:.0f} s'
                 + (f' ({each.where})' if each.where else '') for each in hanging[:MOST_HANGING]]
        failed = self._recorder is not None and self._recorder.writer.error is not None
        if failed:
            lost.append('the trace cannot be written')
        values = {
            'policy': self._engine.scheduler.policy.name, 'workers': str(workers),
            'idle_workers': str(self._engine.idle_workers), 'lent': str(self._pool.lending.n_lent),
            'queue': str(self._engine.queue_length), 'computing': str(self._registry.computing()),
            'callbacks_per_s': f'{step["ran"] * 1e9 / passed:.1f}',
            'busy_ratio': f'{step["busy_ns"] / passed / workers:.3f}',
            'cpu_ratio': f'{cpu_used / passed:.3f}',
            'cpu_us_per_callback': f'{cpu_used / 1e3 / step["ran"]:.1f}' if step['ran'] else '',
            **{key: str(counts[key]) for key in (
                'ran', 'dropped', 'lost', 'skipped', 'unattributed', 'doubtful', 'trace_lost',
                'unreported_misses')}}
        return Status(
            f'{self._thresholds.name}: {WORKERS}',
            ERROR if failed else WARN if lost else OK,
            ', '.join(lost) or f'{counted(step["ran"], "callback")} ran', values)


class Diagnostics:
    """Publishes the state of an executor, from a separate thread."""

    def __init__(
        self, task_set: TaskSet | None, pool: WorkerPool, registry: Registry,
        recorder: Recorder | None, period_ns: int, thresholds: Thresholds, process: str | None,
        notifier: MissNotifier | None,
    ) -> None:
        # Here, not in the thread: an interrupt of an import in the main thread may keep the lock
        # of the imported module for ever.
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
        check_for_type_support(DiagnosticArray)
        self._types = DiagnosticArray, DiagnosticStatus, KeyValue
        self._context = pool.context
        self._registry = registry
        self._period_ns = period_ns
        self._hardware_id = f'{socket.gethostname()}/{process or os.getpid()}'
        verdicts = pool.engine.verdicts
        self._dags = []
        for dag in task_set.dags if task_set is not None else ():
            # a DAG shared by several processes is reported by those with its source or sinks
            reported_by = dag.vertices if process is None else [
                dag.vertices[i] for i in (dag.source, *dag.sinks)]
            self._dags.append((
                {vertex.callback.key for vertex in reported_by},
                DagWatch(verdicts.tally, dag, thresholds, period_ns, verdicts.in_stops)))
        self._workers = pool
        self._requirements = RequirementWatch(thresholds)
        self._pool = PoolWatch(pool, registry, recorder, thresholds, notifier)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def statuses(self) -> list[Status]:
        """Return a status for each DAG with a callback here, each path, and the pool's."""
        now = time.monotonic_ns()
        hosted = self._registry.hosted()
        found = [watch.status(now, hosted) for keys, watch in self._dags
                 if not keys.isdisjoint(hosted)]
        if self._workers.engine.path_watch is not None:
            with self._workers.lock:
                requirements = self._workers.engine.requirements(self._workers.clock.now())
            found += self._requirements.statuses(requirements)
        return [*found, self._pool.status(now)]

    def start(self) -> None:
        """Begin to publish; further calls do nothing."""
        if self._thread is None:
            stop_at_exit(self)
            thread = threading.Thread(target=self._run, name='mddag-diagnostics', daemon=True)
            thread.start()  # may fail
            self._thread = thread

    def stop(self) -> None:
        """Stop publishing; does nothing if it has not begun."""
        self._ending.set()
        if self._thread is not None:
            join(self._thread, END_S)

    def _run(self) -> None:
        try:
            self._publish()
        except Exception as error:
            if not is_over(self._context):
                get_logger('mddag_executor').error(f'there will be no diagnostics: {error}')

    def _publish(self) -> None:
        # no executor runs the node, since it has no callbacks
        node = quiet_node(
            f'{NODE_NAME}_{os.getpid()}', self._context, is_remapped=True)
        try:
            publisher = node.create_publisher(self._types[0], TOPIC, 10)
            due = time.monotonic_ns() + self._period_ns
            while not self._ending.wait(max(0, due - time.monotonic_ns()) / 1e9):
                if is_over(self._context):
                    return
                publisher.publish(self._message())
                # a missed period (the machine slept) is skipped
                due = max(due + self._period_ns, time.monotonic_ns())
        finally:
            with suppress(Exception):  # the context has ended meanwhile
                node.destroy_node()

    def _message(self) -> DiagnosticArray:
        array, status_of, value_of = self._types
        message = array()
        # system time: simulated time may stand still, and this is about the process
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        for status in self.statuses():
            message.status.append(status_of(
                level=bytes([status.level]), name=status.name, message=status.message,
                hardware_id=self._hardware_id,
                values=[value_of(key=key, value=value) for key, value in status.values.items()]))
        return message
