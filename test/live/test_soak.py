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

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from mddag_executor.live.bench.soak import FAULTS, StallWatch, usage
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
    assert sum(result['faults'][fault] for fault in FAULTS) == result['clean_windows'] >= 3
    assert result['faults']['raised'] == result['faults']['raise'] + 1
    assert result['ran'] > 10_000 and result['jobs'] > 2_000
    assert result['executions'] == result['ran'] + result['dropped']


def test_what_a_process_uses():
    before = usage()
    with open('/dev/null'):
        assert usage()['handles'] == before['handles'] + 1
    assert before['memory'] > 1_000_000 and before['threads'] >= 1


def test_the_watch_for_stalls_ends_with_its_process():
    watch = StallWatch()
    watch.stop()
    watch.stalls = [10, 20]
    assert watch.within(15, 25) and watch.within(10, 11) and not watch.within(11, 20)
