# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Ordinary bags rescheduled: recorded sensor messages as releases, declared execution times.

Theory of operation
-------------------
* The releases are those of ``bag_run``.
* Execution times are drawn for each execution from the declared quantiles (seeded), or come from a
  table, fixed for the whole run.
* Data that a bag does not have is ignored, and reported: transport, dispatch, other load of the
  machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
import os
import random
from typing import Any

from mddag_executor.recording.columns import Ints
from mddag_executor.recording.recording import Recording
from mddag_executor.simulate.execution_times import check_execution_times
from mddag_executor.sources.bag_run import read_bag
from mddag_executor.whatif.reschedule import Reschedule, reschedule
from msg_graph import Dag, TaskSet
import numpy as np


def reschedule_bag(
    path: str | os.PathLike[str], task_set: TaskSet, *,
    times: Sequence[Sequence[int]] | None = None, seed: int = 0, name: str | None = None,
    **options: Any,
) -> Reschedule:
    """
    Run the core with the messages of an ordinary bag.

    :param path: a bag's folder, or one of its files.
    :param times: execution times by DAG and vertex, ns; None: drawn from the declared ones.
    :param options: as for ``reschedule``; a bag has no overheads.
    """
    if times is None:
        check_execution_times(task_set, ', or give --execution-times FILE')
    generator = random.Random(seed)

    def times_of(run: Recording) -> list[Ints]:
        counts = np.diff(run.jobs.first).tolist()
        return [
            _drawn(dag, count, generator) if times is None
            else np.tile(np.array(times[dag.index], dtype=np.int64), (count, 1))
            for dag, count in zip(task_set.dags, counts)]

    # the recording is large, and only its load is kept
    return reschedule(partial(read_bag, path, task_set, name), times=times_of, overheads=False,
                      **options)


def _drawn(dag: Dag, count: int, generator: random.Random) -> Ints:
    """Return execution times drawn for each vertex of a number of jobs."""
    declared = [vertex.callback.execution_time for vertex in dag.vertices]
    return np.fromiter(
        (each.draw(generator.random()) for _ in range(count) for each in declared
         if each is not None),      # checked before
        dtype=np.int64, count=count * len(declared)).reshape(count, len(declared))
