# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Job sets for schedule-abstraction analysis, and its verdict.

Theory of operation
-------------------
The schedule abstraction graph (Nasri, Nelissen and Brandenburg, Response-time analysis of limited-
preemptive parallel DAG tasks under global scheduling, ECRTS 2019) explores all orders in which
given jobs can run without preemption on m workers. Its program ``nptest`` (np-schedulability-
analysis) reads two tables in CSV: jobs, and pairs of jobs that precede one another.

1. A job there is one vertex in one job of a DAG. ``Job ID`` is the DAG's job; a ``Task ID`` stands
   for a vertex, numbered so that ties of RADs are broken as ``rad`` does: by the vertex's index,
   then the DAG's.
2. All DAGs are released together at 0, and then exactly periodically, in one hyperperiod (or up to
   a horizon). What is started by others arrives with the release of its DAG and waits for them.
3. Priority is the RAD, and so is the deadline: for a sink that is its own; where another vertex is
   done later than its RAD, a sink after it is late in any case.
4. Costs are the least quantile and the budget. Times are whole ns.
5. If every deadline is within its period, nothing is left when the hyperperiod ends, and all of it
   begins anew; so the verdict is for ever. Else it is only for the jobs that were looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
import subprocess
from typing import NamedTuple

from mddag_executor.analysis.model import AnalysisError, Task
from msg_graph import format_duration

JOBS, EDGES, TASKS = 'jobs.csv', 'edges.csv', 'tasks.csv'
MOST_JOBS = 500_000
_JOBS_HEADER = 'Task ID,Job ID,Arrival min,Arrival max,Cost min,Cost max,Deadline,Priority'
_EDGES_HEADER = 'Predecessor TID,Predecessor JID,Successor TID,Successor JID'


class JobSet(NamedTuple):
    """
    A job set as CSV.

    :ivar tasks: which vertex a Task ID stands for, as CSV.
    :ivar horizon: releases before this are in it, ns.
    :ivar for_ever: whether a verdict on it is one on all later jobs, too.
    """

    jobs: str
    edges: str
    tasks: str
    size: int
    horizon: int
    for_ever: bool


def job_set(tasks: Sequence[Task], horizon: int | None = None) -> JobSet:
    """
    Return the job set of one hyperperiod.

    :param horizon: end of the releases, ns; None for the hyperperiod.
    :raises AnalysisError: it would have too many jobs.
    """
    hyperperiod = math.lcm(*(task.period for task in tasks))
    end = hyperperiod if horizon is None else horizon
    count = sum(-(-end // task.period) * len(task.costs) for task in tasks)
    if count > MOST_JOBS:
        raise AnalysisError(
            f'job set: {format_duration(end)} (hyperperiod {format_duration(hyperperiod)}) make '
            f'{count} jobs, more than {MOST_JOBS}: give a shorter --horizon')
    order = sorted((vertex, place) for place, task in enumerate(tasks)
                   for vertex in range(len(task.costs)))
    number = {key: i for i, key in enumerate(order, 1)}
    names = [f'{i},"{tasks[place].dag.name}","{tasks[place].dag.vertices[vertex].name}"'
             for (vertex, place), i in number.items()]
    return JobSet(
        _csv(_JOBS_HEADER, _jobs(tasks, number, end)),
        _csv(_EDGES_HEADER, _edges(tasks, number, end)),
        _csv('Task ID,DAG,Vertex', names), count, end,
        end % hyperperiod == 0 and all(task.deadline <= task.period for task in tasks))


_Number = dict[tuple[int, int], int]


def _csv(header: str, lines: Iterator[str] | Sequence[str]) -> str:
    return '\n'.join([header, *lines]) + '\n'


def _jobs(tasks: Sequence[Task], number: _Number, end: int) -> Iterator[str]:
    for place, task in enumerate(tasks):
        for job, release in enumerate(range(0, end, task.period)):
            for vertex, cost in enumerate(task.costs):
                time = task.dag.vertices[vertex].callback.execution_time
                least = min(cost, time.quantiles_ns[0]) if time is not None else cost
                rad = release + task.rad[vertex]
                yield (f'{number[vertex, place]},{job},{release},{release},{least},{cost},'
                       f'{rad},{rad}')


def _edges(tasks: Sequence[Task], number: _Number, end: int) -> Iterator[str]:
    for place, task in enumerate(tasks):
        pairs = [(number[a, place], number[b, place]) for a, b in task.dag.edges]
        for job in range(-(-end // task.period)):
            for before, after in pairs:
                yield f'{before},{job},{after},{job}'


class Answer(NamedTuple):
    """What ``nptest`` says of a job set."""

    schedulable: bool
    jobs: int
    states: int
    timed_out: bool


def ask(binary: str, folder: Path, workers: int, seconds: int) -> Answer:
    """
    Run ``nptest`` on the files in a folder.

    :param seconds: the processor time that it may take.
    :raises AnalysisError: it cannot be run, or its answer makes no sense.
    """
    command = [binary, '-m', str(workers), '-l', str(seconds), '-p', str(folder / EDGES),
               str(folder / JOBS)]
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=2 * seconds + 30, check=False,
            stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        raise AnalysisError(
            f'{binary}: it did not end in time: give a shorter --horizon') from None
    except OSError as error:
        raise AnalysisError(
            f'{binary}: it cannot be run ({error.strerror}): give the path of nptest, as it is '
            'built from np-schedulability-analysis') from None
    output = done.stdout.decode('utf-8', 'replace').strip()
    fields = [field.strip() for field in output.splitlines()[-1].split(',')] if output else []
    try:
        # file, schedulable, jobs, states, edges, width, CPU time, memory, timeout, processors
        answer = Answer(fields[1] == '1', int(fields[2]), int(fields[3]), fields[8] == '1')
        if done.returncode or fields[1] not in '01' or len(fields) < 10:
            raise ValueError
    except (IndexError, ValueError):
        said = (done.stderr.decode('utf-8', 'replace').strip() or output or 'nothing')[:200]
        raise AnalysisError(
            f'{binary}: its answer makes no sense (status {done.returncode}, it says: '
            f'{" ".join(said.split())}): give the path of nptest') from None
    return answer
