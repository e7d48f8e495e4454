# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Evaluations by the workers of a Dask cluster, one of which is killed in the middle."""

from __future__ import annotations

from collections.abc import Iterator
import logging
import os
from pathlib import Path
import signal
from typing import Any

from mddag_executor.laboratory.evaluate import evaluate
from mddag_executor.laboratory.experiment import Experiment
from mddag_executor.simulate import SimulationError
from msg_graph import load
import pytest

from .test_evaluate import same

distributed = pytest.importorskip('distributed', reason='the extra dask is not installed')
EXPERIMENT = Experiment(
    load(Path(__file__).parents[2] / 'config' / 'autoware.yaml'), ('rad', 'fifo'),
    duration_ns=200_000_000)


@pytest.fixture(scope='module')
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Give a cluster of two worker processes."""
    import dask
    folder = str(tmp_path_factory.mktemp('dask'))
    with dask.config.set({'temporary-directory': folder}), distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address='127.0.0.1:0',
            silence_logs=logging.CRITICAL) as cluster:
        yield cluster


@pytest.mark.timeout(120)
def test_the_outcome_is_that_of_this_machine(cluster: Any) -> None:
    """Also if a worker is killed: its runs are made again."""
    victim = next(iter(cluster.workers.values())).process.pid
    killed = []

    def kill(done: int) -> None:
        if not killed and done > 20:
            killed.append(victim)
            os.kill(victim, signal.SIGKILL)

    found = evaluate(
        EXPERIMENT, 300, first_run=7, compiled=False, dask=cluster.scheduler_address,
        progress=kill)
    assert killed and same(found, evaluate(
        EXPERIMENT, 300, first_run=7, compiled=False, jobs=2))


def test_an_address_without_a_scheduler() -> None:
    for address in ('tcp://127.0.0.1:1', 'nonsense'):
        with pytest.raises(SimulationError) as caught:
            evaluate(EXPERIMENT, 2, dask=address)
        assert str(caught.value).startswith(f'--dask {address}: ')
        assert ': check the address, and that the scheduler and workers with ' in str(caught.value)
