# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import json
from pathlib import Path
import subprocess
import sys

import pytest

TOP = Path(__file__).resolve().parents[2]


@pytest.mark.nightly
def test_a_short_soak_loses_nothing_and_keeps_nothing():
    """Deadlines are left to `make soak`: they depend on what else the machine does."""
    done = subprocess.run(
        [sys.executable, '-X', 'faulthandler', 'test/endurance/soak.py', 'config/autoware.yaml',
         '--seconds', '25', '--utilisation', '0.5', '--seed', '3'], cwd=TOP, text=True,
        capture_output=True, timeout=150.0, check=False, stdin=subprocess.DEVNULL)
    said = f'status {done.returncode}\n{done.stderr}\n{done.stdout}'
    assert done.stdout and 'Traceback' not in done.stderr, said
    result = json.loads(done.stdout)
    assert done.returncode == (1 if result['failed'] else 0), said
    assert [line for line in result['failed'] if 'deadlines missed' not in line] == [], said
    faults = result['faults']
    assert faults['raised'] == faults['raise'] + 1
    assert sum(faults.values()) - faults['raised'] == result['clean_windows'] >= 1
    assert result['ran'] > 10_000 and result['jobs'] > 2_000
    # one that was made ready by the last tick of the simulated time may still wait
    assert 0 <= result['ready'] - result['ran'] - result['dropped'] <= 2
    assert -0.5 < result['memory_growth'] <= 0.05
