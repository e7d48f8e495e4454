# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who does the chunks of an evaluation: threads or processes of this machine.

With the compiled core (see ``compiled``) the workers are threads, as it runs without the
interpreter's lock; without it they are processes.  ``cluster`` has those of other machines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import signal
from types import TracebackType

from mddag_executor.errors import MddagError
from mddag_executor.simulate.errors import SimulationError
from mddag_executor.simulate.experiment import Chunk, Evaluator, Experiment


class Pool:
    """
    Does chunks; a context manager, whose end waits for those that are under way.

    :ivar jobs: how many chunks it does at a time; it may change.
    :ivar chunk_s: about how long a chunk should take: short enough for Ctrl-C and progress, long
        enough to be worth handing over.
    :ivar submit: lets someone do a number of runs from a place on.
    """

    jobs: int
    submit: Callable[[int, int], Future[Chunk]]
    chunk_s = 0.25

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        pass

    def failure(self, error: BaseException) -> MddagError | None:
        """Return the error that says to the user what an exception of a chunk means, if any."""
        return None

    def check(self) -> None:
        """Look after the pool; called about every second."""


class _LocalPool(Pool):
    """Threads or processes of this machine."""

    def __init__(
        self, executor: Executor, jobs: int, work: Callable[[int, int], Chunk]
    ) -> None:
        self._executor = executor
        self._work = work
        self.jobs = jobs

    def submit(self, first: int, count: int) -> Future[Chunk]:
        """Let a thread or process do runs."""
        return self._executor.submit(self._work, first, count)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._executor.shutdown()

    def failure(self, error: BaseException) -> MddagError | None:
        """Report a worker process that is gone."""
        if not isinstance(error, BrokenProcessPool):
            return None
        return SimulationError(
            'jobs: a worker process was killed: free some memory, or give fewer --jobs')


def threads(evaluator: Evaluator, jobs: int) -> Pool:
    """Return a pool of threads of this process."""
    return _LocalPool(ThreadPoolExecutor(jobs), jobs, evaluator)


def processes(experiments: Sequence[Experiment], runs: int, jobs: int) -> Pool:
    """Return a pool of processes of this machine, with the plain core."""
    return _LocalPool(ProcessPoolExecutor(
        jobs, multiprocessing.get_context('spawn'), _start_worker, (experiments, runs)),
        jobs, _work)


_evaluator: Evaluator | None = None  # of this process, if it is a worker


def _start_worker(experiments: Sequence[Experiment], runs: int) -> None:
    global _evaluator
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the first process's to handle
    _evaluator = Evaluator(experiments, runs)


def _work(first: int, count: int) -> Chunk:
    assert _evaluator is not None
    return _evaluator(first, count)
