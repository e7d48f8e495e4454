# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The paper's experiment: many runs with drawn execution times, under several policies.

Theory of operation
-------------------
Runs depend on nothing but seed and number (see ``experiment``), so they are handed out to workers
in chunks, and the result is the same for any number of workers, wherever they are (``pools``,
``cluster``).  What is done can be kept in a file now and then (``checkpoint``); an evaluation goes
on from there with the runs that are missing.  Ctrl-C ends it after the chunks that are under way,
with what is done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
import time
from typing import TYPE_CHECKING

from mddag_executor.simulate.checkpoint import Checkpoint
from mddag_executor.simulate.errors import SimulationError
from mddag_executor.simulate.evaluation import Evaluation
from mddag_executor.simulate.experiment import Chunk, Evaluator, Experiment, STRIDE
from mddag_executor.simulate.pools import Pool, processes, threads
from mddag_executor.simulate.schedule import SOON_S
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.simulate.cluster import Cluster

__all__ = ['CORES', 'Evaluation', 'Experiment', 'evaluate', 'uses_compiled']

CORES = ('auto', 'compiled', 'plain')
Progress = Callable[[int], None]

_MOST_RUNS = 10 ** 8
_KEEP_S = 5.0
"""What is done is kept this often."""

# Roughly, to choose the core that is sooner done: plain Python's time for each vertex job.
_PLAIN_S = 6e-6


def evaluate(
    experiment: Experiment | Sequence[Experiment],
    runs: int,
    *,
    jobs: int = 1,
    core: str = 'auto',
    cluster: Cluster | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """
    Evaluate an experiment, or several that differ in their task sets and workers.

    :param runs: how many runs of each experiment, each with a draw of its own.
    :param jobs: how many of them to simulate at a time.
    :param core: ``compiled``, ``plain``, or ``auto`` for the one that is sooner done.
    :param cluster: who does the runs instead of this machine's processors.
    :param checkpoint: goes on from what it holds, and keeps there what is done.
    :param progress: gets now and then how many runs are done.
    :return: the outcome; after a KeyboardInterrupt that of the runs that were done.
    :raises SimulationError: on settings that make no sense.
    :raises mddag_executor.core.PolicyError: when there is no such policy.
    :raises InputError: when a callback declares no execution time, or the checkpoint does not fit.
    """
    experiments = (experiment,) if isinstance(experiment, Experiment) else tuple(experiment)
    _check(experiments, runs, jobs)
    outcome = Evaluation(experiments, runs)
    if checkpoint is not None:
        checkpoint.restore(outcome)
    if cluster is not None:
        jobs = cluster.jobs
    compiled = uses_compiled(core, experiments, outcome.asked - outcome.runs, jobs)
    evaluator = Evaluator(experiments, runs, compiled)
    evaluator.check()
    if core == 'auto' and not compiled and cluster is None and (
            _plain_s(experiments, outcome.asked - outcome.runs) < SOON_S):
        jobs = 1  # it is done before other processes have started
    outcome.compiled, outcome.jobs = compiled, jobs
    begin = time.monotonic()
    pool: Pool
    if cluster is not None:
        pool = cluster.pool(experiments, runs, compiled)
    elif compiled or jobs == 1:
        pool = threads(evaluator, jobs)
    else:
        pool = processes(experiments, runs, jobs)
    try:
        if compiled and cluster is None:
            from mddag_executor.simulate.compiled import ACCEPT_RUNS, prepare
            prepare(ACCEPT_RUNS)
        with pool:
            _collect(pool, outcome, checkpoint, progress)
    except KeyboardInterrupt:
        outcome.interrupted = True
    finally:
        if checkpoint is not None and outcome.runs > outcome.resumed:
            checkpoint.save(outcome)
    outcome.elapsed_s = time.monotonic() - begin
    return outcome


def _check(experiments: Sequence[Experiment], runs: int, jobs: int) -> None:
    if not experiments:
        raise SimulationError('graphs: there is none: name at least one declaration')
    if runs < 1:
        raise SimulationError(f'runs: {runs} is too few: give at least 1')
    if runs * len(experiments) > _MOST_RUNS:
        raise SimulationError(
            f'runs: {runs * len(experiments)} is too many: give at most {_MOST_RUNS}')
    assert _MOST_RUNS < STRIDE
    if jobs < 1:
        raise SimulationError(f'jobs: {jobs} is too few: give at least 1')


def uses_compiled(core: str, experiments: Sequence[Experiment], runs: int, jobs: int) -> bool:
    """
    Return whether to use the compiled core.

    :param runs: number of runs of all experiments together.
    """
    if core not in CORES:
        raise SimulationError(
            f"core '{core}': there is no such core: choose one of {', '.join(CORES)}")
    if core == 'plain':
        return False
    from mddag_executor.simulate.compiled import ACCEPT_RUNS, pays
    from mddag_executor.simulate.compiling import available
    if core == 'compiled' and not available():
        raise SimulationError(
            "core: numba, which compiles it, is not there: install 'mddag_executor[batch]' "
            'with pip, or use the plain core')
    if core == 'compiled' or not available():
        return core == 'compiled'
    plain_s = _plain_s(experiments, runs) / jobs
    return plain_s > SOON_S and pays(ACCEPT_RUNS, plain_s)


def _plain_s(experiments: Sequence[Experiment], runs: int) -> float:
    """Return about how long all runs take one plain core."""
    vertex_jobs = sum(
        -(-experiment.duration_ns // dag.period_ns) * len(dag.vertices)
        for experiment in experiments for dag in experiment.task_set.dags)
    return vertex_jobs * len(experiments[0].policies) * _PLAIN_S / len(experiments) * runs


class _Missing:
    """The runs that are not done and not handed out yet."""

    def __init__(self, outcome: Evaluation) -> None:
        flags = np.concatenate(([True], outcome.done, [True])).astype(np.int8)
        steps = np.diff(flags)
        begins, ends = np.flatnonzero(steps == -1), np.flatnonzero(steps == 1)
        self._gaps = list(zip(begins.tolist(), ends.tolist()))[::-1]
        self.count = int((~outcome.done).sum())

    def take(self, size: int) -> tuple[int, int]:
        """Return place and number of some runs that follow each other, at most ``size``."""
        begin, end = self._gaps.pop()
        count = min(size, end - begin)
        if begin + count < end:
            self._gaps.append((begin + count, end))
        self.count -= count
        return begin, count


def _collect(
    pool: Pool, outcome: Evaluation, checkpoint: Checkpoint | None, progress: Progress | None
) -> None:
    """Hand out all runs that are missing and take in what comes back."""
    missing = _Missing(outcome)
    size, kept_s = 1, time.monotonic()
    pending: set[Future[Chunk]] = set()
    try:
        while missing.count or pending:
            while missing.count and len(pending) < 2 * pool.jobs:
                pending.add(pool.submit(*missing.take(size)))
            done, pending = wait(pending, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in done:
                chunk = future.result()
                outcome.add(chunk)
                # Towards the end smaller ones, so that all workers end at about the same time.
                left = missing.count // (4 * pool.jobs)
                size = min(
                    chunk.size_for(pool.chunk_s), max(chunk.size_for(pool.chunk_s / 10), left))
            pool.check()
            if checkpoint is not None and time.monotonic() > kept_s + _KEEP_S:
                checkpoint.save(outcome)
                kept_s = time.monotonic()
            if progress is not None:
                progress(outcome.runs)
    except KeyboardInterrupt:
        _end(pending, outcome)
        raise
    except BaseException as error:
        for future in pending:
            future.cancel()
        explained = pool.failure(error)
        if explained is None:
            raise
        raise explained from None


def _end(pending: set[Future[Chunk]], outcome: Evaluation) -> None:
    """Call back what has not been begun, and take in what has."""
    for future in [each for each in pending if not each.cancel()]:
        outcome.add(future.result())
