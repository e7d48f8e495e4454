# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The paper's experiment: many runs with drawn execution times, under several policies.

Theory of operation
-------------------
A run depends on nothing but the seed and its number (see ``experiment``). So the runs are divided
into chunks of consecutive numbers, any worker evaluates any chunk, and the outcome is the same for
any number of workers, on this machine or on a Dask cluster. The compiled core releases the
interpreter's lock, so threads run it; the plain one needs processes. Ctrl-C cancels the chunks
that have not begun, and the outcome has the runs that are done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    as_completed,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
import logging
import multiprocessing
import signal
import time
from typing import Any

from mddag_executor import __version__
from mddag_executor.errors import MddagError, UsageError
from mddag_executor.laboratory.acceptance import Evaluation
from mddag_executor.laboratory.draws import Draws
from mddag_executor.laboratory.experiment import Chunk, Evaluator, Experiment, STRIDE
from mddag_executor.simulate.policies import is_of_user
from mddag_executor.simulate.schedule import compiling_pays, PLAIN_S, SOON_S

Submit = Callable[[int, int], 'Future[Chunk]']
"""Starts a number of runs from a place on."""

MOST_RUNS = 10 ** 7
_CHUNK_COMPILED, _CHUNK_PLAIN = 250, 10     # a fraction of a second each
_MOST_CHUNKS = 20_000
_CONNECT_S, _WORKER_S = 5, 10               # what a Dask scheduler and its first worker may need


def evaluate(
    experiment: Experiment | Sequence[Experiment],
    runs: int,
    *,
    first_run: int = 0,
    jobs: int = 1,
    dask: str | None = None,
    compiled: bool | None = None,
    progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """
    Evaluate an experiment, or several that differ in their task sets and workers.

    :param runs: how many runs of each experiment, each with a draw of its own.
    :param first_run: number of the first of them.
    :param jobs: how many chunks of them to simulate at a time, on this machine.
    :param dask: address of the scheduler of a Dask cluster which evaluates them instead.
    :param compiled: whether to use the compiled core; None: if that is faster.
    :param progress: gets now and then how many runs are done.
    :return: the outcome; after a KeyboardInterrupt that of the runs that are done.
    :raises UsageError: on settings that make no sense, or a cluster that cannot be used.
    :raises mddag_executor.core.PolicyError: when there is no such policy.
    :raises InputError: when a callback declares no execution time.
    """
    experiments = (experiment,) if isinstance(experiment, Experiment) else tuple(experiment)
    _check(experiments, runs, first_run)
    of_user = [name for each in experiments for name in each.policies if is_of_user(name)]
    if compiled is None:
        compiled = not of_user and compiling_pays(plain_s(experiments, runs) / jobs)
    if compiled:
        if of_user:
            raise UsageError(f"policy '{of_user[0]}': policies of your own are not compiled: "
                             'leave out compiled=True')
        from mddag_executor.simulate.compiled import check_available, prepare
        check_available()
    if not compiled and dask is None and plain_s(experiments, runs) < SOON_S:
        jobs = 1  # it is done before other processes have started
    evaluator = Evaluator(experiments, runs, first_run, compiled)
    for each in experiments:
        Draws(each.task_set, each.seed, each.samples)   # before any run, if something is missing
    outcome = Evaluation(experiments, runs, first_run, compiled, jobs)
    begin = time.monotonic()
    try:
        if compiled and dask is None:    # here, where Ctrl-C interrupts it
            prepare()
        with _dask(dask, evaluator) if dask is not None else _local(jobs, evaluator) as submit:
            _collect(submit, outcome, progress)
    except KeyboardInterrupt:
        outcome.interrupted = True
    outcome.elapsed_s = time.monotonic() - begin
    return outcome


def _check(experiments: Sequence[Experiment], runs: int, first_run: int) -> None:
    if runs * len(experiments) > MOST_RUNS:
        raise UsageError(f'runs: {runs * len(experiments)} is too many: give at most '
                         f'{MOST_RUNS}, and evaluate more in ranges (--first-run)')
    if not 0 <= first_run < STRIDE - MOST_RUNS:
        raise UsageError(
            f'first run: {first_run} is out of range: give 0 to {STRIDE - MOST_RUNS - 1}')


def plain_s(experiments: Sequence[Experiment], runs: int) -> float:
    """Return about how long all runs take with the plain core, one at a time."""
    vertex_jobs = sum(
        dag.jobs_in(experiment.duration_ns) * len(dag.vertices)
        for experiment in experiments for dag in experiment.task_set.dags)
    return vertex_jobs * len(experiments[0].policies) * PLAIN_S * runs


def _collect(
    submit: Submit, outcome: Evaluation, progress: Callable[[int], None] | None
) -> None:
    """Have all chunks evaluated; after Ctrl-C only those that have begun."""
    size = max(min(_CHUNK_COMPILED if outcome.compiled else _CHUNK_PLAIN,
                   -(-outcome.asked // (8 * outcome.jobs))), outcome.asked // _MOST_CHUNKS, 1)
    pending = [submit(first, min(size, outcome.asked - first))
               for first in range(0, outcome.asked, size)]
    try:
        for future in as_completed(pending):
            outcome.add(future.result())
            if progress is not None:
                progress(outcome.runs)
    except KeyboardInterrupt:
        for future in [each for each in reversed(pending) if not each.cancel()]:
            with suppress(BrokenProcessPool):  # the signal may have ended all processes
                outcome.add(future.result())
        raise
    finally:
        for future in pending:
            future.cancel()


@contextmanager
def _local(jobs: int, evaluator: Evaluator) -> Iterator[Submit]:
    """Give threads of this process, or processes for the plain core."""
    pool: Executor
    if evaluator.compiled or jobs == 1:
        pool = ThreadPoolExecutor(jobs)
    else:
        pool = ProcessPoolExecutor(     # Ctrl-C is for this process to handle
            jobs, multiprocessing.get_context('spawn'), signal.signal,
            (signal.SIGINT, signal.SIG_IGN))
    try:
        with pool:
            yield lambda first, count: pool.submit(evaluator, first, count)
    except BrokenProcessPool:
        raise UsageError('--parallel: a worker process was killed: free some memory, or give a '
                         'smaller number') from None


@contextmanager
def _dask(address: str, evaluator: Evaluator) -> Iterator[Submit]:
    """Give the workers of a Dask cluster; the experiments are sent to each of them once."""
    from distributed import Client
    logging.getLogger('distributed').setLevel(logging.CRITICAL + 1)     # errors become one line
    try:
        with Client(address, timeout=_CONNECT_S, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=_WORKER_S)
            sent = client.scatter(evaluator, broadcast=True)
            yield partial(client.get_executor(pure=False).submit, _on_worker, sent, __version__)
    except MddagError:
        raise
    except (Exception, CancelledError) as error:    # whatever the cluster or its network raises
        said = ' '.join(f'{type(error).__name__}: {error}'.split())[:160]
        raise UsageError(
            f'--dask {address}: {said}: check the address, and that the scheduler and workers '
            f'with mddag_executor {__version__} run there') from None


def _on_worker(evaluator: Any, version: str, first: int, count: int) -> Chunk:
    if version != __version__:
        raise UsageError(f'--dask: a worker has mddag_executor {__version__}, and this is '
                         f'{version}: install the same version there')
    chunk: Chunk = evaluator(first, count)
    return chunk
