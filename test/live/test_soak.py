# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections import deque
import json
from pathlib import Path
import subprocess
import sys
from threading import Thread
from types import SimpleNamespace
from typing import Any
import weakref

from mddag_executor.live import DeadlineMiss
from mddag_executor.live.bench.soak import FAULTS, MEMORY_RATIO, Soak, StallWatch, usage
from mddag_executor.live.bench.soak_memory import in_use, resident
import pytest

TOP = Path(__file__).resolve().parents[2]


def soak(*arguments: str, timeout: float = 150.0) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, '-m', 'mddag_executor.live.bench.soak', *arguments], cwd=TOP, text=True,
        capture_output=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL)
    result: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == (1 if result['failed'] else 0)
    assert 'Traceback' not in done.stderr, done.stderr
    return result


@pytest.mark.slow
@pytest.mark.parametrize('intake', ['events', 'waitset'])
def test_a_short_soak_loses_nothing_and_keeps_nothing(intake: str):
    """Deadlines are left to `make soak`: they depend on what else the machine does."""
    result = soak(
        'config/autoware.yaml', '--seconds', '25', '--utilisation', '0.5', '--seed', '3',
        '--intake', intake)
    failed = [line for line in result['failed'] if 'deadlines missed' not in line]
    assert failed == []
    assert sum(result['faults'][fault] for fault in FAULTS) == result['clean_windows'] >= 2
    assert result['faults']['raised'] == result['faults']['raise'] + 1
    assert result['ran'] > 10_000 and result['jobs'] > 2_000
    # one that was made ready by the last tick of the simulated time may still wait
    assert 0 <= result['executions'] - result['ran'] - result['dropped'] <= 2
    assert -20_000 < result['middleware_keeps'] < 50_000, 'bytes for each node made again'
    assert -0.5 < result['memory_growth'] <= MEMORY_RATIO


def test_what_a_process_uses():
    before = usage()
    with open('/dev/null'):
        assert usage()['handles'] == before['handles'] + 1
    assert before['memory'] > 1_000_000 and before['threads'] >= 1


def test_memory_that_was_freed_is_not_in_use():
    before = in_use()
    blocks = [bytes(10_000) for _ in range(8_000)]
    assert resident() - before > 60_000_000
    kept = blocks[::100]  # so that the C library can't give it all back by itself
    del blocks
    cycle: list[Any] = [Thread()]
    cycle.append(cycle)
    gone = weakref.ref(cycle[0])
    del cycle
    assert in_use() - before < 20_000_000
    assert gone() is None and len(kept) == 80


def test_of_the_misses_those_in_clean_windows_are_kept():
    def miss(release: int, vertex: str) -> DeadlineMiss:
        return DeadlineMiss('dag', vertex, 0, release, release + 1, None, 'expired')

    soak = Soak.__new__(Soak)
    soak._missed, soak._clean_missed, soak._clean = deque(), [], []
    soak._missed.extend([miss(5, 'early'), miss(15, 'before any window')])
    assert soak._sort_out() == 0 and not soak._missed
    soak._clean = [(20, 30, 'burst'), (50, 60, 'destroy')]
    soak._missed.extend([miss(19, 'a'), miss(20, 'b'), miss(29, 'c'), miss(30, 'd'),
                         miss(49, 'e'), miss(55, 'f')])
    assert soak._sort_out() == 3
    soak._missed.append(miss(25, 'told late'))
    assert soak._sort_out() == 1 and not soak._missed
    assert soak._clean_missed == [
        ('burst', miss(20, 'b')), ('burst', miss(29, 'c')), ('destroy', miss(55, 'f')),
        ('burst', miss(25, 'told late'))]


def test_what_the_middleware_keeps_is_left_out_of_the_growth():
    def failures(after: int, keeps: float) -> list[str]:
        soak = Soak.__new__(Soak)
        soak.nodes = SimpleNamespace(started=0)  # type: ignore[assignment]
        usual = {'threads': 1, 'handles': 1}
        result = {'before': {'memory': 100_000_000, **usual},
                  'after': {'memory': after, **usual},
                  'middleware_keeps': keeps, 'faults': {'destroy': 10}, 'clean_misses': 0}
        return soak._failures(result, {'callbacks': {}, 'dags': {}}, [])

    assert failures(104_900_000, 0.0) == []
    assert failures(105_500_000, 0.0) == [
        'memory grew by 5.5% (besides 0 kB that the middleware keeps of nodes made again)']
    assert failures(105_500_000, 60_000.0) == []
    assert len(failures(105_500_000, -60_000.0)) == 1  # noise, and nobody gives back for others


def test_the_watch_for_stalls_ends_with_its_process():
    watch = StallWatch()
    watch.stop()
    watch.stalls = [10, 20]
    assert watch.within(15, 25) and watch.within(10, 11) and not watch.within(11, 20)
