# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Evaluations on a Dask cluster of real processes, one of which is killed in the middle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import os
from pathlib import Path
import signal
import socket
import threading
from typing import Any

from mddag_executor.simulate import cluster as module
from mddag_executor.simulate.cluster import Cluster, ClusterError
from mddag_executor.simulate.evaluate import evaluate, Experiment
from msg_graph import load
import pytest

from .test_evaluate import same

distributed = pytest.importorskip('distributed', reason='the extra dask is not there')
dask = pytest.importorskip('dask', reason='the extra dask is not there')
pytestmark = pytest.mark.timeout(120)

BASE = Experiment(
    load(Path(__file__).parents[2] / 'config' / 'autoware.yaml'), ('rad', 'fifo'),
    duration_ns=200_000_000, seed=7)


@pytest.fixture(scope='module', autouse=True)
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what Dask leaves behind of clusters that these tests make."""
    folder = str(tmp_path_factory.mktemp('dask'))
    with dask.config.set({'temporary-directory': folder}):
        yield


@pytest.fixture(scope='module')
def scheduler() -> Iterator[Any]:
    """Give a cluster of two processes, as somebody else would run it."""
    with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address='127.0.0.1:0',
            silence_logs='CRITICAL') as local:
        yield local


def test_it_changes_nothing(scheduler: Any) -> None:
    experiments = (BASE, replace(BASE, workers=3))
    here = evaluate(experiments, 20, core='plain')
    with Cluster(scheduler.scheduler_address, 1) as cluster:
        there = evaluate(experiments, 20, core='plain', cluster=cluster)
    assert same(here, there) and there.jobs == 2
    assert 0 < here.accepted.mean() < 1


def test_a_worker_is_killed(scheduler: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every run is handed over once; Dask gives what the lost worker had to another."""
    submitted = 0
    submit = module._ClusterPool.submit

    def counting(self: Any, first: int, count: int) -> Any:
        nonlocal submitted
        submitted += count
        return submit(self, first, count)

    monkeypatch.setattr(module._ClusterPool, 'submit', counting)
    monkeypatch.setattr(module._ClusterPool, 'chunk_s', 0.05)
    experiment = replace(BASE, duration_ns=600_000_000)
    runs, killed_at = 60, 0
    with Cluster(scheduler.scheduler_address, 1) as cluster:
        workers = cluster._client.run(os.getpid)

        def kill(done: int) -> None:
            nonlocal killed_at
            if done > 5 and not killed_at:
                killed_at = done
                os.kill(next(iter(workers.values())), signal.SIGKILL)

        there = evaluate(experiment, runs, core='plain', cluster=cluster, progress=kill)
        after = cluster._client.run(os.getpid)
    assert 5 < killed_at < runs / 2
    assert set(after.values()) != set(workers.values())
    assert submitted == runs
    assert same(there, evaluate(experiment, runs, core='plain', jobs=2))


def test_interrupted(scheduler: Any) -> None:
    def stop(done: int) -> None:
        if done > 3:
            raise KeyboardInterrupt

    with Cluster(scheduler.scheduler_address, 1) as cluster:
        outcome = evaluate(BASE, 10_000, core='plain', cluster=cluster, progress=stop)
        assert outcome.interrupted and 3 < outcome.runs < 10_000
        whole = evaluate(BASE, int(outcome.done.nonzero()[0].max()) + 1, core='plain', jobs=2)
        some = outcome.done[:whole.runs]
        assert (outcome.accepted[:, outcome.done] == whole.accepted[:, some]).all()
        # The cluster is still good for something.
        assert same(evaluate(BASE, 4, core='plain', cluster=cluster),
                    evaluate(BASE, 4, core='plain'))


def test_the_scheduler_goes_away() -> None:
    local = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address='127.0.0.1:0',
        silence_logs='CRITICAL')
    with Cluster(local.scheduler_address, 1) as cluster:
        closing = threading.Thread(target=local.close)

        def close(done: int) -> None:
            if done > 1 and not closing.ident:
                closing.start()

        with pytest.raises(ClusterError, match='the connection to the scheduler was lost: check'):
            evaluate(BASE, 100_000, core='plain', cluster=cluster, progress=close)
        closing.join()


def test_another_version(scheduler: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, '__version__', '9.9.9')
    with Cluster(scheduler.scheduler_address, 1) as cluster:
        with pytest.raises(ClusterError, match=r'a worker has mddag_executor .*, and this is 9'):
            evaluate(BASE, 2, core='plain', cluster=cluster)


def test_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, '_WORKER_S', 0.2)
    with distributed.LocalCluster(
            n_workers=0, processes=False, dashboard_address='127.0.0.1:0') as local:
        with pytest.raises(ClusterError, match='the cluster has no workers: start some, as '):
            Cluster(local.scheduler_address, 1)


@pytest.mark.parametrize(('address', 'problem'), [
    ('tcp://127.0.0.1:{free}', 'no Dask scheduler answers there: check the address, and that the'),
    ('127.0.0.1:{silent}', 'no Dask scheduler answers there: '),
    ('nonsense', 'this is no usable address (ValueError: missing port number'),
    ('http://127.0.0.1:80', 'this is no usable address (ValueError: unknown address scheme'),
    ('', 'this is no usable address'),
    ('{worker}', 'this is no Dask scheduler: give the address of one'),
])
def test_addresses(
    scheduler: Any, monkeypatch: pytest.MonkeyPatch, address: str, problem: str
) -> None:
    monkeypatch.setattr(module, 'CONNECT_S', 0.5)
    with socket.socket() as free, socket.socket() as silent:
        free.bind(('127.0.0.1', 0))
        silent.bind(('127.0.0.1', 0))
        silent.listen()
        address = address.format(
            free=free.getsockname()[1], silent=silent.getsockname()[1],
            worker=scheduler.workers[0].worker_address)
        with pytest.raises(ClusterError) as caught:
            Cluster(address, 1)
    assert str(caught.value).startswith(f'--dask {address}: {problem}')
