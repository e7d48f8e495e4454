# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds how much longer callbacks may take before a deadline is missed, or how much less they must.

Theory of operation
-------------------
The load, recorded or periodic, is scheduled repeatedly, each time with the execution times of one
callback (or of all) multiplied by a factor.  Bisection finds the greatest factor, to 1 %, with
which no deadline is missed: above 1 if none is missed with factor 1, otherwise below 1, and 0 if
even ``LEAST`` is not enough.  Dispatch times are not multiplied.

A run that meets all deadlines takes long; a run with a miss ends early.  So a miss is searched
again in a *window*: the releases before it, ``WINDOW`` times its deadline or 2, 4, … times as
long, are enough, unless no worker was idle meanwhile.  The bisection runs only windows, those that
broke before first.  Its factor is tried on the whole load, which confirms it or finds another
window.

Schedules have anomalies: a longer callback may meet a deadline that a shorter one misses.  So the
result is a factor below which no tried factor broke.

Misses that remain if all callbacks together take ``LEAST`` times as long have other reasons (lost
messages, late releases, dispatch): they are ignored, and so is a sink that has only such misses.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import zip_longest
import math
import multiprocessing
import signal
import time
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.analysis.as_recorded import slack as margin
from mddag_executor.core import NEVER, Tables
from mddag_executor.core.jobs import is_miss
from mddag_executor.core.requirements import as_dags
from mddag_executor.core.state import Decision, SINK_IN_TIME
from mddag_executor.simulate import schedule, Settings, Workload
from mddag_executor.simulate.schedule import prepare
from mddag_executor.simulate.workload import as_arrays
from msg_graph import TaskSet
from msg_graph.derive import gc_paused
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.simulations import (
        FewerResult,
        SinkMargin,
        SlackFactor,
        SlackResult,
    )
    from mddag_executor.results.sinks import DagCounts, Requirements, SinkCounts
    from msg_graph import Process

MOST, LEAST = 100.0, 0.01
EXACT = 1.01
WINDOW = 3
LONG = 4
"""Windows are used for loads of at least this many windows."""
_MOST_WINDOWS = 8
_FEW_S = 3.0
_RUNS = 5
"""Estimated number of runs of the whole load per callback."""
_NO_DEADLINE = NEVER // 2
ALL = -1
"""All callbacks."""
NOTHING = -1
"""No sink."""


class Miss(NamedTuple):
    """
    A missed deadline.

    :ivar sink: its global vertex.
    :ivar until: when the job completed or ended.
    """

    sink: int
    deadline: int
    release: int
    until: int


class Problem(NamedTuple):
    """
    A load and its scheduling.

    :ivar load: a recorded load, or a periodic one.
    :ivar callback_of: by global vertex the number of its callback.
    :ivar dispatches: the dispatch part of the first of ``load.costs``.
    :ivar untimed: callbacks whose times are not known: no factor says anything of them.
    """

    load: Workload
    settings: Settings
    tables: Tables
    callback_of: list[int]
    dispatches: Any = ()
    untimed: frozenset[int] = frozenset()

    @property
    def callbacks(self) -> list[int]:
        """Return the numbers of the callbacks to search for."""
        return sorted({*self.callback_of} - self.untimed)


class Found(NamedTuple):
    """
    The greatest factor, and the sink that breaks next.

    A factor of None: nothing broke up to ``MOST``; 0: even ``LEAST`` is not enough.
    """

    factor: float | None
    breaks: int


class Fewer(NamedTuple):
    """Number of workers or CPUs, the sufficient number, and the sink that one less breaks."""

    given: int
    least: int
    breaks: int


class Search:
    """
    Searches the greatest factors of a problem.

    :ivar compiled: whether the core runs compiled.
    :ivar missed: by sink the number of missed deadlines with factor 1.
    :ivar left_out: sinks that miss all of them with any factor.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self.compiled = problem, False
        self.compile_for(_RUNS)
        load: Any = as_arrays(problem.load)
        self._load = load
        self._dispatches = np.zeros_like(load.costs)
        self._dispatches[:len(problem.dispatches)] = problem.dispatches
        self._of = self._callback_of_cost(load, problem.tables)
        self._length = int(load.times[-1] - load.times[0]) if len(load.times) else 0
        #: Windows with a miss, the last one first.
        self._windows: list[tuple[int, int]] = []
        decisions = self._decisions(load)
        self.missed = Counter(vertex for kind, _, vertex, *_ in decisions if is_miss(kind))
        self.left_out: list[int] = []
        #: Sinks and jobs that miss with any factor.
        self._known: set[tuple[int, int]] = set()
        if self.missed:
            self._leave_out_hopeless_ones()
        #: The miss to begin with, if there is one with factor 1.
        self._first = self.miss(ALL, 1.0, worst=True) if self.missed else None
        self._low, self._high = (1.0, MOST) if self._first is None else (LEAST, 1.0)

    def _leave_out_hopeless_ones(self) -> None:
        """Ignore misses that shorter execution times do not avoid."""
        decisions = self._decisions(self._scaled(ALL, LEAST))
        met = {vertex for kind, _, vertex, *_ in decisions if kind == SINK_IN_TIME}
        self._known = {(vertex, job) for kind, _, vertex, job, *_ in decisions if is_miss(kind)}
        self.left_out = sorted({vertex for vertex, _ in self._known} - met)
        if self.left_out:
            deadlines = list(self._problem.tables.sink_deadline)
            for sink in self.left_out:
                deadlines[sink] = _NO_DEADLINE
            self._problem = self._problem._replace(
                tables=self._problem.tables._replace(sink_deadline=deadlines))
            self._known = {(vertex, job) for vertex, job in self._known if vertex in met}

    def compile_for(self, runs: int) -> None:
        """
        Compile the core if it pays for this many runs of the whole load.

        If one callback alone cannot help, its search needs no such run.  So this is called when it
        is known that the searches take long: compiling takes minutes on a busy machine.
        """
        if runs and not self.compiled:
            self.compiled = prepare(
                self._problem.tables, self._problem.load, self._problem.settings, runs)

    @property
    def misses(self) -> bool:
        """Return whether deadlines are missed with factor 1, so that factors are below 1."""
        return self._first is not None

    def _callback_of_cost(self, load: Workload, tables: Tables) -> Any:
        """Return by index of a cost its callback; -1: undeclared."""
        of = np.full(len(load.costs), -1, dtype=np.int64)
        jobs = np.bincount(load.dags, minlength=tables.n_dags).tolist()
        for dag in range(tables.n_dags):
            first, after = tables.first_vertex[dag:dag + 2]
            row = np.array(self._problem.callback_of[first:after])
            base = load.cost_base[dag]
            rows = jobs[dag] if load.cost_stride[dag] else 1
            of[base:base + rows * len(row)] = np.tile(row, rows)
        return of

    def _decisions(
        self, load: Workload, end: int = NEVER, stop: bool = False
    ) -> Sequence[Decision]:
        problem = self._problem
        settings = replace(
            problem.settings, duration_ns=min(end, problem.settings.duration_ns),
            stop_at_first_miss=stop)
        with gc_paused():
            return schedule(problem.tables, load, settings, compiled=self.compiled).decisions

    def _misses(self, load: Workload, end: int, stop: bool) -> list[Miss]:
        """Return the additional misses."""
        relative = self._problem.tables.sink_deadline
        return [Miss(vertex, deadline, deadline - relative[vertex], until)
                for kind, _, vertex, job, deadline, until in self._decisions(load, end, stop)
                if is_miss(kind) and (vertex, job) not in self._known]

    def _scaled(self, callback: int, factor: float) -> Workload:
        """Return the load with a longer callback."""
        load, which = self._load, self._of == callback if callback != ALL else self._of >= 0
        costs, computed = load.costs.copy(), load.computed.copy()
        pure = costs[which] - self._dispatches[which]
        costs[which] += np.minimum(pure * (factor - 1), NEVER >> 8).astype(np.int64)
        if len(computed):
            which &= computed >= 0
            computed[which] = np.minimum(computed[which] * factor, NEVER >> 8).astype(np.int64)
        scaled: Workload = load._replace(costs=costs, computed=computed)
        return scaled

    def miss(
        self, callback: int, factor: float, window: tuple[int, int] | None = None,
        worst: bool = False,
    ) -> Miss | None:
        """
        Return a deadline that a factor breaks, in a window or anywhere; None: no such deadline.

        :param worst: the miss with the greatest lateness; otherwise the first.
        """
        load, end = self._scaled(callback, factor), NEVER
        if window is not None:
            end = window[1]
            first, last = (bisect_left(load.times, each) for each in window)
            load = load._replace(
                times=load.times[first:last], dags=load.dags[first:last],
                jobs=load.jobs[first:last], releases=load.releases[first:last])
        stops = not self._known and not worst
        missed = self._misses(load, end, stops)
        if stops and missed and all(miss.sink in self.left_out for miss in missed):
            # the run stopped at an expired job of an ignored sink
            missed = self._misses(load, end, False)
        return min((miss for miss in missed if miss.sink not in self.left_out), default=None,
                   key=lambda miss: miss.deadline - worst * miss.until)

    def factor(self, callback: int) -> Found:
        """Return the greatest factor for a callback, or for ``ALL``."""
        factor, breaks = self._high, NOTHING
        for window in list(self._windows):
            miss = self.miss(callback, factor, window) if factor > self._low else None
            if miss is not None:
                factor, breaks = self._bisect(callback, factor, miss.sink, window)
        while factor > self._low:       # without a miss at its low end
            miss = self._first if self.misses and factor == self._high else \
                self.miss(callback, factor, worst=factor < self._high)
            if miss is None:
                break
            short = self._window(callback, factor, miss)
            factor, breaks = self._bisect(callback, factor, miss.sink, short)
            if short is None:
                break
            self._windows = [short, *self._windows][:_MOST_WINDOWS]
        return Found(None if breaks == NOTHING else factor, breaks)

    def _window(self, callback: int, factor: float, miss: Miss) -> tuple[int, int] | None:
        """Return a window in which a miss is found again; None: not much shorter than the load."""
        length = WINDOW * (miss.deadline - miss.release)
        while LONG * length < self._length:
            window = miss.release - length, miss.deadline + 1
            if self.miss(callback, factor, window) is not None:
                return window
            length *= 2
        return None

    def fewer_workers(self) -> list[Fewer]:
        """
        Return by process the minimum number of workers that misses nothing; empty: unknown.

        One process after another is reduced, so all these numbers together miss nothing.
        """
        found, pools = list[Fewer](), self._problem.settings.pools
        while len(found) < len(pools) and not self.misses:
            before = [each.least for each in found]
            given, *rest = pools[len(before):]
            found.append(self._fewer(given, partial(_pools, before, rest)))
        return found

    def fewer_cpus(self) -> Fewer | None:
        """Return the minimum number of CPUs that misses nothing; None: unknown."""
        given = self._problem.settings.cpus
        return None if given is None or self.misses else self._fewer(
            given, lambda least: {'cpus': least})

    def _fewer(self, given: int, setting: Callable[[int], dict[str, Any]]) -> Fewer:
        """Return the minimum with which nothing is missed, of settings made of a number."""
        problem, least, miss = self._problem, given, None
        while least > 1 and miss is None:
            self._problem = problem._replace(
                settings=replace(problem.settings, **setting(least - 1)))
            miss = self.miss(ALL, 1.0)
            if miss is None:
                least -= 1
        self._problem = problem
        return Fewer(given, least, NOTHING if miss is None else miss.sink)

    def _bisect(
        self, callback: int, high: float, breaks: int, window: tuple[int, int] | None
    ) -> tuple[float, int]:
        """
        Return the greatest factor below one that is not met, and the sink that breaks next.

        The factor is 0 if none is met.
        """
        low = self._low
        if self.misses:
            miss = self.miss(callback, low, window)
            if miss is not None:
                return 0.0, miss.sink
        while high > low * EXACT:
            middle = math.sqrt(low * high)
            miss = self.miss(callback, middle, window)
            if miss is None:
                low = middle
            else:
                high, breaks = middle, miss.sink
        return low, breaks


class Slack(NamedTuple):
    """
    Results of the search.

    :ivar factors: by callback, and of all together (``ALL``).
    :ivar missed: by sink the number of missed deadlines with factor 1.
    :ivar left_out: sinks that miss all of them with any factor.
    :ivar workers: by process the sufficient workers; empty: unknown, or deadlines are missed.
    :ivar cpus: the sufficient CPUs; None: unknown, or deadlines are missed.
    """

    factors: dict[int, Found]
    missed: dict[int, int]
    left_out: list[int]
    workers: list[Fewer]
    cpus: Fewer | None


def find_slack(
    problem: Problem, progress: Callable[[int], None] = lambda done: None, jobs: int = 1
) -> Slack:
    """
    Find the greatest factors of all callbacks, and of all together.

    :param progress: called with the number of finished callbacks.
    :param jobs: number of processes for long searches.
    """
    search = Search(problem)
    progress(0)
    rest = problem.callbacks
    found = {ALL: search.factor(ALL)}
    progress(0)
    begin, quick = time.monotonic(), True
    while rest and quick:
        callback = rest.pop(0)
        found[callback] = _factor(search, callback)
        progress(len(found) - 1)
        quick = (time.monotonic() - begin) * len(rest) < _FEW_S * (len(found) - 1)
    search.compile_for(_RUNS * len(rest))
    for callback, one in zip(rest, _factors(search, rest, min(len(rest), jobs))):
        found[callback] = one
        progress(len(found) - 1)
    return Slack(found, search.missed, search.left_out, search.fewer_workers(),
                 search.fewer_cpus())


def _pools(before: Sequence[int], rest: Sequence[int], workers: int) -> dict[str, Any]:
    return {'pools': (*before, workers, *rest)}


def slack_result(
    slack: Slack, task_set: TaskSet, dags: Mapping[str, DagCounts],
    processes: Sequence[Process] = (), requirements: Requirements | None = None,
) -> SlackResult:
    """
    Return the result format of ``slack --json``.

    :param dags: of the result of the run with factor 1; ``requirements``: its paths, if something
        is required of them.
    :param processes: if there are several; otherwise empty.
    """
    names = [vertex.name for vertex in task_set.vertices]

    def shown(found: Found) -> SlackFactor:
        return {'factor': None if found.factor is None else round(found.factor, 4),
                'breaks': named(found.breaks)}

    def named(sink: int) -> str | None:
        return None if sink == NOTHING else names[sink]

    def enough(fewer: Fewer | None) -> FewerResult | None:
        return None if fewer is None else {
            'given': fewer.given, 'least': fewer.least, 'breaks': named(fewer.breaks)}

    def margins(sinks: Mapping[str, SinkCounts]) -> dict[str, SinkMargin]:
        return {name: {'relative_deadline_ns': sink['relative_deadline_ns'],
                       'margin_ns': margin(sink)} for name, sink in sinks.items()}

    result: SlackResult = {
        'most': MOST,
        'callbacks': {callback.key: shown(slack.factors[i])
                      for i, callback in enumerate(task_set.callbacks) if i in slack.factors},
        'load': shown(slack.factors[ALL]),
        'workers': enough(slack.workers[0] if slack.workers and not processes else None),
        'cpus': enough(slack.cpus),
        'missed': {names[sink]: slack.missed[sink] for sink in sorted(slack.missed)},
        'left_out': [names[sink] for sink in slack.left_out],
        'sinks': {name: one for dag in dags.values()
                  for name, one in margins(dag['sinks']).items()}}
    if processes:
        result['processes'] = [
            {'name': process.name, 'workers': enough(fewer)}
            for process, fewer in zip_longest(processes, slack.workers)]
    if requirements:
        result['requirements'] = {
            name: one for path in as_dags(requirements).values()
            for name, one in margins(path['sinks']).items()}
    return result


def _factors(search: Search, callbacks: list[int], jobs: int) -> Iterator[Found]:
    """Yield the factors of callbacks, searched in parallel."""
    if jobs < 2:
        yield from (_factor(search, callback) for callback in callbacks)
        return
    spawn = multiprocessing.get_context('spawn')
    with ThreadPoolExecutor(jobs) if search.compiled else \
            ProcessPoolExecutor(jobs, spawn, _start) as pool:
        yield from pool.map(partial(_factor, search), callbacks)


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process handles Ctrl-C


def _factor(search: Search, callback: int) -> Found:
    """Return a callback's factor, independent of order and process."""
    return copy(search).factor(callback)    # a copy, because its windows must not affect others
