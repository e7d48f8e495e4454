# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The settings of an executor: checked, and converted to one form.

Settings that are invalid, or impossible on this machine or for this process, raise ``UsageError``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import operator
import os
from typing import Any

from mddag_executor.core.tables import ON_LATE
from mddag_executor.defaults import workers
from mddag_executor.errors import UsageError
from msg_graph import DurationError, load, parse_duration, TaskSet
from msg_graph.duration import DAY
from msg_graph.errors import did_you_mean, listed, quoted
from msg_graph.model import MOST_WORKERS
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NotInitializedException
from rclpy.utilities import get_default_context

THREAD_POLICIES = ('SCHED_OTHER', 'SCHED_BATCH', 'SCHED_FIFO', 'SCHED_RR')
SHORTEST_DIAGNOSTICS_NS = 10_000_000
MOST_JOBS = 1_000_000


def whole_number(name: str, value: Any, most: int, unit: str = '') -> int:
    """Return a positive integer."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if not 1 <= number <= most:
        raise UsageError(f'{name}: {value!r}{unit}: give an integer from 1 to {most}{unit}')
    return number


def check_context(context: Context | None) -> None:
    """Check that a context (None: the default) is initialised; raise NotInitializedException."""
    if (get_default_context() if context is None else context).handle is None:
        raise NotInitializedException('an executor needs a context: call rclpy.init() before')


def check_process(name: str | None, task_set: TaskSet | None) -> None:
    """Check the name of a declared process, or None."""
    names = [process.name for process in task_set.processes] if task_set is not None else []
    if name is not None and name not in names:
        remedy = did_you_mean(name, names, f'give one of {listed(names)}') if names else (
            "declare 'processes:', or leave it out")
        raise UsageError(f'process {quoted(name)}: the declaration has no such process: {remedy}')


def check_handler(handler: object) -> None:
    """Check that a handler of missed deadlines, or None, can be called."""
    if handler is not None and not callable(handler):
        raise UsageError(f'on_deadline_miss: {handler!r} cannot be called: '
                         'give a function of one DeadlineMiss')


@dataclass(frozen=True)
class Thresholds:
    """
    The limits beyond which a status of ``/diagnostics`` is worse than OK.

    :ivar warn_ratio: WARN when this share of the window's results missed their deadlines.
    :ivar warn_burst: WARN when there were this many misses in one period of the diagnostics.
    :ivar error_ratio: ERROR when this share of the window's results missed their deadlines, and at
        least ``warn_burst`` did (one miss in two results proves nothing).
    :ivar window: length of the window in periods of the diagnostics.
    :ivar stale_periods: STALE when a source has released no job for this many of its periods, and
        for a period of the diagnostics.
    :ivar name: prefix of the names of the statuses, for robots with several processes.
    """

    warn_ratio: float = 0.01
    warn_burst: int = 3
    error_ratio: float = 0.1
    window: int = 10
    stale_periods: int = 3
    name: str = 'mddag'

    def __post_init__(self) -> None:
        for field in ('warn_ratio', 'error_ratio'):
            value = getattr(self, field)
            if not isinstance(value, (int, float)) or not 0.0 < value <= 1.0:
                raise UsageError(f'{field}: {value} is not a share: give more than 0, at most 1')
        for field in ('warn_burst', 'window', 'stale_periods'):
            whole_number(field, getattr(self, field), MOST_JOBS)


def check_thresholds(thresholds: object) -> None:
    """Check the thresholds of the diagnostics, or None."""
    if not isinstance(thresholds, Thresholds | None):
        raise UsageError(f'thresholds: {thresholds!r}: give '
                         'mddag_executor.executor.settings.Thresholds(...)')


def _nanoseconds(name: str, time: Any) -> Any:
    """Return the ns of a text like ``1s`` or of rclpy's ``Duration``; other values unchanged."""
    if isinstance(time, str):
        try:
            return parse_duration(time)
        except DurationError as error:
            raise DurationError(f'{name}: {error.problem}', error.remedy) from None
    return time.nanoseconds if isinstance(time, Duration) else time


def diagnostics_period_ns(period: int | str | Duration | None) -> int | None:
    """Return the period of the diagnostics in ns; None, and None for 0: no diagnostics."""
    period = _nanoseconds('diagnostics_period', period)
    if period is None or period == 0:
        return None
    period = whole_number('diagnostics_period', period, DAY, ' ns')
    if period < SHORTEST_DIAGNOSTICS_NS:
        raise UsageError(
            f'diagnostics_period: {period} ns is too short: give at least '
            f'{SHORTEST_DIAGNOSTICS_NS // 1_000_000}ms, or 0 for none')
    return period


def resolve(
    graph: str | os.PathLike[str] | TaskSet | None, num_workers: int | None,
    default_deadline: int | str | Duration, num_threads: int | None = None,
) -> tuple[TaskSet | None, int, int]:
    """
    Return the task set, the number of workers and the default deadline (ns) of an executor.

    :param num_threads: the name of ``num_workers`` in ``MultiThreadedExecutor``.
    :raises msg_graph.GraphError: when the declaration is invalid.
    """
    task_set = load(graph) if isinstance(graph, (str, os.PathLike)) else graph
    if task_set is not None and not isinstance(task_set, TaskSet):
        raise UsageError(f'graph: {graph!r} is not a declaration: give the path of one, a '
                         'TaskSet, or None' + (f'; a number of threads is num_workers={graph}'
                                      if type(graph) is int else ''))
    if num_threads is not None:
        if num_workers is not None:
            raise UsageError('num_threads: num_workers is also given: give one of the two')
        num_workers = whole_number('num_threads', num_threads, MOST_WORKERS)
    if num_workers is None:
        num_workers = workers(None, task_set)
    num_workers = whole_number('num_workers', num_workers, MOST_WORKERS)
    default_deadline = whole_number(
        'default_deadline', _nanoseconds('default_deadline', default_deadline), DAY, ' ns')
    return task_set, num_workers, default_deadline


def check_on_late(on_late: object) -> None:
    """Check that the treatment of late jobs is known."""
    if on_late not in [*ON_LATE]:
        raise UsageError(
            f"on_late: '{on_late}' is unknown: give one of {', '.join(ON_LATE)}")


def thread_setting(
    policy: str | None, priority: int | None, cpus: Iterable[int] | None
) -> Callable[[], None] | None:
    """Return a function that each worker thread calls first; None: there is nothing to set."""
    if policy is None and priority is not None:
        raise UsageError('worker_priority: there is no policy for it: give worker_policy too')
    if policy is None and cpus is None:
        return None
    if policy is not None and policy not in THREAD_POLICIES:
        raise UsageError(
            f"worker_policy: '{policy}' is unknown: give one of {', '.join(THREAD_POLICIES)}")
    if priority is not None and priority != 0:  # 0: that of SCHED_OTHER
        whole_number('worker_priority', priority, 99)
    if policy is not None:
        least, most = (ask(getattr(os, policy)) for ask in (
            os.sched_get_priority_min, os.sched_get_priority_max))
        if not least <= (priority or 0) <= most:
            raise UsageError(f'worker_priority: {policy} ' + (
                f'needs one: give {least} to {most}' if most else 'has none: leave it out'))
    if cpus is not None:
        mine, given = os.sched_getaffinity(0), cpus
        cpus = set(given) if isinstance(given, Iterable) else set()
        if not cpus or not cpus <= mine:
            raise UsageError(f'worker_cpus: {given!r}: give CPUs that this process may use, of '
                             f'{sorted(mine)}')

    def prepare() -> None:
        if cpus is not None:
            os.sched_setaffinity(0, cpus)
        if policy is None:
            return
        try:
            os.sched_setscheduler(0, getattr(os, policy), os.sched_param(priority or 0))
        except OSError as error:
            raise UsageError(
                f'worker_policy: this process may not use {policy} {priority or 0} ({error}): '
                'raise its rtprio limit (ulimit -r) or run it with CAP_SYS_NICE') from None

    return prepare
