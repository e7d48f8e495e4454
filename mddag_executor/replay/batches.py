# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What happened in a run, many at once: how the compiled replay tells of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from mddag_executor.core.state import Decision
from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.follower import Observer
from mddag_executor.replay.judge import Judge
from mddag_executor.replay.usage import Usage
from msg_graph import TaskSet
import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]


class Batch(NamedTuple):
    """
    A stretch of a run.

    :ivar pieces: what ran, a row each in the order of their ends, with the columns START to
        CALLBACK below; DAG-less callbacks have vertex -1.  ``follower.Piece`` has what they mean.
    :ivar releases: DAG, job and release of each.
    :ivar released_after: how many of ``pieces`` had ended when each release was recorded.
    :ivar decisions: what the core decided; ``decided_after`` as for releases.
    """

    pieces: Ints
    releases: Ints
    released_after: Ints
    decisions: Sequence[Decision]
    decided_after: Ints


START, END, READY, VERTEX, JOB, WORKER, CALLBACK = (
    fw.R_START, fw.R_END, fw.R_READY, fw.R_VERTEX, fw.R_JOB, fw.R_WORKER, fw.R_CALLBACK)


class Watcher(Protocol):
    """Who wants to be told of a run while it is replayed (a report, an export)."""

    def observers(self, task_set: TaskSet, judge: Judge) -> Sequence[Observer]:
        """Return observers; they are told after the judge.  What was told before is forgotten."""

    def name_by(self, names: Callable[[int], str]) -> None:
        """Take in what tells the names of callbacks that are not declared, by their address."""


@runtime_checkable
class BatchWatcher(Watcher, Protocol):
    """Who can be told of a run in batches, too, instead of one thing after the other."""

    def begin(self, task_set: TaskSet, judge: Judge, usage: Usage) -> None:
        """Take in what will have counted the run when it is over, and forget what was told."""

    def take(self, batch: Batch) -> None:
        """Take in what happened."""
