# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import json
from pathlib import Path
import subprocess
import sys

import pytest
from soak import FAULTS, MEMORY_RATIO

TOP = Path(__file__).resolve().parents[2]


def soak(*arguments, timeout=150.0):
    done = subprocess.run(
        [sys.executable, '-X', 'faulthandler', 'test/endurance/soak.py', *arguments], cwd=TOP,
        text=True, capture_output=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL)
    said = f'status {done.returncode}\n{done.stderr}\n{done.stdout}'
    print(said)  # pytest shows it with a failure
    assert done.stdout and 'Traceback' not in done.stderr, said
    result = json.loads(done.stdout)
    assert done.returncode == (1 if result['failed'] else 0), said
    return result


@pytest.mark.nightly
def test_a_short_soak_loses_nothing_and_keeps_nothing():
    """Deadlines are left to `make soak`: they depend on what else the machine does."""
    result = soak(
        'config/autoware.yaml', '--seconds', '25', '--utilisation', '0.5', '--seed', '3')
    failed = [line for line in result['failed'] if 'deadlines missed' not in line]
    assert failed == []
    assert sum(result['faults'][fault] for fault in FAULTS) == result['clean_windows'] >= 2
    assert result['faults']['raised'] == result['faults']['raise'] + 1
    assert result['ran'] > 10_000 and result['jobs'] > 2_000
    # one that was made ready by the last tick of the simulated time may still wait
    assert 0 <= result['executions'] - result['ran'] - result['dropped'] <= 2
    assert -0.5 < result['memory_growth'] <= MEMORY_RATIO
