# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Runs on more than one machine: chunks as tasks of a Dask cluster.

Theory of operation
-------------------
The experiments travel once to each worker, in a plugin, which the scheduler also gives to workers
that come later or come back.  A task is just place and number of its runs, so when a worker is
lost the scheduler hands its tasks to others, and nothing else is lost.  A worker uses the compiled
core if this machine would and numba is there; the results are the same.

Dask is the extra ``dask``: this module is imported when a cluster is asked for.  Dask's own log is
silenced: what concerns the user becomes one error.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from concurrent.futures import CancelledError, Future
import logging
import tempfile
import threading
import time
from types import TracebackType
from typing import Any
import uuid
import warnings

import dask.config
from distributed import Client, get_worker, KilledWorker, LocalCluster, Security, WorkerPlugin
from distributed.comm import connect
from mddag_executor import __version__
from mddag_executor.errors import MddagError
from mddag_executor.simulate.errors import SimulationError
from mddag_executor.simulate.experiment import Chunk, Evaluator, Experiment
from mddag_executor.simulate.pools import Pool

LOCAL = 'local'
CONNECT_S = 3.0
"""An address has this long to answer."""

_WORKER_S = 10.0  # the first worker may take this long to come
_ALONE_S = 60.0  # an evaluation waits this long without any worker
_REMEDY = 'check the address, and that the scheduler runs'


class ClusterError(SimulationError):
    """A Dask cluster that cannot be used."""


class Cluster:
    """
    A connection to a Dask cluster; a context manager.

    :param address: the scheduler's, as ``tcp://host:8786``, or ``local`` for processes of this
        machine.
    :param jobs: number of processes if it is local.
    :raises ClusterError: it cannot be reached or used.
    """

    def __init__(self, address: str, jobs: int) -> None:
        for name in ('distributed', 'tornado.application', 'asyncio'):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self.address = address
        self._local: Any = None
        self._client: Any = None
        # Dask never removes what it puts there.
        self._folder = tempfile.TemporaryDirectory(
            prefix='mddag-dask-', ignore_cleanup_errors=True)
        try:
            with dask.config.set({'temporary-directory': self._folder.name}):
                self._connect(jobs)
        except BaseException:
            self.close()
            raise

    def _connect(self, jobs: int) -> None:
        target: Any = self.address
        if self.address == LOCAL:
            target = self._local = LocalCluster(
                n_workers=jobs, threads_per_worker=1, processes=True,
                dashboard_address='127.0.0.1:0',  # not the usual port, which may be in use
                silence_logs=logging.CRITICAL)
        else:
            self._probe()
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of versions; what matters is checked on the workers
            self._client = Client(target, timeout=CONNECT_S, set_as_default=False)
        try:
            self._client.wait_for_workers(1, timeout=_WORKER_S)
        except asyncio.TimeoutError:  # the built-in one since Python 3.11
            raise ClusterError(
                f"--dask {self.address}: the cluster has no workers: start some, as 'dask worker "
                f"{self.address}'") from None

    def _probe(self) -> None:
        """Ask who listens there; a Dask client that cannot connect leaves threads and noise."""
        try:
            kind = asyncio.run(asyncio.wait_for(_identity(self.address), 2 * CONNECT_S))
        except Exception as error:  # noqa: B902 - whatever a foreign server's answer causes
            why = 'no Dask scheduler answers there'
            if isinstance(error, ValueError) and str(error):
                why = f'this is no usable address ({_said(error)})'
            raise ClusterError(f'--dask {self.address}: {why}: {_REMEDY}') from None
        if kind != 'Scheduler':
            raise ClusterError(
                f'--dask {self.address}: this is no Dask scheduler: give the address of one')

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Leave the cluster; one of this machine's ends."""
        for each in (self._client, self._local):
            if each is not None:
                each.close(timeout=CONNECT_S)
        self._client = self._local = None
        self._folder.cleanup()

    @property
    def jobs(self) -> int:
        """Return how many threads the workers have now."""
        return sum(self._client.nthreads().values())

    def pool(self, experiments: Sequence[Experiment], runs: int, compiled: bool) -> Pool:
        """Return a pool that lets the cluster do the runs."""
        return _ClusterPool(self._client, self.address, experiments, runs, compiled)


class _ClusterPool(Pool):

    chunk_s = 0.5

    def __init__(
        self, client: Any, address: str, experiments: Sequence[Experiment], runs: int,
        compiled: bool,
    ) -> None:
        self._client = client
        self._address = address
        self._doer = _Doer(tuple(experiments), runs, compiled, address == LOCAL)
        self._executor = client.get_executor(pure=False)
        self._seen_s = self._looked_s = time.monotonic()
        self.jobs = max(1, sum(client.nthreads().values()))

    def __enter__(self) -> Pool:
        try:
            self._client.register_plugin(self._doer, self._doer.name)
        except MddagError:
            raise
        except Exception as error:
            raise ClusterError(
                f'--dask {self._address}: its workers cannot run mddag ({_said(error)}): install '
                f'mddag_executor {__version__} and the same Python there') from None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._executor.shutdown(wait=False)
        try:
            self._client.unregister_worker_plugin(self._doer.name)
        except Exception:  # noqa: B902 - the cluster is gone, or its last worker is
            pass

    def submit(self, first: int, count: int) -> Future[Chunk]:
        """Let a worker do runs."""
        future: Future[Chunk] = self._executor.submit(_work, self._doer.name, first, count)
        return future

    def failure(self, error: BaseException) -> MddagError | None:
        """Report a cluster that is gone, or that kills what it is given."""
        if isinstance(error, KilledWorker):
            return ClusterError(
                f'--dask {self._address}: several workers died on the same runs: give them more '
                'memory')
        lost = 'CancelledError' in type(error).__name__  # Dask has one of its own
        if lost or isinstance(error, (CancelledError, OSError)):
            return ClusterError(
                f'--dask {self._address}: the connection to the scheduler was lost: {_REMEDY}')
        return None

    def check(self) -> None:
        """Count the threads; fail when no worker has been there for long."""
        now = time.monotonic()
        if now < self._looked_s + 1.0:
            return
        self._looked_s = now
        threads = sum(self._client.nthreads().values())
        if threads:
            self.jobs, self._seen_s = threads, now
        elif now > self._seen_s + _ALONE_S:
            raise ClusterError(
                f'--dask {self._address}: all workers are gone: start some, and go on from what '
                'is kept with --resume')


async def _identity(address: str) -> object:
    """Return what a Dask server calls itself: Scheduler, Worker, Nanny."""
    comm = await connect(
        address, timeout=CONNECT_S, **Security().get_connection_args('client'))
    try:
        await comm.write({'op': 'identity', 'reply': True})
        answer = await asyncio.wait_for(comm.read(), CONNECT_S)
        return answer.get('type') if isinstance(answer, dict) else None
    finally:
        comm.abort()


def _said(error: BaseException) -> str:
    text = f'{type(error).__name__}: {error}'
    return ' '.join(text.split())[:160]


class _Doer(WorkerPlugin):  # type: ignore[misc, unused-ignore]
    """What a worker needs to do chunks; made here, used there."""

    def __init__(
        self, experiments: tuple[Experiment, ...], runs: int, compiled: bool, is_local: bool
    ) -> None:
        self.name = f'mddag-{uuid.uuid4().hex}'
        self._experiments = experiments
        self._runs = runs
        self._compiled = compiled
        self._version = __version__
        self._is_local = is_local
        self._evaluator: Evaluator | None = None

    def setup(self, worker: Any) -> None:
        """Make a worker ready that gets this."""
        if self._version != __version__:
            raise ClusterError(
                f'--dask: a worker has mddag_executor {__version__}, and this is {self._version}: '
                'install the same version there')
        if self._is_local and threading.current_thread() is threading.main_thread():
            # The terminal's Ctrl-C is the first process's to handle.
            import signal
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        from mddag_executor.simulate.compiling import available
        self._compiled = self._compiled and available()
        self._evaluator = Evaluator(self._experiments, self._runs, self._compiled)
        self._prepare = threading.Lock()

    def __call__(self, first: int, count: int) -> Chunk:
        assert self._evaluator is not None
        if self._compiled:
            from mddag_executor.simulate.compiled import ACCEPT_RUNS, prepare
            with self._prepare:  # the first one compiles, not the worker's event loop
                prepare(ACCEPT_RUNS)
        return self._evaluator(first, count)


def _work(name: str, first: int, count: int) -> Chunk:
    """Do a chunk; this is what runs on a worker."""
    doer: _Doer = get_worker().plugins[name]
    return doer(first, count)
