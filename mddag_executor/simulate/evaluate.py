# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The paper's experiment: many runs with drawn execution times, under several policies.

Theory of operation
-------------------
Each run draws one execution time for each vertex (see ``draws``) and simulates the task set under
every policy with these same times, until the first miss.  A run without a miss is accepted.  As in
the paper only completions are judged, unless told otherwise.

Runs are numbered, and a run's draw depends on nothing but seed and number; so runs are handed out
to workers in chunks, and the result is the same for any number of workers.  With the compiled core
(see ``compiled``) the workers are threads, as it runs without the interpreter's lock; without it
they are processes.  Ctrl-C ends the evaluation after the chunks that are under way, with what is
done.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import (
    Executor,
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
import multiprocessing
import signal
import time
from typing import Any, NamedTuple, Protocol

from mddag_executor.core import policy as find_policy
from mddag_executor.core import Tables
from mddag_executor.core.jobs import finish
from mddag_executor.core.state import new_state
from mddag_executor.simulate.acceptance import Acceptance, BINS, bins_of, Bools
from mddag_executor.simulate.draws import Draws, feasible, Floats, Samples, Times, utilisations
from mddag_executor.simulate.engine import any_missed, run
from mddag_executor.simulate.run import check, periodic_load, Settings, SimulationError
from msg_graph import TaskSet
import numpy as np

DEFAULT_POLICIES = ('rad', 'rm', 'wc', 'fifo')
CORES = ('auto', 'compiled', 'plain')
CHUNK_S = 0.25
"""About how long a worker should take for a chunk: short enough for Ctrl-C and progress."""

_MOST_RUNS = 10 ** 8

# Roughly, to choose the core that is sooner done: plain Python's time for each vertex job, and the
# compiled core's to be loaded and to be compiled.
_PLAIN_S, _LOAD_S, _COMPILE_S = 6e-6, 1.0, 15.0


@dataclass(frozen=True)
class Experiment:
    """
    What to evaluate; it is sent to worker processes as a whole.

    :param policies: names of policies.
    :param preemptive: None runs each policy in its own mode of the paper's experiment.
    :param samples: measured values of each callback (ns); None draws from the quantile tables.
    :param overhead_ns: added to an execution each time it is dispatched.
    """

    task_set: TaskSet
    policies: tuple[str, ...] = DEFAULT_POLICIES
    workers: int = 7
    duration_ns: int = 3_000_000_000
    seed: int = 0
    samples: Samples | None = None
    preemptive: bool | None = None
    overhead_ns: int = 0
    judge: str = 'completions'

    def settings(self, policy: str) -> Settings:
        """Return how to simulate a run under a policy."""
        preemptive = find_policy(policy).preemptive if self.preemptive is None else self.preemptive
        return Settings(
            policy=policy, workers=self.workers, duration_ns=self.duration_ns,
            preemptive=preemptive, judge=self.judge, stop_at_first_miss=True,
            dispatch_overhead_ns=self.overhead_ns)


class Chunk(NamedTuple):
    """
    What came of some consecutive runs.

    ``accepted`` has a row for each policy, a column for each run.
    """

    first: int
    utilisation: Floats
    possible: Bools
    accepted: Bools
    took_s: float

    def size_for(self, seconds: float) -> int:
        """Return how many runs like these take about that long."""
        return max(1, round(len(self.utilisation) * seconds / max(self.took_s, 1e-6)))


Task = Callable[[int, int], Chunk]


class Judge(Protocol):
    """Simulates runs of a task set."""

    def warm_up(self) -> None:
        """Do what has to be done once."""

    def __call__(self, settings: Settings, times: Times) -> Bools:
        """Tell which of the runs with these execution times met every deadline."""


class Evaluator:
    """Evaluates chunks of an experiment; each worker has one."""

    def __init__(self, experiment: Experiment, compiled: bool = False) -> None:
        self._experiment = experiment
        self._settings = [experiment.settings(name) for name in experiment.policies]
        for settings in self._settings:
            check(settings)
        self._draws = Draws(experiment.task_set, experiment.seed, experiment.samples)
        self._judge: Judge
        if compiled:
            from mddag_executor.simulate.compiled import CompiledJudge
            self._judge = CompiledJudge(experiment.task_set, experiment.duration_ns)
        else:
            self._judge = PlainJudge(experiment.task_set, experiment.duration_ns)

    def prepare(self) -> None:
        """Do what has to be done once, before the first run."""
        self._judge.warm_up()

    def __call__(self, first: int, count: int) -> Chunk:
        """Evaluate ``count`` runs from number ``first`` on."""
        task_set, workers = self._experiment.task_set, self._experiment.workers
        duration_ns = self._experiment.duration_ns
        begin = time.monotonic()
        times = self._draws.times(first, count)
        accepted = np.array([self._judge(settings, times) for settings in self._settings])
        return Chunk(
            first, utilisations(task_set, times, workers),
            feasible(task_set, times, workers, duration_ns), accepted, time.monotonic() - begin)


class PlainJudge:
    """Simulates runs in plain Python."""

    def __init__(self, task_set: TaskSet, duration_ns: int) -> None:
        self._tables = Tables.build(task_set)
        load = periodic_load(
            task_set, [[0] * len(dag.vertices) for dag in task_set.dags], duration_ns)
        self._load = load._replace(
            cost_base=[self._tables.first_vertex[dag.index] for dag in task_set.dags])

    def warm_up(self) -> None:
        """Do nothing."""

    def __call__(self, settings: Settings, times: Times) -> Bools:
        """Tell which of the runs met every deadline."""
        tables, policy = self._tables, find_policy(settings.policy)
        accepted = np.zeros(len(times), dtype=np.bool_)
        for row in range(len(times)):
            state = new_state(
                tables, settings.workers, preemptive=bool(settings.preemptive),
                dispatch_overhead=settings.dispatch_overhead_ns,
                switch_overhead=settings.switch_overhead_ns)
            load = self._load._replace(costs=times[row].tolist())
            ended = run(
                tables, state, policy.key, load, settings.duration_ns,
                settings.stop_at_first_miss)
            if settings.judge == 'horizon':
                finish(tables, state, ended)
            accepted[row] = not any_missed(state, 0)
        return accepted


@dataclass
class Evaluation:
    """
    Outcome of an experiment.

    :ivar done: which runs were done; the others' entries in the arrays mean nothing.
    """

    experiment: Experiment
    asked: int
    compiled: bool
    jobs: int
    elapsed_s: float = 0.0
    interrupted: bool = False
    utilisation: Floats = field(init=False)
    possible: Bools = field(init=False)
    accepted: Bools = field(init=False)
    done: Bools = field(init=False)

    def __post_init__(self) -> None:
        """Make room for the runs."""
        self.utilisation = np.zeros(self.asked)
        self.possible = np.zeros(self.asked, dtype=np.bool_)
        self.accepted = np.zeros((len(self.experiment.policies), self.asked), dtype=np.bool_)
        self.done = np.zeros(self.asked, dtype=np.bool_)

    def add(self, chunk: Chunk) -> None:
        """Take a chunk's outcome in."""
        runs = slice(chunk.first, chunk.first + len(chunk.utilisation))
        self.utilisation[runs] = chunk.utilisation
        self.possible[runs] = chunk.possible
        self.accepted[:, runs] = chunk.accepted
        self.done[runs] = True

    @property
    def runs(self) -> int:
        """Count the runs that were done."""
        return int(self.done.sum())

    def by_policy(self) -> dict[str, Acceptance]:
        """Return the acceptance of each policy."""
        bins = bins_of(self.utilisation[self.done])
        return {name: Acceptance(bins, self.accepted[i][self.done])
                for i, name in enumerate(self.experiment.policies)}

    def bound(self) -> Acceptance:
        """Return the acceptance that no scheduler can exceed."""
        return Acceptance(bins_of(self.utilisation[self.done]), self.possible[self.done])

    def counts(self) -> list[int]:
        """Return how many runs each bin has."""
        counts: list[int] = np.bincount(
            bins_of(self.utilisation[self.done]), minlength=len(BINS)).tolist()
        return counts

    def result(self) -> dict[str, Any]:
        """Return the result format of ``evaluate --json``."""
        experiment = self.experiment
        acceptance, bound = self.by_policy(), self.bound()
        return {
            'runs': self.runs, 'elapsed_s': round(self.elapsed_s, 3), 'bins': list(BINS),
            'counts': self.counts(),
            'acceptance': {name: each.ratio for name, each in acceptance.items()},
            'bound': bound.ratio,
            'policies': {
                name: {'preemptive': experiment.settings(name).preemptive, **each.result()}
                for name, each in acceptance.items()},
            'bound_total': bound.total,
            'workers': experiment.workers, 'duration_ns': experiment.duration_ns,
            'seed': experiment.seed, 'overhead_ns': experiment.overhead_ns,
            'judge': experiment.judge, 'samples': experiment.samples is not None,
            'interrupted': self.interrupted, 'compiled': self.compiled, 'jobs': self.jobs}


def evaluate(
    experiment: Experiment,
    runs: int,
    *,
    jobs: int = 1,
    core: str = 'auto',
    progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """
    Evaluate an experiment.

    :param runs: how many runs, each with a draw of its own.
    :param jobs: how many of them to simulate at a time.
    :param core: ``compiled``, ``plain``, or ``auto`` for the one that is sooner done.
    :param progress: told now and then how many runs are done, -1 while the core is compiled.
    :return: the outcome; after a KeyboardInterrupt that of the runs that were done.
    :raises SimulationError: on settings that make no sense.
    :raises mddag_executor.core.PolicyError: when there is no such policy.
    :raises InputError: when a callback declares no execution time.
    """
    if runs < 1:
        raise SimulationError(f'runs: {runs} is too few: give at least 1')
    if runs > _MOST_RUNS:
        raise SimulationError(f'runs: {runs} is too many: give at most {_MOST_RUNS}')
    if jobs < 1:
        raise SimulationError(f'jobs: {jobs} is too few: give at least 1')
    compiled = _compiled(core, experiment, runs, jobs)
    evaluator = Evaluator(experiment, compiled)  # finds what is wrong with the experiment
    outcome = Evaluation(experiment, runs, compiled, jobs)
    begin = time.monotonic()
    pool: Executor
    task: Task = evaluator
    if compiled or jobs == 1:
        pool = ThreadPoolExecutor(jobs)
    else:
        task = _work
        pool = ProcessPoolExecutor(
            jobs, multiprocessing.get_context('spawn'), _start_worker, (experiment,))
    with pool:
        try:
            if compiled:
                _wait(pool.submit(evaluator.prepare), progress)
            _collect(pool, task, outcome, progress)
        except BrokenProcessPool:
            raise SimulationError(
                'jobs: a worker process was killed: free some memory, or give fewer --jobs'
            ) from None
        except KeyboardInterrupt:
            outcome.interrupted = True
    outcome.elapsed_s = time.monotonic() - begin
    return outcome


def _compiled(core: str, experiment: Experiment, runs: int, jobs: int) -> bool:
    """Tell whether to use the compiled core."""
    if core not in CORES:
        raise SimulationError(
            f"core '{core}': there is no such core: choose one of {', '.join(CORES)}")
    if core == 'plain':
        return False
    from mddag_executor.simulate.compiled import available, cached
    if core == 'compiled' and not available():
        raise SimulationError(
            "core: numba, which compiles it, is not there: install 'mddag_executor[batch]' "
            'with pip, or use the plain core')
    if core == 'compiled' or not available():
        return core == 'compiled'
    vertex_jobs = sum(
        -(-experiment.duration_ns // dag.period_ns) * len(dag.vertices)
        for dag in experiment.task_set.dags)
    plain_s = vertex_jobs * len(experiment.policies) * runs * _PLAIN_S / jobs
    return plain_s > _LOAD_S and (plain_s > _COMPILE_S or cached())


def _wait(future: Future[None], progress: Callable[[int], None] | None) -> None:
    while not wait((future,), timeout=0.2).done:
        if progress is not None:
            progress(-1)
    future.result()


_evaluator: Evaluator | None = None  # of this process, if it is a worker


def _start_worker(experiment: Experiment) -> None:
    global _evaluator
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the first process's to handle
    _evaluator = Evaluator(experiment)


def _work(first: int, count: int) -> Chunk:
    assert _evaluator is not None
    return _evaluator(first, count)


def _collect(
    pool: Executor, task: Task, outcome: Evaluation, progress: Callable[[int], None] | None
) -> None:
    """Hand out all runs and take in what comes back."""
    size, started = 1, 0
    pending: set[Future[Chunk]] = set()
    try:
        while started < outcome.asked or pending:
            while started < outcome.asked and len(pending) < 2 * outcome.jobs:
                count = min(size, outcome.asked - started)
                pending.add(pool.submit(task, started, count))
                started += count
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                chunk = future.result()
                outcome.add(chunk)
                # Towards the end smaller ones, so that all workers end at about the same time.
                left = (outcome.asked - started) // (4 * outcome.jobs)
                size = min(chunk.size_for(CHUNK_S), max(chunk.size_for(CHUNK_S / 10), left))
            if progress is not None:
                progress(outcome.runs)
    except KeyboardInterrupt:
        for future in pending:
            if not future.cancel():
                outcome.add(future.result())
        raise
    except BaseException:
        for future in pending:
            future.cancel()
        raise
