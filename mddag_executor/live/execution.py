# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How long synthetic callbacks execute, and how an execution is emulated.

Theory of operation
-------------------
As in the paper's experiment, each vertex gets **one** execution time for the whole run, drawn from
its declared quantiles.  Then all of them are scaled by one factor so that the normalised
utilisation, sum(C / T) / workers, is what was asked for.  One such draw is one point of the
experiment: whether its deadlines can be met at all depends on the draw
(``ExecutionPlan.infeasible``), so a figure measured with one seed speaks for that seed.

``sleep`` stands for work outside of Python (a GPU, a C++ library that releases the interpreter
lock): it takes a worker but no CPU, so the CPU that the process does take is overhead.
``spin`` takes CPU and the interpreter lock: all bodies together have at most one core.
``native`` takes CPU without the lock, as numpy or OpenCV.  ``mixed`` draws for each callback which
of the three it does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import hashlib
import math
import random
import statistics
import time
from typing import Literal

from mddag_executor.errors import MddagError
from mddag_executor.simulate.workload import draw_execution_times
from mddag_executor.simulate.workload import utilisation as normalised
from msg_graph import Dag, TaskSet, Vertex
from msg_graph.analysis import path_lengths

Body = Literal['sleep', 'spin', 'native']
Mode = Literal[Body, 'mixed']
BODIES: tuple[Body, ...] = ('sleep', 'spin', 'native')

Emulate = Callable[[int], None]
"""
Executes for that many nanoseconds in the calling thread.

A sleeper's attribute ``busy_below_ns`` says up to which execution time it takes CPU for it.
"""


class PlanError(MddagError):
    """An execution plan that cannot be made from this declaration."""


@dataclass(frozen=True)
class Infeasible:
    """
    A sink that no scheduler can serve in time: its critical path is longer than its deadline.

    ``critical_path_ns`` is the longest path from the source up to and including the sink.
    """

    dag: str
    vertex: str
    critical_path_ns: int
    deadline_ns: int


class ExecutionPlan:
    """
    The execution time of each vertex for one run.

    :param task_set: the declared DAG tasks.
    :param seed: the same seed gives the same draw, on every machine and Python version.
    :param utilisation: normalised utilisation to scale to; None takes the draw as it is.
    :param workers: the number of workers that the utilisation is normalised to.
    :param mode: one of ``BODIES``, or ``mixed``.
    :raises PlanError: when a utilisation is asked for and no execution time is declared.
    """

    def __init__(
        self,
        task_set: TaskSet,
        seed: int = 0,
        utilisation: float | None = None,
        workers: int = 7,
        mode: Mode = 'sleep',
    ) -> None:
        self.seed = seed
        self.workers = workers
        self.mode: Mode = mode
        self.asked = utilisation
        self._task_set = task_set
        drawn = draw_execution_times(task_set, seed, undeclared=0)
        self.drawn_utilisation = normalised(task_set, drawn, workers)
        self.factor = 1.0
        if utilisation is not None:
            if not (utilisation > 0 and math.isfinite(utilisation)):
                raise PlanError(
                    f'utilisation {utilisation}: this is no number above zero: give one as 0.6')
            if self.drawn_utilisation == 0:
                raise PlanError(
                    f'{task_set.file}: no callback has an execution time, so there is nothing to '
                    'scale: declare execution_time, or leave the utilisation out')
            self.factor = utilisation / self.drawn_utilisation
        self._times = [[round(c * self.factor) for c in dag] for dag in drawn]

    @property
    def utilisation(self) -> float:
        """Return the normalised utilisation that results: sum(C / T) / workers."""
        return normalised(self._task_set, self._times, self.workers)

    def execution_ns(self, dag: int, vertex: int) -> int:
        """Return the execution time of a vertex, by DAG index and local index, ns."""
        return self._times[dag][vertex]

    def body(self, vertex: Vertex) -> Body:
        """Return what the execution of a vertex does."""
        if self.mode == 'mixed':
            return random.Random(f'{self.seed} {vertex.callback.key}').choice(BODIES)
        return self.mode

    def critical_path_ns(self, dag: Dag) -> list[int]:
        """Return the longest path from the source to the end of each vertex, by index, ns."""
        return path_lengths(dag, self._times[dag.index])

    def infeasible(self) -> list[Infeasible]:
        """Return the sinks whose critical path is longer than their deadline."""
        found = []
        for dag in self._task_set.dags:
            ends = self.critical_path_ns(dag)
            for sink in dag.sinks:
                vertex = dag.vertices[sink]
                deadline = vertex.deadline_ns
                if deadline is not None and ends[sink] > deadline:
                    found.append(Infeasible(dag.name, vertex.name, ends[sink], deadline))
        return found


def typical_oversleep_ns(samples: int = 100, asked_ns: int = 300_000) -> int:
    """Measure by how much time.sleep() is late on this machine when it is idle: the median, ns."""
    late = []
    for _ in range(samples):
        start = time.monotonic_ns()
        time.sleep(asked_ns / 1e9)
        late.append(time.monotonic_ns() - start - asked_ns)
    return max(0, int(statistics.median(late)))


def sleeper(oversleep_ns: int | None = None) -> Emulate:
    """
    Make a function that takes a worker for some time without taking CPU.

    It asks time.sleep() for less by what this machine typically adds, so that the mean is right
    when the machine isn't overloaded.  What is shorter than that (about 70 us under Linux, whose
    timer slack is 50 us) is waited out busily.  When the machine is overloaded, executions get
    longer: that is so for real callbacks too, and it is not hidden.

    :param oversleep_ns: the typical oversleep; None measures it (30 ms).
    """
    typical = typical_oversleep_ns() if oversleep_ns is None else oversleep_ns
    monotonic_ns, sleep = time.monotonic_ns, time.sleep

    def emulate(execution_ns: int) -> None:
        if execution_ns > typical:
            sleep((execution_ns - typical) * 1e-9)
            return
        end = monotonic_ns() + execution_ns
        while monotonic_ns() < end:
            pass

    emulate.busy_below_ns = typical  # type: ignore[attr-defined]
    return emulate


def spinner() -> Emulate:
    """Make a function that takes that much CPU time of the calling thread."""
    thread_time_ns = time.thread_time_ns

    def emulate(execution_ns: int) -> None:
        end = thread_time_ns() + execution_ns
        while thread_time_ns() < end:
            pass

    return emulate


def native() -> Emulate:
    """
    Make a function that takes about that much CPU time in C, without the interpreter lock.

    How much C does in a time is measured first (some milliseconds), and then goes by what it did
    lately: the speed of a virtual machine changes by a tenth.
    """
    def compute(iterations: int) -> None:
        hashlib.pbkdf2_hmac('sha256', b'password', b'salt', iterations)

    def taken(iterations: int) -> int:
        before = time.thread_time_ns()
        compute(iterations)
        return time.thread_time_ns() - before

    few, many = (min(taken(n) for _ in range(5)) for n in (1, 2000))
    each = max(1, many - few) / 1999

    def emulate(execution_ns: int) -> None:
        nonlocal each
        iterations = max(1, round((execution_ns - few) / each))
        took = taken(iterations)
        if iterations >= 500:
            each += ((took - few) / iterations - each) / 16

    return emulate


def emulator(body: Body) -> Emulate:
    """Return what executes a body."""
    return sleeper() if body == 'sleep' else spinner() if body == 'spin' else native()
