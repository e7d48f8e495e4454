# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The differences between a run and its declaration.

The rules are in ``msg_graph.drift``.  Their input comes from the executor's counts, and the
releases from ``Watch``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TYPE_CHECKING

from mddag_executor.executor.outside import since
from mddag_executor.results.runs import CallbackCounts, Statistics
from msg_graph import TaskSet
from msg_graph.drift import Drift, drift, Observed, Releases

if TYPE_CHECKING:
    from mddag_executor.executor.executor import MultiDeadlineExecutor


class Watch:
    """Watches an executor from now on."""

    def __init__(self, executor: MultiDeadlineExecutor, task_set: TaskSet) -> None:
        self._executor = executor
        self._task_set = task_set
        self._now = executor._trace_clock.now
        self._begin = self._now()
        self._end: int | None = None
        self._releases = [Releases() for _ in task_set.dags]
        self._before: Mapping[str, CallbackCounts] = {}
        self._outside_before = self._outside = executor.published_outside()
        self._gone: dict[str, int] = {}
        executor._engine.verdicts.on_release = self._released

    def _released(self, dag: int, release: int) -> None:
        if dag < len(self._releases):
            self._releases[dag].add(release)

    def restart(self) -> None:
        """Watch from now on: what ran before has only been seen."""
        self._begin = self._now()
        self._releases = [Releases() for _ in self._task_set.dags]
        self._before = self._executor.statistics()['callbacks']
        self._outside_before = self._executor.published_outside()

    def stop(self) -> None:
        """Watch no longer: the run has ended."""
        if self._end is None:
            self._end = self._now()
            self._gone = self._executor._registry.bindings.gone()
            self._outside = self._executor.published_outside()

    def drift(self, statistics: Statistics) -> list[Drift]:
        """Return the differences between run and declaration; ``statistics`` are its counts."""
        return drift(self._task_set, self.observed(statistics))

    def observed(self, statistics: Statistics) -> Observed:
        """Return the observations; ``statistics`` are the run's counts."""
        first = min((r.first for r in self._releases if r.count), default=self._begin)
        counts, end = statistics['callbacks'], self._now() if self._end is None else self._end
        gone = self._executor._registry.bindings.gone() if self._end is None else self._gone
        sources = (dag.vertices[dag.source].callback.key for dag in self._task_set.dags)
        return Observed(
            duration_ns=max(0, end - first), end_ns=end,
            releases=dict(zip(sources, self._releases)),
            messages=self._since_begin(counts, 'ready'),
            executions=self._since_begin(counts, 'ran'),
            topics_received={**self._executor._registry.received()},
            publishes={**self._executor._registry.bindings.published()},
            nodes={key.rpartition(':')[0] for key in counts},
            undeclared=self._executor._registry.bindings.undeclared(),
            gone={key: max(0, end - at) for key, at in gone.items()},
            outside=since(
                self._executor.published_outside() if self._end is None else self._outside,
                self._outside_before))

    def _since_begin(
        self, counts: Mapping[str, CallbackCounts], which: Literal['ready', 'ran'],
    ) -> dict[str, int]:
        """Return counts since the begin, at least 1 for a callback that has one from before it."""
        return {key: count[which] - self._before[key][which] or min(1, count[which])
                if key in self._before else count[which] for key, count in counts.items()}
