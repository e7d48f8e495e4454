# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The trace of a computed run, as the live executor would have recorded it.

Theory of operation
-------------------
Virtual time is the trace's clock: it starts at 0.  A worker is a thread; the address of a callback
is its place in the declaration, from 1.  An execution that was preempted is recorded in pieces, as
a coroutine that was suspended.  A sync callback, which the simulator runs once, completes with all
its legs at its end, and all of its time is the last one's.  Where executions shared CPUs or held
the interpreter, their CPU time is recorded, which is their execution time, and whether they did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import os
from typing import Any

from mddag_executor.core import DEFAULT_DEADLINE_NS, rad_offsets
from mddag_executor.core.state import Decision, DROP, JOB_END, SINK_IN_TIME
from mddag_executor.replay.computed import ComputedRun
from mddag_executor.replay.happenings import Observer
from mddag_executor.replay.judge import Judge
from mddag_executor.simulate import Load, SimulatedRun
from mddag_executor.trace import TraceFile
from msg_graph import TaskSet

PROCESS = 1
_MOST = 2 ** 31 - 1


def write_trace(
    path: str | os.PathLike[str], task_set: TaskSet, load: Load, run: SimulatedRun
) -> None:
    """Write the trace of a run that was simulated with its log."""
    with TraceFile(path) as file:
        write_events(task_set, load, run, lambda *event: file.extend((event,), PROCESS))
        assert file.rejected == 0, file.rejection


def write_events(
    task_set: TaskSet, load: Load, run: SimulatedRun, add: Callable[..., object]
) -> None:
    """Give out the events of such a trace: name, time, thread, fields."""
    settings = run.settings
    add('task_set', 0, 0, task_set.text, task_set.file, settings.policy, settings.workers,
        DEFAULT_DEADLINE_NS, _MOST, settings.preempts, settings.cpus or 0)
    for place, callback in enumerate(task_set.callbacks, 1):
        add('rclcpp_callback_register', 0, 0, place, callback.key)
    computed = ComputedRun.of_run(task_set, load, run)
    writer = RunWriter(computed, settings.cpus is not None, add)
    computed.play([Judge(task_set, compare=False), writer])
    writer.end(run.ended_ns)


class RunWriter(Observer):
    """
    Gives out what happens as events; comes after the judge.

    :param shares: whether executions shared CPUs.
    """

    def __init__(self, run: ComputedRun, shares: bool, add: Callable[..., object]) -> None:
        self._add, self._load = add, run.load
        self._knows_cpu = shares or len(run.load.holds) > 0
        self._vertices = run.task_set.vertices
        self._address = [place + 1 for place in run.task_set.places_of_vertices()]
        self._rad = [offset for dag in run.task_set.dags for offset in rad_offsets(dag)]
        self._drops = [each for each in run.decisions if each[0] == DROP][::-1]
        self._decided: list[Decision] = []
        # by job its release, and by vertex and job the worker that runs it
        self._release: dict[tuple[int, int], int] = {}
        self._worker: dict[tuple[int, int], int] = {}

    def end(self, now: int) -> None:
        """Write what is left, and the end."""
        self._decisions(now)
        self._add('shutdown', now, 0, now)

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Write a release."""
        self._release[dag, job] = release
        self._add('job_release', now, 0, dag, job, release)
        self._decisions(now)

    def started(
        self, dag: int, vertex: int, job: int, ready: int, start: int, callback: int, worker: int
    ) -> None:
        """Write a dispatch."""
        self._decisions(start)
        self._worker[vertex, job] = worker
        self._add('dispatch', start, worker + 1, callback, dag, self._vertices[vertex].index, job,
                  worker, ready, self._release[dag, job] + self._rad[vertex])
        self._add('callback_start', start, worker + 1, callback, False)

    def ran(
        self, callback: int, dag: int, vertex: int, job: int, worker: int, ready: int, start: int,
        end: int, first: int,
    ) -> None:
        """Write the end of a piece."""
        self._add('callback_end', end, worker + 1, callback)

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int, ready: int,
        start: int, ended: int, busy: int, number: int, cpu: int, held: int,
    ) -> None:
        """Write a completion, and what it decided."""
        of = self._vertices[vertex]
        computed: tuple[Any, ...] = ()
        if whole and self._knows_cpu:
            load = self._load
            place = load.cost_base[dag] + job * load.cost_stride[dag] + of.index
            computed = load.costs[place], bool(load.holds and load.holds[place])
        self._add('complete', end, self._worker[vertex, job] + 1, self._address[vertex], dag,
                  of.index, job, bool(whole), end, leg, *computed)
        if whole:
            del self._worker[vertex, job]
        self._decisions(end)

    def ended(self, dag: int, job: int, aborted: bool, now: int) -> None:
        """Write that a job was given up, and what that decided."""
        self._add('abort' if aborted else 'expire', now, 0, dag, job)
        self._decisions(now)

    def decided(self, decisions: Sequence[Decision]) -> None:
        """Keep verdicts, to write them after what they come of."""
        self._decided += decisions

    def _decisions(self, now: int) -> None:
        """Write verdicts and what was dropped."""
        for kind, dag, vertex, job, deadline, time in self._decided:
            if kind not in (JOB_END, SINK_IN_TIME):
                self._add('deadline', now, 0, dag, self._vertices[vertex].index, job, deadline,
                          time)
        self._decided.clear()
        while self._drops and self._drops[-1][5] <= now:
            _, dag, vertex, job, _, time = self._drops.pop()
            self._add('drop', time, 0, self._address[vertex], dag, self._vertices[vertex].index,
                      job, 'aborted')
