# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the drift rules need to know of a live run.

``Watch`` gets each release. Everything else the executor keeps anyway: its statistics, and on
which topics each callback has published. The rules are in ``msg_graph.drift``.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.live.executor import MultiDeadlineExecutor
from msg_graph import TaskSet
from msg_graph.drift import Drift, drift, Observed, Releases


class Watch:
    """
    Watches an executor from here on.

    :param task_set: the declaration that the executor was made with.
    """

    def __init__(self, executor: MultiDeadlineExecutor, task_set: TaskSet) -> None:
        self._executor = executor
        self._task_set = task_set
        self._now = executor._trace_clock.now
        self._begin = self._now()
        self._releases = [Releases() for _ in task_set.dags]
        executor._engine.verdicts.on_release = self._released

    def _released(self, dag: int, release: int) -> None:
        if dag < len(self._releases):
            self._releases[dag].add(release)

    def drift(self, statistics: dict[str, Any]) -> list[Drift]:
        """Return where the run and the declaration disagree; ``statistics`` are its counts."""
        return drift(self._task_set, self.observed(statistics))

    def observed(self, statistics: dict[str, Any]) -> Observed:
        """Return what was seen; ``statistics`` are the counts of the run."""
        first = min((r.first for r in self._releases if r.count), default=self._begin)
        counts = statistics['callbacks']
        sources = (dag.vertices[dag.source].callback.key for dag in self._task_set.dags)
        return Observed(
            duration_ns=max(0, self._now() - first),
            releases=dict(zip(sources, self._releases)),
            got={key: count['ready'] for key, count in counts.items()},
            ran={key: count['ran'] for key, count in counts.items()},
            publishes={**self._executor._registry.publishes()},
            nodes={key.rpartition(':')[0] for key in counts},
            undeclared=self._executor._registry.undeclared())
