# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import gc
import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from limits import BODIES, GcWatch

LIMITS = Path(__file__).with_name('limits.py')


def test_collections_are_noticed():
    with GcWatch() as watch:
        gc.collect()
    gc.collect()
    assert len(watch.pauses) == 1 and watch.pauses[0] > 0


def limits(*arguments: str) -> Any:
    done = subprocess.run(
        [sys.executable, str(LIMITS), *arguments, '--json'],
        capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL)
    assert 'Traceback' not in done.stderr, done.stderr
    return done


def test_the_gil_measurement_has_all_of_its_figures():
    rows = json.loads(limits('gil', '--seconds', '0.2', '--workers', '3').stdout)
    assert [row['callbacks'] for row in rows] == list(BODIES)
    assert all(row['3 workers /s'] > 0 and row['timer late max us'] > 0 for row in rows)


def test_the_gc_measurement_shows_what_freezing_takes_away():
    rows = json.loads(limits('gc', '--seconds', '0.2', '--workers', '2').stdout)
    thawed, frozen = rows
    assert (thawed['freeze_gc'], frozen['freeze_gc']) == ('False', 'True')
    assert frozen['full collection ms'] < thawed['full collection ms'] / 2


def test_a_policy_that_is_not_allowed_is_said_in_one_line():
    done = limits('policy', '--seconds', '0.1', '--workers', '2')
    if done.returncode == 0:
        assert len(json.loads(done.stdout)) == 3
    else:
        assert done.returncode in (1, 2) and 'may not use SCHED_FIFO' in done.stderr
